/*
 * The column stream against an oracle that sees the whole segment at once: every finished column worked out from the
 * file's own numbers, one window at a time: by the rules of docs/model-format.md in double precision, by
 * docs/numeric-contract.md to the bit. Options: --seed N, --count N (random scenarios).
 */
#include <math.h>

#include "check.h"
#include "ubm_writer.h"

enum { FIRINGS_MAX = 20000 };

/* A firing column as it was pushed; `arrived` is 0 for one that never came. */
typedef struct firing {
    uint16_t distance[UPB_BEAMS];
    uint8_t intensity[UPB_BEAMS], arrived;
} firing;

typedef struct finished {
    uint64_t frame;
    uint32_t column, flags;
    uint16_t distance[UPB_ROWS];
    uint8_t intensity[UPB_ROWS];
} finished;

/* What a stream was given since its last edge, and what it gave. */
static firing firings[FIRINGS_MAX];
static unsigned firing_count;
static finished outputs[FIRINGS_MAX];
static unsigned output_count;

static void collect(void *user, const upb_column *column) {
    CHECK(user == outputs);
    if (!CHECK(output_count < FIRINGS_MAX))
        return;
    finished *out = &outputs[output_count++];
    out->frame = column->frame;
    out->column = column->column;
    out->flags = column->flags;
    memcpy(out->distance, column->distance, sizeof out->distance);
    memcpy(out->intensity, column->intensity, sizeof out->intensity);
}

/* ----------------------------------------------------------------------------------------------- oracle */

/* Where a segment stands, and its sensor in whole columns. */
typedef struct segment {
    const test_model *model;
    upb_precision precision;
    uint32_t columns; /* per turn */
    uint32_t start;   /* first firing column */
    uint64_t frame;
    int32_t offset[UPB_BEAMS], shift, least;
} segment;

/* Of the stream that is open. */
static upb_precision open_precision;

static segment begin(const test_model *model, uint32_t columns, int aligned, uint32_t start, uint64_t frame) {
    segment s = {.model = model, .precision = open_precision, .columns = columns, .start = start, .frame = frame};
    int32_t most = -100000;
    s.least = 100000;
    for (int k = 0; k < 32; k++) {
        s.offset[k] = aligned ? 0 : (int32_t)floor((double)model->offset[k] * columns / 360e6 + 0.5);
        most = s.offset[k] > most ? s.offset[k] : most;
        s.least = s.offset[k] < s.least ? s.offset[k] : s.least;
    }
    s.shift = s.least > 0 ? s.least : most < 0 ? most : 0;
    return s;
}

/* Azimuth columns are numbered from the segment's first finished one, `n`. Its turns and columns: */
static int64_t absolute(const segment *s, int64_t n) {
    const int64_t columns = s->columns;
    return ((int64_t)s->start + s->shift + columns) % columns + n;
}

/* The firing of beam k in azimuth column n, or null. */
static const firing *sample(const segment *s, int64_t n, unsigned k) {
    const int64_t j = n - s->offset[k] + s->shift;
    return j >= 0 && j < firing_count && firings[j].arrived ? &firings[j] : NULL;
}

/* A window pixel: column n seen from column `from` of the same window; false if it is empty. */
static int pixel(const segment *s, int64_t from, int64_t n, unsigned k, double value[2]) {
    value[0] = value[1] = 0;
    if (n < 0 || n >= firing_count)
        return 0;
    if (s->model->edge == UPB_EDGE_ZERO && absolute(s, n) / s->columns != absolute(s, from) / s->columns)
        return 0;
    const firing *f = sample(s, n, k);
    if (!f || f->distance[k] < s->model->min_count || f->distance[k] > s->model->row_max[2 * k])
        return 0;
    value[0] = f->distance[k];
    value[1] = f->intensity[k];
    return 1;
}

/* The filled window [row][column][distance or intensity]; false if it has no valid pixel. */
static int fill_window(int valid[2][3], double x[2][3][2]) {
    int any = 0, column_valid[3];
    for (int c = 0; c < 3; c++) {
        column_valid[c] = valid[0][c] || valid[1][c];
        any |= column_valid[c];
        if (valid[0][c] != valid[1][c])
            memcpy(x[valid[0][c] ? 1 : 0][c], x[valid[0][c] ? 0 : 1][c], sizeof x[0][0]);
    }
    for (int row = 0; row < 2; row++)
        for (int which = 0; which < 2; which++) {
            const double l = x[row][0][which], m = x[row][1][which], r = x[row][2][which];
            if (!column_valid[0])
                x[row][0][which] = column_valid[1] ? m : r;
            if (!column_valid[2])
                x[row][2][which] = column_valid[1] ? m : l;
            if (!column_valid[1])
                x[row][1][which] = column_valid[0] && column_valid[2] ? fmin(l, r) : column_valid[0] ? l : r;
        }
    return any;
}

/* The network of the file on six values in metres, or steps. */
static double plain_network(const test_network *net, double x[2][3][2], int which, double unit) {
    double minimum = x[0][0][which], y;
    for (int i = 1; i < 6; i++)
        minimum = fmin(minimum, x[i / 3][i % 3][which]);
    y = (double)net->c + (double)net->skip * minimum * unit;
    for (uint32_t h = 0; h < net->hidden; h++) {
        double sum = (double)net->b[h] + (double)net->a[h][6] * minimum * unit;
        for (int i = 0; i < 6; i++)
            sum += (double)net->a[h][i] * x[i / 3][i % 3][which] * unit;
        y += (double)net->v[h] * (sum > 0 ? sum : (double)net->slope * sum);
    }
    return (net->flags & 1 ? fmax(y, 0) : y) / unit;
}

