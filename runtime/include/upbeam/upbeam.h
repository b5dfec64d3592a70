/*
 * upbeam: columns of a 32-beam LiDAR in, columns of 64 rows out.
 *
 * The library holds no state of its own: no heap, no threads, no I/O, no globals. The caller gives all memory, and
 * keeps it. Objects are opaque and live in memory whose size a getter tells. Nothing is freed: to end, forget the
 * memory. Calls on different objects may run on different threads; calls on one object may not run at the same time.
 *
 * Usage:
 *     static _Alignas(UPB_ALIGN) unsigned char model_memory[UPB_MODEL_BYTES_MAX];
 *     static _Alignas(UPB_ALIGN) unsigned char stream_memory[65536];
 *     upb_model *model;
 *     upb_stream *stream;
 *     upb_stream_config config = upb_stream_config_default();
 *     config.sink = on_column;                      // called with every finished column of 64 rows
 *     if (upb_model_load(model_memory, sizeof model_memory, ubm, ubm_bytes, &model, NULL) != UPB_OK) ...
 *     if (upb_stream_init(stream_memory, sizeof stream_memory, model, &config, &stream, NULL) != UPB_OK) ...
 *     for (;;) upb_stream_push(stream, column, distance, intensity);   // 32 counts, 32 intensities
 *
 * Units: a distance is the sensor's own unsigned 16-bit count (the model tells its size, 2 or 4 mm); 0 is "no return".
 * An intensity is 0..255. Beam 0 is the top one. Azimuth is clockwise seen from above; column 0 begins at the model's
 * cut. Even output rows are the sensor's, to the bit; odd rows are generated (upb_row_is_generated).
 */
#ifndef UPBEAM_UPBEAM_H
#define UPBEAM_UPBEAM_H

#include <stddef.h>
#include <stdint.h>

#if defined(_WIN32) && defined(UPB_SHARED)
#ifdef UPB_BUILDING
#define UPB_API __declspec(dllexport)
#else
#define UPB_API __declspec(dllimport)
#endif
#elif defined(__GNUC__) && defined(UPB_BUILDING)
#define UPB_API __attribute__((visibility("default")))
#else
#define UPB_API
#endif

