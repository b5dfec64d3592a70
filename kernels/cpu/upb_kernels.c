/* Chooses kernels from the features of the CPU. */
#include "upb_kernels.h"

#if defined(UPB_HAVE_C_FMA) || defined(UPB_HAVE_AVX2) || defined(UPB_HAVE_AVX512)

#include <cpuid.h>

/* Bits of XCR0: the register state that the operating system saves. */
#define XCR0_AVX 0x06u
#define XCR0_AVX512 0xe6u

static uint32_t read_xcr0(void) {
    uint32_t low, high;
    /* The intrinsic would need -mxsave for this file, and so for code that must run everywhere. */
    __asm__ volatile("xgetbv" : "=a"(low), "=d"(high) : "c"(0));
    return low;
}

/* Of leaf 7, registers b and c. */
#define LEAF7B_AVX2 (1u << 5)
#define LEAF7B_AVX512_F_DQ_BW_VL (1u << 16 | 1u << 17 | 1u << 30 | 1u << 31)
#define LEAF7C_AVX512_VNNI (1u << 11)

static int machine_has(upb_cpu cpu) {
    const uint32_t fma = 1u << 12, osxsave = 1u << 27;
    uint32_t a, b, c, d;
    if (!__get_cpuid(1, &a, &b, &c, &d) || (c & (fma | osxsave)) != (fma | osxsave))
        return 0;
    if (!__get_cpuid_count(7, 0, &a, &b, &c, &d) || !(b & LEAF7B_AVX2))
        return 0;
    const uint32_t xcr0 = read_xcr0();
    if (cpu == UPB_CPU_AVX2)
        return (xcr0 & XCR0_AVX) == XCR0_AVX;
    if ((b & LEAF7B_AVX512_F_DQ_BW_VL) != LEAF7B_AVX512_F_DQ_BW_VL || (xcr0 & XCR0_AVX512) != XCR0_AVX512)
        return 0;
    return cpu == UPB_CPU_AVX512 || (c & LEAF7C_AVX512_VNNI);
}

#endif

#ifdef UPB_HAVE_NEON_DOT

#ifdef __linux__
#include <sys/auxv.h>
#define HWCAP_DOT (1ul << 20) /* HWCAP_ASIMDDP; older headers do not name it */
#endif

static int machine_has_dot(void) {
#ifdef __linux__
    return (getauxval(AT_HWCAP) & HWCAP_DOT) != 0;
#elif defined(__ARM_FEATURE_DOTPROD)
    return 1;
#else
    return 0;
#endif
}

#endif

/* Fills the kernels of exactly this instruction set; false where it is missing. */
static int fill(upb_kernels *kernels, upb_cpu cpu) {
    switch (cpu) {
    case UPB_CPU_SCALAR:
        upb_kernels_fill_c(kernels);
#ifdef UPB_HAVE_C_FMA
        if (machine_has(UPB_CPU_AVX2)) /* which includes FMA */
            upb_kernels_fill_c_fma(kernels);
#endif
        upb_kernels_fill_int_c(kernels);
        return 1;
#ifdef UPB_HAVE_AVX2
    case UPB_CPU_AVX2:
        if (!machine_has(cpu))
            return 0;
        upb_kernels_fill_avx2(kernels);
        upb_kernels_fill_int_avx2(kernels);
        return 1;
#endif
#ifdef UPB_HAVE_AVX512
    case UPB_CPU_AVX512:
        if (!machine_has(cpu))
            return 0;
        upb_kernels_fill_avx512(kernels);
        upb_kernels_fill_int_avx512(kernels);
        return 1;
#ifdef UPB_HAVE_AVX512_VNNI
    case UPB_CPU_AVX512_VNNI:
        if (!machine_has(cpu))
            return 0;
        upb_kernels_fill_avx512(kernels);
        upb_kernels_fill_int_avx512_vnni(kernels);
        return 1;
#endif
#endif
#ifdef UPB_HAVE_NEON
    case UPB_CPU_NEON: /* part of every AArch64 */
        upb_kernels_fill_neon(kernels);
        upb_kernels_fill_int_neon(kernels);
        return 1;
#ifdef UPB_HAVE_NEON_DOT
    case UPB_CPU_NEON_DOT:
        if (!machine_has_dot())
            return 0;
        upb_kernels_fill_neon(kernels);
        upb_kernels_fill_int_neon_dot(kernels);
        return 1;
#endif
#endif
    default:
        return 0;
    }
}

upb_cpu upb_kernels_select(upb_kernels *kernels, upb_cpu cpu) {
    static const uint8_t fastest_first[] = {UPB_CPU_AVX512_VNNI, UPB_CPU_AVX512, UPB_CPU_NEON_DOT,
                                            UPB_CPU_NEON,        UPB_CPU_AVX2,   UPB_CPU_SCALAR};
    if (cpu != UPB_CPU_AUTO)
        return fill(kernels, cpu) ? cpu : UPB_CPU_AUTO;
    for (unsigned i = 0; i < sizeof fastest_first; i++)
        if (fill(kernels, (upb_cpu)fastest_first[i]))
            return (upb_cpu)fastest_first[i];
    return UPB_CPU_AUTO;
}
