/*
 * The column stream: firing columns -> destagger ring -> prepared columns -> windows -> finished columns.
 *
 * Columns are counted in three places that follow each other: the firing column just taken, the azimuth column just
 * completed by it (the ring's delay behind), and the finished column (one behind that, for its right neighbour).
 * A segment is what lies between two edges of the stream: from its start, a reset or a flush to the next one.
 */
#include <string.h>

#include "upb_interleave.h"
#include "upb_internal.h"

#define ALL_BEAMS 0xffffffffu
#define REORDER_COLUMNS 64u /* default: a few packets */
#define GAP_TURNS_MAX 16u

/*
 * The last firing columns, whose beams go to azimuth columns that are not complete: [slots] rows each, aligned to their
 * size, since vectors are read from them.
 */
typedef struct column_ring {
    uint16_t (*distance)[UPB_BEAMS];
    uint8_t (*intensity)[UPB_BEAMS];
    uint32_t *received; /* 0: the column never arrived, and its rows mean nothing */
} column_ring;

enum { RING_COLUMN_BYTES = UPB_BEAMS * (sizeof(uint16_t) + sizeof(uint8_t)) + sizeof(uint32_t) };

/* How azimuth offsets become a ring. */
typedef struct destagger {
    int32_t shift;  /* azimuth column of firing column j: j + shift + (0 at group_age = delay) */
    uint32_t slots; /* firing columns that an azimuth column is made of lie within as many; 1: no ring is needed */
    uint32_t delay; /* firing columns from a column to its last beam */
    /* Beams of the same offset come from the same firing column: */
    uint32_t groups;
    uint32_t group_beams[UPB_BEAMS]; /* bit k: beam k */
    uint16_t group_age[UPB_BEAMS];   /* firing columns before the one that completes the azimuth column */
} destagger;

/* Place of an azimuth column. */
typedef struct place {
    uint64_t frame;
    uint32_t column;
} place;

/* Three that rotate (left, middle, right of the window), and one that stays 0: beyond an edge. */
enum { PREPARED_COLUMNS = 4, EMPTY_COLUMN = 3 };

/* The memory of a stream: this; prepared columns, float or integer; the ring. */
struct upb_stream {
    _Alignas(UPB_ALIGN) uint16_t out_distance[UPB_ROWS];
    uint8_t out_intensity[UPB_ROWS];
    upb_prepare_f32_fn prepare_f32;
    upb_collect_f32_fn collect_f32;
    upb_windows_f32_fn windows_f32;
    upb_prepare_int_fn prepare_int;
    upb_collect_int_fn collect_int;
    upb_windows_int_fn windows_int; /* of the precision */
    const upb_model *model;
    const upb_model_int *integer; /* of the precision; null: float */
    upb_prepared *prepared;       /* [PREPARED_COLUMNS] */
    upb_column_sink sink;
    void *user;
    uint32_t columns;
    uint32_t reorder_columns;
    upb_mode mode; /* of the next finished column */
    upb_stream_stats stats;
    destagger beams;

    /* firing columns of this segment */
    uint32_t started;     /* a firing column was taken */
    uint32_t last_column; /* the last one, inserted ones included */
    uint32_t waiting;     /* firing columns still to come before the segment's first azimuth column is complete */
    uint32_t newest;      /* place in the ring of the next firing column */
    column_ring ring;     /* of beams.slots, nulls if that is 1 */

    /* azimuth columns of this segment */
    place next;     /* the next one to complete */
    uint32_t spare; /* prepared column that the next one goes to */
    const upb_prepared *left, *middle;
    uint32_t pending; /* `middle` waits for its right neighbour, and own_* are its rows */
    uint32_t pending_flags;
    uint16_t own_distance[UPB_BEAMS];
    uint8_t own_intensity[UPB_BEAMS];
    place pending_place;
};

static const uint16_t no_distance[UPB_BEAMS];
static const uint8_t no_intensity[UPB_BEAMS];

/* ------------------------------------------------------------------------------------------- making one */

upb_stream_config upb_stream_config_default(void) {
    upb_stream_config config;
    memset(&config, 0, sizeof config);
    config.struct_bytes = sizeof config;
    config.precision = UPB_PRECISION_FP32;
    config.cpu = UPB_CPU_AUTO;
    return config;
}

