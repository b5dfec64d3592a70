/* A thread that sleeps in short steps and notes when it was woken late: the machine stood still, or was busy. */
#ifndef UPBEAM_LIVE_WITNESS_H
#define UPBEAM_LIVE_WITNESS_H

#include <stdatomic.h>

#include "live_clock.h"
#include "upb_live.h"

#define LIVE_STALLS_PER_WITNESS 1024u

typedef struct live_witness {
    const live_clock *clock;
    const _Atomic int *end;
    uint64_t period_ns;
    uint64_t threshold_ns;
    uint32_t cpu;   /* to be bound to; UINT32_MAX: not bound */
    uint32_t bound; /* it is */
    uint32_t count;
    uint64_t unlisted;
    upb_live_stall stalls[LIVE_STALLS_PER_WITNESS];
} live_witness;

/* The cores this process may use, at most `capacity`; 0 if the system does not tell. */
uint32_t live_witness_cpus(uint32_t *cpus, uint32_t capacity);

/* Thread function: `witness` until *end. */
void *live_witness_run(void *witness);

/* Sorts by start, as upb_live_explains needs it. */
void live_witness_sort(upb_live_stall *stalls, size_t count);

#endif
