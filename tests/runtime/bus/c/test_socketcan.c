/* The SocketCAN transport against a stand-in for the machine's socket calls. It was not run on a bus. */
#include <errno.h>
#include <linux/can.h>
#include <linux/can/error.h>
#include <linux/can/raw.h>

#include "check.h"
#include "upb_socketcan.h"

/* The stand-in's memory: what it was asked, what it answers. One test program, one socket. */
static struct {
    int fail_at; /* number of the call of open, options and bind that fails */
    int calls, open, filters;
    struct canfd_frame sent, waiting[128];
    size_t sent_bytes, waiting_bytes[128];
    int first, count, send_errno;
} fake;

static int step(void) {
    errno = EPERM;
    return ++fake.calls == fake.fail_at ? -1 : 0;
}

static int fake_open(int domain, int type, int protocol) {
    CHECK(domain == PF_CAN && type & SOCK_RAW && protocol == CAN_RAW);
    if (step())
        return -1;
    fake.open++;
    return 7;
}

static unsigned fake_index(const char *name) { return strcmp(name, "can0") == 0 ? 3 : 0; }

static int fake_option(int fd, int level, int name, const void *value, socklen_t bytes) {
    CHECK(fd == 7 && level == SOL_CAN_RAW && value);
    if (name == CAN_RAW_FILTER)
        fake.filters = (int)(bytes / sizeof(struct can_filter));
    return step();
}

static int fake_bind(int fd, const struct sockaddr *address, socklen_t bytes) {
    struct sockaddr_can can;
    CHECK(fd == 7 && bytes == sizeof can);
    memcpy(&can, address, sizeof can);
    CHECK(can.can_family == AF_CAN && can.can_ifindex == 3);
    return step();
}

static ssize_t fake_send(int fd, const void *bytes, size_t count, int flags) {
    CHECK(fd == 7 && flags == 0 && count <= sizeof fake.sent);
    if (fake.send_errno) {
        errno = fake.send_errno;
        return -1;
    }
    memcpy(&fake.sent, bytes, count);
    fake.sent_bytes = count;
    return (ssize_t)count;
}

static ssize_t fake_receive(int fd, void *bytes, size_t count, int flags) {
    CHECK(fd == 7 && flags == 0 && count == sizeof(struct canfd_frame));
    if (fake.first == fake.count) {
        errno = EAGAIN;
        return -1;
    }
    memcpy(bytes, &fake.waiting[fake.first], fake.waiting_bytes[fake.first]);
    return (ssize_t)fake.waiting_bytes[fake.first++];
}

static int fake_close(int fd) {
    CHECK(fd == 7);
    fake.open--;
    return 0;
}

static const upb_socket_calls fake_calls = {fake_open, fake_index,   fake_option, fake_bind,
                                            fake_send, fake_receive, fake_close};
static const uint32_t ids[] = {0x300, 0x7a0, 0x7df};

static void arrive(uint32_t id, uint8_t length, size_t bytes) {
    fake.waiting[fake.count] = (struct canfd_frame){.can_id = id, .len = length, .flags = CANFD_BRS, .data = {1, 2, 3}};
    fake.waiting_bytes[fake.count++] = bytes;
}

static void test_open(void) {
    upb_socketcan port;
    for (int call = 1; call <= 5; call++) {
        memset(&fake, 0, sizeof fake);
        fake.fail_at = call;
        CHECK_EQUAL(upb_socketcan_open(&port, "can0", ids, 3, &fake_calls), -1);
        CHECK(port.what && port.error == EPERM && port.fd == -1);
        CHECK_EQUAL(fake.open, 0);
    }
    memset(&fake, 0, sizeof fake);
    CHECK_EQUAL(upb_socketcan_open(&port, "can9", ids, 3, &fake_calls), -1);
    CHECK(strcmp(port.what, "interface name") == 0);
    CHECK_EQUAL(upb_socketcan_open(&port, "can0", ids, 3, &fake_calls), 0);
    CHECK_EQUAL(fake.filters, 3);
    upb_socketcan_close(&port);
    upb_socketcan_close(&port);
    CHECK_EQUAL(fake.open, 0);
}

