/*
 * CAN frames as bytes in memory, and the two things the bus side of upbeam needs from its surroundings: a way to send,
 * and memory that survives a restart. Both are function pointers; the library itself does no I/O.
 */
#ifndef UPBEAM_CAN_H
#define UPBEAM_CAN_H

#include "upbeam/upbeam.h"

#ifdef __cplusplus
extern "C" {
#endif

#define UPB_CAN_CLASSIC_BYTES 8u
#define UPB_CAN_FD_BYTES 64u

#define UPB_CAN_FD 1u       /* an FD frame */
#define UPB_CAN_BRS 2u      /* of an FD frame: the data phase runs at the higher bit rate */
#define UPB_CAN_EXTENDED 4u /* a 29-bit identifier */

typedef struct upb_can_frame {
    uint32_t id;    /* 0..0x7ff, 0..0x1fffffff if UPB_CAN_EXTENDED */
    uint8_t flags;  /* UPB_CAN_FD, UPB_CAN_BRS, UPB_CAN_EXTENDED; no others */
    uint8_t length; /* bytes of data: 0..8; FD also 12, 16, 20, 24, 32, 48, 64 */
    uint8_t data[UPB_CAN_FD_BYTES];
} upb_can_frame;

/* True if the identifier fits, the flags are known and a frame can have the length. */
UPB_API int upb_can_frame_is_valid(const upb_can_frame *frame);

/*
 * A frame as bytes, the same in a UDP datagram (one frame each, nothing else in it) and in a record of the serial
 * console:
 *     byte 0..3   identifier, little-endian
 *     byte 4      flags: UPB_CAN_*
 *     byte 5      length L of the data
 *     byte 6..    L bytes of data
 */
#define UPB_CAN_WIRE_HEADER 6u
#define UPB_CAN_WIRE_MAX (UPB_CAN_WIRE_HEADER + UPB_CAN_FD_BYTES)

/* Writes the frame to `bytes` (room for UPB_CAN_WIRE_MAX); how many were written, 0 for a frame that is not valid. */
UPB_API size_t upb_can_frame_encode(const upb_can_frame *frame, uint8_t *bytes);

/* Reads a frame of exactly `count` bytes. Errors: ARGUMENT, TRUNCATED (length and data disagree), VALUE. */
UPB_API upb_status upb_can_frame_decode(const uint8_t *bytes, size_t count, upb_can_frame *frame);

typedef enum upb_send {
    UPB_SEND_DONE = 0,
    UPB_SEND_BUSY = 1,  /* no room now: offered again at the next step, with what is true then */
    UPB_SEND_FAILED = 2 /* the bus is off, the link is gone: the frame is dropped and counted */
} upb_send;

typedef struct upb_can_transport {
    upb_send (*send)(void *user, const upb_can_frame *frame); /* null: there is no bus */
    void *user;
} upb_can_transport;

typedef struct upb_serial_transport {
    /* All of the bytes or none; a frame is at most UPB_CONSOLE_FRAME_MAX bytes. */
    upb_send (*send)(void *user, const uint8_t *bytes, size_t count); /* null: there is no line */
    void *user;
} upb_serial_transport;

/* ----------------------------------------------------------------------------------------------- storage */

typedef enum upb_store {
    UPB_STORE_FRESHNESS = 1, /* UPB_STORE_FRESHNESS_BYTES: the counter of the last command taken */
    UPB_STORE_FAULTS = 2     /* at most UPB_STORE_FAULTS_BYTES: the fault memory */
} upb_store;

typedef enum upb_stored {
    UPB_STORED_DONE = 0,
    UPB_STORED_NOTHING = 1, /* read only: never written, the device is new */
    UPB_STORED_FAILED = 2   /* unreadable, or not written */
} upb_stored;

/*
 * Memory that survives a restart. A write is whole or not at all, also when power fails during it: after a restart
 * a read gives the old bytes or the new ones. What is stored carries its own checksum.
 */
typedef struct upb_storage {
    upb_stored (*read)(void *user, upb_store what, uint8_t *bytes, size_t count); /* exactly `count` bytes */
    upb_stored (*write)(void *user, upb_store what, const uint8_t *bytes, size_t count);
    void *user;
} upb_storage;

#ifdef __cplusplus
}
#endif

#endif /* UPBEAM_CAN_H */
