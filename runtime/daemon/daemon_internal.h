/* What the source files of the daemon's core share. */
#ifndef UPB_DAEMON_INTERNAL_H
#define UPB_DAEMON_INTERNAL_H

#include "upb_column_wire.h"
#include "upb_daemon.h"

#define NS_PER_US UINT64_C(1000)
#define NS_PER_MS UINT64_C(1000000)
#define NS_PER_S UINT64_C(1000000000)

enum {
    FIRINGS_KEPT = 1024,    /* firings whose azimuth and time are known; a power of two. The stream's delay is less */
    STREAM_BYTES = 1 << 17, /* room for a stream of any width whose delay is less than FIRINGS_KEPT */
    TURN_COLUMNS_MIN = 100,
    TURN_COLUMNS_MAX = 16384,
    OPEN_FRAMES = 8, /* more than a ledger holds open */
    TAKEN_KEPT = 64, /* packets known again if they come twice */
    VIRTUAL_QUEUE_MAX = 4096,
    SLOTS = 3, /* models: in use, to be used next, being looked at */
    NO_SLOT = SLOTS
};

/* ------------------------------------------------------------------------------------------- sabotage */

/* Reactions that config.sabotage can take out; their bits follow those of the faults (bit id - 1). */
typedef enum daemon_reaction {
    REACT_LADDER_DOWN,
    REACT_LADDER_UP,
    REACT_STALE,
    REACT_FLOOD,
    REACT_DUPLICATE,
    REACT_LATE,
    REACT_SOURCE,
    REACT_GAP,
    REACT_RESYNC,
    REACT_TIMEOUT,
    REACT_STUCK,
    REACT_REPAIR,
    REACT_MODEL_CHECK,
    REACTIONS
} daemon_reaction;

/* ---------------------------------------------------------------------------------------------- parts */

/* A firing pushed to the stream (or inserted): what its column needs when it comes out, delay_columns later. */
typedef struct firing_note {
    uint64_t time_ns; /* the sensor's */
    uint64_t frame;
    uint32_t azimuth_mdeg;
    uint32_t column; /* in its frame */
    uint32_t flags;  /* UPB_WIRE_INSERTED, UPB_WIRE_SECOND: it has another return */
    uint16_t second_distance[UPB_BEAMS];
    uint8_t second_intensity[UPB_BEAMS];
} firing_note;

/* A frame received in part, or whose last column is still on its way. */
typedef struct open_frame {
    uint64_t frame;
    uint32_t received; /* firings */
    uint32_t inserted;
    uint32_t partial;
    uint32_t mode; /* the worst of its columns */
} open_frame;

/* The data packets' own order, by the sensor's clock. */
typedef struct packet_sequence {
    uint32_t started;
    uint32_t time_us;         /* of the last packet taken, after the hour */
    uint32_t taken_count;     /* of taken[], which wraps */
    uint64_t sensor_ns;       /* the same, hours counted on */
    uint64_t received_ns;     /* of the last packet taken */
    int64_t offset_ns;        /* least of received - sensor time of late: no packet arrives before it is sent */
    int64_t window_offset_ns; /* the same of the present window */
    uint64_t window_begin_ns;
    int64_t drift_offset_ns; /* of the window before, for the drift */
    uint64_t drift_at_ns;
    uint32_t drift_windows;
    uint64_t jitter_ns;    /* of the packet at hand */
    uint32_t candidate_us; /* a packet outside the sequence that others may confirm */
    uint32_t candidate_count;
    struct {
        uint32_t time_us, azimuth_mdeg;
    } taken[TAKEN_KEPT];
} packet_sequence;

/* What monitors count between two looks. */
typedef struct health_counts {
    uint32_t firings;
    uint32_t returns;
    uint32_t near;
    uint32_t far;
    uint32_t alone;
    uint32_t inserted;
    uint32_t taken; /* packets */
    uint32_t refused[UPB_DROPS];
    uint32_t jumps_azimuth, jumps_time;
    uint32_t stuck;
    uint32_t positions;
    uint32_t overloaded; /* packets worked on in a mode that lag had forced, and stale ones */
    uint64_t jitter_ns;  /* greatest */
    uint64_t service_ns; /* sum over packets in mode service_mode */
    uint32_t service_packets;
    uint16_t beam_returns[UPB_BEAMS];
    uint16_t beam_same[UPB_BEAMS]; /* as far as at the firing before */
} health_counts;

