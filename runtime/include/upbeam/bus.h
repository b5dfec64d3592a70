/*
 * The device on its buses: status out on CAN and serial, commands in, diagnostics. One object, in the caller's memory,
 * driven by the caller: frames and bytes in, snapshot in, time in; frames and bytes out through function pointers.
 *
 * Usage (one thread; all times are ns of one monotonic clock):
 *     static upb_bus bus;
 *     upb_bus_config config = upb_bus_config_default();
 *     config.can.send = ...; config.serial.send = ...; config.storage = ...; config.key = ...; config.execute = ...;
 *     upb_bus_init(&bus, &config, now);
 *     for (;;) {
 *         upb_bus_can(&bus, &frame, now);                  // each frame received
 *         upb_bus_serial(&bus, bytes, count, now);         // bytes received
 *         upb_bus_ledger(&bus, &record, now);              // each frame of the ledger that closed
 *         upb_faults_report(&bus.faults, id, look, now);   // each look of a monitor
 *         upb_bus_step(&bus, &snapshot, now);              // every 10 ms or more often
 *     }
 *     upb_bus_end(&bus);
 *
 * The object takes about 4.4 kB, calls less than 2 kB of stack (gcc -O2, x86-64). Messages, identifiers, cycle times:
 * hw_sim/can/upbeam.dbc and docs/can.md.
 */
#ifndef UPBEAM_BUS_H
#define UPBEAM_BUS_H

#include "upbeam/can.h"
#include "upbeam/command.h"
#include "upbeam/console.h"
#include "upbeam/e2e.h"
#include "upbeam/faults.h"
#include "upbeam/uds.h"