/* True if `got` is floor(y + 0.5) limited to low..high, or is so for a y that is a little different. */
static int rounds_to(double got, double y, double tolerance, double low, double high, double outside_low,
                     double outside_high) {
    for (int i = -1; i <= 1; i++) {
        const double whole = floor(y + i * tolerance + 0.5);
        if (got == (whole < low ? outside_low : whole > high ? outside_high : whole))
            return 1;
    }
    return 0;
}

/* floor(a / 2^n + 1/2) */
static int64_t half_up(int64_t a, uint32_t n) {
    const int64_t divisor = (int64_t)1 << n, raised = a + divisor / 2;
    return raised / divisor - (raised % divisor < 0);
}

/* Steps 1 to 9 of docs/numeric-contract.md, by division instead of shifts, in 64 bits. */
static int64_t contract_network(const test_integer *net, upb_precision precision, double pixels[2][3][2], int which) {
    int64_t x[6], minimum = 65536, span = 0, shift = 0, output = net->c;
    for (int i = 0; i < 6; i++) {
        x[i] = (int64_t)pixels[i / 3][i % 3][which];
        minimum = x[i] < minimum ? x[i] : minimum;
        span = x[i] > span ? x[i] : span;
    }
    for (span -= minimum; precision == UPB_PRECISION_INT8 && span >= (int64_t)256 << shift;)
        shift++;
    for (uint32_t h = 0; h < net->hidden; h++) {
        int64_t sum = 0;
        for (int i = 0; i < 6; i++) {
            const int64_t rounded = half_up(x[i] - minimum, (uint32_t)shift);
            sum += net->w[h][i] * (precision == UPB_PRECISION_INT8 && rounded > 255 ? 255 : rounded);
        }
        sum = sum * ((int64_t)1 << (shift + net->k)) + net->m[h] * minimum * ((int64_t)1 << net->j) + net->b[h];
        const int64_t a = half_up(sum, 16), bent = half_up(a * net->slope, 15);
        output += net->v[h] * (a > bent ? a : bent);
    }
    return half_up(output, net->t) + net->skip * minimum;
}

static unsigned generated_returns, contract_returns;

/* The integer precisions: no tolerance. */
static void check_contract(const segment *s, double x[2][3][2], const finished *out, unsigned k) {
    const test_model *m = s->model;
    const test_integer *net = m->integer[s->precision];
    const int64_t d = contract_network(&net[0], s->precision, x, 0), i = contract_network(&net[1], s->precision, x, 1);
    const int given = d >= m->min_count && d <= m->row_max[2 * k + 1];
    CHECK_EQUAL(out->distance[2 * k + 1], given ? d : 0);
    CHECK_EQUAL(out->intensity[2 * k + 1], !given || i < 0 ? 0 : i > 255 ? 255 : i);
    contract_returns += given != 0;
}

static void check_generated(const segment *s, const finished *out, int64_t n, unsigned k) {
    const test_model *m = s->model;
    int valid[2][3], any = 1;
    double x[2][3][2];
    for (int row = 0; row < 2; row++)
        for (int c = 0; c < 3; c++)
            valid[row][c] = pixel(s, n, n + c - 1, k + (unsigned)row, x[row][c]);
    if (m->empty_rule == UPB_EMPTY_FILL)
        any = fill_window(valid, x);
    const uint16_t distance = out->distance[2 * k + 1];
    const uint8_t intensity = out->intensity[2 * k + 1];
    if (!any) {
        CHECK(distance == 0 && intensity == 0);
        return;
    }
    if (s->precision != UPB_PRECISION_FP32) {
        check_contract(s, x, out, k);
        return;
    }
    const double d = plain_network(&m->network[0], x, 0, m->unit_um * 1e-6), i = plain_network(&m->network[1], x, 1, 1);
    if (!CHECK(rounds_to(distance, d, 0.05, m->min_count, m->row_max[2 * k + 1], 0, 0)))
        fprintf(stderr, "    frame %llu column %u window %u: distance %u, expected about %.3f\n",
                (unsigned long long)out->frame, out->column, k, distance, d);
    if (distance == 0)
        CHECK_EQUAL(intensity, 0);
    else if (!CHECK(rounds_to(intensity, i, 0.001, 0, 255, 0, 255)))
        fprintf(stderr, "    frame %llu column %u window %u: intensity %u, expected about %.3f\n",
                (unsigned long long)out->frame, out->column, k, intensity, i);
    generated_returns += distance != 0;
}

