/* Reads .ubm model files (docs/model-format.md). Bounded: every byte is looked at a fixed number of times. */
#include "upb_reader.h"

enum {
    FORMAT_VERSION = 1,
    HEADER_BYTES = 32,
    ENTRY_BYTES = 16,
    CRC_BYTES = 4,
    FILE_BYTES_MAX = 1 << 20,
    SECTIONS_MAX = 32,
    SENS_BYTES = 832,
    COUNT_BYTES = 4, /* number of networks, before them */
    NETWORK_HEAD_BYTES = 16,
    UNIT_NUMBERS = UPB_TAPS + 2 /* weights, b and v of a hidden unit */
};

#define SECTION_REQUIRED 1u
#define NETWORK_POSITIVE 1u
#define MAGNITUDE_MAX 1e6f

/* ----------------------------------------------------------------------------------------------- frame */

/* Checks the header and the checksum. `sections` receives the number of sections. */
static upb_status read_header(const upb_reader *r, uint32_t *sections, uint32_t *crc) {
    uint32_t file_bytes;
    size_t magic_bytes = r->size < 4 ? r->size : 4;
    if (memcmp(r->bytes, "UPBM", magic_bytes) != 0)
        return upb_fail(r->error, UPB_E_MAGIC, "magic", 0, magic_bytes == 4 ? upb_u32_at(r, 0) : 0,
                        UPB_TAG('U', 'P', 'B', 'M'));
    if (r->size < HEADER_BYTES + CRC_BYTES)
        return upb_fail(r->error, UPB_E_TRUNCATED, "file", 0, r->size, HEADER_BYTES + CRC_BYTES);
    if (upb_u16_at(r, 4) != FORMAT_VERSION)
        return upb_fail(r->error, UPB_E_VERSION, "version", 4, upb_u16_at(r, 4), FORMAT_VERSION);
    if (upb_u16_at(r, 6) != HEADER_BYTES)
        return upb_bad_value(r, "header_bytes", 6, upb_u16_at(r, 6), HEADER_BYTES);
    upb_status status = upb_ranged(r, "file_bytes", 8, HEADER_BYTES + CRC_BYTES, FILE_BYTES_MAX, &file_bytes);
    if (status != UPB_OK)
        return status;
    if (file_bytes != r->size)
        return upb_fail(r->error, UPB_E_TRUNCATED, "file_bytes", 8, r->size, file_bytes);
    *crc = upb_u32_at(r, r->size - CRC_BYTES);
    uint32_t computed = upb_crc32(0, r->bytes, r->size - CRC_BYTES);
    if (*crc != computed)
        return upb_fail(r->error, UPB_E_CRC, "crc32", r->size - CRC_BYTES, *crc, computed);
    for (size_t at = 16; at < HEADER_BYTES; at++)
        if (r->bytes[at])
            return upb_bad_value(r, "reserved", at, r->bytes[at], 0);
    return upb_ranged(r, "sections", 12, 1, SECTIONS_MAX, sections);
}

static upb_status bad_section(const upb_reader *r, uint32_t tag, size_t at, uint64_t got, uint64_t expected) {
    const char text[5] = {(char)(tag & 255), (char)(tag >> 8 & 255), (char)(tag >> 16 & 255), (char)(tag >> 24), 0};
    return upb_fail(r->error, UPB_E_SECTION, text, at, got, expected);
}

