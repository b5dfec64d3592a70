/*
 * upbeam on an OpenCL device: whole images of a 32-beam LiDAR in, images of 64 rows out.
 *
 * A library of its own (libupbeam_opencl): unlike libupbeam it allocates memory and calls a driver. The OpenCL loader
 * (libOpenCL.so.1) is opened at run time, so a program that links this starts on machines without one. The kernels are
 * those of kernels/opencl, part of the library. Models, units and rules are those of upbeam.h.
 *
 * Every frame is an image of its own, whose two ends are edges; streams that continue over the seam run on the CPU
 * (upb_stream). Objects may be used from one thread at a time.
 *
 * Usage:
 *     char error[UPB_CL_ERROR_BYTES];
 *     upb_cl_config config = upb_cl_config_default();
 *     upb_cl *cl;
 *     if (upb_cl_create(&config, ubm, ubm_bytes, &cl, error, sizeof error) != UPB_CL_OK) puts(error) ...
 *     for (;;) upb_cl_frame(cl, distance, intensity, out_distance, out_intensity, error, sizeof error);
 *     upb_cl_destroy(cl);
 */
#ifndef UPBEAM_UPBEAM_OPENCL_H
#define UPBEAM_UPBEAM_OPENCL_H

#include "upbeam/upbeam.h"

#ifdef __cplusplus
extern "C" {
#endif

typedef enum upb_cl_status {
    UPB_CL_OK = 0,
    UPB_CL_E_ARGUMENT = 1, /* a null pointer, or a value outside its range */
    UPB_CL_E_LIBRARY = 2,  /* no OpenCL loader on this machine, or one without a function that is needed */
    UPB_CL_E_PLATFORM = 3, /* the loader knows no platform */
    UPB_CL_E_DEVICE = 4,   /* no device, none with this index, or it cannot be opened */
    UPB_CL_E_MODEL = 5,    /* the model file was refused, or does not have the precision */
    UPB_CL_E_BUILD = 6,    /* the driver's compiler refused the kernel: its log is in the error text */
    UPB_CL_E_MEMORY = 7,   /* the device or the host has not enough memory */
    UPB_CL_E_RUN = 8       /* a call of the driver failed: the error text names it */
} upb_cl_status;

/*
 * Where a call takes `error` and `error_bytes`, it writes there, if it fails, one line that says what went wrong (after
 * a build failure the compiler's log follows), zero terminated and cut to fit. `error` may be null.
 */
#define UPB_CL_ERROR_BYTES 8192u

typedef struct upb_cl_device {
    char name[128];
    char platform[128];
    char driver[64];
    uint32_t units;         /* compute units */
    uint32_t is_cpu;        /* 1: a CPU */
    uint32_t shares_memory; /* 1: buffers are mapped instead of copied */
    uint32_t reserved;
    uint64_t memory_bytes;
} upb_cl_device;

/* Number of devices of all platforms, in *count. Errors: LIBRARY, PLATFORM; *count is then 0. */
UPB_API upb_cl_status upb_cl_count_devices(uint32_t *count, char *error, size_t error_bytes);

/* Errors: ARGUMENT, LIBRARY, PLATFORM, DEVICE. */
UPB_API upb_cl_status upb_cl_describe_device(uint32_t index, upb_cl_device *device, char *error, size_t error_bytes);

typedef struct upb_cl_config {
    uint32_t struct_bytes; /* sizeof(upb_cl_config), set by upb_cl_config_default */
    uint32_t device;       /* index, as upb_cl_describe_device counts */
    uint32_t precision;    /* upb_precision */
    uint32_t columns;      /* width of the images, 4..UPB_MAX_COLUMNS; 0: the model's */
    /*
     * How the kernel is cut (docs/opencl.md; upbeam's Python side measures what is best): columns in a vector, 1, 2, 4,
     * 8 or 16; blocks of so many columns that a work-item takes one after the other, up to 512, 0: one; how many of
     * these go through a network together, 1, or 2 of an even number; pairs of beams that it takes if it does not walk,
     * up to 31; work-items of a work-group. 0 in `vec`: all five by kind of device.
     */
    uint32_t vec, walk, share, rows, group;
    uint32_t reserved[7]; /* 0 */
} upb_cl_config;

UPB_API upb_cl_config upb_cl_config_default(void);

typedef struct upb_cl upb_cl;

/*
 * Opens the device, reads the model file (`ubm` need not be kept), builds the kernel and allocates all buffers. Errors:
 * all but RUN; *cl is then null.
 */
UPB_API upb_cl_status upb_cl_create(const upb_cl_config *config, const void *ubm, size_t ubm_bytes, upb_cl **cl,
                                    char *error, size_t error_bytes);

/* The width of its images. 0 for null. */
UPB_API uint32_t upb_cl_columns(const upb_cl *cl);

/*
 * One image: `distance` and `intensity` of UPB_BEAMS rows, the outputs of UPB_ROWS, each row upb_cl_columns() elements
 * long and right behind the one before. Even output rows are the input's, to the bit. Errors: ARGUMENT, MEMORY, RUN.
 */
UPB_API upb_cl_status upb_cl_frame(upb_cl *cl, const uint16_t *distance, const uint8_t *intensity,
                                   uint16_t *out_distance, uint8_t *out_intensity, char *error, size_t error_bytes);

typedef struct upb_cl_times {
    uint64_t kernel_ns;   /* by the device's clock */
    uint64_t transfer_ns; /* copies to and from the device; mapping and unmapping where memory is shared */
} upb_cl_times;

/* Of the last frame. Errors: ARGUMENT. */
UPB_API upb_cl_status upb_cl_get_times(const upb_cl *cl, upb_cl_times *times);

/* Waits for the device, and frees everything. Null is fine. */
UPB_API void upb_cl_destroy(upb_cl *cl);

#ifdef __cplusplus
}
#endif

#endif /* UPBEAM_UPBEAM_OPENCL_H */
