/*
 * Commands from outside, on CAN FD and on the serial console. A command is taken only if its checksum is good, its
 * CMAC-AES-128 (RFC 4493, the first 64 bits) was made with the device's key, and its freshness counter is above that of
 * every command taken before, over restarts. Anything else changes nothing and is counted by cause.
 */
#ifndef UPBEAM_COMMAND_H
#define UPBEAM_COMMAND_H

#include "upbeam/can.h"
#include "upbeam/e2e.h"

#ifdef __cplusplus
extern "C" {
#endif

#define UPB_KEY_BYTES 16u
#define UPB_MAC_BYTES 8u

/* AES-128-CMAC of `count` bytes, all 16 bytes of it. No branch and no address depends on key or data. */
UPB_API void upb_cmac(const uint8_t key[UPB_KEY_BYTES], const uint8_t *bytes, size_t count, uint8_t mac[16]);

typedef enum upb_command_code {
    UPB_COMMAND_STATUS = 1,      /* answer, and send every status message now */
    UPB_COMMAND_MODE = 2,        /* argument: upb_mode to hold, or UPB_MODE_AUTOMATIC */
    UPB_COMMAND_MODEL = 3,       /* model_crc32: the model file to change to, at a frame boundary */
    UPB_COMMAND_CLEAR_FAULTS = 4 /* argument: fault id, 0 all */
} upb_command_code;

#define UPB_MODE_AUTOMATIC 255u /* the degradation ladder decides */

typedef struct upb_command {
    uint32_t code;        /* upb_command_code */
    uint32_t freshness;   /* counter: above that of every command before it */
    uint32_t argument;    /* 0..255 */
    uint32_t model_crc32; /* upb_model_info.crc32 */
} upb_command;

typedef enum upb_command_result {
    UPB_COMMAND_DONE = 0,
    UPB_COMMAND_E2E = 1,     /* length or checksum wrong: not answered */
    UPB_COMMAND_NO_KEY = 2,  /* the device has no key: it takes no command */
    UPB_COMMAND_MAC = 3,     /* not made with the device's key */
    UPB_COMMAND_STALE = 4,   /* its freshness counter is not above the last one's: a replay */
    UPB_COMMAND_STORAGE = 5, /* the freshness counter cannot be read or written: nothing is taken */
    UPB_COMMAND_UNKNOWN = 6, /* no such command */
    UPB_COMMAND_VALUE = 7,   /* an argument outside its range, or reserved bits not 0 */
    UPB_COMMAND_REFUSED = 8  /* the device refused: no such model, not now */
} upb_command_result;

#define UPB_COMMAND_RESULTS 9u

/* "DONE", static; "?" for unknown results. */
UPB_API const char *upb_command_result_text(uint32_t result);

/* Message bytes on CAN FD and in console records (hw_sim/can/upbeam.dbc: TST_Command, UPB_Response). */
#define UPB_COMMAND_BYTES 24u
#define UPB_COMMAND_ID 0x300u
#define UPB_COMMAND_DATA_ID 0x0300u
#define UPB_RESPONSE_ID 0x301u
#define UPB_RESPONSE_DATA_ID 0x0301u

typedef struct upb_response {
    uint32_t code;             /* of the command, as it came */
    uint32_t result;           /* upb_command_result */
    uint32_t freshness;        /* of the command, as it came */
    uint32_t stored_freshness; /* of the last command taken */
    uint32_t mode;             /* upb_mode now */
} upb_response;

/*
 * Carries out a command that was found authentic and fresh: DONE, VALUE or REFUSED (other results count as that).
 * UPB_COMMAND_STATUS and UPB_COMMAND_CLEAR_FAULTS do not come here.
 */
typedef upb_command_result (*upb_command_fn)(void *user, const upb_command *command);

#define UPB_STORE_FRESHNESS_BYTES 12u

typedef struct upb_commands {
    uint8_t key[UPB_KEY_BYTES];
    uint8_t has_key;
    uint8_t storage_good; /* the freshness counter is known */
    uint8_t sequence;     /* E2E counter of the next response */
    uint32_t freshness;   /* of the last command taken, 0: none ever */
    upb_storage storage;
    upb_command_fn execute;
    void *user;
    uint64_t results[UPB_COMMAND_RESULTS]; /* commands by upb_command_result */
    uint64_t sequence_faults; /* E2E counter not the expected one; counted, not refused: freshness decides */
    upb_e2e_check check;
} upb_commands;

/*
 * `key` null or all zero: the device has no key and takes no command. Storage that holds nothing begins at 0; storage
 * that cannot be read, or holds damage, refuses every command (STORAGE) until the device is provisioned again.
 * `execute` may be null: mode and model commands are then REFUSED. Errors: ARGUMENT (no storage functions).
 */
UPB_API upb_status upb_commands_init(upb_commands *commands, const uint8_t *key, const upb_storage *storage,
                                     upb_command_fn execute, void *user);

/*
 * Judges the bytes of a command message and fills *command; DONE if it is authentic and fresh and its counter is stored
 * (the counter is used up then, whatever comes of the command). Counts every result but DONE.
 */
UPB_API upb_command_result upb_command_accept(upb_commands *commands, const uint8_t *data, size_t count,
                                              upb_command *command);

/* Builds the bytes of a command: the tester's side. `sequence` is the E2E counter, advanced. Errors: ARGUMENT. */
UPB_API upb_status upb_command_build(const upb_command *command, const uint8_t key[UPB_KEY_BYTES], uint8_t *sequence,
                                     uint8_t data[UPB_COMMAND_BYTES]);
/* Builds the bytes of a response; authenticated only if `authentic`, else its MAC is 0. */
UPB_API upb_status upb_response_build(upb_commands *commands, const upb_response *response, int authentic,
                                      uint8_t data[UPB_COMMAND_BYTES]);

#ifdef __cplusplus
}
#endif

#endif /* UPBEAM_COMMAND_H */
