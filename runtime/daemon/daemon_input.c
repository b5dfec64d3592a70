/* Data packets: who sent it, does it follow the last one, is it late, doubled, part of a flood; then its firings. */
#include <string.h>

#include "daemon_internal.h"

enum {
    LATE_US = 100000,    /* behind by at most this: overtaken on the way; by more: the clock was set back */
    AHEAD_NS = 50000000, /* before it can have been sent: the clock was set forward */
    CONFIRM_LATE = 4,    /* packets in order, all late: the clock was set back a little; or the sensor in a flood */
    CONFIRM_JUMP = 2,
    CONTINUES_PACKETS = 4, /* a packet this near behind another follows it */
    STUCK_RUN = 24,        /* firings, two packets */
    FLOOD_WINDOW_NS = 10000000,
    FLOOD_HOLD_NS = 100000000,
    DRIFT_WINDOW_NS = 500000000
};

#define HOUR_US INT64_C(3600000000)

/* ------------------------------------------------------------------------------------------------ order */

/* b - a on the sensor's clock, the short way round the hour. */
static int64_t after_us(uint32_t a, uint32_t b) {
    int64_t apart = (int64_t)b - a;
    if (apart > HOUR_US / 2)
        apart -= HOUR_US;
    else if (apart < -HOUR_US / 2)
        apart += HOUR_US;
    return apart;
}

static int64_t packet_us(const upb_daemon *d) {
    return (int64_t)((uint64_t)d->cycle_ns * d->packet_firings / NS_PER_US) + 1;
}

static int continues(const upb_daemon *d, uint32_t from_us, uint32_t to_us) {
    const int64_t apart = after_us(from_us, to_us);
    return apart > 0 && apart <= CONTINUES_PACKETS * packet_us(d);
}

static int was_taken(const packet_sequence *s, const upb_packet_info *info) {
    const uint32_t count = s->taken_count < TAKEN_KEPT ? s->taken_count : TAKEN_KEPT;
    for (uint32_t i = 0; i < count; i++)
        if (s->taken[i].time_us == info->time_us && s->taken[i].azimuth_mdeg == info->azimuth_mdeg)
            return 1;
    return 0;
}

/* A packet outside the sequence: true if enough others before it tell the same story. */
static int is_confirmed(upb_daemon *d, const upb_packet_info *info, uint32_t needed) {
    packet_sequence *s = &d->sequence;
    if (s->candidate_count && s->candidate_us == info->time_us)
        return 0; /* the same one again */
    s->candidate_count =
        s->candidate_count && continues(d, s->candidate_us, info->time_us) ? s->candidate_count + 1 : 1;
    s->candidate_us = info->time_us;
    return s->candidate_count >= needed;
}

static void begin_sequence(upb_daemon *d, const upb_packet_info *info, uint64_t received_ns) {
    packet_sequence *s = &d->sequence;
    memset(s, 0, sizeof *s);
    s->started = 1;
    s->sensor_ns = info->time_us * NS_PER_US;
    s->offset_ns = (int64_t)(received_ns - s->sensor_ns);
    s->window_offset_ns = s->offset_ns;
    s->window_begin_ns = received_ns;
}

static void restart(upb_daemon *d, const upb_packet_info *info, uint64_t received_ns) {
    d->counters.resyncs++;
    d->health.now.jumps_time++;
    daemon_report(d, UPB_FAULT_SENSOR_TIME_JUMP, UPB_MONITOR_FAILED, info->time_us);
    daemon_event(d, UPB_EVENT_RESYNC, UPB_FAULT_SENSOR_TIME_JUMP, 0, 0);
    daemon_end_segment(d, 1);
    daemon_forget_turn(d);
    begin_sequence(d, info, received_ns);
}

static int in_flood(const upb_daemon *d, uint64_t received_ns) {
    return received_ns < d->health.flood_until_ns && daemon_detects(d, UPB_FAULT_NET_FLOOD) &&
           daemon_reacts(d, REACT_FLOOD);
}

