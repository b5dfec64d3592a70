/* CAN frames: what can be one, and frames as bytes. */
#include <string.h>

#include "upb_bytes.h"
#include "upbeam/can.h"

static int is_length(uint32_t flags, uint32_t length) {
    if (length <= UPB_CAN_CLASSIC_BYTES)
        return 1;
    if (!(flags & UPB_CAN_FD) || length > UPB_CAN_FD_BYTES)
        return 0;
    return length <= 24 ? length % 4 == 0 : length == 32 || length == 48 || length == 64;
}

int upb_can_frame_is_valid(const upb_can_frame *frame) {
    if (!frame || frame->flags & ~(UPB_CAN_FD | UPB_CAN_BRS | UPB_CAN_EXTENDED))
        return 0;
    if (frame->flags & UPB_CAN_BRS && !(frame->flags & UPB_CAN_FD))
        return 0;
    return frame->id <= (frame->flags & UPB_CAN_EXTENDED ? 0x1fffffffu : 0x7ffu) &&
           is_length(frame->flags, frame->length);
}

size_t upb_can_frame_encode(const upb_can_frame *frame, uint8_t *bytes) {
    if (!bytes || !upb_can_frame_is_valid(frame))
        return 0;
    upb_put_le(bytes, frame->id, 4);
    bytes[4] = frame->flags;
    bytes[5] = frame->length;
    memcpy(bytes + UPB_CAN_WIRE_HEADER, frame->data, frame->length);
    return UPB_CAN_WIRE_HEADER + (size_t)frame->length;
}

upb_status upb_can_frame_decode(const uint8_t *bytes, size_t count, upb_can_frame *frame) {
    if (!bytes || !frame)
        return UPB_E_ARGUMENT;
    if (count < UPB_CAN_WIRE_HEADER || count != UPB_CAN_WIRE_HEADER + (size_t)bytes[5])
        return UPB_E_TRUNCATED;
    upb_can_frame read = {0};
    read.id = (uint32_t)upb_get_le(bytes, 4);
    read.flags = bytes[4];
    read.length = bytes[5];
    if (!upb_can_frame_is_valid(&read))
        return UPB_E_VALUE;
    memcpy(read.data, bytes + UPB_CAN_WIRE_HEADER, read.length);
    *frame = read;
    return UPB_OK;
}