static void check_output(const segment *s, const finished *out, int64_t n) {
    const int64_t place = absolute(s, n);
    uint32_t flags = place % s->columns == s->columns - 1 ? UPB_COLUMN_LAST : 0;
    for (unsigned k = 0; k < UPB_BEAMS; k++) {
        const firing *f = sample(s, n, k);
        flags |= f ? 0 : UPB_COLUMN_INCOMPLETE;
        CHECK_EQUAL(out->distance[2 * k], f ? f->distance[k] : 0);
        CHECK_EQUAL(out->intensity[2 * k], f ? f->intensity[k] : 0);
    }
    CHECK_EQUAL(out->frame, s->frame + (uint64_t)(place / s->columns));
    CHECK_EQUAL(out->column, place % s->columns);
    CHECK_EQUAL(out->flags, flags);
    for (unsigned k = 0; k < UPB_WINDOWS; k++)
        check_generated(s, out, n, k);
    const int repeat = s->model->last_row == UPB_LAST_ROW_REPEAT;
    CHECK_EQUAL(out->distance[63], repeat ? out->distance[62] : 0);
    CHECK_EQUAL(out->intensity[63], repeat ? out->intensity[62] : 0);
}

/* How many columns a segment of `count` firing columns has handed out, before it ends. */
static unsigned handed_out(const segment *s, unsigned count) {
    unsigned complete = count > (unsigned)(s->shift - s->least) ? count - (unsigned)(s->shift - s->least) : 0;
    if (!complete)
        return 0;
    const int at_edge = s->model->edge == UPB_EDGE_ZERO && absolute(s, complete) % s->columns == 0;
    return at_edge ? complete : complete - 1;
}

/* Checks the whole segment, and forgets it. */
static void check_segment(const segment *s) {
    if (CHECK_EQUAL(output_count, firing_count))
        for (unsigned n = 0; n < output_count; n++)
            check_output(s, &outputs[n], n);
    firing_count = output_count = 0;
}

/* ---------------------------------------------------------------------------------------------- streams */

typedef struct open_stream {
    upb_model *model;
    upb_stream *stream;
    void *model_memory, *stream_memory;
} open_stream;

static void *aligned_memory(size_t bytes) {
    void *memory = aligned_alloc(UPB_ALIGN, (bytes + UPB_ALIGN - 1) / UPB_ALIGN * UPB_ALIGN);
    if (!memory)
        exit(2);
    memset(memory, 0xa5, bytes); /* memory need not be zero */
    return memory;
}

static open_stream open_with(const test_model *m, upb_stream_config config) {
    static uint8_t file[UBM_MAX];
    open_stream s;
    upb_error error;
    size_t bytes = 0;
    s.model_memory = aligned_memory(upb_model_bytes());
    if (upb_model_load(s.model_memory, upb_model_bytes(), file, write_ubm(file, m, NULL, 0), &s.model, &error) !=
            UPB_OK ||
        upb_stream_bytes(s.model, &config, &bytes, &error) != UPB_OK) {
        fprintf(stderr, "cannot open: %s\n", error.what);
        exit(2);
    }
    s.stream_memory = aligned_memory(bytes);
    CHECK_EQUAL(upb_stream_init(s.stream_memory, bytes, s.model, &config, &s.stream, &error), UPB_OK);
    open_precision = (upb_precision)config.precision;
    firing_count = output_count = 0;
    return s;
}

static void close_stream(open_stream *s) {
    free(s->model_memory);
    free(s->stream_memory);
}

static upb_stream_config collecting(uint32_t cpu) {
    upb_stream_config config = upb_stream_config_default();
    config.cpu = cpu;
    config.sink = collect;
    config.user = outputs;
    return config;
}

/* Every kind of pixel: in range, none, just at the limits, and the greatest count. Neighbours are alike. */
static firing random_firing(random_source *random, const test_model *m) {
    firing f = {.arrived = 1};
    const uint32_t base = m->min_count + random_below(random, (m->max_count - m->min_count) / 2);
    for (unsigned k = 0; k < UPB_BEAMS; k++) {
        const uint32_t special[6] = {0, m->min_count - 1, m->min_count, m->max_count, m->max_count + 1, 65535};
        const uint32_t kind = random_below(random, 24);
        f.distance[k] = (uint16_t)(kind < 6 ? special[kind] : kind < 12 ? 0 : base + random_below(random, 500));
        f.intensity[k] = (uint8_t)random_u32(random); /* also where there is no return */
    }
    return f;
}

static void insert_missing(uint32_t count) {
    for (; count && CHECK(firing_count < FIRINGS_MAX); count--)
        memset(&firings[firing_count++], 0, sizeof(firing));
}

static void push_firing(open_stream *s, uint32_t column, const firing *f) {
    CHECK_EQUAL(upb_stream_push(s->stream, column, f->distance, f->intensity), UPB_OK);
    firings[firing_count++] = *f;
}

/* ------------------------------------------------------------------------------------ random scenarios */

typedef struct scenario {
    test_model model;
    uint32_t columns, reorder, aligned, precision;
    uint32_t trouble; /* one push in so many goes wrong; 0: none */
} scenario;

/* Offsets within +-reach degrees: like a VLP-32C's, an HDL-64E's, or extreme ones; also all of one sign. */
static void random_offsets(random_source *random, test_model *m) {
    static const int32_t reach[] = {0, 4200000, 9200000, 45000000, 1000000};
    const int32_t most = reach[random_below(random, 5)];
    const uint32_t sign = random_below(random, 6);
    for (unsigned k = 0; k < UPB_BEAMS; k++) {
        const int32_t value = most ? (int32_t)random_below(random, 2 * (uint32_t)most + 1) - most : 0;
        m->offset[k] = sign == 0 ? most / 2 + abs(value) / 2 : sign == 1 ? -most / 2 - abs(value) / 2 : value;
    }
    if (sign == 2)
        for (unsigned k = 0; k < UPB_BEAMS; k++)
            m->offset[k] = most;
}