/* UPB_DROPS: take it. No packet of the sensor is refused for ever: what others confirm is taken, in a flood as well. */
static uint32_t judge_order(upb_daemon *d, const upb_packet_info *info, uint64_t received_ns) {
    packet_sequence *s = &d->sequence;
    if (!s->started) {
        begin_sequence(d, info, received_ns);
        return UPB_DROPS;
    }
    const int64_t after = after_us(s->time_us, info->time_us);
    if (after <= 0 && was_taken(s, info))
        return daemon_reacts(d, REACT_DUPLICATE) ? UPB_DROP_DUPLICATE : UPB_DROPS;
    const int64_t sent_ns = (int64_t)s->sensor_ns + after * (int64_t)NS_PER_US + s->offset_ns;
    const int is_late = after <= 0 && after > -LATE_US;
    const int is_jump = after <= -LATE_US || sent_ns - (int64_t)received_ns > AHEAD_NS;
    const int flood = in_flood(d, received_ns);
    const int is_doubtful = flood && !continues(d, s->time_us, info->time_us);
    if (is_late && !daemon_reacts(d, REACT_LATE))
        return UPB_DROPS;
    if (!is_late && !is_jump && !is_doubtful) {
        s->candidate_count = 0;
        return UPB_DROPS;
    }
    const int is_back = d->sensor_silent && (is_late || is_jump); /* it was off: nobody expects its clock to go on */
    if ((!is_back || flood) &&
        (!daemon_reacts(d, REACT_RESYNC) || !is_confirmed(d, info, is_jump && !flood ? CONFIRM_JUMP : CONFIRM_LATE)))
        return flood ? UPB_DROP_FLOOD : is_jump ? UPB_DROP_JUMP : UPB_DROP_LATE;
    if (is_back) {
        daemon_forget_turn(d);
        begin_sequence(d, info, received_ns);
    } else if (is_late || is_jump)
        restart(d, info, received_ns);
    return UPB_DROPS;
}

/* --------------------------------------------------------------------------------------------- clocks */

/* Least of received - sensor time, half a second at a time: what it does from one to the next is the clocks' drift. */
static void watch_clocks(upb_daemon *d, int64_t offset_ns, uint64_t received_ns) {
    packet_sequence *s = &d->sequence;
    if (offset_ns < s->window_offset_ns)
        s->window_offset_ns = offset_ns;
    if (offset_ns < s->offset_ns)
        s->offset_ns = offset_ns;
    if (received_ns - s->window_begin_ns < DRIFT_WINDOW_NS)
        return;
    if (s->drift_windows) {
        const int64_t million = 1000000, elapsed = (int64_t)(s->window_begin_ns - s->drift_at_ns);
        const int64_t drift = elapsed > 0 ? (s->drift_offset_ns - s->window_offset_ns) * million / elapsed : 0;
        const int64_t most = INT32_MAX;
        d->health.drift_ppm = (int32_t)(drift > most ? most : drift < -most ? -most : drift);
        d->health.drift_known = 1;
    }
    s->drift_windows++;
    s->drift_offset_ns = s->window_offset_ns;
    s->drift_at_ns = s->window_begin_ns;
    s->offset_ns = s->window_offset_ns;
    s->window_offset_ns = offset_ns;
    s->window_begin_ns = received_ns;
}

static void take_into_sequence(upb_daemon *d, const upb_packet_info *info, uint64_t received_ns) {
    packet_sequence *s = &d->sequence;
    const int64_t after = s->taken_count ? after_us(s->time_us, info->time_us) : 0;
    const uint64_t elapsed_ns = received_ns - s->received_ns;
    const int64_t jitter = (int64_t)elapsed_ns - after * (int64_t)NS_PER_US;
    s->jitter_ns = s->taken_count && after > 0 ? (uint64_t)(jitter < 0 ? -jitter : jitter) : 0;
    if (after > 0 || !s->taken_count) {
        s->sensor_ns += (uint64_t)after * NS_PER_US;
        s->time_us = info->time_us;
    }
    s->received_ns = received_ns;
    s->taken[s->taken_count % TAKEN_KEPT].time_us = info->time_us;
    s->taken[s->taken_count % TAKEN_KEPT].azimuth_mdeg = info->azimuth_mdeg;
    s->taken_count = s->taken_count + 1 < 2 * TAKEN_KEPT ? s->taken_count + 1 : TAKEN_KEPT;
    watch_clocks(d, (int64_t)(received_ns - s->sensor_ns), received_ns);
    d->health.now.taken++;
    d->heard_ns = daemon_now(d);
}

/* --------------------------------------------------------------------------------------------- refusing */

