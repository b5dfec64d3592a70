/*
 * Damaged and hostile packets, records and positions: no crash, no sanitizer finding, everything handed out in its
 * range, every packet counted. Options: --seed N, --count N (packets), --corpus DIR (seed files; default: made on the
 * spot),
 * --write-corpus DIR. A packet is copied to a heap block of exactly its size before it is read.
 */
#include "packet_maker.h"

#define CORPUS_FILES 17u
#define PACKET_MAX 1500u

typedef struct seed_file {
    char name[48];
    uint32_t size;
    uint8_t bytes[UPB_PACKET_BYTES];
} seed_file;

static seed_file corpus[CORPUS_FILES];

/* --------------------------------------------------------------------------------------------------------- corpus */

static void make_data_seed(seed_file *seed, upb_sensor sensor, upb_return_mode mode, random_source *random) {
    static const char *const mode_names[] = {"strongest", "last", "dual"};
    upb_packet_encoder encoder = encoder_of(sensor, mode);
    spinner s = {sensor, 3600000, UPB_HOUR_NS - 300000, random_below(random, 2000)};
    upb_firing firings[UPB_PACKET_FIRINGS];
    next_packet(&encoder, &s, random, firings, seed->bytes);
    seed->size = UPB_PACKET_BYTES;
    snprintf(seed->name, sizeof seed->name, "%s_%s.bin", upb_sensor_info_get(sensor)->name,
             mode_names[mode - UPB_RETURN_STRONGEST]);
}

static void make_corpus(void) {
    random_source random = random_seeded(2368);
    uint32_t n = 0;
    for (uint32_t s = 0; s < DECODED_SENSORS; s++)
        for (uint32_t mode = 0; mode < RETURN_MODES; mode++)
            make_data_seed(&corpus[n++], decoded_sensors[s], return_modes[mode], &random);
    upb_position position;
    memset(&position, 0, sizeof position);
    position.time_us = 1234567;
    position.pps = UPB_PPS_LOCKED;
    strcpy(position.nmea, "$GPRMC,123519,A,4807.038,N,01131.000,E,022.4,084.4,230394,003.1,W*6A");
    for (uint32_t k = 0; k < 2; k++, n++) {
        CHECK_EQUAL(upb_position_encode(&position, corpus[n].bytes), UPB_PACKET_OK);
        corpus[n].size = UPB_POSITION_PACKET_BYTES;
        snprintf(corpus[n].name, sizeof corpus[n].name, "position_%s.bin", k ? "shutdown" : "locked");
        position.thermal_shutdown = 1;
        position.nmea[0] = 0;
    }
    CHECK_EQUAL(n, CORPUS_FILES);
}

static FILE *open_seed(const char *folder, const char *name, const char *mode) {
    char path[1024];
    const int n = snprintf(path, sizeof path, "%s/%.47s", folder, name);
    FILE *file = n > 0 && (size_t)n < sizeof path ? fopen(path, mode) : NULL;
    if (!file) {
        perror(path);
        exit(2);
    }
    return file;
}

static void write_corpus(const char *folder) {
    for (uint32_t k = 0; k < CORPUS_FILES; k++) {
        FILE *file = open_seed(folder, corpus[k].name, "wb");
        CHECK_EQUAL(fwrite(corpus[k].bytes, 1, corpus[k].size, file), corpus[k].size);
        fclose(file);
    }
}

/* The files kept are those this program makes: an old packet never stops being read. */
static void read_corpus(const char *folder) {
    for (uint32_t k = 0; k < CORPUS_FILES; k++) {
        uint8_t bytes[PACKET_MAX];
        FILE *file = open_seed(folder, corpus[k].name, "rb");
        const size_t size = fread(bytes, 1, sizeof bytes, file);
        fclose(file);
        CHECK_EQUAL(size, corpus[k].size);
        if (!CHECK(memcmp(bytes, corpus[k].bytes, corpus[k].size) == 0))
            fprintf(stderr, "    %s\n", corpus[k].name);
        upb_packet_info info;
        CHECK_EQUAL(upb_packet_identify(bytes, size, &info), UPB_PACKET_OK);
    }
}

/* ------------------------------------------------------------------------------------------------------ mutations */

