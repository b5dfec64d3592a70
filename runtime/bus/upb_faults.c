/* The fault memory: debounce, UDS status bits, occurrences, storage. */
#include <string.h>

#include "generated/upb_dbc_fault_names.h"
#include "upb_bytes.h"
#include "upbeam/e2e.h"
#include "upbeam/faults.h"

_Static_assert(sizeof dbc_fault_names / sizeof dbc_fault_names[0] == UPB_FAULTS + 1u,
               "upb_fault is not the DBC's list");

enum {
    STORED_MAGIC = 0x4655,
    STORED_VERSION = 1,
    STORED_HEADER = 12,
    STORED_ENTRY = 32,
    CRC_AT = 10, /* of the image with these two bytes 0 */
    COUNTER_FAILED = 127,
    COUNTER_PASSED = -128
};

#define DTC_BASE 0xd00000u
#define STATUS_CLEARED (UPB_DTC_NOT_COMPLETED_SINCE_CLEAR | UPB_DTC_NOT_COMPLETED_THIS_CYCLE)

/* Looks until a fault is set / healed: one; two and four; three and eight; eight and sixteen. */
static const upb_debounce at_once = {127, 128}, quick = {64, 32}, steady = {43, 16}, slow = {16, 8};

upb_debounce upb_fault_debounce(uint32_t id) {
    switch (id) {
    case UPB_FAULT_SENSOR_TIMEOUT:
    case UPB_FAULT_SENSOR_THERMAL:
    case UPB_FAULT_SENSOR_WRONG_MODEL:
    case UPB_FAULT_COMPUTE_INTEGRITY:
    case UPB_FAULT_CAN_COMMAND_REJECTED:
    case UPB_FAULT_MODEL_REJECTED:
    case UPB_FAULT_POWER_RESET:
        return at_once;
    case UPB_FAULT_SENSOR_AZIMUTH_STUCK:
    case UPB_FAULT_SENSOR_AZIMUTH_JUMP:
    case UPB_FAULT_SENSOR_TIME_JUMP:
    case UPB_FAULT_SENSOR_ALL_ZERO:
    case UPB_FAULT_NET_MALFORMED:
    case UPB_FAULT_NET_FLOOD:
    case UPB_FAULT_CAN_BUS_OFF:
        return quick;
    case UPB_FAULT_SENSOR_VISIBILITY:
    case UPB_FAULT_SENSOR_CROSSTALK:
    case UPB_FAULT_SENSOR_PPS_LOST:
    case UPB_FAULT_COMPUTE_THROTTLE:
    case UPB_FAULT_CLOCK_DRIFT:
        return slow;
    default:
        return steady;
    }
}

const char *upb_fault_name(uint32_t id) { return dbc_fault_names[id <= UPB_FAULTS ? id : 0]; }

uint32_t upb_fault_dtc(uint32_t id) { return id >= 1 && id <= UPB_FAULTS ? DTC_BASE + (id << 8) : 0; }

uint32_t upb_fault_of_dtc(uint32_t dtc) {
    const uint32_t id = dtc >> 8 & 0xff;
    return id && dtc == upb_fault_dtc(id) ? id : 0;
}

/* ------------------------------------------------------------------------------------------------ storage */

static void put_entry(const upb_fault_entry *entry, uint8_t *bytes) {
    bytes[0] = entry->status;
    bytes[1] = entry->cycles_ok;
    bytes[2] = entry->mode;
    bytes[3] = 0;
    upb_put_le(bytes + 4, entry->occurrences, 2);
    upb_put_le(bytes + 6, entry->cycle, 2);
    upb_put_le(bytes + 8, entry->first_ns, 8);
    upb_put_le(bytes + 16, entry->last_ns, 8);
    upb_put_le(bytes + 24, entry->frame, 8);
}

static void get_entry(upb_fault_entry *entry, const uint8_t *bytes) {
    entry->status = bytes[0] & UPB_DTC_STATUS_MASK;
    entry->cycles_ok = bytes[1];
    entry->mode = bytes[2];
    entry->occurrences = (uint16_t)upb_get_le(bytes + 4, 2);
    entry->cycle = (uint16_t)upb_get_le(bytes + 6, 2);
    entry->first_ns = upb_get_le(bytes + 8, 8);
    entry->last_ns = upb_get_le(bytes + 16, 8);
    entry->frame = upb_get_le(bytes + 24, 8);
}

