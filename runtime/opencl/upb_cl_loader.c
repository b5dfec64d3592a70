/* The OpenCL loader, opened at run time, and the devices it knows. */
#include <dlfcn.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "upb_cl_internal.h"

enum { PLATFORMS_MAX = 16, DEVICES_MAX = 64 };

upb_cl_status upb_cl_fail(upb_cl_report report, upb_cl_status status, const char *format, ...) {
    if (report.text && report.bytes) {
        va_list arguments;
        va_start(arguments, format);
        (void)vsnprintf(report.text, report.bytes, format, arguments);
        va_end(arguments);
    }
    return status;
}

/* A variable names another loader than the system's, such as that of a Python wheel. */
static void *open_loader(void) {
    static const char *const names[] = {"libOpenCL.so.1", "libOpenCL.so"};
    const char *chosen = getenv("UPBEAM_OPENCL_LIBRARY");
    if (chosen && *chosen)
        return dlopen(chosen, RTLD_NOW | RTLD_LOCAL);
    void *library = NULL;
    for (size_t i = 0; i < sizeof names / sizeof names[0] && !library; i++)
        library = dlopen(names[i], RTLD_NOW | RTLD_LOCAL);
    return library;
}

/* Never closed: drivers keep threads and exit handlers. */
upb_cl_status upb_cl_load(upb_cl_api *api, upb_cl_report report) {
    void *const library = open_loader(), *symbol;
    if (!library)
        return upb_cl_fail(report, UPB_CL_E_LIBRARY, "no OpenCL loader: %s", dlerror());
#define LOOK_UP(result, name, arguments)                                                                               \
    symbol = dlsym(library, "cl" #name);                                                                               \
    if (!symbol)                                                                                                       \
        return upb_cl_fail(report, UPB_CL_E_LIBRARY, "the OpenCL loader has no cl" #name);                             \
    memcpy(&api->name, &symbol, sizeof symbol); /* C has no cast from an object to a function */
    UPB_CL_FUNCTIONS(LOOK_UP)
#undef LOOK_UP
    return UPB_CL_OK;
}

static upb_cl_status find_devices(const upb_cl_api *api, cl_device_id devices[DEVICES_MAX], uint32_t *count,
                                  upb_cl_report report) {
    cl_platform_id platforms[PLATFORMS_MAX];
    cl_uint platform_count = 0;
    const cl_int status = api->GetPlatformIDs(PLATFORMS_MAX, platforms, &platform_count);
    *count = 0;
    if (status != CL_SUCCESS || !platform_count)
        return upb_cl_fail(report, UPB_CL_E_PLATFORM, "no OpenCL platform (error %d): install a driver, or PoCL",
                           status);
    for (cl_uint p = 0; p < platform_count && p < PLATFORMS_MAX; p++) {
        cl_uint found = 0;
        const cl_uint room = DEVICES_MAX - *count;
        if (!room || api->GetDeviceIDs(platforms[p], CL_DEVICE_TYPE_ALL, room, devices + *count, &found) != CL_SUCCESS)
            continue; /* a driver without its device */
        *count += found < room ? found : room;
    }
    return UPB_CL_OK;
}

static void describe(const upb_cl_api *api, cl_device_id id, upb_cl_device *device) {
    cl_platform_id platform = NULL;
    cl_bitfield type = 0;
    cl_bool unified = 0;

    memset(device, 0, sizeof *device);
    (void)api->GetDeviceInfo(id, CL_DEVICE_NAME, sizeof device->name - 1, device->name, NULL);
    (void)api->GetDeviceInfo(id, CL_DRIVER_VERSION, sizeof device->driver - 1, device->driver, NULL);
    (void)api->GetDeviceInfo(id, CL_DEVICE_PLATFORM, sizeof(cl_platform_id), &platform, NULL);
    (void)api->GetPlatformInfo(platform, CL_PLATFORM_NAME, sizeof device->platform - 1, device->platform, NULL);
    (void)api->GetDeviceInfo(id, CL_DEVICE_MAX_COMPUTE_UNITS, sizeof device->units, &device->units, NULL);
    (void)api->GetDeviceInfo(id, CL_DEVICE_GLOBAL_MEM_SIZE, sizeof device->memory_bytes, &device->memory_bytes, NULL);
    (void)api->GetDeviceInfo(id, CL_DEVICE_TYPE, sizeof type, &type, NULL);
    (void)api->GetDeviceInfo(id, CL_DEVICE_HOST_UNIFIED_MEMORY, sizeof unified, &unified, NULL);
    device->is_cpu = (type & CL_DEVICE_TYPE_CPU) != 0;
    device->shares_memory = unified != 0;
}

upb_cl_status upb_cl_find_device(upb_cl_api *api, uint32_t index, cl_device_id *device, upb_cl_device *description,
                                 upb_cl_report report) {
    cl_device_id devices[DEVICES_MAX];
    uint32_t count = 0;
    upb_cl_status status = upb_cl_load(api, report);
    if (status == UPB_CL_OK)
        status = find_devices(api, devices, &count, report);
    if (status != UPB_CL_OK)
        return status;
    if (index >= count)
        return upb_cl_fail(report, UPB_CL_E_DEVICE, "no OpenCL device %u, there are %u", (unsigned)index,
                           (unsigned)count);
    *device = devices[index];
    describe(api, *device, description);
    return UPB_CL_OK;
}

upb_cl_status upb_cl_count_devices(uint32_t *count, char *error, size_t error_bytes) {
    const upb_cl_report report = {error, error_bytes};
    cl_device_id devices[DEVICES_MAX];
    upb_cl_api api;
    if (!count)
        return upb_cl_fail(report, UPB_CL_E_ARGUMENT, "count is null");
    *count = 0;
    const upb_cl_status status = upb_cl_load(&api, report);
    return status == UPB_CL_OK ? find_devices(&api, devices, count, report) : status;
}

upb_cl_status upb_cl_describe_device(uint32_t index, upb_cl_device *device, char *error, size_t error_bytes) {
    const upb_cl_report report = {error, error_bytes};
    cl_device_id id;
    upb_cl_api api;
    if (!device)
        return upb_cl_fail(report, UPB_CL_E_ARGUMENT, "device is null");
    return upb_cl_find_device(&api, index, &id, device, report);
}
