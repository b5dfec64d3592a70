/*
 * User-space driver of the upbeam FPGA core's register block (docs/fpga-registers.md, upb_regs.h).
 *
 * The bus is two function pointers: memory-mapped registers on a device (upb_uio.h), a simulated core in a test. No
 * heap, no threads, no globals, no waiting: what takes time is asked for again by the caller. Calls on one object may
 * not run at the same time.
 *
 * The core answers an access that it refuses with SLVERR, which ends a process on many systems (SIGBUS): every call
 * looks before it writes and returns a status instead.
 *
 * Usage:
 *     upb_fpga fpga;
 *     upb_fpga_settings settings = {.deadline_clocks = upb_fpga_clocks(&fpga, 1000), .irq_events =
 * UPB_EVENTS_DEADLINE}; if (upb_fpga_open(&fpga, &bus) != UPB_FPGA_OK) ... if (upb_fpga_start(&fpga, &settings) !=
 * UPB_FPGA_OK) ... for (;;) { wait for the interrupt; upb_fpga_take_events(&fpga, &events); ... }
 */
#ifndef UPB_FPGA_H
#define UPB_FPGA_H

#include <stddef.h>
#include <stdint.h>

#include "upb_regs.h"

#ifdef __cplusplus
extern "C" {
#endif

typedef enum upb_fpga_status {
    UPB_FPGA_OK = 0,
    UPB_FPGA_E_ARGUMENT = 1,  /* a null pointer, or a value outside its range */
    UPB_FPGA_E_BUS = 2,       /* an access failed: fault.address */
    UPB_FPGA_E_ID = 3,        /* no upbeam core there */
    UPB_FPGA_E_VERSION = 4,   /* a register map of another major version */
    UPB_FPGA_E_RUNNING = 5,   /* not while the core runs */
    UPB_FPGA_E_READ_ONLY = 6, /* this core's weights cannot be written */
    UPB_FPGA_E_PENDING = 7,   /* the last image still waits for a frame */
    UPB_FPGA_E_IMAGE = 8,     /* not a weights image, or a damaged one */
    UPB_FPGA_E_SHAPE = 9,     /* an image for another core: fault.address tells the register it does not agree with */
    UPB_FPGA_E_WRITTEN = 10,  /* the core did not receive what was written */
    UPB_FPGA_E_SYSTEM = 11    /* the operating system refused: errno */
} upb_fpga_status;

/* One lower-case English phrase without full stop, static, never null. */
const char *upb_fpga_status_text(upb_fpga_status status);

/* How registers are reached. Addresses are bytes, multiples of 4 below UPB_REGS_BYTES; accesses have 32 bits. Both
 * return 0, or anything else where the access failed. */
typedef struct upb_fpga_bus {
    int (*read)(void *user, uint32_t address, uint32_t *value);
    int (*write)(void *user, uint32_t address, uint32_t value);
    void *user;
} upb_fpga_bus;

/* What the core is. Does not change while it is configured, but for the two CRCs. */
typedef struct upb_fpga_info {
    char contract[20];    /* "upbeam.int8.v1", zero terminated */
    uint32_t version;     /* of the register map: major << 16 | minor << 8 | patch */
    uint32_t model_crc;   /* CRC-32 of the model file in use */
    uint32_t weights_crc; /* CRC-32 of the weights image in use; 0: the built-in weights */
    uint32_t clock_hz;    /* 0: unknown */
    uint32_t columns;     /* of a frame */
    uint32_t shape;       /* UPB_SHAPE_* */
    uint32_t scale[2];    /* distance, intensity: UPB_SCALE_DISTANCE_* */
    uint32_t slopes;      /* UPB_SLOPES_* */
    uint32_t ring_slots;  /* columns of the destagger ring; 0: none */
    uint32_t ring_delay;  /* firing columns */
} upb_fpga_info;

typedef struct upb_fpga_settings {
    uint32_t columns;         /* of a frame, 4 to 65535; 0: as it is (the model's after reset) */
    uint32_t deadline_clocks; /* last input column to last output beat of a frame; 0: none */
    uint32_t irq_events;      /* UPB_EVENTS_* that raise the interrupt */
} upb_fpga_settings;

/* Counters since the last start, modulo 2^32; they stay readable after a stop. Times are in clocks. */
typedef struct upb_fpga_counters {
    uint32_t frames_in, columns_in;   /* frames begun, whole columns */
    uint32_t frames_out, columns_out; /* whole frames, columns */
    uint32_t dropped_beats;           /* while waiting for a frame */
    uint32_t errors;                  /* short and long columns and frames */
    uint32_t misses;                  /* of the deadline */
    uint32_t frame_clocks;            /* last whole frame: first input beat to last output beat */
    uint32_t latency;                 /* last whole frame: last input column to last output beat */
    uint32_t latency_max;
} upb_fpga_counters;

/* What went wrong, where it applies. */
typedef struct upb_fpga_fault {
    uint32_t address, got, expected;
} upb_fpga_fault;

typedef struct upb_fpga {
    upb_fpga_bus bus;
    upb_fpga_info info;
    upb_fpga_fault fault;
} upb_fpga;

/* Reads what the core is, and changes nothing. The bus is copied; `user` stays the caller's.
 * Errors: E_ARGUMENT, E_BUS, E_ID, E_VERSION. */
upb_fpga_status upb_fpga_open(upb_fpga *fpga, const upb_fpga_bus *bus);

/* Clears the events and lets the core run: it waits for the first beat of a frame. Errors: E_ARGUMENT, E_BUS,
 * E_RUNNING. */
upb_fpga_status upb_fpga_start(upb_fpga *fpga, const upb_fpga_settings *settings);

/* Holds the core in reset: columns in it are lost. Weights in use, and an image that waits, stay. Errors: E_ARGUMENT,
 * E_BUS. */
upb_fpga_status upb_fpga_stop(upb_fpga *fpga);

/* UPB_EVENTS_* that have come since the last call; clears those, and with them the interrupt. Errors: E_ARGUMENT,
 * E_BUS. */
upb_fpga_status upb_fpga_take_events(upb_fpga *fpga, uint32_t *events);

/* Not a snapshot: counters that move are read one after another. Errors: E_ARGUMENT, E_BUS. */
upb_fpga_status upb_fpga_read_counters(upb_fpga *fpga, upb_fpga_counters *counters);

/*
 * Writes an image (upb_weights.bin of `upbeam export --to rtl`) to the bank that is not in use, checks it and asks for
 * it to be used from the next frame on; all windows of a frame see the same weights. UPB_EVENTS_SWAPPED tells when; the
 * two CRCs of info are read again by upb_fpga_refresh. Nothing is written of an image that does not fit. Errors:
 * E_ARGUMENT, E_BUS, E_READ_ONLY, E_PENDING, E_IMAGE, E_SHAPE, E_WRITTEN.
 */
upb_fpga_status upb_fpga_load(upb_fpga *fpga, const uint8_t *image, size_t bytes);

/* Reads info.model_crc, weights_crc and columns again. Errors: E_ARGUMENT, E_BUS. */
upb_fpga_status upb_fpga_refresh(upb_fpga *fpga);

/* Clocks of a time, rounded up, at most 2^32 - 1; 0 where the core does not tell its frequency. */
uint32_t upb_fpga_clocks(const upb_fpga *fpga, uint32_t microseconds);

#ifdef __cplusplus
}
#endif

#endif
