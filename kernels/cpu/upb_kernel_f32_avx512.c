/* The float window kernel with AVX-512 (F, BW, DQ, VL): compiled with those flags, called only where the machine has
 * them. */
#include "upb_vectors_avx512.h"

/* The bits of 2^23 + x are 0x4b00 above x: unpacking runs beside fused products, conversions do not. */
static inline __m512 to_floats(V words) {
    return _mm512_sub_ps(_mm512_castsi512_ps(words), _mm512_set1_ps(8388608.0f));
}

#define F __m512
#define F_LOW(v) to_floats(_mm512_unpacklo_epi16(v, V_SET(0x4b00)))
#define F_HIGH(v) to_floats(_mm512_unpackhi_epi16(v, V_SET(0x4b00)))
#define F_SET(x) _mm512_set1_ps(x)
#define F_STORE(p, v) _mm512_store_ps(p, v)
#define F_ADD(a, b) _mm512_add_ps(a, b)
#define F_MUL(a, b) _mm512_mul_ps(a, b)
#define F_MIN(a, b) _mm512_min_ps(a, b)
#define F_MAX(a, b) _mm512_max_ps(a, b)
#define F_FMA(a, b, c) _mm512_fmadd_ps(a, b, c)
#define F_FLOOR32(v) _mm512_cvt_roundps_epi32(v, _MM_FROUND_TO_NEG_INF | _MM_FROUND_NO_EXC)
#define UPB_FILL_KERNELS upb_kernels_fill_avx512

#include "upb_kernel_f32_template.h"
