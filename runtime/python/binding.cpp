// The extension module upbeam.runtime._native: the C library's objects for NumPy arrays. The GIL is released wherever
// columns are computed; arrays are used in place.
#include "handles.h"

#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <cstdlib>
#include <cstring>
#include <iterator>
#include <mutex>
#include <optional>
#include <vector>

#include "raw_windows.h"

namespace nb = nanobind;
using namespace nb::literals;

std::string describe(upb_status status, const upb_error *error) {
    std::string text = upb_status_text(status);
    if (error == nullptr || error->what[0] == '\0')
        return text;
    text = std::string(error->what) + ": " + text;
    if (error->got != 0 || error->expected != 0) // values of signed fields are there as two's complement
        text += " (got " + std::to_string(static_cast<int64_t>(error->got)) + ", expected " +
                std::to_string(static_cast<int64_t>(error->expected)) + ")";
    if (error->offset != 0)
        text += " at byte " + std::to_string(error->offset);
    return text;
}

void check(upb_status status, const upb_error *error) {
    if (status != UPB_OK)
        throw NativeError(describe(status, error));
}

AlignedMemory::AlignedMemory(std::size_t bytes) : bytes_((bytes + UPB_ALIGN - 1) / UPB_ALIGN * UPB_ALIGN) {
    memory_.reset(std::aligned_alloc(UPB_ALIGN, bytes_));
    if (!memory_)
        throw std::bad_alloc();
    std::memset(memory_.get(), 0, bytes_);
}

void AlignedMemory::Free::operator()(void *p) const { std::free(p); }

ModelHandle::ModelHandle(const nb::bytes &ubm) : memory_(upb_model_bytes()) {
    upb_error error = {};
    check(upb_model_load(memory_.get(), memory_.bytes(), ubm.c_str(), ubm.size(), &model_, &error), &error);
}

upb_model_info ModelHandle::info() const {
    upb_model_info info = {};
    check(upb_model_get_info(model_, &info));
    return info;
}

namespace {

using DistanceIn = nb::ndarray<const uint16_t, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
using IntensityIn = nb::ndarray<const uint8_t, nb::ndim<2>, nb::c_contig, nb::device::cpu>;

// In the order of upb_cpu, of upb_precision, of upb_mode.
constexpr const char *cpu_names[] = {"auto", "scalar", "avx2", "avx512", "neon", "avx512-vnni", "neon-dot"};
constexpr const char *precision_names[] = {"fp32", "int16", "int8"};
constexpr const char *mode_names[] = {"network", "valid_mean", "repeat", "pass_through"};

template <size_t N> uint32_t index_of(const char *const (&names)[N], const std::string &name, const char *what) {
    std::string expected;
    for (size_t i = 0; i < N; ++i) {
        if (name == names[i])
            return static_cast<uint32_t>(i);
        expected += (i ? ", " : "") + std::string(names[i]);
    }
    throw NativeError("unknown " + std::string(what) + " '" + name + "', expected one of: " + expected);
}

upb_cpu cpu_from_name(const std::string &name) {
    return static_cast<upb_cpu>(index_of(cpu_names, name, "instruction set"));
}

upb_precision precision_from_name(const std::string &name) {
    return static_cast<upb_precision>(index_of(precision_names, name, "precision"));
}

const char *cpu_name(uint32_t cpu) { return cpu < std::size(cpu_names) ? cpu_names[cpu] : "?"; }

const char *precision_name(uint32_t p) { return p < std::size(precision_names) ? precision_names[p] : "?"; }

template <size_t N> nb::tuple name_tuple(const char *const (&names)[N]) {
    nb::list list;
    for (const char *name : names)
        list.append(name);
    return nb::tuple(list);
}

// A [rows, width] array that owns `data`.
template <typename T>
nb::ndarray<T, nb::numpy, nb::ndim<2>, nb::c_contig> own(std::vector<T> *data, size_t rows, size_t width) {
    nb::capsule owner(data, [](void *p) noexcept { delete static_cast<std::vector<T> *>(p); });
    return nb::ndarray<T, nb::numpy, nb::ndim<2>, nb::c_contig>(data->data(), {rows, width}, owner);
}

void need_shape(const char *what, size_t rows, size_t columns, size_t want_rows, size_t want_columns) {
    if (rows != want_rows || columns != want_columns)
        throw NativeError(std::string(what) + " has shape [" + std::to_string(rows) + ", " + std::to_string(columns) +
                          "], expected [" + std::to_string(want_rows) + ", " + std::to_string(want_columns) + "]");
}

// A column stream. A mutex keeps two Python threads out of it while the GIL is released.
class StreamHandle {
  public:
    StreamHandle(const ModelHandle &model, const std::string &precision, const std::string &cpu, uint32_t columns,
                 uint32_t distance_unit_um, bool any_sensor, bool aligned)
        : StreamHandle(model, config(precision, cpu, columns, distance_unit_um, any_sensor, aligned), columns) {}

