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

/* Everything in a file. */
typedef struct test_model {
    char sensor[32];
    uint32_t columns, unit_um, cut_mdeg, min_count, max_count;
    uint8_t edge, last_row, empty_rule;
    int32_t elevation[UPB_ROWS], offset[UPB_BEAMS], height[UPB_ROWS];
    uint16_t row_max[UPB_ROWS];
    test_network network[2];
} test_model;

/* A section beside SENS and NETW. */
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

static inline size_t aligned8(size_t n) { return (n + 7) / 8 * 8; }

/* Writes a file into `file` (UBM_MAX zero bytes), `extra` sections first; returns its size. */
static inline size_t write_ubm(uint8_t *file, const test_model *m, const test_section *extra, uint32_t extras) {
    const uint32_t sections = extras + 2;
    size_t at = 32 + 16 * sections;
    memset(file, 0, UBM_MAX);
    memcpy(file, "UPBM", 4);
    put_u16(file + 6, 32);
    put_u32(file + 12, sections);
    for (uint32_t i = 0; i < sections; i++) {
        uint8_t *entry = file + 32 + 16 * i;
        size_t bytes;
        at = aligned8(at);
        if (i < extras) {
            memset(file + at, extra[i].fill, extra[i].bytes);
            bytes = extra[i].bytes;
        } else
            bytes = i == extras ? write_sens(file + at, m) : write_netw(file + at, m);
        memcpy(entry, i < extras ? extra[i].tag : i == extras ? "SENS" : "NETW", 4);
        put_u32(entry + 4, i < extras ? extra[i].flags : 1);
        put_u32(entry + 8, (uint32_t)at);
        put_u32(entry + 12, (uint32_t)bytes);
        at += bytes;
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

#endif /* UPB_TEST_UBM_WRITER_H */
