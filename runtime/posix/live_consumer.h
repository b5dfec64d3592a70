/* Takes packets, pushes their columns into the stream, collects the output and closes the frames in the ledger. */
#ifndef UPBEAM_LIVE_CONSUMER_H
#define UPBEAM_LIVE_CONSUMER_H

#include <stdatomic.h>

#include "live_clock.h"
#include "live_ring.h"
#include "upb_live.h"

#define LIVE_OPEN_FRAMES 8u /* more than a ledger holds open */

typedef struct live_image {
    uint64_t frame;
    uint32_t columns_out;
    uint16_t *distance; /* [columns][UPB_ROWS] */
    uint8_t *intensity;
} live_image;

typedef struct live_received {
    uint64_t frame;
    uint32_t columns;
} live_received;

typedef struct live_consumer {
    const upb_live_config *config;
    live_clock *clock;
    upb_stream *stream;
    upb_ledger ledger;
    upb_ledger_record ledger_last; /* the ledger's own ring: `frames` below keeps them all */

    upb_live_frame *frames; /* [frame_capacity] */
    size_t frame_capacity, frame_count;
    live_received received[LIVE_OPEN_FRAMES]; /* by frame modulo LIVE_OPEN_FRAMES */

    live_image *images; /* [keep_count], then two that take turns for the other frames */
    live_image *image;  /* being filled, or null */
    live_image *last;   /* last one with a last column, or null */
    size_t keep_next;   /* keep_frames before it have passed */
    uint32_t spare;     /* which of the two is next */

    uint64_t frames_total; /* that can come out */
    uint64_t frames_empty;
    uint32_t shift;       /* azimuth column of firing column 0: frames are counted by azimuth */
    uint64_t base_frame;  /* the stream's frame 0 in the run's numbers */
    uint64_t next_column; /* expected next, counted from the start of the run */
    uint64_t packet_ns;   /* when the packet at hand was received */
    uint32_t probing;     /* the stream is being asked, not fed */
    uint32_t started;     /* a packet was taken */
    uint32_t begins_late; /* the first column taken was not at the start of a turn */
    uint32_t flushing;    /* the end has come */

    uint64_t packets_taken, columns_taken, columns_out, columns_incomplete, columns_refused;
    upb_histogram column_compute, packet_compute;

    /* For upb_live_get_progress. */
    _Atomic uint64_t shown_frames, shown_missed, shown_last_ns, shown_max_ns;
} live_consumer;

/* The sink to give to upb_stream_config, with the consumer as `user`. */
void live_consumer_on_column(void *user, const upb_column *column);

/* After the stream is made: finds out how the sensor's azimuth offsets renumber the columns. */
upb_status live_consumer_attach(live_consumer *consumer, upb_stream *stream);

void live_consumer_take(live_consumer *consumer, const live_packet *packet);

/* No packet follows: `columns_played` is what the sensor sent in all. Hands out the rest, closes what is open. */
void live_consumer_finish(live_consumer *consumer, uint64_t columns_played);

#endif
