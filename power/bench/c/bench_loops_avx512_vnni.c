/* Loops for machines with AVX-512 and VNNI. */
#define BENCH_VNNI
#include "bench_loops_avx512.c"
