/*
 * The real-time runner: queueing on virtual time against calculations by hand, accounts of a run on real threads.
 * Wall-clock time is never checked. Run it under the thread sanitizer as well.
 */
#include <pthread.h>
#include <stdatomic.h>
#include <time.h>

#include "check.h"
#include "live_ring.h"
#include "ubm_writer.h"
#include "upb_live.h"

enum { COLUMNS = 24, PER_PACKET = 12, FRAMES = 6, MS = 1000000 };

static _Alignas(UPB_ALIGN) unsigned char model_memory[UPB_MODEL_BYTES_MAX];
static uint16_t distance[FRAMES * COLUMNS * UPB_BEAMS];
static uint8_t intensity[FRAMES * COLUMNS * UPB_BEAMS];

/* All beams of a column look `offset_columns` further. */
static const upb_model *load_model(uint8_t edge, int32_t offset_columns) {
    static uint8_t file[UBM_MAX];
    random_source random = random_seeded(7);
    test_model m = random_model(&random, COLUMNS, 3);
    upb_model *model;

    m.edge = edge;
    for (int k = 0; k < 32; k++)
        m.offset[k] = offset_columns * (360000000 / COLUMNS);
    const size_t bytes = write_ubm(file, &m, NULL, 0);
    CHECK_EQUAL(upb_model_load(model_memory, sizeof model_memory, file, bytes, &model, NULL), UPB_OK);
    return model;
}

static void fill_frames(void) {
    random_source random = random_seeded(8);
    for (size_t i = 0; i < sizeof intensity; i++) {
        distance[i] = (uint16_t)(1500 + random_below(&random, 20000));
        intensity[i] = (uint8_t)random_below(&random, 256);
    }
}

/* Two packets a frame, 5 ms apart. */
static upb_live_config slow_config(void) {
    upb_live_config config = upb_live_config_default();
    config.distance = distance;
    config.intensity = intensity;
    config.frames = FRAMES;
    config.columns = COLUMNS;
    config.columns_per_packet = PER_PACKET;
    config.rate_millihertz = 100000;
    config.virtual_clock.enabled = 1;
    config.lead_ns = 0;
    return config;
}

static upb_live *run(const upb_model *model, const upb_live_config *config) {
    upb_live *live = NULL;
    upb_error error;
    if (CHECK_EQUAL(upb_live_create(model, config, &live, &error), UPB_LIVE_OK))
        CHECK_EQUAL(upb_live_run(live), UPB_LIVE_OK);
    else
        exit(check_report("live"));
    return live;
}

static void check_accounts(const upb_live_result *r) {
    uint64_t missing = 0, received = 0;
    for (size_t i = 0; i < r->frame_count; i++) {
        missing += r->frames[i].record.missing_columns;
        received += r->frames[i].columns_received;
    }
    CHECK_EQUAL(r->frames_begun, r->met + r->missed + r->partial + r->frames_empty);
    CHECK_EQUAL(r->frame_count, r->met + r->missed + r->partial);
    CHECK_EQUAL(r->packets_played, r->packets_taken + r->dropped_fault + r->dropped_overflow);
    CHECK_EQUAL(r->drop_count + r->drops_unlisted, r->dropped_fault + r->dropped_overflow);
    CHECK_EQUAL(r->columns_played, r->columns_taken + r->columns_missing);
    CHECK_EQUAL(received, r->columns_taken);
    CHECK(missing <= r->columns_missing);
    if (r->frames_empty == 0)
        CHECK_EQUAL(missing, r->columns_missing);
    CHECK_EQUAL(r->columns_refused, 0);
    CHECK_EQUAL(r->latency.count, r->met + r->missed);
    CHECK_EQUAL(r->column_compute.count, r->columns_taken);
    CHECK_EQUAL(r->packet_compute.count, r->packets_taken);
}

/* ------------------------------------------------------------------------------------------------ virtual time */

