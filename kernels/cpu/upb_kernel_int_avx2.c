/* The integer window kernels with AVX2: compiled with that flag, called only where the machine has it. */
#include "upb_vectors_avx2.h"

#define HALVES 1
#define I_SET32(x) _mm256_set1_epi32(x)
#define I_UNPACK_LOW(a, b) _mm256_unpacklo_epi16(a, b)
#define I_UNPACK_HIGH(a, b) _mm256_unpackhi_epi16(a, b)
#define I_DOT(sum, a, b) _mm256_add_epi32(sum, _mm256_madd_epi16(a, b))
#define I_UPPER(a, b) _mm256_blend_epi16(_mm256_srli_epi32(a, 16), b, 0xaa)
#define I_MAX(a, b) _mm256_max_epi16(a, b)
#define I_SCALE(a, b) _mm256_mulhrs_epi16(a, b)
#define I_SHIFT_RIGHT32(a, n) _mm256_sra_epi32(a, _mm_cvtsi32_si128((int)(n)))
#define UPB_FILL_KERNELS upb_kernels_fill_int_avx2

#include "upb_kernel_int_pairs.h"

#include "upb_kernel_int_template.h"
