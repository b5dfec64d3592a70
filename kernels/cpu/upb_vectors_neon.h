/* Vectors of unsigned 16-bit numbers with NEON. See upb_kernel_rules.h for what the names mean. */
#ifndef UPB_VECTORS_NEON_H
#define UPB_VECTORS_NEON_H

#include <arm_neon.h>
#include <stdint.h>
#include <string.h>

#include "upb_kernels.h"

#define V uint16x8_t
#define M uint16x8_t
#define V_LANES 8

typedef struct wide {
    int32x4_t half[2];
} wide;

#define W wide

static inline W minus_1(W w) {
    const int32x4_t one = vdupq_n_s32(1);
    return (W){{vsubq_s32(w.half[0], one), vsubq_s32(w.half[1], one)}};
}

static inline W add_words(W w, V v) {
    return (W){{vreinterpretq_s32_u32(vaddw_u16(vreinterpretq_u32_s32(w.half[0]), vget_low_u16(v))),
                vreinterpretq_s32_u32(vaddw_high_u16(vreinterpretq_u32_s32(w.half[1]), v))}};
}

static inline M mask_of_bits(uint32_t bits) {
    static const uint16_t lane[8] = {1, 2, 4, 8, 16, 32, 64, 128};
    return vtstq_u16(vdupq_n_u16((uint16_t)bits), vld1q_u16(lane));
}

static inline V load_floats(const float *p) {
    return vmovn_high_u32(vmovn_u32(vcvtq_u32_f32(vld1q_f32(p))), vcvtq_u32_f32(vld1q_f32(p + 4)));
}

#define V_LOAD(p) vld1q_u16(p)
#define V_LOAD_FLOATS(p) load_floats(p)
#define V_LOADU(p) vld1q_u16(p)
#define V_STORE(p, v) vst1q_u16(p, v)
#define V_STOREU(p, v) vst1q_u16(p, v)
#define V_LOAD_U8(p) vmovl_u8(vld1_u8(p))
#define V_STORE_U8(p, v) vst1_u8(p, vmovn_u16(v))
#define V_SET(x) vdupq_n_u16((uint16_t)(x))
#define V_ADD_SAT(a, b) vqaddq_u16(a, b)
#define V_SUB(a, b) vsubq_u16(a, b)
#define V_AND(a, b) vandq_u16(a, b)
#define V_OR(a, b) vorrq_u16(a, b)
#define V_XOR(a, b) veorq_u16(a, b)
#define V_OR3(a, b, c) V_OR(V_OR(a, b), c)
#define V_CLEAR_XOR(a, b, c) V_XOR(vbicq_u16(a, b), c)
#define V_AVERAGE(a, b) vrhaddq_u16(a, b)
#define V_MIN(a, b) vminq_u16(a, b)
#define V_SHIFT_LEFT(v, n) vshlq_u16(v, vdupq_n_s16((int16_t)(n)))
#define V_SHIFT_RIGHT(v, n) vshlq_u16(v, vdupq_n_s16((int16_t)(0 - (n))))
#define V_NEXT(a, b) vextq_u16(a, b, 1)
#define V_SMEAR_UPPER(v) vshlq_u16(vdupq_n_u16(0xffff), vnegq_s16(vreinterpretq_s16_u16(vclzq_u16(v))))
#define M_ALL(yes) vdupq_n_u16((uint16_t)(0 - (yes)))
#define M_BITS(bits) mask_of_bits(bits)
#define M_IS_ZERO(v) vceqzq_u16(v)
#define M_AT_LEAST(a, b) vcgeq_u16(a, b)
#define M_AND(m, n) vandq_u16(m, n)
#define M_AND_NOT(m, n) vbicq_u16(m, n)
#define V_SELECT(m, yes, no) vbslq_u16(m, yes, no)
#define V_MIN_WHERE(m, a, b, no) V_SELECT(m, V_MIN(a, b), no)
#define V_KEEP(m, v) vandq_u16(m, v)
#define W_MINUS_1(w) minus_1(w)
#define W_ADD_V(w, v) add_words(w, v)
#define V_FROM_W(w) vqmovun_high_s32(vqmovun_s32((w).half[0]), (w).half[1])

#endif /* UPB_VECTORS_NEON_H */
