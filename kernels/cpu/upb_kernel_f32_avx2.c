/* The float window kernel with AVX2 and FMA: compiled with those flags, called only where the machine has them. */
#include "upb_vectors_avx2.h"

/* The bits of 2^23 + x are 0x4b00 above x. */
static inline __m256 to_floats(V words) {
    return _mm256_sub_ps(_mm256_castsi256_ps(words), _mm256_set1_ps(8388608.0f));
}

#define F __m256
#define F_LOW(v) to_floats(_mm256_unpacklo_epi16(v, V_SET(0x4b00)))
#define F_HIGH(v) to_floats(_mm256_unpackhi_epi16(v, V_SET(0x4b00)))
#define F_SET(x) _mm256_set1_ps(x)
#define F_STORE(p, v) _mm256_store_ps(p, v)
#define F_ADD(a, b) _mm256_add_ps(a, b)
#define F_MUL(a, b) _mm256_mul_ps(a, b)
#define F_MIN(a, b) _mm256_min_ps(a, b)
#define F_MAX(a, b) _mm256_max_ps(a, b)
#define F_FMA(a, b, c) _mm256_fmadd_ps(a, b, c)
#define F_FLOOR32(v) _mm256_cvttps_epi32(_mm256_floor_ps(v))
#define UPB_FILL_KERNELS upb_kernels_fill_avx2

#include "upb_kernel_f32_template.h"
