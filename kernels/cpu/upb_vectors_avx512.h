/*
 * Vectors of unsigned 16-bit numbers with AVX-512 (F, BW, DQ, VL): all windows of a column are one. See
 * upb_kernel_rules.h for what the names mean.
 */
#ifndef UPB_VECTORS_AVX512_H
#define UPB_VECTORS_AVX512_H

#include <immintrin.h>
#include <stdint.h>

#include "upb_kernels.h"

#define V __m512i
#define I __m512i
#define M __mmask32
#define V_LANES 32

typedef struct wide {
    I half[2];
} wide;

#define W wide

static inline V next_lanes(V a, V b) {
    static const _Alignas(64) uint16_t next[32] = {1,  2,  3,  4,  5,  6,  7,  8,  9,  10, 11, 12, 13, 14, 15, 16,
                                                   17, 18, 19, 20, 21, 22, 23, 24, 25, 26, 27, 28, 29, 30, 31, 32};
    return _mm512_permutex2var_epi16(a, _mm512_load_si512(next), b);
}

/* By half bytes. Of a byte from 128 on, the lower half is looked up as 0: the upper one says all. */
static inline V smear_upper(V v) {
    const V of_low = _mm512_broadcast_i32x4(_mm_setr_epi8(0, 1, 3, 3, 7, 7, 7, 7, 15, 15, 15, 15, 15, 15, 15, 15));
    const V of_high =
        _mm512_broadcast_i32x4(_mm_setr_epi8(0, 31, 63, 63, 127, 127, 127, 127, -1, -1, -1, -1, -1, -1, -1, -1));
    return _mm512_or_si512(_mm512_shuffle_epi8(of_low, v), _mm512_shuffle_epi8(of_high, _mm512_srli_epi16(v, 4)));
}

static inline V load_floats(const float *p) {
    const __m256i low = _mm512_cvtepi32_epi16(_mm512_cvttps_epi32(_mm512_load_ps(p)));
    const __m256i high = _mm512_cvtepi32_epi16(_mm512_cvttps_epi32(_mm512_load_ps(p + 16)));
    return _mm512_inserti64x4(_mm512_castsi256_si512(low), high, 1);
}

static inline W minus_1(W w) {
    const I ones = _mm512_set1_epi32(-1);
    return (W){{_mm512_add_epi32(w.half[0], ones), _mm512_add_epi32(w.half[1], ones)}};
}

static inline W add_words(W w, V v) {
    const I zero = _mm512_setzero_si512();
    return (W){{_mm512_add_epi32(w.half[0], _mm512_unpacklo_epi16(v, zero)),
                _mm512_add_epi32(w.half[1], _mm512_unpackhi_epi16(v, zero))}};
}

#define V_LOAD(p) _mm512_load_si512(p)
#define V_LOAD_FLOATS(p) load_floats(p)
#define V_LOADU(p) _mm512_loadu_si512(p)
#define V_STORE(p, v) _mm512_store_si512(p, v)
#define V_STOREU(p, v) _mm512_storeu_si512(p, v)
#define V_LOAD_U8(p) _mm512_cvtepu8_epi16(_mm256_loadu_si256((const __m256i *)(const void *)(p)))
#define V_STORE_U8(p, v) _mm256_storeu_si256((__m256i *)(void *)(p), _mm512_cvtepi16_epi8(v))
#define V_SET(x) _mm512_set1_epi16((int16_t)(x))
#define V_ADD_SAT(a, b) _mm512_adds_epu16(a, b)
#define V_SUB(a, b) _mm512_sub_epi16(a, b)
#define V_AND(a, b) _mm512_and_si512(a, b)
#define V_OR(a, b) _mm512_or_si512(a, b)
#define V_XOR(a, b) _mm512_xor_si512(a, b)
#define V_OR3(a, b, c) _mm512_ternarylogic_epi32(a, b, c, 0xfe)
#define V_CLEAR_XOR(a, b, c) _mm512_ternarylogic_epi32(a, b, c, 0x9a)
#define V_AVERAGE(a, b) _mm512_avg_epu16(a, b)
#define V_MIN(a, b) _mm512_min_epu16(a, b)
#define V_SHIFT_LEFT(v, n) _mm512_sll_epi16(v, _mm_cvtsi32_si128((int)(n)))
#define V_SHIFT_RIGHT(v, n) _mm512_srl_epi16(v, _mm_cvtsi32_si128((int)(n)))
#define V_NEXT(a, b) next_lanes(a, b)
#define V_SMEAR_UPPER(v) smear_upper(v)
#define M_ALL(yes) ((__mmask32)(0u - (unsigned)(yes)))
#define M_BITS(bits) ((__mmask32)(bits))
#define M_IS_ZERO(v) _mm512_testn_epi16_mask(v, v)
#define M_AT_LEAST(a, b) _mm512_cmpge_epu16_mask(a, b)
#define M_AND(m, n) ((m) & (n))
#define M_AND_NOT(m, n) ((m) & ~(n))
#define V_SELECT(m, yes, no) _mm512_mask_blend_epi16(m, no, yes)
#define V_MIN_WHERE(m, a, b, no) _mm512_mask_min_epu16(no, m, a, b)
#define V_KEEP(m, v) _mm512_maskz_mov_epi16(m, v)
#define W_MINUS_1(w) minus_1(w)
#define W_ADD_V(w, v) add_words(w, v)
#define V_FROM_W(w) _mm512_packus_epi32((w).half[0], (w).half[1])

#endif /* UPB_VECTORS_AVX512_H */
