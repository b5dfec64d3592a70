/* What the source files of libupbeam_opencl share. */
#ifndef UPB_CL_INTERNAL_H
#define UPB_CL_INTERNAL_H

#include "upb_cl_api.h"
#include "upb_internal.h"
#include "upbeam/upbeam_opencl.h"

/* Where an error goes. */
typedef struct upb_cl_report {
    char *text; /* may be null */
    size_t bytes;
} upb_cl_report;

/* Writes the message, and returns `status`. */
#if defined(__GNUC__)
__attribute__((format(printf, 3, 4)))
#endif
upb_cl_status
upb_cl_fail(upb_cl_report report, upb_cl_status status, const char *format, ...);

/* Fills the functions from the OpenCL loader, which stays open until the program ends. Errors: LIBRARY. */
upb_cl_status upb_cl_load(upb_cl_api *api, upb_cl_report report);

/* The device with this index. Errors: LIBRARY (api is filled here), PLATFORM, DEVICE. */
upb_cl_status upb_cl_find_device(upb_cl_api *api, uint32_t index, cl_device_id *device, upb_cl_device *description,
                                 upb_cl_report report);

/* Gives PoCL a name for a processor that it does not know (see upb_cl_pocl.c). */
void upb_cl_name_processor(const upb_cl_api *api, cl_device_id device, const upb_cl_device *description);

/* How an image lies in the device's buffers: rows of so many pixels, `pad` empty columns on both sides of the input. */
typedef struct upb_cl_layout {
    uint32_t columns, pad, stride_in, stride_out;
} upb_cl_layout;

/* The whole program text, zero terminated, from malloc; null if there is no memory. */
char *upb_cl_source(const upb_model *model, upb_precision precision, const upb_cl_layout *layout);

#endif /* UPB_CL_INTERNAL_H */
