/*
 * PoCL on a processor that its compiler does not know.
 *
 * PoCL 3.0 and 3.1 compile with an LLVM that knows no name for newer processors (AMD Zen 4 and 5, say); PoCL then takes
 * `generic`, which its own front end refuses: every build fails with "unknown target CPU 'generic'". No option of PoCL
 * changes the name. Here the device gets another one before its first program: the pointer in its struct that leads to
 * `generic` is led to a name whose instructions the processor has. Only on x86-64 Linux, only for a device of these
 * versions that calls itself generic, only if exactly one pointer of its struct leads to that word; otherwise nothing
 * is touched. UPBEAM_POCL_CPU=off leaves PoCL alone. kernels/opencl/pocl.py does the same.
 */
#define _GNU_SOURCE
#include <string.h>

#include "upb_cl_internal.h"

#if defined(__linux__) && defined(__x86_64__) && defined(__GNUC__)
#include <stdlib.h>
#include <sys/uio.h>
#include <unistd.h>

static const char unknown[] = "generic";
/* The name stands at byte 640; beyond the struct lies other memory, where a second such pointer may be. */
enum { STRUCT_BYTES = 1024 };

/* Through the kernel: an address that is none does no harm. */
static int read_memory(uintptr_t address, void *to, size_t bytes) {
    const struct iovec local = {to, bytes}, remote = {(void *)address, bytes};
    return process_vm_readv(getpid(), &local, 1, &remote, 1, 0) == (ssize_t)bytes;
}

static int is_nameless(const upb_cl_api *api, cl_device_id id, const upb_cl_device *device) {
    static const char ending[] = "-linux-gnu-generic";
    char version[256] = "";
    (void)api->GetDeviceInfo(id, CL_DEVICE_VERSION, sizeof version - 1, version, NULL);
    size_t length = strlen(version);
    while (length && version[length - 1] == ' ')
        version[--length] = 0;
    return strcmp(device->platform, "Portable Computing Language") == 0 &&
           (strncmp(device->driver, "3.0", 3) == 0 || strncmp(device->driver, "3.1", 3) == 0) &&
           length >= sizeof ending - 1 && strcmp(version + length - (sizeof ending - 1), ending) == 0;
}

static const char *best_level(void) {
    __builtin_cpu_init();
    if (__builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") && __builtin_cpu_supports("avx512cd") &&
        __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512vl"))
        return "skylake-avx512";
    return __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") ? "haswell" : "x86-64";
}

void upb_cl_name_processor(const upb_cl_api *api, cl_device_id id, const upb_cl_device *device) {
    const char *chosen = getenv("UPBEAM_POCL_CPU");
    const char *name = chosen && *chosen ? chosen : best_level();
    uintptr_t words[STRUCT_BYTES / sizeof(uintptr_t)];
    size_t found = 0, place = 0;
    if (strcmp(name, "off") == 0 || !is_nameless(api, id, device) || !read_memory((uintptr_t)id, words, sizeof words))
        return;
    for (size_t i = 0; i < sizeof words / sizeof words[0]; i++) {
        char text[sizeof unknown];
        if (read_memory(words[i], text, sizeof text) && memcmp(text, unknown, sizeof text) == 0) {
            place = i;
            found++;
        }
    }
    char *copy = found == 1 ? strdup(name) : NULL; /* PoCL may free it */
    if (copy)
        memcpy((char *)id + place * sizeof(uintptr_t), &copy, sizeof copy);
}

#else

void upb_cl_name_processor(const upb_cl_api *api, cl_device_id id, const upb_cl_device *device) {
    (void)api, (void)id, (void)device;
}

#endif