/* Checks one entry of the section table at `at`; `end` is where the section before it (or the table) ends. */
static upb_status read_entry(const upb_reader *r, size_t at, size_t end, upb_section *entry) {
    const size_t limit = r->size - CRC_BYTES;
    entry->tag = upb_u32_at(r, at);
    entry->flags = upb_u32_at(r, at + 4);
    entry->offset = upb_u32_at(r, at + 8);
    entry->bytes = upb_u32_at(r, at + 12);
    for (size_t i = 0; i < 4; i++)
        if (r->bytes[at + i] < 0x20 || r->bytes[at + i] > 0x7e)
            return upb_bad_value(r, "tag", at + i, r->bytes[at + i], 0x20);
    if (entry->flags & ~SECTION_REQUIRED)
        return upb_bad_value(r, "flags", at + 4, entry->flags, SECTION_REQUIRED);
    if (entry->offset % 8)
        return bad_section(r, entry->tag, at + 8, entry->offset, entry->offset / 8 * 8);
    if (entry->offset < end)
        return bad_section(r, entry->tag, at + 8, entry->offset, end);
    if (entry->offset > limit || entry->bytes > limit - entry->offset)
        return bad_section(r, entry->tag, at + 12, (uint64_t)entry->offset + entry->bytes, limit);
    for (size_t i = end; i < entry->offset; i++)
        if (r->bytes[i])
            return upb_bad_value(r, "gap", i, r->bytes[i], 0);
    return UPB_OK;
}

/* Reads the section table into `entries` (SECTIONS_MAX). */
static upb_status read_table(const upb_reader *r, uint32_t sections, upb_section *entries) {
    size_t end = HEADER_BYTES + (size_t)sections * ENTRY_BYTES;
    if (end > r->size - CRC_BYTES)
        return upb_fail(r->error, UPB_E_SECTION, "section table", 12, end, r->size - CRC_BYTES);
    for (uint32_t i = 0; i < sections; i++) {
        const size_t at = HEADER_BYTES + (size_t)i * ENTRY_BYTES;
        upb_status status = read_entry(r, at, end, &entries[i]);
        if (status != UPB_OK)
            return status;
        for (uint32_t j = 0; j < i; j++)
            if (entries[j].tag == entries[i].tag) /* twice: expected is where the first stands */
                return bad_section(r, entries[i].tag, at, at, HEADER_BYTES + (uint64_t)j * ENTRY_BYTES);
        end = (size_t)entries[i].offset + entries[i].bytes;
    }
    for (; end < r->size - CRC_BYTES; end++)
        if (r->bytes[end])
            return upb_bad_value(r, "gap", end, r->bytes[end], 0);
    return UPB_OK;
}

/* ------------------------------------------------------------------------------------------------ SENS */

static upb_status read_name(const upb_reader *r, size_t at, char name[32]) {
    int ended = 0;
    for (unsigned i = 0; i < 32; i++) {
        uint8_t c = r->bytes[at + i];
        int bad = ended ? c != 0 : c != 0 && (c < 0x20 || c > 0x7e);
        if (bad || (i == 31 && c))
            return upb_bad_element(r, "SENS.name", i, at + i, c, 0);
        ended = c == 0;
        name[i] = (char)c;
    }
    return UPB_OK;
}

static upb_status read_rules(const upb_reader *r, size_t at, upb_model_info *info) {
    const uint8_t *rule = r->bytes + at;
    if (rule[0] > UPB_EDGE_SEAM)
        return upb_bad_value(r, "SENS.edge", at, rule[0], UPB_EDGE_SEAM);
    if (rule[1] > UPB_LAST_ROW_EMPTY)
        return upb_bad_value(r, "SENS.last_row", at + 1, rule[1], UPB_LAST_ROW_EMPTY);
    if (rule[2] > UPB_EMPTY_FILL)
        return upb_bad_value(r, "SENS.empty_rule", at + 2, rule[2], UPB_EMPTY_FILL);
    for (unsigned i = 3; i < 8; i++)
        if (rule[i])
            return upb_bad_element(r, "SENS.reserved", i - 3, at + i, rule[i], 0);
    info->edge = rule[0];
    info->last_row = rule[1];
    info->empty_rule = rule[2];
    return UPB_OK;
}

/* `count` values within +-limit. */
static upb_status read_signed(const upb_reader *r, const char *what, size_t at, unsigned count, int32_t limit,
                              int32_t *values) {
    for (unsigned i = 0; i < count; i++) {
        const int64_t value = values[i] = upb_i32_at(r, at + 4 * i);
        if (value < -limit || value > limit)
            return upb_bad_element(r, what, i, at + 4 * i, (uint64_t)value,
                                   (uint64_t)(int64_t)(value < 0 ? -limit : limit));
    }
    return UPB_OK;
}

