// The extension module upbeam.runtime.bus._bus: the C bus library for Python. A Device is a upb_bus on a desk: its
// storage is a dict of bytes, what it sends is collected, what it is told to do is collected.
#include <nanobind/nanobind.h>
#include <nanobind/stl/map.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <cstring>
#include <map>
#include <optional>
#include <stdexcept>
#include <string>
#include <tuple>
#include <utility>
#include <vector>

#include "upbeam/bus.h"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

using Frame = std::tuple<uint32_t, uint32_t, nb::bytes>;  // identifier, flags, data
using Storage = nb::typed<nb::dict, nb::int_, nb::bytes>; // by upb_store

const uint8_t *bytes_of(const nb::bytes &bytes) { return reinterpret_cast<const uint8_t *>(bytes.data()); }

nb::bytes to_bytes(const uint8_t *bytes, size_t count) {
    return nb::bytes(reinterpret_cast<const char *>(bytes), count);
}

void check(upb_status status, const char *what) {
    if (status != UPB_OK)
        throw std::invalid_argument(std::string(what) + ": status " + std::to_string(status));
}

upb_can_frame make_frame(uint32_t id, uint32_t flags, const nb::bytes &data) {
    upb_can_frame frame{};
    if (data.size() > UPB_CAN_FD_BYTES || flags > 255)
        throw std::invalid_argument("frame: at most 64 bytes of data, flags 0..7");
    frame.id = id;
    frame.flags = static_cast<uint8_t>(flags);
    frame.length = static_cast<uint8_t>(data.size());
    std::memcpy(frame.data, data.data(), data.size());
    return frame;
}

Frame from_frame(const upb_can_frame &frame) { return {frame.id, frame.flags, to_bytes(frame.data, frame.length)}; }

class Device {
  public:
    Device(const std::optional<nb::bytes> &key, const Storage &storage, bool clear_locked, bool status_on_serial,
           bool can_reset, uint32_t block_size, uint32_t st_min, uint64_t now_ns)
        : storage_(storage) {
        upb_bus_config config = upb_bus_config_default();
        if (key && key->size() != UPB_KEY_BYTES)
            throw std::invalid_argument("key: 16 bytes");
        config.key = key ? bytes_of(*key) : nullptr;
        config.can = {send, this};
        config.serial = {send_serial, this};
        config.storage = {read, write, this};
        config.execute = execute;
        config.reset = can_reset ? reset : nullptr;
        config.user = this;
        config.clear_locked = clear_locked;
        config.status_on_serial = status_on_serial;
        config.isotp.block_size = static_cast<uint8_t>(block_size);
        config.isotp.st_min = static_cast<uint8_t>(st_min);
        check(upb_bus_init(&bus_, &config, now_ns), "device");
    }
    Device(const Device &) = delete; // the bus object points at itself
    Device &operator=(const Device &) = delete;

    bool can(uint32_t id, const nb::bytes &data, uint32_t flags, uint64_t now_ns) {
        const upb_can_frame frame = make_frame(id, flags, data);
        return upb_bus_can(&bus_, &frame, now_ns);
    }
    void serial(const nb::bytes &bytes, uint64_t now_ns) {
        upb_bus_serial(&bus_, bytes_of(bytes), bytes.size(), now_ns);
    }
    void ledger(const upb_ledger_record &record) { upb_bus_ledger(&bus_, &record); }
    void step(uint64_t now_ns) { upb_bus_step(&bus_, &snapshot, now_ns); }
    bool end() { return upb_bus_end(&bus_) == UPB_STORED_DONE; }

    std::vector<Frame> take_can() {
        std::vector<Frame> frames;
        for (const upb_can_frame &frame : std::exchange(sent_, {}))
            frames.push_back(from_frame(frame));
        return frames;
    }
    nb::bytes take_serial() {
        const std::vector<uint8_t> line = std::exchange(line_, {});
        return to_bytes(line.data(), line.size());
    }
    std::vector<std::tuple<uint32_t, uint32_t, uint32_t, uint32_t>> take_commands() {
        return std::exchange(commands_, {});
    }

