"""The serial console: COBS against the ``cobs`` package, and a parser that is back in step after garbage."""

from __future__ import annotations

from pathlib import Path

import pytest
from cobs import cobs
from crccheck.crc import Crc16Ibm3740
from hypothesis import given
from hypothesis import strategies as st

from upbeam.runtime.bus import Parser, cobs_decode, cobs_encode, console_encode, frame_decode, frame_encode

runs = st.builds(lambda n, b: bytes([b]) * n, st.integers(0, 600), st.integers(0, 255))
blobs = st.one_of(st.binary(max_size=700), runs, st.builds(lambda a, b: a + b"\0" + b, runs, runs))


@given(blobs)
def test_cobs_encodes_as_the_package(data: bytes) -> None:
    assert cobs_encode(data) == cobs.encode(data)
    assert cobs_decode(cobs.encode(data)) == data


@given(st.binary(min_size=1, max_size=80))
def test_cobs_decodes_as_the_package(data: bytes) -> None:
    try:
        expected = cobs.decode(data)
    except cobs.DecodeError:
        expected = None
    assert cobs_decode(data) == expected


def test_no_bytes_are_no_cobs() -> None:
    assert cobs_decode(b"") is None


lengths = st.sampled_from([0, 1, 8, 12, 24, 64])
frames = st.tuples(st.integers(0, 0x7FF), lengths.flatmap(lambda n: st.binary(min_size=n, max_size=n)))


@given(frames)
def test_a_record_restated(frame: tuple[int, bytes]) -> None:
    can_id, data = frame
    plain = can_id.to_bytes(4, "little") + bytes([3, len(data)]) + data
    assert frame_encode(can_id, data, 3) == plain
    assert frame_decode(plain) == (can_id, 3, data)
    assert console_encode(can_id, data, 3) == cobs.encode(plain + Crc16Ibm3740.calc(plain).to_bytes(2, "big")) + b"\0"


@given(st.lists(st.one_of(frames, st.binary(max_size=300)), max_size=12), st.integers(1, 50))
def test_parser_is_back_in_step_after_garbage(parts: list[tuple[int, bytes] | bytes], chunk: int) -> None:
    """Garbage, a delimiter, a record: every record comes through, however the bytes are cut."""
    stream, expected = b"", []
    for part in parts:
        if isinstance(part, bytes):
            stream += part.replace(b"\0", b"\1") + b"\0"
        else:
            stream += console_encode(part[0], part[1], 3)
            expected.append((part[0], 3, part[1]))
    parser = Parser()
    got = [f for i in range(0, len(stream), chunk) for f in parser.feed(stream[i : i + chunk])]
    garbage = sum(isinstance(part, bytes) and part != b"" for part in parts)
    assert got == expected
    assert parser.refused == garbage


def test_serial_framing_fault_sets_and_heals(desk) -> None:  # type: ignore[no-untyped-def]
    for _ in range(2):
        desk.device.serial(b"\x05noise\0", desk.now)
    assert not desk.device.faults_active
    desk.device.serial(b"\x05noise\0", desk.now)
    assert desk.device.faults_active == 1 << 26  # SERIAL_FRAMING is fault 27
    assert desk.device.serial_refused == 3
    desk.run(5001)
    assert not desk.device.faults_active


CORPUS = [
    [cell.strip() for cell in line.split("|")]
    for line in (Path(__file__).parent / "corpus" / "serial.txt").read_text().splitlines()
    if not line.startswith("#")
]


@pytest.mark.parametrize(("stream", "good", "refused"), [row[1:] for row in CORPUS], ids=[row[0] for row in CORPUS])
def test_corpus(stream: str, good: str, refused: str) -> None:
    parser = Parser()
    assert len(parser.feed(bytes.fromhex(stream))) == int(good)
    assert parser.refused == int(refused)
