/* Loops in AVX-512 (F, BW, DQ, VL). BENCH_VNNI: with VNNI too, which adds up dot products. */
#include <immintrin.h>

#include "bench_isas.h"

#ifdef BENCH_VNNI
#define ISA_NAME "avx512-vnni"
#define ISA_SYMBOL bench_isa_avx512_vnni
#define I_DOT16(sum, a, b) _mm512_dpwssd_epi32(sum, a, b)
#define I_DOT8(sum, a, b) _mm512_dpbusd_epi32(sum, a, b)
#else
#define ISA_NAME "avx512"
#define ISA_SYMBOL bench_isa_avx512
#define I_DOT16(sum, a, b) _mm512_add_epi32(sum, _mm512_madd_epi16(a, b))
#endif
#define F __m512
#define I __m512i
#define F_LANES 16
#define OPAQUE(v) __asm__ volatile("" : "+v"(v))
#define F_SET(x) _mm512_set1_ps(x)
#define I_SET(x) _mm512_set1_epi32(x)
#define LOAD(p) _mm512_load_si512(p)
#define STORE(p, v) _mm512_store_si512(p, v)
#define BROADCAST(p) broadcast(p)
#define F_FMA(a, b, c) _mm512_fmadd_ps(a, b, c)
#define F_ADD(a, b) _mm512_add_ps(a, b)
#define F_MINMAX(a, b) _mm512_max_ps(a, b)
#define F_COMPARE(v, a) use_mask16(_mm512_cmp_ps_mask(v, a, _CMP_GE_OQ))
#define F_BLEND(v, a) v = _mm512_mask_blend_ps(0x5a5a, v, a)
#define F_CONVERT(v) _mm512_cvtepi32_ps(_mm512_castps_si512(v))
#define I_MUL(a, b) _mm512_mulhrs_epi16(a, b)
#define I_ADD(a, b) _mm512_sub_epi16(a, b)
#define I_MINMAX(a, b) _mm512_min_epu16(a, b)
#define I_LOGIC(a, b) _mm512_xor_si512(a, b)
#define I_COMPARE(v, a) use_mask32(_mm512_cmpge_epu16_mask(v, a))
#define I_BLEND(v, a) v = _mm512_mask_blend_epi16(0x5a5a5a5au, v, a)
#define I_SHIFT(v) _mm512_slli_epi16(v, 1)
#define I_SHUFFLE(v, a) _mm512_unpacklo_epi16(v, a)
#define AS_I(f) _Generic((f), __m512: _mm512_castps_si512, __m512i: same_i)(f)
#define AS_F(i) _mm512_castsi512_ps(i)

static inline __m512i same_i(__m512i i) { return i; }

/* In assembly: a compiler would do one for many. */
static inline __m512i broadcast(const void *p) {
    __m512i v;
    __asm__ volatile("vpbroadcastd %1, %0" : "=v"(v) : "m"(*(const int32_t *)p));
    return v;
}

static inline void use_mask16(__mmask16 mask) { __asm__ volatile("" : : "k"(mask)); }

static inline void use_mask32(__mmask32 mask) { __asm__ volatile("" : : "k"(mask)); }

#include "bench_loops_template.h"
