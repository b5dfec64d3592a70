/*
 * Loops of independent instructions in vectors: included once by each instruction set's file, which defines before
 *
 *   ISA_NAME, ISA_SYMBOL   its name; the bench_isa to define
 *   F, I                   vectors of floats and of integers;  F_LANES floats, so 2 * F_LANES 16-bit integers
 *   OPAQUE(v)              tells the compiler that v may have changed
 *   F_SET(x), I_SET(x)     all lanes; I_SET of 32 bits;  LOAD(p), STORE(p, v): whole vectors of I, aligned
 *   BROADCAST(p)           the 32 bits at p in all lanes, I
 *   F_FMA(a, b, c), F_MUL, F_ADD, F_MINMAX(a, b)
 *   F_COMPARE(v, a), F_BLEND(v, a): statements, one compare or blend whose result becomes v, or is used;  F_CONVERT(v)
 *   I_DOT16(sum, a, b), I_MUL, I_ADD, I_MINMAX, I_LOGIC (a, b), I_COMPARE(v, a), I_BLEND(v, a), I_SHIFT(v),
 * I_SHUFFLE(v, a) I_DOT8(sum, a, b)      optional AS_I(f), AS_F(i)       the same bits
 *
 * How many of which: the tables here. They count what the kernels in kernels/cpu must do for the rules of the model
 * file (empty pixels filled) in the cheapest order that is known, and are the counts that the loops run.
 */
#include "bench.h"

/* Instructions in every kernel, for one vector of windows and both networks: the column prepared, windows gathered. */
enum {
    PREPARE_LOADS = 2 + 4,    /* counts, intensities, farthest counts; neighbours one lane on */
    PREPARE_COMPARES = 2 + 2, /* range limits; top and bottom empty */
    PREPARE_BLENDS = 2 + 4,   /* pixels out of range; four filled rows */
    PREPARE_STORES = 4,
    GATHER_LOADS = 12,         /* three columns, two rows, distance and intensity */
    GATHER_COMPARES = 3,       /* empty columns, once for both networks */
    GATHER_BLENDS = 4 * 7,     /* four rows of three columns: two, three and two */
    GATHER_MINMAX = 4 + 2 * 5, /* the nearer of left and right; window minima */
    GATHER_ADDS = 2 * 6,       /* differences from the minimum */
    OUTPUT_COMPARES = 3,       /* limits, and a window without a return */
    OUTPUT_BLENDS = 2,         /* points that are not given */
    OUTPUT_MINMAX = 2,         /* intensity 0..255 */
    OUTPUT_STORES = 2,
    REST_LOADS = PREPARE_LOADS + GATHER_LOADS + 1,
    REST_COMPARES = PREPARE_COMPARES + GATHER_COMPARES + OUTPUT_COMPARES,
    REST_BLENDS = PREPARE_BLENDS + GATHER_BLENDS + OUTPUT_BLENDS,
    REST_MINMAX = GATHER_MINMAX + OUTPUT_MINMAX,
    REST_STORES = PREPARE_STORES + OUTPUT_STORES
};

/* Float, for F_LANES windows. The rectifier is max(a, 0); what of it is linear is one affine map of the taps. */
enum {
    F_UNIT_FMA = 7 + 1, /* seven taps; the output */
    F_UNIT_MINMAX = 1,
    F_UNIT_LOADS = 5,         /* nine weights, for two vectors */
    F_REST_FMA = 2 * (7 + 1), /* what is linear; the minimum */
    F_REST_ADDS = GATHER_ADDS + 2,
    F_REST_CONVERTS = 2 + 2 + 2, /* inputs, floor, outputs */
    F_REST_SHUFFLES = 2 + 2      /* inputs widened, outputs narrowed */
};

/* Integer, for 2 * F_LANES windows: inputs are 16 bits, sums two vectors of 32. */
enum {
    I_UNIT_DOT = 2 * 4 + 1, /* four pairs of inputs in two vectors; half of the two vectors of outputs */
    I_UNIT_MULTIPLY = 1,    /* slope */
    I_UNIT_MINMAX = 1,
    I_UNIT_SHUFFLE = 1, /* upper halves of two sums */
    I_UNIT_LOADS = 6,
    I_REST_ADDS = GATHER_ADDS + 2 * 2 + 2, /* the minimum; what is compared with the limits */
    I_REST_LOGIC = 2 * 7,                  /* unsigned to signed */
    I_REST_SHIFTS = 2 * 7 + 2 * 2,         /* inputs; outputs */
    I_REST_SHUFFLES =
        1 + 2 + 2 * (8 + 2) + 3 + 1, /* widened, next lanes, pairs of inputs and minima, packed, narrowed */
    /* the block code of int8, both networks: the largest difference, its highest bit, three steps for each input */
    CODE_LOGIC = 2 * (5 + 1 + 6),
    CODE_SHIFTS = 2 * (2 + 2),
    CODE_SHUFFLES = 2 * 2,
    CODE_MINMAX = 2 * (1 + 1 + 6),
    CODE_ADDS = 2 * (2 + 6)
};

