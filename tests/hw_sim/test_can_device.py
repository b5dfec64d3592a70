"""The C bus library on the simulated bus, judged by the tester's side, and each as the other's oracle."""

from __future__ import annotations

import random
from itertools import pairwise

import pytest
import udsoncan
from hypothesis import given, settings
from hypothesis import strategies as st

from upbeam.hw_sim.can import database
from upbeam.hw_sim.can.analysis import BusRates, response_times
from upbeam.hw_sim.can.bus import Node, SimulatedBus
from upbeam.hw_sim.can.commander import MAC_OFFSET, Command, Commander, Mode, Response, cmac
from upbeam.hw_sim.can.device import DeviceNode
from upbeam.hw_sim.can.e2e import E2EConfig, E2EStatus, Profile05, Profile11, Receiver, StateMachine, Window
from upbeam.hw_sim.can.frame import FD_LENGTHS, CanFrame
from upbeam.hw_sim.can.monitor import Monitor
from upbeam.hw_sim.can.report import Traffic
from upbeam.hw_sim.can.station import ErrorState
from upbeam.hw_sim.can.uds import UdsTester, VirtualConnection
from upbeam.hw_sim.can.wire import decode_frame, encode_frame
from upbeam.hw_sim.serial import NoisyLine, RecordParser, encode_record
from upbeam.runtime import bus as native

MS = 1_000_000
KEY = bytes(range(1, 17))


class Bench:
    """A device and a tester on one bus."""

    def __init__(self, key: bytes | None = KEY, **options: object) -> None:
        self.storage: dict[int, bytes] = {}
        self.bus = SimulatedBus()
        self.device = native.Device(key, self.storage, **options)  # type: ignore[arg-type]
        self.node: Node = self.bus.node("UPBEAM")
        self.tester: Node = self.bus.node("TESTER")
        self.on_bus = DeviceNode(self.bus, self.node, self.device)
        self.commander = Commander(KEY)
        self.monitor = Monitor()
        self.tester.listeners.append(lambda r: self.monitor.add(r.frame, r.time_ns) and None)

    def restart(self) -> None:
        self.on_bus.stop()
        self.device.end()
        self.device = native.Device(KEY, self.storage, now_ns=self.bus.now_ns)
        self.on_bus.start(self.device)

    def command(self, frame: CanFrame, wait_ns: int = 50 * MS) -> Response | None:
        """Send a command; its answer, None if there is none in time."""
        heard = len(self.tester.received)
        self.tester.send(frame)
        self.bus.advance(wait_ns)
        answers = [self.commander.response(r.frame) for r in self.tester.received[heard:]]
        return next((a for a in answers if a is not None), None)


def test_status_comes_at_its_cycle_times_protected_and_within_the_bound() -> None:
    bench = Bench()
    bench.bus.advance_to(3000 * MS)
    cycles = {n: row.count for n, row in bench.monitor.rows.items() if n in ("UPB_Status", "UPB_Latency", "UPB_Model")}
    assert cycles == {"UPB_Status": 60, "UPB_Latency": 60, "UPB_Model": 3}
    for verdicts in bench.monitor.decoder.verdicts.values():
        assert set(verdicts) == {E2EStatus.OK}
    assert bench.monitor.decoder.unknown == 0
    assert not bench.bus.errors
    worst = {r.message.frame.identifier: r for r in response_times(database.message_set(), BusRates(2000, 500))}
    for sent in bench.bus.transmissions:
        bound = worst[sent.frame.identifier]
        assert bound.response_ns is not None
        assert sent.response_ns <= bound.response_ns - bound.message.jitter_ns


def test_the_periods_of_the_analysis_are_those_of_the_device() -> None:
    traffic = Traffic()
    for name, identifier, flags, cycle_ms, data_id, length in native.messages():
        message = database.load().get_message_by_name(name)
        protection = database.profile(message)
        assert protection is not None
        assert (message.frame_id, message.length, message.is_fd) == (identifier, length, bool(flags & 1))
        assert protection.config.data_id == data_id
        if cycle_ms:
            assert traffic.period_ns(message) == cycle_ms * MS


