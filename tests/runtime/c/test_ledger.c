/* Histogram and deadline ledger, on a clock that stands still unless it is moved. */
#include "check.h"
#include "upbeam/upbeam.h"

/* -------------------------------------------------------------------------------------------- histogram */

enum { SAMPLES = 20000 };

static int compare_u64(const void *a, const void *b) {
    const uint64_t x = *(const uint64_t *)a, y = *(const uint64_t *)b;
    return (x > y) - (x < y);
}

/* Spread evenly over the octaves below 2^bits. */
static uint64_t random_ns(random_source *random, unsigned bits) {
    const uint64_t value = (uint64_t)random_u32(random) << 32 | random_u32(random);
    return value >> (64 - 1 - random_below(random, bits));
}

/* The definition: the least sample that at least this share of all do not exceed. */
static uint64_t true_quantile(const uint64_t *sorted, unsigned count, uint32_t per_million) {
    const uint64_t rank = ((uint64_t)count * per_million + 999999) / 1000000;
    return sorted[rank ? rank - 1 : 0];
}

static void check_quantiles(const upb_histogram *histogram, uint64_t *samples, unsigned count) {
    static const uint32_t shares[] = {0, 1, 1000, 10000, 250000, 500000, 900000, 990000, 999000, 999999, 1000000};
    qsort(samples, count, sizeof samples[0], compare_u64);
    for (unsigned i = 0; i < sizeof shares / sizeof shares[0]; i++) {
        const uint64_t got = upb_histogram_quantile(histogram, shares[i]);
        const uint64_t expected = true_quantile(samples, count, shares[i]);
        CHECK(got >= expected);
        CHECK(got - expected <= expected / 32);
        if (expected < 64)
            CHECK_EQUAL(got, expected);
    }
    CHECK_EQUAL(upb_histogram_quantile(histogram, 1000000), samples[count - 1]);
    CHECK_EQUAL(histogram->min_ns, samples[0]);
    CHECK_EQUAL(histogram->max_ns, samples[count - 1]);
    CHECK_EQUAL(histogram->count, count);
}

static void test_quantiles(random_source *random) {
    static uint64_t samples[SAMPLES];
    static upb_histogram histogram, half, merged;
    for (unsigned bits = 3; bits <= 40; bits++) {
        const unsigned count = bits % 5 ? SAMPLES : 1 + random_below(random, 5);
        uint64_t sum = 0;
        upb_histogram_reset(&histogram);
        upb_histogram_reset(&half);
        upb_histogram_reset(&merged);
        for (unsigned i = 0; i < count; i++) {
            samples[i] = random_ns(random, bits);
            sum += samples[i];
            upb_histogram_add(&histogram, samples[i]);
            upb_histogram_add(i % 2 ? &half : &merged, samples[i]);
        }
        CHECK_EQUAL(histogram.sum_ns, sum);
        check_quantiles(&histogram, samples, count);
        upb_histogram_merge(&merged, &half);
        CHECK(memcmp(&merged, &histogram, sizeof merged) == 0);
    }
}

/* Every value at a border of buckets, alone in the histogram with a larger one. */
static void test_bucket_borders(void) {
    static upb_histogram histogram;
    for (unsigned bit = 0; bit <= 42; bit++)
        for (int step = -2; step <= 2; step++) {
            const uint64_t value = ((uint64_t)1 << bit) + (uint64_t)(int64_t)step;
            if (value >> 43)
                continue; /* 2^0 - 2 */
            upb_histogram_reset(&histogram);
            upb_histogram_add(&histogram, value);
            upb_histogram_add(&histogram, (uint64_t)1 << 50);
            const uint64_t got = upb_histogram_quantile(&histogram, 500000);
            CHECK(got >= value);
            /* the last bucket is shared with what is longer */
            CHECK(value >= ((uint64_t)63 << 34) || got - value <= value / 32);
            CHECK_EQUAL(upb_histogram_quantile(&histogram, 2000000), (uint64_t)1 << 50);
        }
}

static void test_empty_histogram(void) {
    static upb_histogram empty, one;
    upb_histogram_reset(&empty);
    CHECK_EQUAL(upb_histogram_quantile(&empty, 500000), 0);
    upb_histogram_reset(&one);
    upb_histogram_add(&one, 1000);
    upb_histogram_merge(&one, &empty);
    CHECK_EQUAL(one.min_ns, 1000);
    CHECK_EQUAL(one.count, 1);
    upb_histogram_merge(&empty, &one);
    CHECK(memcmp(&empty, &one, sizeof one) == 0);
}

/* ----------------------------------------------------------------------------------------------- ledger */

static uint64_t now_ns;

static uint64_t read_clock(void *user) {
    CHECK(user == &now_ns);
    return now_ns;
}

static const upb_clock test_clock = {read_clock, &now_ns};

