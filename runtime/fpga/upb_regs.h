/* Register map of the upbeam FPGA core. Generated from kernels/rtl/registers.toml; do not edit. */
/* clang-format off */
#ifndef UPB_REGS_H
#define UPB_REGS_H

#define UPB_REGS_ID 0x42505531u
#define UPB_REGS_VERSION_MAJOR 1u
#define UPB_REGS_VERSION_MINOR 0u
#define UPB_REGS_VERSION_PATCH 0u
#define UPB_REGS_BYTES 0x8000u
#define UPB_REGS_WEIGHTS 0x4000u
#define UPB_REGS_WEIGHTS_BYTES 0x4000u

/* ro: 0x42505531: this is an upbeam core */
#define UPB_REG_ID 0x000u

/* ro: of this register map */
#define UPB_REG_VERSION 0x004u
#define UPB_VERSION_PATCH 0x000000ffu /* corrections */
#define UPB_VERSION_PATCH_SHIFT 0u
#define UPB_VERSION_MINOR 0x0000ff00u /* additions */
#define UPB_VERSION_MINOR_SHIFT 8u
#define UPB_VERSION_MAJOR 0x00ff0000u /* software for another major version does not fit */
#define UPB_VERSION_MAJOR_SHIFT 16u

/* ro: id of the integer contract, 16 ASCII characters in CONTRACT_0 to 3, the top byte first, zeros before them */
#define UPB_REG_CONTRACT_0 0x008u

/* ro: see CONTRACT_0 */
#define UPB_REG_CONTRACT_1 0x00cu

/* ro: see CONTRACT_0 */
#define UPB_REG_CONTRACT_2 0x010u

/* ro: see CONTRACT_0 */
#define UPB_REG_CONTRACT_3 0x014u

/* ro: CRC-32 of the model file in use: built in, or what WEIGHTS_MODEL held at the last swap */
#define UPB_REG_MODEL_CRC 0x018u

/* ro: CRC-32 of the weights image in use; 0 while they are the built-in ones */
#define UPB_REG_WEIGHTS_CRC 0x01cu

/* ro: what the core was elaborated for */
#define UPB_REG_SHAPE 0x020u
#define UPB_SHAPE_FOLD 0x00000fffu /* clocks a window and lane */
#define UPB_SHAPE_FOLD_SHIFT 0u
#define UPB_SHAPE_LANES 0x003ff000u /* windows side by side */
#define UPB_SHAPE_LANES_SHIFT 12u
#define UPB_SHAPE_HIDDEN 0x0fc00000u /* hidden units */
#define UPB_SHAPE_HIDDEN_SHIFT 22u
#define UPB_SHAPE_WIDE 0x10000000u /* weights have 16 bits (int16), not 8 (int8) */
#define UPB_SHAPE_WRITABLE 0x20000000u /* weights can be written */
#define UPB_SHAPE_DESTAGGER 0x40000000u /* a destagger ring stands before the core */

/* ro: shifts of the distance network (docs/numeric-contract.md): fixed at elaboration */
#define UPB_REG_SCALE_DISTANCE 0x024u
#define UPB_SCALE_DISTANCE_K 0x000000ffu /* k */
#define UPB_SCALE_DISTANCE_K_SHIFT 0u
#define UPB_SCALE_DISTANCE_J 0x0000ff00u /* j */
#define UPB_SCALE_DISTANCE_J_SHIFT 8u
#define UPB_SCALE_DISTANCE_T 0x00ff0000u /* t */
#define UPB_SCALE_DISTANCE_T_SHIFT 16u
#define UPB_SCALE_DISTANCE_SKIP 0x01000000u /* skip */

/* ro: shifts of the intensity network */
#define UPB_REG_SCALE_INTENSITY 0x028u
#define UPB_SCALE_INTENSITY_K 0x000000ffu /* k */
#define UPB_SCALE_INTENSITY_K_SHIFT 0u
#define UPB_SCALE_INTENSITY_J 0x0000ff00u /* j */
#define UPB_SCALE_INTENSITY_J_SHIFT 8u
#define UPB_SCALE_INTENSITY_T 0x00ff0000u /* t */
#define UPB_SCALE_INTENSITY_T_SHIFT 16u
#define UPB_SCALE_INTENSITY_SKIP 0x01000000u /* skip */

/* ro: slopes of the rectifiers, in 1/32768 */
#define UPB_REG_SLOPES 0x02cu
#define UPB_SLOPES_DISTANCE 0x0000ffffu /* of the distance network */
#define UPB_SLOPES_DISTANCE_SHIFT 0u
#define UPB_SLOPES_INTENSITY 0xffff0000u /* of the intensity network */
#define UPB_SLOPES_INTENSITY_SHIFT 16u

/* ro: the destagger ring; 0 without one */
#define UPB_REG_RING 0x030u
#define UPB_RING_SLOTS 0x0000ffffu /* columns that fill at the same time */
#define UPB_RING_SLOTS_SHIFT 0u
#define UPB_RING_DELAY 0xffff0000u /* firing columns from a column to its last beam */
#define UPB_RING_DELAY_SHIFT 16u

