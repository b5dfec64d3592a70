/*
 * The integer window kernels with NEON, which every AArch64 has. UPB_DOT: the machine has the dot product instructions
 * too, which int8 takes.
 */
#include "upb_vectors_neon.h"

/* Inputs and minimum stand shifted left by k. */
static inline V window_minimum(const upb_network_int *net, const V x[UPB_TAPS]) {
    return V_SHIFT_RIGHT(x[UPB_TAP_MINIMUM], net->k);
}

/* Unsigned becomes signed, 32768 less: the bias makes up for it. */
static inline int16x8_t signed_minimum(const upb_network_int *net, const V x[UPB_TAPS]) {
    return vreinterpretq_s16_u16(veorq_u16(V_SHIFT_LEFT(window_minimum(net, x), net->j), vdupq_n_u16(0x8000)));
}

/* Steps 5 and 6 for one unit: bias and the upper half of its sum, rectifier. */
UPB_INLINE int16x8_t rectified(W sum, const int32_t *bias, int32_t slope) {
    const int32x4_t added = vld1q_dup_s32(bias);
    const int16x8_t hidden = vaddhn_high_s32(vaddhn_s32(sum.half[0], added), sum.half[1], added);
    return vmaxq_s16(hidden, slope ? vqrdmulhq_n_s16(hidden, (int16_t)slope) : vdupq_n_s16(0));
}

/* Step 7 for two units; `pair`: their output weights. */
UPB_INLINE void add_units(W *output, int16x8_t a, int16x8_t b, const int16_t *pair) {
    int32_t two;
    memcpy(&two, pair, sizeof two);
    const int16x4_t weights = vreinterpret_s16_s32(vdup_n_s32(two));
    output->half[0] = vmlal_lane_s16(output->half[0], vget_low_s16(a), weights, 0);
    output->half[1] = vmlal_high_lane_s16(output->half[1], a, weights, 0);
    output->half[0] = vmlal_lane_s16(output->half[0], vget_low_s16(b), weights, 1);
    output->half[1] = vmlal_high_lane_s16(output->half[1], b, weights, 1);
}

/* Steps 8 and 9. */
UPB_INLINE W finish_output(const upb_network_int *net, W output, V minimum) {
    const int32x4_t shift = vdupq_n_s32(-(int32_t)net->t);
    const W rounded = {{vshlq_s32(output.half[0], shift), vshlq_s32(output.half[1], shift)}};
    return W_ADD_V(rounded, vandq_u16(minimum, vdupq_n_u16(net->skip ? 0xffff : 0)));
}

#define ADD_TAP(sum, x, weights, i)                                                                                    \
    (sum.half[0] = vmlal_laneq_s16(sum.half[0], vget_low_s16(x[i]), weights, i),                                       \
     sum.half[1] = vmlal_high_laneq_s16(sum.half[1], x[i], weights, i))

/* All of a unit's sum but its bias. */
UPB_INLINE W unit_sum(const int16_t *unit, const int16x8_t x[UPB_TAPS]) {
    const int16x8_t weights = vld1q_s16(unit);
    W sum = {{vmull_laneq_s16(vget_low_s16(x[0]), weights, 0), vmull_high_laneq_s16(x[0], weights, 0)}};
    ADD_TAP(sum, x, weights, 1);
    ADD_TAP(sum, x, weights, 2);
    ADD_TAP(sum, x, weights, 3);
    ADD_TAP(sum, x, weights, 4);
    ADD_TAP(sum, x, weights, 5);
    ADD_TAP(sum, x, weights, 6);
    return sum;
}

typedef struct inputs {
    int16x8_t x[UPB_TAPS];
} inputs;

UPB_INLINE inputs inputs_of(const upb_network_int *net, const V x[UPB_TAPS]) {
    inputs in;
    for (int i = 0; i < UPB_TAP_MINIMUM; i++)
        in.x[i] = vreinterpretq_s16_u16(x[i]);
    in.x[UPB_TAP_MINIMUM] = signed_minimum(net, x);
    return in;
}

UPB_INLINE W layers_words(const upb_network_int *net, const inputs *in, int32_t slope) {
    W output = {{vdupq_n_s32(net->offset), vdupq_n_s32(net->offset)}};
    for (uint32_t h = 0; h < net->hidden; h += 2) { /* two, so that an in-order core has work between dependent steps */
        const W a = unit_sum(net->weight[h], in->x), b = unit_sum(net->weight[h + 1], in->x);
        add_units(&output, rectified(a, &net->bias_signed[h], slope), rectified(b, &net->bias_signed[h + 1], slope),
                  &net->output[h]);
    }
    return output;
}

UPB_INLINE W output_of(const upb_network_int *net, const inputs *in, const V x[UPB_TAPS]) {
    return finish_output(net, net->slope ? layers_words(net, in, net->slope) : layers_words(net, in, 0),
                         window_minimum(net, x));
}

