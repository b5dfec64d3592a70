/* A device, a program, its buffers; a frame through them. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "upb_cl_internal.h"

enum { PAD = 16, PAIRS = 31, WALK_MAX = 512, PIXEL_BYTES = 3 /* two of a distance, one of an intensity */ };

struct upb_cl {
    upb_cl_api api;
    cl_device_id device;
    upb_cl_device description;
    cl_context context;
    cl_command_queue queue;
    cl_program program;
    cl_kernel kernel;
    cl_mem input, output;
    size_t input_bytes, output_bytes;
    uint8_t *staging_in, *staging_out; /* where memory is not shared */
    upb_cl_layout layout;
    size_t global[2], local[2];
    upb_cl_times times;
};

upb_cl_config upb_cl_config_default(void) {
    return (upb_cl_config){.struct_bytes = sizeof(upb_cl_config), .precision = UPB_PRECISION_FP32};
}

uint32_t upb_cl_columns(const upb_cl *cl) { return cl ? cl->layout.columns : 0; }

static upb_cl_status driver_failed(upb_cl_report report, const char *what, cl_int code) {
    const int memory =
        code == CL_MEM_OBJECT_ALLOCATION_FAILURE || code == CL_OUT_OF_RESOURCES || code == CL_OUT_OF_HOST_MEMORY;
    return upb_cl_fail(report, memory ? UPB_CL_E_MEMORY : UPB_CL_E_RUN, "%s%s: OpenCL error %d",
                       memory ? "out of memory: " : "", what, (int)code);
}

/* --------------------------------------------------------------------------------------------- creation */

/* What is best on the devices that were measured (docs/opencl.md), where the caller leaves it open. */
static void choose_shape(const upb_cl *cl, upb_cl_config *config) {
    cl_uint width = 0;
    if (config->vec)
        return;
    config->rows = config->group = config->share = 1;
    if (!cl->description.is_cpu) {
        config->vec = 1;
        config->group = 64;
        return;
    }
    (void)cl->api.GetDeviceInfo(cl->device, CL_DEVICE_NATIVE_VECTOR_WIDTH_FLOAT, sizeof width, &width, NULL);
    config->vec = width >= 16 ? 16 : width >= 8 ? 8 : 4;
    config->share = 2;
    config->walk = (config->columns + 2 * config->vec - 1) / (2 * config->vec) * 2;
    config->walk = config->walk < WALK_MAX ? config->walk : WALK_MAX;
}

static upb_cl_status check_shape(const upb_cl_config *config, upb_cl_report report) {
    const uint32_t vec = config->vec, walk = config->walk, share = config->share;
    const int vec_fits = vec <= 16 && (vec & (vec - 1)) == 0;
    const int walk_fits = !walk || (walk <= WALK_MAX && vec > 1 && config->rows == 1);
    const int share_fits = share == 1 || (share == 2 && walk && walk % 2 == 0);
    if (vec_fits && walk_fits && share_fits && config->rows >= 1 && config->rows <= PAIRS && config->group >= 1)
        return UPB_CL_OK;
    return upb_cl_fail(report, UPB_CL_E_ARGUMENT, "no such kernel: vec %u, walk %u, share %u, rows %u, group %u",
                       (unsigned)vec, (unsigned)walk, (unsigned)share, (unsigned)config->rows, (unsigned)config->group);
}

/* Rows are padded to whole work-groups, and to whole pads for the alignment of vectors. */
static void lay_out(upb_cl *cl, const upb_cl_config *config) {
    const uint32_t per_item = config->vec * (config->walk ? config->walk : 1);
    uint32_t block = per_item * config->group;
    while (block % PAD)
        block *= 2;
    const uint32_t padded = (config->columns + block - 1) / block * block;
    cl->layout = (upb_cl_layout){config->columns, PAD, padded + 2 * PAD, padded};
    cl->global[0] = padded / per_item;
    cl->global[1] = (PAIRS + config->rows - 1) / config->rows;
    cl->local[0] = config->group;
    cl->local[1] = 1;
    cl->input_bytes = (size_t)PIXEL_BYTES * UPB_BEAMS * cl->layout.stride_in;
    cl->output_bytes = (size_t)PIXEL_BYTES * UPB_ROWS * cl->layout.stride_out;
}