static void damage(uint8_t *bytes, uint32_t size, random_source *random) {
    static const uint8_t extremes[] = {0x00, 0xFF, 0x7F, 0x80, 0x37, 0x38, 0x39, 0x21, 0xEE, 0xDD};
    if (size == 0)
        return;
    for (uint32_t k = random_below(random, 4); k > 0; k--) {
        uint8_t *at = &bytes[random_below(random, size)];
        switch (random_below(random, 5)) {
        case 0:
            *at ^= (uint8_t)(1u << random_below(random, 8));
            break;
        case 1:
            *at = extremes[random_below(random, sizeof extremes)];
            break;
        case 2:
            *at = (uint8_t)random_u32(random);
            break;
        case 3: /* an azimuth */
            bytes[(100 * random_below(random, 12) + 2 + random_below(random, 2)) % size] = (uint8_t)random_u32(random);
            break;
        default: /* time, return mode, model; or clock and state of a position packet */
            bytes[(size >= 512 + 6 ? size - 6 + random_below(random, 6) : 198 + random_below(random, 10)) % size] =
                (uint8_t)random_u32(random);
        }
    }
}

/* The next packet: a seed, damaged, spliced with another, cut short or made longer; or noise. */
static uint32_t next_input(uint8_t bytes[PACKET_MAX], random_source *random) {
    const seed_file *seed = &corpus[random_below(random, CORPUS_FILES)];
    const seed_file *other = &corpus[random_below(random, CORPUS_FILES)];
    uint32_t size = seed->size;
    memset(bytes, 0, PACKET_MAX);
    memcpy(bytes, seed->bytes, size);
    switch (random_below(random, 16)) {
    case 0: { /* splice */
        const uint32_t from = random_below(random, size < other->size ? size : other->size);
        memcpy(bytes + from, other->bytes + from, (size < other->size ? size : other->size) - from);
        break;
    }
    case 1:
        size = random_below(random, PACKET_MAX);
        break;
    case 2: /* noise behind good flags */
        for (uint32_t k = 0; k < size; k++)
            if (k % 100 > 1)
                bytes[k] = (uint8_t)random_u32(random);
        break;
    default:
        break;
    }
    damage(bytes, size, random);
    return size;
}

/* --------------------------------------------------------------------------------------------------------- checks */

typedef struct target {
    upb_packet_decoder decoder;
    upb_azimuth_tracker tracker;
    uint64_t fed;
} target;

static void check_firing(target *t, const upb_firing *firing, const upb_packet_info *info) {
    CHECK(firing->azimuth_mdeg < UPB_FULL_TURN_MDEG);
    CHECK(firing->beams == upb_sensor_info_get(t->decoder.sensor)->beams);
    CHECK(firing->time_ns % UPB_HOUR_NS / 1000 >= info->time_us ||
          firing->time_ns / UPB_HOUR_NS > 0); /* goes on past the hour */
    uint32_t any = 0;
    for (uint32_t beam = 0; beam < UPB_PACKET_BEAMS; beam++) {
        any |= firing->distance[beam];
        CHECK(beam < firing->beams || (firing->distance[beam] == 0 && firing->intensity[beam] == 0));
    }
    CHECK_EQUAL((firing->flags & UPB_FIRING_EMPTY) == 0, any != 0);
    if (firing->flags & UPB_FIRING_SECOND)
        return;
    const int64_t before = t->tracker.firing;
    const upb_step step = upb_azimuth_track(&t->tracker, firing);
    CHECK(step.firing == before + 1 + step.missing || (step.flags & (UPB_STEP_LATE | UPB_STEP_FIRST)));
    CHECK(step.missing <= UPB_TRACKER_LOST_NS / 40000);
}

static uint64_t packets_counted(const upb_packet_stats *stats) {
    uint64_t sum = 0;
    for (uint32_t k = 0; k < UPB_PACKET_STATUSES; k++)
        sum += stats->packets[k];
    return sum;
}

