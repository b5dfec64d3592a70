"""Commands: CMAC against another library; what is not authentic and fresh changes nothing and is counted."""

from __future__ import annotations

from typing import Any

import pytest
from cantools.database.can import Database
from cryptography.hazmat.primitives.ciphers.algorithms import AES
from cryptography.hazmat.primitives.cmac import CMAC
from hypothesis import given
from hypothesis import strategies as st

from upbeam.runtime.bus import cmac, command_bytes, console_encode, protect

STATUS, MODE, MODEL, CLEAR = 1, 2, 3, 4
COMMAND, RESPONSE, FD = 0x300, 0x301, 3


def oracle(key: bytes, data: bytes) -> bytes:
    mac = CMAC(AES(key))
    mac.update(data)
    return mac.finalize()


def sign(key: bytes, body: bytes, sequence: int = 0) -> bytes:
    """Bytes 3 to 15 of a command with MAC and E2E header."""
    return protect(5, 0x300, sequence, bytes(3) + body + oracle(key, (0x300).to_bytes(2, "big") + body)[:8])[0]


def build_command(key: bytes, code: int, freshness: int, argument: int = 0, model: int = 0, sequence: int = 0) -> bytes:
    """A command built without the library, from docs/can.md."""
    text = bytes([code]) + freshness.to_bytes(4, "little") + bytes([argument, 0, 0, 0]) + model.to_bytes(4, "little")
    return sign(key, text, sequence)


@given(st.binary(min_size=16, max_size=16), st.binary(max_size=100))
def test_cmac_agrees_with_another_implementation(key: bytes, data: bytes) -> None:
    assert cmac(key, data) == oracle(key, data)


@given(
    st.binary(min_size=16, max_size=16),
    st.integers(0, 255),
    st.integers(0, (1 << 32) - 1),
    st.integers(0, 255),
    st.integers(0, (1 << 32) - 1),
    st.integers(0, 255),
)
def test_command_bytes_are_those_of_the_document(
    key: bytes, code: int, freshness: int, argument: int, model: int, sequence: int
) -> None:
    assert command_bytes(key, code, freshness, argument, model, sequence) == build_command(
        key, code, freshness, argument, model, sequence
    )


def answers(desk: Any, db: Database) -> list[dict[str, Any]]:
    message = db.get_message_by_name("UPB_Response")
    return [message.decode(d, decode_choices=False) for i, _, d in desk.device.take_can() if i == RESPONSE]  # type: ignore[misc]


def test_a_command_is_carried_out_once(desk: Any, db: Database) -> None:
    data = build_command(desk.key, MODEL, 5, model=0xCAFEBABE)
    assert desk.send(COMMAND, data, FD)
    assert desk.device.take_commands() == [(MODEL, 5, 0, 0xCAFEBABE)]
    (answer,) = answers(desk, db)
    assert (answer["Code"], answer["Freshness"], answer["Result"], answer["StoredFreshness"]) == (MODEL, 5, 0, 5)
    before = dict(desk.storage)
    for _ in range(3):
        desk.send(COMMAND, data, FD)
    desk.restart()
    desk.send(COMMAND, data, FD)
    assert desk.device.take_commands() == []
    assert desk.device.results["STALE"] == 1
    assert desk.storage == before
    desk.send(COMMAND, build_command(desk.key, MODE, 6, 3), FD)
    assert desk.device.take_commands() == [(MODE, 6, 3, 0)]


def test_the_answer_is_authentic_only_to_an_authentic_command(desk: Any, db: Database) -> None:
    desk.send(COMMAND, build_command(desk.key, STATUS, 1), FD)
    desk.send(COMMAND, build_command(bytes(16), STATUS, 2), FD)
    good, forged = (data for can_id, _, data in desk.device.take_can() if can_id == RESPONSE)
    assert good[16:] == oracle(desk.key, (0x301).to_bytes(2, "big") + good[3:16])[:8]
    assert forged[16:] == bytes(8)
    assert forged[8] == 3  # MAC


