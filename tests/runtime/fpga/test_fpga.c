/*
 * The driver of the FPGA core against registers in memory that behave as docs/fpga-registers.md says: an access that
 * the core would refuse is counted, and there must be none, whatever image is loaded.
 */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "upb_fpga.h"

enum { WORDS = 64, HEAD = 36, IMAGE_BYTES = HEAD + 8 * WORDS, ROUNDS = 50000 };

static const uint32_t shape = 24u | 1u << 12 | 12u << 22 | UPB_SHAPE_WRITABLE;

typedef struct core {
    uint32_t registers[UPB_REGS_BYTES / 4];
    uint32_t refused;
} core;

static uint32_t crc_step(uint32_t crc, uint32_t word) {
    for (int bit = 0; bit < 32; bit++, word >>= 1)
        crc = crc >> 1 ^ (0xedb88320u & (0u - ((crc ^ word) & 1u)));
    return crc;
}

static int core_read(void *user, uint32_t address, uint32_t *value) {
    core *c = user;
    if (address % 4 || address >= UPB_REGS_WEIGHTS) {
        c->refused++;
        return -1;
    }
    *value = address == UPB_REG_WEIGHTS_SUM ? ~c->registers[address / 4] : c->registers[address / 4];
    return 0;
}

static void swap(core *c) {
    const uint32_t *r = c->registers;
    if (r[UPB_REG_WEIGHTS_WRITTEN / 4] == r[UPB_REG_WEIGHTS_LENGTH / 4] &&
        ~r[UPB_REG_WEIGHTS_SUM / 4] == r[UPB_REG_WEIGHTS_EXPECTED / 4])
        c->registers[UPB_REG_STATUS / 4] |= UPB_STATUS_SWAP_PENDING;
    else
        c->registers[UPB_REG_EVENTS / 4] |= UPB_EVENTS_WEIGHTS;
}

static int core_write(void *user, uint32_t address, uint32_t value) {
    core *c = user;
    const int pending = (c->registers[UPB_REG_STATUS / 4] & UPB_STATUS_SWAP_PENDING) != 0;
    const int loading = address == UPB_REG_WEIGHTS_COMMAND || address == UPB_REG_WEIGHTS_LENGTH ||
                        address == UPB_REG_WEIGHTS_EXPECTED || address == UPB_REG_WEIGHTS_MODEL ||
                        address >= UPB_REGS_WEIGHTS;
    const int plain = address == UPB_REG_CONTROL || address == UPB_REG_DEADLINE || address == UPB_REG_IRQ_ENABLE ||
                      address == UPB_REG_EVENTS || (address == UPB_REG_COLUMNS && value >= 4 && value <= 65535);
    if (address % 4 || address >= UPB_REGS_BYTES || (loading ? pending : !plain)) {
        c->refused++;
        return -1;
    }
    if (address == UPB_REG_EVENTS)
        c->registers[address / 4] &= ~value;
    else if (address == UPB_REG_WEIGHTS_COMMAND && value == UPB_WEIGHTS_COMMAND_BEGIN) {
        c->registers[UPB_REG_WEIGHTS_WRITTEN / 4] = 0;
        c->registers[UPB_REG_WEIGHTS_SUM / 4] = 0xffffffffu;
    } else if (address == UPB_REG_WEIGHTS_COMMAND)
        swap(c);
    else
        c->registers[address / 4] = value;
    if (address >= UPB_REGS_WEIGHTS) {
        uint32_t *sum = &c->registers[UPB_REG_WEIGHTS_SUM / 4];
        *sum = crc_step(crc_step(*sum, address - UPB_REGS_WEIGHTS), value);
        c->registers[UPB_REG_WEIGHTS_WRITTEN / 4]++;
    }
    return 0;
}

static void reset(core *c) {
    memset(c, 0, sizeof *c);
    c->registers[UPB_REG_ID / 4] = UPB_REGS_ID;
    c->registers[UPB_REG_VERSION / 4] = UPB_REGS_VERSION_MAJOR << UPB_VERSION_MAJOR_SHIFT;
    c->registers[UPB_REG_SHAPE / 4] = shape;
    c->registers[UPB_REG_SCALE_DISTANCE / 4] = 0x01040007u;
    c->registers[UPB_REG_SCALE_INTENSITY / 4] = 0x0109080cu;
    c->registers[UPB_REG_COLUMNS / 4] = 2048;
    c->registers[UPB_REG_CONTRACT_3 / 4] = 0x612e7631u; /* "a.v1" */
}

static void put_word(uint8_t *bytes, uint32_t value) {
    for (int i = 0; i < 4; i++)
        bytes[i] = (uint8_t)(value >> (8 * i));
}

static void make_image(uint8_t *image) {
    const uint32_t head[] = {
        0x57425055u, 1, shape & ~(uint32_t)UPB_SHAPE_WRITABLE, 0x01040007u, 0x0109080cu, 0, 0xabcdu, WORDS, 0};
    uint32_t crc = 0xffffffffu;
    for (size_t i = 0; i < sizeof head / sizeof head[0]; i++)
        put_word(image + 4 * i, head[i]);
    for (uint32_t i = 0; i < WORDS; i++) {
        put_word(image + HEAD + 8 * i, 4 * i);
        put_word(image + HEAD + 8 * i + 4, 0x1234567u * i);
        crc = crc_step(crc_step(crc, 4 * i), 0x1234567u * i);
    }
    put_word(image + 32, ~crc);
}

static uint64_t random_state;

static uint32_t next_random(void) {
    random_state ^= random_state << 13;
    random_state ^= random_state >> 7;
    random_state ^= random_state << 17;
    return (uint32_t)(random_state >> 32);
}