/* Integer networks, and sometimes other limits: with smaller counts there is room for shifts, with the largest none. */
static void random_integers(random_source *random, test_model *m) {
    static const uint32_t most[] = {40000, 65535, 9000, 30000};
    m->max_count = most[random_below(random, 4)];
    for (int row = 0; row < 64; row++)
        if (random_below(random, 2) || m->row_max[row] > m->max_count)
            m->row_max[row] = (uint16_t)m->max_count;
    add_integers(random, m, 1 + random_below(random, UPB_MAX_HIDDEN));
}

static scenario random_scenario(random_source *random) {
    static const uint32_t widths[] = {4, 5, 16, 37, 64, 180, 904};
    scenario c;
    c.columns = widths[random_below(random, 7)];
    c.model = random_model(random, c.columns, 1 + random_below(random, UPB_MAX_HIDDEN));
    c.model.edge = (uint8_t)random_below(random, 2);
    c.model.last_row = (uint8_t)random_below(random, 2);
    c.model.empty_rule = (uint8_t)random_below(random, 2);
    random_offsets(random, &c.model);
    c.precision = random_below(random, UPB_PRECISIONS);
    if (c.precision != UPB_PRECISION_FP32)
        random_integers(random, &c.model);
    c.reorder = 1 + random_below(random, c.columns / 2);
    c.aligned = random_below(random, 8) == 0;
    c.trouble = random_below(random, 3) ? 1 + random_below(random, 30) : 0;
    return c;
}

/* What the stream's statistics must be. */
static upb_stream_stats expected;

static void check_stats(const open_stream *s) {
    upb_stream_stats got;
    CHECK_EQUAL(upb_stream_get_stats(s->stream, &got), UPB_OK);
    CHECK_EQUAL(got.columns_in, expected.columns_in);
    CHECK_EQUAL(got.columns_out, expected.columns_out);
    CHECK_EQUAL(got.columns_missing, expected.columns_missing);
    CHECK_EQUAL(got.columns_late, expected.columns_late);
    CHECK_EQUAL(got.frames_out, expected.frames_out);
}

/* Something goes wrong before the push of `column`; returns the column that comes instead. */
static uint32_t random_trouble(open_stream *s, random_source *random, const scenario *c, uint32_t column) {
    const uint32_t farthest = c->columns - 2 - c->reorder; /* a jump that is no late column */
    firing f = random_firing(random, &c->model);
    uint32_t count;
    switch (random_below(random, 4)) {
    case 0: /* duplicated, or late */
        count = 1 + random_below(random, c->reorder + 1);
        CHECK_EQUAL(upb_stream_push(s->stream, (column + c->columns - count) % c->columns, f.distance, f.intensity),
                    UPB_E_ORDER);
        expected.columns_late++;
        return column;
    case 1: /* a gap that the stream was told of: up to some turns */
        count = random_below(random, random_below(random, 4) || c->columns > 100 ? 5 : 3 * c->columns);
        CHECK_EQUAL(upb_stream_gap(s->stream, count), UPB_OK);
        insert_missing(count);
        expected.columns_missing += count;
        return (column + count) % c->columns;
    case 2: /* a single one is missing */
        count = farthest ? 1 : 0;
        break;
    default: /* a jump */
        count = random_below(random, farthest + 1);
    }
    insert_missing(count);
    expected.columns_missing += count;
    return (column + count) % c->columns;
}

static void run_segment(open_stream *s, random_source *random, const scenario *c, segment *seg, unsigned length) {
    uint32_t column = seg->start;
    CHECK_EQUAL(upb_stream_gap(s->stream, 3), UPB_OK); /* does nothing before the first push */
    for (unsigned i = 0; i < length && firing_count + 4 * c->columns < FIRINGS_MAX; i++) {
        if (i && c->trouble && random_below(random, c->trouble) == 0)
            column = random_trouble(s, random, c, column);
        const firing f = random_firing(random, &c->model);
        push_firing(s, column, &f);
        expected.columns_in++;
        column = (column + 1) % c->columns;
        CHECK_EQUAL(output_count, handed_out(seg, firing_count));
    }
    CHECK_EQUAL(upb_stream_flush(s->stream), UPB_OK);
    CHECK_EQUAL(output_count, firing_count);
    expected.columns_out += output_count;
    for (unsigned n = 0; n < output_count; n++)
        expected.frames_out += absolute(seg, n) % c->columns == c->columns - 1;
}

static void run_scenario(random_source *random) {
    const scenario c = random_scenario(random);
    upb_stream_config config = collecting(UPB_CPU_AUTO);
    upb_stream_stats stats;
    config.reorder_columns = c.reorder;
    config.aligned = c.aligned;
    config.precision = c.precision;
    open_stream s = open_with(&c.model, config);
    uint64_t frame = 0;
    memset(&expected, 0, sizeof expected);
    upb_stream_get_stats(s.stream, &stats);
    for (int i = 0; i < 3; i++) {
        segment seg = begin(&c.model, c.columns, (int)c.aligned, random_below(random, c.columns), frame);
        CHECK_EQUAL(stats.delay_columns, seg.shift - seg.least + 1);
        run_segment(&s, random, &c, &seg, 1 + random_below(random, c.columns > 100 ? c.columns + 50 : 4 * c.columns));
        frame = outputs[output_count - 1].frame + 1;
        check_segment(&seg);
        check_stats(&s);
    }
    close_stream(&s);
}

