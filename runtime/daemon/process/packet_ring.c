#include "packet_ring.h"

void packet_ring_init(packet_ring *ring, ring_datagram *slots, uint32_t capacity) {
    ring->slots = slots;
    ring->capacity = capacity;
    atomic_init(&ring->head, 0);
    atomic_init(&ring->tail, 0);
    atomic_init(&ring->full, 0);
}

ring_datagram *packet_ring_claim(packet_ring *ring) {
    const uint64_t head = atomic_load_explicit(&ring->head, memory_order_relaxed);
    if (head - atomic_load_explicit(&ring->tail, memory_order_acquire) >= ring->capacity)
        return NULL;
    return &ring->slots[head & (ring->capacity - 1u)];
}

void packet_ring_publish(packet_ring *ring) {
    const uint64_t head = atomic_load_explicit(&ring->head, memory_order_relaxed);
    atomic_store_explicit(&ring->head, head + 1, memory_order_release);
}

void packet_ring_count_full(packet_ring *ring) { atomic_fetch_add_explicit(&ring->full, 1, memory_order_relaxed); }

const ring_datagram *packet_ring_peek(packet_ring *ring) {
    const uint64_t tail = atomic_load_explicit(&ring->tail, memory_order_relaxed);
    if (tail == atomic_load_explicit(&ring->head, memory_order_acquire))
        return NULL;
    return &ring->slots[tail & (ring->capacity - 1u)];
}

void packet_ring_release(packet_ring *ring) {
    const uint64_t tail = atomic_load_explicit(&ring->tail, memory_order_relaxed);
    atomic_store_explicit(&ring->tail, tail + 1, memory_order_release);
}

uint64_t packet_ring_take_full(packet_ring *ring) {
    return atomic_exchange_explicit(&ring->full, 0, memory_order_relaxed);
}
