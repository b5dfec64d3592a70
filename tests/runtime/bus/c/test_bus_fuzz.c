/*
 * Random and mutated bytes at every parser of the bus library. What must hold: nothing but a genuine command is carried
 * out, the fault memory and the links stay within their bounds, a good record after garbage is understood.
 *     test_bus_fuzz [--count N] [--seed S]     N inputs of each kind
 */
#include "bench_device.h"
#include "check.h"

static bench_device device;
static random_source source;

static void random_bytes(uint8_t *bytes, size_t count) {
    for (size_t i = 0; i < count; i++)
        bytes[i] = (uint8_t)random_u32(&source);
}

/* One to four changes: a bit, a byte, a copied byte. Never none at all. */
static void mutate(uint8_t *bytes, size_t count) {
    for (uint32_t n = 1 + random_below(&source, 4); n > 0; n--) {
        const size_t at = random_below(&source, (uint32_t)count);
        switch (random_below(&source, 3)) {
        case 0:
            bytes[at] ^= (uint8_t)(1u << random_below(&source, 8));
            break;
        case 1:
            bytes[at] = (uint8_t)random_u32(&source);
            break;
        default:
            bytes[at] = bytes[random_below(&source, (uint32_t)count)];
        }
    }
}

/* On CAN or on the serial line. */
static void receive_somewhere(const upb_can_frame *frame) {
    uint8_t bytes[UPB_CONSOLE_FRAME_MAX];
    const size_t count = random_below(&source, 2) ? upb_console_encode(frame, bytes) : 0;
    if (count)
        upb_bus_serial(&device.bus, bytes, count, device.now_ns);
    else
        upb_bus_can(&device.bus, frame, device.now_ns);
}

/* Genuine commands, altered after the MAC was made, with a checksum made good again: none is carried out. */
static void fuzz_commands(unsigned long count) {
    const upb_e2e_config e2e = {UPB_COMMAND_DATA_ID, UPB_COMMAND_BYTES, 2};
    uint8_t sequence = 0;
    memset(&device, 0, sizeof device);
    bench_start(&device, bench_key);
    for (unsigned long i = 0; i < count; i++) {
        const upb_command command = {1 + random_below(&source, 4), 1 + random_u32(&source) % 1000,
                                     random_below(&source, 5), random_u32(&source)};
        upb_can_frame frame = bench_command(&command, bench_key, &sequence), genuine = frame;
        mutate(frame.data, sizeof frame.data);
        frame.length = (uint8_t)(random_below(&source, 8) ? UPB_COMMAND_BYTES : random_below(&source, 65));
        if (memcmp(frame.data + 3, genuine.data + 3, UPB_COMMAND_BYTES - 3) == 0)
            continue;
        if (random_below(&source, 2))
            upb_e2e_p05_protect(&e2e, &sequence, frame.data, UPB_COMMAND_BYTES);
        receive_somewhere(&frame);
        bench_forget(&device);
    }
    CHECK_EQUAL(device.executions, 0);
    CHECK_EQUAL(device.bus.commands.freshness, 0);
    CHECK_EQUAL(device.store.writes[UPB_STORE_FRESHNESS], 0);
    CHECK(device.bus.commands.results[UPB_COMMAND_MAC] > 0);
    CHECK(device.bus.commands.results[UPB_COMMAND_E2E] > 0);
    const upb_command last = {UPB_COMMAND_MODE, 1, 0, 0};
    const upb_can_frame frame = bench_command(&last, bench_key, &sequence);
    upb_bus_can(&device.bus, &frame, device.now_ns);
    CHECK_EQUAL(device.executions, 1);
}

static upb_can_frame random_diagnostics(void) {
    static const uint8_t services[] = {0x10, 0x11, 0x14, 0x19, 0x22, 0x3e, 0x27, 0x00};
    upb_can_frame frame = {.id = random_below(&source, 8) ? UPB_UDS_REQUEST_ID : UPB_UDS_FUNCTIONAL_ID};
    frame.length = (uint8_t)(random_below(&source, 4) ? 8 : random_below(&source, 9));
    random_bytes(frame.data, 8);
    switch (random_below(&source, 4)) {
    case 0: /* a request in a single frame */
        frame.data[0] = (uint8_t)(1 + random_below(&source, 7));
        frame.data[1] = services[random_below(&source, sizeof services)];
        frame.data[2] &= 0x8f;
        break;
    case 1: /* the beginning of a longer one */
        frame.data[0] = (uint8_t)(0x10 | random_below(&source, 3));
        frame.data[2] = services[random_below(&source, sizeof services)];
        break;
    case 2: /* more of it, in order */
        frame.data[0] = (uint8_t)(0x20 | device.bus.isotp.rx_sequence);
        break;
    default: /* flow control */
        frame.data[0] = (uint8_t)(0x30 | random_below(&source, 4));
        frame.data[2] = (uint8_t)random_below(&source, 3);
    }
    if (random_below(&source, 6) == 0)
        mutate(frame.data, 8);
    return frame;
}