#ifdef UPB_DOT
#define HAS_NETWORKS_INT8
static const uint16_t int8_lift[2]; /* none */
#define UPB_FILL_KERNELS upb_kernels_fill_int_neon_dot

/* Four windows: their codes less 128, as bytes (0, 1, 2, 3) and (4, 5, none, none) of 32 bits; the minimum; s + k. */
typedef struct coded {
    int8x16_t first, second;
    int16x4_t minimum;
    int32x4_t shift;
} coded;

static inline int8x16_t less_128(uint16x8_t bytes) {
    return vreinterpretq_s8_u8(veorq_u8(vreinterpretq_u8_u16(bytes), vdupq_n_u8(0x80)));
}

/* Step 3. Inputs stand shifted left by k: their own shift s is larger by as much, or they have that many zeros. */
UPB_INLINE void code(coded group[2], const upb_network_int *net, const V x[UPB_TAPS]) {
    const V any = V_OR(V_OR(V_OR(x[0], x[1]), V_OR(x[2], x[3])), V_OR(x[4], x[5])); /* as long as the largest */
    const uint16x8_t shift = vsubq_u16(vdupq_n_u16(16), vclzq_u16(vshrq_n_u16(any, 8)));
    const int16x8_t back = vnegq_s16(vreinterpretq_s16_u16(shift));
    const uint16x8_t total = vaddq_u16(shift, vdupq_n_u16((uint16_t)net->in_weights));
    V q[6];
    for (int i = 0; i < 6; i++)
        q[i] = vminq_u16(vrshlq_u16(x[i], back), vdupq_n_u16(255));
    const uint16x8_t q01 = vsliq_n_u16(q[0], q[1], 8), q23 = vsliq_n_u16(q[2], q[3], 8);
    const uint16x8_t q45 = vsliq_n_u16(q[4], q[5], 8);
    const int16x8_t minimum = signed_minimum(net, x);
    group[0] = (coded){less_128(vzip1q_u16(q01, q23)), less_128(vzip1q_u16(q45, q45)), vget_low_s16(minimum),
                       vreinterpretq_s32_u32(vmovl_u16(vget_low_u16(total)))};
    group[1] = (coded){less_128(vzip2q_u16(q01, q23)), less_128(vzip2q_u16(q45, q45)), vget_high_s16(minimum),
                       vreinterpretq_s32_u32(vmovl_high_u16(total))};
}

/* Step 4 without the bias. */
UPB_INLINE W unit_sum_bytes(const upb_network_int *net, uint32_t h, const coded group[2]) {
    const int8x8_t weights = vld1_s8(net->weight8[h]); /* of bytes that are none: 0 */
    const int16x8_t words = vld1q_s16(net->weight[h]); /* a lane of a row: a copy to all lanes takes a vector unit */
    const int32x4_t begin = vdupq_n_s32(net->dot_signed[h]);
    W sum;
    for (int g = 0; g < 2; g++) {
        int32x4_t dot = vdotq_lane_s32(begin, group[g].first, weights, 0);
        dot = vdotq_lane_s32(dot, group[g].second, weights, 1);
        dot = vshlq_s32(dot, group[g].shift);
        sum.half[g] = vmlal_laneq_s16(dot, group[g].minimum, words, UPB_TAP_MINIMUM);
    }
    return sum;
}

UPB_INLINE W layers_bytes(const upb_network_int *net, const coded group[2], int32_t slope) {
    W output = {{vdupq_n_s32(net->offset), vdupq_n_s32(net->offset)}};
    for (uint32_t h = 0; h < net->hidden; h += 2) {
        const W a = unit_sum_bytes(net, h, group), b = unit_sum_bytes(net, h + 1, group);
        add_units(&output, rectified(a, &net->bias8[h], slope), rectified(b, &net->bias8[h + 1], slope),
                  &net->output[h]);
    }
    return output;
}

UPB_INLINE W network_bytes(const upb_network_int *net, const coded group[2], V minimum) {
    return finish_output(net, net->slope ? layers_bytes(net, group, net->slope) : layers_bytes(net, group, 0), minimum);
}

UPB_INLINE void networks_int8(W y[2], const upb_network_int networks[2], V x[2][UPB_TAPS]) {
    coded distance[2], intensity[2];
    code(distance, &networks[0], x[0]);
    code(intensity, &networks[1], x[1]);
    y[0] = network_bytes(&networks[0], distance, window_minimum(&networks[0], x[0]));
    y[1] = network_bytes(&networks[1], intensity, window_minimum(&networks[1], x[1]));
}

#else
#define UPB_FILL_KERNELS upb_kernels_fill_int_neon
#endif

#include "upb_kernel_int_template.h"
