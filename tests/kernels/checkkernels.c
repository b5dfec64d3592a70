/*
 * Every window kernel of this machine against the plain C one, on random and extreme columns; with --bench the very
 * same calls are timed. Integer kernels: see integer.h. Options: --seed N, --rounds N (models to check), --model
 * FILE.ubm (a trained one), --bench, --require NAME (an instruction set that must be there).
 *
 * All kernels that a machine with fused products chooses, the scalar one included, agree to the bit. What may differ is
 * plain C on a machine without them: it rounds twice where the others round once. So raw outputs agree within 1e-5 of
 * the sum of the magnitudes that they are made of, and a count may flip where the output lies that near a threshold.
 * With a trained model on scenes (smooth surfaces) the outputs agree within SCENE_TOLERANCE counts and at most 300
 * windows of a million differ by a count (100 measured: twice the probability of the error, 5e-5 counts).
 */
#define _POSIX_C_SOURCE 199309L
#include <math.h>
#include <time.h>

#include "check.h"
#include "columns.h"
#include "upb_internal.h"

static const char *const cpu_names[] = {"auto", "c", "avx2", "avx512", "neon", "vnni", "dot"};
enum { LAST_CPU = UPB_CPU_NEON_DOT };

#include "integer.h"

#define TOLERANCE 1e-5
#define SCENE_TOLERANCE 0.01

typedef struct result {
    float raw[2][UPB_LANES];
    uint16_t distance[UPB_LANES];
    uint8_t intensity[UPB_LANES];
} result;

/* What is compared, for a failure's message. */
typedef struct parameters {
    const char *cpu_name, *pattern;
    unsigned long seed;
    unsigned round;
    int scene;
    const upb_model_f32 *model;
} parameters;

/* Of everything, and of the trained model on scenes. */
static struct {
    unsigned long long windows, flips;
} all, scenes;

/* ------------------------------------------------------------------------------------------------ inputs */

static void random_network(random_source *random, upb_network_f32 *net, uint32_t hidden, float in_unit,
                           float out_unit) {
    memset(net, 0, sizeof *net);
    net->hidden = hidden;
    net->positive = random_below(random, 2);
    net->slope = random_below(random, 4) ? 0.01f : (float)random_below(random, 2);
    net->skip = random_below(random, 3) ? 1.0f : 0.0f;
    net->offset = out_unit * random_signed(random);
    for (uint32_t h = 0; h < hidden; h++) {
        for (int i = 0; i < UPB_TAPS; i++)
            net->unit[h][i] = in_unit * random_signed(random);
        net->unit[h][UPB_UNIT_BIAS] = random_signed(random);
        net->unit[h][UPB_UNIT_OUTPUT] = out_unit * random_signed(random) / (float)hidden;
    }
}

/* The outputs of a wild model are far outside what counts can hold. */
static void random_model_f32(random_source *random, upb_model_f32 *model, uint32_t hidden, int is_wild) {
    const float wild = is_wild ? 1e9f : 1.0f;
    random_network(random, &model->network[UPB_DISTANCE], hidden, 0.002f, 500.0f * wild);
    random_network(random, &model->network[UPB_INTENSITY], 1 + random_below(random, UPB_MAX_HIDDEN), 0.05f,
                   20.0f * wild);
    const uint32_t low = 1 + random_below(random, 3000), high = low + random_below(random, 65536 - low);
    model->min_count = (float)low;
    for (unsigned k = 0; k < UPB_LANES; k++) {
        model->seen_max[k] =
            random_below(random, 2) ? (float)high : (float)(low + random_below(random, high - low + 1));
        model->given_max[k] =
            random_below(random, 2) ? (float)high : (float)(low + random_below(random, high - low + 1));
    }
    model->seen_max[31] = (float)high;
    model->fill = random_below(random, 2);
}

static void pattern_columns(random_source *random, const unsigned pattern[3], const upb_model_f32 *model,
                            raw_column column[3]) {
    for (int c = 0; c < 3; c++)
        pattern_column(random, pattern[c], (uint32_t)model->min_count, (uint32_t)model->seen_max[31], &column[c]);
}

