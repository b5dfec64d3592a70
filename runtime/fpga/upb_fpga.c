#include "upb_fpga.h"

#include <string.h>

/* A weights image: head, then pairs of address and value; see quant/export/rtl_weights.py. */
enum {
    IMAGE_MAGIC = 0,
    IMAGE_FORMAT = 4,
    IMAGE_SHAPE = 8,
    IMAGE_SCALE_DISTANCE = 12,
    IMAGE_SCALE_INTENSITY = 16,
    IMAGE_SLOPES = 20,
    IMAGE_MODEL = 24,
    IMAGE_WORDS = 28,
    IMAGE_CRC = 32,
    IMAGE_HEAD_BYTES = 36,
    IMAGE_PAIR_BYTES = 8
};
#define IMAGE_MAGIC_VALUE 0x57425055u /* "UPBW" */
#define IMAGE_FORMAT_VALUE 1u
/* What an image and a core must have in common. */
#define SHAPE_OF_IMAGE (UPB_SHAPE_FOLD | UPB_SHAPE_LANES | UPB_SHAPE_HIDDEN | UPB_SHAPE_WIDE)

const char *upb_fpga_status_text(upb_fpga_status status) {
    switch (status) {
    case UPB_FPGA_OK:
        return "done";
    case UPB_FPGA_E_ARGUMENT:
        return "a null pointer, or a value outside its range";
    case UPB_FPGA_E_BUS:
        return "an access to a register failed";
    case UPB_FPGA_E_ID:
        return "no upbeam core at this address";
    case UPB_FPGA_E_VERSION:
        return "a register map of another major version";
    case UPB_FPGA_E_RUNNING:
        return "not while the core runs";
    case UPB_FPGA_E_READ_ONLY:
        return "this core's weights cannot be written";
    case UPB_FPGA_E_PENDING:
        return "the last weights image still waits for a frame";
    case UPB_FPGA_E_IMAGE:
        return "not a weights image, or a damaged one";
    case UPB_FPGA_E_SHAPE:
        return "a weights image for another core";
    case UPB_FPGA_E_WRITTEN:
        return "the core did not receive what was written";
    case UPB_FPGA_E_SYSTEM:
        return "the operating system refused";
    }
    return "unknown status";
}

/* ---------------------------------------------------------------------------------------------- registers */

static upb_fpga_status fail(upb_fpga *f, upb_fpga_status status, uint32_t address, uint32_t got, uint32_t expected) {
    const upb_fpga_fault fault = {address, got, expected};
    f->fault = fault;
    return status;
}

static upb_fpga_status get(upb_fpga *f, uint32_t address, uint32_t *value) {
    return f->bus.read(f->bus.user, address, value) == 0 ? UPB_FPGA_OK : fail(f, UPB_FPGA_E_BUS, address, 0, 0);
}

static upb_fpga_status put(upb_fpga *f, uint32_t address, uint32_t value) {
    return f->bus.write(f->bus.user, address, value) == 0 ? UPB_FPGA_OK : fail(f, UPB_FPGA_E_BUS, address, 0, 0);
}

typedef struct reading {
    uint32_t address;
    uint32_t *value;
} reading;

static upb_fpga_status get_all(upb_fpga *f, const reading *readings, size_t count) {
    upb_fpga_status status = UPB_FPGA_OK;
    for (size_t i = 0; i < count && status == UPB_FPGA_OK; i++)
        status = get(f, readings[i].address, readings[i].value);
    return status;
}

#define COUNT(array) (sizeof(array) / sizeof(array)[0])

static upb_fpga_status read_contract(upb_fpga *f) {
    size_t length = 0;
    for (uint32_t word = 0; word < 4; word++) {
        uint32_t value;
        const upb_fpga_status status = get(f, UPB_REG_CONTRACT_0 + 4 * word, &value);
        if (status != UPB_FPGA_OK)
            return status;
        for (uint32_t shift = 32; shift; shift -= 8) {
            const char letter = (char)(value >> (shift - 8) & 0xffu);
            if (letter)
                f->info.contract[length++] = letter;
        }
    }
    f->info.contract[length] = 0;
    return UPB_FPGA_OK;
}

