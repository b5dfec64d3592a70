/*
 * Window kernels on the CPU: internal interface between the column stream and one C file per instruction set.
 *
 * A column of 32 beams has 31 windows; window k lies between beams k and k+1. Windows are the lanes of the vectors:
 * lane k of every array below is window k. Lane 31 is padding: it holds finite values of no meaning, and nobody reads
 * its result.
 *
 * All distances are in counts (the sensor's units), all intensities in their 8-bit steps; the size of a count is folded
 * into the weights when the model is loaded. So is the step from the file's pixels to differences from the window
 * minimum: these are exact, and smaller, which leaves less to be rounded. The rules are in docs/model-format.md.
 */
#ifndef UPB_KERNELS_H
#define UPB_KERNELS_H

#include <stdint.h>

#include "upbeam/upbeam.h"

/* For functions that are made for constant arguments, of which they have several. */
#ifdef __GNUC__
#define UPB_INLINE static inline __attribute__((always_inline))
#else
#define UPB_INLINE static inline
#endif

#define UPB_LANES 32u /* UPB_WINDOWS and one lane of padding */
#define UPB_TAPS 7    /* inputs of a network: six window pixels, as differences from their minimum, and the minimum */
#define UPB_TAP_MINIMUM 6

/* Places in a row of upb_network_f32.unit. */
enum { UPB_UNIT_BIAS = UPB_TAPS, UPB_UNIT_OUTPUT = UPB_TAPS + 1, UPB_UNIT_FLOATS = 16 };

/*
 * One network, folded: y = offset + sum over h of OUTPUT[h] * leaky(BIAS[h] + sum over i of unit[h][i] * x[i]) + skip *
 * min, in this order. One hidden unit is one cache line: seven weights, bias, output weight, zeros. Units from `hidden`
 * on are zeros, so that kernels may take two at a time. Values: finite, magnitudes below 1e11; slope 0..1. Inputs are
 * at most 65535, so that no sum overflows.
 */
typedef struct upb_network_f32 {
    _Alignas(UPB_ALIGN) float unit[UPB_MAX_HIDDEN][UPB_UNIT_FLOATS];
    uint32_t hidden;   /* 1..UPB_MAX_HIDDEN */
    uint32_t positive; /* not 0: the output is max(y, 0) */
    float slope;       /* of the leaky rectifier */
    float skip;        /* weight of the window minimum in the output */
    float offset;
} upb_network_f32;

enum { UPB_DISTANCE = 0, UPB_INTENSITY = 1 };

/* Some beams of a column: distance and intensity are [UPB_BEAMS], no alignment needed; beams: bit k: beam k. */
typedef struct upb_beam_source {
    const uint16_t *distance;
    const uint8_t *intensity;
    uint32_t beams;
} upb_beam_source;

/* Where the beams of one column are: no beam is in two sources; one that is in none is 0. */
typedef struct upb_beam_sources {
    upb_beam_source source[UPB_BEAMS];
    uint32_t count;
} upb_beam_sources;

/* What a kernel needs of a model. */
typedef struct upb_model_f32 {
    upb_network_f32 network[2];                     /* UPB_DISTANCE, UPB_INTENSITY */
    _Alignas(UPB_ALIGN) float seen_max[UPB_LANES];  /* farthest count seen of each beam, whole, min_count..65535 */
    _Alignas(UPB_ALIGN) float given_max[UPB_LANES]; /* farthest count given by each window; the last lane is padding */
    float min_count;                                /* at least 1, whole: nearest count that is seen and given */
    uint32_t fill;                                  /* not 0: UPB_EMPTY_FILL */
} upb_model_f32;

/* Rows of a prepared column. Top is beam k, bottom beam k+1. */
enum { UPB_DISTANCE_TOP, UPB_DISTANCE_BOTTOM, UPB_INTENSITY_TOP, UPB_INTENSITY_BOTTOM, UPB_PREPARED_ROWS };

/*
 * A column as windows see it: range limits applied (a pixel outside is 0, distance and intensity), and under
 * UPB_EMPTY_FILL an empty pixel filled from the other one of its pair. Three of them side by side make the windows.
 * Distances are 0 (empty) or min_count..65535, intensities 0..255, in integer networks shifted left as their kernels
 * like; all 0 is an empty column. To be used with the model and the instruction set that it was prepared with.
 */
typedef struct upb_prepared {
    _Alignas(UPB_ALIGN) uint16_t row[UPB_PREPARED_ROWS][UPB_LANES];
} upb_prepared;

typedef upb_prepared upb_prepared_f32;

/* distance: [UPB_BEAMS] counts, 0..65535; intensity: [UPB_BEAMS]; no alignment needed. */
typedef void (*upb_prepare_f32_fn)(upb_prepared_f32 *prepared, const upb_model_f32 *model, const uint16_t *distance,
                                   const uint8_t *intensity);

/*
 * The same of a column whose beams are in several places; the column itself is written to distance and intensity,
 * [UPB_BEAMS]. In one function, since a vector load across the stores of others would have to wait for them, and they
 * for everything before them.
 */
typedef void (*upb_collect_f32_fn)(upb_prepared_f32 *prepared, const upb_model_f32 *model,
                                   const upb_beam_sources *sources, uint16_t *distance, uint8_t *intensity);

/*
 * Both networks on the 31 windows around `middle`. Writes UPB_LANES values to both outputs (no alignment needed):
 * distance 0 or min_count..given_max, intensity 0..255 and 0 where the distance is 0. The three columns may be one and
 * the same.
 */
typedef void (*upb_windows_f32_fn)(const upb_model_f32 *model, const upb_prepared_f32 *left,
                                   const upb_prepared_f32 *middle, const upb_prepared_f32 *right, uint16_t *distance,
                                   uint8_t *intensity);

