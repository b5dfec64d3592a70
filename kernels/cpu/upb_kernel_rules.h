/*
 * The rules around the networks in vectors of 16 bits, for networks of any number type: what is seen, filling, window
 * minimum and differences, what is given. Counts and intensities fit 16 bits, so that one vector takes as many windows
 * as two vectors of floats or 32-bit sums. Each instruction set has in upb_vectors_*.h:
 *
 *   V, M                 a vector of V_LANES unsigned 16-bit numbers; a mask of them.  V_LANES divides UPB_LANES
 *   W                    32-bit numbers of V_LANES windows in two vectors, half[0] and half[1], in an order of its own
 *   V_LOAD, V_LOADU(p)   V_LANES u16, aligned to their size or not;      V_STORE, V_STOREU(p, v)
 *   V_LOAD_U8(p), V_STORE_U8(p, v)   the same of u8, unaligned; v is at most 255
 *   V_LOAD_FLOATS(p)     V_LANES aligned floats, whole and in range
 *   V_SET(x)             all lanes x
 *   V_ADD_SAT, V_SUB, V_AND, V_OR, V_XOR, V_MIN (a, b);   V_SHIFT_LEFT, V_SHIFT_RIGHT(v, n), n in 0..16
 *   V_NEXT(a, b)         lanes 1.. of a, then lane 0 of b
 *   V_SMEAR_UPPER(v)     in the upper byte of each lane, its highest bit set and all below (0 of 0); in the lower one,
 *                        anything
 *   M_ALL(yes)           yes or no, 1 or 0, for all lanes;     M_BITS(bits): bit k of a uint32_t for lane k
 *   M_IS_ZERO(v), M_AT_LEAST(a, b): a >= b, M_AND(m, n), M_AND_NOT(m, n): m and not n
 *   V_SELECT(m, yes, no), V_KEEP(m, v): v or 0, V_MIN_WHERE(m, a, b, no): the less one or no
 *   V_OR3(a, b, c);      V_CLEAR_XOR(a, b, c): (a & ~b) ^ c;     V_AVERAGE(a, b): (a + b + 1) >> 1
 *   W_MINUS_1(w), W_ADD_V(w, v): w + v, V_FROM_W(w): signed, what does not fit u16 is saturated
 *
 * The plain C kernels say the same one lane at a time: read those first.
 */
#ifndef UPB_KERNEL_RULES_H
#define UPB_KERNEL_RULES_H

#include "upb_kernels.h"

#define V_BLOCKS (UPB_LANES / V_LANES)

/* Of a model. A function uses some of it, and the compiler drops the rest. */
typedef struct limits {
    V seen_max[V_BLOCKS], given_max[V_BLOCKS], min_count;
    M fill; /* UPB_EMPTY_FILL */
} limits;

/* A column. */
typedef struct rows {
    V distance[V_BLOCKS], intensity[V_BLOCKS];
} rows;

UPB_INLINE rows load_rows(const uint16_t *distance, const uint8_t *intensity) {
    rows column;
    for (unsigned b = 0; b < V_BLOCKS; b++) {
        column.distance[b] = V_LOADU(distance + b * V_LANES);
        column.intensity[b] = V_LOAD_U8(intensity + b * V_LANES);
    }
    return column;
}

/* Also written to distance and intensity. */
UPB_INLINE rows collect_rows(uint16_t *distance, uint8_t *intensity, const upb_beam_sources *sources) {
    rows column;
    for (unsigned b = 0; b < V_BLOCKS; b++) {
        const unsigned k = b * V_LANES;
        V d = V_SET(0), i = V_SET(0);
        for (uint32_t s = 0; s < sources->count; s++) {
            const upb_beam_source *source = &sources->source[s];
            const M here = M_BITS(source->beams >> k);
            d = V_SELECT(here, V_LOADU(source->distance + k), d);
            i = V_SELECT(here, V_LOAD_U8(source->intensity + k), i);
        }
        V_STOREU(distance + k, d);
        V_STORE_U8(intensity + k, i);
        column.distance[b] = d;
        column.intensity[b] = i;
    }
    return column;
}