static upb_cl_status open_queue(upb_cl *cl, upb_cl_report report) {
    cl_int code;
    cl->context = cl->api.CreateContext(NULL, 1, &cl->device, NULL, NULL, &code);
    if (code == CL_SUCCESS)
        cl->queue = cl->api.CreateCommandQueue(cl->context, cl->device, CL_QUEUE_PROFILING_ENABLE, &code);
    if (code == CL_SUCCESS)
        return UPB_CL_OK;
    return upb_cl_fail(report, UPB_CL_E_DEVICE, "OpenCL device %s cannot be opened: error %d", cl->description.name,
                       (int)code);
}

/* Reports the compiler's log. */
static upb_cl_status build_failed(const upb_cl *cl, cl_int code, upb_cl_report report) {
    size_t bytes = 0;
    const upb_cl_status status = upb_cl_fail(
        report, UPB_CL_E_BUILD, "OpenCL device %s cannot build the kernel: error %d", cl->description.name, (int)code);
    (void)cl->api.GetProgramBuildInfo(cl->program, cl->device, CL_PROGRAM_BUILD_LOG, 0, NULL, &bytes);
    char *log = calloc(1, bytes + 1);
    if (log && report.text) {
        const size_t used = strlen(report.text);
        (void)cl->api.GetProgramBuildInfo(cl->program, cl->device, CL_PROGRAM_BUILD_LOG, bytes, log, NULL);
        (void)snprintf(report.text + used, report.bytes - used, ", its log:\n%s", log);
    }
    free(log);
    return status;
}

/* Counts and weights are finite, and so are all sums of them. */
static upb_cl_status build(upb_cl *cl, const upb_cl_config *config, const char *source, upb_cl_report report) {
    char options[160];
    cl_int code;
    (void)snprintf(options, sizeof options,
                   "-cl-std=CL1.2 -cl-finite-math-only -DVEC=%u -DROWS=%u -DWALK=%u -DSHARE=%u", (unsigned)config->vec,
                   (unsigned)config->rows, (unsigned)config->walk, (unsigned)config->share);
    cl->program = cl->api.CreateProgramWithSource(cl->context, 1, &source, NULL, &code);
    if (code != CL_SUCCESS)
        return driver_failed(report, "clCreateProgramWithSource", code);
    code = cl->api.BuildProgram(cl->program, 1, &cl->device, options, NULL, NULL);
    if (code == CL_SUCCESS)
        cl->kernel = cl->api.CreateKernel(cl->program, "upsample_image", &code);
    return code == CL_SUCCESS ? UPB_CL_OK : build_failed(cl, code, report);
}

/* What lies beyond the edges of the input is zeroed here, once. */
static upb_cl_status clear_input(upb_cl *cl, upb_cl_report report) {
    uint8_t *zeros = calloc(1, cl->input_bytes);
    if (!zeros)
        return upb_cl_fail(report, UPB_CL_E_MEMORY, "out of memory: %zu bytes", cl->input_bytes);
    const cl_int code = cl->api.EnqueueWriteBuffer(cl->queue, cl->input, 1, 0, cl->input_bytes, zeros, 0, NULL, NULL);
    if (cl->description.shares_memory) {
        free(zeros);
    } else {
        cl->staging_in = zeros;
        cl->staging_out = malloc(cl->output_bytes);
        if (!cl->staging_out)
            return upb_cl_fail(report, UPB_CL_E_MEMORY, "out of memory: %zu bytes", cl->output_bytes);
    }
    return code == CL_SUCCESS ? UPB_CL_OK : driver_failed(report, "clEnqueueWriteBuffer", code);
}

