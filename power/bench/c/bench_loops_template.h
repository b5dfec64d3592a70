/*
 * Loops of independent instructions in vectors: included once by each instruction set's file, which includes its
 * upb_vectors_*.h of the kernels, whose names are in upb_kernel_rules.h, and defines before
 *
 *   ISA_NAME, ISA_SYMBOL   its name; the bench_isa to define
 *   F, F_LANES             a vector of floats, and of how many; V_LANES is twice that
 *   OPAQUE(v)              tells the compiler that v may have changed
 *   START_MASK, MASK       makes a mask that the compiler does not know; the mask
 *   USE_MASK(v, m)         M is used, or becomes v
 *   F_SET(x), I_SET(x)     all lanes; I_SET of 32 bits
 *   BROADCAST(p)           the 32 bits at p in all lanes, I
 *   F_FMA(a, b, c), F_MUL, F_ADD, F_MAX (a, b);  F_FLOOR32(v) as in the float kernel, as F
 *   I_DOT16(sum, a, b), I_SCALE, I_MAX, I_ADD32, I_BLEND, I_UNPACK (a, b);  I_SHIFT32(v)
 *   I_DOT8(sum, a, b)      optional
 *   AS_I(f), AS_F(i)       the same bits
 *   SECOND_TEN             b, or a where registers are 16: the accumulators after a0 to a9
 *   WEIGHT_READS           how often an integer kernel reads a weight: once for both halves of the windows, or 2
 *   MASK_ANDS              1; or 0 where a comparison under a mask is one instruction
 *   FLOATS_SHUFFLES        what puts two vectors of V_LOAD_FLOATS into one
 *
 * How many of which: the tables here, operation by operation those of upb_kernel_rules.h, upb_kernel_f32_template.h,
 * upb_kernel_int_template.h and upb_kernel_int_pairs.h, for empty pixels filled. They are the counts that the loops
 * run. Not counted: what is the same for all windows of a call (constants, slope, nearest count), and shifts of
 * distances, as k and j are 0 there in most models; those of intensities are not.
 */
#include "bench.h"

/* The rules, for V_LANES windows: a column prepared, both networks' windows gathered, outputs given. */
enum {
    PREPARE_LOADS = 1,    /* counts */
    PREPARE_LOADS_U8 = 1, /* intensities, widened */
    PREPARE_AT_LEAST = 2, /* range limits */
    PREPARE_IS_ZERO = 2,  /* top and bottom empty */
    PREPARE_MASK_ANDS = 1 + 2,
    PREPARE_KEEPS = 2,   /* pixels out of range */
    PREPARE_NEXT = 2,    /* bottom neighbours */
    PREPARE_SELECTS = 4, /* four filled rows */
    PREPARE_STORES = 4,
    GATHER_LOADS = 12,      /* three columns, two rows, distance and intensity */
    GATHER_IS_ZERO = 3 + 1, /* empty columns, once for both networks; empty windows */
    GATHER_MASK_ANDS = 3 + 1,
    GATHER_SELECTS = 4 * 4, /* four rows: two for the left pixel, two for the right */
    GATHER_MIN_WHERE = 4,   /* the middle one */
    GATHER_MIN = 2 * 5,     /* window minima */
    GATHER_SUB = 2 * 6,     /* differences from the minimum */
    GIVE_FROM_W = 3,        /* distance, the same less 1, intensity */
    GIVE_ADD32 = 2,         /* less 1 */
    GIVE_MIN = 1,           /* intensity */
    GIVE_AT_LEAST = 2,      /* limits */
    GIVE_MASK_ANDS = 2,
    GIVE_KEEPS = 2,
    GIVE_STORES = 1,
    GIVE_STORES_U8 = 1,
    RULES_LIMITS = 2, /* farthest counts seen and given: a load, in float models V_LOAD_FLOATS */
    RULES_LOADS = PREPARE_LOADS + GATHER_LOADS,
    RULES_AT_LEAST = PREPARE_AT_LEAST + GIVE_AT_LEAST,
    RULES_IS_ZERO = PREPARE_IS_ZERO + GATHER_IS_ZERO,
    RULES_MASK_ANDS = (PREPARE_MASK_ANDS + GATHER_MASK_ANDS + GIVE_MASK_ANDS) * MASK_ANDS,
    RULES_SELECTS = PREPARE_SELECTS + GATHER_SELECTS,
    RULES_KEEPS = PREPARE_KEEPS + GIVE_KEEPS,
    RULES_MIN = GATHER_MIN + GIVE_MIN,
    RULES_STORES = PREPARE_STORES + GIVE_STORES
};

