/* The device on its buses: dispatches what comes in, sends what is due, keeps the bus's own faults. */
#include "upbeam/bus.h"

#include <string.h>

#include "upb_bytes.h"
#include "upb_sender.h"

enum { RESPONSE_NONE = 0, RESPONSE_CAN = 1, RESPONSE_SERIAL = 2 };

#define SAVE_SOON_NS 1000000000u
#define SAVE_LATER_NS 60000000000u
#define NEVER UINT64_MAX

upb_bus_config upb_bus_config_default(void) {
    upb_bus_config config;
    memset(&config, 0, sizeof config);
    config.struct_bytes = sizeof config;
    config.status_on_serial = 1;
    config.isotp = upb_isotp_config_default();
    config.isotp.tx_id = UPB_UDS_RESPONSE_ID;
    config.isotp.rx_id = UPB_UDS_REQUEST_ID;
    config.isotp.rx_id_all = UPB_UDS_FUNCTIONAL_ID;
    return config;
}

/* ----------------------------------------------------------------------------------------------- channels */

/* Every CAN frame of the device leaves here: a transport that fails is a bus that is off. */
static upb_send emit_can(void *user, const upb_can_frame *frame) {
    upb_bus *bus = user;
    const upb_send sent = bus->config.can.send(bus->config.can.user, frame);
    if (sent == UPB_SEND_BUSY)
        return sent;
    bus->can_failed += sent == UPB_SEND_FAILED;
    upb_faults_report(&bus->faults, UPB_FAULT_CAN_BUS_OFF,
                      sent == UPB_SEND_FAILED ? UPB_MONITOR_PREFAILED : UPB_MONITOR_PREPASSED, bus->now_ns);
    return sent;
}

static upb_send emit_serial(void *user, const upb_can_frame *frame) {
    upb_bus *bus = user;
    uint8_t bytes[UPB_CONSOLE_FRAME_MAX];
    const size_t count = upb_console_encode(frame, bytes);
    const upb_send sent = bus->config.serial.send(bus->config.serial.user, bytes, count);
    bus->serial_failed += sent == UPB_SEND_FAILED;
    return sent;
}

uint64_t upb_bus_counter(const upb_bus *bus, uint32_t counter) {
    uint64_t refused = 0;
    switch (counter) {
    case UPB_COUNTER_COMMANDS_TAKEN:
        return bus->commands.results[UPB_COMMAND_DONE];
    case UPB_COUNTER_COMMANDS_REFUSED:
        for (uint32_t i = UPB_COMMAND_DONE + 1; i < UPB_COMMAND_RESULTS; i++)
            refused += bus->commands.results[i];
        return refused;
    case UPB_COUNTER_CAN_FAILED:
        return bus->can_failed;
    case UPB_COUNTER_SERIAL_FAILED:
        return bus->serial_failed;
    case UPB_COUNTER_SERIAL_REFUSED:
        return upb_console_refused(&bus->parser);
    case UPB_COUNTER_LEDGER_DROPPED:
        return bus->can.ledger_dropped;
    default:
        return counter < UPB_COUNTERS ? bus->snapshot.counters[counter] : 0;
    }
}

/* -------------------------------------------------------------------------------------------- diagnostics */

static size_t put_model(const upb_bus_snapshot *now, uint8_t *bytes) {
    upb_put_be(bytes, now->model_crc32, 4);
    upb_put_be(bytes + 4, now->precision, 1);
    upb_put_be(bytes + 5, now->cpu, 1);
    upb_put_be(bytes + 6, now->model_swaps, 2);
    return 8;
}

static size_t put_record(const upb_ledger_record *record, uint8_t *bytes) {
    const uint64_t wide[5] = {record->frame, record->first_input_ns, record->last_input_ns, record->output_ns,
                              record->latency_ns};
    const uint32_t narrow[4] = {record->verdict, record->missing_columns, record->mode, record->reserved};
    for (size_t i = 0; i < 5; i++)
        upb_put_be(bytes + 8 * i, wide[i], 8);
    for (size_t i = 0; i < 4; i++)
        upb_put_be(bytes + 40 + 4 * i, narrow[i], 4);
    return 56;
}

