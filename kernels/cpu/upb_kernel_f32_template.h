/*
 * The window kernel in vectors: included once by each instruction set's file, which defines before
 *
 *   V, M                 a vector of V_LANES floats; a mask of them
 *   V_LANES, V_BLOCK     V_BLOCK vectors go through a network together (they share the loads of its weights);
 *                        V_LANES * V_BLOCK divides UPB_LANES
 *   V_LOAD, V_LOADU(p)   V_LANES floats, aligned to their size or not;    V_STORE, V_STOREU(p, v)
 *   V_LOAD_U16(p), V_LOAD_U8(p)   V_LANES integers as floats, unaligned
 *   V_STORE_U16(p, v), V_STORE_U8(p, v)   the same way back; v is whole and in range
 *   V_SET(x)             all lanes x
 *   V_ADD, V_SUB, V_MUL, V_MIN, V_MAX (a, b);  V_FMA(a, b, c): a * b + c, rounded once;  V_FLOOR(v)
 *   M_IS_ZERO(v), M_BETWEEN(v, low, high), M_AND_NOT(m, n): m and not n;  V_SELECT(m, yes, no)
 *   UPB_FILL_KERNELS     the name of the function that hands the kernels out
 *
 * The plain C kernel says the same one lane at a time: read it first.
 */
#include "upb_kernels.h"

typedef struct window {
    V x[UPB_TAPS];
} window;

static void prepare_f32(upb_prepared_f32 *prepared, const upb_model_f32 *model, const uint16_t *distance,
                        const uint8_t *intensity) {
    _Alignas(UPB_ALIGN) float d[UPB_LANES + V_LANES], i[UPB_LANES + V_LANES];
    const V low = V_SET(model->min_count), zero = V_SET(0.0f);
    for (unsigned k = 0; k < UPB_LANES; k += V_LANES) {
        V count = V_LOAD_U16(distance + k);
        M valid = M_BETWEEN(count, low, V_LOAD(model->seen_max + k));
        V_STORE(d + k, V_SELECT(valid, count, zero));
        V_STORE(i + k, V_SELECT(valid, V_LOAD_U8(intensity + k), zero));
    }
    V_STORE(d + UPB_LANES, zero);
    V_STORE(i + UPB_LANES, zero);
    for (unsigned k = 0; k < UPB_LANES; k += V_LANES) {
        V d_top = V_LOAD(d + k), d_bottom = V_LOADU(d + k + 1);
        V i_top = V_LOAD(i + k), i_bottom = V_LOADU(i + k + 1);
        M top_empty = M_IS_ZERO(d_top), bottom_empty = M_IS_ZERO(d_bottom);
        if (!model->fill)
            top_empty = bottom_empty = M_AND_NOT(top_empty, top_empty);
        V_STORE(&prepared->row[UPB_DISTANCE_TOP][k], V_SELECT(top_empty, d_bottom, d_top));
        V_STORE(&prepared->row[UPB_DISTANCE_BOTTOM][k], V_SELECT(bottom_empty, d_top, d_bottom));
        V_STORE(&prepared->row[UPB_INTENSITY_TOP][k], V_SELECT(top_empty, i_bottom, i_top));
        V_STORE(&prepared->row[UPB_INTENSITY_BOTTOM][k], V_SELECT(bottom_empty, i_top, i_bottom));
    }
}

static inline void fill_columns(V x[3], const M empty[3]) {
    const V left = x[0], middle = x[1], right = x[2];
    V nearer = V_SELECT(empty[0], right, V_SELECT(empty[2], left, V_MIN(left, right)));
    x[0] = V_SELECT(empty[0], V_SELECT(empty[1], right, middle), left);
    x[1] = V_SELECT(empty[1], nearer, middle);
    x[2] = V_SELECT(empty[2], V_SELECT(empty[1], left, middle), right);
}

/* The windows of V_BLOCK vectors from lane k on; `first` is the top row of a prepared column. */
static inline void gather(window *w, const upb_model_f32 *model, const upb_prepared_f32 *const column[3], int first,
                          unsigned k) {
    for (unsigned b = 0; b < V_BLOCK; b++) {
        V *x = w[b].x;
        M empty[3];
        for (int c = 0; c < 3; c++) {
            x[c] = V_LOAD(&column[c]->row[first][k + b * V_LANES]);
            x[3 + c] = V_LOAD(&column[c]->row[first + 1][k + b * V_LANES]);
            empty[c] = M_IS_ZERO(V_LOAD(&column[c]->row[UPB_DISTANCE_TOP][k + b * V_LANES]));
        }
        if (model->fill) {
            fill_columns(x, empty);
            fill_columns(x + 3, empty);
        }
        V minimum = V_MIN(V_MIN(V_MIN(x[0], x[1]), V_MIN(x[2], x[3])), V_MIN(x[4], x[5]));
        for (int i = 0; i < UPB_TAP_MINIMUM; i++)
            x[i] = V_SUB(x[i], minimum);
        x[UPB_TAP_MINIMUM] = minimum;
    }
}