    bool report(uint32_t fault, uint32_t look, uint64_t now_ns) {
        return upb_faults_report(&bus_.faults, fault, static_cast<upb_monitor>(look), now_ns);
    }
    uint32_t fault_status(uint32_t fault) const {
        if (fault < 1 || fault > UPB_FAULTS)
            throw std::invalid_argument("fault: 1.." + std::to_string(UPB_FAULTS));
        return bus_.faults.entries[fault].status;
    }
    uint64_t faults_active() const { return upb_faults_active(&bus_.faults); }
    std::map<std::string, uint64_t> results() const {
        std::map<std::string, uint64_t> counts;
        for (uint32_t i = 0; i < UPB_COMMAND_RESULTS; i++)
            counts[upb_command_result_text(i)] = bus_.commands.results[i];
        return counts;
    }
    std::vector<uint64_t> isotp_errors() const { return {bus_.isotp.errors, bus_.isotp.errors + UPB_ISOTP_ERRORS}; }
    uint32_t freshness() const { return bus_.commands.freshness; }
    uint64_t serial_refused() const { return upb_console_refused(&bus_.parser); }
    uint64_t sequence_faults() const { return bus_.commands.sequence_faults; }

    upb_bus_snapshot snapshot{};
    uint32_t can_answer = UPB_SEND_DONE;
    uint32_t execute_answer = UPB_COMMAND_DONE;
    bool storage_fails = false;

  private:
    static upb_send send(void *user, const upb_can_frame *frame) {
        auto *self = static_cast<Device *>(user);
        if (self->can_answer == UPB_SEND_DONE)
            self->sent_.push_back(*frame);
        return static_cast<upb_send>(self->can_answer);
    }
    static upb_send send_serial(void *user, const uint8_t *bytes, size_t count) {
        auto *self = static_cast<Device *>(user);
        self->line_.insert(self->line_.end(), bytes, bytes + count);
        return UPB_SEND_DONE;
    }
    static upb_stored read(void *user, upb_store what, uint8_t *bytes, size_t count) {
        auto *self = static_cast<Device *>(user);
        if (self->storage_fails)
            return UPB_STORED_FAILED;
        const nb::int_ key(static_cast<int>(what));
        if (!self->storage_.contains(key))
            return UPB_STORED_NOTHING;
        const nb::bytes stored = nb::cast<nb::bytes>(self->storage_[key]);
        if (stored.size() != count)
            return UPB_STORED_FAILED;
        std::memcpy(bytes, stored.data(), count);
        return UPB_STORED_DONE;
    }
    static upb_stored write(void *user, upb_store what, const uint8_t *bytes, size_t count) {
        auto *self = static_cast<Device *>(user);
        if (self->storage_fails)
            return UPB_STORED_FAILED;
        self->storage_[nb::int_(static_cast<int>(what))] = to_bytes(bytes, count);
        return UPB_STORED_DONE;
    }
    static upb_command_result execute(void *user, const upb_command *command) {
        auto *self = static_cast<Device *>(user);
        self->commands_.push_back({command->code, command->freshness, command->argument, command->model_crc32});
        return static_cast<upb_command_result>(self->execute_answer);
    }
    static int reset(void *, uint32_t) { return 1; }

    Storage storage_;
    std::vector<upb_can_frame> sent_;
    std::vector<uint8_t> line_;
    std::vector<std::tuple<uint32_t, uint32_t, uint32_t, uint32_t>> commands_;
    upb_bus bus_{};
};

// One E2E receiver: the check of a message and the state machine behind it.
class Receiver {
  public:
    Receiver(uint32_t profile, uint32_t data_id, uint32_t length, uint32_t max_delta_counter)
        : profile_(profile), config_{static_cast<uint16_t>(data_id), static_cast<uint8_t>(length),
                                     static_cast<uint8_t>(max_delta_counter)} {
        if (profile != 11 && profile != 5)
            throw std::invalid_argument("profile: 11 or 5");
        (profile == 11 ? upb_e2e_p11_check_init : upb_e2e_p05_check_init)(&check_);
    }
    uint32_t check(const std::optional<nb::bytes> &data) {
        const auto judge = profile_ == 11 ? upb_e2e_p11_check : upb_e2e_p05_check;
        return judge(&check_, &config_, data ? bytes_of(*data) : nullptr, data ? data->size() : 0);
    }

