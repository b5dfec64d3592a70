// upb_ulx3s as a shared library: bytes at its headers and at its serial port, clock by clock.
//
// A byte in: bits 0..7 data, 8 last, 9..10 user. A byte out: the same. The serial port sends and receives bit by bit.
#include <cstddef>
#include <cstdint>
#include <deque>
#include <vector>

#include "Vupb_ulx3s.h"
#include "verilated.h"

namespace {

constexpr int kDivider = 8; // clocks a bit: of the parameter DIVIDER

class Board {
  public:
    Board() { top_.btn_pwr_n = top_.ftdi_txd = 1; }

    void clocks(std::uint64_t count) {
        while (count--)
            step();
    }

    std::deque<std::uint16_t> in;
    std::vector<std::uint16_t> out;
    std::deque<std::uint8_t> serial_in;
    std::vector<std::uint8_t> serial_out;
    bool irq() const { return top_.irq; }
    void press(bool down) { top_.btn_pwr_n = !down; }
    int bad_stops = 0;
    std::uint32_t stall = 0; // in 1/65536 of the clocks

  private:
    void step() {
        top_.clk_25mhz = 0;
        state_ = state_ * 6364136223846793005u + 1442695040888963407u;
        top_.in_valid = !in.empty();
        if (!in.empty()) {
            top_.in_data = in.front() & 0xFF;
            top_.in_last = in.front() >> 8 & 1;
            top_.in_user = in.front() >> 9 & 3;
        }
        top_.out_ready = (state_ >> 40 & 0xFFFF) >= stall;
        send();
        top_.eval();
        receive();
        const bool taken = top_.in_valid && top_.in_ready;
        if (top_.out_valid && top_.out_ready)
            out.push_back(static_cast<std::uint16_t>(top_.out_data | top_.out_last << 8 | top_.out_user << 9));
        top_.clk_25mhz = 1;
        top_.eval();
        if (taken)
            in.pop_front();
    }

    void send() {
        if (send_left_ == 0 && !serial_in.empty()) {
            frame_ = static_cast<std::uint32_t>(serial_in.front()) << 1 | 0x200;
            serial_in.pop_front();
            send_left_ = 10 * kDivider;
        }
        top_.ftdi_txd = 1;
        if (send_left_) {
            top_.ftdi_txd = frame_ >> ((10 * kDivider - send_left_) / kDivider) & 1;
            send_left_--;
        }
    }

    void receive() {
        if (receive_at_ < 0) {
            if (!top_.ftdi_rxd)
                receive_at_ = 0, byte_ = 0;
            return;
        }
        receive_at_++;
        if (receive_at_ % kDivider != kDivider / 2)
            return;
        const int bit = receive_at_ / kDivider;
        if (bit >= 1 && bit <= 8)
            byte_ |= static_cast<std::uint32_t>(top_.ftdi_rxd) << (bit - 1);
        if (bit == 9) {
            bad_stops += !top_.ftdi_rxd;
            serial_out.push_back(static_cast<std::uint8_t>(byte_));
            receive_at_ = -1;
        }
    }

    Vupb_ulx3s top_;
    std::uint64_t state_ = 1;
    std::uint32_t frame_ = 0, byte_ = 0;
    int send_left_ = 0, receive_at_ = -1;
};

Board &board(void *b) { return *static_cast<Board *>(b); }

} // namespace

extern "C" {
void *board_new() { return new Board; }
void board_delete(void *b) { delete static_cast<Board *>(b); }
void board_clocks(void *b, std::uint64_t count) { board(b).clocks(count); }
void board_feed(void *b, const std::uint16_t *bytes, std::size_t count) {
    board(b).in.insert(board(b).in.end(), bytes, bytes + count);
}
std::size_t board_given(void *b) { return board(b).out.size(); }
void board_take(void *b, std::uint16_t *bytes) {
    for (std::size_t n = 0; n < board(b).out.size(); n++)
        bytes[n] = board(b).out[n];
    board(b).out.clear();
}
void board_send(void *b, const std::uint8_t *bytes, std::size_t count) {
    board(b).serial_in.insert(board(b).serial_in.end(), bytes, bytes + count);
}
std::size_t board_received(void *b) { return board(b).serial_out.size(); }
void board_receive(void *b, std::uint8_t *bytes) {
    for (std::size_t n = 0; n < board(b).serial_out.size(); n++)
        bytes[n] = board(b).serial_out[n];
    board(b).serial_out.clear();
}
int board_irq(void *b) { return board(b).irq(); }
int board_bad_stops(void *b) { return board(b).bad_stops; }
void board_press(void *b, int down) { board(b).press(down != 0); }
void board_stall(void *b, std::uint32_t share) { board(b).stall = share; }
}
