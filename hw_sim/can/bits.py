"""The bits of a frame as they stand on the wire, stuffing and CRC included, and back.

ISO 11898-1:2015. A bit is 0 (dominant) or 1 (recessive). Classic frames are stuffed from start of frame to the end of
the CRC: after five equal bits one of the other value. CAN FD stuffs so up to the end of the payload only; its CRC
field (stuff count, CRC) has a fixed stuff bit before every fourth bit, inverse to the bit before, and the first
of them takes the place of a stuff bit that would be due just there.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache

from .frame import CanFrame

DOMINANT = 0
RECESSIVE = 1
STUFF_RUN = 5
EOF_BITS = 7
INTERMISSION_BITS = 3
FIXED_STUFF_STEP = 4
STUFF_COUNT_BITS = 4
CRC17_MAX_BYTES = 16


@dataclass(frozen=True, slots=True)
class CrcRule:
    """A CRC of the bus: ``width`` bits, generator without its top term, start value."""

    width: int
    polynomial: int
    start: int

    def step(self, register: int, bit: int) -> int:
        """Register after one more bit."""
        top = (register >> (self.width - 1)) & 1
        register = (register << 1) & ((1 << self.width) - 1)
        return register ^ self.polynomial if top ^ bit else register

    def of(self, bits: Iterable[int]) -> int:
        """CRC of a bit sequence."""
        register = self.start
        for bit in bits:
            register = self.step(register, bit)
        return register


CRC15 = CrcRule(15, 0x4599, 0)
CRC17 = CrcRule(17, 0x1685B, 1 << 16)
CRC21 = CrcRule(21, 0x102899, 1 << 20)


def crc_rule(frame: CanFrame) -> CrcRule:
    """The CRC that protects ``frame``."""
    if not frame.fd:
        return CRC15
    return CRC17 if len(frame.data) <= CRC17_MAX_BYTES else CRC21


@dataclass(frozen=True, slots=True)
class WireBits:
    """A frame on the wire, start of frame to the last bit of end of frame (intermission not included).

    ``bits`` holds one byte per bit; ``arbitration`` is the number of leading bits in which a recessive bit may lose
    arbitration; ``nominal_head`` bits, then ``data_phase`` bits at the data bit rate, then the rest at the nominal
    rate; ``ack_slot`` is the index of the acknowledge bit (sent recessive); ``stuff_positions`` are the indexes of
    the stuff bits, fixed ones included.
    """

    bits: bytes
    arbitration: int
    nominal_head: int
    data_phase: int
    ack_slot: int
    stuff_positions: frozenset[int]

    @property
    def nominal_bits(self) -> int:
        """Bits sent at the nominal bit rate, intermission not included."""
        return len(self.bits) - self.data_phase

    def duration_ns(self, nominal_bit_ns: int, data_bit_ns: int, *, intermission: bool = False) -> int:
        """Time on the wire. A bit is counted whole: BRS at the nominal rate, CRC delimiter at the data rate.

        The rate really changes at the sample points of those two bits; with equal sample points the sum is the same.
        """
        nominal = self.nominal_bits + (INTERMISSION_BITS if intermission else 0)
        return nominal * nominal_bit_ns + self.data_phase * data_bit_ns


def to_bits(value: int, width: int) -> list[int]:
    """``width`` bits of ``value``, most significant first."""
    return [(value >> shift) & 1 for shift in range(width - 1, -1, -1)]


def from_bits(bits: Sequence[int]) -> int:
    """Number that ``bits`` spell, most significant first."""
    value = 0
    for bit in bits:
        value = value << 1 | bit
    return value


def stuff_count_bits(stuff_bits: int) -> list[int]:
    """The stuff count field of CAN FD: stuff bits modulo 8 in Gray code, then even parity."""
    count = stuff_bits % 8
    gray = to_bits(count ^ count >> 1, 3)
    return [*gray, sum(gray) % 2]


def arbitration_bits(frame: CanFrame) -> list[int]:
    """SOF up to IDE (standard) or RTR/RRS (extended), without stuffing: the bits that decide who goes on."""
    rtr = RECESSIVE if frame.remote else DOMINANT
    if not frame.extended:
        return [DOMINANT, *to_bits(frame.identifier, 11), rtr, DOMINANT]
    base, rest = to_bits(frame.identifier >> 18, 11), to_bits(frame.identifier & 0x3FFFF, 18)
    return [DOMINANT, *base, RECESSIVE, RECESSIVE, *rest, rtr]


def arbitration_key(frame: CanFrame) -> tuple[int, ...]:
    """Sorts as arbitration decides: the smallest wins. Equal keys send the same arbitration field."""
    return tuple(arbitration_bits(frame))


def header_bits(frame: CanFrame) -> tuple[list[int], int]:
    """SOF to DLC without stuffing, and how many of these bits go out at the nominal rate even with BRS."""
    bits = arbitration_bits(frame)
    if frame.fd:  # FDF recessive, res dominant, BRS; ESI opens the data phase
        bits += [RECESSIVE, DOMINANT, int(frame.bit_rate_switch)]
        nominal = len(bits)
        bits.append(int(frame.error_state_indicator))
    else:  # r0 after IDE, or r1 and r0 after the RTR of an extended frame
        bits += [DOMINANT, DOMINANT] if frame.extended else [DOMINANT]
        nominal = len(bits)
    return bits + to_bits(frame.length_code, 4), nominal


def payload_bits(data: bytes) -> list[int]:
    """Payload, first byte first, most significant bit first."""
    return [bit for byte in data for bit in to_bits(byte, 8)]


def stuff(bits: Sequence[int], *, after_last: bool) -> tuple[list[int], list[int]]:
    """Bits with a stuff bit after every five equal ones (stuff bits count), and the index of each input bit.

    ``after_last``: whether a stuff bit due after the very last bit is sent (classic: yes, FD: the fixed one is).
    """
    out: list[int] = []
    where: list[int] = []
    run = 0
    for index, bit in enumerate(bits):
        run = run + 1 if out and out[-1] == bit else 1
        where.append(len(out))
        out.append(bit)
        if run == STUFF_RUN and (after_last or index + 1 < len(bits)):
            out.append(1 - bit)
            run = 1
    return out, where


@lru_cache(maxsize=4096)
def wire_bits(frame: CanFrame) -> WireBits:
    """The bits that a transmitter of ``frame`` sends."""
    header, nominal = header_bits(frame)
    arbitration = len(arbitration_bits(frame))
    content = header + payload_bits(frame.data)
    if frame.fd:
        return _fd_bits(frame, content, arbitration, nominal)
    protected = content + to_bits(CRC15.of(content), CRC15.width)
    stuffed, where = stuff(protected, after_last=True)
    bits = stuffed + [RECESSIVE] * (3 + EOF_BITS)  # CRC delimiter, ACK slot, ACK delimiter
    return WireBits(
        bits=bytes(bits),
        arbitration=where[arbitration - 1] + 1,
        nominal_head=len(bits),
        data_phase=0,
        ack_slot=len(stuffed) + 1,
        stuff_positions=frozenset(range(len(stuffed))) - frozenset(where),
    )


def _fd_bits(frame: CanFrame, content: list[int], arbitration: int, nominal: int) -> WireBits:
    stuffed, where = stuff(content, after_last=False)
    rule = crc_rule(frame)
    count = stuff_count_bits(len(stuffed) - len(content))
    crc_field = count + to_bits(rule.of(stuffed + count), rule.width)
    bits, fixed = list(stuffed), []
    for index, bit in enumerate(crc_field):
        if index % FIXED_STUFF_STEP == 0:
            fixed.append(len(bits))
            bits.append(1 - bits[-1])
        bits.append(bit)
    ack_slot = len(bits) + 1
    head = where[nominal - 1] + 1  # a stuff bit after BRS is sent at the data rate already
    tail = [RECESSIVE] * (3 + EOF_BITS)
    return WireBits(
        bits=bytes(bits + tail),
        arbitration=where[arbitration - 1] + 1,
        nominal_head=head if frame.bit_rate_switch else len(bits) + len(tail),
        data_phase=ack_slot - head if frame.bit_rate_switch else 0,
        ack_slot=ack_slot,
        stuff_positions=(frozenset(range(len(stuffed))) - frozenset(where)) | frozenset(fixed),
    )
