/* Loops in AVX2 and FMA. */
#include <immintrin.h>

#include "bench_isas.h"

#define ISA_NAME "avx2"
#define ISA_SYMBOL bench_isa_avx2
#define F __m256
#define I __m256i
#define F_LANES 8
#define OPAQUE(v) __asm__ volatile("" : "+x"(v))
#define F_SET(x) _mm256_set1_ps(x)
#define I_SET(x) _mm256_set1_epi32(x)
#define LOAD(p) _mm256_load_si256((const __m256i *)(const void *)(p))
#define STORE(p, v) _mm256_store_si256((__m256i *)(void *)(p), v)
#define BROADCAST(p) broadcast(p)
#define F_FMA(a, b, c) _mm256_fmadd_ps(a, b, c)
#define F_ADD(a, b) _mm256_add_ps(a, b)
#define F_MINMAX(a, b) _mm256_max_ps(a, b)
#define F_COMPARE(v, a) v = _mm256_cmp_ps(v, a, _CMP_GE_OQ)
#define F_BLEND(v, a) v = _mm256_blendv_ps(v, a, a)
#define F_CONVERT(v) _mm256_cvtepi32_ps(_mm256_castps_si256(v))
#define I_DOT16(sum, a, b) _mm256_add_epi32(sum, _mm256_madd_epi16(a, b))
#define I_MUL(a, b) _mm256_mulhrs_epi16(a, b)
#define I_ADD(a, b) _mm256_sub_epi16(a, b)
#define I_MINMAX(a, b) _mm256_min_epu16(a, b)
#define I_LOGIC(a, b) _mm256_xor_si256(a, b)
#define I_COMPARE(v, a) v = _mm256_cmpeq_epi16(v, a)
#define I_BLEND(v, a) v = _mm256_blendv_epi8(v, a, a)
#define I_SHIFT(v) _mm256_slli_epi16(v, 1)
#define I_SHUFFLE(v, a) _mm256_unpacklo_epi16(v, a)
#define AS_I(f) _Generic((f), __m256: _mm256_castps_si256, __m256i: same_i)(f)
#define AS_F(i) _mm256_castsi256_ps(i)

/* In assembly: a compiler would do one for many. */
static inline __m256i broadcast(const void *p) {
    __m256i v;
    __asm__ volatile("vpbroadcastd %1, %0" : "=x"(v) : "m"(*(const int32_t *)p));
    return v;
}

static inline __m256i same_i(__m256i i) { return i; }

#include "bench_loops_template.h"
