#include "packet_ring.h"

void packet_ring_init(packet_ring *ring, ring_datagram *slots, uint32_t capacity) {
    ring->slots = slots;
    spsc_init(&ring->index, capacity);
    atomic_init(&ring->full, 0);
}

ring_datagram *packet_ring_claim(packet_ring *ring) {
    const uint32_t slot = spsc_claim(&ring->index);
    return slot == SPSC_NONE ? NULL : &ring->slots[slot];
}

void packet_ring_publish(packet_ring *ring) { spsc_publish(&ring->index); }

void packet_ring_count_full(packet_ring *ring) { atomic_fetch_add_explicit(&ring->full, 1, memory_order_relaxed); }

const ring_datagram *packet_ring_peek(packet_ring *ring) {
    const uint32_t slot = spsc_peek(&ring->index);
    return slot == SPSC_NONE ? NULL : &ring->slots[slot];
}

void packet_ring_release(packet_ring *ring) { spsc_release(&ring->index); }

uint64_t packet_ring_take_full(packet_ring *ring) {
    return atomic_exchange_explicit(&ring->full, 0, memory_order_relaxed);
}
