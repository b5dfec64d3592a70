/* AUTOSAR E2E Profiles 11 and 5, and the receiver's state machine (AUTOSAR FO PRS_E2EProtocol). */
#include <string.h>

#include "upb_bytes.h"
#include "upbeam/can.h"
#include "upbeam/e2e.h"

uint8_t upb_crc8(uint8_t crc, const void *bytes, size_t count) {
    const uint8_t *p = bytes;
    for (size_t i = 0; i < count; i++) {
        crc ^= p[i];
        for (int bit = 0; bit < 8; bit++)
            crc = (uint8_t)(crc << 1 ^ (crc & 0x80 ? 0x1d : 0));
    }
    return crc;
}

uint16_t upb_crc16(uint16_t crc, const void *bytes, size_t count) {
    const uint8_t *p = bytes;
    for (size_t i = 0; i < count; i++) {
        crc ^= (uint16_t)(p[i] << 8);
        for (int bit = 0; bit < 8; bit++)
            crc = (uint16_t)(crc << 1 ^ (crc & 0x8000 ? 0x1021 : 0));
    }
    return crc;
}

static int p11_is_config(const upb_e2e_config *config) {
    return config && config->data_id < 0xf00 && config->length >= UPB_E2E_P11_HEADER &&
           config->length <= UPB_CAN_CLASSIC_BYTES && config->max_delta_counter >= 1 &&
           config->max_delta_counter < UPB_E2E_P11_COUNTERS;
}

static int p05_is_config(const upb_e2e_config *config) {
    return config && config->length >= UPB_E2E_P05_HEADER && config->length <= UPB_CAN_FD_BYTES &&
           config->max_delta_counter >= 1;
}

/* Variant 11C: the low byte of the data id and a 0 go before the data; the id's nibble is in the data. */
static uint8_t p11_crc(const upb_e2e_config *config, const uint8_t *data) {
    const uint8_t id[2] = {(uint8_t)config->data_id, 0};
    return upb_crc8(upb_crc8(UPB_CRC8_START, id, sizeof id), data + 1, (size_t)config->length - 1);
}

/* The data id comes after the data, low byte first. */
static uint16_t p05_crc(const upb_e2e_config *config, const uint8_t *data) {
    const uint8_t id[2] = {(uint8_t)config->data_id, (uint8_t)(config->data_id >> 8)};
    return upb_crc16(upb_crc16(UPB_CRC16_START, data + 2, (size_t)config->length - 2), id, sizeof id);
}

upb_status upb_e2e_p11_protect(const upb_e2e_config *config, uint8_t *counter, uint8_t *data, size_t count) {
    if (!p11_is_config(config) || !counter || *counter >= UPB_E2E_P11_COUNTERS || !data || count != config->length)
        return UPB_E_ARGUMENT;
    data[1] = (uint8_t)(config->data_id >> 8 << 4 | *counter);
    data[0] = p11_crc(config, data);
    *counter = (uint8_t)((*counter + 1u) % UPB_E2E_P11_COUNTERS);
    return UPB_OK;
}

upb_status upb_e2e_p05_protect(const upb_e2e_config *config, uint8_t *counter, uint8_t *data, size_t count) {
    if (!p05_is_config(config) || !counter || !data || count != config->length)
        return UPB_E_ARGUMENT;
    data[2] = *counter;
    upb_put_le(data, p05_crc(config, data), 2);
    *counter = (uint8_t)(*counter + 1u);
    return UPB_OK;
}

void upb_e2e_p11_check_init(upb_e2e_check *check) {
    check->counter = UPB_E2E_P11_COUNTERS - 1;
    check->delta = 0;
}

void upb_e2e_p05_check_init(upb_e2e_check *check) {
    check->counter = 0xff;
    check->delta = 0;
}

static upb_e2e_status judge_counter(upb_e2e_check *check, const upb_e2e_config *config, uint8_t counter,
                                    uint8_t delta) {
    check->counter = counter;
    check->delta = delta;
    if (delta == 0)
        return UPB_E2E_REPEATED;
    if (delta == 1)
        return UPB_E2E_OK;
    return delta <= config->max_delta_counter ? UPB_E2E_OK_SOME_LOST : UPB_E2E_WRONG_SEQUENCE;
}

