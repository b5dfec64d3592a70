/* What the parts of the process share. All but process_receive belongs to the working thread. */
#ifndef UPBEAMD_PROCESS_H
#define UPBEAMD_PROCESS_H

#include <netinet/in.h>
#include <stdatomic.h>
#include <stdio.h>

#include "file_writer.h"
#include "packet_ring.h"
#include "report.h"
#include "settings.h"
#ifdef UPBEAMD_SOCKETCAN
#include "upb_socketcan.h"
#endif

enum {
    MODELS_MAX = 64,
    BATCH = 32, /* datagrams a call receives */
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

/* CLOCK_MONOTONIC; the signature is upb_clock's. */
uint64_t process_now(void *user);

/* receive.c: the receiving thread's function, with the process. */
void *process_receive(void *process);

/* links.c: the daemon's sinks, with the process as user; what comes in on the buses. */
void links_send_columns(void *user, uint64_t time_ns, const uint8_t *data, size_t bytes);
void links_send_hdl64(void *user, uint64_t time_ns, const uint8_t *data, size_t bytes);
upb_send links_send_can(void *user, uint64_t time_ns, const upb_can_frame *frame);
upb_send links_send_serial(void *user, uint64_t time_ns, const uint8_t *data, size_t bytes);
void links_take_can(process *p);
void links_take_serial(process *p);

/* files.c: what must survive a restart, models, status. */
upb_stored files_read_store(void *user, upb_store what, uint8_t *bytes, size_t count);
upb_stored files_write_store(void *user, upb_store what, const uint8_t *bytes, size_t count);
int files_find_model(void *user, uint32_t crc32, const void **ubm, size_t *bytes);
void files_read_models(process *p);
void files_forget_models(process *p);
/* Reads the model file again, for the next frame on. */
void files_reload(process *p);
void files_write_record(void *user, const upb_ledger_record *record);
void files_write_event(void *user, const upb_event *event);
void files_write_status(process *p);
void files_write_calibration(process *p);
/* "what: reason" on standard error. */
void files_print_error(const char *what, upb_status status, const upb_error *error);

#endif /* UPBEAMD_PROCESS_H */
