/*
 * The model loader: good files, damaged ones, impossible ones. Options: --seed N, --count N (files of the mutation
 * loop). Run it under the sanitizers too: a file is copied to a heap block of exactly its size before it is read.
 */
#include <math.h>

#include "check.h"
#include "ubm_writer.h"
#include "upb_internal.h"
#include "upb_network_int.h"

static _Alignas(UPB_ALIGN) unsigned char memory[UPB_MODEL_BYTES_MAX];

/* Loads a file from a block that ends where it ends, and at an odd address. */
static upb_status load(const uint8_t *file, size_t size, upb_model **model, upb_error *error) {
    uint8_t *block = malloc(size + 1);
    if (!block)
        exit(2);
    memcpy(block + 1, file, size);
    const upb_status status = upb_model_load(memory, sizeof memory, block + 1, size, model, error);
    free(block);
    CHECK((status == UPB_OK) == (*model != NULL));
    if (status != UPB_OK) {
        CHECK_EQUAL(error->status, status);
        CHECK(error->what[0] != 0 && memchr(error->what, 0, sizeof error->what) != NULL);
    }
    return status;
}

static void expect_error(const uint8_t *file, size_t size, upb_status status, const char *what) {
    upb_model *model;
    upb_error error;
    const upb_status got = load(file, size, &model, &error);
    if (!CHECK_EQUAL(got, status) || (got != UPB_OK && !CHECK(strcmp(error.what, what) == 0)))
        fprintf(stderr, "    expected status %d (%s), got %d (%s)\n", status, what, got, got ? error.what : "loaded");
}

/* -------------------------------------------------------------------------------------------- good files */

static int32_t slow_offset(int32_t offset_udeg, uint32_t columns) {
    return (int32_t)floor((double)offset_udeg * columns / 360e6 + 0.5);
}

static void test_offsets(random_source *random) {
    CHECK_EQUAL(upb_offset_columns(0, 2048), 0);
    CHECK(upb_offset_columns(-4200000, 904) == -11 && upb_offset_columns(4200000, 904) == 11);
    CHECK(upb_offset_columns(500000, 360) == 1 && upb_offset_columns(-500000, 360) == 0); /* halves go up */
    for (int i = 0; i < 10000; i++) {
        const int32_t offset = (int32_t)random_below(random, 90000001) - 45000000;
        const uint32_t columns = 4 + random_below(random, 65532);
        CHECK(upb_offset_columns(offset, columns) == slow_offset(offset, columns));
    }
}

static void test_info(random_source *random) {
    static uint8_t file[UBM_MAX];
    test_model m = random_model(random, 904, 7);
    m.unit_um = 4000;
    m.network[1].hidden = 3;
    m.offset[5] = -4200000;
    const size_t size = write_ubm(file, &m, NULL, 0);
    upb_model *model;
    upb_error error;
    upb_model_info info;
    if (!CHECK_EQUAL(load(file, size, &model, &error), UPB_OK))
        return;
    CHECK_EQUAL(upb_model_get_info(model, &info), UPB_OK);
    CHECK(strcmp(info.sensor, "test-32") == 0);
    CHECK_EQUAL(info.columns, 904);
    CHECK_EQUAL(info.distance_unit_um, 4000);
    CHECK_EQUAL(info.cut_mdeg, 180000);
    CHECK_EQUAL(info.min_count, 1500);
    CHECK_EQUAL(info.max_count, 40000);
    CHECK_EQUAL(info.edge, UPB_EDGE_SEAM);
    CHECK_EQUAL(info.last_row, UPB_LAST_ROW_EMPTY);
    CHECK_EQUAL(info.empty_rule, UPB_EMPTY_FILL);
    CHECK_EQUAL(info.hidden[0], 7);
    CHECK_EQUAL(info.hidden[1], 3);
    CHECK_EQUAL(info.crc32, plain_crc32(file, size - 4));
    CHECK_EQUAL(info.file_bytes, size);
    CHECK_EQUAL(info.precisions, 1u << UPB_PRECISION_FP32);
    CHECK_EQUAL(info.weight_bytes[UPB_PRECISION_FP32], 4 * (2 * (4 + 1) + (7 + 3) * 9));
    CHECK(info.weight_bytes[UPB_PRECISION_INT16] == 0 && info.weight_bytes[UPB_PRECISION_INT8] == 0);
    CHECK_EQUAL(info.signature_bytes, 0);
    CHECK(memcmp(info.row_elevation_udeg, m.elevation, sizeof m.elevation) == 0);
    CHECK(memcmp(info.azimuth_offset_udeg, m.offset, sizeof m.offset) == 0);
    CHECK(memcmp(info.row_height_um, m.height, sizeof m.height) == 0);
    CHECK_EQUAL(upb_model_get_info(model, NULL), UPB_E_ARGUMENT);
    CHECK_EQUAL(upb_model_get_info(NULL, &info), UPB_E_ARGUMENT);
}

