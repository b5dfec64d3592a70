/* The integer window kernels with AVX2: compiled with that flag, called only where the machine has it. */
#include <immintrin.h>
#include <stdint.h>

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

/* By half bytes: the highest bit of the upper one, if any, is greater than that of the lower. */
static inline V top_bit(V v) {
    const V of_low = _mm256_setr_epi8(0, 1, 2, 2, 4, 4, 4, 4, 8, 8, 8, 8, 8, 8, 8, 8, /* the same again */
                                      0, 1, 2, 2, 4, 4, 4, 4, 8, 8, 8, 8, 8, 8, 8, 8);
    const V of_high = _mm256_slli_epi16(of_low, 4);
    const V low = _mm256_shuffle_epi8(of_low, _mm256_and_si256(v, _mm256_set1_epi16(15)));
    return _mm256_max_epu8(low, _mm256_shuffle_epi8(of_high, _mm256_srli_epi16(v, 4)));
}

static inline W minus_1(W w) {
    const I ones = _mm256_set1_epi32(-1);
    return (W){{_mm256_add_epi32(w.half[0], ones), _mm256_add_epi32(w.half[1], ones)}};
}

#define V_LOAD(p) _mm256_load_si256((const __m256i *)(const void *)(p))
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
#define V_MIN(a, b) _mm256_min_epu16(a, b)
#define V_MAX(a, b) _mm256_max_epu16(a, b)
#define V_SHIFT_LEFT(v, n) _mm256_sll_epi16(v, _mm_cvtsi32_si128((int)(n)))
#define V_SHIFT_RIGHT(v, n) _mm256_srl_epi16(v, _mm_cvtsi32_si128((int)(n)))
#define V_NEXT(a, b) next_lanes(a, b)
#define V_TOP_BIT(v) top_bit(v)
#define M_IS_ZERO(v) _mm256_cmpeq_epi16(v, _mm256_setzero_si256())
#define M_AT_LEAST(a, b) _mm256_cmpeq_epi16(_mm256_max_epu16(a, b), a)
#define M_AND(m, n) _mm256_and_si256(m, n)
#define M_AND_NOT(m, n) _mm256_andnot_si256(n, m)
#define V_SELECT(m, yes, no) _mm256_blendv_epi8(no, yes, m)
#define V_KEEP(m, v) _mm256_and_si256(m, v)
#define W_MINUS_1(w) minus_1(w)
#define V_FROM_W(w) _mm256_packus_epi32((w).half[0], (w).half[1])

#define HALVES 1
#define I_SET32(x) _mm256_set1_epi32(x)
#define I_UNPACK_LOW(a, b) _mm256_unpacklo_epi16(a, b)
#define I_UNPACK_HIGH(a, b) _mm256_unpackhi_epi16(a, b)
#define I_DOT(sum, a, b) _mm256_add_epi32(sum, _mm256_madd_epi16(a, b))
#define I_UPPER(a, b) _mm256_blend_epi16(_mm256_srli_epi32(a, 16), b, 0xaa)
#define I_MAX(a, b) _mm256_max_epi16(a, b)
#define I_SCALE(a, b) _mm256_mulhrs_epi16(a, b)
#define I_XOR(a, b) _mm256_xor_si256(a, b)
#define I_ADD32(a, b) _mm256_add_epi32(a, b)
#define I_SHIFT_RIGHT32(a, n) _mm256_sra_epi32(a, _mm_cvtsi32_si128((int)(n)))
#define UPB_FILL_KERNELS upb_kernels_fill_int_avx2

#include "upb_kernel_int_pairs.h"

#include "upb_kernel_int_template.h"