int32_t upb_offset_columns(int32_t offset_udeg, uint32_t columns) {
    const int64_t turn_udeg = 360000000;
    const int64_t doubled = 2 * (int64_t)offset_udeg * columns + turn_udeg, divisor = 2 * turn_udeg;
    return (int32_t)(doubled / divisor - (doubled % divisor < 0));
}

static uint32_t columns_of(const upb_model_info *info, const upb_stream_config *config) {
    return config->columns ? config->columns : info->columns;
}

static void add_beam(destagger *plan, unsigned beam, uint16_t age) {
    uint32_t group = 0;
    while (group < plan->groups && plan->group_age[group] != age)
        group++;
    if (group == plan->groups)
        plan->group_age[plan->groups++] = age;
    plan->group_beams[group] |= 1u << beam;
}

/*
 * Offsets that are all of one sign only rename the columns: what they have in common is `shift`, what remains reaches
 * from -delay to slots - 1 - delay around 0.
 */
static destagger plan_destagger(const upb_model_info *info, const upb_stream_config *config) {
    const uint32_t columns = columns_of(info, config);
    destagger plan = {0};
    int32_t offset[UPB_BEAMS], least = INT32_MAX, most = INT32_MIN;
    for (unsigned k = 0; k < UPB_BEAMS; k++) {
        offset[k] = config->aligned ? 0 : upb_offset_columns(info->azimuth_offset_udeg[k], columns);
        least = offset[k] < least ? offset[k] : least;
        most = offset[k] > most ? offset[k] : most;
    }
    plan.shift = least > 0 ? least : most < 0 ? most : 0;
    plan.slots = (uint32_t)(most - least) + 1;
    plan.delay = (uint32_t)(plan.shift - least);
    for (unsigned k = 0; k < UPB_BEAMS; k++)
        add_beam(&plan, k, (uint16_t)(offset[k] - least));
    return plan;
}

static size_t ring_bytes(const destagger *plan) { return plan->slots > 1 ? plan->slots * RING_COLUMN_BYTES : 0; }

static upb_status bad_argument(upb_error *error, const char *what, uint64_t got, uint64_t expected) {
    return upb_fail(error, UPB_E_ARGUMENT, what, 0, got, expected);
}

static upb_status check_sensor(const upb_model_info *info, const upb_stream_config *config, upb_error *error) {
    if (config->columns > UPB_MAX_COLUMNS || (config->columns > 0 && config->columns < 4))
        return bad_argument(error, "columns", config->columns, config->columns < 4 ? 4 : UPB_MAX_COLUMNS);
    if (config->columns && config->columns != info->columns && !config->any_sensor)
        return upb_fail(error, UPB_E_SENSOR, "columns", 0, config->columns, info->columns);
    if (config->distance_unit_um && config->distance_unit_um != info->distance_unit_um)
        return upb_fail(error, UPB_E_SENSOR, "distance_unit_um", 0, config->distance_unit_um, info->distance_unit_um);
    return UPB_OK;
}

static upb_status check_config(const upb_model *model, const upb_stream_config *config, upb_error *error) {
    if (!model || !config)
        return bad_argument(error, model ? "config" : "model", 0, 0);
    if (config->struct_bytes != sizeof *config)
        return bad_argument(error, "struct_bytes", config->struct_bytes, sizeof *config);
    if (config->precision > UPB_PRECISION_INT8)
        return bad_argument(error, "precision", config->precision, UPB_PRECISION_INT8);
    if (config->cpu > UPB_CPU_NEON_DOT)
        return bad_argument(error, "cpu", config->cpu, UPB_CPU_NEON_DOT);
    if (config->any_sensor > 1)
        return bad_argument(error, "any_sensor", config->any_sensor, 1);
    if (config->aligned > 1)
        return bad_argument(error, "aligned", config->aligned, 1);
    for (unsigned i = 0; i < sizeof config->reserved / sizeof config->reserved[0]; i++)
        if (config->reserved[i])
            return bad_argument(error, "reserved", config->reserved[i], 0);
    upb_status status = check_sensor(&model->info, config, error);
    if (status != UPB_OK)
        return status;
    const uint32_t reorder_most = columns_of(&model->info, config) / 2;
    if (config->reorder_columns > reorder_most)
        return bad_argument(error, "reorder_columns", config->reorder_columns, reorder_most);
    if (!upb_model_has(model, config->precision))
        return upb_fail(error, UPB_E_PRECISION, "precision", 0, config->precision, model->info.precisions);
    upb_kernels kernels;
    if (upb_kernels_select(&kernels, (upb_cpu)config->cpu) == UPB_CPU_AUTO)
        return upb_fail(error, UPB_E_CPU, "cpu", 0, config->cpu, upb_kernels_select(&kernels, UPB_CPU_AUTO));
    return UPB_OK;
}