/*
 * TIMES(count, OP): `count` times OP(v), at most 48, v being the accumulators a0 to a11 by turns: more than an
 * instruction's latency times the instructions of a cycle, and few enough for 16 registers. Written out, since
 * compilers keep arrays that are indexed in a loop in memory.
 */
#define ONE(n, count, OP, v)                                                                                           \
    if ((n) < (int)(count)) {                                                                                          \
        OP(v);                                                                                                         \
        OPAQUE(v);                                                                                                     \
    }
#define TWELVE(n, count, OP)                                                                                           \
    ONE(n, count, OP, a0)                                                                                              \
    ONE((n) + 1, count, OP, a1)                                                                                        \
    ONE((n) + 2, count, OP, a2)                                                                                        \
    ONE((n) + 3, count, OP, a3)                                                                                        \
    ONE((n) + 4, count, OP, a4)                                                                                        \
    ONE((n) + 5, count, OP, a5)                                                                                        \
    ONE((n) + 6, count, OP, a6)                                                                                        \
    ONE((n) + 7, count, OP, a7)                                                                                        \
    ONE((n) + 8, count, OP, a8)                                                                                        \
    ONE((n) + 9, count, OP, a9)                                                                                        \
    ONE((n) + 10, count, OP, a10)                                                                                      \
    ONE((n) + 11, count, OP, a11)
#define TIMES(count, OP)                                                                                               \
    {                                                                                                                  \
        _Static_assert((int)(count) <= (int)LOOP_TIMES, "TIMES goes up to 48");                                        \
        TWELVE(0, count, OP) TWELVE(12, count, OP) TWELVE(24, count, OP) TWELVE(36, count, OP)                         \
    }

enum { LOOP_TIMES = 48, SCRATCH = 8, FOUR = 4 };

static _Alignas(4096) unsigned char scratch[SCRATCH * UPB_ALIGN];

#define DO_LOAD(v)                                                                                                     \
    {                                                                                                                  \
        I loaded = BROADCAST(scratch);                                                                                 \
        OPAQUE(loaded);                                                                                                \
    }
#define DO_STORE(v) STORE(scratch, AS_I(v))
#define DO_F_FMA(v) v = F_FMA(v, x, y)
#define DO_F_ADD(v) v = F_ADD(v, x)
#define DO_F_MINMAX(v) v = F_MINMAX(v, x)
#define DO_F_COMPARE(v) F_COMPARE(v, x)
#define DO_F_BLEND(v) F_BLEND(v, x)
#define DO_F_CONVERT(v) v = F_CONVERT(v)
#define DO_F_SHUFFLE(v) v = AS_F(I_SHUFFLE(AS_I(v), AS_I(x)))
/* Where multiply and add are apart, the product must be computed anew. */
#define DO_I_DOT16(v)                                                                                                  \
    OPAQUE(y);                                                                                                         \
    v = I_DOT16(v, x, y)
#define DO_I_MULTIPLY(v) v = I_MUL(v, x)
#define DO_I_ADD(v) v = I_ADD(v, x)
#define DO_I_MINMAX(v) v = I_MINMAX(v, x)
#define DO_I_LOGIC(v) v = I_LOGIC(v, x)
#define DO_I_COMPARE(v) I_COMPARE(v, x)
#define DO_I_BLEND(v) I_BLEND(v, x)
#define DO_I_SHIFT(v) v = I_SHIFT(v)
#define DO_I_SHUFFLE(v) v = I_SHUFFLE(v, x)

#define START(T, x_value, y_value)                                                                                     \
    T x = x_value, y = y_value;                                                                                        \
    T a0 = y, a1 = y, a2 = y, a3 = y, a4 = y, a5 = y, a6 = y, a7 = y, a8 = y, a9 = y, a10 = y, a11 = y;                \
    OPAQUE(x);                                                                                                         \
    OPAQUE(y);