static size_t put_list(const uint64_t *values, size_t count, uint8_t *bytes) {
    for (size_t i = 0; i < count; i++)
        upb_put_be(bytes + 8 * i, values[i], 8);
    return 8 * count;
}

enum { DID_BYTES_MAX = 8 * UPB_COUNTERS };

/* At most DID_BYTES_MAX bytes: the counters. */
static size_t put_did(const upb_bus *bus, uint32_t did, uint8_t *bytes) {
    const upb_bus_snapshot *now = &bus->snapshot;
    const uint64_t latency[2] = {now->record.latency_ns, now->latency_max_ns};
    uint64_t counters[UPB_COUNTERS];
    switch (did) {
    case UPB_DID_VERSION:
        memcpy(bytes, UPB_VERSION_TEXT, sizeof UPB_VERSION_TEXT - 1);
        return sizeof UPB_VERSION_TEXT - 1;
    case UPB_DID_MODEL:
        return put_model(now, bytes);
    case UPB_DID_COUNTERS:
        for (uint32_t i = 0; i < UPB_COUNTERS; i++)
            counters[i] = upb_bus_counter(bus, i);
        return put_list(counters, UPB_COUNTERS, bytes);
    case UPB_DID_LATENCY:
        return put_list(latency, 2, bytes);
    case UPB_DID_COMMANDS:
        return put_list(bus->commands.results, UPB_COMMAND_RESULTS, bytes);
    case UPB_DID_FRESHNESS:
        upb_put_be(bytes, bus->commands.freshness, 4);
        return 4;
    case UPB_DID_DROPS:
        return put_list(now->drops, UPB_DROP_CAUSES_MAX, bytes);
    case UPB_DID_LEDGER:
        return put_record(&now->record, bytes);
    default:
        return 0;
    }
}

_Static_assert(UPB_DROP_CAUSES_MAX <= UPB_COUNTERS && UPB_COMMAND_RESULTS <= UPB_COUNTERS &&
                   sizeof(upb_ledger_record) <= DID_BYTES_MAX && sizeof UPB_VERSION_TEXT <= DID_BYTES_MAX,
               "the counters are the longest data");

static size_t read_did(void *user, uint32_t did, uint8_t *bytes, size_t room) {
    uint8_t data[DID_BYTES_MAX];
    const size_t count = put_did(user, did, data);
    if (count <= room)
        memcpy(bytes, data, count);
    return count;
}

static void serve_diagnostics(upb_bus *bus, uint64_t now_ns) {
    uint8_t answer[UPB_ISOTP_BYTES];
    size_t count;
    int functional;
    const uint8_t *request = upb_isotp_message(&bus->isotp, &count, &functional);
    if (request && !upb_isotp_is_sending(&bus->isotp)) {
        const size_t bytes = upb_uds_answer(&bus->uds, request, count, functional, now_ns, answer);
        upb_isotp_take(&bus->isotp);
        if (bytes)
            upb_isotp_send(&bus->isotp, answer, bytes, now_ns);
    }
    upb_isotp_step(&bus->isotp, now_ns);
}

/* ----------------------------------------------------------------------------------------------- commands */

/* What the program makes of it; only results that are its to give. */
static upb_command_result run(const upb_commands *commands, const upb_command *command) {
    const upb_command_result result =
        commands->execute ? commands->execute(commands->user, command) : UPB_COMMAND_REFUSED;
    return result == UPB_COMMAND_DONE || result == UPB_COMMAND_VALUE ? result : UPB_COMMAND_REFUSED;
}

static upb_command_result execute(upb_bus *bus, const upb_command *command, uint64_t now_ns) {
    switch (command->code) {
    case UPB_COMMAND_STATUS:
        upb_sender_hurry(&bus->can, now_ns);
        upb_sender_hurry(&bus->serial, now_ns);
        return UPB_COMMAND_DONE;
    case UPB_COMMAND_CLEAR_FAULTS:
        return upb_faults_clear(&bus->faults, command->argument) == UPB_OK ? UPB_COMMAND_DONE : UPB_COMMAND_VALUE;
    default:
        return run(&bus->commands, command);
    }
}

