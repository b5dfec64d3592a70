// The packet codecs for NumPy. Arrays are copied; nothing here outlives its call but the decoder, encoder and tracker.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <cstring>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "upbeam/packets.h"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

template <typename T> using In1 = nb::ndarray<const T, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
template <typename T> using In2 = nb::ndarray<const T, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
using Lasers = In2<int64_t>;
using OptionalLasers = std::optional<Lasers>;

// One column each of the arrays that stand for calibrations: names and order are LASER_FIELDS.
struct LaserField {
    const char *name;
    int64_t (*get)(const upb_laser &);
    void (*set)(upb_laser &, int64_t);
};
#define FIELD(name)                                                                                                    \
    {#name, [](const upb_laser &l) { return static_cast<int64_t>(l.name); },                                           \
     [](upb_laser &l, int64_t v) { l.name = static_cast<decltype(l.name)>(v); }}
const LaserField laser_fields[] = {
    FIELD(elevation_mdeg),    FIELD(azimuth_offset_mdeg), FIELD(fire_time_ns),       FIELD(distance_correction_um),
    FIELD(distance_x_um),     FIELD(distance_y_um),       FIELD(vertical_offset_um), FIELD(horizontal_offset_um),
    FIELD(focal_distance_um), FIELD(focal_slope_e4),      FIELD(min_intensity),      FIELD(max_intensity),
    FIELD(laser_id),
};
#undef FIELD
constexpr size_t field_count = sizeof laser_fields / sizeof laser_fields[0];

PyObject *packet_error; // the module keeps it

void check(upb_packet_status status, const char *what) {
    if (status == UPB_PACKET_OK)
        return;
    const std::string text = std::string(what) + ": " + upb_packet_status_text(status);
    PyErr_SetObject(packet_error, nb::make_tuple(text, static_cast<int>(status)).ptr());
    throw nb::python_error();
}

upb_sensor sensor_by_name(const std::string &name) {
    const upb_sensor sensor = upb_sensor_by_name(name.c_str());
    if (sensor == UPB_SENSOR_AUTO && name != "auto")
        check(UPB_PACKET_E_ARGUMENT, ("sensor '" + name + "'").c_str());
    return sensor;
}

upb_packet_calibration calibration_of(upb_sensor sensor, const Lasers &lasers, bool two_point) {
    upb_packet_calibration calibration = {};
    calibration.sensor = sensor;
    calibration.two_point = two_point;
    if (lasers.shape(0) > UPB_PACKET_BEAMS || lasers.shape(1) != field_count)
        check(UPB_PACKET_E_ARGUMENT, "calibration array");
    calibration.beams = static_cast<uint32_t>(lasers.shape(0));
    for (size_t beam = 0; beam < lasers.shape(0); ++beam) {
        for (size_t k = 0; k < field_count; ++k) {
            const int64_t value = lasers(beam, k);
            laser_fields[k].set(calibration.laser[beam], value);
            if (laser_fields[k].get(calibration.laser[beam]) != value)
                check(UPB_PACKET_E_CALIBRATION, laser_fields[k].name);
        }
    }
    return calibration;
}

template <typename T> T *fresh(size_t n, nb::capsule &owner) {
    T *data = new T[n ? n : 1]();
    owner = nb::capsule(data, [](void *p) noexcept { delete[] static_cast<T *>(p); });
    return data;
}

template <typename T, typename F> auto array1(size_t n, F &&value) {
    nb::capsule owner;
    T *data = fresh<T>(n, owner);
    for (size_t i = 0; i < n; ++i)
        data[i] = static_cast<T>(value(i));
    return nb::ndarray<T, nb::numpy, nb::ndim<1>, nb::c_contig>(data, {n}, owner);
}

template <typename T, typename F> auto array2(size_t n, size_t m, F &&row) {
    nb::capsule owner;
    T *data = fresh<T>(n * m, owner);
    for (size_t i = 0; i < n; ++i)
        row(i, data + i * m);
    return nb::ndarray<T, nb::numpy, nb::ndim<2>, nb::c_contig>(data, {n, m}, owner);
}

nb::tuple calibration_tuple(const upb_packet_calibration &c) {
    return nb::make_tuple(upb_sensor_info_get(c.sensor)->name, c.two_point != 0,
                          array2<int64_t>(c.beams, field_count, [&](size_t beam, int64_t *row) {
                              for (size_t k = 0; k < field_count; ++k)
                                  row[k] = laser_fields[k].get(c.laser[beam]);
                          }));
}

