/* The packet codecs: what goes in comes out, what cannot be is refused with its cause. Options: --seed N. */
#include <math.h>

#include "packet_maker.h"

#define TEN_HZ 3600000u /* mdeg a second */

/* ----------------------------------------------------------------------------------------------- there and back */

static void check_same_returns(const upb_firing *got, const upb_firing *expected) {
    CHECK_EQUAL(got->beams, expected->beams);
    CHECK(memcmp(got->distance, expected->distance, sizeof got->distance) == 0);
    CHECK(memcmp(got->intensity, expected->intensity, sizeof got->intensity) == 0);
    CHECK_EQUAL((got->flags ^ expected->flags) & UPB_FIRING_SECOND, 0);
}

static int32_t azimuth_error(uint32_t got, uint32_t expected) {
    int32_t error = (int32_t)got - (int32_t)expected;
    if (error > 180000)
        error -= 360000;
    return error < -180000 ? error + 360000 : error;
}

static void check_place(const upb_firing *got, const upb_firing *expected, int dual, uint64_t span_ns) {
    /* Azimuths are rounded to 10 mdeg; between blocks the packet's rate, known to a part in a hundred, counts too. */
    const int32_t error = azimuth_error(got->azimuth_mdeg, expected->azimuth_mdeg);
    const int32_t limit = got->flags & UPB_FIRING_INTERPOLATED ? 10 : 5;
    CHECK(error >= -limit && error <= limit);
    CHECK(expected->time_ns - got->time_ns < 1000); /* cut to microseconds */
    CHECK(got->azimuth_mdeg < UPB_FULL_TURN_MDEG);
    CHECK_EQUAL((got->flags & UPB_FIRING_DUAL) != 0, dual);
    CHECK(fabs((double)got->rate_mdeg_s - expected->rate_mdeg_s) <= 10e9 / (double)span_ns + 1.0);
}

static void test_round_trip(upb_sensor sensor, upb_return_mode mode, uint32_t rate, random_source *random) {
    upb_packet_encoder encoder = encoder_of(sensor, mode);
    /* A packet alone does not tell an S2, whose cycle is its own. */
    const upb_sensor told = sensor == UPB_SENSOR_HDL_64E_S2 ? sensor : UPB_SENSOR_AUTO;
    upb_packet_decoder decoder = decoder_of(told, UPB_PICK_STRONGEST);
    spinner s = {sensor, rate, 2 * UPB_HOUR_NS - 1000000, 0}; /* the hour passes on the way */
    const uint64_t base_ns = s.start_ns / UPB_HOUR_NS * UPB_HOUR_NS - UPB_HOUR_NS;
    uint8_t packet[UPB_PACKET_BYTES];
    upb_firing sent[UPB_PACKET_FIRINGS], got[UPB_PACKET_FIRINGS];
    const int dual = mode == UPB_RETURN_DUAL;
    uint32_t count = 0;
    for (uint32_t n = 0; n < 40; n++) {
        upb_packet_info info;
        const uint32_t expected = next_packet(&encoder, &s, random, sent, packet);
        CHECK_EQUAL(upb_packet_decode(&decoder, packet, sizeof packet, got, &count, &info), UPB_PACKET_OK);
        CHECK_EQUAL(count, expected);
        CHECK_EQUAL(info.kind, UPB_PACKET_KIND_DATA);
        CHECK_EQUAL(info.return_mode == UPB_RETURN_DUAL, dual);
        /* The last azimuth on the wire: a VLP-16's last block has another firing behind it. */
        const uint32_t between = count - (dual ? 2u : 1u) * upb_sensor_info_get(sensor)->firings_per_block;
        for (uint32_t k = 0; k < count && k < expected; k++) {
            sent[k].time_ns -= base_ns;
            check_same_returns(&got[k], &sent[k]);
            check_place(&got[k], &sent[k], dual, got[between].time_ns - got[0].time_ns);
        }
    }
    CHECK_EQUAL(decoder.stats.packets[UPB_PACKET_OK], 40);
    CHECK_EQUAL(decoder.stats.hours, 1);
    CHECK_EQUAL(decoder.stats.firings, encoder.stats.firings);
    CHECK_EQUAL(upb_sensor_info_get(decoder.sensor)->beams, upb_sensor_info_get(sensor)->beams);
}

static void test_round_trips(random_source *random) {
    static const uint32_t rates[] = {TEN_HZ / 2, TEN_HZ, 2 * TEN_HZ};
    for (uint32_t s = 0; s < DECODED_SENSORS; s++)
        for (uint32_t mode = 0; mode < RETURN_MODES; mode++)
            for (uint32_t rate = 0; rate < 3; rate++)
                test_round_trip(decoded_sensors[s], return_modes[mode], rates[rate], random);
}

/* The last block's returns verbatim, where the caller wants these; the pair of a beam in any case. */
static void test_pick_last(random_source *random) {
    upb_packet_encoder encoder = encoder_of(UPB_SENSOR_VLP_32C, UPB_RETURN_DUAL);
    upb_packet_decoder last = decoder_of(UPB_SENSOR_VLP_32C, UPB_PICK_LAST);
    spinner s = {UPB_SENSOR_VLP_32C, TEN_HZ, 0, 0};
    uint8_t packet[UPB_PACKET_BYTES];
    upb_firing sent[UPB_PACKET_FIRINGS], got[UPB_PACKET_FIRINGS];
    uint32_t count;
    const uint32_t expected = next_packet(&encoder, &s, random, sent, packet);
    CHECK_EQUAL(upb_packet_decode(&last, packet, sizeof packet, got, &count, NULL), UPB_PACKET_OK);
    CHECK_EQUAL(count, expected);
    for (uint32_t k = 0; k + 1 < count; k += 2) {
        CHECK_EQUAL(got[k].return_kind, UPB_RETURN_LAST);
        CHECK_EQUAL(got[k + 1].return_kind, UPB_RETURN_STRONGEST);
        CHECK(memcmp(got[k].distance, sent[k + 1].distance, sizeof sent[k].distance) == 0);
        CHECK(memcmp(got[k + 1].distance, sent[k].distance, sizeof sent[k].distance) == 0);
    }
}