upb_status upb_stream_bytes(const upb_model *model, const upb_stream_config *config, size_t *bytes, upb_error *error) {
    upb_status status = check_config(model, config, error);
    if (status != UPB_OK)
        return status;
    if (!bytes)
        return bad_argument(error, "bytes", 0, 0);
    const destagger plan = plan_destagger(&model->info, config);
    *bytes = sizeof(upb_stream) + PREPARED_COLUMNS * sizeof(upb_prepared) + ring_bytes(&plan);
    return UPB_OK;
}

upb_status upb_stream_sizes(const upb_model *model, const upb_stream_config *config, upb_sizes *sizes,
                            upb_error *error) {
    size_t bytes;
    upb_status status = upb_stream_bytes(model, config, &bytes, error);
    if (status != UPB_OK)
        return status;
    if (!sizes)
        return bad_argument(error, "sizes", 0, 0);
    const destagger plan = plan_destagger(&model->info, config);
    memset(sizes, 0, sizeof *sizes);
    sizes->file = model->info.file_bytes;
    sizes->weights = model->info.weight_bytes[config->precision];
    sizes->tables = config->precision == UPB_PRECISION_FP32 ? sizeof(upb_model_f32) : sizeof(upb_model_int);
    sizes->state = (uint32_t)bytes;
    sizes->ring = (uint32_t)ring_bytes(&plan);
    return UPB_OK;
}

static const upb_prepared *empty_column(const upb_stream *stream) { return &stream->prepared[EMPTY_COLUMN]; }

/* Begins a segment whose columns will be numbered from `frame` on. */
static void begin_segment(upb_stream *stream, uint64_t frame) {
    stream->started = 0;
    stream->waiting = stream->beams.delay;
    stream->newest = 0;
    stream->next.frame = frame;
    stream->pending = 0;
    stream->left = empty_column(stream);
    if (stream->ring.received)
        memset(stream->ring.received, 0, stream->beams.slots * sizeof stream->ring.received[0]);
}

static column_ring place_ring(uint32_t slots, unsigned char *memory) {
    column_ring ring = {0};
    if (slots > 1) {
        ring.distance = (uint16_t(*)[UPB_BEAMS])(void *)memory;
        ring.intensity = (uint8_t(*)[UPB_BEAMS])(ring.distance + slots);
        ring.received = (uint32_t *)(void *)(ring.intensity + slots);
    }
    return ring;
}

static void choose_kernels(upb_stream *s, const upb_stream_config *config) {
    upb_kernels kernels;
    s->stats.cpu = upb_kernels_select(&kernels, (upb_cpu)config->cpu);
    s->prepare_f32 = kernels.prepare_f32;
    s->collect_f32 = kernels.collect_f32;
    s->windows_f32 = kernels.windows_f32;
    s->prepare_int = kernels.prepare_int;
    s->collect_int = kernels.collect_int;
    s->windows_int = config->precision == UPB_PRECISION_INT16 ? kernels.windows_int16 : kernels.windows_int8;
    s->integer = config->precision == UPB_PRECISION_FP32 ? NULL : upb_model_integer(s->model, config->precision);
}

