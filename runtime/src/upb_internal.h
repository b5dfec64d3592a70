/* What the source files of the library share. */
#ifndef UPB_INTERNAL_H
#define UPB_INTERNAL_H

#include <stddef.h>
#include <stdint.h>

#include "upb_kernels.h"
#include "upbeam/upbeam.h"

struct upb_model {
    upb_model_f32 f32;
    upb_model_int integer[UPB_PRECISIONS - 1]; /* of INT16, INT8; networks are zeros where the file has none */
    upb_model_info info;
};

/* True if the model file has the precision. */
static inline int upb_model_has(const upb_model *model, uint32_t precision) {
    return (model->info.precisions >> precision & 1) != 0;
}

/* The model of an integer precision. */
static inline const upb_model_int *upb_model_integer(const upb_model *model, uint32_t precision) {
    return &model->integer[precision - UPB_PRECISION_INT16];
}

/* Fills `error` unless it is null, and returns `status`. `what` is cut to fit. */
upb_status upb_fail(upb_error *error, upb_status status, const char *what, uint64_t offset, uint64_t got,
                    uint64_t expected);

/* OK if `bytes` bytes at `memory` can hold `needed`. */
upb_status upb_check_memory(const void *memory, size_t bytes, size_t needed, upb_error *error);

/* floor(offset * columns / 360 degrees + 0.5), exact. */
int32_t upb_offset_columns(int32_t offset_udeg, uint32_t columns);

/* CRC-32 (CRC-32/ISO-HDLC) of bytes that follow others whose CRC is `crc`; 0 to begin. */
uint32_t upb_crc32(uint32_t crc, const void *bytes, size_t size);

/* For tests: a number of the stream whose damage shows in upb_stream_checksum and nowhere else. */
uint32_t *upb_stream_test_constant(upb_stream *stream);

/*
 * The generated rows of one column in every mode but NETWORK. limits: of the model, those alone are used; distance,
 * intensity: [UPB_BEAMS] of the sensor; out_*: [UPB_LANES], of which lane UPB_WINDOWS has no meaning.
 */
void upb_ladder_column(const upb_model_int *limits, upb_mode mode, const uint16_t *distance, const uint8_t *intensity,
                       uint16_t *out_distance, uint8_t *out_intensity);

#endif /* UPB_INTERNAL_H */