/* Packets arrive every 5 ms and take 8: packet p is done at 8 (p + 1), and the queue grows by 3 ms a packet. */
static void test_queueing_by_hand(void) {
    upb_live_config config = slow_config();
    config.virtual_clock.packet_service_ns = 8 * MS;
    config.deadline_ns = 30 * MS;

    /* Seam: frame f is complete with the first column of packet 2f + 2; the last one with the flush. */
    upb_live *live = run(load_model(UPB_EDGE_SEAM, 0), &config);
    const upb_live_result *r = upb_live_get_result(live);
    CHECK_EQUAL(r->frame_count, FRAMES);
    for (uint64_t f = 0; f < r->frame_count; f++) {
        const int last = f == FRAMES - 1;
        CHECK_EQUAL(r->frames[f].record.frame, f);
        CHECK_EQUAL(r->frames[f].record.first_input_ns, 2 * f * 5 * MS);
        CHECK_EQUAL(r->frames[f].record.last_input_ns, (2 * f + 1) * 5 * MS);
        CHECK_EQUAL(r->frames[f].record.latency_ns, (6 * f + (last ? 11 : 19)) * MS);
        CHECK_EQUAL(r->frames[f].wait_ns, last ? 0 : 5 * MS);
        CHECK_EQUAL(r->frames[f].flags, last ? UPB_LIVE_FLUSHED : 0);
        CHECK_EQUAL(r->frames[f].record.verdict, r->frames[f].record.latency_ns > 30 * MS);
    }
    CHECK_EQUAL(r->missed, 4); /* 31, 37, 43, 41 ms */
    check_accounts(r);
    upb_live_destroy(live);

    /* Zero edge: frame f is complete with its own last packet. */
    live = run(load_model(UPB_EDGE_ZERO, 0), &config);
    r = upb_live_get_result(live);
    for (uint64_t f = 0; f < r->frame_count; f++)
        CHECK_EQUAL(r->frames[f].record.latency_ns, (6 * f + 11) * MS);
    check_accounts(r);
    upb_live_destroy(live);
}

/* 0.5 ms a column, 6 ms a packet: the first column of packet 2f + 2 is done half a millisecond after packet 2f + 1. */
static void test_service_per_column(void) {
    upb_live_config config = slow_config();
    const uint64_t whole[] = {6 * MS};

    for (int as_array = 0; as_array < 2; as_array++) {
        config.virtual_clock.column_service_ns = as_array ? 0 : MS / 2;
        config.virtual_clock.service_ns = whole;
        config.virtual_clock.service_count = (size_t)as_array;
        upb_live *live = run(load_model(UPB_EDGE_SEAM, 0), &config);
        const upb_live_result *r = upb_live_get_result(live);
        for (uint64_t f = 0; f + 1 < r->frame_count; f++)
            CHECK_EQUAL(r->frames[f].record.latency_ns, 2 * f * MS + 7 * MS + MS / 2);
        CHECK_EQUAL(r->column_compute.min_ns, MS / 2);
        CHECK_EQUAL(r->column_compute.max_ns, MS / 2);
        CHECK_EQUAL(r->packet_compute.max_ns, 6 * MS);
        check_accounts(r);
        upb_live_destroy(live);
    }
}

/* Service 1 ms: the latency is the wait for the packet that completes the frame, jitter included. */
static void test_jitter(void) {
    upb_live_config config = slow_config();
    const uint64_t jitter[] = {0, 7 * MS, 0}; /* packet 2 is due before packet 1 arrives, and follows it */
    config.virtual_clock.packet_service_ns = MS;
    config.virtual_clock.jitter_ns = jitter;
    config.virtual_clock.jitter_count = 3;
    upb_live *live = run(load_model(UPB_EDGE_SEAM, 0), &config);
    const upb_live_result *r = upb_live_get_result(live);
    CHECK_EQUAL(r->frames[0].record.last_input_ns, 12 * MS);
    CHECK_EQUAL(r->frames[0].record.latency_ns, 2 * MS); /* packets 1 and 2 arrive together, at 12 ms */
    CHECK_EQUAL(r->frames[0].wait_ns, 0);
    CHECK_EQUAL(r->frames[1].record.first_input_ns, 12 * MS);
    CHECK_EQUAL(r->pacer_lateness.max_ns, 7 * MS);
    check_accounts(r);
    upb_live_destroy(live);
}

/*
 * Two places, service 8 ms, arrivals every 5 ms. Services end at 8, 16, 24, so packet 3 at 15 ms finds both places
 * taken; with 32, 40 packet 6 at 30 ms; with 48, 56 packet 9 at 45 ms (packet 8 at 40 ms takes the place just freed);
 * 64: packet 11 at 55 ms.
 */
