/* Loops in AVX-512 (F, BW, DQ, VL). BENCH_VNNI: with VNNI too, which adds up dot products. */
#include <immintrin.h>

#include "bench_isas.h"
#include "upb_vectors_avx512.h"

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
#define F_LANES 16
#define OPAQUE(v) __asm__ volatile("" : "+v"(v))
#define F_SET(x) _mm512_set1_ps(x)
#define I_SET(x) _mm512_set1_epi32(x)
#define BROADCAST(p) broadcast(p)
#define F_FMA(a, b, c) _mm512_fmadd_ps(a, b, c)
#define F_ADD(a, b) _mm512_add_ps(a, b)
#define F_MUL(a, b) _mm512_mul_ps(a, b)
#define F_MAX(a, b) _mm512_max_ps(a, b)
#define F_FLOOR32(v) AS_F(_mm512_cvt_roundps_epi32(v, _MM_FROUND_TO_NEG_INF | _MM_FROUND_NO_EXC))
#define I_BLEND(a, b) _mm512_mask_blend_epi16(0x55555555u, a, b)
#define I_SCALE(a, b) _mm512_mulhrs_epi16(a, b)
#define I_MAX(a, b) _mm512_max_epi16(a, b)
#define I_ADD32(a, b) _mm512_add_epi32(a, b)
#define I_SHIFT32(v) _mm512_srli_epi32(v, 16)
#define I_UNPACK(a, b) _mm512_unpacklo_epi16(a, b)
#define I_LOOK_UP(table, v) _mm512_shuffle_epi8(table, v)
#define AS_I(v) _Generic((v), __m512: as_i, __m512i: same_i)(v)
#define AS_F(i) _mm512_castsi512_ps(i)
#define AS_SAME(v, i) _Generic((v), __m512: as_f, __m512i: same_i)(i)
#define START_MASK                                                                                                     \
    __mmask32 mask = 0x5a5a5a5au;                                                                                      \
    __asm__ volatile("" : "+k"(mask));
#define MASK mask
#define USE_MASK(v, m) __asm__ volatile("" : : "k"(m))
#define SECOND_TEN b
#define WEIGHT_READS 1
#define MASK_ANDS 0
#define FLOATS_SHUFFLES 3

static inline __m512i as_i(__m512 f) { return _mm512_castps_si512(f); }

static inline __m512 as_f(__m512i i) { return _mm512_castsi512_ps(i); }

static inline __m512i same_i(__m512i i) { return i; }

/* In assembly: a compiler would do one for many. */
static inline __m512i broadcast(const void *p) {
    __m512i v;
    __asm__ volatile("vpbroadcastd %1, %0" : "=v"(v) : "m"(*(const int32_t *)p));
    return v;
}

#include "bench_loops_template.h"
