/* The window kernel with NEON, which every AArch64 has. */
#include <arm_neon.h>
#include <stdint.h>
#include <string.h>

static inline float32x4_t load_u8(const uint8_t *p) {
    uint32_t four;
    memcpy(&four, p, sizeof four); /* vld1_u8 would read eight: past the end of a column */
    uint8x8_t bytes = vreinterpret_u8_u32(vdup_n_u32(four));
    return vcvtq_f32_u32(vmovl_u16(vget_low_u16(vmovl_u8(bytes))));
}

static inline void store_u8(uint8_t *p, float32x4_t v) {
    uint16x4_t words = vmovn_u32(vcvtq_u32_f32(v));
    uint32_t four = vget_lane_u32(vreinterpret_u32_u8(vmovn_u16(vcombine_u16(words, words))), 0);
    memcpy(p, &four, sizeof four);
}

#define V float32x4_t
#define M uint32x4_t
#define V_LANES 4
#define V_BLOCK 2
#define V_LOAD(p) vld1q_f32(p)
#define V_LOADU(p) vld1q_f32(p)
#define V_STORE(p, v) vst1q_f32(p, v)
#define V_STOREU(p, v) vst1q_f32(p, v)
#define V_LOAD_U16(p) vcvtq_f32_u32(vmovl_u16(vld1_u16(p)))
#define V_LOAD_U8(p) load_u8(p)
#define V_STORE_U16(p, v) vst1_u16(p, vmovn_u32(vcvtq_u32_f32(v)))
#define V_STORE_U8(p, v) store_u8(p, v)
#define V_SET(x) vdupq_n_f32(x)
#define V_ADD(a, b) vaddq_f32(a, b)
#define V_SUB(a, b) vsubq_f32(a, b)
#define V_MUL(a, b) vmulq_f32(a, b)
#define V_MIN(a, b) vminq_f32(a, b)
#define V_MAX(a, b) vmaxq_f32(a, b)
#define V_FMA(a, b, c) vfmaq_f32(c, b, a)
#define V_FLOOR(v) vrndmq_f32(v)
#define M_IS_ZERO(v) vceqzq_f32(v)
#define M_BETWEEN(v, low, high) vandq_u32(vcgeq_f32(v, low), vcleq_f32(v, high))
#define M_AND_NOT(m, n) vbicq_u32(m, n)
#define V_SELECT(m, yes, no) vbslq_f32(m, yes, no)
#define UPB_FILL_KERNELS upb_kernels_fill_neon

#include "upb_kernel_f32_template.h"