/* Magic (2), version, number of entries, cycle (4), ended, 0, CRC-16 (2); then the entries from id 1 on. */
static void put_image(const upb_faults *faults, uint8_t *image) {
    memset(image, 0, UPB_STORE_FAULTS_BYTES);
    upb_put_le(image, STORED_MAGIC, 2);
    image[2] = STORED_VERSION;
    image[3] = UPB_FAULTS;
    upb_put_le(image + 4, faults->cycle, 4);
    image[8] = (uint8_t)faults->ended;
    for (uint32_t id = 1; id <= UPB_FAULTS; id++)
        put_entry(&faults->entries[id], image + STORED_HEADER + STORED_ENTRY * (id - 1));
    upb_put_le(image + CRC_AT, upb_crc16(UPB_CRC16_START, image, UPB_STORE_FAULTS_BYTES), 2);
}

/* False if the image is damaged. A memory of fewer faults, of an older version, is taken. */
static int get_image(upb_faults *faults, uint8_t *image) {
    const uint64_t crc = upb_get_le(image + CRC_AT, 2);
    upb_put_le(image + CRC_AT, 0, 2);
    if (upb_get_le(image, 2) != STORED_MAGIC || image[2] != STORED_VERSION || image[3] > UPB_FAULTS ||
        crc != upb_crc16(UPB_CRC16_START, image, UPB_STORE_FAULTS_BYTES))
        return 0;
    faults->cycle = (uint32_t)upb_get_le(image + 4, 4);
    faults->ended = image[8];
    for (uint32_t id = 1; id <= image[3]; id++)
        get_entry(&faults->entries[id], image + STORED_HEADER + STORED_ENTRY * (id - 1));
    return 1;
}

upb_stored upb_faults_save(upb_faults *faults) {
    uint8_t image[UPB_STORE_FAULTS_BYTES];
    if (!faults->dirty || !faults->storage.write)
        return UPB_STORED_DONE;
    put_image(faults, image);
    if (faults->storage.write(faults->storage.user, UPB_STORE_FAULTS, image, sizeof image) != UPB_STORED_DONE) {
        faults->store_failures++;
        return UPB_STORED_FAILED;
    }
    faults->dirty = UPB_FAULTS_CLEAN;
    return UPB_STORED_DONE;
}

upb_stored upb_faults_end(upb_faults *faults) {
    faults->ended = 1;
    faults->dirty = UPB_FAULTS_SOON;
    return upb_faults_save(faults);
}

/* ------------------------------------------------------------------------------------------------- cycles */

static void forget(upb_fault_entry *entry) {
    memset(entry, 0, sizeof *entry);
    entry->status = STATUS_CLEARED;
}

/* The end of the operation cycle that was stored, seen from the start of the next. */
static void begin_cycle(upb_fault_entry *entry) {
    const int failed = entry->status & UPB_DTC_TEST_FAILED_THIS_CYCLE;
    const int passed = !failed && !(entry->status & UPB_DTC_NOT_COMPLETED_THIS_CYCLE);
    if (passed) {
        entry->status &= (uint8_t)~UPB_DTC_PENDING;
        if (entry->status & UPB_DTC_CONFIRMED && ++entry->cycles_ok >= UPB_FAULTS_AGE_CYCLES)
            entry->status &= (uint8_t)~UPB_DTC_CONFIRMED;
    }
    entry->status &= (uint8_t)~(UPB_DTC_TEST_FAILED | UPB_DTC_TEST_FAILED_THIS_CYCLE);
    entry->status |= UPB_DTC_NOT_COMPLETED_THIS_CYCLE;
    entry->counter = 0;
}

static void load(upb_faults *faults, int *ended) {
    uint8_t image[UPB_STORE_FAULTS_BYTES];
    *ended = 1; /* of a new device */
    if (!faults->storage.read)
        return;
    const upb_stored found = faults->storage.read(faults->storage.user, UPB_STORE_FAULTS, image, sizeof image);
    if (found == UPB_STORED_NOTHING)
        return;
    if (found == UPB_STORED_DONE && get_image(faults, image))
        *ended = (int)faults->ended;
    else
        faults->store_failures++;
}

upb_status upb_faults_init(upb_faults *faults, const upb_storage *storage, uint64_t now_ns) {
    int ended;
    if (!faults || !storage)
        return UPB_E_ARGUMENT;
    memset(faults, 0, sizeof *faults);
    for (uint32_t id = 0; id <= UPB_FAULTS; id++) {
        forget(&faults->entries[id]);
        faults->debounce[id] = upb_fault_debounce(id);
    }
    faults->storage = *storage;
    load(faults, &ended);
    for (uint32_t id = 1; id <= UPB_FAULTS; id++)
        begin_cycle(&faults->entries[id]);
    faults->cycle++;
    faults->ended = 0;
    faults->dirty = UPB_FAULTS_SOON;
    upb_faults_report(faults, UPB_FAULT_POWER_RESET, ended ? UPB_MONITOR_PASSED : UPB_MONITOR_FAILED, now_ns);
    return UPB_OK;
}

