/*
 * What surrounds the networks (docs/model-format.md), VEC neighbouring columns at a time. OpenCL C 1.2.
 *
 * The host puts a prelude before this file: the model's numbers as macros and tables, UPB_* below. The build options of
 * the variant:
 *   VEC     columns in a vector: 1, 2, 4, 8, 16
 *   ROWS    pairs of beams that a work-item takes one after the other, the shared beam loaded once
 *   WALK    blocks of VEC columns that a work-item takes one after the other; the columns left and right then come from
 *           registers. 0: they are loaded and prepared again, each at its own place
 *   SHARE   of these blocks, how many go through a network together and share the loads of its weights: 1, 2
 *   UPB_WEIGHTS_ARE_ARGUMENTS   the weights come in two __constant buffers instead of being part of the program
 *
 * Images on the device: 32 input rows of UPB_STRIDE_IN pixels, the first column at UPB_PAD; all outside the image is 0,
 * which is what lies beyond an edge. 64 output rows of UPB_STRIDE_OUT pixels; those right of the image mean nothing.
 */
#define UPB_BEAMS 32
#define UPB_PAIRS 31

#define JOIN_(a, b) a##b
#define JOIN(a, b) JOIN_(a, b)
#if VEC == 1
#define VECTOR(type) type
#define LOAD_ANYWHERE(p) (*(p))
#else
#define VECTOR(type) JOIN(type, VEC)
#define LOAD_ANYWHERE(p) JOIN(vload, VEC)(0, p)
#endif
/*
 * At columns that are multiples of VEC: rows begin at multiples of 16 pixels. Not vloadn and vstoren, which promise
 * less about the address: PoCL puts such vectors of small integers together pixel by pixel.
 */
#define LOAD(type, p) (*(__global const VECTOR(type) *)(p))
#define STORE(type, v, p) (*(__global VECTOR(type) *)(p) = (v))
#define CONVERT(type, v) JOIN(convert_, VECTOR(type))(v)

/* NUMBER is what a window computes with: float, or int. A comparison of either gives an int for each lane. */
#define N VECTOR(UPB_NUMBER)
#define MASK VECTOR(int)
#define TO_N(v) CONVERT(UPB_NUMBER, v)
#define PICK(mask, yes, no) select(no, yes, mask)

#ifdef UPB_WEIGHTS_ARE_ARGUMENTS
#define UPB_WEIGHTS_PARAMETERS , __constant UPB_NUMBER *weights_0, __constant UPB_NUMBER *weights_1
#else
__constant UPB_NUMBER weights_0[] = UPB_WEIGHTS_0;
__constant UPB_NUMBER weights_1[] = UPB_WEIGHTS_1;
#define UPB_WEIGHTS_PARAMETERS
#endif

__constant UPB_NUMBER seen_max[UPB_BEAMS] = UPB_SEEN_MAX;
__constant UPB_NUMBER given_max[UPB_BEAMS] = UPB_GIVEN_MAX;

/* Pixels of a beam; distance and intensity are 0 where the distance is outside the limits. */
typedef struct beam_pixels {
    N distance, intensity;
} beam_pixels;

static inline beam_pixels see(VECTOR(ushort) distance, VECTOR(uchar) intensity, int beam) {
    const N count = TO_N(distance), grey = TO_N(intensity), zero = (N)(0);
    const MASK seen = (count >= (N)(UPB_MIN_COUNT)) & (count <= (N)(seen_max[beam]));
    beam_pixels b;
    b.distance = PICK(seen, count, zero);
    b.intensity = PICK(seen, grey, zero);
    return b;
}

static inline beam_pixels load_beam(__global const ushort *distance, __global const uchar *intensity, int beam,
                                    int column) {
    const size_t at = (size_t)beam * UPB_STRIDE_IN + UPB_PAD + column;
    return see(LOAD(ushort, distance + at), LOAD(uchar, intensity + at), beam);
}

/* Columns of a pair of beams as windows see them: under UPB_FILL an empty pixel is the other one of its pair. */
typedef struct beam_pair {
    N distance[2], intensity[2]; /* top, bottom */
} beam_pair;

static inline beam_pair make_pair(beam_pixels top, beam_pixels bottom) {
    beam_pair p;
#if UPB_FILL
    const MASK no_top = top.distance == (N)(0), no_bottom = bottom.distance == (N)(0);
    p.distance[0] = PICK(no_top, bottom.distance, top.distance);
    p.distance[1] = PICK(no_bottom, top.distance, bottom.distance);
    p.intensity[0] = PICK(no_top, bottom.intensity, top.intensity);
    p.intensity[1] = PICK(no_bottom, top.intensity, bottom.intensity);
#else
    p.distance[0] = top.distance;
    p.distance[1] = bottom.distance;
    p.intensity[0] = top.intensity;
    p.intensity[1] = bottom.intensity;
#endif
    return p;
}

