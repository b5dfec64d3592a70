/*
 * The float window kernel in vectors: included once by each instruction set's file, which includes its upb_vectors_*.h
 * and defines before
 *
 *   F                    a vector of V_LANES / 2 floats
 *   F_LOW, F_HIGH(v)     the windows of V as floats, in the order of W: half 0, half 1
 *   F_SET(x)             all lanes x;     F_STORE(p, v), aligned
 *   F_ADD, F_MUL, F_MIN, F_MAX (a, b);    F_FMA(a, b, c): a * b + c, rounded once
 *   F_FLOOR32(v)         as 32-bit integers, rounded down; v is at most OUTPUT_MOST, below -2^31 becomes some negative
 *                        number
 *   UPB_FILL_KERNELS     the name of the function that hands the kernels out
 *
 * Inputs are whole numbers below 2^16: as floats they are exact. The plain C kernel says the same one lane at a time.
 */
#include "upb_kernel_rules.h"

static const uint16_t unlifted[2];
static const uint32_t unshifted[2];

#define OUTPUT_MOST 1e6f /* more than any count: outputs are cut to it before they become integers */

UPB_INLINE limits limits_of(const upb_model_f32 *model) {
    limits of = {.min_count = V_SET((uint16_t)model->min_count), .fill = M_ALL(model->fill != 0)};
    for (unsigned b = 0; b < V_BLOCKS; b++) {
        of.seen_max[b] = V_LOAD_FLOATS(model->seen_max + b * V_LANES);
        of.given_max[b] = V_LOAD_FLOATS(model->given_max + b * V_LANES);
    }
    return of;
}

static void prepare_f32(upb_prepared_f32 *prepared, const upb_model_f32 *model, const uint16_t *distance,
                        const uint8_t *intensity) {
    const limits of = limits_of(model);
    prepare(prepared, &of, unshifted, load_rows(distance, intensity));
}

static void collect_f32(upb_prepared_f32 *prepared, const upb_model_f32 *model, const upb_beam_sources *sources,
                        uint16_t *distance, uint8_t *intensity) {
    const limits of = limits_of(model);
    prepare(prepared, &of, unshifted, collect_rows(distance, intensity, sources));
}

/* y[half]: the output of a half of the windows less skip * minimum. */
UPB_INLINE void layers(F y[2], const upb_network_f32 *net, const V x[UPB_TAPS], int is_leaky) {
    const F slope = F_SET(net->slope), zero = F_SET(0.0f);
    F in[2][UPB_TAPS];
    for (int i = 0; i < UPB_TAPS; i++) {
        in[0][i] = F_LOW(x[i]);
        in[1][i] = F_HIGH(x[i]);
    }
    y[0] = y[1] = F_SET(net->offset);
    for (uint32_t h = 0; h < net->hidden; h += 2) { /* two, so that there is work between dependent steps */
        F sum[2][2];
        for (unsigned u = 0; u < 2; u++)
            sum[u][0] = sum[u][1] = F_SET(net->unit[h + u][UPB_UNIT_BIAS]);
        for (int i = 0; i < UPB_TAPS; i++)
            for (unsigned u = 0; u < 2; u++)
                for (int half = 0; half < 2; half++)
                    sum[u][half] = F_FMA(F_SET(net->unit[h + u][i]), in[half][i], sum[u][half]);
        for (unsigned u = 0; u < 2; u++)
            for (int half = 0; half < 2; half++) {
                const F bent = is_leaky ? F_MUL(slope, sum[u][half]) : zero;
                y[half] = F_FMA(F_SET(net->unit[h + u][UPB_UNIT_OUTPUT]), F_MAX(sum[u][half], bent), y[half]);
            }
    }
}

/* A plain rectifier saves a product for each unit; of a leaky one with slope 0 it differs in the sign of a zero. */
UPB_INLINE void any_layers(F y[2], const upb_network_f32 *net, const V x[UPB_TAPS]) {
    if (net->slope > 0.0f)
        layers(y, net, x, 1);
    else
        layers(y, net, x, 0);
}

/* The whole output, rounded half up. The minimum is whole: adding it to the rounded rest is exact. */
UPB_INLINE W network(const upb_network_f32 *net, const V x[UPB_TAPS]) {
    const F half = F_SET(0.5f), most = F_SET(OUTPUT_MOST);
    F rest[2];
    W y;
    any_layers(rest, net, x);
    y.half[0] = F_FLOOR32(F_MIN(F_ADD(rest[0], half), most));
    y.half[1] = F_FLOOR32(F_MIN(F_ADD(rest[1], half), most));
    return W_ADD_V(y, net->skip > 0.0f ? x[UPB_TAP_MINIMUM] : V_SET(0));
}

static void windows_f32(const upb_model_f32 *model, const upb_prepared_f32 *left, const upb_prepared_f32 *middle,
                        const upb_prepared_f32 *right, uint16_t *distance, uint8_t *intensity) {
    const upb_prepared *const column[3] = {left, middle, right};
    const limits of = limits_of(model);
    for (unsigned b = 0; b < V_BLOCKS; b++) {
        V x[2][UPB_TAPS];
        W y[2];
        const M nothing = gather(x, column, b * V_LANES, of.fill, unlifted);
        /* No loop: compilers leave it rolled, and then keep the inputs in memory. */
        y[0] = network(&model->network[0], x[0]);
        y[1] = network(&model->network[1], x[1]);
        give(distance + b * V_LANES, intensity + b * V_LANES, y, nothing, of.given_max[b], of.min_count);
    }
}

/* The unrounded output, in the order of windows: within 128 bits, half 0 has the first four of eight, half 1 the rest.
 */
static void store_raw(float *out, const F rest[2], const upb_network_f32 *net, V minimum) {
    _Alignas(UPB_ALIGN) float y[2][V_LANES / 2], least[2][V_LANES / 2];
    for (int half = 0; half < 2; half++)
        F_STORE(y[half], rest[half]);
    F_STORE(least[0], F_LOW(minimum));
    F_STORE(least[1], F_HIGH(minimum));
    for (unsigned k = 0; k < V_LANES; k++) {
        const unsigned half = k / 4 % 2, lane = k / 8 * 4 + k % 4;
        const float whole = y[half][lane] + net->skip * least[half][lane];
        out[k] = net->positive && whole < 0.0f ? 0.0f : whole;
    }
}

static void raw_f32(const upb_model_f32 *model, const upb_prepared_f32 *left, const upb_prepared_f32 *middle,
                    const upb_prepared_f32 *right, float *distance, float *intensity) {
    const upb_prepared *const column[3] = {left, middle, right};
    float *const out[2] = {distance, intensity};
    const M fill = M_ALL(model->fill != 0);
    for (unsigned k = 0; k < UPB_LANES; k += V_LANES) {
        V x[2][UPB_TAPS];
        F rest[2];
        (void)gather(x, column, k, fill, unlifted);
        for (int n = 0; n < 2; n++) {
            any_layers(rest, &model->network[n], x[n]);
            store_raw(out[n] + k, rest, &model->network[n], x[n][UPB_TAP_MINIMUM]);
        }
    }
}

void UPB_FILL_KERNELS(upb_kernels *kernels) {
    kernels->prepare_f32 = prepare_f32;
    kernels->collect_f32 = collect_f32;
    kernels->windows_f32 = windows_f32;
    kernels->raw_f32 = raw_f32;
}
