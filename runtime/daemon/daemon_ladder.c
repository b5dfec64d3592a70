/* The degradation ladder: how late work begins tells how the generated rows are made. */
#include "daemon_internal.h"

enum { HOLD_DOUBLED_MAX = 16 };

void daemon_ladder_init(upb_daemon *d) {
    d->ladder =
        (ladder){.floor = d->config.mode_floor, .hold_ns = d->config.ladder_hold_ns, .least_service_ns = UINT64_MAX};
    d->ladder.mode = d->ladder.floor;
}

/* The mode in force: a command's, else the worse of what the lag asks for and the floor. */
void daemon_ladder_apply(upb_daemon *d) {
    ladder *l = &d->ladder;
    uint32_t mode = l->lag_mode > l->floor ? l->lag_mode : l->floor;
    if (l->held && l->held_mode > mode)
        mode = l->held_mode;
    if (d->integrity.broken)
        mode = UPB_MODE_PASS_THROUGH;
    if (mode != l->mode) {
        const uint32_t before = l->mode;
        l->mode = mode;
        l->least_service_ns = UINT64_MAX;
        d->counters.mode_changes++;
        d->health.now.service_ns = d->health.now.service_packets = 0; /* a mean over two modes says nothing */
        daemon_event(d, UPB_EVENT_MODE, before, mode, d->lag_ns);
    }
    if (d->stream)
        upb_stream_set_mode(d->stream, (upb_mode)l->mode);
}

static uint32_t mode_of_lag(const upb_daemon_config *config, uint64_t lag_ns) {
    uint32_t mode = UPB_MODES - 1;
    while (mode > 0 && lag_ns < config->ladder_down_ns[mode - 1])
        mode--;
    return mode;
}

/* Did every packet since the climb take more than half of the time there is? Else the machine stood still, and no mode
 * helps with that. */
static int work_is_heavy(const upb_daemon *d) {
    const uint64_t least = d->ladder.least_service_ns;
    return least != UINT64_MAX && 2 * least > (uint64_t)d->cycle_ns * d->packet_firings;
}

void daemon_ladder_worked(upb_daemon *d, uint64_t service_ns) {
    if (service_ns < d->ladder.least_service_ns)
        d->ladder.least_service_ns = service_ns;
}

static void fall(upb_daemon *d, uint32_t mode, uint64_t now_ns) {
    ladder *l = &d->ladder;
    /* Whoever climbs and falls at once has climbed too early: wait longer next time. */
    if (l->climbed_ns && now_ns - l->climbed_ns < 2 * l->hold_ns && work_is_heavy(d) &&
        l->hold_ns < HOLD_DOUBLED_MAX * d->config.ladder_hold_ns)
        l->hold_ns *= 2;
    l->climbed_ns = 0;
    l->lag_mode = mode;
}

static void climb(upb_daemon *d, uint64_t now_ns) {
    ladder *l = &d->ladder;
    l->lag_mode--;
    l->climbed_ns = now_ns;
    l->calm_since_ns = now_ns;
}

void daemon_ladder_look(upb_daemon *d, uint64_t begin_ns) {
    ladder *l = &d->ladder;
    const uint32_t wanted = mode_of_lag(&d->config, d->lag_ns);
    if (d->lag_ns >= d->config.ladder_up_ns)
        l->calm_since_ns = 0;
    else if (!l->calm_since_ns)
        l->calm_since_ns = begin_ns ? begin_ns : 1;
    if (wanted > l->lag_mode && daemon_reacts(d, REACT_LADDER_DOWN))
        fall(d, wanted, begin_ns);
    else if (l->calm_since_ns && begin_ns - l->calm_since_ns >= l->hold_ns) {
        if (l->lag_mode > 0 && daemon_reacts(d, REACT_LADDER_UP))
            climb(d, begin_ns);
        else if (l->lag_mode == 0 && begin_ns - l->climbed_ns >= 4 * l->hold_ns)
            l->hold_ns = d->config.ladder_hold_ns; /* it lasted: what was learnt is old */
    }
    if (l->lag_mode > 0 || d->lag_ns >= d->config.ladder_down_ns[0])
        d->health.now.overloaded++;
    daemon_ladder_apply(d);
}
