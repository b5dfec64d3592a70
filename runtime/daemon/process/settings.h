/* Settings of upbeamd: a file of `key = value` lines, each key a flag as well. docs/upbeamd.md lists them. */
#ifndef UPBEAMD_SETTINGS_H
#define UPBEAMD_SETTINGS_H

#include <stdio.h>

#include "upb_daemon.h"

#define SETTING_TEXT 256u

typedef struct settings {
    upb_daemon_config daemon;
    char config[SETTING_TEXT];          /* file read before the other flags */
    char model[SETTING_TEXT];           /* .ubm file */
    char models[SETTING_TEXT];          /* folder of .ubm files that a command may ask for */
    char listen[SETTING_TEXT];          /* address:port of data packets */
    char position_listen[SETTING_TEXT]; /* address:port of position packets */
    char columns[SETTING_TEXT];         /* address:port the column stream goes to; empty: none */
    char hdl64[SETTING_TEXT];           /* address:port the HDL-64E packets go to; empty: none */
    char can[SETTING_TEXT];             /* udp:PORT:ADDRESS:PORT or socketcan:NAME; empty: none */
    char serial[SETTING_TEXT];          /* a tty; empty: none */
    char key[SETTING_TEXT];             /* file with the key of commands */
    char state[SETTING_TEXT];           /* folder of what must survive a restart; empty: nothing does */
    char json[SETTING_TEXT];            /* status file */
    char ledger[SETTING_TEXT];          /* file of ledger records and events, a JSON object a line */
    char calibration[SETTING_TEXT];     /* file for drivers: table of the HDL-64E that is shown */
    uint32_t json_ms;                   /* between two writes of the status file */
    uint32_t serial_baud;
    uint32_t receive_buffer;       /* bytes asked of the socket */
    uint32_t ring_packets;         /* a power of two */
    uint32_t priority;             /* SCHED_FIFO; 0: not asked for */
    int32_t receive_cpu, work_cpu; /* -1: any */
} settings;

settings settings_default(void);

/*
 * Reads lines of text into `settings`; on a line that is no setting writes "NAME:LINE: reason" to `problem` and returns
 * 0. `name` is for that message. '#' begins a comment.
 */
int settings_read(settings *settings, const char *name, const char *text, char *problem, size_t problem_bytes);
/* One setting, by key with '-' or '_'. 0 and a reason in `problem` if it is unknown or its value impossible. */
int settings_set(settings *settings, const char *key, const char *value, char *problem, size_t problem_bytes);
/* Every key with its default and what it means. */
void settings_print_help(FILE *to);
/* All settings as they are: the file that would give them. */
void settings_print(const settings *settings, FILE *to);

#endif /* UPBEAMD_SETTINGS_H */
