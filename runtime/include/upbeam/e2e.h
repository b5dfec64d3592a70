/*
 * AUTOSAR end-to-end protection (AUTOSAR FO PRS_E2EProtocol): Profile 11 for classic CAN, Profile 5 for CAN FD, and the
 * receiver's state machine. It finds damage, loss, repetition and mixing-up of messages; it does not keep out an
 * attacker (upbeam/command.h does).
 */
#ifndef UPBEAM_E2E_H
#define UPBEAM_E2E_H

#include "upbeam/upbeam.h"

#ifdef __cplusplus
extern "C" {
#endif

/*
 * Checksums, named by their entry in the catalogue of parametrised CRC algorithms; the value in brackets is that of the
 * nine bytes "123456789". `crc` is the value of the bytes before, or the named start value for the first.
 */
#define UPB_CRC8_START                                                                                                 \
    0u /* CRC-8/SAE-J1850-ZERO, also CRC-8/GSM-A (0x37): E2E Profile 11 cancels start and final XOR */
#define UPB_CRC16_START 0xffffu /* CRC-16/IBM-3740, also CRC-16/CCITT-FALSE (0x29b1): Profile 5, serial console */
UPB_API uint8_t upb_crc8(uint8_t crc, const void *bytes, size_t count);
UPB_API uint16_t upb_crc16(uint16_t crc, const void *bytes, size_t count);

typedef enum upb_e2e_status {
    UPB_E2E_OK = 0,
    UPB_E2E_OK_SOME_LOST = 1,   /* the counter went on by more than one, within max_delta_counter */
    UPB_E2E_WRONG_CRC = 2,      /* damaged, another data id, or another length (AUTOSAR: ERROR) */
    UPB_E2E_REPEATED = 3,       /* the same counter again */
    UPB_E2E_WRONG_SEQUENCE = 4, /* the counter went on by more than max_delta_counter; taken as the new counter */
    UPB_E2E_NO_NEW_DATA = 5     /* nothing was received since the last check */
} upb_e2e_status;

/* Profile 11, variant 11C: CRC in byte 0, counter 0..14 in the low nibble of byte 1, bits 8..11 of the data id above.
 */
#define UPB_E2E_P11_HEADER 2u
#define UPB_E2E_P11_COUNTERS 15u
/* Profile 5, offset 0: CRC in bytes 0 and 1, little-endian, counter 0..255 in byte 2. */
#define UPB_E2E_P05_HEADER 3u

typedef struct upb_e2e_config {
    uint16_t data_id;          /* Profile 11: 12 bits; never 0xf00..0xfff */
    uint8_t length;            /* bytes of the message, its header with them: 2..8, Profile 5 3..64 */
    uint8_t max_delta_counter; /* the counter may go on by at most this between two checks: 1.. */
} upb_e2e_config;

/* Puts `counter` and the CRC into `data` and gives the counter of the message after it. Errors: ARGUMENT. */
UPB_API upb_status upb_e2e_p11_protect(const upb_e2e_config *config, uint8_t *counter, uint8_t *data, size_t count);
UPB_API upb_status upb_e2e_p05_protect(const upb_e2e_config *config, uint8_t *counter, uint8_t *data, size_t count);

/* The receiver of one message; upb_e2e_check_init before the first check. */
typedef struct upb_e2e_check {
    uint8_t counter; /* of the last message whose CRC was good */
    uint8_t delta;   /* how far the counter went on at the last check */
} upb_e2e_check;

UPB_API void upb_e2e_p11_check_init(upb_e2e_check *check);
UPB_API void upb_e2e_p05_check_init(upb_e2e_check *check);
/* Judges a message; `data` null: nothing was received. As AUTOSAR has it, the first counter expected is 0. */
UPB_API upb_e2e_status upb_e2e_p11_check(upb_e2e_check *check, const upb_e2e_config *config, const uint8_t *data,
                                         size_t count);
UPB_API upb_e2e_status upb_e2e_p05_check(upb_e2e_check *check, const upb_e2e_config *config, const uint8_t *data,
                                         size_t count);

/* --------------------------------------------------------------------------------------- state machine */

#define UPB_E2E_WINDOW_MAX 16u

typedef enum upb_e2e_state {
    UPB_E2E_STATE_NODATA = 0, /* nothing usable was received yet */
    UPB_E2E_STATE_INIT = 1,   /* being qualified */
    UPB_E2E_STATE_VALID = 2,  /* the data may be used */
    UPB_E2E_STATE_INVALID = 3 /* it may not */
} upb_e2e_state;

/* Limits over the last `window` checks in one state: at least min_ok good ones, at most max_error wrong CRCs. */
typedef struct upb_e2e_window {
    uint8_t window; /* 1..UPB_E2E_WINDOW_MAX */
    uint8_t min_ok;
    uint8_t max_error;
} upb_e2e_window;

typedef struct upb_e2e_machine_config {
    upb_e2e_window init;
    upb_e2e_window valid;
    upb_e2e_window invalid;
    uint8_t clear_to_invalid; /* 1: forget the window on the way to INVALID */
} upb_e2e_machine_config;

typedef struct upb_e2e_machine {
    upb_e2e_machine_config config;
    upb_e2e_state state;
    uint8_t count; /* statuses in `window`, from the oldest on */
    uint8_t window[UPB_E2E_WINDOW_MAX];
} upb_e2e_machine;

/* Errors: ARGUMENT (a window of 0 or too large, a minimum above its window). */
UPB_API upb_status upb_e2e_machine_init(upb_e2e_machine *machine, const upb_e2e_machine_config *config);
/* One check's status in, the new state out. */
UPB_API upb_e2e_state upb_e2e_machine_step(upb_e2e_machine *machine, upb_e2e_status status);

#ifdef __cplusplus
}
#endif

#endif /* UPBEAM_E2E_H */
