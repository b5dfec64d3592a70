/* Firings and packets of every sensor, for the tests. */
#ifndef UPB_TEST_PACKET_MAKER_H
#define UPB_TEST_PACKET_MAKER_H

#include "check.h"
#include "upbeam/packets.h"

static const upb_sensor decoded_sensors[] = {UPB_SENSOR_HDL_32E, UPB_SENSOR_VLP_32C, UPB_SENSOR_VLP_16,
                                             UPB_SENSOR_HDL_64E_S2, UPB_SENSOR_HDL_64E_S3};
static const upb_return_mode return_modes[] = {UPB_RETURN_STRONGEST, UPB_RETURN_LAST, UPB_RETURN_DUAL};
#define DECODED_SENSORS 5u
#define RETURN_MODES 3u

/* A sensor that turns evenly: firing `n` since the start. */
typedef struct spinner {
    upb_sensor sensor;
    uint32_t rate_mdeg_s;
    uint64_t start_ns;
    uint64_t n;
} spinner;

static inline uint32_t spinner_azimuth(const spinner *s, uint64_t n) {
    const uint64_t cycle_ns = upb_sensor_info_get(s->sensor)->firing_cycle_ns;
    return (uint32_t)(n * cycle_ns * s->rate_mdeg_s / 1000000000u % UPB_FULL_TURN_MDEG);
}

static inline upb_firing spinner_next(spinner *s, random_source *random) {
    const upb_sensor_info *info = upb_sensor_info_get(s->sensor);
    upb_firing firing;
    memset(&firing, 0, sizeof firing);
    firing.time_ns = s->start_ns + s->n * info->firing_cycle_ns;
    firing.azimuth_mdeg = spinner_azimuth(s, s->n);
    firing.rate_mdeg_s = s->rate_mdeg_s;
    firing.beams = (uint8_t)info->beams;
    for (uint32_t beam = 0; beam < info->beams; beam++) {
        firing.distance[beam] = random_below(random, 8) ? (uint16_t)random_u32(random) : 0;
        firing.intensity[beam] = (uint8_t)random_u32(random);
    }
    s->n++;
    return firing;
}

/* The other return of a firing: the same in a third of the beams, none in some, never brighter. */
static inline upb_firing other_return(const upb_firing *firing, random_source *random) {
    upb_firing second = *firing;
    second.flags |= UPB_FIRING_SECOND;
    for (uint32_t beam = 0; beam < firing->beams; beam++) {
        if (random_below(random, 3) == 0)
            continue;
        second.distance[beam] = firing->distance[beam] ? (uint16_t)random_u32(random) : 0;
        second.intensity[beam] = (uint8_t)random_below(random, firing->intensity[beam] + 1u);
    }
    return second;
}

/* The next packet; the firings in it, seconds included, go to `firings` (at most UPB_PACKET_FIRINGS). */
static inline uint32_t next_packet(upb_packet_encoder *encoder, spinner *s, random_source *random, upb_firing *firings,
                                   uint8_t *packet) {
    uint32_t ready = 0, count = 0;
    while (!ready && count < UPB_PACKET_FIRINGS) {
        firings[count] = spinner_next(s, random);
        CHECK_EQUAL(upb_packet_encode(encoder, &firings[count], packet, &ready), UPB_PACKET_OK);
        count++;
        if (encoder->config.return_mode == UPB_RETURN_DUAL) {
            firings[count] = other_return(&firings[count - 1], random);
            CHECK_EQUAL(upb_packet_encode(encoder, &firings[count], packet, &ready), UPB_PACKET_OK);
            count++;
        }
    }
    CHECK(ready);
    return count;
}

static inline upb_packet_encoder encoder_of(upb_sensor sensor, upb_return_mode mode) {
    upb_packet_encoder encoder;
    upb_packet_encoder_config config = upb_packet_encoder_config_default(sensor);
    config.return_mode = mode;
    CHECK_EQUAL(upb_packet_encoder_init(&encoder, &config), UPB_PACKET_OK);
    return encoder;
}

static inline upb_packet_decoder decoder_of(upb_sensor sensor, upb_pick pick) {
    upb_packet_decoder decoder;
    upb_packet_decoder_config config = upb_packet_decoder_config_default();
    config.sensor = sensor;
    config.pick = pick;
    CHECK_EQUAL(upb_packet_decoder_init(&decoder, &config), UPB_PACKET_OK);
    return decoder;
}

#endif
