/*
 * The daemon's core under hostile bytes: packets that are mutated, cut, doubled, swapped, of other sensors, or noise;
 * CAN frames and serial bytes between. After every call the books balance; what goes out is well formed. Options:
 * --seed N, --count N (packets), --model FILE (default: UPB_TEST_MODEL).
 */
#include "check.h"
#include "upb_column_wire.h"
#include "upb_daemon.h"

enum { RECENT = 32 };

typedef struct bench {
    upb_daemon *daemon;
    void *memory;
    upb_packet_encoder encoder;
    random_source random;
    uint64_t now_ns;
    uint64_t sensor_ns;
    uint32_t azimuth_mdeg;
    uint32_t step_mdeg;
    uint8_t recent[RECENT][UPB_PACKET_BYTES];
    uint32_t recent_count;
    uint64_t columns, seconds, datagrams, packets, records;
    uint64_t last_frame;
    uint32_t last_sequence;
} bench;

/* ---------------------------------------------------------------------------------------------- outputs */

static void on_columns(void *user, uint64_t time_ns, const uint8_t *datagram, size_t bytes) {
    bench *b = user;
    upb_wire_header header;
    upb_wire_column column;
    (void)time_ns;
    if (!CHECK(upb_wire_read_header(datagram, bytes, &header) == UPB_OK) || !CHECK(bytes <= 1472))
        return;
    CHECK(b->datagrams == 0 || header.sequence == b->last_sequence + 1);
    CHECK(header.frame >= b->last_frame);
    b->last_sequence = header.sequence;
    b->last_frame = header.frame;
    b->datagrams++;
    for (uint32_t i = 0; i < header.columns; i++) {
        upb_wire_read_column(datagram, i, &column);
        b->columns += !(column.flags & UPB_WIRE_SECOND);
        b->seconds += (column.flags & UPB_WIRE_SECOND) != 0;
        CHECK(column.azimuth_mdeg < UPB_FULL_TURN_MDEG);
    }
}

static void on_hdl64(void *user, uint64_t time_ns, const uint8_t *packet, size_t bytes) {
    bench *b = user;
    upb_packet_info info;
    (void)time_ns;
    b->packets++;
    CHECK(upb_packet_identify(packet, bytes, &info) == UPB_PACKET_OK);
}

static upb_send on_can(void *user, uint64_t time_ns, const upb_can_frame *frame) {
    bench *b = user;
    (void)time_ns;
    CHECK(upb_can_frame_is_valid(frame));
    return random_below(&b->random, 50) ? UPB_SEND_DONE : UPB_SEND_FAILED;
}

static upb_send on_serial(void *user, uint64_t time_ns, const uint8_t *data, size_t bytes) {
    bench *b = user;
    (void)time_ns;
    CHECK(bytes > 0 && data[bytes - 1] == 0);
    return random_below(&b->random, 50) ? UPB_SEND_DONE : UPB_SEND_BUSY;
}

static void on_ledger(void *user, const upb_ledger_record *record) {
    bench *b = user;
    CHECK(record->output_ns >= record->last_input_ns && record->last_input_ns >= record->first_input_ns);
    b->records++;
}

/* ----------------------------------------------------------------------------------------------- inputs */

static void fill(bench *b, upb_firing *firing) {
    memset(firing, 0, sizeof *firing);
    firing->beams = UPB_BEAMS;
    firing->time_ns = b->sensor_ns;
    firing->azimuth_mdeg = b->azimuth_mdeg;
    for (unsigned k = 0; k < UPB_BEAMS; k++) {
        firing->distance[k] = random_below(&b->random, 8) ? (uint16_t)(2000 + 100 * k + random_below(&b->random, 50))
                                                          : (uint16_t)random_u32(&b->random);
        firing->intensity[k] = (uint8_t)random_u32(&b->random);
    }
    b->sensor_ns += 46080;
    b->azimuth_mdeg = (b->azimuth_mdeg + b->step_mdeg) % UPB_FULL_TURN_MDEG;
}