/* What the kernels are given is the file's network: differences, counts. */
static void test_folding(random_source *random) {
    static uint8_t file[UBM_MAX];
    const test_model m = random_model(random, 1024, 32);
    const size_t size = write_ubm(file, &m, NULL, 0);
    upb_model *model;
    upb_error error;
    if (!CHECK_EQUAL(load(file, size, &model, &error), UPB_OK))
        return;
    for (int n = 0; n < 2; n++) {
        const double unit = n == UPB_DISTANCE ? 0.002 : 1.0;
        const test_network *from = &m.network[n];
        const upb_network_f32 *to = &model->f32.network[n];
        for (uint32_t h = 0; h < from->hidden; h++) {
            double sum = 0;
            for (int i = 0; i < 7; i++)
                sum += (double)from->a[h][i];
            for (int i = 0; i < 6; i++)
                CHECK(fabs((double)to->unit[h][i] - (double)from->a[h][i] * unit) <= 1e-7 * unit);
            CHECK(fabs((double)to->unit[h][6] - sum * unit) <= 1e-6 * unit);
            CHECK(to->unit[h][UPB_UNIT_BIAS] == from->b[h]);
            CHECK(fabs((double)to->unit[h][UPB_UNIT_OUTPUT] * unit - (double)from->v[h]) <= 1e-7);
        }
        CHECK(to->skip == from->skip && to->slope == from->slope && to->positive == from->flags);
        CHECK(fabs((double)to->offset * unit - (double)from->c) <= 1e-6);
    }
}

/* What the kernels are given is the file's network, finished. */
static void compare_integer(const test_integer *from, const upb_network_int *loaded, upb_precision precision) {
    upb_network_int net;
    memset(&net, 0, sizeof net);
    net.hidden = from->hidden;
    net.skip = from->skip;
    net.slope = (int32_t)from->slope;
    net.k = from->k, net.j = from->j, net.t = from->t;
    net.offset = from->c;
    for (uint32_t h = 0; h < from->hidden; h++) {
        net.bias[h] = from->b[h];
        net.output[h] = from->v[h];
        memcpy(net.weight[h], from->w[h], sizeof from->w[h]);
        net.weight[h][UPB_TAP_MINIMUM] = from->m[h];
    }
    upb_network_int_finish(&net, precision);
    CHECK(memcmp(&net, loaded, sizeof net) == 0);
}

static void test_integers(random_source *random) {
    static uint8_t file[UBM_MAX];
    for (uint32_t hidden = 1; hidden <= UPB_MAX_HIDDEN; hidden++) {
        test_model m = random_model(random, 1024, 12);
        add_integers(random, &m, hidden);
        m.integer[UPB_PRECISION_INT8][1].hidden = 1;
        const size_t size = write_ubm(file, &m, NULL, 0);
        const uint32_t narrow = 28 + 13 * hidden;
        upb_model *model;
        upb_error error;
        if (!CHECK_EQUAL(load(file, size, &model, &error), UPB_OK))
            return;
        for (int p = 0; p < 2; p++)
            for (int n = 0; n < 2; n++)
                compare_integer(&m.integer[p + 1][n], &model->integer[p].network[n], (upb_precision)(p + 1));
        CHECK_EQUAL(model->info.precisions, 7);
        CHECK_EQUAL(model->info.weight_bytes[UPB_PRECISION_INT16], 2 * (28 + 20 * hidden));
        CHECK_EQUAL(model->info.weight_bytes[UPB_PRECISION_INT8], (narrow + 3) / 4 * 4 + 44);
        CHECK(memcmp(model->integer[0].seen_max, model->integer[1].seen_max, sizeof model->integer[0].seen_max) == 0);
        for (unsigned k = 0; k < UPB_LANES; k++) {
            CHECK_EQUAL(model->integer[0].seen_max[k], m.row_max[2 * k]);
            CHECK_EQUAL(model->integer[0].given_max[k], m.row_max[2 * k + 1]);
        }
        CHECK(model->integer[1].min_count == 1500 && model->integer[1].fill == 1);
    }
}