#define F_START START(F, F_SET(0.999f), F_SET(0.001f))
#define I_START START(I, I_SET(0x00030005), I_SET(0x00070002))

static void loop_fma(uint64_t rounds, const void *memory, size_t bytes) {
    F_START(void) memory, (void)bytes;
    while (rounds--)
        TIMES(LOOP_TIMES, DO_F_FMA)
}

static void loop_dot16(uint64_t rounds, const void *memory, size_t bytes) {
    I_START(void) memory, (void)bytes;
    while (rounds--)
        TIMES(LOOP_TIMES, DO_I_DOT16)
}

#ifdef I_DOT8
#define DO_I_DOT8(v) v = I_DOT8(v, x, y)
static void loop_dot8(uint64_t rounds, const void *memory, size_t bytes) {
    I_START(void) memory, (void)bytes;
    while (rounds--)
        TIMES(LOOP_TIMES, DO_I_DOT8)
}
#endif

/* A round is one page. */
static void loop_load(uint64_t rounds, const void *memory, size_t bytes) {
    enum { PAGE = 4096, STEP = 8 * sizeof(I) };
    const unsigned char *p = memory, *const end = p + bytes;
    while (rounds--) {
        for (const unsigned char *const next = p + PAGE; p != next; p += STEP) {
            I l0 = LOAD(p), l1 = LOAD(p + sizeof(I)), l2 = LOAD(p + 2 * sizeof(I)), l3 = LOAD(p + 3 * sizeof(I));
            I l4 = LOAD(p + 4 * sizeof(I)), l5 = LOAD(p + 5 * sizeof(I)), l6 = LOAD(p + 6 * sizeof(I)),
              l7 = LOAD(p + 7 * sizeof(I));
            OPAQUE(l0);
            OPAQUE(l1);
            OPAQUE(l2);
            OPAQUE(l3);
            OPAQUE(l4);
            OPAQUE(l5);
            OPAQUE(l6);
            OPAQUE(l7);
        }
        p = p == end ? memory : p;
    }
}

/* `count` hidden units; four at a time, so that no accumulator's turn comes before its result. */
#define F_UNITS(count)                                                                                                 \
    TIMES((count) * F_UNIT_LOADS, DO_LOAD)                                                                             \
    TIMES((count) * F_UNIT_FMA, DO_F_FMA)                                                                              \
    TIMES((count) * F_UNIT_MINMAX, DO_F_MINMAX)

static void mix_f32(uint64_t blocks, uint32_t units) {
    F_START
    while (blocks--) {
        uint32_t left = units;
        TIMES(REST_LOADS, DO_LOAD)
        TIMES(REST_COMPARES, DO_F_COMPARE)
        TIMES(REST_BLENDS, DO_F_BLEND)
        TIMES(REST_MINMAX, DO_F_MINMAX)
        TIMES(F_REST_FMA, DO_F_FMA)
        TIMES(F_REST_ADDS, DO_F_ADD)
        TIMES(F_REST_CONVERTS, DO_F_CONVERT)
        TIMES(F_REST_SHUFFLES, DO_F_SHUFFLE)
        TIMES(REST_STORES, DO_STORE)
        for (; left >= FOUR; left -= FOUR) {
            F_UNITS(FOUR)
        }
        for (; left; left--) {
            F_UNITS(1)
        }
    }
}

#define I_UNITS(count)                                                                                                 \
    TIMES((count) * I_UNIT_LOADS, DO_LOAD)                                                                             \
    TIMES((count) * I_UNIT_DOT, DO_I_DOT16)                                                                            \
    TIMES((count) * I_UNIT_SHUFFLE, DO_I_SHUFFLE)                                                                      \
    TIMES((count) * I_UNIT_MULTIPLY, DO_I_MULTIPLY)                                                                    \
    TIMES((count) * I_UNIT_MINMAX, DO_I_MINMAX)
#define I_ALL_UNITS                                                                                                    \
    for (; left >= FOUR; left -= FOUR) {                                                                               \
        I_UNITS(FOUR)                                                                                                  \
    }                                                                                                                  \
    for (; left; left--) {                                                                                             \
        I_UNITS(1)                                                                                                     \
    }