static void send_response(upb_bus *bus) {
    const uint8_t channel = bus->response_pending;
    if (!channel)
        return;
    const upb_send sent = channel == RESPONSE_CAN ? emit_can(bus, &bus->response) : emit_serial(bus, &bus->response);
    if (sent != UPB_SEND_BUSY)
        bus->response_pending = RESPONSE_NONE;
}

static void respond(upb_bus *bus, const upb_command *command, upb_command_result result, int authentic,
                    uint8_t channel) {
    const upb_response response = {command->code, (uint32_t)result, command->freshness, bus->commands.freshness,
                                   bus->snapshot.mode & 255u};
    if (bus->response_pending == RESPONSE_CAN) /* the one that still waits is lost */
        bus->can_failed++;
    else if (bus->response_pending == RESPONSE_SERIAL)
        bus->serial_failed++;
    memset(&bus->response, 0, sizeof bus->response);
    bus->response.id = UPB_RESPONSE_ID;
    bus->response.flags = UPB_CAN_FD | UPB_CAN_BRS;
    bus->response.length = UPB_COMMAND_BYTES;
    upb_response_build(&bus->commands, &response, authentic, bus->response.data);
    bus->response_pending = channel;
    send_response(bus);
}

/* True for results that only an authentic command has. */
static int is_authentic(upb_command_result result) {
    return result != UPB_COMMAND_E2E && result != UPB_COMMAND_NO_KEY && result != UPB_COMMAND_MAC;
}

static void take_command(upb_bus *bus, const upb_can_frame *frame, uint8_t channel, uint64_t now_ns) {
    upb_command command;
    upb_command_result result = upb_command_accept(&bus->commands, frame->data, frame->length, &command);
    if (result == UPB_COMMAND_DONE) {
        result = execute(bus, &command, now_ns);
        bus->commands.results[result]++;
    }
    if (result == UPB_COMMAND_DONE) {
        upb_faults_report(&bus->faults, UPB_FAULT_CAN_COMMAND_REJECTED, UPB_MONITOR_PASSED, now_ns);
        bus->command_refused_ns = NEVER;
    } else {
        upb_faults_report(&bus->faults, UPB_FAULT_CAN_COMMAND_REJECTED, UPB_MONITOR_FAILED, now_ns);
        bus->command_refused_ns = now_ns;
    }
    if (result != UPB_COMMAND_E2E)
        respond(bus, &command, result, is_authentic(result), channel);
}

static int is_command(const upb_can_frame *frame) {
    return frame->id == UPB_COMMAND_ID && !(frame->flags & UPB_CAN_EXTENDED);
}

/* ------------------------------------------------------------------------------------------------- public */

upb_status upb_bus_init(upb_bus *bus, const upb_bus_config *config, uint64_t now_ns) {
    if (!bus || !config || config->struct_bytes != sizeof *config)
        return UPB_E_ARGUMENT;
    memset(bus, 0, sizeof *bus);
    bus->config = *config;
    bus->config.key = NULL; /* the caller's, not kept */
    bus->now_ns = now_ns;
    bus->command_refused_ns = bus->record_refused_ns = NEVER;
    const upb_uds_config uds = {read_did, config->reset, config->clear_locked, bus, config->user};
    const upb_can_transport can = {config->can.send ? emit_can : NULL, bus};
    if (upb_faults_init(&bus->faults, &config->storage, now_ns) != UPB_OK ||
        upb_commands_init(&bus->commands, config->key, &config->storage, config->execute, config->user) != UPB_OK ||
        upb_isotp_init(&bus->isotp, &config->isotp, &can) != UPB_OK ||
        upb_uds_init(&bus->uds, &uds, &bus->faults) != UPB_OK)
        return UPB_E_ARGUMENT;
    if (config->muted_faults)
        upb_faults_mute(&bus->faults, config->muted_faults);
    upb_console_parser_init(&bus->parser);
    upb_sender_init(&bus->can, now_ns);
    upb_sender_init(&bus->serial, now_ns);
    return UPB_OK;
}

