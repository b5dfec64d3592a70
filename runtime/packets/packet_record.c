/*
 * The 1820 bytes an HDL-64E tells of itself, 7 of each cycle of 16 packets:
 *     0  "UNIT#", noise threshold of the upper and lower bank
 *     7  64 times 28 bytes, by laser number: number, nine signed 16-bit values (elevation and rotational correction in
 * 0.01 degrees, five lengths in mm, focal distance in mm, focal slope in tenths), least and greatest intensity, 7
 * unused 1792  (the last 7 unused bytes) time of calibration, humidity; 1799 speed, field of view, hours, addresses,
 * returns, warnings, power level, checksum
 */
#include "packet_record.h"

#include <string.h>

#include "packet_wire.h"

#define LASERS_AT 7u
#define LASER_BYTES 28u
#define LASER_SUMMED_BYTES 20u /* from the second byte on */
#define TAIL_AT 1792u
#define SUM_AT 1818u
#define LASER_VALUES 9u
#define S3_POLYNOMIAL 0x8005u

static const int32_t value_scale[LASER_VALUES] = {10, -10, 1000, 1000, 1000, 1000, 1000, 1000, 1000};

static uint32_t crc16(uint32_t crc, const uint8_t *bytes, uint32_t n) {
    for (uint32_t k = 0; k < n; k++) {
        crc ^= (uint32_t)bytes[k] << 8;
        for (int bit = 0; bit < 8; bit++)
            crc = (crc << 1 ^ (crc & 0x8000u ? S3_POLYNOMIAL : 0u)) & 0xFFFFu;
    }
    return crc;
}

static uint32_t checksum(upb_sensor sensor, const uint8_t *record) {
    if (sensor == UPB_SENSOR_HDL_64E_S2)
        return UPB_RECORD_BYTES;
    uint32_t crc = 0;
    for (uint32_t k = 0; k < UPB_PACKET_BEAMS; k++)
        crc = crc16(crc, record + LASERS_AT + LASER_BYTES * k + 1, LASER_SUMMED_BYTES);
    return crc;
}

/* ------------------------------------------------------------------------------------------------------ writing */

static upb_packet_status put_laser(uint8_t *at, const upb_laser *laser) {
    const int32_t values[LASER_VALUES] = {
        laser->elevation_mdeg,       laser->azimuth_offset_mdeg, laser->distance_correction_um,
        laser->distance_x_um,        laser->distance_y_um,       laser->vertical_offset_um,
        laser->horizontal_offset_um, laser->focal_distance_um,   laser->focal_slope_e4};
    at[0] = laser->laser_id;
    for (uint32_t k = 0; k < LASER_VALUES; k++) {
        const int32_t scale = value_scale[k];
        if (values[k] > INT32_MAX - 1000 || values[k] < INT32_MIN + 1001)
            return UPB_PACKET_E_CALIBRATION;
        const int32_t count = scale > 0 ? packet_round_div(values[k], scale) : -packet_round_div(values[k], -scale);
        if (count > INT16_MAX || count < INT16_MIN)
            return UPB_PACKET_E_CALIBRATION;
        wire_put16(at + 1 + 2 * k, (uint32_t)count & 0xFFFFu);
    }
    at[19] = laser->min_intensity;
    at[20] = laser->max_intensity;
    return UPB_PACKET_OK;
}

static void put_tail(uint8_t *tail, const upb_hdl64e_status *status) {
    memcpy(tail, status->calibrated, sizeof status->calibrated);
    tail[6] = status->humidity;
    wire_put16(tail + 7, status->rpm);
    wire_put16(tail + 9, status->fov_min_cdeg);
    wire_put16(tail + 11, status->fov_max_cdeg);
    wire_put16(tail + 13, status->life_hours);
    memcpy(tail + 15, status->ip_source, sizeof status->ip_source);
    memcpy(tail + 19, status->ip_destination, sizeof status->ip_destination);
    tail[23] = status->returns;
    tail[24] = status->warnings;
    tail[25] = status->power_level;
}

