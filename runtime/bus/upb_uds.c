/* A UDS server (ISO 14229-1): sessions, fault memory, data by identifier. */
#include <string.h>

#include "upb_bytes.h"
#include "upbeam/uds.h"

enum {
    SID_SESSION = 0x10,
    SID_RESET = 0x11,
    SID_CLEAR = 0x14,
    SID_READ_DTC = 0x19,
    SID_READ_DID = 0x22,
    SID_TESTER_PRESENT = 0x3e,
    POSITIVE = 0x40,
    NEGATIVE = 0x7f,
    SUPPRESS = 0x80
};

typedef enum nrc {
    NRC_NONE = 0,
    NRC_NO_SERVICE = 0x11,
    NRC_NO_SUBFUNCTION = 0x12,
    NRC_LENGTH = 0x13,
    NRC_TOO_LONG = 0x14,
    NRC_CONDITIONS = 0x22,
    NRC_OUT_OF_RANGE = 0x31,
    NRC_SECURITY = 0x33,
    NRC_NO_SERVICE_IN_SESSION = 0x7f
} nrc;

enum { SESSION_DEFAULT = 1, SESSION_EXTENDED = 3, RESET_HARD = 1, RESET_SOFT = 3 };
enum { P2_MS = 50, P2_EXTENDED_10MS = 500, DIDS_MAX = 8, DTC_FORMAT_UDS = 1, GROUP_ALL = 0xffffff };
enum { DTC_COUNT = 0x01, DTC_BY_MASK = 0x02, DTC_SNAPSHOT = 0x04, DTC_EXTENDED = 0x06, DTC_SUPPORTED = 0x0a };
enum { RECORD = 1, RECORD_ALL = 0xff };
/* Identifiers in the snapshot record of a fault. */
enum { DID_FRAME = 0xfd10, DID_MODE = 0xfd11, DID_FIRST = 0xfd12, DID_LAST = 0xfd13, DID_CYCLE = 0xfd14 };

#define S3_NS 5000000000u /* a session ends this long after the last request */

typedef struct request {
    const uint8_t *bytes;
    size_t count;
} request;

typedef struct answer {
    uint8_t *bytes; /* room for UPB_ISOTP_BYTES */
    size_t count;
} answer;

upb_status upb_uds_init(upb_uds *uds, const upb_uds_config *config, upb_faults *faults) {
    if (!uds || !config || !faults || !config->read_did)
        return UPB_E_ARGUMENT;
    memset(uds, 0, sizeof *uds);
    uds->config = *config;
    uds->faults = faults;
    uds->session = SESSION_DEFAULT;
    return UPB_OK;
}

static void put(answer *out, uint64_t value, size_t bytes) {
    upb_put_be(out->bytes + out->count, value, bytes);
    out->count += bytes;
}

static nrc change_session(upb_uds *uds, const request *in, answer *out) {
    if (in->count != 2)
        return NRC_LENGTH;
    const uint8_t session = in->bytes[1] & (uint8_t)~SUPPRESS;
    if (session != SESSION_DEFAULT && session != SESSION_EXTENDED)
        return NRC_NO_SUBFUNCTION;
    uds->session = session;
    put(out, session, 1);
    put(out, P2_MS, 2);
    put(out, P2_EXTENDED_10MS, 2);
    return NRC_NONE;
}

static nrc reset(upb_uds *uds, const request *in, answer *out) {
    if (!uds->config.reset)
        return NRC_NO_SERVICE;
    if (uds->session == SESSION_DEFAULT)
        return NRC_NO_SERVICE_IN_SESSION;
    if (in->count != 2)
        return NRC_LENGTH;
    const uint8_t type = in->bytes[1] & (uint8_t)~SUPPRESS;
    if (type != RESET_HARD && type != RESET_SOFT)
        return NRC_NO_SUBFUNCTION;
    if (!uds->config.reset(uds->config.reset_user, type))
        return NRC_CONDITIONS;
    put(out, type, 1);
    return NRC_NONE;
}

