/*
 * The window networks as anybody would write them in C, for the compiler to vectorise: compiled at the time of the
 * benchmark, with this machine's compilers at their best flags, and held against our kernels. Same inputs, rules and
 * outputs: counts of both images in, rows filled, both networks, generated counts out.
 *
 * Images lie in rows, which suits compilers best: a window's six pixels are six rows at an offset, and every loop runs
 * along a row. HIDDEN is given on the command line, so that loops over units may be unrolled. SHAPE: 0, a window at a
 * time with all units, BLOCK windows after each other; 1, a unit at a time over BLOCK windows, sums in memory.
 */
#include <math.h>
#include <stdint.h>
#include <string.h>

#ifndef HIDDEN
#error "HIDDEN: units of the networks"
#endif
#ifndef SHAPE
#define SHAPE 0
#endif

enum { BEAMS = 32, TAPS = 7, COLUMNS_MAX = 8192, BLOCK = 256 };

typedef struct plain_f32 {
    float weight[HIDDEN][TAPS], bias[HIDDEN], output[HIDDEN];
    float slope, skip, offset;
} plain_f32;

typedef struct plain_int {
    int32_t weight[HIDDEN][TAPS], bias[HIDDEN], output[HIDDEN];
    int32_t k, j, t, slope, skip, offset;
} plain_int;

/* Distance, then intensity. `precision`: 0 float, 1 int16, 2 int8. Images [BEAMS][columns]; outputs [BEAMS-1][columns].
 */
typedef struct plain_job {
    plain_f32 f32[2];
    plain_int integer[2];
    int32_t seen_max[BEAMS], given_max[BEAMS];
    int32_t min_count, columns, precision;
    const uint16_t *distance;
    const uint8_t *intensity;
    uint16_t *out_distance;
    uint8_t *out_intensity;
} plain_job;

/* For compilers that leave a short loop rolled, and then cannot vectorise the one around it. */
#ifdef __clang__
#define UNROLLED _Pragma("clang loop unroll(full)")
#else
#define UNROLLED _Pragma("GCC unroll 64")
#endif

#define FLOOR_HALF_UP(y) floorf((y) + 0.5f)

/* ---------------------------------------------------------------------------------------------------- float */

#define NUMBER float
#define NAME(x) x##_f32
#include "plain_rows.h"
#undef NUMBER
#undef NAME

/* The output before the minimum is added. */
static inline float window_f32(const plain_f32 *restrict net, float x0, float x1, float x2, float x3, float x4,
                               float x5, float x6) {
    float y = net->offset;
    UNROLLED
    for (int h = 0; h < HIDDEN; h++) {
        const float *restrict w = net->weight[h];
        const float sum =
            net->bias[h] + w[0] * x0 + w[1] * x1 + w[2] * x2 + w[3] * x3 + w[4] * x4 + w[5] * x5 + w[6] * x6;
        const float bent = net->slope * sum;
        y += net->output[h] * (sum > bent ? sum : bent);
    }
    return y;
}

static void network_f32(float *restrict y, const plain_f32 *restrict net, const float *const *x, int n) {
    const float *restrict x0 = x[0], *restrict x1 = x[1], *restrict x2 = x[2], *restrict x3 = x[3], *restrict x4 = x[4],
                          *restrict x5 = x[5], *restrict x6 = x[6];
#if SHAPE == 0
    for (int c = 0; c < n; c++)
        y[c] = FLOOR_HALF_UP(window_f32(net, x0[c], x1[c], x2[c], x3[c], x4[c], x5[c], x6[c])) + net->skip * x6[c];
#else
    for (int c = 0; c < n; c++)
        y[c] = net->offset;
    for (int h = 0; h < HIDDEN; h++) {
        const float *w = net->weight[h];
        for (int c = 0; c < n; c++) {
            const float sum = net->bias[h] + w[0] * x0[c] + w[1] * x1[c] + w[2] * x2[c] + w[3] * x3[c] + w[4] * x4[c] +
                              w[5] * x5[c] + w[6] * x6[c];
            const float bent = net->slope * sum;
            y[c] += net->output[h] * (sum > bent ? sum : bent);
        }
    }
    for (int c = 0; c < n; c++)
        y[c] = FLOOR_HALF_UP(y[c]) + net->skip * x6[c];
#endif
}

static void run_f32(plain_job *job) {
    static float y[2][BLOCK];
    for (int k = 0; k < BEAMS - 1; k++) {
        fill_pair_f32(job, k);
        for (int c = 0; c < job->columns; c += BLOCK) {
            const int n = job->columns - c < BLOCK ? job->columns - c : BLOCK;
            const float *x[2][TAPS];
            gather_f32(x, c, n);
            network_f32(y[0], &job->f32[0], x[0], n);
            network_f32(y[1], &job->f32[1], x[1], n);
            give_f32(job, k, c, n, y[0], y[1], x[0][6]);
        }
    }
}

/* -------------------------------------------------------------------------------------------------- integers */

