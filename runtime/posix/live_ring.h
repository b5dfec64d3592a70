/* A ring of packets between one producer and one consumer, without locks. */
#ifndef UPBEAM_LIVE_RING_H
#define UPBEAM_LIVE_RING_H

#include <stddef.h>
#include <stdint.h>

#include "spsc.h"

/* A packet's header; its columns follow in the slot, distances first. */
typedef struct live_packet {
    uint64_t sequence;     /* of the packet, from 0 */
    uint64_t first_column; /* of the packet, counted from the start of the run */
    uint64_t received_ns;
    uint32_t columns;
    const uint16_t *distance; /* [columns][UPB_BEAMS], in the slot */
    const uint8_t *intensity; /* [columns][UPB_BEAMS], in the slot */
} live_packet;

typedef struct live_ring {
    live_packet *packets; /* [capacity] */
    uint16_t *distance;   /* [capacity][columns_per_packet][UPB_BEAMS] */
    uint8_t *intensity;
    uint32_t columns_per_packet;
    spsc index;
} live_ring;

/* 0 if the heap is exhausted; live_ring_free is then still to be called. */
int live_ring_init(live_ring *ring, uint32_t capacity, uint32_t columns_per_packet);
void live_ring_free(live_ring *ring);

/* Producer: copies a packet in, as a socket would. `packet` points to the sender's columns. 0 if the ring is full. */
int live_ring_put(live_ring *ring, const live_packet *packet);

/* Consumer: the oldest packet, in place, or null. It stays in the ring until live_ring_release. */
const live_packet *live_ring_peek(live_ring *ring);
void live_ring_release(live_ring *ring);

#endif