/* -------------------------------------------------------------------------------------------- comparison */

static void run(const upb_kernels *kernels, const upb_model_f32 *model, const raw_column column[3], result *out) {
    upb_prepared_f32 prepared[3];
    for (int c = 0; c < 3; c++)
        kernels->prepare_f32(&prepared[c], model, column[c].distance, column[c].intensity);
    kernels->windows_f32(model, &prepared[0], &prepared[1], &prepared[2], out->distance, out->intensity);
    kernels->raw_f32(model, &prepared[0], &prepared[1], &prepared[2], out->raw[0], out->raw[1]);
}

/* The sum of the magnitudes that an output is made of: at most this much times 65535 for each tap. */
static double magnitude(const upb_network_f32 *net, const float x[UPB_TAPS]) {
    double sum = fabs((double)net->offset) + fabs((double)net->skip * x[6]);
    for (uint32_t h = 0; h < net->hidden; h++) {
        double inner = fabs((double)net->unit[h][UPB_UNIT_BIAS]);
        for (int i = 0; i < UPB_TAPS; i++)
            inner += fabs((double)net->unit[h][i] * x[i]);
        sum += fabs((double)net->unit[h][UPB_UNIT_OUTPUT]) * inner;
    }
    return sum;
}

/* An upper bound of each tap's magnitude in window k: the largest value near it, wherever the fill took it from. */
static void bound_taps(const raw_column column[3], int which, unsigned k, float x[UPB_TAPS]) {
    float most = 0;
    for (int c = 0; c < 3; c++)
        for (unsigned beam = k; beam < k + 2; beam++) {
            float value = which == UPB_DISTANCE ? column[c].distance[beam] : column[c].intensity[beam];
            most = value > most ? value : most;
        }
    for (int i = 0; i < UPB_TAPS; i++)
        x[i] = most;
}

static void complain(const parameters *p, const char *what, unsigned k, double got, double expected) {
    if (check_failures > 20)
        return;
    fprintf(stderr, "    %s, lane %u: got %.9g, expected %.9g\n", what, k, got, expected);
    fprintf(stderr, "    kernel %s, --seed %lu, round %u, columns %s, hidden %u and %u, limits %g..%g, fill %u\n",
            p->cpu_name, p->seed, p->round, p->pattern, p->model->network[0].hidden, p->model->network[1].hidden,
            (double)p->model->min_count, (double)p->model->seen_max[31], p->model->fill);
}

/* Is an integer + 1/2, where floor(y + 0.5) jumps, within the tolerance of y? */
static int at_threshold(double y, double tolerance) {
    const double from_half = fabs(y - 0.5 - floor(y - 0.5 + 0.5));
    /* y + 0.5 is itself rounded to a float */
    return from_half <= tolerance + fabs(y) * 1.2e-7 + 6e-8;
}

static void compare_lane(const parameters *p, const raw_column column[3], const result *got, const result *expected,
                         unsigned k) {
    double tolerance[2];
    for (int n = 0; n < 2; n++) {
        float x[UPB_TAPS];
        bound_taps(column, n, k, x);
        tolerance[n] = p->scene ? SCENE_TOLERANCE : TOLERANCE * magnitude(&p->model->network[n], x);
        if (!CHECK(fabs((double)got->raw[n][k] - (double)expected->raw[n][k]) <= tolerance[n]))
            complain(p, n ? "raw intensity" : "raw distance", k, (double)got->raw[n][k], (double)expected->raw[n][k]);
    }
    const int same = got->distance[k] == expected->distance[k] && got->intensity[k] == expected->intensity[k];
    all.windows++;
    all.flips += !same;
    scenes.windows += p->scene ? 1u : 0u;
    scenes.flips += p->scene && !same ? 1u : 0u;
    if (same)
        return;
    const int distance_ok =
        got->distance[k] == expected->distance[k] || at_threshold((double)expected->raw[0][k], tolerance[0]);
    /* An intensity follows its distance into and out of "no return". */
    const int validity_flip = (got->distance[k] == 0) != (expected->distance[k] == 0);
    const int intensity_ok = got->intensity[k] == expected->intensity[k] || validity_flip ||
                             at_threshold((double)expected->raw[1][k], tolerance[1]);
    if (!CHECK(distance_ok))
        complain(p, "distance", k, got->distance[k], expected->distance[k]);
    if (!CHECK(intensity_ok))
        complain(p, "intensity", k, got->intensity[k], expected->intensity[k]);
}

