/* The bus library on known vectors and on a desk: what it sends, what it believes, what it remembers. */
#include <time.h>

#include "bench_device.h"
#include "check.h"

static bench_device device; /* too large for a stack */

static void new_device(void) { memset(&device, 0, sizeof device); }

/* ---------------------------------------------------------------------------------------------------- E2E */

/* Check values of the catalogue of parametrised CRC algorithms, for "123456789". */
static void test_crc(void) {
    CHECK_EQUAL(upb_crc8(UPB_CRC8_START, "123456789", 9), 0x37);     /* CRC-8/GSM-A: no start value, no final XOR */
    CHECK_EQUAL(upb_crc8(0xff, "123456789", 9) ^ 0xff, 0x4b);        /* CRC-8/SAE-J1850, AUTOSAR's Crc_CalculateCRC8 */
    CHECK_EQUAL(upb_crc16(UPB_CRC16_START, "123456789", 9), 0x29b1); /* CRC-16/IBM-3740, Crc_CalculateCRC16 */
}

/*
 * The protect examples of AUTOSAR FO PRS_E2EProtocol, as public implementations quote them: eight bytes of zeros, data
 * ids 0x123 (11C) and 0x1234 (5).
 */
static void test_e2e_examples(void) {
    const upb_e2e_config p11 = {0x123, 8, 1}, p05 = {0x1234, 8, 1};
    uint8_t data[8] = {0}, counter = 0;
    const uint8_t first11[8] = {0x2a, 0x10}, second11[8] = {0x77, 0x11};
    CHECK_EQUAL(upb_e2e_p11_protect(&p11, &counter, data, 8), UPB_OK);
    CHECK(memcmp(data, first11, 8) == 0);
    CHECK_EQUAL(upb_e2e_p11_protect(&p11, &counter, data, 8), UPB_OK);
    CHECK(memcmp(data, second11, 8) == 0);
    const uint8_t first05[8] = {0x1c, 0xca, 0x00}, second05[8] = {0xcf, 0x8d, 0x01};
    memset(data, counter = 0, sizeof data);
    CHECK_EQUAL(upb_e2e_p05_protect(&p05, &counter, data, 8), UPB_OK);
    CHECK(memcmp(data, first05, 8) == 0);
    CHECK_EQUAL(upb_e2e_p05_protect(&p05, &counter, data, 8), UPB_OK);
    CHECK(memcmp(data, second05, 8) == 0);
}

static void test_e2e_arguments(void) {
    const upb_e2e_config good = {0x123, 8, 1}, wide = {0xf00, 8, 1}, none = {0x123, 8, 0}, longer = {0x123, 9, 1};
    uint8_t data[64] = {0}, counter = 0, high = 15;
    CHECK_EQUAL(upb_e2e_p11_protect(&good, &counter, data, 7), UPB_E_ARGUMENT);
    CHECK_EQUAL(upb_e2e_p11_protect(&good, &high, data, 8), UPB_E_ARGUMENT);
    CHECK_EQUAL(upb_e2e_p11_protect(&wide, &counter, data, 8), UPB_E_ARGUMENT);
    CHECK_EQUAL(upb_e2e_p11_protect(&none, &counter, data, 8), UPB_E_ARGUMENT);
    CHECK_EQUAL(upb_e2e_p11_protect(&longer, &counter, data, 9), UPB_E_ARGUMENT);
    CHECK_EQUAL(upb_e2e_p05_protect(&longer, &counter, data, 9), UPB_OK);
}