/* For tests: the networks' outputs before rounding, limits and the all-empty rule; [UPB_LANES] each, no alignment
 * needed. */
typedef void (*upb_raw_f32_fn)(const upb_model_f32 *model, const upb_prepared_f32 *left, const upb_prepared_f32 *middle,
                               const upb_prepared_f32 *right, float *distance, float *intensity);

/* ------------------------------------------------------------------------------------------- integer networks */

/*
 * One integer network (docs/numeric-contract.md), widened to what both contracts share; made by upb_network_int_finish
 * of a network as the file has it. Units are padded to an even number with zeros, so that kernels may take two at a
 * time. A unit's six weights, the minimum's and a zero are four pairs of 16 bits.
 *
 * In int8, W << min(k, 8) still fits 16 bits, and (q << s) << (k - 8) fits as well: `weight` and `k` are so, and an
 * int8 network is an int16 network of the codes q << s. Kernels that multiply bytes take `weight8` (eight bytes with
 * two zeros) with the shift `in_weights` that the others have in them, and what belongs to them; in int16 these are 0.
 *
 * `bias` includes the rounding of step 5, `offset` that of step 8. What is unsigned here, a kernel may take as signed,
 * 32768 less: `bias_signed` is the bias of one that does so with the inputs (shifted by k) and the minimum (by j),
 * `bias8` that of one that does so with the minimum alone. `dot_signed` is 128 * sum of W: where a kernel takes q -
 * 128, its sums of products begin here. All are exact modulo 2^32.
 */
typedef struct upb_network_int {
    _Alignas(UPB_ALIGN) int16_t weight[UPB_MAX_HIDDEN][8]; /* W[0..5], M, 0 */
    _Alignas(UPB_ALIGN) int32_t bias[UPB_MAX_HIDDEN];
    _Alignas(UPB_ALIGN) int32_t bias_signed[UPB_MAX_HIDDEN];
    _Alignas(UPB_ALIGN) int16_t output[UPB_MAX_HIDDEN]; /* V */
    _Alignas(UPB_ALIGN) int8_t weight8[UPB_MAX_HIDDEN][8];
    _Alignas(UPB_ALIGN) int32_t bias8[UPB_MAX_HIDDEN];
    _Alignas(UPB_ALIGN) int32_t dot_signed[UPB_MAX_HIDDEN];
    int32_t offset;
    uint32_t hidden; /* even, 2..UPB_MAX_HIDDEN */
    uint32_t k, j, t;
    uint32_t in_weights;
    int32_t slope; /* 0..32767 */
    uint32_t skip; /* 0, 1 */
} upb_network_int;

/* What an integer kernel needs of a model. The proof against overflow has been made of `network`. */
typedef struct upb_model_int {
    upb_network_int network[2];                        /* UPB_DISTANCE, UPB_INTENSITY */
    _Alignas(UPB_ALIGN) uint16_t seen_max[UPB_LANES];  /* as in upb_model_f32 */
    _Alignas(UPB_ALIGN) uint16_t given_max[UPB_LANES]; /* the last lane is padding */
    uint16_t min_count;
    uint16_t fill;
} upb_model_int;

typedef upb_prepared upb_prepared_int;

typedef void (*upb_prepare_int_fn)(upb_prepared_int *prepared, const upb_model_int *model, const uint16_t *distance,
                                   const uint8_t *intensity);

typedef void (*upb_collect_int_fn)(upb_prepared_int *prepared, const upb_model_int *model,
                                   const upb_beam_sources *sources, uint16_t *distance, uint8_t *intensity);

/* As upb_windows_f32_fn, to the bit of the contract. One function for each contract. */
typedef void (*upb_windows_int_fn)(const upb_model_int *model, const upb_prepared_int *left,
                                   const upb_prepared_int *middle, const upb_prepared_int *right, uint16_t *distance,
                                   uint8_t *intensity);

typedef struct upb_kernels {
    upb_prepare_f32_fn prepare_f32;
    upb_windows_f32_fn windows_f32;
    upb_raw_f32_fn raw_f32;
    upb_prepare_int_fn prepare_int;
    upb_windows_int_fn windows_int16;
    upb_windows_int_fn windows_int8;
    upb_collect_f32_fn collect_f32;
    upb_collect_int_fn collect_int;
} upb_kernels;

/*
 * Fills `kernels` with those of one instruction set, UPB_CPU_AUTO: the fastest. Returns the upb_cpu chosen, or
 * UPB_CPU_AUTO if this machine or this build does not have the one asked for (`kernels` is then untouched).
 */
upb_cpu upb_kernels_select(upb_kernels *kernels, upb_cpu cpu);

/*
 * Each in its own file, compiled with the flags of its instruction set: call only where the machine has it. They fill
 * in the float kernels, or with _int_ the integer ones.
 */
void upb_kernels_fill_c(upb_kernels *kernels);
void upb_kernels_fill_c_fma(upb_kernels *kernels);
void upb_kernels_fill_avx2(upb_kernels *kernels);
void upb_kernels_fill_avx512(upb_kernels *kernels);
void upb_kernels_fill_neon(upb_kernels *kernels);
void upb_kernels_fill_int_c(upb_kernels *kernels);
void upb_kernels_fill_int_avx2(upb_kernels *kernels);
void upb_kernels_fill_int_avx512(upb_kernels *kernels);
void upb_kernels_fill_int_avx512_vnni(upb_kernels *kernels);
void upb_kernels_fill_int_neon(upb_kernels *kernels);
void upb_kernels_fill_int_neon_dot(upb_kernels *kernels);

#endif /* UPB_KERNELS_H */
