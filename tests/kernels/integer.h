/*
 * Integer kernels: the plain C one against docs/numeric-contract.md worked out anew in 64 bits, every other one against
 * the plain C one, to the bit; and the proof against overflow. Part of checkkernels.
 */
#ifndef UPB_TEST_INTEGER_H
#define UPB_TEST_INTEGER_H

#include "columns.h"
#include "upb_network_int.h"

/* A model as a file has it, and as kernels take it. */
typedef struct int_model {
    upb_precision precision;
    uint32_t max_count;
    upb_network_int file[2];
    upb_model_int ready;
} int_model;

typedef struct int_result {
    uint16_t distance[UPB_LANES];
    uint8_t intensity[UPB_LANES];
} int_result;

/* What is compared, for a failure's message. */
typedef struct int_parameters {
    unsigned long seed;
    unsigned round;
    const char *cpu_name, *pattern;
    const int_model *model;
} int_parameters;

/* -------------------------------------------------------------------------------------- the contract anew */

static int64_t floor_shift(int64_t a, uint32_t n) {
    const int64_t step = (int64_t)1 << n;
    return a >= 0 ? a / step : -((-a + step - 1) / step);
}

static int64_t half_up(int64_t a, uint32_t n) { return n ? floor_shift(a + ((int64_t)1 << (n - 1)), n) : a; }

/* All steps of one network; checks that nothing leaves the type that the contract gives it. */
static int64_t expected_network(const upb_network_int *file, upb_precision precision, const uint16_t x[6],
                                upb_int_trace *trace) {
    int64_t m = x[0], most = 0, d[6], q[6], s = 0;
    for (int i = 0; i < 6; i++)
        m = x[i] < m ? x[i] : m;
    for (int i = 0; i < 6; i++) {
        d[i] = x[i] - m;
        most = d[i] > most ? d[i] : most;
    }
    if (precision == UPB_PRECISION_INT8)
        while (most >= (int64_t)256 << s)
            s++;
    int64_t Y = file->offset;
    for (int i = 0; i < 6; i++) {
        q[i] = half_up(d[i], (uint32_t)s);
        if (precision == UPB_PRECISION_INT8 && q[i] > 255)
            q[i] = 255;
        trace->difference[i] = (uint16_t)d[i];
        trace->code[i] = (uint16_t)q[i];
    }
    for (uint32_t h = 0; h < file->hidden; h++) {
        int64_t S = 0;
        for (int i = 0; i < 6; i++)
            S += file->weight[h][i] * q[i];
        S = S * ((int64_t)1 << ((uint32_t)s + file->k)) +
            file->weight[h][UPB_TAP_MINIMUM] * m * ((int64_t)1 << file->j) + file->bias[h];
        const int64_t a = half_up(S, 16), bent = half_up(a * file->slope, 15), z = a > bent ? a : bent;
        CHECK(S >= INT32_MIN && S <= INT32_MAX && a >= INT16_MIN && a <= INT16_MAX);
        Y += file->output[h] * z;
        trace->sum[h] = (int32_t)S;
        trace->hidden[h] = (int16_t)a;
        trace->rectified[h] = (int16_t)z;
    }
    CHECK(Y >= -(1 << 30) && Y < 1 << 30);
    trace->minimum = (uint16_t)m;
    trace->shift = (uint32_t)s;
    trace->output = (int32_t)Y;
    trace->rounded = (int32_t)half_up(Y, file->t);
    trace->value = trace->rounded + (file->skip ? (int32_t)m : 0);
    return trace->value;
}

/* One column of a window after the range limits and the first half of the fill: top, bottom. */
static void expected_pair(uint16_t pair[2], uint16_t value[2], const int_model *model, const raw_column *column,
                          unsigned k, int which) {
    int valid[2];
    for (unsigned r = 0; r < 2; r++) {
        const uint16_t count = column->distance[k + r];
        valid[r] = count >= model->ready.min_count && count <= model->ready.seen_max[k + r];
        value[r] = !valid[r] ? 0 : which == UPB_DISTANCE ? count : column->intensity[k + r];
    }
    pair[0] = model->ready.fill && !valid[0] ? value[1] : value[0];
    pair[1] = model->ready.fill && !valid[1] ? value[0] : value[1];
    value[0] = value[1] = valid[0] || valid[1];
}