static void test_overflow_by_hand(void) {
    upb_live_config config = slow_config();
    config.ring_packets = 2;
    config.virtual_clock.packet_service_ns = 8 * MS;
    upb_live *live = run(load_model(UPB_EDGE_SEAM, 0), &config);
    const upb_live_result *r = upb_live_get_result(live);
    const uint64_t dropped[] = {3, 6, 9, 11};
    CHECK_EQUAL(r->dropped_overflow, 4);
    for (size_t i = 0; i < r->drop_count; i++) {
        CHECK_EQUAL(r->drops[i].packet, dropped[i]);
        CHECK_EQUAL(r->drops[i].at_ns, dropped[i] * 5 * MS);
        CHECK_EQUAL(r->drops[i].columns, PER_PACKET);
        CHECK_EQUAL(r->drops[i].cause, UPB_LIVE_CAUSE_OVERFLOW);
    }
    /* They are halves of frames 1, 3, 4 and 5. */
    const uint32_t missing[FRAMES] = {0, 12, 0, 12, 12, 12};
    for (size_t f = 0; f < r->frame_count; f++)
        CHECK_EQUAL(r->frames[f].record.missing_columns, missing[f]);
    check_accounts(r);
    upb_live_destroy(live);
}

static void test_dropped_packets(void) {
    upb_live_config config = slow_config();
    const uint64_t drop[] = {0, 4, 5, 7, 11}; /* half of 0, all of 2, half of 3, the end of 5 */
    const uint64_t keep[] = {1, 3, 99};
    config.drop_packets = drop;
    config.drop_count = 5;
    config.keep_frames = keep;
    config.keep_count = 3;
    upb_live *live = run(load_model(UPB_EDGE_SEAM, 0), &config);
    const upb_live_result *r = upb_live_get_result(live);
    const uint64_t frame[] = {0, 1, 3, 4, 5};
    const uint32_t missing[] = {12, 0, 12, 0, 12};
    CHECK_EQUAL(r->frame_count, 5);
    for (size_t i = 0; i < r->frame_count; i++) {
        CHECK_EQUAL(r->frames[i].record.frame, frame[i]);
        CHECK_EQUAL(r->frames[i].record.missing_columns, missing[i]);
        CHECK_EQUAL(r->frames[i].record.verdict, i == 0 ? UPB_VERDICT_PARTIAL : UPB_VERDICT_MET);
    }
    CHECK_EQUAL(r->frames_empty, 1);
    CHECK_EQUAL(r->dropped_fault, 5);
    CHECK_EQUAL(r->drops[2].cause, UPB_LIVE_CAUSE_FAULT);
    CHECK_EQUAL(r->columns_out, FRAMES * COLUMNS - PER_PACKET); /* all but what came before the stream */
    CHECK_EQUAL(r->columns_incomplete, 4 * PER_PACKET);
    CHECK_EQUAL(r->kept[0].columns_out, COLUMNS);
    CHECK_EQUAL(r->kept[1].columns_out, COLUMNS);
    CHECK_EQUAL(r->kept[2].columns_out, 0);
    CHECK_EQUAL(r->last.frame, 5);
    for (unsigned k = 0; k < UPB_BEAMS; k++) {
        const size_t column = 3; /* of frame 3, received; column 15 of it was not */
        CHECK_EQUAL(r->kept[1].distance[column * UPB_ROWS + 2 * k], distance[(3 * COLUMNS + column) * UPB_BEAMS + k]);
        CHECK_EQUAL(r->kept[1].intensity[column * UPB_ROWS + 2 * k], intensity[(3 * COLUMNS + column) * UPB_BEAMS + k]);
        CHECK_EQUAL(r->kept[1].distance[15 * UPB_ROWS + 2 * k], 0);
    }
    check_accounts(r);
    upb_live_destroy(live);
}

/* More than a turn is lost at once: the stream alone could not count it. */
static void test_many_turns_lost(void) {
    upb_live_config config = slow_config();
    uint64_t drop[39];
    for (uint64_t i = 0; i < 39; i++)
        drop[i] = 1 + i;
    config.frames_total = 40;
    config.drop_packets = drop;
    config.drop_count = 39;
    upb_live *live = run(load_model(UPB_EDGE_SEAM, 0), &config);
    const upb_live_result *r = upb_live_get_result(live);
    CHECK_EQUAL(r->frames_begun, 40);
    CHECK_EQUAL(r->frames_empty, 19);
    CHECK_EQUAL(r->frame_count, 21);
    CHECK_EQUAL(r->frames[0].record.missing_columns, 12);
    CHECK_EQUAL(r->frames[1].record.frame, 20);
    CHECK_EQUAL(r->frames[1].record.missing_columns, 0);
    check_accounts(r);
    upb_live_destroy(live);
}

