/*
 * The folded networks in float32: y = offset + sum over h of output[h] * leaky(bias[h] + weight[h] . x + minimum[h] *
 * m), and the window minimum m once more where UPB_SKIP_* says so. Weights of a unit: six of the differences, the
 * minimum's, bias, output; after all units the offset. The order of operations is that of the CPU kernels
 * (kernels/cpu).
 */
#define UNIT 9

/* Fused where the device does it in hardware: then the bits are those of the CPU kernels. */
#if defined(FP_FAST_FMAF) || defined(__FMA__)
#define FUSED(a, b, c) fma((N)(a), b, c)
#else
#pragma OPENCL FP_CONTRACT OFF
#define FUSED(a, b, c) ((N)(a) * (b) + (c))
#endif

/* A network's outputs y[SHARE], rounded half up. `hidden`, `slope` and `skip` are constants of the program. */
__attribute__((always_inline)) static inline void network(N *y, const windows *in, __constant float *w, int hidden,
                                                          float slope, int skip) {
#pragma unroll
    for (int b = 0; b < SHARE; b++)
        y[b] = (N)(w[hidden * UNIT]);
#pragma unroll
    for (int h = 0; h < hidden; h++) {
        __constant float *unit = w + h * UNIT;
#pragma unroll
        for (int b = 0; b < SHARE; b++) {
            N sum = (N)(unit[7]);
#pragma unroll
            for (int i = 0; i < 6; i++)
                sum = FUSED(unit[i], in->x[b][i], sum);
            sum = FUSED(unit[6], in->least[b], sum);
            y[b] = FUSED(unit[8], max(sum, sum * slope), y[b]);
        }
    }
#pragma unroll
    for (int b = 0; b < SHARE; b++) /* the minimum is whole: adding it to the rounded rest is exact */
        y[b] = floor(y[b] + 0.5f) + (skip ? in->least[b] : (N)(0));
}

static inline void distance_sums(N *y, windows *w, __constant float *weights) {
    network(y, w, weights, UPB_HIDDEN_0, UPB_SLOPE_0, UPB_SKIP_0);
}

static inline void intensity_sums(N *y, windows *w, __constant float *weights) {
    network(y, w, weights, UPB_HIDDEN_1, UPB_SLOPE_1, UPB_SKIP_1);
}