static void test_memory(random_source *random) {
    static uint8_t file[UBM_MAX];
    const test_model m = random_model(random, 1024, 12);
    const size_t size = write_ubm(file, &m, NULL, 0);
    upb_model *model;
    upb_error error;
    CHECK_EQUAL(upb_model_load(memory + 1, sizeof memory - 1, file, size, &model, &error), UPB_E_ALIGN);
    CHECK_EQUAL(upb_model_load(memory, upb_model_bytes() - 1, file, size, &model, &error), UPB_E_SIZE);
    CHECK_EQUAL(error.expected, upb_model_bytes());
    CHECK_EQUAL(upb_model_load(NULL, sizeof memory, file, size, &model, &error), UPB_E_ARGUMENT);
    CHECK_EQUAL(upb_model_load(memory, sizeof memory, NULL, size, &model, &error), UPB_E_ARGUMENT);
    CHECK_EQUAL(upb_model_load(memory, sizeof memory, file, size, NULL, &error), UPB_E_ARGUMENT);
    CHECK_EQUAL(upb_model_load(memory, upb_model_bytes(), file, size, &model, NULL), UPB_OK);
    CHECK_EQUAL(upb_model_load(memory, sizeof memory, file, 0, &model, NULL), UPB_E_TRUNCATED);
}

/* ----------------------------------------------------------------------------------------- damaged files */

static void test_truncation(const uint8_t *file, size_t size) {
    upb_model *model;
    upb_error error;
    for (size_t length = 0; length < size; length++)
        CHECK_EQUAL(load(file, length, &model, &error), UPB_E_TRUNCATED);
    uint8_t longer[UBM_MAX + 1];
    memcpy(longer, file, size);
    longer[size] = 0;
    CHECK_EQUAL(load(longer, size + 1, &model, &error), UPB_E_TRUNCATED);
}

static void test_flipped_bits(uint8_t *file, size_t size) {
    upb_model *model;
    upb_error error;
    for (size_t bit = 0; bit < 8 * size; bit++) {
        file[bit / 8] ^= (uint8_t)(1u << bit % 8);
        CHECK(load(file, size, &model, &error) != UPB_OK);
        if (bit >= 8 * 12)
            CHECK_EQUAL(error.status, UPB_E_CRC);
        file[bit / 8] ^= (uint8_t)(1u << bit % 8);
    }
}

/* Limits that hold for whatever was loaded: the kernels count on them. */
static void check_invariants(const upb_model *model) {
    for (int n = 0; n < 2; n++) {
        const upb_network_f32 *net = &model->f32.network[n];
        CHECK(net->hidden >= 1 && net->hidden <= UPB_MAX_HIDDEN);
        CHECK(net->slope >= 0 && net->slope <= 1);
        CHECK(isfinite(net->skip) && isfinite(net->offset));
        int bounded = 1;
        for (uint32_t h = 0; h < UPB_MAX_HIDDEN; h++)
            for (int i = 0; i < UPB_UNIT_FLOATS; i++)
                bounded &= fabsf(net->unit[h][i]) <= 1e11f; /* false for NaN */
        CHECK(bounded);
    }
    for (uint32_t p = UPB_PRECISION_INT16; p <= UPB_PRECISION_INT8; p++)
        for (int n = 0; n < 2 && upb_model_has(model, p); n++) {
            const upb_network_int *net = &upb_model_integer(model, p)->network[n];
            CHECK(net->hidden >= 2 && net->hidden <= UPB_MAX_HIDDEN && net->hidden % 2 == 0);
            CHECK(net->k <= 16 && net->j <= 16 && net->t <= 24 && net->skip <= 1);
            CHECK(net->slope >= 0 && net->slope <= 32767);
        }
    CHECK(model->info.columns >= 4 && model->info.columns <= UPB_MAX_COLUMNS);
    CHECK(model->info.min_count >= 1 && model->info.min_count <= model->info.max_count);
    CHECK(model->info.max_count <= 65535 && memchr(model->info.sensor, 0, 32) != NULL);
}

/* Every byte, every value, checksum made right again: loads, or a clean error. */
static void test_every_byte(uint8_t *file, size_t size) {
    upb_model *model;
    upb_error error;
    unsigned long loaded = 0;
    for (size_t at = 0; at < size - 4; at++) {
        const uint8_t old = file[at];
        for (unsigned step = 1; step < 256; step += at < 600 ? 1 : 17) {
            file[at] = (uint8_t)(old + step);
            seal(file, size);
            if (load(file, size, &model, &error) == UPB_OK) {
                loaded++;
                check_invariants(model);
            }
        }
        file[at] = old;
    }
    seal(file, size);
    CHECK(loaded > 1000);
    expect_error(file, size, UPB_OK, "");
}