/* A sensor sends the second strongest where the last return is the strongest: the brighter one must win. */
static void test_brighter_wins(void) {
    upb_packet_encoder encoder = encoder_of(UPB_SENSOR_HDL_32E, UPB_RETURN_DUAL);
    upb_packet_decoder decoder = decoder_of(UPB_SENSOR_HDL_32E, UPB_PICK_STRONGEST);
    uint8_t packet[UPB_PACKET_BYTES];
    upb_firing got[UPB_PACKET_FIRINGS], odd, even;
    uint32_t ready = 0, count;
    memset(&odd, 0, sizeof odd);
    odd.beams = 32;
    even = odd;
    even.flags = UPB_FIRING_SECOND;
    odd.distance[0] = 100, odd.intensity[0] = 9, even.distance[0] = 200, even.intensity[0] = 10; /* last is brighter */
    odd.distance[1] = 100, odd.intensity[1] = 9, even.distance[1] = 200, even.intensity[1] = 9; /* equal: as labelled */
    odd.distance[2] = 0, odd.intensity[2] = 50, even.distance[2] = 200, even.intensity[2] = 1;  /* one return only */
    odd.distance[3] = 100, odd.intensity[3] = 1, even.distance[3] = 0, even.intensity[3] = 50;
    for (uint32_t k = 0; k < 6; k++) {
        odd.azimuth_mdeg = even.azimuth_mdeg = 200 * k;
        CHECK_EQUAL(upb_packet_encode(&encoder, &odd, packet, &ready), UPB_PACKET_OK);
        CHECK_EQUAL(upb_packet_encode(&encoder, &even, packet, &ready), UPB_PACKET_OK);
    }
    CHECK(ready);
    CHECK_EQUAL(upb_packet_decode(&decoder, packet, sizeof packet, got, &count, NULL), UPB_PACKET_OK);
    CHECK_EQUAL(got[0].distance[0], 200);
    CHECK_EQUAL(got[1].distance[0], 100);
    CHECK_EQUAL(got[0].distance[1], 100);
    CHECK_EQUAL(got[0].distance[2], 200);
    CHECK_EQUAL(got[1].distance[2], 0);
    CHECK_EQUAL(got[0].distance[3], 100);
    CHECK(got[0].flags == UPB_FIRING_DUAL && got[1].flags == (UPB_FIRING_DUAL | UPB_FIRING_SECOND));
}

/* ------------------------------------------------------------------------------------------------------- refusals */

static void expect(const uint8_t *packet, size_t n, upb_packet_status status) {
    static upb_firing firings[UPB_PACKET_FIRINGS];
    upb_packet_decoder decoder = decoder_of(UPB_SENSOR_AUTO, UPB_PICK_STRONGEST);
    uint32_t count = 77;
    upb_packet_info info;
    CHECK_EQUAL(upb_packet_identify(packet, n, &info), status);
    CHECK_EQUAL(upb_packet_decode(&decoder, packet, n, firings, &count, NULL), status);
    CHECK(status == UPB_PACKET_OK || count == 0);
    CHECK_EQUAL(decoder.stats.packets[status], 1);
    CHECK(upb_packet_status_text(status)[0] != 0);
}

static void test_sizes(const uint8_t *packet) {
    static const uint32_t ouster[] = {3392, 6464, 12608, 24896, 8448, 16640, 33024};
    static uint8_t large[65536];
    memcpy(large, packet, UPB_PACKET_BYTES);
    for (uint32_t n = 0; n < 2000; n++)
        if (n != UPB_PACKET_BYTES && n != UPB_POSITION_PACKET_BYTES)
            expect(large, n, UPB_PACKET_E_SIZE);
    for (uint32_t k = 0; k < 7; k++)
        expect(large, ouster[k], UPB_PACKET_E_OUSTER);
}

static void test_damage(upb_sensor sensor, random_source *random) {
    const int banks = upb_sensor_info_get(sensor)->blocks_per_firing == 2;
    upb_packet_encoder encoder = encoder_of(sensor, UPB_RETURN_STRONGEST);
    spinner s = {sensor, TEN_HZ, 0, 0};
    uint8_t good[UPB_PACKET_BYTES], packet[UPB_PACKET_BYTES];
    upb_firing sent[UPB_PACKET_FIRINGS];
    next_packet(&encoder, &s, random, sent, good);
    expect(good, sizeof good, UPB_PACKET_OK);
    for (uint32_t block = 0; block < UPB_PACKET_BLOCKS; block++) {
        memcpy(packet, good, sizeof good);
        packet[100 * block] ^= 1;
        /* A second block of neither bank leaves an HDL-64E's packet to be told by a model byte it does not have. */
        expect(packet, sizeof packet, banks && block == 1 ? UPB_PACKET_E_MODEL : UPB_PACKET_E_FLAG);
        memcpy(packet, good, sizeof good);
        packet[100 * block + 2] = 0xA0; /* 36000 */
        packet[100 * block + 3] = 0x8C;
        expect(packet, sizeof packet, UPB_PACKET_E_AZIMUTH);
    }
    memcpy(packet, good, sizeof good);
    packet[1200] = 0x00, packet[1201] = 0xA4, packet[1202] = 0x93, packet[1203] = 0xD6; /* 3600000000 */
    expect(packet, sizeof packet, UPB_PACKET_E_TIME);
    memset(packet, 0, sizeof packet);
    expect(packet, sizeof packet, UPB_PACKET_E_FLAG); /* the empty packet some drivers append */
    if (banks)
        return;
    static const struct {
        uint8_t model;
        upb_packet_status status;
    } models[] = {{0xA1, UPB_PACKET_E_VLS_128},  {0x23, UPB_PACKET_E_VLP_32AB}, {0x24, UPB_PACKET_E_PUCK_HIRES},
                  {0x31, UPB_PACKET_E_VELARRAY}, {0x00, UPB_PACKET_E_MODEL},    {0xFF, UPB_PACKET_E_MODEL}};
    memcpy(packet, good, sizeof good);
    for (uint32_t k = 0; k < sizeof models / sizeof models[0]; k++) {
        packet[1205] = models[k].model;
        expect(packet, sizeof packet, models[k].status);
    }
    memcpy(packet, good, sizeof good);
    for (uint32_t mode = 0; mode < 256; mode++) {
        packet[1204] = (uint8_t)mode;
        /* Dual needs pairs of equal azimuth: this packet has none. */
        expect(packet, sizeof packet,
               mode == 0x37 || mode == 0x38 ? UPB_PACKET_OK
               : mode == 0x39               ? UPB_PACKET_E_RETURN_PAIR
                                            : UPB_PACKET_E_RETURN_MODE);
    }
}

