/* How packets lie in bytes: places, flags, little-endian numbers. Shared by the codecs, not installed. */
#ifndef UPBEAM_PACKET_WIRE_H
#define UPBEAM_PACKET_WIRE_H

#include "upbeam/packets.h"

#define WIRE_BLOCK_BYTES 100u
#define WIRE_BLOCK_LASERS 32u
#define WIRE_RETURNS_AT 4u /* in a block: after flag and azimuth */
#define WIRE_RETURN_BYTES 3u
#define WIRE_TIME_AT 1200u
#define WIRE_RETURN_MODE_AT 1204u /* an HDL-64E's status type */
#define WIRE_MODEL_AT 1205u       /* and value */
#define WIRE_UPPER 0xEEFFu
#define WIRE_LOWER 0xDDFFu
#define WIRE_THIRD 0xCCFFu /* a VLS-128's */
#define WIRE_FULL_TURN_CDEG 36000u
#define WIRE_HOUR_US 3600000000u

#define WIRE_POSITION_TIME_AT 198u

static inline uint32_t wire_get16(const uint8_t *p) { return (uint32_t)p[0] | (uint32_t)p[1] << 8; }

static inline uint32_t wire_get32(const uint8_t *p) { return wire_get16(p) | wire_get16(p + 2) << 16; }

static inline void wire_put16(uint8_t *p, uint32_t value) {
    p[0] = (uint8_t)(value & 0xFFu);
    p[1] = (uint8_t)(value >> 8 & 0xFFu);
}

static inline void wire_put32(uint8_t *p, uint32_t value) {
    wire_put16(p, value & 0xFFFFu);
    wire_put16(p + 2, value >> 16);
}

static inline const uint8_t *wire_block(const uint8_t *packet, uint32_t block) {
    return packet + WIRE_BLOCK_BYTES * block;
}

/* Azimuth of a block, 0.01 degrees. */
static inline uint32_t wire_azimuth(const uint8_t *packet, uint32_t block) {
    return wire_get16(wire_block(packet, block) + 2);
}

/* From one azimuth to another the short way round, 0.01 degrees, -18000..17999. */
static inline int32_t wire_turn(uint32_t from_cdeg, uint32_t to_cdeg) {
    const uint32_t half = WIRE_FULL_TURN_CDEG / 2;
    return (int32_t)((to_cdeg + WIRE_FULL_TURN_CDEG + half - from_cdeg) % WIRE_FULL_TURN_CDEG) - (int32_t)half;
}

/* True for the sensors of which two series share one packet. */
static inline int wire_is_hdl64e(upb_sensor sensor) {
    return sensor == UPB_SENSOR_HDL_64E_S2 || sensor == UPB_SENSOR_HDL_64E_S3;
}

/* How the blocks of a packet make firings. Block b belongs to slot b / blocks_per_firing; in dual return the slots come
 * in pairs, one of last and one of strongest returns. */
typedef struct wire_layout {
    uint32_t blocks_per_firing;
    uint32_t firings_per_block;
    uint32_t returns; /* 1, or 2 in dual return */
    uint32_t slots;   /* UPB_PACKET_BLOCKS / blocks_per_firing / returns: places of one azimuth */
    uint32_t last_at; /* in a dual pair: which of the two holds the last returns */
} wire_layout;

wire_layout wire_layout_of(upb_sensor sensor, upb_return_mode mode);

/* First block of return `which` (0, 1) at azimuth place `slot`. */
static inline uint32_t wire_slot_block(const wire_layout *layout, uint32_t slot, uint32_t which) {
    return (slot * layout->returns + which) * layout->blocks_per_firing;
}

#endif
