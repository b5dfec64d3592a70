/*
 * The serial console: the frames of the CAN bus on a byte stream. A record is
 *     COBS( frame as upb_can_frame_encode has it | CRC-16/IBM-3740 of it, big-endian ) 0x00
 * A reader that meets garbage is back in step at the next 0x00. docs/serial.md
 */
#ifndef UPBEAM_CONSOLE_H
#define UPBEAM_CONSOLE_H

#include "upbeam/can.h"

#ifdef __cplusplus
extern "C" {
#endif

#define UPB_CONSOLE_PAYLOAD_MAX (UPB_CAN_WIRE_MAX + 2u)      /* before COBS */
#define UPB_CONSOLE_FRAME_MAX (UPB_CONSOLE_PAYLOAD_MAX + 2u) /* with COBS's code byte and the delimiter */

/*
 * Consistent overhead byte stuffing (Cheshire and Baker 1999), without the delimiter. upb_cobs_encode: bytes written,
 * count + count / 254 + 1 at most. upb_cobs_decode: bytes written, or SIZE_MAX if it is no code (a 0 in it, a block
 * that ends early) or does not fit `room`. `out` and `in` may not overlap.
 */
UPB_API size_t upb_cobs_encode(const uint8_t *in, size_t count, uint8_t *out);
UPB_API size_t upb_cobs_decode(const uint8_t *in, size_t count, uint8_t *out, size_t room);

/* A record's bytes, delimiter and all (room for UPB_CONSOLE_FRAME_MAX); 0 for a frame that is not valid. */
UPB_API size_t upb_console_encode(const upb_can_frame *frame, uint8_t *bytes);

typedef struct upb_console_parser {
    uint64_t good;     /* records taken */
    uint64_t bad_cobs; /* refused, by cause */
    uint64_t bad_crc;
    uint64_t bad_frame; /* CRC good, but no frame: length, flags or identifier */
    uint64_t overlong;
    uint16_t have;
    uint8_t skipping; /* overlong: until the next delimiter */
    uint8_t bytes[UPB_CONSOLE_FRAME_MAX];
} upb_console_parser;

UPB_API void upb_console_parser_init(upb_console_parser *parser);
/* One byte in; true if it ended a good record: *frame is filled. */
UPB_API int upb_console_parse(upb_console_parser *parser, uint8_t byte, upb_can_frame *frame);
/* Records refused, all causes. */
UPB_API uint64_t upb_console_refused(const upb_console_parser *parser);

#ifdef __cplusplus
}
#endif

#endif /* UPBEAM_CONSOLE_H */
