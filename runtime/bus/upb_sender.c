/* The status messages of hw_sim/can/upbeam.dbc: contents, cycle times, E2E counters. */
#include "upb_sender.h"

#include <string.h>

#include "generated/upb_dbc.h"
#include "generated/upb_dbc_tables.h"

_Static_assert(sizeof dbc_messages / sizeof dbc_messages[0] == UPB_MESSAGES, "upb_message is not the DBC's list");
_Static_assert(sizeof dbc_counters / sizeof dbc_counters[0] == UPB_COUNTERS + UPB_DROP_CAUSES_MAX,
               "upb_counter is not the DBC's list");
_Static_assert(sizeof dbc_fault_bits / sizeof dbc_fault_bits[0] == UPB_FAULTS + 1u, "upb_fault is not the DBC's list");

enum { CYCLIC = UPB_MESSAGE_LEDGER, STAGGER_NS = 5000000, COUNTERS_ALL = UPB_COUNTERS + UPB_DROP_CAUSES_MAX };

#define MAX_24 ((uint32_t)0xffffff)
#define MAX_40 ((uint64_t)0xffffffffff)
#define LATENCY_NOT_AVAILABLE MAX_24
#define NS_PER_MS 1000000u

const upb_message_info *upb_message_get_info(upb_message message) {
    return (uint32_t)message < UPB_MESSAGES ? &dbc_messages[message] : NULL;
}

/* ----------------------------------------------------------------------------------------------- contents */

static uint64_t at_most(uint64_t value, uint64_t limit) { return value < limit ? value : limit; }

static uint32_t latency_us(const upb_bus *bus, uint64_t latency_ns) {
    if (!bus->snapshot.counters[UPB_COUNTER_FRAMES])
        return LATENCY_NOT_AVAILABLE;
    return (uint32_t)at_most(latency_ns / 1000, MAX_24 - 1);
}

static void pack_status(const upb_bus *bus, uint8_t *data) {
    const upb_bus_snapshot *now = &bus->snapshot;
    const struct upb_dbc_upb_status_t message = {
        .mode = (uint8_t)(now->mode & 15u),
        .verdict = (uint8_t)(now->record.verdict & 15u),
        .state = (uint8_t)(now->state & 15u),
        .commands_enabled = bus->commands.has_key && bus->commands.storage_good,
        .fault_active = upb_faults_active(&bus->faults) != 0,
        .frame = (uint32_t)now->record.frame,
    };
    upb_dbc_upb_status_pack(data, &message, UPB_CAN_CLASSIC_BYTES);
}

static void pack_latency(const upb_bus *bus, uint8_t *data) {
    const struct upb_dbc_upb_latency_t message = {
        .latency_last = latency_us(bus, bus->snapshot.record.latency_ns),
        .latency_max = latency_us(bus, bus->snapshot.latency_max_ns),
    };
    upb_dbc_upb_latency_pack(data, &message, UPB_CAN_CLASSIC_BYTES);
}

static void pack_counter(const upb_bus *bus, uint32_t which, uint8_t *data) {
    struct upb_dbc_upb_counters_t message;
    const uint64_t value =
        which < UPB_COUNTERS ? upb_bus_counter(bus, which) : bus->snapshot.drops[which - UPB_COUNTERS];
    const uint64_t shown = at_most(value, MAX_40);
    memset(&message, 0, sizeof message);
    message.counter_index = dbc_counters[which].index;
    memcpy((uint8_t *)&message + dbc_counters[which].offset, &shown, sizeof shown);
    upb_dbc_upb_counters_pack(data, &message, UPB_CAN_CLASSIC_BYTES);
}

static void pack_faults(const upb_bus *bus, uint8_t *data) {
    struct upb_dbc_upb_faults_t message;
    memset(&message, 0, sizeof message);
    for (uint32_t id = 1; id <= UPB_FAULTS; id++)
        *((uint8_t *)&message + dbc_fault_bits[id]) = upb_fault_is_active(&bus->faults, id) != 0;
    message.latest_fault = (uint8_t)bus->faults.latest;
    upb_dbc_upb_faults_pack(data, &message, UPB_CAN_CLASSIC_BYTES);
}

static void pack_fault_detail(const upb_bus *bus, uint32_t id, uint8_t *data) {
    const upb_fault_entry *entry = &bus->faults.entries[id];
    const struct upb_dbc_upb_fault_detail_t message = {
        .fault = (uint8_t)id,
        .dtc_status = entry->status,
        .occurrences = (uint8_t)at_most(entry->occurrences, UINT8_MAX),
        .last_frame = (uint32_t)(entry->frame & MAX_24),
    };
    upb_dbc_upb_fault_detail_pack(data, &message, UPB_CAN_CLASSIC_BYTES);
}

static void pack_model(const upb_bus *bus, uint8_t *data) {
    const struct upb_dbc_upb_model_t message = {
        .model_crc32 = bus->snapshot.model_crc32,
        .precision = (uint8_t)(bus->snapshot.precision & 15u),
        .cpu = (uint8_t)(bus->snapshot.cpu & 15u),
        .swaps = (uint8_t)bus->snapshot.model_swaps,
    };
    upb_dbc_upb_model_pack(data, &message, UPB_CAN_CLASSIC_BYTES);
}

static void pack_ledger(const upb_ledger_record *record, uint64_t dropped, uint8_t *data) {
    const struct upb_dbc_upb_ledger_t message = {
        .frame = record->frame,
        .first_input = record->first_input_ns,
        .last_input = record->last_input_ns,
        .output = record->output_ns,
        .latency_ns = record->latency_ns,
        .verdict = record->verdict,
        .missing_columns = record->missing_columns,
        .mode = record->mode,
        .reserved = record->reserved,
        .dropped = (uint32_t)dropped,
    };
    upb_dbc_upb_ledger_pack(data, &message, UPB_CAN_FD_BYTES);
}