// ----------------------------------------------------------------------------------------------------------- status

// clang-format off
#define STATUS_FIELDS(X)                                                                                               \
    X(hour) X(minute) X(second) X(day) X(month) X(year) X(gps) X(temperature_c) X(firmware) X(warnings)                \
    X(upper_threshold) X(lower_threshold) X(humidity) X(returns) X(power_level) X(rpm) X(fov_min_cdeg)                 \
    X(fov_max_cdeg) X(life_hours)
#define STATUS_BYTES(X) X(calibrated) X(ip_source) X(ip_destination)
// clang-format on

nb::dict status_dict(const upb_hdl64e_status &s) {
    nb::dict d;
#define GET(name) d[#name] = s.name;
    STATUS_FIELDS(GET)
#undef GET
#define GET(name) d[#name] = nb::bytes(s.name, sizeof s.name);
    STATUS_BYTES(GET)
#undef GET
    return d;
}

void set_bytes(uint8_t *target, size_t n, nb::handle value, const char *name) {
    const nb::bytes given = nb::cast<nb::bytes>(value);
    if (given.size() != n)
        check(UPB_PACKET_E_ARGUMENT, name);
    std::memcpy(target, given.data(), n);
}

void set_status(upb_hdl64e_status &s, const nb::dict &values) {
    for (auto [key, value] : values) {
        const std::string name = nb::cast<std::string>(key);
#define SET(field)                                                                                                     \
    if (name == #field) {                                                                                              \
        s.field = nb::cast<decltype(s.field)>(value);                                                                  \
        continue;                                                                                                      \
    }
        STATUS_FIELDS(SET)
#undef SET
#define SET(field)                                                                                                     \
    if (name == #field) {                                                                                              \
        set_bytes(s.field, sizeof s.field, value, #field);                                                             \
        continue;                                                                                                      \
    }
        STATUS_BYTES(SET)
#undef SET
        check(UPB_PACKET_E_ARGUMENT, ("status field '" + name + "'").c_str());
    }
}

// ---------------------------------------------------------------------------------------------------------- firings

nb::tuple firings_tuple(const std::vector<upb_firing> &f, uint32_t beams) {
    const size_t n = f.size();
    return nb::make_tuple(
        array1<uint64_t>(n, [&](size_t i) { return f[i].time_ns; }),
        array1<uint32_t>(n, [&](size_t i) { return f[i].azimuth_mdeg; }),
        array1<uint32_t>(n, [&](size_t i) { return f[i].rate_mdeg_s; }),
        array1<uint16_t>(n, [&](size_t i) { return f[i].flags; }),
        array1<uint8_t>(n, [&](size_t i) { return f[i].return_kind; }),
        array2<uint16_t>(n, beams,
                         [&](size_t i, uint16_t *row) { std::memcpy(row, f[i].distance, beams * sizeof *row); }),
        array2<uint8_t>(n, beams, [&](size_t i, uint8_t *row) { std::memcpy(row, f[i].intensity, beams); }));
}

struct FiringArrays {
    In1<uint64_t> time_ns;
    In1<uint32_t> azimuth_mdeg, rate_mdeg_s;
    In1<uint16_t> flags;
    In2<uint16_t> distance;
    In2<uint8_t> intensity;

    size_t size() const {
        const size_t n = distance.shape(0);
        const size_t beams = distance.shape(1);
        if (time_ns.shape(0) != n || azimuth_mdeg.shape(0) != n || rate_mdeg_s.shape(0) != n || flags.shape(0) != n ||
            intensity.shape(0) != n || intensity.shape(1) != beams || beams > UPB_PACKET_BEAMS)
            check(UPB_PACKET_E_ARGUMENT, "shapes of the firings' arrays");
        return n;
    }

    upb_firing at(size_t i) const {
        upb_firing f = {};
        f.time_ns = time_ns(i);
        f.azimuth_mdeg = azimuth_mdeg(i);
        f.rate_mdeg_s = rate_mdeg_s(i);
        f.flags = flags(i);
        f.beams = static_cast<uint8_t>(distance.shape(1));
        std::memcpy(f.distance, &distance(i, 0), distance.shape(1) * sizeof(uint16_t));
        std::memcpy(f.intensity, &intensity(i, 0), distance.shape(1));
        return f;
    }
};

class Decoder {
  public:
    Decoder(const std::string &sensor, int pick, const OptionalLasers &lasers, bool two_point, bool keep_calibration) {
        upb_packet_decoder_config config = upb_packet_decoder_config_default();
        upb_packet_calibration calibration;
        config.sensor = sensor_by_name(sensor);
        config.pick = static_cast<upb_pick>(pick);
        config.keep_calibration = keep_calibration;
        if (lasers) {
            calibration = calibration_of(config.sensor, *lasers, two_point);
            config.calibration = &calibration;
        }
        check(upb_packet_decoder_init(&decoder_, &config), "decoder");
    }

    nb::tuple decode(const std::vector<nb::bytes> &payloads) {
        std::vector<upb_firing> firings;
        std::vector<uint32_t> packet;
        std::vector<uint8_t> statuses;
        upb_firing buffer[UPB_PACKET_FIRINGS];
        for (const nb::bytes &payload : payloads) {
            uint32_t count = 0;
            statuses.push_back(static_cast<uint8_t>(upb_packet_decode(
                &decoder_, static_cast<const uint8_t *>(payload.data()), payload.size(), buffer, &count, nullptr)));
            firings.insert(firings.end(), buffer, buffer + count);
            packet.insert(packet.end(), count, static_cast<uint32_t>(statuses.size() - 1));
        }
        const uint32_t beams = upb_sensor_info_get(decoder_.sensor)->beams;
        return nb::make_tuple(firings_tuple(firings, beams),
                              array1<uint32_t>(packet.size(), [&](size_t i) { return packet[i]; }),
                              array1<uint8_t>(statuses.size(), [&](size_t i) { return statuses[i]; }));
    }

    const char *sensor() const { return upb_sensor_info_get(decoder_.sensor)->name; }
    nb::tuple calibration() const { return calibration_tuple(decoder_.calibration); }
    nb::dict status() const { return status_dict(decoder_.status); }

    nb::dict stats() const {
        const upb_packet_stats &s = decoder_.stats;
        nb::dict d;
        d["packets"] = std::vector<uint64_t>(s.packets, s.packets + UPB_PACKET_STATUSES);
        d["positions"] = s.positions;
        d["firings"] = s.firings;
        d["jumps"] = s.jumps;
        d["hours"] = s.hours;
        d["records"] = s.records;
        d["records_bad"] = s.records_bad;
        return d;
    }

  private:
    upb_packet_decoder decoder_;
};

class Encoder {
  public:
    Encoder(const std::string &sensor, int return_mode, const OptionalLasers &lasers, bool two_point,
            uint32_t distance_unit_um, const nb::dict &status) {
        upb_packet_encoder_config config = upb_packet_encoder_config_default(sensor_by_name(sensor));
        upb_packet_calibration calibration;
        config.return_mode = static_cast<upb_return_mode>(return_mode);
        config.distance_unit_um = distance_unit_um;
        set_status(config.status, status);
        if (lasers) {
            calibration = calibration_of(config.sensor, *lasers, two_point);
            config.calibration = &calibration;
        }
        check(upb_packet_encoder_init(&encoder_, &config), "encoder");
    }

    nb::list encode(const In1<uint64_t> &time_ns, const In1<uint32_t> &azimuth_mdeg, const In1<uint32_t> &rate_mdeg_s,
                    const In1<uint16_t> &flags, const In2<uint16_t> &distance, const In2<uint8_t> &intensity) {
        const FiringArrays firings{time_ns, azimuth_mdeg, rate_mdeg_s, flags, distance, intensity};
        nb::list packets;
        uint8_t packet[UPB_PACKET_BYTES];
        uint32_t ready = 0;
        for (size_t i = 0, n = firings.size(); i < n; ++i) {
            const upb_firing firing = firings.at(i);
            check(upb_packet_encode(&encoder_, &firing, packet, &ready), ("firing " + std::to_string(i)).c_str());
            if (ready)
                packets.append(nb::bytes(packet, sizeof packet));
        }
        return packets;
    }

    uint32_t pending() const { return upb_packet_encoder_pending(&encoder_); }
    uint32_t drop() { return upb_packet_encoder_drop(&encoder_); }
    void set_status_fields(const nb::dict &values) { set_status(encoder_.status, values); }
    nb::dict status() const { return status_dict(encoder_.status); }

    void set_record(const Lasers &lasers, bool two_point) {
        const upb_packet_calibration calibration = calibration_of(encoder_.config.sensor, lasers, two_point);
        check(upb_packet_encoder_set_record(&encoder_, &calibration), "record");
    }

    nb::dict stats() const {
        nb::dict d;
        d["packets"] = encoder_.stats.packets;
        d["firings"] = encoder_.stats.firings;
        d["too_far"] = encoder_.stats.too_far;
        return d;
    }

  private:
    upb_packet_encoder encoder_;
};

class Tracker {
  public:
    Tracker(uint32_t cut_mdeg, uint32_t cycle_ns) {
        check(upb_azimuth_tracker_init(&tracker_, cut_mdeg, cycle_ns), "tracker");
    }

    nb::tuple track(const In1<uint64_t> &time_ns, const In1<uint32_t> &azimuth_mdeg, const In1<uint32_t> &rate_mdeg_s) {
        const size_t n = time_ns.shape(0);
        if (azimuth_mdeg.shape(0) != n || rate_mdeg_s.shape(0) != n)
            check(UPB_PACKET_E_ARGUMENT, "shapes of the firings' arrays");
        std::vector<upb_step> steps;
        upb_firing firing = {};
        for (size_t i = 0; i < n; ++i) {
            firing.time_ns = time_ns(i);
            firing.azimuth_mdeg = azimuth_mdeg(i);
            firing.rate_mdeg_s = rate_mdeg_s(i);
            steps.push_back(upb_azimuth_track(&tracker_, &firing));
        }
        return nb::make_tuple(array1<uint32_t>(n, [&](size_t i) { return steps[i].flags; }),
                              array1<uint32_t>(n, [&](size_t i) { return steps[i].missing; }),
                              array1<int64_t>(n, [&](size_t i) { return steps[i].firing; }),
                              array1<int64_t>(n, [&](size_t i) { return steps[i].angle_mdeg; }),
                              array1<uint64_t>(n, [&](size_t i) { return steps[i].frame; }),
                              array1<uint32_t>(n, [&](size_t i) { return steps[i].rpm_milli; }));
    }

    uint32_t turn_firings() const { return upb_azimuth_turn_firings(&tracker_); }

  private:
    upb_azimuth_tracker tracker_;
};

// -------------------------------------------------------------------------------------------------------- functions

nb::tuple identify(const nb::bytes &payload) {
    upb_packet_info info;
    const upb_packet_status status =
        upb_packet_identify(static_cast<const uint8_t *>(payload.data()), payload.size(), &info);
    return nb::make_tuple(static_cast<int>(status), static_cast<int>(info.kind), upb_sensor_info_get(info.sensor)->name,
                          static_cast<int>(info.return_mode), info.block, info.got, info.azimuth_mdeg, info.time_us);
}

nb::tuple points(const std::string &sensor, const Lasers &lasers, bool two_point, const In1<uint64_t> &time_ns,
                 const In1<uint32_t> &azimuth_mdeg, const In1<uint32_t> &rate_mdeg_s, const In1<uint16_t> &flags,
                 const In2<uint16_t> &distance, const In2<uint8_t> &intensity) {
    const FiringArrays firings{time_ns, azimuth_mdeg, rate_mdeg_s, flags, distance, intensity};
    const upb_packet_calibration calibration = calibration_of(sensor_by_name(sensor), lasers, two_point);
    uint32_t bad = 0;
    check(upb_packet_calibration_check(&calibration, &bad), ("beam " + std::to_string(bad)).c_str());
    std::vector<upb_point> found;
    std::vector<uint32_t> firing_of;
    upb_point buffer[UPB_PACKET_BEAMS];
    for (size_t i = 0, n = firings.size(); i < n; ++i) {
        const upb_firing firing = firings.at(i);
        const uint32_t count = upb_firing_points(&calibration, &firing, buffer);
        found.insert(found.end(), buffer, buffer + count);
        firing_of.insert(firing_of.end(), count, static_cast<uint32_t>(i));
    }
    const size_t n = found.size();
    return nb::make_tuple(array2<float>(n, 3,
                                        [&](size_t i, float *row) {
                                            row[0] = found[i].x_m;
                                            row[1] = found[i].y_m;
                                            row[2] = found[i].z_m;
                                        }),
                          array1<uint8_t>(n, [&](size_t i) { return found[i].intensity; }),
                          array1<uint8_t>(n, [&](size_t i) { return found[i].beam; }),
                          array1<uint32_t>(n, [&](size_t i) { return firing_of[i]; }),
                          array1<uint32_t>(n, [&](size_t i) { return found[i].azimuth_mdeg; }),
                          array1<uint32_t>(n, [&](size_t i) { return found[i].distance_um; }));
}

nb::tuple default_calibration(const std::string &sensor) {
    upb_packet_calibration calibration;
    check(upb_packet_calibration_default(sensor_by_name(sensor), &calibration), sensor.c_str());
    return calibration_tuple(calibration);
}

nb::tuple row_calibration(const In1<int32_t> &row_elevation_mdeg, uint32_t turn_columns) {
    upb_packet_calibration calibration;
    if (row_elevation_mdeg.shape(0) != UPB_PACKET_BEAMS)
        check(UPB_PACKET_E_ARGUMENT, "row elevations");
    check(upb_packet_calibration_rows(row_elevation_mdeg.data(), turn_columns, &calibration), "row elevations");
    return calibration_tuple(calibration);
}

nb::tuple sorted_calibration(const std::string &sensor, const Lasers &lasers, bool two_point) {
    upb_packet_calibration calibration = calibration_of(sensor_by_name(sensor), lasers, two_point);
    upb_packet_calibration_sort(&calibration);
    uint32_t bad = 0;
    check(upb_packet_calibration_check(&calibration, &bad), ("beam " + std::to_string(bad)).c_str());
    return calibration_tuple(calibration);
}

nb::bytes write_record(const std::string &sensor, const Lasers &lasers, bool two_point, const nb::dict &status) {
    const upb_packet_calibration calibration = calibration_of(sensor_by_name(sensor), lasers, two_point);
    upb_hdl64e_status s = upb_packet_encoder_config_default(calibration.sensor).status;
    set_status(s, status);
    uint8_t record[UPB_RECORD_BYTES];
    check(upb_record_write(&calibration, &s, record), "record");
    return nb::bytes(record, sizeof record);
}

nb::tuple read_record(const nb::bytes &record) {
    upb_packet_calibration calibration;
    upb_hdl64e_status status = {};
    if (record.size() != UPB_RECORD_BYTES)
        check(UPB_PACKET_E_SIZE, "record");
    check(upb_record_read(static_cast<const uint8_t *>(record.data()), &calibration, &status), "record");
    return nb::make_tuple(calibration_tuple(calibration), status_dict(status));
}

// clang-format off
#define POSITION_FIELDS(X)                                                                                             \
    X(time_us) X(thermal_shutdown) X(temperature_top) X(temperature_bottom) X(temperature_at_shutdown)                 \
    X(temperature_at_power_up) X(adc_temperature) X(adc_temperature_change) X(adc_seconds) X(adc_reason) X(adc_flags)
// clang-format on

nb::dict decode_position(const nb::bytes &payload) {
    upb_position p;
    check(upb_position_decode(static_cast<const uint8_t *>(payload.data()), payload.size(), &p), "position packet");
    nb::dict d;
#define GET(name) d[#name] = p.name;
    POSITION_FIELDS(GET)
#undef GET
    d["pps"] = static_cast<int>(p.pps);
    d["nmea"] = p.nmea;
    d["nmea_valid"] = p.nmea_valid != 0;
    return d;
}

nb::bytes encode_position(const nb::dict &values) {
    upb_position p = {};
#define SET(name)                                                                                                      \
    if (values.contains(#name))                                                                                        \
        p.name = nb::cast<decltype(p.name)>(values[#name]);
    POSITION_FIELDS(SET)
#undef SET
    const std::string nmea = values.contains("nmea") ? nb::cast<std::string>(values["nmea"]) : "";
    if (nmea.size() > UPB_NMEA_BYTES)
        check(UPB_PACKET_E_ARGUMENT, "nmea");
    std::memcpy(p.nmea, nmea.c_str(), nmea.size());
    p.pps = values.contains("pps") ? static_cast<upb_pps>(nb::cast<int>(values["pps"])) : UPB_PPS_ABSENT;
    uint8_t packet[UPB_POSITION_PACKET_BYTES];
    check(upb_position_encode(&p, packet), "position packet");
    return nb::bytes(packet, sizeof packet);
}

nb::list sensors() {
    nb::list list;
    for (uint32_t k = 1; k < UPB_SENSORS; ++k) {
        const upb_sensor_info *info = upb_sensor_info_get(static_cast<upb_sensor>(k));
        list.append(nb::make_tuple(info->name, info->beams, info->distance_unit_um, info->firing_cycle_ns,
                                   info->packet_firings, info->model));
    }
    return list;
}

} // namespace

NB_MODULE(_packets, m) {
    m.doc() = "Packet codecs (runtime/include/upbeam/packets.h). Use upbeam.runtime.packets.";
    packet_error = PyErr_NewExceptionWithDoc(
        "upbeam.runtime.packets._packets.PacketError",
        "A packet, calibration or argument that cannot be. args: a sentence, the status's number.", PyExc_ValueError,
        nullptr);
    m.attr("PacketError") = nb::borrow(packet_error);

    nb::list fields;
    for (const LaserField &field : laser_fields)
        fields.append(field.name);
    m.attr("LASER_FIELDS") = nb::tuple(fields);
    nb::list texts;
    for (uint32_t k = 0; k < UPB_PACKET_STATUSES; ++k)
        texts.append(upb_packet_status_text(static_cast<upb_packet_status>(k)));
    m.attr("STATUS_TEXTS") = nb::tuple(texts);

    m.def("sensors", &sensors, "(name, beams, distance_unit_um, firing_cycle_ns, packet_firings, model) of each.");
    m.def("identify", &identify, "payload"_a);
    m.def("default_calibration", &default_calibration, "sensor"_a);
    m.def("row_calibration", &row_calibration, "row_elevation_mdeg"_a, "turn_columns"_a);
    m.def("sorted_calibration", &sorted_calibration, "sensor"_a, "lasers"_a, "two_point"_a);
    m.def("write_record", &write_record, "sensor"_a, "lasers"_a, "two_point"_a, "status"_a);
    m.def("read_record", &read_record, "record"_a);
    m.def("decode_position", &decode_position, "payload"_a);
    m.def("encode_position", &encode_position, "values"_a);
    m.def("points", &points, "sensor"_a, "lasers"_a, "two_point"_a, "time_ns"_a, "azimuth_mdeg"_a, "rate_mdeg_s"_a,
          "flags"_a, "distance"_a, "intensity"_a);

    nb::class_<Decoder>(m, "Decoder")
        .def(nb::init<const std::string &, int, const OptionalLasers &, bool, bool>(), "sensor"_a, "pick"_a,
             "lasers"_a.none(), "two_point"_a, "keep_calibration"_a)
        .def("decode", &Decoder::decode, "payloads"_a)
        .def_prop_ro("sensor", &Decoder::sensor)
        .def_prop_ro("calibration", &Decoder::calibration)
        .def_prop_ro("status", &Decoder::status)
        .def_prop_ro("stats", &Decoder::stats);
    nb::class_<Encoder>(m, "Encoder")
        .def(nb::init<const std::string &, int, const OptionalLasers &, bool, uint32_t, const nb::dict &>(), "sensor"_a,
             "return_mode"_a, "lasers"_a.none(), "two_point"_a, "distance_unit_um"_a, "status"_a)
        .def("encode", &Encoder::encode, "time_ns"_a, "azimuth_mdeg"_a, "rate_mdeg_s"_a, "flags"_a, "distance"_a,
             "intensity"_a)
        .def("set_status", &Encoder::set_status_fields, "values"_a)
        .def("set_record", &Encoder::set_record, "lasers"_a, "two_point"_a)
        .def("drop", &Encoder::drop)
        .def_prop_ro("pending", &Encoder::pending)
        .def_prop_ro("status", &Encoder::status)
        .def_prop_ro("stats", &Encoder::stats);
    nb::class_<Tracker>(m, "Tracker")
        .def(nb::init<uint32_t, uint32_t>(), "cut_mdeg"_a, "cycle_ns"_a)
        .def("track", &Tracker::track, "time_ns"_a, "azimuth_mdeg"_a, "rate_mdeg_s"_a)
        .def_prop_ro("turn_firings", &Tracker::turn_firings);
}