static void refuse(upb_daemon *d, uint32_t drop, uint64_t received_ns) {
    health *h = &d->health;
    d->counters.packets_dropped[drop]++;
    h->now.refused[drop]++;
    if (drop == UPB_DROP_QUEUE || drop == UPB_DROP_STALE || drop == UPB_DROP_STUCK || drop == UPB_DROP_ENDED)
        return; /* what the sensor sends, no more than it */
    if (received_ns - h->flood_window_ns >= FLOOD_WINDOW_NS) {
        h->flood_window_ns = received_ns;
        h->flood_count = 0;
    }
    /* A quarter more than the sensor sends: one whose own packets are all refused is no flood. */
    const uint64_t sent = NS_PER_S * 5 / 4 / ((uint64_t)d->cycle_ns * d->packet_firings);
    const uint64_t per_second = d->config.flood_per_second ? d->config.flood_per_second : sent;
    if (++h->flood_count * (NS_PER_S / FLOOD_WINDOW_NS) > per_second) {
        h->flood_until_ns = received_ns + FLOOD_HOLD_NS;
        daemon_report(d, UPB_FAULT_NET_FLOOD, UPB_MONITOR_FAILED, h->flood_count);
    }
}

static int is_stuck(const upb_daemon *d) {
    return d->stuck_run >= STUCK_RUN && daemon_detects(d, UPB_FAULT_SENSOR_AZIMUTH_STUCK) &&
           daemon_reacts(d, REACT_STUCK);
}

static int is_stuck_there(const upb_daemon *d, const upb_packet_info *info) {
    const uint32_t a = d->stuck_azimuth_mdeg, b = info->azimuth_mdeg, apart = a > b ? a - b : b - a;
    return is_stuck(d) && (apart < 100 || apart > UPB_FULL_TURN_MDEG - 100);
}

static uint32_t drop_of_status(upb_packet_status status) {
    switch (status) {
    case UPB_PACKET_OK:
        return UPB_DROPS;
    case UPB_PACKET_E_MODEL:
    case UPB_PACKET_E_SENSOR:
    case UPB_PACKET_E_VLS_128:
    case UPB_PACKET_E_VLP_32AB:
    case UPB_PACKET_E_PUCK_HIRES:
    case UPB_PACKET_E_VELARRAY:
    case UPB_PACKET_E_OUSTER:
        return UPB_DROP_WRONG_MODEL;
    default:
        return UPB_DROP_MALFORMED;
    }
}

/* UPB_DROPS: a data packet of the sensor. */
static uint32_t drop_of(const upb_daemon *d, upb_packet_status status, const upb_packet_info *info) {
    if (status != UPB_PACKET_OK)
        return drop_of_status(status);
    if (info->kind != UPB_PACKET_KIND_DATA)
        return UPB_DROP_MALFORMED; /* a position packet on the data port */
    return (uint32_t)info->sensor == d->config.sensor ? UPB_DROPS : UPB_DROP_WRONG_MODEL;
}

/* UPB_DROPS: take it. */
static uint32_t judge(upb_daemon *d, const uint8_t *data, size_t bytes, uint32_t source_ipv4, uint64_t received_ns,
                      upb_packet_info *info) {
    if (d->ended)
        return UPB_DROP_ENDED;
    if (d->config.source_ipv4 && source_ipv4 != d->config.source_ipv4 && daemon_reacts(d, REACT_SOURCE))
        return UPB_DROP_WRONG_SOURCE;
    const upb_packet_status status = upb_packet_identify(data, bytes, info);
    const uint32_t drop = drop_of(d, status, info);
    if (drop != UPB_DROPS)
        return in_flood(d, received_ns) ? UPB_DROP_FLOOD : drop;
    if (is_stuck_there(d, info))
        return UPB_DROP_STUCK;
    return judge_order(d, info, received_ns);
}

/* ------------------------------------------------------------------------------------------------- work */

/* Virtual time: is the modelled queue full? Work on the packet `queue_packets` before has not begun then. */
static int virtual_queue_is_full(const upb_daemon *d, uint64_t received_ns) {
    const uint32_t packets = d->config.queue_packets;
    if (!daemon_is_virtual(d) || !packets)
        return 0;
    const uint32_t place = (d->queue_next + VIRTUAL_QUEUE_MAX - packets) % VIRTUAL_QUEUE_MAX;
    return d->queue_begun_ns[place] > received_ns;
}

static uint64_t begin_work(upb_daemon *d, uint64_t received_ns) {
    if (daemon_is_virtual(d)) {
        daemon_time_at_least(d, received_ns);
        daemon_time_at_least(d, d->busy_until_ns);
        d->queue_begun_ns[d->queue_next] = d->now_ns;
        d->queue_next = (d->queue_next + 1) % VIRTUAL_QUEUE_MAX;
    }
    const uint64_t begin_ns = daemon_now(d);
    d->lag_ns = saturating_minus(begin_ns, received_ns);
    if (d->lag_ns > d->lag_max_ns)
        d->lag_max_ns = d->lag_ns;
    return begin_ns;
}

