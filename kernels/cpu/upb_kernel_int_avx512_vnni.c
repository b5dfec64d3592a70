/* The integer window kernels for machines with AVX-512 and VNNI. */
#define UPB_VNNI
#include "upb_kernel_int_avx512.c"
