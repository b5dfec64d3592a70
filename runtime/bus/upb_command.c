/* Authenticated commands: checksum, then MAC, then freshness, then storage; only then is a command believed. */
#include <string.h>

#include "generated/upb_dbc.h"
#include "upb_bytes.h"
#include "upbeam/command.h"
#include "upbeam/faults.h"

enum {
    FIRST_SIGNED = 3, /* bytes of the message under the MAC: from the code on, up to the MAC itself */
    MAC_AT = UPB_COMMAND_BYTES - UPB_MAC_BYTES,
    MODES = UPB_DBC_UPB_STATUS_MODE_PASS_THROUGH_CHOICE + 1,
    STORED_MAGIC = 0x4655
};

static const upb_e2e_config command_e2e = {UPB_COMMAND_DATA_ID, UPB_COMMAND_BYTES, 2};
static const upb_e2e_config response_e2e = {UPB_RESPONSE_DATA_ID, UPB_COMMAND_BYTES, 2};

const char *upb_command_result_text(uint32_t result) {
    static const char texts[UPB_COMMAND_RESULTS][8] = {"DONE",    "E2E",     "NO_KEY", "MAC",    "STALE",
                                                       "STORAGE", "UNKNOWN", "VALUE",  "REFUSED"};
    return result < UPB_COMMAND_RESULTS ? texts[result] : "?";
}

/* The MAC of a message: over its data id, big-endian, and its bytes from the code to before the MAC. */
static void message_mac(const uint8_t *key, uint32_t data_id, const uint8_t *data, uint8_t mac[16]) {
    uint8_t text[2 + MAC_AT - FIRST_SIGNED];
    upb_put_be(text, data_id, 2);
    memcpy(text + 2, data + FIRST_SIGNED, MAC_AT - FIRST_SIGNED);
    upb_cmac(key, text, sizeof text, mac);
}

/* Takes the same time wherever the two differ. */
static int is_equal(const uint8_t *a, const uint8_t *b, size_t count) {
    uint8_t difference = 0;
    for (size_t i = 0; i < count; i++)
        difference = (uint8_t)(difference | (a[i] ^ b[i]));
    return difference == 0;
}

/* ---------------------------------------------------------------------------------------------- freshness */

/*
 * Magic (2), the counter (4), its complement (4), CRC-16 (2). The complement: one damage in 65536 passes a CRC-16, and
 * a counter that was set back lets replays in.
 */
static void put_freshness(uint32_t freshness, uint8_t stored[UPB_STORE_FRESHNESS_BYTES]) {
    upb_put_le(stored, STORED_MAGIC, 2);
    upb_put_le(stored + 2, freshness, 4);
    upb_put_le(stored + 6, ~freshness, 4);
    upb_put_le(stored + 10, upb_crc16(UPB_CRC16_START, stored, 10), 2);
}

static int load_freshness(upb_commands *commands) {
    uint8_t stored[UPB_STORE_FRESHNESS_BYTES] = {0}, expected[UPB_STORE_FRESHNESS_BYTES];
    if (!commands->storage.read || !commands->storage.write)
        return 0;
    const upb_stored found = commands->storage.read(commands->storage.user, UPB_STORE_FRESHNESS, stored, sizeof stored);
    if (found == UPB_STORED_NOTHING)
        return 1;
    const uint32_t freshness = (uint32_t)upb_get_le(stored + 2, 4);
    put_freshness(freshness, expected);
    if (found != UPB_STORED_DONE || !is_equal(stored, expected, sizeof stored))
        return 0;
    commands->freshness = freshness;
    return 1;
}

static int save_freshness(upb_commands *commands, uint32_t freshness) {
    uint8_t stored[UPB_STORE_FRESHNESS_BYTES];
    put_freshness(freshness, stored);
    return commands->storage.write(commands->storage.user, UPB_STORE_FRESHNESS, stored, sizeof stored) ==
           UPB_STORED_DONE;
}

upb_status upb_commands_init(upb_commands *commands, const uint8_t *key, const upb_storage *storage,
                             upb_command_fn execute, void *user) {
    static const uint8_t no_key[UPB_KEY_BYTES];
    if (!commands || !storage || !storage->read != !storage->write)
        return UPB_E_ARGUMENT;
    memset(commands, 0, sizeof *commands);
    if (key && !is_equal(key, no_key, UPB_KEY_BYTES)) {
        memcpy(commands->key, key, UPB_KEY_BYTES);
        commands->has_key = 1;
    }
    commands->storage = *storage;
    commands->execute = execute;
    commands->user = user;
    upb_e2e_p05_check_init(&commands->check);
    commands->storage_good = (uint8_t)load_freshness(commands);
    return UPB_OK;
}

/* ------------------------------------------------------------------------------------------------- accept */

