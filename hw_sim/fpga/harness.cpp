// Drives upb_core clock by clock, under Verilator or (UPB_CXXRTL) as the C++ that Yosys writes: beats from standard
// input, what came of them to standard output.
//
// Input:  little-endian uint32 a beat: bits 0..23 tdata, 24 tlast, 25..26 tuser.
// Output: a Head, then the clock at which each input beat was accepted (uint32), then 16 bytes for each output beat:
//         uint64 with bits 0..47 tdata, 48 tlast, 49..50 tuser; uint32 its clock; uint32 the clock its valid rose.
// Clock 0 is the first after reset. Gaps of the source and stalls of the sink are drawn from a seed; both keep the
// rules of AXI4-Stream, and the core is held to them: what it offers stays until it is taken.
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <memory>
#include <vector>

#ifdef UPB_CXXRTL
#include "upb_core_cxxrtl.cpp"
#else
#include "Vupb_core.h"
#include "verilated.h"
#if VM_TRACE
#if VM_TRACE_SAIF
#include "verilated_saif_c.h"
using TraceFile = VerilatedSaifC;
#else
#include "verilated_vcd_c.h"
using TraceFile = VerilatedVcdC;
#endif
#endif
#endif

namespace {

constexpr int kResetClocks = 64;
constexpr std::uint64_t kForever = 1ull << 62;
constexpr std::uint32_t kMagic = 0x31425055; // "UPB1"

struct Options {
    std::uint64_t columns = 2048, seed = 1, quiet = 4000, max_clocks = 1000000000;
    std::uint64_t gap = 0, stall = 0;              // in 1/65536 of the clocks
    std::uint64_t stuck_from = 0, stuck_until = 0; // clocks in which the sink takes nothing
    const char *trace = nullptr;
};

struct Head {
    std::uint32_t magic, failed; // failed: 1 valid fell before ready, 2 data changed before ready, 3 too many clocks
    std::uint64_t accepted, given, clocks;
    std::uint64_t gaps,
        stalls; // clocks without an offer before the last beat; clocks of a sink that was not ready, before its last
    std::uint64_t events[8]; // columns, frames, short column, long column, short frame, long frame, dropped, overrun
};

struct Given {
    std::uint64_t beat;
    std::uint32_t clock, rose;
};

class Random {
  public:
    explicit Random(std::uint64_t seed) : state_(seed * 0x9E3779B97F4A7C15u + 0x1234567u) {}
    bool once_in(std::uint64_t share) { return (next() & 0xFFFF) < share; }

  private:
    std::uint64_t next() { // xorshift64*
        state_ ^= state_ >> 12;
        state_ ^= state_ << 25;
        state_ ^= state_ >> 27;
        return (state_ * 0x2545F4914F6CDD1Du) >> 32;
    }
    std::uint64_t state_;
};

#ifdef UPB_CXXRTL
// Ports as plain values around the model that Yosys wrote.
class Core {
  public:
    std::uint32_t aclk = 0, aresetn = 0, cfg_columns = 0, s_axis_tvalid = 0, s_axis_tdata = 0, s_axis_tlast = 0,
                  s_axis_tuser = 0;
    std::uint32_t m_axis_tready = 0, s_axis_tready = 0, m_axis_tvalid = 0, m_axis_tlast = 0, m_axis_tuser = 0;
    std::uint64_t m_axis_tdata = 0;
    std::uint32_t ev_column = 0, ev_frame = 0, ev_short_column = 0, ev_long_column = 0;
    std::uint32_t ev_short_frame = 0, ev_long_frame = 0, ev_dropped = 0, ev_overrun = 0;