/* Four banks, as a VLS-128 sends them: no HDL-64E. */
static void test_vls128(const uint8_t *hdl32e) {
    static const uint8_t bank[4] = {0xEE, 0xDD, 0xCC, 0xBB};
    uint8_t packet[UPB_PACKET_BYTES];
    memcpy(packet, hdl32e, sizeof packet);
    for (uint32_t block = 0; block < UPB_PACKET_BLOCKS; block++)
        packet[100 * block + 1] = bank[block % 4];
    packet[1205] = 0xA1;
    expect(packet, sizeof packet, UPB_PACKET_E_VLS_128);
}

static void test_other_sensor(random_source *random) {
    upb_firing firings[UPB_PACKET_FIRINGS];
    uint8_t packet[UPB_PACKET_BYTES];
    for (uint32_t a = 0; a < DECODED_SENSORS; a++)
        for (uint32_t b = 0; b < DECODED_SENSORS; b++) {
            const int both_64 = a >= 3 && b >= 3; /* one packet does not tell the series */
            upb_packet_encoder encoder = encoder_of(decoded_sensors[b], UPB_RETURN_STRONGEST);
            upb_packet_decoder decoder = decoder_of(decoded_sensors[a], UPB_PICK_STRONGEST);
            spinner s = {decoded_sensors[b], TEN_HZ, 0, 0};
            uint32_t count = 5;
            next_packet(&encoder, &s, random, firings, packet);
            const upb_packet_status status = upb_packet_decode(&decoder, packet, sizeof packet, firings, &count, NULL);
            CHECK_EQUAL(status, a == b || both_64 ? UPB_PACKET_OK : UPB_PACKET_E_SENSOR);
            CHECK_EQUAL(count == 0, status != UPB_PACKET_OK);
        }
}

static void test_arguments(void) {
    upb_packet_decoder decoder;
    upb_packet_decoder_config config = upb_packet_decoder_config_default();
    upb_packet_calibration calibration;
    CHECK_EQUAL(upb_packet_decoder_init(NULL, &config), UPB_PACKET_E_ARGUMENT);
    CHECK_EQUAL(upb_packet_decoder_init(&decoder, NULL), UPB_PACKET_E_ARGUMENT);
    for (uint32_t k = UPB_SENSOR_VLS_128; k <= UPB_SENSORS; k++) {
        config.sensor = (upb_sensor)k;
        CHECK_EQUAL(upb_packet_decoder_init(&decoder, &config), UPB_PACKET_E_ARGUMENT);
    }
    config.sensor = UPB_SENSOR_VLP_16;
    config.calibration = &calibration;
    CHECK_EQUAL(upb_packet_calibration_default(UPB_SENSOR_HDL_32E, &calibration), UPB_PACKET_OK);
    CHECK_EQUAL(upb_packet_decoder_init(&decoder, &config), UPB_PACKET_E_ARGUMENT); /* of another sensor */
    CHECK_EQUAL(upb_packet_calibration_default(UPB_SENSOR_VLP_16, &calibration), UPB_PACKET_OK);
    CHECK_EQUAL(upb_packet_decoder_init(&decoder, &config), UPB_PACKET_OK);
    calibration.laser[3].laser_id = calibration.laser[4].laser_id;
    CHECK_EQUAL(upb_packet_decoder_init(&decoder, &config), UPB_PACKET_E_CALIBRATION);
    config.sensor = UPB_SENSOR_AUTO;
    CHECK_EQUAL(upb_packet_decoder_init(&decoder, &config), UPB_PACKET_E_ARGUMENT);
    CHECK(upb_sensor_info_get((upb_sensor)UPB_SENSORS) == NULL && upb_sensor_info_get((upb_sensor)-1) == NULL);
    CHECK_EQUAL(upb_sensor_by_name("HDL-32e"), UPB_SENSOR_HDL_32E);
    CHECK(upb_sensor_by_name("hdl-32") == UPB_SENSOR_AUTO && upb_sensor_by_name(NULL) == UPB_SENSOR_AUTO);
    CHECK(strcmp(upb_packet_status_text((upb_packet_status)UPB_PACKET_STATUSES), "no such status") == 0);
}

/* ------------------------------------------------------------------------------------------------- azimuth and time */

/* A part of the turn is left out in the middle of a packet: the rate must not smear, time must go on. */
static void test_jump(random_source *random) {
    upb_packet_encoder encoder = encoder_of(UPB_SENSOR_VLP_32C, UPB_RETURN_STRONGEST);
    upb_packet_decoder decoder = decoder_of(UPB_SENSOR_VLP_32C, UPB_PICK_STRONGEST);
    spinner s = {UPB_SENSOR_VLP_32C, TEN_HZ, UPB_HOUR_NS, 0};
    uint8_t packet[UPB_PACKET_BYTES];
    upb_firing got[UPB_PACKET_FIRINGS];
    uint32_t ready = 0, count;
    for (uint32_t k = 0; k < 12; k++) {
        if (k == 5)
            s.n += 904; /* about half a turn */
        const upb_firing firing = spinner_next(&s, random);
        CHECK_EQUAL(upb_packet_encode(&encoder, &firing, packet, &ready), UPB_PACKET_OK);
    }
    CHECK_EQUAL(upb_packet_decode(&decoder, packet, sizeof packet, got, &count, NULL), UPB_PACKET_OK);
    CHECK_EQUAL(decoder.stats.jumps, 1);
    for (uint32_t k = 0; k < count; k++) {
        CHECK_EQUAL(got[k].flags & UPB_FIRING_JUMP, k == 5 ? UPB_FIRING_JUMP : 0);
        CHECK(fabs((double)got[k].rate_mdeg_s - TEN_HZ) < 0.02 * TEN_HZ);
    }
    const double step_ns = (double)(got[5].time_ns - got[4].time_ns);
    CHECK(fabs(step_ns - 905 * 55296.0) < 0.02 * 905 * 55296.0);
    CHECK_EQUAL(got[11].time_ns - got[5].time_ns, 6 * 55296);
}