/* shift: left shift of the values of each network; it leaves 0 to be 0, and the order. */
UPB_INLINE void prepare(upb_prepared *prepared, const limits *of, const uint32_t shift[2], rows column) {
    V d[V_BLOCKS + 1], i[V_BLOCKS + 1];
    for (unsigned b = 0; b < V_BLOCKS; b++) {
        const V count = column.distance[b], strength = column.intensity[b];
        const M seen = M_AND(M_AT_LEAST(count, of->min_count), M_AT_LEAST(of->seen_max[b], count));
        d[b] = V_KEEP(seen, shift[UPB_DISTANCE] ? V_SHIFT_LEFT(count, shift[UPB_DISTANCE]) : count);
        i[b] = V_KEEP(seen, shift[UPB_INTENSITY] ? V_SHIFT_LEFT(strength, shift[UPB_INTENSITY]) : strength);
    }
    d[V_BLOCKS] = i[V_BLOCKS] = V_SET(0);
    for (unsigned b = 0; b < V_BLOCKS; b++) {
        const V d_bottom = V_NEXT(d[b], d[b + 1]), i_bottom = V_NEXT(i[b], i[b + 1]);
        const M top_empty = M_AND(of->fill, M_IS_ZERO(d[b])), bottom_empty = M_AND(of->fill, M_IS_ZERO(d_bottom));
        V_STORE(&prepared->row[UPB_DISTANCE_TOP][b * V_LANES], V_SELECT(top_empty, d_bottom, d[b]));
        V_STORE(&prepared->row[UPB_DISTANCE_BOTTOM][b * V_LANES], V_SELECT(bottom_empty, d[b], d_bottom));
        V_STORE(&prepared->row[UPB_INTENSITY_TOP][b * V_LANES], V_SELECT(top_empty, i_bottom, i[b]));
        V_STORE(&prepared->row[UPB_INTENSITY_BOTTOM][b * V_LANES], V_SELECT(bottom_empty, i[b], i_bottom));
    }
}

/* One row of a window. What is empty is 0, so that both neighbours of an empty middle, once filled, hold its choice. */
UPB_INLINE void fill_columns(V x[3], const M empty[3]) {
    const V left = x[0], middle = x[1], right = x[2];
    x[0] = V_SELECT(empty[0], V_SELECT(empty[1], right, middle), left);
    x[2] = V_SELECT(empty[2], V_SELECT(empty[1], left, middle), right);
    x[1] = V_MIN_WHERE(empty[1], x[0], x[2], middle);
}

/* Of one network: differences from the minimum, each plus `lift`, and the minimum. `top` is a row of prepared columns.
 */
UPB_INLINE void gather_network(V x[UPB_TAPS], const upb_prepared *const column[3], int top, unsigned k,
                               const M empty[3], V lift) {
    for (int c = 0; c < 3; c++) {
        x[c] = V_LOAD(&column[c]->row[top][k]);
        x[3 + c] = V_LOAD(&column[c]->row[top + 1][k]);
    }
    fill_columns(x, empty);
    fill_columns(x + 3, empty);
    const V minimum = V_MIN(V_MIN(V_MIN(x[0], x[1]), V_MIN(x[2], x[3])), V_MIN(x[4], x[5]));
    const V base = V_SUB(minimum, lift);
    for (int i = 0; i < UPB_TAP_MINIMUM; i++)
        x[i] = V_SUB(x[i], base);
    x[UPB_TAP_MINIMUM] = minimum;
}

/*
 * The windows from lane k on, of both networks, with a lift for each: the steps of one depend on each other and would
 * wait alone. Returns where the whole window is empty and its rule is to give nothing then.
 */
UPB_INLINE M gather(V x[2][UPB_TAPS], const upb_prepared *const column[3], unsigned k, M fill, const uint16_t lift[2]) {
    M empty[3];
    for (int c = 0; c < 3; c++)
        empty[c] = M_AND(fill, M_IS_ZERO(V_LOAD(&column[c]->row[UPB_DISTANCE_TOP][k])));
    gather_network(x[UPB_DISTANCE], column, UPB_DISTANCE_TOP, k, empty, V_SET(lift[UPB_DISTANCE]));
    gather_network(x[UPB_INTENSITY], column, UPB_INTENSITY_TOP, k, empty, V_SET(lift[UPB_INTENSITY]));
    return M_AND(fill, M_IS_ZERO(x[UPB_DISTANCE][UPB_TAP_MINIMUM]));
}

/* y: of both networks, in any range. */
UPB_INLINE void give(uint16_t *distance, uint8_t *intensity, const W y[2], M nothing, V given_max, V min_count) {
    /* y beyond 65535 is caught by y - 1, which then saturates to no less than any limit. */
    const V d = V_FROM_W(y[UPB_DISTANCE]), less = V_FROM_W(W_MINUS_1(y[UPB_DISTANCE]));
    const V i = V_MIN(V_FROM_W(y[UPB_INTENSITY]), V_SET(255));
    const M near_enough = M_AND_NOT(M_AT_LEAST(d, min_count), nothing);
    const M given = M_AND_NOT(near_enough, M_AT_LEAST(less, given_max));
    V_STOREU(distance, V_KEEP(given, d));
    V_STORE_U8(intensity, V_KEEP(given, i));
}

#endif /* UPB_KERNEL_RULES_H */
