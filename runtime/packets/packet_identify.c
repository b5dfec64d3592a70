/* What a payload is, and whether all of it can be. */
#include <string.h>

#include "packet_wire.h"

#define SAME_FIRING_CDEG 50 /* what upper and lower bank of one firing may differ in azimuth */

static int is_ouster_size(size_t n) {
    /* Legacy data packets of 16, 32, 64 and 128 beams; RNG19 with one and two returns. */
    static const uint16_t sizes[] = {3392, 6464, 12608, 24896, 8448, 16640, 33024};
    for (size_t k = 0; k < sizeof sizes / sizeof sizes[0]; k++)
        if (n == sizes[k])
            return 1;
    return 0;
}

static upb_packet_status fail(upb_packet_info *info, upb_packet_status status, uint32_t block, uint32_t got) {
    info->block = block;
    info->got = got;
    return status;
}

/* The sensor of a packet whose last byte is its model. */
static upb_packet_status sensor_of_model(uint8_t model, upb_packet_info *info) {
    static const uint8_t refused[UPB_SENSORS] = {
        [UPB_SENSOR_VLS_128] = UPB_PACKET_E_VLS_128,
        [UPB_SENSOR_VLP_32AB] = UPB_PACKET_E_VLP_32AB,
        [UPB_SENSOR_PUCK_HIRES] = UPB_PACKET_E_PUCK_HIRES,
        [UPB_SENSOR_VELARRAY] = UPB_PACKET_E_VELARRAY,
    };
    for (uint32_t k = 1; model && k < UPB_SENSORS; k++) {
        if (upb_sensor_info_get((upb_sensor)k)->model != model)
            continue;
        info->sensor = (upb_sensor)k;
        return (upb_packet_status)refused[k];
    }
    return fail(info, UPB_PACKET_E_MODEL, 0, model);
}

/* An HDL-64E sends its banks by turns and has no model byte; so does a VLS-128, with four banks. */
static upb_packet_status find_sensor(const uint8_t *packet, upb_packet_info *info) {
    const uint32_t second = wire_get16(wire_block(packet, 1));
    const uint32_t third = wire_get16(wire_block(packet, 2));
    if (second == WIRE_LOWER && third != WIRE_THIRD) {
        info->sensor = UPB_SENSOR_HDL_64E_S3;
        info->return_mode = UPB_RETURN_STRONGEST;
        return UPB_PACKET_OK;
    }
    const upb_packet_status status = sensor_of_model(info->status_value, info);
    if (status != UPB_PACKET_OK)
        return status;
    info->return_mode = (upb_return_mode)info->status_type;
    if (info->status_type < UPB_RETURN_STRONGEST || info->status_type > UPB_RETURN_DUAL)
        return fail(info, UPB_PACKET_E_RETURN_MODE, 0, info->status_type);
    return UPB_PACKET_OK;
}

static upb_packet_status check_blocks(const uint8_t *packet, upb_packet_info *info) {
    const int banks = wire_is_hdl64e(info->sensor);
    for (uint32_t block = 0; block < UPB_PACKET_BLOCKS; block++) {
        const uint32_t flag = wire_get16(wire_block(packet, block));
        const uint32_t azimuth = wire_azimuth(packet, block);
        if (flag != (banks && block % 2 ? WIRE_LOWER : WIRE_UPPER))
            return fail(info, UPB_PACKET_E_FLAG, block, flag);
        if (azimuth >= WIRE_FULL_TURN_CDEG)
            return fail(info, UPB_PACKET_E_AZIMUTH, block, azimuth);
    }
    return UPB_PACKET_OK;
}

/* Blocks of one azimuth: a dual pair to the count, the two banks nearly. */
static upb_packet_status check_pairs(const uint8_t *packet, upb_packet_info *info) {
    const int banks = wire_is_hdl64e(info->sensor);
    const int32_t tolerance = banks ? SAME_FIRING_CDEG : 0;
    if (!banks && info->return_mode != UPB_RETURN_DUAL)
        return UPB_PACKET_OK;
    for (uint32_t block = 0; block < UPB_PACKET_BLOCKS; block += 2) {
        const int32_t turn = wire_turn(wire_azimuth(packet, block), wire_azimuth(packet, block + 1));
        if (turn > tolerance || turn < -tolerance)
            return fail(info, UPB_PACKET_E_RETURN_PAIR, block, wire_azimuth(packet, block + 1));
    }
    return UPB_PACKET_OK;
}

/* An HDL-64E's dual returns: every azimuth twice. A stuck one is the same in all blocks, and no sign of it. */
static int banks_come_twice(const uint8_t *packet) {
    for (uint32_t block = 0; block < UPB_PACKET_BLOCKS; block += 4)
        if (wire_azimuth(packet, block) != wire_azimuth(packet, block + 2))
            return 0;
    return wire_azimuth(packet, 0) != wire_azimuth(packet, 4);
}

static upb_packet_status identify_data(const uint8_t *packet, upb_packet_info *info) {
    info->status_type = packet[WIRE_RETURN_MODE_AT];
    info->status_value = packet[WIRE_MODEL_AT];
    info->azimuth_mdeg = 10 * wire_azimuth(packet, 0);
    info->time_us = wire_get32(packet + WIRE_TIME_AT);
    if (wire_get16(packet) != WIRE_UPPER)
        return fail(info, UPB_PACKET_E_FLAG, 0, wire_get16(packet));
    info->kind = UPB_PACKET_KIND_DATA;
    upb_packet_status status = find_sensor(packet, info);
    if (status == UPB_PACKET_OK)
        status = check_blocks(packet, info);
    if (status == UPB_PACKET_OK)
        status = check_pairs(packet, info);
    if (status != UPB_PACKET_OK)
        return status;
    if (wire_is_hdl64e(info->sensor) && banks_come_twice(packet))
        info->return_mode = UPB_RETURN_DUAL;
    if (info->time_us >= WIRE_HOUR_US)
        return fail(info, UPB_PACKET_E_TIME, 0, info->time_us);
    return UPB_PACKET_OK;
}

static upb_packet_status identify_position(const uint8_t *packet, upb_packet_info *info) {
    upb_position position;
    info->kind = UPB_PACKET_KIND_POSITION;
    info->time_us = wire_get32(packet + WIRE_POSITION_TIME_AT);
    const upb_packet_status status = upb_position_decode(packet, UPB_POSITION_PACKET_BYTES, &position);
    return status == UPB_PACKET_OK ? status : fail(info, status, 0, info->time_us);
}

upb_packet_status upb_packet_identify(const uint8_t *bytes, size_t n, upb_packet_info *info) {
    if (!bytes || !info)
        return UPB_PACKET_E_ARGUMENT;
    memset(info, 0, sizeof *info);
    if (n == UPB_PACKET_BYTES)
        return identify_data(bytes, info);
    if (n == UPB_POSITION_PACKET_BYTES)
        return identify_position(bytes, info);
    info->got = n < UINT32_MAX ? (uint32_t)n : UINT32_MAX;
    if (!is_ouster_size(n))
        return UPB_PACKET_E_SIZE;
    info->sensor = UPB_SENSOR_OUSTER;
    return UPB_PACKET_E_OUSTER;
}
