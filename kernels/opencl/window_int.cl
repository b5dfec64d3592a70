/*
 * The integer networks (docs/numeric-contract.md; the numbers of its steps stand below), int16 or int8 as UPB_BITS
 * says. Weights of a unit: W[0..5], M, B with the rounding of step 5, V; after all units C with the rounding of step 8.
 * Sums are unsigned: they may wrap on their way to a result that fits.
 */
#define UNIT 9
#define U VECTOR(uint)
#define AS_U(v) JOIN(as_, U)(v)
#define AS_N(v) JOIN(as_, N)(v)

#if UPB_BITS == 8
/* Step 3: what is left of the differences in eight bits. Gives the shift that they share. */
static inline U block_code(N *q) {
    const N any = q[0] | q[1] | q[2] | q[3] | q[4] | q[5]; /* as long in binary as the largest */
    /* Its length from a float's exponent, 127 + length - 1: exact below 2^24, and clz() is scalar in PoCL. */
    const U shift = AS_U(max((AS_N(CONVERT(float, any)) >> 23) - (127 - 1 + 8), (N)(0)));
    const U half_step = ((U)(1) << shift) >> 1;
#pragma unroll
    for (int i = 0; i < 6; i++)
        q[i] = AS_N(min((AS_U(q[i]) + half_step) >> shift, (U)(255)));
    return shift;
}
#endif

/* Steps 3 to 9, y[SHARE]. All numbers after `w` are constants of the program. */
__attribute__((always_inline)) static inline void network(N *y, windows *in, __constant int *w, int hidden, int k,
                                                          int j, int t, int slope, int skip) {
    U shift[SHARE], output[SHARE];
#pragma unroll
    for (int b = 0; b < SHARE; b++) {
        output[b] = (U)((uint)w[hidden * UNIT]);
#if UPB_BITS == 8
        shift[b] = block_code(in->x[b]) + (U)(k);
#else
        shift[b] = (U)(k);
#endif
    }
#pragma unroll
    for (int h = 0; h < hidden; h++) {
        __constant int *unit = w + h * UNIT;
#pragma unroll
        for (int b = 0; b < SHARE; b++) {
            U sum = AS_U(in->x[b][0]) * (uint)unit[0];
#pragma unroll
            for (int i = 1; i < 6; i++)
                sum += AS_U(in->x[b][i]) * (uint)unit[i];
            sum = (sum << shift[b]) + ((AS_U(in->least[b]) * (uint)unit[6]) << (U)(j)) + (uint)unit[7];
            const N a = AS_N(sum) >> 16;                  /* 5 */
            const N bent = (a * slope + (1 << 14)) >> 15; /* 6 */
            output[b] += AS_U(max(a, bent) * unit[8]);    /* 7 */
        }
    }
#pragma unroll
    for (int b = 0; b < SHARE; b++)
        y[b] = (AS_N(output[b]) >> t) + (skip ? in->least[b] : (N)(0));
}

static inline void distance_sums(N *y, windows *w, __constant int *weights) {
    network(y, w, weights, UPB_HIDDEN_0, UPB_K_0, UPB_J_0, UPB_T_0, UPB_SLOPE_0, UPB_SKIP_0);
}

static inline void intensity_sums(N *y, windows *w, __constant int *weights) {
    network(y, w, weights, UPB_HIDDEN_1, UPB_K_1, UPB_J_1, UPB_T_1, UPB_SLOPE_1, UPB_SKIP_1);
}
