/* Names, configuration, memory, life and status of a daemon; the work is in daemon_*.c. */
#include <string.h>

#include "daemon_internal.h"
#include "upb_internal.h"

#define LOOK_NS (100 * NS_PER_MS)
#define UNSEEN_NS (20 * NS_PER_MS) /* between two ticks: longer, and nobody was looking */

/* ---------------------------------------------------------------------------------------------- names */

#define NAME_OF(names, index) ((index) < sizeof(names) / sizeof(names)[0] ? (names)[index] : "?")

const char *upb_drop_name(uint32_t drop) {
    static const char names[UPB_DROPS][16] = {"malformed", "wrong_model", "wrong_source", "duplicate", "late", "flood",
                                              "queue",     "stale",       "stuck",        "jump",      "ended"};
    return NAME_OF(names, drop);
}

const char *upb_event_name(uint32_t kind) {
    static const char names[][16] = {"mode",   "fault_set",   "fault_cleared", "model_swapped", "model_rejected",
                                     "resync", "stream_made", "integrity",     "gap",           "ended"};
    return NAME_OF(names, kind);
}

const char *upb_daemon_check_name(uint32_t bit) {
    static const char names[UPB_FAULTS + REACTIONS][24] = {"sensor_timeout",      "sensor_azimuth_stuck",
                                                           "sensor_azimuth_jump", "sensor_time_jump",
                                                           "sensor_rpm_range",    "sensor_beam_dead",
                                                           "sensor_ring_stuck",   "sensor_all_zero",
                                                           "sensor_thermal",      "sensor_pps_lost",
                                                           "sensor_visibility",   "sensor_crosstalk",
                                                           "sensor_wrong_model",  "net_loss",
                                                           "net_reorder",         "net_duplicate",
                                                           "net_malformed",       "net_flood",
                                                           "net_jitter",          "compute_overload",
                                                           "compute_deadline",    "compute_integrity",
                                                           "compute_throttle",    "clock_drift",
                                                           "can_bus_off",         "can_command_rejected",
                                                           "serial_framing",      "model_rejected",
                                                           "power_reset",         "react_ladder_down",
                                                           "react_ladder_up",     "react_stale",
                                                           "react_flood",         "react_duplicate",
                                                           "react_late",          "react_source",
                                                           "react_gap",           "react_resync",
                                                           "react_timeout",       "react_stuck",
                                                           "react_repair",        "react_model_check"};
    return bit < sizeof names / sizeof names[0] ? names[bit] : NULL;
}

/* ------------------------------------------------------------------------------------------- configuration */

upb_daemon_config upb_daemon_config_default(void) {
    upb_daemon_config c;
    memset(&c, 0, sizeof c);
    c.struct_bytes = sizeof c;
    c.sensor = UPB_SENSOR_HDL_32E;
    c.rpm_tolerance_permille = 100;
    c.cut_mdeg = UPB_DAEMON_CUT_OF_MODEL;
    c.width_tolerance_permille = 30;
    c.precision = UPB_PRECISION_INT16;
    c.deadline_ns = 50 * NS_PER_MS;
    c.ladder_down_ns[0] = 5 * NS_PER_MS;
    c.ladder_down_ns[1] = 10 * NS_PER_MS;
    c.ladder_down_ns[2] = 20 * NS_PER_MS;
    c.ladder_up_ns = NS_PER_MS;
    c.ladder_hold_ns = 200 * NS_PER_MS;
    c.stale_ns = 40 * NS_PER_MS;
    c.timeout_ns = 50 * NS_PER_MS;
    c.jitter_ns = 5 * NS_PER_MS;
    c.drift_ppm = 200;
    c.loss_permille = 5;
    c.throttle_permille = 1500;
    c.visibility_permille = 700;
    c.crosstalk_permille = 10;
    c.integrity_bytes = 8192;
    c.ubm_bytes_max = 1 << 16;
    c.ledger_capacity = 1024;
    return c;
}