static nrc tester_present(upb_uds *uds, const request *in, answer *out) {
    (void)uds;
    if (in->count != 2)
        return NRC_LENGTH;
    if (in->bytes[1] & (uint8_t)~SUPPRESS)
        return NRC_NO_SUBFUNCTION;
    put(out, 0, 1);
    return NRC_NONE;
}

static nrc clear_faults(upb_uds *uds, const request *in, answer *out) {
    (void)out;
    if (uds->session == SESSION_DEFAULT)
        return NRC_NO_SERVICE_IN_SESSION;
    if (in->count != 4)
        return NRC_LENGTH;
    const uint32_t group = (uint32_t)upb_get_be(in->bytes + 1, 3);
    const uint32_t id = upb_fault_of_dtc(group);
    if (group != GROUP_ALL && !id)
        return NRC_OUT_OF_RANGE;
    if (uds->config.clear_locked)
        return NRC_SECURITY;
    upb_faults_clear(uds->faults, id);
    return NRC_NONE;
}

static nrc count_faults(upb_uds *uds, const request *in, answer *out) {
    if (in->count != 3)
        return NRC_LENGTH;
    put(out, UPB_DTC_STATUS_MASK, 1);
    put(out, DTC_FORMAT_UDS, 1);
    put(out, upb_faults_count(uds->faults, in->bytes[2]), 2);
    return NRC_NONE;
}

_Static_assert(3 + 4 * UPB_FAULTS <= UPB_ISOTP_BYTES, "the list of all faults fits a message");

/* Every fault whose status has a bit of `mask`; all of them for `mask` 0. */
static nrc list_faults(upb_uds *uds, uint8_t mask, answer *out) {
    put(out, UPB_DTC_STATUS_MASK, 1);
    for (uint32_t id = 1; id <= UPB_FAULTS; id++) {
        const uint8_t status = uds->faults->entries[id].status;
        if (!mask || status & mask) {
            put(out, upb_fault_dtc(id), 3);
            put(out, status, 1);
        }
    }
    return NRC_NONE;
}

static void put_snapshot(const upb_fault_entry *entry, answer *out) {
    put(out, RECORD, 1);
    put(out, 5, 1); /* identifiers that follow */
    put(out, DID_FRAME, 2);
    put(out, entry->frame, 8);
    put(out, DID_MODE, 2);
    put(out, entry->mode, 1);
    put(out, DID_FIRST, 2);
    put(out, entry->first_ns, 8);
    put(out, DID_LAST, 2);
    put(out, entry->last_ns, 8);
    put(out, DID_CYCLE, 2);
    put(out, entry->cycle, 2);
}

static void put_extended(const upb_fault_entry *entry, answer *out) {
    put(out, RECORD, 1);
    put(out, entry->occurrences, 2);
    put(out, (uint8_t)entry->counter, 1);
    put(out, entry->cycles_ok, 1);
}

/* The records of one fault; none for a fault that never failed. */
static nrc read_record(upb_uds *uds, const request *in, answer *out,
                       void (*put_record)(const upb_fault_entry *, answer *)) {
    if (in->count != 6)
        return NRC_LENGTH;
    const uint32_t id = upb_fault_of_dtc((uint32_t)upb_get_be(in->bytes + 2, 3));
    if (!id || (in->bytes[5] != RECORD && in->bytes[5] != RECORD_ALL))
        return NRC_OUT_OF_RANGE;
    const upb_fault_entry *entry = &uds->faults->entries[id];
    put(out, upb_fault_dtc(id), 3);
    put(out, entry->status, 1);
    if (entry->occurrences)
        put_record(entry, out);
    return NRC_NONE;
}

