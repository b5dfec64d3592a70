// The networks without a stream around them: for comparing kernels with other implementations, and looking inside.
#pragma once

#include "upbeam/upbeam.h"

#ifdef __cplusplus
extern "C" {
#endif

// The float networks' outputs before rounding, limits and validity. distance, intensity: azimuth-aligned columns
// [columns][UPB_BEAMS], both ends edges. Writes [columns][UPB_BEAMS] counts and intensities, the last of each 32
// without meaning. Returns UPB_E_CPU if this machine or build lacks the instruction set.
upb_status upb_raw_windows(const upb_model *model, upb_cpu cpu, uint32_t columns, const uint16_t *distance,
                           const uint8_t *intensity, float *raw_distance, float *raw_intensity);

// What an integer kernel generates, for columns as above. Writes [columns][UPB_BEAMS], the last of each 32 is 0.
// Returns UPB_E_CPU, UPB_E_PRECISION.
upb_status upb_int_windows(const upb_model *model, upb_precision precision, upb_cpu cpu, uint32_t columns,
                           const uint16_t *distance, const uint8_t *intensity, uint16_t *out_distance,
                           uint8_t *out_intensity);

// The steps of docs/numeric-contract.md, by their names there.
typedef struct upb_int_steps {
    uint32_t hidden; // units, padded to an even number
    int32_t m, d[6], s, q[6], S[UPB_MAX_HIDDEN], a[UPB_MAX_HIDDEN], z[UPB_MAX_HIDDEN], Y, r, y;
} upb_int_steps;

// Traces one integer network (0: distance, 1: intensity) in one window, after filling. Returns UPB_E_PRECISION.
upb_status upb_int_trace_window(const upb_model *model, upb_precision precision, int which, const uint16_t window[6],
                                upb_int_steps *steps);

#ifdef __cplusplus
}
#endif
