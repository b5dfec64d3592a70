// Python module upbeam.power.bench._native: the benchmark's C part.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <cstdlib>
#include <memory>
#include <stdexcept>
#include <string>
#include <vector>

#include "bench.h"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

using DistanceIn = nb::ndarray<const uint16_t, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
using IntensityIn = nb::ndarray<const uint8_t, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
using Times = nb::ndarray<nb::numpy, uint64_t, nb::ndim<1>>;

constexpr uint32_t ISAS = 8;

void check(upb_status status, const upb_error &error) {
    if (status == UPB_OK)
        return;
    std::string text = upb_status_text(status);
    if (error.what[0] != '\0')
        text = std::string(error.what) + ": " + text;
    throw nb::value_error(text.c_str());
}

struct Free {
    void operator()(void *p) const { std::free(p); }
};
using Memory = std::unique_ptr<void, Free>;

Memory aligned(size_t bytes, size_t alignment) {
    void *p = nullptr;
    if (posix_memalign(&p, alignment, bytes) != 0)
        throw std::bad_alloc();
    return Memory(p);
}

Times to_array(std::vector<uint64_t> *values) {
    nb::capsule owner(values, [](void *p) noexcept { delete static_cast<std::vector<uint64_t> *>(p); });
    return Times(values->data(), {values->size()}, owner);
}

// One piece of work to time, with a model of its own.
class Job {
  public:
    Job(const nb::bytes &ubm, uint32_t precision, uint32_t cpu, uint32_t work, uint32_t threads,
        const DistanceIn &distance, const IntensityIn &intensity)
        : model_memory_(aligned(upb_model_bytes(), UPB_ALIGN)), columns_(distance.shape(0)) {
        upb_error error = {};
        upb_model *model = nullptr;
        if (distance.shape(1) != UPB_BEAMS || intensity.shape(1) != UPB_BEAMS || intensity.shape(0) != columns_)
            throw nb::value_error("distance and intensity must be [columns, 32]");
        check(upb_model_load(model_memory_.get(), upb_model_bytes(), ubm.c_str(), ubm.size(), &model, &error), error);
        check(bench_job_make(model, static_cast<upb_precision>(precision), static_cast<upb_cpu>(cpu),
                             static_cast<bench_work>(work), threads, static_cast<uint32_t>(columns_), distance.data(),
                             intensity.data(), &job_, &error),
              error);
    }
    ~Job() { bench_job_free(job_); }
    Job(const Job &) = delete;
    Job &operator=(const Job &) = delete;

    Times time(uint32_t repeats) {
        auto *ns = new std::vector<uint64_t>(repeats);
        {
            nb::gil_scoped_release release;
            bench_job_time(job_, repeats, ns->data());
        }
        return to_array(ns);
    }

    nb::tuple output() const {
        const size_t count = columns_ * UPB_BEAMS;
        const uint16_t *d = bench_job_distance(job_);
        const uint8_t *i = bench_job_intensity(job_);
        auto *distance = new std::vector<uint16_t>(d, d + count);
        auto *intensity = new std::vector<uint8_t>(i, i + count);
        nb::capsule d_owner(distance, [](void *p) noexcept { delete static_cast<std::vector<uint16_t> *>(p); });
        nb::capsule i_owner(intensity, [](void *p) noexcept { delete static_cast<std::vector<uint8_t> *>(p); });
        return nb::make_tuple(
            nb::ndarray<nb::numpy, uint16_t, nb::ndim<2>>(distance->data(), {columns_, UPB_BEAMS}, d_owner),
            nb::ndarray<nb::numpy, uint8_t, nb::ndim<2>>(intensity->data(), {columns_, UPB_BEAMS}, i_owner));
    }

    nb::dict latency(uint64_t pushes, uint64_t interval_ns) {
        auto histogram = std::make_unique<upb_histogram>();
        uint64_t timer_ns = 0;
        {
            nb::gil_scoped_release release;
            bench_job_latency(job_, pushes, interval_ns, histogram.get(), &timer_ns);
        }
        nb::dict d;
        d["columns"] = histogram->count;
        d["p50_ns"] = upb_histogram_quantile(histogram.get(), 500000);
        d["p99_ns"] = upb_histogram_quantile(histogram.get(), 990000);
        d["p999_ns"] = upb_histogram_quantile(histogram.get(), 999000);
        d["max_ns"] = histogram->max_ns;
        d["timer_ns"] = timer_ns;
        return d;
    }

  private:
    Memory model_memory_;
    size_t columns_;
    bench_job *job_ = nullptr;
};

std::vector<const bench_isa *> isas() {
    const bench_isa *found[ISAS];
    return {found, found + bench_isas(found, ISAS)};
}

