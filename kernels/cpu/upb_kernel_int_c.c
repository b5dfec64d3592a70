/*
 * The integer window kernels in plain C: the reference that every other one is checked against, and the fallback. The
 * steps are those of docs/numeric-contract.md. Sums are unsigned: they may wrap on their way to a result that fits.
 */
#include <stddef.h>

#include "upb_collect.h"
#include "upb_kernels.h"
#include "upb_network_int.h"

static void prepare_int_c(upb_prepared_int *prepared, const upb_model_int *model, const uint16_t *distance,
                          const uint8_t *intensity) {
    uint16_t d[UPB_LANES + 1], i[UPB_LANES + 1];
    for (unsigned k = 0; k < UPB_LANES; k++) {
        const int is_seen = distance[k] >= model->min_count && distance[k] <= model->seen_max[k];
        d[k] = is_seen ? distance[k] : 0;
        i[k] = is_seen ? intensity[k] : 0;
    }
    d[UPB_LANES] = i[UPB_LANES] = 0;
    for (unsigned k = 0; k < UPB_LANES; k++) {
        /* Intensities are filled in the same places as distances: a measured intensity may be 0. */
        const unsigned top = model->fill && !d[k] ? k + 1 : k;
        const unsigned bottom = model->fill && !d[k + 1] ? k : k + 1;
        prepared->row[UPB_DISTANCE_TOP][k] = d[top];
        prepared->row[UPB_DISTANCE_BOTTOM][k] = d[bottom];
        prepared->row[UPB_INTENSITY_TOP][k] = i[top];
        prepared->row[UPB_INTENSITY_BOTTOM][k] = i[bottom];
    }
}

static void collect_int_c(upb_prepared_int *prepared, const upb_model_int *model, const upb_beam_sources *sources,
                          uint16_t *distance, uint8_t *intensity) {
    collect_beams(distance, intensity, sources);
    prepare_int_c(prepared, model, distance, intensity);
}

/* Fills the empty ones of three neighbours: x is one row of a window, `empty` tells of its columns. */
static void fill_columns(uint16_t x[3], const int empty[3]) {
    const uint16_t left = x[0], middle = x[1], right = x[2];
    if (empty[0])
        x[0] = empty[1] ? right : middle;
    if (empty[2])
        x[2] = empty[1] ? left : middle;
    if (empty[1])
        x[1] = empty[0] ? right : empty[2] || left < right ? left : right;
}

/* The window of lane k: top row, bottom row; `first` is the top row of a prepared column. */
static void gather(uint16_t x[6], const upb_model_int *model, const upb_prepared_int *const column[3], int first,
                   unsigned k) {
    int empty[3];
    for (int c = 0; c < 3; c++) {
        x[c] = column[c]->row[first][k];
        x[3 + c] = column[c]->row[first + 1][k];
        empty[c] = !column[c]->row[UPB_DISTANCE_TOP][k]; /* the pair is filled: its top tells for both */
    }
    if (model->fill) {
        fill_columns(x, empty);
        fill_columns(x + 3, empty);
    }
}

/* A shift of a negative number to the right keeps its sign: with every compiler that this project knows. */
static int32_t shift_right(int32_t a, uint32_t shift) { return a >> shift; }

static uint16_t subtract_minimum(uint16_t d[6], const uint16_t x[6]) {
    uint16_t minimum = x[0];
    for (int i = 1; i < 6; i++)
        minimum = x[i] < minimum ? x[i] : minimum;
    for (int i = 0; i < 6; i++)
        d[i] = (uint16_t)(x[i] - minimum);
    return minimum;
}

/* Step 3 of int8: differences become what is left of them in eight bits. Returns the shift that they share. */
static uint32_t block_code(uint16_t q[6]) {
    uint32_t any = 0, shift = 0;
    for (int i = 0; i < 6; i++)
        any |= q[i]; /* as long in binary as the largest */
    while (any >> shift > 255)
        shift++;
    for (int i = 0; i < 6; i++) {
        const uint32_t rounded = (q[i] + ((uint32_t)1 << shift >> 1)) >> shift;
        q[i] = (uint16_t)(rounded < 255 ? rounded : 255);
    }
    return shift;
}

