/*
 * Monitors. What they count grows with every packet; they look at each frame's end, and at least every LOOK_NS where
 * no frame ends. What a fault does with many looks (debounce, memory) is the bus's fault memory. docs/upbeamd.md has
 * the table of what is detected, when, and what the output does meanwhile.
 */
#include <string.h>

#include "daemon_internal.h"

enum {
    BASELINE_LOOKS = 5, /* whole frames until baselines are trusted */
    BASELINE_SHIFT = 5, /* then they follow by 1/32 a frame */
    BEAM_ALIVE = 200,   /* permille of firings with a return: a beam that is expected to see something */
    BEAM_SAME = 950,    /* permille of returns as far as the one before: no scene is so round */
    BEAM_SAME_RETURNS = 64,
    NEAR_MORE = 100, /* permille of returns nearer than NEAR_UM above the baseline: fog before the sensor */
    FAR_LESS = 500,  /* permille of the baseline of returns beyond FAR_UM: fog takes these first */
    FAR_BASE = 20,   /* permille: a baseline of less says nothing */
    NEAR_UM = 4000000,
    FAR_UM = 25000000,
    ALONE_UM = 1000000, /* a return this much off both its neighbours in the row stands alone */
    STUCK_FIRINGS = 6,
    SERVICE_PACKETS = 16 /* a mean of fewer would be a baseline that nothing reaches again */
};

/* Sixteenths keep a baseline of whole permille moving. */
#define SIXTEENTH(permille) ((permille) * 16u)

void daemon_report(upb_daemon *d, upb_fault fault, upb_monitor look, uint64_t value) {
    if (!daemon_detects(d, fault))
        return;
    upb_faults_context(&d->bus.faults, d->frame, d->ladder.mode);
    if (!upb_faults_report(&d->bus.faults, (uint32_t)fault, look, daemon_now(d)))
        return;
    const int active = upb_fault_is_active(&d->bus.faults, (uint32_t)fault);
    if (active)
        d->faults_ever |= UINT64_C(1) << (fault - 1);
    daemon_event(d, active ? UPB_EVENT_FAULT_SET : UPB_EVENT_FAULT_CLEARED, (uint32_t)fault, 0, value);
}

static void look(upb_daemon *d, upb_fault fault, int fails, uint64_t value) {
    daemon_report(d, fault, fails ? UPB_MONITOR_PREFAILED : UPB_MONITOR_PREPASSED, value);
}

/* ------------------------------------------------------------------------------------------ each firing */

/* Sums over the beams of a firing, in loops that compilers make vectors of. */
void daemon_health_firing(upb_daemon *d, const upb_firing *firing) {
    health_counts *c = &d->health.now;
    const uint32_t unit = d->slot[d->active].info.distance_unit_um;
    const uint16_t near = (uint16_t)(NEAR_UM / unit), far = (uint16_t)(FAR_UM / unit);
    const int32_t apart = (int32_t)(ALONE_UM / unit);
    const uint16_t *right = firing->distance, *middle = d->health.last[0], *left = d->health.last[1];
    uint32_t returns = 0, nearer = 0, farther = 0, alone = 0;
    for (unsigned k = 0; k < UPB_BEAMS; k++) {
        const uint16_t count = right[k];
        const int32_t to_left = (int32_t)middle[k] - left[k], to_right = (int32_t)middle[k] - count;
        const int32_t across = (int32_t)left[k] - count;
        const int off_left = to_left > apart || to_left<-apart, off_right = to_right> apart || to_right < -apart;
        const int together = across <= apart && across >= -apart;
        const int all = middle[k] && left[k] && count;
        returns += count != 0;
        nearer += count != 0 && count < near;
        farther += count > far;
        alone += (uint32_t)(all & off_left & off_right & together);
        c->beam_returns[k] = (uint16_t)(c->beam_returns[k] + (count != 0));
        c->beam_same[k] = (uint16_t)(c->beam_same[k] + (count != 0 && count == middle[k]));
    }
    c->firings++;
    c->returns += returns;
    c->near += nearer;
    c->far += farther;
    c->alone += alone;
    memcpy(d->health.last[1], d->health.last[0], sizeof d->health.last[0]);
    memcpy(d->health.last[0], firing->distance, sizeof d->health.last[0]);
}