upb_status upb_stream_init(void *memory, size_t memory_bytes, const upb_model *model, const upb_stream_config *config,
                           upb_stream **stream, upb_error *error) {
    size_t bytes;
    if (!stream)
        return bad_argument(error, "stream", 0, 0);
    *stream = NULL;
    upb_status status = upb_stream_bytes(model, config, &bytes, error);
    if (status == UPB_OK)
        status = upb_check_memory(memory, memory_bytes, bytes, error);
    if (status != UPB_OK)
        return status;
    upb_stream *s = memory;
    memset(s, 0, bytes);
    s->model = model;
    s->sink = config->sink;
    s->user = config->user;
    s->columns = columns_of(&model->info, config);
    s->reorder_columns = config->reorder_columns ? config->reorder_columns : REORDER_COLUMNS;
    if (s->reorder_columns > s->columns / 2)
        s->reorder_columns = s->columns / 2;
    s->beams = plan_destagger(&model->info, config);
    s->prepared = (upb_prepared *)(s + 1);
    s->ring = place_ring(s->beams.slots, (unsigned char *)(s->prepared + PREPARED_COLUMNS));
    choose_kernels(s, config);
    s->stats.precision = config->precision;
    s->stats.delay_columns = s->beams.delay + 1;
    s->stats.state_bytes = (uint32_t)bytes;
    begin_segment(s, 0);
    *stream = s;
    return UPB_OK;
}

upb_status upb_stream_reset(upb_stream *stream) {
    if (!stream)
        return UPB_E_ARGUMENT;
    const upb_stream_stats old = stream->stats;
    memset(&stream->stats, 0, sizeof stream->stats);
    stream->stats.delay_columns = old.delay_columns;
    stream->stats.cpu = old.cpu;
    stream->stats.precision = old.precision;
    stream->stats.state_bytes = old.state_bytes;
    begin_segment(stream, 0);
    return UPB_OK;
}

upb_status upb_stream_get_stats(const upb_stream *stream, upb_stream_stats *stats) {
    if (!stream || !stats)
        return UPB_E_ARGUMENT;
    *stats = stream->stats;
    return UPB_OK;
}

upb_status upb_stream_set_mode(upb_stream *stream, upb_mode mode) {
    if (!stream || (uint32_t)mode >= UPB_MODES)
        return UPB_E_ARGUMENT;
    stream->mode = mode;
    return UPB_OK;
}

upb_status upb_stream_checksum(const upb_stream *stream, uint32_t *checksum) {
    if (!stream || !checksum)
        return UPB_E_ARGUMENT;
    /* Field by field: padding has no value. */
    const upb_stream *const s = stream;
    const struct {
        const void *at;
        size_t bytes;
    } parts[] = {{&s->prepare_f32, sizeof s->prepare_f32},
                 {&s->windows_f32, sizeof s->windows_f32},
                 {&s->prepare_int, sizeof s->prepare_int},
                 {&s->windows_int, sizeof s->windows_int},
                 {&s->model, sizeof s->model},
                 {&s->integer, sizeof s->integer},
                 {&s->prepared, sizeof s->prepared},
                 {&s->sink, sizeof s->sink},
                 {&s->user, sizeof s->user},
                 {&s->columns, sizeof s->columns},
                 {&s->ring, sizeof s->ring},
                 {&s->reorder_columns, sizeof s->reorder_columns},
                 {&s->beams, sizeof s->beams}};
    uint32_t crc = 0;
    for (size_t i = 0; i < sizeof parts / sizeof parts[0]; i++)
        crc = upb_crc32(crc, parts[i].at, parts[i].bytes);
    *checksum = crc;
    return UPB_OK;
}

uint32_t *upb_stream_test_constant(upb_stream *stream) { return &stream->reorder_columns; }

/* -------------------------------------------------------------------------------------- azimuth columns */

static void prepare(const upb_stream *s, upb_prepared *prepared, const uint16_t *distance, const uint8_t *intensity) {
    if (s->integer)
        s->prepare_int(prepared, s->integer, distance, intensity);
    else
        s->prepare_f32(prepared, &s->model->f32, distance, intensity);
}

/* The same of a column that is collected to distance and intensity. */
static void prepare_collected(const upb_stream *s, upb_prepared *prepared, const upb_beam_sources *sources,
                              uint16_t *distance, uint8_t *intensity) {
    if (s->integer)
        s->collect_int(prepared, s->integer, sources, distance, intensity);
    else
        s->collect_f32(prepared, &s->model->f32, sources, distance, intensity);
}

static void make_windows(const upb_stream *s, const upb_prepared *right, uint16_t *distance, uint8_t *intensity) {
    if (s->mode != UPB_MODE_NETWORK)
        upb_ladder_column(&s->model->integer[0], s->mode, s->own_distance, s->own_intensity, distance, intensity);
    else if (s->integer)
        s->windows_int(s->integer, s->left, s->middle, right, distance, intensity);
    else
        s->windows_f32(&s->model->f32, s->left, s->middle, right, distance, intensity);
}

