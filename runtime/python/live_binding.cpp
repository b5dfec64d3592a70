// The real-time runner for NumPy arrays. A run owns references to its arrays; the GIL is released while it runs.
#include "handles.h"

#include <nanobind/ndarray.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <cstring>
#include <memory>
#include <type_traits>
#include <utility>
#include <vector>

#include "upb_live.h"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

using DistanceFrames = nb::ndarray<const uint16_t, nb::shape<-1, -1, UPB_BEAMS>, nb::c_contig, nb::device::cpu>;
using IntensityFrames = nb::ndarray<const uint8_t, nb::shape<-1, -1, UPB_BEAMS>, nb::c_contig, nb::device::cpu>;
using Numbers = std::vector<uint64_t>;

void check_live(upb_live_status status, const upb_error &error) {
    if (status == UPB_LIVE_OK)
        return;
    if (status == UPB_LIVE_E_LIBRARY)
        check(error.status, &error);
    std::string text = upb_live_status_text(status);
    if (status == UPB_LIVE_E_ARGUMENT)
        text = std::string(error.what) + ": " + text + " (got " + std::to_string(error.got) + ", limit " +
               std::to_string(error.expected) + ")";
    throw NativeError(text);
}

nb::dict histogram_dict(const upb_histogram &h) {
    nb::dict d;
    d["count"] = h.count;
    d["mean"] = h.count ? static_cast<double>(h.sum_ns) / static_cast<double>(h.count) : 0.0;
    d["min"] = h.count ? h.min_ns : 0;
    d["p50"] = upb_histogram_quantile(&h, 500000);
    d["p90"] = upb_histogram_quantile(&h, 900000);
    d["p99"] = upb_histogram_quantile(&h, 990000);
    d["p999"] = upb_histogram_quantile(&h, 999000);
    d["max"] = h.max_ns;
    return d;
}

nb::dict frame_dict(const upb_live_frame &f) {
    nb::dict d;
    d["frame"] = f.record.frame;
    d["first_input_ns"] = f.record.first_input_ns;
    d["last_input_ns"] = f.record.last_input_ns;
    d["output_ns"] = f.record.output_ns;
    d["latency_ns"] = f.record.latency_ns;
    d["verdict"] = f.record.verdict;
    d["missing_columns"] = f.record.missing_columns;
    d["mode"] = f.record.mode;
    d["wait_ns"] = f.wait_ns;
    d["columns_received"] = f.columns_received;
    d["flushed"] = (f.flags & UPB_LIVE_FLUSHED) != 0;
    d["explained"] = (f.flags & UPB_LIVE_EXPLAINED) != 0;
    return d;
}

nb::dict stall_dict(const upb_live_stall &s) {
    nb::dict d;
    d["start_ns"] = s.start_ns;
    d["duration_ns"] = s.duration_ns;
    d["cpu"] = s.cpu == UINT32_MAX ? nb::object(nb::none()) : nb::object(nb::int_(s.cpu));
    return d;
}

nb::dict drop_dict(const upb_live_drop &drop) {
    nb::dict d;
    d["packet"] = drop.packet;
    d["at_ns"] = drop.at_ns;
    d["columns"] = drop.columns;
    d["cause"] = drop.cause == UPB_LIVE_CAUSE_FAULT ? "fault" : "overflow";
    return d;
}

template <typename T> auto copy_image(const T *source, size_t columns) {
    const size_t pixels = columns * UPB_ROWS;
    T *copy = new T[pixels];
    nb::capsule owner(copy, [](void *p) noexcept { delete[] static_cast<T *>(p); });
    std::memcpy(copy, source, pixels * sizeof(T));
    return nb::ndarray<T, nb::numpy, nb::ndim<2>, nb::c_contig>(copy, {columns, UPB_ROWS}, owner);
}

nb::tuple image_tuple(const upb_live_image &image, size_t columns) {
    return nb::make_tuple(image.frame, image.columns_out, copy_image(image.distance, columns),
                          copy_image(image.intensity, columns));
}

template <typename T, typename F> nb::list list_of(const T *items, size_t count, F &&convert) {
    nb::list list;
    for (size_t i = 0; i < count; ++i)
        list.append(convert(items[i]));
    return list;
}