def test_a_ledger_record_arrives_whole() -> None:
    bench = Bench()
    record = native.Record()
    record.frame, record.first_input_ns, record.output_ns = 2**40 + 5, 123_456_789_012, 123_500_000_000
    record.latency_ns, record.missing_columns, record.mode, record.verdict = 48_000, 7, 2, 1
    bench.device.ledger(record)
    bench.bus.advance_to(100 * MS)
    got = bench.monitor.signals("UPB_Ledger")
    assert (got["Frame"], got["FirstInput"], got["Output"]) == (2**40 + 5, 123_456_789_012, 123_500_000_000)
    assert (got["LatencyNs"], got["MissingColumns"], got["Mode"], got["Verdict"]) == (48_000, 7, "REPEAT", "MISSED")


def test_authentic_fresh_commands_are_carried_out_and_answered() -> None:
    bench = Bench()
    bench.bus.advance_to(10 * MS)
    answer = bench.command(bench.commander.mode(Mode.REPEAT))
    assert answer is not None
    assert (answer.result, answer.authentic, answer.freshness, answer.stored_freshness) == ("DONE", True, 1, 1)
    assert bench.device.take_commands() == [(Command.MODE, 1, Mode.REPEAT, 0)]
    answer = bench.command(bench.commander.status())
    assert answer is not None
    assert (answer.code, answer.result) == ("STATUS", "DONE")


def test_anything_else_changes_nothing_and_is_counted() -> None:
    bench = Bench()
    bench.bus.advance_to(10 * MS)
    first = bench.commander.mode(Mode.REPEAT)
    bench.command(first)
    bench.device.take_commands()
    replay = bench.command(first)
    assert replay is None or replay.result == "STALE"
    wrong_mac = bench.command(bench.commander.forge(Command.MODE, 100, argument=1, mac=bytes(8)))
    assert wrong_mac is not None
    assert (wrong_mac.result, wrong_mac.authentic) == ("MAC", False)
    other_key = Commander(bytes(16), 50).mode(Mode.NETWORK)
    bench.command(other_key)
    damaged = bench.commander.forge(Command.MODE, 101, argument=1)
    bench.command(CanFrame(0x300, damaged.data[:5] + b"\xff" + damaged.data[6:], fd=True, bit_rate_switch=True))
    stale = bench.command(bench.commander.forge(Command.MODE, 1, argument=1))
    assert stale is not None
    assert stale.result == "STALE"
    unknown = bench.command(bench.commander.forge(77, 102))
    assert unknown is not None
    assert unknown.result == "UNKNOWN"
    reserved = bench.command(bench.commander.forge(Command.STATUS, 103, reserved=1))
    assert reserved is not None
    assert reserved.result == "VALUE"
    assert bench.device.take_commands() == []
    results = dict(bench.device.results)
    assert (results["STALE"], results["MAC"], results["E2E"]) == (2, 2, 1)
    bench.bus.advance(200 * MS)
    assert bench.monitor.signals("UPB_Faults")["CAN_COMMAND_REJECTED"] == "YES"


def test_freshness_outlives_a_reset_of_the_device() -> None:
    bench = Bench()
    bench.bus.advance_to(10 * MS)
    used = bench.commander.status()
    assert bench.command(used) is not None
    bench.restart()
    bench.bus.advance(20 * MS)
    answer = bench.command(used)
    assert answer is not None
    assert answer.result == "STALE"
    answer = bench.command(bench.commander.status())
    assert answer is not None
    assert answer.result == "DONE"


def test_a_device_without_a_key_takes_no_command() -> None:
    bench = Bench(key=None)
    bench.bus.advance_to(60 * MS)
    answer = bench.command(bench.commander.status())
    assert answer is None or answer.result == "NO_KEY"
    assert bench.device.take_commands() == []
    assert bench.monitor.signals("UPB_Status")["CommandsEnabled"] == "NO"


