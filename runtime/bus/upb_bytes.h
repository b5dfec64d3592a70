/* Numbers as bytes: `le` least significant byte first, `be` most significant first. Used inside the bus library only.
 */
#ifndef UPB_BYTES_H
#define UPB_BYTES_H

#include <stddef.h>
#include <stdint.h>

static inline void upb_put_le(uint8_t *bytes, uint64_t value, size_t count) {
    for (size_t i = 0; i < count; i++)
        bytes[i] = (uint8_t)(value >> 8 * i);
}

static inline void upb_put_be(uint8_t *bytes, uint64_t value, size_t count) {
    for (size_t i = 0; i < count; i++)
        bytes[count - 1 - i] = (uint8_t)(value >> 8 * i);
}

static inline uint64_t upb_get_le(const uint8_t *bytes, size_t count) {
    uint64_t value = 0;
    for (size_t i = 0; i < count; i++)
        value |= (uint64_t)bytes[i] << 8 * i;
    return value;
}

static inline uint64_t upb_get_be(const uint8_t *bytes, size_t count) {
    uint64_t value = 0;
    for (size_t i = 0; i < count; i++)
        value = value << 8 | bytes[i];
    return value;
}

#endif /* UPB_BYTES_H */
