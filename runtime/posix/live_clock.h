/* The two clocks of a run: CLOCK_MONOTONIC, or one that advances by the service times it is told. */
#ifndef UPBEAM_LIVE_CLOCK_H
#define UPBEAM_LIVE_CLOCK_H

#include <stdint.h>

typedef struct live_clock {
    uint32_t is_virtual;
    uint64_t origin_ns; /* CLOCK_MONOTONIC at the start of the run */
    uint64_t now_ns;    /* virtual: the present */
    /* Virtual: service of the packet at hand. Column i of n ends at start + fixed + spread * (i + 1) / n. */
    uint64_t start_ns;
    uint64_t fixed_ns;
    uint64_t spread_ns;
} live_clock;

uint64_t live_monotonic_ns(void);

/* Since the start of the run; the signature is upb_clock's. */
uint64_t live_clock_now(void *clock);

/* Virtual clock: the present becomes the end of column `index` of `count` of the packet at hand. Else nothing. */
void live_clock_column(live_clock *clock, uint32_t index, uint32_t count);

/* Sleeps until `until_ns` of the run, or a little longer. */
void live_clock_sleep(const live_clock *clock, uint64_t until_ns);

/* Asks the kernel to wake this thread without its usual 50 us of slack. */
void live_thread_precise_timers(void);

/* Processor time this thread has used. */
uint64_t live_thread_cpu_ns(void);

#endif