static int same_lane(const result *a, const result *b, unsigned k) {
    return a->raw[0][k] == b->raw[0][k] && a->raw[1][k] == b->raw[1][k] && a->distance[k] == b->distance[k] &&
           a->intensity[k] == b->intensity[k];
}

/* Every kernel of this machine on the same three columns. */
static void compare_kernels(parameters *p, const raw_column column[3]) {
    result expected, chosen = {.distance = {0}};
    const char *chosen_name = NULL;
    upb_kernels kernels;
    upb_kernels_fill_c(&kernels);
    run(&kernels, p->model, column, &expected);
    for (int cpu = UPB_CPU_SCALAR; cpu <= LAST_CPU; cpu++) {
        result got;
        if (upb_kernels_select(&kernels, (upb_cpu)cpu) != (upb_cpu)cpu)
            continue;
        run(&kernels, p->model, column, &got);
        p->cpu_name = cpu_names[cpu];
        for (unsigned k = 0; k < UPB_WINDOWS; k++) {
            compare_lane(p, column, &got, &expected, k);
            if (chosen_name && !CHECK(same_lane(&got, &chosen, k)))
                complain(p, chosen_name, k, (double)got.raw[0][k], (double)chosen.raw[0][k]);
        }
        chosen = got;
        chosen_name = cpu_names[cpu];
    }
}

/* A random model: every pattern in the middle beside every pattern on its left, and any one on its right. */
static void check_round(parameters *p, random_source *random) {
    static upb_model_f32 model;
    random_model_f32(random, &model, 1 + p->round / 2 % UPB_MAX_HIDDEN, p->round % 4 == 3);
    p->model = &model;
    p->scene = 0;
    for (unsigned i = 0; i < 3 * PATTERNS * PATTERNS; i++) {
        raw_column column[3];
        const unsigned pattern[3] = {i / PATTERNS % PATTERNS, i % PATTERNS, random_below(random, PATTERNS)};
        pattern_columns(random, pattern, &model, column);
        p->pattern = patterns[pattern[1]];
        compare_kernels(p, column);
    }
}

static void check_scenes(parameters *p, random_source *random, const upb_model_f32 *model) {
    p->model = model;
    p->scene = 1;
    p->pattern = patterns[SCENE];
    for (unsigned i = 0; i < 20000; i++) {
        raw_column column[3];
        pattern_columns(random, (const unsigned[3]){SCENE, SCENE, SCENE}, model, column);
        compare_kernels(p, column);
    }
    printf("%llu windows of scenes compared, %llu flips at thresholds\n", scenes.windows, scenes.flips);
    CHECK(scenes.flips * 1000000 <= scenes.windows * 300);
}

/* --------------------------------------------------------------------------------------- known answers */

