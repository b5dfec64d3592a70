/* Sections `Q16 ` and `Q8  ` of a model file: the integer networks (docs/model-format.md, docs/numeric-contract.md). */
#include "upb_network_int.h"
#include "upb_reader.h"

enum {
    CONTRACT_BYTES = 32,
    HEAD_BYTES = CONTRACT_BYTES + 4, /* and the number of networks */
    NETWORK_HEAD_BYTES = 28,
    OFFSET_AT = 24, /* of C in it */
    WEIGHTS = 6,
    CODE_BITS = 8, /* of a difference in int8: it has so much room more */
    MAX_SHIFT_IN = 16,
    MAX_SHIFT_OUT = 24,
    INTENSITY_MAX = 255
};

static const char precision_name[UPB_PRECISIONS][4] = {"", "Q16", "Q8"};
static const char network_name[2][12] = {".distance.", ".intensity."};

/* One network of a section while it is read. */
typedef struct network_reader {
    const upb_reader *file;
    upb_precision precision;
    unsigned which;              /* UPB_DISTANCE, UPB_INTENSITY */
    uint32_t largest;            /* X of the contract: the largest input */
    uint32_t largest_difference; /* D */
    upb_network_int *net;
} network_reader;

/* Writes "Q16.distance.field" to `text`, cut to fit. */
static const char *full_name(char text[32], const network_reader *n, const char *field) {
    const char *const parts[] = {precision_name[n->precision], network_name[n->which], field};
    size_t length = 0;
    for (unsigned i = 0; i < 3; i++)
        for (const char *from = parts[i]; *from && length < 31; from++)
            text[length++] = *from;
    text[length] = 0;
    return text;
}

static upb_status bad_field(const network_reader *n, const char *field, size_t at, uint64_t got, uint64_t expected) {
    char text[32];
    return upb_bad_value(n->file, full_name(text, n, field), at, got, expected);
}

static upb_status ranged_field(const network_reader *n, const char *field, size_t at, uint32_t low, uint32_t high,
                               uint32_t *value) {
    char text[32];
    return upb_ranged(n->file, full_name(text, n, field), at, low, high, value);
}

static uint32_t bit_length(uint32_t value) {
    uint32_t bits = 0;
    for (; value; value >>= 1)
        bits++;
    return bits;
}

/* The largest left shift, at most MAX_SHIFT_IN, with which an input fits 16 bits. */
static uint32_t largest_shift(uint32_t largest_input) {
    const uint32_t room = 16 - bit_length(largest_input);
    return room < MAX_SHIFT_IN ? room : MAX_SHIFT_IN;
}

static upb_status read_head(const network_reader *n, size_t at) {
    upb_network_int *net = n->net;
    uint32_t slope;
    const uint32_t shift_max = largest_shift(n->largest);
    const uint32_t k_room = n->precision == UPB_PRECISION_INT16 ? shift_max : shift_max + CODE_BITS;
    const uint32_t k_max = k_room < MAX_SHIFT_IN ? k_room : MAX_SHIFT_IN;
    upb_status status;
    if ((status = ranged_field(n, "hidden", at, 1, UPB_MAX_HIDDEN, &net->hidden)) != UPB_OK ||
        (status = ranged_field(n, "skip", at + 4, 0, 1, &net->skip)) != UPB_OK ||
        (status = ranged_field(n, "slope", at + 8, 0, 32767, &slope)) != UPB_OK ||
        (status = ranged_field(n, "k", at + 12, 0, k_max, &net->k)) != UPB_OK ||
        (status = ranged_field(n, "j", at + 16, 0, shift_max, &net->j)) != UPB_OK ||
        (status = ranged_field(n, "t", at + 20, 0, MAX_SHIFT_OUT, &net->t)) != UPB_OK)
        return status;
    net->slope = (int32_t)slope;
    net->offset = upb_i32_at(n->file, at + OFFSET_AT);
    return UPB_OK;
}

/* Bytes of a network of the file with `hidden` units, without padding. */
static size_t network_bytes(upb_precision precision, uint32_t hidden) {
    const size_t narrow = precision == UPB_PRECISION_INT8 ? 1 : 2;
    return NETWORK_HEAD_BYTES + hidden * (4 + 2 + (1 + WEIGHTS) * narrow);
}

/* The arrays behind the head. */
static void read_units(const network_reader *n, size_t at) {
    upb_network_int *net = n->net;
    const int wide = n->precision == UPB_PRECISION_INT16;
    const size_t hidden = net->hidden, narrow = wide ? 2 : 1;
    const size_t minimum = at + 4 * hidden, output = minimum + 2 * hidden, weight = output + narrow * hidden;
    for (size_t h = 0; h < hidden; h++) {
        net->bias[h] = upb_i32_at(n->file, at + 4 * h);
        net->weight[h][UPB_TAP_MINIMUM] = upb_i16_at(n->file, minimum + 2 * h);
        net->output[h] = wide ? upb_i16_at(n->file, output + 2 * h) : upb_i8_at(n->file, output + h);
        for (size_t i = 0; i < WEIGHTS; i++) {
            const size_t place = weight + narrow * (WEIGHTS * h + i);
            net->weight[h][i] = wide ? upb_i16_at(n->file, place) : upb_i8_at(n->file, place);
        }
    }
}