/* Window k: its six pixels; returns whether any of them is valid. */
static int expected_window(uint16_t x[6], const int_model *model, const raw_column column[3], unsigned k, int which) {
    uint16_t pair[3][2], has[3][2];
    for (int c = 0; c < 3; c++)
        expected_pair(pair[c], has[c], model, &column[c], k, which);
    const int l = has[0][0], m = has[1][0], r = has[2][0];
    for (int row = 0; row < 2; row++) {
        const uint16_t left = pair[0][row], middle = pair[1][row], right = pair[2][row];
        uint16_t *out = x + 3 * row;
        out[0] = left, out[1] = middle, out[2] = right;
        if (!model->ready.fill)
            continue;
        if (!l)
            out[0] = m ? middle : right;
        if (!r)
            out[2] = m ? middle : left;
        if (!m)
            out[1] = l && r ? (left < right ? left : right) : l ? left : right;
    }
    return l || m || r;
}

static void check_trace(const int_model *model, int which, const uint16_t x[6], upb_int_trace *expected) {
    upb_int_trace got;
    const upb_network_int *file = &model->file[which];
    upb_trace_int(&model->ready.network[which], model->precision, x, &got);
    CHECK(got.minimum == expected->minimum && got.shift == expected->shift && got.output == expected->output &&
          got.rounded == expected->rounded && got.value == expected->value);
    CHECK(!memcmp(got.difference, expected->difference, sizeof got.difference));
    CHECK(!memcmp(got.code, expected->code, sizeof got.code));
    CHECK(!memcmp(got.sum, expected->sum, file->hidden * sizeof got.sum[0]));
    CHECK(!memcmp(got.hidden, expected->hidden, file->hidden * sizeof got.hidden[0]));
    CHECK(!memcmp(got.rectified, expected->rectified, file->hidden * sizeof got.rectified[0]));
}

static void expected_result(const int_model *model, const raw_column column[3], int_result *out) {
    for (unsigned k = 0; k < UPB_WINDOWS; k++) {
        uint16_t x[6];
        int64_t y[2];
        int seen = 0;
        for (int which = 1; which >= 0; which--) {
            upb_int_trace trace;
            seen = expected_window(x, model, column, k, which);
            y[which] = expected_network(&model->file[which], model->precision, x, &trace);
            check_trace(model, which, x, &trace);
        }
        const int given =
            y[0] >= model->ready.min_count && y[0] <= model->ready.given_max[k] && (seen || !model->ready.fill);
        out->distance[k] = given ? (uint16_t)y[0] : 0;
        out->intensity[k] = (uint8_t)(!given || y[1] < 0 ? 0 : y[1] > 255 ? 255 : y[1]);
    }
}

/* ------------------------------------------------------------------------------------------ random models */

/* A number of at most `bits` bits and a sign, all magnitudes alike. */
static int32_t random_of_bits(random_source *random, uint32_t bits) {
    const uint32_t used = random_below(random, bits + 1);
    const int64_t value = used ? (int64_t)(random_u32(random) >> (32 - used)) : 0;
    return (int32_t)(random_below(random, 2) ? value : -value - (used == bits));
}

static void random_int_network(random_source *random, upb_network_int *net, upb_precision precision, uint32_t hidden,
                               uint32_t largest) {
    static const int32_t slopes[] = {0, 256, 328, 32767};
    const uint32_t narrow = precision == UPB_PRECISION_INT8 ? 7 : 15;
    uint32_t room = 0;
    while (largest << (room + 1) <= 65535 && room < 16)
        room++;
    const uint32_t k_most = precision == UPB_PRECISION_INT16 ? room : room < 8 ? room + 8 : 16;
    memset(net, (int)random_below(random, 256), sizeof *net); /* what the file does not say may be anything */
    net->hidden = hidden;
    net->skip = random_below(random, 3) > 0;
    net->slope = random_below(random, 5) ? slopes[random_below(random, 4)] : (int32_t)random_below(random, 32768);
    net->k = random_below(random, k_most + 1);
    net->j = random_below(random, room + 1);
    net->t = random_below(random, 25);
    net->offset = random_of_bits(random, 29);
    for (uint32_t h = 0; h < hidden; h++) {
        for (int i = 0; i < UPB_TAP_MINIMUM; i++)
            net->weight[h][i] = (int16_t)random_of_bits(random, narrow);
        net->weight[h][UPB_TAP_MINIMUM] = (int16_t)random_of_bits(random, 15);
        net->bias[h] = random_of_bits(random, 31);
        net->output[h] = (int16_t)random_of_bits(random, narrow);
    }
}