static upb_fpga_status check_identity(upb_fpga *f) {
    uint32_t id;
    upb_fpga_status status = get(f, UPB_REG_ID, &id);
    if (status == UPB_FPGA_OK && id != UPB_REGS_ID)
        status = fail(f, UPB_FPGA_E_ID, UPB_REG_ID, id, UPB_REGS_ID);
    if (status == UPB_FPGA_OK)
        status = get(f, UPB_REG_VERSION, &f->info.version);
    if (status == UPB_FPGA_OK && f->info.version >> UPB_VERSION_MAJOR_SHIFT != UPB_REGS_VERSION_MAJOR)
        status = fail(f, UPB_FPGA_E_VERSION, UPB_REG_VERSION, f->info.version >> UPB_VERSION_MAJOR_SHIFT,
                      UPB_REGS_VERSION_MAJOR);
    return status;
}

upb_fpga_status upb_fpga_open(upb_fpga *fpga, const upb_fpga_bus *bus) {
    if (!fpga || !bus || !bus->read || !bus->write)
        return UPB_FPGA_E_ARGUMENT;
    memset(fpga, 0, sizeof *fpga);
    fpga->bus = *bus;
    uint32_t ring = 0;
    const reading readings[] = {
        {UPB_REG_CLOCK_HZ, &fpga->info.clock_hz},       {UPB_REG_SHAPE, &fpga->info.shape},
        {UPB_REG_SCALE_DISTANCE, &fpga->info.scale[0]}, {UPB_REG_SCALE_INTENSITY, &fpga->info.scale[1]},
        {UPB_REG_SLOPES, &fpga->info.slopes},           {UPB_REG_RING, &ring}};
    upb_fpga_status status = check_identity(fpga);
    if (status == UPB_FPGA_OK)
        status = read_contract(fpga);
    if (status == UPB_FPGA_OK)
        status = get_all(fpga, readings, COUNT(readings));
    fpga->info.ring_slots = ring & UPB_RING_SLOTS;
    fpga->info.ring_delay = ring >> UPB_RING_DELAY_SHIFT;
    return status == UPB_FPGA_OK ? upb_fpga_refresh(fpga) : status;
}

upb_fpga_status upb_fpga_refresh(upb_fpga *fpga) {
    if (!fpga)
        return UPB_FPGA_E_ARGUMENT;
    const reading readings[] = {{UPB_REG_MODEL_CRC, &fpga->info.model_crc},
                                {UPB_REG_WEIGHTS_CRC, &fpga->info.weights_crc},
                                {UPB_REG_COLUMNS, &fpga->info.columns}};
    return get_all(fpga, readings, COUNT(readings));
}

/* ------------------------------------------------------------------------------------------------ running */

upb_fpga_status upb_fpga_start(upb_fpga *fpga, const upb_fpga_settings *settings) {
    if (!fpga || !settings || settings->columns > 65535u || (settings->columns && settings->columns < 4u))
        return UPB_FPGA_E_ARGUMENT;
    uint32_t control;
    upb_fpga_status status = get(fpga, UPB_REG_CONTROL, &control);
    if (status == UPB_FPGA_OK && control & UPB_CONTROL_ENABLE)
        return fail(fpga, UPB_FPGA_E_RUNNING, UPB_REG_CONTROL, control, 0);
    if (status == UPB_FPGA_OK && settings->columns)
        status = put(fpga, UPB_REG_COLUMNS, settings->columns);
    if (status == UPB_FPGA_OK)
        status = put(fpga, UPB_REG_DEADLINE, settings->deadline_clocks);
    if (status == UPB_FPGA_OK)
        status = put(fpga, UPB_REG_EVENTS, 0xffffffffu);
    if (status == UPB_FPGA_OK)
        status = put(fpga, UPB_REG_IRQ_ENABLE, settings->irq_events);
    if (status == UPB_FPGA_OK)
        status = put(fpga, UPB_REG_CONTROL, UPB_CONTROL_ENABLE);
    return status == UPB_FPGA_OK ? upb_fpga_refresh(fpga) : status;
}

upb_fpga_status upb_fpga_stop(upb_fpga *fpga) { return fpga ? put(fpga, UPB_REG_CONTROL, 0) : UPB_FPGA_E_ARGUMENT; }