static void fuzz_diagnostics(unsigned long count) {
    memset(&device, 0, sizeof device);
    bench_start(&device, bench_key);
    for (unsigned long i = 0; i < count; i++) {
        const upb_can_frame frame = random_diagnostics();
        device.now_ns += random_below(&source, 4) ? 1000000u : random_below(&source, 1u << 31);
        upb_bus_can(&device.bus, &frame, device.now_ns);
        upb_bus_step(&device.bus, &device.snapshot, device.now_ns);
        for (unsigned k = 0; k < device.sent_count; k++)
            check_that(upb_can_frame_is_valid(&device.sent[k]), "a frame that was sent is valid", __FILE__, __LINE__);
        check_that(device.bus.isotp.rx_have <= UPB_ISOTP_BYTES &&
                       device.bus.isotp.tx_sent <= device.bus.isotp.tx_length,
                   "the link stays in its buffers", __FILE__, __LINE__);
        bench_forget(&device);
    }
    CHECK(device.bus.uds.requests > 0);
    CHECK_EQUAL(device.executions, 0);
    /* When the line is quiet again, a request is answered. */
    device.now_ns += 10000000000u;
    upb_bus_step(&device.bus, &device.snapshot, device.now_ns);
    bench_forget(&device);
    const upb_can_frame present = {.id = UPB_UDS_REQUEST_ID, .length = 3, .data = {2, 0x3e, 0}};
    upb_bus_can(&device.bus, &present, device.now_ns);
    const upb_can_frame *answer = bench_last(&device, UPB_UDS_RESPONSE_ID);
    CHECK(answer && answer->data[1] == 0x7e);
}

/* Mutated records and noise; then the delimiter and a good record, which must come through. */
static void fuzz_serial(unsigned long count) {
    static upb_console_parser parser;
    upb_console_parser_init(&parser);
    for (unsigned long i = 0; i < count; i++) {
        uint8_t bytes[3 * UPB_CONSOLE_FRAME_MAX];
        upb_can_frame frame = {.id = random_below(&source, 0x800), .flags = UPB_CAN_FD, .length = 24}, got;
        random_bytes(frame.data, frame.length);
        size_t noise = upb_console_encode(&frame, bytes);
        if (random_below(&source, 2))
            random_bytes(bytes, noise = random_below(&source, sizeof bytes));
        else
            mutate(bytes, noise);
        for (size_t k = 0; k < noise; k++)
            upb_console_parse(&parser, bytes[k], &got);
        upb_console_parse(&parser, 0, &got);
        const size_t good = upb_console_encode(&frame, bytes);
        int ended = 0;
        for (size_t k = 0; k < good; k++)
            ended += upb_console_parse(&parser, bytes[k], &got);
        check_that(ended == 1 && memcmp(&got, &frame, sizeof got) == 0, "a good record after noise is understood",
                   __FILE__, __LINE__);
    }
    CHECK(parser.bad_cobs && parser.bad_crc && parser.overlong);
}

/* Random bytes as COBS: what decodes encodes to the same again, if it has no block that could have been longer. */
static void fuzz_cobs(unsigned long count) {
    for (unsigned long i = 0; i < count; i++) {
        uint8_t plain[600], code[610], back[600];
        const size_t bytes = random_below(&source, sizeof plain);
        random_bytes(plain, bytes);
        for (size_t k = 0; k < bytes; k++) /* long runs without zeros, too */
            plain[k] = (uint8_t)(i % 3 ? plain[k] : plain[k] | 1);
        const size_t coded = upb_cobs_encode(plain, bytes, code);
        check_that(coded <= bytes + bytes / 254 + 1 && !memchr(code, 0, coded), "COBS has no zero", __FILE__, __LINE__);
        check_that(upb_cobs_decode(code, coded, back, sizeof back) == bytes && memcmp(plain, back, bytes) == 0,
                   "COBS comes back", __FILE__, __LINE__);
        check_that(upb_cobs_decode(code, coded, back, bytes ? bytes - 1 : 0) == (bytes ? SIZE_MAX : 0),
                   "COBS does not write beyond its room", __FILE__, __LINE__);
        random_bytes(code, coded);
        upb_cobs_decode(code, coded, back, random_below(&source, sizeof back));
    }
}

/* Damaged storage: the device starts, and refuses commands or has an empty fault memory. */
static void fuzz_storage(unsigned long count) {
    static bench_store good;
    uint8_t sequence = 0;
    memset(&device, 0, sizeof device);
    bench_start(&device, bench_key);
    const upb_command command = {UPB_COMMAND_MODE, 50, 0, 0};
    const upb_can_frame frame = bench_command(&command, bench_key, &sequence);
    upb_bus_can(&device.bus, &frame, 0);
    upb_bus_end(&device.bus);
    good = device.store;
    for (unsigned long i = 0; i < count; i++) {
        device.store = good;
        mutate(device.store.bytes[UPB_STORE_FRESHNESS], good.count[UPB_STORE_FRESHNESS]);
        mutate(device.store.bytes[UPB_STORE_FAULTS], good.count[UPB_STORE_FAULTS]);
        check_that(bench_start(&device, bench_key) == UPB_OK, "a device with damaged storage starts", __FILE__,
                   __LINE__);
        const int same = memcmp(device.store.bytes[UPB_STORE_FRESHNESS], good.bytes[UPB_STORE_FRESHNESS],
                                UPB_STORE_FRESHNESS_BYTES) == 0;
        check_that(device.bus.commands.storage_good == same, "damage is noticed", __FILE__, __LINE__);
    }
}

int main(int argc, char **argv) {
    const unsigned long count = option_number(argc, argv, "--count", 100000);
    const unsigned long seed = option_number(argc, argv, "--seed", 20);
    printf("seed %lu, %lu inputs of each kind\n", seed, count);
    source = random_seeded(seed);
    fuzz_commands(count);
    fuzz_diagnostics(count);
    fuzz_serial(count);
    fuzz_cobs(count / 10);
    fuzz_storage(count / 10);
    return check_report("bus_fuzz");
}