/* Finishes the pending column between its neighbours and hands it out. */
static void finish(upb_stream *s, const upb_prepared *right) {
    uint16_t distance[UPB_LANES];
    uint8_t intensity[UPB_LANES];
    make_windows(s, right, distance, intensity);
    interleave_rows(UPB_BEAMS, s->out_distance, s->out_intensity, s->own_distance, s->own_intensity, distance,
                    intensity);
    const int repeat = s->model->info.last_row == UPB_LAST_ROW_REPEAT && s->mode != UPB_MODE_PASS_THROUGH;
    s->out_distance[UPB_ROWS - 1] = repeat ? s->own_distance[UPB_BEAMS - 1] : 0;
    s->out_intensity[UPB_ROWS - 1] = repeat ? s->own_intensity[UPB_BEAMS - 1] : 0;
    s->pending = 0;
    s->stats.columns_out++;
    s->stats.frames_out += (s->pending_flags & UPB_COLUMN_LAST) != 0;
    if (s->sink) {
        const upb_column column = {s->pending_place.frame, s->pending_place.column,
                                   s->pending_flags | (uint32_t)s->mode << UPB_COLUMN_MODE_SHIFT, s->out_distance,
                                   s->out_intensity};
        s->sink(s->user, &column);
    }
}

/* Makes the column just prepared the pending one. Its own rows leave as they came. */
static void keep_pending(upb_stream *s, const upb_prepared *prepared, const uint16_t *distance,
                         const uint8_t *intensity, int complete) {
    memcpy(s->own_distance, distance, sizeof s->own_distance);
    memcpy(s->own_intensity, intensity, sizeof s->own_intensity);
    s->middle = prepared;
    s->pending = 1;
    s->pending_place = s->next;
    s->pending_flags =
        (complete ? 0 : UPB_COLUMN_INCOMPLETE) | (s->next.column + 1 == s->columns ? UPB_COLUMN_LAST : 0);
}

/* Takes the next azimuth column of the segment, which was prepared in the spare place. */
static void take_azimuth_column(upb_stream *s, const uint16_t *distance, const uint8_t *intensity, int complete) {
    upb_prepared *prepared = &s->prepared[s->spare];
    s->spare = s->spare + 1 == EMPTY_COLUMN ? 0 : s->spare + 1;
    if (s->pending) {
        finish(s, prepared);
        s->left = s->middle;
    }
    keep_pending(s, prepared, distance, intensity, complete);
    s->next.column++;
    if (s->next.column == s->columns) {
        s->next.column = 0;
        s->next.frame++;
        if (s->model->info.edge == UPB_EDGE_ZERO) {
            finish(s, empty_column(s));
            s->left = empty_column(s);
        }
    }
}

/* --------------------------------------------------------------------------------------- firing columns */

/* Where the beams of the azimuth column are that the firing column given completes; returns those that arrived. */
static uint32_t find_beams(const upb_stream *s, upb_beam_sources *sources, const uint16_t *distance,
                           const uint8_t *intensity) {
    uint32_t arrived = 0;
    upb_beam_source *source = sources->source;
    sources->count = s->beams.groups;
    for (uint32_t g = 0; g < s->beams.groups; g++) {
        const uint32_t age = s->beams.group_age[g];
        const uint32_t at = s->newest >= age ? s->newest - age : s->newest + s->beams.slots - age;
        source[g].beams = s->ring.received[at] ? s->beams.group_beams[g] : 0;
        source[g].distance = age ? s->ring.distance[at] : distance;
        source[g].intensity = age ? s->ring.intensity[at] : intensity;
        arrived |= source[g].beams;
    }
    return arrived;
}

