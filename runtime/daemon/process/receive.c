/* The receiving thread: datagrams of the sensor's two ports into the ring. */
#define _GNU_SOURCE
#include <arpa/inet.h>
#include <errno.h>
#include <poll.h>
#include <string.h>
#include <sys/socket.h>
#include <unistd.h>

#include "process.h"

enum { RECEIVE_WAIT_MS = 100 };

static void take_batch(process *p, int fd, ring_kind kind) {
    uint8_t data[BATCH][RING_DATAGRAM_MAX + 1];
    struct sockaddr_in from[BATCH];
    struct iovec parts[BATCH];
    struct mmsghdr messages[BATCH];
    for (;;) {
        memset(messages, 0, sizeof messages);
        for (unsigned i = 0; i < BATCH; i++) {
            parts[i] = (struct iovec){data[i], sizeof data[i]};
            messages[i].msg_hdr.msg_iov = &parts[i];
            messages[i].msg_hdr.msg_iovlen = 1;
            messages[i].msg_hdr.msg_name = &from[i];
            messages[i].msg_hdr.msg_namelen = sizeof from[i];
        }
        const int count = recvmmsg(fd, messages, BATCH, MSG_DONTWAIT, NULL);
        if (count < 0 && errno != EAGAIN && errno != EINTR)
            atomic_fetch_add(&p->receive_failed, 1);
        if (count <= 0)
            return;
        const uint64_t now = process_now(NULL);
        for (int i = 0; i < count; i++) {
            ring_datagram *slot = packet_ring_claim(&p->ring);
            if (!slot && kind == RING_DATA)
                packet_ring_count_full(&p->ring);
            else if (!slot)
                atomic_fetch_add(&p->positions_full, 1);
            if (!slot)
                continue;
            slot->received_ns = now;
            slot->source_ipv4 = ntohl(from[i].sin_addr.s_addr);
            slot->bytes = (uint16_t)messages[i].msg_len;
            slot->kind = (uint16_t)kind;
            memcpy(slot->data, data[i], messages[i].msg_len);
            packet_ring_publish(&p->ring);
        }
        if (count < BATCH)
            return;
    }
}

static void wake_worker(process *p) {
    const char byte = 0;
    if (atomic_exchange(&p->sleeping, 0) && write(p->wake[1], &byte, 1) < 0)
        return; /* full: it is awake */
}

void *process_receive(void *user) {
    process *p = user;
    struct pollfd fds[2] = {{.fd = p->data_fd, .events = POLLIN}, {.fd = p->position_fd, .events = POLLIN}};
    while (!atomic_load(&p->stop)) {
        const int ready = poll(fds, 2, RECEIVE_WAIT_MS);
        if (ready <= 0)
            continue;
        if (fds[0].revents)
            take_batch(p, p->data_fd, RING_DATA);
        if (fds[1].revents)
            take_batch(p, p->position_fd, RING_POSITION);
        wake_worker(p);
    }
    return NULL;
}