upb_fpga_status upb_fpga_take_events(upb_fpga *fpga, uint32_t *events) {
    if (!fpga || !events)
        return UPB_FPGA_E_ARGUMENT;
    const upb_fpga_status status = get(fpga, UPB_REG_EVENTS, events);
    /* Only what was read is cleared: what comes in between stays for the next call. */
    return status == UPB_FPGA_OK && *events ? put(fpga, UPB_REG_EVENTS, *events) : status;
}

upb_fpga_status upb_fpga_read_counters(upb_fpga *fpga, upb_fpga_counters *counters) {
    if (!fpga || !counters)
        return UPB_FPGA_E_ARGUMENT;
    const reading readings[] = {
        {UPB_REG_FRAMES_IN, &counters->frames_in},   {UPB_REG_COLUMNS_IN, &counters->columns_in},
        {UPB_REG_FRAMES_OUT, &counters->frames_out}, {UPB_REG_COLUMNS_OUT, &counters->columns_out},
        {UPB_REG_DROPPED, &counters->dropped_beats}, {UPB_REG_ERRORS, &counters->errors},
        {UPB_REG_MISSES, &counters->misses},         {UPB_REG_FRAME_CLOCKS, &counters->frame_clocks},
        {UPB_REG_LATENCY, &counters->latency},       {UPB_REG_LATENCY_MAX, &counters->latency_max},
    };
    return get_all(fpga, readings, COUNT(readings));
}

uint32_t upb_fpga_clocks(const upb_fpga *fpga, uint32_t microseconds) {
    if (!fpga)
        return 0;
    const uint64_t clocks = ((uint64_t)fpga->info.clock_hz * microseconds + 999999u) / 1000000u;
    return clocks > UINT32_MAX ? UINT32_MAX : (uint32_t)clocks;
}

/* ------------------------------------------------------------------------------------------------ weights */

static uint32_t word_at(const uint8_t *bytes, size_t at) {
    return (uint32_t)bytes[at] | (uint32_t)bytes[at + 1] << 8 | (uint32_t)bytes[at + 2] << 16 |
           (uint32_t)bytes[at + 3] << 24;
}

/* CRC-32 as zlib's. Bit by bit: an image has a few kilobytes, a table would be as large. */
static uint32_t crc32_of(const uint8_t *bytes, size_t count) {
    uint32_t crc = 0xffffffffu;
    for (size_t i = 0; i < count; i++) {
        crc ^= bytes[i];
        for (int bit = 0; bit < 8; bit++)
            crc = crc >> 1 ^ (0xedb88320u & (0u - (crc & 1u)));
    }
    return ~crc;
}

static int in_window(uint32_t address) { return address % 4 == 0 && address < UPB_REGS_WEIGHTS_BYTES; }

static upb_fpga_status check_image(upb_fpga *f, const uint8_t *image, size_t bytes) {
    if (bytes < IMAGE_HEAD_BYTES)
        return fail(f, UPB_FPGA_E_IMAGE, 0, (uint32_t)bytes, IMAGE_HEAD_BYTES);
    if (word_at(image, IMAGE_MAGIC) != IMAGE_MAGIC_VALUE || word_at(image, IMAGE_FORMAT) != IMAGE_FORMAT_VALUE)
        return fail(f, UPB_FPGA_E_IMAGE, 0, word_at(image, IMAGE_MAGIC), IMAGE_MAGIC_VALUE);
    const uint32_t words = word_at(image, IMAGE_WORDS);
    const size_t payload = bytes - IMAGE_HEAD_BYTES;
    if (payload % IMAGE_PAIR_BYTES || payload / IMAGE_PAIR_BYTES != words || words > UPB_REGS_WEIGHTS_BYTES / 4u)
        return fail(f, UPB_FPGA_E_IMAGE, 0, (uint32_t)(payload / IMAGE_PAIR_BYTES), words);
    const uint32_t crc = crc32_of(image + IMAGE_HEAD_BYTES, payload);
    if (crc != word_at(image, IMAGE_CRC))
        return fail(f, UPB_FPGA_E_IMAGE, 0, crc, word_at(image, IMAGE_CRC));
    for (size_t at = IMAGE_HEAD_BYTES; at < bytes; at += IMAGE_PAIR_BYTES)
        if (!in_window(word_at(image, at)))
            return fail(f, UPB_FPGA_E_IMAGE, word_at(image, at), 0, UPB_REGS_WEIGHTS_BYTES);
    return UPB_FPGA_OK;
}