static void feed(target *t, const uint8_t *bytes, uint32_t size) {
    static upb_firing firings[UPB_PACKET_FIRINGS];
    upb_point points[UPB_PACKET_BEAMS];
    upb_packet_info info, again;
    uint32_t count = 99;
    uint8_t *block = malloc(size + 1u);
    if (!block)
        exit(2);
    memcpy(block + 1, bytes, size);
    const upb_packet_status identified = upb_packet_identify(block + 1, size, &again);
    const upb_packet_status status = upb_packet_decode(&t->decoder, block + 1, size, firings, &count, &info);
    free(block);
    t->fed++;
    CHECK((uint32_t)status < UPB_PACKET_STATUSES && upb_packet_status_text(status)[0]);
    CHECK(status == identified || status == UPB_PACKET_E_SENSOR);
    CHECK(count <= UPB_PACKET_FIRINGS && (status == UPB_PACKET_OK || count == 0));
    CHECK_EQUAL(packets_counted(&t->decoder.stats), t->fed);
    for (uint32_t k = 0; k < count && k < UPB_PACKET_FIRINGS; k++)
        check_firing(t, &firings[k], &info);
    if (count)
        CHECK(upb_firing_points(&t->decoder.calibration, &firings[0], points) <= UPB_PACKET_BEAMS);
}

static void start(target *t, upb_sensor sensor, random_source *random) {
    memset(t, 0, sizeof *t);
    t->decoder = decoder_of(sensor, random_below(random, 2) ? UPB_PICK_LAST : UPB_PICK_STRONGEST);
    const uint32_t cycle = sensor ? upb_sensor_info_get(sensor)->firing_cycle_ns : 46080;
    CHECK_EQUAL(upb_azimuth_tracker_init(&t->tracker, random_below(random, 360000), cycle), UPB_PACKET_OK);
}

static void fuzz_packets(unsigned long count, random_source *random) {
    static target targets[DECODED_SENSORS + 1];
    uint8_t bytes[PACKET_MAX];
    for (unsigned long n = 0; n < count; n++) {
        const uint32_t which = random_below(random, DECODED_SENSORS + 1);
        if (n % 5000 == 0)
            for (uint32_t k = 0; k <= DECODED_SENSORS; k++)
                start(&targets[k], k ? decoded_sensors[k - 1] : UPB_SENSOR_AUTO, random);
        const uint32_t size = next_input(bytes, random);
        feed(&targets[which], bytes, size);
    }
}

/* Records of any bytes: what passes can be a calibration, and comes back the same. */
static void fuzz_records(unsigned long count, random_source *random) {
    uint8_t record[UPB_RECORD_BYTES], again[UPB_RECORD_BYTES], good[UPB_RECORD_BYTES];
    upb_packet_calibration c;
    upb_hdl64e_status status = upb_packet_encoder_config_default(UPB_SENSOR_HDL_64E_S2).status;
    CHECK_EQUAL(upb_packet_calibration_default(UPB_SENSOR_HDL_64E_S2, &c), UPB_PACKET_OK);
    CHECK_EQUAL(upb_record_write(&c, &status, good), UPB_PACKET_OK); /* an S2's: no checksum hides what follows */
    unsigned long passed = 0;
    for (unsigned long n = 0; n < count; n++) {
        memcpy(record, good, sizeof record);
        for (uint32_t k = random_below(random, 6); k > 0; k--)
            record[7 + random_below(random, UPB_RECORD_BYTES - 9)] = (uint8_t)random_u32(random);
        memset(&status, 0, sizeof status);
        const upb_packet_status outcome = upb_record_read(record, &c, &status);
        CHECK(outcome == UPB_PACKET_OK || outcome == UPB_PACKET_E_CALIBRATION);
        if (outcome != UPB_PACKET_OK)
            continue;
        passed++;
        CHECK_EQUAL(upb_packet_calibration_check(&c, NULL), UPB_PACKET_OK);
        CHECK_EQUAL(upb_record_write(&c, &status, again), UPB_PACKET_OK);
        upb_packet_calibration back;
        CHECK_EQUAL(upb_record_read(again, &back, &status), UPB_PACKET_OK);
        CHECK(memcmp(&back, &c, sizeof c) == 0);
    }
    CHECK(count < 100 || (passed > 0 && passed < count));
}

int main(int argc, char **argv) {
    const unsigned long seed = option_number(argc, argv, "--seed", 1);
    const unsigned long count = option_number(argc, argv, "--count", 100000);
    const char *kept = option_text(argc, argv, "--corpus");
    const char *written = option_text(argc, argv, "--write-corpus");
    random_source random = random_seeded(seed);
    printf("fuzz_packets --seed %lu --count %lu\n", seed, count);
    make_corpus();
    if (written) {
        write_corpus(written);
        return check_report("corpus");
    }
    if (kept)
        read_corpus(kept);
    fuzz_packets(count, &random);
    fuzz_records(count / 20, &random);
    return check_report("fuzz_packets");
}