static void test_send(void) {
    upb_socketcan port;
    memset(&fake, 0, sizeof fake);
    upb_socketcan_open(&port, "can0", ids, 3, &fake_calls);
    const upb_can_transport transport = upb_socketcan_transport(&port);
    const upb_can_frame classic = {.id = 0x210, .length = 8, .data = {9}};
    const upb_can_frame fd = {.id = 0x1abcdef, .flags = UPB_CAN_FD | UPB_CAN_BRS | UPB_CAN_EXTENDED, .length = 64};
    CHECK_EQUAL(transport.send(transport.user, &classic), UPB_SEND_DONE);
    CHECK(fake.sent_bytes == CAN_MTU && fake.sent.can_id == 0x210 && fake.sent.len == 8 && fake.sent.data[0] == 9);
    CHECK_EQUAL(transport.send(transport.user, &fd), UPB_SEND_DONE);
    CHECK(fake.sent_bytes == CANFD_MTU && fake.sent.can_id == (0x1abcdef | CAN_EFF_FLAG) &&
          fake.sent.flags == CANFD_BRS);
    fake.send_errno = ENOBUFS;
    CHECK_EQUAL(transport.send(transport.user, &classic), UPB_SEND_BUSY);
    fake.send_errno = ENETDOWN;
    CHECK_EQUAL(transport.send(transport.user, &classic), UPB_SEND_FAILED);
    CHECK(port.busy == 1 && port.failed == 1 && port.error == ENETDOWN);
    upb_socketcan_close(&port);
    CHECK_EQUAL(transport.send(transport.user, &classic), UPB_SEND_FAILED);
}

static void test_receive(void) {
    upb_socketcan port;
    upb_can_frame frame;
    memset(&fake, 0, sizeof fake);
    upb_socketcan_open(&port, "can0", ids, 3, &fake_calls);
    const upb_can_transport transport = upb_socketcan_transport(&port);
    arrive(0x7a0, 3, CAN_MTU);
    arrive(0x300, 24, CANFD_MTU);
    arrive(0x300, 9, CANFD_MTU);              /* no such length on the wire */
    arrive(0x300 | CAN_RTR_FLAG, 0, CAN_MTU); /* a remote frame */
    arrive(0x300, 8, CAN_MTU - 1);            /* half a frame */
    CHECK_EQUAL(upb_socketcan_receive(&port, &frame), 1);
    CHECK(frame.id == 0x7a0 && frame.flags == 0 && frame.length == 3 && frame.data[2] == 3);
    CHECK_EQUAL(upb_socketcan_receive(&port, &frame), 1);
    CHECK(frame.id == 0x300 && frame.flags == (UPB_CAN_FD | UPB_CAN_BRS) && frame.length == 24);
    CHECK_EQUAL(upb_socketcan_receive(&port, &frame), 0);
    CHECK_EQUAL(port.refused, 3);
    arrive(CAN_ERR_FLAG | CAN_ERR_BUSOFF, 8, CAN_MTU);
    CHECK_EQUAL(upb_socketcan_receive(&port, &frame), 0);
    CHECK_EQUAL(transport.send(transport.user, &frame), UPB_SEND_FAILED);
    arrive(CAN_ERR_FLAG | CAN_ERR_RESTARTED, 8, CAN_MTU);
    CHECK_EQUAL(upb_socketcan_receive(&port, &frame), 0);
    CHECK(!port.bus_off);
    while (fake.count < 128) /* a flood of error frames ends the call, not the caller */
        arrive(CAN_ERR_FLAG, 8, CAN_MTU);
    CHECK_EQUAL(upb_socketcan_receive(&port, &frame), 0);
    CHECK(fake.first < fake.count);
    upb_socketcan_close(&port);
    CHECK_EQUAL(upb_socketcan_receive(&port, &frame), -1);
}

int main(void) {
    test_open();
    test_send();
    test_receive();
    return check_report("socketcan (stand-in calls; not run on a bus)");
}
