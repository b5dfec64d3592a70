/*
 * What this machine can do, and what our kernels make of it. Times are in nanoseconds of CLOCK_MONOTONIC.
 *
 * Part of the benchmark, never of the library: it uses a heap and threads.
 */
#ifndef BENCH_H
#define BENCH_H

#include <stddef.h>
#include <stdint.h>

#include "upbeam/upbeam.h"

#ifdef __cplusplus
extern "C" {
#endif

uint64_t bench_now_ns(void);

/* ---------------------------------------------------------------------------------------------- the machine */

/*
 * A loop of independent instructions that never waits for a result: what the execution ports allow. A round is
 * `per_round` multiply-adds (or bytes).
 */
typedef struct bench_loop {
    const char *kind; /* "fma_f32", "dot_int16", "dot_int8", "load" */
    uint32_t per_round;
    /* `memory` is read by loads only: `bytes` bytes, a multiple of 4096, UPB_ALIGN-aligned. */
    void (*run)(uint64_t rounds, const void *memory, size_t bytes);
} bench_loop;

/* Kinds of operations that a window kernel is made of; most are one instruction, on AVX2 some are two. */
enum {
    BENCH_MULTIPLY_ADD, /* fused, or a dot product instruction (which is two where multiply and add are apart) */
    BENCH_MULTIPLY,
    BENCH_ADD, /* additions, subtractions */
    BENCH_MINMAX,
    BENCH_COMPARE,
    BENCH_BLEND,
    BENCH_LOGIC,
    BENCH_SHIFT,
    BENCH_CONVERT, /* between integer and float, rounding to whole numbers */
    BENCH_SHUFFLE, /* widening, narrowing, moving between lanes */
    BENCH_LOAD,    /* of weights (broadcast) and of rows */
    BENCH_STORE,
    BENCH_KINDS
};

/*
 * The operations that a kernel needs, without their dependencies: running them says how fast the kernel could be if
 * only the ports counted. For `windows` windows: `pair` for each two hidden units of a network, `leaky` besides if its
 * rectifier has a slope, `rest` for everything else of both networks.
 */
typedef struct bench_mix {
    const char *precision; /* "fp32", "int16", "int8" */
    uint32_t windows;
    uint16_t pair[BENCH_KINDS];
    uint16_t leaky[BENCH_KINDS];
    uint16_t rest[BENCH_KINDS];
    /* `blocks` times all that: plain_pairs without and leaky_pairs with slope, of both networks together. */
    void (*run)(uint64_t blocks, uint32_t plain_pairs, uint32_t leaky_pairs);
} bench_mix;

typedef struct bench_isa {
    const char *name; /* as in the Python names of upb_cpu */
    const bench_loop *loops;
    const bench_mix *mixes;
    uint32_t loop_count, mix_count;
} bench_isa;

/* The instruction sets of this machine that loops are written for, at most `capacity`; returns their number. */
uint32_t bench_isas(const bench_isa **isas, uint32_t capacity);

/* Name of a kind of instruction, static. */
const char *bench_kind_name(uint32_t kind);

/* Least nanoseconds of a round in `repeats` measurements of about a millisecond each. */
double bench_loop_ns(const bench_loop *loop, const void *memory, size_t bytes, uint32_t repeats);

/* Least nanoseconds of a block, likewise; pairs as in bench_mix.run. */
double bench_mix_ns(const bench_mix *mix, uint32_t plain_pairs, uint32_t leaky_pairs, uint32_t repeats);

/* Clock of this core in GHz while it computes: a chain of additions that take one cycle each. */
double bench_clock_ghz(uint32_t repeats);

/* ---------------------------------------------------------------------------------------------- our kernels */

typedef enum bench_work {
    BENCH_KERNELS = 0, /* counts of columns in, generated counts out: prepare and windows of both networks */
    BENCH_PUSH = 1,    /* the whole step of a stream: upb_stream_push, column by column, sink included */
    BENCH_FRAME = 2    /* the whole-frame call, image rows in and out */
} bench_work;

typedef struct bench_job bench_job;

/*
 * Something to time: one frame of `columns` aligned columns, distance and intensity [columns][UPB_BEAMS], which are
 * copied. `threads` share the columns (BENCH_KERNELS only, at most 16). Free with bench_job_free. The model must
 * outlive it. Errors: those of upb_stream_init; ARGUMENT.
 */
upb_status bench_job_make(const upb_model *model, upb_precision precision, upb_cpu cpu, bench_work work,
                          uint32_t threads, uint32_t columns, const uint16_t *distance, const uint8_t *intensity,
                          bench_job **job, upb_error *error);
void bench_job_free(bench_job *job);

/* Runs it `repeats` times and writes the time of each. */
void bench_job_time(bench_job *job, uint32_t repeats, uint64_t *ns);

/*
 * What the last run of BENCH_KERNELS generated: [columns][UPB_BEAMS], of each column the last has no meaning. Both ends
 * of the frame are edges.
 */
const uint16_t *bench_job_distance(const bench_job *job);
const uint8_t *bench_job_intensity(const bench_job *job);

/*
 * Time from pushing a column to its finished output's call of the sink, that is the computing of upb_stream_push, of
 * `pushes` columns. `interval_ns` apart, as a sensor sends them (the core waits without sleeping); 0: one after the
 * other. The job is BENCH_PUSH. *timer_ns: what reading the clock twice costs at least, included in each time.
 */
void bench_job_latency(bench_job *job, uint64_t pushes, uint64_t interval_ns, upb_histogram *histogram,
                       uint64_t *timer_ns);

/* Times `call(argument)` like bench_job_time. */
void bench_time_call(void (*call)(void *), void *argument, uint32_t repeats, uint64_t *ns);

#ifdef __cplusplus
}
#endif

#endif /* BENCH_H */
