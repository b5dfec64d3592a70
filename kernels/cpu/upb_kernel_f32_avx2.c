/* The window kernel with AVX2 and FMA: compiled with those flags, called only where the machine has them. */
#include <immintrin.h>
#include <stdint.h>

static inline __m128i to_u16(__m256 v) {
    __m256i whole = _mm256_cvttps_epi32(v);
    return _mm_packus_epi32(_mm256_castsi256_si128(whole), _mm256_extracti128_si256(whole, 1));
}

static inline void store_u8(uint8_t *p, __m256 v) {
    __m128i words = to_u16(v);
    _mm_storel_epi64((__m128i *)(void *)p, _mm_packus_epi16(words, words));
}

#define V __m256
#define M __m256
#define V_LANES 8
#define V_BLOCK 4
#define V_LOAD(p) _mm256_load_ps(p)
#define V_LOADU(p) _mm256_loadu_ps(p)
#define V_STORE(p, v) _mm256_store_ps(p, v)
#define V_STOREU(p, v) _mm256_storeu_ps(p, v)
#define V_LOAD_U16(p) _mm256_cvtepi32_ps(_mm256_cvtepu16_epi32(_mm_loadu_si128((const __m128i *)(const void *)(p))))
#define V_LOAD_U8(p) _mm256_cvtepi32_ps(_mm256_cvtepu8_epi32(_mm_loadl_epi64((const __m128i *)(const void *)(p))))
#define V_STORE_U16(p, v) _mm_storeu_si128((__m128i *)(void *)(p), to_u16(v))
#define V_STORE_U8(p, v) store_u8(p, v)
#define V_SET(x) _mm256_set1_ps(x)
#define V_ADD(a, b) _mm256_add_ps(a, b)
#define V_SUB(a, b) _mm256_sub_ps(a, b)
#define V_MUL(a, b) _mm256_mul_ps(a, b)
#define V_MIN(a, b) _mm256_min_ps(a, b)
#define V_MAX(a, b) _mm256_max_ps(a, b)
#define V_FMA(a, b, c) _mm256_fmadd_ps(a, b, c)
#define V_FLOOR(v) _mm256_floor_ps(v)
#define M_IS_ZERO(v) _mm256_cmp_ps(v, _mm256_setzero_ps(), _CMP_EQ_OQ)
#define M_BETWEEN(v, low, high) _mm256_and_ps(_mm256_cmp_ps(v, low, _CMP_GE_OQ), _mm256_cmp_ps(v, high, _CMP_LE_OQ))
#define M_AND_NOT(m, n) _mm256_andnot_ps(n, m)
#define V_SELECT(m, yes, no) _mm256_blendv_ps(no, yes, m)
#define UPB_FILL_KERNELS upb_kernels_fill_avx2

#include "upb_kernel_f32_template.h"
