/* What the calibration and the record of an HDL-64E share. */
#ifndef UPBEAM_PACKET_RECORD_H
#define UPBEAM_PACKET_RECORD_H

#include "upbeam/packets.h"

#define PACKET_MAX_LENGTH_UM 32767000 /* what fits a record's 16 bits of millimetres */

/* After the begin of the firing, by the laser's number. */
uint32_t packet_hdl64e_fire_time_ns(upb_sensor sensor, uint32_t laser_id);

/* Nearest whole quotient, halves away from zero; divisor above 0. */
static inline int32_t packet_round_div(int32_t value, int32_t divisor) {
    return (value >= 0 ? value + divisor / 2 : value - divisor / 2) / divisor;
}

#endif
