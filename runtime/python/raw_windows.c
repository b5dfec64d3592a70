#include "raw_windows.h"

#include <string.h>

#include "upb_internal.h"
#include "upb_network_int.h"

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

upb_status upb_int_windows(const upb_model *model, upb_precision precision, upb_cpu cpu, uint32_t columns,
                           const uint16_t *distance, const uint8_t *intensity, uint16_t *out_distance,
                           uint8_t *out_intensity) {
    upb_kernels kernels;
    upb_prepared_int empty, prepared[3];
    if (precision == UPB_PRECISION_FP32 || !upb_model_has(model, precision))
        return UPB_E_PRECISION;
    if (upb_kernels_select(&kernels, cpu) == UPB_CPU_AUTO)
        return UPB_E_CPU;
    const upb_model_int *integer = upb_model_integer(model, precision);
    const upb_windows_int_fn windows = precision == UPB_PRECISION_INT16 ? kernels.windows_int16 : kernels.windows_int8;
    memset(&empty, 0, sizeof empty);
    for (uint32_t c = 0; c <= columns; c++) { // one column behind, as above
        if (c < columns)
            kernels.prepare_int(&prepared[c % 3], integer, distance + (size_t)c * UPB_BEAMS,
                                intensity + (size_t)c * UPB_BEAMS);
        if (c == 0)
            continue;
        uint16_t *d = out_distance + (size_t)(c - 1) * UPB_LANES;
        uint8_t *i = out_intensity + (size_t)(c - 1) * UPB_LANES;
        windows(integer, c >= 2 ? &prepared[(c - 2) % 3] : &empty, &prepared[(c - 1) % 3],
                c < columns ? &prepared[c % 3] : &empty, d, i);
        d[UPB_WINDOWS] = 0;
        i[UPB_WINDOWS] = 0;
    }
    return UPB_OK;
}

upb_status upb_int_trace_window(const upb_model *model, upb_precision precision, int which, const uint16_t window[6],
                                upb_int_steps *steps) {
    upb_int_trace t;
    if (precision == UPB_PRECISION_FP32 || !upb_model_has(model, precision))
        return UPB_E_PRECISION;
    const upb_network_int *net = &upb_model_integer(model, precision)->network[which];
    upb_trace_int(net, precision, window, &t);
    *steps = (upb_int_steps){
        .hidden = net->hidden, .m = t.minimum, .s = (int32_t)t.shift, .Y = t.output, .r = t.rounded, .y = t.value};
    for (int i = 0; i < 6; i++) {
        steps->d[i] = t.difference[i];
        steps->q[i] = t.code[i];
    }
    for (uint32_t h = 0; h < net->hidden; h++) {
        steps->S[h] = t.sum[h];
        steps->a[h] = t.hidden[h];
        steps->z[h] = t.rectified[h];
    }
    return UPB_OK;
}