static void test_mutations(random_source *random, const uint8_t *file, size_t size, unsigned long count) {
    static uint8_t mutant[UBM_MAX];
    unsigned long loaded = 0;
    for (unsigned long i = 0; i < count; i++) {
        upb_model *model;
        upb_error error;
        const size_t length = random_below(random, 8) ? size : 40 + random_below(random, (uint32_t)size - 40);
        memcpy(mutant, file, length);
        for (uint32_t changes = 1 + random_below(random, 4); changes; changes--) {
            /* half of them in the header and the table, where they hurt most */
            const uint32_t at = random_below(random, random_below(random, 2) ? 112 : (uint32_t)length - 4);
            const uint32_t kind = random_below(random, 3);
            if (at + 4 <= length)
                mutant[at] = (uint8_t)(kind == 0 ? random_u32(random) : kind == 1 ? 0xffu : mutant[at] + 8u);
        }
        if (random_below(random, 4)) {
            memcpy(mutant, file, 8); /* or most would end there */
            put_u32(mutant + 8, (uint32_t)length);
        }
        seal(mutant, length);
        if (load(mutant, length, &model, &error) == UPB_OK) {
            loaded++;
            check_invariants(model);
        }
    }
    printf("%lu mutated files, %lu of them loaded\n", count, loaded);
}

/* -------------------------------------------------------------------------------------- impossible files */

static void test_sections(const test_model *m) {
    static uint8_t file[UBM_MAX];
    upb_error error;
    upb_model *model;
    const test_section known[] = {{"PROV", 0, 13, '{'}, {"DENS", 0, 0, 0}, {"METR", 0, 40, ' '}};
    const test_section unknown = {"WXYZ", 0, 5, 0xff}, required = {"WXYZ", 1, 5, 0xff}, odd_flags = {"WXYZ", 2, 5, 0};
    const test_section bad_tag = {"W\x01YZ", 0, 5, 0}, twice[] = {{"PROV", 0, 8, 0}, {"PROV", 0, 8, 0}};
    const test_section many[31] = {{"A000", 0, 0, 0}};
    expect_error(file, write_ubm(file, m, known, 3), UPB_OK, "");
    expect_error(file, write_ubm(file, m, &unknown, 1), UPB_OK, "");
    expect_error(file, write_ubm(file, m, &required, 1), UPB_E_SECTION, "WXYZ");
    expect_error(file, write_ubm(file, m, &odd_flags, 1), UPB_E_VALUE, "flags");
    expect_error(file, write_ubm(file, m, &bad_tag, 1), UPB_E_VALUE, "tag");
    expect_error(file, write_ubm(file, m, twice, 2), UPB_E_SECTION, "PROV");
    expect_error(file, write_ubm(file, m, many, 31), UPB_E_VALUE, "sections");
    const test_section early = {"SIGN", 0, 5, 1};
    expect_error(file, write_ubm(file, m, &early, 1), UPB_E_SECTION, "SIGN");
    for (int missing = 0; missing < 2; missing++) {
        const size_t size = write_ubm(file, m, NULL, 0);
        put_u32(file + 32 + 16 * missing + 4, 0);
        memcpy(file + 32 + 16 * missing, "NONE", 4);
        seal(file, size);
        expect_error(file, size, UPB_E_SECTION, missing ? "NETW" : "SENS");
    }
    const size_t size = write_ubm(file, m, &required, 1);
    CHECK_EQUAL(load(file, size, &model, &error), UPB_E_SECTION);
    CHECK_EQUAL(error.offset, 32);
}

/* One u32 (or byte) of a valid file replaced, the checksum made right: the error and its name. */
typedef struct wrong_field {
    int at, bytes;
    uint32_t value;
    upb_status status;
    const char *what;
} wrong_field;

enum { SENS = 64, NETW = SENS + 832, NETW_1 = NETW + 4 + 16 + 12 * 36 + 4 };

