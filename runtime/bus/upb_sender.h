/* Status messages out on one channel: used inside the bus library. */
#ifndef UPB_SENDER_H
#define UPB_SENDER_H

#include "upbeam/bus.h"

/* Where a sender's frames go. */
typedef struct upb_channel {
    upb_send (*emit)(void *user, const upb_can_frame *frame);
    void *user;
} upb_channel;

void upb_sender_init(upb_sender *sender, uint64_t now_ns);
/* All messages are due now. */
void upb_sender_hurry(upb_sender *sender, uint64_t now_ns);
void upb_sender_queue(upb_sender *sender, const upb_ledger_record *record);
/* Sends what is due, the ledger first; stops when the channel has no room. */
void upb_sender_step(upb_sender *sender, const upb_bus *bus, const upb_channel *channel, uint64_t now_ns);

/* A counter of the snapshot, or the bus's own. */
uint64_t upb_bus_counter(const upb_bus *bus, uint32_t counter);

#endif /* UPB_SENDER_H */
