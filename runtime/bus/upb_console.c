/* COBS (Cheshire and Baker, IEEE/ACM Transactions on Networking 7(2), 1999) and the records of the serial console. */
#include <string.h>

#include "upb_bytes.h"
#include "upbeam/console.h"
#include "upbeam/e2e.h"

enum { BLOCK_MAX = 0xff, CRC_BYTES = 2 };

size_t upb_cobs_encode(const uint8_t *in, size_t count, uint8_t *out) {
    size_t code_at = 0, written = 1;
    uint8_t code = 1;
    for (size_t i = 0; i < count; i++) {
        if (in[i]) {
            out[written++] = in[i];
            code++;
        }
        /* A block ends at a zero, and when it is full and more follows. */
        if (!in[i] || (code == BLOCK_MAX && i + 1 < count)) {
            out[code_at] = code;
            code_at = written++;
            code = 1;
        }
    }
    out[code_at] = code;
    return written;
}

size_t upb_cobs_decode(const uint8_t *in, size_t count, uint8_t *out, size_t room) {
    size_t read = 0, written = 0;
    if (count == 0)
        return SIZE_MAX;
    while (read < count) {
        const uint8_t code = in[read++];
        const size_t block = (size_t)code - 1u;
        if (code == 0 || block > count - read || block > room - written)
            return SIZE_MAX;
        for (size_t i = 0; i < block; i++) {
            if (!in[read + i])
                return SIZE_MAX;
            out[written + i] = in[read + i];
        }
        read += block;
        written += block;
        if (code < BLOCK_MAX && read < count) {
            if (written == room)
                return SIZE_MAX;
            out[written++] = 0;
        }
    }
    return written;
}

size_t upb_console_encode(const upb_can_frame *frame, uint8_t *bytes) {
    uint8_t payload[UPB_CONSOLE_PAYLOAD_MAX];
    const size_t count = bytes ? upb_can_frame_encode(frame, payload) : 0;
    if (!count)
        return 0;
    upb_put_be(payload + count, upb_crc16(UPB_CRC16_START, payload, count), CRC_BYTES);
    const size_t written = upb_cobs_encode(payload, count + CRC_BYTES, bytes);
    bytes[written] = 0;
    return written + 1;
}

void upb_console_parser_init(upb_console_parser *parser) { memset(parser, 0, sizeof *parser); }

uint64_t upb_console_refused(const upb_console_parser *parser) {
    return parser->bad_cobs + parser->bad_crc + parser->bad_frame + parser->overlong;
}

static int parse_record(upb_console_parser *parser, upb_can_frame *frame) {
    uint8_t payload[UPB_CONSOLE_PAYLOAD_MAX];
    const size_t count = upb_cobs_decode(parser->bytes, parser->have, payload, sizeof payload);
    if (count == SIZE_MAX || count < CRC_BYTES) {
        parser->bad_cobs++;
        return 0;
    }
    if (upb_get_be(payload + count - CRC_BYTES, CRC_BYTES) != upb_crc16(UPB_CRC16_START, payload, count - CRC_BYTES)) {
        parser->bad_crc++;
        return 0;
    }
    if (upb_can_frame_decode(payload, count - CRC_BYTES, frame) != UPB_OK) {
        parser->bad_frame++;
        return 0;
    }
    parser->good++;
    return 1;
}

int upb_console_parse(upb_console_parser *parser, uint8_t byte, upb_can_frame *frame) {
    if (byte) {
        if (parser->have < sizeof parser->bytes)
            parser->bytes[parser->have++] = byte;
        else
            parser->skipping = 1;
        return 0;
    }
    int good = 0;
    if (parser->skipping)
        parser->overlong++;
    else if (parser->have) /* delimiters in a row are idle line */
        good = parse_record(parser, frame);
    parser->have = 0;
    parser->skipping = 0;
    return good;
}
