/*
 * CAN frames over Linux SocketCAN (raw sockets with FD frames). Non-blocking: what does not fit now is BUSY. Nothing in
 * this project's tests has a CAN interface: the calls are tested against a stand-in, and the transport was not run on a
 * bus.
 */
#ifndef UPB_SOCKETCAN_H
#define UPB_SOCKETCAN_H

#include <sys/socket.h>
#include <sys/types.h>

#include "upbeam/can.h"

#ifdef __cplusplus
extern "C" {
#endif

/* The system calls in use; a test puts its own here. Null to upb_socketcan_open: the machine's. */
typedef struct upb_socket_calls {
    int (*open)(int domain, int type, int protocol);
    unsigned (*interface_index)(const char *name);
    int (*set_option)(int fd, int level, int name, const void *value, socklen_t bytes);
    int (*bind)(int fd, const struct sockaddr *address, socklen_t bytes);
    ssize_t (*send)(int fd, const void *bytes, size_t count, int flags);
    ssize_t (*receive)(int fd, void *bytes, size_t count, int flags);
    int (*close)(int fd);
} upb_socket_calls;

typedef struct upb_socketcan {
    upb_socket_calls calls;
    int fd;           /* -1: closed. For poll(): readable when a frame waits */
    int bus_off;      /* the controller reported bus-off and has not reported a restart */
    int error;        /* errno of the last call that failed */
    const char *what; /* the call that failed, static */
    uint64_t refused; /* frames received that are neither data frames nor error frames of a known form */
    uint64_t busy;    /* sends that found no room */
    uint64_t failed;  /* sends that failed */
} upb_socketcan;

/*
 * Opens interface `name` ("can0") for the `count` identifiers of `ids` (11 bits; 0: all frames). 0, or -1: `what` and
 * `error` tell, nothing is open.
 */
int upb_socketcan_open(upb_socketcan *port, const char *name, const uint32_t *ids, size_t count,
                       const upb_socket_calls *calls);
/* The transport of the port. */
upb_can_transport upb_socketcan_transport(upb_socketcan *port);
/* 1: *frame is the next frame; 0: none waits; -1: the socket failed. */
int upb_socketcan_receive(upb_socketcan *port, upb_can_frame *frame);
void upb_socketcan_close(upb_socketcan *port);

#ifdef __cplusplus
}
#endif

#endif /* UPB_SOCKETCAN_H */
