// The extension module upbeam.runtime.daemon._daemon: the daemon's core on virtual time, its outputs collected.
#include <nanobind/nanobind.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <cstdlib>
#include <cstring>
#include <map>
#include <memory>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

#include "upb_daemon.h"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

// Becomes upbeam.runtime.daemon.DaemonError (a ValueError).
class DaemonError : public std::runtime_error {
  public:
    using std::runtime_error::runtime_error;
};

std::string describe(upb_status status, const upb_error &error) {
    std::string text = upb_status_text(status);
    if (error.what[0] != '\0')
        text = std::string(error.what) + ": " + text;
    if (error.got != 0 || error.expected != 0)
        text += " (got " + std::to_string(error.got) + ", expected " + std::to_string(error.expected) + ")";
    return text;
}

struct Free {
    void operator()(void *p) const { std::free(p); }
};

using Bytes = std::vector<uint8_t>;
using Timed = std::pair<uint64_t, Bytes>;

struct CanOut {
    uint64_t time_ns;
    upb_can_frame frame;
};

nb::bytes to_bytes(const Bytes &b) { return nb::bytes(reinterpret_cast<const char *>(b.data()), b.size()); }

nb::dict record_dict(const upb_ledger_record &r) {
    nb::dict d;
    d["frame"] = r.frame;
    d["first_input_ns"] = r.first_input_ns;
    d["last_input_ns"] = r.last_input_ns;
    d["output_ns"] = r.output_ns;
    d["latency_ns"] = r.latency_ns;
    d["verdict"] = r.verdict;
    d["missing_columns"] = r.missing_columns;
    d["mode"] = r.mode;
    return d;
}

nb::dict event_dict(const upb_event &e) {
    nb::dict d;
    d["time_ns"] = e.time_ns;
    d["frame"] = e.frame;
    d["kind"] = upb_event_name(e.kind);
    d["a"] = e.a;
    d["b"] = e.b;
    d["value"] = e.value;
    if (e.kind == UPB_EVENT_FAULT_SET || e.kind == UPB_EVENT_FAULT_CLEARED || e.kind == UPB_EVENT_RESYNC)
        d["fault"] = upb_fault_name(e.a);
    return d;
}

// One number of the configuration, by the name it has in C.
struct Field {
    const char *name;
    size_t offset;
    size_t bytes; // 4 or 8
};

#define FIELD(name) {#name, offsetof(upb_daemon_config, name), sizeof(upb_daemon_config::name)}
constexpr Field fields[] = {
    FIELD(sensor),
    FIELD(any_model),
    FIELD(source_ipv4),
    FIELD(rpm),
    FIELD(rpm_tolerance_permille),
    FIELD(cut_mdeg),
    FIELD(fov_begin_mdeg),
    FIELD(fov_end_mdeg),
    FIELD(width_tolerance_permille),
    FIELD(precision),
    FIELD(cpu),
    FIELD(deadline_ns),
    FIELD(ladder_up_ns),
    FIELD(ladder_hold_ns),
    FIELD(mode_floor),
    FIELD(stale_ns),
    FIELD(timeout_ns),
    FIELD(flood_per_second),
    FIELD(jitter_ns),
    FIELD(drift_ppm),
    FIELD(loss_permille),
    FIELD(throttle_permille),
    FIELD(visibility_permille),
    FIELD(crosstalk_permille),
    FIELD(integrity_bytes),
    FIELD(ubm_bytes_max),
    FIELD(ledger_capacity),
    FIELD(queue_packets),
    FIELD(sabotage),
};
#undef FIELD

uint64_t field_of(const upb_daemon_config &config, const Field &field) {
    uint64_t wide = 0;
    uint32_t narrow = 0;
    const auto *at = reinterpret_cast<const unsigned char *>(&config) + field.offset;
    std::memcpy(field.bytes == 4 ? static_cast<void *>(&narrow) : &wide, at, field.bytes);
    return field.bytes == 4 ? narrow : wide;
}

void set_field(upb_daemon_config &config, const Field &field, uint64_t value) {
    auto *at = reinterpret_cast<unsigned char *>(&config) + field.offset;
    const auto narrow = static_cast<uint32_t>(value);
    if (field.bytes == 4 && value != narrow)
        throw DaemonError(std::string(field.name) + ": " + std::to_string(value) + " does not fit 32 bits");
    std::memcpy(at, field.bytes == 4 ? static_cast<const void *>(&narrow) : &value, field.bytes);
}