/* ----------------------------------------------------------------------------------- chosen situations */

/* Plain turns of one kernel under some rules; false if this machine does not have it: checkkernels lists them. */
static int run_kernel(random_source *random, uint32_t cpu, uint32_t precision, unsigned rules) {
    static uint8_t file[UBM_MAX];
    _Alignas(UPB_ALIGN) static unsigned char memory[UPB_MODEL_BYTES_MAX];
    test_model m = random_model(random, 48, 12);
    upb_stream_config config = collecting(cpu);
    upb_model *model;
    size_t bytes;
    add_integers(random, &m, 1 + random_below(random, 16));
    m.edge = rules & 1;
    m.last_row = rules >> 1 & 1;
    m.empty_rule = (uint8_t)(rules >> 2);
    config.precision = precision;
    CHECK_EQUAL(upb_model_load(memory, sizeof memory, file, write_ubm(file, &m, NULL, 0), &model, NULL), UPB_OK);
    if (upb_stream_bytes(model, &config, &bytes, NULL) == UPB_E_CPU)
        return 0;
    open_stream s = open_with(&m, config);
    const segment seg = begin(&m, 48, 0, 0, 0);
    upb_stream_stats stats;
    upb_stream_get_stats(s.stream, &stats);
    CHECK_EQUAL(stats.cpu, cpu);
    CHECK_EQUAL(stats.precision, precision);
    for (unsigned i = 0; i < 150; i++) {
        const firing f = random_firing(random, &m);
        push_firing(&s, i % 48, &f);
    }
    upb_stream_flush(s.stream);
    check_segment(&seg);
    close_stream(&s);
    return 1;
}

/* Every kernel and precision, both edges, last rows and empty rules. */
static void test_kernels_and_rules(random_source *random) {
    unsigned found = 0;
    for (uint32_t cpu = UPB_CPU_SCALAR; cpu <= UPB_CPU_NEON_DOT; cpu++)
        for (uint32_t precision = 0; precision < UPB_PRECISIONS; precision++)
            for (unsigned rules = 0; rules < 8; rules++)
                found += (unsigned)run_kernel(random, cpu, precision, rules);
    CHECK(found >= 8 * UPB_PRECISIONS);
}

static void set_offsets(test_model *m, int32_t reach) {
    for (int k = 0; k < 32; k++)
        m->offset[k] = k % 2 ? reach : -reach;
}

/* A stream of turns, pushed and as frames: the same bits. */
static void compare_frames(random_source *random, uint8_t edge, int32_t reach, uint32_t columns, uint32_t precision) {
    enum { TURNS = 3, PAD = 7 };
    test_model m = random_model(random, columns, 12);
    upb_stream_config config = collecting(UPB_CPU_AUTO);
    add_integers(random, &m, 12);
    config.precision = precision;
    m.edge = edge;
    set_offsets(&m, reach);
    open_stream s = open_with(&m, config);
    upb_stream_stats stats;
    upb_stream_get_stats(s.stream, &stats);
    const unsigned at_end =
        edge == UPB_EDGE_ZERO && stats.delay_columns == 1 ? 0 : stats.delay_columns; /* pending after a turn */
    const uint32_t stride = columns + PAD;
    uint16_t *in_d = calloc(32 * stride, 2), *out_d = calloc(64 * stride, 2);
    uint8_t *in_i = calloc(32 * stride, 1), *out_i = calloc(64 * stride, 1);
    open_stream frames = open_with(&m, config);
    unsigned compared = 0;
    for (unsigned turn = 0; turn <= TURNS; turn++) {
        uint32_t written = 99;
        for (uint32_t c = 0; turn < TURNS && c < columns; c++) {
            const firing f = random_firing(random, &m);
            push_firing(&s, c, &f);
            for (unsigned k = 0; k < 32; k++)
                in_d[k * stride + c] = f.distance[k], in_i[k * stride + c] = f.intensity[k];
        }
        memset(out_d, 0xee, 64 * stride * 2);
        memset(out_i, 0xee, 64 * stride);
        if (turn < TURNS) {
            CHECK_EQUAL(upb_stream_frame(frames.stream, in_d, stride, in_i, stride, out_d, stride, out_i, stride,
                                         columns, &written),
                        UPB_OK);
            CHECK_EQUAL(written, turn ? columns : columns - at_end);
        } else {
            upb_stream_flush(s.stream);
            if (at_end)
                CHECK_EQUAL(upb_stream_frame_end(frames.stream, out_d, stride, out_i, stride, at_end - 1, &written),
                            UPB_E_SIZE);
            CHECK_EQUAL(upb_stream_frame_end(frames.stream, out_d, stride, out_i, stride, at_end, &written), UPB_OK);
            CHECK_EQUAL(written, at_end);
        }
        for (uint32_t c = 0; c < written; c++, compared++)
            for (unsigned row = 0; row < 64; row++) {
                CHECK_EQUAL(out_d[row * stride + c], outputs[compared].distance[row]);
                CHECK_EQUAL(out_i[row * stride + c], outputs[compared].intensity[row]);
            }
        for (unsigned row = 0; row < 64; row++)
            CHECK(out_d[row * stride + written] == 0xeeee && out_i[row * stride + written] == 0xee);
    }
    CHECK_EQUAL(compared, TURNS * columns);
    CHECK_EQUAL(output_count, TURNS * columns); /* the frame call did not call the sink */
    const segment seg = begin(&m, columns, 0, 0, 0);
    check_segment(&seg);
    close_stream(&s);
    close_stream(&frames);
    free(in_d), free(out_d), free(in_i), free(out_i);
}