#define NUMBER int32_t
#define NAME(x) x##_int
#include "plain_rows.h"

/* docs/numeric-contract.md, step 3 of int8. */
static void block_code(int32_t q[6][BLOCK], int32_t *restrict shift, const int32_t *const *x, int n) {
    const int32_t *restrict x0 = x[0], *restrict x1 = x[1], *restrict x2 = x[2], *restrict x3 = x[3],
                            *restrict x4 = x[4], *restrict x5 = x[5];
    for (int c = 0; c < n; c++) {
        const int32_t any = x0[c] | x1[c] | x2[c] | x3[c] | x4[c] | x5[c];
        shift[c] = (any > 255) + (any > 511) + (any > 1023) + (any > 2047) + (any > 4095) + (any > 8191) +
                   (any > 16383) + (any > 32767);
    }
    for (int i = 0; i < 6; i++) {
        const int32_t *restrict xi = x[i];
        for (int c = 0; c < n; c++) {
            const int32_t rounded = (xi[c] + ((1 << shift[c]) >> 1)) >> shift[c];
            q[i][c] = rounded > 255 ? 255 : rounded;
        }
    }
}

/* Step 4 to 6 of one unit. */
static inline int32_t unit_int(const plain_int *restrict net, int h, int32_t q0, int32_t q1, int32_t q2, int32_t q3,
                               int32_t q4, int32_t q5, int32_t shift, int32_t least) {
    const int32_t *restrict w = net->weight[h];
    uint32_t sum = (uint32_t)w[0] * (uint32_t)q0 + (uint32_t)w[1] * (uint32_t)q1 + (uint32_t)w[2] * (uint32_t)q2 +
                   (uint32_t)w[3] * (uint32_t)q3 + (uint32_t)w[4] * (uint32_t)q4 + (uint32_t)w[5] * (uint32_t)q5;
    sum = (sum << shift) + ((uint32_t)w[6] * (uint32_t)least << net->j) + (uint32_t)net->bias[h];
    const int32_t a = (int32_t)(sum + (1 << 15)) >> 16, bent = (a * net->slope + (1 << 14)) >> 15;
    return net->output[h] * (a > bent ? a : bent);
}

/* Steps 4 to 9: `shift` is that of the block code, or null. */
static inline void network_int(int32_t *restrict y, const plain_int *restrict net, const int32_t *restrict q0,
                               const int32_t *restrict q1, const int32_t *restrict q2, const int32_t *restrict q3,
                               const int32_t *restrict q4, const int32_t *restrict q5, const int32_t *restrict least,
                               const int32_t *restrict shift, int n) {
    const int32_t half = (1 << net->t) >> 1;
#if SHAPE == 1
    for (int c = 0; c < n; c++)
        y[c] = net->offset;
    for (int h = 0; h < HIDDEN; h++)
        for (int c = 0; c < n; c++)
            y[c] +=
                unit_int(net, h, q0[c], q1[c], q2[c], q3[c], q4[c], q5[c], (shift ? shift[c] : 0) + net->k, least[c]);
    for (int c = 0; c < n; c++)
        y[c] = ((y[c] + half) >> net->t) + net->skip * least[c];
#else
    for (int c = 0; c < n; c++) {
        int32_t output = net->offset;
        UNROLLED
        for (int h = 0; h < HIDDEN; h++)
            output +=
                unit_int(net, h, q0[c], q1[c], q2[c], q3[c], q4[c], q5[c], (shift ? shift[c] : 0) + net->k, least[c]);
        y[c] = ((output + half) >> net->t) + net->skip * least[c];
    }
#endif
}

static void networks_int(const plain_job *job, int32_t y[2][BLOCK], const int32_t *x[2][TAPS], int n) {
    static int32_t q[6][BLOCK], shift[BLOCK];
    for (int which = 0; which < 2; which++) {
        const int32_t *const *in = x[which];
        const plain_int *net = &job->integer[which];
        if (job->precision == 1) {
            network_int(y[which], net, in[0], in[1], in[2], in[3], in[4], in[5], in[6], 0, n);
        } else {
            block_code(q, shift, in, n);
            network_int(y[which], net, q[0], q[1], q[2], q[3], q[4], q[5], in[6], shift, n);
        }
    }
}

static void run_int(plain_job *job) {
    static int32_t y[2][BLOCK];
    for (int k = 0; k < BEAMS - 1; k++) {
        fill_pair_int(job, k);
        for (int c = 0; c < job->columns; c += BLOCK) {
            const int n = job->columns - c < BLOCK ? job->columns - c : BLOCK;
            const int32_t *x[2][TAPS];
            gather_int(x, c, n);
            networks_int(job, y, x, n);
            give_int(job, k, c, n, y[0], y[1], x[0][6]);
        }
    }
}

void plain_run(void *argument) {
    plain_job *job = argument;
    if (job->precision == 0)
        run_f32(job);
    else
        run_int(job);
}

int32_t plain_job_bytes(void) { return (int32_t)sizeof(plain_job); }