  private:
    uint32_t profile_;
    upb_e2e_config config_;
    upb_e2e_check check_{};
};

using Window = std::tuple<uint32_t, uint32_t, uint32_t>; // window, least good, most wrong

class Machine {
  public:
    Machine(const Window &init, const Window &valid, const Window &invalid, bool clear_to_invalid) {
        const upb_e2e_machine_config config{window(init), window(valid), window(invalid), clear_to_invalid};
        ::check(upb_e2e_machine_init(&machine_, &config), "window");
    }
    uint32_t step(uint32_t status) { return upb_e2e_machine_step(&machine_, static_cast<upb_e2e_status>(status)); }

  private:
    static upb_e2e_window window(const Window &w) {
        return {static_cast<uint8_t>(std::get<0>(w)), static_cast<uint8_t>(std::get<1>(w)),
                static_cast<uint8_t>(std::get<2>(w))};
    }
    upb_e2e_machine machine_{};
};

class Parser {
  public:
    Parser() { upb_console_parser_init(&parser_); }
    std::vector<Frame> feed(const nb::bytes &bytes) {
        std::vector<Frame> frames;
        upb_can_frame frame;
        for (size_t i = 0; i < bytes.size(); i++)
            if (upb_console_parse(&parser_, bytes_of(bytes)[i], &frame))
                frames.push_back(from_frame(frame));
        return frames;
    }
    uint64_t refused() const { return upb_console_refused(&parser_); }

  private:
    upb_console_parser parser_{};
};

std::pair<nb::bytes, uint32_t> protect(uint32_t profile, uint32_t data_id, uint32_t counter, const nb::bytes &data) {
    const upb_e2e_config config{static_cast<uint16_t>(data_id), static_cast<uint8_t>(data.size()), 1};
    std::vector<uint8_t> copy(bytes_of(data), bytes_of(data) + data.size());
    uint8_t next = static_cast<uint8_t>(counter);
    if (data.size() > UPB_CAN_FD_BYTES || counter > 255 || data_id > 0xffff || (profile != 11 && profile != 5))
        throw std::invalid_argument("protect: profile 11 or 5, at most 64 bytes");
    check((profile == 11 ? upb_e2e_p11_protect : upb_e2e_p05_protect)(&config, &next, copy.data(), copy.size()),
          "protect");
    return {to_bytes(copy.data(), copy.size()), next};
}

nb::bytes cmac(const nb::bytes &key, const nb::bytes &data) {
    uint8_t mac[16];
    if (key.size() != UPB_KEY_BYTES)
        throw std::invalid_argument("key: 16 bytes");
    upb_cmac(bytes_of(key), bytes_of(data), data.size(), mac);
    return to_bytes(mac, sizeof mac);
}

nb::bytes command_bytes(const nb::bytes &key, uint32_t code, uint32_t freshness, uint32_t argument,
                        uint32_t model_crc32, uint32_t sequence) {
    const upb_command command{code, freshness, argument, model_crc32};
    uint8_t data[UPB_COMMAND_BYTES], next = static_cast<uint8_t>(sequence);
    if (key.size() != UPB_KEY_BYTES)
        throw std::invalid_argument("key: 16 bytes");
    check(upb_command_build(&command, bytes_of(key), &next, data), "command");
    return to_bytes(data, sizeof data);
}

nb::bytes cobs_encode(const nb::bytes &data) {
    std::vector<uint8_t> out(data.size() + data.size() / 254 + 1);
    return to_bytes(out.data(), upb_cobs_encode(bytes_of(data), data.size(), out.data()));
}

std::optional<nb::bytes> cobs_decode(const nb::bytes &data) {
    std::vector<uint8_t> out(data.size() + 1);
    const size_t count = upb_cobs_decode(bytes_of(data), data.size(), out.data(), out.size());
    return count == SIZE_MAX ? std::nullopt : std::optional<nb::bytes>(to_bytes(out.data(), count));
}