/* One kernel against values worked out by hand: y is the sum of the taps, weighted by powers of ten. */
static void check_by_hand(const upb_kernels *kernels) {
    static upb_model_f32 model;
    memset(&model, 0, sizeof model);
    for (int n = 0; n < 2; n++) {
        model.network[n].hidden = 1;
        model.network[n].unit[0][UPB_UNIT_OUTPUT] = 1.0f;
    }
    model.min_count = 2;
    for (unsigned k = 0; k < UPB_LANES; k++)
        model.seen_max[k] = model.given_max[k] = 60000;
    model.fill = 1;
    const float weights[UPB_TAPS] = {1, 10, 100, 1000, 10000, 0, 11111}; /* of differences: pixels count 1..10000 */
    memcpy(model.network[0].unit[0], weights, sizeof weights);
    model.network[1].offset = -3;
    model.network[1].skip = 1;
    raw_column column[3];
    memset(column, 0, sizeof column);
    column[0].distance[0] = 2, column[1].distance[0] = 3, column[2].distance[0] = 4; /* beam 0: 2 3 4 */
    column[0].distance[1] = 5, column[1].distance[1] = 1, column[2].distance[1] = 3; /* beam 1: 5 - 3, 1 is too near */
    column[0].intensity[0] = 9, column[1].intensity[0] = 8, column[2].intensity[0] = 7;
    column[0].intensity[1] = 10, column[1].intensity[1] = 1, column[2].intensity[1] = 11;
    column[0].distance[3] = 4, column[2].distance[3] = 2; /* windows 2 and 3: the middle column is empty */
    result out;
    run(kernels, &model, column, &out);
    CHECK_EQUAL(out.raw[0][0], 2 + 30 + 400 + 5000 + 30000);
    CHECK_EQUAL(out.distance[0], 35432);
    CHECK_EQUAL(out.intensity[0], 7 - 3);
    CHECK_EQUAL(out.raw[0][2], 4 + 20 + 200 + 4000 + 20000); /* both rows 4 2 2 */
    CHECK_EQUAL(out.raw[0][1], 5 + 30 + 300 + 5000 + 30000); /* beam 1 alone: 5 3 3 */
    CHECK_EQUAL(out.distance[5], 0);
    CHECK_EQUAL(out.intensity[2], 0);
    model.fill = 0;
    run(kernels, &model, column, &out);
    CHECK_EQUAL(out.raw[0][0], 2 + 30 + 400 + 5000);
    CHECK_EQUAL(out.raw[0][2], 4000);
    CHECK_EQUAL(out.raw[0][3], 4 + 200);
}

/* ------------------------------------------------------------------------------------------- collecting */

/* What collecting gives, and preparing what is collected. */
typedef struct collected {
    upb_prepared prepared;
    raw_column column;
} collected;

static void compare_collected(const collected *got, const raw_column *column, const upb_prepared *expected) {
    CHECK(!memcmp(got->column.distance, column->distance, sizeof column->distance));
    CHECK(!memcmp(got->column.intensity, column->intensity, sizeof column->intensity));
    CHECK(!memcmp(got->prepared.row, expected->row, sizeof expected->row));
}

/* Beams of a few columns or many, and some of none; random models, whose limits cut some. */
static void check_collect(const upb_kernels *kernels, random_source *random) {
    static upb_model_f32 f32;
    static int_model integer;
    random_model_f32(random, &f32, 1, 0);
    random_int_model(random, &integer, UPB_PRECISION_INT8, 1, 0);
    raw_column from[UPB_BEAMS], column;
    for (unsigned i = 0; i < UPB_BEAMS; i++)
        pattern_column(random, i % PATTERNS, 1, 65535, &from[i]);
    for (unsigned round = 0; round < 200; round++) {
        upb_beam_sources sources = {.count = random_below(random, UPB_BEAMS + 1)};
        const uint32_t owners = sources.count + 1 + random_below(random, 3);
        memset(&column, 0, sizeof column);
        for (uint32_t i = 0; i < sources.count; i++)
            sources.source[i] = (upb_beam_source){from[i].distance, from[i].intensity, 0};
        for (unsigned k = 0; k < UPB_BEAMS; k++) {
            const uint32_t owner = random_below(random, owners);
            if (owner >= sources.count)
                continue;
            sources.source[owner].beams |= 1u << k;
            column.distance[k] = from[owner].distance[k];
            column.intensity[k] = from[owner].intensity[k];
        }
        upb_prepared expected;
        collected got;
        kernels->prepare_f32(&expected, &f32, column.distance, column.intensity);
        kernels->collect_f32(&got.prepared, &f32, &sources, got.column.distance, got.column.intensity);
        compare_collected(&got, &column, &expected);
        kernels->prepare_int(&expected, &integer.ready, column.distance, column.intensity);
        kernels->collect_int(&got.prepared, &integer.ready, &sources, got.column.distance, got.column.intensity);
        compare_collected(&got, &column, &expected);
    }
}

