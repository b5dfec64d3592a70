/* Integer networks (docs/numeric-contract.md): derived fields, proof against overflow, and one window step by step. */
#include "upb_network_int.h"

static uint32_t half_of(uint32_t shift) { return shift ? (uint32_t)1 << (shift - 1) : 0; }

static int32_t wrapped(int32_t a, uint32_t b) { return (int32_t)((uint32_t)a + b); }

static int32_t at_least_0(int32_t value) { return value > 0 ? value : 0; }

static void clear_padding(upb_network_int *net) {
    for (uint32_t h = net->hidden; h < UPB_MAX_HIDDEN; h++) {
        for (int i = 0; i < UPB_TAPS; i++)
            net->weight[h][i] = 0;
        net->bias[h] = 0;
        net->output[h] = 0;
    }
    net->hidden += net->hidden & 1u;
}

/* What kernels that multiply bytes take, from W as the file has it. */
static void derive_bytes(upb_network_int *net, uint32_t h, int is_int8) {
    int32_t sum = 0;
    for (int i = 0; i < UPB_TAP_MINIMUM; i++) {
        net->weight8[h][i] = is_int8 ? (int8_t)net->weight[h][i] : 0;
        sum += net->weight8[h][i];
    }
    net->weight8[h][6] = net->weight8[h][7] = 0;
    net->dot_signed[h] = 128 * sum;
    net->bias8[h] = is_int8 ? wrapped(net->bias[h], (uint32_t)net->weight[h][UPB_TAP_MINIMUM] * 32768u) : 0;
}

void upb_network_int_finish(upb_network_int *net, upb_precision precision) {
    const int is_int8 = precision == UPB_PRECISION_INT8;
    const uint32_t in_weights = !is_int8 ? 0 : net->k < 8 ? net->k : 8;
    clear_padding(net);
    net->offset = wrapped(net->offset, half_of(net->t));
    for (uint32_t h = 0; h < UPB_MAX_HIDDEN; h++) {
        int16_t *weight = net->weight[h];
        weight[7] = 0;
        net->bias[h] = wrapped(net->bias[h], half_of(16));
        derive_bytes(net, h, is_int8);
        int32_t sum = weight[UPB_TAP_MINIMUM];
        for (int i = 0; i < UPB_TAP_MINIMUM; i++) {
            weight[i] = (int16_t)(weight[i] * (1 << in_weights));
            sum += weight[i];
        }
        net->bias_signed[h] = wrapped(net->bias[h], (uint32_t)sum * 32768u);
    }
    net->in_weights = in_weights;
    net->k -= in_weights;
}

/* -------------------------------------------------------------------------------------------- the proof */

static int32_t length_in_bits(uint32_t n) {
    int32_t bits = 0;
    for (; n; n >>= 1)
        bits++;
    return bits;
}

/* The largest q << s. */
static int64_t largest_code(upb_precision precision, uint32_t difference) {
    const int32_t shift = precision == UPB_PRECISION_INT8 ? at_least_0(length_in_bits(difference) - 8) : 0;
    if (!shift)
        return difference;
    const int64_t saturated = (int64_t)255 << shift, rounded = (int64_t)difference + half_of((uint32_t)shift);
    return saturated < rounded ? saturated : rounded;
}

static int64_t round_shift(int64_t a, uint32_t shift) { return (a + half_of(shift)) >> shift; }

/* Steps 5 and 6 of the contract. */
static int64_t rectified(int64_t sum, int32_t slope) {
    const int64_t a = round_shift(sum, 16), bent = round_shift(a * slope, 15);
    return a > bent ? a : bent;
}

static int fail(upb_int_failure *failure, const char *bound, uint32_t unit, int64_t got, int64_t limit) {
    if (failure)
        *failure = (upb_int_failure){.bound = bound, .unit = unit, .got = got, .limit = limit};
    return 0;
}

static int parameters_in_range(const upb_network_int *net, upb_precision precision, uint32_t largest,
                               upb_int_failure *failure) {
    const struct {
        const char *name;
        int64_t value, least, most;
    } range[] = {{"hidden", net->hidden, 1, UPB_MAX_HIDDEN},
                 {"skip", net->skip, 0, 1},
                 {"slope", net->slope, 0, 32767},
                 {"k", net->k, 0, 16},
                 {"j", net->j, 0, 16},
                 {"t", net->t, 0, 24}};
    for (unsigned i = 0; i < sizeof range / sizeof range[0]; i++)
        if (range[i].value < range[i].least || range[i].value > range[i].most)
            return fail(failure, range[i].name, 0, range[i].value, range[i].most);
    /* int8 has eight bits of the shift in its weights. */
    const uint32_t k = precision == UPB_PRECISION_INT16 ? net->k : net->k > 8 ? net->k - 8 : 0;
    if ((uint64_t)largest << k > 65535)
        return fail(failure, "largest input << k", 0, (int64_t)largest << k, 65535);
    if ((uint64_t)largest << net->j > 65535)
        return fail(failure, "largest input << j", 0, (int64_t)largest << net->j, 65535);
    return 1;
}

int upb_network_int_prove(const upb_network_int *net, upb_precision precision, uint32_t largest, uint32_t difference,
                          upb_int_failure *failure) {
    if (!parameters_in_range(net, precision, largest, failure))
        return 0;
    const int64_t code = largest_code(precision, difference) * ((int64_t)1 << net->k);
    const int64_t minimum = (int64_t)largest << net->j;
    int64_t output_low = net->offset, output_high = net->offset;
    for (uint32_t h = 0; h < net->hidden; h++) {
        const int32_t m = net->weight[h][UPB_TAP_MINIMUM];
        int64_t low = (m < 0 ? m : 0) * minimum + net->bias[h], high = at_least_0(m) * minimum + net->bias[h];
        for (int i = 0; i < UPB_TAP_MINIMUM; i++) {
            const int32_t w = net->weight[h][i];
            low += (w < 0 ? w : 0) * code;
            high += at_least_0(w) * code;
        }
        if (low < INT32_MIN)
            return fail(failure, "S low", h, low, INT32_MIN);
        if (high + half_of(16) > INT32_MAX)
            return fail(failure, "S high", h, high, (int64_t)INT32_MAX - half_of(16));
        const int64_t z_low = net->output[h] * rectified(low, net->slope);
        const int64_t z_high = net->output[h] * rectified(high, net->slope);
        output_low += z_low < z_high ? z_low : z_high;
        output_high += z_low < z_high ? z_high : z_low;
    }
    const int64_t limit = (int64_t)1 << 30;
    if (output_low < -limit)
        return fail(failure, "Y low", 0, output_low, -limit);
    if (output_high + half_of(net->t) >= limit)
        return fail(failure, "Y high", 0, output_high, limit - 1 - half_of(net->t));
    return 1;
}
