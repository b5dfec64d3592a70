/* Runs the loops: which of them this machine has, how long they take. */
#define _POSIX_C_SOURCE 199309L
#include <time.h>

#include "bench.h"
#include "bench_isas.h"
#include "upb_kernels.h"

uint64_t bench_now_ns(void) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (uint64_t)now.tv_sec * 1000000000u + (uint64_t)now.tv_nsec;
}

const char *bench_kind_name(uint32_t kind) {
    static const char *const names[BENCH_KINDS] = {"multiply_add", "multiply", "add",   "minmax",
                                                   "compare",      "blend",    "logic", "shift",
                                                   "convert",      "shuffle",  "load",  "store"};
    return kind < BENCH_KINDS ? names[kind] : "";
}

/* The library's own selection says what the machine has. */
#if defined(UPB_HAVE_AVX2) || defined(UPB_HAVE_AVX512)
static int machine_has(upb_cpu cpu) {
    upb_kernels kernels;
    return upb_kernels_select(&kernels, cpu) == cpu;
}
#endif

uint32_t bench_isas(const bench_isa **isas, uint32_t capacity) {
    uint32_t count = 0;
#ifdef UPB_HAVE_AVX2
    if (count < capacity && machine_has(UPB_CPU_AVX2))
        isas[count++] = &bench_isa_avx2;
#endif
#ifdef UPB_HAVE_AVX512
    if (count < capacity && machine_has(UPB_CPU_AVX512))
        isas[count++] = &bench_isa_avx512;
#ifdef UPB_HAVE_AVX512_VNNI
    if (count < capacity && machine_has(UPB_CPU_AVX512_VNNI))
        isas[count++] = &bench_isa_avx512_vnni;
#endif
#endif
    (void)isas, (void)capacity;
    return count;
}

/* Enough rounds for a time that the clock tells well, and few enough to fit between two interruptions. */
#define TARGET_NS 1000000u

typedef void (*rounds_fn)(const void *what, uint64_t rounds);

static double least_ns(rounds_fn run, const void *what, uint32_t repeats) {
    uint64_t rounds = 1, ns = 0, least = UINT64_MAX;
    for (;;) {
        const uint64_t start = bench_now_ns();
        run(what, rounds);
        ns = bench_now_ns() - start;
        if (ns >= TARGET_NS || rounds > (uint64_t)1 << 40)
            break;
        rounds = ns < TARGET_NS / 16 ? rounds * 8 : rounds * 2;
    }
    for (uint32_t i = 0; i < repeats; i++) {
        const uint64_t start = bench_now_ns();
        run(what, rounds);
        ns = bench_now_ns() - start;
        least = ns < least ? ns : least;
    }
    return (double)least / (double)rounds;
}

typedef struct loop_run {
    const bench_loop *loop;
    const void *memory;
    size_t bytes;
} loop_run;

static void run_loop(const void *what, uint64_t rounds) {
    const loop_run *r = what;
    r->loop->run(rounds, r->memory, r->bytes);
}

double bench_loop_ns(const bench_loop *loop, const void *memory, size_t bytes, uint32_t repeats) {
    const loop_run r = {loop, memory, bytes};
    return least_ns(run_loop, &r, repeats);
}

typedef struct mix_run {
    const bench_mix *mix;
    uint32_t plain_pairs, leaky_pairs;
} mix_run;

static void run_mix(const void *what, uint64_t rounds) {
    const mix_run *r = what;
    r->mix->run(rounds, r->plain_pairs, r->leaky_pairs);
}

double bench_mix_ns(const bench_mix *mix, uint32_t plain_pairs, uint32_t leaky_pairs, uint32_t repeats) {
    const mix_run r = {mix, plain_pairs, leaky_pairs};
    return least_ns(run_mix, &r, repeats);
}

/* Sixteen additions, each of the result of the one before. */
static void run_chain(const void *what, uint64_t rounds) {
    uint64_t x = rounds, y = (uint64_t)(uintptr_t)what | 1;
    while (rounds--) {
#define STEP                                                                                                           \
    x += y;                                                                                                            \
    __asm__ volatile("" : "+r"(x));
        STEP STEP STEP STEP STEP STEP STEP STEP STEP STEP STEP STEP STEP STEP STEP STEP
#undef STEP
    }
}

double bench_clock_ghz(uint32_t repeats) { return 16.0 / least_ns(run_chain, NULL, repeats); }
