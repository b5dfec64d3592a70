/*
 * The integer window kernels with AVX-512 (F, BW, DQ, VL): compiled with those flags, called only where the machine has
 * them. All windows of a column are one vector. UPB_VNNI: the machine has VNNI too, which adds up dot products.
 */
#include <immintrin.h>
#include <stdint.h>

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

/* By half bytes: the highest bit of the upper one, if any, is greater than that of the lower. */
static inline V top_bit(V v) {
    const V of_low = _mm512_broadcast_i32x4(_mm_setr_epi8(0, 1, 2, 2, 4, 4, 4, 4, 8, 8, 8, 8, 8, 8, 8, 8));
    const V of_high = _mm512_slli_epi16(of_low, 4);
    const V low = _mm512_shuffle_epi8(of_low, _mm512_and_si512(v, _mm512_set1_epi16(15)));
    return _mm512_max_epu8(low, _mm512_shuffle_epi8(of_high, _mm512_srli_epi16(v, 4)));
}

/* One shuffle: the even 16-bit lanes of b are replaced by the odd ones of a. */
static inline I upper_halves(I a, I b) {
    const I from = _mm512_broadcast_i32x4(_mm_setr_epi8(2, 3, 2, 3, 6, 7, 6, 7, 10, 11, 10, 11, 14, 15, 14, 15));
    return _mm512_mask_shuffle_epi8(b, 0x3333333333333333u, a, from);
}

static inline W minus_1(W w) {
    const I ones = _mm512_set1_epi32(-1);
    return (W){{_mm512_add_epi32(w.half[0], ones), _mm512_add_epi32(w.half[1], ones)}};
}

#define V_LOAD(p) _mm512_load_si512(p)
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
#define V_MIN(a, b) _mm512_min_epu16(a, b)
#define V_MAX(a, b) _mm512_max_epu16(a, b)
#define V_SHIFT_LEFT(v, n) _mm512_sll_epi16(v, _mm_cvtsi32_si128((int)(n)))
#define V_SHIFT_RIGHT(v, n) _mm512_srl_epi16(v, _mm_cvtsi32_si128((int)(n)))
#define V_NEXT(a, b) next_lanes(a, b)
#define V_TOP_BIT(v) top_bit(v)
#define M_IS_ZERO(v) _mm512_testn_epi16_mask(v, v)
#define M_AT_LEAST(a, b) _mm512_cmpge_epu16_mask(a, b)
#define M_AND(m, n) ((m) & (n))
#define M_AND_NOT(m, n) ((m) & ~(n))
#define V_SELECT(m, yes, no) _mm512_mask_blend_epi16(m, no, yes)
#define V_KEEP(m, v) _mm512_maskz_mov_epi16(m, v)
#define W_MINUS_1(w) minus_1(w)
#define V_FROM_W(w) _mm512_packus_epi32((w).half[0], (w).half[1])

#define HALVES 2
#define I_SET32(x) _mm512_set1_epi32(x)
#define I_UNPACK_LOW(a, b) _mm512_unpacklo_epi16(a, b)
#define I_UNPACK_HIGH(a, b) _mm512_unpackhi_epi16(a, b)
#ifdef UPB_VNNI
#define I_DOT(sum, a, b) _mm512_dpwssd_epi32(sum, a, b)
#define UPB_FILL_KERNELS upb_kernels_fill_int_avx512_vnni
#else
#define I_DOT(sum, a, b) _mm512_add_epi32(sum, _mm512_madd_epi16(a, b))
#define UPB_FILL_KERNELS upb_kernels_fill_int_avx512
#endif
#define I_UPPER(a, b) upper_halves(a, b)
#define I_MAX(a, b) _mm512_max_epi16(a, b)
#define I_SCALE(a, b) _mm512_mulhrs_epi16(a, b)
#define I_XOR(a, b) _mm512_xor_si512(a, b)
#define I_ADD32(a, b) _mm512_add_epi32(a, b)
#define I_SHIFT_RIGHT32(a, n) _mm512_sra_epi32(a, _mm_cvtsi32_si128((int)(n)))

#include "upb_kernel_int_pairs.h"

#include "upb_kernel_int_template.h"
