#define _GNU_SOURCE
#include "live_clock.h"

#include <errno.h>
#include <time.h>

#ifdef __linux__
#include <sys/prctl.h>
#endif

#define NS_PER_S 1000000000u

static uint64_t read_clock(clockid_t id) {
    struct timespec t;
    clock_gettime(id, &t);
    return (uint64_t)t.tv_sec * NS_PER_S + (uint64_t)t.tv_nsec;
}

uint64_t live_monotonic_ns(void) { return read_clock(CLOCK_MONOTONIC); }

uint64_t live_thread_cpu_ns(void) { return read_clock(CLOCK_THREAD_CPUTIME_ID); }

uint64_t live_clock_now(void *clock) {
    const live_clock *c = clock;
    return c->is_virtual ? c->now_ns : live_monotonic_ns() - c->origin_ns;
}

void live_clock_column(live_clock *clock, uint32_t index, uint32_t count) {
    if (clock->is_virtual)
        clock->now_ns = clock->start_ns + clock->fixed_ns + clock->spread_ns * (index + 1u) / count;
}

void live_clock_sleep(const live_clock *clock, uint64_t until_ns) {
    const uint64_t at = clock->origin_ns + until_ns;
    const struct timespec t = {.tv_sec = (time_t)(at / NS_PER_S), .tv_nsec = (long)(at % NS_PER_S)};
    while (clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &t, NULL) == EINTR) {
    }
}

void live_thread_precise_timers(void) {
#ifdef __linux__
    prctl(PR_SET_TIMERSLACK, 1UL, 0UL, 0UL, 0UL);
#endif
}
