"""A CAN frame as bytes: in a UDP datagram of its own, and inside a record of the serial console.

``identifier (4, little-endian) | flags | length | data``, as ``upbeam/can.h`` has it.
"""

from __future__ import annotations

from .frame import CanFrame

FLAG_FD = 1
FLAG_BRS = 2
FLAG_EXTENDED = 4
HEADER_BYTES = 6
MAX_BYTES = HEADER_BYTES + 64


def encode_frame(frame: CanFrame) -> bytes:
    """Bytes of a data frame. :raises ValueError: a remote frame, which the format does not carry."""
    if frame.remote:
        raise ValueError(f"frame {frame.name}: remote frames are not carried")
    flags = FLAG_FD * frame.fd | FLAG_BRS * frame.bit_rate_switch | FLAG_EXTENDED * frame.extended
    return frame.identifier.to_bytes(4, "little") + bytes([flags, len(frame.data)]) + frame.data


def decode_frame(data: bytes) -> CanFrame:
    """The frame of exactly these bytes. :raises ValueError: says what is wrong with them."""
    if len(data) < HEADER_BYTES:
        raise ValueError(f"{len(data)} bytes, a frame has at least {HEADER_BYTES}")
    flags, length = data[4], data[5]
    if flags & ~(FLAG_FD | FLAG_BRS | FLAG_EXTENDED):
        raise ValueError(f"unknown flags {flags:#04x}")
    if len(data) != HEADER_BYTES + length:
        raise ValueError(f"{len(data) - HEADER_BYTES} bytes of data, the length says {length}")
    return CanFrame(
        int.from_bytes(data[:4], "little"),
        bytes(data[HEADER_BYTES:]),
        extended=bool(flags & FLAG_EXTENDED),
        fd=bool(flags & FLAG_FD),
        bit_rate_switch=bool(flags & FLAG_BRS),
    )