def test_faults_are_read_and_cleared_over_uds() -> None:
    bench = Bench()
    bench.bus.advance_to(10 * MS)
    bench.device.report(1, 3, bench.bus.now_ns)
    bench.device.report(18, 3, bench.bus.now_ns)
    with UdsTester(VirtualConnection(bench.bus, bench.tester)) as tester:
        faults = tester.faults(0x01)
        assert [(f.fault, f.name, f.active) for f in faults] == [(1, "SENSOR_TIMEOUT", True), (18, "NET_FLOOD", True)]
        assert len(tester.read(0xFD01)) == 8 * native.COUNTERS  # many consecutive frames
        bench.device.report(1, 0, bench.bus.now_ns)
        bench.device.report(18, 0, bench.bus.now_ns)
        with pytest.raises(udsoncan.exceptions.NegativeResponseException):
            tester.clear()
        tester.session(3)
        tester.clear()
        assert [f.name for f in tester.faults(0x08)] == []
        with pytest.raises(udsoncan.exceptions.NegativeResponseException):
            tester.read(0x1234)
    assert sum(bench.device.isotp_errors) == 0


def test_a_request_of_many_frames_keeps_the_separation_time_the_device_asks_for() -> None:
    bench = Bench(st_min=10)
    bench.bus.advance_to(10 * MS)
    with (
        UdsTester(VirtualConnection(bench.bus, bench.tester)) as tester,
        pytest.raises(udsoncan.exceptions.NegativeResponseException, match="ervice"),
    ):
        tester.client.write_data_by_identifier(0xFD00, bytes(40))  # not supported, but received whole
    starts = [t.start_ns for t in bench.bus.transmissions if t.frame.identifier == 0x7A0 and t.frame.data[0] >> 4 == 2]
    assert len(starts) == 6
    assert min(b - a for a, b in pairwise(starts)) > 9 * MS
    assert sum(bench.device.isotp_errors) == 0


def test_bus_off_is_survived() -> None:
    bench = Bench()
    bench.bus.advance_to(100 * MS)
    bench.bus.flip_bit(20, identifier=0x210, count=40)
    bench.bus.advance_to(1000 * MS)
    assert "bus off" in [e.detail for e in bench.bus.events if e.node == "UPBEAM"]
    assert bench.node.state is ErrorState.ACTIVE
    sent = [t for t in bench.bus.transmissions if t.frame.identifier == 0x210]
    assert len(sent) == 1000 // 50  # the one of 1000 ms is on its way
    assert set(bench.monitor.decoder.verdicts["UPB_Status"]) == {E2EStatus.OK}


def test_a_sender_that_corrupts_its_frames_is_found_by_e2e_not_by_the_bus() -> None:
    bench = Bench()
    bench.bus.advance_to(100 * MS)
    bench.node.tamper = lambda f: CanFrame(f.identifier, f.data[:-1] + b"\xee") if f.identifier == 0x210 else f
    bench.bus.advance_to(300 * MS)
    assert not bench.bus.errors
    assert bench.monitor.decoder.verdicts["UPB_Status"][E2EStatus.WRONG_CRC] == len(
        [
            t
            for t in bench.bus.transmissions
            if t.frame.identifier == 0x210 and t.queued_ns > 100 * MS and t.end_ns < 300 * MS
        ]
    )


# --------------------------------------------------------------------------- each the other's oracle


@settings(max_examples=100, deadline=None)
@given(st.integers(0, 2**32))
def test_both_ends_protect_and_judge_alike(seed: int) -> None:
    rng = random.Random(seed)
    eleven = rng.random() < 0.5
    length = rng.randrange(2, 9) if eleven else rng.randrange(3, 65)
    config = E2EConfig(rng.randrange(0xF00), length, rng.randrange(1, 5))
    profile = (Profile11 if eleven else Profile05)(config)
    theirs = native.Receiver(11 if eleven else 5, config.data_id, length, config.max_delta_counter)
    ours = Receiver(profile)
    counter = rng.randrange(profile.counters)
    for _ in range(20):
        data = rng.randbytes(length)
        good, after = native.protect(11 if eleven else 5, config.data_id, counter, data)
        assert good == profile.protect(data, counter)
        counter = rng.choice([after, after, counter, (after + 1) % profile.counters])
        seen: bytes | None = good
        match rng.randrange(6):
            case 0:
                at = rng.randrange(length)
                seen = good[:at] + bytes([good[at] ^ 1 << rng.randrange(8)]) + good[at + 1 :]
            case 1:
                seen = None
            case 2:
                seen = good[:-1]
        assert theirs.check(seen) == ours.check(seen)