/* The sensor's next packet. */
static void next_packet(bench *b, uint8_t packet[UPB_PACKET_BYTES]) {
    upb_firing firing;
    uint32_t ready = 0;
    while (!ready) {
        fill(b, &firing);
        if (!CHECK(upb_packet_encode(&b->encoder, &firing, packet, &ready) == UPB_PACKET_OK))
            return;
    }
    memcpy(b->recent[b->recent_count++ % RECENT], packet, UPB_PACKET_BYTES);
}

static size_t mutate(bench *b, uint8_t *bytes) {
    random_source *r = &b->random;
    switch (random_below(r, 9)) {
    case 0: /* bits turned round */
        for (uint32_t n = 1 + random_below(r, 8); n; n--)
            bytes[random_below(r, UPB_PACKET_BYTES)] ^= (uint8_t)(1u << random_below(r, 8));
        return UPB_PACKET_BYTES;
    case 1: /* a field of a block's head */
        bytes[100 * random_below(r, 12) + random_below(r, 4)] = (uint8_t)random_u32(r);
        return UPB_PACKET_BYTES;
    case 2: /* time, mode, model */
        bytes[1200 + random_below(r, 6)] = (uint8_t)random_u32(r);
        return UPB_PACKET_BYTES;
    case 3: /* cut, or too long */
        return random_below(r, UPB_PACKET_BYTES + 200);
    case 4: /* one that came before */
        if (b->recent_count)
            memcpy(bytes, b->recent[random_below(r, b->recent_count < RECENT ? b->recent_count : RECENT)],
                   UPB_PACKET_BYTES);
        return UPB_PACKET_BYTES;
    case 5: /* noise */
        for (unsigned i = 0; i < UPB_PACKET_BYTES; i++)
            bytes[i] = (uint8_t)random_u32(r);
        return UPB_PACKET_BYTES;
    case 6: /* another sensor's */
        bytes[1205] = (uint8_t)(0x20 + random_below(r, 10));
        return UPB_PACKET_BYTES;
    case 7: /* the whole time, wildly */
        for (unsigned i = 0; i < 4; i++)
            bytes[1200 + i] = (uint8_t)random_u32(r);
        return UPB_PACKET_BYTES;
    default: /* dual return is claimed */
        bytes[1204] = 0x39;
        return UPB_PACKET_BYTES;
    }
}

static void send_noise_to_buses(bench *b) {
    upb_can_frame frame;
    uint8_t bytes[100];
    memset(&frame, 0, sizeof frame);
    const uint32_t ids[] = {0x300, 0x7a0, 0x7df, 0x123};
    frame.id = ids[random_below(&b->random, 4)];
    frame.flags = (uint8_t)random_below(&b->random, 8);
    frame.length = (uint8_t)random_below(&b->random, UPB_CAN_FD_BYTES + 1);
    for (unsigned i = 0; i < sizeof bytes; i++)
        bytes[i] = (uint8_t)(random_below(&b->random, 6) ? random_u32(&b->random) : 0);
    memcpy(frame.data, bytes, UPB_CAN_FD_BYTES);
    upb_daemon_can(b->daemon, &frame, b->now_ns);
    upb_daemon_serial(b->daemon, bytes, random_below(&b->random, sizeof bytes), b->now_ns);
    upb_daemon_position(b->daemon, bytes, random_below(&b->random, sizeof bytes), 0, b->now_ns);
}

static void disturb(bench *b) {
    random_source *r = &b->random;
    switch (random_below(r, 12)) {
    case 0:
        b->now_ns += random_below(r, 200000000);
        break;
    case 1:
        b->azimuth_mdeg = random_below(r, UPB_FULL_TURN_MDEG / 10) * 10;
        break;
    case 2:
        b->sensor_ns = (uint64_t)random_u32(r) * 800;
        break;
    case 3:
        b->step_mdeg = random_below(r, 100) * 10;
        break;
    case 4: {
        const uint64_t service[UPB_MODES] = {random_below(r, 2000000), random_below(r, 1000000),
                                             random_below(r, 700000), random_below(r, 500000)};
        upb_daemon_set_service(b->daemon, service);
        break;
    }
    case 5:
        upb_daemon_set_floor(b->daemon, (upb_mode)random_below(r, UPB_MODES), b->now_ns);
        break;
    case 6:
        upb_daemon_queue_full(b->daemon, random_below(r, 5), b->now_ns);
        break;
    case 7: /* packets are lost */
        for (uint32_t n = random_below(r, 400); n; n--) {
            upb_firing firing;
            fill(b, &firing);
        }
        break;
    default:
        send_noise_to_buses(b);
    }
}