#ifdef __cplusplus
extern "C" {
#endif

/* Raised when a caller must be recompiled. upb_api_version() tells what the library was built with. */
#define UPB_API_VERSION 1u

#define UPB_BEAMS 32u      /* beams of an input column */
#define UPB_ROWS 64u       /* rows of an output column */
#define UPB_WINDOWS 31u    /* windows of a column: pairs of neighbouring beams */
#define UPB_MAX_HIDDEN 32u /* hidden units of a network, at most */
#define UPB_MAX_COLUMNS 65535u
#define UPB_ALIGN 64u              /* alignment of all memory given to the library, bytes */
#define UPB_MODEL_BYTES_MAX 16384u /* upb_model_bytes() never exceeds this */

typedef enum upb_status {
    UPB_OK = 0,
    UPB_E_ARGUMENT = 1,   /* a null pointer, or a value outside its range */
    UPB_E_SIZE = 2,       /* the caller's memory is too small: error.expected tells how much is needed */
    UPB_E_ALIGN = 3,      /* the caller's memory is not aligned to UPB_ALIGN */
    UPB_E_TRUNCATED = 4,  /* a model file ends early, or is longer than it says */
    UPB_E_MAGIC = 5,      /* not a .ubm model file */
    UPB_E_VERSION = 6,    /* a format version this library does not read */
    UPB_E_CRC = 7,        /* the model file's checksum does not match: damaged */
    UPB_E_SECTION = 8,    /* a required section is unknown (error.what: its tag), missing, or lies outside the file */
    UPB_E_VALUE = 9,      /* a value in the model file is impossible: error.what names it */
    UPB_E_SENSOR = 10,    /* the stream's sensor is not the one the model was made for */
    UPB_E_PRECISION = 11, /* the model file does not have the precision */
    UPB_E_CPU = 12,       /* an instruction set was asked for that this machine, or this build, does not have */
    UPB_E_ORDER = 13,     /* a column older than one already taken: dropped and counted */
    UPB_E_SIGNATURE = 14  /* the caller's verify function refused the model file */
} upb_status;

/* One lower-case English sentence without full stop, static, never null. */
UPB_API const char *upb_status_text(upb_status status);

/* What went wrong, for a message: filled when a call that takes one fails. */
typedef struct upb_error {
    upb_status status;
    uint32_t offset;   /* byte offset in the model file, where it applies */
    uint64_t got;      /* the value found, where it applies */
    uint64_t expected; /* the value, or the limit, expected */
    char what[32];     /* the field, section or argument, zero terminated */
} upb_error;

UPB_API uint32_t upb_api_version(void);
/* "0.1.0", static. */
UPB_API const char *upb_version(void);

/* ------------------------------------------------------------------------------------------------- model */

typedef struct upb_model upb_model;

typedef enum upb_edge {
    UPB_EDGE_ZERO = 0, /* beyond the first and last column of a turn all is 0 (the paper) */
    UPB_EDGE_SEAM = 1  /* the turn continues: the neighbour of the last column is the next turn's first */
} upb_edge;

typedef enum upb_last_row {
    UPB_LAST_ROW_REPEAT = 0, /* row 63 repeats row 62 (the paper) */
    UPB_LAST_ROW_EMPTY = 1   /* row 63 is no return: no ghost beam */
} upb_last_row;

typedef enum upb_empty_rule {
    UPB_EMPTY_NONE = 0, /* an empty pixel is the value 0 (the paper) */
    UPB_EMPTY_FILL = 1  /* an empty pixel takes the opposite row's value, an empty column its neighbours' (docs) */
} upb_empty_rule;

/*
 * What a stream computes with. Float is in every model file; the integer precisions (docs/numeric-contract.md: the same
 * bits on every machine) are in those that were quantised: upb_model_info.precisions.
 */
typedef enum upb_precision { UPB_PRECISION_FP32 = 0, UPB_PRECISION_INT16 = 1, UPB_PRECISION_INT8 = 2 } upb_precision;

#define UPB_PRECISIONS 3u

typedef struct upb_model_info {
    char sensor[32];           /* name of the beam table, zero terminated */
    uint32_t columns;          /* per turn */
    uint32_t distance_unit_um; /* size of a distance count, micrometres */
    uint32_t cut_mdeg;         /* azimuth where column 0 begins, thousandths of a degree, clockwise */
    uint32_t min_count;        /* nearest and farthest count the network sees and gives; others are no return */
    uint32_t max_count;
    uint32_t edge;                          /* upb_edge */
    uint32_t last_row;                      /* upb_last_row */
    uint32_t empty_rule;                    /* upb_empty_rule */
    uint32_t hidden[2];                     /* hidden units of the float networks: distance, intensity */
    uint32_t crc32;                         /* of the model file: its identity */
    uint32_t file_bytes;                    /* of the model file, all sections */
    uint32_t signature_bytes;               /* of its signature, 0: none. Says nothing of who looked at it */
    uint32_t precisions;                    /* bit 1 << upb_precision: the file has it */
    uint32_t weight_bytes[UPB_PRECISIONS];  /* of both networks as the file holds them; 0: not in the file */
    int32_t row_elevation_udeg[UPB_ROWS];   /* millionths of a degree above the horizon */
    int32_t azimuth_offset_udeg[UPB_BEAMS]; /* clockwise from the firing's azimuth to the beam's */
    int32_t row_height_um[UPB_ROWS];        /* height of the row's laser origin over the sensor's, micrometres */
    uint16_t row_max_count[UPB_ROWS];       /* farthest count seen (even rows) or given (odd rows) */
} upb_model_info;

/* Bytes of memory a model needs. */
UPB_API size_t upb_model_bytes(void);

/*
 * Reads a .ubm file from `ubm` (copied: it need not be kept) into `memory` (UPB_ALIGN-aligned, at least
 * upb_model_bytes()). Every byte is checked: length, checksum, sections, values. `error` may be null.
 * Errors: ARGUMENT, SIZE, ALIGN, TRUNCATED, MAGIC, VERSION, CRC, SECTION, VALUE; *model is then null.
 */
UPB_API upb_status upb_model_load(void *memory, size_t memory_bytes, const void *ubm, size_t ubm_bytes,
                                  upb_model **model, upb_error *error);

/*
 * Looks at a model file's signature: not 0 if it is good. `data` are the bytes it is for, from the file's first to the
 * signature section; `signature` is that section's content, at most UPB_SIGNATURE_BYTES_MAX. A file without one comes
 * with its bytes before the checksum, and signature_bytes 0. Neither pointer is null; both are valid during the call.
 */
typedef int (*upb_verify_fn)(void *user, const void *data, size_t data_bytes, const void *signature,
                             size_t signature_bytes);

#define UPB_SIGNATURE_BYTES_MAX 4096u

/*
 * upb_model_load for a caller that takes signed models only: `verify` is asked once, when length, checksum and section
 * table have been checked and before anything else of the file is read. The library has no cryptography of its own. A
 * null `verify` asks nobody. Errors: those of upb_model_load, SIGNATURE.
 */
UPB_API upb_status upb_model_load_verified(void *memory, size_t memory_bytes, const void *ubm, size_t ubm_bytes,
                                           upb_verify_fn verify, void *user, upb_model **model, upb_error *error);

UPB_API upb_status upb_model_get_info(const upb_model *model, upb_model_info *info);

/* ------------------------------------------------------------------------------------------------ stream */

typedef struct upb_stream upb_stream;

typedef enum upb_cpu {
    UPB_CPU_AUTO = 0, /* the fastest this machine has */
    UPB_CPU_SCALAR = 1,
    UPB_CPU_AVX2 = 2,        /* AVX2 and FMA */
    UPB_CPU_AVX512 = 3,      /* AVX-512 F, BW, DQ, VL */
    UPB_CPU_NEON = 4,        /* AArch64 */
    UPB_CPU_AVX512_VNNI = 5, /* UPB_CPU_AVX512 and VNNI */
    UPB_CPU_NEON_DOT = 6     /* AArch64 with the dot product instructions */
} upb_cpu;

/*
 * At least one beam's sample of this column never arrived: its pixel is "no return". Besides columns that never arrived
 * this happens, with azimuth offsets, to the columns next to the two ends of a stream: beams that look ahead had not
 * fired yet, those that look back did not fire any more.
 */
#define UPB_COLUMN_INCOMPLETE 1u
#define UPB_COLUMN_LAST 2u       /* last column of its frame: columns-1 */
#define UPB_COLUMN_MODE_SHIFT 8u /* bits 8 and 9: the upb_mode that made the column's generated rows */

/*
 * How generated rows are made, from dearest to cheapest: the degradation ladder. The sensor's own rows are the same in
 * every mode. Range limits are those of the model in every mode: a pixel of a row beyond its limits is not seen, and
 * what is generated beyond its own is no return. Only NETWORK depends on the stream's precision.
 */
typedef enum upb_mode {
    UPB_MODE_NETWORK = 0,
    /*
     * The mean of those of the two vertical neighbours that are seen: (a + b + 1) / 2 in whole numbers, so that halves
     * round up; one alone as it is; none: no return. Intensities follow the distances. model/baselines.py, valid-mean
     */
    UPB_MODE_VALID_MEAN = 1,
    UPB_MODE_REPEAT = 2,      /* the upper neighbour, if seen: model/baselines.py, nearest */
    UPB_MODE_PASS_THROUGH = 3 /* generated rows are no return, row 63 too */
} upb_mode;

#define UPB_MODES 4u

/* A finished column. The arrays belong to the stream and are valid during the call of the sink. */
typedef struct upb_column {
    uint64_t frame;           /* turns since the stream's start, from 0; the first may be partial */
    uint32_t column;          /* 0 .. columns-1 */
    uint32_t flags;           /* UPB_COLUMN_* */
    const uint16_t *distance; /* [UPB_ROWS] counts */
    const uint8_t *intensity; /* [UPB_ROWS] */
} upb_column;

/* True for rows that no laser measured. */
static inline int upb_row_is_generated(uint32_t row) { return (int)(row & 1u); }

/* The mode that made the column's generated rows. */
static inline upb_mode upb_column_mode(const upb_column *column) {
    return (upb_mode)(column->flags >> UPB_COLUMN_MODE_SHIFT & 3u);
}

/* Must not call the stream that calls it. */
typedef void (*upb_column_sink)(void *user, const upb_column *column);

typedef struct upb_stream_config {
    uint32_t struct_bytes;     /* sizeof(upb_stream_config), set by upb_stream_config_default */
    uint32_t precision;        /* upb_precision */
    uint32_t cpu;              /* upb_cpu: force one instruction set, e.g. for tests */
    uint32_t reorder_columns;  /* a column at most this far behind the last one (0: the same again) is late, dropped and
                                  counted; farther is a gap. 1..columns/2; 0: 64, or columns/2 if that is less */
    uint32_t distance_unit_um; /* unit of the stream's counts; 0: the model's. Another unit is refused (SENSOR) */
    uint32_t columns;          /* columns per turn of the stream; 0: the model's. Another width is refused (SENSOR)
                                  unless any_sensor */
    uint32_t any_sensor;       /* 1: take a stream of another width */
    uint32_t aligned; /* 1: columns come azimuth aligned, as range images are; the model's offsets are not applied */
    uint32_t reserved[8]; /* 0 */
    upb_column_sink sink; /* called in order with every finished column; may be null */
    void *user;           /* handed to the sink */
} upb_stream_config;

UPB_API upb_stream_config upb_stream_config_default(void);

typedef struct upb_stream_stats {
    uint64_t columns_in;      /* pushed and used */
    uint64_t columns_out;     /* handed to the sink */
    uint64_t columns_missing; /* never arrived: inserted as no return */
    uint64_t columns_late;    /* arrived behind a later one: dropped */
    uint64_t frames_out;      /* frames whose last column was handed out */
    uint32_t
        delay_columns;    /* pushes from a column's own to the one that hands it out: the destagger ring's, and one for
                             the right neighbour. The last column of a turn under UPB_EDGE_ZERO is one push earlier */
    uint32_t cpu;         /* upb_cpu in use */
    uint32_t state_bytes; /* of the stream's memory that is read or written */
    uint32_t precision;   /* upb_precision in use */
} upb_stream_stats;

/* Bytes of memory a stream of this model and configuration needs; the same checks as upb_stream_init. */
UPB_API upb_status upb_stream_bytes(const upb_model *model, const upb_stream_config *config, size_t *bytes,
                                    upb_error *error);

/* What a model and a stream take, in bytes. */
typedef struct upb_sizes {
    uint32_t file;    /* the model file, all sections and precisions */
    uint32_t weights; /* both networks of the precision as the file holds them */
    uint32_t tables;  /* the same in memory as the kernels read them, padded, with the limits of 32 beams */
    uint32_t state;   /* the stream: upb_stream_bytes */
    uint32_t ring;    /* of it, the destagger ring; 0 where no beam is offset, and for aligned columns */
    uint32_t reserved[3];
} upb_sizes;

/* The sizes for config->precision; the same checks as upb_stream_init. */
UPB_API upb_status upb_stream_sizes(const upb_model *model, const upb_stream_config *config, upb_sizes *sizes,
                                    upb_error *error);

/*
 * Makes a stream in `memory` (UPB_ALIGN-aligned, at least upb_stream_bytes()). The model must outlive it.
 * Errors: ARGUMENT, SIZE, ALIGN, SENSOR, CPU; PRECISION: not in the model file (got: the upb_precision asked for,
 * expected: upb_model_info.precisions, the mask of those that are there).
 */
UPB_API upb_status upb_stream_init(void *memory, size_t memory_bytes, const upb_model *model,
                                   const upb_stream_config *config, upb_stream **stream, upb_error *error);

/*
 * Takes one firing column: `column` is its place in the turn (0 .. columns-1), `distance` and `intensity` hold
 * UPB_BEAMS values. Columns that were skipped since the last call are inserted as no return and counted. Calls the sink
 * for each column that becomes complete: normally one, more after a gap or at a `zero` edge, none at the start of a
 * stream. A stream begins and ends with an edge: its first finished column is the first pushed one. (Where the azimuth
 * offsets of all beams have one sign, the columns of the output are counted from the nearest offset on.) Errors:
 * ARGUMENT (nothing taken), ORDER (a late column: nothing taken, counted).
 */
UPB_API upb_status upb_stream_push(upb_stream *stream, uint32_t column, const uint16_t *distance,
                                   const uint8_t *intensity);

/*
 * Inserts `columns` columns that never arrived. Before the first push, and after a flush, it does nothing. Each costs
 * as much as a pushed one. Errors: ARGUMENT (more than 16 turns).
 */
UPB_API upb_status upb_stream_gap(upb_stream *stream, uint32_t columns);

/*
 * Ends the stream with an edge: hands out what is pending, up to the last pushed column (or inserted one). The next
 * push starts a new frame wherever it stands; the frame number goes on.
 */
UPB_API upb_status upb_stream_flush(upb_stream *stream);

/*
 * How generated rows are made from the next finished column on: that is the one after the last the sink saw, whose own
 * firing was pushed delay_columns before. A new stream is in UPB_MODE_NETWORK; reset and flush keep the mode. A column
 * depends on its own mode only, not on those before it. Errors: ARGUMENT.
 */
UPB_API upb_status upb_stream_set_mode(upb_stream *stream, upb_mode mode);

/*
 * A checksum (CRC-32) of what does not change in a stream after upb_stream_init: how beams are destaggered, sizes,
 * which functions and which model it uses. Two calls that differ tell that the memory was damaged between them. The
 * mode and what the stream knows of columns are not in it. Errors: ARGUMENT.
 */
UPB_API upb_status upb_stream_checksum(const upb_stream *stream, uint32_t *checksum);

/* Forgets all columns and counts, as after upb_stream_init; the mode stays. */
UPB_API upb_status upb_stream_reset(upb_stream *stream);

UPB_API upb_status upb_stream_get_stats(const upb_stream *stream, upb_stream_stats *stats);

/*
 * The whole-frame call: pushes a range image of UPB_BEAMS rows x `columns` (the stream's) through the stream and writes
 * the finished columns side by side, in order, into images of UPB_ROWS rows. Rows are `*_stride` elements apart.
 * The stream carries the pending columns over to the next call, so that a sequence of calls gives the same bits as
 * upb_stream_push column by column: a call finishes `columns` columns, the first one upb_stream_stats.delay_columns
 * fewer, upb_stream_frame_end the rest. (Under UPB_EDGE_ZERO without azimuth offsets every call finishes its own
 * frame.) `out_capacity` is the width of the output images, at least `columns`; *out_columns tells how many were
 * written. The stream must stand at the start of a turn (new, flushed, or column columns-1 taken last). The sink is not
 * called. Input and output must not overlap. Errors: ARGUMENT (also: inside a turn, a stride less than a row), SIZE.
 */
UPB_API upb_status upb_stream_frame(upb_stream *stream, const uint16_t *distance, size_t distance_stride,
                                    const uint8_t *intensity, size_t intensity_stride, uint16_t *out_distance,
                                    size_t out_distance_stride, uint8_t *out_intensity, size_t out_intensity_stride,
                                    uint32_t out_capacity, uint32_t *out_columns);

/*
 * upb_stream_flush for the whole-frame call: writes the pending columns, at most delay_columns of them. The strides
 * must not be less than `out_capacity`. Errors: ARGUMENT, SIZE (nothing done).
 */
UPB_API upb_status upb_stream_frame_end(upb_stream *stream, uint16_t *out_distance, size_t out_distance_stride,
                                        uint8_t *out_intensity, size_t out_intensity_stride, uint32_t out_capacity,
                                        uint32_t *out_columns);

/* --------------------------------------------------------------------------------------------- histogram */

/*
 * Latencies in nanoseconds in fixed memory: exact below 64 ns, then 32 buckets an octave (a quantile is at most 1/32
 * above the true one, never below), up to 2^40 ns (18 minutes); what is longer is counted in the last bucket. The
 * maximum and the sum are exact.
 */
#define UPB_HISTOGRAM_BUCKETS 1152u

typedef struct upb_histogram {
    uint64_t count;
    uint64_t sum_ns;
    uint64_t min_ns;
    uint64_t max_ns;
    uint32_t bucket[UPB_HISTOGRAM_BUCKETS];
} upb_histogram;

UPB_API void upb_histogram_reset(upb_histogram *histogram);
UPB_API void upb_histogram_add(upb_histogram *histogram, uint64_t ns);
/* The upper end of the bucket that holds the quantile `per_million` (500000: median), capped at max_ns; 0 if empty. */
UPB_API uint64_t upb_histogram_quantile(const upb_histogram *histogram, uint32_t per_million);
/* Adds `other` to `histogram`. */
UPB_API void upb_histogram_merge(upb_histogram *histogram, const upb_histogram *other);

/* ------------------------------------------------------------------------------------------------ ledger */

/* A monotonic clock, given by the caller: the library never asks the machine for the time. */
typedef struct upb_clock {
    uint64_t (*now_ns)(void *user);
    void *user;
} upb_clock;

typedef enum upb_verdict {
    UPB_VERDICT_MET = 0,
    UPB_VERDICT_MISSED = 1, /* latency above the deadline */
    UPB_VERDICT_PARTIAL = 2 /* the frame began or ended outside the stream: shown, not judged */
} upb_verdict;

/* One frame: the same record in C, JSON, CAN and serial. */
typedef struct upb_ledger_record {
    uint64_t frame;
    uint64_t first_input_ns;  /* when the frame's first column was received */
    uint64_t last_input_ns;   /* when its last column was received */
    uint64_t output_ns;       /* when its last output column was complete */
    uint64_t latency_ns;      /* output_ns - last_input_ns */
    uint32_t verdict;         /* upb_verdict */
    uint32_t missing_columns; /* never arrived */
    uint32_t mode;            /* upb_mode */
    uint32_t reserved;
} upb_ledger_record;

typedef struct upb_ledger {
    upb_clock clock;
    uint64_t deadline_ns;
    upb_ledger_record *records; /* the caller's ring of the last `capacity` closed frames */
    uint32_t capacity;
    uint32_t open_count;
    upb_ledger_record open[4]; /* frames received in part, oldest first */
    uint64_t closed;           /* frames closed: record k of the ring is frame count k modulo capacity */
    uint64_t missed;
    uint64_t partial;
    uint64_t lost;         /* frames opened that never closed: pushed out by newer ones */
    upb_histogram latency; /* of the frames judged */
} upb_ledger;

/* `records` (capacity >= 1) belongs to the caller and must outlive the ledger. Errors: ARGUMENT. */
UPB_API upb_status upb_ledger_init(upb_ledger *ledger, upb_ledger_record *records, uint32_t capacity,
                                   uint64_t deadline_ns, upb_clock clock);
/*
 * A column of `frame` was received at `received_ns` (the ledger's clock). Frames begin in order. Errors: ARGUMENT (a
 * time before that of the frame's last column; a frame that was closed, or is older than one that was received).
 */
UPB_API upb_status upb_ledger_input(upb_ledger *ledger, uint64_t frame, uint64_t received_ns);
/*
 * The last output column of `frame` is complete now (reads the clock): closes its record. `partial` is not 0 for a
 * frame that began or ended outside the stream. The record is copied to *record unless null. Errors: ARGUMENT (frame
 * not open; the clock stands before the frame's last input: nothing is closed).
 */
UPB_API upb_status upb_ledger_output(upb_ledger *ledger, uint64_t frame, uint32_t missing_columns, uint32_t partial,
                                     uint32_t mode, upb_ledger_record *record);

#ifdef __cplusplus
}
#endif

#endif /* UPBEAM_UPBEAM_H */