nb::bytes frame_encode(uint32_t id, const nb::bytes &data, uint32_t flags) {
    const upb_can_frame frame = make_frame(id, flags, data);
    uint8_t bytes[UPB_CAN_WIRE_MAX];
    const size_t count = upb_can_frame_encode(&frame, bytes);
    if (!count)
        throw std::invalid_argument("frame: no such identifier, flags or length");
    return to_bytes(bytes, count);
}

Frame frame_decode(const nb::bytes &bytes) {
    upb_can_frame frame;
    check(upb_can_frame_decode(bytes_of(bytes), bytes.size(), &frame), "frame");
    return from_frame(frame);
}

nb::bytes console_encode(uint32_t id, const nb::bytes &data, uint32_t flags) {
    const upb_can_frame frame = make_frame(id, flags, data);
    uint8_t bytes[UPB_CONSOLE_FRAME_MAX];
    const size_t count = upb_console_encode(&frame, bytes);
    if (!count)
        throw std::invalid_argument("frame: no such identifier, flags or length");
    return to_bytes(bytes, count);
}

template <size_t COUNT> void set_list(uint64_t (&list)[COUNT], const std::vector<uint64_t> &values) {
    if (values.size() != COUNT)
        throw std::invalid_argument("expected " + std::to_string(COUNT) + " values");
    std::copy(values.begin(), values.end(), list);
}

void bind_snapshot(nb::module_ &m) {
    nb::class_<upb_ledger_record>(m, "Record")
        .def(nb::init<>())
        .def_rw("frame", &upb_ledger_record::frame)
        .def_rw("first_input_ns", &upb_ledger_record::first_input_ns)
        .def_rw("last_input_ns", &upb_ledger_record::last_input_ns)
        .def_rw("output_ns", &upb_ledger_record::output_ns)
        .def_rw("latency_ns", &upb_ledger_record::latency_ns)
        .def_rw("verdict", &upb_ledger_record::verdict)
        .def_rw("missing_columns", &upb_ledger_record::missing_columns)
        .def_rw("mode", &upb_ledger_record::mode)
        .def_rw("reserved", &upb_ledger_record::reserved);
    nb::class_<upb_bus_snapshot>(m, "Snapshot")
        .def_rw("record", &upb_bus_snapshot::record)
        .def_rw("state", &upb_bus_snapshot::state)
        .def_rw("mode", &upb_bus_snapshot::mode)
        .def_rw("latency_max_ns", &upb_bus_snapshot::latency_max_ns)
        .def_rw("model_crc32", &upb_bus_snapshot::model_crc32)
        .def_rw("model_swaps", &upb_bus_snapshot::model_swaps)
        .def_rw("precision", &upb_bus_snapshot::precision)
        .def_rw("cpu", &upb_bus_snapshot::cpu)
        .def(
            "set_counters", [](upb_bus_snapshot &s, const std::vector<uint64_t> &v) { set_list(s.counters, v); },
            "values"_a)
        .def(
            "set_drops", [](upb_bus_snapshot &s, const std::vector<uint64_t> &v) { set_list(s.drops, v); }, "values"_a);
}

void bind_device(nb::module_ &m) {
    nb::class_<Device>(m, "Device", "A upb_bus on a desk: dict for storage, lists of what it sent and was told to do.")
        .def(nb::init<const std::optional<nb::bytes> &, const Storage &, bool, bool, bool, uint32_t, uint32_t,
                      uint64_t>(),
             "key"_a.none(), "storage"_a, nb::kw_only(), "clear_locked"_a = false, "status_on_serial"_a = true,
             "can_reset"_a = false, "block_size"_a = 0, "st_min"_a = 0, "now_ns"_a = 0)
        .def("can", &Device::can, "id"_a, "data"_a, "flags"_a, "now_ns"_a,
             "A frame received; True if it was for the device.")
        .def("serial", &Device::serial, "data"_a, "now_ns"_a)
        .def("ledger", &Device::ledger, "record"_a)
        .def("step", &Device::step, "now_ns"_a)
        .def("end", &Device::end)
        .def("take_can", &Device::take_can, "Frames sent since the last call: (id, flags, data).")
        .def("take_serial", &Device::take_serial)
        .def("take_commands", &Device::take_commands, "Commands carried out: (code, freshness, argument, model_crc32).")
        .def("report", &Device::report, "fault"_a, "look"_a, "now_ns"_a)
        .def("fault_status", &Device::fault_status, "fault"_a)
        .def_prop_ro("faults_active", &Device::faults_active)
        .def_prop_ro("results", &Device::results)
        .def_prop_ro("isotp_errors", &Device::isotp_errors)
        .def_prop_ro("freshness", &Device::freshness)
        .def_prop_ro("serial_refused", &Device::serial_refused)
        .def_prop_ro("sequence_faults", &Device::sequence_faults)
        .def_ro("snapshot", &Device::snapshot)
        .def_rw("can_answer", &Device::can_answer)
        .def_rw("execute_answer", &Device::execute_answer)
        .def_rw("storage_fails", &Device::storage_fails);
}