/* ------------------------------------------------------------------------------------------------ books */

static void check_books(bench *b) {
    const upb_daemon_status s = upb_daemon_get_status(b->daemon);
    const upb_daemon_counters *c = &s.counters;
    uint64_t dropped = 0, by_mode = 0;
    for (uint32_t i = 0; i < UPB_DROPS; i++)
        dropped += c->packets_dropped[i];
    for (uint32_t i = 0; i < UPB_MODES; i++)
        by_mode += c->columns_by_mode[i];
    CHECK_EQUAL(c->packets_received, c->packets_processed + dropped);
    CHECK_EQUAL(c->columns_out, by_mode);
    CHECK(c->columns_out <= c->firings_processed + c->firings_inserted);
    CHECK_EQUAL(c->column_datagrams, b->datagrams);
    CHECK_EQUAL(c->hdl64_packets, b->packets);
    CHECK_EQUAL(c->frames_closed, b->records);
}

static void check_end(bench *b) {
    upb_daemon_end(b->daemon, b->now_ns);
    check_books(b);
    const upb_daemon_counters c = upb_daemon_get_status(b->daemon).counters;
    CHECK_EQUAL(c.columns_out + c.columns_lost, c.firings_processed + c.firings_inserted);
    CHECK_EQUAL(b->columns, c.columns_out);
    CHECK_EQUAL(b->seconds, c.second_returns);
    CHECK_EQUAL(c.hdl64_packets * 6, c.columns_out + c.hdl64_padding);
    printf("%llu packets processed, dropped:", (unsigned long long)c.packets_processed);
    for (uint32_t i = 0; i < UPB_DROPS; i++)
        printf(" %s %llu", upb_drop_name(i), (unsigned long long)c.packets_dropped[i]);
    printf("; %llu frames, %llu resyncs\n", (unsigned long long)c.frames_closed, (unsigned long long)c.resyncs);
    CHECK(c.packets_processed > 0 && c.frames_closed > 0);
}

/* ------------------------------------------------------------------------------------------------- runs */

static uint8_t *read_model(const char *path, size_t *bytes) {
    FILE *file = fopen(path, "rb");
    uint8_t *content = malloc(1 << 20);
    *bytes = file && content ? fread(content, 1, 1 << 20, file) : 0;
    if (file)
        fclose(file);
    if (!*bytes) {
        fprintf(stderr, "%s: no model\n", path);
        exit(2);
    }
    return content;
}

static void begin(bench *b, const uint8_t *ubm, size_t ubm_bytes, uint64_t seed) {
    upb_daemon_config config = upb_daemon_config_default();
    upb_packet_encoder_config encoder = upb_packet_encoder_config_default(UPB_SENSOR_HDL_32E);
    upb_error error;
    memset(b, 0, sizeof *b);
    b->random = random_seeded(seed);
    b->step_mdeg = 166;
    config.service_ns[0] = 100000;
    config.queue_packets = 256;
    config.sinks = (upb_daemon_sinks){.user = b,
                                      .column_stream = on_columns,
                                      .hdl64 = on_hdl64,
                                      .can = on_can,
                                      .serial = on_serial,
                                      .ledger = on_ledger};
    const size_t bytes = upb_daemon_bytes(&config);
    b->memory = aligned_alloc(UPB_ALIGN, bytes);
    const upb_status status = upb_daemon_init(b->memory, bytes, &config, ubm, ubm_bytes, &b->daemon, &error);
    if (status != UPB_OK) {
        fprintf(stderr, "init: %s: %s\n", error.what, upb_status_text(status));
        exit(2);
    }
    CHECK(upb_packet_encoder_init(&b->encoder, &encoder) == UPB_PACKET_OK);
}