/* -------------------------------------------------------------------------------------------- each look */

static uint32_t permille(uint64_t part, uint64_t whole) { return whole ? (uint32_t)(part * 1000 / whole) : 0; }

static void follow(uint32_t *baseline, uint32_t looks, uint32_t value) {
    const int64_t apart = (int64_t)SIXTEENTH(value) - *baseline;
    *baseline =
        (uint32_t)(*baseline + (looks < BASELINE_LOOKS ? apart / (int64_t)(looks + 1) : apart >> BASELINE_SHIFT));
}

static void look_at_packets(upb_daemon *d) {
    const health_counts *c = &d->health.now;
    const uint32_t firings = c->firings + c->inserted;
    look(d, UPB_FAULT_NET_LOSS, c->inserted * 1000 > firings * d->config.loss_permille, c->inserted);
    look(d, UPB_FAULT_NET_REORDER, c->refused[UPB_DROP_LATE] > 0, c->refused[UPB_DROP_LATE]);
    look(d, UPB_FAULT_NET_DUPLICATE, c->refused[UPB_DROP_DUPLICATE] > 0, c->refused[UPB_DROP_DUPLICATE]);
    look(d, UPB_FAULT_NET_MALFORMED, c->refused[UPB_DROP_MALFORMED] > 0, c->refused[UPB_DROP_MALFORMED]);
    look(d, UPB_FAULT_SENSOR_WRONG_MODEL, c->refused[UPB_DROP_WRONG_MODEL] > 0, c->refused[UPB_DROP_WRONG_MODEL]);
    look(d, UPB_FAULT_NET_JITTER, c->jitter_ns > d->config.jitter_ns, c->jitter_ns);
    /* A jump is over when it is seen: it sets its fault when it happens, and only heals here. */
    if (!c->jumps_azimuth)
        look(d, UPB_FAULT_SENSOR_AZIMUTH_JUMP, 0, 0);
    if (!c->jumps_time)
        look(d, UPB_FAULT_SENSOR_TIME_JUMP, 0, 0);
    if (c->taken || c->refused[UPB_DROP_STUCK])
        look(d, UPB_FAULT_SENSOR_AZIMUTH_STUCK, c->stuck >= STUCK_FIRINGS || c->refused[UPB_DROP_STUCK] > 0, c->stuck);
    if (daemon_now(d) > d->health.flood_until_ns)
        look(d, UPB_FAULT_NET_FLOOD, 0, 0);
}

static void look_at_speed(upb_daemon *d) {
    const uint64_t nominal = d->config.rpm ? (uint64_t)d->config.rpm * 1000 : 0;
    const uint64_t tolerance = nominal * d->config.rpm_tolerance_permille / 1000;
    if (!d->rpm_milli || !d->health.now.taken)
        return;
    const uint64_t apart = d->rpm_milli > nominal ? d->rpm_milli - nominal : nominal - d->rpm_milli;
    /* What a rotating sensor can do at all, where no speed is configured. */
    const int fails = nominal ? apart > tolerance : d->rpm_milli < 290000 || d->rpm_milli > 1210000;
    look(d, UPB_FAULT_SENSOR_RPM_RANGE, fails, d->rpm_milli);
}

static void look_at_work(upb_daemon *d) {
    health *h = &d->health;
    const uint32_t mode = d->ladder.mode;
    look(d, UPB_FAULT_COMPUTE_OVERLOAD, h->now.overloaded > 0, d->lag_ns);
    if (h->now.service_packets < SERVICE_PACKETS)
        return;
    const uint64_t mean = h->now.service_ns / h->now.service_packets;
    h->service_mean_ns = mean;
    uint64_t *base = &h->base_service_ns[mode];
    if (h->service_looks[mode] < BASELINE_LOOKS) {
        *base = h->service_looks[mode] == 0 || mean < *base ? mean : *base;
        h->service_looks[mode]++;
        return;
    }
    look(d, UPB_FAULT_COMPUTE_THROTTLE, mean * 1000 > *base * d->config.throttle_permille, mean);
    if (mean < *base)
        *base = mean;
}

