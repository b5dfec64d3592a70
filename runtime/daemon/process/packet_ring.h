/* A ring of datagrams between the thread that receives them and the one that works on them, without locks. */
#ifndef UPBEAMD_PACKET_RING_H
#define UPBEAMD_PACKET_RING_H

#include <stddef.h>
#include <stdint.h>

#include "spsc.h"

#define RING_DATAGRAM_MAX 1500u /* what is longer is cut: no packet of a sensor is */

typedef enum ring_kind { RING_DATA = 0, RING_POSITION = 1 } ring_kind;

typedef struct ring_datagram {
    uint64_t received_ns;
    uint32_t source_ipv4; /* host byte order */
    uint16_t bytes;       /* RING_DATAGRAM_MAX + 1: it was longer */
    uint16_t kind;        /* ring_kind */
    uint8_t data[RING_DATAGRAM_MAX + 1];
} ring_datagram;

typedef struct packet_ring {
    ring_datagram *slots; /* [capacity], of the caller */
    spsc index;
    _Alignas(SPSC_CACHE_LINE) _Atomic uint64_t full; /* data packets that found no slot */
} packet_ring;

void packet_ring_init(packet_ring *ring, ring_datagram *slots, uint32_t capacity);

/* Producer: the slot to fill next, or null if the ring is full. It is in the ring once packet_ring_publish was called.
 */
ring_datagram *packet_ring_claim(packet_ring *ring);
void packet_ring_publish(packet_ring *ring);
/* Producer: a data packet was received and found no slot. */
void packet_ring_count_full(packet_ring *ring);

/* Consumer: the oldest datagram, in place, or null. It stays until packet_ring_release. */
const ring_datagram *packet_ring_peek(packet_ring *ring);
void packet_ring_release(packet_ring *ring);
/* Consumer: data packets that found no slot since the last call. */
uint64_t packet_ring_take_full(packet_ring *ring);

#endif /* UPBEAMD_PACKET_RING_H */
