/*
 * The degradation ladder: every mode against its definition, pixel by pixel, on random models and columns of every
 * kind of pixel; the stream's checksum. Option: --seed N.
 */
#include "check.h"
#include "ubm_writer.h"
#include "upb_internal.h"

enum { COLUMNS = 96 };

typedef struct column {
    uint16_t distance[UPB_BEAMS];
    uint8_t intensity[UPB_BEAMS];
} column;

typedef struct taken {
    const upb_model_info *info;
    const column *in;
    upb_mode mode; /* of the column that is finished next */
    unsigned count, returns;
} taken;

static int is_seen(const upb_model_info *info, const column *c, unsigned k) {
    return c->distance[k] >= info->min_count && c->distance[k] <= info->row_max_count[2 * k];
}

/* What stands between beams k and k + 1. */
static void expected_pixel(const upb_model_info *info, const column *c, upb_mode mode, unsigned k, uint32_t *distance,
                           uint32_t *grey) {
    const int top = is_seen(info, c, k), bottom = is_seen(info, c, k + 1);
    *distance = *grey = 0;
    if (mode == UPB_MODE_PASS_THROUGH || (mode == UPB_MODE_REPEAT && !top) || !(top || bottom))
        return;
    if (mode == UPB_MODE_REPEAT || !bottom) {
        *distance = c->distance[k];
        *grey = c->intensity[k];
    } else if (!top) {
        *distance = c->distance[k + 1];
        *grey = c->intensity[k + 1];
    } else {
        *distance = ((uint32_t)c->distance[k] + c->distance[k + 1] + 1) / 2;
        *grey = ((uint32_t)c->intensity[k] + c->intensity[k + 1] + 1) / 2;
    }
    if (*distance > info->row_max_count[2 * k + 1])
        *distance = *grey = 0;
}

static void on_column(void *user, const upb_column *out) {
    taken *t = user;
    const column *in = &t->in[t->count++];
    CHECK_EQUAL(upb_column_mode(out), t->mode);
    for (unsigned k = 0; k < UPB_BEAMS; k++) {
        CHECK_EQUAL(out->distance[2 * k], in->distance[k]);
        CHECK_EQUAL(out->intensity[2 * k], in->intensity[k]);
    }
    if (t->mode == UPB_MODE_NETWORK)
        return;
    for (unsigned k = 0; k < UPB_WINDOWS; k++) {
        uint32_t distance, grey;
        expected_pixel(t->info, in, t->mode, k, &distance, &grey);
        CHECK_EQUAL(out->distance[2 * k + 1], distance);
        CHECK_EQUAL(out->intensity[2 * k + 1], grey);
        t->returns += distance != 0;
    }
    const int repeats = t->info->last_row == UPB_LAST_ROW_REPEAT && t->mode != UPB_MODE_PASS_THROUGH;
    CHECK_EQUAL(out->distance[UPB_ROWS - 1], repeats ? in->distance[UPB_BEAMS - 1] : 0);
    CHECK_EQUAL(out->intensity[UPB_ROWS - 1], repeats ? in->intensity[UPB_BEAMS - 1] : 0);
}

static void fill(random_source *random, const upb_model_info *info, column *c) {
    for (unsigned k = 0; k < UPB_BEAMS; k++) {
        const uint32_t most = info->row_max_count[2 * k];
        const uint32_t kinds[8] = {0,
                                   65535,
                                   info->min_count - 1,
                                   info->min_count,
                                   most,
                                   most < 65535 ? most + 1 : most,
                                   random_u32(random) & 65535,
                                   info->min_count + random_below(random, 2000)};
        c->distance[k] = (uint16_t)kinds[random_below(random, 8)];
        c->intensity[k] = (uint8_t)random_u32(random);
    }
}

/* Modes change from column to column: each column has its own, whatever came before. */
static unsigned run(random_source *random, uint8_t last_row) {
    _Alignas(UPB_ALIGN) static unsigned char model_memory[UPB_MODEL_BYTES_MAX], memory[65536];
    static uint8_t file[UBM_MAX];
    static column in[COLUMNS];
    test_model m = random_model(random, COLUMNS, 8);
    upb_model *model;
    upb_model_info info;
    upb_stream *stream;
    upb_stream_config config = upb_stream_config_default();
    uint32_t before = 0, after = 1;
    m.last_row = last_row;
    m.edge = UPB_EDGE_SEAM;
    for (unsigned row = 0; row < UPB_ROWS; row++)
        m.row_max[row] = (uint16_t)(m.min_count + random_below(random, m.max_count - m.min_count + 1));
    CHECK_EQUAL(upb_model_load(model_memory, sizeof model_memory, file, write_ubm(file, &m, NULL, 0), &model, NULL),
                UPB_OK);
    upb_model_get_info(model, &info);
    taken t = {.info = &info, .in = in};
    config.sink = on_column;
    config.user = &t;
    config.aligned = 1;
    CHECK_EQUAL(upb_stream_init(memory, sizeof memory, model, &config, &stream, NULL), UPB_OK);
    CHECK_EQUAL(upb_stream_checksum(stream, &before), UPB_OK);
    for (unsigned i = 0; i < COLUMNS; i++) {
        fill(random, &info, &in[i]);
        t.mode = (upb_mode)random_below(random, UPB_MODES);
        CHECK_EQUAL(upb_stream_set_mode(stream, t.mode), UPB_OK);
        CHECK_EQUAL(upb_stream_push(stream, i, in[i].distance, in[i].intensity), UPB_OK);
    }
    CHECK_EQUAL(upb_stream_flush(stream), UPB_OK);
    CHECK_EQUAL(t.count, COLUMNS);
    CHECK_EQUAL(upb_stream_checksum(stream, &after), UPB_OK);
    CHECK_EQUAL(after, before);
    *upb_stream_test_constant(stream) ^= 1;
    CHECK_EQUAL(upb_stream_checksum(stream, &after), UPB_OK);
    CHECK(after != before);
    return t.returns;
}

static void test_arguments(void) {
    uint32_t checksum;
    CHECK_EQUAL(upb_stream_set_mode(NULL, UPB_MODE_REPEAT), UPB_E_ARGUMENT);
    CHECK_EQUAL(upb_stream_checksum(NULL, &checksum), UPB_E_ARGUMENT);
    CHECK_EQUAL(upb_crc32(0, "123456789", 9), 0xcbf43926); /* check value of CRC-32/ISO-HDLC */
    CHECK_EQUAL(upb_crc32(upb_crc32(0, "1234", 4), "56789", 5), 0xcbf43926);
}

int main(int argc, char **argv) {
    const unsigned long seed = option_number(argc, argv, "--seed", 1);
    random_source random = random_seeded(seed);
    unsigned returns = 0;
    printf("test_ladder --seed %lu\n", seed);
    test_arguments();
    for (unsigned i = 0; i < 40; i++)
        returns += run(&random, i % 2 ? UPB_LAST_ROW_REPEAT : UPB_LAST_ROW_EMPTY);
    CHECK(returns > 10000);
    return check_report("ladder");
}
