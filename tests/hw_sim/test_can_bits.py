"""Bits of CAN frames: stuffing, CRC, lengths, and reading them back."""

from __future__ import annotations

import itertools
import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from upbeam.hw_sim.can.analysis import bound_length, length_of, longest_length, shortest_length
from upbeam.hw_sim.can.bits import CRC15, CRC17, CRC21, arbitration_key, stuff, wire_bits
from upbeam.hw_sim.can.frame import FD_LENGTHS, CanFrame, fd_length
from upbeam.hw_sim.can.station import ErrorKind, receive_bits

INTERMISSION = [1, 1, 1]


@st.composite
def frames(draw: st.DrawFn, *, remote: bool = True) -> CanFrame:
    """Any frame; payloads lean towards long runs."""
    extended, fd = draw(st.booleans()), draw(st.booleans())
    identifier = draw(st.integers(0, (1 << (29 if extended else 11)) - 1))
    if remote and not fd and draw(st.integers(0, 9)) == 0:
        return CanFrame(identifier, extended=extended, remote=True, remote_length=draw(st.integers(0, 8)))
    length = draw(st.sampled_from(FD_LENGTHS) if fd else st.integers(0, 8))
    byte = st.one_of(st.sampled_from([0x00, 0xFF, 0x78, 0x87, 0x0F, 0xF0]), st.integers(0, 255))
    data = bytes(draw(st.lists(byte, min_size=length, max_size=length)))
    return CanFrame(identifier, data, extended, fd, fd and draw(st.booleans()), fd and draw(st.booleans()))


@settings(max_examples=200, deadline=None)
@given(frames())
def test_every_frame_reads_back_from_its_bits(frame: CanFrame) -> None:
    got, errors = receive_bits([*wire_bits(frame).bits, *INTERMISSION])
    assert got == [frame]
    assert not errors


@settings(max_examples=100, deadline=None)
@given(st.lists(st.integers(0, 1), max_size=80), st.booleans())
def test_stuffing_against_brute_force(bits: list[int], after_last: bool) -> None:
    """The oracle: walk along what was sent, a stuff bit stands after every five equal ones and nowhere else."""
    stuffed, where = stuff(bits, after_last=after_last)
    out: list[int] = []
    for index, bit in enumerate(bits):
        out.append(bit)
        due = len(out) >= 5 and len(set(out[-5:])) == 1
        if due and (after_last or index + 1 < len(bits)):
            out.append(1 - bit)
    assert stuffed == out
    assert [stuffed[i] for i in where] == bits
    runs = [len(list(group)) for _, group in itertools.groupby(stuffed)]
    assert max(runs, default=0) <= 5


def divide(bits: list[int], generator: int, width: int, start: int) -> int:
    """CRC by long division of the polynomial over GF(2), the start value added to the first bits."""
    number = 0
    for bit in [*bits, *([0] * width)]:
        number = number << 1 | bit
    number ^= start << len(bits)
    while number.bit_length() > width:
        number ^= generator << (number.bit_length() - width - 1)
    return number


@settings(max_examples=100, deadline=None)
@given(st.lists(st.integers(0, 1), min_size=1, max_size=120))
def test_crc_is_the_remainder_of_the_standards_polynomials(bits: list[int]) -> None:
    powers15 = (15, 14, 10, 8, 7, 4, 3, 0)
    powers17 = (17, 16, 14, 13, 11, 6, 4, 3, 1, 0)
    powers21 = (21, 20, 13, 11, 7, 4, 3, 0)
    for rule, powers in ((CRC15, powers15), (CRC17, powers17), (CRC21, powers21)):
        assert rule.of(bits) == divide(bits, sum(1 << p for p in powers), rule.width, rule.start)


@pytest.mark.parametrize(("size", "bits"), [(0, 47), (1, 55), (4, 79), (8, 111)])
def test_length_without_stuffing_is_that_of_the_standard(size: int, bits: int) -> None:
    """SOF, identifier, RTR, IDE, r0, DLC, payload, CRC and delimiters, end of frame, intermission; 20 more extended."""
    for extended in (False, True):
        frame = CanFrame(0x555, bytes([0x55] * size), extended)
        assert length_of(frame).bits - len(wire_bits(frame).stuff_positions) == bits + 20 * extended


def test_a_frame_written_out_by_hand() -> None:
    """Identifier 0x014, one byte 0x01: stuff bits after the first five zeros, after r0 and within the payload."""
    frame = CanFrame(0x014, b"\x01")
    plain = [int(bit) for bit in "000000010100000000100000001"]
    crc = divide(plain, 0xC599, 15, 0)
    head = "000001001010000010001000001001"
    tail = f"{crc:015b}"  # 111011101010011: nothing to stuff
    assert "".join(map(str, wire_bits(frame).bits)) == head + tail + "1111111111"