void bind_faults(nb::module_ &m) {
    m.attr("FAULTS") = UPB_FAULTS;
    m.attr("COUNTERS") = UPB_COUNTERS;
    m.attr("DROP_CAUSES") = UPB_DROP_CAUSES_MAX;
    m.def("fault_name", &upb_fault_name, "id"_a);
    m.def("fault_dtc", &upb_fault_dtc, "id"_a);
    m.def(
        "fault_debounce",
        [](uint32_t id) {
            const upb_debounce d = upb_fault_debounce(id);
            return std::pair<uint32_t, uint32_t>(d.up, d.down);
        },
        "id"_a);
    m.def(
        "messages",
        [] {
            std::vector<std::tuple<std::string, uint32_t, uint32_t, uint32_t, uint32_t, uint32_t>> all;
            for (uint32_t i = 0; i < UPB_MESSAGES; i++) {
                const upb_message_info *info = upb_message_get_info(static_cast<upb_message>(i));
                all.push_back({info->name, info->id, info->flags, info->cycle_ms, info->e2e.data_id, info->e2e.length});
            }
            return all;
        },
        "The device's own messages: (name, id, flags, cycle_ms, data_id, length).");
}

} // namespace

NB_MODULE(_bus, m) {
    bind_snapshot(m);
    bind_device(m);
    bind_faults(m);
    nb::class_<Receiver>(m, "Receiver")
        .def(nb::init<uint32_t, uint32_t, uint32_t, uint32_t>(), "profile"_a, "data_id"_a, "length"_a,
             "max_delta_counter"_a)
        .def("check", &Receiver::check, "data"_a.none(), "upb_e2e_status of a message, or of none.");
    nb::class_<Machine>(m, "Machine")
        .def(nb::init<const Window &, const Window &, const Window &, bool>(), "init"_a, "valid"_a, "invalid"_a,
             "clear_to_invalid"_a = false)
        .def("step", &Machine::step, "status"_a);
    nb::class_<Parser>(m, "Parser")
        .def(nb::init<>())
        .def("feed", &Parser::feed, "data"_a)
        .def_prop_ro("refused", &Parser::refused);
    m.def("crc8", [](const nb::bytes &data) { return upb_crc8(UPB_CRC8_START, data.data(), data.size()); }, "data"_a);
    m.def(
        "crc16", [](const nb::bytes &data) { return upb_crc16(UPB_CRC16_START, data.data(), data.size()); }, "data"_a);
    m.def("cmac", &cmac, "key"_a, "data"_a);
    m.def("protect", &protect, "profile"_a, "data_id"_a, "counter"_a, "data"_a,
          "The message protected, and the next counter.");
    m.def("command_bytes", &command_bytes, "key"_a, "code"_a, "freshness"_a, "argument"_a = 0, "model_crc32"_a = 0,
          "sequence"_a = 0);
    m.def("cobs_encode", &cobs_encode, "data"_a);
    m.def("cobs_decode", &cobs_decode, "data"_a, "None if it is no COBS.");
    m.def("frame_encode", &frame_encode, "id"_a, "data"_a, "flags"_a = 0);
    m.def("frame_decode", &frame_decode, "data"_a);
    m.def("console_encode", &console_encode, "id"_a, "data"_a, "flags"_a = 0);
}
