"""The tester's side: E2E, frames as bytes, the message database, commands, python-can, UDS, monitor, report."""

from __future__ import annotations

import json
import os
import random
import socket
import threading
from itertools import pairwise
from pathlib import Path

import can
import isotp
import pytest
import udsoncan
from hypothesis import given, settings
from hypothesis import strategies as st

from upbeam.hw_sim.can import database, monitor, report
from upbeam.hw_sim.can.bits import wire_bits
from upbeam.hw_sim.can.bus import Node, SimulatedBus
from upbeam.hw_sim.can.checksum import crc8, crc16
from upbeam.hw_sim.can.commander import MAC_OFFSET, Commander, FreshnessFile, Mode, cmac, mac_of
from upbeam.hw_sim.can.e2e import (
    E2EConfig,
    E2EState,
    E2EStatus,
    Profile05,
    Profile11,
    Receiver,
    Sender,
    StateMachine,
    Window,
)
from upbeam.hw_sim.can.frame import CanFrame
from upbeam.hw_sim.can.pythoncan import (
    Bridge,
    SimulatedInterface,
    Transcript,
    UdpInterface,
    drain,
    from_message,
    read_transcript,
    to_message,
)
from upbeam.hw_sim.can.uds import UdsTester, VirtualConnection, connect, separation_ns
from upbeam.hw_sim.can.wire import decode_frame, encode_frame

MS = 1_000_000
KEY = bytes.fromhex("2b7e151628aed2a6abf7158809cf4f3c")

# ----------------------------------------------------------------------------------------------- E2E


def test_checksums_have_the_catalogues_check_values() -> None:
    assert crc8(b"123456789") == 0x37
    assert crc16(b"123456789") == 0x29B1


def test_protection_gives_the_examples_of_the_standard() -> None:
    """FO PRS_E2EProtocol, protocol examples of Profile 11C (data id 0x123) and 5 (data id 0x1234), zeros as data."""
    eleven = Profile11(E2EConfig(0x123, 8))
    assert [eleven.protect(bytes(8), c)[:2].hex() for c in (0, 1)] == ["2a10", "7711"]
    five = Profile05(E2EConfig(0x1234, 8))
    assert five.protect(bytes(8), 0)[:3].hex() == "1cca00"


@pytest.mark.parametrize("profile", [Profile11(E2EConfig(0x210, 8, 2)), Profile05(E2EConfig(0x220, 64, 2))])
def test_receiver_tells_loss_repetition_and_damage_apart(profile: Profile11 | Profile05) -> None:
    length = profile.config.length
    frames = [profile.protect(bytes(length), c % profile.counters) for c in range(2 * profile.counters)]

    def verdict_after(*, start: int, then: bytes | None) -> E2EStatus:
        receiver = Receiver(profile)
        for data in frames[: start + 1]:
            assert receiver.check(data) is E2EStatus.OK
        return receiver.check(then)

    last = profile.counters - 1
    assert verdict_after(start=last, then=frames[last + 1]) is E2EStatus.OK
    assert verdict_after(start=3, then=frames[3]) is E2EStatus.REPEATED
    assert verdict_after(start=3, then=frames[5]) is E2EStatus.OK_SOME_LOST
    assert verdict_after(start=3, then=frames[6]) is E2EStatus.WRONG_SEQUENCE
    assert verdict_after(start=3, then=None) is E2EStatus.NO_NEW_DATA
    assert verdict_after(start=3, then=frames[4][:-1]) is E2EStatus.WRONG_CRC
    other = type(profile)(E2EConfig(profile.config.data_id ^ 0x100, length))
    assert verdict_after(start=3, then=other.protect(bytes(length), 4)) is E2EStatus.WRONG_CRC