void upb_faults_context(upb_faults *faults, uint64_t frame, uint32_t mode) {
    faults->frame = frame;
    faults->mode = mode;
}

/* ----------------------------------------------------------------------------------------------- reports */

static void note_failure(upb_faults *faults, uint32_t id, uint64_t now_ns) {
    upb_fault_entry *entry = &faults->entries[id];
    if (entry->occurrences == 0)
        entry->first_ns = now_ns;
    entry->occurrences = (uint16_t)(entry->occurrences + (entry->occurrences < UINT16_MAX));
    entry->last_ns = now_ns;
    entry->frame = faults->frame;
    entry->mode = (uint8_t)faults->mode;
    entry->cycle = (uint16_t)faults->cycle;
    entry->cycles_ok = 0;
    entry->status |= UPB_DTC_TEST_FAILED | UPB_DTC_TEST_FAILED_THIS_CYCLE | UPB_DTC_PENDING | UPB_DTC_CONFIRMED |
                     UPB_DTC_FAILED_SINCE_CLEAR;
    faults->latest = id;
}

static int count_look(int counter, upb_debounce debounce, upb_monitor look) {
    switch (look) {
    case UPB_MONITOR_PASSED:
        return COUNTER_PASSED;
    case UPB_MONITOR_FAILED:
        return COUNTER_FAILED;
    case UPB_MONITOR_PREFAILED:
        counter = (counter < 0 ? 0 : counter) + debounce.up;
        return counter > COUNTER_FAILED ? COUNTER_FAILED : counter;
    default:
        counter = (counter > 0 ? 0 : counter) - debounce.down;
        return counter < COUNTER_PASSED ? COUNTER_PASSED : counter;
    }
}

int upb_faults_report(upb_faults *faults, uint32_t id, upb_monitor look, uint64_t now_ns) {
    if (id < 1 || id > UPB_FAULTS || look > UPB_MONITOR_FAILED || faults->muted >> (id - 1) & 1)
        return 0;
    upb_fault_entry *entry = &faults->entries[id];
    const uint8_t before = entry->status;
    const int counter = count_look(entry->counter, faults->debounce[id], look);
    entry->counter = (int8_t)counter;
    if (counter != COUNTER_FAILED && counter != COUNTER_PASSED)
        return 0;
    entry->status &= (uint8_t)~STATUS_CLEARED;
    if (counter == COUNTER_PASSED)
        entry->status &= (uint8_t)~UPB_DTC_TEST_FAILED;
    else if (!(before & UPB_DTC_TEST_FAILED))
        note_failure(faults, id, now_ns);
    const uint8_t changed = entry->status ^ before;
    if (changed & ~UPB_DTC_TEST_FAILED)
        faults->dirty = UPB_FAULTS_SOON;
    else if (changed && faults->dirty == UPB_FAULTS_CLEAN)
        faults->dirty = UPB_FAULTS_LATER;
    return changed & UPB_DTC_TEST_FAILED;
}

int upb_fault_is_active(const upb_faults *faults, uint32_t id) {
    return id >= 1 && id <= UPB_FAULTS && faults->entries[id].status & UPB_DTC_TEST_FAILED;
}

uint64_t upb_faults_active(const upb_faults *faults) {
    uint64_t active = 0;
    for (uint32_t id = 1; id <= UPB_FAULTS; id++)
        active |= (uint64_t)(faults->entries[id].status & UPB_DTC_TEST_FAILED) << (id - 1);
    return active;
}

uint32_t upb_faults_count(const upb_faults *faults, uint8_t mask) {
    uint32_t count = 0;
    for (uint32_t id = 1; id <= UPB_FAULTS; id++)
        count += (faults->entries[id].status & mask) != 0;
    return count;
}

upb_status upb_faults_clear(upb_faults *faults, uint32_t id) {
    if (!faults || id > UPB_FAULTS)
        return UPB_E_ARGUMENT;
    for (uint32_t i = id ? id : 1; i <= (id ? id : UPB_FAULTS); i++)
        forget(&faults->entries[i]);
    if (id == 0 || faults->latest == id)
        faults->latest = 0;
    faults->dirty = UPB_FAULTS_SOON;
    return UPB_OK;
}

void upb_faults_mute(upb_faults *faults, uint64_t mask) {
    faults->muted = mask;
    for (uint32_t id = 1; id <= UPB_FAULTS; id++)
        if (mask >> (id - 1) & 1)
            upb_faults_clear(faults, id);
}