static upb_status bad(upb_error *error, const char *what, uint64_t got, uint64_t expected) {
    return upb_fail(error, UPB_E_ARGUMENT, what, 0, got, expected);
}

static upb_status check_ladder(const upb_daemon_config *c, upb_error *error) {
    for (unsigned i = 0; i + 1 < UPB_MODES - 1; i++)
        if (c->ladder_down_ns[i] > c->ladder_down_ns[i + 1])
            return bad(error, "ladder_down_ns", c->ladder_down_ns[i + 1], c->ladder_down_ns[i]);
    if (c->ladder_up_ns == 0 || c->ladder_up_ns > c->ladder_down_ns[0])
        return bad(error, "ladder_up_ns", c->ladder_up_ns, c->ladder_down_ns[0]);
    if (c->stale_ns < c->ladder_down_ns[UPB_MODES - 2])
        return bad(error, "stale_ns", c->stale_ns, c->ladder_down_ns[UPB_MODES - 2]);
    return UPB_OK;
}

static upb_status check_config(const upb_daemon_config *c, upb_error *error) {
    const struct {
        const char *what;
        uint64_t value, least, most;
    } ranges[] = {
        {"struct_bytes", c->struct_bytes, sizeof *c, sizeof *c},
        {"sensor", c->sensor, UPB_SENSOR_HDL_32E, UPB_SENSOR_VLP_32C},
        {"any_model", c->any_model, 0, 1},
        {"rpm", c->rpm, 0, 1500},
        {"rpm_tolerance_permille", c->rpm_tolerance_permille, 0, 1000},
        {"cut_mdeg", c->cut_mdeg == UPB_DAEMON_CUT_OF_MODEL ? 0 : c->cut_mdeg, 0, UPB_FULL_TURN_MDEG - 1},
        {"fov_begin_mdeg", c->fov_begin_mdeg, 0, UPB_FULL_TURN_MDEG - 1},
        {"fov_end_mdeg", c->fov_end_mdeg, 0, UPB_FULL_TURN_MDEG - 1},
        {"width_tolerance_permille", c->width_tolerance_permille, 0, 1000},
        {"precision", c->precision, 0, UPB_PRECISION_INT8},
        {"cpu", c->cpu, 0, UPB_CPU_NEON_DOT},
        {"mode_floor", c->mode_floor, 0, UPB_MODES - 1},
        {"ladder_hold_ns", c->ladder_hold_ns, 1, 3600 * NS_PER_S},
        {"timeout_ns", c->timeout_ns, NS_PER_MS, 3600 * NS_PER_S},
        {"ubm_bytes_max", c->ubm_bytes_max, 64, 1 << 20},
        {"ledger_capacity", c->ledger_capacity, 1, 1 << 24},
        {"queue_packets", c->queue_packets, 0, VIRTUAL_QUEUE_MAX - 1},
    };
    for (size_t i = 0; i < sizeof ranges / sizeof ranges[0]; i++)
        if (ranges[i].value < ranges[i].least || ranges[i].value > ranges[i].most)
            return bad(error, ranges[i].what, ranges[i].value,
                       ranges[i].value < ranges[i].least ? ranges[i].least : ranges[i].most);
    return check_ladder(c, error);
}

/* ---------------------------------------------------------------------------------------------- memory */

typedef struct layout {
    size_t daemon, model[SLOTS], ubm[SLOTS], stream, notes, records, bytes;
} layout;

static size_t place(size_t *at, size_t bytes) {
    const size_t here = *at;
    *at += (bytes + UPB_ALIGN - 1) / UPB_ALIGN * UPB_ALIGN;
    return here;
}

static layout lay_out(const upb_daemon_config *c) {
    layout l = {0};
    l.daemon = place(&l.bytes, sizeof(upb_daemon));
    for (unsigned i = 0; i < SLOTS; i++) {
        l.model[i] = place(&l.bytes, UPB_MODEL_BYTES_MAX);
        l.ubm[i] = place(&l.bytes, c->ubm_bytes_max);
    }
    l.stream = place(&l.bytes, STREAM_BYTES);
    l.notes = place(&l.bytes, FIRINGS_KEPT * sizeof(firing_note));
    l.records = place(&l.bytes, c->ledger_capacity * sizeof(upb_ledger_record));
    return l;
}