static void run(const uint8_t *ubm, size_t ubm_bytes, uint64_t seed, unsigned long count) {
    static bench b;
    uint8_t bytes[UPB_PACKET_BYTES + 200];
    begin(&b, ubm, ubm_bytes, seed);
    for (unsigned long i = 0; i < count; i++) {
        memset(bytes, 0, sizeof bytes);
        next_packet(&b, bytes);
        b.now_ns += 552960;
        /* Stretches of order between stretches of damage: faults come and go. */
        const int rough = i / 500 % 2 == 1;
        const size_t size = rough && random_below(&b.random, 3) == 0 ? mutate(&b, bytes) : UPB_PACKET_BYTES;
        upb_daemon_packet(b.daemon, bytes, size, random_u32(&b.random), b.now_ns);
        if (rough && random_below(&b.random, 40) == 0)
            disturb(&b);
        if (i % 16 == 0)
            upb_daemon_tick(b.daemon, b.now_ns);
        if (i % 64 == 0)
            check_books(&b);
        if (i % 2000 == 1999)
            b.step_mdeg = 166;
    }
    check_end(&b);
    free(b.memory);
}

/* Damaged model files: each is refused or used, the daemon goes on. */
static void run_models(const uint8_t *ubm, size_t ubm_bytes, uint64_t seed) {
    static bench b;
    uint8_t packet[UPB_PACKET_BYTES], *damaged = malloc(ubm_bytes);
    begin(&b, ubm, ubm_bytes, seed);
    for (unsigned i = 0; i < 400; i++) {
        memcpy(damaged, ubm, ubm_bytes);
        damaged[random_below(&b.random, (uint32_t)ubm_bytes)] ^= (uint8_t)(1u << random_below(&b.random, 8));
        const size_t size = random_below(&b.random, 4) ? ubm_bytes : random_below(&b.random, (uint32_t)ubm_bytes);
        CHECK(upb_daemon_swap_model(b.daemon, damaged, size, b.now_ns, NULL) != UPB_OK);
        for (unsigned k = 0; k < 10; k++) {
            next_packet(&b, packet);
            b.now_ns += 552960;
            upb_daemon_packet(b.daemon, packet, sizeof packet, 0, b.now_ns);
        }
    }
    free(damaged);
    CHECK_EQUAL(upb_daemon_get_status(b.daemon).counters.models_rejected, 400);
    CHECK_EQUAL(upb_daemon_get_status(b.daemon).counters.packets_processed, 4000);
    check_end(&b);
    free(b.memory);
}

/* Every bit of the memory that must not change, but pointers: found. */
static void run_integrity(const uint8_t *ubm, size_t ubm_bytes, uint64_t seed) {
    static bench b;
    uint8_t packet[UPB_PACKET_BYTES];
    for (unsigned i = 0; i < 12; i++) {
        begin(&b, ubm, ubm_bytes, seed + i);
        for (unsigned k = 0; k < 400 + 180 * 12; k++) {
            next_packet(&b, packet);
            b.now_ns += 552960;
            upb_daemon_packet(b.daemon, packet, sizeof packet, 0, b.now_ns);
            if (k == 400) /* rows of the float networks' weights lie first */
                upb_daemon_flip_bit(b.daemon, UPB_REGION_MODEL, random_below(&b.random, 8 * 2048));
        }
        CHECK_EQUAL(upb_daemon_get_status(b.daemon).counters.integrity_failures, 1);
        CHECK_EQUAL(upb_daemon_get_status(b.daemon).counters.integrity_repairs, 1);
        upb_daemon_end(b.daemon, b.now_ns);
        check_books(&b);
        free(b.memory);
    }
}