static upb_command_result judge_values(const upb_command *command, const uint8_t *data) {
    const int is_mode = command->code == UPB_COMMAND_MODE, is_model = command->code == UPB_COMMAND_MODEL;
    const int is_clear = command->code == UPB_COMMAND_CLEAR_FAULTS;
    if (!is_mode && !is_model && !is_clear && command->code != UPB_COMMAND_STATUS)
        return UPB_COMMAND_UNKNOWN;
    if (upb_get_le(data + 9, 3) != 0 || (!is_model && command->model_crc32) ||
        (!is_mode && !is_clear && command->argument))
        return UPB_COMMAND_VALUE;
    if (is_mode && command->argument >= MODES && command->argument != UPB_MODE_AUTOMATIC)
        return UPB_COMMAND_VALUE;
    if ((is_clear && command->argument > UPB_FAULTS) || (is_model && !command->model_crc32))
        return UPB_COMMAND_VALUE;
    return UPB_COMMAND_DONE;
}

static int count_sequence_fault(upb_e2e_status status) {
    return status == UPB_E2E_REPEATED || status == UPB_E2E_WRONG_SEQUENCE;
}

static upb_command_result judge(upb_commands *commands, const uint8_t *data, size_t count, upb_command *command) {
    struct upb_dbc_tst_command_t message;
    uint8_t mac[16];
    const upb_e2e_status e2e =
        data ? upb_e2e_p05_check(&commands->check, &command_e2e, data, count) : UPB_E2E_WRONG_CRC;
    if (e2e == UPB_E2E_WRONG_CRC)
        return UPB_COMMAND_E2E;
    commands->sequence_faults += (uint64_t)count_sequence_fault(e2e);
    upb_dbc_tst_command_unpack(&message, data, count);
    command->code = message.code;
    command->freshness = message.freshness;
    command->argument = message.argument;
    command->model_crc32 = message.model_crc32;
    if (!commands->has_key)
        return UPB_COMMAND_NO_KEY;
    message_mac(commands->key, UPB_COMMAND_DATA_ID, data, mac);
    if (!is_equal(mac, data + MAC_AT, UPB_MAC_BYTES))
        return UPB_COMMAND_MAC;
    if (!commands->storage_good)
        return UPB_COMMAND_STORAGE;
    if (command->freshness <= commands->freshness)
        return UPB_COMMAND_STALE;
    if (!save_freshness(commands, command->freshness))
        return UPB_COMMAND_STORAGE;
    commands->freshness = command->freshness;
    return judge_values(command, data);
}

upb_command_result upb_command_accept(upb_commands *commands, const uint8_t *data, size_t count, upb_command *command) {
    memset(command, 0, sizeof *command);
    const upb_command_result result = judge(commands, data, count, command);
    if (result != UPB_COMMAND_DONE)
        commands->results[result]++;
    return result;
}

/* -------------------------------------------------------------------------------------------------- build */

upb_status upb_command_build(const upb_command *command, const uint8_t key[UPB_KEY_BYTES], uint8_t *sequence,
                             uint8_t data[UPB_COMMAND_BYTES]) {
    uint8_t mac[16];
    if (!command || !key || !sequence || !data || command->code > 255 || command->argument > 255)
        return UPB_E_ARGUMENT;
    const struct upb_dbc_tst_command_t message = {.code = (uint8_t)command->code,
                                                  .freshness = command->freshness,
                                                  .argument = (uint8_t)command->argument,
                                                  .model_crc32 = command->model_crc32};
    upb_dbc_tst_command_pack(data, &message, UPB_COMMAND_BYTES);
    message_mac(key, UPB_COMMAND_DATA_ID, data, mac);
    memcpy(data + MAC_AT, mac, UPB_MAC_BYTES);
    return upb_e2e_p05_protect(&command_e2e, sequence, data, UPB_COMMAND_BYTES);
}

upb_status upb_response_build(upb_commands *commands, const upb_response *response, int authentic,
                              uint8_t data[UPB_COMMAND_BYTES]) {
    uint8_t mac[16];
    if (!commands || !response || !data || response->code > 255 || response->result > 255 || response->mode > 255)
        return UPB_E_ARGUMENT;
    const struct upb_dbc_upb_response_t message = {.code = (uint8_t)response->code,
                                                   .freshness = response->freshness,
                                                   .result = (uint8_t)response->result,
                                                   .mode = (uint8_t)response->mode,
                                                   .stored_freshness = response->stored_freshness};
    upb_dbc_upb_response_pack(data, &message, UPB_COMMAND_BYTES);
    if (authentic) {
        message_mac(commands->key, UPB_RESPONSE_DATA_ID, data, mac);
        memcpy(data + MAC_AT, mac, UPB_MAC_BYTES);
    }
    return upb_e2e_p05_protect(&response_e2e, &commands->sequence, data, UPB_COMMAND_BYTES);
}
