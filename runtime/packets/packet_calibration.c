/* Tables of lasers: nominal ones, what can be, and the one that 64-row columns are written by. */
#include <string.h>

#include "packet_record.h"
#include "packet_tables.h"
#include "packet_wire.h"

#define MAX_ANGLE_MDEG 90000
#define WIRE_ANGLE_MDEG 10 /* angles in an HDL-64E's record: 0.01 degrees */

static const packet_beam *nominal(upb_sensor sensor) {
    switch (sensor) {
    case UPB_SENSOR_HDL_32E:
        return packet_hdl_32e;
    case UPB_SENSOR_VLP_32C:
        return packet_vlp_32c;
    case UPB_SENSOR_VLP_16:
        return packet_vlp_16;
    case UPB_SENSOR_HDL_64E_S2:
    case UPB_SENSOR_HDL_64E_S3:
        return packet_hdl_64e;
    default:
        return NULL;
    }
}

uint32_t packet_hdl64e_fire_time_ns(upb_sensor sensor, uint32_t laser_id) {
    /* The manuals' firing time tables: groups of four lasers, eight a cycle, the banks together. */
    static const uint16_t in_group_s2[4] = {0, 1260, 2460, 3660};
    static const uint16_t in_group_s3[4] = {0, 1300, 2500, 3700};
    const uint16_t *in_group = sensor == UPB_SENSOR_HDL_64E_S2 ? in_group_s2 : in_group_s3;
    const uint32_t group_ns = upb_sensor_info_get(sensor)->firing_cycle_ns / 8;
    return group_ns * (laser_id % WIRE_BLOCK_LASERS / 4) + in_group[laser_id % 4];
}

upb_packet_status upb_packet_calibration_default(upb_sensor sensor, upb_packet_calibration *calibration) {
    const packet_beam *beams = nominal(sensor);
    if (!calibration || !beams)
        return UPB_PACKET_E_ARGUMENT;
    memset(calibration, 0, sizeof *calibration);
    calibration->sensor = sensor;
    calibration->beams = upb_sensor_info_get(sensor)->beams;
    for (uint32_t k = 0; k < calibration->beams; k++) {
        upb_laser *laser = &calibration->laser[k];
        laser->elevation_mdeg = beams[k].elevation_mdeg;
        laser->azimuth_offset_mdeg = beams[k].azimuth_offset_mdeg;
        laser->fire_time_ns =
            wire_is_hdl64e(sensor) ? packet_hdl64e_fire_time_ns(sensor, beams[k].laser_id) : beams[k].fire_time_ns;
        laser->vertical_offset_um = beams[k].vertical_offset_um;
        laser->horizontal_offset_um = beams[k].horizontal_offset_um;
        laser->max_intensity = UINT8_MAX;
        laser->laser_id = beams[k].laser_id;
    }
    return UPB_PACKET_OK;
}

static int within(int32_t value, int32_t limit) { return value >= -limit && value <= limit; }

static int laser_can_be(const upb_laser *laser, uint32_t beams, uint32_t cycle_ns) {
    return within(laser->elevation_mdeg, MAX_ANGLE_MDEG) && within(laser->azimuth_offset_mdeg, MAX_ANGLE_MDEG) &&
           laser->fire_time_ns < cycle_ns && within(laser->distance_correction_um, PACKET_MAX_LENGTH_UM) &&
           within(laser->distance_x_um, PACKET_MAX_LENGTH_UM) && within(laser->distance_y_um, PACKET_MAX_LENGTH_UM) &&
           within(laser->vertical_offset_um, PACKET_MAX_LENGTH_UM) &&
           within(laser->horizontal_offset_um, PACKET_MAX_LENGTH_UM) && laser->laser_id < beams &&
           laser->min_intensity <= laser->max_intensity;
}