static void test_e2e_check(void) {
    const upb_e2e_config config = {0x210, 8, 2};
    upb_e2e_check check;
    uint8_t frames[15][8], counter = 0;
    for (int i = 0; i < 15; i++) {
        memset(frames[i], i, 8);
        upb_e2e_p11_protect(&config, &counter, frames[i], 8);
    }
    CHECK_EQUAL(counter, 0); /* 15 is never used */
    upb_e2e_p11_check_init(&check);
    CHECK_EQUAL(upb_e2e_p11_check(&check, &config, NULL, 0), UPB_E2E_NO_NEW_DATA);
    CHECK_EQUAL(upb_e2e_p11_check(&check, &config, frames[0], 8), UPB_E2E_OK);
    CHECK_EQUAL(upb_e2e_p11_check(&check, &config, frames[0], 8), UPB_E2E_REPEATED);
    CHECK_EQUAL(upb_e2e_p11_check(&check, &config, frames[2], 8), UPB_E2E_OK_SOME_LOST);
    CHECK_EQUAL(upb_e2e_p11_check(&check, &config, frames[5], 8), UPB_E2E_WRONG_SEQUENCE);
    CHECK_EQUAL(upb_e2e_p11_check(&check, &config, frames[6], 8), UPB_E2E_OK);
    CHECK_EQUAL(upb_e2e_p11_check(&check, &config, frames[14], 8), UPB_E2E_WRONG_SEQUENCE);
    CHECK_EQUAL(upb_e2e_p11_check(&check, &config, frames[0], 8), UPB_E2E_OK);
    CHECK_EQUAL(upb_e2e_p11_check(&check, &config, frames[1], 7), UPB_E2E_WRONG_CRC);
    for (int bit = 0; bit < 64; bit++) {
        frames[1][bit / 8] ^= (uint8_t)(1 << bit % 8);
        CHECK_EQUAL(upb_e2e_p11_check(&check, &config, frames[1], 8), UPB_E2E_WRONG_CRC);
        frames[1][bit / 8] ^= (uint8_t)(1 << bit % 8);
    }
    CHECK_EQUAL(upb_e2e_p11_check(&check, &config, frames[1], 8), UPB_E2E_OK);
}

/* NODATA -> INIT -> VALID -> INVALID -> VALID, with the limits of the windows. */
static void test_e2e_machine(void) {
    const upb_e2e_machine_config config = {{4, 2, 1}, {4, 2, 1}, {4, 3, 0}, 1};
    const upb_e2e_machine_config bad = {{4, 5, 1}, {4, 2, 1}, {4, 3, 0}, 1};
    upb_e2e_machine machine;
    CHECK_EQUAL(upb_e2e_machine_init(&machine, &bad), UPB_E_ARGUMENT);
    CHECK_EQUAL(upb_e2e_machine_init(&machine, &config), UPB_OK);
    CHECK_EQUAL(upb_e2e_machine_step(&machine, UPB_E2E_NO_NEW_DATA), UPB_E2E_STATE_NODATA);
    CHECK_EQUAL(upb_e2e_machine_step(&machine, UPB_E2E_WRONG_CRC), UPB_E2E_STATE_NODATA);
    CHECK_EQUAL(upb_e2e_machine_step(&machine, UPB_E2E_WRONG_SEQUENCE), UPB_E2E_STATE_INIT);
    CHECK_EQUAL(upb_e2e_machine_step(&machine, UPB_E2E_OK), UPB_E2E_STATE_INIT);
    CHECK_EQUAL(upb_e2e_machine_step(&machine, UPB_E2E_OK_SOME_LOST), UPB_E2E_STATE_VALID);
    CHECK_EQUAL(upb_e2e_machine_step(&machine, UPB_E2E_WRONG_CRC), UPB_E2E_STATE_VALID);
    CHECK_EQUAL(upb_e2e_machine_step(&machine, UPB_E2E_WRONG_CRC), UPB_E2E_STATE_INVALID);
    CHECK_EQUAL(upb_e2e_machine_step(&machine, UPB_E2E_OK), UPB_E2E_STATE_INVALID);
    CHECK_EQUAL(upb_e2e_machine_step(&machine, UPB_E2E_OK), UPB_E2E_STATE_INVALID);
    CHECK_EQUAL(upb_e2e_machine_step(&machine, UPB_E2E_OK), UPB_E2E_STATE_VALID);
    CHECK_EQUAL(upb_e2e_machine_step(&machine, UPB_E2E_NO_NEW_DATA), UPB_E2E_STATE_VALID);
    CHECK_EQUAL(upb_e2e_machine_step(&machine, UPB_E2E_NO_NEW_DATA), UPB_E2E_STATE_VALID);
    CHECK_EQUAL(upb_e2e_machine_step(&machine, UPB_E2E_NO_NEW_DATA), UPB_E2E_STATE_INVALID);
}

