/*
 * The integer window kernels in vectors: included once by each instruction set's file, which includes its
 * upb_vectors_*.h and defines before
 *
 *   inputs               what the networks of one vector of windows start from
 *   inputs_of(net, x)    of differences and minimum, V[UPB_TAPS], all shifted left by k of the network, differences
 *                        with the highest bit flipped: signed numbers, 32768 less
 *   output_of(net, in, x)  y of a network, W
 *   UPB_FILL_KERNELS     the name of the function that hands the kernels out
 *
 * and, if its int8 has instructions of its own, HAS_NETWORKS_INT8 and networks_int8(y, networks, x), whose differences
 * have int8_lift[2] added instead of the flipped bit. Both networks' inputs are made before either's sums: the steps up
 * to there depend on each other and would wait alone. The plain C kernel says the same one lane at a time: read it
 * first.
 */
#include "upb_kernel_rules.h"

#define SIGN_BIT 0x8000u

static const uint16_t int16_lift[2] = {SIGN_BIT, SIGN_BIT};

UPB_INLINE limits limits_of(const upb_model_int *model) {
    limits of = {.min_count = V_SET(model->min_count), .fill = M_ALL(model->fill != 0)};
    for (unsigned b = 0; b < V_BLOCKS; b++) {
        of.seen_max[b] = V_LOAD(model->seen_max + b * V_LANES);
        of.given_max[b] = V_LOAD(model->given_max + b * V_LANES);
    }
    return of;
}

/* Shifted by k here, once for the three windows of a column. */
UPB_INLINE void prepare_rows(upb_prepared_int *prepared, const upb_model_int *model, rows of_column) {
    const limits of = limits_of(model);
    const upb_network_int *const net = model->network;
    prepare(prepared, &of, (const uint32_t[2]){net[UPB_DISTANCE].k, net[UPB_INTENSITY].k}, of_column);
}

static void prepare_int(upb_prepared_int *prepared, const upb_model_int *model, const uint16_t *distance,
                        const uint8_t *intensity) {
    prepare_rows(prepared, model, load_rows(distance, intensity));
}

static void collect_int(upb_prepared_int *prepared, const upb_model_int *model, const upb_beam_sources *sources,
                        uint16_t *distance, uint8_t *intensity) {
    prepare_rows(prepared, model, collect_rows(distance, intensity, sources));
}

/* No loop over the networks: compilers leave it rolled, and then keep the inputs in memory. */
UPB_INLINE void networks_int16(W y[2], const upb_network_int networks[2], V x[2][UPB_TAPS]) {
    const inputs distance = inputs_of(&networks[0], x[0]), intensity = inputs_of(&networks[1], x[1]);
    y[0] = output_of(&networks[0], &distance, x[0]);
    y[1] = output_of(&networks[1], &intensity, x[1]);
}

#ifndef HAS_NETWORKS_INT8
/*
 * Step 3 of int8: differences become q << s, their sign bit flipped. Intensities fit eight bits as they are. The shift
 * s is never needed as such: with `below`, 2^s - 1, rounding is to add half of 2^s and to clear the bits below it. What
 * would become 256 << s is cut to one less before: then it becomes 255 << s. That differences come shifted by k changes
 * nothing: s is then larger by up to k, and the bits below 2^k are 0.
 */
UPB_INLINE void code_block(V x[UPB_TAPS]) {
    const V any = V_OR(V_OR3(x[0], x[1], x[2]), V_OR3(x[3], x[4], x[5])); /* as long as the largest */
    const V smeared = V_SMEAR_UPPER(any), below = V_SHIFT_RIGHT(smeared, 8), half = V_AVERAGE(below, V_SET(0));
    const V largest = V_OR(smeared, V_SET(0xff)); /* (256 << s) - 1 */
    for (int i = 0; i < UPB_TAP_MINIMUM; i++)
        x[i] = V_CLEAR_XOR(V_MIN(V_ADD_SAT(x[i], half), largest), below, V_SET(SIGN_BIT));
}

static const uint16_t int8_lift[2] = {0, SIGN_BIT};

/* On 16-bit instructions. Intensities first: their sums are work while distances are coded. */
UPB_INLINE void networks_int8(W y[2], const upb_network_int networks[2], V x[2][UPB_TAPS]) {
    code_block(x[UPB_DISTANCE]);
    const inputs distance = inputs_of(&networks[0], x[0]), intensity = inputs_of(&networks[1], x[1]);
    y[1] = output_of(&networks[1], &intensity, x[1]);
    y[0] = output_of(&networks[0], &distance, x[0]);
}
#endif

typedef void networks_fn(W y[2], const upb_network_int networks[2], V x[2][UPB_TAPS]);

UPB_INLINE void windows(networks_fn *networks, const uint16_t lift[2], const upb_model_int *model,
                        const upb_prepared *const column[3], uint16_t *distance, uint8_t *intensity) {
    const limits of = limits_of(model);
    for (unsigned b = 0; b < V_BLOCKS; b++) {
        V x[2][UPB_TAPS];
        W y[2];
        const M nothing = gather(x, column, b * V_LANES, of.fill, lift);
        networks(y, model->network, x);
        give(distance + b * V_LANES, intensity + b * V_LANES, y, nothing, of.given_max[b], of.min_count);
    }
}

static void windows_int16(const upb_model_int *model, const upb_prepared_int *left, const upb_prepared_int *middle,
                          const upb_prepared_int *right, uint16_t *distance, uint8_t *intensity) {
    const upb_prepared *const column[3] = {left, middle, right};
    windows(networks_int16, int16_lift, model, column, distance, intensity);
}

static void windows_int8(const upb_model_int *model, const upb_prepared_int *left, const upb_prepared_int *middle,
                         const upb_prepared_int *right, uint16_t *distance, uint8_t *intensity) {
    const upb_prepared *const column[3] = {left, middle, right};
    windows(networks_int8, int8_lift, model, column, distance, intensity);
}

void UPB_FILL_KERNELS(upb_kernels *kernels) {
    kernels->prepare_int = prepare_int;
    kernels->collect_int = collect_int;
    kernels->windows_int16 = windows_int16;
    kernels->windows_int8 = windows_int8;
}
