/* Loops of each instruction set, in files compiled with its flags: run only where the machine has it. */
#ifndef BENCH_ISAS_H
#define BENCH_ISAS_H

#include "bench.h"

extern const bench_isa bench_isa_avx2, bench_isa_avx512, bench_isa_avx512_vnni;

#endif /* BENCH_ISAS_H */
