/*
 * libupbeam_opencl beside the CPU: the same images through both. Integers must agree to the bit; float where the
 * rounding of a sum decides may differ. Without an OpenCL device it says so, and still tests what is refused.
 */
#include "check.h"

#include "upbeam/upbeam_opencl.h"

enum { FILE_MAX = 1 << 20, COLUMNS_MAX = 2048, FLOAT_PIXELS_PER_MILLION = 100 };

static const char *const precision_name[UPB_PRECISIONS] = {"fp32", "int16", "int8"};

typedef struct image {
    uint16_t distance[UPB_ROWS * COLUMNS_MAX];
    uint8_t intensity[UPB_ROWS * COLUMNS_MAX];
} image;

static unsigned char ubm[FILE_MAX];
static size_t ubm_bytes;
static _Alignas(UPB_ALIGN) unsigned char model_memory[UPB_MODEL_BYTES_MAX], stream_memory[1 << 20];
static upb_model *model;
static image input, on_cpu, on_device;

/* The image on the CPU: a stream of one frame, whose ends are edges. */
static void upsample_on_cpu(uint32_t columns, uint32_t precision) {
    upb_stream_config config = upb_stream_config_default();
    upb_stream *stream;
    uint32_t done = 0, rest = 0;
    config.precision = precision;
    config.columns = columns;
    config.any_sensor = config.aligned = 1;
    if (!CHECK(upb_stream_init(stream_memory, sizeof stream_memory, model, &config, &stream, NULL) == UPB_OK))
        return;
    CHECK(upb_stream_frame(stream, input.distance, columns, input.intensity, columns, on_cpu.distance, columns,
                           on_cpu.intensity, columns, columns, &done) == UPB_OK);
    static image tail;
    CHECK(upb_stream_frame_end(stream, tail.distance, columns, tail.intensity, columns, columns, &rest) == UPB_OK);
    CHECK_EQUAL(done + rest, columns);
    for (uint32_t row = 0; row < UPB_ROWS; row++)
        for (uint32_t c = 0; c < rest; c++) {
            on_cpu.distance[row * columns + done + c] = tail.distance[row * columns + c];
            on_cpu.intensity[row * columns + done + c] = tail.intensity[row * columns + c];
        }
}

static void fill_random(random_source *random, uint32_t columns, uint32_t empty_percent) {
    for (uint32_t i = 0; i < UPB_BEAMS * columns; i++) {
        const int is_empty = random_below(random, 100) < empty_percent;
        input.distance[i] = is_empty ? 0 : (uint16_t)(1000 + random_below(random, 40000));
        input.intensity[i] = (uint8_t)random_below(random, 256);
    }
}

static void fill_extreme(uint32_t columns, uint16_t even, uint16_t odd) {
    for (uint32_t i = 0; i < UPB_BEAMS * columns; i++) {
        input.distance[i] = (i + i / columns) % 2 ? odd : even;
        input.intensity[i] = i % 2 ? 255 : 0;
    }
}

/* Pixels of the two images that differ. */
static uint32_t compare(uint32_t columns) {
    uint32_t count = 0;
    for (uint32_t i = 0; i < UPB_ROWS * columns; i++)
        count += on_cpu.distance[i] != on_device.distance[i] || on_cpu.intensity[i] != on_device.intensity[i];
    return count;
}

static void check_image(upb_cl *cl, uint32_t precision, const char *what) {
    char error[UPB_CL_ERROR_BYTES] = "";
    const uint32_t columns = upb_cl_columns(cl);
    upb_cl_times times = {0, 0};
    upsample_on_cpu(columns, precision);
    if (!CHECK(upb_cl_frame(cl, input.distance, input.intensity, on_device.distance, on_device.intensity, error,
                            sizeof error) == UPB_CL_OK)) {
        fprintf(stderr, "%s\n", error);
        return;
    }
    const uint32_t different = compare(columns), pixels = UPB_WINDOWS * columns;
    const uint32_t allowed = precision == UPB_PRECISION_FP32 ? 1 + pixels / 1000000 * FLOAT_PIXELS_PER_MILLION : 0;
    if (!CHECK(different <= allowed) || different)
        printf("  %s, %s, %u columns: %u pixels differ\n", precision_name[precision], what, (unsigned)columns,
               (unsigned)different);
    CHECK(upb_cl_get_times(cl, &times) == UPB_CL_OK && times.kernel_ns > 0);
}