nb::list loop_names() {
    nb::list names;
    for (const bench_isa *isa : isas())
        for (uint32_t k = 0; k < isa->loop_count; ++k)
            names.append(nb::make_tuple(isa->name, isa->loops[k].kind, isa->loops[k].per_round));
    return names;
}

const bench_loop &find_loop(const std::string &name, const std::string &kind) {
    for (const bench_isa *isa : isas())
        for (uint32_t k = 0; k < isa->loop_count; ++k)
            if (isa->name == name && isa->loops[k].kind == kind)
                return isa->loops[k];
    throw nb::value_error(("no loop " + kind + " for " + name + " on this machine").c_str());
}

double loop_ns(const std::string &isa, const std::string &kind, size_t bytes, uint32_t repeats) {
    constexpr size_t page = 4096;
    const bench_loop &loop = find_loop(isa, kind);
    const size_t size = bytes < page ? page : bytes / page * page;
    const Memory memory = aligned(size, page);
    std::fill_n(static_cast<unsigned char *>(memory.get()), size, static_cast<unsigned char>(1));
    nb::gil_scoped_release release;
    return bench_loop_ns(&loop, memory.get(), size, repeats);
}

nb::dict counts(const uint16_t *count) {
    nb::dict d;
    for (uint32_t kind = 0; kind < BENCH_KINDS; ++kind)
        if (count[kind] != 0)
            d[bench_kind_name(kind)] = static_cast<uint32_t>(count[kind]);
    return d;
}

nb::list mixes() {
    nb::list all;
    for (const bench_isa *isa : isas())
        for (uint32_t k = 0; k < isa->mix_count; ++k) {
            const bench_mix &mix = isa->mixes[k];
            nb::dict d;
            d["isa"] = isa->name;
            d["precision"] = mix.precision;
            d["windows"] = mix.windows;
            d["pair"] = counts(mix.pair);
            d["leaky"] = counts(mix.leaky);
            d["rest"] = counts(mix.rest);
            all.append(d);
        }
    return all;
}

double mix_ns(const std::string &name, const std::string &precision, uint32_t plain_pairs, uint32_t leaky_pairs,
              uint32_t repeats) {
    for (const bench_isa *isa : isas())
        for (uint32_t k = 0; k < isa->mix_count; ++k)
            if (isa->name == name && isa->mixes[k].precision == precision) {
                nb::gil_scoped_release release;
                return bench_mix_ns(&isa->mixes[k], plain_pairs, leaky_pairs, repeats);
            }
    throw nb::value_error(("no mix " + precision + " for " + name + " on this machine").c_str());
}

Times time_call(uintptr_t call, uintptr_t argument, uint32_t repeats) {
    auto *ns = new std::vector<uint64_t>(repeats);
    {
        nb::gil_scoped_release release;
        bench_time_call(reinterpret_cast<void (*)(void *)>(call), reinterpret_cast<void *>(argument), repeats,
                        ns->data());
    }
    return to_array(ns);
}

} // namespace

NB_MODULE(_native, m) {
    m.doc() = "Loops that measure this machine, and times of the kernels: see bench.h.";
    nb::class_<Job>(m, "Job", "One piece of work to time: a frame of aligned columns [columns, 32].")
        .def(nb::init<const nb::bytes &, uint32_t, uint32_t, uint32_t, uint32_t, const DistanceIn &,
                      const IntensityIn &>(),
             "ubm"_a, "precision"_a, "cpu"_a, "work"_a, "threads"_a, "distance"_a, "intensity"_a)
        .def("time", &Job::time, "repeats"_a, "Nanoseconds of each of `repeats` runs.")
        .def("output", &Job::output, "Generated counts and intensities [columns, 32] of the last run, kernels only.")
        .def("latency", &Job::latency, "pushes"_a, "interval_ns"_a, "Quantiles of the time from push to sink.");
    m.def("loop_names", &loop_names, "(isa, kind, multiply-adds or bytes of a round) of this machine's loops.");
    m.def("loop_ns", &loop_ns, "isa"_a, "kind"_a, "bytes"_a = 4096, "repeats"_a = 5, "Nanoseconds of a round.");
    m.def("mixes", &mixes, "This machine's mixes of operations: isa, precision, windows, pair, leaky, rest.");
    m.def("mix_ns", &mix_ns, "isa"_a, "precision"_a, "plain_pairs"_a, "leaky_pairs"_a, "repeats"_a = 5,
          "Nanoseconds of a block; pairs of hidden units of both networks together.");
    m.def("clock_ghz", &bench_clock_ghz, "repeats"_a = 5);
    m.def("time_call", &time_call, "call"_a, "argument"_a, "repeats"_a,
          "Nanoseconds of each of `repeats` calls of the C function at address `call` with a pointer.");
}