    StreamHandle(const ModelHandle &model, upb_stream_config c, uint32_t columns) : memory_(bytes(model, c)) {
        upb_error error = {};
        c.sink = &StreamHandle::sink;
        c.user = this;
        columns_ = columns != 0 ? columns : model.info().columns;
        check(upb_stream_init(memory_.get(), memory_.bytes(), model.model(), &c, &stream_, &error), &error);
    }

    // An image [32, columns] of its own, both ends edges -> [64, columns].
    nb::tuple image(const DistanceIn &distance, const IntensityIn &intensity) {
        need_shape("distance", distance.shape(0), distance.shape(1), UPB_BEAMS, columns_);
        need_shape("intensity", intensity.shape(0), intensity.shape(1), UPB_BEAMS, columns_);
        auto *d = new std::vector<uint16_t>(UPB_ROWS * static_cast<size_t>(columns_));
        auto d_out = own(d, UPB_ROWS, columns_);
        auto *i = new std::vector<uint8_t>(UPB_ROWS * static_cast<size_t>(columns_));
        auto i_out = own(i, UPB_ROWS, columns_);
        {
            nb::gil_scoped_release release;
            std::lock_guard<std::mutex> lock(mutex_);
            uint32_t n = 0, rest = 0;
            check(upb_stream_reset(stream_));
            check(upb_stream_frame(stream_, distance.data(), columns_, intensity.data(), columns_, d->data(), columns_,
                                   i->data(), columns_, columns_, &n));
            check(upb_stream_frame_end(stream_, d->data() + n, columns_, i->data() + n, columns_, columns_ - n, &rest));
            if (n + rest != columns_)
                throw NativeError("internal: an image came out incomplete");
        }
        return nb::make_tuple(d_out, i_out);
    }

    // Pushes columns [n, 32] that start at `column`; returns what became complete, [64, m], and the columns' places.
    nb::tuple push(const DistanceIn &distance, const IntensityIn &intensity, uint32_t column) {
        const size_t n = distance.shape(0);
        need_shape("distance", n, distance.shape(1), n, UPB_BEAMS);
        need_shape("intensity", intensity.shape(0), intensity.shape(1), n, UPB_BEAMS);
        Collected out;
        {
            nb::gil_scoped_release release;
            std::lock_guard<std::mutex> lock(mutex_);
            Collecting collecting(*this, out);
            for (size_t k = 0; k < n; ++k) {
                const upb_status status =
                    upb_stream_push(stream_, static_cast<uint32_t>((column + k) % columns_),
                                    distance.data() + k * UPB_BEAMS, intensity.data() + k * UPB_BEAMS);
                if (status != UPB_E_ORDER)
                    check(status); // a late column is counted in the stats
            }
        }
        return columns(out);
    }

    nb::tuple gap(uint32_t count) {
        Collected out;
        collect(out, [&] { check(upb_stream_gap(stream_, count)); });
        return columns(out);
    }

    nb::tuple flush() {
        Collected out;
        collect(out, [&] { check(upb_stream_flush(stream_)); });
        return columns(out);
    }

    void reset() {
        std::lock_guard<std::mutex> lock(mutex_);
        check(upb_stream_reset(stream_));
    }

