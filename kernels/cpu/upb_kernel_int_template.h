/*
 * The integer window kernels in vectors: included once by each instruction set's file, which defines before
 *
 *   V, M                 a vector of V_LANES unsigned 16-bit numbers; a mask of them.  V_LANES divides UPB_LANES
 *   W                    the 32-bit numbers of V_LANES windows, in an order of its own
 *   V_LOAD, V_LOADU(p)   V_LANES u16, aligned to their size or not;      V_STORE, V_STOREU(p, v)
 *   V_LOAD_U8(p), V_STORE_U8(p, v)   the same of u8, unaligned; v is at most 255
 *   V_SET(x)             all lanes x
 *   V_ADD_SAT, V_SUB, V_AND, V_OR, V_MIN, V_MAX (a, b);   V_SHIFT_LEFT, V_SHIFT_RIGHT(v, n), n in 0..16
 *   V_NEXT(a, b)         lanes 1.. of a, then lane 0 of b
 *   V_TOP_BIT(v)         the highest bit of each lane alone, 0 of 0; v is at most 255
 *   M_IS_ZERO(v), M_AT_LEAST(a, b): a >= b, M_AND(m, n), M_AND_NOT(m, n): m and not n
 *   V_SELECT(m, yes, no), V_KEEP(m, v): v or 0
 *   W_MINUS_1(w), V_FROM_W(w): signed, what does not fit u16 is saturated
 *   networks_int16(y, networks, x)  y of both networks, W[2]; x: differences and minimum, V[2][UPB_TAPS]
 *   UPB_FILL_KERNELS     the name of the function that hands the kernels out
 *
 * and, if its int8 has instructions of its own, HAS_NETWORKS_INT8 and networks_int8(y, networks, x).
 *
 * Both networks' inputs are made before either's sums: the steps up to there depend on each other and would wait alone.
 * The plain C kernel says the same one lane at a time: read it first.
 */
#include "upb_kernels.h"

#define V_BLOCKS (UPB_LANES / V_LANES)

static void prepare_int(upb_prepared_int *prepared, const upb_model_int *model, const uint16_t *distance,
                        const uint8_t *intensity) {
    V d[V_BLOCKS + 1], i[V_BLOCKS + 1];
    const V low = V_SET(model->min_count);
    const M fill = M_IS_ZERO(V_SET(model->fill ? 0 : 1));
    for (unsigned b = 0; b < V_BLOCKS; b++) {
        const V count = V_LOADU(distance + b * V_LANES);
        const M seen = M_AND(M_AT_LEAST(count, low), M_AT_LEAST(V_LOAD(model->seen_max + b * V_LANES), count));
        d[b] = V_KEEP(seen, count);
        i[b] = V_KEEP(seen, V_LOAD_U8(intensity + b * V_LANES));
    }
    d[V_BLOCKS] = i[V_BLOCKS] = V_SET(0);
    for (unsigned b = 0; b < V_BLOCKS; b++) {
        const V d_bottom = V_NEXT(d[b], d[b + 1]), i_bottom = V_NEXT(i[b], i[b + 1]);
        const M top_empty = M_AND(fill, M_IS_ZERO(d[b])), bottom_empty = M_AND(fill, M_IS_ZERO(d_bottom));
        V_STORE(&prepared->row[UPB_DISTANCE_TOP][b * V_LANES], V_SELECT(top_empty, d_bottom, d[b]));
        V_STORE(&prepared->row[UPB_DISTANCE_BOTTOM][b * V_LANES], V_SELECT(bottom_empty, d[b], d_bottom));
        V_STORE(&prepared->row[UPB_INTENSITY_TOP][b * V_LANES], V_SELECT(top_empty, i_bottom, i[b]));
        V_STORE(&prepared->row[UPB_INTENSITY_BOTTOM][b * V_LANES], V_SELECT(bottom_empty, i[b], i_bottom));
    }
}

UPB_INLINE void fill_columns(V x[3], const M empty[3]) {
    const V left = x[0], middle = x[1], right = x[2];
    const V nearer = V_SELECT(empty[0], right, V_SELECT(empty[2], left, V_MIN(left, right)));
    x[0] = V_SELECT(empty[0], V_SELECT(empty[1], right, middle), left);
    x[1] = V_SELECT(empty[1], nearer, middle);
    x[2] = V_SELECT(empty[2], V_SELECT(empty[1], left, middle), right);
}

