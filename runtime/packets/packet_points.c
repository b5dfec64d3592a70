/* Firings to points: where each laser points when it fires, and its corrections. */
#include <math.h>

#include "packet_wire.h"

#define FAR_UM 25040000.0 /* from where distance_correction_um holds; the two near places (HDL-64E manual) */
#define NEAR_X_UM 2400000.0
#define NEAR_Y_UM 1930000.0

static const double radians_per_mdeg = 3.14159265358979323846 / 180e3;

static uint32_t laser_azimuth_mdeg(const upb_laser *laser, const upb_firing *firing) {
    const uint64_t turned = ((uint64_t)firing->rate_mdeg_s * laser->fire_time_ns + 500000000) / 1000000000;
    const int64_t sum = (int64_t)(firing->azimuth_mdeg % UPB_FULL_TURN_MDEG) + (int64_t)(turned % UPB_FULL_TURN_MDEG) +
                        laser->azimuth_offset_mdeg;
    return (uint32_t)((sum + 10 * (int64_t)UPB_FULL_TURN_MDEG) % (int64_t)UPB_FULL_TURN_MDEG);
}

/* The correction of a distance whose share along one axis is `along_um`, beyond the one at 25 m. */
static double near_correction_um(double far_um, double near_um, double near_at_um, double along_um) {
    return (far_um - near_um) * (along_um - near_at_um) / (FAR_UM - near_at_um) + near_um - far_um;
}

/* The origin lies `up` over the sensor's and `left` of the direction: a shift, whatever the elevation. The manual's x
 * is to the right, its y to the front; near the sensor each axis has a distance of its own, and the height their mean.
 */
static void place_point(const upb_laser *laser, int near, double distance_um, upb_point *point) {
    const double azimuth = point->azimuth_mdeg * radians_per_mdeg;
    const double elevation = laser->elevation_mdeg * radians_per_mdeg;
    const double sin_a = sin(azimuth), cos_a = cos(azimuth), sin_e = sin(elevation), cos_e = cos(elevation);
    const double left = laser->horizontal_offset_um;
    double right_um = distance_um, front_um = distance_um;
    if (near) {
        const double flat = distance_um * cos_e;
        right_um += near_correction_um(laser->distance_correction_um, laser->distance_x_um, NEAR_X_UM,
                                       fabs(flat * sin_a - left * cos_a));
        front_um += near_correction_um(laser->distance_correction_um, laser->distance_y_um, NEAR_Y_UM,
                                       fabs(flat * cos_a + left * sin_a));
    }
    point->x_m = (float)((front_um * cos_e * cos_a + left * sin_a) * 1e-6);
    point->y_m = (float)((left * cos_a - right_um * cos_e * sin_a) * 1e-6);
    point->z_m = (float)(((front_um + right_um) / 2 * sin_e + laser->vertical_offset_um) * 1e-6);
}

uint32_t upb_firing_points(const upb_packet_calibration *calibration, const upb_firing *firing,
                           upb_point points[UPB_PACKET_BEAMS]) {
    if (!calibration || !firing || !points || upb_packet_calibration_check(calibration, NULL) != UPB_PACKET_OK)
        return 0;
    const uint32_t unit_um = upb_sensor_info_get(calibration->sensor)->distance_unit_um;
    const uint32_t beams = firing->beams < calibration->beams ? firing->beams : calibration->beams;
    uint32_t count = 0;
    for (uint32_t beam = 0; beam < beams; beam++) {
        const upb_laser *laser = &calibration->laser[beam];
        const int64_t distance_um = (int64_t)firing->distance[beam] * unit_um + laser->distance_correction_um;
        if (firing->distance[beam] == 0 || distance_um <= 0)
            continue;
        upb_point *point = &points[count++];
        point->intensity = firing->intensity[beam];
        point->beam = (uint8_t)beam;
        point->reserved = 0;
        point->azimuth_mdeg = laser_azimuth_mdeg(laser, firing);
        point->distance_um = (uint32_t)distance_um;
        const int near = calibration->two_point && (double)firing->distance[beam] * unit_um < FAR_UM;
        place_point(laser, near, (double)distance_um, point);
    }
    return count;
}