void take_array(const nb::handle &value, const char *name, uint64_t *to, size_t count) {
    const auto numbers = nb::cast<std::vector<uint64_t>>(value);
    if (numbers.size() != count)
        throw DaemonError(std::string(name) + ": expected " + std::to_string(count) + " numbers, got " +
                          std::to_string(numbers.size()));
    std::copy(numbers.begin(), numbers.end(), to);
}

void take_setting(upb_daemon_config &config, const std::string &name, const nb::handle &value) {
    if (name == "ladder_down_ns")
        return take_array(value, "ladder_down_ns", config.ladder_down_ns, UPB_MODES - 1);
    if (name == "service_ns")
        return take_array(value, "service_ns", config.service_ns, UPB_MODES);
    for (const Field &field : fields)
        if (name == field.name)
            return set_field(config, field, nb::cast<uint64_t>(value));
    throw DaemonError("unknown setting '" + name + "'");
}

nb::dict default_settings() {
    const upb_daemon_config config = upb_daemon_config_default();
    nb::dict d;
    for (const Field &field : fields)
        d[field.name] = field_of(config, field);
    nb::list down, service;
    for (uint64_t ns : config.ladder_down_ns)
        down.append(ns);
    for (uint64_t ns : config.service_ns)
        service.append(ns);
    d["ladder_down_ns"] = nb::tuple(down);
    d["service_ns"] = nb::tuple(service);
    return d;
}

class Daemon {
  public:
    // storage: bytes by upb_store kept from a run before, handed out again by `stored`.
    Daemon(const nb::bytes &ubm, const nb::dict &settings, const std::vector<std::string> &outputs,
           const nb::bytes &key, const nb::dict &stored, const std::vector<nb::bytes> &models) {
        config_ = upb_daemon_config_default();
        for (auto [name, value] : settings)
            take_setting(config_, nb::cast<std::string>(name), value);
        for (auto [what, bytes] : stored) {
            const auto content = nb::cast<nb::bytes>(bytes);
            store_[nb::cast<uint32_t>(what)] = Bytes(content.c_str(), content.c_str() + content.size());
        }
        for (const nb::bytes &model : models)
            models_.emplace_back(model.c_str(), model.c_str() + model.size());
        if (key.size() != 0 && key.size() != UPB_KEY_BYTES)
            throw DaemonError("key: expected " + std::to_string(UPB_KEY_BYTES) + " bytes, got " +
                              std::to_string(key.size()));
        config_.key = key.size() ? reinterpret_cast<const uint8_t *>(key.c_str()) : nullptr;
        config_.storage = {read_store, write_store, this};
        config_.find_model = find_model;
        config_.reset = on_reset;
        config_.user = this;
        config_.sinks.user = this;
        config_.sinks.ledger = on_ledger;
        config_.sinks.event = on_event;
        for (const std::string &output : outputs)
            want(output);
        const size_t bytes = upb_daemon_bytes(&config_);
        const size_t room = bytes ? bytes : UPB_ALIGN;
        memory_.reset(std::aligned_alloc(UPB_ALIGN, (room + UPB_ALIGN - 1) / UPB_ALIGN * UPB_ALIGN));
        if (!memory_)
            throw std::bad_alloc();
        upb_error error = {};
        const upb_status status =
            upb_daemon_init(memory_.get(), bytes, &config_, ubm.c_str(), ubm.size(), &daemon_, &error);
        if (status != UPB_OK)
            throw DaemonError(describe(status, error));
    }

    Daemon(const Daemon &) = delete;
    Daemon &operator=(const Daemon &) = delete;

    void packet(const nb::bytes &data, uint64_t received_ns, uint32_t source) {
        upb_daemon_packet(daemon_, bytes_of(data), data.size(), source, received_ns);
    }

    void position(const nb::bytes &data, uint64_t received_ns, uint32_t source) {
        upb_daemon_position(daemon_, bytes_of(data), data.size(), source, received_ns);
    }

    void queue_full(uint64_t packets, uint64_t now_ns) { upb_daemon_queue_full(daemon_, packets, now_ns); }

    void can(uint32_t id, const nb::bytes &data, uint64_t received_ns, uint32_t flags) {
        upb_can_frame frame = {};
        if (data.size() > UPB_CAN_FD_BYTES)
            throw DaemonError("a CAN frame has at most 64 bytes, got " + std::to_string(data.size()));
        frame.id = id;
        frame.flags = static_cast<uint8_t>(flags);
        frame.length = static_cast<uint8_t>(data.size());
        std::memcpy(frame.data, data.c_str(), data.size());
        upb_daemon_can(daemon_, &frame, received_ns);
    }