/* -------------------------------------------------------------------------------------------------- CMAC */

/* RFC 4493, section 4: examples 1 to 4 (NIST SP 800-38B, D.1). */
static void test_cmac(void) {
    static const uint8_t text[64] = {0x6b, 0xc1, 0xbe, 0xe2, 0x2e, 0x40, 0x9f, 0x96, 0xe9, 0x3d, 0x7e, 0x11, 0x73,
                                     0x93, 0x17, 0x2a, 0xae, 0x2d, 0x8a, 0x57, 0x1e, 0x03, 0xac, 0x9c, 0x9e, 0xb7,
                                     0x6f, 0xac, 0x45, 0xaf, 0x8e, 0x51, 0x30, 0xc8, 0x1c, 0x46, 0xa3, 0x5c, 0xe4,
                                     0x11, 0xe5, 0xfb, 0xc1, 0x19, 0x1a, 0x0a, 0x52, 0xef, 0xf6, 0x9f, 0x24, 0x45,
                                     0xdf, 0x4f, 0x9b, 0x17, 0xad, 0x2b, 0x41, 0x7b, 0xe6, 0x6c, 0x37, 0x10};
    static const struct {
        size_t count;
        uint8_t mac[16];
    } examples[] = {
        {0, {0xbb, 0x1d, 0x69, 0x29, 0xe9, 0x59, 0x37, 0x28, 0x7f, 0xa3, 0x7d, 0x12, 0x9b, 0x75, 0x67, 0x46}},
        {16, {0x07, 0x0a, 0x16, 0xb4, 0x6b, 0x4d, 0x41, 0x44, 0xf7, 0x9b, 0xdd, 0x9d, 0xd0, 0x4a, 0x28, 0x7c}},
        {40, {0xdf, 0xa6, 0x67, 0x47, 0xde, 0x9a, 0xe6, 0x30, 0x30, 0xca, 0x32, 0x61, 0x14, 0x97, 0xc8, 0x27}},
        {64, {0x51, 0xf0, 0xbe, 0xbf, 0x7e, 0x3b, 0x9d, 0x92, 0xfc, 0x49, 0x74, 0x17, 0x79, 0x36, 0x3c, 0xfe}},
    };
    for (size_t i = 0; i < sizeof examples / sizeof examples[0]; i++) {
        uint8_t mac[16];
        upb_cmac(bench_key, text, examples[i].count, mac);
        CHECK(memcmp(mac, examples[i].mac, 16) == 0);
    }
}

/* What a forged command costs; reported, never asserted. */
static void report_cmac_time(void) {
    uint8_t mac[16] = {0};
    const clock_t begin = clock();
    for (int i = 0; i < 1000; i++)
        upb_cmac(bench_key, mac, 15, mac);
    printf("CMAC of a command: %.1f us of processor time (measured)\n",
           (double)(clock() - begin) * 1e3 / (double)CLOCKS_PER_SEC);
}

/* ---------------------------------------------------------------------------------------------- commands */

