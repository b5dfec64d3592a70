/* Vectors of unsigned 16-bit numbers with AVX2. See upb_kernel_rules.h for what the names mean. */
#ifndef UPB_VECTORS_AVX2_H
#define UPB_VECTORS_AVX2_H

#include <immintrin.h>
#include <stdint.h>

#include "upb_kernels.h"

#define V __m256i
#define I __m256i
#define M __m256i
#define V_LANES 16

typedef struct wide {
    I half[2];
} wide;

#define W wide

static inline V load_u8(const uint8_t *p) {
    return _mm256_cvtepu8_epi16(_mm_loadu_si128((const __m128i *)(const void *)p));
}

static inline void store_u8(uint8_t *p, V v) {
    const V bytes = _mm256_permute4x64_epi64(_mm256_packus_epi16(v, v), 0x08);
    _mm_storeu_si128((__m128i *)(void *)p, _mm256_castsi256_si128(bytes));
}

static inline V next_lanes(V a, V b) { return _mm256_alignr_epi8(_mm256_permute2x128_si256(a, b, 0x21), a, 2); }

/* By half bytes. Of a byte from 128 on, the lower half is looked up as 0: the upper one says all. */
static inline V smear_upper(V v) {
    const V of_low = _mm256_broadcastsi128_si256(_mm_setr_epi8(0, 1, 3, 3, 7, 7, 7, 7, 15, 15, 15, 15, 15, 15, 15, 15));
    const V of_high =
        _mm256_broadcastsi128_si256(_mm_setr_epi8(0, 31, 63, 63, 127, 127, 127, 127, -1, -1, -1, -1, -1, -1, -1, -1));
    return _mm256_or_si256(_mm256_shuffle_epi8(of_low, v), _mm256_shuffle_epi8(of_high, _mm256_srli_epi16(v, 4)));
}

static inline M mask_of_bits(uint32_t bits) {
    const V lane = _mm256_setr_epi16(1, 1 << 1, 1 << 2, 1 << 3, 1 << 4, 1 << 5, 1 << 6, 1 << 7, 1 << 8, 1 << 9, 1 << 10,
                                     1 << 11, 1 << 12, 1 << 13, 1 << 14, -32768);
    return _mm256_cmpeq_epi16(_mm256_and_si256(_mm256_set1_epi16((int16_t)bits), lane), lane);
}

static inline V load_floats(const float *p) {
    const I low = _mm256_cvttps_epi32(_mm256_load_ps(p)), high = _mm256_cvttps_epi32(_mm256_load_ps(p + 8));
    return _mm256_permute4x64_epi64(_mm256_packus_epi32(low, high), 0xd8);
}

static inline W minus_1(W w) {
    const I ones = _mm256_set1_epi32(-1);
    return (W){{_mm256_add_epi32(w.half[0], ones), _mm256_add_epi32(w.half[1], ones)}};
}

static inline W add_words(W w, V v) {
    const I zero = _mm256_setzero_si256();
    return (W){{_mm256_add_epi32(w.half[0], _mm256_unpacklo_epi16(v, zero)),
                _mm256_add_epi32(w.half[1], _mm256_unpackhi_epi16(v, zero))}};
}

#define V_LOAD(p) _mm256_load_si256((const __m256i *)(const void *)(p))
#define V_LOAD_FLOATS(p) load_floats(p)
#define V_LOADU(p) _mm256_loadu_si256((const __m256i *)(const void *)(p))
#define V_STORE(p, v) _mm256_store_si256((__m256i *)(void *)(p), v)
#define V_STOREU(p, v) _mm256_storeu_si256((__m256i *)(void *)(p), v)
#define V_LOAD_U8(p) load_u8(p)
#define V_STORE_U8(p, v) store_u8(p, v)
#define V_SET(x) _mm256_set1_epi16((int16_t)(x))
#define V_ADD_SAT(a, b) _mm256_adds_epu16(a, b)
#define V_SUB(a, b) _mm256_sub_epi16(a, b)
#define V_AND(a, b) _mm256_and_si256(a, b)
#define V_OR(a, b) _mm256_or_si256(a, b)
#define V_XOR(a, b) _mm256_xor_si256(a, b)
#define V_OR3(a, b, c) V_OR(V_OR(a, b), c)
#define V_CLEAR_XOR(a, b, c) V_XOR(_mm256_andnot_si256(b, a), c)
#define V_AVERAGE(a, b) _mm256_avg_epu16(a, b)
#define V_MIN(a, b) _mm256_min_epu16(a, b)
#define V_SHIFT_LEFT(v, n) _mm256_sll_epi16(v, _mm_cvtsi32_si128((int)(n)))
#define V_SHIFT_RIGHT(v, n) _mm256_srl_epi16(v, _mm_cvtsi32_si128((int)(n)))
#define V_NEXT(a, b) next_lanes(a, b)
#define V_SMEAR_UPPER(v) smear_upper(v)
#define M_ALL(yes) _mm256_set1_epi32(-(yes))
#define M_BITS(bits) mask_of_bits(bits)
#define M_IS_ZERO(v) _mm256_cmpeq_epi16(v, _mm256_setzero_si256())
#define M_AT_LEAST(a, b) _mm256_cmpeq_epi16(_mm256_max_epu16(a, b), a)
#define M_AND(m, n) _mm256_and_si256(m, n)
#define M_AND_NOT(m, n) _mm256_andnot_si256(n, m)
#define V_SELECT(m, yes, no) _mm256_blendv_epi8(no, yes, m)
#define V_MIN_WHERE(m, a, b, no) V_SELECT(m, V_MIN(a, b), no)
#define V_KEEP(m, v) _mm256_and_si256(m, v)
#define W_MINUS_1(w) minus_1(w)
#define W_ADD_V(w, v) add_words(w, v)
#define V_FROM_W(w) _mm256_packus_epi32((w).half[0], (w).half[1])

#endif /* UPB_VECTORS_AVX2_H */