/* ro: frequency of aclk as it was told at elaboration; 0 if it was not */
#define UPB_REG_CLOCK_HZ 0x034u

/* rw: control */
#define UPB_REG_CONTROL 0x040u
#define UPB_CONTROL_ENABLE 0x00000001u /* 1: the core runs; 0: it is held in reset, and what is in it is lost */

/* ro: state */
#define UPB_REG_STATUS 0x044u
#define UPB_STATUS_RUNNING 0x00000001u /* the core is out of reset (64 clocks after ENABLE at the latest) */
#define UPB_STATUS_SWAP_PENDING 0x00000002u /* written weights wait for the next frame */
#define UPB_STATUS_BANK 0x00000004u /* bank of the weights in use */
#define UPB_STATUS_IRQ 0x00000008u /* level of the interrupt line */

/* rw: columns of a frame, 4 to 65535; from the model at reset. Written while the core runs, or beyond these limits: SLVERR */
#define UPB_REG_COLUMNS 0x048u

/* rw: clocks from a frame's last input column to its last output beat after which it has missed (and that a beat may wait for the sink); 0: no deadline */
#define UPB_REG_DEADLINE 0x04cu

/* w1c: what has happened since it was cleared */
#define UPB_REG_EVENTS 0x050u
#define UPB_EVENTS_FRAME 0x00000001u /* a frame has left */
#define UPB_EVENTS_SWAPPED 0x00000002u /* written weights are in use */
#define UPB_EVENTS_DEADLINE 0x00000004u /* a frame has not left within DEADLINE */
#define UPB_EVENTS_SHORT_COLUMN 0x00000008u /* error: tlast, or a new frame, before beam 31 */
#define UPB_EVENTS_LONG_COLUMN 0x00000010u /* error: no tlast with beam 31 */
#define UPB_EVENTS_SHORT_FRAME 0x00000020u /* error: a new frame before COLUMNS columns */
#define UPB_EVENTS_LONG_FRAME 0x00000040u /* error: more than COLUMNS columns */
#define UPB_EVENTS_DROPPED 0x00000080u /* error: beats were dropped while waiting for a frame */
#define UPB_EVENTS_OVERRUN 0x00000100u /* error: the output FIFO lost a beat (a fault of the core) */
#define UPB_EVENTS_WEIGHTS 0x00000200u /* error: a swap was refused: length or CRC-32 of what was written is another */
#define UPB_EVENTS_STALLED 0x00000400u /* a beat has waited at m_axis for DEADLINE clocks: the sink is stuck, and soon the source will be */

/* rw: bits of EVENTS that raise the interrupt, a level: high while any of them is set in both */
#define UPB_REG_IRQ_ENABLE 0x054u

/* ro: frames begun at the input, modulo 2^32, like all counters; cleared when ENABLE rises */
#define UPB_REG_FRAMES_IN 0x060u

/* ro: whole columns taken */
#define UPB_REG_COLUMNS_IN 0x064u

/* ro: whole frames that left */
#define UPB_REG_FRAMES_OUT 0x068u

/* ro: columns that left */
#define UPB_REG_COLUMNS_OUT 0x06cu

/* ro: beats dropped while waiting for a frame */
#define UPB_REG_DROPPED 0x070u

/* ro: short and long columns and frames together */
#define UPB_REG_ERRORS 0x074u

/* ro: frames that missed the deadline */
#define UPB_REG_MISSES 0x078u

/* ro: of the last whole frame: clocks from its first input beat in the core to its last output beat */
#define UPB_REG_FRAME_CLOCKS 0x07cu

/* ro: of the last whole frame: clocks from its last input column in the core to its last output beat */
#define UPB_REG_LATENCY 0x080u

/* ro: largest LATENCY since ENABLE */
#define UPB_REG_LATENCY_MAX 0x084u

/* wo: loading weights; SLVERR where they cannot be written, and while a swap is pending */
#define UPB_REG_WEIGHTS_COMMAND 0x0a0u
#define UPB_WEIGHTS_COMMAND_BEGIN 0x00000001u /* a new image begins: clears WEIGHTS_WRITTEN and WEIGHTS_SUM */
#define UPB_WEIGHTS_COMMAND_SWAP 0x00000002u /* use what was written from the next frame on, if length and CRC-32 are as expected; else EVENTS.WEIGHTS */

/* ro: words written since BEGIN */
#define UPB_REG_WEIGHTS_WRITTEN 0x0a4u

/* ro: CRC-32 (as zlib's) of them: of each its byte address from `weights` on, then its value, both as four bytes, low first */
#define UPB_REG_WEIGHTS_SUM 0x0a8u

/* rw: words expected */
#define UPB_REG_WEIGHTS_LENGTH 0x0acu

/* rw: CRC-32 expected */
#define UPB_REG_WEIGHTS_EXPECTED 0x0b0u

/* rw: CRC-32 of the model file that the image is of; becomes MODEL_CRC */
#define UPB_REG_WEIGHTS_MODEL 0x0b4u

#endif
