#define _GNU_SOURCE
#include "live_witness.h"

#include <pthread.h>
#include <stdlib.h>

#ifdef __linux__
#include <sched.h>

uint32_t live_witness_cpus(uint32_t *cpus, uint32_t capacity) {
    cpu_set_t set;
    uint32_t count = 0;

    if (sched_getaffinity(0, sizeof set, &set) != 0)
        return 0;
    for (uint32_t cpu = 0; cpu < CPU_SETSIZE && count < capacity; cpu++)
        if (CPU_ISSET(cpu, &set))
            cpus[count++] = cpu;
    return count;
}

static uint32_t bind_to(uint32_t cpu) {
    cpu_set_t set;
    CPU_ZERO(&set);
    CPU_SET(cpu, &set);
    return pthread_setaffinity_np(pthread_self(), sizeof set, &set) == 0;
}
#else
uint32_t live_witness_cpus(uint32_t *cpus, uint32_t capacity) {
    (void)cpus;
    (void)capacity;
    return 0;
}

static uint32_t bind_to(uint32_t cpu) {
    (void)cpu;
    return 0;
}
#endif

static void note_stall(live_witness *w, uint64_t due_ns, uint64_t woken_ns) {
    if (w->count == LIVE_STALLS_PER_WITNESS) {
        w->unlisted++;
        return;
    }
    w->stalls[w->count++] = (upb_live_stall){
        .start_ns = due_ns, .duration_ns = woken_ns - due_ns, .cpu = w->bound ? w->cpu : UINT32_MAX, .reserved = 0};
}

void *live_witness_run(void *witness) {
    live_witness *w = witness;

    w->bound = w->cpu != UINT32_MAX && bind_to(w->cpu);
    live_thread_precise_timers();
    uint64_t now = live_clock_now((void *)(uintptr_t)w->clock);
    while (!atomic_load_explicit(w->end, memory_order_relaxed)) {
        const uint64_t due = now + w->period_ns;
        live_clock_sleep(w->clock, due);
        now = live_clock_now((void *)(uintptr_t)w->clock);
        if (now > due + w->threshold_ns)
            note_stall(w, due, now);
    }
    return NULL;
}

static int by_start(const void *a, const void *b) {
    const upb_live_stall *x = a;
    const upb_live_stall *y = b;
    return (x->start_ns > y->start_ns) - (x->start_ns < y->start_ns);
}

void live_witness_sort(upb_live_stall *stalls, size_t count) {
    if (count > 1)
        qsort(stalls, count, sizeof *stalls, by_start);
}

int upb_live_explains(const upb_live_stall *stalls, size_t count, uint64_t from_ns, uint64_t to_ns,
                      uint64_t deadline_ns) {
    uint64_t stalled = 0;
    uint64_t counted_until = from_ns;

    for (size_t i = 0; i < count; i++) {
        const uint64_t end = stalls[i].start_ns + stalls[i].duration_ns;
        const uint64_t from = stalls[i].start_ns > counted_until ? stalls[i].start_ns : counted_until;
        const uint64_t to = end < to_ns ? end : to_ns;
        if (to > from) {
            stalled += to - from;
            counted_until = to;
        }
    }
    return to_ns >= from_ns && to_ns - from_ns - stalled <= deadline_ns;
}
