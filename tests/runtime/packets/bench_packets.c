/* Nanoseconds a packet takes, best of runs: reported, not asserted. Options: --count N (runs of 100 packets). */
#include <time.h>

#include "packet_maker.h"

#define BATCH 100u

static uint64_t now_ns(void) {
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (uint64_t)t.tv_sec * 1000000000u + (uint64_t)t.tv_nsec;
}

static void bench(upb_sensor sensor, upb_return_mode mode, unsigned long runs, random_source *random) {
    static uint8_t packets[BATCH][UPB_PACKET_BYTES];
    static upb_firing firings[BATCH][UPB_PACKET_FIRINGS], out[UPB_PACKET_FIRINGS];
    static uint32_t counts[BATCH];
    upb_packet_encoder encoder = encoder_of(sensor, mode);
    upb_packet_decoder decoder = decoder_of(sensor, UPB_PICK_STRONGEST);
    spinner s = {sensor, 7200000, 0, 0};
    uint64_t decode_ns = UINT64_MAX, encode_ns = UINT64_MAX;
    for (uint32_t k = 0; k < BATCH; k++)
        counts[k] = next_packet(&encoder, &s, random, firings[k], packets[k]);
    for (unsigned long run = 0; run < runs; run++) {
        uint32_t count = 0, ready = 0;
        const uint64_t start = now_ns();
        for (uint32_t k = 0; k < BATCH; k++)
            (void)upb_packet_decode(&decoder, packets[k], UPB_PACKET_BYTES, out, &count, NULL);
        const uint64_t between = now_ns();
        for (uint32_t k = 0; k < BATCH; k++)
            for (uint32_t f = 0; f < counts[k]; f++)
                (void)upb_packet_encode(&encoder, &firings[k][f], packets[k], &ready);
        const uint64_t end = now_ns();
        CHECK(count > 0 && ready);
        decode_ns = between - start < decode_ns ? between - start : decode_ns;
        encode_ns = end - between < encode_ns ? end - between : encode_ns;
    }
    printf("%-10s %-9s decode %5llu ns, encode %5llu ns a packet\n", upb_sensor_info_get(sensor)->name,
           mode == UPB_RETURN_DUAL ? "dual" : "strongest", (unsigned long long)(decode_ns / BATCH),
           (unsigned long long)(encode_ns / BATCH));
}

int main(int argc, char **argv) {
    random_source random = random_seeded(1);
    const unsigned long runs = option_number(argc, argv, "--count", 5000);
    for (uint32_t s = 0; s < DECODED_SENSORS; s++) {
        bench(decoded_sensors[s], UPB_RETURN_STRONGEST, runs, &random);
        bench(decoded_sensors[s], UPB_RETURN_DUAL, runs, &random);
    }
    return check_report("bench_packets");
}
