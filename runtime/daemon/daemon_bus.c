/* The daemon on its buses: a snapshot for what is sent, and what commands do. */
#include <string.h>

#include "daemon_internal.h"

#define BUS_STEP_NS (5 * NS_PER_MS)

static upb_send send_can(void *user, const upb_can_frame *frame) {
    upb_daemon *d = user;
    const upb_send sent = d->config.sinks.can(d->config.sinks.user, daemon_now(d), frame);
    d->counters.can_sent += sent == UPB_SEND_DONE;
    return sent;
}

static upb_send send_serial(void *user, const uint8_t *bytes, size_t count) {
    upb_daemon *d = user;
    const upb_send sent = d->config.sinks.serial(d->config.sinks.user, daemon_now(d), bytes, count);
    d->counters.serial_sent += sent == UPB_SEND_DONE ? count : 0;
    return sent;
}

static upb_command_result hold_mode(upb_daemon *d, uint32_t mode) {
    if (mode != UPB_MODE_AUTOMATIC && mode >= UPB_MODES)
        return UPB_COMMAND_VALUE;
    d->ladder.held = mode != UPB_MODE_AUTOMATIC;
    d->ladder.held_mode = mode;
    daemon_ladder_apply(d);
    return UPB_COMMAND_DONE;
}

static upb_command_result change_model(upb_daemon *d, uint32_t crc32) {
    const void *ubm;
    size_t bytes;
    if (!d->config.find_model || !d->config.find_model(d->config.user, crc32, &ubm, &bytes))
        return UPB_COMMAND_REFUSED;
    return upb_daemon_swap_model(d, ubm, bytes, daemon_now(d), NULL) == UPB_OK ? UPB_COMMAND_DONE : UPB_COMMAND_REFUSED;
}

static upb_command_result execute(void *user, const upb_command *command) {
    upb_daemon *d = user;
    if (command->code == UPB_COMMAND_MODE)
        return hold_mode(d, command->argument);
    if (command->code == UPB_COMMAND_MODEL)
        return change_model(d, command->model_crc32);
    return UPB_COMMAND_UNKNOWN;
}

static int reset(void *user, uint32_t type) {
    upb_daemon *d = user;
    return d->config.reset(d->config.user, type);
}

upb_status daemon_bus_init(upb_daemon *d) {
    upb_bus_config config = upb_bus_config_default();
    config.can = (upb_can_transport){d->config.sinks.can ? send_can : NULL, d};
    config.serial = (upb_serial_transport){d->config.sinks.serial ? send_serial : NULL, d};
    config.storage = d->config.storage;
    config.key = d->config.key;
    config.execute = execute;
    config.muted_faults = d->config.sabotage & ((UINT64_C(1) << UPB_FAULTS) - 1);
    config.reset = d->config.reset ? reset : NULL;
    config.user = d;
    return upb_bus_init(&d->bus, &config, d->now_ns);
}

static uint32_t state_of(const upb_daemon *d) {
    if (d->ended)
        return UPB_STATE_STOPPING;
    if (!d->counters.packets_processed)
        return UPB_STATE_STARTING;
    if (d->sensor_silent)
        return UPB_STATE_NO_SENSOR;
    return d->ladder.mode == UPB_MODE_NETWORK ? UPB_STATE_RUNNING : UPB_STATE_DEGRADED;
}

static void fill_counters(const upb_daemon *d, uint64_t *to) {
    const upb_daemon_counters *c = &d->counters;
    uint64_t dropped = 0;
    for (uint32_t i = 0; i < UPB_DROPS; i++)
        dropped += c->packets_dropped[i];
    to[UPB_COUNTER_PACKETS_IN] = c->packets_received;
    to[UPB_COUNTER_PACKETS_OUT] = c->column_datagrams + c->hdl64_packets;
    to[UPB_COUNTER_PACKETS_DROPPED] = dropped;
    to[UPB_COUNTER_COLUMNS_IN] = c->firings_processed;
    to[UPB_COUNTER_COLUMNS_OUT] = c->columns_out;
    to[UPB_COUNTER_COLUMNS_MISSING] = c->firings_inserted + c->firings_skipped;
    to[UPB_COUNTER_FRAMES] = c->frames_closed;
    to[UPB_COUNTER_FRAMES_MISSED] = c->frames_missed;
    to[UPB_COUNTER_FRAMES_PARTIAL] = c->frames_partial;
    to[UPB_COUNTER_FRAMES_LOST] = c->frames_skipped + d->ledger.lost;
    to[UPB_COUNTER_MODE_CHANGES] = c->mode_changes;
}

