/*
 * upb_daemon: packets of a 32-beam sensor in, columns and packets of 64 beams out. The core of `upbeamd` (upbeamd.c
 * wraps it in threads and sockets), and what tests and the bench drive on virtual time.
 *
 * A step function: bytes and times come in through calls, bytes leave through function pointers during those calls.
 * Memory is the caller's; no heap, no threads, no I/O, no globals. Calls on one daemon may not run at the same time.
 *
 *     upb_daemon_config config = upb_daemon_config_default();
 *     config.sinks.column_stream = send_columns;
 *     size_t bytes = upb_daemon_bytes(&config);
 *     upb_daemon_init(memory, bytes, &config, ubm, ubm_bytes, &daemon, &error);
 *     for (;;) { upb_daemon_packet(daemon, packet, packet_bytes, source, received_ns); upb_daemon_tick(daemon, now); }
 *
 * Every firing of the sensor is one column: none is resampled, doubled or lost. Frames are cut where the azimuth passes
 * config.cut_mdeg, never by counting. Firings that never arrived are inserted as no return.
 *
 * Time. Nanoseconds of one monotonic clock. With config.clock.now_ns null, time is virtual: work on a packet begins
 * when it was received or when the work before has ended, whichever is later, and takes config.service_ns[mode];
 * everything that the daemon then says of time follows from the calls alone, to the nanosecond.
 *
 * packets_received = packets_processed + the sum over causes of packets_dropped, after every call.
 */
#ifndef UPB_DAEMON_H
#define UPB_DAEMON_H

#include "upbeam/bus.h"
#include "upbeam/packets.h"
#include "upbeam/upbeam.h"

