/*
 * upbeamd: UDP packets of a 32-beam sensor in, the column stream and HDL-64E packets out, reports on CAN and serial.
 *
 * Three threads. One receives datagrams into a ring and does nothing else; one works on them in the daemon's core,
 * sends, and serves buses and signals; one writes files. The working thread waits for a disk in three cases: lines of
 * the ledger file (buffered), the freshness counter (before a command is carried out), and models read on SIGHUP.
 */
#define _GNU_SOURCE
#include <arpa/inet.h>
#include <dirent.h>
#include <errno.h>
#include <fcntl.h>
#include <poll.h>
#include <pthread.h>
#include <sched.h>
#include <signal.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <sys/un.h>
#include <time.h>
#include <unistd.h>

#include "file_writer.h"
#include "network.h"
#include "packet_ring.h"
#include "report.h"
#include "settings.h"
#ifdef UPBEAMD_SOCKETCAN
#include "upb_socketcan.h"
#endif

enum {
    MODELS_MAX = 64,
    BATCH = 32, /* datagrams a call receives */
    TICK_NS = 5000000,
    WAIT_MS = 5, /* of the working thread, when nothing comes */
    RECEIVE_WAIT_MS = 100,
    MODELS_BYTES_MAX = 1 << 20
};

typedef struct model_file {
    uint8_t *content;
    size_t bytes;
} model_file;

typedef struct process {
    settings settings;
    upb_daemon *daemon;
    process_counts counts;
    packet_ring ring;
    file_writer writer;
    int data_fd, position_fd, columns_fd, hdl64_fd, can_fd, serial_fd;
    int wake[2]; /* the receiving thread writes a byte when the other one sleeps */
    _Atomic uint32_t sleeping;
    _Atomic uint32_t stop;
    _Atomic uint64_t receive_failed, positions_full;
    struct sockaddr_in can_to;
    FILE *ledger;
    uint64_t ticked_ns, reported_ns, watchdog_ns;
    uint64_t watchdog_period_ns;  /* of systemd; 0: none */
    int at_end;                   /* the status file gets the ledger as well */
    uint32_t reload_wanted;       /* the kept model was found damaged */
    uint32_t calibration_columns; /* per turn, that the file was written for */
    model_file models[MODELS_MAX];
    size_t model_count;
#ifdef UPBEAMD_SOCKETCAN
    upb_socketcan socketcan;
    int has_socketcan;
#endif
} process;

/* The only thing that a signal handler may reach. */
static int signal_pipe[2] = {-1, -1};

static void on_signal(int number) {
    const int error = errno;
    const char byte = (char)number;
    if (write(signal_pipe[1], &byte, 1) < 0)
        errno = 0; /* full: one of the kind is waiting already */
    errno = error;
}

static uint64_t monotonic_ns(void *user) {
    struct timespec t;
    (void)user;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (uint64_t)t.tv_sec * UINT64_C(1000000000) + (uint64_t)t.tv_nsec;
}

/* -------------------------------------------------------------------------------------------- receiving */

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
        const uint64_t now = monotonic_ns(NULL);
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