typedef struct health {
    health_counts now;
    uint64_t looked_ns;
    uint16_t last[2][UPB_BEAMS]; /* distances of the last two firings */
    uint32_t looks;              /* whole frames that the baselines have seen */
    /* Baselines, sixteenths of a permille. */
    uint32_t base_returns, base_near, base_far, base_alone;
    uint32_t base_beam[UPB_BEAMS];
    uint64_t base_service_ns[UPB_MODES];
    uint32_t service_looks[UPB_MODES];
    /* Latest of position packets. */
    uint32_t pps_was_locked, pps_lost, thermal;
    /* Flood of refused packets. */
    uint64_t flood_window_ns, flood_until_ns;
    uint32_t flood_count;
    int32_t drift_ppm;
    uint32_t drift_known;
    uint32_t returns_permille;
    uint64_t service_mean_ns;
} health;

typedef struct ladder {
    uint32_t lag_mode;               /* what the lag asks for */
    uint32_t mode;                   /* in use: not better than the floor */
    uint32_t floor, held, held_mode; /* a command holds a mode */
    uint64_t calm_since_ns;          /* 0: not calm */
    uint64_t climbed_ns;
    uint64_t hold_ns;
    uint64_t least_service_ns; /* of a packet since the mode changed */
} ladder;

typedef struct integrity {
    uint32_t model_crc, kept_crc, stream_crc, config_crc;
    uint32_t region; /* being walked */
    uint32_t crc;    /* of what was walked of it */
    size_t at;
    uint64_t failures_seen; /* counter at the end of the last pass */
    uint32_t broken;        /* nothing left to repair with: PASS_THROUGH */
} integrity;

/* A model: its tables, and the file they came from. */
typedef struct model_slot {
    upb_model *model;
    uint8_t *memory; /* upb_model_bytes() */
    uint8_t *ubm;    /* config.ubm_bytes_max */
    size_t ubm_bytes;
    upb_model_info info;
} model_slot;

struct upb_daemon {
    upb_daemon_config config;
    upb_daemon_config config_copy; /* to repair from */
    upb_daemon_counters counters;
    uint64_t now_ns; /* virtual time: the present; else the latest that was seen */
    uint64_t busy_until_ns;
    uint64_t service_ns[UPB_MODES]; /* virtual time: work on a packet */
    uint64_t received_ns;           /* of the last data packet, never back */
    uint64_t lag_ns, lag_max_ns, last_latency_ns;
    uint64_t faults_ever;
    uint32_t ended;
    uint64_t heard_ns; /* when the last packet was taken, or waiting for one began */
    uint64_t tick_ns;  /* of the last tick */
    uint32_t ticked;
    uint32_t sensor_silent; /* longer than config.timeout_ns */

    model_slot slot[SLOTS];
    uint32_t active;  /* slot in use */
    uint32_t pending; /* slot to be used from the next frame on, or NO_SLOT */

    /* input */
    upb_packet_decoder decoder;
    upb_azimuth_tracker tracker;
    packet_sequence sequence;
    uint32_t cycle_ns;
    uint32_t packet_firings;
    uint32_t stuck_run; /* firings whose azimuth did not move */
    uint32_t stuck_azimuth_mdeg;

    /* stream */
    upb_stream *stream; /* null: it has not begun, or ended at a gap */
    uint8_t *stream_memory;
    uint32_t columns; /* per turn, of the stream; 0: it never began */
    uint32_t delay_columns;
    int32_t offset[UPB_BEAMS], shift; /* columns: where a second return goes */
    uint64_t second_end;              /* number of the firing after the last with a second return; 0: none ever */
    uint64_t pushed, out, segment;    /* numbers of firings: next in, next out, first of the segment */
    uint32_t ending;                  /* the stream is being flushed */
    int64_t last_angle_mdeg;
    uint32_t last_azimuth_mdeg;
    uint32_t fov_break; /* firings for which the clock may still jump: the blind part of the turn has just passed */
    uint64_t last_time_ns;
    uint64_t frame_base, frame; /* number of the tracker's frame 0; of the last firing */
    uint32_t frame_column;      /* next in the frame */
    uint32_t frame_open;        /* `frame` is one that a firing belongs to */
    uint32_t rpm_milli;
    open_frame frames[OPEN_FRAMES];
    firing_note *notes; /* [FIRINGS_KEPT], by number */

