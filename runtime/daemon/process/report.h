/* The daemon's state as JSON: one object a file, or one a line. */
#ifndef UPBEAMD_REPORT_H
#define UPBEAMD_REPORT_H

#include <stdio.h>

#include "upb_daemon.h"

/* What the process adds to what the core knows. */
typedef struct process_counts {
    uint64_t send_failed;    /* datagrams that the system did not take */
    uint64_t receive_failed; /* calls */
    uint64_t positions_full; /* position packets that found no slot in the ring */
    uint64_t reloads;        /* SIGHUPs */
    uint64_t can_failed;     /* frames received that could not be read */
    uint32_t receive_buffer; /* bytes the system gave */
    uint32_t real_time;      /* 1: both threads run under SCHED_FIFO */
    uint32_t pinned;         /* threads bound to a core */
} process_counts;

/* Without the list of frames: `with_ledger` 0. */
void report_status(FILE *to, const upb_daemon *daemon, const process_counts *process, int with_ledger);
void report_record(FILE *to, const upb_ledger_record *record);
void report_event(FILE *to, const upb_event *event);
/* The table of the HDL-64E that is shown, as drivers read it (YAML). */
void report_calibration(FILE *to, const upb_packet_calibration *calibration);

#endif /* UPBEAMD_REPORT_H */
