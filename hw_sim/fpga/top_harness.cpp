// upb_top as a shared library: what a host and a sensor would do at its ports, clock by clock, for software under test.
//
// Registers: a manager of AXI4-Lite, one access at a time, with delays drawn from a seed between its channels; each
// access lets the clock run until it is answered. Streams: beats wait in a queue until the core takes them, what the
// core gives is kept; both sides stall as told. The rules of both buses are checked at every clock; the first one that
// is broken is kept (upb_sim_failure).
//
// A beat in: bits 0..23 tdata, 24 tlast, 25..26 tuser. A beat out: bits 0..47 tdata, 48 tlast, 49..50 tuser.
#include <cstddef>
#include <cstdint>
#include <deque>
#include <memory>
#include <vector>

#include "Vupb_top.h"
#include "verilated.h"

namespace {

constexpr int kResetClocks = 4, kAnswerClocks = 1000;

// A valid that was not answered must stay, and what it carries with it.
class Held {
  public:
    bool broken(bool valid, bool ready, std::uint64_t payload) {
        const bool fault = waiting_ && (!valid || payload != payload_);
        waiting_ = valid && !ready;
        payload_ = payload;
        return fault;
    }

  private:
    bool waiting_ = false;
    std::uint64_t payload_ = 0;
};

class Sim {
  public:
    explicit Sim(std::uint64_t seed) : state_(seed * 0x9E3779B97F4A7C15u + 1) {
        top_.aresetn = 0;
        clocks(kResetClocks);
        top_.aresetn = 1;
        clocks(2);
    }

    void clocks(std::uint64_t count) {
        while (count--)
            step();
    }

    // The response (0 OKAY, 2 SLVERR), or -1 where none came.
    int write(std::uint32_t address, std::uint32_t value, std::uint32_t strobe) {
        clocks(next() % 3);
        int address_in = static_cast<int>(next() % 4), data_in = static_cast<int>(next() % 4),
            answer_in = static_cast<int>(next() % 4);
        bool address_done = false, data_done = false;
        for (int n = 0; n < kAnswerClocks; n++) {
            top_.s_axil_awvalid = !address_done && n >= address_in;
            top_.s_axil_awaddr = address & 0x7FFF;
            top_.s_axil_wvalid = !data_done && n >= data_in;
            top_.s_axil_wdata = value;
            top_.s_axil_wstrb = strobe & 15;
            top_.s_axil_bready = n >= answer_in;
            low();
            const bool address_now = top_.s_axil_awvalid && top_.s_axil_awready,
                       data_now = top_.s_axil_wvalid && top_.s_axil_wready;
            const bool answered = top_.s_axil_bvalid && top_.s_axil_bready;
            const int response = top_.s_axil_bresp;
            if (answered && !(address_done && data_done))
                fail(5);
            high();
            address_done = address_done || address_now;
            data_done = data_done || data_now;
            if (answered) {
                quiet();
                return response;
            }
        }
        quiet();
        return -1;
    }

    int read(std::uint32_t address, std::uint32_t *value) {
        clocks(next() % 3);
        const int answer_in = static_cast<int>(next() % 4);
        bool done = false;
        for (int n = 0; n < kAnswerClocks; n++) {
            top_.s_axil_arvalid = !done;
            top_.s_axil_araddr = address & 0x7FFF;
            top_.s_axil_rready = n >= answer_in;
            low();
            const bool now = top_.s_axil_arvalid && top_.s_axil_arready;
            const bool answered = top_.s_axil_rvalid && top_.s_axil_rready;
            const int response = top_.s_axil_rresp;
            if (answered)
                *value = top_.s_axil_rdata;
            if (answered && !done)
                fail(6);
            high();
            done = done || now;
            if (answered) {
                quiet();
                return response;
            }
        }
        quiet();
        return -1;
    }

    std::deque<std::uint32_t> in;
    std::vector<std::uint64_t> out;
    std::uint32_t gap = 0, stall = 0; // in 1/65536 of the clocks
    bool stuck = false;               // the sink takes nothing
    int failure = 0;
    std::uint64_t clock = 0;
    std::uint64_t last_taken = 0, last_given = 0; // clocks
    bool irq() const { return top_.irq; }

  private:
    void step() {
        low();
        high();
    }

    void low() {
        top_.aclk = 0;
        if (!offering_ && !in.empty() && top_.aresetn)
            offering_ = !once_in(gap);
        top_.s_axis_tvalid = offering_;
        if (offering_) {
            top_.s_axis_tdata = in.front() & 0xFFFFFF;
            top_.s_axis_tlast = (in.front() >> 24) & 1;
            top_.s_axis_tuser = (in.front() >> 25) & 3;
        }
        top_.m_axis_tready = !stuck && !once_in(stall);
        top_.eval();
        if (top_.aresetn)
            check();
    }