/* A little less of a unit's sum. */
static void shrink_unit(upb_network_int *net, uint32_t h) {
    for (int i = 0; i < UPB_TAPS; i++)
        net->weight[h][i] = (int16_t)(net->weight[h][i] * 31 / 32);
    net->bias[h] = (int32_t)(net->bias[h] * (int64_t)31 / 32);
}

/* Makes the network just pass the proof. */
static void shrink_to_proof(upb_network_int *net, upb_precision precision, uint32_t largest, uint32_t difference) {
    upb_int_failure failure;
    while (!upb_network_int_prove(net, precision, largest, difference, &failure)) {
        if (!CHECK(failure.bound[0] == 'S' || failure.bound[0] == 'Y'))
            return;
        if (failure.bound[0] == 'S')
            shrink_unit(net, failure.unit);
        else {
            net->offset = (int32_t)(net->offset * (int64_t)31 / 32);
            for (uint32_t h = 0; h < net->hidden; h++)
                net->output[h] = (int16_t)(net->output[h] * 31 / 32);
        }
    }
}

/* Outputs near what decides: nothing, the limits low and high, the end of 16 bits. */
static void aim_output(random_source *random, upb_network_int *net, uint32_t low, uint32_t high) {
    const uint32_t aims[] = {0, low, high, 65535 + random_below(random, 2), 65536 + random_below(random, 4096)};
    net->t = random_below(random, 12);
    net->offset = (int32_t)(aims[random_below(random, 5)] << net->t);
    const int divisor = 1 << random_below(random, 15);
    for (uint32_t h = 0; h < net->hidden; h++)
        net->output[h] = (int16_t)(net->output[h] / divisor);
}

static void random_int_model(random_source *random, int_model *model, upb_precision precision, uint32_t hidden,
                             int is_aimed) {
    upb_model_int *ready = &model->ready;
    const int is_widest = random_below(random, 4) == 0;
    const uint32_t low = is_widest ? 1 : 1 + random_below(random, 3000);
    const uint32_t high = is_widest ? 65535 : low + random_below(random, 65536 - low);
    memset(model, 0, sizeof *model);
    model->precision = precision;
    model->max_count = high;
    ready->min_count = (uint16_t)low;
    ready->fill = (uint16_t)random_below(random, 2);
    for (unsigned k = 0; k < UPB_LANES; k++) {
        const uint32_t seen = random_below(random, high - low + 1), given = random_below(random, high - low + 1);
        ready->seen_max[k] = (uint16_t)(random_below(random, 2) ? high : low + seen);
        ready->given_max[k] = (uint16_t)(random_below(random, 2) ? high : low + given);
    }
    for (int which = 0; which < 2; which++) {
        const uint32_t largest = which == UPB_DISTANCE ? high : 255;
        const uint32_t difference = which == UPB_DISTANCE && ready->fill ? high - low : largest;
        upb_network_int *file = &model->file[which];
        random_int_network(random, file, precision, which ? 1 + random_below(random, UPB_MAX_HIDDEN) : hidden, largest);
        if (is_aimed)
            aim_output(random, file, which ? 0 : low, which ? 255 : high);
        shrink_to_proof(file, precision, largest, difference);
        ready->network[which] = *file;
        upb_network_int_finish(&ready->network[which], precision);
    }
}

/* --------------------------------------------------------------------------------------------- comparison */

static void run_int(const upb_kernels *kernels, const int_model *model, const raw_column column[3], int_result *out) {
    upb_prepared_int prepared[3];
    for (int c = 0; c < 3; c++)
        kernels->prepare_int(&prepared[c], &model->ready, column[c].distance, column[c].intensity);
    (model->precision == UPB_PRECISION_INT8 ? kernels->windows_int8 : kernels->windows_int16)(
        &model->ready, &prepared[0], &prepared[1], &prepared[2], out->distance, out->intensity);
}