static void test_arguments(const uint8_t *ubm, size_t ubm_bytes) {
    upb_daemon_config config = upb_daemon_config_default();
    upb_daemon *daemon;
    upb_error error;
    const size_t bytes = upb_daemon_bytes(&config);
    uint8_t *memory = aligned_alloc(UPB_ALIGN, bytes);
    CHECK(upb_daemon_init(memory, bytes - 1, &config, ubm, ubm_bytes, &daemon, &error) == UPB_E_SIZE);
    CHECK_EQUAL(error.expected, bytes);
    CHECK(upb_daemon_init(memory + 1, bytes, &config, ubm, ubm_bytes, &daemon, &error) == UPB_E_ALIGN);
    CHECK(upb_daemon_init(NULL, bytes, &config, ubm, ubm_bytes, &daemon, &error) == UPB_E_ARGUMENT);
    CHECK(upb_daemon_init(memory, bytes, &config, NULL, 0, &daemon, &error) == UPB_E_ARGUMENT);
    config.struct_bytes--;
    CHECK_EQUAL(upb_daemon_bytes(&config), 0);
    CHECK(upb_daemon_init(memory, bytes, &config, ubm, ubm_bytes, &daemon, &error) == UPB_E_ARGUMENT);
    CHECK(strcmp(error.what, "struct_bytes") == 0);
    CHECK(daemon == NULL);
    for (uint32_t id = 1; id <= UPB_FAULTS; id++) { /* the fault memory's names, in lower case */
        const char *name = upb_fault_name(id), *check = upb_daemon_check_name(id - 1);
        for (; *name && (*name == *check || *name == *check - 32); name++)
            check++;
        CHECK(*name == 0 && *check == 0);
    }
    free(memory);
}

/* ---------------------------------------------------------------------------------------------- recovery */

enum {
    PACKET_NS = 552960,
    RECOVERY_PACKETS = 5425, /* 3 s */
    HEARD_PACKETS = 400,     /* 0.22 s: from then on every packet is taken */
    SETTLED_PACKETS = 1900   /* 1.05 s: from then on no break, and no packet misses a column */
};

/* What is wrong in a stretch of packets, all at once. */
typedef enum trouble {
    OTHER_MODEL = 1,
    STANDS_STILL = 2,
    MUTATED = 4,
    DISTURBED = 8,
    JUNK_FLOOD = 16,
    ECHO_FLOOD = 32,
    SILENT = 64,
    CLOCK_SET = 128,
    TROUBLES = 256
} trouble;

static void flood(bench *b, uint32_t troubles) {
    uint8_t bytes[UPB_PACKET_BYTES];
    for (uint32_t n = random_below(&b->random, 8); n; n--) {
        memset(bytes, 0, sizeof bytes);
        if (troubles & ECHO_FLOOD)
            memcpy(bytes, b->recent[random_below(&b->random, RECENT)], sizeof bytes);
        upb_daemon_packet(b->daemon, bytes, sizeof bytes, 0, b->now_ns);
    }
}

static void suffer(bench *b, uint32_t troubles, uint32_t packets) {
    uint8_t bytes[UPB_PACKET_BYTES + 200];
    if (troubles & STANDS_STILL)
        b->step_mdeg = 0;
    if (troubles & CLOCK_SET) /* by up to an hour, or a little back */
        b->sensor_ns += random_below(&b->random, 2) ? (uint64_t)random_u32(&b->random) * 838
                                                    : UINT64_C(3600000000000) - random_below(&b->random, 200000000);
    for (uint32_t i = 0; i < packets; i++) {
        memset(bytes, 0, sizeof bytes);
        next_packet(b, bytes);
        b->now_ns += PACKET_NS;
        if (troubles & OTHER_MODEL)
            bytes[1205] = 0x28;
        const int bad = troubles & MUTATED && random_below(&b->random, 3) == 0;
        const size_t size = bad ? mutate(b, bytes) : UPB_PACKET_BYTES;
        if (!(troubles & SILENT))
            upb_daemon_packet(b->daemon, bytes, size, 0, b->now_ns);
        if (troubles & (JUNK_FLOOD | ECHO_FLOOD))
            flood(b, troubles);
        if (troubles & DISTURBED && random_below(&b->random, 40) == 0)
            disturb(b);
        if (i % 16 == 0)
            upb_daemon_tick(b->daemon, b->now_ns);
    }
}