    /* output */
    upb_wire_header wire_header;
    uint32_t wire_sequence;
    uint8_t wire[UPB_WIRE_BYTES_MAX];
    upb_packet_encoder encoder;
    upb_packet_calibration calibration;
    uint32_t encoder_made;
    uint32_t calibration_columns; /* per turn, that `calibration` is for */
    uint32_t hdl64_azimuth_mdeg;  /* of the last column in the encoder */
    uint64_t hdl64_time_ns;
    uint64_t closing; /* frame whose last column waits in the encoder */
    uint32_t closing_set;

    ladder ladder;
    health health;
    integrity integrity;
    upb_ledger ledger;
    upb_bus bus;
    uint64_t bus_step_ns;

    /* virtual time: when work on the last packets began */
    uint32_t queue_next;
    uint64_t queue_begun_ns[VIRTUAL_QUEUE_MAX];
};

/* ---------------------------------------------------------------------------------------------- time */

static inline int daemon_is_virtual(const upb_daemon *d) { return d->config.clock.now_ns == NULL; }

/* The present. Never goes back. */
uint64_t daemon_now(upb_daemon *d);
/* Virtual time is at least this. */
void daemon_time_at_least(upb_daemon *d, uint64_t now_ns);

static inline uint64_t saturating_minus(uint64_t a, uint64_t b) { return a > b ? a - b : 0; }

/* ---------------------------------------------------------------------------------------------- parts */

static inline int daemon_detects(const upb_daemon *d, upb_fault fault) {
    return !(d->config.sabotage >> (fault - 1) & 1);
}
static inline int daemon_reacts(const upb_daemon *d, daemon_reaction reaction) {
    return !(d->config.sabotage >> (UPB_FAULTS + (uint32_t)reaction) & 1);
}

void daemon_event(upb_daemon *d, upb_event_kind kind, uint32_t a, uint32_t b, uint64_t value);

/* daemon_ladder.c: before work on a packet; the mode it is to be worked on in is then in force. */
void daemon_ladder_init(upb_daemon *d);
void daemon_ladder_look(upb_daemon *d, uint64_t begin_ns);
void daemon_ladder_apply(upb_daemon *d);
/* A packet took so long. */
void daemon_ladder_worked(upb_daemon *d, uint64_t service_ns);

/* daemon_stream.c */
void daemon_take_firing(upb_daemon *d, const upb_firing *firing, const upb_firing *second, uint64_t received_ns);
/* Hands out what is pending. `partial`: the last frame is not whole. The next firing begins a new segment. */
void daemon_end_segment(upb_daemon *d, int partial);
/* What is pending is lost, and its frames close in part. */
void daemon_drop_segment(upb_daemon *d);
/* The tracker knows nothing any more: the next firing begins a frame of its own. */
void daemon_forget_turn(upb_daemon *d);
upb_status daemon_check_model(const upb_daemon_config *config, const upb_model *model, int any_model, upb_error *error);
void daemon_begin_stream(upb_daemon *d, uint32_t columns);

/* daemon_output.c */
void daemon_output_column(upb_daemon *d, const upb_wire_column *column, const upb_wire_column *second, uint64_t frame);
void daemon_output_end(upb_daemon *d);
void daemon_output_begin(upb_daemon *d);
/* The last packet with a column of the frame has left. */
void daemon_close_frame(upb_daemon *d, uint64_t frame);

/* daemon_health.c */
void daemon_report(upb_daemon *d, upb_fault fault, upb_monitor look, uint64_t value);
void daemon_health_firing(upb_daemon *d, const upb_firing *firing);
void daemon_health_look(upb_daemon *d, int whole_frame);
void daemon_health_forget(upb_daemon *d);

/* daemon_integrity.c */
void daemon_integrity_init(upb_daemon *d);
void daemon_integrity_stream_made(upb_daemon *d);
void daemon_integrity_step(upb_daemon *d, size_t bytes);
uint32_t daemon_integrity_period(const upb_daemon *d);

/* daemon_bus.c */
upb_status daemon_bus_init(upb_daemon *d);
void daemon_bus_step(upb_daemon *d, uint64_t now_ns);
/* Events of the faults that the bus keeps itself; `before`: those active before it was called. */
void daemon_note_bus_faults(upb_daemon *d, uint64_t before);

#endif /* UPB_DAEMON_INTERNAL_H */