static void test_swapped_at_the_hour(random_source *random) {
    upb_packet_encoder encoder = encoder_of(UPB_SENSOR_HDL_32E, UPB_RETURN_STRONGEST);
    upb_packet_decoder decoder = decoder_of(UPB_SENSOR_AUTO, UPB_PICK_STRONGEST);
    spinner s = {UPB_SENSOR_HDL_32E, TEN_HZ, UPB_HOUR_NS - 1000000, 0};
    static uint8_t packet[6][UPB_PACKET_BYTES];
    static const uint32_t order[6] = {0, 2, 1, 3, 5, 4};
    upb_firing firings[UPB_PACKET_FIRINGS];
    uint64_t first_ns = 0;
    uint32_t count;
    for (uint32_t k = 0; k < 6; k++)
        next_packet(&encoder, &s, random, firings, packet[k]);
    for (uint32_t k = 0; k < 6; k++) {
        CHECK_EQUAL(upb_packet_decode(&decoder, packet[order[k]], UPB_PACKET_BYTES, firings, &count, NULL), 0);
        if (k == 0)
            first_ns = firings[0].time_ns;
        const uint64_t expected = first_ns + (uint64_t)order[k] * 12 * 46080;
        CHECK(firings[0].time_ns + 1000 >= expected && firings[0].time_ns <= expected + 1000);
    }
    CHECK_EQUAL(decoder.stats.hours, 1);
}

/* --------------------------------------------------------------------------------------------------- calibrations */

static void test_calibrations(void) {
    upb_packet_calibration c, copy;
    uint32_t beam = 0;
    for (uint32_t k = 0; k < DECODED_SENSORS; k++) {
        CHECK_EQUAL(upb_packet_calibration_default(decoded_sensors[k], &c), UPB_PACKET_OK);
        CHECK_EQUAL(upb_packet_calibration_check(&c, &beam), UPB_PACKET_OK);
        for (uint32_t b = 0; b < c.beams; b++)
            CHECK(c.laser[b].fire_time_ns < upb_sensor_info_get(c.sensor)->firing_cycle_ns);
    }
    CHECK_EQUAL(upb_packet_calibration_default(UPB_SENSOR_OUSTER, &c), UPB_PACKET_E_ARGUMENT);
    CHECK_EQUAL(upb_packet_calibration_default(UPB_SENSOR_HDL_64E_S3, &c), UPB_PACKET_OK);
#define BROKEN(change)                                                                                                 \
    copy = c;                                                                                                          \
    change;                                                                                                            \
    CHECK_EQUAL(upb_packet_calibration_check(&copy, &beam), UPB_PACKET_E_CALIBRATION)
    BROKEN(copy.laser[7].laser_id = 64);
    CHECK_EQUAL(beam, 7);
    BROKEN(copy.laser[9].laser_id = copy.laser[8].laser_id);
    CHECK_EQUAL(beam, 9);
    BROKEN(copy.laser[20].elevation_mdeg = copy.laser[19].elevation_mdeg + 1);
    BROKEN(copy.laser[0].elevation_mdeg = 90001);
    BROKEN(copy.laser[63].azimuth_offset_mdeg = -90001);
    BROKEN(copy.laser[1].fire_time_ns = 57600);
    BROKEN(copy.laser[1].distance_correction_um = 40000000);
    BROKEN((copy.laser[1].min_intensity = 9, copy.laser[1].max_intensity = 8));
    BROKEN(copy.beams = 63);
    BROKEN(copy.two_point = 2);
#undef BROKEN
    copy = c;
    for (uint32_t k = 0; k < 32; k++) {
        const upb_laser swap = copy.laser[k];
        copy.laser[k] = copy.laser[63 - k];
        copy.laser[63 - k] = swap;
    }
    CHECK_EQUAL(upb_packet_calibration_check(&copy, NULL), UPB_PACKET_E_CALIBRATION);
    upb_packet_calibration_sort(&copy);
    CHECK(memcmp(&copy, &c, sizeof c) == 0);
}

static void test_rows(void) {
    int32_t elevation[UPB_PACKET_BEAMS];
    upb_packet_calibration c;
    for (int32_t row = 0; row < 64; row++)
        elevation[row] = 10667 - row * 656;
    CHECK_EQUAL(upb_packet_calibration_rows(elevation, 2170, &c), UPB_PACKET_OK);
    for (uint32_t row = 0; row < 64; row++) {
        const upb_laser *laser = &c.laser[row];
        CHECK_EQUAL(laser->laser_id, row % 2 * 32 + row / 2); /* measured rows in the upper bank */
        CHECK(laser->distance_correction_um == 0 && laser->vertical_offset_um == 0 && laser->horizontal_offset_um == 0);
        const double turn = 360000.0 / 2170 * laser->fire_time_ns / 57600;
        CHECK(fabs(laser->azimuth_offset_mdeg + turn) <= 5.0 && laser->azimuth_offset_mdeg % 10 == 0);
    }
    CHECK_EQUAL(upb_packet_calibration_rows(elevation, 3, &c), UPB_PACKET_E_ARGUMENT);
    elevation[10] = elevation[9] - 1; /* the same after rounding */
    elevation[9] -= elevation[9] % 10;
    elevation[10] = elevation[9] - 1;
    CHECK_EQUAL(upb_packet_calibration_rows(elevation, 2170, &c), UPB_PACKET_E_CALIBRATION);
}

/* --------------------------------------------------------------------------------------------------------- record */

static upb_packet_calibration random_unit(upb_sensor sensor, random_source *random) {
    upb_packet_calibration c;
    CHECK_EQUAL(upb_packet_calibration_default(sensor, &c), UPB_PACKET_OK);
    c.two_point = 1;
    for (uint32_t k = 0; k < c.beams; k++) {
        upb_laser *laser = &c.laser[k];
        laser->azimuth_offset_mdeg = 10 * ((int32_t)random_below(random, 1800) - 900);
        laser->distance_correction_um = 1000 * (int32_t)random_below(random, 2000);
        laser->distance_x_um = 1000 + laser->distance_correction_um;
        laser->distance_y_um = 1000 * (int32_t)random_below(random, 2000);
        laser->focal_distance_um = 1000 * (int32_t)random_below(random, 30000);
        laser->focal_slope_e4 = 1000 * ((int32_t)random_below(random, 40) - 20);
        laser->min_intensity = (uint8_t)random_below(random, 40);
    }
    return c;
}