/* A healthy sensor is heard again: whatever was wrong before. */
static void recover(bench *b, const char *after) {
    const uint64_t service[UPB_MODES] = {100000};
    uint8_t packet[UPB_PACKET_BYTES];
    upb_daemon_counters heard = {0}, settled = {0};
    int ok = 1;
    b->step_mdeg = 166;
    upb_daemon_set_service(b->daemon, service);
    upb_daemon_set_floor(b->daemon, UPB_MODE_NETWORK, b->now_ns);
    for (unsigned i = 0; i < RECOVERY_PACKETS; i++) {
        if (i == HEARD_PACKETS)
            heard = upb_daemon_get_status(b->daemon).counters;
        if (i == SETTLED_PACKETS)
            settled = upb_daemon_get_status(b->daemon).counters;
        next_packet(b, packet);
        b->now_ns += PACKET_NS;
        upb_daemon_packet(b->daemon, packet, sizeof packet, 0, b->now_ns);
        if (i % 16 == 0)
            upb_daemon_tick(b->daemon, b->now_ns);
    }
    const upb_daemon_counters c = upb_daemon_get_status(b->daemon).counters;
    const uint64_t since = RECOVERY_PACKETS - SETTLED_PACKETS;
    ok &= CHECK_EQUAL(c.packets_processed - heard.packets_processed, RECOVERY_PACKETS - HEARD_PACKETS);
    ok &= CHECK_EQUAL(c.resyncs, settled.resyncs);
    ok &= CHECK_EQUAL(c.firings_processed - settled.firings_processed, 12 * since);
    ok &= CHECK_EQUAL(c.firings_inserted + c.firings_skipped, settled.firings_inserted + settled.firings_skipped);
    ok &= CHECK_EQUAL(c.frames_partial + c.frames_skipped + c.frames_forced,
                      settled.frames_partial + settled.frames_skipped + settled.frames_forced);
    const uint32_t columns = upb_daemon_get_status(b->daemon).columns;
    ok &= CHECK(columns > 2100 && columns < 2240);
    if (!ok)
        printf("  after %s\n", after);
}

static void run_recovery(const uint8_t *ubm, size_t ubm_bytes, uint64_t seed, unsigned long rounds) {
    static bench b;
    char after[200];
    begin(&b, ubm, ubm_bytes, seed);
    suffer(&b, 0, 2 * RECENT);
    for (unsigned long round = 0; round < rounds; round++) {
        int length = snprintf(after, sizeof after, "round %lu, troubles", round);
        for (uint32_t stretch = 1 + random_below(&b.random, 3); stretch; stretch--) {
            /* One alone, or any together. */
            const uint32_t troubles =
                random_below(&b.random, 2) ? 1u << random_below(&b.random, 8) : random_below(&b.random, TROUBLES);
            const uint32_t packets = 1 + random_below(&b.random, 1200);
            length += snprintf(after + length, sizeof after - (size_t)length, " %u for %u packets;", troubles, packets);
            suffer(&b, troubles, packets);
            check_books(&b);
        }
        recover(&b, after);
    }
    check_end(&b);
    free(b.memory);
}

int main(int argc, char **argv) {
    const unsigned long seed = option_number(argc, argv, "--seed", 1),
                        count = option_number(argc, argv, "--count", 100000);
    const char *path = option_text(argc, argv, "--model");
    size_t bytes;
    uint8_t *ubm = read_model(path ? path : UPB_TEST_MODEL, &bytes);
    printf("seed %lu, %lu packets\n", seed, count);
    test_arguments(ubm, bytes);
    run(ubm, bytes, seed, count);
    run_recovery(ubm, bytes, seed, 1 + count / 2500);
    run_models(ubm, bytes, seed);
    run_integrity(ubm, bytes, seed);
    free(ubm);
    return check_report("daemon");
}