/* Step 4, and the rounding of step 5. */
static int32_t unit_sum(const upb_network_int *net, uint32_t h, const uint16_t q[6], uint32_t shift, uint16_t minimum) {
    uint32_t sum = 0;
    for (int i = 0; i < 6; i++)
        sum += (uint32_t)(int32_t)net->weight[h][i] * q[i];
    sum <<= shift + net->k;
    sum += (uint32_t)(int32_t)net->weight[h][UPB_TAP_MINIMUM] * minimum << net->j;
    return (int32_t)(sum + (uint32_t)net->bias[h]);
}

/* Step 6. */
static int32_t rectify(int32_t a, int32_t slope) {
    const int32_t bent = shift_right(a * slope + (1 << 14), 15);
    return a > bent ? a : bent;
}

/* Steps 1 to 9. `trace` may be null. */
UPB_INLINE int32_t network(const upb_network_int *net, upb_precision precision, const uint16_t x[6],
                           upb_int_trace *trace) {
    uint16_t q[6];
    const uint16_t minimum = subtract_minimum(q, x);
    const uint32_t shift = precision == UPB_PRECISION_INT8 ? block_code(q) : 0;
    uint32_t output = (uint32_t)net->offset;
    for (uint32_t h = 0; h < net->hidden; h++) {
        const int32_t sum = unit_sum(net, h, q, shift, minimum);
        const int32_t hidden = shift_right(sum, 16), bent = rectify(hidden, net->slope);
        output += (uint32_t)(net->output[h] * bent);
        if (trace) {
            trace->sum[h] = sum - (1 << 15);
            trace->hidden[h] = (int16_t)hidden;
            trace->rectified[h] = (int16_t)bent;
        }
    }
    const int32_t rounded = shift_right((int32_t)output, net->t);
    const int32_t value = rounded + (net->skip ? minimum : 0);
    if (trace) {
        for (int i = 0; i < 6; i++) {
            trace->difference[i] = (uint16_t)(x[i] - minimum);
            trace->code[i] = q[i];
        }
        trace->minimum = minimum;
        trace->shift = shift;
        trace->output = (int32_t)(output - ((uint32_t)1 << net->t >> 1));
        trace->rounded = rounded;
        trace->value = value;
    }
    return value;
}

void upb_trace_int(const upb_network_int *net, upb_precision precision, const uint16_t x[6], upb_int_trace *trace) {
    *trace = (upb_int_trace){0};
    (void)network(net, precision, x, trace);
}

UPB_INLINE void windows(const upb_model_int *model, upb_precision precision, const upb_prepared_int *const column[3],
                        uint16_t *distance, uint8_t *intensity) {
    for (unsigned k = 0; k < UPB_LANES; k++) {
        uint16_t x[6];
        gather(x, model, column, UPB_DISTANCE_TOP, k);
        const int32_t d = network(&model->network[UPB_DISTANCE], precision, x, NULL);
        int seen = !model->fill;
        for (int i = 0; i < 6; i++)
            seen |= x[i] != 0; /* filled: all or none */
        const int given = seen && d >= model->min_count && d <= model->given_max[k];
        gather(x, model, column, UPB_INTENSITY_TOP, k);
        const int32_t i = network(&model->network[UPB_INTENSITY], precision, x, NULL);
        distance[k] = given ? (uint16_t)d : 0;
        intensity[k] = given ? (uint8_t)(i < 0 ? 0 : i > 255 ? 255 : i) : 0;
    }
}

static void windows_int16_c(const upb_model_int *model, const upb_prepared_int *left, const upb_prepared_int *middle,
                            const upb_prepared_int *right, uint16_t *distance, uint8_t *intensity) {
    windows(model, UPB_PRECISION_INT16, (const upb_prepared_int *const[3]){left, middle, right}, distance, intensity);
}

static void windows_int8_c(const upb_model_int *model, const upb_prepared_int *left, const upb_prepared_int *middle,
                           const upb_prepared_int *right, uint16_t *distance, uint8_t *intensity) {
    windows(model, UPB_PRECISION_INT8, (const upb_prepared_int *const[3]){left, middle, right}, distance, intensity);
}

void upb_kernels_fill_int_c(upb_kernels *kernels) {
    kernels->prepare_int = prepare_int_c;
    kernels->collect_int = collect_int_c;
    kernels->windows_int16 = windows_int16_c;
    kernels->windows_int8 = windows_int8_c;
}
