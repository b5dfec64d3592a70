/* Latency histogram in fixed memory: 64 exact buckets, then 32 an octave. */
#include <string.h>

#include "upbeam/upbeam.h"

enum { EXACT = 64, EXACT_BITS = 6, OCTAVE = 32, OCTAVE_BITS = 5, TOP_BITS = 40 };

_Static_assert(EXACT + (TOP_BITS - EXACT_BITS) * OCTAVE == UPB_HISTOGRAM_BUCKETS, "buckets");

static uint32_t bucket_of(uint64_t ns) {
    if (ns < EXACT)
        return (uint32_t)ns;
    if (ns >> TOP_BITS)
        return UPB_HISTOGRAM_BUCKETS - 1;
    uint32_t octave = EXACT_BITS;
    while (ns >> (octave + 1))
        octave++;
    return EXACT + (octave - EXACT_BITS) * OCTAVE + ((uint32_t)(ns >> (octave - OCTAVE_BITS)) & (OCTAVE - 1));
}

/* The greatest value that falls into a bucket. */
static uint64_t bucket_end(uint32_t bucket) {
    if (bucket < EXACT)
        return bucket;
    if (bucket == UPB_HISTOGRAM_BUCKETS - 1)
        return UINT64_MAX; /* what is too long is counted here */
    const uint32_t octave = EXACT_BITS + (bucket - EXACT) / OCTAVE, step = (bucket - EXACT) % OCTAVE;
    return ((uint64_t)(OCTAVE + step + 1) << (octave - OCTAVE_BITS)) - 1;
}

static uint32_t add_u32(uint32_t a, uint32_t b) { return a > UINT32_MAX - b ? UINT32_MAX : a + b; }

void upb_histogram_reset(upb_histogram *histogram) { memset(histogram, 0, sizeof *histogram); }

void upb_histogram_add(upb_histogram *histogram, uint64_t ns) {
    uint32_t *bucket = &histogram->bucket[bucket_of(ns)];
    *bucket = add_u32(*bucket, 1);
    if (histogram->count == 0 || ns < histogram->min_ns)
        histogram->min_ns = ns;
    if (ns > histogram->max_ns)
        histogram->max_ns = ns;
    histogram->count++;
    histogram->sum_ns += ns;
}

uint64_t upb_histogram_quantile(const upb_histogram *histogram, uint32_t per_million) {
    const uint64_t million = 1000000, share = per_million < million ? per_million : million;
    /* ceil(count * share / million) without overflow: the rank of the value asked for, counted from 1 */
    const uint64_t whole = histogram->count / million, rest = histogram->count % million;
    uint64_t rank = whole * share + (rest * share + million - 1) / million, seen = 0;
    if (rank == 0)
        rank = 1;
    for (uint32_t b = 0; b < UPB_HISTOGRAM_BUCKETS; b++) {
        seen += histogram->bucket[b];
        if (seen >= rank)
            return bucket_end(b) < histogram->max_ns ? bucket_end(b) : histogram->max_ns;
    }
    return histogram->max_ns; /* empty: 0 */
}

void upb_histogram_merge(upb_histogram *histogram, const upb_histogram *other) {
    if (other->count == 0)
        return;
    if (histogram->count == 0 || other->min_ns < histogram->min_ns)
        histogram->min_ns = other->min_ns;
    if (other->max_ns > histogram->max_ns)
        histogram->max_ns = other->max_ns;
    histogram->count += other->count;
    histogram->sum_ns += other->sum_ns;
    for (uint32_t b = 0; b < UPB_HISTOGRAM_BUCKETS; b++)
        histogram->bucket[b] = add_u32(histogram->bucket[b], other->bucket[b]);
}