static upb_cl_status allocate(upb_cl *cl, upb_cl_report report) {
    const cl_bitfield host = cl->description.shares_memory ? CL_MEM_ALLOC_HOST_PTR : 0;
    cl_ulong largest = 0;
    cl_int code;
    (void)cl->api.GetDeviceInfo(cl->device, CL_DEVICE_MAX_MEM_ALLOC_SIZE, sizeof largest, &largest, NULL);
    if (cl->output_bytes > largest)
        return upb_cl_fail(report, UPB_CL_E_MEMORY, "out of memory: needs a buffer of %zu bytes, the device gives %llu",
                           cl->output_bytes, (unsigned long long)largest);
    cl->input = cl->api.CreateBuffer(cl->context, CL_MEM_READ_ONLY | host, cl->input_bytes, NULL, &code);
    if (code == CL_SUCCESS)
        cl->output = cl->api.CreateBuffer(cl->context, CL_MEM_WRITE_ONLY | host, cl->output_bytes, NULL, &code);
    if (code == CL_SUCCESS)
        code = cl->api.SetKernelArg(cl->kernel, 0, sizeof cl->input, &cl->input);
    if (code == CL_SUCCESS)
        code = cl->api.SetKernelArg(cl->kernel, 1, sizeof cl->output, &cl->output);
    return code == CL_SUCCESS ? clear_input(cl, report) : driver_failed(report, "clCreateBuffer", code);
}

/* Reads the model into `memory`, which belongs to the caller, and refuses what cannot be run. */
static upb_cl_status read_model(void *memory, const void *ubm, size_t ubm_bytes, uint32_t precision,
                                const upb_model **model, upb_cl_report report) {
    static const char *const names[UPB_PRECISIONS] = {"fp32", "int16", "int8"};
    upb_error error = {.what = ""};
    upb_model *loaded;
    if (upb_model_load(memory, UPB_MODEL_BYTES_MAX, ubm, ubm_bytes, &loaded, &error) != UPB_OK)
        return upb_cl_fail(report, UPB_CL_E_MODEL, "model: %s (%s)", upb_status_text(error.status), error.what);
    if (!upb_model_has(loaded, precision))
        return upb_cl_fail(report, UPB_CL_E_MODEL, "model: precision %s is not in the file", names[precision]);
    *model = loaded;
    return UPB_CL_OK;
}

/* With the model at hand: device, program, buffers. */
static upb_cl_status set_up(upb_cl *cl, upb_cl_config config, const upb_model *model, upb_cl_report report) {
    upb_cl_status status = upb_cl_find_device(&cl->api, config.device, &cl->device, &cl->description, report);
    if (status != UPB_CL_OK)
        return status;
    upb_cl_name_processor(&cl->api, cl->device, &cl->description);
    config.columns = config.columns ? config.columns : model->info.columns;
    choose_shape(cl, &config);
    if ((status = check_shape(&config, report)) != UPB_CL_OK)
        return status;
    lay_out(cl, &config);
    char *source = upb_cl_source(model, (upb_precision)config.precision, &cl->layout);
    if (!source)
        return upb_cl_fail(report, UPB_CL_E_MEMORY, "out of memory: the program's text");
    if ((status = open_queue(cl, report)) == UPB_CL_OK && (status = build(cl, &config, source, report)) == UPB_CL_OK)
        status = allocate(cl, report);
    free(source);
    return status;
}

static int is_sound(const upb_cl_config *config) {
    const int width_fits = !config->columns || (config->columns >= 4 && config->columns <= UPB_MAX_COLUMNS);
    return config->struct_bytes == sizeof *config && config->precision < UPB_PRECISIONS && width_fits;
}