int upb_bus_can(upb_bus *bus, const upb_can_frame *frame, uint64_t now_ns) {
    if (!upb_can_frame_is_valid(frame))
        return 0;
    bus->now_ns = now_ns;
    if (is_command(frame)) {
        take_command(bus, frame, RESPONSE_CAN, now_ns);
        return 1;
    }
    const int taken = upb_isotp_receive(&bus->isotp, frame, now_ns);
    if (taken)
        serve_diagnostics(bus, now_ns);
    return taken;
}

void upb_bus_serial(upb_bus *bus, const uint8_t *bytes, size_t count, uint64_t now_ns) {
    upb_can_frame frame;
    bus->now_ns = now_ns;
    for (size_t i = 0; i < count; i++) {
        const uint64_t refused = upb_console_refused(&bus->parser);
        if (upb_console_parse(&bus->parser, bytes[i], &frame)) {
            upb_faults_report(&bus->faults, UPB_FAULT_SERIAL_FRAMING, UPB_MONITOR_PREPASSED, now_ns);
            if (is_command(&frame))
                take_command(bus, &frame, RESPONSE_SERIAL, now_ns);
            else
                bus->records_unknown++;
        } else if (upb_console_refused(&bus->parser) != refused) {
            upb_faults_report(&bus->faults, UPB_FAULT_SERIAL_FRAMING, UPB_MONITOR_PREFAILED, now_ns);
            bus->record_refused_ns = now_ns;
        }
    }
}

void upb_bus_ledger(upb_bus *bus, const upb_ledger_record *record) {
    if (bus->config.can.send)
        upb_sender_queue(&bus->can, record);
    if (bus->config.serial.send && bus->config.status_on_serial)
        upb_sender_queue(&bus->serial, record);
}

static void heal(upb_bus *bus, uint32_t fault, uint64_t *refused_ns, uint64_t now_ns) {
    if (*refused_ns == NEVER || now_ns - *refused_ns < UPB_BUS_HEAL_NS)
        return;
    *refused_ns = NEVER;
    upb_faults_report(&bus->faults, fault, UPB_MONITOR_PASSED, now_ns);
}

static void keep_faults(upb_bus *bus, uint64_t now_ns) {
    heal(bus, UPB_FAULT_CAN_COMMAND_REJECTED, &bus->command_refused_ns, now_ns);
    heal(bus, UPB_FAULT_SERIAL_FRAMING, &bus->record_refused_ns, now_ns);
    if (bus->snapshot.state == UPB_STATE_RUNNING)
        upb_faults_report(&bus->faults, UPB_FAULT_POWER_RESET, UPB_MONITOR_PASSED, now_ns);
}

static void save_faults(upb_bus *bus, uint64_t now_ns) {
    if ((bus->faults.dirty == UPB_FAULTS_SOON && now_ns >= bus->save_soon_ns) ||
        (bus->faults.dirty == UPB_FAULTS_LATER && now_ns >= bus->save_later_ns)) {
        upb_faults_save(&bus->faults);
        bus->save_soon_ns = now_ns + SAVE_SOON_NS;
        bus->save_later_ns = now_ns + SAVE_LATER_NS;
    }
}

void upb_bus_step(upb_bus *bus, const upb_bus_snapshot *snapshot, uint64_t now_ns) {
    const upb_channel can = {emit_can, bus}, serial = {emit_serial, bus};
    bus->snapshot = *snapshot;
    bus->now_ns = now_ns;
    upb_faults_context(&bus->faults, snapshot->record.frame, snapshot->mode);
    keep_faults(bus, now_ns);
    save_faults(bus, now_ns);
    send_response(bus);
    serve_diagnostics(bus, now_ns);
    if (bus->config.can.send)
        upb_sender_step(&bus->can, bus, &can, now_ns);
    if (bus->config.serial.send && bus->config.status_on_serial)
        upb_sender_step(&bus->serial, bus, &serial, now_ns);
}

upb_stored upb_bus_end(upb_bus *bus) { return upb_faults_end(&bus->faults); }