/* What both precisions do around the layers of both networks: W_ADD_V, and the offsets. */
enum { SKIP_UNPACK = 2 * 2, SKIP_ADD32 = 2 * 2, OFFSET_LOADS = 2 };

/* Float: V_LANES windows are two vectors. */
enum {
    F_PAIR_FMA = 2 * 2 * (7 + 1), /* two units, two vectors: seven taps; the output */
    F_PAIR_MAX = 2 * 2,
    F_PAIR_LOADS = 2 * 9, /* the weights, once for both vectors */
    F_LEAKY_MUL = 2 * 2,  /* slope */
    F_UNPACK = 2 * 2 * 7, /* inputs widened: unpacked, one subtraction */
    F_FROM_WORDS = 2 * 2 * 7,
    F_ROUND_ADD = 2 * 2, /* a half; the cut; rounded down */
    F_ROUND_MIN = 2 * 2,
    F_FLOORS = 2 * 2,
    F_ADDS = F_FROM_WORDS + F_ROUND_ADD
};

/* Integer: sums are two vectors of 32 bits. */
enum {
    I_PAIR_DOT = 2 * (2 * 4 + 1), /* two vectors: of two units four pairs of inputs; of both the output */
    I_PAIR_MAX = 2,
    I_PAIR_SHIFT = 2, /* upper halves of two sums: a shift and a blend */
    I_PAIR_BLEND = 2,
    I_PAIR_LOADS = WEIGHT_READS * (2 * (4 + 1) + 1), /* pairs of weights, bias; output weights */
    I_LEAKY_SCALE = 2,
    I_LIFT16 = 2, /* what is subtracted gets the sign bit: both networks in int16, intensities in int8 */
    I_LIFT8 = 1,
    I_XOR = 2, /* the minimum becomes signed */
    I_UNPACK_PAIRS = 2 * 2 * 4,
    I_SHIFT_BY = 1 + 1 + 1 + 2 * 2, /* of intensities: by k, the minimum back and by j; both outputs by t */
    /* the block code of int8, of distances only */
    CODE_OR3 = 2,        /* as long as the largest */
    CODE_OR = 1 + 1 + 1, /* the same; V_SMEAR_UPPER: two halves of a byte looked up; the largest code */
    CODE_SHIFT = 1 + 1,
    CODE_LOOK_UP = 2,
    CODE_AVERAGE = 1,
    CODE_ADD_SAT = 6, /* each difference: half a step, saturated, cleared and signed */
    CODE_MIN = 6,
    CODE_CLEAR_XOR = 6
};

/*
 * TIMES(count, OP): `count` times OP(v), at most 48, v being the accumulators a0 to a9 by turns, then b0 to b9 where
 * registers are many: at least an instruction's latency times the instructions of a cycle, and few enough for 16
 * registers with what they work on. It goes on with the accumulator after the last one's (`turn`, which the compiler
 * knows), so that few of an operation do not all wait for the first accumulators. Written out, since compilers keep
 * arrays that are indexed in a loop in memory.
 */
#define ONE(n, count, OP, v)                                                                                           \
    if ((n) >= turn && (n) < turn + (unsigned)(count)) {                                                               \
        OP(v);                                                                                                         \
        OPAQUE(v);                                                                                                     \
    }