upb_cl_status upb_cl_create(const upb_cl_config *config, const void *ubm, size_t ubm_bytes, upb_cl **cl, char *error,
                            size_t error_bytes) {
    const upb_cl_report report = {error, error_bytes};
    const upb_model *model = NULL;
    if (cl)
        *cl = NULL;
    if (!cl || !ubm || !config || !is_sound(config))
        return upb_cl_fail(report, UPB_CL_E_ARGUMENT, "a null pointer, or a configuration out of range");
    void *memory = aligned_alloc(UPB_ALIGN, UPB_MODEL_BYTES_MAX);
    upb_cl *made = calloc(1, sizeof *made);
    upb_cl_status status = UPB_CL_OK;
    if (!memory || !made)
        status = upb_cl_fail(report, UPB_CL_E_MEMORY, "out of memory: %zu bytes", sizeof *made + UPB_MODEL_BYTES_MAX);
    if (status == UPB_CL_OK)
        status = read_model(memory, ubm, ubm_bytes, config->precision, &model, report);
    if (status == UPB_CL_OK)
        status = set_up(made, *config, model, report);
    free(memory);
    if (status == UPB_CL_OK)
        *cl = made;
    else
        upb_cl_destroy(made);
    return status;
}

void upb_cl_destroy(upb_cl *cl) {
    if (!cl)
        return;
    if (cl->queue) {
        (void)cl->api.Finish(cl->queue);
        (void)cl->api.ReleaseCommandQueue(cl->queue);
    }
    if (cl->input)
        (void)cl->api.ReleaseMemObject(cl->input);
    if (cl->output)
        (void)cl->api.ReleaseMemObject(cl->output);
    if (cl->kernel)
        (void)cl->api.ReleaseKernel(cl->kernel);
    if (cl->program)
        (void)cl->api.ReleaseProgram(cl->program);
    if (cl->context)
        (void)cl->api.ReleaseContext(cl->context);
    free(cl->staging_in);
    free(cl->staging_out);
    free(cl);
}

/* ---------------------------------------------------------------------------------------------- a frame */

/* Copies rows, `from_stride` and `to_stride` bytes apart. */
static void copy_rows(uint8_t *to, size_t to_stride, const uint8_t *from, size_t from_stride, size_t bytes,
                      unsigned rows) {
    for (unsigned row = 0; row < rows; row++)
        memcpy(to + row * to_stride, from + row * from_stride, bytes);
}

static void fill_input(const upb_cl *cl, uint8_t *input, const uint16_t *distance, const uint8_t *intensity) {
    const size_t stride = cl->layout.stride_in, columns = cl->layout.columns, grey = 2 * stride * UPB_BEAMS;
    copy_rows(input + (size_t)2 * PAD, 2 * stride, (const uint8_t *)distance, 2 * columns, 2 * columns, UPB_BEAMS);
    copy_rows(input + grey + PAD, stride, intensity, columns, columns, UPB_BEAMS);
}

static void take_output(const upb_cl *cl, const uint8_t *output, uint16_t *distance, uint8_t *intensity) {
    const size_t stride = cl->layout.stride_out, columns = cl->layout.columns, grey = 2 * stride * UPB_ROWS;
    copy_rows((uint8_t *)distance, 2 * columns, output, 2 * stride, 2 * columns, UPB_ROWS);
    copy_rows(intensity, columns, output + grey, stride, columns, UPB_ROWS);
}

/* Adds the time of a finished command, and lets go of its event. */
static void take_time(const upb_cl *cl, cl_event event, uint64_t *sum_ns) {
    cl_ulong start = 0, end = 0;
    if (!event)
        return;
    (void)cl->api.GetEventProfilingInfo(event, CL_PROFILING_COMMAND_START, sizeof start, &start, NULL);
    (void)cl->api.GetEventProfilingInfo(event, CL_PROFILING_COMMAND_END, sizeof end, &end, NULL);
    *sum_ns += end > start ? end - start : 0;
    (void)cl->api.ReleaseEvent(event);
}

/* The commands of a frame that take part in the transfer time. */
enum { WRITE, RELEASE_INPUT, READ, RELEASE_OUTPUT, TRANSFERS };