/* Beams that all look to one side: frames, counted by azimuth, begin in the middle of a turn. */
static void test_shifted_sensor(void) {
    upb_live_config config = slow_config();
    for (int32_t shift = -2; shift <= 2; shift += 4) {
        upb_live *live = run(load_model(UPB_EDGE_SEAM, shift), &config);
        const upb_live_result *r = upb_live_get_result(live);
        CHECK_EQUAL(r->frames_begun, FRAMES + 1);
        CHECK_EQUAL(r->partial, 2); /* the first and the last */
        CHECK_EQUAL(r->frames[0].record.verdict, UPB_VERDICT_PARTIAL);
        CHECK_EQUAL(r->frames[0].columns_received, shift < 0 ? -shift : COLUMNS - shift);
        CHECK_EQUAL(r->frames[FRAMES].record.verdict, UPB_VERDICT_PARTIAL);
        for (size_t i = 1; i < FRAMES; i++)
            CHECK_EQUAL(r->frames[i].columns_received, COLUMNS);
        CHECK_EQUAL(r->columns_missing, 0);
        check_accounts(r);
        upb_live_destroy(live);
    }

    /* The last packet holds all that was to come of the last frame. */
    const uint64_t drop[] = {2 * FRAMES - 1};
    config.drop_packets = drop;
    config.drop_count = 1;
    upb_live *live = run(load_model(UPB_EDGE_SEAM, 2), &config);
    const upb_live_result *r = upb_live_get_result(live);
    CHECK_EQUAL(r->frames_begun, FRAMES + 1);
    CHECK_EQUAL(r->frames_empty, 1);
    check_accounts(r);
    upb_live_destroy(live);
}

/* Frame 0 is lost as a whole, and the stream begins within frame 1. */
static void test_late_beginning(void) {
    upb_live_config config = slow_config();
    const uint64_t drop[] = {0, 1, 2};
    config.drop_packets = drop;
    config.drop_count = 3;
    upb_live *live = run(load_model(UPB_EDGE_SEAM, 0), &config);
    const upb_live_result *r = upb_live_get_result(live);
    CHECK_EQUAL(r->frames_empty, 1);
    CHECK_EQUAL(r->frames[0].record.frame, 1);
    CHECK_EQUAL(r->frames[0].record.verdict, UPB_VERDICT_PARTIAL);
    CHECK_EQUAL(r->frames[0].record.missing_columns, 12);
    CHECK_EQUAL(r->frames[1].record.verdict, UPB_VERDICT_MET);
    check_accounts(r);
    upb_live_destroy(live);
}

/* ------------------------------------------------------------------------------------------------------- parts */

static void test_ring(void) {
    live_ring ring;
    live_packet packet = {.columns = PER_PACKET, .distance = distance, .intensity = intensity};

    CHECK(live_ring_init(&ring, 4, PER_PACKET));
    CHECK(live_ring_peek(&ring) == NULL);
    for (uint64_t i = 0; i < 10; i++) {
        for (packet.sequence = 4 * i; packet.sequence < 4 * i + 4; packet.sequence++) {
            packet.distance = distance + packet.sequence * UPB_BEAMS;
            CHECK(live_ring_put(&ring, &packet));
        }
        CHECK(!live_ring_put(&ring, &packet));
        for (uint64_t k = 0; k < 4; k++) {
            const live_packet *got = live_ring_peek(&ring);
            const uint16_t *sent = distance + (4 * i + k) * UPB_BEAMS;
            CHECK_EQUAL(got->sequence, 4 * i + k);
            CHECK(got->distance != sent); /* copied */
            CHECK_EQUAL(memcmp(got->distance, sent, PER_PACKET * UPB_BEAMS * sizeof *sent), 0);
            CHECK_EQUAL(memcmp(got->intensity, intensity, PER_PACKET * UPB_BEAMS), 0);
            live_ring_release(&ring);
        }
        CHECK(live_ring_peek(&ring) == NULL);
    }
    live_ring_free(&ring);
}