    void set_mode(const std::string &mode) {
        std::lock_guard<std::mutex> lock(mutex_);
        check(upb_stream_set_mode(stream_, static_cast<upb_mode>(index_of(mode_names, mode, "mode"))));
    }

    nb::dict stats() {
        upb_stream_stats s = {};
        {
            std::lock_guard<std::mutex> lock(mutex_);
            check(upb_stream_get_stats(stream_, &s));
        }
        nb::dict d;
        d["columns_in"] = s.columns_in;
        d["columns_out"] = s.columns_out;
        d["columns_missing"] = s.columns_missing;
        d["columns_late"] = s.columns_late;
        d["frames_out"] = s.frames_out;
        d["delay_columns"] = s.delay_columns;
        d["cpu"] = cpu_name(s.cpu);
        d["precision"] = precision_name(s.precision);
        d["state_bytes"] = s.state_bytes;
        d["memory_bytes"] = memory_.bytes();
        return d;
    }

  private:
    struct Collected {
        std::vector<uint16_t> distance; // [m][64]
        std::vector<uint8_t> intensity;
        std::vector<uint64_t> place; // frame, column, flags of each
    };

    // Points the stream's sink at `out` for as long as it lives.
    struct Collecting {
        Collecting(StreamHandle &s, Collected &out) : stream(s) { stream.collected_ = &out; }
        ~Collecting() { stream.collected_ = nullptr; }
        StreamHandle &stream;
    };

    static void sink(void *user, const upb_column *column) {
        Collected *out = static_cast<StreamHandle *>(user)->collected_;
        if (out == nullptr)
            return;
        out->distance.insert(out->distance.end(), column->distance, column->distance + UPB_ROWS);
        out->intensity.insert(out->intensity.end(), column->intensity, column->intensity + UPB_ROWS);
        out->place.insert(out->place.end(), {column->frame, column->column, column->flags});
    }

    static upb_stream_config config(const std::string &precision, const std::string &cpu, uint32_t columns,
                                    uint32_t unit, bool any_sensor, bool aligned) {
        upb_stream_config c = upb_stream_config_default();
        c.precision = static_cast<uint32_t>(precision_from_name(precision));
        c.cpu = static_cast<uint32_t>(cpu_from_name(cpu));
        c.columns = columns;
        c.distance_unit_um = unit;
        c.any_sensor = any_sensor ? 1u : 0u;
        c.aligned = aligned ? 1u : 0u;
        return c;
    }

    static size_t bytes(const ModelHandle &model, const upb_stream_config &c) {
        size_t n = 0;
        upb_error error = {};
        check(upb_stream_bytes(model.model(), &c, &n, &error), &error);
        return n;
    }

    template <typename F> void collect(Collected &out, F &&call) {
        nb::gil_scoped_release release;
        std::lock_guard<std::mutex> lock(mutex_);
        Collecting collecting(*this, out);
        call();
    }

    static nb::tuple columns(Collected &out) {
        const size_t m = out.place.size() / 3;
        auto *d = new std::vector<uint16_t>(std::move(out.distance));
        auto *i = new std::vector<uint8_t>(std::move(out.intensity));
        auto *p = new std::vector<uint64_t>(std::move(out.place));
        return nb::make_tuple(own(d, m, UPB_ROWS), own(i, m, UPB_ROWS), own(p, m, 3));
    }

