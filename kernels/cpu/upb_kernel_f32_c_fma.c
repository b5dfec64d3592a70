/* The plain C kernel compiled for x86-64 machines with FMA: one lane at a time, and the bits of the vector kernels. */
#define UPB_FILL_KERNELS upb_kernels_fill_c_fma
#include "upb_kernel_f32_c.c"
