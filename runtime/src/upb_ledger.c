/* Deadline ledger: one record per frame, in memory of the caller. */
#include <string.h>

#include "upbeam/upbeam.h"

enum { OPEN_MAX = sizeof((upb_ledger *)0)->open / sizeof((upb_ledger *)0)->open[0] };

upb_status upb_ledger_init(upb_ledger *ledger, upb_ledger_record *records, uint32_t capacity, uint64_t deadline_ns,
                           upb_clock clock) {
    if (!ledger || !records || capacity == 0 || !clock.now_ns)
        return UPB_E_ARGUMENT;
    memset(ledger, 0, sizeof *ledger);
    memset(records, 0, capacity * sizeof *records);
    ledger->clock = clock;
    ledger->deadline_ns = deadline_ns;
    ledger->records = records;
    ledger->capacity = capacity;
    return UPB_OK;
}

/* Index among the open frames, open_count if it is not there. */
static uint32_t find_open(const upb_ledger *ledger, uint64_t frame) {
    uint32_t i = 0;
    while (i < ledger->open_count && ledger->open[i].frame != frame)
        i++;
    return i;
}

static void remove_open(upb_ledger *ledger, uint32_t index) {
    ledger->open_count--;
    for (uint32_t i = index; i < ledger->open_count; i++)
        ledger->open[i] = ledger->open[i + 1];
}

/* True if a frame may be opened: frames come in order, and a closed one is never opened again. */
static int is_new(const upb_ledger *ledger, uint64_t frame) {
    if (ledger->open_count && frame < ledger->open[ledger->open_count - 1].frame)
        return 0;
    return ledger->closed == 0 || frame > ledger->records[(ledger->closed - 1) % ledger->capacity].frame;
}

upb_status upb_ledger_input(upb_ledger *ledger, uint64_t frame, uint64_t received_ns) {
    if (!ledger)
        return UPB_E_ARGUMENT;
    uint32_t index = find_open(ledger, frame);
    if (index < ledger->open_count) {
        if (received_ns < ledger->open[index].last_input_ns)
            return UPB_E_ARGUMENT;
        ledger->open[index].last_input_ns = received_ns;
        return UPB_OK;
    }
    if (!is_new(ledger, frame))
        return UPB_E_ARGUMENT;
    if (ledger->open_count == OPEN_MAX) {
        remove_open(ledger, 0);
        ledger->lost++;
    }
    upb_ledger_record *opened = &ledger->open[ledger->open_count++];
    memset(opened, 0, sizeof *opened);
    opened->frame = frame;
    opened->first_input_ns = opened->last_input_ns = received_ns;
    return UPB_OK;
}

static void judge(upb_ledger *ledger, upb_ledger_record *record, uint32_t partial) {
    if (partial) {
        record->verdict = UPB_VERDICT_PARTIAL;
        ledger->partial++;
        return;
    }
    record->verdict = record->latency_ns > ledger->deadline_ns ? UPB_VERDICT_MISSED : UPB_VERDICT_MET;
    ledger->missed += record->verdict == UPB_VERDICT_MISSED;
    upb_histogram_add(&ledger->latency, record->latency_ns);
}

upb_status upb_ledger_output(upb_ledger *ledger, uint64_t frame, uint32_t missing_columns, uint32_t partial,
                             uint32_t mode, upb_ledger_record *record) {
    if (!ledger || mode >= UPB_MODES)
        return UPB_E_ARGUMENT;
    const uint32_t index = find_open(ledger, frame);
    if (index == ledger->open_count)
        return UPB_E_ARGUMENT;
    const uint64_t now = ledger->clock.now_ns(ledger->clock.user);
    if (now < ledger->open[index].last_input_ns)
        return UPB_E_ARGUMENT;
    upb_ledger_record *closed = &ledger->records[ledger->closed % ledger->capacity];
    *closed = ledger->open[index];
    closed->output_ns = now;
    closed->latency_ns = now - closed->last_input_ns;
    closed->missing_columns = missing_columns;
    closed->mode = mode;
    judge(ledger, closed, partial);
    ledger->closed++;
    remove_open(ledger, index);
    if (record)
        *record = *closed;
    return UPB_OK;
}