size_t upb_daemon_bytes(const upb_daemon_config *config) {
    return config && check_config(config, NULL) == UPB_OK ? lay_out(config).bytes : 0;
}

/* ------------------------------------------------------------------------------------------------ time */

uint64_t daemon_now(upb_daemon *d) {
    if (!daemon_is_virtual(d)) {
        const uint64_t now = d->config.clock.now_ns(d->config.clock.user);
        d->now_ns = now > d->now_ns ? now : d->now_ns;
    }
    return d->now_ns;
}

static uint64_t ledger_now(void *user) { return daemon_now(user); }

void daemon_time_at_least(upb_daemon *d, uint64_t now_ns) {
    if (daemon_is_virtual(d) && now_ns > d->now_ns)
        d->now_ns = now_ns;
}

void daemon_event(upb_daemon *d, upb_event_kind kind, uint32_t a, uint32_t b, uint64_t value) {
    d->counters.events++;
    if (!d->config.sinks.event)
        return;
    const upb_event event = {daemon_now(d), d->frame, value, (uint32_t)kind, a, b, 0};
    d->config.sinks.event(d->config.sinks.user, &event);
}

/* ------------------------------------------------------------------------------------------------ life */

static upb_status load_model(upb_daemon *d, uint32_t slot_index, const void *ubm, size_t ubm_bytes, upb_error *error) {
    model_slot *slot = &d->slot[slot_index];
    const int any = d->config.any_model || !daemon_reacts(d, REACT_MODEL_CHECK);
    if (!ubm || ubm_bytes > d->config.ubm_bytes_max)
        return upb_fail(error, ubm ? UPB_E_SIZE : UPB_E_ARGUMENT, "ubm", 0, ubm_bytes, d->config.ubm_bytes_max);
    memcpy(slot->ubm, ubm, ubm_bytes);
    slot->ubm_bytes = ubm_bytes;
    upb_status status = upb_model_load(slot->memory, UPB_MODEL_BYTES_MAX, slot->ubm, ubm_bytes, &slot->model, error);
    if (status == UPB_OK)
        status = daemon_check_model(&d->config, slot->model, any, error);
    return status == UPB_OK ? upb_model_get_info(slot->model, &slot->info) : status;
}

static void take_layout(upb_daemon *d, uint8_t *memory, const layout *l) {
    for (unsigned i = 0; i < SLOTS; i++) {
        d->slot[i].memory = memory + l->model[i];
        d->slot[i].ubm = memory + l->ubm[i];
    }
    d->stream_memory = memory + l->stream;
    d->notes = (firing_note *)(void *)(memory + l->notes);
}

static uint32_t cut_of(const upb_daemon *d) {
    const upb_daemon_config *c = &d->config;
    if (c->cut_mdeg != UPB_DAEMON_CUT_OF_MODEL)
        return c->cut_mdeg;
    if (c->fov_begin_mdeg == c->fov_end_mdeg)
        return d->slot[0].info.cut_mdeg;
    const uint32_t blind = (c->fov_begin_mdeg + UPB_FULL_TURN_MDEG - c->fov_end_mdeg) % UPB_FULL_TURN_MDEG;
    return (c->fov_end_mdeg + blind / 2) % UPB_FULL_TURN_MDEG;
}

