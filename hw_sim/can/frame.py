"""One CAN frame: classic CAN 2.0A/B and CAN FD (ISO 11898-1:2015)."""

from __future__ import annotations

from dataclasses import dataclass

FD_LENGTHS = (0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64)
"""Payload length in bytes of each data length code of CAN FD."""

CLASSIC_MAX_BYTES = 8
STANDARD_ID_BITS = 11
EXTENDED_ID_BITS = 29


@dataclass(frozen=True, slots=True)
class CanFrame:
    """A data or remote frame as a node hands it to its controller.

    ``identifier`` has 11 bits, or 29 with ``extended``. ``data`` holds 0 to 8 bytes, with ``fd`` one of
    :data:`FD_LENGTHS`. ``bit_rate_switch`` (FD only) sends payload and CRC at the data bit rate;
    ``error_state_indicator`` (FD only) says that the sender is error passive. ``remote`` (classic only) asks for
    ``remote_length`` bytes and carries none. :raises ValueError: for anything that no controller could send.
    """

    identifier: int
    data: bytes = b""
    extended: bool = False
    fd: bool = False
    bit_rate_switch: bool = False
    error_state_indicator: bool = False
    remote: bool = False
    remote_length: int = 0

    def __post_init__(self) -> None:
        bits = EXTENDED_ID_BITS if self.extended else STANDARD_ID_BITS
        if not 0 <= self.identifier < 1 << bits:
            raise ValueError(f"identifier {self.identifier:#x} does not fit {bits} bits")
        if self.fd and self.remote:
            raise ValueError(f"identifier {self.identifier:#x}: CAN FD has no remote frames")
        if self.fd and len(self.data) not in FD_LENGTHS:
            raise ValueError(f"identifier {self.identifier:#x}: no CAN FD frame has {len(self.data)} bytes")
        if not self.fd and len(self.data) > CLASSIC_MAX_BYTES:
            raise ValueError(f"identifier {self.identifier:#x}: {len(self.data)} bytes, a classic frame holds 8")
        if not self.fd and (self.bit_rate_switch or self.error_state_indicator):
            raise ValueError(f"identifier {self.identifier:#x}: bit rate switch and ESI belong to CAN FD")
        if self.remote and (self.data or not 0 <= self.remote_length <= CLASSIC_MAX_BYTES):
            raise ValueError(f"identifier {self.identifier:#x}: a remote frame has no data, it asks for 0 to 8 bytes")

    @property
    def length_code(self) -> int:
        """The 4-bit DLC."""
        if self.remote:
            return self.remote_length
        return FD_LENGTHS.index(len(self.data)) if self.fd else len(self.data)

    @property
    def name(self) -> str:
        """Identifier as tools print it: three hexadecimal digits, eight where extended."""
        return f"{self.identifier:08X}" if self.extended else f"{self.identifier:03X}"


def fd_length(needed: int) -> int:
    """Smallest CAN FD payload length of at least ``needed`` bytes. :raises ValueError: above 64."""
    for length in FD_LENGTHS:
        if length >= needed:
            return length
    raise ValueError(f"{needed} bytes do not fit a CAN FD frame (64 at most)")