/* Packets of 10 columns in frames of 24, played again and again: each packet full and when due, each frame the same. */
static void test_frames_played_again(void) {
    upb_live_config config = slow_config();
    const uint64_t keep[] = {2, 2 + FRAMES};
    config.frames_total = 2 * FRAMES + 1;
    config.columns_per_packet = 10;
    config.keep_frames = keep;
    config.keep_count = 2;
    upb_live *live = run(load_model(UPB_EDGE_SEAM, 0), &config);
    const upb_live_result *r = upb_live_get_result(live);
    const size_t pixels = COLUMNS * UPB_ROWS;
    CHECK_EQUAL(r->packets_played, (2 * FRAMES + 1) * COLUMNS / 10 + 1);
    CHECK_EQUAL(r->pacer_lateness.max_ns, 0);
    CHECK_EQUAL(r->kept[1].columns_out, COLUMNS);
    CHECK_EQUAL(memcmp(r->kept[0].distance, r->kept[1].distance, pixels * sizeof *r->kept[0].distance), 0);
    CHECK_EQUAL(memcmp(r->kept[0].intensity, r->kept[1].intensity, pixels), 0);
    CHECK_EQUAL(r->last.frame, 2 * FRAMES);
    for (size_t column = 0; column < COLUMNS; column++) /* the first frame again, beyond the arrays' end */
        CHECK_EQUAL(r->last.distance[column * UPB_ROWS], distance[column * UPB_BEAMS]);
    check_accounts(r);
    upb_live_destroy(live);
}

static void test_deterministic(void) {
    upb_live_config config = slow_config();
    const uint64_t service[] = {3 * MS, 9 * MS, 1, 20 * MS, 4 * MS};
    const uint64_t jitter[] = {1, 2 * MS, 0, 4 * MS};
    config.frames_total = 50;
    config.ring_packets = 4;
    config.virtual_clock.service_ns = service;
    config.virtual_clock.service_count = 5;
    config.virtual_clock.jitter_ns = jitter;
    config.virtual_clock.jitter_count = 4;
    const upb_model *model = load_model(UPB_EDGE_SEAM, 0);
    upb_live *a = run(model, &config), *b = run(model, &config);
    const upb_live_result *x = upb_live_get_result(a), *y = upb_live_get_result(b);
    CHECK(x->dropped_overflow > 0);
    CHECK_EQUAL(x->frame_count, y->frame_count);
    CHECK_EQUAL(memcmp(x->frames, y->frames, x->frame_count * sizeof *x->frames), 0);
    CHECK_EQUAL(memcmp(x->drops, y->drops, x->drop_count * sizeof *x->drops), 0);
    CHECK_EQUAL(memcmp(&x->latency, &y->latency, sizeof x->latency), 0);
    CHECK_EQUAL(memcmp(x->last.distance, y->last.distance, COLUMNS * UPB_ROWS * sizeof *x->last.distance), 0);
    check_accounts(x);
    upb_live_destroy(a);
    upb_live_destroy(b);
}

/* ----------------------------------------------------------------------------------------------- explanations */

static void test_explains(void) {
    const upb_live_stall stalls[] = {{100, 50, 0, 0}, {120, 10, 1, 0}, {140, 40, 1, 0}, {300, 100, 0, 0}};

    CHECK(!upb_live_explains(NULL, 0, 0, 60, 50));
    CHECK(upb_live_explains(NULL, 0, 0, 50, 50));
    /* 100..180 in all, the overlaps counted once */
    CHECK(upb_live_explains(stalls, 3, 90, 220, 50));
    CHECK(!upb_live_explains(stalls, 3, 90, 221, 50));
    /* only what lies within the latency counts */
    CHECK(upb_live_explains(stalls, 4, 150, 310, 120));
    CHECK(!upb_live_explains(stalls, 4, 150, 310, 119));
    CHECK(!upb_live_explains(stalls, 4, 180, 300, 119));
}

/* ---------------------------------------------------------------------------------------------------- settings */