static void test_life_cycle(void) {
    static upb_ledger ledger;
    upb_ledger_record ring[2], record;
    CHECK_EQUAL(upb_ledger_init(&ledger, ring, 2, 1000, test_clock), UPB_OK);

    CHECK_EQUAL(upb_ledger_input(&ledger, 0, 100), UPB_OK);
    CHECK_EQUAL(upb_ledger_input(&ledger, 0, 5000), UPB_OK);
    CHECK_EQUAL(upb_ledger_input(&ledger, 1, 5001), UPB_OK);
    now_ns = 6000; /* exactly the deadline: met */
    CHECK_EQUAL(upb_ledger_output(&ledger, 0, 3, 0, UPB_MODE_NETWORK, &record), UPB_OK);
    CHECK_EQUAL(record.frame, 0);
    CHECK_EQUAL(record.first_input_ns, 100);
    CHECK_EQUAL(record.last_input_ns, 5000);
    CHECK_EQUAL(record.output_ns, 6000);
    CHECK_EQUAL(record.latency_ns, 1000);
    CHECK_EQUAL(record.verdict, UPB_VERDICT_MET);
    CHECK_EQUAL(record.missing_columns, 3);
    CHECK(memcmp(&record, &ring[0], sizeof record) == 0);

    CHECK_EQUAL(upb_ledger_input(&ledger, 1, 9000), UPB_OK);
    now_ns = 10001;
    CHECK_EQUAL(upb_ledger_output(&ledger, 1, 0, 0, UPB_MODE_NETWORK, &record), UPB_OK);
    CHECK_EQUAL(record.verdict, UPB_VERDICT_MISSED);

    CHECK_EQUAL(upb_ledger_input(&ledger, 7, 11000), UPB_OK);
    now_ns = 99999; /* far too late, but partial: not judged */
    CHECK_EQUAL(upb_ledger_output(&ledger, 7, 0, 1, UPB_MODE_NETWORK, NULL), UPB_OK);
    CHECK_EQUAL(ring[0].frame, 7); /* the ring went round */
    CHECK_EQUAL(ring[0].verdict, UPB_VERDICT_PARTIAL);
    CHECK_EQUAL(ledger.closed, 3);
    CHECK_EQUAL(ledger.missed, 1);
    CHECK_EQUAL(ledger.partial, 1);
    CHECK_EQUAL(ledger.lost, 0);
    CHECK_EQUAL(ledger.latency.count, 2);
    CHECK_EQUAL(ledger.latency.max_ns, 1001);
    CHECK_EQUAL(ledger.open_count, 0);
}

static void test_lost_frames(void) {
    static upb_ledger ledger;
    upb_ledger_record ring[8];
    upb_ledger_init(&ledger, ring, 8, 1000, test_clock);
    now_ns = 1000;
    for (uint64_t frame = 0; frame < 6; frame++)
        CHECK_EQUAL(upb_ledger_input(&ledger, frame, 100 + frame), UPB_OK);
    CHECK_EQUAL(ledger.open_count, 4);
    CHECK_EQUAL(ledger.lost, 2);
    CHECK_EQUAL(upb_ledger_output(&ledger, 1, 0, 0, 0, NULL), UPB_E_ARGUMENT); /* lost */
    CHECK_EQUAL(upb_ledger_output(&ledger, 3, 0, 0, 0, NULL), UPB_OK);         /* from the middle */
    CHECK_EQUAL(ledger.open_count, 3);
    CHECK_EQUAL(upb_ledger_output(&ledger, 3, 0, 0, 0, NULL), UPB_E_ARGUMENT); /* closed already */
    CHECK_EQUAL(upb_ledger_output(&ledger, 2, 0, 0, 0, NULL), UPB_OK);
    CHECK_EQUAL(upb_ledger_output(&ledger, 5, 0, 0, 0, NULL), UPB_OK);
    CHECK_EQUAL(ring[2].first_input_ns, 105);
    CHECK_EQUAL(ledger.open_count, 1);
}

static void test_ledger_errors(void) {
    static upb_ledger ledger;
    upb_ledger_record ring[1];
    const upb_clock no_clock = {NULL, NULL};
    CHECK_EQUAL(upb_ledger_init(NULL, ring, 1, 1, test_clock), UPB_E_ARGUMENT);
    CHECK_EQUAL(upb_ledger_init(&ledger, NULL, 1, 1, test_clock), UPB_E_ARGUMENT);
    CHECK_EQUAL(upb_ledger_init(&ledger, ring, 0, 1, test_clock), UPB_E_ARGUMENT);
    CHECK_EQUAL(upb_ledger_init(&ledger, ring, 1, 1, no_clock), UPB_E_ARGUMENT);
    CHECK_EQUAL(upb_ledger_init(&ledger, ring, 1, 1, test_clock), UPB_OK);
    CHECK_EQUAL(upb_ledger_input(&ledger, 5, 100), UPB_OK);
    CHECK_EQUAL(upb_ledger_input(&ledger, 5, 99), UPB_E_ARGUMENT); /* time runs backwards */
    CHECK_EQUAL(upb_ledger_input(&ledger, 4, 101), UPB_E_ARGUMENT);
    CHECK_EQUAL(upb_ledger_output(&ledger, 5, 0, 0, 99, NULL), UPB_E_ARGUMENT);
    now_ns = 50;
    CHECK_EQUAL(upb_ledger_output(&ledger, 5, 0, 0, 0, NULL), UPB_E_ARGUMENT);
    CHECK_EQUAL(ledger.open_count, 1);
    now_ns = 100;
    CHECK_EQUAL(upb_ledger_output(&ledger, 5, 0, 0, 0, NULL), UPB_OK);
    CHECK_EQUAL(upb_ledger_input(&ledger, 5, 200), UPB_E_ARGUMENT); /* never opened again */
    CHECK_EQUAL(upb_ledger_input(&ledger, 6, 200), UPB_OK);
}

int main(int argc, char **argv) {
    const unsigned long seed = option_number(argc, argv, "--seed", 1);
    random_source random = random_seeded(seed);
    test_quantiles(&random);
    test_bucket_borders();
    test_empty_histogram();
    test_life_cycle();
    test_lost_frames();
    test_ledger_errors();
    return check_report("ledger");
}