#define TEN(n, count, OP, a)                                                                                           \
    ONE((n) + 0, count, OP, a##0)                                                                                      \
    ONE((n) + 1, count, OP, a##1)                                                                                      \
    ONE((n) + 2, count, OP, a##2)                                                                                      \
    ONE((n) + 3, count, OP, a##3)                                                                                      \
    ONE((n) + 4, count, OP, a##4)                                                                                      \
    ONE((n) + 5, count, OP, a##5)                                                                                      \
    ONE((n) + 6, count, OP, a##6)                                                                                      \
    ONE((n) + 7, count, OP, a##7)                                                                                      \
    ONE((n) + 8, count, OP, a##8)                                                                                      \
    ONE((n) + 9, count, OP, a##9)
#define TEN_OF(n, count, OP, a) TEN(n, count, OP, a)
#define TWENTY(n, count, OP)                                                                                           \
    TEN(n, count, OP, a)                                                                                               \
    TEN_OF((n) + 10, count, OP, SECOND_TEN)
#define TIMES(count, OP)                                                                                               \
    {                                                                                                                  \
        _Static_assert((int)(count) <= (int)LOOP_TIMES, "TIMES goes up to 48");                                        \
        TWENTY(0u, count, OP)                                                                                          \
        TWENTY(20u, count, OP)                                                                                         \
        TWENTY(40u, count, OP)                                                                                         \
        TWENTY(60u, count, OP)                                                                                         \
        turn = (turn + (unsigned)(count)) % 20u;                                                                       \
    }

enum { LOOP_TIMES = 48, TINY_IS_ZERO = 0x8040 /* of MXCSR: inputs and results */, OUT = 4 * UPB_ALIGN };

/* Read at the beginning, written from OUT on: loads that wait for stores are no matter of ports. */
static _Alignas(4096) unsigned char scratch[2 * OUT];

/* Somewhere, as far as the compiler knows: it may neither leave out a load nor do one for many. */
static inline const void *any_memory(void) {
    const void *p = scratch;
    __asm__ volatile("" : "+r"(p));
    return p;
}

#define DO_WEIGHT(v)                                                                                                   \
    {                                                                                                                  \
        I loaded = BROADCAST(scratch);                                                                                 \
        OPAQUE(loaded);                                                                                                \
    }
#define LOADED(how)                                                                                                    \
    {                                                                                                                  \
        V loaded = how(any_memory());                                                                                  \
        OPAQUE(loaded);                                                                                                \
    }
#define DO_LOAD(v) LOADED(V_LOADU)
#define DO_LOAD_U8(v) LOADED(V_LOAD_U8)
#define DO_LOAD_FLOATS(v) LOADED(V_LOAD_FLOATS)
#define DO_STORE(v) V_STOREU((void *)(scratch + OUT), AS_I(v))
#define DO_STORE_U8(v) V_STORE_U8(scratch + OUT, AS_I(v))
#define DO_F_FMA(v) v = F_FMA(v, x, y)
#define DO_F_MUL(v) v = F_MUL(v, x)
#define DO_F_ADD(v) v = F_ADD(v, x)
#define DO_F_MAX(v) v = F_MAX(v, x)
#define DO_F_FLOOR(v) v = F_FLOOR32(v)
/* Where multiply and add are apart, the product must be computed anew. */
#define DO_I_DOT16(v)                                                                                                  \
    OPAQUE(y);                                                                                                         \
    v = I_DOT16(v, x, y)
#define DO_I_SCALE(v) v = I_SCALE(v, x)
#define DO_I_MAX(v) v = I_MAX(v, x)
#define DO_I_BLEND(v) v = I_BLEND(v, x)
#define DO_I_SHIFT32(v) v = I_SHIFT32(v)
/* On floats too: the same registers. */
#define DO_V(v, result)                                                                                                \
    {                                                                                                                  \
        V in = AS_I(v);                                                                                                \
        in = result;                                                                                                   \
        v = AS_SAME(v, in);                                                                                            \
    }
#define DO_AT_LEAST(v)                                                                                                 \
    {                                                                                                                  \
        const M at_least = M_AT_LEAST(AS_I(v), AS_I(x));                                                               \
        USE_MASK(v, at_least);                                                                                         \
    }
#define DO_IS_ZERO(v)                                                                                                  \
    {                                                                                                                  \
        const M is_zero = M_IS_ZERO(AS_I(v));                                                                          \
        USE_MASK(v, is_zero);                                                                                          \
    }
#define DO_SELECT(v) DO_V(v, V_SELECT(MASK, AS_I(x), in))
#define DO_MIN_WHERE(v) DO_V(v, V_MIN_WHERE(MASK, AS_I(x), in, AS_I(y)))
#define DO_KEEP(v) DO_V(v, V_KEEP(MASK, in))
#define DO_MIN(v) DO_V(v, V_MIN(in, AS_I(x)))
#define DO_SUB(v) DO_V(v, V_SUB(in, AS_I(x)))
#define DO_ADD_SAT(v) DO_V(v, V_ADD_SAT(in, AS_I(x)))
#define DO_ADD32(v) DO_V(v, I_ADD32(in, AS_I(x)))
#define DO_LOGIC(v) DO_V(v, V_XOR(in, AS_I(x)))
#define DO_OR3(v) DO_V(v, V_OR3(in, AS_I(x), AS_I(y)))
#define DO_CLEAR_XOR(v) DO_V(v, V_CLEAR_XOR(in, AS_I(x), AS_I(y)))
#define DO_AVERAGE(v) DO_V(v, V_AVERAGE(in, AS_I(x)))
#define DO_SHIFT(v) DO_V(v, V_SHIFT_LEFT(in, 1))
#define DO_SHIFT_BY(v) DO_V(v, V_SHIFT_LEFT(in, shift))
#define DO_UNPACK(v) DO_V(v, I_UNPACK(in, AS_I(x)))
#define DO_LOOK_UP(v) DO_V(v, I_LOOK_UP(AS_I(x), in))
#define DO_FROM_W(v) DO_V(v, V_FROM_W(((W){{in, AS_I(x)}})))
#define DO_NEXT(v) DO_V(v, V_NEXT(in, AS_I(x)))

#define START(T, x_value, y_value)                                                                                     \
    T x = x_value, y = y_value;                                                                                        \
    T a0 = y, a1 = y, a2 = y, a3 = y, a4 = y, a5 = y, a6 = y, a7 = y, a8 = y, a9 = y;                                  \
    T b0 = y, b1 = y, b2 = y, b3 = y, b4 = y, b5 = y, b6 = y, b7 = y, b8 = y, b9 = y;                                  \
    (void)b0, (void)b1, (void)b2, (void)b3, (void)b4, (void)b5, (void)b6, (void)b7, (void)b8, (void)b9;                \
    unsigned turn = 0;                                                                                                 \
    OPAQUE(x);                                                                                                         \
    OPAQUE(y);
#define F_START START(F, F_SET(0.999f), F_SET(0.001f))
#define I_START START(I, I_SET(0x00030005), I_SET(0x00070002))
#define RULES_START                                                                                                    \
    unsigned shift = 1;                                                                                                \
    START_MASK                                                                                                         \
    __asm__ volatile("" : "+r"(shift));

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
            I l0 = V_LOAD(p), l1 = V_LOAD(p + sizeof(I)), l2 = V_LOAD(p + 2 * sizeof(I)),
              l3 = V_LOAD(p + 3 * sizeof(I));
            I l4 = V_LOAD(p + 4 * sizeof(I)), l5 = V_LOAD(p + 5 * sizeof(I)), l6 = V_LOAD(p + 6 * sizeof(I)),
              l7 = V_LOAD(p + 7 * sizeof(I));
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

/* All but the layers and what is around them. */
#define RULES                                                                                                          \
    TIMES(RULES_LOADS, DO_LOAD)                                                                                        \
    TIMES(PREPARE_LOADS_U8, DO_LOAD_U8)                                                                                \
    TIMES(RULES_AT_LEAST, DO_AT_LEAST)                                                                                 \
    TIMES(RULES_IS_ZERO, DO_IS_ZERO)                                                                                   \
    TIMES(RULES_MASK_ANDS, DO_LOGIC)                                                                                   \
    TIMES(RULES_KEEPS, DO_KEEP)                                                                                        \
    TIMES(PREPARE_NEXT, DO_NEXT)                                                                                       \
    TIMES(RULES_SELECTS, DO_SELECT)                                                                                    \
    TIMES(GATHER_MIN_WHERE, DO_MIN_WHERE)                                                                              \
    TIMES(RULES_MIN, DO_MIN)                                                                                           \
    TIMES(GATHER_SUB, DO_SUB)                                                                                          \
    TIMES(OFFSET_LOADS, DO_WEIGHT)                                                                                     \
    TIMES(SKIP_UNPACK, DO_UNPACK)                                                                                      \
    TIMES(SKIP_ADD32 + GIVE_ADD32, DO_ADD32)                                                                           \
    TIMES(GIVE_FROM_W, DO_FROM_W)                                                                                      \
    TIMES(RULES_STORES, DO_STORE)                                                                                      \
    TIMES(GIVE_STORES_U8, DO_STORE_U8)

/* Pairs of units: the accumulators' turns begin anew, so that the compiler knows them. */
#define ALL_PAIRS(PAIR, LEAKY)                                                                                         \
    for (uint32_t left = plain; left; left--) {                                                                        \
        turn = 0;                                                                                                      \
        PAIR                                                                                                           \
    }                                                                                                                  \
    for (uint32_t left = leaky; left; left--) {                                                                        \
        turn = 0;                                                                                                      \
        PAIR LEAKY                                                                                                     \
    }                                                                                                                  \
    turn = 0;

#define F_PAIR                                                                                                         \
    TIMES(F_PAIR_LOADS, DO_WEIGHT)                                                                                     \
    TIMES(F_PAIR_FMA, DO_F_FMA)                                                                                        \
    TIMES(F_PAIR_MAX, DO_F_MAX)

static void mix_f32(uint64_t blocks, uint32_t plain, uint32_t leaky) {
    F_START
    RULES_START
    /* What integer operations leave is no number that means anything: tiny ones must not cost more than others. */
    const unsigned control = _mm_getcsr();
    _mm_setcsr(control | TINY_IS_ZERO);
    while (blocks--) {
        RULES
        TIMES(RULES_LIMITS, DO_LOAD_FLOATS)
        TIMES(F_UNPACK, DO_UNPACK)
        TIMES(F_ADDS, DO_F_ADD)
        TIMES(F_ROUND_MIN, DO_F_MAX)
        TIMES(F_FLOORS, DO_F_FLOOR)
        ALL_PAIRS(F_PAIR, TIMES(F_LEAKY_MUL, DO_F_MUL))
    }
    _mm_setcsr(control);
}

#define I_PAIR                                                                                                         \
    TIMES(I_PAIR_LOADS, DO_WEIGHT)                                                                                     \
    TIMES(I_PAIR_DOT, DO_I_DOT16)                                                                                      \
    TIMES(I_PAIR_SHIFT, DO_I_SHIFT32)                                                                                  \
    TIMES(I_PAIR_BLEND, DO_I_BLEND)                                                                                    \
    TIMES(I_PAIR_MAX, DO_I_MAX)
#define I_ALL_PAIRS ALL_PAIRS(I_PAIR, TIMES(I_LEAKY_SCALE, DO_I_SCALE))
#define I_REST(lifts)                                                                                                  \
    RULES                                                                                                              \
    TIMES(RULES_LIMITS, DO_LOAD)                                                                                       \
    TIMES(lifts, DO_SUB)                                                                                               \
    TIMES(I_XOR, DO_LOGIC)                                                                                             \
    TIMES(I_UNPACK_PAIRS, DO_UNPACK)                                                                                   \
    TIMES(I_SHIFT_BY, DO_SHIFT_BY)

static void mix_int16(uint64_t blocks, uint32_t plain, uint32_t leaky) {
    I_START
    RULES_START
    while (blocks--) {
        I_REST(I_LIFT16)
        I_ALL_PAIRS
    }
}

static void mix_int8(uint64_t blocks, uint32_t plain, uint32_t leaky) {
    I_START
    RULES_START
    while (blocks--) {
        I_REST(I_LIFT8)
        TIMES(CODE_OR3, DO_OR3)
        TIMES(CODE_OR, DO_LOGIC)
        TIMES(CODE_SHIFT, DO_SHIFT)
        TIMES(CODE_LOOK_UP, DO_LOOK_UP)
        TIMES(CODE_AVERAGE, DO_AVERAGE)
        TIMES(CODE_ADD_SAT, DO_ADD_SAT)
        TIMES(CODE_MIN, DO_MIN)
        TIMES(CODE_CLEAR_XOR, DO_CLEAR_XOR)
        I_ALL_PAIRS
    }
}

/* Operations of the rules and of the output by kind, which all precisions share. */
enum {
    REST_ADDS = GATHER_SUB + SKIP_ADD32 + GIVE_ADD32,
    REST_MINMAX = RULES_MIN + GATHER_MIN_WHERE,
    REST_COMPARES = RULES_AT_LEAST + RULES_IS_ZERO,
    REST_BLENDS = RULES_SELECTS + RULES_KEEPS,
    REST_SHUFFLES = PREPARE_LOADS_U8 + PREPARE_NEXT + SKIP_UNPACK + GIVE_FROM_W + GIVE_STORES_U8,
    REST_LOADS = RULES_LOADS + PREPARE_LOADS_U8 + OFFSET_LOADS,
    REST_STORES = RULES_STORES + GIVE_STORES_U8
};

#define I_PAIR_COUNTS                                                                                                  \
    {[BENCH_MULTIPLY_ADD] = I_PAIR_DOT,                                                                                \
     [BENCH_MINMAX] = I_PAIR_MAX,                                                                                      \
     [BENCH_BLEND] = I_PAIR_BLEND,                                                                                     \
     [BENCH_SHIFT] = I_PAIR_SHIFT,                                                                                     \
     [BENCH_LOAD] = I_PAIR_LOADS}
#define I_REST_COUNTS(logic, shifts, shuffles, minmax, adds)                                                           \
    {[BENCH_ADD] = REST_ADDS + (adds),                                                                                 \
     [BENCH_MINMAX] = REST_MINMAX + (minmax),                                                                          \
     [BENCH_COMPARE] = REST_COMPARES,                                                                                  \
     [BENCH_BLEND] = REST_BLENDS,                                                                                      \
     [BENCH_LOGIC] = RULES_MASK_ANDS + I_XOR + (logic),                                                                \
     [BENCH_SHIFT] = I_SHIFT_BY + (shifts),                                                                            \
     [BENCH_SHUFFLE] = REST_SHUFFLES + I_UNPACK_PAIRS + (shuffles),                                                    \
     [BENCH_LOAD] = REST_LOADS + RULES_LIMITS,                                                                         \
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
     V_LANES,
     {[BENCH_MULTIPLY_ADD] = F_PAIR_FMA, [BENCH_MINMAX] = F_PAIR_MAX, [BENCH_LOAD] = F_PAIR_LOADS},
     {[BENCH_MULTIPLY] = F_LEAKY_MUL},
     {[BENCH_ADD] = REST_ADDS + F_ADDS,
      [BENCH_MINMAX] = REST_MINMAX + F_ROUND_MIN,
      [BENCH_COMPARE] = REST_COMPARES,
      [BENCH_BLEND] = REST_BLENDS,
      [BENCH_LOGIC] = RULES_MASK_ANDS,
      [BENCH_CONVERT] = F_FLOORS + 2 * RULES_LIMITS,
      [BENCH_SHUFFLE] = REST_SHUFFLES + F_UNPACK + FLOATS_SHUFFLES * RULES_LIMITS,
      [BENCH_LOAD] = REST_LOADS + 2 * RULES_LIMITS,
      [BENCH_STORE] = REST_STORES},
     mix_f32},
    {"int16",
     V_LANES,
     I_PAIR_COUNTS,
     {[BENCH_MULTIPLY] = I_LEAKY_SCALE},
     I_REST_COUNTS(0, 0, 0, 0, I_LIFT16),
     mix_int16},
    {"int8",
     V_LANES,
     I_PAIR_COUNTS,
     {[BENCH_MULTIPLY] = I_LEAKY_SCALE},
     I_REST_COUNTS(CODE_OR3 + CODE_OR + CODE_CLEAR_XOR, CODE_SHIFT, CODE_LOOK_UP, CODE_MIN,
                   I_LIFT8 + CODE_AVERAGE + CODE_ADD_SAT),
     mix_int8},
};

const bench_isa ISA_SYMBOL = {ISA_NAME, loops, mixes, sizeof loops / sizeof loops[0], sizeof mixes / sizeof mixes[0]};