static void test_commands(void) {
    uint8_t sequence = 0, other_key[UPB_KEY_BYTES];
    memcpy(other_key, bench_key, sizeof other_key);
    other_key[15] ^= 1;
    new_device();
    CHECK_EQUAL(bench_start(&device, bench_key), UPB_OK);
    const upb_command hold = {UPB_COMMAND_MODE, 7, 2, 0};
    upb_can_frame frame = bench_command(&hold, bench_key, &sequence);
    CHECK(upb_bus_can(&device.bus, &frame, device.now_ns));
    CHECK_EQUAL(device.executions, 1);
    CHECK_EQUAL(device.executed.argument, 2);
    CHECK_EQUAL(device.store.writes[UPB_STORE_FRESHNESS], 1);
    CHECK(bench_last(&device, UPB_RESPONSE_ID) != NULL);
    /* A replay, an older one, another key: nothing changes. */
    upb_bus_can(&device.bus, &frame, device.now_ns);
    const upb_command old = {UPB_COMMAND_MODE, 6, 1, 0}, forged = {UPB_COMMAND_MODE, 8, 1, 0};
    frame = bench_command(&old, bench_key, &sequence);
    upb_bus_can(&device.bus, &frame, device.now_ns);
    frame = bench_command(&forged, other_key, &sequence);
    upb_bus_can(&device.bus, &frame, device.now_ns);
    CHECK_EQUAL(device.executions, 1);
    CHECK_EQUAL(device.bus.commands.results[UPB_COMMAND_STALE], 2);
    CHECK_EQUAL(device.bus.commands.results[UPB_COMMAND_MAC], 1);
    CHECK_EQUAL(device.bus.commands.freshness, 7);
    CHECK_EQUAL(device.store.writes[UPB_STORE_FRESHNESS], 1);
    CHECK(upb_fault_is_active(&device.bus.faults, UPB_FAULT_CAN_COMMAND_REJECTED));
    bench_step(&device, 5001);
    CHECK(!upb_fault_is_active(&device.bus.faults, UPB_FAULT_CAN_COMMAND_REJECTED));
    /* After a restart the replay is still one. */
    CHECK_EQUAL(bench_start(&device, bench_key), UPB_OK);
    frame = bench_command(&hold, bench_key, &sequence);
    upb_bus_can(&device.bus, &frame, device.now_ns);
    CHECK_EQUAL(device.executions, 1);
    CHECK_EQUAL(device.bus.commands.results[UPB_COMMAND_STALE], 1);
}

static upb_command_result try_command(uint32_t code, uint32_t freshness, uint32_t argument, uint32_t crc32) {
    uint8_t sequence = 0;
    const upb_command command = {code, freshness, argument, crc32};
    const upb_can_frame frame = bench_command(&command, bench_key, &sequence);
    uint64_t before[UPB_COMMAND_RESULTS];
    memcpy(before, device.bus.commands.results, sizeof before);
    upb_bus_can(&device.bus, &frame, device.now_ns);
    for (uint32_t i = 0; i < UPB_COMMAND_RESULTS; i++)
        if (device.bus.commands.results[i] != before[i])
            return (upb_command_result)i;
    return (upb_command_result)UPB_COMMAND_RESULTS;
}

static void test_command_values(void) {
    new_device();
    bench_start(&device, bench_key);
    CHECK_EQUAL(try_command(UPB_COMMAND_STATUS, 1, 0, 0), UPB_COMMAND_DONE);
    CHECK_EQUAL(try_command(UPB_COMMAND_STATUS, 2, 1, 0), UPB_COMMAND_VALUE);
    CHECK_EQUAL(try_command(UPB_COMMAND_MODE, 3, 4, 0), UPB_COMMAND_VALUE);
    CHECK_EQUAL(try_command(UPB_COMMAND_MODE, 4, UPB_MODE_AUTOMATIC, 0), UPB_COMMAND_DONE);
    CHECK_EQUAL(try_command(UPB_COMMAND_MODEL, 5, 0, 0), UPB_COMMAND_VALUE);
    CHECK_EQUAL(try_command(UPB_COMMAND_MODEL, 6, 0, 0x12345678), UPB_COMMAND_DONE);
    CHECK_EQUAL(device.executed.model_crc32, 0x12345678);
    CHECK_EQUAL(try_command(UPB_COMMAND_CLEAR_FAULTS, 7, UPB_FAULTS + 1, 0), UPB_COMMAND_VALUE);
    CHECK_EQUAL(try_command(99, 8, 0, 0), UPB_COMMAND_UNKNOWN);
    CHECK_EQUAL(device.bus.commands.freshness, 8); /* used up even where the value was refused */
    device.execute_answer = UPB_COMMAND_REFUSED;
    CHECK_EQUAL(try_command(UPB_COMMAND_MODEL, 9, 0, 1), UPB_COMMAND_REFUSED);
    CHECK_EQUAL(try_command(UPB_COMMAND_MODE, UINT32_MAX, 0, 0), UPB_COMMAND_REFUSED);
    CHECK_EQUAL(try_command(UPB_COMMAND_MODE, UINT32_MAX, 0, 0), UPB_COMMAND_STALE);
}