static void test_frames(random_source *random) {
    for (uint8_t edge = UPB_EDGE_ZERO; edge <= UPB_EDGE_SEAM; edge++) {
        compare_frames(random, edge, 0, 2048, UPB_PRECISION_FP32);
        compare_frames(random, edge, 4200000, 904, UPB_PRECISION_FP32);  /* VLP-32C: +-11 columns */
        compare_frames(random, edge, 9200000, 2048, UPB_PRECISION_FP32); /* HDL-64E: +-52 columns */
        for (uint32_t precision = 0; precision < UPB_PRECISIONS; precision++)
            compare_frames(random, edge, 45000000, 4, precision);
        compare_frames(random, edge, 0, 300, UPB_PRECISION_INT16);
        compare_frames(random, edge, 4200000, 904, UPB_PRECISION_INT8);
    }
}

static void test_frame_errors(random_source *random) {
    static uint16_t d[64 * 32];
    static uint8_t i[64 * 32];
    uint32_t n;
    test_model m = random_model(random, 32, 12);
    open_stream s = open_with(&m, collecting(UPB_CPU_AUTO));
    CHECK_EQUAL(upb_stream_frame(s.stream, d, 31, i, 32, d, 32, i, 32, 32, &n), UPB_E_ARGUMENT);
    CHECK_EQUAL(upb_stream_frame(s.stream, d, 32, i, 31, d, 32, i, 32, 32, &n), UPB_E_ARGUMENT);
    CHECK_EQUAL(upb_stream_frame(s.stream, d, 32, i, 32, d, 31, i, 32, 32, &n), UPB_E_ARGUMENT);
    CHECK_EQUAL(upb_stream_frame(s.stream, d, 32, i, 32, d, 32, i, 31, 32, &n), UPB_E_ARGUMENT);
    CHECK_EQUAL(upb_stream_frame(s.stream, NULL, 32, i, 32, d, 32, i, 32, 32, &n), UPB_E_ARGUMENT);
    CHECK_EQUAL(upb_stream_frame(s.stream, d, 32, i, 32, d, 32, i, 32, 31, &n), UPB_E_SIZE);
    CHECK_EQUAL(upb_stream_frame_end(s.stream, d, 32, i, 32, 0, &n), UPB_OK);
    CHECK_EQUAL(n, 0);
    CHECK_EQUAL(upb_stream_push(s.stream, 5, d, i), UPB_OK); /* inside a turn */
    CHECK_EQUAL(upb_stream_frame(s.stream, d, 32, i, 32, d, 32, i, 32, 32, &n), UPB_E_ARGUMENT);
    CHECK_EQUAL(upb_stream_frame_end(s.stream, d, 32, i, 32, 1, &n), UPB_OK);
    CHECK_EQUAL(n, 1);
    CHECK_EQUAL(output_count, 0);
    close_stream(&s);
}

/* A reset stream does as a new one: outputs, statistics, frame numbers. */
static void test_reset(random_source *random) {
    test_model m = random_model(random, 64, 12);
    set_offsets(&m, 20000000);
    open_stream s = open_with(&m, collecting(UPB_CPU_AUTO));
    upb_stream_stats fresh, again;
    upb_stream_get_stats(s.stream, &fresh);
    for (unsigned i = 0; i < 100; i++) {
        const firing f = random_firing(random, &m);
        push_firing(&s, i % 64, &f);
    }
    CHECK_EQUAL(upb_stream_reset(s.stream), UPB_OK);
    upb_stream_get_stats(s.stream, &again);
    CHECK(memcmp(&fresh, &again, sizeof fresh) == 0);
    firing_count = output_count = 0;
    CHECK_EQUAL(upb_stream_flush(s.stream), UPB_OK);
    for (unsigned i = 17; i < 100; i++) {
        const firing f = random_firing(random, &m);
        push_firing(&s, i % 64, &f);
    }
    upb_stream_flush(s.stream);
    const segment seg = begin(&m, 64, 0, 17, 0);
    check_segment(&seg);
    close_stream(&s);
}

/* A gap of sixteen turns: every column of it comes out, empty. */
static void test_long_gap(random_source *random) {
    test_model m = random_model(random, 200, 12);
    set_offsets(&m, 9200000);
    open_stream s = open_with(&m, collecting(UPB_CPU_AUTO));
    const segment seg = begin(&m, 200, 0, 190, 0);
    const firing f = random_firing(random, &m);
    push_firing(&s, 190, &f);
    CHECK_EQUAL(upb_stream_gap(s.stream, 16 * 200 + 1), UPB_E_ARGUMENT);
    CHECK_EQUAL(upb_stream_gap(s.stream, 16 * 200), UPB_OK);
    insert_missing(16 * 200);
    push_firing(&s, 191, &f);
    upb_stream_flush(s.stream);
    check_segment(&seg);
    close_stream(&s);
}