static upb_status read_geometry(const upb_reader *r, size_t at, upb_model_info *info) {
    const int32_t *elevation = info->row_elevation_udeg;
    const size_t offsets_at = at + UPB_ROWS * 4, heights_at = offsets_at + UPB_BEAMS * 4;
    upb_status status = read_signed(r, "SENS.elevation", at, UPB_ROWS, 90000000, info->row_elevation_udeg);
    for (unsigned row = 1; row < UPB_ROWS && status == UPB_OK; row++)
        if (elevation[row] >= elevation[row - 1])
            status = upb_bad_element(r, "SENS.elevation", row, at + 4 * row, (uint64_t)(int64_t)elevation[row],
                                     (uint64_t)((int64_t)elevation[row - 1] - 1));
    if (status == UPB_OK)
        status = read_signed(r, "SENS.azimuth_offset", offsets_at, UPB_BEAMS, 45000000, info->azimuth_offset_udeg);
    if (status == UPB_OK)
        status = read_signed(r, "SENS.row_height", heights_at, UPB_ROWS, 10000000, info->row_height_um);
    return status;
}

static upb_status read_row_limits(const upb_reader *r, size_t at, upb_model_info *info) {
    for (unsigned row = 0; row < UPB_ROWS; row++) {
        const uint32_t most = upb_u16_at(r, at + 2 * row);
        if (most < info->min_count || most > info->max_count)
            return upb_bad_element(r, "SENS.row_max_count", row, at + 2 * row, most,
                                   most < info->min_count ? info->min_count : info->max_count);
        info->row_max_count[row] = (uint16_t)most;
    }
    return UPB_OK;
}

static upb_status read_sensor(const upb_reader *r, const upb_section *s, upb_model_info *info) {
    const size_t at = s->offset;
    uint32_t beams;
    upb_status status;
    if (s->bytes != SENS_BYTES)
        return upb_bad_value(r, "SENS.bytes", at, s->bytes, SENS_BYTES);
    if ((status = read_name(r, at, info->sensor)) != UPB_OK ||
        (status = upb_ranged(r, "SENS.beams", at + 32, UPB_BEAMS, UPB_BEAMS, &beams)) != UPB_OK ||
        (status = upb_ranged(r, "SENS.columns", at + 36, 4, UPB_MAX_COLUMNS, &info->columns)) != UPB_OK ||
        (status = upb_ranged(r, "SENS.distance_unit_um", at + 40, 100, 100000, &info->distance_unit_um)) != UPB_OK ||
        (status = upb_ranged(r, "SENS.cut_mdeg", at + 44, 0, 359999, &info->cut_mdeg)) != UPB_OK ||
        (status = upb_ranged(r, "SENS.max_count", at + 52, 1, 65535, &info->max_count)) != UPB_OK ||
        (status = upb_ranged(r, "SENS.min_count", at + 48, 1, info->max_count, &info->min_count)) != UPB_OK ||
        (status = read_rules(r, at + 56, info)) != UPB_OK)
        return status;
    if ((status = read_geometry(r, at + 64, info)) != UPB_OK)
        return status;
    return read_row_limits(r, at + 704, info);
}

/* ------------------------------------------------------------------------------------------------ NETW */

/* A finite float of magnitude at most 1e6. `network` and the field's name make the report. */
static upb_status read_float(const upb_reader *r, unsigned network, const char *field, size_t at, float *value) {
    uint32_t bits = upb_u32_at(r, at);
    memcpy(value, &bits, sizeof *value);
    if (*value >= -MAGNITUDE_MAX && *value <= MAGNITUDE_MAX) /* false for NaN too */
        return UPB_OK;
    char text[32] = "NETW";
    upb_append_index(text, network);
    strncat(text, field, 12);
    return upb_bad_value(r, text, at, bits, (uint64_t)MAGNITUDE_MAX);
}

