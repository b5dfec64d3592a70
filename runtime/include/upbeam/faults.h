/*
 * The fault memory: what can be wrong (one list), how sure one must be (debounce), and what is remembered (the UDS
 * status byte, how often, first and last time, a snapshot). ISO 14229-1 names.
 */
#ifndef UPBEAM_FAULTS_H
#define UPBEAM_FAULTS_H

#include "upbeam/can.h"

#ifdef __cplusplus
extern "C" {
#endif

/* The one list. Bit id-1 of UPB_Faults on CAN; DTC 0xD00000 + id*256 (U10xx); docs/can.md says what sets and heals. */
typedef enum upb_fault {
    UPB_FAULT_NONE = 0,
    UPB_FAULT_SENSOR_TIMEOUT = 1,
    UPB_FAULT_SENSOR_AZIMUTH_STUCK = 2,
    UPB_FAULT_SENSOR_AZIMUTH_JUMP = 3,
    UPB_FAULT_SENSOR_TIME_JUMP = 4,
    UPB_FAULT_SENSOR_RPM_RANGE = 5,
    UPB_FAULT_SENSOR_BEAM_DEAD = 6,
    UPB_FAULT_SENSOR_RING_STUCK = 7,
    UPB_FAULT_SENSOR_ALL_ZERO = 8,
    UPB_FAULT_SENSOR_THERMAL = 9,
    UPB_FAULT_SENSOR_PPS_LOST = 10,
    UPB_FAULT_SENSOR_VISIBILITY = 11,
    UPB_FAULT_SENSOR_CROSSTALK = 12,
    UPB_FAULT_SENSOR_WRONG_MODEL = 13,
    UPB_FAULT_NET_LOSS = 14,
    UPB_FAULT_NET_REORDER = 15,
    UPB_FAULT_NET_DUPLICATE = 16,
    UPB_FAULT_NET_MALFORMED = 17,
    UPB_FAULT_NET_FLOOD = 18,
    UPB_FAULT_NET_JITTER = 19,
    UPB_FAULT_COMPUTE_OVERLOAD = 20,
    UPB_FAULT_COMPUTE_DEADLINE = 21,
    UPB_FAULT_COMPUTE_INTEGRITY = 22,
    UPB_FAULT_COMPUTE_THROTTLE = 23,
    UPB_FAULT_CLOCK_DRIFT = 24,
    UPB_FAULT_CAN_BUS_OFF = 25,
    UPB_FAULT_CAN_COMMAND_REJECTED = 26,
    UPB_FAULT_SERIAL_FRAMING = 27,
    UPB_FAULT_MODEL_REJECTED = 28,
    UPB_FAULT_POWER_RESET = 29
} upb_fault;

#define UPB_FAULTS 29u     /* ids 1..UPB_FAULTS */
#define UPB_FAULTS_MAX 40u /* room on CAN and in storage */

/* "SENSOR_TIMEOUT", static; "NONE" for 0 and unknown ids. */
UPB_API const char *upb_fault_name(uint32_t id);
/* The 24-bit DTC; 0 for 0 and unknown ids. */
UPB_API uint32_t upb_fault_dtc(uint32_t id);
/* The id of a DTC; 0 if there is none. */
UPB_API uint32_t upb_fault_of_dtc(uint32_t dtc);

/* Bits of the UDS status byte (ISO 14229-1, D.2). */
#define UPB_DTC_TEST_FAILED 0x01u
#define UPB_DTC_TEST_FAILED_THIS_CYCLE 0x02u
#define UPB_DTC_PENDING 0x04u
#define UPB_DTC_CONFIRMED 0x08u
#define UPB_DTC_NOT_COMPLETED_SINCE_CLEAR 0x10u
#define UPB_DTC_FAILED_SINCE_CLEAR 0x20u
#define UPB_DTC_NOT_COMPLETED_THIS_CYCLE 0x40u
#define UPB_DTC_STATUS_MASK 0x7fu /* the warning lamp bit is not supported */

/* What a monitor says each time it looks. */
typedef enum upb_monitor {
    UPB_MONITOR_PASSED = 0,    /* surely healthy: heals at once */
    UPB_MONITOR_PREPASSED = 1, /* looks healthy: one step down */
    UPB_MONITOR_PREFAILED = 2, /* looks faulty: one step up */
    UPB_MONITOR_FAILED = 3     /* surely faulty: sets at once */
} upb_monitor;

/* Debounce of a fault: the detection counter runs from -128 (healthy) to 127 (faulty). */
typedef struct upb_debounce {
    uint8_t up;   /* 1..127 on PREFAILED; from a value below 0 it begins at 0 */
    uint8_t down; /* 1..128 on PREPASSED; from a value above 0 it begins at 0 */
} upb_debounce;

/* The debounce a fault starts with (docs/can.md has the table). */
UPB_API upb_debounce upb_fault_debounce(uint32_t id);

typedef struct upb_fault_entry {
    uint8_t status;       /* UPB_DTC_* */
    int8_t counter;       /* fault detection counter: 127 failed, -128 passed */
    uint8_t cycles_ok;    /* operation cycles since the last failure, for ageing */
    uint8_t mode;         /* upb_mode at the last failure */
    uint16_t cycle;       /* operation cycle of the last failure, modulo 65536 */
    uint16_t occurrences; /* times it became failed, up to 65535 */
    uint64_t first_ns;    /* when it first and last became failed: the caller's clock, in the cycle it was then */
    uint64_t last_ns;
    uint64_t frame; /* frame at the last failure */
} upb_fault_entry;

/* A new fault is stored soon; that a known one came or went may wait, so that nobody wears the storage out. */
typedef enum upb_faults_dirty { UPB_FAULTS_CLEAN = 0, UPB_FAULTS_LATER = 1, UPB_FAULTS_SOON = 2 } upb_faults_dirty;

typedef struct upb_faults {
    upb_fault_entry entries[UPB_FAULTS + 1u]; /* by id */
    upb_debounce debounce[UPB_FAULTS + 1u];
    upb_storage storage;
    uint32_t latest;         /* id that failed last, 0: none */
    uint32_t cycle;          /* operation cycles begun, this one with them */
    uint32_t ended;          /* upb_faults_end was called */
    uint32_t dirty;          /* upb_faults_dirty: whether and how soon to store */
    uint32_t store_failures; /* writes refused, and a stored memory that could not be read */
    uint64_t frame;          /* upb_faults_context */
    uint32_t mode;
    uint64_t muted; /* bit id-1: upb_faults_mute */
} upb_faults;

#define UPB_FAULTS_AGE_CYCLES 40u /* operation cycles without the fault after which it is no longer confirmed */

/*
 * Reads what is stored (a null read function: nothing) and begins an operation cycle: no test has failed yet, pending
 * and confirmed faults are remembered. Damaged storage starts empty and counts a store failure. If the cycle before was
 * not ended by upb_faults_end, POWER_RESET fails at `now_ns`. Errors: ARGUMENT.
 */
UPB_API upb_status upb_faults_init(upb_faults *faults, const upb_storage *storage, uint64_t now_ns);
/* What the next failures are remembered with. */
UPB_API void upb_faults_context(upb_faults *faults, uint64_t frame, uint32_t mode);
/* A monitor's look. True if testFailed changed. Unknown ids are ignored. */
UPB_API int upb_faults_report(upb_faults *faults, uint32_t id, upb_monitor look, uint64_t now_ns);
/*
 * To test tests: looks at the faults whose bit id-1 is set are ignored from now on, and what is remembered of them is
 * forgotten. Replaces the mask of the call before.
 */
UPB_API void upb_faults_mute(upb_faults *faults, uint64_t mask);
UPB_API int upb_fault_is_active(const upb_faults *faults, uint32_t id);
/* Bit id-1 for each fault whose test fails now. */
UPB_API uint64_t upb_faults_active(const upb_faults *faults);
/* Number of faults with any of the status bits of `mask`. */
UPB_API uint32_t upb_faults_count(const upb_faults *faults, uint8_t mask);
/* Forgets one fault, or all (id 0). Errors: ARGUMENT (no such fault). A monitor that still fails sets it anew. */
UPB_API upb_status upb_faults_clear(upb_faults *faults, uint32_t id);
/*
 * Writes the memory if it changed; a write that failed is tried again at the next call. upb_bus_step calls it at most
 * once a second for what is to be stored soon, once a minute for the rest; upb_bus_end always. Without a write
 * function: UPB_STORED_DONE, nothing is kept.
 */
UPB_API upb_stored upb_faults_save(upb_faults *faults);
/* Ends the operation cycle in good order and writes the memory: the next start finds no POWER_RESET. */
UPB_API upb_stored upb_faults_end(upb_faults *faults);

/* What is stored of the fault memory: always this many bytes (upb_faults.c has their order). */
#define UPB_STORE_FAULTS_BYTES (12u + 32u * UPB_FAULTS_MAX)

#ifdef __cplusplus
}
#endif

#endif /* UPBEAM_FAULTS_H */