static void test_command_storage(void) {
    static const uint8_t no_key[UPB_KEY_BYTES];
    new_device();
    bench_start(&device, no_key);
    CHECK_EQUAL(try_command(UPB_COMMAND_STATUS, 1, 0, 0), UPB_COMMAND_NO_KEY);
    bench_start(&device, bench_key);
    device.store.fail_write = 1;
    CHECK_EQUAL(try_command(UPB_COMMAND_MODE, 1, 1, 0), UPB_COMMAND_STORAGE);
    CHECK_EQUAL(device.executions, 0);
    device.store.fail_write = 0;
    CHECK_EQUAL(try_command(UPB_COMMAND_MODE, 1, 1, 0), UPB_COMMAND_DONE);
    device.store.bytes[UPB_STORE_FRESHNESS][3] ^= 1; /* damage: no command until it is provisioned again */
    bench_start(&device, bench_key);
    CHECK_EQUAL(try_command(UPB_COMMAND_MODE, 9, 1, 0), UPB_COMMAND_STORAGE);
    device.store.fail_read = 1;
    bench_start(&device, bench_key);
    CHECK_EQUAL(try_command(UPB_COMMAND_MODE, 9, 1, 0), UPB_COMMAND_STORAGE);
    device.store.fail_read = 0;
    device.store.count[UPB_STORE_FRESHNESS] = 0;
    bench_start(&device, bench_key);
    CHECK_EQUAL(try_command(UPB_COMMAND_MODE, 9, 1, 0), UPB_COMMAND_DONE);
}

/* ------------------------------------------------------------------------------------------------ faults */

static void test_debounce(void) {
    const upb_storage none = {0};
    upb_faults faults;
    upb_faults_init(&faults, &none, 0);
    for (uint32_t id = 1; id <= UPB_FAULTS; id++) {
        if (id == UPB_FAULT_POWER_RESET)
            continue;
        const upb_debounce d = upb_fault_debounce(id);
        unsigned up = 0, down = 0;
        while (!upb_fault_is_active(&faults, id) && up < 200)
            upb_faults_report(&faults, id, UPB_MONITOR_PREFAILED, up++);
        while (upb_fault_is_active(&faults, id) && down < 200)
            upb_faults_report(&faults, id, UPB_MONITOR_PREPASSED, up + down++);
        CHECK_EQUAL(up, (127u + d.up - 1) / d.up);
        CHECK_EQUAL(down, (128u + d.down - 1) / d.down);
        CHECK_EQUAL(upb_fault_of_dtc(upb_fault_dtc(id)), id);
        CHECK_EQUAL(faults.entries[id].status,
                    UPB_DTC_TEST_FAILED_THIS_CYCLE | UPB_DTC_PENDING | UPB_DTC_CONFIRMED | UPB_DTC_FAILED_SINCE_CLEAR);
    }
    CHECK_EQUAL(upb_faults_count(&faults, UPB_DTC_CONFIRMED), UPB_FAULTS - 1);
    CHECK_EQUAL(upb_faults_report(&faults, 0, UPB_MONITOR_FAILED, 0), 0);
    CHECK_EQUAL(upb_faults_report(&faults, UPB_FAULTS + 1, UPB_MONITOR_FAILED, 0), 0);
    CHECK_EQUAL(upb_fault_of_dtc(0xd00000), 0);
    CHECK_EQUAL(upb_fault_of_dtc(0xd00101), 0);
    CHECK_EQUAL(upb_faults_clear(&faults, UPB_FAULTS + 1), UPB_E_ARGUMENT);
    CHECK_EQUAL(upb_faults_clear(&faults, 0), UPB_OK);
    CHECK_EQUAL(upb_faults_count(&faults, UPB_DTC_CONFIRMED), 0);
    CHECK_EQUAL(upb_faults_count(&faults, UPB_DTC_NOT_COMPLETED_SINCE_CLEAR), UPB_FAULTS);
}

