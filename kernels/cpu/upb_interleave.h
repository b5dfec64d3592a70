/*
 * Rows 0, 2, ... and 1, 3, ... of a column become one column. The vectors here are part of every x86-64 and AArch64, so
 * that this needs no choice at run time. Of the plain loops, not every compiler makes such vectors.
 */
#ifndef UPB_INTERLEAVE_H
#define UPB_INTERLEAVE_H

#include <stddef.h>
#include <stdint.h>

#if defined(__SSE2__)

#include <emmintrin.h>

enum { INTERLEAVE_BYTES = 16 };

static inline void interleave_u16(uint16_t *out, const uint16_t *even, const uint16_t *odd) {
    const __m128i a = _mm_loadu_si128((const __m128i *)(const void *)even);
    const __m128i b = _mm_loadu_si128((const __m128i *)(const void *)odd);
    _mm_storeu_si128((__m128i *)(void *)out, _mm_unpacklo_epi16(a, b));
    _mm_storeu_si128((__m128i *)(void *)(out + 8), _mm_unpackhi_epi16(a, b));
}

static inline void interleave_u8(uint8_t *out, const uint8_t *even, const uint8_t *odd) {
    const __m128i a = _mm_loadu_si128((const __m128i *)(const void *)even);
    const __m128i b = _mm_loadu_si128((const __m128i *)(const void *)odd);
    _mm_storeu_si128((__m128i *)(void *)out, _mm_unpacklo_epi8(a, b));
    _mm_storeu_si128((__m128i *)(void *)(out + 16), _mm_unpackhi_epi8(a, b));
}

#elif defined(__aarch64__)

#include <arm_neon.h>

enum { INTERLEAVE_BYTES = 16 };

static inline void interleave_u16(uint16_t *out, const uint16_t *even, const uint16_t *odd) {
    vst2q_u16(out, ((uint16x8x2_t){{vld1q_u16(even), vld1q_u16(odd)}}));
}

static inline void interleave_u8(uint8_t *out, const uint8_t *even, const uint8_t *odd) {
    vst2q_u8(out, ((uint8x16x2_t){{vld1q_u8(even), vld1q_u8(odd)}}));
}

#else

enum { INTERLEAVE_BYTES = 2 };

static inline void interleave_u16(uint16_t *out, const uint16_t *even, const uint16_t *odd) {
    out[0] = *even;
    out[1] = *odd;
}

static inline void interleave_u8(uint8_t *out, const uint8_t *even, const uint8_t *odd) {
    for (int i = 0; i < INTERLEAVE_BYTES; i++) {
        out[2 * i] = even[i];
        out[2 * i + 1] = odd[i];
    }
}

#endif

/* rows: of even and of odd each, a multiple of 16; `out_*` have twice as many. No alignment needed, no overlap. */
static inline void interleave_rows(size_t rows, uint16_t *out_distance, uint8_t *out_intensity,
                                   const uint16_t *even_distance, const uint8_t *even_intensity,
                                   const uint16_t *odd_distance, const uint8_t *odd_intensity) {
    for (size_t k = 0; k < rows; k += INTERLEAVE_BYTES / 2)
        interleave_u16(out_distance + 2 * k, even_distance + k, odd_distance + k);
    for (size_t k = 0; k < rows; k += INTERLEAVE_BYTES)
        interleave_u8(out_intensity + 2 * k, even_intensity + k, odd_intensity + k);
}

#endif /* UPB_INTERLEAVE_H */
