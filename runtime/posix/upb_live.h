/*
 * A stream in real time: plays recorded or simulated frames at a sensor's pace, upsamples them and judges every frame.
 *
 * Three kinds of threads. The pacer plays the sensor: packet by packet, each at its due time. The consumer takes the
 * packets from a ring, as from a socket, and pushes their columns into a upb_stream. One witness a core sleeps in short
 * steps and notes when it was woken late, so that a stall of the machine is told apart from one of ours.
 *
 * This library is not part of libupbeam: it has threads, and memory from the heap (taken by upb_live_create alone,
 * given back by upb_live_destroy). With a virtual clock the same consumer and ledger run on one thread and give the
 * same bits every time.
 *
 * Times are nanoseconds since the start of the run: CLOCK_MONOTONIC, or the virtual clock.
 *
 * Usage:
 *     upb_live_config config = upb_live_config_default();
 *     config.distance = distance; ...
 *     if (upb_live_create(model, &config, &live, &error) == UPB_LIVE_OK && upb_live_run(live) == UPB_LIVE_OK)
 *         print(upb_live_get_result(live));
 *     upb_live_destroy(live);
 */
#ifndef UPBEAM_UPB_LIVE_H
#define UPBEAM_UPB_LIVE_H

#include "upbeam/upbeam.h"