/* Of muted faults nothing is found, remembered or stored; the others are as ever. */
static void test_muted_faults(void) {
    const upb_storage none = {0};
    upb_faults faults;
    upb_faults_init(&faults, &none, 0);
    for (uint32_t id = 1; id <= UPB_FAULTS; id++)
        upb_faults_report(&faults, id, UPB_MONITOR_FAILED, id);
    upb_faults_mute(&faults, UINT64_C(0x15555555));
    for (uint32_t id = 1; id <= UPB_FAULTS; id++) {
        const int muted = id % 2;
        CHECK_EQUAL(upb_fault_is_active(&faults, id), !muted);
        CHECK_EQUAL(faults.entries[id].occurrences, !muted);
        CHECK_EQUAL(upb_faults_report(&faults, id, UPB_MONITOR_PASSED, 100) != 0, !muted);
        CHECK_EQUAL(upb_faults_report(&faults, id, UPB_MONITOR_FAILED, 100) != 0, !muted);
    }
    CHECK_EQUAL(upb_faults_active(&faults), UINT64_C(0x0aaaaaaa));
    upb_faults_mute(&faults, 0);
    CHECK_EQUAL(upb_faults_report(&faults, 1, UPB_MONITOR_FAILED, 200) != 0, 1);
}

/* Confirmed over restarts, forgotten after 40 cycles in which the test passed; a reset without an end is noticed. */
static void test_fault_cycles(void) {
    new_device();
    device.snapshot.record.frame = 1234;
    bench_start(&device, bench_key);
    CHECK(!upb_fault_is_active(&device.bus.faults, UPB_FAULT_POWER_RESET));
    bench_step(&device, 1);
    upb_faults_report(&device.bus.faults, UPB_FAULT_NET_LOSS, UPB_MONITOR_FAILED, 5);
    bench_step(&device, 2000);
    bench_start(&device, bench_key); /* power was lost */
    CHECK(upb_fault_is_active(&device.bus.faults, UPB_FAULT_POWER_RESET));
    const upb_fault_entry *entry = &device.bus.faults.entries[UPB_FAULT_NET_LOSS];
    CHECK_EQUAL(entry->status,
                UPB_DTC_PENDING | UPB_DTC_CONFIRMED | UPB_DTC_FAILED_SINCE_CLEAR | UPB_DTC_NOT_COMPLETED_THIS_CYCLE);
    CHECK_EQUAL(entry->frame, 1234);
    CHECK_EQUAL(entry->occurrences, 1);
    device.snapshot.state = UPB_STATE_RUNNING;
    bench_step(&device, 1);
    CHECK(!upb_fault_is_active(&device.bus.faults, UPB_FAULT_POWER_RESET));
    for (uint32_t cycle = 1; cycle <= UPB_FAULTS_AGE_CYCLES; cycle++) {
        upb_faults_report(&device.bus.faults, UPB_FAULT_NET_LOSS, UPB_MONITOR_PASSED, 0);
        CHECK(entry->status & UPB_DTC_CONFIRMED);
        CHECK_EQUAL(upb_bus_end(&device.bus), UPB_STORED_DONE);
        bench_start(&device, bench_key);
        CHECK(!upb_fault_is_active(&device.bus.faults, UPB_FAULT_POWER_RESET));
        CHECK_EQUAL(entry->status & UPB_DTC_PENDING, 0);
    }
    CHECK(!(entry->status & UPB_DTC_CONFIRMED));
    /* It fails again: ageing begins anew. A reset after cycles that ended well is noticed, too. */
    upb_faults_report(&device.bus.faults, UPB_FAULT_NET_LOSS, UPB_MONITOR_FAILED, 0);
    CHECK_EQUAL(entry->cycles_ok, 0);
    CHECK_EQUAL(entry->occurrences, 2);
    bench_step(&device, 1);
    bench_start(&device, bench_key);
    CHECK(upb_fault_is_active(&device.bus.faults, UPB_FAULT_POWER_RESET));
    CHECK(entry->status & UPB_DTC_CONFIRMED);
    device.store.bytes[UPB_STORE_FAULTS][40] ^= 4;
    bench_start(&device, bench_key);
    CHECK_EQUAL(device.bus.faults.store_failures, 1);
    CHECK_EQUAL(upb_faults_count(&device.bus.faults, UPB_DTC_CONFIRMED), 0);
    device.store.fail_write = 1;
    CHECK_EQUAL(upb_bus_end(&device.bus), UPB_STORED_FAILED);
}