static const wrong_field wrong_fields[] = {
    {0, 4, 0x4d425056, UPB_E_MAGIC, "magic"},
    {4, 2, 0, UPB_E_VERSION, "version"},
    {4, 2, 2, UPB_E_VERSION, "version"},
    {6, 2, 33, UPB_E_VALUE, "header_bytes"},
    {8, 4, 2000000, UPB_E_VALUE, "file_bytes"},
    {12, 4, 0, UPB_E_VALUE, "sections"},
    {12, 4, 33, UPB_E_VALUE, "sections"},
    {31, 1, 1, UPB_E_VALUE, "reserved"},
    {32 + 8, 4, SENS + 4, UPB_E_SECTION, "SENS"},    /* not a multiple of 8 */
    {32 + 8, 4, SENS - 8, UPB_E_SECTION, "SENS"},    /* in the table */
    {32 + 8, 4, 1 << 20, UPB_E_SECTION, "SENS"},     /* outside the file */
    {32 + 12, 4, 0xfffffff8, UPB_E_SECTION, "SENS"}, /* offset + bytes overflows */
    {48 + 8, 4, SENS + 824, UPB_E_SECTION, "NETW"},  /* overlaps */
    {48 + 12, 4, 0x7fffffff, UPB_E_SECTION, "NETW"},
    {32 + 12, 4, 824, UPB_E_VALUE, "gap"}, /* what is left over is not 0 */
    {SENS + 0, 1, 7, UPB_E_VALUE, "SENS.name[0]"},
    {SENS + 20, 1, 'x', UPB_E_VALUE, "SENS.name[20]"}, /* behind the end */
    {SENS + 32, 4, 31, UPB_E_VALUE, "SENS.beams"},
    {SENS + 36, 4, 3, UPB_E_VALUE, "SENS.columns"},
    {SENS + 36, 4, 65536, UPB_E_VALUE, "SENS.columns"},
    {SENS + 40, 4, 99, UPB_E_VALUE, "SENS.distance_unit_um"},
    {SENS + 40, 4, 100001, UPB_E_VALUE, "SENS.distance_unit_um"},
    {SENS + 44, 4, 360000, UPB_E_VALUE, "SENS.cut_mdeg"},
    {SENS + 48, 4, 0, UPB_E_VALUE, "SENS.min_count"},
    {SENS + 48, 4, 40001, UPB_E_VALUE, "SENS.min_count"},
    {SENS + 52, 4, 65536, UPB_E_VALUE, "SENS.max_count"},
    {SENS + 56, 1, 2, UPB_E_VALUE, "SENS.edge"},
    {SENS + 57, 1, 2, UPB_E_VALUE, "SENS.last_row"},
    {SENS + 58, 1, 2, UPB_E_VALUE, "SENS.empty_rule"},
    {SENS + 63, 1, 1, UPB_E_VALUE, "SENS.reserved[4]"},
    {SENS + 64, 4, 90000001, UPB_E_VALUE, "SENS.elevation[0]"},
    {SENS + 68, 4, 10000000, UPB_E_VALUE, "SENS.elevation[1]"}, /* as high as row 0 */
    {SENS + 316, 4, (uint32_t)-90000001, UPB_E_VALUE, "SENS.elevation[63]"},
    {SENS + 320, 4, 45000001, UPB_E_VALUE, "SENS.azimuth_offset[0]"},
    {SENS + 444, 4, (uint32_t)-45000001, UPB_E_VALUE, "SENS.azimuth_offset[31]"},
    {SENS + 448, 4, 10000001, UPB_E_VALUE, "SENS.row_height[0]"},
    {SENS + 700, 4, (uint32_t)-10000001, UPB_E_VALUE, "SENS.row_height[63]"},
    {SENS + 704, 2, 40001, UPB_E_VALUE, "SENS.row_max_count[0]"},
    {SENS + 830, 2, 1, UPB_E_VALUE, "SENS.row_max_count[63]"},
    {NETW, 4, 1, UPB_E_VALUE, "NETW.count"},
    {NETW + 4, 4, 0, UPB_E_VALUE, "NETW[0].hidden"},
    {NETW + 4, 4, 33, UPB_E_VALUE, "NETW[0].hidden"},
    {NETW_1, 4, 33, UPB_E_VALUE, "NETW[1].hidden"},
    {NETW_1, 4, 11, UPB_E_VALUE, "NETW.bytes"}, /* too long for its networks */
    {NETW_1, 4, 13, UPB_E_VALUE, "NETW.bytes"}, /* too short */
    {NETW + 8, 4, 2, UPB_E_VALUE, "NETW[0].flags"},
    {NETW + 12, 4, 0x3f800001, UPB_E_VALUE, "NETW[0].slope"},
    {NETW + 12, 4, 0xbf000000, UPB_E_VALUE, "NETW[0].slope"},
    {NETW + 16, 4, 0x7fc00000, UPB_E_VALUE, "NETW[0].skip"}, /* NaN */
    {NETW + 20, 4, 0x7f800000, UPB_E_VALUE, "NETW[0].A"},    /* infinity */
    {NETW + 20, 4, 0x49742401, UPB_E_VALUE, "NETW[0].A"},    /* just above 1e6 */
    {NETW + 20, 4, 0x49742400, UPB_OK, ""},                  /* 1e6 */
    {NETW + 20 + 12 * 28, 4, 0xff800000, UPB_E_VALUE, "NETW[0].b"},
    {NETW + 20 + 12 * 32, 4, 0x7f800001, UPB_E_VALUE, "NETW[0].v"},
    {NETW_1 - 4, 4, 0x50000000, UPB_E_VALUE, "NETW[0].c"},
};

