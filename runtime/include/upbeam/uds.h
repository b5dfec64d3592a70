/*
 * Diagnostics: a UDS server (ISO 14229-1) over ISO-TP (ISO 15765-2, normal addressing, classic 8-byte frames). One
 * request at a time, buffers of fixed size, every timeout on the caller's clock.
 */
#ifndef UPBEAM_UDS_H
#define UPBEAM_UDS_H

#include "upbeam/can.h"
#include "upbeam/faults.h"

#ifdef __cplusplus
extern "C" {
#endif

/* ------------------------------------------------------------------------------------------------ ISO-TP */

#define UPB_ISOTP_BYTES 512u /* longest message taken or sent; a longer one is answered with flow status "overflow" */

typedef enum upb_isotp_error {
    UPB_ISOTP_NONE = 0,
    UPB_ISOTP_TIMEOUT_BS = 1,     /* no flow control came */
    UPB_ISOTP_TIMEOUT_CR = 2,     /* no consecutive frame came */
    UPB_ISOTP_WRONG_SEQUENCE = 3, /* a consecutive frame was lost or repeated */
    UPB_ISOTP_UNEXPECTED = 4,     /* a frame that does not belong here; a new first frame ends the old message */
    UPB_ISOTP_OVERFLOW = 5,       /* message longer than UPB_ISOTP_BYTES, or the other side has no room */
    UPB_ISOTP_WAIT_EXCEEDED = 6,  /* too many flow controls "wait" */
    UPB_ISOTP_MALFORMED = 7,      /* a length or flow status that cannot be */
    UPB_ISOTP_SEND_FAILED = 8     /* the transport dropped a frame */
} upb_isotp_error;

#define UPB_ISOTP_ERRORS 9u

typedef struct upb_isotp_config {
    uint32_t tx_id;     /* 11 bits */
    uint32_t rx_id;     /* physical */
    uint32_t rx_id_all; /* functional: single frames only; 0: none */
    uint64_t n_bs_ns;   /* wait for flow control; default 1 s */
    uint64_t n_cr_ns;   /* wait for a consecutive frame; default 1 s */
    uint8_t block_size; /* asked of the sender: consecutive frames per flow control, 0 all */
    uint8_t st_min;     /* asked of the sender: milliseconds between them, 0..127 */
    uint8_t wait_max;   /* flow controls "wait" taken in a row; default 8 */
    uint8_t padding;    /* value of unused bytes; frames are always 8 bytes long. default 0xcc */
} upb_isotp_config;

UPB_API upb_isotp_config upb_isotp_config_default(void);

typedef struct upb_isotp {
    upb_isotp_config config;
    upb_can_transport transport;
    uint64_t errors[UPB_ISOTP_ERRORS]; /* by cause */
    uint64_t rx_deadline_ns;
    uint64_t tx_deadline_ns; /* of flow control, or when the next consecutive frame may go */
    uint64_t tx_gap_ns;      /* st_min the receiver asked for */
    uint16_t rx_length, rx_have, tx_length, tx_sent;
    uint8_t rx_state, tx_state, rx_sequence, tx_sequence, rx_block, tx_block, tx_waits, rx_functional;
    uint8_t flow_pending; /* a flow control to send: 0 none, else status + 1 */
    uint8_t rx[UPB_ISOTP_BYTES];
    uint8_t tx[UPB_ISOTP_BYTES];
} upb_isotp;

UPB_API upb_status upb_isotp_init(upb_isotp *link, const upb_isotp_config *config, const upb_can_transport *transport);
/* A CAN frame: true if it was for this link. A message that became complete waits in rx (upb_isotp_message). */
UPB_API int upb_isotp_receive(upb_isotp *link, const upb_can_frame *frame, uint64_t now_ns);
/* The complete message received, null if there is none; upb_isotp_take frees the buffer for the next. */
UPB_API const uint8_t *upb_isotp_message(const upb_isotp *link, size_t *count, int *functional);
UPB_API void upb_isotp_take(upb_isotp *link);
/* Begins to send. Errors: ARGUMENT (empty, too long), ORDER (one is still being sent). */
UPB_API upb_status upb_isotp_send(upb_isotp *link, const uint8_t *bytes, size_t count, uint64_t now_ns);
/* True until the last frame of the message has left, or the message was given up. */
UPB_API int upb_isotp_is_sending(const upb_isotp *link);
/* Sends what is due, ends what is late. At most 16 frames a call. */
UPB_API void upb_isotp_step(upb_isotp *link, uint64_t now_ns);

/* --------------------------------------------------------------------------------------------------- UDS */

typedef enum upb_did {
    UPB_DID_SESSION = 0xF186,   /* active session, 1 byte */
    UPB_DID_VERSION = 0xF189,   /* text: version of the software */
    UPB_DID_MODEL = 0xFD00,     /* crc32 (4), precision (1), cpu (1), swaps (2) */
    UPB_DID_COUNTERS = 0xFD01,  /* upb_counter in order, 8 bytes each */
    UPB_DID_LATENCY = 0xFD02,   /* of the last frame, greatest: 8 bytes each, ns */
    UPB_DID_COMMANDS = 0xFD03,  /* commands by upb_command_result, 8 bytes each */
    UPB_DID_FRESHNESS = 0xFD04, /* of the last command taken, 4 bytes */
    UPB_DID_DROPS = 0xFD05,     /* drops by cause, 8 bytes each */
    UPB_DID_LEDGER = 0xFD06     /* the last record: the fields of upb_ledger_record in order */
} upb_did;                      /* all numbers big-endian, as UDS has them */

typedef struct upb_uds_config {
    /* Bytes of the data of `did`, 0 for an unknown one; written to `bytes` if they fit `room`. */
    size_t (*read_did)(void *user, uint32_t did, uint8_t *bytes, size_t room);
    /* ECUReset: true if the device will reset after the answer. Null: service not supported. */
    int (*reset)(void *user, uint32_t type);
    uint32_t clear_locked; /* 1: ClearDiagnosticInformation is denied; the authenticated command alone clears */
    void *user;            /* of read_did */
    void *reset_user;
} upb_uds_config;

typedef struct upb_uds {
    upb_uds_config config;
    upb_faults *faults;
    uint64_t session_until_ns; /* S3: end of a session that is not the default one */
    uint8_t session;           /* 1 default, 3 extended */
    uint64_t requests;
    uint64_t refused; /* answered with a negative response, or silently where the standard wants it */
} upb_uds;

UPB_API upb_status upb_uds_init(upb_uds *uds, const upb_uds_config *config, upb_faults *faults);
/* Answers a request; bytes of the answer in `answer` (room for UPB_ISOTP_BYTES), 0: none is due. */
UPB_API size_t upb_uds_answer(upb_uds *uds, const uint8_t *request, size_t count, int functional, uint64_t now_ns,
                              uint8_t *answer);

#ifdef __cplusplus
}
#endif

#endif /* UPBEAM_UDS_H */