static int failures;

static void expect(int condition, const char *what, int line) {
    if (!condition) {
        fprintf(stderr, "line %d: %s\n", line, what);
        failures++;
    }
}
#define EXPECT(condition) expect(condition, #condition, __LINE__)

static core simulated;

static void test_open_and_run(upb_fpga *fpga) {
    const upb_fpga_settings settings = {1085, 100, UPB_EVENTS_DEADLINE}, wrong = {3, 0, 0};
    uint32_t events;
    EXPECT(strcmp(fpga->info.contract, "a.v1") == 0);
    EXPECT(upb_fpga_start(fpga, &wrong) == UPB_FPGA_E_ARGUMENT);
    EXPECT(upb_fpga_start(fpga, &settings) == UPB_FPGA_OK);
    EXPECT(fpga->info.columns == 1085);
    EXPECT(upb_fpga_start(fpga, &settings) == UPB_FPGA_E_RUNNING);
    simulated.registers[UPB_REG_EVENTS / 4] = UPB_EVENTS_FRAME | UPB_EVENTS_DEADLINE;
    EXPECT(upb_fpga_take_events(fpga, &events) == UPB_FPGA_OK && events == (UPB_EVENTS_FRAME | UPB_EVENTS_DEADLINE));
    EXPECT(upb_fpga_take_events(fpga, &events) == UPB_FPGA_OK && events == 0);
    EXPECT(upb_fpga_stop(fpga) == UPB_FPGA_OK);
    EXPECT(upb_fpga_clocks(fpga, 1000) == 0);
    fpga->info.clock_hz = 25000001;
    EXPECT(upb_fpga_clocks(fpga, 1) == 26);
    EXPECT(upb_fpga_clocks(fpga, UINT32_MAX) == UINT32_MAX);
}

static void test_null(upb_fpga *fpga) {
    uint8_t byte = 0;
    EXPECT(upb_fpga_open(NULL, &fpga->bus) == UPB_FPGA_E_ARGUMENT);
    EXPECT(upb_fpga_open(fpga, NULL) == UPB_FPGA_E_ARGUMENT);
    EXPECT(upb_fpga_start(fpga, NULL) == UPB_FPGA_E_ARGUMENT);
    EXPECT(upb_fpga_stop(NULL) == UPB_FPGA_E_ARGUMENT);
    EXPECT(upb_fpga_take_events(fpga, NULL) == UPB_FPGA_E_ARGUMENT);
    EXPECT(upb_fpga_read_counters(fpga, NULL) == UPB_FPGA_E_ARGUMENT);
    EXPECT(upb_fpga_load(fpga, NULL, 10) == UPB_FPGA_E_ARGUMENT);
    EXPECT(upb_fpga_load(NULL, &byte, 1) == UPB_FPGA_E_ARGUMENT);
    EXPECT(upb_fpga_refresh(NULL) == UPB_FPGA_E_ARGUMENT);
    EXPECT(upb_fpga_clocks(NULL, 1) == 0);
}

/* An image with some bytes changed, or cut, in memory of exactly its size: never read beyond, refused unless it is
 * sound. */
static void test_mutations(upb_fpga *fpga) {
    uint8_t image[IMAGE_BYTES];
    uint32_t accepted = 0;
    make_image(image);
    for (int round = 0; round < ROUNDS; round++) {
        const size_t bytes = next_random() % 4 ? IMAGE_BYTES : next_random() % (IMAGE_BYTES + 1);
        uint8_t *mutated = malloc(bytes ? bytes : 1);
        if (!mutated)
            abort();
        memcpy(mutated, image, bytes);
        for (uint32_t changes = next_random() % 3; changes && bytes; changes--)
            mutated[next_random() % (next_random() % 2 ? (bytes < HEAD ? bytes : HEAD) : bytes)] =
                (uint8_t)next_random();
        simulated.registers[UPB_REG_STATUS / 4] = 0;
        const upb_fpga_status status = upb_fpga_load(fpga, mutated, bytes);
        /* The model's CRC-32, bytes 24 to 27, is the image's to tell. */
        const int same = bytes == IMAGE_BYTES && memcmp(mutated, image, 24) == 0 &&
                         memcmp(mutated + 28, image + 28, IMAGE_BYTES - 28) == 0;
        EXPECT((status == UPB_FPGA_OK) == same);
        EXPECT(status == UPB_FPGA_OK || status == UPB_FPGA_E_IMAGE || status == UPB_FPGA_E_SHAPE);
        accepted += status == UPB_FPGA_OK;
        free(mutated);
    }
    EXPECT(accepted > 0 && accepted < ROUNDS);
    EXPECT(upb_fpga_load(fpga, image, IMAGE_BYTES) == UPB_FPGA_OK ||
           upb_fpga_load(fpga, image, IMAGE_BYTES) == UPB_FPGA_E_PENDING);
    EXPECT(upb_fpga_load(fpga, image, IMAGE_BYTES) == UPB_FPGA_E_PENDING);
}

int main(int argc, char **argv) {
    const upb_fpga_bus bus = {core_read, core_write, &simulated};
    upb_fpga fpga;
    random_state = argc > 1 ? strtoull(argv[1], NULL, 10) : 20;
    printf("seed %llu\n", (unsigned long long)random_state);
    random_state = random_state * 0x9E3779B97F4A7C15u + 1;
    reset(&simulated);
    EXPECT(upb_fpga_open(&fpga, &bus) == UPB_FPGA_OK);
    test_open_and_run(&fpga);
    test_null(&fpga);
    test_mutations(&fpga);
    EXPECT(simulated.refused == 0);
    return failures != 0;
}
