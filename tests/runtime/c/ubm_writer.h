/* Writes .ubm files for the tests, from docs/model-format.md and not from the reader's code. */
#ifndef UPB_TEST_UBM_WRITER_H
#define UPB_TEST_UBM_WRITER_H

#include <stdint.h>
#include <string.h>

#include "check.h"
#include "upbeam/upbeam.h"

/* One network as the file holds it: metres in and out (distance network). */
typedef struct test_network {
    uint32_t hidden, flags;
    float slope, skip;
    float a[UPB_MAX_HIDDEN][7], b[UPB_MAX_HIDDEN], v[UPB_MAX_HIDDEN];
    float c;
} test_network;

/* One integer network as the file holds it. */
typedef struct test_integer {
    uint32_t hidden, skip, slope, k, j, t;
    int32_t c, b[UPB_MAX_HIDDEN];
    int16_t m[UPB_MAX_HIDDEN], v[UPB_MAX_HIDDEN], w[UPB_MAX_HIDDEN][6];
} test_integer;

/* Everything in a file. */
typedef struct test_model {
    char sensor[32];
    uint32_t columns, unit_um, cut_mdeg, min_count, max_count;
    uint8_t edge, last_row, empty_rule;
    int32_t elevation[UPB_ROWS], offset[UPB_BEAMS], height[UPB_ROWS];
    uint16_t row_max[UPB_ROWS];
    test_network network[2];
    uint32_t precisions; /* bit 1 << upb_precision: the integer networks that the file gets */
    test_integer integer[UPB_PRECISIONS][2];
    uint32_t signed_with; /* not 0: the last section is SIGN, with signed_with - 1 bytes */
} test_model;

/* A section before SENS and NETW. */
typedef struct test_section {
    char tag[5];
    uint32_t flags, bytes;
    uint8_t fill;
} test_section;

enum { UBM_MAX = 16384 };

static inline void put_u16(uint8_t *at, uint32_t value) {
    at[0] = (uint8_t)value;
    at[1] = (uint8_t)(value >> 8);
}

static inline void put_u32(uint8_t *at, uint32_t value) {
    put_u16(at, value);
    put_u16(at + 2, value >> 16);
}

static inline uint8_t *append_u32(uint8_t *at, uint32_t value) {
    put_u32(at, value);
    return at + 4;
}

static inline uint8_t *append_floats(uint8_t *at, const float *values, size_t count) {
    for (size_t i = 0; i < count; i++) {
        uint32_t bits;
        memcpy(&bits, &values[i], sizeof bits);
        at = append_u32(at, bits);
    }
    return at;
}

static inline uint8_t *append_narrow(uint8_t *at, int16_t value, int narrow) {
    at[0] = (uint8_t)value;
    if (!narrow)
        at[1] = (uint8_t)((uint16_t)value >> 8);
    return at + (narrow ? 1 : 2);
}

/* The textbook CRC-32, one bit at a time. */
static inline uint32_t plain_crc32(const uint8_t *bytes, size_t size) {
    uint32_t crc = 0xffffffffu;
    for (size_t i = 0; i < size; i++) {
        crc ^= bytes[i];
        for (int bit = 0; bit < 8; bit++)
            crc = crc & 1 ? crc >> 1 ^ 0xedb88320u : crc >> 1;
    }
    return ~crc;
}

static inline void seal(uint8_t *file, size_t size) { put_u32(file + size - 4, plain_crc32(file, size - 4)); }

static inline size_t write_sens(uint8_t *at, const test_model *m) {
    memcpy(at, m->sensor, 32);
    put_u32(at + 32, UPB_BEAMS);
    put_u32(at + 36, m->columns);
    put_u32(at + 40, m->unit_um);
    put_u32(at + 44, m->cut_mdeg);
    put_u32(at + 48, m->min_count);
    put_u32(at + 52, m->max_count);
    at[56] = m->edge;
    at[57] = m->last_row;
    at[58] = m->empty_rule;
    for (int i = 0; i < 64; i++)
        put_u32(at + 64 + 4 * i, (uint32_t)m->elevation[i]);
    for (int i = 0; i < 32; i++)
        put_u32(at + 320 + 4 * i, (uint32_t)m->offset[i]);
    for (int i = 0; i < 64; i++)
        put_u32(at + 448 + 4 * i, (uint32_t)m->height[i]);
    for (int i = 0; i < 64; i += 2)
        put_u32(at + 704 + 2 * i, m->row_max[i] | (uint32_t)m->row_max[i + 1] << 16);
    return 832;
}