class LiveRun {
  public:
    LiveRun(const ModelHandle &model, DistanceFrames distance, IntensityFrames intensity, const upb_live_config &config,
            Numbers drop_packets, Numbers keep_frames, Numbers service_ns, Numbers jitter_ns)
        : distance_(std::move(distance)), intensity_(std::move(intensity)), drop_packets_(std::move(drop_packets)),
          keep_frames_(std::move(keep_frames)), service_ns_(std::move(service_ns)), jitter_ns_(std::move(jitter_ns)),
          columns_(distance_.shape(1)) {
        if (intensity_.shape(0) != distance_.shape(0) || intensity_.shape(1) != columns_)
            throw NativeError("distance and intensity have different shapes");
        upb_live_config c = config;
        c.distance = distance_.data();
        c.intensity = intensity_.data();
        c.frames = static_cast<uint32_t>(distance_.shape(0));
        c.columns = static_cast<uint32_t>(columns_);
        c.drop_packets = drop_packets_.data();
        c.drop_count = drop_packets_.size();
        c.keep_frames = keep_frames_.data();
        c.keep_count = keep_frames_.size();
        c.virtual_clock.service_ns = service_ns_.data();
        c.virtual_clock.service_count = service_ns_.size();
        c.virtual_clock.jitter_ns = jitter_ns_.data();
        c.virtual_clock.jitter_count = jitter_ns_.size();
        upb_error error = {};
        upb_live *live = nullptr;
        check_live(upb_live_create(model.model(), &c, &live, &error), error);
        live_.reset(live);
    }

    void run() {
        nb::gil_scoped_release release;
        check_live(upb_live_run(live_.get()), upb_error{});
    }

    void stop() { upb_live_stop(live_.get()); }

    nb::dict progress() const {
        const upb_live_progress p = upb_live_get_progress(live_.get());
        nb::dict d;
        d["frames"] = p.frames;
        d["missed"] = p.missed;
        d["last_latency_ns"] = p.last_latency_ns;
        d["max_latency_ns"] = p.max_latency_ns;
        d["packets_played"] = p.packets_played;
        d["packets_dropped"] = p.packets_dropped;
        return d;
    }

    nb::dict result() const {
        const upb_live_result &r = *upb_live_get_result(live_.get());
        nb::dict d;
        d["counts"] = counts(r);
        d["stopped"] = r.stopped != 0;
        d["realtime_granted"] = r.realtime_granted != 0;
        d["memory_locked"] = r.memory_locked != 0;
        d["cpu"] = r.cpu;
        d["delay_columns"] = r.delay_columns;
        d["state_bytes"] = r.state_bytes;
        d["stream_bytes"] = r.stream_bytes;
        d["duration_ns"] = r.duration_ns;
        d["consumer_cpu_ns"] = r.consumer_cpu_ns;
        d["pacer_cpu_ns"] = r.pacer_cpu_ns;
        d["latency"] = histogram_dict(r.latency);
        d["pacer_lateness"] = histogram_dict(r.pacer_lateness);
        d["column_compute"] = histogram_dict(r.column_compute);
        d["packet_compute"] = histogram_dict(r.packet_compute);
        d["frames"] = list_of(r.frames, r.frame_count, frame_dict);
        d["stalls"] = list_of(r.stalls, r.stall_count, stall_dict);
        d["stalls_unlisted"] = r.stalls_unlisted;
        d["witnesses"] = r.witnesses;
        d["witnesses_bound"] = r.witnesses_bound;
        d["drops"] = list_of(r.drops, r.drop_count, drop_dict);
        d["drops_unlisted"] = r.drops_unlisted;
        d["kept"] = list_of(r.kept, r.kept_count, [this](const upb_live_image &i) { return image_tuple(i, columns_); });
        d["last"] = r.last.columns_out ? nb::object(image_tuple(r.last, columns_)) : nb::object(nb::none());
        return d;
    }

  private:
    static nb::dict counts(const upb_live_result &r) {
        nb::dict d;
        d["frames_begun"] = r.frames_begun;
        d["frames_met"] = r.met;
        d["frames_missed"] = r.missed;
        d["frames_partial"] = r.partial;
        d["frames_empty"] = r.frames_empty;
        d["packets_played"] = r.packets_played;
        d["packets_taken"] = r.packets_taken;
        d["packets_dropped_fault"] = r.dropped_fault;
        d["packets_dropped_overflow"] = r.dropped_overflow;
        d["columns_played"] = r.columns_played;
        d["columns_taken"] = r.columns_taken;
        d["columns_missing"] = r.columns_missing;
        d["columns_out"] = r.columns_out;
        d["columns_incomplete"] = r.columns_incomplete;
        d["columns_refused"] = r.columns_refused;
        return d;
    }