static upb_fpga_status check_fit(upb_fpga *f, const uint8_t *image) {
    const struct {
        uint32_t address, has, wants;
    } pairs[] = {
        {UPB_REG_SHAPE, f->info.shape & SHAPE_OF_IMAGE, word_at(image, IMAGE_SHAPE)},
        {UPB_REG_SCALE_DISTANCE, f->info.scale[0], word_at(image, IMAGE_SCALE_DISTANCE)},
        {UPB_REG_SCALE_INTENSITY, f->info.scale[1], word_at(image, IMAGE_SCALE_INTENSITY)},
        {UPB_REG_SLOPES, f->info.slopes, word_at(image, IMAGE_SLOPES)},
    };
    for (size_t i = 0; i < COUNT(pairs); i++)
        if (pairs[i].has != pairs[i].wants)
            return fail(f, UPB_FPGA_E_SHAPE, pairs[i].address, pairs[i].wants, pairs[i].has);
    return UPB_FPGA_OK;
}

static upb_fpga_status check_ready(upb_fpga *f) {
    uint32_t state;
    if (!(f->info.shape & UPB_SHAPE_WRITABLE))
        return fail(f, UPB_FPGA_E_READ_ONLY, UPB_REG_SHAPE, f->info.shape, UPB_SHAPE_WRITABLE);
    const upb_fpga_status status = get(f, UPB_REG_STATUS, &state);
    if (status == UPB_FPGA_OK && state & UPB_STATUS_SWAP_PENDING)
        return fail(f, UPB_FPGA_E_PENDING, UPB_REG_STATUS, state, 0);
    return status;
}

static upb_fpga_status write_words(upb_fpga *f, const uint8_t *image, size_t bytes) {
    upb_fpga_status status = put(f, UPB_REG_WEIGHTS_COMMAND, UPB_WEIGHTS_COMMAND_BEGIN);
    for (size_t at = IMAGE_HEAD_BYTES; at < bytes && status == UPB_FPGA_OK; at += IMAGE_PAIR_BYTES)
        status = put(f, UPB_REGS_WEIGHTS + word_at(image, at), word_at(image, at + 4));
    return status;
}

/* What the core counted of an image, against what the image says; on a good match, the swap. */
static upb_fpga_status commit(upb_fpga *f, const uint8_t *image) {
    uint32_t written = 0, sum = 0;
    const uint32_t words = word_at(image, IMAGE_WORDS), crc = word_at(image, IMAGE_CRC);
    const reading readings[] = {{UPB_REG_WEIGHTS_WRITTEN, &written}, {UPB_REG_WEIGHTS_SUM, &sum}};
    upb_fpga_status status = get_all(f, readings, COUNT(readings));
    if (status == UPB_FPGA_OK && written != words)
        return fail(f, UPB_FPGA_E_WRITTEN, UPB_REG_WEIGHTS_WRITTEN, written, words);
    if (status == UPB_FPGA_OK && sum != crc)
        return fail(f, UPB_FPGA_E_WRITTEN, UPB_REG_WEIGHTS_SUM, sum, crc);
    if (status == UPB_FPGA_OK)
        status = put(f, UPB_REG_WEIGHTS_LENGTH, words);
    if (status == UPB_FPGA_OK)
        status = put(f, UPB_REG_WEIGHTS_EXPECTED, crc);
    if (status == UPB_FPGA_OK)
        status = put(f, UPB_REG_WEIGHTS_MODEL, word_at(image, IMAGE_MODEL));
    return status == UPB_FPGA_OK ? put(f, UPB_REG_WEIGHTS_COMMAND, UPB_WEIGHTS_COMMAND_SWAP) : status;
}

upb_fpga_status upb_fpga_load(upb_fpga *fpga, const uint8_t *image, size_t bytes) {
    if (!fpga || !image)
        return UPB_FPGA_E_ARGUMENT;
    upb_fpga_status status = check_ready(fpga);
    if (status == UPB_FPGA_OK)
        status = check_image(fpga, image, bytes);
    if (status == UPB_FPGA_OK)
        status = check_fit(fpga, image);
    if (status == UPB_FPGA_OK)
        status = write_words(fpga, image, bytes);
    return status == UPB_FPGA_OK ? commit(fpga, image) : status;
}
