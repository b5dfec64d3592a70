/* SocketCAN: Linux's documentation of CAN sockets is Documentation/networking/can.rst. */
#include "upb_socketcan.h"

#include <errno.h>
#include <fcntl.h>
#include <linux/can.h>
#include <linux/can/error.h>
#include <linux/can/raw.h>
#include <net/if.h>
#include <string.h>
#include <unistd.h>

enum { FILTERS_MAX = 8, FRAMES_MAX = 64 };

static const upb_socket_calls machine_calls = {socket, if_nametoindex, setsockopt, bind, send, recv, close};

static int fail(upb_socketcan *port, const char *what, int error) {
    upb_socketcan_close(port);
    port->what = what;
    port->error = error;
    return -1;
}

static int set_filters(upb_socketcan *port, const uint32_t *ids, size_t count) {
    struct can_filter filters[FILTERS_MAX];
    if (!count)
        return 0;
    for (size_t i = 0; i < count; i++)
        filters[i] = (struct can_filter){ids[i], CAN_EFF_FLAG | CAN_RTR_FLAG | CAN_SFF_MASK};
    return port->calls.set_option(port->fd, SOL_CAN_RAW, CAN_RAW_FILTER, filters,
                                  (socklen_t)(count * sizeof filters[0]));
}

int upb_socketcan_open(upb_socketcan *port, const char *name, const uint32_t *ids, size_t count,
                       const upb_socket_calls *calls) {
    const int on = 1;
    const can_err_mask_t errors = CAN_ERR_BUSOFF | CAN_ERR_RESTARTED;
    memset(port, 0, sizeof *port);
    port->calls = calls ? *calls : machine_calls;
    port->fd = -1;
    if (count > FILTERS_MAX)
        return fail(port, "more identifiers than filters", EINVAL);
    struct sockaddr_can address;
    memset(&address, 0, sizeof address);
    address.can_family = AF_CAN;
    address.can_ifindex = (int)port->calls.interface_index(name);
    if (!address.can_ifindex)
        return fail(port, "interface name", errno);
    port->fd = port->calls.open(PF_CAN, SOCK_RAW | SOCK_NONBLOCK | SOCK_CLOEXEC, CAN_RAW);
    if (port->fd < 0)
        return fail(port, "socket", errno);
    if (port->calls.set_option(port->fd, SOL_CAN_RAW, CAN_RAW_FD_FRAMES, &on, sizeof on) < 0)
        return fail(port, "CAN_RAW_FD_FRAMES", errno);
    if (port->calls.set_option(port->fd, SOL_CAN_RAW, CAN_RAW_ERR_FILTER, &errors, sizeof errors) < 0)
        return fail(port, "CAN_RAW_ERR_FILTER", errno);
    if (set_filters(port, ids, count) < 0)
        return fail(port, "CAN_RAW_FILTER", errno);
    if (port->calls.bind(port->fd, (const struct sockaddr *)&address, sizeof address) < 0)
        return fail(port, "bind", errno);
    return 0;
}

void upb_socketcan_close(upb_socketcan *port) {
    if (port->fd >= 0)
        port->calls.close(port->fd);
    port->fd = -1;
}

/* -------------------------------------------------------------------------------------------------- send */

/* A classic and an FD frame begin alike; the number of bytes written tells the kernel which it is. */
static size_t to_kernel(const upb_can_frame *frame, struct canfd_frame *raw) {
    memset(raw, 0, sizeof *raw);
    raw->can_id = frame->id | (frame->flags & UPB_CAN_EXTENDED ? CAN_EFF_FLAG : 0);
    raw->len = frame->length;
    raw->flags = frame->flags & UPB_CAN_BRS ? CANFD_BRS : 0;
    memcpy(raw->data, frame->data, frame->length);
    return frame->flags & UPB_CAN_FD ? CANFD_MTU : CAN_MTU;
}

static upb_send send_frame(void *user, const upb_can_frame *frame) {
    upb_socketcan *port = user;
    struct canfd_frame raw;
    const size_t count = to_kernel(frame, &raw);
    if (port->fd >= 0 && !port->bus_off) {
        if (port->calls.send(port->fd, &raw, count, 0) == (ssize_t)count)
            return UPB_SEND_DONE;
        port->error = errno;
        port->what = "send";
        if (errno == EAGAIN || errno == ENOBUFS || errno == EINTR) {
            port->busy++;
            return UPB_SEND_BUSY;
        }
    }
    port->failed++;
    return UPB_SEND_FAILED;
}

upb_can_transport upb_socketcan_transport(upb_socketcan *port) { return (upb_can_transport){send_frame, port}; }

/* ----------------------------------------------------------------------------------------------- receive */

static void note_error_frame(upb_socketcan *port, const struct canfd_frame *raw) {
    if (raw->can_id & CAN_ERR_BUSOFF)
        port->bus_off = 1;
    if (raw->can_id & CAN_ERR_RESTARTED)
        port->bus_off = 0;
}

static int from_kernel(const struct canfd_frame *raw, size_t count, upb_can_frame *frame) {
    memset(frame, 0, sizeof *frame);
    if ((count != CAN_MTU && count != CANFD_MTU) || raw->can_id & CAN_RTR_FLAG || raw->len > sizeof frame->data)
        return 0;
    frame->id = raw->can_id & CAN_EFF_MASK;
    frame->length = raw->len;
    if (raw->can_id & CAN_EFF_FLAG)
        frame->flags |= UPB_CAN_EXTENDED;
    if (count == CANFD_MTU)
        frame->flags |= (uint8_t)(UPB_CAN_FD | (raw->flags & CANFD_BRS ? UPB_CAN_BRS : 0));
    memcpy(frame->data, raw->data, raw->len);
    return upb_can_frame_is_valid(frame);
}

int upb_socketcan_receive(upb_socketcan *port, upb_can_frame *frame) {
    /* Bounded: a bus full of error frames may not hold the caller. */
    for (int i = 0; i < FRAMES_MAX; i++) {
        struct canfd_frame raw;
        memset(&raw, 0, sizeof raw);
        const ssize_t count = port->fd >= 0 ? port->calls.receive(port->fd, &raw, sizeof raw, 0) : -1;
        if (count < 0) {
            if (port->fd >= 0 && (errno == EAGAIN || errno == EWOULDBLOCK || errno == EINTR))
                return 0;
            port->error = port->fd >= 0 ? errno : EBADF;
            port->what = "receive";
            return -1;
        }
        if (raw.can_id & CAN_ERR_FLAG)
            note_error_frame(port, &raw);
        else if (from_kernel(&raw, (size_t)count, frame))
            return 1;
        else
            port->refused++;
    }
    return 0;
}