    void eval() {
        top_.p_aclk.set(aclk);
        top_.p_aresetn.set(aresetn);
        top_.p_cfg__columns.set(cfg_columns);
        top_.p_s__axis__tvalid.set(s_axis_tvalid);
        top_.p_s__axis__tdata.set(s_axis_tdata);
        top_.p_s__axis__tlast.set(s_axis_tlast);
        top_.p_s__axis__tuser.set(s_axis_tuser);
        top_.p_m__axis__tready.set(m_axis_tready);
        top_.step();
        s_axis_tready = value(top_.p_s__axis__tready);
        m_axis_tvalid = value(top_.p_m__axis__tvalid);
        m_axis_tlast = value(top_.p_m__axis__tlast);
        m_axis_tuser = value(top_.p_m__axis__tuser);
        m_axis_tdata = wide(top_.p_m__axis__tdata);
        ev_column = value(top_.p_ev__column);
        ev_frame = value(top_.p_ev__frame);
        ev_short_column = value(top_.p_ev__short__column);
        ev_long_column = value(top_.p_ev__long__column);
        ev_short_frame = value(top_.p_ev__short__frame);
        ev_long_frame = value(top_.p_ev__long__frame);
        ev_dropped = value(top_.p_ev__dropped);
        ev_overrun = value(top_.p_ev__overrun);
    }

  private:
    // A port is a value<N>, or a wire<N> that holds one.
    template <std::size_t N> static std::uint64_t wide(const cxxrtl::value<N> &port) {
        return port.data[0] | (N > 32 ? static_cast<std::uint64_t>(port.data[N > 32 ? 1 : 0]) << 32 : 0);
    }
    template <std::size_t N> static std::uint64_t wide(const cxxrtl::wire<N> &port) { return wide(port.curr); }
    template <class Port> static std::uint32_t value(const Port &port) {
        return static_cast<std::uint32_t>(wide(port));
    }
    cxxrtl_design::p_upb__core top_;
};
#else
using Core = Vupb_core;
#endif

class Bench {
  public:
    Bench(const Options &options, std::vector<std::uint32_t> beats)
        : options_(options), beats_(std::move(beats)), random_(options.seed) {
#if VM_TRACE
        if (options.trace) {
            Verilated::traceEverOn(true);
            core_.trace(&trace_, 99);
            trace_.open(options.trace);
        }
#endif
    }

    int run() {
        reset();
        std::uint64_t idle = 0;
        while (idle < options_.quiet) {
            if (clock_ >= options_.max_clocks)
                head_.failed = 3;
            if (head_.failed)
                break;
            // A sink that is stuck for good ends the run, one that will take again does not.
            const bool waits = clock_ < options_.stuck_until && options_.stuck_until < kForever;
            idle = step() || waits ? 0 : idle + 1;
        }
#if VM_TRACE
        if (options_.trace)
            trace_.close();
#endif
        return write();
    }

  private:
    void half(int level) {
        core_.aclk = level != 0;
        core_.eval();
#if VM_TRACE
        if (options_.trace)
            trace_.dump(time_);
#endif
        time_++;
    }

    void reset() {
        core_.aresetn = 0;
        core_.cfg_columns = static_cast<std::uint16_t>(options_.columns);
        core_.s_axis_tvalid = 0;
        core_.m_axis_tready = 0;
        for (int n = 0; n < kResetClocks; n++) {
            half(0);
            half(1);
        }
        core_.aresetn = 1;
    }

    // One clock. Inputs change after the rising edge; returns whether anything moved.
    bool step() {
        half(0);
        offer();
        core_.eval();
        const bool in = core_.s_axis_tvalid && core_.s_axis_tready;
        const bool out = core_.m_axis_tvalid && core_.m_axis_tready;
        check();
        if (in)
            accepted_.push_back(static_cast<std::uint32_t>(clock_));
        if (out)
            given_.push_back({beat(), static_cast<std::uint32_t>(clock_), rose_});
        count();
        tally(out);
        was_valid_ = core_.m_axis_tvalid && !out;
        was_beat_ = beat();
        half(1);
        if (in) {
            next_++;
            offering_ = false;
        }
        clock_++;
        return in || out;
    }

    void offer() {
        if (!offering_ && next_ < beats_.size())
            offering_ = !random_.once_in(options_.gap);
        core_.s_axis_tvalid = offering_;
        if (offering_) {
            const std::uint32_t word = beats_[next_];
            core_.s_axis_tdata = word & 0xFFFFFF;
            core_.s_axis_tlast = (word >> 24) & 1;
            core_.s_axis_tuser = (word >> 25) & 3;
        }
        const bool stuck = clock_ >= options_.stuck_from && clock_ < options_.stuck_until;
        core_.m_axis_tready = !stuck && !random_.once_in(options_.stall);
    }