    void high() {
        const bool taken = top_.s_axis_tvalid && top_.s_axis_tready;
        if (taken)
            last_taken = clock;
        if (top_.m_axis_tvalid && top_.m_axis_tready) {
            out.push_back(beat());
            last_given = clock;
        }
        top_.aclk = 1;
        top_.eval();
        if (taken) {
            in.pop_front();
            offering_ = false;
        }
        clock++;
    }

    std::uint64_t beat() const {
        return static_cast<std::uint64_t>(top_.m_axis_tdata) | static_cast<std::uint64_t>(top_.m_axis_tlast) << 48 |
               static_cast<std::uint64_t>(top_.m_axis_tuser) << 49;
    }

    void check() {
        // A core that is disabled drops what it has: a valid may fall with it.
        if (stream_.broken(top_.m_axis_tvalid, top_.m_axis_tready || disabling_, beat()))
            fail(1);
        if (b_.broken(top_.s_axil_bvalid, top_.s_axil_bready, top_.s_axil_bresp))
            fail(3);
        if (r_.broken(top_.s_axil_rvalid, top_.s_axil_rready,
                      static_cast<std::uint64_t>(top_.s_axil_rdata) << 2 | top_.s_axil_rresp))
            fail(4);
    }

    void quiet() {
        top_.s_axil_awvalid = top_.s_axil_wvalid = top_.s_axil_bready = top_.s_axil_arvalid = top_.s_axil_rready = 0;
    }
    void fail(int what) {
        if (!failure)
            failure = what;
    }
    std::uint64_t next() { // xorshift64*
        state_ ^= state_ >> 12;
        state_ ^= state_ << 25;
        state_ ^= state_ >> 27;
        return (state_ * 0x2545F4914F6CDD1Du) >> 33;
    }
    bool once_in(std::uint64_t share) { return (next() & 0xFFFF) < share; }

  public:
    bool disabling_ = false;

  private:
    std::uint64_t state_;
    Vupb_top top_;
    Held stream_, b_, r_;
    bool offering_ = false;
};

} // namespace

extern "C" {

void *upb_sim_new(std::uint64_t seed) { return new Sim(seed); }
void upb_sim_delete(void *sim) { delete static_cast<Sim *>(sim); }

int upb_sim_access_read(void *sim, std::uint32_t address, std::uint32_t *value) {
    return static_cast<Sim *>(sim)->read(address, value);
}
int upb_sim_access_write(void *sim, std::uint32_t address, std::uint32_t value, std::uint32_t strobe) {
    return static_cast<Sim *>(sim)->write(address, value, strobe);
}

// The bus of upb_fpga.h: 0, or the response.
int upb_sim_bus_read(void *sim, std::uint32_t address, std::uint32_t *value) {
    return upb_sim_access_read(sim, address, value);
}
int upb_sim_bus_write(void *sim, std::uint32_t address, std::uint32_t value) {
    return upb_sim_access_write(sim, address, value, 15);
}

void upb_sim_clocks(void *sim, std::uint64_t count) { static_cast<Sim *>(sim)->clocks(count); }
void upb_sim_feed(void *sim, const std::uint32_t *beats, std::size_t count) {
    auto &in = static_cast<Sim *>(sim)->in;
    in.insert(in.end(), beats, beats + count);
}
std::size_t upb_sim_waiting(void *sim) { return static_cast<Sim *>(sim)->in.size(); }
std::size_t upb_sim_given(void *sim) { return static_cast<Sim *>(sim)->out.size(); }
void upb_sim_take(void *sim, std::uint64_t *beats) {
    auto &out = static_cast<Sim *>(sim)->out;
    for (std::size_t n = 0; n < out.size(); n++)
        beats[n] = out[n];
    out.clear();
}
void upb_sim_traffic(void *sim, std::uint32_t gap, std::uint32_t stall, int stuck) {
    auto *s = static_cast<Sim *>(sim);
    s->gap = gap;
    s->stall = stall;
    s->stuck = stuck != 0;
}
void upb_sim_may_drop(void *sim, int yes) { static_cast<Sim *>(sim)->disabling_ = yes != 0; }
int upb_sim_irq(void *sim) { return static_cast<Sim *>(sim)->irq(); }
int upb_sim_failure(void *sim) { return static_cast<Sim *>(sim)->failure; }
std::uint64_t upb_sim_clock(void *sim) { return static_cast<Sim *>(sim)->clock; }
std::uint64_t upb_sim_last_taken(void *sim) { return static_cast<Sim *>(sim)->last_taken; }
std::uint64_t upb_sim_last_given(void *sim) { return static_cast<Sim *>(sim)->last_given; }
}
