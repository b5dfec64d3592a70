/* A column of beams from several places, in plain C. */
#ifndef UPB_COLLECT_H
#define UPB_COLLECT_H

#include "upb_kernels.h"

static inline void collect_beams(uint16_t *distance, uint8_t *intensity, const upb_beam_sources *sources) {
    for (unsigned k = 0; k < UPB_BEAMS; k++) {
        distance[k] = 0;
        intensity[k] = 0;
        for (uint32_t s = 0; s < sources->count; s++)
            if (sources->source[s].beams >> k & 1) {
                distance[k] = sources->source[s].distance[k];
                intensity[k] = sources->source[s].intensity[k];
            }
    }
}

#endif /* UPB_COLLECT_H */
