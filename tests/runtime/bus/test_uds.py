"""Diagnostics: ``udsoncan`` over ``can-isotp`` as testers of the C server, on an in-memory bus and virtual time."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import pairwise
from typing import Any

import isotp
import pytest
import udsoncan
from udsoncan.client import Client
from udsoncan.connections import BaseConnection
from udsoncan.exceptions import NegativeResponseException, TimeoutException

from upbeam.runtime.bus import COUNTERS, FAULTS, fault_dtc

REQUEST, ANSWER, FUNCTIONAL = 0x7A0, 0x7A8, 0x7DF
EXTENDED = 3
NET_LOSS = 14
MAX_STEPS = 3000


class Link(BaseConnection):
    """can-isotp on one side, the device on the other; each step is a millisecond of the device's time."""

    def __init__(self, desk: Any, **parameters: int) -> None:
        super().__init__("desk")
        self.desk = desk
        self.waiting: list[isotp.CanMessage] = []
        self.lose: Callable[[int, bytes], bool] = lambda can_id, data: False
        address = isotp.Address(isotp.AddressingMode.Normal_11bits, txid=REQUEST, rxid=ANSWER)
        parameters = {"stmin": 0, "blocksize": 0, "tx_padding": 0xAA} | parameters
        self.stack = isotp.TransportLayerLogic(
            lambda timeout: self.waiting.pop(0) if self.waiting else None, self.to_device, address, params=parameters
        )

    def to_device(self, message: isotp.CanMessage) -> None:
        if not self.lose(message.arbitration_id, bytes(message.data)):
            self.desk.send(message.arbitration_id, bytes(message.data))

    def pump(self) -> None:
        self.desk.run(1)
        for can_id, _, data in self.desk.device.take_can():
            if can_id == ANSWER and not self.lose(can_id, data):
                self.waiting.append(isotp.CanMessage(arbitration_id=can_id, data=bytearray(data)))
        self.stack.process()

    def open(self) -> Link:
        return self

    def close(self) -> None:
        pass

    def is_open(self) -> bool:
        return True

    def empty_rxqueue(self) -> None:
        self.waiting.clear()

    def specific_send(self, payload: bytes, timeout: float | None = None) -> None:
        self.stack.send(payload)

    def specific_wait_frame(self, timeout: float | None = None) -> bytes:
        for _ in range(MAX_STEPS):
            self.pump()
            if self.stack.available():
                received = self.stack.recv()
                assert received is not None
                return bytes(received)
        raise TimeoutException("no answer in virtual time")

    def ask(self, payload: bytes) -> bytes:
        self.specific_send(payload)
        return self.specific_wait_frame()


class Number(udsoncan.DidCodec):
    """Big-endian bytes of a fixed length."""

    def __init__(self, length: int) -> None:
        self.length = length

    def encode(self, *values: Any) -> bytes:
        raise NotImplementedError

    def decode(self, string_bin: bytes) -> int:
        return int.from_bytes(string_bin, "big")

    def __len__(self) -> int:
        return self.length


CONFIG: dict[str, Any] = {
    "data_identifiers": {
        0xF186: Number(1),
        0xF189: udsoncan.AsciiCodec(5),
        0xFD00: Number(8),
        0xFD01: Number(8 * COUNTERS),
        0xFD04: Number(4),
        0xFD06: Number(56),
        0xFD10: Number(8),
        0xFD11: Number(1),
        0xFD12: Number(8),
        0xFD13: Number(8),
        0xFD14: Number(2),
    },
    "extended_data_size": {fault_dtc(i): 4 for i in range(1, FAULTS + 1)},
    "use_server_timing": False,
}


@pytest.fixture
def link(desk: Any) -> Link:
    return Link(desk)


@pytest.fixture
def client(link: Link) -> Iterator[Client]:
    with Client(link, config=CONFIG) as opened:
        yield opened


def fail(desk: Any, fault: int, frame: int = 77, mode: int = 2) -> None:
    """A fault at a frame."""
    desk.device.snapshot.mode = mode
    record = desk.device.snapshot.record
    record.frame = frame
    desk.device.snapshot.record = record
    desk.run(1)
    desk.device.report(fault, 3, desk.now)


def test_fault_memory_is_read(client: Client, desk: Any) -> None:
    fail(desk, NET_LOSS)
    fail(desk, 9)
    desk.device.report(9, 0, desk.now)  # healed, still confirmed
    count = client.get_number_of_dtc_by_status_mask(0x08)
    assert count is not None
    assert count.service_data.dtc_count == 2
    listed = client.get_dtc_by_status_mask(0x01)
    assert listed is not None
    (dtc,) = listed.service_data.dtcs
    assert (dtc.id, dtc.status.get_byte_as_int()) == (fault_dtc(NET_LOSS), 0x2F)
    confirmed = client.get_dtc_by_status_mask(0x08)
    assert confirmed is not None
    assert [d.id for d in confirmed.service_data.dtcs] == [fault_dtc(9), fault_dtc(NET_LOSS)]
    supported = client.get_supported_dtc()
    assert supported is not None
    assert [d.id for d in supported.service_data.dtcs] == [fault_dtc(i) for i in range(1, FAULTS + 1)]