upb_packet_status upb_packet_calibration_check(const upb_packet_calibration *calibration, uint32_t *beam) {
    uint32_t bad = 0;
    if (!beam)
        beam = &bad;
    *beam = 0;
    if (!calibration || !nominal(calibration->sensor))
        return UPB_PACKET_E_ARGUMENT;
    const upb_sensor_info *info = upb_sensor_info_get(calibration->sensor);
    if (calibration->beams != info->beams || calibration->two_point > 1)
        return UPB_PACKET_E_CALIBRATION;
    uint64_t seen = 0;
    for (uint32_t k = 0; k < info->beams; k++) {
        const upb_laser *laser = &calibration->laser[k];
        *beam = k;
        if (!laser_can_be(laser, info->beams, info->firing_cycle_ns) || (seen >> laser->laser_id & 1u))
            return UPB_PACKET_E_CALIBRATION;
        if (k > 0 && laser->elevation_mdeg > laser[-1].elevation_mdeg)
            return UPB_PACKET_E_CALIBRATION;
        seen |= UINT64_C(1) << laser->laser_id;
    }
    *beam = 0;
    return UPB_PACKET_OK;
}

void upb_packet_calibration_sort(upb_packet_calibration *calibration) {
    if (!calibration)
        return;
    const uint32_t beams = calibration->beams <= UPB_PACKET_BEAMS ? calibration->beams : UPB_PACKET_BEAMS;
    for (uint32_t k = 1; k < beams; k++) {
        const upb_laser laser = calibration->laser[k];
        uint32_t at = k;
        for (; at > 0 && calibration->laser[at - 1].elevation_mdeg < laser.elevation_mdeg; at--)
            calibration->laser[at] = calibration->laser[at - 1];
        calibration->laser[at] = laser;
    }
}

/* What a decoder adds to the azimuth of a laser that fires this late, rounded to the record's steps. */
static int32_t turn_while_firing_mdeg(uint32_t fire_time_ns, uint32_t cycle_ns, uint32_t turn_columns) {
    const uint64_t scaled = (uint64_t)UPB_FULL_TURN_MDEG / WIRE_ANGLE_MDEG * fire_time_ns;
    const uint64_t per = (uint64_t)cycle_ns * turn_columns;
    return WIRE_ANGLE_MDEG * (int32_t)((scaled + per / 2) / per);
}

upb_packet_status upb_packet_calibration_rows(const int32_t row_elevation_mdeg[UPB_PACKET_BEAMS], uint32_t turn_columns,
                                              upb_packet_calibration *calibration) {
    if (!row_elevation_mdeg || !calibration || turn_columns < 4 || turn_columns > UINT16_MAX)
        return UPB_PACKET_E_ARGUMENT;
    const upb_sensor_info *info = upb_sensor_info_get(UPB_SENSOR_HDL_64E_S3);
    memset(calibration, 0, sizeof *calibration);
    calibration->sensor = UPB_SENSOR_HDL_64E_S3;
    calibration->beams = info->beams;
    for (uint32_t row = 0; row < UPB_PACKET_BEAMS; row++) {
        upb_laser *laser = &calibration->laser[row];
        if (!within(row_elevation_mdeg[row], MAX_ANGLE_MDEG))
            return UPB_PACKET_E_CALIBRATION;
        laser->laser_id = (uint8_t)(row % 2 * WIRE_BLOCK_LASERS + row / 2);
        laser->elevation_mdeg = packet_round_div(row_elevation_mdeg[row], WIRE_ANGLE_MDEG) * WIRE_ANGLE_MDEG;
        laser->fire_time_ns = packet_hdl64e_fire_time_ns(UPB_SENSOR_HDL_64E_S3, laser->laser_id);
        laser->azimuth_offset_mdeg = -turn_while_firing_mdeg(laser->fire_time_ns, info->firing_cycle_ns, turn_columns);
        laser->max_intensity = UINT8_MAX;
        if (row > 0 && laser->elevation_mdeg >= laser[-1].elevation_mdeg)
            return UPB_PACKET_E_CALIBRATION;
    }
    return upb_packet_calibration_check(calibration, NULL);
}