static void test_record(random_source *random) {
    for (uint32_t k = 3; k < DECODED_SENSORS; k++) {
        const upb_packet_calibration unit = random_unit(decoded_sensors[k], random);
        upb_hdl64e_status status = upb_packet_encoder_config_default(unit.sensor).status, got_status;
        upb_packet_calibration got;
        uint8_t record[UPB_RECORD_BYTES];
        status.humidity = 33, status.rpm = 1200, status.warnings = UPB_WARNING_LENS, status.life_hours = 60000;
        status.ip_source[0] = 192, status.power_level = 0xA0, status.upper_threshold = 24;
        memset(&got_status, 0, sizeof got_status);
        CHECK_EQUAL(upb_record_write(&unit, &status, record), UPB_PACKET_OK);
        CHECK_EQUAL(upb_record_read(record, &got, &got_status), UPB_PACKET_OK);
        CHECK(memcmp(&got, &unit, sizeof unit) == 0);
        got_status.hour = status.hour, got_status.day = status.day, got_status.month = status.month;
        got_status.gps = status.gps;
        CHECK(memcmp(&got_status, &status, sizeof status) == 0);
        record[8] ^= 1; /* an angle of laser 0: an S3's checksum tells, an S2 has none */
        const upb_packet_status damaged = upb_record_read(record, &got, &got_status);
        CHECK(unit.sensor == UPB_SENSOR_HDL_64E_S2 || damaged == UPB_PACKET_E_CALIBRATION);
    }
}

/* Packets of an HDL-64E until the decoder has its record, from anywhere in the cycle. */
static uint32_t packets_until_record(upb_packet_encoder *encoder, upb_packet_decoder *decoder, spinner *s,
                                     random_source *random, uint32_t lose_every, uint32_t limit) {
    uint8_t packet[UPB_PACKET_BYTES];
    upb_firing firings[UPB_PACKET_FIRINGS];
    const uint64_t before = decoder->stats.records;
    uint32_t count;
    for (uint32_t n = 1; n <= limit; n++) {
        next_packet(encoder, s, random, firings, packet);
        if (lose_every && n % lose_every == 0)
            continue;
        CHECK_EQUAL(upb_packet_decode(decoder, packet, sizeof packet, firings, &count, NULL), UPB_PACKET_OK);
        if (n % 50 == 0) /* a duplicate must not shift the record */
            CHECK_EQUAL(upb_packet_decode(decoder, packet, sizeof packet, firings, &count, NULL), UPB_PACKET_OK);
        if (decoder->stats.records > before)
            return n;
    }
    return 0;
}

static void test_record_stream(upb_sensor sensor, random_source *random) {
    const upb_packet_calibration unit = random_unit(sensor, random);
    upb_packet_encoder encoder;
    upb_packet_encoder_config config = upb_packet_encoder_config_default(sensor);
    config.calibration = &unit;
    CHECK_EQUAL(upb_packet_encoder_init(&encoder, &config), UPB_PACKET_OK);
    upb_packet_decoder decoder = decoder_of(UPB_SENSOR_AUTO, UPB_PICK_STRONGEST);
    spinner s = {sensor, TEN_HZ, 0, 0};
    encoder.status.temperature_c = 51;
    encoder.cycle = random_below(random, 16), encoder.record_at = random_below(random, UPB_RECORD_BYTES);
    const uint32_t n = packets_until_record(&encoder, &decoder, &s, random, 0, 2 * UPB_RECORD_PACKETS);
    CHECK(n >= UPB_RECORD_PACKETS - 16 && n <= UPB_RECORD_PACKETS + 16);
    CHECK_EQUAL(decoder.sensor, sensor); /* the series is known now */
    CHECK(memcmp(&decoder.calibration, &unit, sizeof unit) == 0);
    CHECK_EQUAL(decoder.status.temperature_c, 51);
    CHECK_EQUAL(decoder.stats.records_bad, 0);
    /* With a loss in each round of an S3 no record passes its checksum; without, the next whole round does. */
    CHECK_EQUAL(packets_until_record(&encoder, &decoder, &s, random, 1000, 9000), 0);
    CHECK(sensor == UPB_SENSOR_HDL_64E_S2 || decoder.stats.records_bad > 0);
    CHECK(packets_until_record(&encoder, &decoder, &s, random, 0, 3 * UPB_RECORD_PACKETS) > 0);
    CHECK(memcmp(&decoder.calibration, &unit, sizeof unit) == 0);
}

/* A new table begins the cycle and the record anew. */
static void test_set_record(random_source *random) {
    const upb_packet_calibration unit = random_unit(UPB_SENSOR_HDL_64E_S3, random);
    upb_packet_encoder encoder = encoder_of(UPB_SENSOR_HDL_64E_S3, UPB_RETURN_STRONGEST);
    spinner s = {UPB_SENSOR_HDL_64E_S3, TEN_HZ, 0, 0};
    uint8_t packet[UPB_PACKET_BYTES];
    upb_firing firings[UPB_PACKET_FIRINGS];
    for (uint32_t n = 0; n < 100; n++)
        next_packet(&encoder, &s, random, firings, packet);
    CHECK_EQUAL(upb_packet_encoder_set_record(&encoder, &unit), UPB_PACKET_OK);
    for (uint32_t n = 0; n < 16; n++) {
        next_packet(&encoder, &s, random, firings, packet);
        CHECK_EQUAL(packet[1204], "HMSDNYGTV1234567"[n]);
        CHECK(n < 9 || n >= 14 || packet[1205] == (uint8_t)"UNIT#"[n - 9]);
    }
}

/* An azimuth that stands still is no dual return. */
static void test_stuck_is_not_dual(void) {
    upb_packet_encoder encoder = encoder_of(UPB_SENSOR_HDL_64E_S3, UPB_RETURN_STRONGEST);
    upb_packet_decoder decoder = decoder_of(UPB_SENSOR_AUTO, UPB_PICK_STRONGEST);
    uint8_t packet[UPB_PACKET_BYTES];
    upb_firing firing, got[UPB_PACKET_FIRINGS];
    uint32_t ready = 0, count;
    memset(&firing, 0, sizeof firing);
    firing.beams = 64;
    while (!ready)
        CHECK_EQUAL(upb_packet_encode(&encoder, &firing, packet, &ready), UPB_PACKET_OK);
    CHECK_EQUAL(upb_packet_decode(&decoder, packet, sizeof packet, got, &count, NULL), UPB_PACKET_OK);
    CHECK(count == 6 && got[0].flags == UPB_FIRING_EMPTY && got[0].rate_mdeg_s == 0);
}

/* -------------------------------------------------------------------------------------------------------- encoder */