static upb_status read_head(const upb_reader *r, unsigned network, size_t at, upb_network_f32 *net) {
    static const char hidden_name[2][16] = {"NETW[0].hidden", "NETW[1].hidden"};
    static const char flags_name[2][16] = {"NETW[0].flags", "NETW[1].flags"};
    static const char skip_name[2][16] = {"NETW[0].skip", "NETW[1].skip"};
    static const char slope_name[2][16] = {"NETW[0].slope", "NETW[1].slope"};
    upb_status status;
    if ((status = upb_ranged(r, hidden_name[network], at, 1, UPB_MAX_HIDDEN, &net->hidden)) != UPB_OK ||
        (status = upb_ranged(r, flags_name[network], at + 4, 0, NETWORK_POSITIVE, &net->positive)) != UPB_OK ||
        (status = read_float(r, network, ".slope", at + 8, &net->slope)) != UPB_OK)
        return status;
    if (!(net->slope >= 0.0f && net->slope <= 1.0f))
        return upb_bad_value(r, slope_name[network], at + 8, upb_u32_at(r, at + 8), 1);
    if ((status = read_float(r, network, ".skip", at + 12, &net->skip)) != UPB_OK)
        return status;
    if (net->skip != 0.0f && net->skip != 1.0f)
        return upb_bad_value(r, skip_name[network], at + 12, upb_u32_at(r, at + 12), 1);
    return UPB_OK;
}

/* Reads the network at `*at`, which ends before `end`, and moves `*at` behind it. */
static upb_status read_network(const upb_reader *r, unsigned network, size_t *at, size_t end, upb_network_f32 *net) {
    if (end - *at < NETWORK_HEAD_BYTES)
        return upb_bad_value(r, "NETW.bytes", *at, end - *at, NETWORK_HEAD_BYTES);
    upb_status status = read_head(r, network, *at, net);
    if (status != UPB_OK)
        return status;
    const size_t hidden = net->hidden, a = *at + NETWORK_HEAD_BYTES;
    const size_t b = a + hidden * UPB_TAPS * 4, v = b + hidden * 4, c = v + hidden * 4;
    if (end - a < hidden * UNIT_NUMBERS * 4 + 4)
        return upb_bad_value(r, "NETW.bytes", a, end - a, hidden * UNIT_NUMBERS * 4 + 4);
    for (size_t h = 0; h < hidden; h++) {
        for (size_t i = 0; i < UPB_TAPS; i++)
            if ((status = read_float(r, network, ".A", a + (h * UPB_TAPS + i) * 4, &net->unit[h][i])) != UPB_OK)
                return status;
        if ((status = read_float(r, network, ".b", b + h * 4, &net->unit[h][UPB_UNIT_BIAS])) != UPB_OK ||
            (status = read_float(r, network, ".v", v + h * 4, &net->unit[h][UPB_UNIT_OUTPUT])) != UPB_OK)
            return status;
    }
    *at = c + 4;
    return read_float(r, network, ".c", c, &net->offset);
}

/*
 * From the file's network to the kernels' (upb_kernels.h): `unit` is the size of a count in what the file's network
 * sees and gives. A network on pixels x is one on differences x - min whose weight of the minimum is the sum of all.
 */
static void fold(upb_network_f32 *net, double unit) {
    for (uint32_t h = 0; h < net->hidden; h++) {
        double sum = 0;
        for (int i = 0; i < UPB_TAPS; i++) {
            sum += (double)net->unit[h][i];
            net->unit[h][i] = (float)((i == UPB_TAP_MINIMUM ? sum : (double)net->unit[h][i]) * unit);
        }
        net->unit[h][UPB_UNIT_OUTPUT] = (float)((double)net->unit[h][UPB_UNIT_OUTPUT] / unit);
    }
    net->offset = (float)((double)net->offset / unit);
}