static upb_status init_parts(upb_daemon *d, upb_ledger_record *records, upb_error *error) {
    const upb_sensor_info *sensor = upb_sensor_info_get((upb_sensor)d->config.sensor);
    const uint32_t cut = cut_of(d);
    d->cycle_ns = sensor->firing_cycle_ns;
    d->packet_firings = sensor->packet_firings;
    upb_packet_decoder_config decoder = upb_packet_decoder_config_default();
    decoder.sensor = (upb_sensor)d->config.sensor;
    if (upb_packet_decoder_init(&d->decoder, &decoder) != UPB_PACKET_OK)
        return bad(error, "sensor", d->config.sensor, 0);
    if (upb_azimuth_tracker_init(&d->tracker, cut, d->cycle_ns) != UPB_PACKET_OK)
        return bad(error, "cut_mdeg", cut, UPB_FULL_TURN_MDEG - 1);
    const upb_status status = upb_ledger_init(&d->ledger, records, d->config.ledger_capacity, d->config.deadline_ns,
                                              (upb_clock){ledger_now, d});
    return status == UPB_OK ? daemon_bus_init(d) : status;
}

upb_status upb_daemon_init(void *memory, size_t memory_bytes, const upb_daemon_config *config, const void *ubm,
                           size_t ubm_bytes, upb_daemon **daemon, upb_error *error) {
    if (!config || !daemon)
        return bad(error, config ? "daemon" : "config", 0, 0);
    *daemon = NULL;
    upb_status status = check_config(config, error);
    if (status != UPB_OK)
        return status;
    const layout l = lay_out(config);
    if ((status = upb_check_memory(memory, memory_bytes, l.bytes, error)) != UPB_OK)
        return status;
    upb_daemon *d = memory;
    memset(memory, 0, l.bytes);
    memcpy(&d->config, config, sizeof d->config); /* with its padding, whose checksum is taken */
    memcpy(d->service_ns, config->service_ns, sizeof d->service_ns);
    d->pending = NO_SLOT;
    take_layout(d, memory, &l);
    if ((status = load_model(d, 0, ubm, ubm_bytes, error)) != UPB_OK ||
        (status = init_parts(d, (upb_ledger_record *)(void *)((uint8_t *)memory + l.records), error)) != UPB_OK)
        return status;
    d->config.key = NULL; /* the bus has its copy */
    memcpy(&d->config_copy, &d->config, sizeof d->config_copy);
    daemon_ladder_init(d);
    daemon_integrity_init(d);
    d->heard_ns = d->health.looked_ns = daemon_now(d);
    daemon_note_bus_faults(d, 0); /* POWER_RESET is known from the start */
    *daemon = d;
    return UPB_OK;
}

upb_status upb_daemon_swap_model(upb_daemon *d, const void *ubm, size_t ubm_bytes, uint64_t now_ns, upb_error *error) {
    uint32_t slot = 0;
    while (slot == d->active || slot == d->pending)
        slot++;
    daemon_time_at_least(d, now_ns);
    const upb_status status = load_model(d, slot, ubm, ubm_bytes, error);
    if (status != UPB_OK) {
        d->counters.models_rejected++;
        daemon_report(d, UPB_FAULT_MODEL_REJECTED, UPB_MONITOR_FAILED, (uint64_t)status);
        daemon_event(d, UPB_EVENT_MODEL_REJECTED, (uint32_t)status, 0, 0);
        return status;
    }
    d->pending = slot;
    daemon_report(d, UPB_FAULT_MODEL_REJECTED, UPB_MONITOR_PASSED, 0);
    return UPB_OK;
}

upb_status upb_daemon_set_floor(upb_daemon *d, upb_mode mode, uint64_t now_ns) {
    if ((uint32_t)mode >= UPB_MODES)
        return UPB_E_ARGUMENT;
    daemon_time_at_least(d, now_ns);
    d->ladder.floor = (uint32_t)mode;
    daemon_ladder_apply(d);
    return UPB_OK;
}

/* How long a sensor with a limited field of view is silent each turn. */
static uint64_t blind_ns(const upb_daemon *d) {
    const upb_daemon_config *c = &d->config;
    const uint64_t blind = (c->fov_begin_mdeg + UPB_FULL_TURN_MDEG - c->fov_end_mdeg) % UPB_FULL_TURN_MDEG;
    const uint64_t rpm_milli = d->rpm_milli ? d->rpm_milli : 300000;
    return blind * 60 * (NS_PER_S / UPB_FULL_TURN_MDEG) * 1000 / rpm_milli;
}