    struct Destroy {
        void operator()(upb_live *live) const { upb_live_destroy(live); }
    };

    DistanceFrames distance_;
    IntensityFrames intensity_;
    Numbers drop_packets_, keep_frames_, service_ns_, jitter_ns_;
    size_t columns_;
    std::unique_ptr<upb_live, Destroy> live_;
};

bool explains(const std::vector<std::pair<uint64_t, uint64_t>> &stalls, uint64_t from_ns, uint64_t to_ns,
              uint64_t deadline_ns) {
    std::vector<upb_live_stall> list;
    for (const auto &[start, duration] : stalls)
        list.push_back({start, duration, 0, 0});
    return upb_live_explains(list.data(), list.size(), from_ns, to_ns, deadline_ns) != 0;
}

// A field of the configuration's parts, as a plain attribute.
template <auto Part, auto Field> void bind_part(nb::class_<upb_live_config> &c, const char *name) {
    using Value = std::remove_reference_t<decltype((std::declval<upb_live_config>().*Part).*Field)>;
    c.def_prop_rw(
        name, [](const upb_live_config &self) { return (self.*Part).*Field; },
        [](upb_live_config &self, Value value) { (self.*Part).*Field = value; });
}

void bind_config(nb::module_ &m) {
    nb::class_<upb_live_config> c(m, "LiveConfig", "Settings of a run: see upb_live.h.");
    c.def("__init__", [](upb_live_config *self) { new (self) upb_live_config(upb_live_config_default()); });
    c.def_rw("frames_total", &upb_live_config::frames_total);
    c.def_rw("columns_per_packet", &upb_live_config::columns_per_packet);
    c.def_rw("rate_millihertz", &upb_live_config::rate_millihertz);
    c.def_rw("deadline_ns", &upb_live_config::deadline_ns);
    c.def_rw("ring_packets", &upb_live_config::ring_packets);
    c.def_rw("wait", &upb_live_config::wait);
    c.def_rw("poll_ns", &upb_live_config::poll_ns);
    c.def_rw("spin_ns", &upb_live_config::spin_ns);
    c.def_rw("lead_ns", &upb_live_config::lead_ns);
    c.def_rw("realtime", &upb_live_config::realtime);
    c.def_rw("lock_memory", &upb_live_config::lock_memory);
    c.def_rw("witness", &upb_live_config::witness);
    c.def_rw("witness_period_ns", &upb_live_config::witness_period_ns);
    c.def_rw("stall_threshold_ns", &upb_live_config::stall_threshold_ns);
    bind_part<&upb_live_config::stream, &upb_stream_config::precision>(c, "precision");
    bind_part<&upb_live_config::stream, &upb_stream_config::cpu>(c, "cpu");
    bind_part<&upb_live_config::stream, &upb_stream_config::distance_unit_um>(c, "distance_unit_um");
    bind_part<&upb_live_config::stream, &upb_stream_config::any_sensor>(c, "any_sensor");
    bind_part<&upb_live_config::stream, &upb_stream_config::aligned>(c, "aligned");
    bind_part<&upb_live_config::virtual_clock, &upb_live_virtual::enabled>(c, "virtual_clock");
    bind_part<&upb_live_config::virtual_clock, &upb_live_virtual::packet_service_ns>(c, "packet_service_ns");
    bind_part<&upb_live_config::virtual_clock, &upb_live_virtual::column_service_ns>(c, "column_service_ns");
}

} // namespace

void bind_live(nb::module_ &m) {
    bind_config(m);
    nb::class_<LiveRun>(m, "LiveRun", "One run of the real-time runner.")
        .def(nb::init<const ModelHandle &, DistanceFrames, IntensityFrames, const upb_live_config &, Numbers, Numbers,
                      Numbers, Numbers>(),
             "model"_a, "distance"_a, "intensity"_a, "config"_a, "drop_packets"_a, "keep_frames"_a, "service_ns"_a,
             "jitter_ns"_a, nb::keep_alive<1, 2>())
        .def("run", &LiveRun::run)
        .def("stop", &LiveRun::stop)
        .def("progress", &LiveRun::progress, nb::sig("def progress(self) -> dict[str, int]"))
        .def("result", &LiveRun::result, nb::sig("def result(self) -> dict[str, typing.Any]"));
    m.def("live_explains", &explains, "stalls"_a, "from_ns"_a, "to_ns"_a, "deadline_ns"_a,
          "True if the latency meets the deadline without the stalls, (start, duration) sorted by start.");
}