/* `at` counts from `start`. */
static void check_wrong_fields(const uint8_t *file, size_t size, size_t start, const wrong_field *fields,
                               size_t count) {
    static uint8_t changed[UBM_MAX];
    for (size_t i = 0; i < count; i++) {
        const wrong_field *field = &fields[i];
        memcpy(changed, file, size);
        for (int byte = 0; byte < field->bytes; byte++)
            changed[start + (size_t)field->at + (size_t)byte] = (uint8_t)(field->value >> 8 * byte);
        seal(changed, size);
        expect_error(changed, size, field->status, field->what);
    }
}

static void test_wrong_fields(const test_model *m) {
    static uint8_t file[UBM_MAX];
    const size_t size = write_ubm(file, m, NULL, 0);
    check_wrong_fields(file, size, 0, wrong_fields, sizeof wrong_fields / sizeof wrong_fields[0]);
}

/* ------------------------------------------------------------------------------------- integer sections */

enum { Q_HEAD = 36, Q16_1 = Q_HEAD + 28 + 7 * 20, Q8_1 = Q_HEAD + 120 };

/* Seven hidden units: an int8 network has 119 bytes and one of padding. */
static const wrong_field wrong_16[] = {
    {0, 1, 'v', UPB_E_VALUE, "Q16.contract"},
    {14, 1, '2', UPB_E_VALUE, "Q16.contract"},
    {15, 1, '1', UPB_E_VALUE, "Q16.contract"},
    {31, 1, 1, UPB_E_VALUE, "Q16.contract"},
    {32, 4, 1, UPB_E_VALUE, "Q16.count"},
    {Q_HEAD, 4, 0, UPB_E_VALUE, "Q16.distance.hidden"},
    {Q_HEAD, 4, 33, UPB_E_VALUE, "Q16.distance.hidden"},
    {Q16_1, 4, 33, UPB_E_VALUE, "Q16.intensity.hidden"},
    {Q16_1, 4, 8, UPB_E_VALUE, "Q16.intensity.bytes"}, /* too short */
    {Q_HEAD + 4, 4, 2, UPB_E_VALUE, "Q16.distance.skip"},
    {Q_HEAD + 8, 4, 32768, UPB_E_VALUE, "Q16.distance.slope"},
    {Q_HEAD + 12, 4, 1, UPB_E_VALUE, "Q16.distance.k"}, /* 40000 << 1 */
    {Q_HEAD + 16, 4, 1, UPB_E_VALUE, "Q16.distance.j"},
    {Q_HEAD + 20, 4, 25, UPB_E_VALUE, "Q16.distance.t"},
    {Q16_1 + 12, 4, 9, UPB_E_VALUE, "Q16.intensity.k"}, /* 255 << 9 */
    {Q16_1 + 16, 4, 9, UPB_E_VALUE, "Q16.intensity.j"},
    {Q_HEAD + 28 + 5 * 4, 4, 0x7fffffff, UPB_E_VALUE, "Q16.distance.S[5]"},
    {Q16_1 + 28 + 6 * 4, 4, 0x80000000, UPB_E_VALUE, "Q16.intensity.S[6]"},
    {Q_HEAD + 24, 4, 0x7fffffff, UPB_E_VALUE, "Q16.distance.Y"},
    {Q16_1 + 24, 4, 0x80000000, UPB_E_VALUE, "Q16.intensity.Y"},
};

static const wrong_field wrong_8[] = {
    {10, 1, '1', UPB_E_VALUE, "Q8.contract"},
    {32, 4, 3, UPB_E_VALUE, "Q8.count"},
    {Q_HEAD + 119, 1, 1, UPB_E_VALUE, "Q8.distance.padding"},
    {Q8_1 + 119, 1, 0x80, UPB_E_VALUE, "Q8.intensity.padding"},
    {Q8_1 + 12, 4, 17, UPB_E_VALUE, "Q8.intensity.k"},
    {Q_HEAD + 12, 4, 9, UPB_E_VALUE, "Q8.distance.k"}, /* 40000 << (9 - 8) */
    {Q8_1 + 16, 4, 9, UPB_E_VALUE, "Q8.intensity.j"},
    {Q8_1, 4, 8, UPB_E_VALUE, "Q8.intensity.bytes"},
    {Q8_1 + 28, 4, 0x7fffffff, UPB_E_VALUE, "Q8.intensity.S[0]"},
    {Q_HEAD + 24, 4, 0x80000000, UPB_E_VALUE, "Q8.distance.Y"},
};