/* One row of the windows, x[0..2], its empty columns filled from their neighbours. */
static inline void window_row(N *x, N left, N middle, N right, MASK no_left, MASK no_middle, MASK no_right) {
#if UPB_FILL
    const N between = PICK(no_left, right, PICK(no_right, left, min(left, right)));
    x[0] = PICK(no_left, PICK(no_middle, right, middle), left);
    x[1] = PICK(no_middle, between, middle);
    x[2] = PICK(no_right, PICK(no_middle, left, middle), right);
#else
    x[0] = left;
    x[1] = middle;
    x[2] = right;
#endif
}

/* Windows of SHARE vectors, after the rules: six differences from their minimum, and the minimum. */
typedef struct windows {
    N x[SHARE][6], least[SHARE];
} windows;

/* From six pixels to their minimum, and differences from it. */
static inline N subtract_minimum(N *x) {
    const N least = min(min(min(x[0], x[1]), min(x[2], x[3])), min(x[4], x[5]));
#pragma unroll
    for (int i = 0; i < 6; i++)
        x[i] -= least;
    return least;
}

/* Which columns of a pair are empty. After the fill of pairs the top tells for both. */
static inline MASK is_empty(beam_pair p) { return p.distance[0] == (N)(0); }

/* The windows around `middle`. `intensity`: which of the two images. The three are arrays of SHARE. */
static inline void gather(windows *w, int intensity, const beam_pair *left, const beam_pair *middle,
                          const beam_pair *right) {
#pragma unroll
    for (int b = 0; b < SHARE; b++) {
        const MASK no_left = is_empty(left[b]), no_middle = is_empty(middle[b]), no_right = is_empty(right[b]);
#pragma unroll
        for (int row = 0; row < 2; row++)
            window_row(w->x[b] + 3 * row, intensity ? left[b].intensity[row] : left[b].distance[row],
                       intensity ? middle[b].intensity[row] : middle[b].distance[row],
                       intensity ? right[b].intensity[row] : right[b].distance[row], no_left, no_middle, no_right);
        w->least[b] = subtract_minimum(w->x[b]);
    }
}

/* The networks and what becomes of their sums: window_f32.cl and window_int.cl. `w` may be written over. */
static inline void distance_sums(N *y, windows *w, __constant UPB_NUMBER *weights);
static inline void intensity_sums(N *y, windows *w, __constant UPB_NUMBER *weights);

/* Writes the generated row below beam `pair`, SHARE vectors from `column` on. The three pairs are arrays of SHARE. */
static inline void generate(__global ushort *out_distance, __global uchar *out_intensity, int pair, int column,
                            const beam_pair *left, const beam_pair *middle, const beam_pair *right,
                            __constant UPB_NUMBER *distance_weights, __constant UPB_NUMBER *intensity_weights) {
    const size_t at = (size_t)(2 * pair + 1) * UPB_STRIDE_OUT + column;
    const N zero = (N)(0);
    MASK given[SHARE];
    N y[SHARE];
    windows w;
    gather(&w, 0, left, middle, right);
    distance_sums(y, &w, distance_weights);
#pragma unroll
    for (int b = 0; b < SHARE; b++) {
        given[b] = (y[b] >= (N)(UPB_MIN_COUNT)) & (y[b] <= (N)(given_max[pair]));
        if (UPB_FILL)
            given[b] &= w.least[b] > zero; /* filled: 0 only if the whole window is empty */
        STORE(ushort, CONVERT(ushort, PICK(given[b], y[b], zero)), out_distance + at + b * VEC);
    }
    gather(&w, 1, left, middle, right);
    intensity_sums(y, &w, intensity_weights);
#pragma unroll
    for (int b = 0; b < SHARE; b++) {
        const N grey = min(max(y[b], zero), (N)(255)); /* before the conversion: it may not fit an integer */
        STORE(uchar, CONVERT(uchar, PICK(given[b], grey, zero)), out_intensity + at + b * VEC);
    }
}

/* Input row `beam` to its output row, to the bit; the last one also to row 63, or nothing there. */
static inline void copy_beam(__global const ushort *distance, __global const uchar *intensity,
                             __global ushort *out_distance, __global uchar *out_intensity, int beam, int column) {
    const size_t from = (size_t)beam * UPB_STRIDE_IN + UPB_PAD + column;
    const size_t to = (size_t)(2 * beam) * UPB_STRIDE_OUT + column;
    const VECTOR(ushort) count = LOAD(ushort, distance + from);
    const VECTOR(uchar) grey = LOAD(uchar, intensity + from);
    STORE(ushort, count, out_distance + to);
    STORE(uchar, grey, out_intensity + to);
    if (beam == UPB_BEAMS - 1) {
        STORE(ushort, UPB_REPEAT_LAST_ROW ? count : (VECTOR(ushort))(0), out_distance + to + UPB_STRIDE_OUT);
        STORE(uchar, UPB_REPEAT_LAST_ROW ? grey : (VECTOR(uchar))(0), out_intensity + to + UPB_STRIDE_OUT);
    }
}
