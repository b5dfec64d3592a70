/*
 * The integer window kernels with AVX-512 (F, BW, DQ, VL): compiled with those flags, called only where the machine has
 * them. UPB_VNNI: the machine has VNNI too, which adds up dot products.
 */
#include "upb_vectors_avx512.h"

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
/* A blend runs beside dot products; the one shuffle that would do does not. */
#define I_UPPER(a, b) _mm512_mask_blend_epi16(0x55555555u, b, _mm512_srli_epi32(a, 16))
#define I_MAX(a, b) _mm512_max_epi16(a, b)
#define I_SCALE(a, b) _mm512_mulhrs_epi16(a, b)
#define I_SHIFT_RIGHT32(a, n) _mm512_sra_epi32(a, _mm_cvtsi32_si128((int)(n)))

#include "upb_kernel_int_pairs.h"

#include "upb_kernel_int_template.h"
