/* The kernel: global size (blocks of columns, groups of pairs of beams), see upbeam/kernels/opencl/variants.py. */

#if WALK
#if VEC == 2
#define FROM_LEFT(p, c) ((N)(p.s1, c.s0))
#define FROM_RIGHT(c, n) ((N)(c.s1, n.s0))
#elif VEC == 4
#define FROM_LEFT(p, c) ((N)(p.s3, c.s012))
#define FROM_RIGHT(c, n) ((N)(c.s123, n.s0))
#elif VEC == 8
#define FROM_LEFT(p, c) ((N)(p.s7, c.s0123, c.s456))
#define FROM_RIGHT(c, n) ((N)(c.s1234, c.s567, n.s0))
#elif VEC == 16
#define FROM_LEFT(p, c) ((N)(p.sf, c.s01234567, c.s89ab, c.scde))
#define FROM_RIGHT(c, n) ((N)(c.s12345678, c.s9abc, c.sdef, n.s0))
#else
#error "WALK needs vectors"
#endif

static inline beam_pair load_pair(__global const ushort *distance, __global const uchar *intensity, int pair,
                                  int column) {
    return make_pair(load_beam(distance, intensity, pair, column), load_beam(distance, intensity, pair + 1, column));
}

/* The columns one to the left of `middle`, or one to the right. */
static inline beam_pair shift_left(beam_pair before, beam_pair middle) {
    beam_pair p;
#pragma unroll
    for (int row = 0; row < 2; row++) {
        p.distance[row] = FROM_LEFT(before.distance[row], middle.distance[row]);
        p.intensity[row] = FROM_LEFT(before.intensity[row], middle.intensity[row]);
    }
    return p;
}

static inline beam_pair shift_right(beam_pair middle, beam_pair after) {
    beam_pair p;
#pragma unroll
    for (int row = 0; row < 2; row++) {
        p.distance[row] = FROM_RIGHT(middle.distance[row], after.distance[row]);
        p.intensity[row] = FROM_RIGHT(middle.intensity[row], after.intensity[row]);
    }
    return p;
}
#else
static inline beam_pixels load_shifted(__global const ushort *distance, __global const uchar *intensity, int beam,
                                       int column) {
    const size_t at = (size_t)beam * UPB_STRIDE_IN + UPB_PAD + column;
    return see(LOAD_ANYWHERE(distance + at), LOAD_ANYWHERE(intensity + at), beam);
}
#endif

/* Input and output are a distance image and behind it an intensity image. */
__kernel void upsample_image(__global const uchar *restrict input,
                             __global uchar *restrict output UPB_WEIGHTS_PARAMETERS) {
    __global const ushort *distance = (__global const ushort *)input;
    __global const uchar *intensity = input + 2 * UPB_BEAMS * UPB_STRIDE_IN;
    __global ushort *out_distance = (__global ushort *)output;
    __global uchar *out_intensity = output + 4 * UPB_BEAMS * UPB_STRIDE_OUT;
#if WALK
    const int pair = get_global_id(1), first = (int)get_global_id(0) * (WALK * VEC);
    beam_pair at[SHARE + 2]; /* the block before, SHARE blocks, the one after */
    at[0] = load_pair(distance, intensity, pair, first - VEC);
    at[1] = load_pair(distance, intensity, pair, first);
    for (int column = first; column < first + WALK * VEC; column += SHARE * VEC) {
        beam_pair left[SHARE], right[SHARE];
#pragma unroll
        for (int b = 0; b < SHARE; b++) {
            at[b + 2] = load_pair(distance, intensity, pair, column + (b + 1) * VEC);
            left[b] = shift_left(at[b], at[b + 1]);
            right[b] = shift_right(at[b + 1], at[b + 2]);
            copy_beam(distance, intensity, out_distance, out_intensity, pair, column + b * VEC);
            if (pair == UPB_PAIRS - 1)
                copy_beam(distance, intensity, out_distance, out_intensity, pair + 1, column + b * VEC);
        }
        generate(out_distance, out_intensity, pair, column, left, at + 1, right, weights_0, weights_1);
        at[0] = at[SHARE];
        at[1] = at[SHARE + 1];
    }
#else
    const int column = (int)get_global_id(0) * VEC, first = (int)get_global_id(1) * ROWS;
    beam_pixels top[3], bottom[3];
#pragma unroll
    for (int c = 0; c < 3; c++)
        top[c] = load_shifted(distance, intensity, first, column + c - 1);
    for (int pair = first; pair < min(first + ROWS, UPB_PAIRS); pair++) {
#pragma unroll
        for (int c = 0; c < 3; c++)
            bottom[c] = load_shifted(distance, intensity, pair + 1, column + c - 1);
        copy_beam(distance, intensity, out_distance, out_intensity, pair, column);
        if (pair == UPB_PAIRS - 1)
            copy_beam(distance, intensity, out_distance, out_intensity, pair + 1, column);
        const beam_pair left = make_pair(top[0], bottom[0]), middle = make_pair(top[1], bottom[1]),
                        right = make_pair(top[2], bottom[2]);
        generate(out_distance, out_intensity, pair, column, &left, &middle, &right, weights_0, weights_1);
#pragma unroll
        for (int c = 0; c < 3; c++)
            top[c] = bottom[c];
    }
#endif
}