/* Where a section begins; `*entry` is its place in the table. */
static size_t find_section(const uint8_t *file, const char *tag, size_t *entry) {
    for (*entry = 32; memcmp(file + *entry, tag, 4) != 0; *entry += 16)
        if (!CHECK(*entry < 512))
            exit(2);
    return file[*entry + 8] | (size_t)file[*entry + 9] << 8;
}

static void test_wrong_integers(random_source *random) {
    static uint8_t file[UBM_MAX];
    test_model m = random_model(random, 1024, 12);
    size_t entry;
    add_integers(random, &m, 7);
    for (int p = 1; p <= 2; p++)
        for (int n = 0; n < 2; n++) /* a minimum that the sums of wrong biases cannot cancel */
            for (int h = 0; h < 7; h++)
                m.integer[p][n].m[h] = 1, m.integer[p][n].w[h][0] = -1;
    const size_t size = write_ubm(file, &m, NULL, 0);
    expect_error(file, size, UPB_OK, "");
    check_wrong_fields(file, size, find_section(file, "Q16 ", &entry), wrong_16, sizeof wrong_16 / sizeof wrong_16[0]);
    const wrong_field short_16 = {12, 4, 35, UPB_E_VALUE, "gap"}; /* what is left over is not 0 */
    check_wrong_fields(file, size, entry, &short_16, 1);
    check_wrong_fields(file, size, find_section(file, "Q8  ", &entry), wrong_8, sizeof wrong_8 / sizeof wrong_8[0]);
    const wrong_field longer = {12, 4, Q_HEAD + 2 * 120 + 4, UPB_E_VALUE, "Q8.intensity.bytes"};
    check_wrong_fields(file, size, entry, &longer, 1); /* as far as the gap behind it */
    const test_section empty = {"Q8  ", 0, 35, 0}, zeros = {"Q8  ", 0, 60, 0};
    m.precisions = 0;
    expect_error(file, write_ubm(file, &m, &empty, 1), UPB_E_VALUE, "Q8.bytes");
    expect_error(file, write_ubm(file, &m, &zeros, 1), UPB_E_VALUE, "Q8.contract");
}

/* One unit whose sum, or output, stands at the bound of the proof, and one beyond. */
static void expect_bound(test_model *m, upb_precision precision, int32_t *value, int32_t good, int step,
                         const char *what) {
    static uint8_t file[UBM_MAX];
    char name[32];
    const int32_t old = *value;
    m->precisions = 1u << precision;
    *value = good;
    expect_error(file, write_ubm(file, m, NULL, 0), UPB_OK, "");
    *value = good + step;
    snprintf(name, sizeof name, "%s.distance.%s", precision == UPB_PRECISION_INT8 ? "Q8" : "Q16", what);
    expect_error(file, write_ubm(file, m, NULL, 0), UPB_E_VALUE, name);
    *value = old;
}

static void test_bounds(random_source *random) {
    test_model m = random_model(random, 1024, 12); /* counts 1500 to 40000 */
    test_integer *net[UPB_PRECISIONS] = {NULL, &m.integer[UPB_PRECISION_INT16][0], &m.integer[UPB_PRECISION_INT8][0]};
    add_integers(random, &m, 2);
    for (upb_precision p = UPB_PRECISION_INT16; p <= UPB_PRECISION_INT8; p = (upb_precision)(p + 1)) {
        const int32_t top = INT32_MAX - 32768, most_filled = p == UPB_PRECISION_INT8 ? 38500 + 128 : 38500,
                      most = p == UPB_PRECISION_INT8 ? 40000 + 128 : 40000;
        memset(net[p], 0, sizeof *net[p]);
        net[p]->hidden = 2;
        net[p]->t = 3;
        expect_bound(&m, p, &net[p]->b[1], top, 1, "S[1]");
        m.empty_rule = UPB_EMPTY_FILL;
        net[p]->w[1][4] = 100;
        expect_bound(&m, p, &net[p]->b[1], top - 100 * most_filled, 1, "S[1]");
        m.empty_rule = UPB_EMPTY_NONE;
        expect_bound(&m, p, &net[p]->b[1], top - 100 * most, 1, "S[1]");
        net[p]->m[1] = -100; /* the minimum and the differences at their worst, independently */
        expect_bound(&m, p, &net[p]->b[1], INT32_MIN + 100 * 40000, -1, "S[1]");
        expect_bound(&m, p, &net[p]->b[1], top - 100 * most, 1, "S[1]");
        net[p]->w[1][4] = net[p]->m[1] = 0;
        expect_bound(&m, p, &net[p]->c, (1 << 30) - 1 - 4, 1, "Y");
        expect_bound(&m, p, &net[p]->c, -(1 << 30), -1, "Y");
        net[p]->b[0] = 1000 << 16;
        net[p]->v[0] = 100;
        expect_bound(&m, p, &net[p]->c, (1 << 30) - 1 - 4 - 100000, 1, "Y");
        net[p]->v[0] = -100;
        expect_bound(&m, p, &net[p]->c, 100000 - (1 << 30), -1, "Y");
        net[p]->b[0] = -(1000 << 16); /* half of it by the slope */
        net[p]->slope = 16384;
        expect_bound(&m, p, &net[p]->c, (1 << 30) - 1 - 4 - 50000, 1, "Y");
        m.empty_rule = UPB_EMPTY_FILL;
    }
}