static void test_encoder(random_source *random) {
    upb_packet_encoder encoder;
    upb_packet_encoder_config config = upb_packet_encoder_config_default(UPB_SENSOR_HDL_64E_S3);
    uint8_t packet[UPB_PACKET_BYTES];
    uint32_t ready = 0;
    config.distance_unit_um = 4000;
    CHECK_EQUAL(upb_packet_encoder_init(&encoder, &config), UPB_PACKET_OK);
    spinner s = {UPB_SENSOR_HDL_64E_S3, TEN_HZ, 0, 0};
    upb_firing firing = spinner_next(&s, random);
    memset(firing.distance, 0, sizeof firing.distance);
    firing.distance[0] = 32767, firing.distance[2] = 32768, firing.distance[4] = 65535;
    for (uint32_t k = 0; k < 6; k++)
        CHECK_EQUAL(upb_packet_encode(&encoder, &firing, packet, &ready), UPB_PACKET_OK);
    CHECK(ready);
    CHECK_EQUAL(encoder.stats.too_far, 12);
    upb_packet_decoder decoder = decoder_of(UPB_SENSOR_AUTO, UPB_PICK_STRONGEST);
    upb_firing got[UPB_PACKET_FIRINGS];
    uint32_t count;
    CHECK_EQUAL(upb_packet_decode(&decoder, packet, sizeof packet, got, &count, NULL), UPB_PACKET_OK);
    CHECK(got[0].distance[0] == 65534 && got[0].distance[2] == 0 && got[0].distance[4] == 0);
    firing.azimuth_mdeg = 360000;
    CHECK_EQUAL(upb_packet_encode(&encoder, &firing, packet, &ready), UPB_PACKET_E_ARGUMENT);
    firing.azimuth_mdeg = 359996; /* rounds to the next turn's 0 */
    CHECK_EQUAL(upb_packet_encode(&encoder, &firing, packet, &ready), UPB_PACKET_OK);
    CHECK(encoder.packet[2] == 0 && encoder.packet[3] == 0);
    firing.flags = UPB_FIRING_SECOND;
    CHECK_EQUAL(upb_packet_encode(&encoder, &firing, packet, &ready), UPB_PACKET_E_ARGUMENT);
    firing.flags = 0, firing.beams = 63;
    CHECK_EQUAL(upb_packet_encode(&encoder, &firing, packet, &ready), UPB_PACKET_E_ARGUMENT);
    CHECK_EQUAL(upb_packet_encoder_pending(&encoder), 1);
    CHECK_EQUAL(upb_packet_encoder_drop(&encoder), 1);
    CHECK_EQUAL(upb_packet_encoder_pending(&encoder), 0);
    config.distance_unit_um = 3000;
    CHECK_EQUAL(upb_packet_encoder_init(&encoder, &config), UPB_PACKET_E_ARGUMENT);
    config.sensor = UPB_SENSOR_VLS_128;
    CHECK_EQUAL(upb_packet_encoder_init(&encoder, &config), UPB_PACKET_E_ARGUMENT);
}

/* ------------------------------------------------------------------------------------------------ position packets */

static void test_position(void) {
    static const char nmea[] = "$GPRMC,123519,A,4807.038,N,01131.000,E,022.4,084.4,230394,003.1,W*6A";
    upb_position sent, got;
    uint8_t packet[UPB_POSITION_PACKET_BYTES];
    memset(&sent, 0, sizeof sent);
    sent.time_us = 3599999999u, sent.pps = UPB_PPS_LOCKED, sent.thermal_shutdown = 1;
    sent.temperature_top = 60, sent.temperature_bottom = 61, sent.temperature_at_shutdown = 90;
    sent.temperature_at_power_up = 20, sent.adc_temperature = 40, sent.adc_temperature_change = -5;
    sent.adc_seconds = 100000, sent.adc_reason = 4, sent.adc_flags = 7;
    memcpy(sent.nmea, nmea, sizeof nmea);
    CHECK_EQUAL(upb_position_encode(&sent, packet), UPB_PACKET_OK);
    CHECK_EQUAL(upb_position_decode(packet, sizeof packet, &got), UPB_PACKET_OK);
    CHECK_EQUAL(got.nmea_valid, 1);
    got.nmea_valid = 0;
    CHECK(memcmp(&got, &sent, sizeof got) == 0);
    expect(packet, sizeof packet, UPB_PACKET_OK);
    packet[210] ^= 2; /* a letter of the sentence: text still, the checksum is wrong */
    CHECK_EQUAL(upb_position_decode(packet, sizeof packet, &got), UPB_PACKET_OK);
    CHECK_EQUAL(got.nmea_valid, 0);
    packet[210] = 0x07;
    expect(packet, sizeof packet, UPB_PACKET_E_POSITION);
    packet[210] = 'A', packet[202] = 4;
    expect(packet, sizeof packet, UPB_PACKET_E_POSITION);
    packet[202] = 0, packet[201] = 0xFF;
    expect(packet, sizeof packet, UPB_PACKET_E_TIME);
    CHECK_EQUAL(upb_position_decode(packet, 511, &got), UPB_PACKET_E_SIZE);
    sent.time_us++;
    CHECK_EQUAL(upb_position_encode(&sent, packet), UPB_PACKET_E_ARGUMENT);
}

/* -------------------------------------------------------------------------------------------------------- tracking */

static upb_step track(upb_azimuth_tracker *tracker, const spinner *s, uint64_t n) {
    upb_firing firing;
    memset(&firing, 0, sizeof firing);
    firing.time_ns = s->start_ns + n * upb_sensor_info_get(s->sensor)->firing_cycle_ns;
    firing.azimuth_mdeg = spinner_azimuth(s, n) / 10 * 10;
    firing.rate_mdeg_s = s->rate_mdeg_s;
    return upb_azimuth_track(tracker, &firing);
}

static upb_azimuth_tracker tracker_of(upb_sensor sensor, uint32_t cut_mdeg) {
    upb_azimuth_tracker tracker;
    CHECK_EQUAL(upb_azimuth_tracker_init(&tracker, cut_mdeg, upb_sensor_info_get(sensor)->firing_cycle_ns),
                UPB_PACKET_OK);
    return tracker;
}

