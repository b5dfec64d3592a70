/*
 * The integer window kernels in vectors: included once by each instruction set's file, which includes its
 * upb_vectors_*.h and defines before
 *
 *   networks_int16(y, networks, x)  y of both networks, W[2]; x: differences and minimum, V[2][UPB_TAPS], all shifted
 *                                   left by k of their network, differences with the highest bit flipped: signed
 *                                   numbers, 32768 less
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
static void prepare_int(upb_prepared_int *prepared, const upb_model_int *model, const uint16_t *distance,
                        const uint8_t *intensity) {
    const limits of = limits_of(model);
    prepare(prepared, &of, (const uint32_t[2]){model->network[UPB_DISTANCE].k, model->network[UPB_INTENSITY].k},
            distance, intensity);
}

#ifndef HAS_NETWORKS_INT8
/*
 * Step 3 of int8: differences become q << s, their sign bit flipped. Intensities fit eight bits as they are. The shift
 * s is never needed as such: with `half`, 2^(s-1) or 0, rounding is to add half and to clear the bits below 2^s. What
 * saturates at 65535 is 255 << 8 as well. That differences come shifted by k changes nothing: s is then larger by up to
 * k, and the bits below 2^k are 0.
 */
UPB_INLINE void code_block(V x[UPB_TAPS]) {
    const V any = V_OR(V_OR(V_OR(x[0], x[1]), V_OR(x[2], x[3])), V_OR(x[4], x[5])); /* as long as the largest */
    const V half = V_TOP_BIT(V_SHIFT_RIGHT(any, 8)), step = V_MAX(V_SHIFT_LEFT(half, 1), V_SET(1));
    const V above = V_SUB(V_SET(0), step), sign = V_SET(SIGN_BIT);
    const V largest = V_XOR(V_SUB(V_SHIFT_LEFT(step, 8), step), sign);
    for (int i = 0; i < UPB_TAP_MINIMUM; i++)
        x[i] = V_MIN_SIGNED(V_AND_XOR(V_ADD_SAT(x[i], half), above, sign), largest);
}

static const uint16_t int8_lift[2] = {0, SIGN_BIT};

/* On 16-bit instructions. */
UPB_INLINE void networks_int8(W y[2], const upb_network_int networks[2], V x[2][UPB_TAPS]) {
    code_block(x[UPB_DISTANCE]);
    networks_int16(y, networks, x);
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
    kernels->windows_int16 = windows_int16;
    kernels->windows_int8 = windows_int8;
}