static void test_shape(uint32_t precision, uint32_t columns, uint32_t vec, uint32_t walk, uint32_t share,
                       uint32_t rows) {
    char error[UPB_CL_ERROR_BYTES] = "";
    random_source random = random_seeded(columns + vec);
    upb_cl_config config = upb_cl_config_default();
    upb_cl *cl;
    config.precision = precision;
    config.columns = columns;
    config.vec = vec;
    config.walk = walk;
    config.share = share;
    config.rows = rows;
    config.group = 1;
    if (!CHECK(upb_cl_create(&config, ubm, ubm_bytes, &cl, error, sizeof error) == UPB_CL_OK)) {
        fprintf(stderr, "%s\n", error);
        return;
    }
    CHECK_EQUAL(upb_cl_columns(cl), columns);
    for (uint32_t empty = 0; empty <= 100; empty += 25) {
        fill_random(&random, columns, empty);
        check_image(cl, precision, "random");
    }
    fill_extreme(columns, 65535, 0);
    check_image(cl, precision, "65535 and 0");
    fill_extreme(columns, 40000, 1500);
    check_image(cl, precision, "40000 and 1500");
    upb_cl_destroy(cl);
}

static void test_refusals(void) {
    char error[UPB_CL_ERROR_BYTES] = "";
    upb_cl_config config = upb_cl_config_default();
    upb_cl *cl;
    CHECK(upb_cl_create(NULL, ubm, ubm_bytes, &cl, error, sizeof error) == UPB_CL_E_ARGUMENT && error[0]);
    CHECK(upb_cl_create(&config, ubm, ubm_bytes, NULL, NULL, 0) == UPB_CL_E_ARGUMENT);
    config.columns = 3;
    CHECK(upb_cl_create(&config, ubm, ubm_bytes, &cl, error, sizeof error) == UPB_CL_E_ARGUMENT);
    config.columns = 0;
    CHECK(upb_cl_create(&config, ubm, ubm_bytes - 1, &cl, error, sizeof error) == UPB_CL_E_MODEL);
    CHECK(cl == NULL);
    CHECK(upb_cl_frame(NULL, input.distance, input.intensity, on_device.distance, on_device.intensity, NULL, 0) ==
          UPB_CL_E_ARGUMENT);
    CHECK_EQUAL(upb_cl_columns(NULL), 0);
    upb_cl_destroy(NULL);
}

static void test_on_device(uint32_t devices) {
    char error[UPB_CL_ERROR_BYTES] = "";
    upb_cl_config config = upb_cl_config_default();
    upb_cl_device device;
    upb_model_info info;
    upb_cl *cl;
    CHECK(upb_cl_describe_device(0, &device, NULL, 0) == UPB_CL_OK);
    printf("device: %s on %s %s\n", device.name, device.platform, device.driver);
    config.device = devices;
    CHECK(upb_cl_create(&config, ubm, ubm_bytes, &cl, error, sizeof error) == UPB_CL_E_DEVICE && cl == NULL);
    config.device = 0;
    config.vec = 3;
    CHECK(upb_cl_create(&config, ubm, ubm_bytes, &cl, error, sizeof error) == UPB_CL_E_ARGUMENT);
    CHECK(upb_model_get_info(model, &info) == UPB_OK);
    for (uint32_t p = 0; p < UPB_PRECISIONS; p++) {
        if (!(info.precisions >> p & 1)) {
            printf("the model file has no %s: not tested\n", precision_name[p]);
            continue;
        }
        test_shape(p, 37, 1, 0, 1, 3);
        test_shape(p, 256, 8, 4, 1, 1);
        test_shape(p, COLUMNS_MAX, 0, 0, 0, 0);
    }
}

int main(int argc, char **argv) {
    char error[UPB_CL_ERROR_BYTES] = "";
    uint32_t devices = 0;
    FILE *file = argc > 1 ? fopen(argv[1], "rb") : NULL;
    if (!file) {
        fprintf(stderr, "usage: test_opencl MODEL.ubm\n");
        return 2;
    }
    ubm_bytes = fread(ubm, 1, sizeof ubm, file);
    fclose(file);
    if (!CHECK(upb_model_load(model_memory, sizeof model_memory, ubm, ubm_bytes, &model, NULL) == UPB_OK))
        return check_report("opencl");
    test_refusals();
    if (upb_cl_count_devices(&devices, error, sizeof error) != UPB_CL_OK || !devices)
        printf("no device to test on: %s\n", error);
    else
        test_on_device(devices);
    return check_report("opencl");
}