    void serial(const nb::bytes &data, uint64_t received_ns) {
        upb_daemon_serial(daemon_, bytes_of(data), data.size(), received_ns);
    }

    void tick(uint64_t now_ns) { upb_daemon_tick(daemon_, now_ns); }
    void end(uint64_t now_ns) { upb_daemon_end(daemon_, now_ns); }

    void swap_model(const nb::bytes &ubm, uint64_t now_ns) {
        upb_error error = {};
        const upb_status status = upb_daemon_swap_model(daemon_, ubm.c_str(), ubm.size(), now_ns, &error);
        if (status != UPB_OK)
            throw DaemonError(describe(status, error));
    }

    void set_floor(uint32_t mode, uint64_t now_ns) {
        if (upb_daemon_set_floor(daemon_, static_cast<upb_mode>(mode), now_ns) != UPB_OK)
            throw DaemonError("mode " + std::to_string(mode) + ", expected 0 to 3");
    }

    void set_service(const nb::object &service_ns) {
        uint64_t ns[UPB_MODES];
        take_array(service_ns, "service_ns", ns, UPB_MODES);
        upb_daemon_set_service(daemon_, ns);
    }

    // Whether the buses can be reached: a false one answers "failed" to every frame.
    void set_links(bool can, bool serial) {
        can_up_ = can;
        serial_up_ = serial;
    }

    nb::list take_columns() { return take(columns_); }
    nb::list take_hdl64() { return take(hdl64_); }
    nb::list take_serial() { return take(serial_); }

    nb::list take_can() {
        nb::list list;
        for (const CanOut &out : can_)
            list.append(nb::make_tuple(out.time_ns, out.frame.id,
                                       nb::bytes(reinterpret_cast<const char *>(out.frame.data), out.frame.length),
                                       static_cast<uint32_t>(out.frame.flags)));
        can_.clear();
        return list;
    }

    nb::list take_ledger() {
        nb::list list;
        for (const upb_ledger_record &record : ledger_)
            list.append(record_dict(record));
        ledger_.clear();
        return list;
    }

    nb::list take_events() {
        nb::list list;
        for (const upb_event &event : events_)
            list.append(event_dict(event));
        events_.clear();
        return list;
    }

    nb::dict counters() const {
        const upb_daemon_counters c = upb_daemon_get_status(daemon_).counters;
        nb::dict d;
#define COUNTER(name) d[#name] = c.name;
        COUNTER(packets_received)
        COUNTER(packets_processed)
        COUNTER(firings_processed)
        COUNTER(firings_inserted)
        COUNTER(firings_skipped)
        COUNTER(columns_out)
        COUNTER(columns_lost)
        COUNTER(column_datagrams)
        COUNTER(hdl64_packets)
        COUNTER(hdl64_beyond_range)
        COUNTER(hdl64_padding)
        COUNTER(second_returns)
        COUNTER(frames_closed)
        COUNTER(frames_missed)
        COUNTER(frames_partial)
        COUNTER(frames_forced)
        COUNTER(frames_skipped)
        COUNTER(mode_changes)
        COUNTER(positions_received)
        COUNTER(positions_malformed)
        COUNTER(can_received)
        COUNTER(can_sent)
        COUNTER(serial_received)
        COUNTER(serial_sent)
        COUNTER(commands_accepted)
        COUNTER(commands_rejected)
        COUNTER(models_swapped)
        COUNTER(models_rejected)
        COUNTER(streams_made)
        COUNTER(resyncs)
        COUNTER(integrity_checks)
        COUNTER(integrity_failures)
        COUNTER(integrity_repairs)
        COUNTER(events)
#undef COUNTER
        nb::dict drops;
        for (uint32_t i = 0; i < UPB_DROPS; ++i)
            drops[upb_drop_name(i)] = c.packets_dropped[i];
        d["packets_dropped"] = drops;
        nb::list modes;
        for (uint64_t columns : c.columns_by_mode)
            modes.append(columns);
        d["columns_by_mode"] = modes;
        return d;
    }

    nb::dict status() const {
        const upb_daemon_status s = upb_daemon_get_status(daemon_);
        nb::dict d;
        d["now_ns"] = s.now_ns;
        d["frame"] = s.frame;
        d["lag_ns"] = s.lag_ns;
        d["lag_max_ns"] = s.lag_max_ns;
        d["last_latency_ns"] = s.last_latency_ns;
        d["service_ns"] = s.service_ns;
        d["mode"] = s.mode;
        d["columns"] = s.columns;
        d["delay_columns"] = s.delay_columns;
        d["rpm"] = s.rpm_milli / 1000.0;
        d["drift_ppm"] = s.drift_ppm;
        d["model_crc32"] = s.model_crc32;
        d["returns_permille"] = s.returns_permille;
        d["integrity_period_frames"] = s.integrity_period_frames;
        d["ended"] = s.ended != 0;
        d["faults"] = fault_names(s.faults);
        d["faults_ever"] = fault_names(s.faults_ever);
        return d;
    }