upb_packet_status upb_record_write(const upb_packet_calibration *calibration, const upb_hdl64e_status *status,
                                   uint8_t record[UPB_RECORD_BYTES]) {
    if (!calibration || !status || !record || !wire_is_hdl64e(calibration->sensor))
        return UPB_PACKET_E_ARGUMENT;
    upb_packet_status outcome = upb_packet_calibration_check(calibration, NULL);
    if (outcome != UPB_PACKET_OK)
        return outcome;
    memset(record, 0, UPB_RECORD_BYTES);
    memcpy(record, "UNIT#", 5);
    record[5] = status->upper_threshold;
    record[6] = status->lower_threshold;
    for (uint32_t k = 0; k < UPB_PACKET_BEAMS; k++) {
        const upb_laser *laser = &calibration->laser[k];
        outcome = put_laser(record + LASERS_AT + LASER_BYTES * laser->laser_id, laser);
        if (outcome != UPB_PACKET_OK)
            return outcome;
    }
    put_tail(record + TAIL_AT, status);
    wire_put16(record + SUM_AT, checksum(calibration->sensor, record));
    return UPB_PACKET_OK;
}

/* ------------------------------------------------------------------------------------------------------ reading */

static int32_t value_of(const uint8_t *at, uint32_t k) {
    const uint32_t bits = wire_get16(at + 1 + 2 * k);
    return value_scale[k] * (bits < 0x8000u ? (int32_t)bits : (int32_t)bits - 0x10000);
}

static void get_laser(const uint8_t *at, upb_sensor sensor, upb_laser *laser) {
    memset(laser, 0, sizeof *laser);
    laser->laser_id = at[0];
    laser->fire_time_ns = packet_hdl64e_fire_time_ns(sensor, at[0]);
    laser->elevation_mdeg = value_of(at, 0);
    laser->azimuth_offset_mdeg = value_of(at, 1);
    laser->distance_correction_um = value_of(at, 2);
    laser->distance_x_um = value_of(at, 3);
    laser->distance_y_um = value_of(at, 4);
    laser->vertical_offset_um = value_of(at, 5);
    laser->horizontal_offset_um = value_of(at, 6);
    laser->focal_distance_um = value_of(at, 7);
    laser->focal_slope_e4 = value_of(at, 8);
    laser->min_intensity = at[19];
    laser->max_intensity = at[20];
}

static void get_tail(const uint8_t *tail, upb_hdl64e_status *status) {
    memcpy(status->calibrated, tail, sizeof status->calibrated);
    status->humidity = tail[6];
    status->rpm = (uint16_t)wire_get16(tail + 7);
    status->fov_min_cdeg = (uint16_t)wire_get16(tail + 9);
    status->fov_max_cdeg = (uint16_t)wire_get16(tail + 11);
    status->life_hours = (uint16_t)wire_get16(tail + 13);
    memcpy(status->ip_source, tail + 15, sizeof status->ip_source);
    memcpy(status->ip_destination, tail + 19, sizeof status->ip_destination);
    status->returns = tail[23];
    status->warnings = tail[24];
    status->power_level = tail[25];
}

upb_packet_status upb_record_read(const uint8_t record[UPB_RECORD_BYTES], upb_packet_calibration *calibration,
                                  upb_hdl64e_status *status) {
    if (!record || !calibration || !status)
        return UPB_PACKET_E_ARGUMENT;
    const uint32_t sum = wire_get16(record + SUM_AT);
    if (memcmp(record, "UNIT#", 5) != 0)
        return UPB_PACKET_E_CALIBRATION;
    /* An S3's CRC may happen to be an S2's length, not the other way round: the CRC is asked first. */
    upb_sensor sensor = UPB_SENSOR_HDL_64E_S3;
    if (sum != checksum(sensor, record))
        sensor = UPB_SENSOR_HDL_64E_S2;
    if (sum != checksum(sensor, record))
        return UPB_PACKET_E_CALIBRATION;
    memset(calibration, 0, sizeof *calibration);
    calibration->sensor = sensor;
    calibration->beams = UPB_PACKET_BEAMS;
    for (uint32_t k = 0; k < UPB_PACKET_BEAMS; k++) {
        get_laser(record + LASERS_AT + LASER_BYTES * k, sensor, &calibration->laser[k]);
        if (calibration->laser[k].distance_x_um || calibration->laser[k].distance_y_um)
            calibration->two_point = 1;
    }
    upb_packet_calibration_sort(calibration);
    status->upper_threshold = record[5];
    status->lower_threshold = record[6];
    get_tail(record + TAIL_AT, status);
    return upb_packet_calibration_check(calibration, NULL);
}
