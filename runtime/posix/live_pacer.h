/* Plays the sensor: which packet is due when, and what becomes of it. */
#ifndef UPBEAM_LIVE_PACER_H
#define UPBEAM_LIVE_PACER_H

#include <stdatomic.h>

#include "live_clock.h"
#include "live_ring.h"
#include "upb_live.h"

typedef struct live_pacer {
    const upb_live_config *config;
    live_clock *clock;
    uint64_t columns_total; /* to play */
    uint64_t next_column;
    size_t drop_next;           /* drop_packets before it have passed */
    uint16_t *wrapped_distance; /* [columns_per_packet][UPB_BEAMS]: a packet that reaches over the arrays' end */
    uint8_t *wrapped_intensity;

    upb_histogram lateness;
    uint64_t columns_played;
    uint64_t dropped_fault, dropped_overflow;
    upb_live_drop *drops; /* [drop_capacity] */
    size_t drop_capacity, drop_count;
    uint64_t drops_unlisted;

    /* For upb_live_get_progress. */
    _Atomic uint64_t shown_packets, shown_dropped;
} live_pacer;

/* When the column of that number since the start of the run is due. */
uint64_t live_pacer_due_ns(const live_pacer *pacer, uint64_t column);

/* The next packet; its columns lie in the caller's arrays where possible. 0 when all have been played. */
int live_pacer_next(live_pacer *pacer, live_packet *packet);

/* True if a fault was ordered for this packet; it is then counted. Packets must be asked for in their order. */
int live_pacer_drops(live_pacer *pacer, const live_packet *packet);
void live_pacer_overflowed(live_pacer *pacer, const live_packet *packet);
/* The packet has been played, whatever became of it. */
void live_pacer_played(live_pacer *pacer, const live_packet *packet);

/* Sleeps, then spins, until `due_ns`; sooner if *stop becomes true. */
void live_pacer_wait(const live_pacer *pacer, uint64_t due_ns, _Atomic int *stop);

#endif