    nb::dict latency() const {
        const upb_histogram &h = upb_daemon_get_ledger(daemon_)->latency;
        nb::dict d;
        d["count"] = h.count;
        d["p50"] = upb_histogram_quantile(&h, 500000);
        d["p99"] = upb_histogram_quantile(&h, 990000);
        d["p999"] = upb_histogram_quantile(&h, 999000);
        d["max"] = h.max_ns;
        return d;
    }

    // [64] rows of (elevation, azimuth offset) in thousandths of a degree; empty before the stream begins.
    nb::list calibration() const {
        nb::list rows;
        const upb_packet_calibration *c = upb_daemon_get_calibration(daemon_);
        for (uint32_t row = 0; c != nullptr && row < UPB_ROWS; ++row)
            rows.append(nb::make_tuple(c->laser[row].elevation_mdeg, c->laser[row].azimuth_offset_mdeg));
        return rows;
    }

    size_t region_bytes(uint32_t region) const {
        return upb_daemon_region_bytes(daemon_, static_cast<upb_region>(region));
    }
    void flip_bit(uint32_t region, size_t bit) { upb_daemon_flip_bit(daemon_, static_cast<upb_region>(region), bit); }

    // What the bus has stored, for the next daemon.
    nb::dict stored() const {
        nb::dict d;
        for (const auto &[what, bytes] : store_)
            d[nb::int_(what)] = to_bytes(bytes);
        return d;
    }

    nb::list resets() const {
        nb::list list;
        for (uint32_t type : resets_)
            list.append(type);
        return list;
    }

    size_t memory_bytes() const { return upb_daemon_bytes(&config_); }

  private:
    static const uint8_t *bytes_of(const nb::bytes &b) { return reinterpret_cast<const uint8_t *>(b.c_str()); }

    static nb::list fault_names(uint64_t faults) {
        nb::list list;
        for (uint32_t id = 1; id <= UPB_FAULTS; ++id)
            if (faults >> (id - 1) & 1)
                list.append(upb_fault_name(id));
        return list;
    }

    void want(const std::string &output) {
        if (output == "columns")
            config_.sinks.column_stream = on_columns;
        else if (output == "hdl64")
            config_.sinks.hdl64 = on_hdl64;
        else if (output == "can")
            config_.sinks.can = on_can;
        else if (output == "serial")
            config_.sinks.serial = on_serial;
        else
            throw DaemonError("unknown output '" + output + "', expected columns, hdl64, can or serial");
    }

    static nb::list take(std::vector<Timed> &from) {
        nb::list list;
        for (const Timed &item : from)
            list.append(nb::make_tuple(item.first, to_bytes(item.second)));
        from.clear();
        return list;
    }

    static Daemon &self(void *user) { return *static_cast<Daemon *>(user); }

    static void on_columns(void *user, uint64_t time_ns, const uint8_t *data, size_t bytes) {
        self(user).columns_.emplace_back(time_ns, Bytes(data, data + bytes));
    }
    static void on_hdl64(void *user, uint64_t time_ns, const uint8_t *data, size_t bytes) {
        self(user).hdl64_.emplace_back(time_ns, Bytes(data, data + bytes));
    }
    static upb_send on_can(void *user, uint64_t time_ns, const upb_can_frame *frame) {
        if (!self(user).can_up_)
            return UPB_SEND_FAILED;
        self(user).can_.push_back({time_ns, *frame});
        return UPB_SEND_DONE;
    }
    static upb_send on_serial(void *user, uint64_t time_ns, const uint8_t *data, size_t bytes) {
        if (!self(user).serial_up_)
            return UPB_SEND_FAILED;
        self(user).serial_.emplace_back(time_ns, Bytes(data, data + bytes));
        return UPB_SEND_DONE;
    }
    static void on_ledger(void *user, const upb_ledger_record *record) { self(user).ledger_.push_back(*record); }
    static void on_event(void *user, const upb_event *event) { self(user).events_.push_back(*event); }