upb_e2e_status upb_e2e_p11_check(upb_e2e_check *check, const upb_e2e_config *config, const uint8_t *data,
                                 size_t count) {
    if (!data)
        return UPB_E2E_NO_NEW_DATA;
    if (!p11_is_config(config) || count != config->length || data[1] >> 4 != config->data_id >> 8 ||
        (data[1] & 15u) >= UPB_E2E_P11_COUNTERS || data[0] != p11_crc(config, data))
        return UPB_E2E_WRONG_CRC;
    const uint8_t counter = data[1] & 15u;
    const uint32_t delta = (counter + UPB_E2E_P11_COUNTERS - check->counter) % UPB_E2E_P11_COUNTERS;
    return judge_counter(check, config, counter, (uint8_t)delta);
}

upb_e2e_status upb_e2e_p05_check(upb_e2e_check *check, const upb_e2e_config *config, const uint8_t *data,
                                 size_t count) {
    if (!data)
        return UPB_E2E_NO_NEW_DATA;
    if (!p05_is_config(config) || count != config->length || upb_get_le(data, 2) != p05_crc(config, data))
        return UPB_E2E_WRONG_CRC;
    return judge_counter(check, config, data[2], (uint8_t)(data[2] - check->counter));
}

/* --------------------------------------------------------------------------------------- state machine */

static int is_window(const upb_e2e_window *window) {
    return window->window >= 1 && window->window <= UPB_E2E_WINDOW_MAX && window->min_ok <= window->window &&
           window->max_error <= window->window;
}

upb_status upb_e2e_machine_init(upb_e2e_machine *machine, const upb_e2e_machine_config *config) {
    if (!machine || !config || !is_window(&config->init) || !is_window(&config->valid) || !is_window(&config->invalid))
        return UPB_E_ARGUMENT;
    memset(machine, 0, sizeof *machine);
    machine->config = *config;
    return UPB_OK;
}

/* Keeps the newest `window` statuses, this one with them. */
static void add_status(upb_e2e_machine *machine, uint32_t window, upb_e2e_status status) {
    const uint32_t kept = machine->count < window ? machine->count : window - 1;
    memmove(machine->window, machine->window + (machine->count - kept), kept);
    machine->window[kept] = (uint8_t)status;
    machine->count = (uint8_t)(kept + 1);
}

static void count_statuses(const upb_e2e_machine *machine, uint32_t *ok, uint32_t *errors) {
    *ok = *errors = 0;
    for (uint32_t i = 0; i < machine->count; i++) {
        *ok += machine->window[i] == UPB_E2E_OK || machine->window[i] == UPB_E2E_OK_SOME_LOST;
        *errors += machine->window[i] == UPB_E2E_WRONG_CRC;
    }
}

static void enter(upb_e2e_machine *machine, upb_e2e_state state) {
    if (state == UPB_E2E_STATE_INVALID && machine->state != state && machine->config.clear_to_invalid)
        machine->count = 0;
    machine->state = state;
}

upb_e2e_state upb_e2e_machine_step(upb_e2e_machine *machine, upb_e2e_status status) {
    if (machine->state == UPB_E2E_STATE_NODATA) {
        if (status != UPB_E2E_WRONG_CRC && status != UPB_E2E_NO_NEW_DATA)
            machine->state = UPB_E2E_STATE_INIT;
        return machine->state;
    }
    const upb_e2e_window *limits = machine->state == UPB_E2E_STATE_INIT    ? &machine->config.init
                                   : machine->state == UPB_E2E_STATE_VALID ? &machine->config.valid
                                                                           : &machine->config.invalid;
    uint32_t ok, errors;
    add_status(machine, limits->window, status);
    count_statuses(machine, &ok, &errors);
    if (errors <= limits->max_error && ok >= limits->min_ok)
        enter(machine, UPB_E2E_STATE_VALID);
    else if (machine->state == UPB_E2E_STATE_VALID || errors > limits->max_error)
        enter(machine, UPB_E2E_STATE_INVALID);
    return machine->state;
}