@pytest.mark.parametrize(
    ("name", "alter"),
    [
        ("E2E", lambda data, key: data[:5] + b"\xff" + data[6:]),
        ("E2E", lambda data, key: data[:20]),
        ("MAC", lambda data, key: protect(5, 0x300, 0, data[:8] + b"\x01" + data[9:])[0]),
        ("MAC", lambda data, key: protect(5, 0x300, 0, data[:16] + bytes(8))[0]),
        ("MAC", lambda data, key: build_command(key[::-1], MODE, 9)),
        ("STALE", lambda data, key: build_command(key, MODE, 4)),
        ("STALE", lambda data, key: build_command(key, MODE, 0)),
        ("UNKNOWN", lambda data, key: build_command(key, 77, 9)),
        ("VALUE", lambda data, key: build_command(key, MODE, 9, 4)),
        ("VALUE", lambda data, key: build_command(key, MODE, 9, model=1)),
        ("VALUE", lambda data, key: build_command(key, MODEL, 9)),
        ("VALUE", lambda data, key: sign(key, data[3:9] + b"\x01" + data[10:16])),  # reserved bytes
        ("VALUE", lambda data, key: sign(key, data[3:11] + b"\x80" + data[12:16])),
    ],
)
def test_every_refusal_has_its_cause(desk: Any, name: str, alter: Any) -> None:
    desk.send(COMMAND, build_command(desk.key, STATUS, 4), FD)
    desk.send(COMMAND, alter(build_command(desk.key, MODE, 9), desk.key), FD)
    assert desk.device.take_commands() == []
    assert desk.device.results == {k: int(k in ("DONE", name)) for k in desk.device.results}
    assert desk.device.faults_active >> 25 & 1  # CAN_COMMAND_REJECTED is fault 26
    desk.run(5001)
    assert not desk.device.faults_active


@pytest.mark.parametrize("key", [None, bytes(16)])
def test_without_a_key_no_command_is_taken(make_desk: Any, key: bytes | None) -> None:
    desk = make_desk(key)
    desk.send(COMMAND, build_command(bytes(16), STATUS, 1), FD)
    assert desk.device.results["NO_KEY"] == 1
    assert desk.storage == {}


def test_a_counter_that_cannot_be_stored_takes_no_command(desk: Any) -> None:
    desk.device.storage_fails = True
    desk.send(COMMAND, build_command(desk.key, MODE, 1), FD)
    assert desk.device.take_commands() == []
    desk.device.storage_fails = False
    desk.send(COMMAND, build_command(desk.key, MODE, 1), FD)
    assert len(desk.device.take_commands()) == 1
    assert desk.device.results["STORAGE"] == 1


def test_the_counter_is_used_up_by_a_command_that_was_refused_inside(desk: Any) -> None:
    desk.device.execute_answer = 8  # REFUSED
    data = build_command(desk.key, MODEL, 3, model=1)
    desk.send(COMMAND, data, FD)
    desk.device.execute_answer = 0
    desk.send(COMMAND, data, FD)
    assert len(desk.device.take_commands()) == 1
    assert desk.device.results == {k: int(k in ("REFUSED", "STALE")) for k in desk.device.results}


def test_serial_and_can_share_the_counter(desk: Any) -> None:
    data = build_command(desk.key, MODE, 7, 1)
    desk.device.serial(console_encode(COMMAND, data, FD), desk.now)
    assert desk.device.take_commands() == [(MODE, 7, 1, 0)]
    desk.send(COMMAND, data, FD)
    assert desk.device.results["STALE"] == 1


def test_faults_are_cleared_by_a_command(desk: Any) -> None:
    desk.device.report(14, 3, 0)
    desk.device.report(15, 3, 0)
    desk.send(COMMAND, build_command(desk.key, CLEAR, 1, 14), FD)
    assert desk.device.faults_active == 1 << 14
    desk.send(COMMAND, build_command(desk.key, CLEAR, 2, 0), FD)
    assert desk.device.faults_active == 0
