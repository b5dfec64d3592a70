/*
 * A network on x86 integer vectors, where one instruction multiplies pairs of 16-bit numbers and sums each pair in 32
 * bits. Inputs stand as pairs in two vectors: of windows 0..3 of each 128 bits (half 0) and 4..7 (half 1), which is
 * where unpacking puts them and packing takes them from. Hidden units go in pairs too: half a sum is a hidden value, so
 * that two sums make one vector of pairs for the output layer. Before including, define besides the template's macros
 *
 *   HALVES                 1: one half after the other, where registers are few; 2: both, sharing the loads of weights
 *   I                      a vector of integers (what V is)
 *   I_SET32(x)             all 32-bit lanes x
 *   I_UNPACK_LOW, I_UNPACK_HIGH(a, b)    16-bit lanes of a and b in turn, within 128 bits
 *   I_DOT(sum, a, b)       sum + a.even * b.even + a.odd * b.odd, signed, modulo 2^32
 *   I_UPPER(a, b)          in each 32-bit lane the upper half of a, below that of b
 *   I_MAX, I_SCALE(a, b)   signed 16 bits; (a * b + 2^14) >> 15
 *   I_SHIFT_RIGHT32(a, n)  arithmetic
 */
#include <string.h>

#include "upb_kernels.h"

enum { PAIRS = 4 };

typedef struct inputs {
    I pair[2][PAIRS];
} inputs;

/* Two 16-bit weights at p, in all lanes. */
static inline I set_pair(const int16_t *p) {
    int32_t two;
    memcpy(&two, p, sizeof two);
    return I_SET32(two);
}

static inline V window_minimum(const upb_network_int *net, const V x[UPB_TAPS]) {
    return net->k ? V_SHIFT_RIGHT(x[UPB_TAP_MINIMUM], net->k) : x[UPB_TAP_MINIMUM];
}

/* Unsigned becomes signed, 32768 less: bias_signed makes up for it. */
UPB_INLINE inputs inputs_of(const upb_network_int *net, const V x[UPB_TAPS]) {
    const V least = window_minimum(net, x);
    const V last = V_XOR(net->j ? V_SHIFT_LEFT(least, net->j) : least, V_SET(0x8000u));
    inputs in;
    for (int p = 0; p < PAIRS; p++) {
        const V even = p == PAIRS - 1 ? last : x[2 * p], odd = p == PAIRS - 1 ? V_SET(0) : x[2 * p + 1];
        in.pair[0][p] = I_UNPACK_LOW(even, odd);
        in.pair[1][p] = I_UNPACK_HIGH(even, odd);
    }
    return in;
}

UPB_INLINE I unit_sum(const upb_network_int *net, uint32_t h, const I pair[PAIRS]) {
    I sum = I_SET32(net->bias_signed[h]);
    for (int p = 0; p < PAIRS; p++)
        sum = I_DOT(sum, pair[p], set_pair(&net->weight[h][2 * p]));
    return sum;
}

/* Steps 4 to 7 of HALVES halves from `first` on. */
UPB_INLINE void layers(I *output, const upb_network_int *net, const inputs *in, int first, int is_leaky) {
    const I slope = I_SET32((int32_t)((uint32_t)net->slope * 0x10001u)), zero = I_SET32(0);
    for (int half = first; half < first + HALVES; half++)
        output[half] = I_SET32(net->offset);
    for (uint32_t h = 0; h < net->hidden; h += 2)
        for (int half = first; half < first + HALVES; half++) {
            const I hidden = I_UPPER(unit_sum(net, h, in->pair[half]), unit_sum(net, h + 1, in->pair[half]));
            const I bent = is_leaky ? I_SCALE(hidden, slope) : zero;
            output[half] = I_DOT(output[half], I_MAX(hidden, bent), set_pair(&net->output[h]));
        }
}

UPB_INLINE W output_of(const upb_network_int *net, const inputs *in, const V x[UPB_TAPS]) {
    W y;
    for (int half = 0; half < 2; half += HALVES)
        if (net->slope)
            layers(y.half, net, in, half, 1);
        else
            layers(y.half, net, in, half, 0);
    for (int half = 0; half < 2; half++)
        y.half[half] = I_SHIFT_RIGHT32(y.half[half], net->t);
    return W_ADD_V(y, net->skip ? window_minimum(net, x) : V_SET(0));
}