/* --------------------------------------------------------------------------------------------- benchmark */

static double seconds_now(void) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (double)now.tv_sec + 1e-9 * (double)now.tv_nsec;
}

static int compare_doubles(const void *a, const void *b) {
    const double x = *(const double *)a, y = *(const double *)b;
    return (x > y) - (x < y);
}

enum { BENCH_COLUMNS = 2048, BENCH_RUNS = 51, BENCH_HIDDEN = 12 };

/* Models to time: trained where the file has the precision, else random ones of BENCH_HIDDEN units. */
typedef struct bench_models {
    upb_model_f32 f32;
    upb_model_int integer[2];
} bench_models;

static const char *const precision_names[] = {"float", "int16", "int8"};

/* Seconds for BENCH_COLUMNS columns: preparing each, and both networks on its windows. */
static double time_f32(const upb_kernels *kernels, const upb_model_f32 *model, const raw_column *columns) {
    static upb_prepared_f32 prepared[3];
    static uint16_t distance[BENCH_COLUMNS][UPB_LANES];
    static uint8_t intensity[BENCH_COLUMNS][UPB_LANES];
    const double start = seconds_now();
    for (unsigned c = 0; c < BENCH_COLUMNS; c++) {
        kernels->prepare_f32(&prepared[c % 3], model, columns[c].distance, columns[c].intensity);
        kernels->windows_f32(model, &prepared[(c + 1) % 3], &prepared[(c + 2) % 3], &prepared[c % 3], distance[c],
                             intensity[c]);
    }
    return seconds_now() - start;
}

static double time_int(const upb_kernels *kernels, upb_windows_int_fn windows, const upb_model_int *model,
                       const raw_column *columns) {
    static upb_prepared_int prepared[3];
    static uint16_t distance[BENCH_COLUMNS][UPB_LANES];
    static uint8_t intensity[BENCH_COLUMNS][UPB_LANES];
    const double start = seconds_now();
    for (unsigned c = 0; c < BENCH_COLUMNS; c++) {
        kernels->prepare_int(&prepared[c % 3], model, columns[c].distance, columns[c].intensity);
        windows(model, &prepared[(c + 1) % 3], &prepared[(c + 2) % 3], &prepared[c % 3], distance[c], intensity[c]);
    }
    return seconds_now() - start;
}

/* Prints the least and the median of BENCH_RUNS; returns the median. */
static double report(const char *cpu_name, const char *what, const char *precision, double *seconds) {
    qsort(seconds, BENCH_RUNS, sizeof seconds[0], compare_doubles);
    const double least = seconds[0], median = seconds[BENCH_RUNS / 2];
    printf("%-7s %-7s %-6s %8.1f %8.1f ns per column, %7.3f %7.3f ms per image of %d columns (min, median; measured)\n",
           cpu_name, what, precision, least / BENCH_COLUMNS * 1e9, median / BENCH_COLUMNS * 1e9, least * 1e3,
           median * 1e3, BENCH_COLUMNS);
    return median;
}

static uint32_t column_sum;

static void use_column(void *user, const upb_column *column) {
    (void)user;
    column_sum += column->distance[1];
}

/* Seconds of each push, sorted: from a column's counts to the finished column before it, in the sink. */
static void report_latency(const char *cpu_name, const char *precision, double *seconds) {
    const size_t pushes = (size_t)BENCH_RUNS * BENCH_COLUMNS;
    qsort(seconds, pushes, sizeof seconds[0], compare_doubles);
    printf("%-7s latency %-6s %8.1f %8.1f %8.1f ns for a push (p50, p99.9, max of %zu; measured, reading the clock "
           "included)\n",
           cpu_name, precision, seconds[pushes / 2] * 1e9, seconds[pushes - pushes / 1000] * 1e9,
           seconds[pushes - 1] * 1e9, pushes);
}