static void compare_results(const int_parameters *p, const int_result *got, const int_result *expected) {
    for (unsigned k = 0; k < UPB_WINDOWS; k++) {
        if (CHECK(got->distance[k] == expected->distance[k] && got->intensity[k] == expected->intensity[k]) ||
            check_failures > 20)
            continue;
        const int_model *model = p->model;
        fprintf(stderr, "    lane %u: distance %u, intensity %u; expected %u, %u\n", k, got->distance[k],
                got->intensity[k], expected->distance[k], expected->intensity[k]);
        fprintf(stderr, "    kernel %s %s, --seed %lu, round %u, columns %s, hidden %u and %u, k %u and %u, fill %u\n",
                p->cpu_name, model->precision == UPB_PRECISION_INT8 ? "int8" : "int16", p->seed, p->round, p->pattern,
                model->file[0].hidden, model->file[1].hidden, model->file[0].k, model->file[1].k, model->ready.fill);
    }
}

static unsigned long long int_windows, int_returns;

/* Every kernel of this machine on the same three columns. */
static void compare_int(int_parameters *p, const raw_column column[3]) {
    int_result expected, got;
    upb_kernels kernels;
    memset(&expected, 0, sizeof expected);
    expected_result(p->model, column, &expected);
    for (int cpu = UPB_CPU_SCALAR; cpu <= LAST_CPU; cpu++) {
        if (upb_kernels_select(&kernels, (upb_cpu)cpu) != (upb_cpu)cpu)
            continue;
        run_int(&kernels, p->model, column, &got);
        p->cpu_name = cpu_names[cpu];
        compare_results(p, &got, &expected);
    }
    int_windows += UPB_WINDOWS;
    for (unsigned k = 0; k < UPB_WINDOWS; k++)
        int_returns += expected.distance[k] != 0;
}

/* A random model: every pattern in the middle beside every pattern on its left, and any one on its right. */
static void check_int_round(int_parameters *p, random_source *random, upb_precision precision) {
    static int_model model;
    random_int_model(random, &model, precision, 1 + p->round / 2 % UPB_MAX_HIDDEN, p->round % 2);
    p->model = &model;
    for (unsigned i = 0; i < PATTERNS * PATTERNS; i++) {
        raw_column column[3];
        const unsigned pattern[3] = {i / PATTERNS, i % PATTERNS, random_below(random, PATTERNS)};
        for (int c = 0; c < 3; c++)
            pattern_column(random, pattern[c], model.ready.min_count, model.max_count, &column[c]);
        p->pattern = patterns[pattern[1]];
        compare_int(p, column);
    }
}

/* ---------------------------------------------------------------------------------------------- the proof */

/* A network of one unit that passes: W = 1, everything else 0. */
static upb_network_int plain_network(void) {
    upb_network_int net;
    memset(&net, 0, sizeof net);
    net.hidden = 1;
    net.weight[0][0] = 1;
    return net;
}

static void check_refused(const upb_network_int *net, upb_precision precision, uint32_t largest, const char *bound) {
    upb_int_failure failure = {.bound = "nothing"};
    CHECK(!upb_network_int_prove(net, precision, largest, largest, &failure));
    if (!CHECK(!strcmp(failure.bound, bound)))
        fprintf(stderr, "    refused for %s, expected %s\n", failure.bound, bound);
    CHECK(!upb_network_int_prove(net, precision, largest, largest, NULL));
}

static int proves(const upb_network_int *net, upb_precision precision, uint32_t largest) {
    return upb_network_int_prove(net, precision, largest, largest, NULL);
}

