/* A model file while it is read: bounded access, and reports that name the field. */
#ifndef UPB_READER_H
#define UPB_READER_H

#include <string.h>

#include "upb_internal.h"

#define UPB_TAG(a, b, c, d) ((uint32_t)(a) | (uint32_t)(b) << 8 | (uint32_t)(c) << 16 | (uint32_t)(d) << 24)

typedef struct upb_section {
    uint32_t tag, flags, offset, bytes;
} upb_section;

typedef struct upb_reader {
    const uint8_t *bytes;
    size_t size;
    upb_error *error;
} upb_reader;

/* Bytes one by one: a file may lie at any address, and the machine may be big-endian. */
static inline uint32_t upb_u16_at(const upb_reader *r, size_t at) {
    return (uint32_t)r->bytes[at] | (uint32_t)r->bytes[at + 1] << 8;
}

static inline uint32_t upb_u32_at(const upb_reader *r, size_t at) {
    return upb_u16_at(r, at) | upb_u16_at(r, at + 2) << 16;
}

/* Two's complement on every machine that has the type; a conversion would be up to the compiler. */
static inline int32_t upb_i32_at(const upb_reader *r, size_t at) {
    const uint32_t bits = upb_u32_at(r, at);
    int32_t value;
    memcpy(&value, &bits, sizeof value);
    return value;
}

static inline int16_t upb_i16_at(const upb_reader *r, size_t at) {
    const uint16_t bits = (uint16_t)upb_u16_at(r, at);
    int16_t value;
    memcpy(&value, &bits, sizeof value);
    return value;
}

static inline int8_t upb_i8_at(const upb_reader *r, size_t at) {
    int8_t value;
    memcpy(&value, &r->bytes[at], sizeof value);
    return value;
}

/* Reports UPB_E_VALUE, and returns it. `what` is the field's name. */
upb_status upb_bad_value(const upb_reader *r, const char *what, size_t at, uint64_t got, uint64_t expected);

/* upb_bad_value() with `what` (at most 26 characters) followed by [index]; index <= 999 */
upb_status upb_bad_element(const upb_reader *r, const char *what, unsigned index, size_t at, uint64_t got,
                           uint64_t expected);

/* An u32 within low..high. A value out of range is reported with the limit that it crosses. */
upb_status upb_ranged(const upb_reader *r, const char *what, size_t at, uint32_t low, uint32_t high, uint32_t *value);

/* Appends `[index]` to the zero terminated `text`, which has room. index <= 999 */
void upb_append_index(char *text, unsigned index);

/* Reads `Q16 ` or `Q8  ` into model->integer[], which is zeroed; SENS has been read. */
upb_status upb_read_integer(const upb_reader *r, const upb_section *s, upb_precision precision, upb_model *model);

#endif /* UPB_READER_H */