def test_snapshot_and_extended_data_are_read(client: Client, desk: Any) -> None:
    fail(desk, NET_LOSS)
    first = desk.now
    desk.device.report(NET_LOSS, 0, desk.now)
    fail(desk, NET_LOSS, frame=99, mode=1)
    last = desk.now
    answer = client.get_dtc_snapshot_by_dtc_number(fault_dtc(NET_LOSS), record_number=1)
    assert answer is not None
    (dtc,) = answer.service_data.dtcs
    assert {s.did: s.data for s in dtc.snapshots} == {0xFD10: 99, 0xFD11: 1, 0xFD12: first, 0xFD13: last, 0xFD14: 1}
    extended = client.get_dtc_extended_data_by_dtc_number(fault_dtc(NET_LOSS), record_number=1)
    assert extended is not None
    (dtc,) = extended.service_data.dtcs
    assert dtc.extended_data[0].raw_data == bytes([0, 2, 127, 0])


def test_fault_memory_is_cleared_in_the_extended_session_only(client: Client, desk: Any) -> None:
    fail(desk, NET_LOSS)
    fail(desk, 9)
    with pytest.raises(NegativeResponseException) as refused:
        client.clear_dtc()
    assert refused.value.response.code == 0x7F
    client.change_session(EXTENDED)
    client.clear_dtc(fault_dtc(9))
    assert desk.device.faults_active == 1 << (NET_LOSS - 1)
    with pytest.raises(NegativeResponseException) as refused:
        client.clear_dtc(0x123456)
    assert refused.value.response.code == 0x31
    client.clear_dtc()
    assert desk.device.faults_active == 0
    assert desk.device.fault_status(NET_LOSS) == 0x50


def test_clearing_can_be_locked(make_desk: Any) -> None:
    desk = make_desk(clear_locked=True)
    fail(desk, NET_LOSS)
    with Client(Link(desk), config=CONFIG) as client:
        client.change_session(EXTENDED)
        with pytest.raises(NegativeResponseException) as refused:
            client.clear_dtc()
        assert refused.value.response.code == 0x33
    assert desk.device.faults_active


def test_session_ends_without_requests(client: Client, desk: Any) -> None:
    def session() -> Any:
        answer = client.read_data_by_identifier(0xF186)
        assert answer is not None
        return answer.service_data.values[0xF186]

    client.change_session(EXTENDED)
    desk.run(4900)
    client.tester_present()
    desk.run(4900)
    assert session() == EXTENDED
    desk.run(5001)
    assert session() == 1


def test_identifiers_are_read(client: Client, desk: Any) -> None:
    now = desk.device.snapshot
    now.model_crc32, now.precision, now.cpu, now.model_swaps = 0xCAFEBABE, 2, 3, 4
    now.set_counters(range(100, 100 + COUNTERS))
    answer = client.read_data_by_identifier([0xF189, 0xFD00, 0xFD01, 0xFD04])
    assert answer is not None
    values = answer.service_data.values
    assert values[0xF189].count(".") == 2
    assert values[0xFD00] == 0xCAFEBABE_02_03_0004
    counters = values[0xFD01].to_bytes(8 * COUNTERS, "big")
    assert [int.from_bytes(counters[8 * i : 8 * i + 8], "big") for i in range(11)] == list(range(100, 111))
    assert values[0xFD04] == 0


@pytest.mark.parametrize(
    ("request_bytes", "answer"),
    [
        ("27 01", "7f 27 11"),  # no such service
        ("10 02", "7f 10 12"),  # no such session
        ("10", "7f 10 13"),
        ("10 01 00", "7f 10 13"),
        ("3e 01", "7f 3e 12"),
        ("11 01", "7f 11 11"),  # no reset function given
        ("19 03 00", "7f 19 12"),
        ("19 02", "7f 19 13"),
        ("19 06 d0 00 00 01", "7f 19 31"),
        ("19 06 d0 0e 00 02", "7f 19 31"),
        ("22 12 34", "7f 22 31"),
        ("22 f1", "7f 22 13"),
        ("14 ff ff ff", "7f 14 7f"),
        ("3e 00", "7e 00"),
        ("10 83 ", None),  # positive answer suppressed
        ("19 02 00", "59 02 7f"),
        ("22 fd 05 fd 05 fd 05 fd 05", "7f 22 14"),  # 4 * 130 bytes: longer than the link's buffer
    ],
)
def test_answers_byte_by_byte(link: Link, request_bytes: str, answer: str | None) -> None:
    if answer is None:
        link.specific_send(bytes.fromhex(request_bytes))
        for _ in range(100):
            link.pump()
        assert not link.stack.available()
    else:
        assert link.ask(bytes.fromhex(request_bytes)) == bytes.fromhex(answer)


def test_reset_needs_the_extended_session(make_desk: Any) -> None:
    link = Link(make_desk(can_reset=True))
    assert link.ask(b"\x11\x01") == b"\x7f\x11\x7f"
    link.ask(b"\x10\x03")
    assert link.ask(b"\x11\x01") == b"\x51\x01"