static void pack(const upb_sender *sender, const upb_bus *bus, upb_message which, uint8_t *data) {
    switch (which) {
    case UPB_MESSAGE_STATUS:
        pack_status(bus, data);
        break;
    case UPB_MESSAGE_LATENCY:
        pack_latency(bus, data);
        break;
    case UPB_MESSAGE_COUNTERS:
        pack_counter(bus, sender->counter_index, data);
        break;
    case UPB_MESSAGE_FAULTS:
        pack_faults(bus, data);
        break;
    case UPB_MESSAGE_FAULT_DETAIL:
        pack_fault_detail(bus, sender->fault_index, data);
        break;
    case UPB_MESSAGE_MODEL:
        pack_model(bus, data);
        break;
    case UPB_MESSAGE_LEDGER:
        pack_ledger(&sender->queue[sender->queue_first], sender->ledger_dropped, data);
        break;
    }
}

/* --------------------------------------------------------------------------------------------------- when */

void upb_sender_init(upb_sender *sender, uint64_t now_ns) {
    memset(sender, 0, sizeof *sender);
    for (uint32_t i = 0; i < CYCLIC; i++) /* apart from each other, so that they do not meet on the bus */
        sender->due_ns[i] = now_ns + (uint64_t)STAGGER_NS * i;
}

void upb_sender_hurry(upb_sender *sender, uint64_t now_ns) {
    for (uint32_t i = 0; i < CYCLIC; i++)
        sender->due_ns[i] = now_ns;
}

void upb_sender_queue(upb_sender *sender, const upb_ledger_record *record) {
    if (sender->queue_count == UPB_LEDGER_QUEUE) {
        sender->queue_first = (uint8_t)((sender->queue_first + 1u) % UPB_LEDGER_QUEUE);
        sender->queue_count--;
        sender->ledger_dropped++;
    }
    sender->queue[(sender->queue_first + sender->queue_count++) % UPB_LEDGER_QUEUE] = *record;
}

static int is_remembered(const upb_bus *bus, uint32_t id) {
    return bus->faults.entries[id].status & (UPB_DTC_TEST_FAILED | UPB_DTC_PENDING | UPB_DTC_CONFIRMED);
}

/* The remembered fault after the one shown last; 0 if there is none. */
static uint8_t next_fault(const upb_sender *sender, const upb_bus *bus) {
    for (uint32_t i = 0; i < UPB_FAULTS; i++) {
        const uint32_t id = (sender->fault_index + i) % UPB_FAULTS + 1;
        if (is_remembered(bus, id))
            return (uint8_t)id;
    }
    return 0;
}

/* The next cycle; not the ones that were missed, which would come in a burst. */
static uint64_t next_due(uint64_t due_ns, uint32_t message, uint64_t now_ns) {
    const uint64_t cycle_ns = (uint64_t)dbc_messages[message].cycle_ms * NS_PER_MS;
    return due_ns + cycle_ns > now_ns ? due_ns + cycle_ns : now_ns + cycle_ns;
}

static upb_send send_one(upb_sender *sender, const upb_bus *bus, upb_message which, const upb_channel *channel) {
    const upb_message_info *info = &dbc_messages[which];
    upb_can_frame frame = {.id = info->id, .flags = (uint8_t)info->flags, .length = info->e2e.length};
    uint8_t counter = sender->sequence[which];
    pack(sender, bus, which, frame.data);
    if (info->flags & UPB_CAN_FD)
        upb_e2e_p05_protect(&info->e2e, &counter, frame.data, frame.length);
    else
        upb_e2e_p11_protect(&info->e2e, &counter, frame.data, frame.length);
    const upb_send sent = channel->emit(channel->user, &frame);
    if (sent == UPB_SEND_BUSY)
        return sent;
    sender->sequence[which] = counter; /* a frame that was lost shows as a gap at the receiver */
    sender->sent += sent == UPB_SEND_DONE;
    sender->failed += sent == UPB_SEND_FAILED;
    return sent;
}

static int send_ledger(upb_sender *sender, const upb_bus *bus, const upb_channel *channel) {
    while (sender->queue_count) {
        const upb_send sent = send_one(sender, bus, UPB_MESSAGE_LEDGER, channel);
        if (sent == UPB_SEND_BUSY)
            return 0;
        sender->ledger_dropped += sent == UPB_SEND_FAILED;
        sender->queue_first = (uint8_t)((sender->queue_first + 1u) % UPB_LEDGER_QUEUE);
        sender->queue_count--;
    }
    return 1;
}

void upb_sender_step(upb_sender *sender, const upb_bus *bus, const upb_channel *channel, uint64_t now_ns) {
    if (!send_ledger(sender, bus, channel))
        return;
    for (uint32_t i = 0; i < CYCLIC; i++) {
        if (now_ns < sender->due_ns[i])
            continue;
        if (i == UPB_MESSAGE_FAULT_DETAIL) {
            const uint8_t id = next_fault(sender, bus);
            if (!id) {
                sender->due_ns[i] = next_due(sender->due_ns[i], i, now_ns);
                continue;
            }
            sender->fault_index = id;
        }
        if (send_one(sender, bus, (upb_message)i, channel) == UPB_SEND_BUSY)
            return;
        sender->due_ns[i] = next_due(sender->due_ns[i], i, now_ns);
        if (i == UPB_MESSAGE_COUNTERS)
            sender->counter_index = (uint8_t)((sender->counter_index + 1u) % COUNTERS_ALL);
    }
}
