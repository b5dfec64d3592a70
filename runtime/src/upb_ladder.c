/*
 * Generated rows without a network: the lower rungs of the degradation ladder (upb_mode). One plain C file for every
 * CPU: whole numbers give the same bits everywhere, and compilers make vectors of these loops.
 */
#include <string.h>

#include "upb_internal.h"

/* What the networks would see of a column: pixels beyond their row's limits are 0. One lane more, always empty. */
typedef struct seen_column {
    uint16_t distance[UPB_LANES + 1];
    uint16_t intensity[UPB_LANES + 1];
} seen_column;

/* All ones where `yes`, else 0: masks instead of branches, so that compilers make vectors of the loops. */
static inline uint16_t mask_of(int yes) { return (uint16_t)-yes; }

static void see(seen_column *seen, const upb_model_int *limits, const uint16_t *distance, const uint8_t *intensity) {
    const uint16_t least = limits->min_count;
    for (unsigned k = 0; k < UPB_LANES; k++) {
        const uint16_t is_seen =
            (uint16_t)(mask_of(distance[k] >= least) & mask_of(distance[k] <= limits->seen_max[k]));
        seen->distance[k] = distance[k] & is_seen;
        seen->intensity[k] = intensity[k] & is_seen;
    }
    seen->distance[UPB_LANES] = seen->intensity[UPB_LANES] = 0;
}

/* Of two neighbours; empty ones are 0 in both images, so that a sum of one is that one. */
static void valid_mean(const seen_column *seen, uint16_t *distance, uint16_t *intensity) {
    for (unsigned k = 0; k < UPB_LANES; k++) {
        const uint16_t a = seen->distance[k], b = seen->distance[k + 1];
        const uint16_t grey = (uint16_t)(seen->intensity[k] + seen->intensity[k + 1]);
        const uint16_t both = (uint16_t)(mask_of(a != 0) & mask_of(b != 0));
        const uint16_t mean = (uint16_t)((a & b) + ((a ^ b) >> 1) + ((a ^ b) & 1)); /* (a + b + 1) / 2 in 16 bits */
        distance[k] = (uint16_t)((mean & both) | ((a | b) & ~both));
        intensity[k] = (uint16_t)((((grey + 1) >> 1) & both) | (grey & ~both));
    }
}

/* What is generated beyond its row's limit is no return. */
static void give(const upb_model_int *limits, const uint16_t *distance, const uint16_t *intensity,
                 uint16_t *out_distance, uint8_t *out_intensity) {
    for (unsigned k = 0; k < UPB_LANES; k++) {
        const uint16_t is_given = mask_of(distance[k] <= limits->given_max[k]);
        out_distance[k] = distance[k] & is_given;
        out_intensity[k] = (uint8_t)(intensity[k] & is_given & mask_of(distance[k] != 0));
    }
}

void upb_ladder_column(const upb_model_int *limits, upb_mode mode, const uint16_t *distance, const uint8_t *intensity,
                       uint16_t *out_distance, uint8_t *out_intensity) {
    if (mode == UPB_MODE_PASS_THROUGH) {
        memset(out_distance, 0, UPB_LANES * sizeof *out_distance);
        memset(out_intensity, 0, UPB_LANES);
        return;
    }
    seen_column seen;
    uint16_t made[UPB_LANES], grey[UPB_LANES];
    see(&seen, limits, distance, intensity);
    if (mode == UPB_MODE_REPEAT) {
        give(limits, seen.distance, seen.intensity, out_distance, out_intensity);
        return;
    }
    valid_mean(&seen, made, grey);
    give(limits, made, grey, out_distance, out_intensity);
}