/* The proof of the contract. A sum that could overflow is named with its unit, and with the bound that it reaches. */
static upb_status prove(const network_reader *n, size_t at) {
    upb_int_failure failure;
    if (upb_network_int_prove(n->net, n->precision, n->largest, n->largest_difference, &failure))
        return UPB_OK;
    const uint64_t got = (uint64_t)failure.got, limit = (uint64_t)failure.limit;
    char text[32];
    if (failure.bound[0] != 'S')
        return bad_field(n, failure.bound[0] == 'Y' ? "Y" : failure.bound, at + OFFSET_AT, got, limit);
    return upb_bad_element(n->file, full_name(text, n, "S"), failure.unit, at + NETWORK_HEAD_BYTES + 4 * failure.unit,
                           got, limit);
}

/* Reads the network at `*at`, which ends before `end`, and moves `*at` behind it and its padding. */
static upb_status read_network(const network_reader *n, size_t *at, size_t end) {
    const size_t start = *at;
    if (end - start < NETWORK_HEAD_BYTES)
        return bad_field(n, "bytes", start, end - start, NETWORK_HEAD_BYTES);
    upb_status status = read_head(n, start);
    if (status != UPB_OK)
        return status;
    const size_t bytes = network_bytes(n->precision, n->net->hidden), padded = (bytes + 3) / 4 * 4;
    if (end - start < padded)
        return bad_field(n, "bytes", start, end - start, padded);
    read_units(n, start + NETWORK_HEAD_BYTES);
    for (*at = start + bytes; *at < start + padded; ++*at)
        if (n->file->bytes[*at])
            return bad_field(n, "padding", *at, n->file->bytes[*at], 0);
    if ((status = prove(n, start)) == UPB_OK)
        upb_network_int_finish(n->net, n->precision);
    return status;
}

/* The section's head: the contract's name, padded with zeros, and the number of networks. */
static upb_status read_section_head(const upb_reader *r, const upb_section *s, upb_precision precision) {
    static const char contract[UPB_PRECISIONS][CONTRACT_BYTES] = {"", "upbeam.int16.v1", "upbeam.int8.v1"};
    static const char contract_name[UPB_PRECISIONS][16] = {"", "Q16.contract", "Q8.contract"};
    static const char count_name[UPB_PRECISIONS][16] = {"", "Q16.count", "Q8.count"};
    static const char bytes_name[UPB_PRECISIONS][16] = {"", "Q16.bytes", "Q8.bytes"};
    uint32_t count;
    if (s->bytes < HEAD_BYTES)
        return upb_bad_value(r, bytes_name[precision], s->offset, s->bytes, HEAD_BYTES);
    for (unsigned i = 0; i < CONTRACT_BYTES; i++)
        if (r->bytes[s->offset + i] != (uint8_t)contract[precision][i])
            return upb_bad_value(r, contract_name[precision], s->offset + i, r->bytes[s->offset + i],
                                 (uint8_t)contract[precision][i]);
    return upb_ranged(r, count_name[precision], s->offset + CONTRACT_BYTES, 2, 2, &count);
}

upb_status upb_read_integer(const upb_reader *r, const upb_section *s, upb_precision precision, upb_model *model) {
    upb_model_info *info = &model->info;
    upb_status status = read_section_head(r, s, precision);
    size_t at = (size_t)s->offset + HEAD_BYTES;
    const size_t end = (size_t)s->offset + s->bytes;
    const uint32_t nearest = info->empty_rule == UPB_EMPTY_FILL ? info->min_count : 0;
    network_reader n = {.file = r, .precision = precision};
    for (n.which = UPB_DISTANCE; n.which <= UPB_INTENSITY && status == UPB_OK; n.which++) {
        n.largest = n.which == UPB_DISTANCE ? info->max_count : INTENSITY_MAX;
        n.largest_difference = n.which == UPB_DISTANCE ? info->max_count - nearest : INTENSITY_MAX;
        n.net = &model->integer[precision - UPB_PRECISION_INT16].network[n.which];
        status = read_network(&n, &at, end);
    }
    if (status != UPB_OK)
        return status;
    if (at != end) {
        n.which = UPB_INTENSITY;
        return bad_field(&n, "bytes", s->offset, s->bytes, at - s->offset);
    }
    info->precisions |= 1u << precision;
    info->weight_bytes[precision] = s->bytes - HEAD_BYTES;
    return UPB_OK;
}