static upb_bus_snapshot snapshot_of(const upb_daemon *d) {
    upb_bus_snapshot snapshot;
    memset(&snapshot, 0, sizeof snapshot);
    if (d->ledger.closed)
        snapshot.record = d->ledger.records[(d->ledger.closed - 1) % d->ledger.capacity];
    snapshot.state = state_of(d);
    snapshot.mode = d->ladder.mode;
    snapshot.latency_max_ns = d->ledger.latency.max_ns;
    fill_counters(d, snapshot.counters);
    memcpy(snapshot.drops, d->counters.packets_dropped, sizeof d->counters.packets_dropped);
    snapshot.model_crc32 = d->slot[d->active].info.crc32;
    snapshot.model_swaps = (uint32_t)d->counters.models_swapped;
    snapshot.precision = d->config.precision;
    upb_stream_stats stats;
    if (d->stream && upb_stream_get_stats(d->stream, &stats) == UPB_OK)
        snapshot.cpu = stats.cpu;
    return snapshot;
}

_Static_assert(UPB_DROPS <= UPB_DROP_CAUSES_MAX, "every cause has its counter on the bus");

/* Faults that the bus looks for itself: their events. */
void daemon_note_bus_faults(upb_daemon *d, uint64_t before) {
    static const upb_fault own[] = {UPB_FAULT_CAN_BUS_OFF, UPB_FAULT_CAN_COMMAND_REJECTED, UPB_FAULT_SERIAL_FRAMING,
                                    UPB_FAULT_POWER_RESET};
    const uint64_t now = upb_faults_active(&d->bus.faults);
    for (size_t i = 0; i < sizeof own / sizeof own[0]; i++) {
        const uint64_t bit = UINT64_C(1) << (own[i] - 1);
        if (!((before ^ now) & bit))
            continue;
        d->faults_ever |= now & bit;
        daemon_event(d, now & bit ? UPB_EVENT_FAULT_SET : UPB_EVENT_FAULT_CLEARED, (uint32_t)own[i], 0, 0);
    }
}

static void step(upb_daemon *d, uint64_t now_ns) {
    const upb_bus_snapshot snapshot = snapshot_of(d);
    const uint64_t before = upb_faults_active(&d->bus.faults);
    d->bus_step_ns = now_ns + BUS_STEP_NS;
    upb_bus_step(&d->bus, &snapshot, now_ns);
    daemon_note_bus_faults(d, before);
}

void daemon_bus_step(upb_daemon *d, uint64_t now_ns) {
    if (now_ns >= d->bus_step_ns)
        step(d, now_ns);
}

void upb_daemon_can(upb_daemon *d, const upb_can_frame *frame, uint64_t received_ns) {
    daemon_time_at_least(d, received_ns);
    d->counters.can_received++;
    const uint64_t before = upb_faults_active(&d->bus.faults);
    upb_bus_can(&d->bus, frame, daemon_now(d));
    daemon_note_bus_faults(d, before);
    step(d, daemon_now(d)); /* answers do not wait */
}

void upb_daemon_serial(upb_daemon *d, const uint8_t *data, size_t bytes, uint64_t received_ns) {
    daemon_time_at_least(d, received_ns);
    d->counters.serial_received += bytes;
    const uint64_t before = upb_faults_active(&d->bus.faults);
    upb_bus_serial(&d->bus, data, bytes, daemon_now(d));
    daemon_note_bus_faults(d, before);
    step(d, daemon_now(d));
}
