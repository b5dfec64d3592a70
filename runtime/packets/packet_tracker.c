/* Where firings lie in the turn, and what is missing between them. */
#include <string.h>

#include "packet_wire.h"

#define FULL ((int64_t)UPB_FULL_TURN_MDEG)
#define NS_PER_S INT64_C(1000000000)
#define RATE_SHIFT 8    /* fraction bits of the smoothed rate */
#define RATE_SMOOTH 32  /* firings */
#define EXACT_FIRINGS 8 /* azimuth, in steps of 0.01 degrees, and speed are good enough to count so many */

upb_packet_status upb_azimuth_tracker_init(upb_azimuth_tracker *tracker, uint32_t cut_mdeg, uint32_t cycle_ns) {
    if (!tracker || cut_mdeg >= UPB_FULL_TURN_MDEG || cycle_ns == 0 || cycle_ns > 1000000)
        return UPB_PACKET_E_ARGUMENT;
    memset(tracker, 0, sizeof *tracker);
    tracker->cut_mdeg = cut_mdeg;
    tracker->cycle_ns = cycle_ns;
    return UPB_PACKET_OK;
}

static int64_t rate_of(const upb_azimuth_tracker *tracker) { return (int64_t)(tracker->rate_mdeg_s_q8 >> RATE_SHIFT); }

static void smooth_rate(upb_azimuth_tracker *tracker, uint32_t rate_mdeg_s) {
    const int64_t now = (int64_t)rate_mdeg_s << RATE_SHIFT;
    const int64_t was = (int64_t)tracker->rate_mdeg_s_q8;
    tracker->rate_mdeg_s_q8 = (uint64_t)(was == 0 ? now : was + (now - was) / RATE_SMOOTH);
}

/* -FULL / 2 .. FULL / 2 - 1 */
static int64_t short_way(int64_t angle) {
    const int64_t turned = (angle + FULL / 2) % FULL;
    return (turned < 0 ? turned + FULL : turned) - FULL / 2;
}

static int64_t round_div(int64_t value, int64_t divisor) {
    return value >= 0 ? (value + divisor / 2) / divisor : -((-value + divisor / 2) / divisor);
}

static int64_t magnitude(int64_t value) { return value >= 0 ? value : -value; }

static int64_t within(int64_t value, int64_t low, int64_t high) {
    return value < low ? low : value > high ? high : value;
}

/* How a firing lies to the last one. */
typedef struct motion {
    int64_t turned_mdeg; /* azimuth, whole turns included */
    int64_t firings;     /* 1: the next one; 0 and less: late */
    uint32_t flags;
} motion;

/* The clock tells another story than the azimuth, which is believed: a firing forward, at least. */
static void believe_azimuth(motion *m, int64_t step, int64_t most) {
    m->flags = UPB_STEP_TIME_JUMP;
    m->firings = step > 0 ? within(round_div(m->turned_mdeg, step), 1, most) : 1;
}

/* The clock counts firings, the azimuth says whether to believe it: over a few firings to the number, else roughly. */
static motion motion_between(const upb_azimuth_tracker *tracker, const upb_firing *firing, int64_t elapsed_ns) {
    const int64_t rate = rate_of(tracker);
    const int64_t step = rate * tracker->cycle_ns / NS_PER_S;
    const int64_t most = (int64_t)UPB_TRACKER_LOST_NS / tracker->cycle_ns;
    const int64_t seen = short_way((int64_t)firing->azimuth_mdeg - tracker->azimuth_mdeg);
    const int64_t expected = rate * elapsed_ns / NS_PER_S;
    const int64_t surprise = short_way(seen - expected);
    const int64_t tolerance = 2 * step + 100 + magnitude(expected) / 8;
    motion m = {expected + surprise, round_div(elapsed_ns, tracker->cycle_ns), 0};
    if (rate > 0 && magnitude(surprise) > tolerance) {
        m.turned_mdeg = seen > 0 ? seen : seen + FULL;
        believe_azimuth(&m, step, most);
    } else if (step > 0 && m.turned_mdeg == seen && seen <= EXACT_FIRINGS * step) {
        const int64_t by_azimuth = round_div(seen, step);
        if (by_azimuth >= 1 && by_azimuth != m.firings)
            believe_azimuth(&m, step, most);
    }
    if (seen == 0 && m.firings > 0 && m.turned_mdeg == 0)
        m.flags |= UPB_STEP_STUCK;
    return m;
}