/* Each bound of the contract: the last value that passes, and the first that does not. */
static void check_proof(void) {
    upb_network_int net = plain_network();
    CHECK(proves(&net, UPB_PRECISION_INT16, 65535) && proves(&net, UPB_PRECISION_INT8, 65535));
    net.hidden = 33, check_refused(&net, UPB_PRECISION_INT16, 255, "hidden");
    net.hidden = 0, check_refused(&net, UPB_PRECISION_INT16, 255, "hidden");
    net = plain_network(), net.skip = 2, check_refused(&net, UPB_PRECISION_INT8, 255, "skip");
    net = plain_network(), net.slope = 32768, check_refused(&net, UPB_PRECISION_INT8, 255, "slope");
    net = plain_network(), net.t = 25, check_refused(&net, UPB_PRECISION_INT8, 255, "t");
    net = plain_network(), net.k = 17, check_refused(&net, UPB_PRECISION_INT8, 1, "k");
    net = plain_network(), net.j = 17, check_refused(&net, UPB_PRECISION_INT8, 1, "j");
    net = plain_network(), net.k = 8, CHECK(proves(&net, UPB_PRECISION_INT16, 255));
    check_refused(&net, UPB_PRECISION_INT16, 256, "largest input << k");
    net.k = 16, CHECK(proves(&net, UPB_PRECISION_INT8, 255));
    check_refused(&net, UPB_PRECISION_INT8, 256, "largest input << k");
    net = plain_network(), net.j = 1, CHECK(proves(&net, UPB_PRECISION_INT8, 32767));
    check_refused(&net, UPB_PRECISION_INT8, 32768, "largest input << j");

    net = plain_network(); /* 2^31 - 1 - 2^15 = 60000 + bias */
    net.bias[0] = INT32_MAX - 32768 - 60000, CHECK(proves(&net, UPB_PRECISION_INT16, 60000));
    CHECK(!proves(&net, UPB_PRECISION_INT8, 60000)); /* codes reach 60128 */
    net.bias[0]++, check_refused(&net, UPB_PRECISION_INT16, 60000, "S high");
    net.bias[0] = INT32_MAX - 32768 - 60128, CHECK(proves(&net, UPB_PRECISION_INT8, 60000));
    net.bias[0]++, check_refused(&net, UPB_PRECISION_INT8, 60000, "S high");
    net = plain_network(), net.weight[0][0] = 0, net.weight[0][UPB_TAP_MINIMUM] = -2, net.j = 3;
    net.bias[0] = INT32_MIN + 16 * 1000, CHECK(proves(&net, UPB_PRECISION_INT16, 1000));
    net.bias[0]--, check_refused(&net, UPB_PRECISION_INT16, 1000, "S low");

    net = plain_network(), net.offset = (1 << 30) - 1, CHECK(proves(&net, UPB_PRECISION_INT16, 255));
    net.t = 1, check_refused(&net, UPB_PRECISION_INT16, 255, "Y high");
    net.offset--, CHECK(proves(&net, UPB_PRECISION_INT16, 255));
    net.offset = -(1 << 30), CHECK(proves(&net, UPB_PRECISION_INT16, 255));
    net.offset--, check_refused(&net, UPB_PRECISION_INT16, 255, "Y low");
    net = plain_network(), net.bias[0] = -200 * 65536, net.weight[0][0] = 0, net.slope = 16384; /* z = -100 */
    net.output[0] = 7, net.offset = -(1 << 30) + 700, CHECK(proves(&net, UPB_PRECISION_INT16, 255));
    net.offset--, check_refused(&net, UPB_PRECISION_INT16, 255, "Y low");
    net = plain_network(), net.weight[0][0] = -512, net.slope = 16384, net.output[0] = -100; /* z = -2..0 */
    net.offset = (1 << 30) - 1 - 200, CHECK(proves(&net, UPB_PRECISION_INT16, 512));
    net.offset++, check_refused(&net, UPB_PRECISION_INT16, 512, "Y high");
    net = plain_network(), net.weight[0][0] = 512, net.output[0] = -100; /* z = 0..4 */
    net.offset = -(1 << 30) + 400, CHECK(proves(&net, UPB_PRECISION_INT16, 512));
    net.offset--, check_refused(&net, UPB_PRECISION_INT16, 512, "Y low");
}

static void check_integers(unsigned long seed, unsigned rounds, random_source *random) {
    int_parameters p = {.seed = seed};
    check_proof();
    for (p.round = 0; p.round < rounds; p.round++) {
        check_int_round(&p, random, UPB_PRECISION_INT16);
        check_int_round(&p, random, UPB_PRECISION_INT8);
    }
    printf("%llu windows of integer networks compared, %llu with a return\n", int_windows, int_returns);
    if (rounds >= UPB_MAX_HIDDEN) /* random models: neither all nor none of them give returns */
        CHECK(int_returns * 50 >= int_windows && int_returns * 50 <= int_windows * 49);
}

#endif /* UPB_TEST_INTEGER_H */
