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

/* Half a byte at a time: a table of 64 bytes instead of 1024. */
uint32_t upb_crc32(uint32_t crc, const void *bytes, size_t size) {
    static const uint32_t table[16] = {0x00000000, 0x1db71064, 0x3b6e20c8, 0x26d930ac, 0x76dc4190, 0x6b6b51f4,
                                       0x4db26158, 0x5005713c, 0xedb88320, 0xf00f9344, 0xd6d6a3e8, 0xcb61b38c,
                                       0x9b64c2b0, 0x86d3d2d4, 0xa00ae278, 0xbdbdf21c};
    const uint8_t *byte = bytes;
    crc = ~crc;
    for (size_t i = 0; i < size; i++) {
        crc = crc >> 4 ^ table[(crc ^ byte[i]) & 15];
        crc = crc >> 4 ^ table[(crc ^ (uint32_t)(byte[i] >> 4)) & 15];
    }
    return ~crc;
}