static upb_step step_at(const upb_azimuth_tracker *tracker, uint32_t flags, uint32_t missing) {
    upb_step step;
    step.flags = flags;
    step.missing = missing;
    step.firing = tracker->firing;
    step.angle_mdeg = tracker->angle_mdeg;
    step.frame = tracker->frame;
    step.rpm_milli = (uint32_t)(rate_of(tracker) / 6); /* 6 mdeg a second: a thousandth of a turn a minute */
    return step;
}

/* Nothing is known of what came before: a new frame. */
static upb_step begin(upb_azimuth_tracker *tracker, const upb_firing *firing) {
    const uint32_t first = !tracker->started;
    const int64_t in_turn = ((int64_t)firing->azimuth_mdeg + FULL - tracker->cut_mdeg) % FULL;
    tracker->started = 1;
    tracker->firing += first ? 0 : 1;
    tracker->frame += first ? 0 : 1;
    tracker->angle_mdeg = (int64_t)tracker->frame * FULL + in_turn;
    tracker->azimuth_mdeg = firing->azimuth_mdeg;
    tracker->time_ns = firing->time_ns;
    tracker->rate_mdeg_s_q8 = 0;
    smooth_rate(tracker, firing->rate_mdeg_s);
    return step_at(tracker, first ? UPB_STEP_FIRST : UPB_STEP_RESTART | UPB_STEP_FRAME, 0);
}

static upb_step late(const upb_azimuth_tracker *tracker, const motion *m) {
    upb_step step = step_at(tracker, m->flags | UPB_STEP_LATE, 0);
    step.firing += m->firings;
    step.angle_mdeg += m->turned_mdeg;
    step.frame = step.angle_mdeg > 0 ? (uint64_t)(step.angle_mdeg / FULL) : 0;
    return step;
}

upb_step upb_azimuth_track(upb_azimuth_tracker *tracker, const upb_firing *firing) {
    const int64_t elapsed_ns = (int64_t)(firing->time_ns - tracker->time_ns);
    const int64_t lost_ns = (int64_t)UPB_TRACKER_LOST_NS;
    if (!tracker->started || elapsed_ns > lost_ns || elapsed_ns < -lost_ns)
        return begin(tracker, firing);
    motion m = motion_between(tracker, firing, elapsed_ns);
    if (m.firings <= 0)
        return late(tracker, &m);
    tracker->firing += m.firings;
    tracker->angle_mdeg += m.turned_mdeg;
    tracker->azimuth_mdeg = firing->azimuth_mdeg;
    tracker->time_ns = firing->time_ns;
    smooth_rate(tracker, firing->rate_mdeg_s);
    /* An azimuth that trembles at the cut must not begin a frame twice. */
    const uint64_t frame = tracker->angle_mdeg > 0 ? (uint64_t)(tracker->angle_mdeg / FULL) : 0;
    if (frame > tracker->frame) {
        tracker->frame = frame;
        m.flags |= UPB_STEP_FRAME;
    }
    return step_at(tracker, m.flags, (uint32_t)(m.firings - 1));
}

uint32_t upb_azimuth_turn_firings(const upb_azimuth_tracker *tracker) {
    const int64_t rate = tracker ? rate_of(tracker) : 0;
    return rate > 0 ? (uint32_t)round_div(FULL * NS_PER_S, rate * tracker->cycle_ns) : 0;
}