/* Losses in bursts up to several turns: every firing keeps its number, every turn its frame. */
static void test_losses(random_source *random) {
    for (uint32_t k = 0; k < DECODED_SENSORS; k++) {
        const spinner s = {decoded_sensors[k], TEN_HZ / 2 * (1 + random_below(random, 4)), UPB_HOUR_NS, 0};
        const uint32_t cut_mdeg = random_below(random, 360000);
        upb_azimuth_tracker tracker = tracker_of(s.sensor, cut_mdeg);
        const int64_t to_cut = ((int64_t)spinner_azimuth(&s, 0) + 360000 - cut_mdeg) % 360000;
        const uint64_t cycle_ns = upb_sensor_info_get(s.sensor)->firing_cycle_ns;
        uint64_t n = 0;
        for (uint32_t packet = 0; packet < 3000; packet++) {
            const uint32_t burst = random_below(random, 2) ? 10 : 700;
            const uint32_t lost = packet == 0 || random_below(random, 10) ? 0 : 12 * random_below(random, burst);
            n += lost;
            for (uint32_t f = 0; f < 12; f++, n++) {
                const upb_step step = track(&tracker, &s, n);
                CHECK_EQUAL(step.firing, (int64_t)n);
                CHECK_EQUAL(step.missing, f == 0 ? lost : 0);
                const uint64_t turned = n * cycle_ns * s.rate_mdeg_s / 1000000000u;
                const int64_t angle = to_cut + (int64_t)turned;
                CHECK(step.angle_mdeg <= angle + 10 && step.angle_mdeg >= angle - 10);
                CHECK_EQUAL(step.frame, (uint64_t)step.angle_mdeg / 360000);
                CHECK(!(step.flags & (UPB_STEP_LATE | UPB_STEP_TIME_JUMP | UPB_STEP_STUCK | UPB_STEP_RESTART)));
            }
        }
    }
}

static void test_late(void) {
    const spinner s = {UPB_SENSOR_HDL_32E, TEN_HZ, UPB_HOUR_NS, 0};
    upb_azimuth_tracker tracker = tracker_of(s.sensor, 180000);
    CHECK_EQUAL(track(&tracker, &s, 100).flags, UPB_STEP_FIRST);
    CHECK_EQUAL(track(&tracker, &s, 101).flags, 0);
    upb_step step = track(&tracker, &s, 101); /* a duplicate */
    CHECK(step.flags == UPB_STEP_LATE && step.firing == 1);
    step = track(&tracker, &s, 125);
    CHECK(step.missing == 23 && step.firing == 25);
    step = track(&tracker, &s, 113); /* the packets were swapped */
    CHECK(step.flags == UPB_STEP_LATE && step.firing == 13 && step.missing == 0);
    step = track(&tracker, &s, 90); /* before the first one */
    CHECK(step.flags == UPB_STEP_LATE && step.firing == -10);
    step = track(&tracker, &s, 126);
    CHECK(step.flags == 0 && step.firing == 26);
}

static void test_troubles(void) {
    spinner s = {UPB_SENSOR_HDL_32E, TEN_HZ, 5 * UPB_HOUR_NS, 0};
    upb_azimuth_tracker tracker = tracker_of(s.sensor, 0);
    uint64_t n = 0;
    while (n < 500)
        track(&tracker, &s, n++);
    s.start_ns += 30000000; /* the sensor's clock was set: the azimuth knows that nothing is missing */
    upb_step step = track(&tracker, &s, n);
    CHECK(step.flags == UPB_STEP_TIME_JUMP && step.missing == 0 && step.firing == 500);
    CHECK_EQUAL(track(&tracker, &s, n + 1).flags, 0);
    CHECK_EQUAL(upb_azimuth_turn_firings(&tracker), 2170);
    const upb_firing stuck = {.time_ns = tracker.time_ns + 46080, .azimuth_mdeg = tracker.azimuth_mdeg};
    step = upb_azimuth_track(&tracker, &stuck);
    CHECK_EQUAL(step.flags, UPB_STEP_STUCK);
    s.start_ns += 2 * UPB_TRACKER_LOST_NS;
    const uint64_t frame = step.frame;
    step = track(&tracker, &s, n + 3);
    CHECK(step.flags == (UPB_STEP_RESTART | UPB_STEP_FRAME) && step.missing == 0 && step.frame == frame + 1);
    CHECK_EQUAL(upb_azimuth_tracker_init(&tracker, 360000, 46080), UPB_PACKET_E_ARGUMENT);
    CHECK_EQUAL(upb_azimuth_tracker_init(&tracker, 0, 0), UPB_PACKET_E_ARGUMENT);
}

static upb_step track_at(upb_azimuth_tracker *tracker, uint64_t time_ns, uint32_t azimuth_mdeg, uint32_t rate_mdeg_s) {
    upb_firing firing;
    memset(&firing, 0, sizeof firing);
    firing.time_ns = time_ns;
    firing.azimuth_mdeg = azimuth_mdeg;
    firing.rate_mdeg_s = rate_mdeg_s;
    return upb_azimuth_track(tracker, &firing);
}

/* The clock is some firings wrong, either way, or goes on where the azimuth jumps: the azimuth counts. */
static void test_azimuth_is_believed(void) {
    static const int64_t wrong[] = {-11, -4, -1, 1, 5};
    for (uint32_t k = 0; k < sizeof wrong / sizeof wrong[0]; k++) {
        spinner s = {UPB_SENSOR_VLP_32C, TEN_HZ, 5 * UPB_HOUR_NS, 0};
        upb_azimuth_tracker tracker = tracker_of(s.sensor, 0);
        for (uint64_t n = 0; n < 100; n++)
            track(&tracker, &s, n);
        s.start_ns += (uint64_t)(wrong[k] * 55296);
        const upb_step step = track(&tracker, &s, 100);
        CHECK(step.flags == UPB_STEP_TIME_JUMP && step.firing == 100 && step.missing == 0);
        CHECK(track(&tracker, &s, 102).missing == 1);
    }
    upb_azimuth_tracker tracker = tracker_of(UPB_SENSOR_HDL_32E, 0);
    track_at(&tracker, UPB_HOUR_NS, 0, TEN_HZ);
    track_at(&tracker, UPB_HOUR_NS + 46080, 170, TEN_HZ);
    const upb_step step = track_at(&tracker, UPB_HOUR_NS + 2 * 46080, 60170, TEN_HZ);
    CHECK(step.flags == UPB_STEP_TIME_JUMP && step.missing >= 355 && step.missing <= 365);
}