    AlignedMemory memory_;
    upb_stream *stream_ = nullptr;
    uint32_t columns_ = 0;
    Collected *collected_ = nullptr;
    std::mutex mutex_;
};

nb::tuple raw_windows(const ModelHandle &model, const DistanceIn &distance, const IntensityIn &intensity,
                      const std::string &cpu) {
    const size_t n = distance.shape(0);
    need_shape("distance", n, distance.shape(1), n, UPB_BEAMS);
    need_shape("intensity", intensity.shape(0), intensity.shape(1), n, UPB_BEAMS);
    auto *d = new std::vector<float>(n * UPB_BEAMS);
    auto d_out = own(d, n, UPB_BEAMS);
    auto *i = new std::vector<float>(n * UPB_BEAMS);
    auto i_out = own(i, n, UPB_BEAMS);
    check(upb_raw_windows(model.model(), cpu_from_name(cpu), static_cast<uint32_t>(n), distance.data(),
                          intensity.data(), d->data(), i->data()));
    return nb::make_tuple(d_out, i_out);
}

nb::tuple int_windows(const ModelHandle &model, const std::string &precision, const DistanceIn &distance,
                      const IntensityIn &intensity, const std::string &cpu) {
    const size_t n = distance.shape(0);
    need_shape("distance", n, distance.shape(1), n, UPB_BEAMS);
    need_shape("intensity", intensity.shape(0), intensity.shape(1), n, UPB_BEAMS);
    auto *d = new std::vector<uint16_t>(n * UPB_BEAMS);
    auto d_out = own(d, n, UPB_BEAMS);
    auto *i = new std::vector<uint8_t>(n * UPB_BEAMS);
    auto i_out = own(i, n, UPB_BEAMS);
    const upb_precision p = precision_from_name(precision);
    const upb_cpu c = cpu_from_name(cpu);
    upb_status status;
    {
        nb::gil_scoped_release release;
        status = upb_int_windows(model.model(), p, c, static_cast<uint32_t>(n), distance.data(), intensity.data(),
                                 d->data(), i->data());
    }
    check(status);
    return nb::make_tuple(d_out, i_out);
}

nb::dict trace_int(const ModelHandle &model, const std::string &precision, const std::string &network,
                   const DistanceIn &windows) {
    constexpr const char *networks[] = {"distance", "intensity"};
    const upb_precision p = precision_from_name(precision);
    const int which = static_cast<int>(index_of(networks, network, "network"));
    const size_t n = windows.shape(0);
    need_shape("windows", n, windows.shape(1), n, 6);
    std::vector<upb_int_steps> steps(n + 1); // one more: it tells the width where there is no window
    const uint16_t zeros[6] = {};
    for (size_t i = 0; i <= n; ++i)
        check(upb_int_trace_window(model.model(), p, which, i < n ? windows.data() + 6 * i : zeros, &steps[i]));
    nb::dict out;
    // `first` gives the place of a step in a trace, [width].
    auto put = [&](const char *name, size_t width, auto first) {
        auto *values = new std::vector<int32_t>;
        for (size_t i = 0; i < n; ++i)
            values->insert(values->end(), first(steps[i]), first(steps[i]) + width);
        out[name] = own(values, n, width);
    };
    const size_t hidden = steps[n].hidden;
    put("m", 1, [](const upb_int_steps &s) { return &s.m; });
    put("d", 6, [](const upb_int_steps &s) { return s.d; });
    put("s", 1, [](const upb_int_steps &s) { return &s.s; });
    put("q", 6, [](const upb_int_steps &s) { return s.q; });
    put("S", hidden, [](const upb_int_steps &s) { return s.S; });
    put("a", hidden, [](const upb_int_steps &s) { return s.a; });
    put("z", hidden, [](const upb_int_steps &s) { return s.z; });
    put("Y", 1, [](const upb_int_steps &s) { return &s.Y; });
    put("r", 1, [](const upb_int_steps &s) { return &s.r; });
    put("y", 1, [](const upb_int_steps &s) { return &s.y; });
    return out;
}

nb::dict sizes_dict(const ModelHandle &model, const std::string &precision, uint32_t columns, bool aligned) {
    upb_stream_config c = upb_stream_config_default();
    upb_sizes sizes = {};
    upb_error error = {};
    c.precision = static_cast<uint32_t>(precision_from_name(precision));
    c.columns = columns;
    c.any_sensor = columns != 0 ? 1u : 0u;
    c.aligned = aligned ? 1u : 0u;
    check(upb_stream_sizes(model.model(), &c, &sizes, &error), &error);
    nb::dict d;
    d["file"] = sizes.file;
    d["weights"] = sizes.weights;
    d["tables"] = sizes.tables;
    d["state"] = sizes.state;
    d["ring"] = sizes.ring;
    return d;
}

nb::dict info_dict(const ModelHandle &model) {
    const upb_model_info info = model.info();
    nb::dict d;
    d["sensor"] = info.sensor;
    d["columns"] = info.columns;
    d["distance_unit_um"] = info.distance_unit_um;
    d["cut_mdeg"] = info.cut_mdeg;
    d["min_count"] = info.min_count;
    d["max_count"] = info.max_count;
    d["edge"] = info.edge;
    d["last_row"] = info.last_row;
    d["empty_rule"] = info.empty_rule;
    d["hidden"] = nb::make_tuple(info.hidden[0], info.hidden[1]);
    d["crc32"] = info.crc32;
    d["file_bytes"] = info.file_bytes;
    d["signature_bytes"] = info.signature_bytes;
    nb::list precisions;
    for (uint32_t p = 0; p < UPB_PRECISIONS; ++p)
        if (info.precisions >> p & 1u)
            precisions.append(precision_name(p));
    d["precisions"] = nb::tuple(precisions);
    d["row_elevation_udeg"] = std::vector<int32_t>(info.row_elevation_udeg, info.row_elevation_udeg + UPB_ROWS);
    d["azimuth_offset_udeg"] = std::vector<int32_t>(info.azimuth_offset_udeg, info.azimuth_offset_udeg + UPB_BEAMS);
    return d;
}

} // namespace

