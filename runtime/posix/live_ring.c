#include "live_ring.h"

#include <stdlib.h>
#include <string.h>

#include "upbeam/upbeam.h"

int live_ring_init(live_ring *ring, uint32_t capacity, uint32_t columns_per_packet) {
    const size_t pixels = (size_t)capacity * columns_per_packet * UPB_BEAMS;

    ring->capacity = capacity;
    ring->columns_per_packet = columns_per_packet;
    ring->packets = calloc(capacity, sizeof *ring->packets);
    ring->distance = calloc(pixels, sizeof *ring->distance);
    ring->intensity = calloc(pixels, sizeof *ring->intensity);
    atomic_init(&ring->head, 0);
    atomic_init(&ring->tail, 0);
    return ring->packets != NULL && ring->distance != NULL && ring->intensity != NULL;
}

void live_ring_free(live_ring *ring) {
    free(ring->packets);
    free(ring->distance);
    free(ring->intensity);
}

int live_ring_put(live_ring *ring, const live_packet *packet) {
    const uint64_t head = atomic_load_explicit(&ring->head, memory_order_relaxed);
    const uint64_t tail = atomic_load_explicit(&ring->tail, memory_order_acquire);
    if (head - tail >= ring->capacity)
        return 0;

    const size_t slot = (size_t)(head & (ring->capacity - 1u));
    const size_t start = slot * ring->columns_per_packet * UPB_BEAMS;
    const size_t pixels = (size_t)packet->columns * UPB_BEAMS;
    memcpy(ring->distance + start, packet->distance, pixels * sizeof *ring->distance);
    memcpy(ring->intensity + start, packet->intensity, pixels * sizeof *ring->intensity);
    ring->packets[slot] = *packet;
    ring->packets[slot].distance = ring->distance + start;
    ring->packets[slot].intensity = ring->intensity + start;
    atomic_store_explicit(&ring->head, head + 1, memory_order_release);
    return 1;
}

const live_packet *live_ring_peek(live_ring *ring) {
    const uint64_t tail = atomic_load_explicit(&ring->tail, memory_order_relaxed);
    if (tail == atomic_load_explicit(&ring->head, memory_order_acquire))
        return NULL;
    return &ring->packets[tail & (ring->capacity - 1u)];
}

void live_ring_release(live_ring *ring) {
    const uint64_t tail = atomic_load_explicit(&ring->tail, memory_order_relaxed);
    atomic_store_explicit(&ring->tail, tail + 1, memory_order_release);
}