static inline size_t write_netw(uint8_t *start, const test_model *m) {
    uint8_t *at = append_u32(start, 2);
    for (int n = 0; n < 2; n++) {
        const test_network *net = &m->network[n];
        at = append_u32(at, net->hidden);
        at = append_u32(at, net->flags);
        at = append_floats(at, &net->slope, 1);
        at = append_floats(at, &net->skip, 1);
        for (uint32_t h = 0; h < net->hidden; h++)
            at = append_floats(at, net->a[h], 7);
        at = append_floats(at, net->b, net->hidden);
        at = append_floats(at, net->v, net->hidden);
        at = append_floats(at, &net->c, 1);
    }
    return (size_t)(at - start);
}

static inline size_t write_integer(uint8_t *start, const test_model *m, upb_precision precision) {
    const int narrow = precision == UPB_PRECISION_INT8;
    memcpy(start, narrow ? "upbeam.int8.v1" : "upbeam.int16.v1", narrow ? 14 : 15);
    uint8_t *at = append_u32(start + 32, 2);
    for (int n = 0; n < 2; n++) {
        const test_integer *net = &m->integer[precision][n];
        const uint32_t head[7] = {net->hidden, net->skip, net->slope, net->k, net->j, net->t, (uint32_t)net->c};
        for (int i = 0; i < 7; i++)
            at = append_u32(at, head[i]);
        for (uint32_t h = 0; h < net->hidden; h++)
            at = append_u32(at, (uint32_t)net->b[h]);
        for (uint32_t h = 0; h < net->hidden; h++, at += 2)
            put_u16(at, (uint16_t)net->m[h]);
        for (uint32_t h = 0; h < net->hidden; h++)
            at = append_narrow(at, net->v[h], narrow);
        for (uint32_t i = 0; i < 6 * net->hidden; i++)
            at = append_narrow(at, net->w[i / 6][i % 6], narrow);
        while ((at - start) % 4)
            *at++ = 0;
    }
    return (size_t)(at - start);
}

static inline size_t aligned8(size_t n) { return (n + 7) / 8 * 8; }

/* One section at `at`, an entry of the table for it; returns where it ends. */
static inline size_t write_section(uint8_t *file, uint32_t index, const char *tag, uint32_t flags, size_t at,
                                   size_t bytes) {
    uint8_t *entry = file + 32 + 16 * index;
    memcpy(entry, tag, 4);
    put_u32(entry + 4, flags);
    put_u32(entry + 8, (uint32_t)at);
    put_u32(entry + 12, (uint32_t)bytes);
    return aligned8(at + bytes);
}

static inline uint32_t bit(uint32_t bits, uint32_t n) { return bits >> n & 1; }

/* Writes a file into `file` (UBM_MAX zero bytes), `extra` sections first; returns its size. */
static inline size_t write_ubm(uint8_t *file, const test_model *m, const test_section *extra, uint32_t extras) {
    const uint32_t integers = bit(m->precisions, UPB_PRECISION_INT16) + bit(m->precisions, UPB_PRECISION_INT8);
    const uint32_t sections = extras + 2 + integers + (m->signed_with != 0);
    size_t at = aligned8(32 + 16 * sections);
    uint32_t i = 0;
    memset(file, 0, UBM_MAX);
    memcpy(file, "UPBM", 4);
    put_u16(file + 4, 1);
    put_u16(file + 6, 32);
    put_u32(file + 12, sections);
    for (; i < extras; i++) {
        memset(file + at, extra[i].fill, extra[i].bytes);
        at = write_section(file, i, extra[i].tag, extra[i].flags, at, extra[i].bytes);
    }
    at = write_section(file, i++, "SENS", 1, at, write_sens(file + at, m));
    at = write_section(file, i++, "NETW", 1, at, write_netw(file + at, m));
    if (bit(m->precisions, UPB_PRECISION_INT16))
        at = write_section(file, i++, "Q16 ", 0, at, write_integer(file + at, m, UPB_PRECISION_INT16));
    if (bit(m->precisions, UPB_PRECISION_INT8))
        at = write_section(file, i++, "Q8  ", 0, at, write_integer(file + at, m, UPB_PRECISION_INT8));
    if (m->signed_with) {
        memset(file + at, 0x5a, m->signed_with - 1);
        at = write_section(file, i++, "SIGN", 0, at, m->signed_with - 1);
    }
    put_u32(file + 8, (uint32_t)at + 4);
    seal(file, at + 4);
    return at + 4;
}

