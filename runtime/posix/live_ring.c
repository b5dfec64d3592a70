#include "live_ring.h"

#include <stdlib.h>
#include <string.h>

#include "upbeam/upbeam.h"

int live_ring_init(live_ring *ring, uint32_t capacity, uint32_t columns_per_packet) {
    const size_t pixels = (size_t)capacity * columns_per_packet * UPB_BEAMS;

    spsc_init(&ring->index, capacity);
    ring->columns_per_packet = columns_per_packet;
    ring->packets = calloc(capacity, sizeof *ring->packets);
    ring->distance = calloc(pixels, sizeof *ring->distance);
    ring->intensity = calloc(pixels, sizeof *ring->intensity);
    return ring->packets != NULL && ring->distance != NULL && ring->intensity != NULL;
}

void live_ring_free(live_ring *ring) {
    free(ring->packets);
    free(ring->distance);
    free(ring->intensity);
}

int live_ring_put(live_ring *ring, const live_packet *packet) {
    const uint32_t slot = spsc_claim(&ring->index);
    if (slot == SPSC_NONE)
        return 0;

    const size_t start = (size_t)slot * ring->columns_per_packet * UPB_BEAMS;
    const size_t pixels = (size_t)packet->columns * UPB_BEAMS;
    memcpy(ring->distance + start, packet->distance, pixels * sizeof *ring->distance);
    memcpy(ring->intensity + start, packet->intensity, pixels * sizeof *ring->intensity);
    ring->packets[slot] = *packet;
    ring->packets[slot].distance = ring->distance + start;
    ring->packets[slot].intensity = ring->intensity + start;
    spsc_publish(&ring->index);
    return 1;
}

const live_packet *live_ring_peek(live_ring *ring) {
    const uint32_t slot = spsc_peek(&ring->index);
    return slot == SPSC_NONE ? NULL : &ring->packets[slot];
}

void live_ring_release(live_ring *ring) { spsc_release(&ring->index); }
