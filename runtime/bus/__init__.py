"""The device's buses: the C library of ``runtime/bus`` for Python, as tests and simulations use it.

:class:`Device` is the library's ``upb_bus`` on a desk: frames, bytes and time in, frames and bytes out. The functions
are its parts (E2E protection, CMAC, COBS). C programs include ``upbeam/bus.h``.
"""

from ._bus import (
    COUNTERS,
    DROP_CAUSES,
    FAULTS,
    Device,
    Machine,
    Parser,
    Receiver,
    Record,
    Snapshot,
    cmac,
    cobs_decode,
    cobs_encode,
    command_bytes,
    console_encode,
    crc8,
    crc16,
    fault_debounce,
    fault_dtc,
    fault_name,
    frame_decode,
    frame_encode,
    messages,
    protect,
)

__all__ = [
    "COUNTERS",
    "DROP_CAUSES",
    "FAULTS",
    "Device",
    "Machine",
    "Parser",
    "Receiver",
    "Record",
    "Snapshot",
    "cmac",
    "cobs_decode",
    "cobs_encode",
    "command_bytes",
    "console_encode",
    "crc8",
    "crc16",
    "fault_debounce",
    "fault_dtc",
    "fault_name",
    "frame_decode",
    "frame_encode",
    "messages",
    "protect",
]