static void *receive(void *user) {
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

/* ---------------------------------------------------------------------------------------------- sending */

static void send_datagram(process *p, int fd, const void *data, size_t bytes) {
    if (send(fd, data, bytes, MSG_DONTWAIT | MSG_NOSIGNAL) != (ssize_t)bytes)
        p->counts.send_failed++;
}

static void send_columns(void *user, uint64_t time_ns, const uint8_t *data, size_t bytes) {
    process *p = user;
    (void)time_ns;
    send_datagram(p, p->columns_fd, data, bytes);
}

static void send_hdl64(void *user, uint64_t time_ns, const uint8_t *data, size_t bytes) {
    process *p = user;
    (void)time_ns;
    send_datagram(p, p->hdl64_fd, data, bytes);
}

static upb_send send_can(void *user, uint64_t time_ns, const upb_can_frame *frame) {
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
static upb_send send_serial(void *user, uint64_t time_ns, const uint8_t *data, size_t bytes) {
    process *p = user;
    (void)time_ns;
    const ssize_t sent = write(p->serial_fd, data, bytes);
    if (sent == (ssize_t)bytes)
        return UPB_SEND_DONE;
    return sent < 0 && errno == EAGAIN ? UPB_SEND_BUSY : UPB_SEND_FAILED;
}

static void write_record(void *user, const upb_ledger_record *record) {
    process *p = user;
    if (!p->ledger)
        return;
    report_record(p->ledger, record);
    fputc('\n', p->ledger);
}

static void write_event(void *user, const upb_event *event) {
    process *p = user;
    if (event->kind == UPB_EVENT_INTEGRITY && event->a == UPB_REGION_KEPT)
        p->reload_wanted = 1;
    if (!p->ledger)
        return;
    report_event(p->ledger, event);
    fputc('\n', p->ledger);
}

/* ----------------------------------------------------------------------------------------- kept on disk */

static int store_path(const process *p, upb_store what, char *path, size_t bytes) {
    const char *name = what == UPB_STORE_FRESHNESS ? "freshness" : "faults";
    return snprintf(path, bytes, "%s/%s", p->settings.state, name) < (int)bytes;
}

static upb_stored read_store(void *user, upb_store what, uint8_t *bytes, size_t count) {
    char path[4096];
    if (!store_path(user, what, path, sizeof path))
        return UPB_STORED_FAILED;
    FILE *file = fopen(path, "rb");
    if (!file)
        return errno == ENOENT ? UPB_STORED_NOTHING : UPB_STORED_FAILED;
    const int whole = fread(bytes, 1, count, file) == count && fgetc(file) == EOF;
    fclose(file);
    return whole ? UPB_STORED_DONE : UPB_STORED_FAILED;
}

/* The freshness counter must be on disk before the command it came with is carried out; the fault memory can follow. */
static upb_stored write_store(void *user, upb_store what, const uint8_t *bytes, size_t count) {
    process *p = user;
    char path[4096];
    if (!store_path(user, what, path, sizeof path))
        return UPB_STORED_FAILED;
    void *const copy = what == UPB_STORE_FAULTS && p->writer.started ? malloc(count) : NULL;
    if (!copy)
        return file_replace(path, bytes, count) ? UPB_STORED_DONE : UPB_STORED_FAILED;
    memcpy(copy, bytes, count);
    file_writer_put(&p->writer, WRITE_FAULTS, path, copy, count);
    return UPB_STORED_DONE;
}

/* -------------------------------------------------------------------------------------------- the models */

static int find_model(void *user, uint32_t crc32, const void **ubm, size_t *bytes) {
    process *p = user;
    for (size_t i = 0; i < p->model_count; i++) {
        const model_file *model = &p->models[i];
        uint32_t crc = 0;
        for (unsigned b = 0; model->bytes >= 4 && b < 4; b++) /* a model file ends with its checksum */
            crc |= (uint32_t)model->content[model->bytes - 4 + b] << 8 * b;
        if (model->bytes < 4 || crc != crc32)
            continue;
        *ubm = model->content;
        *bytes = model->bytes;
        return 1;
    }
    return 0;
}

static void forget_models(process *p) {
    while (p->model_count)
        free(p->models[--p->model_count].content);
}

/* Read when the process begins and on SIGHUP: a command must not wait for a disk. */
static void read_models(process *p) {
    char path[4096];
    forget_models(p);
    DIR *folder = p->settings.models[0] ? opendir(p->settings.models) : NULL;
    if (p->settings.models[0] && !folder)
        fprintf(stderr, "upbeamd: %s: %s\n", p->settings.models, strerror(errno));
    for (struct dirent *entry; folder && p->model_count < MODELS_MAX && (entry = readdir(folder));) {
        const char *end = strrchr(entry->d_name, '.');
        if (!end || strcmp(end, ".ubm") != 0 ||
            snprintf(path, sizeof path, "%s/%s", p->settings.models, entry->d_name) >= (int)sizeof path)
            continue;
        model_file *model = &p->models[p->model_count];
        model->content = file_read(path, MODELS_BYTES_MAX, &model->bytes);
        p->model_count += model->content != NULL;
    }
    if (folder)
        closedir(folder);
}

static void print_error(const char *what, upb_status status, const upb_error *error) {
    fprintf(stderr, "upbeamd: %s: %s%s%s", what, error->what, error->what[0] ? ": " : "", upb_status_text(status));
    if (error->got || error->expected)
        fprintf(stderr, " (got %llu, expected %llu)", (unsigned long long)error->got,
                (unsigned long long)error->expected);
    fputc('\n', stderr);
}

static void reload(process *p) {
    upb_error error;
    size_t bytes = 0;
    memset(&error, 0, sizeof error);
    read_models(p);
    uint8_t *ubm = file_read(p->settings.model, MODELS_BYTES_MAX, &bytes);
    static const uint8_t nothing[1];
    const upb_status status =
        upb_daemon_swap_model(p->daemon, ubm ? ubm : nothing, ubm ? bytes : 0, monotonic_ns(NULL), &error);
    if (status == UPB_OK)
        fprintf(stderr, "upbeamd: %s: in use from the next frame on\n", p->settings.model);
    else
        print_error(p->settings.model, status, &error);
    free(ubm);
}

/* --------------------------------------------------------------------------------------------- reporting */

/* Text of malloc() that `write_to` prints; null without memory. */
static char *printed(void (*write_to)(FILE *to, void *user), void *user, size_t *bytes) {
    char *text = NULL;
    FILE *memory = open_memstream(&text, bytes);
    if (!memory)
        return NULL;
    write_to(memory, user);
    if (fclose(memory) == 0)
        return text;
    free(text);
    return NULL;
}

static void print_status(FILE *to, void *user) {
    process *p = user;
    report_status(to, p->daemon, &p->counts, p->at_end);
}

static void print_calibration(FILE *to, void *user) {
    report_calibration(to, upb_daemon_get_calibration(((process *)user)->daemon));
}

static void write_status(process *p) {
    size_t bytes = 0;
    if (!p->settings.json[0])
        return;
    p->counts.receive_failed = atomic_load(&p->receive_failed);
    p->counts.positions_full = atomic_load(&p->positions_full);
    char *const text = printed(print_status, p, &bytes);
    if (text)
        file_writer_put(&p->writer, WRITE_STATUS, p->settings.json, text, bytes);
}

static void write_calibration(process *p) {
    const uint32_t columns = upb_daemon_get_status(p->daemon).columns;
    size_t bytes = 0;
    if (!p->settings.calibration[0] || !upb_daemon_get_calibration(p->daemon) || columns == p->calibration_columns)
        return;
    p->calibration_columns = columns;
    char *const text = printed(print_calibration, p, &bytes);
    if (text)
        file_writer_put(&p->writer, WRITE_CALIBRATION, p->settings.calibration, text, bytes);
}

/* To systemd, where it listens. */
static void notify(const char *text) {
    const char *path = getenv("NOTIFY_SOCKET");
    struct sockaddr_un to = {.sun_family = AF_UNIX};
    if (!path || strlen(path) >= sizeof to.sun_path)
        return;
    memcpy(to.sun_path, path, strlen(path));
    if (path[0] == '@')
        to.sun_path[0] = '\0';
    const int fd = socket(AF_UNIX, SOCK_DGRAM | SOCK_CLOEXEC, 0);
    const socklen_t size = (socklen_t)(offsetof(struct sockaddr_un, sun_path) + strlen(path));
    if (fd >= 0 && sendto(fd, text, strlen(text), MSG_NOSIGNAL, (const struct sockaddr *)&to, size) < 0)
        fprintf(stderr, "upbeamd: NOTIFY_SOCKET: %s\n", strerror(errno));
    if (fd >= 0)
        close(fd);
}

/* --------------------------------------------------------------------------------------------- the buses */

static void take_can(process *p) {
    uint8_t bytes[UPB_CAN_WIRE_MAX + 1];
    upb_can_frame frame;
#ifdef UPBEAMD_SOCKETCAN
    if (p->has_socketcan) {
        while (upb_socketcan_receive(&p->socketcan, &frame) == 1)
            upb_daemon_can(p->daemon, &frame, monotonic_ns(NULL));
        return;
    }
#endif
    for (unsigned i = 0; i < BATCH; i++) {
        const ssize_t count = recv(p->can_fd, bytes, sizeof bytes, MSG_DONTWAIT);
        if (count < 0)
            return;
        if (upb_can_frame_decode(bytes, (size_t)count, &frame) == UPB_OK)
            upb_daemon_can(p->daemon, &frame, monotonic_ns(NULL));
        else
            p->counts.can_failed++;
    }
}

static void take_serial(process *p) {
    uint8_t bytes[512];
    const ssize_t count = read(p->serial_fd, bytes, sizeof bytes);
    if (count > 0)
        upb_daemon_serial(p->daemon, bytes, (size_t)count, monotonic_ns(NULL));
    else if (count == 0 || errno != EAGAIN) { /* the line is gone */
        close(p->serial_fd);
        p->serial_fd = -1;
    }
}

/* ------------------------------------------------------------------------------------------------- work */

static void tick(process *p, uint64_t now) {
    upb_daemon_tick(p->daemon, now);
    p->ticked_ns = now;
    if (p->reload_wanted) {
        p->reload_wanted = 0;
        reload(p);
    }
    if (now - p->reported_ns >= (uint64_t)p->settings.json_ms * 1000000) {
        p->reported_ns = now;
        write_status(p);
        write_calibration(p);
        if (p->ledger)
            fflush(p->ledger);
    }
    if (p->watchdog_period_ns && now - p->watchdog_ns >= p->watchdog_period_ns / 2) {
        p->watchdog_ns = now;
        notify("WATCHDOG=1");
    }
}

static void drain(process *p) {
    for (const ring_datagram *d; (d = packet_ring_peek(&p->ring));) {
        const uint64_t full = packet_ring_take_full(&p->ring);
        if (full)
            upb_daemon_queue_full(p->daemon, full, d->received_ns);
        if (d->kind == RING_DATA)
            upb_daemon_packet(p->daemon, d->data, d->bytes, d->source_ipv4, d->received_ns);
        else
            upb_daemon_position(p->daemon, d->data, d->bytes, d->source_ipv4, d->received_ns);
        packet_ring_release(&p->ring);
        const uint64_t now = monotonic_ns(NULL);
        if (now - p->ticked_ns >= TICK_NS)
            tick(p, now);
    }
}

/* 0: the process is to end. */
static int take_signals(process *p) {
    char byte;
    while (read(signal_pipe[0], &byte, 1) == 1) {
        if (byte != SIGHUP)
            return 0;
        p->counts.reloads++;
        reload(p);
    }
    return 1;
}

static void empty_pipe(int fd) {
    char bytes[64];
    while (read(fd, bytes, sizeof bytes) > 0) {
    }
}

static void work(process *p) {
    for (;;) {
        struct pollfd fds[4] = {{.fd = p->wake[0], .events = POLLIN},
                                {.fd = signal_pipe[0], .events = POLLIN},
                                {.fd = p->can_fd, .events = POLLIN},
                                {.fd = p->serial_fd, .events = POLLIN}};
        atomic_store(&p->sleeping, 1);
        /* What was published before the flag was set wakes nobody. */
        const int waiting = packet_ring_peek(&p->ring) != NULL;
        const int ready = poll(fds, 4, waiting ? 0 : WAIT_MS);
        atomic_store(&p->sleeping, 0);
        if (ready > 0 && fds[0].revents)
            empty_pipe(p->wake[0]);
        drain(p);
        if (ready > 0 && fds[2].revents)
            take_can(p);
        if (ready > 0 && fds[3].revents)
            take_serial(p);
        if (ready > 0 && fds[1].revents && !take_signals(p))
            return;
        const uint64_t now = monotonic_ns(NULL);
        if (now - p->ticked_ns >= TICK_NS)
            tick(p, now);
    }
}

/* ------------------------------------------------------------------------------------------- starting up */

static int read_key(const char *path, uint8_t key[UPB_KEY_BYTES]) {
    struct stat about;
    size_t bytes;
    if (stat(path, &about) == 0 && (about.st_mode & (S_IRWXG | S_IRWXO)))
        fprintf(stderr, "upbeamd: %s: others may read it (chmod 600)\n", path);
    uint8_t *text = file_read(path, 256, &bytes);
    if (!text)
        return 0;
    int good = 1, end = 0;
    for (unsigned i = 0; i < UPB_KEY_BYTES && good; i++) {
        unsigned value;
        good = sscanf((const char *)text + 2 * i, "%2x%n", &value, &end) == 1 && end == 2;
        key[i] = (uint8_t)value;
    }
    good = good && strspn((const char *)text + 2 * UPB_KEY_BYTES, " \r\n") + 2 * UPB_KEY_BYTES == bytes;
    free(text);
    if (!good)
        fprintf(stderr, "upbeamd: %s: no key, expected 32 hexadecimal digits\n", path);
    return good;
}

static int open_udp(const char *what, const char *endpoint, int (*open_it)(const struct sockaddr_in *), int *fd) {
    struct sockaddr_in at;
    *fd = -1;
    if (!endpoint[0])
        return 1;
    if (!parse_endpoint(endpoint, &at)) {
        fprintf(stderr, "upbeamd: %s is '%s', expected address:port\n", what, endpoint);
        return 0;
    }
    *fd = open_it(&at);
    if (*fd < 0)
        fprintf(stderr, "upbeamd: %s %s cannot be opened\n", what, endpoint);
    return *fd >= 0;
}

static int open_can(process *p) {
    const char *can = p->settings.can;
    struct sockaddr_in at = {.sin_family = AF_INET};
    unsigned port;
    int used = 0;
    p->can_fd = -1;
    if (!can[0])
        return 1;
    if (strncmp(can, "socketcan:", 10) == 0) {
#ifdef UPBEAMD_SOCKETCAN
        if (upb_socketcan_open(&p->socketcan, can + 10, NULL, 0, NULL) != 0) {
            fprintf(stderr, "upbeamd: can %s: %s: %s\n", can, p->socketcan.what, strerror(p->socketcan.error));
            return 0;
        }
        p->has_socketcan = 1;
        p->can_fd = p->socketcan.fd;
        return 1;
#else
        fprintf(stderr, "upbeamd: can %s: this build has no SocketCAN\n", can);
        return 0;
#endif
    }
    if (sscanf(can, "udp:%5u:%n", &port, &used) != 1 || !used || port > 65535 ||
        !parse_endpoint(can + used, &p->can_to)) {
        fprintf(stderr, "upbeamd: can is '%s', expected udp:PORT:ADDRESS:PORT or socketcan:NAME\n", can);
        return 0;
    }
    at.sin_port = htons((uint16_t)port);
    at.sin_addr.s_addr = htonl(INADDR_ANY);
    p->can_fd = udp_bound(&at);
    return p->can_fd >= 0;
}

static int open_all(process *p) {
    const settings *s = &p->settings;
    if (!open_udp("listen", s->listen, udp_bound, &p->data_fd) || p->data_fd < 0 ||
        !open_udp("position_listen", s->position_listen, udp_bound, &p->position_fd) ||
        !open_udp("columns", s->columns, udp_connected, &p->columns_fd) ||
        !open_udp("hdl64", s->hdl64, udp_connected, &p->hdl64_fd) || !open_can(p))
        return 0;
    p->serial_fd = -1;
    if (s->serial[0] && (p->serial_fd = tty_open(s->serial, s->serial_baud)) < 0)
        return 0;
    p->counts.receive_buffer = udp_receive_buffer(p->data_fd, s->receive_buffer);
    if (p->counts.receive_buffer < s->receive_buffer)
        fprintf(stderr, "upbeamd: receive buffer is %u bytes, asked for %u (net.core.rmem_max)\n",
                p->counts.receive_buffer, s->receive_buffer);
    if (s->ledger[0] && !(p->ledger = fopen(s->ledger, "w"))) {
        fprintf(stderr, "upbeamd: %s: %s\n", s->ledger, strerror(errno));
        return 0;
    }
    return pipe2(p->wake, O_CLOEXEC | O_NONBLOCK) == 0 && pipe2(signal_pipe, O_CLOEXEC | O_NONBLOCK) == 0;
}

static void catch_signals(void) {
    struct sigaction action;
    memset(&action, 0, sizeof action);
    action.sa_handler = on_signal;
    action.sa_flags = SA_RESTART;
    sigaction(SIGHUP, &action, NULL);
    sigaction(SIGTERM, &action, NULL);
    sigaction(SIGINT, &action, NULL);
    signal(SIGPIPE, SIG_IGN);
}

static int make_daemon(process *p) {
    upb_daemon_config *c = &p->settings.daemon;
    uint8_t key[UPB_KEY_BYTES];
    upb_error error;
    size_t bytes = 0;
    memset(&error, 0, sizeof error);
    if (p->settings.key[0] && !read_key(p->settings.key, key))
        return 0;
    c->key = p->settings.key[0] ? key : NULL;
    if (p->settings.state[0])
        c->storage = (upb_storage){read_store, write_store, p};
    c->find_model = find_model;
    c->user = p;
    c->clock = (upb_clock){monotonic_ns, NULL};
    c->sinks = (upb_daemon_sinks){.user = p,
                                  .column_stream = p->columns_fd >= 0 ? send_columns : NULL,
                                  .hdl64 = p->hdl64_fd >= 0 ? send_hdl64 : NULL,
                                  .can = p->can_fd >= 0 ? send_can : NULL,
                                  .serial = p->serial_fd >= 0 ? send_serial : NULL,
                                  .ledger = write_record,
                                  .event = write_event};
    uint8_t *ubm = file_read(p->settings.model, MODELS_BYTES_MAX, &bytes);
    if (!ubm)
        return 0;
    const size_t size = upb_daemon_bytes(c);
    void *memory = aligned_alloc(UPB_ALIGN, size ? size : UPB_ALIGN);
    const upb_status status =
        memory ? upb_daemon_init(memory, size ? size : UPB_ALIGN, c, ubm, bytes, &p->daemon, &error) : UPB_E_SIZE;
    free(ubm);
    memset(key, 0, sizeof key);
    if (status == UPB_OK)
        return 1;
    print_error(error.what[0] && status == UPB_E_ARGUMENT ? "setting" : p->settings.model, status, &error);
    free(memory);
    return 0;
}

static void pin(process *p, pthread_t thread, int32_t cpu, const char *which) {
    cpu_set_t set;
    if (cpu < 0)
        return;
    CPU_ZERO(&set);
    CPU_SET((size_t)cpu, &set);
    const int error = pthread_setaffinity_np(thread, sizeof set, &set);
    if (error)
        fprintf(stderr, "upbeamd: %s cannot be bound to core %d: %s\n", which, cpu, strerror(error));
    p->counts.pinned += !error;
}

static void make_real_time(process *p, pthread_t receiver) {
    const struct sched_param param = {.sched_priority = (int)p->settings.priority};
    if (!p->settings.priority)
        return;
    int error = pthread_setschedparam(receiver, SCHED_FIFO, &param);
    if (!error)
        error = pthread_setschedparam(pthread_self(), SCHED_FIFO, &param);
    if (error)
        fprintf(stderr, "upbeamd: SCHED_FIFO priority %u: %s\n", p->settings.priority, strerror(error));
    else
        p->counts.real_time = 1;
    if (mlockall(MCL_CURRENT | MCL_FUTURE) != 0)
        fprintf(stderr, "upbeamd: mlockall: %s\n", strerror(errno));
}

/* ----------------------------------------------------------------------------------------- command line */

static void usage(FILE *to) {
    fputs("usage: upbeamd --model FILE [--KEY VALUE ...]\n"
          "Packets of a 32-beam sensor in, packets of 64 beams out. docs/upbeamd.md\n"
          "Keys, in a file (--config FILE, `key = value`) or as flags:\n",
          to);
    settings_print_help(to);
    fputs("  --print-config               print the settings that result, and end\n", to);
}

static int read_config(settings *s, const char *path) {
    char problem[1024];
    size_t bytes;
    uint8_t *text = file_read(path, 1 << 20, &bytes);
    const int good = text && settings_read(s, path, (const char *)text, problem, sizeof problem);
    if (text && !good)
        fprintf(stderr, "upbeamd: %s\n", problem);
    free(text);
    return good;
}

/* `--key value` and `--key=value`. `only_config`: all but --config is passed over. */
static int read_flags(settings *s, int argc, char **argv, int only_config, int *print) {
    char key[64], problem[1024];
    for (int i = 1; i < argc; i++) {
        const char *flag = argv[i], *equals = strchr(flag, '=');
        const size_t bytes = equals ? (size_t)(equals - flag) : strlen(flag);
        if (strcmp(flag, "--print-config") == 0) {
            *print = 1;
            continue;
        }
        if (strncmp(flag, "--", 2) != 0 || bytes < 3 || bytes - 2 >= sizeof key) {
            fprintf(stderr, "upbeamd: '%s' is no flag, expected --key value (upbeamd --help)\n", flag);
            return 0;
        }
        memcpy(key, flag + 2, bytes - 2);
        key[bytes - 2] = '\0';
        if (!equals && i + 1 == argc) {
            fprintf(stderr, "upbeamd: %s: no value\n", flag);
            return 0;
        }
        const char *value = equals ? equals + 1 : argv[++i];
        if (only_config && strcmp(key, "config") != 0)
            continue;
        if (!settings_set(s, key, value, problem, sizeof problem)) {
            fprintf(stderr, "upbeamd: --%s\n", problem);
            return 0;
        }
    }
    return 1;
}

static int check_settings(const settings *s) {
    if (!s->model[0]) {
        fputs("upbeamd: no model: --model FILE, or `model = FILE` in the settings\n", stderr);
        return 0;
    }
    if (s->ring_packets < 16 || s->ring_packets > 65536 || (s->ring_packets & (s->ring_packets - 1))) {
        fprintf(stderr, "upbeamd: ring_packets is %u, expected a power of two from 16 to 65536\n", s->ring_packets);
        return 0;
    }
    if (s->priority > 99) {
        fprintf(stderr, "upbeamd: priority is %u, expected 0 to 99\n", s->priority);
        return 0;
    }
    return 1;
}

static int run(process *p) {
    pthread_t receiver;
    ring_datagram *slots = calloc(p->settings.ring_packets, sizeof *slots);
    if (!slots || !open_all(p) || !make_daemon(p))
        return 1;
    read_models(p);
    packet_ring_init(&p->ring, slots, p->settings.ring_packets);
    catch_signals();
    if (!file_writer_start(&p->writer) || pthread_create(&receiver, NULL, receive, p) != 0) {
        fputs("upbeamd: no thread\n", stderr);
        return 1;
    }
    make_real_time(p, receiver);
    pin(p, receiver, p->settings.receive_cpu, "receiving");
    pin(p, pthread_self(), p->settings.work_cpu, "working");
    const char *watchdog = getenv("WATCHDOG_USEC");
    p->watchdog_period_ns = watchdog ? strtoull(watchdog, NULL, 10) * 1000 : 0;
    notify("READY=1");
    fprintf(stderr, "upbeamd: ready, %s\n", p->settings.listen);
    work(p);
    notify("STOPPING=1");
    atomic_store(&p->stop, 1);
    pthread_join(receiver, NULL);
    drain(p);
    const uint64_t full = packet_ring_take_full(&p->ring), now = monotonic_ns(NULL);
    if (full)
        upb_daemon_queue_full(p->daemon, full, now);
    upb_daemon_end(p->daemon, now);
    write_calibration(p);
    p->at_end = 1;
    write_status(p);
    file_writer_end(&p->writer);
    if (p->ledger)
        fclose(p->ledger);
    forget_models(p);
    free(p->daemon);
    free(slots);
    return 0;
}

int main(int argc, char **argv) {
    static process p;
    int print = 0;
    if (argc == 2 && (strcmp(argv[1], "--help") == 0 || strcmp(argv[1], "-h") == 0)) {
        usage(stdout);
        return 0;
    }
    if (argc == 2 && strcmp(argv[1], "--version") == 0) {
        printf("upbeamd %s\n", upb_version());
        return 0;
    }
    p.settings = settings_default();
    if (!read_flags(&p.settings, argc, argv, 1, &print) ||
        (p.settings.config[0] && !read_config(&p.settings, p.settings.config)) ||
        !read_flags(&p.settings, argc, argv, 0, &print))
        return 2;
    if (print) {
        settings_print(&p.settings, stdout);
        return 0;
    }
    return check_settings(&p.settings) ? run(&p) : 2;
}
