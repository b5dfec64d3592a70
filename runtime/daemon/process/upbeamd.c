/*
 * upbeamd: UDP packets of a 32-beam sensor in, the column stream and HDL-64E packets out, reports on CAN and serial.
 *
 * Three threads. One receives datagrams into a ring and does nothing else; one works on them in the daemon's core,
 * sends, and serves buses and signals; one writes files. The working thread waits for a disk in three cases: lines of
 * the ledger file (buffered), the freshness counter (before a command is carried out), and models read on SIGHUP.
 */
#define _GNU_SOURCE
#include <arpa/inet.h>
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

#include "network.h"
#include "process.h"

enum {
    TICK_NS = 5000000,
    WAIT_MS = 5 /* of the working thread, when nothing comes */
};

/* The only thing that a signal handler may reach. */
static int signal_pipe[2] = {-1, -1};

static void on_signal(int number) {
    const int error = errno;
    const char byte = (char)number;
    if (write(signal_pipe[1], &byte, 1) < 0)
        errno = 0; /* full: one of the kind is waiting already */
    errno = error;
}

uint64_t process_now(void *user) {
    struct timespec t;
    (void)user;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (uint64_t)t.tv_sec * UINT64_C(1000000000) + (uint64_t)t.tv_nsec;
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

/* ------------------------------------------------------------------------------------------------- work */

static void tick(process *p, uint64_t now) {
    upb_daemon_tick(p->daemon, now);
    p->ticked_ns = now;
    if (p->reload_wanted) {
        p->reload_wanted = 0;
        files_reload(p);
    }
    if (now - p->reported_ns >= (uint64_t)p->settings.json_ms * 1000000) {
        p->reported_ns = now;
        files_write_status(p);
        files_write_calibration(p);
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
        const uint64_t now = process_now(NULL);
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
        files_reload(p);
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
            links_take_can(p);
        if (ready > 0 && fds[3].revents)
            links_take_serial(p);
        if (ready > 0 && fds[1].revents && !take_signals(p))
            return;
        const uint64_t now = process_now(NULL);
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
        c->storage = (upb_storage){files_read_store, files_write_store, p};
    c->find_model = files_find_model;
    c->user = p;
    c->clock = (upb_clock){process_now, NULL};
    c->sinks = (upb_daemon_sinks){.user = p,
                                  .column_stream = p->columns_fd >= 0 ? links_send_columns : NULL,
                                  .hdl64 = p->hdl64_fd >= 0 ? links_send_hdl64 : NULL,
                                  .can = p->can_fd >= 0 ? links_send_can : NULL,
                                  .serial = p->serial_fd >= 0 ? links_send_serial : NULL,
                                  .ledger = files_write_record,
                                  .event = files_write_event};
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
    files_print_error(error.what[0] && status == UPB_E_ARGUMENT ? "setting" : p->settings.model, status, &error);
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
            fprintf(stderr, "upbeamd: command line: %s\n", problem);
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
    files_read_models(p);
    packet_ring_init(&p->ring, slots, p->settings.ring_packets);
    catch_signals();
    if (!file_writer_start(&p->writer) || pthread_create(&receiver, NULL, process_receive, p) != 0) {
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
    const uint64_t full = packet_ring_take_full(&p->ring), now = process_now(NULL);
    if (full)
        upb_daemon_queue_full(p->daemon, full, now);
    upb_daemon_end(p->daemon, now);
    files_write_calibration(p);
    p->at_end = 1;
    files_write_status(p);
    file_writer_end(&p->writer);
    if (p->ledger)
        fclose(p->ledger);
    files_forget_models(p);
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
