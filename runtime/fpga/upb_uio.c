#define _POSIX_C_SOURCE 200809L

#include "upb_uio.h"

#include <errno.h>
#include <fcntl.h>
#include <poll.h>
#include <sys/mman.h>
#include <unistd.h>

static int read_register(void *user, uint32_t address, uint32_t *value) {
    const upb_uio *uio = user;
    if (address >= UPB_REGS_BYTES || address % 4)
        return -1;
    *value = uio->registers[address / 4];
    return 0;
}

static int write_register(void *user, uint32_t address, uint32_t value) {
    const upb_uio *uio = user;
    if (address >= UPB_REGS_BYTES || address % 4)
        return -1;
    uio->registers[address / 4] = value;
    return 0;
}

upb_fpga_bus upb_uio_bus(upb_uio *uio) {
    const upb_fpga_bus bus = {read_register, write_register, uio};
    return bus;
}

upb_fpga_status upb_uio_open(upb_uio *uio, const char *path) {
    if (!uio || !path)
        return UPB_FPGA_E_ARGUMENT;
    uio->registers = NULL;
    uio->file = open(path, O_RDWR | O_SYNC | O_CLOEXEC);
    if (uio->file < 0)
        return UPB_FPGA_E_SYSTEM;
    void *mapped = mmap(NULL, UPB_REGS_BYTES, PROT_READ | PROT_WRITE, MAP_SHARED, uio->file, 0);
    if (mapped == MAP_FAILED) {
        const int reason = errno;
        (void)close(uio->file);
        uio->file = -1;
        errno = reason;
        return UPB_FPGA_E_SYSTEM;
    }
    uio->registers = mapped;
    return UPB_FPGA_OK;
}

void upb_uio_close(upb_uio *uio) {
    if (!uio || !uio->registers)
        return;
    (void)munmap((void *)(uintptr_t)uio->registers, UPB_REGS_BYTES);
    (void)close(uio->file);
    uio->registers = NULL;
    uio->file = -1;
}

upb_fpga_status upb_uio_enable(upb_uio *uio) {
    const int32_t one = 1;
    if (!uio || !uio->registers)
        return UPB_FPGA_E_ARGUMENT;
    return write(uio->file, &one, sizeof one) == (ssize_t)sizeof one ? UPB_FPGA_OK : UPB_FPGA_E_SYSTEM;
}

upb_fpga_status upb_uio_wait(upb_uio *uio, int timeout_ms, uint32_t *count, int *came) {
    if (!uio || !uio->registers || !count || !came)
        return UPB_FPGA_E_ARGUMENT;
    struct pollfd waiting = {uio->file, POLLIN, 0};
    int ready;
    do
        ready = poll(&waiting, 1, timeout_ms);
    while (ready < 0 && errno == EINTR);
    *came = ready > 0;
    if (ready < 0)
        return UPB_FPGA_E_SYSTEM;
    if (ready > 0 && read(uio->file, count, sizeof *count) != (ssize_t)sizeof *count)
        return UPB_FPGA_E_SYSTEM;
    return UPB_FPGA_OK;
}