    std::uint64_t beat() const {
        return static_cast<std::uint64_t>(core_.m_axis_tdata) | static_cast<std::uint64_t>(core_.m_axis_tlast) << 48 |
               static_cast<std::uint64_t>(core_.m_axis_tuser) << 49;
    }

    void check() {
        if (was_valid_ && !core_.m_axis_tvalid)
            head_.failed = 1;
        if (was_valid_ && beat() != was_beat_)
            head_.failed = 2;
        if (core_.m_axis_tvalid && !was_valid_)
            rose_ = static_cast<std::uint32_t>(clock_);
    }

    // Stalls after the last output beat delay nothing: they count once another beat is taken.
    void tally(bool out) {
        head_.gaps += next_ < beats_.size() && !core_.s_axis_tvalid;
        pending_stalls_ += !core_.m_axis_tready;
        if (out) {
            head_.stalls += pending_stalls_;
            pending_stalls_ = 0;
        }
    }

    void count() {
        const std::uint64_t now[8] = {core_.ev_column,      core_.ev_frame,       core_.ev_short_column,
                                      core_.ev_long_column, core_.ev_short_frame, core_.ev_long_frame,
                                      core_.ev_dropped,     core_.ev_overrun};
        for (int n = 0; n < 8; n++)
            head_.events[n] += now[n];
    }

    int write() {
        head_.magic = kMagic;
        head_.accepted = accepted_.size();
        head_.given = given_.size();
        head_.clocks = clock_;
        const bool done =
            std::fwrite(&head_, sizeof head_, 1, stdout) == 1 &&
            std::fwrite(accepted_.data(), sizeof accepted_[0], accepted_.size(), stdout) == accepted_.size() &&
            std::fwrite(given_.data(), sizeof given_[0], given_.size(), stdout) == given_.size();
        return done && std::fflush(stdout) == 0 ? 0 : 2;
    }

    Options options_;
    std::vector<std::uint32_t> beats_;
    Random random_;
#if VM_TRACE
    TraceFile trace_;
#endif
    Core core_;
    std::uint64_t clock_ = 0, time_ = 0, was_beat_ = 0, pending_stalls_ = 0;
    std::size_t next_ = 0;
    bool offering_ = false, was_valid_ = false;
    std::uint32_t rose_ = 0;
    std::vector<std::uint32_t> accepted_;
    std::vector<Given> given_;
    Head head_{};
};

bool parse(int argc, char **argv, Options &options) {
    struct {
        const char *name;
        std::uint64_t *value;
    } const numbers[] = {
        {"--columns", &options.columns},
        {"--seed", &options.seed},
        {"--quiet", &options.quiet},
        {"--max-clocks", &options.max_clocks},
        {"--gap", &options.gap},
        {"--stall", &options.stall},
        {"--stuck-from", &options.stuck_from},
        {"--stuck-until", &options.stuck_until},
    };
    for (int n = 1; n + 1 < argc; n += 2) {
        bool known = std::strcmp(argv[n], "--trace") == 0;
        if (known)
            options.trace = argv[n + 1];
        for (const auto &number : numbers)
            if (std::strcmp(argv[n], number.name) == 0) {
                *number.value = std::strtoull(argv[n + 1], nullptr, 10);
                known = true;
            }
        if (!known)
            return false;
    }
    return argc % 2 == 1;
}

std::vector<std::uint32_t> read_beats() {
    std::vector<std::uint32_t> beats;
    std::uint32_t buffer[4096];
    while (const std::size_t got = std::fread(buffer, sizeof buffer[0], 4096, stdin))
        beats.insert(beats.end(), buffer, buffer + got);
    return beats;
}

} // namespace

int main(int argc, char **argv) {
    Options options;
    if (!parse(argc, argv, options)) {
        std::fprintf(stderr, "options come in pairs of a name and a value\n");
        return 2;
    }
    return std::make_unique<Bench>(options, read_beats())->run();
}