static void work(upb_daemon *d, const upb_firing *firings, uint32_t count, uint64_t received_ns, uint64_t begin_ns) {
    const uint64_t service_ns = d->service_ns[d->ladder.mode];
    const uint32_t mode = d->ladder.mode;
    for (uint32_t i = 0; i < count;) {
        const int has_second = i + 1 < count && (firings[i + 1].flags & UPB_FIRING_SECOND);
        if (daemon_is_virtual(d))
            daemon_time_at_least(d, begin_ns + service_ns * (i + 1u) / count);
        daemon_take_firing(d, &firings[i], has_second ? &firings[i + 1] : NULL, received_ns);
        i += has_second ? 2 : 1;
    }
    if (daemon_is_virtual(d))
        daemon_time_at_least(d, begin_ns + service_ns);
    d->busy_until_ns = d->heard_ns = daemon_now(d);
    daemon_ladder_worked(d, d->busy_until_ns - begin_ns);
    if (mode == d->ladder.mode) {
        d->health.now.service_ns += d->busy_until_ns - begin_ns;
        d->health.now.service_packets++;
    }
}

void upb_daemon_packet(upb_daemon *d, const uint8_t *data, size_t bytes, uint32_t source_ipv4, uint64_t received_ns) {
    upb_packet_info info;
    upb_firing firings[UPB_PACKET_FIRINGS];
    uint32_t count = 0;
    d->counters.packets_received++;
    if (received_ns < d->received_ns)
        received_ns = d->received_ns;
    d->received_ns = received_ns;
    daemon_time_at_least(d, received_ns);
    uint32_t drop = judge(d, data, bytes, source_ipv4, received_ns, &info);
    if (drop == UPB_DROPS && virtual_queue_is_full(d, received_ns))
        drop = UPB_DROP_QUEUE;
    if (drop == UPB_DROP_STUCK) { /* the sensor is there; what it measured before it stood still leaves */
        d->heard_ns = daemon_now(d);
        daemon_end_segment(d, 1);
    }
    if (drop != UPB_DROPS) {
        refuse(d, drop, received_ns);
        return;
    }
    if (is_stuck(d)) /* it moves again, at a speed that standing still says nothing of */
        daemon_forget_turn(d);
    take_into_sequence(d, &info, received_ns);
    d->sensor_silent = 0;
    const uint64_t begin_ns = begin_work(d, received_ns);
    daemon_ladder_look(d, begin_ns);
    if (d->lag_ns >= d->config.stale_ns && daemon_reacts(d, REACT_STALE)) {
        refuse(d, UPB_DROP_STALE, received_ns);
        return;
    }
    const upb_packet_status status = upb_packet_decode(&d->decoder, data, bytes, firings, &count, NULL);
    if (status != UPB_PACKET_OK) {
        refuse(d, drop_of_status(status), received_ns);
        return;
    }
    d->counters.packets_processed++;
    const uint32_t fov_break = d->fov_break;
    daemon_report(d, UPB_FAULT_SENSOR_TIMEOUT, UPB_MONITOR_PASSED, 0);
    work(d, firings, count, received_ns, begin_ns);
    /* A packet that spans the blind part of a turn is sent late, and the next one's time says so. */
    if (!fov_break && !d->fov_break && d->sequence.jitter_ns > d->health.now.jitter_ns)
        d->health.now.jitter_ns = d->sequence.jitter_ns;
    daemon_bus_step(d, daemon_now(d));
}

void upb_daemon_queue_full(upb_daemon *d, uint64_t packets, uint64_t now_ns) {
    daemon_time_at_least(d, now_ns);
    d->counters.packets_received += packets;
    d->counters.packets_dropped[UPB_DROP_QUEUE] += packets;
    d->health.now.refused[UPB_DROP_QUEUE] += (uint32_t)packets;
    d->health.now.overloaded += packets > 0;
}

void upb_daemon_position(upb_daemon *d, const uint8_t *data, size_t bytes, uint32_t source_ipv4, uint64_t received_ns) {
    upb_position position;
    daemon_time_at_least(d, received_ns);
    d->counters.positions_received++;
    if ((d->config.source_ipv4 && source_ipv4 != d->config.source_ipv4) ||
        upb_position_decode(data, bytes, &position) != UPB_PACKET_OK) {
        d->counters.positions_malformed++;
        return;
    }
    health *h = &d->health;
    h->now.positions++;
    h->pps_was_locked |= position.pps == UPB_PPS_LOCKED;
    h->pps_lost = h->pps_was_locked && position.pps != UPB_PPS_LOCKED;
    h->thermal = position.thermal_shutdown != 0;
}