@settings(max_examples=100, deadline=None)
@given(st.integers(0, 2**32))
def test_both_state_machines_go_alike(seed: int) -> None:
    rng = random.Random(seed)
    windows = [(size := rng.randrange(1, 9), rng.randrange(size + 1), rng.randrange(size + 1)) for _ in range(3)]
    clear = rng.random() < 0.5
    theirs = native.Machine(*windows, clear_to_invalid=clear)
    ours = StateMachine(*[Window(*w) for w in windows], clear_to_invalid=clear)
    for _ in range(60):
        status = rng.choice([0, 0, 0, 1, 2, 3, 4, 5])
        assert theirs.step(status) == ours.step(E2EStatus(status))


@settings(max_examples=60, deadline=None)
@given(st.binary(min_size=16, max_size=16), st.integers(0, 255), st.integers(1, 2**32 - 1), st.integers(0, 2**32 - 1))
def test_both_ends_build_the_same_command(key: bytes, code: int, freshness: int, crc32: int) -> None:
    ours = Commander(key).forge(code, freshness, argument=code ^ 0x55, model_crc32=crc32)
    assert ours.data == native.command_bytes(key, code, freshness, code ^ 0x55, crc32)
    assert cmac(key, ours.data) == native.cmac(key, ours.data)
    assert len(ours.data) == MAC_OFFSET + 8


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32))
def test_both_parsers_read_the_same_from_a_noisy_line(seed: int) -> None:
    rng = random.Random(seed)
    line = NoisyLine(seed, loss=0.01, flip=0.01, insert=0.01, burst=2)
    ours, theirs = RecordParser(), native.Parser()
    for _ in range(60):
        fd = rng.random() < 0.5
        size = rng.choice(FD_LENGTHS) if fd else rng.randrange(9)
        frame = CanFrame(rng.randrange(0x800), rng.randbytes(size), fd=fd, bit_rate_switch=fd and rng.random() < 0.5)
        record = encode_record(frame)
        assert record == native.console_encode(frame.identifier, frame.data, fd | frame.bit_rate_switch << 1)
        data = line.pass_on(record)
        if rng.random() < 0.05:
            data += bytes(rng.randrange(1, 256) for _ in range(rng.randrange(300))) + b"\0"
        read = [(f.identifier, f.fd | f.bit_rate_switch << 1, f.data) for f in ours.feed(data)]
        assert read == theirs.feed(data)
    assert ours.refused == theirs.refused


@settings(max_examples=150, deadline=None)
@given(st.binary(min_size=4, max_size=80), st.integers(0, 8), st.booleans())
def test_both_ends_take_the_same_bytes_for_a_frame(data: bytes, flags: int, fit: bool) -> None:
    """Random bytes are hardly ever a frame: flags and length are set so that half of them nearly are."""
    raw = bytearray(data)
    if fit and len(raw) > 5:
        raw[1:4] = bytes([raw[1] & 7, 0, 0])
        raw[4:6] = bytes([flags, len(raw) - 6])
    try:
        ours: tuple[int, int, bytes] | None = None
        frame = decode_frame(bytes(raw))
        ours = (frame.identifier, encode_frame(frame)[4], frame.data)
    except ValueError:
        pass
    try:
        theirs = native.frame_decode(bytes(raw))
    except (ValueError, RuntimeError):
        theirs = None
    assert ours == (None if theirs is None else tuple(theirs))