/* The whole step of a stream: destagger ring, both networks, interleaving, sink; and the same as whole frames. */
static void bench_stream(upb_cpu cpu, upb_precision precision, const upb_model *model, const raw_column *columns) {
    static _Alignas(UPB_ALIGN) unsigned char memory[1 << 18];
    static uint16_t in_d[UPB_BEAMS][BENCH_COLUMNS], out_d[UPB_ROWS][BENCH_COLUMNS];
    static uint8_t in_i[UPB_BEAMS][BENCH_COLUMNS], out_i[UPB_ROWS][BENCH_COLUMNS];
    static double push[BENCH_RUNS * BENCH_COLUMNS];
    double pushed[BENCH_RUNS], framed[BENCH_RUNS];
    uint32_t written;
    upb_stream *stream;
    upb_stream_config config = upb_stream_config_default();
    config.cpu = cpu;
    config.precision = precision;
    config.columns = BENCH_COLUMNS;
    config.any_sensor = 1;
    config.sink = use_column;
    if (!CHECK(upb_stream_init(memory, sizeof memory, model, &config, &stream, NULL) == UPB_OK))
        return;
    for (unsigned c = 0; c < BENCH_COLUMNS; c++)
        for (unsigned k = 0; k < UPB_BEAMS; k++)
            in_d[k][c] = columns[c].distance[k], in_i[k][c] = columns[c].intensity[k];
    for (unsigned i = 0; i < BENCH_RUNS; i++) {
        double start = seconds_now();
        for (unsigned c = 0; c < BENCH_COLUMNS; c++)
            upb_stream_push(stream, c, columns[c].distance, columns[c].intensity);
        pushed[i] = seconds_now() - start;
        start = seconds_now();
        upb_stream_frame(stream, in_d[0], BENCH_COLUMNS, in_i[0], BENCH_COLUMNS, out_d[0], BENCH_COLUMNS, out_i[0],
                         BENCH_COLUMNS, BENCH_COLUMNS, &written);
        framed[i] = seconds_now() - start;
    }
    for (unsigned i = 0; i < BENCH_RUNS; i++)
        for (unsigned c = 0; c < BENCH_COLUMNS; c++) {
            const double start = seconds_now();
            upb_stream_push(stream, c, columns[c].distance, columns[c].intensity);
            push[i * BENCH_COLUMNS + c] = seconds_now() - start;
        }
    upb_stream_stats stats;
    upb_stream_get_stats(stream, &stats);
    CHECK(stats.columns_late == 0 && stats.columns_missing == 0 && written == BENCH_COLUMNS);
    report(cpu_names[cpu], "push", precision_names[precision], pushed);
    report(cpu_names[cpu], "frame", precision_names[precision], framed);
    report_latency(cpu_names[cpu], precision_names[precision], push);
}

static void choose_models(bench_models *models, const upb_model *trained, random_source *random) {
    static int_model made;
    random_model_f32(random, &models->f32, BENCH_HIDDEN, 0);
    models->f32.network[UPB_INTENSITY].hidden = BENCH_HIDDEN;
    models->f32.fill = 1;
    if (trained)
        models->f32 = trained->f32;
    for (int i = 0; i < 2; i++) {
        const upb_precision precision = i ? UPB_PRECISION_INT8 : UPB_PRECISION_INT16;
        if (trained && upb_model_has(trained, precision)) {
            models->integer[i] = *upb_model_integer(trained, precision);
            continue;
        }
        random_int_model(random, &made, precision, BENCH_HIDDEN, 1);
        models->integer[i] = made.ready;
        models->integer[i].fill = 1;
        for (int which = 0; which < 2; which++) {
            models->integer[i].network[which].hidden = BENCH_HIDDEN;
            models->integer[i].network[which].slope = 328;
        }
    }
}

