/* The float window kernel with NEON, which every AArch64 has. */
#include "upb_vectors_neon.h"

#define F float32x4_t
#define F_LOW(v) vcvtq_f32_u32(vmovl_u16(vget_low_u16(v)))
#define F_HIGH(v) vcvtq_f32_u32(vmovl_high_u16(v))
#define F_SET(x) vdupq_n_f32(x)
#define F_STORE(p, v) vst1q_f32(p, v)
#define F_ADD(a, b) vaddq_f32(a, b)
#define F_MUL(a, b) vmulq_f32(a, b)
#define F_MIN(a, b) vminq_f32(a, b)
#define F_MAX(a, b) vmaxq_f32(a, b)
#define F_FMA(a, b, c) vfmaq_f32(c, b, a)
#define F_FLOOR32(v) vcvtmq_s32_f32(v)
#define UPB_FILL_KERNELS upb_kernels_fill_neon

#include "upb_kernel_f32_template.h"