/* A network's output less skip * minimum. */
static inline void network(V *y, const upb_network_f32 *net, const window *w) {
    const V slope = V_SET(net->slope);
    for (unsigned b = 0; b < V_BLOCK; b++)
        y[b] = V_SET(net->offset);
    for (uint32_t h = 0; h < net->hidden; h++) {
        const float *unit = net->unit[h];
        V sum[V_BLOCK];
        for (unsigned b = 0; b < V_BLOCK; b++)
            sum[b] = V_SET(unit[UPB_UNIT_BIAS]);
        for (int i = 0; i < UPB_TAPS; i++)
            for (unsigned b = 0; b < V_BLOCK; b++)
                sum[b] = V_FMA(V_SET(unit[i]), w[b].x[i], sum[b]);
        for (unsigned b = 0; b < V_BLOCK; b++)
            y[b] = V_FMA(V_SET(unit[UPB_UNIT_OUTPUT]), V_MAX(sum[b], V_MUL(slope, sum[b])), y[b]);
    }
}

/* The whole output, rounded half up. The minimum is whole: adding it to the rounded rest is exact. */
static inline V rounded_output(V rest, const upb_network_f32 *net, const window *w) {
    return V_FMA(V_SET(net->skip), w->x[UPB_TAP_MINIMUM], V_FLOOR(V_ADD(rest, V_SET(0.5f))));
}

static inline V raw_output(V rest, const upb_network_f32 *net, const window *w) {
    V y = V_FMA(V_SET(net->skip), w->x[UPB_TAP_MINIMUM], rest);
    return net->positive ? V_MAX(y, V_SET(0.0f)) : y;
}

static void windows_f32(const upb_model_f32 *model, const upb_prepared_f32 *left, const upb_prepared_f32 *middle,
                        const upb_prepared_f32 *right, uint16_t *distance, uint8_t *intensity) {
    const upb_prepared_f32 *const column[3] = {left, middle, right};
    const V low = V_SET(model->min_count), zero = V_SET(0.0f);
    for (unsigned k = 0; k < UPB_LANES; k += V_BLOCK * V_LANES) {
        window w[V_BLOCK];
        V y[V_BLOCK];
        M given[V_BLOCK];
        gather(w, model, column, UPB_DISTANCE_TOP, k);
        network(y, &model->network[UPB_DISTANCE], w);
        for (unsigned b = 0; b < V_BLOCK; b++) {
            V d = rounded_output(y[b], &model->network[UPB_DISTANCE], &w[b]);
            given[b] = M_BETWEEN(d, low, V_LOAD(model->given_max + k + b * V_LANES));
            if (model->fill)
                given[b] = M_AND_NOT(given[b], M_IS_ZERO(w[b].x[UPB_TAP_MINIMUM]));
            V_STORE_U16(distance + k + b * V_LANES, V_SELECT(given[b], d, zero));
        }
        gather(w, model, column, UPB_INTENSITY_TOP, k);
        network(y, &model->network[UPB_INTENSITY], w);
        for (unsigned b = 0; b < V_BLOCK; b++) {
            V i = rounded_output(y[b], &model->network[UPB_INTENSITY], &w[b]);
            i = V_MIN(V_MAX(i, zero), V_SET(255.0f));
            V_STORE_U8(intensity + k + b * V_LANES, V_SELECT(given[b], i, zero));
        }
    }
}

static void raw_f32(const upb_model_f32 *model, const upb_prepared_f32 *left, const upb_prepared_f32 *middle,
                    const upb_prepared_f32 *right, float *distance, float *intensity) {
    const upb_prepared_f32 *const column[3] = {left, middle, right};
    for (unsigned k = 0; k < UPB_LANES; k += V_BLOCK * V_LANES) {
        window w[V_BLOCK];
        V y[V_BLOCK];
        gather(w, model, column, UPB_DISTANCE_TOP, k);
        network(y, &model->network[UPB_DISTANCE], w);
        for (unsigned b = 0; b < V_BLOCK; b++)
            V_STOREU(distance + k + b * V_LANES, raw_output(y[b], &model->network[UPB_DISTANCE], &w[b]));
        gather(w, model, column, UPB_INTENSITY_TOP, k);
        network(y, &model->network[UPB_INTENSITY], w);
        for (unsigned b = 0; b < V_BLOCK; b++)
            V_STOREU(intensity + k + b * V_LANES, raw_output(y[b], &model->network[UPB_INTENSITY], &w[b]));
    }
}

void UPB_FILL_KERNELS(upb_kernels *kernels) {
    kernels->prepare_f32 = prepare_f32;
    kernels->windows_f32 = windows_f32;
    kernels->raw_f32 = raw_f32;
}
