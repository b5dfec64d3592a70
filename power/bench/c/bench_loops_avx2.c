/* Loops in AVX2 and FMA. */
#include <immintrin.h>

#include "bench_isas.h"
#include "upb_vectors_avx2.h"

#define ISA_NAME "avx2"
#define ISA_SYMBOL bench_isa_avx2
#define F __m256
#define F_LANES 8
#define OPAQUE(v) __asm__ volatile("" : "+x"(v))
#define F_SET(x) _mm256_set1_ps(x)
#define I_SET(x) _mm256_set1_epi32(x)
#define BROADCAST(p) broadcast(p)
#define F_FMA(a, b, c) _mm256_fmadd_ps(a, b, c)
#define F_ADD(a, b) _mm256_add_ps(a, b)
#define F_MUL(a, b) _mm256_mul_ps(a, b)
#define F_MAX(a, b) _mm256_max_ps(a, b)
#define F_FLOOR32(v) AS_F(_mm256_cvttps_epi32(_mm256_floor_ps(v)))
#define I_BLEND(a, b) _mm256_blend_epi16(a, b, 0xaa)
#define I_SCALE(a, b) _mm256_mulhrs_epi16(a, b)
#define I_MAX(a, b) _mm256_max_epi16(a, b)
#define I_ADD32(a, b) _mm256_add_epi32(a, b)
#define I_SHIFT32(v) _mm256_srli_epi32(v, 16)
#define I_UNPACK(a, b) _mm256_unpacklo_epi16(a, b)
#define I_LOOK_UP(table, v) _mm256_shuffle_epi8(table, v)
#define AS_I(v) _Generic((v), __m256: as_i, __m256i: same_i)(v)
#define AS_F(i) _mm256_castsi256_ps(i)
#define AS_SAME(v, i) _Generic((v), __m256: as_f, __m256i: same_i)(i)
/* No register of its own: there are 16. */
#define START_MASK
#define MASK AS_I(y)
#define USE_MASK(v, m) v = AS_SAME(v, m)
#define SECOND_TEN a
#define WEIGHT_READS 2
#define MASK_ANDS 1
#define FLOATS_SHUFFLES 2
#define I_DOT16(sum, a, b) _mm256_add_epi32(sum, _mm256_madd_epi16(a, b))

static inline __m256i as_i(__m256 f) { return _mm256_castps_si256(f); }

static inline __m256 as_f(__m256i i) { return _mm256_castsi256_ps(i); }

static inline __m256i same_i(__m256i i) { return i; }

/* In assembly: a compiler would do one for many. */
static inline __m256i broadcast(const void *p) {
    __m256i v;
    __asm__ volatile("vpbroadcastd %1, %0" : "=x"(v) : "m"(*(const int32_t *)p));
    return v;
}

#include "bench_loops_template.h"
