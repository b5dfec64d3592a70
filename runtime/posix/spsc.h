/*
 * Indices of a ring between one producer and one consumer, without locks. The slots are the user's: what it writes into
 * a claimed one is seen by the consumer that peeks it after spsc_publish.
 */
#ifndef UPBEAM_SPSC_H
#define UPBEAM_SPSC_H

#include <stdatomic.h>
#include <stdint.h>

#define SPSC_CACHE_LINE 64u
#define SPSC_NONE UINT32_MAX

typedef struct spsc {
    uint32_t capacity; /* slots, a power of two */
    /* Each index is written by one side alone; a line of its own keeps the other side's reads from slowing it. */
    _Alignas(SPSC_CACHE_LINE) _Atomic uint64_t head; /* put in */
    _Alignas(SPSC_CACHE_LINE) _Atomic uint64_t tail; /* released */
} spsc;

static inline void spsc_init(spsc *ring, uint32_t capacity) {
    ring->capacity = capacity;
    atomic_init(&ring->head, 0);
    atomic_init(&ring->tail, 0);
}

/* Producer: the slot to fill next, or SPSC_NONE if the ring is full. */
static inline uint32_t spsc_claim(spsc *ring) {
    const uint64_t head = atomic_load_explicit(&ring->head, memory_order_relaxed);
    const uint64_t tail = atomic_load_explicit(&ring->tail, memory_order_acquire);
    return head - tail >= ring->capacity ? SPSC_NONE : (uint32_t)(head & (ring->capacity - 1u));
}

/* Producer: the claimed slot is filled. */
static inline void spsc_publish(spsc *ring) {
    const uint64_t head = atomic_load_explicit(&ring->head, memory_order_relaxed);
    atomic_store_explicit(&ring->head, head + 1, memory_order_release);
}

/* Consumer: the oldest slot, or SPSC_NONE if the ring is empty. It stays until spsc_release. */
static inline uint32_t spsc_peek(spsc *ring) {
    const uint64_t tail = atomic_load_explicit(&ring->tail, memory_order_relaxed);
    const uint64_t head = atomic_load_explicit(&ring->head, memory_order_acquire);
    return tail == head ? SPSC_NONE : (uint32_t)(tail & (ring->capacity - 1u));
}

static inline void spsc_release(spsc *ring) {
    const uint64_t tail = atomic_load_explicit(&ring->tail, memory_order_relaxed);
    atomic_store_explicit(&ring->tail, tail + 1, memory_order_release);
}

#endif
