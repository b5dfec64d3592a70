/*
 * The bus of upb_fpga over Linux UIO (uio_pdrv_genirq): registers through mmap of /dev/uioN, the interrupt through
 * read.
 */
#ifndef UPB_UIO_H
#define UPB_UIO_H

#include "upb_fpga.h"

#ifdef __cplusplus
extern "C" {
#endif

typedef struct upb_uio {
    int file;
    volatile uint32_t *registers;
} upb_uio;

/* Maps UPB_REGS_BYTES of map 0 of `path`. Errors: E_ARGUMENT, E_SYSTEM (errno). Closed by upb_uio_close. */
upb_fpga_status upb_uio_open(upb_uio *uio, const char *path);
void upb_uio_close(upb_uio *uio);

/* The bus; `uio` must stay where it is. */
upb_fpga_bus upb_uio_bus(upb_uio *uio);

/* Lets the next interrupt through: UIO masks the line with each. Call it after upb_fpga_take_events. Errors: E_SYSTEM.
 */
upb_fpga_status upb_uio_enable(upb_uio *uio);

/* Waits at most so long (-1: for ever). *count: interrupts so far as the kernel counts them; *came: 0 after the time.
 * Errors: E_ARGUMENT, E_SYSTEM. */
upb_fpga_status upb_uio_wait(upb_uio *uio, int timeout_ms, uint32_t *count, int *came);

#ifdef __cplusplus
}
#endif

#endif