static upb_status read_networks(const upb_reader *r, const upb_section *s, upb_model *model) {
    size_t at = s->offset;
    const size_t end = at + s->bytes;
    uint32_t count;
    if (s->bytes < COUNT_BYTES)
        return upb_bad_value(r, "NETW.bytes", at, s->bytes, COUNT_BYTES);
    upb_status status = upb_ranged(r, "NETW.count", at, 2, 2, &count);
    at += COUNT_BYTES;
    for (unsigned n = 0; n < 2 && status == UPB_OK; n++)
        status = read_network(r, n, &at, end, &model->f32.network[n]);
    if (status != UPB_OK)
        return status;
    if (at != end)
        return upb_bad_value(r, "NETW.bytes", s->offset, s->bytes, at - s->offset);
    fold(&model->f32.network[UPB_DISTANCE], model->info.distance_unit_um * 1e-6);
    fold(&model->f32.network[UPB_INTENSITY], 1);
    return UPB_OK;
}

/* ------------------------------------------------------------------------------------------------ file */

/* The sections that this reader knows; null: not in the file. */
typedef struct known_sections {
    const upb_section *sensor, *networks, *integer[UPB_PRECISIONS], *signature;
} known_sections;

/* Finds what this reader knows; refuses required sections that it does not know. */
static upb_status find_sections(const upb_reader *r, uint32_t sections, const upb_section *entries,
                                known_sections *known) {
    const struct {
        uint32_t tag;
        const upb_section **place;
    } tags[] = {{UPB_TAG('S', 'E', 'N', 'S'), &known->sensor},
                {UPB_TAG('N', 'E', 'T', 'W'), &known->networks},
                {UPB_TAG('Q', '1', '6', ' '), &known->integer[UPB_PRECISION_INT16]},
                {UPB_TAG('Q', '8', ' ', ' '), &known->integer[UPB_PRECISION_INT8]},
                {UPB_TAG('S', 'I', 'G', 'N'), &known->signature}};
    const size_t count = sizeof tags / sizeof tags[0];
    memset(known, 0, sizeof *known);
    for (uint32_t i = 0; i < sections; i++) {
        size_t k = 0;
        while (k < count && tags[k].tag != entries[i].tag)
            k++;
        if (k < count)
            *tags[k].place = &entries[i];
        else if (entries[i].flags & SECTION_REQUIRED)
            return bad_section(r, entries[i].tag, HEADER_BYTES + (size_t)i * ENTRY_BYTES, entries[i].flags, 0);
    }
    for (size_t k = 0; k < 2; k++)
        if (!*tags[k].place)
            return bad_section(r, tags[k].tag, 0, 0, 1);
    const upb_section *signature = known->signature, *last = &entries[sections - 1];
    if (signature && signature != last) /* what comes behind it would not be signed */
        return bad_section(r, signature->tag, HEADER_BYTES, signature->offset, last->offset);
    if (signature && signature->bytes > UPB_SIGNATURE_BYTES_MAX)
        return upb_bad_value(r, "SIGN.bytes", signature->offset, signature->bytes, UPB_SIGNATURE_BYTES_MAX);
    return UPB_OK;
}

/* Asks the caller about the signature. */
static upb_status verify_signature(const upb_reader *r, const upb_section *signature, upb_verify_fn verify,
                                   void *user) {
    const size_t end = signature ? signature->offset : r->size - CRC_BYTES;
    const size_t bytes = signature ? signature->bytes : 0;
    if (!verify || verify(user, r->bytes, end, r->bytes + end, bytes))
        return UPB_OK;
    return upb_fail(r->error, UPB_E_SIGNATURE, "SIGN", end, bytes, 0);
}

