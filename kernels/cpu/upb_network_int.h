/* What is done with an integer network outside the kernels: when a model is loaded, and to look inside. */
#ifndef UPB_NETWORK_INT_H
#define UPB_NETWORK_INT_H

#include "upb_kernels.h"

/* What a network was refused for. */
typedef struct upb_int_failure {
    const char *bound; /* "hidden", "skip", "slope", "k", "j", "t", "largest input << k" (in int8: << (k - 8)) or "<<
                          j", "S low", "S high", "Y low", "Y high"; static */
    uint32_t unit;     /* hidden unit, for S; else 0 */
    int64_t got, limit;
} upb_int_failure;

/*
 * True if the parameters are within the contract's limits and no sum can overflow, for any input. `net` is as the file
 * has it, before upb_network_int_finish: weight[h][0..5] = W, weight[h][6] = M, bias = B, output = V, offset = C,
 * hidden = H. `largest`: the largest input, max_count or 255 (at most 65535); `difference`: the largest difference of
 * two inputs in a window, max_count - min_count for distances under UPB_EMPTY_FILL, else `largest`. On false, fills
 * `failure` unless it is null.
 */
int upb_network_int_prove(const upb_network_int *net, upb_precision precision, uint32_t largest, uint32_t difference,
                          upb_int_failure *failure);

/*
 * Makes a network as the file has it (see above; what it does not set may hold anything) one that kernels take: derives
 * all that upb_kernels.h says of it, and pads the units to an even number. Once only, after the proof.
 */
void upb_network_int_finish(upb_network_int *net, upb_precision precision);

/* The working values of one network in one window, for tests and verification: the steps of the contract. */
typedef struct upb_int_trace {
    uint16_t minimum, difference[6];
    uint32_t shift;   /* s */
    uint16_t code[6]; /* q */
    int32_t sum[UPB_MAX_HIDDEN];
    int16_t hidden[UPB_MAX_HIDDEN], rectified[UPB_MAX_HIDDEN];
    int32_t output, rounded, value; /* Y, r, y */
} upb_int_trace;

/* x: the six pixels of a window after filling, within what the proof was made for. Padding units trace as zeros. */
void upb_trace_int(const upb_network_int *net, upb_precision precision, const uint16_t x[6], upb_int_trace *trace);

#endif /* UPB_NETWORK_INT_H */