#ifdef __cplusplus
extern "C" {
#endif

typedef struct upb_daemon upb_daemon;

/* ------------------------------------------------------------------------------------------------------ drops */

/* Why a data packet was not processed: one cause each. upb_drop_name gives it in lower case ("wrong_model"). */
typedef enum upb_drop {
    UPB_DROP_MALFORMED = 0,    /* no packet of the sensor: length, flags or an angle beyond 359.99 degrees */
    UPB_DROP_WRONG_MODEL = 1,  /* a good packet of another sensor than the configured one */
    UPB_DROP_WRONG_SOURCE = 2, /* from another address than config.source_ipv4 */
    UPB_DROP_DUPLICATE = 3,    /* the same sensor time and azimuth as one already taken */
    UPB_DROP_LATE = 4,         /* overtaken: older than one already taken */
    UPB_DROP_FLOOD = 5,        /* during a flood of packets to refuse, one that does not continue the sequence */
    UPB_DROP_QUEUE = 6,        /* the queue before the step was full */
    UPB_DROP_STALE = 7,        /* waited longer than config.stale_ns */
    UPB_DROP_STUCK = 8,        /* the azimuth does not move: the measured directions are unknown */
    UPB_DROP_JUMP = 9,  /* its sensor time does not follow the last one's, and no second packet has confirmed it */
    UPB_DROP_ENDED = 10 /* came after upb_daemon_end */
} upb_drop;

#define UPB_DROPS 11u

/* Static, never null; "?" for a number that is no cause. */
const char *upb_drop_name(uint32_t drop);

/* ------------------------------------------------------------------------------------------------------ events */

typedef enum upb_event_kind {
    UPB_EVENT_MODE = 0,           /* a: mode before, b: mode now, value: lag in ns */
    UPB_EVENT_FAULT_SET = 1,      /* a: upb_fault, value: what the monitor saw (docs/upbeamd.md) */
    UPB_EVENT_FAULT_CLEARED = 2,  /* a: upb_fault */
    UPB_EVENT_MODEL_SWAPPED = 3,  /* value: CRC-32 of the model file now in use */
    UPB_EVENT_MODEL_REJECTED = 4, /* a: upb_status */
    UPB_EVENT_RESYNC = 5,         /* a: cause (upb_fault), value: firings inserted; the stream began anew */
    UPB_EVENT_STREAM_MADE = 6,    /* a: columns per turn */
    UPB_EVENT_INTEGRITY = 7,      /* a: upb_region, b: 1 if it was repaired */
    UPB_EVENT_GAP = 8,            /* a: firings inserted */
    UPB_EVENT_ENDED = 9
} upb_event_kind;

typedef struct upb_event {
    uint64_t time_ns;
    uint64_t frame; /* the frame that is being received */
    uint64_t value;
    uint32_t kind; /* upb_event_kind */
    uint32_t a, b;
    uint32_t reserved;
} upb_event;

/* Static, never null: "mode", "fault_set", ... */
const char *upb_event_name(uint32_t kind);

/* ------------------------------------------------------------------------------------------------------ outputs */

/*
 * Called during the calls below; must not call the daemon. Null: not wanted, and not computed. `time_ns` is when the
 * bytes are complete. Bytes are valid during the call.
 */
typedef struct upb_daemon_sinks {
    void *user;
    void (*column_stream)(void *user, uint64_t time_ns, const uint8_t *datagram, size_t bytes); /* upb_column_wire.h */
    void (*hdl64)(void *user, uint64_t time_ns, const uint8_t *packet, size_t bytes);           /* 1206 bytes */
    upb_send (*can)(void *user, uint64_t time_ns, const upb_can_frame *frame);
    upb_send (*serial)(void *user, uint64_t time_ns, const uint8_t *data, size_t bytes);
    void (*ledger)(void *user, const upb_ledger_record *record);
    void (*event)(void *user, const upb_event *event);
} upb_daemon_sinks;

/* ------------------------------------------------------------------------------------------------ configuration */

#define UPB_DAEMON_CUT_OF_MODEL UINT32_MAX

typedef struct upb_daemon_config {
    uint32_t struct_bytes; /* sizeof(upb_daemon_config), set by upb_daemon_config_default */

    /* the sensor */
    uint32_t sensor;                 /* upb_sensor of packets.h: HDL-32E or VLP-32C */
    uint32_t any_model;              /* 1: take a model made for another sensor */
    uint32_t source_ipv4;            /* take packets of this address only (host byte order); 0: of any */
    uint32_t rpm;                    /* nominal turns a minute; 0: measured when the stream begins */
    uint32_t rpm_tolerance_permille; /* beyond it SENSOR_RPM_RANGE is set */
    uint32_t cut_mdeg; /* frames begin here; UPB_DAEMON_CUT_OF_MODEL: the model's, or behind a limited field of view */
    /* A sensor told to fire in a part of the turn only, clockwise from begin to end. Equal: the whole turn. */
    uint32_t fov_begin_mdeg, fov_end_mdeg;
    uint32_t width_tolerance_permille; /* the stream is made anew at a frame boundary when the speed has changed more */

    /* computing */
    uint32_t precision; /* upb_precision */
    uint32_t cpu;       /* upb_cpu */
    uint64_t deadline_ns;

    /* the degradation ladder: lag is when work on a packet begins minus when it was received */
    uint64_t ladder_down_ns[UPB_MODES - 1]; /* rising: from this lag on VALID_MEAN, REPEAT, PASS_THROUGH at best */
    uint64_t ladder_up_ns;                  /* with the lag below this for ladder_hold_ns the mode goes up one rung */
    uint64_t ladder_hold_ns; /* doubled, up to 16 times, while a climb is followed by a fall within twice the hold */
    uint32_t mode_floor;     /* upb_mode: never better than this */
    uint64_t stale_ns;       /* a packet that waited longer is dropped */

    /* health: what sets and heals each fault is in docs/upbeamd.md */
    uint64_t timeout_ns; /* without a packet this long (beside the blind part of a turn): SENSOR_TIMEOUT, and what is
                            pending leaves */
    uint32_t flood_per_second;    /* refused packets above it: NET_FLOOD; 0: 1.25 times what the sensor sends */
    uint64_t jitter_ns;           /* arrival against sensor time, of one packet to the next: NET_JITTER */
    uint32_t drift_ppm;           /* sensor clock against ours: CLOCK_DRIFT */
    uint32_t loss_permille;       /* firings inserted in a frame: NET_LOSS */
    uint32_t throttle_permille;   /* service time against its baseline, 1500: half as long again: COMPUTE_THROTTLE */
    uint32_t visibility_permille; /* returns against their baseline, below it: SENSOR_VISIBILITY */
    uint32_t crosstalk_permille;  /* returns that stand alone: SENSOR_CROSSTALK */
    uint32_t integrity_bytes;     /* of the memory that must not change, checked at each frame's end */

    /* buses */
    const uint8_t *key;  /* UPB_KEY_BYTES for commands, copied; null: no command is taken */
    upb_storage storage; /* of the bus: freshness and fault memory; functions may be null */
    /* The model file with this CRC-32, for the command that asks for it; 0 if there is none. Bytes are copied. */
    int (*find_model)(void *user, uint32_t crc32, const void **ubm, size_t *bytes);
    int (*reset)(void *user, uint32_t type); /* upb_bus_config.reset */
    void *user;                              /* of find_model and reset */

    /* memory */
    uint32_t ubm_bytes_max;   /* of a model file that may be loaded; two are kept */
    uint32_t ledger_capacity; /* closed frames kept */

    /* virtual time */
    uint64_t service_ns[UPB_MODES]; /* work on a packet */
    uint32_t queue_packets;         /* queue before the step that is modelled; 0: none. With a real clock: 0 */

    /* tests: bit set of upb_daemon_check_name, each one taken out */
    uint64_t sabotage;

    upb_clock clock; /* now_ns null: virtual */
    upb_daemon_sinks sinks;
} upb_daemon_config;

upb_daemon_config upb_daemon_config_default(void);

/*
 * Names of what config.sabotage takes out, in the order of its bits: detections (the names of faults in lower case,
 * "sensor_timeout") and reactions ("react_..."). Null after the last. A fault taken out is not found, remembered or
 * told anywhere. "react_model_check" takes out the check that a model is for this sensor; a file's own checks (format,
 * lengths, CRC-32) keep memory safe and cannot be taken out.
 */
const char *upb_daemon_check_name(uint32_t bit);

/* ------------------------------------------------------------------------------------------------------ life */

/* Bytes of memory a daemon needs; 0 if the configuration is impossible (upb_daemon_init tells why). */
size_t upb_daemon_bytes(const upb_daemon_config *config);

/*
 * Makes a daemon in `memory` (UPB_ALIGN-aligned, upb_daemon_bytes()), with the model in a .ubm file (copied: it is kept
 * for repair). Errors: those of upb_model_load and upb_stream_init; ARGUMENT (error->what names the field of the
 * configuration), SIZE, ALIGN; SENSOR: the model's count or edge rule does not suit (a stream has no seam:
 * UPB_EDGE_SEAM).
 */
upb_status upb_daemon_init(void *memory, size_t memory_bytes, const upb_daemon_config *config, const void *ubm,
                           size_t ubm_bytes, upb_daemon **daemon, upb_error *error);

/* A datagram on the sensor's data port. `source_ipv4` in host byte order. */
void upb_daemon_packet(upb_daemon *daemon, const uint8_t *data, size_t bytes, uint32_t source_ipv4,
                       uint64_t received_ns);
/* A datagram on the sensor's position port. */
void upb_daemon_position(upb_daemon *daemon, const uint8_t *data, size_t bytes, uint32_t source_ipv4,
                         uint64_t received_ns);
/* `packets` data packets were received and dropped before the step: its queue was full. */
void upb_daemon_queue_full(upb_daemon *daemon, uint64_t packets, uint64_t now_ns);
void upb_daemon_can(upb_daemon *daemon, const upb_can_frame *frame, uint64_t received_ns);
void upb_daemon_serial(upb_daemon *daemon, const uint8_t *data, size_t bytes, uint64_t received_ns);
/* Time passes: timeouts, cyclic messages. At least every 10 ms; never with a time before an earlier call's. */
void upb_daemon_tick(upb_daemon *daemon, uint64_t now_ns);

/*
 * Checks a model file and keeps it (copied); it is used from the next frame on. On an error nothing changes, the
 * refusal is counted. Errors: as upb_daemon_init.
 */
upb_status upb_daemon_swap_model(upb_daemon *daemon, const void *ubm, size_t ubm_bytes, uint64_t now_ns,
                                 upb_error *error);

/* Never better than this mode, from now on. Errors: ARGUMENT. */
upb_status upb_daemon_set_floor(upb_daemon *daemon, upb_mode mode, uint64_t now_ns);

/* Hands out everything pending, closes the last frame. Packets that follow are dropped and counted. */
void upb_daemon_end(upb_daemon *daemon, uint64_t now_ns);

/* ------------------------------------------------------------------------------------------------------ looking in */

typedef struct upb_daemon_counters {
    uint64_t packets_received;
    uint64_t packets_processed;
    uint64_t packets_dropped[UPB_DROPS];
    uint64_t firings_processed; /* each became one column */
    uint64_t firings_inserted;  /* never arrived; each became one column of no return */
    uint64_t firings_skipped;   /* never arrived, in gaps too long to insert */
    uint64_t columns_out;       /* = firings_processed + firings_inserted - columns_lost - pending */
    uint64_t columns_lost;      /* pending in a stream whose memory was damaged */
    uint64_t columns_by_mode[UPB_MODES];
    uint64_t column_datagrams;
    uint64_t hdl64_packets;
    uint64_t hdl64_beyond_range; /* returns beyond 131 m: not in HDL-64E packets */
    uint64_t hdl64_padding;      /* empty firings that filled a packet where the stream ended */
    uint64_t second_returns;     /* firings whose other return passed through */
    uint64_t frames_closed, frames_missed, frames_partial;
    uint64_t frames_forced;  /* cut though the azimuth did not pass the cut */
    uint64_t frames_skipped; /* passed in gaps too long to insert */
    uint64_t mode_changes;
    uint64_t positions_received, positions_malformed;
    uint64_t can_received, can_sent, serial_received, serial_sent; /* frames; bytes */
    uint64_t commands_accepted, commands_rejected;
    uint64_t models_swapped, models_rejected;
    uint64_t streams_made, resyncs;
    uint64_t integrity_checks; /* whole passes */
    uint64_t integrity_failures, integrity_repairs;
    uint64_t events;
} upb_daemon_counters;

typedef struct upb_daemon_status {
    upb_daemon_counters counters;
    uint64_t now_ns;
    uint64_t frame;       /* being received */
    uint64_t faults;      /* bit id - 1: the upb_fault is active */
    uint64_t faults_ever; /* since the start */
    uint64_t lag_ns, lag_max_ns;
    uint64_t last_latency_ns;
    uint64_t service_ns; /* of a packet, mean of the last frame */
    uint32_t mode;       /* upb_mode */
    uint32_t columns;    /* per turn, of the stream; 0: it has not begun */
    uint32_t delay_columns;
    uint32_t rpm_milli; /* measured, thousandths of a turn a minute */
    int32_t drift_ppm;  /* measured */
    uint32_t model_crc32;
    uint32_t returns_permille;        /* of the last frame's pixels */
    uint32_t integrity_period_frames; /* a damaged bit is found within so many frames */
    uint32_t ended;
    uint32_t reserved;
} upb_daemon_status;

upb_daemon_status upb_daemon_get_status(const upb_daemon *daemon);
const upb_ledger *upb_daemon_get_ledger(const upb_daemon *daemon);
const upb_faults *upb_daemon_get_faults(const upb_daemon *daemon);
/* The table of the HDL-64E that sinks.hdl64 shows, with azimuth_offset_mdeg for the speed in use; null before the
 * stream begins. Drivers read it from the packets, or from the file that upb_packet tools write of it. */
const upb_packet_calibration *upb_daemon_get_calibration(const upb_daemon *daemon);

/* Virtual time: the work on a packet from now on. */
void upb_daemon_set_service(upb_daemon *daemon, const uint64_t service_ns[UPB_MODES]);

/* Memory that must not change, for tests that damage it. */
typedef enum upb_region {
    UPB_REGION_MODEL = 0,  /* tables the kernels read */
    UPB_REGION_KEPT = 1,   /* the kept model file */
    UPB_REGION_STREAM = 2, /* what the stream never changes */
    UPB_REGION_CONFIG = 3  /* the configuration in use */
} upb_region;

#define UPB_REGIONS 4u

/* Its bytes: 0 for no such region. Test only: turns one bit of it round. */
size_t upb_daemon_region_bytes(const upb_daemon *daemon, upb_region region);
void upb_daemon_flip_bit(upb_daemon *daemon, upb_region region, size_t bit);

#ifdef __cplusplus
}
#endif

#endif /* UPB_DAEMON_H */