/* The width of the stream is not the model's: refused, unless told otherwise; offsets follow the stream's width. */
static void test_any_sensor(random_source *random) {
    test_model m = random_model(random, 64, 12);
    set_offsets(&m, 20000000);
    upb_stream_config config = collecting(UPB_CPU_AUTO);
    config.columns = 180;
    config.any_sensor = 1;
    open_stream s = open_with(&m, config);
    const segment seg = begin(&m, 180, 0, 0, 0);
    for (unsigned i = 0; i < 400; i++) {
        const firing f = random_firing(random, &m);
        push_firing(&s, i % 180, &f);
    }
    upb_stream_flush(s.stream);
    check_segment(&seg);
    close_stream(&s);
}

static void expect_refused(const upb_model *model, upb_stream_config config, upb_status status, const char *what) {
    size_t bytes = 0;
    upb_error error = {.status = UPB_OK};
    upb_stream *stream;
    _Alignas(UPB_ALIGN) static unsigned char memory[65536];
    CHECK_EQUAL(upb_stream_bytes(model, &config, &bytes, &error), status);
    CHECK(strcmp(error.what, what) == 0);
    CHECK_EQUAL(upb_stream_init(memory, sizeof memory, model, &config, &stream, NULL), status);
    CHECK(stream == NULL);
}

static void test_config_errors(random_source *random) {
    test_model m = random_model(random, 64, 12);
    open_stream s = open_with(&m, collecting(UPB_CPU_AUTO));
    const upb_stream_config good = collecting(UPB_CPU_AUTO);
    const struct {
        size_t at;
        uint32_t value;
        upb_status status;
        const char *what;
    } wrong[] = {
        {offsetof(upb_stream_config, struct_bytes), 4, UPB_E_ARGUMENT, "struct_bytes"},
        {offsetof(upb_stream_config, precision), 3, UPB_E_ARGUMENT, "precision"},
        {offsetof(upb_stream_config, precision), UPB_PRECISION_INT16, UPB_E_PRECISION, "precision"},
        {offsetof(upb_stream_config, precision), UPB_PRECISION_INT8, UPB_E_PRECISION, "precision"},
        {offsetof(upb_stream_config, cpu), UPB_CPU_NEON_DOT + 1, UPB_E_ARGUMENT, "cpu"},
        {offsetof(upb_stream_config, reorder_columns), 33, UPB_E_ARGUMENT, "reorder_columns"},
        {offsetof(upb_stream_config, distance_unit_um), 4000, UPB_E_SENSOR, "distance_unit_um"},
        {offsetof(upb_stream_config, columns), 3, UPB_E_ARGUMENT, "columns"},
        {offsetof(upb_stream_config, columns), 65536, UPB_E_ARGUMENT, "columns"},
        {offsetof(upb_stream_config, columns), 65, UPB_E_SENSOR, "columns"},
        {offsetof(upb_stream_config, any_sensor), 2, UPB_E_ARGUMENT, "any_sensor"},
        {offsetof(upb_stream_config, aligned), 2, UPB_E_ARGUMENT, "aligned"},
        {offsetof(upb_stream_config, reserved), 1, UPB_E_ARGUMENT, "reserved"},
    };
    for (size_t i = 0; i < sizeof wrong / sizeof wrong[0]; i++) {
        upb_stream_config config = good;
        memcpy((char *)&config + wrong[i].at, &wrong[i].value, 4);
        expect_refused(s.model, config, wrong[i].status, wrong[i].what);
    }
    expect_refused(NULL, good, UPB_E_ARGUMENT, "model");
    upb_stream_config other_cpu = good;
#if defined(__aarch64__)
    other_cpu.cpu = UPB_CPU_AVX2;
#else
    other_cpu.cpu = UPB_CPU_NEON;
#endif
    expect_refused(s.model, other_cpu, UPB_E_CPU, "cpu");
    close_stream(&s);
}

/* A precision that the file does not have is refused, with those that it has. */
static void test_missing_precision(random_source *random) {
    test_model m = random_model(random, 64, 12);
    upb_stream_config config = collecting(UPB_CPU_AUTO);
    upb_error error;
    size_t bytes;
    add_integers(random, &m, 12);
    m.precisions = 1u << UPB_PRECISION_INT8;
    config.precision = UPB_PRECISION_INT8;
    open_stream s = open_with(&m, config);
    config.precision = UPB_PRECISION_INT16;
    CHECK_EQUAL(upb_stream_bytes(s.model, &config, &bytes, &error), UPB_E_PRECISION);
    CHECK_EQUAL(error.got, UPB_PRECISION_INT16);
    CHECK_EQUAL(error.expected, 1u << UPB_PRECISION_FP32 | 1u << UPB_PRECISION_INT8);
    close_stream(&s);
}

