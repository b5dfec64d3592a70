"""E2E protection against CRCs of another library and a plain restatement of the profiles."""

from __future__ import annotations

import pytest
from crccheck.crc import Crc8Base, Crc16Ibm3740
from hypothesis import given
from hypothesis import strategies as st

from upbeam.runtime.bus import Machine, Receiver, crc8, crc16, protect

OK, SOME_LOST, WRONG_CRC, REPEATED, WRONG_SEQUENCE, NO_NEW_DATA = range(6)


class Crc8GsmA(Crc8Base):
    """CRC-8/GSM-A: the polynomial of SAE J1850, no start value, no final XOR."""

    _poly = 0x1D
    _initvalue = 0x00
    _xor_output = 0x00


def test_check_values_of_the_catalogue() -> None:
    assert crc8(b"123456789") == 0x37
    assert crc16(b"123456789") == 0x29B1


@given(st.binary(max_size=80))
def test_crcs_agree_with_another_implementation(data: bytes) -> None:
    assert crc8(data) == Crc8GsmA.calc(data)
    assert crc16(data) == Crc16Ibm3740.calc(data)


@pytest.mark.parametrize(
    ("profile", "data_id", "counter", "expected"),
    [  # the protect examples of AUTOSAR FO PRS_E2EProtocol, as public implementations quote them: eight bytes of zeros
        (11, 0x123, 0, "2a10000000000000"),
        (11, 0x123, 1, "7711000000000000"),
        (5, 0x1234, 0, "1cca000000000000"),
        (5, 0x1234, 1, "cf8d010000000000"),
    ],
)
def test_published_examples(profile: int, data_id: int, counter: int, expected: str) -> None:
    assert protect(profile, data_id, counter, bytes(8))[0].hex() == expected


@given(st.integers(0, 0xEFF), st.integers(0, 14), st.binary(min_size=8, max_size=8))
def test_profile_11_restated(data_id: int, counter: int, data: bytes) -> None:
    body = bytes([data_id >> 8 << 4 | counter]) + data[2:]
    expected = bytes([Crc8GsmA.calc(bytes([data_id & 0xFF, 0]) + body)]) + body
    assert protect(11, data_id, counter, data) == (expected, (counter + 1) % 15)


@given(st.integers(0, 0xFFFF), st.integers(0, 255), st.binary(min_size=3, max_size=64))
def test_profile_5_restated(data_id: int, counter: int, data: bytes) -> None:
    body = bytes([counter]) + data[3:]
    crc = Crc16Ibm3740.calc(body + data_id.to_bytes(2, "little"))
    assert protect(5, data_id, counter, data) == (crc.to_bytes(2, "little") + body, (counter + 1) % 256)


@pytest.mark.parametrize(("profile", "modulus", "length"), [(11, 15, 8), (5, 256, 24)])
@given(steps=st.lists(st.integers(0, 300), max_size=30), limit=st.integers(1, 14))
def test_receiver_judges_by_how_far_the_counter_went(
    profile: int, modulus: int, length: int, steps: list[int], limit: int
) -> None:
    receiver = Receiver(profile, 0x210, length, limit)
    counter = modulus - 1  # as if the message before the first had been the last of a round
    for step in steps:
        counter = (counter + step) % modulus
        status = receiver.check(protect(profile, 0x210, counter, bytes(length))[0])
        delta = step % modulus
        expected = REPEATED if delta == 0 else OK if delta == 1 else SOME_LOST if delta <= limit else WRONG_SEQUENCE
        assert status == expected
    assert receiver.check(None) == NO_NEW_DATA


@given(st.integers(0, 0xEFF), st.integers(0, 0xEFF), st.integers(0, 63))
def test_damage_and_other_messages_are_noticed(data_id: int, other: int, bit: int) -> None:
    message = protect(11, data_id, 0, b"\xa5" * 8)[0]
    damaged = (int.from_bytes(message, "little") ^ 1 << bit).to_bytes(8, "little")
    assert Receiver(11, data_id, 8, 1).check(damaged) == WRONG_CRC
    if other != data_id:
        assert Receiver(11, other, 8, 1).check(message) == WRONG_CRC
    assert Receiver(11, data_id, 8, 1).check(message) == OK


def test_a_good_checksum_does_not_make_up_for_a_wrong_header() -> None:
    """Counter 15 is never sent; the nibble of another data id with the same low byte is another message."""
    for second in (0x2F, 0x30):
        body = bytes([second]) + bytes(6)
        message = bytes([Crc8GsmA.calc(bytes([0x10, 0]) + body)]) + body
        assert Receiver(11, 0x210, 8, 14).check(message) == WRONG_CRC


def restated_machine(
    statuses: list[int], windows: dict[str, tuple[int, int, int]], clear_to_invalid: bool
) -> list[int]:
    """The state machine of PRS_E2EProtocol in its own words: numbers of good and wrong checks among the last few."""
    states = ["NODATA", "INIT", "VALID", "INVALID"]
    state = "NODATA"
    history: list[int] = []
    path = []
    for status in statuses:
        if state == "NODATA":
            if status not in (WRONG_CRC, NO_NEW_DATA):
                state = "INIT"
        else:
            size, least, most = windows[state]
            history = [*history, status][-size:]
            good = sum(s in (OK, SOME_LOST) for s in history)
            wrong = history.count(WRONG_CRC)
            if wrong <= most and good >= least:
                state = "VALID"
            elif (state == "INIT" and wrong > most) or state == "VALID":
                state = "INVALID"
                if clear_to_invalid:
                    history = []
        path.append(states.index(state))
    return path


window = st.integers(1, 16).flatmap(lambda n: st.tuples(st.just(n), st.integers(0, n), st.integers(0, n)))


@given(st.lists(st.integers(0, 5), max_size=60), window, window, window, st.booleans())
def test_state_machine_restated(
    statuses: list[int],
    init: tuple[int, int, int],
    valid: tuple[int, int, int],
    invalid: tuple[int, int, int],
    clear: bool,
) -> None:
    machine = Machine(init, valid, invalid, clear)
    windows = {"INIT": init, "VALID": valid, "INVALID": invalid}
    assert [machine.step(s) for s in statuses] == restated_machine(statuses, windows, clear)


def test_every_message_of_the_device_passes_its_receiver(desk) -> None:  # type: ignore[no-untyped-def]
    from upbeam.runtime.bus import Record, messages

    for _ in range(5):
        desk.device.ledger(Record())
        desk.device.report(1, 3, 0)
        desk.run(1000)
    receivers = {m[1]: Receiver(5 if m[2] else 11, m[4], m[5], 1) for m in messages()}
    frames = desk.device.take_can()
    assert {can_id for can_id, _, _ in frames} == set(receivers)
    assert {receivers[can_id].check(data) for can_id, _, data in frames} == {OK}