static cl_int run_mapped(upb_cl *cl, const uint16_t *distance, const uint8_t *intensity, uint16_t *out_distance,
                         uint8_t *out_intensity, cl_event transfers[TRANSFERS], cl_event *kernel) {
    const upb_cl_api *api = &cl->api;
    cl_int code;
    void *input = api->EnqueueMapBuffer(cl->queue, cl->input, 1, CL_MAP_WRITE, 0, cl->input_bytes, 0, NULL,
                                        &transfers[WRITE], &code);
    if (code != CL_SUCCESS)
        return code;
    fill_input(cl, input, distance, intensity);
    code = api->EnqueueUnmapMemObject(cl->queue, cl->input, input, 0, NULL, &transfers[RELEASE_INPUT]);
    if (code == CL_SUCCESS)
        code = api->EnqueueNDRangeKernel(cl->queue, cl->kernel, 2, NULL, cl->global, cl->local, 0, NULL, kernel);
    if (code != CL_SUCCESS)
        return code;
    void *output = api->EnqueueMapBuffer(cl->queue, cl->output, 1, CL_MAP_READ, 0, cl->output_bytes, 0, NULL,
                                         &transfers[READ], &code);
    if (code != CL_SUCCESS)
        return code;
    take_output(cl, output, out_distance, out_intensity);
    return api->EnqueueUnmapMemObject(cl->queue, cl->output, output, 0, NULL, &transfers[RELEASE_OUTPUT]);
}

static cl_int run_copied(upb_cl *cl, const uint16_t *distance, const uint8_t *intensity, uint16_t *out_distance,
                         uint8_t *out_intensity, cl_event transfers[TRANSFERS], cl_event *kernel) {
    const upb_cl_api *api = &cl->api;
    fill_input(cl, cl->staging_in, distance, intensity);
    cl_int code = api->EnqueueWriteBuffer(cl->queue, cl->input, 0, 0, cl->input_bytes, cl->staging_in, 0, NULL,
                                          &transfers[WRITE]);
    if (code == CL_SUCCESS)
        code = api->EnqueueNDRangeKernel(cl->queue, cl->kernel, 2, NULL, cl->global, cl->local, 0, NULL, kernel);
    if (code == CL_SUCCESS)
        code = api->EnqueueReadBuffer(cl->queue, cl->output, 1, 0, cl->output_bytes, cl->staging_out, 0, NULL,
                                      &transfers[READ]);
    if (code == CL_SUCCESS)
        take_output(cl, cl->staging_out, out_distance, out_intensity);
    return code;
}

upb_cl_status upb_cl_frame(upb_cl *cl, const uint16_t *distance, const uint8_t *intensity, uint16_t *out_distance,
                           uint8_t *out_intensity, char *error, size_t error_bytes) {
    const upb_cl_report report = {error, error_bytes};
    cl_event transfers[TRANSFERS] = {NULL, NULL, NULL, NULL}, kernel = NULL;
    if (!cl || !distance || !intensity || !out_distance || !out_intensity)
        return upb_cl_fail(report, UPB_CL_E_ARGUMENT, "a null pointer");
    cl_int code = (cl->description.shares_memory ? run_mapped : run_copied)(cl, distance, intensity, out_distance,
                                                                            out_intensity, transfers, &kernel);
    const cl_int finished = cl->api.Finish(cl->queue);
    code = code == CL_SUCCESS ? finished : code;
    cl->times = (upb_cl_times){0, 0};
    take_time(cl, kernel, &cl->times.kernel_ns);
    for (int i = 0; i < TRANSFERS; i++)
        take_time(cl, transfers[i], &cl->times.transfer_ns);
    return code == CL_SUCCESS ? UPB_CL_OK : driver_failed(report, "a frame", code);
}

upb_cl_status upb_cl_get_times(const upb_cl *cl, upb_cl_times *times) {
    if (!cl || !times)
        return UPB_CL_E_ARGUMENT;
    *times = cl->times;
    return UPB_CL_OK;
}