/* The rules, as the kernels of each number type want them. */
static void set_limits(upb_model *model) {
    const upb_model_info *info = &model->info;
    model->f32.min_count = (float)info->min_count;
    model->f32.fill = info->empty_rule == UPB_EMPTY_FILL;
    for (unsigned k = 0; k < UPB_LANES; k++) {
        model->f32.seen_max[k] = (float)info->row_max_count[2 * k];
        model->f32.given_max[k] = (float)info->row_max_count[2 * k + 1];
    }
    for (unsigned p = 0; p < UPB_PRECISIONS - 1; p++) {
        upb_model_int *to = &model->integer[p];
        to->min_count = (uint16_t)info->min_count;
        to->fill = info->empty_rule == UPB_EMPTY_FILL;
        for (unsigned k = 0; k < UPB_LANES; k++) {
            to->seen_max[k] = info->row_max_count[2 * k];
            to->given_max[k] = info->row_max_count[2 * k + 1];
        }
    }
}

/* Reads the sections. `model` is zeroed. */
static upb_status read_sections(const upb_reader *r, const known_sections *known, upb_model *model) {
    upb_model_info *info = &model->info;
    upb_status status = read_sensor(r, known->sensor, info);
    if (status == UPB_OK)
        status = read_networks(r, known->networks, model);
    for (uint32_t p = UPB_PRECISION_INT16; p < UPB_PRECISIONS && status == UPB_OK; p++)
        if (known->integer[p])
            status = upb_read_integer(r, known->integer[p], (upb_precision)p, model);
    if (status != UPB_OK)
        return status;
    for (int n = 0; n < 2; n++)
        info->hidden[n] = model->f32.network[n].hidden;
    info->precisions |= 1u << UPB_PRECISION_FP32;
    info->weight_bytes[UPB_PRECISION_FP32] = known->networks->bytes - COUNT_BYTES;
    info->file_bytes = (uint32_t)r->size;
    info->signature_bytes = known->signature ? known->signature->bytes : 0;
    set_limits(model);
    return UPB_OK;
}

static upb_status read_file(const upb_reader *r, upb_verify_fn verify, void *user, upb_model *model) {
    upb_section entries[SECTIONS_MAX];
    known_sections known;
    uint32_t sections = 0;
    upb_status status;
    if ((status = read_header(r, &sections, &model->info.crc32)) != UPB_OK ||
        (status = read_table(r, sections, entries)) != UPB_OK ||
        (status = find_sections(r, sections, entries, &known)) != UPB_OK ||
        (status = verify_signature(r, known.signature, verify, user)) != UPB_OK)
        return status;
    return read_sections(r, &known, model);
}

size_t upb_model_bytes(void) {
    _Static_assert(sizeof(upb_model) <= UPB_MODEL_BYTES_MAX, "raise UPB_MODEL_BYTES_MAX");
    return sizeof(upb_model);
}

upb_status upb_model_load_verified(void *memory, size_t memory_bytes, const void *ubm, size_t ubm_bytes,
                                   upb_verify_fn verify, void *user, upb_model **model, upb_error *error) {
    if (model)
        *model = NULL;
    if (!model || !ubm)
        return upb_fail(error, UPB_E_ARGUMENT, model ? "ubm" : "model", 0, 0, 0);
    upb_status status = upb_check_memory(memory, memory_bytes, sizeof(upb_model), error);
    if (status != UPB_OK)
        return status;
    const upb_reader r = {ubm, ubm_bytes, error};
    upb_model *loaded = memory;
    memset(loaded, 0, sizeof *loaded);
    status = read_file(&r, verify, user, loaded);
    if (status == UPB_OK)
        *model = loaded;
    return status;
}

upb_status upb_model_load(void *memory, size_t memory_bytes, const void *ubm, size_t ubm_bytes, upb_model **model,
                          upb_error *error) {
    return upb_model_load_verified(memory, memory_bytes, ubm, ubm_bytes, NULL, NULL, model, error);
}

upb_status upb_model_get_info(const upb_model *model, upb_model_info *info) {
    if (!model || !info)
        return UPB_E_ARGUMENT;
    *info = model->info;
    return UPB_OK;
}