/* Takes the next firing column, null: it never arrived, and the azimuth column that it completes. */
static void take_ring_column(upb_stream *s, const uint16_t *distance, const uint8_t *intensity) {
    const uint32_t newest = s->newest;
    s->ring.received[newest] = distance != NULL;
    if (s->waiting)
        s->waiting--; /* it completes a column before the segment's first one: outside the stream */
    else {
        _Alignas(UPB_ALIGN) uint16_t collected_distance[UPB_BEAMS];
        _Alignas(UPB_ALIGN) uint8_t collected_intensity[UPB_BEAMS];
        upb_beam_sources sources;
        const uint32_t arrived =
            find_beams(s, &sources, distance ? distance : no_distance, distance ? intensity : no_intensity);
        prepare_collected(s, &s->prepared[s->spare], &sources, collected_distance, collected_intensity);
        take_azimuth_column(s, collected_distance, collected_intensity, arrived == ALL_BEAMS);
    }
    if (distance) {
        memcpy(s->ring.distance[newest], distance, sizeof s->ring.distance[newest]);
        memcpy(s->ring.intensity[newest], intensity, sizeof s->ring.intensity[newest]);
    }
    s->newest = newest + 1 == s->beams.slots ? 0 : newest + 1;
}

/* Takes the firing column that follows the last one; null: it never arrived. */
static void take_firing_column(upb_stream *s, const uint16_t *distance, const uint8_t *intensity) {
    s->last_column = s->last_column + 1 == s->columns ? 0 : s->last_column + 1;
    if (distance)
        s->stats.columns_in++;
    else
        s->stats.columns_missing++;
    if (s->ring.received) {
        take_ring_column(s, distance, intensity);
    } else {
        prepare(s, &s->prepared[s->spare], distance ? distance : no_distance, distance ? intensity : no_intensity);
        take_azimuth_column(s, distance ? distance : no_distance, distance ? intensity : no_intensity,
                            distance != NULL);
    }
}

/* The segment's first firing column will be `column`. */
static void start_segment(upb_stream *s, uint32_t column) {
    const int64_t columns = s->columns;
    s->started = 1;
    s->last_column = column == 0 ? s->columns - 1 : column - 1;
    s->next.column = (uint32_t)(((int64_t)column + s->beams.shift + columns) % columns);
}

upb_status upb_stream_push(upb_stream *stream, uint32_t column, const uint16_t *distance, const uint8_t *intensity) {
    if (!stream || !distance || !intensity || column >= stream->columns)
        return UPB_E_ARGUMENT;
    if (!stream->started)
        start_segment(stream, column);
    else {
        const uint32_t last = stream->last_column, turn = stream->columns;
        const uint32_t behind = last >= column ? last - column : last + turn - column;
        if (behind <= stream->reorder_columns) {
            stream->stats.columns_late++;
            return UPB_E_ORDER;
        }
        for (uint32_t missing = turn - behind - 1; missing; missing--)
            take_firing_column(stream, NULL, NULL);
    }
    take_firing_column(stream, distance, intensity);
    return UPB_OK;
}

upb_status upb_stream_gap(upb_stream *stream, uint32_t columns) {
    if (!stream || columns > GAP_TURNS_MAX * stream->columns)
        return UPB_E_ARGUMENT;
    if (stream->started)
        for (; columns; columns--)
            take_firing_column(stream, NULL, NULL);
    return UPB_OK;
}

upb_status upb_stream_flush(upb_stream *stream) {
    if (!stream)
        return UPB_E_ARGUMENT;
    if (!stream->started)
        return UPB_OK;
    /* Columns up to the last firing column's; those beyond it, begun by beams that look ahead, are outside the stream.
     */
    for (uint32_t i = 0; i < stream->beams.delay; i++)
        take_ring_column(stream, NULL, NULL);
    if (stream->pending)
        finish(stream, empty_column(stream));
    begin_segment(stream, stream->next.column == 0 ? stream->next.frame : stream->next.frame + 1);
    return UPB_OK;
}

/* ----------------------------------------------------------------------------------------- whole frames */

enum { TILE = 32 };

/* Images that finished columns are written to. Columns go through a tile: image rows are far apart in memory. */
typedef struct image_writer {
    uint16_t *distance;
    uint8_t *intensity;
    size_t distance_stride, intensity_stride;
    uint32_t written; /* columns in the image */
    uint32_t tiled;   /* columns in the tile, behind those */
    uint16_t tile_distance[UPB_ROWS][TILE];
    uint8_t tile_intensity[UPB_ROWS][TILE];
} image_writer;

static void write_tile(image_writer *w) {
    for (size_t row = 0; row < UPB_ROWS; row++) {
        memcpy(w->distance + row * w->distance_stride + w->written, w->tile_distance[row], w->tiled * sizeof(uint16_t));
        memcpy(w->intensity + row * w->intensity_stride + w->written, w->tile_intensity[row], w->tiled);
    }
    w->written += w->tiled;
    w->tiled = 0;
}