/* An azimuth that trembles at the cut begins one frame, not three. */
static void test_trembling_cut(void) {
    static const uint32_t azimuth[] = {89840, 89990, 90000, 89990, 90010, 90170};
    upb_azimuth_tracker tracker = tracker_of(UPB_SENSOR_HDL_32E, 90000);
    uint32_t frames = 0;
    for (uint32_t k = 0; k < 6; k++) {
        const upb_step step = track_at(&tracker, UPB_HOUR_NS + k * 46080, azimuth[k], TEN_HZ);
        frames += (step.flags & UPB_STEP_FRAME) != 0;
        CHECK_EQUAL(step.frame, k < 2 ? 0 : 1);
        CHECK_EQUAL(step.firing, k);
    }
    CHECK_EQUAL(frames, 1);
}

/* The speed is followed within some 200 firings. */
static void test_speed(void) {
    upb_azimuth_tracker tracker = tracker_of(UPB_SENSOR_HDL_32E, 0);
    double angle = 0.0;
    for (uint64_t n = 0; n < 600; n++) {
        const uint32_t rate = n < 300 ? TEN_HZ : TEN_HZ / 10 * 11;
        const upb_step step = track_at(&tracker, UPB_HOUR_NS + n * 46080, (uint32_t)angle / 10 * 10, rate);
        angle += rate * 46080e-9;
        if (n == 299)
            CHECK(step.rpm_milli > 599000 && step.rpm_milli < 601000);
        if (n == 599)
            CHECK(step.rpm_milli > 659000 && step.rpm_milli < 661000);
    }
    CHECK(upb_azimuth_turn_firings(&tracker) >= 1971 && upb_azimuth_turn_firings(&tracker) <= 1975);
}

/* Speed wanders by a tenth within a second: the clock counts on, the turns stay right, frames begin once each. */
static void test_wander(random_source *random) {
    upb_azimuth_tracker tracker = tracker_of(UPB_SENSOR_HDL_32E, 90000);
    double angle = 0.0;
    uint64_t frames = 0;
    for (uint64_t n = 0; n < 200000; n++) {
        if (n % 12 == 0 && random_below(random, 50) == 0) {
            const uint64_t lost = 12 * (1 + random_below(random, 40));
            for (uint64_t k = 0; k < lost; k++, n++)
                angle += 165.888 * (1.0 + 0.1 * sin((double)n / 21700.0 * 6.28));
        }
        upb_firing firing;
        memset(&firing, 0, sizeof firing);
        firing.time_ns = UPB_HOUR_NS + n * 46080;
        firing.azimuth_mdeg = (uint32_t)fmod(angle, 360000.0) / 10 * 10;
        firing.rate_mdeg_s = (uint32_t)(TEN_HZ * (1.0 + 0.1 * sin((double)n / 21700.0 * 6.28)));
        const upb_step step = upb_azimuth_track(&tracker, &firing);
        frames += (step.flags & UPB_STEP_FRAME) != 0;
        CHECK_EQUAL(step.firing, (int64_t)n);
        CHECK(fabs((double)step.angle_mdeg - 270000.0 - angle) < 11.0);
        CHECK_EQUAL(step.flags & ~UPB_STEP_FRAME, n == 0 ? UPB_STEP_FIRST : 0);
        CHECK_EQUAL(step.frame, frames);
        angle += 165.888 * (1.0 + 0.1 * sin((double)n / 21700.0 * 6.28));
    }
}

/* ---------------------------------------------------------------------------------------------------------- points */

static void test_points(void) {
    upb_packet_calibration c;
    upb_firing firing;
    upb_point points[UPB_PACKET_BEAMS];
    CHECK_EQUAL(upb_packet_calibration_default(UPB_SENSOR_HDL_32E, &c), UPB_PACKET_OK);
    memset(&firing, 0, sizeof firing);
    firing.beams = 32;
    firing.distance[8] = 5000; /* the horizontal beam */
    firing.azimuth_mdeg = 90000;
    CHECK_EQUAL(upb_firing_points(&c, &firing, points), 1);
    CHECK(fabsf(points[0].x_m) < 1e-5f && fabsf(points[0].y_m + 10.0f) < 1e-5f && fabsf(points[0].z_m) < 1e-5f);
    CHECK(points[0].beam == 8 && points[0].distance_um == 10000000 && points[0].azimuth_mdeg == 90000);
    firing.rate_mdeg_s = TEN_HZ; /* 17.28 us after the begin: 62 mdeg on */
    CHECK_EQUAL(upb_firing_points(&c, &firing, points), 1);
    CHECK_EQUAL(points[0].azimuth_mdeg, 90062);
    c.laser[8].azimuth_offset_mdeg = -1400;
    CHECK_EQUAL(upb_firing_points(&c, &firing, points), 1);
    CHECK_EQUAL(points[0].azimuth_mdeg, 88662);
    c.laser[8].distance_correction_um = -10000000; /* nothing is left of it */
    CHECK_EQUAL(upb_firing_points(&c, &firing, points), 0);
    c.laser[8].laser_id = 31;
    CHECK_EQUAL(upb_firing_points(&c, &firing, points), 0);
}

int main(int argc, char **argv) {
    const unsigned long seed = option_number(argc, argv, "--seed", 1);
    random_source random = random_seeded(seed);
    printf("test_packets --seed %lu\n", seed);
    upb_packet_encoder encoder = encoder_of(UPB_SENSOR_HDL_32E, UPB_RETURN_STRONGEST);
    spinner s = {UPB_SENSOR_HDL_32E, TEN_HZ, 0, 0};
    uint8_t packet[UPB_PACKET_BYTES];
    upb_firing firings[UPB_PACKET_FIRINGS];
    next_packet(&encoder, &s, &random, firings, packet);
    test_round_trips(&random);
    test_pick_last(&random);
    test_brighter_wins();
    test_sizes(packet);
    for (uint32_t k = 0; k < DECODED_SENSORS; k++)
        test_damage(decoded_sensors[k], &random);
    test_vls128(packet);
    test_other_sensor(&random);
    test_arguments();
    test_jump(&random);
    test_swapped_at_the_hour(&random);
    test_calibrations();
    test_rows();
    test_record(&random);
    test_record_stream(UPB_SENSOR_HDL_64E_S2, &random);
    test_record_stream(UPB_SENSOR_HDL_64E_S3, &random);
    test_set_record(&random);
    test_stuck_is_not_dual();
    test_encoder(&random);
    test_position();
    test_losses(&random);
    test_late();
    test_troubles();
    test_azimuth_is_believed();
    test_trembling_cut();
    test_speed();
    test_wander(&random);
    test_points();
    return check_report("packets");
}