NB_MODULE(_native, m) {
    m.doc() = "The upbeam C library for NumPy arrays.";
    nb::exception<NativeError>(m, "NativeError", PyExc_ValueError);
    m.def("version", &upb_version);
    m.def("api_version", &upb_api_version);
    nb::class_<ModelHandle>(m, "Model", "A loaded .ubm model, immutable.")
        .def(nb::init<const nb::bytes &>(), "ubm"_a)
        .def("info", &info_dict);
    nb::class_<StreamHandle>(m, "Stream", "A column stream over a model.")
        .def(nb::init<const ModelHandle &, const std::string &, const std::string &, uint32_t, uint32_t, bool, bool>(),
             "model"_a, "precision"_a = "fp32", "cpu"_a = "auto", "columns"_a = 0, "distance_unit_um"_a = 0,
             "any_sensor"_a = false, "aligned"_a = false, nb::keep_alive<1, 2>())
        .def("image", &StreamHandle::image, "distance"_a, "intensity"_a)
        .def("push", &StreamHandle::push, "distance"_a, "intensity"_a, "column"_a)
        .def("gap", &StreamHandle::gap, "columns"_a)
        .def("flush", &StreamHandle::flush)
        .def("set_mode", &StreamHandle::set_mode, "mode"_a, "How generated rows are made from the next column on.")
        .def("reset", &StreamHandle::reset)
        .def("stats", &StreamHandle::stats);
    m.def("raw_windows", &raw_windows, "model"_a, "distance"_a, "intensity"_a, "cpu"_a = "auto",
          "Outputs of both networks before rounding and validity for aligned columns [n, 32]: counts and intensities "
          "[n, 32], "
          "of each column the last without meaning. Both ends are edges.");
    m.def(
        "windows_int", &int_windows, "model"_a, "precision"_a, "distance"_a, "intensity"_a, "cpu"_a = "auto",
        "What an integer kernel generates for aligned columns [n, 32]: counts and intensities [n, 32], of each column "
        "the last is 0. Both ends are edges.");
    m.def("trace_int", &trace_int, "model"_a, "precision"_a, "network"_a, "windows"_a,
          "The steps m, d, s, q, S, a, z, Y, r, y of docs/numeric-contract.md for windows [n, 6] of one network, "
          "'distance' or 'intensity': int32 arrays [n, 1], [n, 6] or [n, hidden units, padded to an even number].");
    m.def("sizes", &sizes_dict, "model"_a, "precision"_a, "columns"_a = 0, "aligned"_a = false,
          "Bytes of file, weights, tables, state and ring: see upb_sizes.");
    m.attr("CPUS") = name_tuple(cpu_names);
    m.attr("PRECISIONS") = name_tuple(precision_names);
    bind_live(m);
}