static nrc read_faults(upb_uds *uds, const request *in, answer *out) {
    if (in->count < 2)
        return NRC_LENGTH;
    const uint8_t report = in->bytes[1] & (uint8_t)~SUPPRESS;
    put(out, report, 1);
    switch (report) {
    case DTC_COUNT:
        return count_faults(uds, in, out);
    case DTC_BY_MASK:
        if (in->count != 3)
            return NRC_LENGTH;
        if (!(in->bytes[2] & UPB_DTC_STATUS_MASK)) {
            put(out, UPB_DTC_STATUS_MASK, 1);
            return NRC_NONE;
        }
        return list_faults(uds, in->bytes[2] & UPB_DTC_STATUS_MASK, out);
    case DTC_SUPPORTED:
        return in->count == 2 ? list_faults(uds, 0, out) : NRC_LENGTH;
    case DTC_SNAPSHOT:
        return read_record(uds, in, out, put_snapshot);
    case DTC_EXTENDED:
        return read_record(uds, in, out, put_extended);
    default:
        return NRC_NO_SUBFUNCTION;
    }
}

/* Bytes of an identifier's data, 0 for an unknown one; written to `bytes` if they fit `room`. */
static size_t read_did(const upb_uds *uds, uint32_t did, uint8_t *bytes, size_t room) {
    if (did != UPB_DID_SESSION)
        return uds->config.read_did(uds->config.user, did, bytes, room);
    if (room)
        bytes[0] = uds->session;
    return 1;
}

static nrc read_dids(upb_uds *uds, const request *in, answer *out) {
    if (in->count < 3 || in->count % 2 == 0 || in->count > 1 + 2 * DIDS_MAX)
        return NRC_LENGTH;
    int known = 0;
    for (size_t at = 1; at < in->count; at += 2) {
        const uint32_t did = (uint32_t)upb_get_be(in->bytes + at, 2);
        const size_t used = out->count + 2, room = used < UPB_ISOTP_BYTES ? UPB_ISOTP_BYTES - used : 0;
        const size_t count = read_did(uds, did, out->bytes + (room ? used : 0), room);
        if (!count)
            continue;
        if (count > room)
            return NRC_TOO_LONG;
        put(out, did, 2);
        out->count += count;
        known = 1;
    }
    return known ? NRC_NONE : NRC_OUT_OF_RANGE;
}

static nrc serve(upb_uds *uds, const request *in, answer *out) {
    switch (in->bytes[0]) {
    case SID_SESSION:
        return change_session(uds, in, out);
    case SID_RESET:
        return reset(uds, in, out);
    case SID_CLEAR:
        return clear_faults(uds, in, out);
    case SID_READ_DTC:
        return read_faults(uds, in, out);
    case SID_READ_DID:
        return read_dids(uds, in, out);
    case SID_TESTER_PRESENT:
        return tester_present(uds, in, out);
    default:
        return NRC_NO_SERVICE;
    }
}

/* Asked of all devices, one that cannot serve says nothing. */
static int is_silent(nrc code) {
    return code == NRC_NO_SERVICE || code == NRC_NO_SUBFUNCTION || code == NRC_OUT_OF_RANGE ||
           code == NRC_NO_SERVICE_IN_SESSION;
}

static int has_subfunction(uint8_t sid) {
    return sid == SID_SESSION || sid == SID_RESET || sid == SID_READ_DTC || sid == SID_TESTER_PRESENT;
}

size_t upb_uds_answer(upb_uds *uds, const uint8_t *bytes, size_t count, int functional, uint64_t now_ns,
                      uint8_t *answered) {
    if (!uds || !bytes || !count || !answered)
        return 0;
    if (uds->session != SESSION_DEFAULT && now_ns >= uds->session_until_ns)
        uds->session = SESSION_DEFAULT;
    const request in = {bytes, count};
    answer out = {answered, 0};
    put(&out, bytes[0] | (uint8_t)POSITIVE, 1);
    uds->requests++;
    const nrc code = serve(uds, &in, &out);
    uds->session_until_ns = now_ns + S3_NS;
    if (code == NRC_NONE)
        return has_subfunction(bytes[0]) && bytes[1] & SUPPRESS ? 0 : out.count;
    uds->refused++;
    if (functional && is_silent(code))
        return 0;
    out.count = 0;
    put(&out, NEGATIVE, 1);
    put(&out, bytes[0], 1);
    put(&out, code, 1);
    return out.count;
}