static void test_refusals(void) {
    const upb_model *model = load_model(UPB_EDGE_SEAM, 0);
    upb_live *live;
    upb_error error;

    upb_live_config config = slow_config();
    config.ring_packets = 3;
    CHECK_EQUAL(upb_live_create(model, &config, &live, &error), UPB_LIVE_E_ARGUMENT);
    CHECK(strcmp(error.what, "ring_packets") == 0 && live == NULL);
    config = slow_config();
    config.rate_millihertz = 0;
    CHECK_EQUAL(upb_live_create(model, &config, &live, NULL), UPB_LIVE_E_ARGUMENT);
    config = slow_config();
    config.columns = COLUMNS - 12;
    CHECK_EQUAL(upb_live_create(model, &config, &live, &error), UPB_LIVE_E_LIBRARY);
    CHECK_EQUAL(error.status, UPB_E_SENSOR);
    config = slow_config();
    live = run(model, &config);
    CHECK_EQUAL(upb_live_run(live), UPB_LIVE_E_STATE);
    upb_live_destroy(live);
    for (int status = UPB_LIVE_OK; status <= UPB_LIVE_E_STATE; status++)
        CHECK(strcmp(upb_live_status_text((upb_live_status)status), "unknown status") != 0);
}

/* --------------------------------------------------------------------------------------------------- real time */

static void test_real_threads(uint32_t wait) {
    upb_live_config config = slow_config();
    const uint64_t drop[] = {3};
    config.virtual_clock.enabled = 0;
    config.lead_ns = 5 * MS;
    config.wait = wait;
    config.frames_total = 12;
    config.drop_packets = drop;
    config.drop_count = 1;
    upb_live *live = run(load_model(UPB_EDGE_SEAM, 0), &config);
    const upb_live_result *r = upb_live_get_result(live);
    CHECK_EQUAL(r->frames_begun, 12);
    CHECK_EQUAL(r->packets_played, 24);
    CHECK_EQUAL(r->dropped_fault, 1);
    CHECK_EQUAL(r->stopped, 0);
    CHECK(r->witnesses >= 1);
    CHECK_EQUAL(r->pacer_lateness.count, 24);
    check_accounts(r);
    const upb_live_progress p = upb_live_get_progress(live);
    CHECK_EQUAL(p.frames, r->frame_count);
    CHECK_EQUAL(p.packets_played, 24);
    CHECK_EQUAL(p.max_latency_ns, r->latency.max_ns);
    upb_live_destroy(live);
}

/* Stops the run when a few frames are done, and reads the progress all the while. */
static void *stop_soon(void *argument) {
    upb_live *live = argument;
    const struct timespec pause = {0, MS};
    while (upb_live_get_progress(live).frames < 3)
        nanosleep(&pause, NULL);
    upb_live_stop(live);
    return NULL;
}

static void test_stop(int is_virtual) {
    upb_live_config config = slow_config();
    upb_live *live;
    pthread_t stopper;
    config.virtual_clock.enabled = (uint32_t)is_virtual;
    config.frames_total = 1000000; /* hours, or seconds of virtual work */
    CHECK_EQUAL(upb_live_create(load_model(UPB_EDGE_SEAM, 0), &config, &live, NULL), UPB_LIVE_OK);
    CHECK_EQUAL(pthread_create(&stopper, NULL, stop_soon, live), 0);
    CHECK_EQUAL(upb_live_run(live), UPB_LIVE_OK);
    pthread_join(stopper, NULL);
    const upb_live_result *r = upb_live_get_result(live);
    CHECK_EQUAL(r->stopped, 1);
    CHECK(r->frames_begun >= 3 && r->frames_begun < 1000000);
    CHECK(r->partial <= 1);
    if (r->columns_played % COLUMNS == PER_PACKET)
        CHECK_EQUAL(r->frames[r->frame_count - 1].record.verdict, UPB_VERDICT_PARTIAL);
    CHECK_EQUAL(r->columns_missing, 12 * r->dropped_overflow);
    check_accounts(r);
    upb_live_destroy(live);
}

int main(void) {
    fill_frames();
    test_queueing_by_hand();
    test_service_per_column();
    test_jitter();
    test_overflow_by_hand();
    test_dropped_packets();
    test_many_turns_lost();
    test_shifted_sensor();
    test_late_beginning();
    test_ring();
    test_frames_played_again();
    test_deterministic();
    test_explains();
    test_refusals();
    test_real_threads(UPB_LIVE_WAIT_BLOCK);
    test_real_threads(UPB_LIVE_WAIT_POLL);
    test_stop(0);
    test_stop(1);
    return check_report("live");
}