/* All precisions of one instruction set by turns, and with a trained model the streams that it can feed. */
static void bench(upb_cpu cpu, const bench_models *models, const upb_model *trained, random_source *random) {
    static raw_column columns[BENCH_COLUMNS];
    double seconds[UPB_PRECISIONS][BENCH_RUNS], median[UPB_PRECISIONS];
    upb_kernels kernels;
    if (upb_kernels_select(&kernels, cpu) != cpu)
        return;
    for (unsigned c = 0; c < BENCH_COLUMNS; c++)
        pattern_column(random, c % 2, (uint32_t)models->f32.min_count, (uint32_t)models->f32.seen_max[31], &columns[c]);
    for (unsigned i = 0; i < BENCH_RUNS; i++) {
        seconds[0][i] = time_f32(&kernels, &models->f32, columns);
        seconds[1][i] = time_int(&kernels, kernels.windows_int16, &models->integer[0], columns);
        seconds[2][i] = time_int(&kernels, kernels.windows_int8, &models->integer[1], columns);
    }
    for (unsigned p = 0; p < UPB_PRECISIONS; p++)
        median[p] = report(cpu_names[cpu], "kernel", precision_names[p], seconds[p]);
    printf("%-7s float takes %.2f times as long as int16, %.2f times as long as int8\n", cpu_names[cpu],
           median[0] / median[1], median[0] / median[2]);
    for (unsigned p = 0; trained && p < UPB_PRECISIONS; p++)
        if (upb_model_has(trained, p))
            bench_stream(cpu, (upb_precision)p, trained, columns);
}

static const upb_model *load(const char *path) {
    static _Alignas(UPB_ALIGN) unsigned char memory[UPB_MODEL_BYTES_MAX];
    static unsigned char file[1 << 20];
    upb_model *model;
    upb_error error;
    FILE *stream = fopen(path, "rb");
    const size_t bytes = stream ? fread(file, 1, sizeof file, stream) : 0;
    if (stream)
        fclose(stream);
    if (upb_model_load(memory, sizeof memory, file, bytes, &model, &error) != UPB_OK) {
        fprintf(stderr, "%s: %s (%s)\n", path, upb_status_text(error.status), error.what);
        exit(2);
    }
    return model;
}

/* Known answers, collected columns and, if asked for, times of every instruction set. `required`: the name of one that
 * must be there. */
static void visit_cpus(const upb_model *model, int is_bench, const char *required, random_source random) {
    static bench_models models;
    choose_models(&models, model, &random);
    for (int cpu = UPB_CPU_SCALAR; cpu <= LAST_CPU; cpu++) {
        upb_kernels kernels;
        if (upb_kernels_select(&kernels, (upb_cpu)cpu) != (upb_cpu)cpu) {
            CHECK(cpu != UPB_CPU_SCALAR && (!required || strcmp(cpu_names[cpu], required)));
            printf("%-7s not on this machine or not in this build\n", cpu_names[cpu]);
            continue;
        }
        check_by_hand(&kernels);
        check_collect(&kernels, &random);
        if (is_bench)
            bench((upb_cpu)cpu, &models, model, &random);
    }
}

int main(int argc, char **argv) {
    parameters p = {.seed = option_number(argc, argv, "--seed", (unsigned long)time(NULL))};
    const unsigned rounds = (unsigned)option_number(argc, argv, "--rounds", 2 * UPB_MAX_HIDDEN);
    const char *path = option_text(argc, argv, "--model");
    const upb_model *model = path ? load(path) : NULL;
    random_source random = random_seeded(p.seed);
    printf("checkkernels --seed %lu --rounds %u\n", p.seed, rounds);
    visit_cpus(model, option_given(argc, argv, "--bench"), option_text(argc, argv, "--require"), random);
    for (p.round = 0; p.round < rounds; p.round++)
        check_round(&p, &random);
    printf("%llu windows compared, %llu flips at thresholds\n", all.windows, all.flips);
    check_integers(p.seed, rounds, &random);
    if (model)
        check_scenes(&p, &random, &model->f32);
    else
        printf("no --model: scenes not compared\n");
    return check_report("checkkernels");
}
