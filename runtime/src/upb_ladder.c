/*
 * Generated rows without a network: the lower rungs of the degradation ladder (upb_mode). One plain C file for every
 * CPU: whole numbers give the same bits everywhere, and compilers make vectors of these loops.
 */
#include <string.h>

#include "upb_internal.h"

/* What the networks would see of a column: pixels beyond their row's limits are 0. */
typedef struct seen_column {
    uint16_t distance[UPB_BEAMS];
    uint16_t intensity[UPB_BEAMS];
} seen_column;

static void see(seen_column *seen, const upb_model_info *info, const uint16_t *distance, const uint8_t *intensity) {
    for (unsigned k = 0; k < UPB_BEAMS; k++) {
        const uint16_t most = info->row_max_count[2 * k], count = distance[k];
        const int is_seen = count >= info->min_count && count <= most;
        seen->distance[k] = is_seen ? count : 0;
        seen->intensity[k] = is_seen ? intensity[k] : 0;
    }
}

/* Of two neighbours; empty ones are 0 in both images, so that a sum of one is that one. */
static void valid_mean(const seen_column *seen, uint16_t *distance, uint8_t *intensity) {
    for (unsigned k = 0; k < UPB_WINDOWS; k++) {
        const uint32_t a = seen->distance[k], b = seen->distance[k + 1];
        const uint32_t grey = (uint32_t)seen->intensity[k] + seen->intensity[k + 1];
        const int both = a && b;
        distance[k] = (uint16_t)(both ? (a + b + 1) / 2 : a + b);
        intensity[k] = (uint8_t)(both ? (grey + 1) / 2 : grey);
    }
}

static void repeat(const seen_column *seen, uint16_t *distance, uint8_t *intensity) {
    for (unsigned k = 0; k < UPB_WINDOWS; k++) {
        distance[k] = seen->distance[k];
        intensity[k] = (uint8_t)seen->intensity[k];
    }
}

/* What is generated beyond its row's limit is no return. */
static void give(const upb_model_info *info, uint16_t *distance, uint8_t *intensity) {
    for (unsigned k = 0; k < UPB_WINDOWS; k++) {
        const int is_given = distance[k] <= info->row_max_count[2 * k + 1];
        distance[k] = is_given ? distance[k] : 0;
        intensity[k] = is_given && distance[k] ? intensity[k] : 0;
    }
}

void upb_ladder_column(const upb_model_info *info, upb_mode mode, const uint16_t *distance, const uint8_t *intensity,
                       uint16_t *out_distance, uint8_t *out_intensity) {
    if (mode == UPB_MODE_PASS_THROUGH) {
        memset(out_distance, 0, UPB_LANES * sizeof *out_distance);
        memset(out_intensity, 0, UPB_LANES);
        return;
    }
    seen_column seen;
    see(&seen, info, distance, intensity);
    if (mode == UPB_MODE_VALID_MEAN)
        valid_mean(&seen, out_distance, out_intensity);
    else
        repeat(&seen, out_distance, out_intensity);
    give(info, out_distance, out_intensity);
    out_distance[UPB_WINDOWS] = 0;
    out_intensity[UPB_WINDOWS] = 0;
}