/* A fault that comes and goes all the time does not wear the storage out; a new one is kept at once. */
static void test_storage_wear(void) {
    new_device();
    bench_start(&device, bench_key);
    bench_step(&device, 2000);
    const unsigned first = device.store.writes[UPB_STORE_FAULTS];
    for (int i = 0; i < 300; i++) {
        upb_faults_report(&device.bus.faults, UPB_FAULT_NET_LOSS, UPB_MONITOR_FAILED, device.now_ns);
        bench_step(&device, 1000);
        upb_faults_report(&device.bus.faults, UPB_FAULT_NET_LOSS, UPB_MONITOR_PASSED, device.now_ns);
    }
    CHECK_EQUAL(device.store.writes[UPB_STORE_FAULTS] - first, 1 + 300 / 60 - 1);
    upb_faults_report(&device.bus.faults, UPB_FAULT_NET_REORDER, UPB_MONITOR_FAILED, device.now_ns);
    const unsigned before = device.store.writes[UPB_STORE_FAULTS];
    bench_step(&device, 1);
    CHECK_EQUAL(device.store.writes[UPB_STORE_FAULTS], before + 1);
}

/* -------------------------------------------------------------------------------------------------- sender */

static void test_cycle_times(void) {
    new_device();
    bench_start(&device, bench_key);
    bench_step(&device, 1999); /* the first messages leave in the first 25 ms */
    for (int i = 0; i < (int)UPB_MESSAGES; i++) {
        const upb_message_info *info = upb_message_get_info((upb_message)i);
        const unsigned expected = info->cycle_ms && i != UPB_MESSAGE_FAULT_DETAIL ? 2000 / info->cycle_ms : 0;
        CHECK_EQUAL(bench_count(&device, info->id), expected);
    }
    CHECK(upb_message_get_info((upb_message)UPB_MESSAGES) == NULL);
    /* A device that was not stepped for long sends each once, not all that it missed. */
    bench_forget(&device);
    device.now_ns += 60000000000u;
    bench_step(&device, 1);
    CHECK_EQUAL(device.sent_count, 5);
    bench_forget(&device);
    bench_step(&device, 10);
    CHECK_EQUAL(device.sent_count, 0);
}

static void test_busy_and_failing(void) {
    const upb_ledger_record record = {.frame = 5};
    new_device();
    bench_start(&device, bench_key);
    device.can_answer = UPB_SEND_BUSY;
    bench_step(&device, 500);
    for (int i = 0; i < 10; i++)
        upb_bus_ledger(&device.bus, &record);
    CHECK_EQUAL(device.bus.can.ledger_dropped, 10 - UPB_LEDGER_QUEUE);
    CHECK_EQUAL(device.bus.can_failed, 0);
    device.can_answer = UPB_SEND_DONE;
    bench_step(&device, 1);
    CHECK_EQUAL(bench_count(&device, 0x220), UPB_LEDGER_QUEUE);
    CHECK_EQUAL(device.sent[UPB_LEDGER_QUEUE].data[1] & 15u, 0); /* nothing was lost: the E2E counter begins at 0 */
    device.can_answer = UPB_SEND_FAILED;
    bench_step(&device, 200);
    CHECK(upb_fault_is_active(&device.bus.faults, UPB_FAULT_CAN_BUS_OFF));
    CHECK(device.bus.can_failed > 0);
    const uint64_t dropped = device.bus.can.ledger_dropped;
    upb_bus_ledger(&device.bus, &record);
    bench_step(&device, 1);
    CHECK_EQUAL(device.bus.can.ledger_dropped, dropped + 1);
    device.can_answer = UPB_SEND_DONE;
    bench_step(&device, 500);
    CHECK(!upb_fault_is_active(&device.bus.faults, UPB_FAULT_CAN_BUS_OFF));
}

/* The status command makes every message due at once. */
static void test_status_command(void) {
    new_device();
    bench_start(&device, bench_key);
    bench_step(&device, 1100);
    bench_forget(&device);
    CHECK_EQUAL(try_command(UPB_COMMAND_STATUS, 1, 0, 0), UPB_COMMAND_DONE);
    upb_bus_step(&device.bus, &device.snapshot, device.now_ns);
    CHECK_EQUAL(device.sent_count, 1 + 5); /* the response, and all but the fault detail: there is none */
}

