/* Firings to data packets. */
#include <string.h>

#include "packet_wire.h"

#define STATUS_CYCLE 16u
#define RECORD_STEP 7u        /* bytes of the record in a cycle */
#define RECORD_WARNINGS 1816u /* the record's byte that is sent as type 'W' */

static const uint8_t status_types[STATUS_CYCLE - RECORD_STEP] = {'H', 'M', 'S', 'D', 'N', 'Y', 'G', 'T', 'V'};

upb_packet_encoder_config upb_packet_encoder_config_default(upb_sensor sensor) {
    upb_packet_encoder_config config;
    memset(&config, 0, sizeof config);
    config.sensor = sensor;
    config.return_mode = UPB_RETURN_STRONGEST;
    config.status.day = config.status.month = 1;
    config.status.gps = 'V';
    config.status.calibrated[1] = config.status.calibrated[2] = 1;
    config.status.fov_max_cdeg = WIRE_FULL_TURN_CDEG;
    config.status.rpm = 600;
    return config;
}

static void clear_packet(upb_packet_encoder *encoder) {
    const int banks = wire_is_hdl64e(encoder->config.sensor);
    memset(encoder->packet, 0, sizeof encoder->packet);
    for (uint32_t block = 0; block < UPB_PACKET_BLOCKS; block++)
        wire_put16(encoder->packet + WIRE_BLOCK_BYTES * block, banks && block % 2 ? WIRE_LOWER : WIRE_UPPER);
    encoder->placed = 0;
}

static void place_beams(upb_packet_encoder *encoder, const upb_packet_calibration *calibration) {
    for (uint32_t k = 0; k < calibration->beams; k++)
        encoder->place_beam[calibration->laser[k].laser_id] = (uint8_t)k;
}

upb_packet_status upb_packet_encoder_set_record(upb_packet_encoder *encoder,
                                                const upb_packet_calibration *calibration) {
    uint8_t record[UPB_RECORD_BYTES];
    if (!encoder || !calibration || !wire_is_hdl64e(encoder->config.sensor) ||
        calibration->sensor != encoder->config.sensor)
        return UPB_PACKET_E_ARGUMENT;
    const upb_packet_status status = upb_record_write(calibration, &encoder->status, record);
    if (status != UPB_PACKET_OK)
        return status;
    memcpy(encoder->record, record, sizeof record);
    encoder->cycle = encoder->record_at = 0;
    place_beams(encoder, calibration);
    return UPB_PACKET_OK;
}

static upb_packet_status set_scale(upb_packet_encoder *encoder, uint32_t unit_um) {
    const uint32_t own_um = upb_sensor_info_get(encoder->config.sensor)->distance_unit_um;
    encoder->scale = unit_um ? unit_um / own_um : 1;
    if (encoder->scale == 0 || encoder->scale > UINT16_MAX || (unit_um && unit_um % own_um))
        return UPB_PACKET_E_ARGUMENT;
    return UPB_PACKET_OK;
}

upb_packet_status upb_packet_encoder_init(upb_packet_encoder *encoder, const upb_packet_encoder_config *config) {
    upb_packet_calibration nominal;
    if (!encoder || !config || config->return_mode < UPB_RETURN_STRONGEST || config->return_mode > UPB_RETURN_DUAL)
        return UPB_PACKET_E_ARGUMENT;
    upb_packet_status status = upb_packet_calibration_default(config->sensor, &nominal);
    if (status != UPB_PACKET_OK)
        return status;
    memset(encoder, 0, sizeof *encoder);
    encoder->config = *config;
    encoder->config.calibration = NULL; /* copied: the caller's may go */
    encoder->status = config->status;
    const upb_packet_calibration *calibration = config->calibration ? config->calibration : &nominal;
    if (calibration->sensor != config->sensor)
        return UPB_PACKET_E_ARGUMENT;
    status = upb_packet_calibration_check(calibration, NULL);
    if (status == UPB_PACKET_OK)
        status = set_scale(encoder, config->distance_unit_um);
    if (status == UPB_PACKET_OK && wire_is_hdl64e(config->sensor))
        status = upb_packet_encoder_set_record(encoder, calibration);
    if (status != UPB_PACKET_OK)
        return status;
    place_beams(encoder, calibration);
    clear_packet(encoder);
    return UPB_PACKET_OK;
}

/* -------------------------------------------------------------------------------------------------------- firings */

static void write_returns(upb_packet_encoder *encoder, const upb_firing *firing, uint8_t *at, uint32_t banks,
                          uint32_t lasers) {
    const uint8_t *beam_of = encoder->place_beam;
    for (uint32_t bank = 0; bank < banks; bank++, at += WIRE_BLOCK_BYTES, beam_of += lasers) {
        uint8_t *p = at;
        for (uint32_t laser = 0; laser < lasers; laser++, p += WIRE_RETURN_BYTES) {
            const uint32_t beam = beam_of[laser];
            const uint32_t distance = encoder->scale * firing->distance[beam];
            if (distance > UINT16_MAX) {
                encoder->stats.too_far++;
                continue; /* the place is 0: no return */
            }
            wire_put16(p, distance);
            p[2] = firing->intensity[beam];
        }
    }
}