#ifdef __cplusplus
extern "C" {
#endif

typedef enum upb_bus_state {
    UPB_STATE_STARTING = 0,
    UPB_STATE_RUNNING = 1,
    UPB_STATE_DEGRADED = 2,  /* running, not in mode NETWORK */
    UPB_STATE_NO_SENSOR = 3, /* no packets come */
    UPB_STATE_FAULT = 4,     /* no output */
    UPB_STATE_STOPPING = 5
} upb_bus_state;

/* Counters on CAN (UPB_Counters, multiplexed) and in UDS; since power-on. */
typedef enum upb_counter {
    UPB_COUNTER_PACKETS_IN = 0,
    UPB_COUNTER_PACKETS_OUT = 1,
    UPB_COUNTER_PACKETS_DROPPED = 2, /* all causes */
    UPB_COUNTER_COLUMNS_IN = 3,
    UPB_COUNTER_COLUMNS_OUT = 4,
    UPB_COUNTER_COLUMNS_MISSING = 5,
    UPB_COUNTER_FRAMES = 6, /* closed in the ledger */
    UPB_COUNTER_FRAMES_MISSED = 7,
    UPB_COUNTER_FRAMES_PARTIAL = 8,
    UPB_COUNTER_FRAMES_LOST = 9,
    UPB_COUNTER_MODE_CHANGES = 10,
    /* the bus fills in what follows */
    UPB_COUNTER_COMMANDS_TAKEN = 11,
    UPB_COUNTER_COMMANDS_REFUSED = 12,
    UPB_COUNTER_CAN_FAILED = 13,     /* CAN frames that could not be sent */
    UPB_COUNTER_SERIAL_FAILED = 14,  /* records that could not be sent */
    UPB_COUNTER_SERIAL_REFUSED = 15, /* records that were not understood */
    UPB_COUNTER_LEDGER_DROPPED = 16  /* ledger records that could not be sent on CAN */
} upb_counter;

#define UPB_COUNTERS 17u
#define UPB_DROP_CAUSES_MAX 16u

/* What the device is doing. All but the bus's own counters comes from the caller. */
typedef struct upb_bus_snapshot {
    upb_ledger_record record;            /* of the last frame that closed */
    uint32_t state;                      /* upb_bus_state */
    uint32_t mode;                       /* upb_mode now */
    uint64_t latency_max_ns;             /* greatest of all frames judged */
    uint64_t counters[UPB_COUNTERS];     /* by upb_counter */
    uint64_t drops[UPB_DROP_CAUSES_MAX]; /* packets dropped, by the daemon's cause */
    uint32_t model_crc32;                /* upb_model_info.crc32, 0: no model */
    uint32_t model_swaps;
    uint32_t precision; /* upb_precision */
    uint32_t cpu;       /* upb_cpu */
} upb_bus_snapshot;

typedef enum upb_message {
    UPB_MESSAGE_STATUS = 0,
    UPB_MESSAGE_LATENCY = 1,
    UPB_MESSAGE_COUNTERS = 2, /* one counter each time */
    UPB_MESSAGE_FAULTS = 3,
    UPB_MESSAGE_FAULT_DETAIL = 4, /* one fault each time; not sent while none is remembered */
    UPB_MESSAGE_MODEL = 5,
    UPB_MESSAGE_LEDGER = 6 /* CAN FD, each frame that closed */
} upb_message;

#define UPB_MESSAGES 7u

#define UPB_UDS_REQUEST_ID 0x7a0u
#define UPB_UDS_RESPONSE_ID 0x7a8u
#define UPB_UDS_FUNCTIONAL_ID 0x7dfu

/* A message as the DBC has it. */
typedef struct upb_message_info {
    char name[24];
    uint32_t id;
    uint32_t flags;     /* UPB_CAN_* */
    uint32_t cycle_ms;  /* 0: on event */
    upb_e2e_config e2e; /* Profile 11; Profile 5 for FD messages */
} upb_message_info;

/* Null: no such message. */
UPB_API const upb_message_info *upb_message_get_info(upb_message message);

#define UPB_LEDGER_QUEUE 8u
#define UPB_BUS_HEAL_NS 5000000000u /* a refused command or record stays a fault this long, if no other follows */

/* Status messages on one channel, with their own E2E counters. */
typedef struct upb_sender {
    uint64_t due_ns[UPB_MESSAGES];
    uint64_t sent;
    uint64_t failed; /* frames dropped */
    uint8_t sequence[UPB_MESSAGES];
    uint8_t counter_index; /* next of UPB_Counters */
    uint8_t fault_index;   /* next of UPB_FaultDetail */
    uint8_t queue_first, queue_count;
    uint64_t ledger_dropped; /* records pushed out of the queue */
    upb_ledger_record queue[UPB_LEDGER_QUEUE];
} upb_sender;

typedef struct upb_bus_config {
    uint32_t struct_bytes;     /* sizeof(upb_bus_config), set by upb_bus_config_default */
    uint32_t status_on_serial; /* 1: the status messages also go to the serial line (default) */
    upb_can_transport can;
    upb_serial_transport serial;
    upb_storage storage; /* both functions, or neither: commands are then refused (STORAGE) and faults not kept */
    const uint8_t *key;  /* UPB_KEY_BYTES, copied; null: no command is taken */
    upb_command_fn execute;
    int (*reset)(void *user, uint32_t type); /* upb_uds_config.reset; null: ECUReset is refused */
    void *user;                              /* of execute and reset */
    uint32_t clear_locked;                   /* upb_uds_config.clear_locked */
    uint64_t muted_faults;                   /* upb_faults_mute: 0, but in tests of tests */
    upb_isotp_config isotp;                  /* identifiers and timeouts of diagnostics */
} upb_bus_config;

UPB_API upb_bus_config upb_bus_config_default(void);

typedef struct upb_bus {
    upb_bus_config config;
    upb_faults faults;
    upb_commands commands;
    upb_isotp isotp;
    upb_uds uds;
    upb_sender can;
    upb_sender serial;
    upb_console_parser parser;
    upb_bus_snapshot snapshot;   /* of the last step */
    uint64_t command_refused_ns; /* when the last command, and serial record, was refused; UINT64_MAX: long ago */
    uint64_t record_refused_ns;
    uint64_t records_unknown; /* good records that are no command */
    uint64_t now_ns;          /* of the last call */
    uint64_t save_soon_ns;    /* earliest next writes of the fault memory */
    uint64_t save_later_ns;
    uint64_t can_failed; /* frames the transport dropped, all senders */
    uint64_t serial_failed;
    uint8_t response_pending; /* the transport had no room for the response: 1 CAN, 2 serial */
    upb_can_frame response;
} upb_bus;

/* Reads storage, begins an operation cycle. The object stays where it is: its parts point at it. Errors: ARGUMENT. */
UPB_API upb_status upb_bus_init(upb_bus *bus, const upb_bus_config *config, uint64_t now_ns);
/* A CAN frame received: command or diagnostics; true if it was for this device. */
UPB_API int upb_bus_can(upb_bus *bus, const upb_can_frame *frame, uint64_t now_ns);
/* Bytes received on the serial line: commands. */
UPB_API void upb_bus_serial(upb_bus *bus, const uint8_t *bytes, size_t count, uint64_t now_ns);
/* Queues a record that closed for both channels; it leaves at the next step. */
UPB_API void upb_bus_ledger(upb_bus *bus, const upb_ledger_record *record);
/*
 * Sends what is due: status messages, ledger records, diagnostics. Keeps the faults that are the bus's own: CAN_BUS_OFF
 * (the transport fails), CAN_COMMAND_REJECTED and SERIAL_FRAMING (healed UPB_BUS_HEAL_NS after the last refusal),
 * POWER_RESET (healed when the state is RUNNING). Writes the fault memory (upb_faults_save).
 */
UPB_API void upb_bus_step(upb_bus *bus, const upb_bus_snapshot *snapshot, uint64_t now_ns);
/* The end in good order (upb_faults_end). */
UPB_API upb_stored upb_bus_end(upb_bus *bus);

#ifdef __cplusplus
}
#endif

#endif /* UPBEAM_BUS_H */
