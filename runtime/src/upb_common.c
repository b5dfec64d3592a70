/* Status texts, version, error reports. */
#include <string.h>

#include "upb_internal.h"

/* An array of arrays, not of pointers: pointers would need relocating, and so a writable section. */
static const char status_text[][64] = {
    "no error",
    "an argument is null or out of range",
    "the memory given is too small",
    "the memory given is not aligned to 64 bytes",
    "the model file ends early or is longer than it says",
    "not a .ubm model file",
    "the model file's format version is not known",
    "the model file is damaged: its checksum does not match",
    "a required section of the model file is unusable",
    "a value in the model file is impossible",
    "the stream's sensor is not the one the model was made for",
    "the model file does not have the precision",
    "this machine or this build lacks the instruction set",
    "the column is older than one already taken",
    "the model file's signature was refused",
};

const char *upb_status_text(upb_status status) {
    unsigned index = (unsigned)status;
    return index < sizeof status_text / sizeof status_text[0] ? status_text[index] : "unknown status";
}

uint32_t upb_api_version(void) { return UPB_API_VERSION; }

const char *upb_version(void) { return UPB_VERSION_TEXT; }

upb_status upb_fail(upb_error *error, upb_status status, const char *what, uint64_t offset, uint64_t got,
                    uint64_t expected) {
    if (error) {
        memset(error, 0, sizeof *error);
        error->status = status;
        error->offset = offset > UINT32_MAX ? UINT32_MAX : (uint32_t)offset;
        error->got = got;
        error->expected = expected;
        for (size_t i = 0; i + 1 < sizeof error->what && what[i]; i++)
            error->what[i] = what[i];
    }
    return status;
}

upb_status upb_check_memory(const void *memory, size_t bytes, size_t needed, upb_error *error) {
    if (!memory)
        return upb_fail(error, UPB_E_ARGUMENT, "memory", 0, 0, 0);
    if ((uintptr_t)memory % UPB_ALIGN)
        return upb_fail(error, UPB_E_ALIGN, "memory", 0, (uintptr_t)memory % UPB_ALIGN, 0);
    if (bytes < needed)
        return upb_fail(error, UPB_E_SIZE, "memory_bytes", 0, bytes, needed);
    return UPB_OK;
}
