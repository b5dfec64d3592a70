/* A device on the tests' desk: a bus object, memory that survives restarts and can fail, and what it sent. */
#ifndef UPB_BENCH_DEVICE_H
#define UPB_BENCH_DEVICE_H

#include <string.h>

#include "upbeam/bus.h"

enum { SENT_MAX = 512, LINE_MAX_BYTES = 1 << 16 };

typedef struct bench_store {
    uint8_t bytes[3][UPB_STORE_FAULTS_BYTES];
    size_t count[3]; /* 0: never written */
    int fail_read, fail_write;
    unsigned writes[3];
} bench_store;

typedef struct bench_device {
    upb_bus bus;
    bench_store store;
    upb_can_frame sent[SENT_MAX]; /* the first SENT_MAX frames since the last bench_forget */
    unsigned sent_count;
    uint8_t line[LINE_MAX_BYTES];
    size_t line_bytes;
    upb_send can_answer, serial_answer;
    upb_command executed; /* the last command carried out */
    unsigned executions;
    upb_command_result execute_answer;
    upb_bus_snapshot snapshot;
    uint64_t now_ns;
} bench_device;

static const uint8_t bench_key[UPB_KEY_BYTES] = {0x2b, 0x7e, 0x15, 0x16, 0x28, 0xae, 0xd2, 0xa6,
                                                 0xab, 0xf7, 0x15, 0x88, 0x09, 0xcf, 0x4f, 0x3c};

static upb_stored bench_read(void *user, upb_store what, uint8_t *bytes, size_t count) {
    bench_store *store = user;
    if (store->fail_read)
        return UPB_STORED_FAILED;
    if (!store->count[what])
        return UPB_STORED_NOTHING;
    if (store->count[what] != count)
        return UPB_STORED_FAILED;
    memcpy(bytes, store->bytes[what], count);
    return UPB_STORED_DONE;
}

static upb_stored bench_write(void *user, upb_store what, const uint8_t *bytes, size_t count) {
    bench_store *store = user;
    if (store->fail_write || count > sizeof store->bytes[what])
        return UPB_STORED_FAILED;
    memcpy(store->bytes[what], bytes, count);
    store->count[what] = count;
    store->writes[what]++;
    return UPB_STORED_DONE;
}

static upb_send bench_send(void *user, const upb_can_frame *frame) {
    bench_device *device = user;
    if (device->can_answer == UPB_SEND_DONE && device->sent_count < SENT_MAX)
        device->sent[device->sent_count++] = *frame;
    return device->can_answer;
}

static upb_send bench_send_serial(void *user, const uint8_t *bytes, size_t count) {
    bench_device *device = user;
    if (device->serial_answer == UPB_SEND_DONE && device->line_bytes + count <= sizeof device->line) {
        memcpy(device->line + device->line_bytes, bytes, count);
        device->line_bytes += count;
    }
    return device->serial_answer;
}

static upb_command_result bench_execute(void *user, const upb_command *command) {
    bench_device *device = user;
    device->executed = *command;
    device->executions++;
    return device->execute_answer;
}

static inline void bench_forget(bench_device *device) { device->sent_count = 0, device->line_bytes = 0; }

/* Power on: storage, clock and the answers of the surroundings stay as they are. */
static inline upb_status bench_start(bench_device *device, const uint8_t *key) {
    upb_bus_config config = upb_bus_config_default();
    config.can.send = bench_send;
    config.serial.send = bench_send_serial;
    config.can.user = config.serial.user = config.user = device;
    config.storage.read = bench_read;
    config.storage.write = bench_write;
    config.storage.user = &device->store;
    config.key = key;
    config.execute = bench_execute;
    bench_forget(device);
    return upb_bus_init(&device->bus, &config, device->now_ns);
}

static inline void bench_step(bench_device *device, uint64_t ms) {
    for (uint64_t i = 0; i < ms; i++) {
        device->now_ns += 1000000u;
        upb_bus_step(&device->bus, &device->snapshot, device->now_ns);
    }
}

static inline upb_can_frame bench_command(const upb_command *command, const uint8_t *key, uint8_t *sequence) {
    upb_can_frame frame = {.id = UPB_COMMAND_ID, .flags = UPB_CAN_FD | UPB_CAN_BRS, .length = UPB_COMMAND_BYTES};
    upb_command_build(command, key, sequence, frame.data);
    return frame;
}

/* The last frame sent with an identifier, null if there is none. */
static inline const upb_can_frame *bench_last(const bench_device *device, uint32_t id) {
    for (unsigned i = device->sent_count; i-- > 0;)
        if (device->sent[i].id == id)
            return &device->sent[i];
    return NULL;
}

static inline unsigned bench_count(const bench_device *device, uint32_t id) {
    unsigned count = 0;
    for (unsigned i = 0; i < device->sent_count; i++)
        count += device->sent[i].id == id;
    return count;
}

#endif /* UPB_BENCH_DEVICE_H */