/* The windows from lane k on as differences and minimum; `first` is the top row of a prepared column. */
UPB_INLINE void gather(V x[UPB_TAPS], const upb_prepared_int *const column[3], int first, unsigned k,
                       const M empty[3]) {
    for (int c = 0; c < 3; c++) {
        x[c] = V_LOAD(&column[c]->row[first][k]);
        x[3 + c] = V_LOAD(&column[c]->row[first + 1][k]);
    }
    fill_columns(x, empty);
    fill_columns(x + 3, empty);
    const V minimum = V_MIN(V_MIN(V_MIN(x[0], x[1]), V_MIN(x[2], x[3])), V_MIN(x[4], x[5]));
    for (int i = 0; i < UPB_TAP_MINIMUM; i++)
        x[i] = V_SUB(x[i], minimum);
    x[UPB_TAP_MINIMUM] = minimum;
}

#ifndef HAS_NETWORKS_INT8
/*
 * Step 3 of int8: differences become q << s. The shift s is never needed as such: with `half`, 2^(s-1) or 0, rounding
 * is to add half and to clear the bits below 2^s. What saturates at 65535 is 255 << 8 as well.
 */
UPB_INLINE void code_block(V x[UPB_TAPS]) {
    const V any = V_OR(V_OR(V_OR(x[0], x[1]), V_OR(x[2], x[3])), V_OR(x[4], x[5])); /* as long as the largest */
    const V half = V_TOP_BIT(V_SHIFT_RIGHT(any, 8)), step = V_MAX(V_SHIFT_LEFT(half, 1), V_SET(1));
    const V above = V_SUB(V_SET(0), step), largest = V_SUB(V_SHIFT_LEFT(step, 8), step);
    for (int i = 0; i < UPB_TAP_MINIMUM; i++)
        x[i] = V_MIN(V_AND(V_ADD_SAT(x[i], half), above), largest);
}

/* On 16-bit instructions. */
UPB_INLINE void networks_int8(W y[2], const upb_network_int networks[2], V x[2][UPB_TAPS]) {
    code_block(x[UPB_DISTANCE]);
    code_block(x[UPB_INTENSITY]);
    networks_int16(y, networks, x);
}
#endif

typedef void networks_fn(W y[2], const upb_network_int networks[2], V x[2][UPB_TAPS]);

UPB_INLINE void windows(networks_fn *networks, const upb_model_int *model, const upb_prepared_int *const column[3],
                        uint16_t *distance, uint8_t *intensity) {
    const M fill = M_IS_ZERO(V_SET(model->fill ? 0 : 1));
    for (unsigned k = 0; k < UPB_LANES; k += V_LANES) {
        V x[2][UPB_TAPS];
        W y[2];
        M empty[3];
        for (int c = 0; c < 3; c++)
            empty[c] = M_AND(fill, M_IS_ZERO(V_LOAD(&column[c]->row[UPB_DISTANCE_TOP][k])));
        gather(x[UPB_DISTANCE], column, UPB_DISTANCE_TOP, k, empty);
        gather(x[UPB_INTENSITY], column, UPB_INTENSITY_TOP, k, empty);
        const M nothing = M_AND(fill, M_IS_ZERO(x[UPB_DISTANCE][UPB_TAP_MINIMUM]));
        networks(y, model->network, x);
        /* y beyond 65535 is caught by y - 1, which then saturates to no less than any limit. */
        const V d = V_FROM_W(y[UPB_DISTANCE]), less = V_FROM_W(W_MINUS_1(y[UPB_DISTANCE]));
        const V i = V_MIN(V_FROM_W(y[UPB_INTENSITY]), V_SET(255));
        const M near_enough = M_AND_NOT(M_AT_LEAST(d, V_SET(model->min_count)), nothing);
        const M given = M_AND_NOT(near_enough, M_AT_LEAST(less, V_LOAD(model->given_max + k)));
        V_STOREU(distance + k, V_KEEP(given, d));
        V_STORE_U8(intensity + k, V_KEEP(given, i));
    }
}

static void windows_int16(const upb_model_int *model, const upb_prepared_int *left, const upb_prepared_int *middle,
                          const upb_prepared_int *right, uint16_t *distance, uint8_t *intensity) {
    const upb_prepared_int *const column[3] = {left, middle, right};
    windows(networks_int16, model, column, distance, intensity);
}

static void windows_int8(const upb_model_int *model, const upb_prepared_int *left, const upb_prepared_int *middle,
                         const upb_prepared_int *right, uint16_t *distance, uint8_t *intensity) {
    const upb_prepared_int *const column[3] = {left, middle, right};
    windows(networks_int8, model, column, distance, intensity);
}

void UPB_FILL_KERNELS(upb_kernels *kernels) {
    kernels->prepare_int = prepare_int;
    kernels->windows_int16 = windows_int16;
    kernels->windows_int8 = windows_int8;
}
