/* The integer window kernels for AArch64 machines with the dot product instructions. */
#define UPB_DOT
#include "upb_kernel_int_neon.c"
