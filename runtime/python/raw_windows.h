// The networks' outputs before rounding, limits and validity: for comparing floats with other implementations.
#pragma once

#include "upbeam/upbeam.h"

#ifdef __cplusplus
extern "C" {
#endif

// distance, intensity: azimuth-aligned columns [columns][UPB_BEAMS], both ends edges. Writes [columns][UPB_BEAMS]
// counts and intensities, the last of each 32 without meaning. Returns UPB_E_CPU if this machine or build lacks the
// instruction set.
upb_status upb_raw_windows(const upb_model *model, upb_cpu cpu, uint32_t columns, const uint16_t *distance,
                           const uint8_t *intensity, float *raw_distance, float *raw_intensity);

#ifdef __cplusplus
}
#endif