/* ------------------------------------------------------------------------------------------- signatures */

typedef struct verifier {
    const uint8_t *file;
    size_t data_bytes, signature_bytes;
    int answer, calls;
} verifier;

static int verify(void *user, const void *data, size_t data_bytes, const void *signature, size_t signature_bytes) {
    verifier *v = user;
    v->calls++;
    CHECK(data == v->file && signature == v->file + data_bytes);
    CHECK_EQUAL(data_bytes, v->data_bytes);
    CHECK_EQUAL(signature_bytes, v->signature_bytes);
    for (size_t i = 0; i < signature_bytes; i++)
        CHECK_EQUAL(((const uint8_t *)signature)[i], 0x5a);
    return v->answer;
}

static void test_signature(random_source *random, uint32_t signed_with) {
    static uint8_t file[UBM_MAX];
    test_model m = random_model(random, 1024, 12);
    size_t entry;
    upb_model *model;
    upb_error error;
    add_integers(random, &m, 12);
    m.signed_with = signed_with;
    const size_t size = write_ubm(file, &m, NULL, 0);
    verifier v = {file, signed_with ? find_section(file, "SIGN", &entry) : size - 4, signed_with ? signed_with - 1 : 0,
                  1, 0};
    CHECK_EQUAL(upb_model_load_verified(memory, sizeof memory, file, size, verify, &v, &model, &error), UPB_OK);
    CHECK(model != NULL && v.calls == 1);
    CHECK_EQUAL(model->info.signature_bytes, v.signature_bytes);
    v.answer = 0;
    CHECK_EQUAL(upb_model_load_verified(memory, sizeof memory, file, size, verify, &v, &model, &error),
                UPB_E_SIGNATURE);
    CHECK(model == NULL && v.calls == 2 && strcmp(error.what, "SIGN") == 0);
    CHECK_EQUAL(error.got, v.signature_bytes);
    CHECK_EQUAL(upb_model_load_verified(memory, sizeof memory, file, size, NULL, &v, &model, &error), UPB_OK);
    CHECK_EQUAL(load(file, size, &model, &error), UPB_OK); /* nobody is asked */
    file[size - 1] ^= 1;                                   /* a damaged file is not shown to the verifier */
    CHECK_EQUAL(upb_model_load_verified(memory, sizeof memory, file, size, verify, &v, &model, &error), UPB_E_CRC);
    CHECK_EQUAL(v.calls, 2);
}

static void test_signatures(random_source *random) {
    static uint8_t file[UBM_MAX];
    test_model m = random_model(random, 1024, 12);
    test_signature(random, 0);
    test_signature(random, 1); /* an empty one */
    test_signature(random, 1 + 64);
    test_signature(random, 1 + UPB_SIGNATURE_BYTES_MAX);
    m.signed_with = 1 + UPB_SIGNATURE_BYTES_MAX + 1;
    expect_error(file, write_ubm(file, &m, NULL, 0), UPB_E_VALUE, "SIGN.bytes");
}

int main(int argc, char **argv) {
    static uint8_t file[UBM_MAX];
    const unsigned long seed = option_number(argc, argv, "--seed", 1);
    random_source random = random_seeded(seed);
    const test_model plain = random_model(&random, 2048, 12);
    test_model m = plain;
    add_integers(&random, &m, 5);
    m.signed_with = 1 + 20;
    const size_t size = write_ubm(file, &m, NULL, 0);
    printf("test_model --seed %lu\n", seed);
    test_offsets(&random);
    test_info(&random);
    test_folding(&random);
    test_integers(&random);
    test_memory(&random);
    test_truncation(file, size);
    test_flipped_bits(file, size);
    test_every_byte(file, size);
    test_sections(&plain);
    test_wrong_fields(&plain);
    test_wrong_integers(&random);
    test_bounds(&random);
    test_signatures(&random);
    test_mutations(&random, file, size, option_number(argc, argv, "--count", 20000));
    return check_report("model");
}