/* Sizes are those of the file and of the memory asked for; an integer stream is smaller by half its columns. */
static void test_sizes(random_source *random) {
    static uint8_t file[UBM_MAX];
    test_model m = random_model(random, 2048, 12);
    upb_stream_config config = collecting(UPB_CPU_AUTO);
    uint32_t state[UPB_PRECISIONS];
    add_integers(random, &m, 12);
    set_offsets(&m, 9200000);
    const uint32_t weights[UPB_PRECISIONS] = {2 * 4 * (4 + 9 * 12 + 1), 2 * (28 + 20 * 12), 2 * (28 + 13 * 12)};
    for (uint32_t p = 0; p < UPB_PRECISIONS; p++) {
        upb_sizes sizes;
        size_t bytes;
        config.precision = p;
        open_stream s = open_with(&m, config);
        CHECK_EQUAL(upb_stream_sizes(s.model, &config, &sizes, NULL), UPB_OK);
        CHECK_EQUAL(upb_stream_bytes(s.model, &config, &bytes, NULL), UPB_OK);
        CHECK_EQUAL(sizes.file, write_ubm(file, &m, NULL, 0));
        CHECK_EQUAL(sizes.weights, weights[p]);
        CHECK_EQUAL(sizes.state, bytes);
        CHECK_EQUAL(sizes.ring, (2 * 52 + 1) * (4 + 32 * 3));
        CHECK(sizes.tables > sizes.weights && sizes.tables < upb_model_bytes());
        CHECK_EQUAL(upb_stream_sizes(s.model, &config, NULL, NULL), UPB_E_ARGUMENT);
        CHECK_EQUAL(upb_stream_sizes(NULL, &config, &sizes, NULL), UPB_E_ARGUMENT);
        state[p] = sizes.state;
        config.aligned = 1;
        CHECK_EQUAL(upb_stream_sizes(s.model, &config, &sizes, NULL), UPB_OK);
        CHECK(sizes.ring == 0 && sizes.state == state[p] - (2 * 52 + 1) * 100);
        config.aligned = 0;
        close_stream(&s);
    }
    CHECK_EQUAL(state[UPB_PRECISION_INT16], state[UPB_PRECISION_INT8]);
    CHECK_EQUAL(state[UPB_PRECISION_FP32], state[UPB_PRECISION_INT8]);
}

static void test_arguments(random_source *random) {
    test_model m = random_model(random, 64, 12);
    open_stream s = open_with(&m, collecting(UPB_CPU_AUTO));
    upb_stream_config config = collecting(UPB_CPU_AUTO);
    upb_stream *stream;
    size_t bytes;
    upb_error error;
    upb_stream_stats stats;
    const firing f = random_firing(random, &m);
    upb_stream_bytes(s.model, &config, &bytes, NULL);
    unsigned char *memory = aligned_memory(bytes + 1);
    CHECK_EQUAL(upb_stream_init(memory, bytes - 1, s.model, &config, &stream, &error), UPB_E_SIZE);
    CHECK_EQUAL(error.expected, bytes);
    CHECK_EQUAL(upb_stream_init(memory + 1, bytes, s.model, &config, &stream, NULL), UPB_E_ALIGN);
    CHECK_EQUAL(upb_stream_init(NULL, bytes, s.model, &config, &stream, NULL), UPB_E_ARGUMENT);
    CHECK_EQUAL(upb_stream_init(memory, bytes, s.model, NULL, &stream, NULL), UPB_E_ARGUMENT);
    CHECK_EQUAL(upb_stream_init(memory, bytes, s.model, &config, NULL, NULL), UPB_E_ARGUMENT);
    CHECK_EQUAL(upb_stream_push(s.stream, 64, f.distance, f.intensity), UPB_E_ARGUMENT);
    CHECK_EQUAL(upb_stream_push(s.stream, 0, NULL, f.intensity), UPB_E_ARGUMENT);
    CHECK_EQUAL(upb_stream_push(s.stream, 0, f.distance, NULL), UPB_E_ARGUMENT);
    CHECK_EQUAL(upb_stream_push(NULL, 0, f.distance, f.intensity), UPB_E_ARGUMENT);
    CHECK_EQUAL(upb_stream_gap(NULL, 0), UPB_E_ARGUMENT);
    CHECK_EQUAL(upb_stream_flush(NULL), UPB_E_ARGUMENT);
    CHECK_EQUAL(upb_stream_reset(NULL), UPB_E_ARGUMENT);
    CHECK_EQUAL(upb_stream_get_stats(s.stream, NULL), UPB_E_ARGUMENT);
    upb_stream_get_stats(s.stream, &stats);
    CHECK(stats.columns_in == 0 && stats.columns_late == 0 && stats.state_bytes == bytes && output_count == 0);
    free(memory);
    close_stream(&s);
}

int main(int argc, char **argv) {
    const unsigned long seed = option_number(argc, argv, "--seed", 1);
    const unsigned long count = option_number(argc, argv, "--count", 300);
    random_source random = random_seeded(seed);
    printf("test_stream --seed %lu --count %lu\n", seed, count);
    test_kernels_and_rules(&random);
    test_frames(&random);
    test_frame_errors(&random);
    test_reset(&random);
    test_long_gap(&random);
    test_any_sensor(&random);
    test_config_errors(&random);
    test_missing_precision(&random);
    test_sizes(&random);
    test_arguments(&random);
    for (unsigned long i = 0; i < count; i++) {
        const unsigned long failures = check_failures;
        run_scenario(&random);
        if (check_failures != failures)
            fprintf(stderr, "    in scenario %lu\n", i);
    }
    printf("%u generated returns compared in float, %u in integers\n", generated_returns, contract_returns);
    CHECK(generated_returns > 10000 && contract_returns > 10000);
    return check_report("stream");
}
