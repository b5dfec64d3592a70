#include "raw_windows.h"

#include <string.h>

#include "upb_internal.h"

upb_status upb_raw_windows(const upb_model *model, upb_cpu cpu, uint32_t columns, const uint16_t *distance,
                           const uint8_t *intensity, float *raw_distance, float *raw_intensity) {
    upb_kernels kernels;
    upb_prepared_f32 empty, prepared[3];
    if (upb_kernels_select(&kernels, cpu) == UPB_CPU_AUTO)
        return UPB_E_CPU;
    memset(&empty, 0, sizeof empty);
    for (uint32_t c = 0; c <= columns; c++) { // one column behind: c - 1 is finished when c is prepared
        if (c < columns)
            kernels.prepare_f32(&prepared[c % 3], &model->f32, distance + (size_t)c * UPB_BEAMS,
                                intensity + (size_t)c * UPB_BEAMS);
        if (c == 0)
            continue;
        const size_t at = (size_t)(c - 1) * UPB_BEAMS;
        kernels.raw_f32(&model->f32, c >= 2 ? &prepared[(c - 2) % 3] : &empty, &prepared[(c - 1) % 3],
                        c < columns ? &prepared[c % 3] : &empty, raw_distance + at, raw_intensity + at);
    }
    return UPB_OK;
}
