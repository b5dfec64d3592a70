/* What is known of each sensor, and the words for outcomes. */
#include "packet_tables.h"
#include "packet_wire.h"

static const upb_sensor_info sensors[UPB_SENSORS] = {
    [UPB_SENSOR_AUTO] = {.name = "auto"},
    [UPB_SENSOR_HDL_32E] = {"hdl-32e", 32, PACKET_HDL_32E_UNIT_UM, PACKET_HDL_32E_CYCLE_NS, 12, 0x21, 1, 1},
    [UPB_SENSOR_VLP_32C] = {"vlp-32c", 32, PACKET_VLP_32C_UNIT_UM, PACKET_VLP_32C_CYCLE_NS, 12, 0x28, 1, 1},
    [UPB_SENSOR_VLP_16] = {"vlp-16", 16, PACKET_VLP_16_UNIT_UM, PACKET_VLP_16_CYCLE_NS, 24, 0x22, 1, 2},
    [UPB_SENSOR_HDL_64E_S2] = {"hdl-64e-s2", 64, PACKET_HDL_64E_UNIT_UM, PACKET_HDL_64E_CYCLE_NS, 6, 0, 2, 1},
    [UPB_SENSOR_HDL_64E_S3] = {"hdl-64e-s3", 64, PACKET_HDL_64E_UNIT_UM, 57600, 6, 0, 2, 1},
    [UPB_SENSOR_VLS_128] = {.name = "vls-128", .model = 0xA1},
    [UPB_SENSOR_VLP_32AB] = {.name = "vlp-32a/b", .model = 0x23},
    [UPB_SENSOR_PUCK_HIRES] = {.name = "puck-hi-res", .model = 0x24},
    [UPB_SENSOR_VELARRAY] = {.name = "velarray", .model = 0x31},
    [UPB_SENSOR_OUSTER] = {.name = "ouster"},
};

const upb_sensor_info *upb_sensor_info_get(upb_sensor sensor) {
    return (uint32_t)sensor < UPB_SENSORS ? &sensors[sensor] : NULL;
}

static char lower(char c) { return c >= 'A' && c <= 'Z' ? (char)(c - 'A' + 'a') : c; }

static int same_name(const char *a, const char *b) {
    while (*a && lower(*a) == lower(*b)) {
        a++;
        b++;
    }
    return lower(*a) == lower(*b);
}

upb_sensor upb_sensor_by_name(const char *name) {
    for (uint32_t k = 1; name && k < UPB_SENSORS; k++)
        if (same_name(name, sensors[k].name))
            return (upb_sensor)k;
    return UPB_SENSOR_AUTO;
}

const char *upb_packet_status_text(upb_packet_status status) {
    static const char *const texts[UPB_PACKET_STATUSES] = {
        [UPB_PACKET_OK] = "fine",
        [UPB_PACKET_E_ARGUMENT] = "an argument is null or outside its range",
        [UPB_PACKET_E_SIZE] = "neither a data packet of 1206 bytes nor a position packet of 512",
        [UPB_PACKET_E_FLAG] = "a block does not begin with its bank's flag",
        [UPB_PACKET_E_AZIMUTH] = "a block's azimuth is 360 degrees or more",
        [UPB_PACKET_E_TIME] = "the time after the hour is an hour or more",
        [UPB_PACKET_E_RETURN_MODE] = "the return mode is none of strongest, last and dual",
        [UPB_PACKET_E_MODEL] = "the model byte is of no sensor known",
        [UPB_PACKET_E_SENSOR] = "the packet is another sensor's than the one expected",
        [UPB_PACKET_E_POSITION] = "a position packet's PPS state is none known, or its NMEA sentence is not text",
        [UPB_PACKET_E_CALIBRATION] = "the calibration is impossible or its checksum is wrong",
        [UPB_PACKET_E_RETURN_PAIR] = "blocks of one firing do not share their azimuth",
        [UPB_PACKET_E_VLS_128] = "a VLS-128 (Alpha Prime): 128 beams are not supported",
        [UPB_PACKET_E_VLP_32AB] = "a VLP-32A or VLP-32B: not supported",
        [UPB_PACKET_E_PUCK_HIRES] = "a Puck Hi-Res: not supported",
        [UPB_PACKET_E_VELARRAY] = "a Velarray: not supported",
        [UPB_PACKET_E_OUSTER] = "an Ouster sensor's packet size: not supported",
    };
    return (uint32_t)status < UPB_PACKET_STATUSES ? texts[status] : "no such status";
}

wire_layout wire_layout_of(upb_sensor sensor, upb_return_mode mode) {
    const upb_sensor_info *info = &sensors[sensor];
    wire_layout layout;
    layout.blocks_per_firing = info->blocks_per_firing;
    layout.firings_per_block = info->firings_per_block;
    layout.returns = mode == UPB_RETURN_DUAL ? 2 : 1;
    layout.slots = UPB_PACKET_BLOCKS / layout.blocks_per_firing / layout.returns;
    layout.last_at = wire_is_hdl64e(sensor) ? 1 : 0;
    return layout;
}