    static upb_stored read_store(void *user, upb_store what, uint8_t *bytes, size_t count) {
        const auto found = self(user).store_.find(what);
        if (found == self(user).store_.end())
            return UPB_STORED_NOTHING;
        if (found->second.size() != count)
            return UPB_STORED_FAILED;
        std::memcpy(bytes, found->second.data(), count);
        return UPB_STORED_DONE;
    }
    static upb_stored write_store(void *user, upb_store what, const uint8_t *bytes, size_t count) {
        self(user).store_[what] = Bytes(bytes, bytes + count);
        return UPB_STORED_DONE;
    }
    static int find_model(void *user, uint32_t crc32, const void **ubm, size_t *bytes) {
        for (const Bytes &model : self(user).models_) {
            uint32_t crc = 0;
            if (model.size() >= 4)
                for (unsigned i = 0; i < 4; ++i) // a model file ends with its checksum, little-endian
                    crc |= static_cast<uint32_t>(model[model.size() - 4 + i]) << (8 * i);
            if (model.size() >= 4 && crc == crc32) {
                *ubm = model.data();
                *bytes = model.size();
                return 1;
            }
        }
        return 0;
    }
    static int on_reset(void *user, uint32_t type) {
        self(user).resets_.push_back(type);
        return 1;
    }

    upb_daemon_config config_;
    std::unique_ptr<void, Free> memory_;
    upb_daemon *daemon_ = nullptr;
    bool can_up_ = true, serial_up_ = true;
    std::vector<Timed> columns_, hdl64_, serial_;
    std::vector<CanOut> can_;
    std::vector<upb_ledger_record> ledger_;
    std::vector<upb_event> events_;
    std::map<uint32_t, Bytes> store_;
    std::vector<Bytes> models_;
    std::vector<uint32_t> resets_;
};

nb::tuple check_names() {
    nb::list list;
    for (uint32_t bit = 0; upb_daemon_check_name(bit) != nullptr; ++bit)
        list.append(upb_daemon_check_name(bit));
    return nb::tuple(list);
}

nb::tuple drop_names() {
    nb::list list;
    for (uint32_t drop = 0; drop < UPB_DROPS; ++drop)
        list.append(upb_drop_name(drop));
    return nb::tuple(list);
}

} // namespace

NB_MODULE(_daemon, m) {
    m.doc() = "The core of upbeamd on virtual time.";
    nb::exception<DaemonError>(m, "DaemonError", PyExc_ValueError);
    m.def("default_settings", default_settings);
    m.def("check_names", check_names);
    m.def("drop_names", drop_names);
    nb::class_<Daemon>(m, "Daemon")
        .def(nb::init<const nb::bytes &, const nb::dict &, const std::vector<std::string> &, const nb::bytes &,
                      const nb::dict &, const std::vector<nb::bytes> &>(),
             "ubm"_a, "settings"_a, "outputs"_a, "key"_a, "stored"_a, "models"_a)
        .def("packet", &Daemon::packet, "data"_a, "received_ns"_a, "source"_a = 0)
        .def("position", &Daemon::position, "data"_a, "received_ns"_a, "source"_a = 0)
        .def("queue_full", &Daemon::queue_full, "packets"_a, "now_ns"_a)
        .def("can", &Daemon::can, "id"_a, "data"_a, "received_ns"_a, "flags"_a = 0)
        .def("serial", &Daemon::serial, "data"_a, "received_ns"_a)
        .def("tick", &Daemon::tick, "now_ns"_a)
        .def("end", &Daemon::end, "now_ns"_a)
        .def("swap_model", &Daemon::swap_model, "ubm"_a, "now_ns"_a)
        .def("set_floor", &Daemon::set_floor, "mode"_a, "now_ns"_a)
        .def("set_service", &Daemon::set_service, "service_ns"_a)
        .def("set_links", &Daemon::set_links, "can"_a, "serial"_a)
        .def("take_columns", &Daemon::take_columns)
        .def("take_hdl64", &Daemon::take_hdl64)
        .def("take_serial", &Daemon::take_serial)
        .def("take_can", &Daemon::take_can)
        .def("take_ledger", &Daemon::take_ledger)
        .def("take_events", &Daemon::take_events)
        .def("counters", &Daemon::counters)
        .def("status", &Daemon::status)
        .def("latency", &Daemon::latency)
        .def("calibration", &Daemon::calibration)
        .def("region_bytes", &Daemon::region_bytes, "region"_a)
        .def("flip_bit", &Daemon::flip_bit, "region"_a, "bit"_a)
        .def("stored", &Daemon::stored)
        .def("resets", &Daemon::resets)
        .def("memory_bytes", &Daemon::memory_bytes);
}