static void write_firing(upb_packet_encoder *encoder, const wire_layout *layout, const upb_firing *firing) {
    const uint32_t second = encoder->placed % layout->returns;
    const uint32_t n = encoder->placed / layout->returns;
    const uint32_t slot = n / layout->firings_per_block;
    const uint32_t f = n % layout->firings_per_block;
    const uint32_t lasers = WIRE_BLOCK_LASERS / layout->firings_per_block;
    const uint32_t which = layout->returns == 1 ? 0 : second ? layout->last_at : !layout->last_at;
    uint8_t *at = encoder->packet + WIRE_BLOCK_BYTES * wire_slot_block(layout, slot, which);
    if (f == 0)
        for (uint32_t bank = 0; bank < layout->blocks_per_firing; bank++)
            wire_put16(at + WIRE_BLOCK_BYTES * bank + 2, (firing->azimuth_mdeg + 5) / 10 % WIRE_FULL_TURN_CDEG);
    write_returns(encoder, firing, at + WIRE_RETURNS_AT + f * lasers * WIRE_RETURN_BYTES, layout->blocks_per_firing,
                  lasers);
    if (encoder->placed == 0)
        wire_put32(encoder->packet + WIRE_TIME_AT, (uint32_t)(firing->time_ns % UPB_HOUR_NS / 1000));
}

/* ---------------------------------------------------------------------------------------------------- last two bytes
 */

static uint8_t status_value(const upb_hdl64e_status *status, uint32_t cycle) {
    const uint8_t values[STATUS_CYCLE - RECORD_STEP] = {status->hour, status->minute,        status->second,
                                                        status->day,  status->month,         status->year,
                                                        status->gps,  status->temperature_c, status->firmware};
    return values[cycle];
}

static void write_status(upb_packet_encoder *encoder) {
    uint8_t *type = encoder->packet + WIRE_RETURN_MODE_AT;
    uint8_t *value = encoder->packet + WIRE_MODEL_AT;
    if (encoder->cycle < sizeof status_types) {
        *type = status_types[encoder->cycle];
        *value = status_value(&encoder->status, encoder->cycle);
    } else if (encoder->record_at == RECORD_WARNINGS) {
        *type = 'W';
        *value = encoder->status.warnings;
        encoder->record_at++;
    } else {
        *type = (uint8_t)('1' + encoder->record_at % RECORD_STEP);
        *value = encoder->record[encoder->record_at];
        encoder->record_at = (encoder->record_at + 1) % UPB_RECORD_BYTES;
    }
    encoder->cycle = (encoder->cycle + 1) % STATUS_CYCLE;
}

static void finish_packet(upb_packet_encoder *encoder, uint8_t *packet) {
    if (wire_is_hdl64e(encoder->config.sensor)) {
        write_status(encoder);
    } else {
        encoder->packet[WIRE_RETURN_MODE_AT] = (uint8_t)encoder->config.return_mode;
        encoder->packet[WIRE_MODEL_AT] = upb_sensor_info_get(encoder->config.sensor)->model;
    }
    memcpy(packet, encoder->packet, UPB_PACKET_BYTES);
    encoder->stats.packets++;
    clear_packet(encoder);
}

upb_packet_status upb_packet_encode(upb_packet_encoder *encoder, const upb_firing *firing,
                                    uint8_t packet[UPB_PACKET_BYTES], uint32_t *ready) {
    if (!encoder || !firing || !packet || !ready)
        return UPB_PACKET_E_ARGUMENT;
    *ready = 0;
    const wire_layout layout = wire_layout_of(encoder->config.sensor, encoder->config.return_mode);
    const uint32_t second = encoder->placed % layout.returns;
    if (firing->beams < upb_sensor_info_get(encoder->config.sensor)->beams || firing->beams > UPB_PACKET_BEAMS ||
        firing->azimuth_mdeg >= UPB_FULL_TURN_MDEG || ((firing->flags & UPB_FIRING_SECOND) != 0) != (second != 0))
        return UPB_PACKET_E_ARGUMENT;
    write_firing(encoder, &layout, firing);
    encoder->stats.firings++;
    encoder->placed++;
    if (encoder->placed == layout.slots * layout.firings_per_block * layout.returns) {
        finish_packet(encoder, packet);
        *ready = 1;
    }
    return UPB_PACKET_OK;
}

uint32_t upb_packet_encoder_pending(const upb_packet_encoder *encoder) { return encoder ? encoder->placed : 0; }

uint32_t upb_packet_encoder_drop(upb_packet_encoder *encoder) {
    const uint32_t dropped = upb_packet_encoder_pending(encoder);
    if (dropped)
        clear_packet(encoder);
    return dropped;
}
