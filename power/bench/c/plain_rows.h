/* The rules around the networks, on rows of NUMBERs: included for each kind of number by plain_windows.c. */

/* Rows of the pair of beams k and k+1, filled, a column wider on both sides: those are empty. */
static NUMBER NAME(pair)[4][COLUMNS_MAX + 2];
static NUMBER NAME(taps)[2][TAPS][BLOCK];

static void NAME(fill_pair)(const plain_job *job, int k) {
    const uint16_t *restrict d0 = job->distance + (long)k * job->columns, *restrict d1 = d0 + job->columns;
    const uint8_t *restrict i0 = job->intensity + (long)k * job->columns, *restrict i1 = i0 + job->columns;
    const NUMBER low = (NUMBER)job->min_count, max0 = (NUMBER)job->seen_max[k], max1 = (NUMBER)job->seen_max[k + 1];
    NUMBER *restrict top = NAME(pair)[0] + 1, *restrict bottom = NAME(pair)[1] + 1;
    NUMBER *restrict top_i = NAME(pair)[2] + 1, *restrict bottom_i = NAME(pair)[3] + 1;
    for (int c = 0; c < job->columns; c++) {
        const NUMBER a = (NUMBER)d0[c], b = (NUMBER)d1[c];
        const int seen_a = (a >= low) & (a <= max0), seen_b = (b >= low) & (b <= max1);
        const NUMBER x = seen_a ? a : 0, y = seen_b ? b : 0;
        const NUMBER u = seen_a ? (NUMBER)i0[c] : 0, v = seen_b ? (NUMBER)i1[c] : 0;
        top[c] = seen_a ? x : y;
        bottom[c] = seen_b ? y : x;
        top_i[c] = seen_a ? u : v;
        bottom_i[c] = seen_b ? v : u;
    }
    for (int r = 0; r < 4; r++)
        NAME(pair)[r][0] = NAME(pair)[r][job->columns + 1] = 0;
}

/* Differences and minimum of window c of row pair `first` (0: distances, 2: intensities). */
static inline void NAME(window_of)(NUMBER x[TAPS], int first, int c) {
    const NUMBER *restrict far_row = NAME(pair)[0] + c;
    const int e0 = far_row[0] == 0, e1 = far_row[1] == 0, e2 = far_row[2] == 0;
    UNROLLED
    for (int row = 0; row < 2; row++) {
        const NUMBER *restrict p = NAME(pair)[first + row] + c;
        const NUMBER l = p[0], m = p[1], r = p[2];
        const NUMBER least = l < r ? l : r;
        const NUMBER one = e2 ? l : least;
        const NUMBER between = e0 ? r : one;
        const NUMBER beside_l = e1 ? r : m, beside_r = e1 ? l : m;
        x[3 * row] = e0 ? beside_l : l;
        x[3 * row + 1] = e1 ? between : m;
        x[3 * row + 2] = e2 ? beside_r : r;
    }
    const NUMBER a = x[0] < x[1] ? x[0] : x[1], b = x[2] < x[3] ? x[2] : x[3], d = x[4] < x[5] ? x[4] : x[5];
    const NUMBER ab = a < b ? a : b, least = ab < d ? ab : d;
    UNROLLED
    for (int i = 0; i < 6; i++)
        x[i] -= least;
    x[6] = least;
}

/* The same for n windows from column `from` on: x[network][tap][n]. */
static inline void NAME(gather)(const NUMBER *x[2][TAPS], int from, int n) {
    for (int net = 0; net < 2; net++) {
        NUMBER(*restrict out)[BLOCK] = NAME(taps)[net];
        for (int c = 0; c < n; c++) {
            NUMBER w[TAPS];
            NAME(window_of)(w, 2 * net, from + c);
            UNROLLED
            for (int i = 0; i < TAPS; i++)
                out[i][c] = w[i];
        }
        for (int i = 0; i < TAPS; i++)
            x[net][i] = out[i];
    }
}

/* Limits, and windows without a return. */
static inline void NAME(give)(plain_job *job, int k, int from, int n, const NUMBER *restrict d,
                              const NUMBER *restrict i, const NUMBER *restrict least) {
    uint16_t *restrict out_d = job->out_distance + (long)k * job->columns + from;
    uint8_t *restrict out_i = job->out_intensity + (long)k * job->columns + from;
    const NUMBER low = (NUMBER)job->min_count, high = (NUMBER)job->given_max[k];
    for (int c = 0; c < n; c++) {
        const int given = (d[c] >= low) & (d[c] <= high) & (least[c] > 0);
        const NUMBER above = i[c] > 0 ? i[c] : 0, grey = above < 255 ? above : 255;
        const NUMBER far = given ? d[c] : 0, shade = given ? grey : 0;
        out_d[c] = (uint16_t)(int32_t)far;
        out_i[c] = (uint8_t)(int32_t)shade;
    }
}