@settings(max_examples=150, deadline=None)
@given(st.binary(min_size=8, max_size=8), st.integers(0, 14), st.integers(0, 63))
def test_every_flipped_bit_is_found(data: bytes, counter: int, bit: int) -> None:
    for profile in (Profile11(E2EConfig(0x211, 8)), Profile05(E2EConfig(0x1211, 8))):
        good = bytearray(profile.protect(data, counter))
        assert profile.counter_of(bytes(good)) == counter
        good[bit // 8] ^= 1 << bit % 8
        assert profile.counter_of(bytes(good)) is None


def test_state_machine_qualifies_loses_and_requalifies() -> None:
    machine = StateMachine(Window(3, 2, 0), Window(5, 2, 1), Window(3, 3, 0))
    ok, bad = E2EStatus.OK, E2EStatus.WRONG_CRC
    steps = [(bad, "NODATA"), (ok, "INIT"), (ok, "INIT"), (ok, "VALID"), (bad, "VALID"), (bad, "INVALID")]
    steps += [(ok, "INVALID"), (ok, "INVALID"), (ok, "VALID"), (E2EStatus.NO_NEW_DATA, "VALID")]
    for status, state in steps:
        assert machine.step(status).name == state
    silent = StateMachine(Window(1, 1, 0), Window(2, 1, 0), Window(1, 1, 0))
    for status in (ok, ok, E2EStatus.NO_NEW_DATA):
        silent.step(status)
    assert silent.state is E2EState.VALID
    assert silent.step(E2EStatus.REPEATED) is E2EState.INVALID


# ---------------------------------------------------------------------------------------- frames as bytes


@settings(max_examples=100, deadline=None)
@given(st.binary(max_size=90))
def test_any_bytes_are_a_frame_or_refused_and_frames_survive(data: bytes) -> None:
    try:
        frame = decode_frame(data)
    except ValueError:
        return
    assert encode_frame(frame) == data


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"\0" * 5, "at least 6"),
        (b"\x01\0\0\0\x08\x00", "unknown flags"),
        (b"\x01\0\0\0\x00\x02a", "the length says 2"),
        (b"\x00\x08\0\0\x00\x00", "does not fit 11 bits"),
        (b"\x01\0\0\0\x01\x09" + bytes(9), "no CAN FD frame"),
        (b"\x01\0\0\0\x02\x00", "belong to CAN FD"),
    ],
)
def test_what_is_wrong_with_bytes_is_said(data: bytes, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        decode_frame(data)


# --------------------------------------------------------------------------------------------- database

STATUS = {"Mode": "REPEAT", "Verdict": "MISSED", "State": "DEGRADED", "CommandsEnabled": 1, "FaultActive": 0}


def test_every_message_with_a_profile_packs_and_decodes() -> None:
    decoder = database.Decoder()
    for message in database.load().messages:
        if not message.signals or database.profile(message) is None:
            continue
        plain = {
            s.name: 0 for s in message.signals if not s.name.startswith("E2E_") and s.multiplexer_ids in (None, [0])
        }
        decoded = decoder.decode(database.pack(message.name, dict(plain)))
        assert decoded is not None
        assert decoded.e2e is E2EStatus.OK
        assert set(plain) >= {n for n in decoded.signals if not n.startswith("E2E_")}


def test_signals_are_only_given_where_the_frame_is_good() -> None:
    decoder = database.Decoder()
    good = database.pack("UPB_Status", {**STATUS, "Frame": 77}, 0)
    decoded = decoder.decode(good, 5)
    assert decoded is not None
    assert decoded.usable
    assert (decoded.signals["Mode"], decoded.signals["Frame"], decoded.time_ns) == ("REPEAT", 77, 5)
    damaged = decoder.decode(CanFrame(good.identifier, good.data[:-1] + b"\xff"))
    assert damaged is not None
    assert not damaged.usable
    assert damaged.signals == {}
    assert decoder.decode(CanFrame(0x123)) is None
    assert decoder.unknown == 1
    assert decoder.verdicts["UPB_Status"] == {E2EStatus.OK: 1, E2EStatus.WRONG_CRC: 1}


def test_the_message_set_is_that_of_the_database() -> None:
    messages = {m.name: m for m in database.message_set()}
    assert messages["UPB_Status"].period_ns == 50 * MS
    assert messages["UPB_Ledger"].frame.fd
    assert messages["UPB_Ledger"].frame.bit_rate_switch
    assert len(messages) == len(database.load().messages)
    assert not [m for m in database.message_set(classic_only=True) if m.frame.fd]
    assert not [m for m in database.message_set(switch_bit_rate=False) if m.frame.bit_rate_switch]


# --------------------------------------------------------------------------------------------- commands


def test_cmac_gives_the_examples_of_rfc_4493() -> None:
    message = bytes.fromhex("6bc1bee22e409f96e93d7e117393172aae2d8a571e03ac9c9eb76fac45af8e5130c81c46a35ce411")
    assert cmac(KEY, b"").hex() == "bb1d6929e95937287fa37d129b756746"
    assert cmac(KEY, message[:16]).hex() == "070a16b46b4d4144f79bdd9dd04a287c"
    assert cmac(KEY, message[:40]).hex() == "dfa66747de9ae63030ca32611497c827"


def test_commands_are_fresh_protected_and_authentic() -> None:
    commander = Commander(KEY)
    frames = [commander.status(), commander.mode(Mode.REPEAT), commander.mode(None), commander.model(0x12345678)]
    frames.append(commander.clear_faults(3))
    decoder = database.Decoder()
    decoded = [decoder.decode(frame) for frame in frames]
    seen = [(d.signals["Code"], d.signals["Argument"], d.signals["Freshness"], d.e2e) for d in decoded if d]
    assert seen == [
        ("STATUS", 0, 1, E2EStatus.OK),
        ("MODE", 2, 2, E2EStatus.OK),
        ("MODE", 255, 3, E2EStatus.OK),
        ("MODEL", 0, 4, E2EStatus.OK),
        ("CLEAR_FAULTS", 3, 5, E2EStatus.OK),
    ]
    for frame in frames:
        assert frame.fd
        assert frame.data[9:12] == b"\0\0\0"
        expected = cmac(KEY, b"\x03\x00" + frame.data[3:16])[:8]
        assert frame.data[MAC_OFFSET:] == expected


def test_the_freshness_counter_outlives_the_tester(tmp_path: Path) -> None:
    path = tmp_path / "freshness.json"
    first = Commander(KEY, path)
    first.status()
    first.status()
    again = Commander(KEY, path)
    again.status()
    assert again.freshness == 3
    assert FreshnessFile(path).read() == 3
    path.write_text("{", encoding="utf-8")
    with pytest.raises(ValueError, match="no freshness counter"):
        Commander(KEY, path)
    FreshnessFile(path).write(0xFFFFFFFF)
    with pytest.raises(OverflowError, match="new key"):
        Commander(KEY, path).status()


def response_frame(key: bytes, counter: int, *, freshness: int = 1, result: str = "DONE") -> CanFrame:
    signals = {"Code": "STATUS", "Freshness": freshness, "Result": result, "Mode": 0, "StoredFreshness": 1, "Mac": 0}
    plain = database.pack("UPB_Response", signals, counter)
    data = bytearray(plain.data)
    data[2] = counter
    data[MAC_OFFSET:] = mac_of(key, 0x301, bytes(data))
    protection = database.profile(database.load().get_message_by_name("UPB_Response"))
    assert protection is not None
    return CanFrame(plain.identifier, protection.protect(bytes(data), counter), fd=True, bit_rate_switch=True)


def test_responses_are_read_and_their_mac_judged() -> None:
    commander = Commander(KEY)
    good = commander.response(response_frame(KEY, 0))
    assert good is not None
    assert (good.result, good.mode, good.authentic, good.stored_freshness) == ("DONE", "NETWORK", True, 1)
    other = commander.response(response_frame(bytes(16), 1, result="MAC"))
    assert other is not None
    assert (other.result, other.authentic) == ("MAC", False)
    assert commander.response(response_frame(bytes(16), 1, result="MAC")) is None  # the same frame again
    assert commander.response(response_frame(KEY, 1)) is not None  # another with that counter: after a reset
    damaged = response_frame(KEY, 2)
    assert commander.response(CanFrame(0x301, damaged.data[:-1] + b"!", fd=True, bit_rate_switch=True)) is None
    assert commander.response(CanFrame(0x210, bytes(8))) is None


def test_a_wrong_key_is_refused_at_once() -> None:
    with pytest.raises(ValueError, match="AES-128 takes 16"):
        Commander(b"short")


# ------------------------------------------------------------------------------------------- python-can


def some_frames(seed: int, count: int) -> list[CanFrame]:
    rng = random.Random(seed)
    out = []
    for _ in range(count):
        fd, extended = rng.random() < 0.5, rng.random() < 0.5
        size = rng.choice((0, 8, 12, 64)) if fd else rng.randrange(9)
        identifier = rng.randrange(1 << (29 if extended else 11))
        out.append(CanFrame(identifier, rng.randbytes(size), extended, fd, fd and rng.random() < 0.5))
    return out


def test_messages_of_python_can_are_our_frames() -> None:
    for frame in [*some_frames(1, 50), CanFrame(5, remote=True, remote_length=3)]:
        assert from_message(to_message(frame, 1_500_000_000)) == frame
    with pytest.raises(ValueError, match="error frame"):
        from_message(can.Message(is_error_frame=True))


def test_the_simulated_bus_as_a_python_can_bus_on_virtual_time() -> None:
    bus = SimulatedBus()
    a, b = (SimulatedInterface(bus, bus.node(name)) for name in "ab")
    frame = CanFrame(0x123, b"\x01\x02")
    a.send(to_message(frame))
    got = b.recv(1.0)
    assert got is not None
    assert from_message(got) == frame
    assert got.timestamp == bus.now_ns / 1e9 == (len(wire_bits(frame).bits) - 1) * 2e-6
    assert b.recv(0.5) is None
    assert bus.now_ns == round(got.timestamp * 1e9) + 500 * MS
    b.set_filters([{"can_id": 0x200, "can_mask": 0x7FF, "extended": False}])
    a.send(to_message(frame))
    a.send(to_message(CanFrame(0x200)))
    got = b.recv(1.0)
    assert got is not None
    assert got.arbitration_id == 0x200
    a.node.counters.off = True
    with pytest.raises(can.CanOperationError, match="bus-off"):
        a.send(to_message(frame))
    a.shutdown()
    b.shutdown()


def test_datagrams_pass_both_ways_and_garbage_is_counted() -> None:
    one = UdpInterface()
    two = UdpInterface(peer=one.address)
    one.peer = two.address
    try:
        frames = some_frames(2, 20)
        for frame in frames:
            two.send(to_message(frame))
        assert [from_message(m) for m in (one.recv(2.0) for _ in frames) if m] == frames
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as raw:
            raw.sendto(b"garbage", one.address)
        one.send(to_message(frames[0]))
        assert drain(two) or two.recv(2.0)
        two.send(to_message(frames[0]))
        assert one.recv(2.0) is not None
        assert one.malformed == 1
    finally:
        one.shutdown()
        two.shutdown()


def test_a_bridge_joins_datagrams_and_python_cans_virtual_bus() -> None:
    device, desk = UdpInterface(), UdpInterface()
    device.peer, desk.peer = desk.address, device.address
    inside = can.Bus(interface="virtual", channel="upbeam-bridge", protocol=can.CanProtocol.CAN_FD)
    tool = can.Bus(interface="virtual", channel="upbeam-bridge", protocol=can.CanProtocol.CAN_FD)
    bridge = Bridge(desk, inside)
    try:
        frame = database.pack("UPB_Status", {**STATUS, "Frame": 1})
        device.send(to_message(frame))
        assert bridge.pump(2.0) == 1
        message = tool.recv(0.0)
        assert message is not None
        assert from_message(message) == frame
        tool.send(to_message(Commander(KEY).status()))
        assert bridge.pump(0.0) == 1
        message = device.recv(2.0)
        assert message is not None
        assert message.arbitration_id == 0x300
    finally:
        for bus in (device, desk, inside, tool):
            bus.shutdown()


def test_a_bridge_to_udp_multicast_neither_loses_nor_echoes() -> None:
    """Frames of the daemon's datagrams for CAN tools in other processes, and their frames back."""
    channel = {"interface": "udp_multicast", "channel": "239.74.163.2", "port": 20_000 + os.getpid() % 20_000}
    try:
        inside, tool = can.Bus(**channel), can.Bus(**channel)  # type: ignore[arg-type]
    except (OSError, can.CanError) as error:
        pytest.skip(f"no multicast on this machine: {error}")
    device, desk = UdpInterface(), UdpInterface()
    device.peer, desk.peer = desk.address, device.address
    bridge = Bridge(desk, inside)
    try:
        frames = [frame for frame in some_frames(4, 10) if not frame.error_state_indicator]
        for frame in frames:
            device.send(to_message(frame))
            assert bridge.pump(5.0) == 1
            message = tool.recv(5.0)
            assert message is not None
            assert from_message(message) == frame
        sent_back = CanFrame(0x300, b"tool")
        tool.send(to_message(sent_back))
        for _ in range(200):
            bridge.pump(0.02)
            if bridge.passed == len(frames) + 1:
                break
        assert [from_message(m) for m in drain(device)] == [sent_back]
        assert (bridge.passed, bridge.echoes, bridge.dropped) == (len(frames) + 1, len(frames), 0)
    finally:
        for bus in (device, desk, inside, tool):
            bus.shutdown()


@pytest.mark.parametrize("suffix", [".blf", ".asc"])
def test_a_transcript_reads_back_with_virtual_times(tmp_path: Path, suffix: str) -> None:
    bus = SimulatedBus()
    a, _ = bus.node("a"), bus.node("b")
    frames = some_frames(3, 30)
    bus.flip_bit(30, count=2)
    for index, frame in enumerate(frames):
        a.send(frame, index * MS)
    bus.advance_to(100 * MS)
    transcript = Transcript(bus, tmp_path / f"run{suffix}")
    transcript.write()
    assert (transcript.frames, transcript.errors) == (30, len([e for e in bus.events if e.what == "error"]))
    got = read_transcript(tmp_path / f"run{suffix}")
    assert [f for _, f in got] == [t.frame for t in bus.transmissions]
    if suffix == ".blf":
        assert [t for t, _ in got] == [pytest.approx(t.end_ns, abs=1000) for t in bus.transmissions]


# -------------------------------------------------------------------------------------------------- UDS


class Ecu:
    """A small UDS server over can-isotp on a node of the simulated bus: the other side for the tester."""

    def __init__(self, bus: SimulatedBus, node: Node) -> None:
        self.bus, self.node = bus, node
        self.incoming: list[isotp.CanMessage] = []
        self.requests: list[bytes] = []
        self.layer = isotp.TransportLayerLogic(
            rxfn=lambda timeout: self.incoming.pop(0) if self.incoming else None,
            txfn=lambda message: node.send(CanFrame(message.arbitration_id, bytes(message.data))),
            address=isotp.Address(isotp.AddressingMode.Normal_11bits, txid=0x7A8, rxid=0x7A0),
            params={"tx_data_min_length": 8, "stmin": 5, "blocksize": 4},
        )
        node.listeners.append(self.on_frame)

    def on_frame(self, received: object) -> None:
        frame = received.frame  # type: ignore[attr-defined]
        self.incoming.append(isotp.CanMessage(arbitration_id=frame.identifier, data=frame.data))
        self.layer.process(0.0)
        request = self.layer.recv()
        if request is not None:
            self.requests.append(bytes(request))
            self.layer.send(self.answer(bytes(request)))
            self.layer.process(0.0)

    @staticmethod
    def answer(request: bytes) -> bytes:
        if request[0] == 0x22 and request[1:3] == b"\xf1\x89":
            return b"\x62\xf1\x89" + b"upbeam 0.1.0, a version text of many frames"
        if request[:2] == b"\x19\x02":
            return b"\x59\x02\x7f" + bytes([0xD0, 0x01, 0x00, 0x2F]) + bytes([0xD0, 0x12, 0x00, 0x08])
        if request[0] == 0x14:
            return b"\x54"
        if request[0] == 0x2E:
            return b"\x6e" + request[1:3]
        return bytes([0x7F, request[0], 0x11])


def test_uds_on_virtual_time() -> None:
    bus = SimulatedBus()
    ecu = Ecu(bus, bus.node("ecu"))
    with UdsTester(VirtualConnection(bus, bus.node("tester"))) as tester:
        assert tester.read(0xF189).startswith(b"upbeam 0.1.0")
        faults = tester.faults()
        assert [(f.fault, f.name, f.active, f.confirmed) for f in faults] == [
            (1, "SENSOR_TIMEOUT", True, True),
            (18, "NET_FLOOD", False, True),
        ]
        tester.clear()
        before = bus.now_ns
        tester.client.write_data_by_identifier(0xFD00, bytes(40))  # several consecutive frames, 5 ms apart
        starts = [t.start_ns for t in bus.transmissions if t.frame.data[0] >> 4 == 2 and t.start_ns > before]
        assert len(starts) == 6
        gaps = [b - a for a, b in pairwise(starts)]
        assert min(gaps) >= 5 * MS - 20_000
        with pytest.raises(udsoncan.exceptions.NegativeResponseException):
            tester.reset()
    assert ecu.requests[0] == b"\x22\xf1\x89"


def test_uds_without_a_device_times_out_on_virtual_time() -> None:
    bus = SimulatedBus()
    bus.node("somebody")
    with (
        UdsTester(VirtualConnection(bus, bus.node("tester")), timeout_s=1.5) as tester,
        pytest.raises(udsoncan.exceptions.TimeoutException),
    ):
        tester.read(0xF189)
    assert bus.now_ns == pytest.approx(1500 * MS, abs=MS / 10)  # udsoncan takes off what it needed itself


def test_uds_over_a_real_python_can_bus() -> None:
    desk = can.Bus(interface="virtual", channel="upbeam-uds")
    device = can.Bus(interface="virtual", channel="upbeam-uds")
    stop = threading.Event()

    def serve() -> None:
        address = isotp.Address(isotp.AddressingMode.Normal_11bits, txid=0x7A8, rxid=0x7A0)
        stack = isotp.CanStack(device, address=address, params={"tx_data_min_length": 8})
        while not stop.is_set():
            stack.process(0.005)
            if (request := stack.recv()) is not None:
                stack.send(Ecu.answer(bytes(request)))

    server = threading.Thread(target=serve)
    server.start()
    try:
        with UdsTester(connect(desk), timeout_s=20.0) as tester:
            assert tester.read(0xF189).startswith(b"upbeam 0.1.0")
            assert [f.name for f in tester.faults()] == ["SENSOR_TIMEOUT", "NET_FLOOD"]
    finally:
        stop.set()
        server.join()
        desk.shutdown()
        device.shutdown()


def test_separation_times_of_flow_control() -> None:
    assert [separation_ns(c) for c in (0, 5, 0x7F, 0xF1, 0xF9, 0x80, 0xFF)] == [
        *(0, 5 * MS, 127 * MS),
        *(100_000, 900_000),
        *(127 * MS, 127 * MS),
    ]


# -------------------------------------------------------------------------------------- monitor and report


def device_traffic() -> list[tuple[int, CanFrame]]:
    status, counters = (
        Sender(p)
        for name in ("UPB_Status", "UPB_Counters")
        if (p := database.profile(database.load().get_message_by_name(name)))
    )
    out = []
    for index in range(20):
        frame = database.pack("UPB_Status", {**STATUS, "Frame": index})
        out.append((index * 50 * MS, CanFrame(frame.identifier, status.protect(frame.data))))
        signals: dict[str, database.Value] = {"CounterIndex": index % 2}
        signals["PacketsIn" if index % 2 == 0 else "PacketsOut"] = 100 + index
        frame = database.pack("UPB_Counters", signals)
        out.append((index * 50 * MS + 1, CanFrame(frame.identifier, counters.protect(frame.data))))
    return out


def test_monitor_shows_what_was_said_last() -> None:
    watch = monitor.Monitor()
    for time_ns, frame in device_traffic():
        watch.add(frame, time_ns)
    assert watch.signals("UPB_Status")["Frame"] == 19
    counters = watch.signals("UPB_Counters")
    assert (counters["PacketsIn"], counters["PacketsOut"]) == (118, 119)
    assert watch.rows["UPB_Status"].period_ns == 50 * MS
    watch.add(CanFrame(0x210, bytes(8)), 2000 * MS)
    assert watch.rows["UPB_Status"].refused == 1
    assert watch.signals("UPB_Status")["Frame"] == 19
    assert watch.table(2000 * MS).row_count == 3


def test_monitor_command_reads_a_transcript(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bus = SimulatedBus()
    node, _ = bus.node("device"), bus.node("tester")
    for time_ns, frame in device_traffic():
        node.send(frame, time_ns)
    bus.advance_to(2000 * MS)
    Transcript(bus, tmp_path / "run.blf").write()
    assert monitor.main(["--read", str(tmp_path / "run.blf")]) == 0
    assert "UPB_Status" in capsys.readouterr().out
    assert monitor.main(["--read", str(tmp_path / "absent.blf")]) == 2
    assert "absent.blf" in capsys.readouterr().err


def test_monitor_command_listens_to_datagrams(capsys: pytest.CaptureFixture[str]) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    sender = UdpInterface(peer=("127.0.0.1", port))
    stop = threading.Event()

    def send() -> None:
        while not stop.wait(0.01):
            sender.send(to_message(device_traffic()[0][1]))

    thread = threading.Thread(target=send)
    thread.start()
    try:
        assert monitor.main(["--udp", f"127.0.0.1:{port}", "--seconds", "0.5"]) == 0
    finally:
        stop.set()
        thread.join()
        sender.shutdown()
    assert "UPB_Status" in capsys.readouterr().out


def test_report_bounds_hold_in_its_own_simulation(capsys: pytest.CaptureFixture[str]) -> None:
    assert report.main(["--json", "--seconds", "0.3"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert len(found["buses"]) == 3
    for bus in found["buses"]:
        assert 0 < bus["simulated_load"] <= 1
        for line in bus["lines"]:
            assert 0 < line["simulated_us"] <= line["response_bound_us"] <= line["response_classical_us"]
            assert line["bits_shortest"] <= line["bits_longest"] <= line["bits_bound"]
    assert report.main(["--nominal", "83333"]) == 2
    assert "whole number" in capsys.readouterr().err


def test_report_says_when_a_deadline_can_be_missed(capsys: pytest.CaptureFixture[str]) -> None:
    assert report.main(["--nominal", "62500", "--data", "62500", "--seconds", "0.05"]) == 1
    assert "not bounded" in capsys.readouterr().out