static void watch_silence(upb_daemon *d, uint64_t now_ns) {
    if (d->ended || now_ns < d->heard_ns || now_ns - d->heard_ns < d->config.timeout_ns + blind_ns(d))
        return;
    daemon_report(d, UPB_FAULT_SENSOR_TIMEOUT, UPB_MONITOR_FAILED, now_ns - d->heard_ns);
    if (!daemon_detects(d, UPB_FAULT_SENSOR_TIMEOUT) || d->sensor_silent)
        return;
    d->sensor_silent = 1;
    if (daemon_reacts(d, REACT_TIMEOUT))
        daemon_end_segment(d, 1);
    daemon_health_forget(d);
}

void upb_daemon_tick(upb_daemon *d, uint64_t now_ns) {
    daemon_time_at_least(d, now_ns);
    if (!d->ticked) { /* waiting begins with the first call that tells the time */
        d->ticked = 1;
        if (!d->counters.packets_received)
            d->heard_ns = d->health.looked_ns = now_ns;
    } else if (now_ns > d->tick_ns + UNSEEN_NS)
        d->heard_ns += now_ns - d->tick_ns; /* the machine stood still: that says nothing of the sensor */
    d->tick_ns = now_ns;
    watch_silence(d, now_ns);
    const uint64_t present = daemon_now(d);
    if (present - d->health.looked_ns >= LOOK_NS && !d->ended)
        daemon_health_look(d, 0);
    daemon_bus_step(d, present);
}

void upb_daemon_end(upb_daemon *d, uint64_t now_ns) {
    daemon_time_at_least(d, now_ns);
    if (d->ended)
        return;
    daemon_end_segment(d, 1);
    d->ended = 1;
    daemon_event(d, UPB_EVENT_ENDED, 0, 0, 0);
    d->bus_step_ns = 0;
    daemon_bus_step(d, daemon_now(d));
    upb_bus_end(&d->bus);
}

void upb_daemon_set_service(upb_daemon *d, const uint64_t service_ns[UPB_MODES]) {
    memcpy(d->service_ns, service_ns, sizeof d->service_ns);
}

/* ------------------------------------------------------------------------------------------ looking in */

upb_daemon_status upb_daemon_get_status(const upb_daemon *d) {
    upb_daemon_status s;
    memset(&s, 0, sizeof s);
    s.counters = d->counters;
    s.counters.commands_rejected = 0;
    for (uint32_t i = 1; i < UPB_COMMAND_RESULTS; i++)
        s.counters.commands_rejected += d->bus.commands.results[i];
    s.counters.commands_accepted = d->bus.commands.results[UPB_COMMAND_DONE];
    s.now_ns = d->now_ns;
    s.frame = d->frame;
    s.faults = upb_faults_active(&d->bus.faults);
    s.faults_ever = d->faults_ever;
    s.lag_ns = d->lag_ns;
    s.lag_max_ns = d->lag_max_ns;
    s.last_latency_ns = d->last_latency_ns;
    s.service_ns = d->health.service_mean_ns;
    s.mode = d->ladder.mode;
    s.columns = d->columns;
    s.delay_columns = d->delay_columns;
    s.rpm_milli = d->rpm_milli;
    s.drift_ppm = d->health.drift_ppm;
    s.model_crc32 = d->slot[d->active].info.crc32;
    s.returns_permille = d->health.returns_permille;
    s.integrity_period_frames = daemon_integrity_period(d);
    s.ended = d->ended;
    return s;
}

const upb_ledger *upb_daemon_get_ledger(const upb_daemon *d) { return &d->ledger; }

const upb_faults *upb_daemon_get_faults(const upb_daemon *d) { return &d->bus.faults; }

const upb_packet_calibration *upb_daemon_get_calibration(const upb_daemon *d) {
    return d->encoder_made ? &d->calibration : NULL;
}
