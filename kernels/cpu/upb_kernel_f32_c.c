/* The window kernel in plain C: the reference that every other one is checked against, and the fallback. */
#include <math.h>

#include "upb_collect.h"
#include "upb_kernels.h"

#ifndef UPB_FILL_KERNELS
#define UPB_FILL_KERNELS upb_kernels_fill_c
#endif

/* Fused where that costs no call: then the bits are those of the vector kernels, which all fuse in the same order. */
#if defined(FP_FAST_FMAF) || defined(__FMA__)
#define FUSED(a, b, c) fmaf(a, b, c)
#else
#define FUSED(a, b, c) ((a) * (b) + (c))
#endif

static int is_seen(const upb_model_f32 *model, unsigned beam, uint16_t distance) {
    return (float)distance >= model->min_count && (float)distance <= model->seen_max[beam];
}

static void prepare_f32_c(upb_prepared_f32 *prepared, const upb_model_f32 *model, const uint16_t *distance,
                          const uint8_t *intensity) {
    uint16_t d[UPB_LANES + 1], i[UPB_LANES + 1];
    for (unsigned k = 0; k < UPB_LANES; k++) {
        d[k] = is_seen(model, k, distance[k]) ? distance[k] : 0;
        i[k] = is_seen(model, k, distance[k]) ? intensity[k] : 0;
    }
    d[UPB_LANES] = i[UPB_LANES] = 0;
    for (unsigned k = 0; k < UPB_LANES; k++) {
        /* Intensities are filled in the same places as distances: a measured intensity may be 0. */
        unsigned top = model->fill && d[k] == 0 ? k + 1 : k;
        unsigned bottom = model->fill && d[k + 1] == 0 ? k : k + 1;
        prepared->row[UPB_DISTANCE_TOP][k] = d[top];
        prepared->row[UPB_DISTANCE_BOTTOM][k] = d[bottom];
        prepared->row[UPB_INTENSITY_TOP][k] = i[top];
        prepared->row[UPB_INTENSITY_BOTTOM][k] = i[bottom];
    }
}

static void collect_f32_c(upb_prepared_f32 *prepared, const upb_model_f32 *model, const upb_beam_sources *sources,
                          uint16_t *distance, uint8_t *intensity) {
    collect_beams(distance, intensity, sources);
    prepare_f32_c(prepared, model, distance, intensity);
}

static float least(float a, float b) { return a < b ? a : b; }

/* Fills the empty ones of three neighbours: x is one row of a window, `empty` tells of its columns. */
static void fill_columns(float x[3], const int empty[3]) {
    const float left = x[0], middle = x[1], right = x[2];
    if (empty[0])
        x[0] = empty[1] ? right : middle;
    if (empty[2])
        x[2] = empty[1] ? left : middle;
    if (empty[1])
        x[1] = empty[0] ? right : empty[2] ? left : least(left, right);
}

/* The window of lane k: top row, bottom row, minimum; `first` is the top row of a prepared column. */
static void gather(float x[UPB_TAPS], const upb_model_f32 *model, const upb_prepared_f32 *const column[3], int first,
                   unsigned k) {
    int empty[3];
    for (int c = 0; c < 3; c++) {
        x[c] = column[c]->row[first][k];
        x[3 + c] = column[c]->row[first + 1][k];
        empty[c] = column[c]->row[UPB_DISTANCE_TOP][k] == 0; /* the pair is filled: its top tells for both */
    }
    if (model->fill) {
        fill_columns(x, empty);
        fill_columns(x + 3, empty);
    }
    x[UPB_TAP_MINIMUM] = x[0];
    for (int i = 1; i < UPB_TAP_MINIMUM; i++)
        x[UPB_TAP_MINIMUM] = least(x[UPB_TAP_MINIMUM], x[i]);
    for (int i = 0; i < UPB_TAP_MINIMUM; i++)
        x[i] -= x[UPB_TAP_MINIMUM]; /* exact: whole numbers below 2^16 */
}

/* A network's output less skip * minimum. */
static float network(const upb_network_f32 *net, const float x[UPB_TAPS]) {
    float y = net->offset;
    for (uint32_t h = 0; h < net->hidden; h++) {
        const float *unit = net->unit[h];
        float sum = unit[UPB_UNIT_BIAS];
        for (int i = 0; i < UPB_TAPS; i++)
            sum = FUSED(unit[i], x[i], sum);
        float bent = net->slope * sum;
        y = FUSED(unit[UPB_UNIT_OUTPUT], sum > bent ? sum : bent, y);
    }
    return y;
}

/* The whole output, rounded half up. The minimum is whole: adding it to the rounded rest is exact. */
static float rounded_output(const upb_network_f32 *net, const float x[UPB_TAPS]) {
    return floorf(network(net, x) + 0.5f) + net->skip * x[UPB_TAP_MINIMUM];
}

static float raw_output(const upb_network_f32 *net, const float x[UPB_TAPS]) {
    float y = network(net, x) + net->skip * x[UPB_TAP_MINIMUM];
    return net->positive && y < 0.0f ? 0.0f : y;
}

static void windows_f32_c(const upb_model_f32 *model, const upb_prepared_f32 *left, const upb_prepared_f32 *middle,
                          const upb_prepared_f32 *right, uint16_t *distance, uint8_t *intensity) {
    const upb_prepared_f32 *const column[3] = {left, middle, right};
    for (unsigned k = 0; k < UPB_LANES; k++) {
        float x[UPB_TAPS];
        gather(x, model, column, UPB_DISTANCE_TOP, k);
        float d = rounded_output(&model->network[UPB_DISTANCE], x);
        int seen = !model->fill || x[UPB_TAP_MINIMUM] != 0.0f; /* filled: 0 only if the whole window is empty */
        int given = seen && d >= model->min_count && d <= model->given_max[k];
        gather(x, model, column, UPB_INTENSITY_TOP, k);
        float i = rounded_output(&model->network[UPB_INTENSITY], x);
        i = i < 0.0f ? 0.0f : i > 255.0f ? 255.0f : i; /* before the conversion: it may not fit an integer */
        distance[k] = given ? (uint16_t)d : 0;
        intensity[k] = given ? (uint8_t)i : 0;
    }
}

static void raw_f32_c(const upb_model_f32 *model, const upb_prepared_f32 *left, const upb_prepared_f32 *middle,
                      const upb_prepared_f32 *right, float *distance, float *intensity) {
    const upb_prepared_f32 *const column[3] = {left, middle, right};
    for (unsigned k = 0; k < UPB_LANES; k++) {
        float x[UPB_TAPS];
        gather(x, model, column, UPB_DISTANCE_TOP, k);
        distance[k] = raw_output(&model->network[UPB_DISTANCE], x);
        gather(x, model, column, UPB_INTENSITY_TOP, k);
        intensity[k] = raw_output(&model->network[UPB_INTENSITY], x);
    }
}

void UPB_FILL_KERNELS(upb_kernels *kernels) {
    kernels->collect_f32 = collect_f32_c;
    kernels->prepare_f32 = prepare_f32_c;
    kernels->windows_f32 = windows_f32_c;
    kernels->raw_f32 = raw_f32_c;
}