/* The scene, beam by beam. The first failing beam is what the fault tells. */
static void look_at_beams(upb_daemon *d) {
    health *h = &d->health;
    uint32_t dead = UPB_BEAMS, stuck = UPB_BEAMS, share[UPB_BEAMS];
    for (uint32_t k = 0; k < UPB_BEAMS; k++)
        share[k] = permille(h->now.beam_returns[k], h->now.firings);
    for (uint32_t k = 0; k < UPB_BEAMS; k++) {
        const int was_alive = h->looks >= BASELINE_LOOKS && h->base_beam[k] >= SIXTEENTH(BEAM_ALIVE);
        const int between = k > 0 && k + 1 < UPB_BEAMS && share[k - 1] >= BEAM_ALIVE && share[k + 1] >= BEAM_ALIVE;
        if (share[k] == 0 && (was_alive || between) && dead == UPB_BEAMS)
            dead = k;
        if (h->now.beam_returns[k] >= BEAM_SAME_RETURNS &&
            permille(h->now.beam_same[k], h->now.beam_returns[k]) >= BEAM_SAME && stuck == UPB_BEAMS)
            stuck = k;
        if (share[k])
            follow(&h->base_beam[k], h->looks, share[k]);
    }
    look(d, UPB_FAULT_SENSOR_BEAM_DEAD, h->now.returns && dead < UPB_BEAMS, dead);
    look(d, UPB_FAULT_SENSOR_RING_STUCK, stuck < UPB_BEAMS, stuck);
}

static void look_at_scene(upb_daemon *d) {
    health *h = &d->health;
    const health_counts *c = &h->now;
    const uint32_t returns = permille(c->returns, (uint64_t)c->firings * UPB_BEAMS);
    const uint32_t near = permille(c->near, c->returns), far = permille(c->far, c->returns);
    const uint32_t alone = permille(c->alone, c->returns);
    h->returns_permille = returns;
    look(d, UPB_FAULT_SENSOR_ALL_ZERO, c->returns == 0, 0);
    if (c->returns == 0)
        return; /* nothing else can be said of the scene */
    look_at_beams(d);
    int fog = 0, crosstalk = 0;
    if (h->looks >= BASELINE_LOOKS) {
        fog = SIXTEENTH(returns) * 1000 < h->base_returns * d->config.visibility_permille ||
              SIXTEENTH(near) > h->base_near + SIXTEENTH(NEAR_MORE) ||
              (h->base_far >= SIXTEENTH(FAR_BASE) && SIXTEENTH(far) * 1000 < h->base_far * FAR_LESS);
        crosstalk = SIXTEENTH(alone) > h->base_alone + SIXTEENTH(d->config.crosstalk_permille);
        look(d, UPB_FAULT_SENSOR_VISIBILITY, fog, returns);
        look(d, UPB_FAULT_SENSOR_CROSSTALK, crosstalk, alone);
    }
    if (fog || crosstalk)
        return; /* what is wrong must not become the baseline */
    follow(&h->base_returns, h->looks, returns);
    follow(&h->base_near, h->looks, near);
    follow(&h->base_far, h->looks, far);
    follow(&h->base_alone, h->looks, alone);
    h->looks += h->looks < BASELINE_LOOKS;
}

void daemon_health_look(upb_daemon *d, int whole_frame) {
    health *h = &d->health;
    look_at_packets(d);
    look_at_speed(d);
    look_at_work(d);
    if (whole_frame)
        look_at_scene(d);
    if (h->now.positions) {
        look(d, UPB_FAULT_SENSOR_PPS_LOST, h->pps_lost != 0, 0);
        look(d, UPB_FAULT_SENSOR_THERMAL, h->thermal != 0, 0);
    }
    if (h->drift_known) {
        const uint32_t drift = (uint32_t)(h->drift_ppm < 0 ? -h->drift_ppm : h->drift_ppm);
        look(d, UPB_FAULT_CLOCK_DRIFT, drift > d->config.drift_ppm, drift);
        h->drift_known = 0;
    }
    daemon_integrity_step(d, d->config.integrity_bytes);
    memset(&h->now, 0, sizeof h->now);
    h->looked_ns = daemon_now(d);
}

void daemon_health_forget(upb_daemon *d) {
    memset(d->health.last, 0, sizeof d->health.last);
    d->sequence.drift_windows = 0;
}