@pytest.mark.parametrize(("size", "standard", "extended"), [(0, 55, 80), (1, 65, 90), (4, 95, 120), (8, 135, 160)])
def test_classical_bound_has_the_textbook_values(size: int, standard: int, extended: int) -> None:
    assert bound_length(CanFrame(0x123, bytes(size))).bits == standard
    assert bound_length(CanFrame(0x123, bytes(size), extended=True)).bits == extended


@pytest.mark.parametrize("identifier", [0x000, 0x078, 0x10F, 0x210, 0x7FF])
@pytest.mark.parametrize("fd", [False, True])
def test_longest_and_shortest_frame_against_every_payload(identifier: int, fd: bool) -> None:
    for size in (0, 1):
        sizes = {
            length_of(CanFrame(identifier, bytes(data), fd=fd, bit_rate_switch=fd))
            for data in itertools.product(range(256), repeat=size)
        }
        frame = CanFrame(identifier, bytes(size), fd=fd, bit_rate_switch=fd)
        assert longest_length(frame) == max(sizes, key=lambda length: length.bits)
        assert shortest_length(frame) == min(sizes, key=lambda length: length.bits)


@settings(max_examples=40, deadline=None)
@given(frames(remote=False))
def test_no_frame_is_longer_than_the_longest_nor_that_than_the_bound(frame: CanFrame) -> None:
    if not frame.fd and frame.extended:  # the search over CRC states takes a while
        frame = CanFrame(frame.identifier & 0x7FF, frame.data)
    if not frame.fd:
        frame = CanFrame(frame.identifier & 0x70F, frame.data)
    actual, longest, bound = length_of(frame), longest_length(frame), bound_length(frame)
    assert shortest_length(frame).bits <= actual.bits <= longest.bits <= bound.bits
    assert actual.nominal <= longest.nominal <= bound.nominal
    assert longest.time_ns(2000, 500) <= bound.time_ns(2000, 500)


@settings(max_examples=30, deadline=None)
@given(frames(), st.data())
def test_a_listener_finds_every_single_bit_error(frame: CanFrame, data: st.DataObject) -> None:
    bits = list(wire_bits(frame).bits)
    at = data.draw(st.integers(0, len(bits) - 2))  # the last bit of EOF is too late for a listener to refuse
    if at == wire_bits(frame).ack_slot:
        return
    bits[at] ^= 1
    got, errors = receive_bits([*bits, *([1] * 30)])
    if at == 0:  # no start of frame: whatever the listener makes of the rest, it is not this frame
        assert frame not in got
        return
    assert not got
    assert errors
    assert errors[0][0] >= at


def test_kinds_of_errors_by_where_they_strike() -> None:
    frame = CanFrame(0x123, b"\x12\x34\x56\x78")
    wire = wire_bits(frame)

    def first_error(at: int, bits: bytes = wire.bits) -> ErrorKind:
        damaged = list(bits)
        damaged[at] ^= 1
        return receive_bits([*damaged, *([1] * 30)])[1][0][1]

    assert first_error(min(wire.stuff_positions)) is ErrorKind.STUFF
    assert first_error(wire.ack_slot + 1) is ErrorKind.FORM  # ACK delimiter
    assert first_error(wire.ack_slot - 1) is ErrorKind.FORM  # CRC delimiter
    assert first_error(len(wire.bits) - 4) is ErrorKind.FORM  # end of frame
    kinds = {first_error(at) for at in range(1, wire.ack_slot - 1)}
    assert ErrorKind.CRC in kinds


def test_arbitration_order_is_that_of_the_bits() -> None:
    standard = CanFrame(0x123, b"1")
    asked = CanFrame(0x123, remote=True)
    extended = CanFrame(0x123 << 18, b"1", extended=True)
    higher = CanFrame(0x122, b"1")
    order = sorted([extended, asked, standard, higher], key=arbitration_key)
    assert order == [higher, standard, asked, extended]
    rng = random.Random(3)
    for _ in range(200):
        one, two = (CanFrame(rng.randrange(1 << 11)) for _ in range(2))
        assert (arbitration_key(one) < arbitration_key(two)) == (one.identifier < two.identifier)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"identifier": 0x800}, "does not fit 11 bits"),
        ({"identifier": 1 << 29, "extended": True}, "does not fit 29 bits"),
        ({"identifier": 1, "data": bytes(9)}, "a classic frame holds 8"),
        ({"identifier": 1, "data": bytes(9), "fd": True}, "no CAN FD frame has 9"),
        ({"identifier": 1, "bit_rate_switch": True}, "belong to CAN FD"),
        ({"identifier": 1, "fd": True, "remote": True}, "no remote frames"),
        ({"identifier": 1, "data": b"1", "remote": True}, "a remote frame has no data"),
    ],
)
def test_what_no_controller_could_send_is_refused(arguments: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        CanFrame(**arguments)  # type: ignore[arg-type]


def test_fd_lengths() -> None:
    assert [fd_length(n) for n in (0, 8, 9, 33, 64)] == [0, 8, 12, 48, 64]
    with pytest.raises(ValueError, match="do not fit"):
        fd_length(65)