/* ------------------------------------------------------------------------------------------------- frames */

static void test_frame_bytes(void) {
    upb_can_frame frame = {.id = 0x7ff, .flags = 0, .length = 9}, back;
    uint8_t bytes[UPB_CAN_WIRE_MAX + 1];
    CHECK_EQUAL(upb_can_frame_encode(&frame, bytes), 0); /* no classic frame has 9 bytes, and no FD frame */
    frame.flags = UPB_CAN_FD;
    CHECK_EQUAL(upb_can_frame_encode(&frame, bytes), 0);
    frame.length = 12;
    CHECK_EQUAL(upb_can_frame_encode(&frame, bytes), 18);
    CHECK_EQUAL(upb_can_frame_decode(bytes, 18, &back), UPB_OK);
    CHECK(memcmp(&frame, &back, sizeof frame) == 0);
    CHECK_EQUAL(upb_can_frame_decode(bytes, 17, &back), UPB_E_TRUNCATED);
    CHECK_EQUAL(upb_can_frame_decode(bytes, 19, &back), UPB_E_TRUNCATED);
    bytes[4] |= 8;
    CHECK_EQUAL(upb_can_frame_decode(bytes, 18, &back), UPB_E_VALUE);
    frame.id = 0x800;
    CHECK(!upb_can_frame_is_valid(&frame));
    frame.flags |= UPB_CAN_EXTENDED;
    CHECK(upb_can_frame_is_valid(&frame));
    frame.flags = UPB_CAN_BRS;
    frame.id = frame.length = 0;
    CHECK(!upb_can_frame_is_valid(&frame));
}

/* An ISO-TP message that stops: the timeout counts, and the next message is taken. */
static void test_isotp_timeouts(void) {
    const upb_can_transport transport = {bench_send, &device};
    const upb_isotp_config config = device.bus.config.isotp;
    const upb_can_frame first = {.id = UPB_UDS_REQUEST_ID, .length = 8, .data = {0x10, 20, 1, 2, 3, 4, 5, 6}};
    const upb_can_frame single = {.id = UPB_UDS_REQUEST_ID, .length = 8, .data = {2, 0x3e, 0}};
    static upb_isotp link;
    uint8_t message[20] = {0};
    size_t count;
    int functional;
    device.can_answer = UPB_SEND_DONE;
    CHECK_EQUAL(upb_isotp_init(&link, &config, &transport), UPB_OK);
    CHECK(upb_isotp_receive(&link, &first, 0));
    upb_isotp_step(&link, config.n_cr_ns);
    CHECK_EQUAL(link.errors[UPB_ISOTP_TIMEOUT_CR], 1);
    CHECK(upb_isotp_receive(&link, &single, config.n_cr_ns));
    CHECK(upb_isotp_message(&link, &count, &functional) != NULL && count == 2);
    CHECK_EQUAL(upb_isotp_send(&link, message, 20, 0), UPB_OK);
    CHECK_EQUAL(upb_isotp_send(&link, message, 20, 0), UPB_E_ORDER);
    upb_isotp_step(&link, config.n_bs_ns - 1);
    CHECK(upb_isotp_is_sending(&link));
    upb_isotp_step(&link, config.n_bs_ns);
    CHECK_EQUAL(link.errors[UPB_ISOTP_TIMEOUT_BS], 1);
    CHECK(!upb_isotp_is_sending(&link));
}

int main(void) {
    test_crc();
    test_e2e_examples();
    test_e2e_arguments();
    test_e2e_check();
    test_e2e_machine();
    test_cmac();
    report_cmac_time();
    test_commands();
    test_command_values();
    test_command_storage();
    test_debounce();
    test_muted_faults();
    test_fault_cycles();
    test_storage_wear();
    test_cycle_times();
    test_busy_and_failing();
    test_status_command();
    test_frame_bytes();
    test_isotp_timeouts();
    return check_report("bus");
}