#ifdef __cplusplus
extern "C" {
#endif

typedef enum upb_live_status {
    UPB_LIVE_OK = 0,
    UPB_LIVE_E_ARGUMENT = 1, /* error.what names the configuration's field, error.expected its limit */
    UPB_LIVE_E_LIBRARY = 2,  /* libupbeam refused: error.status tells why */
    UPB_LIVE_E_MEMORY = 3,   /* the heap is exhausted */
    UPB_LIVE_E_THREAD = 4,   /* a thread or a semaphore could not be made */
    UPB_LIVE_E_STATE = 5     /* upb_live_run was called a second time */
} upb_live_status;

/* One lower-case English sentence without full stop, static, never null. */
const char *upb_live_status_text(upb_live_status status);

/*
 * How the consumer waits for the next packet. Blocking is the default: on a busy two-core virtual machine, at 20 Hz x
 * 2048, it had the lowest p99 of the latency, at 2 % of a core; polling every 20 us took 40 %, every 100 us 12 %.
 */
typedef enum upb_live_wait {
    UPB_LIVE_WAIT_BLOCK = 0, /* on a semaphore: woken by the pacer */
    UPB_LIVE_WAIT_POLL = 1   /* looks every poll_ns; 0: never sleeps, and burns a core */
} upb_live_wait;

/* How a virtual clock advances. Arrays are used again from their start when they are shorter than the run. */
typedef struct upb_live_virtual {
    uint32_t enabled;
    uint64_t packet_service_ns; /* time to take a packet, before its first column */
    uint64_t column_service_ns; /* time to take one column */
    const uint64_t *service_ns; /* or: the whole time for each packet, spread evenly over its columns */
    size_t service_count;       /* 0: use the two constants */
    const uint64_t *jitter_ns;  /* each packet arrives this much after its due time (never before an earlier one) */
    size_t jitter_count;        /* 0: every packet arrives when due */
} upb_live_virtual;

typedef struct upb_live_config {
    const uint16_t *distance;    /* [frames][columns][UPB_BEAMS] counts, as fired; the caller's, must outlive the run */
    const uint8_t *intensity;    /* [frames][columns][UPB_BEAMS] */
    uint32_t frames;             /* frames in the arrays, at least 1 */
    uint32_t columns;            /* per turn */
    uint64_t frames_total;       /* frames to play; beyond `frames` they start again; 0: as many as there are */
    uint32_t columns_per_packet; /* 1..columns */
    uint32_t rate_millihertz;    /* turns per 1000 seconds, 1..100000 */
    uint64_t deadline_ns;        /* at least 1 */
    upb_stream_config stream;    /* precision, cpu, any_sensor: sink and columns are set by the runner */

    uint32_t ring_packets; /* packets the ring holds, a power of two, 2..65536; one more is dropped and counted */
    uint32_t wait;         /* upb_live_wait */
    uint32_t poll_ns;      /* for UPB_LIVE_WAIT_POLL */
    uint32_t spin_ns;      /* the pacer sleeps until this long before a packet is due, then spins */
    uint64_t lead_ns;      /* the first packet is due this long after the start: the threads' time to start */

    uint32_t realtime;           /* 1: ask for SCHED_FIFO for pacer and consumer */
    uint32_t lock_memory;        /* 1: ask for mlockall during the run */
    uint32_t witness;            /* 1: run witness threads */
    uint64_t witness_period_ns;  /* a witness sleeps this long */
    uint64_t stall_threshold_ns; /* a witness woken later than this notes a stall */

    const uint64_t *drop_packets; /* fault: these packets, rising, never reach the ring */
    size_t drop_count;
    const uint64_t *keep_frames; /* output images to keep, rising */
    size_t keep_count;
    upb_live_virtual virtual_clock;
} upb_live_config;

/* 20 Hz, 12 columns a packet, 50 ms, a ring of 256 packets, a witness a core; frames and columns must be filled in. */
upb_live_config upb_live_config_default(void);

#define UPB_LIVE_FLUSHED 1u   /* the stream ended with this frame: a flush completed it, not a later packet */
#define UPB_LIVE_EXPLAINED 2u /* missed, and met without the machine's stalls (upb_live_explains) */

/* A frame of the ledger, and what the runner knows beyond it. */
typedef struct upb_live_frame {
    upb_ledger_record record; /* missing_columns: played, but never arrived */
    uint64_t wait_ns;         /* part of the latency: until the packet arrived that completed the last column */
    uint32_t columns_received;
    uint32_t flags; /* UPB_LIVE_FLUSHED, UPB_LIVE_EXPLAINED */
} upb_live_frame;

typedef struct upb_live_stall {
    uint64_t start_ns; /* when the witness was to be woken */
    uint64_t duration_ns;
    uint32_t cpu; /* the core the witness is bound to; UINT32_MAX: it is not bound */
    uint32_t reserved;
} upb_live_stall;

typedef enum upb_live_cause { UPB_LIVE_CAUSE_FAULT = 0, UPB_LIVE_CAUSE_OVERFLOW = 1 } upb_live_cause;

/* A packet that never reached the consumer. */
typedef struct upb_live_drop {
    uint64_t packet;
    uint64_t at_ns;
    uint32_t columns;
    uint32_t cause; /* upb_live_cause */
} upb_live_drop;

/* An output image, column-major as it is produced. Columns that were not produced are 0. */
typedef struct upb_live_image {
    uint64_t frame;
    uint32_t columns_out; /* columns produced, 0 if the run ended before */
    uint32_t reserved;
    const uint16_t *distance; /* [columns][UPB_ROWS] */
    const uint8_t *intensity; /* [columns][UPB_ROWS] */
} upb_live_image;

/*
 * Accounts that hold after every run:
 *     frames_begun   = met + missed + partial + frames_empty
 *     packets_played = packets_taken + dropped_fault + dropped_overflow
 *     columns_played = columns_taken + columns of the dropped packets
 */
typedef struct upb_live_result {
    uint32_t stopped;          /* 1: upb_live_stop ended it */
    uint32_t realtime_granted; /* 1: asked for, and granted to both threads */
    uint32_t memory_locked;    /* 1: asked for, and granted */
    uint32_t cpu;              /* upb_cpu the stream used */
    uint32_t delay_columns;
    uint32_t state_bytes;  /* of the stream's memory in use */
    size_t stream_bytes;   /* of the stream's memory */
    uint64_t frames_begun; /* frames of which a packet was played */
    uint64_t met, missed, partial;
    uint64_t frames_empty; /* no column arrived: there is no latency to judge */
    uint64_t packets_played, packets_taken, dropped_fault, dropped_overflow;
    uint64_t columns_played, columns_taken, columns_missing, columns_out, columns_incomplete;
    uint64_t columns_refused; /* upb_stream_push returned an error: a defect */
    uint64_t duration_ns;
    uint64_t consumer_cpu_ns, pacer_cpu_ns; /* processor time of the threads; 0 with a virtual clock */
    upb_histogram latency;                  /* of the frames judged */
    upb_histogram pacer_lateness;           /* packet played minus packet due */
    upb_histogram column_compute;           /* one column pushed, its output collected */
    upb_histogram packet_compute;           /* one packet, from taken to done */
    const upb_live_frame *frames;           /* in the order they were closed */
    size_t frame_count;
    const upb_live_stall *stalls; /* by start */
    size_t stall_count;
    uint64_t stalls_unlisted; /* more than the list holds */
    uint32_t witnesses;       /* threads that ran */
    uint32_t witnesses_bound; /* of them bound to a core */
    const upb_live_drop *drops;
    size_t drop_count;
    uint64_t drops_unlisted;
    const upb_live_image *kept; /* [keep_count] */
    size_t kept_count;
    upb_live_image last; /* the last frame with a last column; columns_out is 0 if there is none */
} upb_live_result;

typedef struct upb_live_progress {
    uint64_t frames; /* closed */
    uint64_t missed;
    uint64_t last_latency_ns;
    uint64_t max_latency_ns;
    uint64_t packets_played;
    uint64_t packets_dropped;
} upb_live_progress;

typedef struct upb_live upb_live;

/* Takes all memory of the run. The model, and the arrays the configuration points to, must outlive it. */
upb_live_status upb_live_create(const upb_model *model, const upb_live_config *config, upb_live **live,
                                upb_error *error);
/* Runs to the end, or until upb_live_stop; once. The caller's thread waits (with a virtual clock: works). */
upb_live_status upb_live_run(upb_live *live);
/* Ends the run early: what has arrived is finished, an unfinished frame is PARTIAL. From any thread or signal handler.
 */
void upb_live_stop(upb_live *live);
/* From any thread, without holding up the run. The values may be of slightly different moments. */
upb_live_progress upb_live_get_progress(const upb_live *live);
/* Valid after upb_live_run until upb_live_destroy. */
const upb_live_result *upb_live_get_result(const upb_live *live);
void upb_live_destroy(upb_live *live);

/*
 * True if a latency from `from_ns` to `to_ns` would be at most `deadline_ns` without the time that lies within a stall
 * (of any core, overlapping ones counted once). `stalls` is sorted by start.
 */
int upb_live_explains(const upb_live_stall *stalls, size_t count, uint64_t from_ns, uint64_t to_ns,
                      uint64_t deadline_ns);

#ifdef __cplusplus
}
#endif

#endif