static void write_column(void *user, const upb_column *column) {
    image_writer *w = user;
    for (unsigned row = 0; row < UPB_ROWS; row++) {
        w->tile_distance[row][w->tiled] = column->distance[row];
        w->tile_intensity[row][w->tiled] = column->intensity[row];
    }
    if (++w->tiled == TILE)
        write_tile(w);
}

/* Swaps the stream's sink for a writer, or back. */
static void swap_sink(upb_stream *s, upb_column_sink *sink, void **user) {
    const upb_column_sink old_sink = s->sink;
    void *const old_user = s->user;
    s->sink = *sink;
    s->user = *user;
    *sink = old_sink;
    *user = old_user;
}

/* Pushes columns 0..columns-1 of an image, tile by tile for the same reason. */
static void push_image(upb_stream *s, const uint16_t *distance, size_t distance_stride, const uint8_t *intensity,
                       size_t intensity_stride) {
    uint16_t tile_distance[TILE][UPB_BEAMS];
    uint8_t tile_intensity[TILE][UPB_BEAMS];
    for (uint32_t first = 0; first < s->columns; first += TILE) {
        const uint32_t width = s->columns - first < TILE ? s->columns - first : TILE;
        for (size_t beam = 0; beam < UPB_BEAMS; beam++)
            for (size_t i = 0; i < width; i++) {
                tile_distance[i][beam] = distance[beam * distance_stride + first + i];
                tile_intensity[i][beam] = intensity[beam * intensity_stride + first + i];
            }
        for (uint32_t i = 0; i < width; i++)
            take_firing_column(s, tile_distance[i], tile_intensity[i]);
    }
}

upb_status upb_stream_frame(upb_stream *stream, const uint16_t *distance, size_t distance_stride,
                            const uint8_t *intensity, size_t intensity_stride, uint16_t *out_distance,
                            size_t out_distance_stride, uint8_t *out_intensity, size_t out_intensity_stride,
                            uint32_t out_capacity, uint32_t *out_columns) {
    if (!stream || !distance || !intensity || !out_distance || !out_intensity || !out_columns)
        return UPB_E_ARGUMENT;
    *out_columns = 0;
    if (distance_stride < stream->columns || intensity_stride < stream->columns || out_distance_stride < out_capacity ||
        out_intensity_stride < out_capacity || (stream->started && stream->last_column + 1 != stream->columns))
        return UPB_E_ARGUMENT;
    /* As many columns are pending after a frame as before it, or more. */
    if (out_capacity < stream->columns)
        return UPB_E_SIZE;
    image_writer writer = {.distance = out_distance,
                           .intensity = out_intensity,
                           .distance_stride = out_distance_stride,
                           .intensity_stride = out_intensity_stride};
    upb_column_sink sink = write_column;
    void *user = &writer;
    if (!stream->started)
        start_segment(stream, 0);
    swap_sink(stream, &sink, &user);
    push_image(stream, distance, distance_stride, intensity, intensity_stride);
    swap_sink(stream, &sink, &user);
    write_tile(&writer);
    *out_columns = writer.written;
    return UPB_OK;
}

upb_status upb_stream_frame_end(upb_stream *stream, uint16_t *out_distance, size_t out_distance_stride,
                                uint8_t *out_intensity, size_t out_intensity_stride, uint32_t out_capacity,
                                uint32_t *out_columns) {
    if (!stream || !out_distance || !out_intensity || !out_columns)
        return UPB_E_ARGUMENT;
    *out_columns = 0;
    if (out_distance_stride < out_capacity || out_intensity_stride < out_capacity)
        return UPB_E_ARGUMENT;
    if (stream->started && out_capacity < stream->beams.delay - stream->waiting + stream->pending)
        return UPB_E_SIZE;
    image_writer writer = {.distance = out_distance,
                           .intensity = out_intensity,
                           .distance_stride = out_distance_stride,
                           .intensity_stride = out_intensity_stride};
    upb_column_sink sink = write_column;
    void *user = &writer;
    swap_sink(stream, &sink, &user);
    const upb_status status = upb_stream_flush(stream);
    swap_sink(stream, &sink, &user);
    write_tile(&writer);
    *out_columns = writer.written;
    return status;
}
