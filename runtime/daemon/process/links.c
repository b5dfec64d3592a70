/* What the daemon sends, and what comes in on its buses. Nothing here waits. */
#define _GNU_SOURCE
#include <errno.h>
#include <sys/socket.h>
#include <unistd.h>

#include "process.h"

/* ---------------------------------------------------------------------------------------------- sending */

static void send_datagram(process *p, int fd, const void *data, size_t bytes) {
    if (send(fd, data, bytes, MSG_DONTWAIT | MSG_NOSIGNAL) != (ssize_t)bytes)
        p->counts.send_failed++;
}

void links_send_columns(void *user, uint64_t time_ns, const uint8_t *data, size_t bytes) {
    process *p = user;
    (void)time_ns;
    send_datagram(p, p->columns_fd, data, bytes);
}

void links_send_hdl64(void *user, uint64_t time_ns, const uint8_t *data, size_t bytes) {
    process *p = user;
    (void)time_ns;
    send_datagram(p, p->hdl64_fd, data, bytes);
}

upb_send links_send_can(void *user, uint64_t time_ns, const upb_can_frame *frame) {
    process *p = user;
    uint8_t bytes[UPB_CAN_WIRE_MAX];
    (void)time_ns;
#ifdef UPBEAMD_SOCKETCAN
    if (p->has_socketcan) {
        const upb_can_transport transport = upb_socketcan_transport(&p->socketcan);
        return transport.send(transport.user, frame);
    }
#endif
    const size_t count = upb_can_frame_encode(frame, bytes);
    const ssize_t sent = sendto(p->can_fd, bytes, count, MSG_DONTWAIT | MSG_NOSIGNAL,
                                (const struct sockaddr *)&p->can_to, sizeof p->can_to);
    if (sent == (ssize_t)count)
        return UPB_SEND_DONE;
    return errno == EAGAIN || errno == ENOBUFS ? UPB_SEND_BUSY : UPB_SEND_FAILED;
}

/* All or nothing: a record that fits the line's buffer in part would be two broken ones. */
upb_send links_send_serial(void *user, uint64_t time_ns, const uint8_t *data, size_t bytes) {
    process *p = user;
    (void)time_ns;
    const ssize_t sent = write(p->serial_fd, data, bytes);
    if (sent == (ssize_t)bytes)
        return UPB_SEND_DONE;
    return sent < 0 && errno == EAGAIN ? UPB_SEND_BUSY : UPB_SEND_FAILED;
}

/* --------------------------------------------------------------------------------------------- the buses */

void links_take_can(process *p) {
    uint8_t bytes[UPB_CAN_WIRE_MAX + 1];
    upb_can_frame frame;
#ifdef UPBEAMD_SOCKETCAN
    if (p->has_socketcan) {
        while (upb_socketcan_receive(&p->socketcan, &frame) == 1)
            upb_daemon_can(p->daemon, &frame, process_now(NULL));
        return;
    }
#endif
    for (unsigned i = 0; i < BATCH; i++) {
        const ssize_t count = recv(p->can_fd, bytes, sizeof bytes, MSG_DONTWAIT);
        if (count < 0)
            return;
        if (upb_can_frame_decode(bytes, (size_t)count, &frame) == UPB_OK)
            upb_daemon_can(p->daemon, &frame, process_now(NULL));
        else
            p->counts.can_failed++;
    }
}

void links_take_serial(process *p) {
    uint8_t bytes[512];
    const ssize_t count = read(p->serial_fd, bytes, sizeof bytes);
    if (count > 0)
        upb_daemon_serial(p->daemon, bytes, (size_t)count, process_now(NULL));
    else if (count == 0 || errno != EAGAIN) { /* the line is gone */
        close(p->serial_fd);
        p->serial_fd = -1;
    }
}