#define I_REST                                                                                                         \
    TIMES(REST_LOADS, DO_LOAD)                                                                                         \
    TIMES(REST_COMPARES, DO_I_COMPARE)                                                                                 \
    TIMES(REST_BLENDS, DO_I_BLEND)                                                                                     \
    TIMES(REST_MINMAX, DO_I_MINMAX)                                                                                    \
    TIMES(I_REST_ADDS, DO_I_ADD)                                                                                       \
    TIMES(I_REST_LOGIC, DO_I_LOGIC)                                                                                    \
    TIMES(I_REST_SHIFTS, DO_I_SHIFT)                                                                                   \
    TIMES(I_REST_SHUFFLES, DO_I_SHUFFLE)                                                                               \
    TIMES(REST_STORES, DO_STORE)

static void mix_int16(uint64_t blocks, uint32_t units) {
    I_START
    while (blocks--) {
        uint32_t left = units;
        I_REST
        I_ALL_UNITS
    }
}

static void mix_int8(uint64_t blocks, uint32_t units) {
    I_START
    while (blocks--) {
        uint32_t left = units;
        I_REST
        TIMES(CODE_LOGIC, DO_I_LOGIC)
        TIMES(CODE_SHIFTS, DO_I_SHIFT)
        TIMES(CODE_SHUFFLES, DO_I_SHUFFLE)
        TIMES(CODE_MINMAX, DO_I_MINMAX)
        TIMES(CODE_ADDS, DO_I_ADD)
        I_ALL_UNITS
    }
}

#define I_UNIT_COUNTS                                                                                                  \
    {[BENCH_MULTIPLY_ADD] = I_UNIT_DOT,                                                                                \
     [BENCH_MULTIPLY] = I_UNIT_MULTIPLY,                                                                               \
     [BENCH_MINMAX] = I_UNIT_MINMAX,                                                                                   \
     [BENCH_SHUFFLE] = I_UNIT_SHUFFLE,                                                                                 \
     [BENCH_LOAD] = I_UNIT_LOADS}
#define I_REST_COUNTS(logic, shifts, shuffles, minmax, adds)                                                           \
    {[BENCH_ADD] = I_REST_ADDS + (adds),                                                                               \
     [BENCH_MINMAX] = REST_MINMAX + (minmax),                                                                          \
     [BENCH_COMPARE] = REST_COMPARES,                                                                                  \
     [BENCH_BLEND] = REST_BLENDS,                                                                                      \
     [BENCH_LOGIC] = I_REST_LOGIC + (logic),                                                                           \
     [BENCH_SHIFT] = I_REST_SHIFTS + (shifts),                                                                         \
     [BENCH_SHUFFLE] = I_REST_SHUFFLES + (shuffles),                                                                   \
     [BENCH_LOAD] = REST_LOADS,                                                                                        \
     [BENCH_STORE] = REST_STORES}

static const bench_loop loops[] = {
    {"fma_f32", LOOP_TIMES *F_LANES, loop_fma},
    {"dot_int16", LOOP_TIMES * 2 * F_LANES, loop_dot16},
#ifdef I_DOT8
    {"dot_int8", LOOP_TIMES * 4 * F_LANES, loop_dot8},
#endif
    {"load", 4096, loop_load},
};

static const bench_mix mixes[] = {
    {"fp32",
     F_LANES,
     {[BENCH_MULTIPLY_ADD] = F_UNIT_FMA, [BENCH_MINMAX] = F_UNIT_MINMAX, [BENCH_LOAD] = F_UNIT_LOADS},
     {[BENCH_MULTIPLY_ADD] = F_REST_FMA,
      [BENCH_ADD] = F_REST_ADDS,
      [BENCH_MINMAX] = REST_MINMAX,
      [BENCH_COMPARE] = REST_COMPARES,
      [BENCH_BLEND] = REST_BLENDS,
      [BENCH_CONVERT] = F_REST_CONVERTS,
      [BENCH_SHUFFLE] = F_REST_SHUFFLES,
      [BENCH_LOAD] = REST_LOADS,
      [BENCH_STORE] = REST_STORES},
     mix_f32},
    {"int16", 2 * F_LANES, I_UNIT_COUNTS, I_REST_COUNTS(0, 0, 0, 0, 0), mix_int16},
    {"int8", 2 * F_LANES, I_UNIT_COUNTS, I_REST_COUNTS(CODE_LOGIC, CODE_SHIFTS, CODE_SHUFFLES, CODE_MINMAX, CODE_ADDS),
     mix_int8},
};

const bench_isa ISA_SYMBOL = {ISA_NAME, loops, mixes, sizeof loops / sizeof loops[0], sizeof mixes / sizeof mixes[0]};