/*
 * A model with random weights of about the sizes that training gives: the output lies near the window's distances and
 * uses every tap. Distances are metres.
 */
static inline test_model random_model(random_source *random, uint32_t columns, uint32_t hidden) {
    test_model m;
    memset(&m, 0, sizeof m);
    memcpy(m.sensor, "test-32", 8);
    m.columns = columns;
    m.unit_um = 2000;
    m.cut_mdeg = 180000;
    m.min_count = 1500;
    m.max_count = 40000;
    m.edge = UPB_EDGE_SEAM;
    m.last_row = UPB_LAST_ROW_EMPTY;
    m.empty_rule = UPB_EMPTY_FILL;
    for (int i = 0; i < 64; i++)
        m.elevation[i] = 10000000 - 600000 * i, m.height[i] = 1000 * (32 - i),
        m.row_max[i] = (uint16_t)(random_below(random, 3) ? 40000 : 1500 + random_below(random, 38501));
    for (int n = 0; n < 2; n++) {
        test_network *net = &m.network[n];
        net->hidden = hidden;
        net->flags = (uint32_t)n;
        net->slope = 0.01f;
        net->skip = 0.0f;
        net->c = random_signed(random);
        for (uint32_t h = 0; h < hidden; h++) {
            for (int i = 0; i < 7; i++)
                net->a[h][i] = 0.5f * random_signed(random);
            net->b[h] = random_signed(random);
            net->v[h] = random_signed(random) / (float)hidden;
        }
    }
    return m;
}

/* -limit .. limit, and no more than 16 or 8 bits hold */
static inline int16_t random_weight(random_source *random, uint64_t limit, uint32_t most) {
    const uint32_t reach = limit < most ? (uint32_t)limit : most;
    return (int16_t)((int32_t)random_below(random, 2 * reach + 1) - (int32_t)reach);
}

/*
 * A random network that passes the contract's proof with `largest` as its largest input: the sum of a unit is at most
 * 7/8 of its 32 bits, one eighth for each term; the output's at most half of its 31.
 */
static inline test_integer random_integer(random_source *random, uint32_t hidden, upb_precision precision,
                                          uint32_t largest) {
    const uint32_t most = precision == UPB_PRECISION_INT8 ? 127 : 32767;
    const uint64_t eighth = 1u << 28;
    test_integer net;
    uint32_t room = 0;
    memset(&net, 0, sizeof net);
    while (largest << (room + 1) <= 65535)
        room++;
    net.hidden = hidden;
    net.skip = random_below(random, 2);
    net.slope = random_below(random, 3) ? random_below(random, 32768) : 0;
    net.j = random_below(random, room + 1);
    net.k = random_below(random, precision == UPB_PRECISION_INT8 ? 9 : room + 1);
    net.t = largest > 255 ? 10 + random_below(random, 6) : 17 + random_below(random, 4);
    net.c = (int32_t)random_below(random, 1u << 28) - (1 << 27);
    for (uint32_t h = 0; h < hidden; h++) {
        net.b[h] = (int32_t)random_below(random, 1u << 29) - (1 << 28);
        net.m[h] = random_weight(random, eighth / ((uint64_t)largest << net.j), 32767);
        net.v[h] = random_weight(random, (1u << 13) / hidden, most);
        for (int i = 0; i < 6; i++)
            net.w[h][i] = random_weight(random, eighth * 9 / 10 / ((uint64_t)largest << net.k), most);
    }
    return net;
}

/* Gives a model random integer networks of both precisions. */
static inline void add_integers(random_source *random, test_model *m, uint32_t hidden) {
    m->precisions = 1u << UPB_PRECISION_INT16 | 1u << UPB_PRECISION_INT8;
    for (int p = UPB_PRECISION_INT16; p <= UPB_PRECISION_INT8; p++)
        for (int n = 0; n < 2; n++)
            m->integer[p][n] = random_integer(random, hidden, (upb_precision)p, n ? 255 : m->max_count);
}

#endif /* UPB_TEST_UBM_WRITER_H */