def test_functional_requests_are_answered_or_silent(desk: Any) -> None:
    for request, expected in ((b"\x02\x3e\x00", [b"\x02\x7e\x00"]), (b"\x02\x27\x01", []), (b"\x03\x22\x12\x34", [])):
        desk.send(FUNCTIONAL, request)
        assert [d[: len(request)] for i, _, d in desk.device.take_can() if i == ANSWER] == expected


@pytest.mark.parametrize("block_size", [0, 1, 2, 15])
@pytest.mark.parametrize("tester_block", [0, 1, 8])
def test_long_messages_both_ways(make_desk: Any, block_size: int, tester_block: int) -> None:
    """Eight identifiers up, one of them unknown; more than 400 bytes down; flow control of both sides."""
    desk = make_desk(block_size=block_size)
    link = Link(desk, blocksize=tester_block)
    request = b"\x22" + bytes.fromhex("fd01 fd05 fd03 1234 fd00 fd04 f186 fd06")
    answer = link.ask(request)
    assert len(answer) == 1 + 2 * 7 + 8 * COUNTERS + 128 + 72 + 8 + 4 + 1 + 56
    assert desk.device.isotp_errors == [0] * 9


def test_gap_asked_by_the_receiver_is_kept(make_desk: Any) -> None:
    """Separation time of 20 ms: consecutive frames of the device are at least that far apart in virtual time."""
    desk = make_desk()
    desk.send(REQUEST, bytes.fromhex("03 22 fd 01"))
    desk.send(REQUEST, bytes.fromhex("30 00 14"))
    times: list[int] = []
    for _ in range(1000):
        times += [desk.now for i, _, d in desk.device.take_can() if i == ANSWER and d[0] >> 4 == 2]
        desk.run(1)
    assert len(times) == -(-(3 + 8 * COUNTERS - 6) // 7)
    assert {b - a for a, b in pairwise(times)} == {20 * 1_000_000}


@pytest.mark.parametrize(
    ("frames", "errors"),
    [
        (["10 14 22 fd 00 fd 00 fd", "22 00 fd 00 fd 00 fd 00"], {3: 1}),  # wrong sequence number
        (["10 14 22 fd 00 fd 00 fd", "21 00"], {7: 1}),  # a consecutive frame that ends early
        (["21 00 fd 00 fd 00 fd 00"], {4: 1}),  # a consecutive frame of nothing
        (["30 00 00"], {4: 1}),  # flow control for nothing
        (["12 01 22 fd 00 fd 00 fd"], {5: 1}),  # 513 bytes
        (["10 00 00 00 20 00 22 fd"], {5: 1}),  # the form for more than 4095 bytes
        (["10 07 22 fd 00 fd 00 fd"], {7: 1}),  # fits a single frame
        (["00 22 fd 00"], {7: 1}),
        (["0f 22 fd 00"], {7: 1}),
        (["40 22 fd 00"], {7: 1}),
        ([""], {7: 1}),
        (["10 14 22 fd 00 fd 00 fd", "10 14 22 fd 00 fd 00 fd"], {4: 1}),  # a new one ends the old
    ],
)
def test_isotp_faults_are_counted_by_cause(desk: Any, frames: list[str], errors: dict[int, int]) -> None:
    for frame in frames:
        desk.send(REQUEST, bytes.fromhex(frame))
    assert desk.device.isotp_errors == [errors.get(i, 0) for i in range(9)]
    desk.run(2000)  # whatever was begun is over
    link = Link(desk)
    desk.device.take_can()
    assert link.ask(b"\x3e\x00") == b"\x7e\x00"


def test_a_lost_consecutive_frame_ends_the_request(desk: Any) -> None:
    link = Link(desk)
    link.lose = lambda can_id, data: can_id == REQUEST and data[0] == 0x22
    link.specific_send(b"\x22" + bytes.fromhex("fd00") * 8)
    for _ in range(1500):
        link.pump()
    assert not link.stack.available()
    assert sum(desk.device.isotp_errors) == 1
    link.lose = lambda can_id, data: False
    assert link.ask(b"\x3e\x00") == b"\x7e\x00"


def test_a_tester_that_sends_no_flow_control_is_given_up(desk: Any) -> None:
    desk.send(REQUEST, bytes.fromhex("03 22 fd 01"))
    desk.run(999)
    assert desk.device.isotp_errors[1] == 0
    desk.run(2)
    assert desk.device.isotp_errors[1] == 1


@pytest.mark.parametrize(("flow", "error"), [("32 00 00", 5), ("35 00 00", 7), ("31 00 00", 6)])
def test_flow_control_that_ends_the_answer(desk: Any, flow: str, error: int) -> None:
    desk.send(REQUEST, bytes.fromhex("03 22 fd 01"))
    for _ in range(9):  # more waits than are taken
        desk.send(REQUEST, bytes.fromhex(flow))
        if desk.device.isotp_errors[error]:
            break
    assert desk.device.isotp_errors[error] == 1
    assert Link(desk).ask(b"\x3e\x00") == b"\x7e\x00"
