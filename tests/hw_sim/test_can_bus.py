"""The simulated bus: time, arbitration, errors and fault confinement."""

from __future__ import annotations

import random
import subprocess
import sys
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from upbeam.hw_sim.can.analysis import length_of
from upbeam.hw_sim.can.bits import arbitration_key, wire_bits
from upbeam.hw_sim.can.bus import RECOVERY_BITS, RECOVERY_SEQUENCES, SimulatedBus, bit_time_ns
from upbeam.hw_sim.can.frame import CanFrame
from upbeam.hw_sim.can.station import ErrorCounters, ErrorKind, ErrorState, Station, Undisturbed, run_bits

BIT = 2000  # ns at 500 kbit/s
MS = 1_000_000


def random_frame(rng: random.Random) -> CanFrame:
    extended, fd = rng.random() < 0.3, rng.random() < 0.4
    identifier = rng.randrange(1 << (29 if extended else 11))
    size = rng.choice((0, 8, 12, 64)) if fd else rng.randrange(9)
    return CanFrame(identifier, rng.randbytes(size), extended, fd, fd and rng.random() < 0.7)


def test_a_frame_takes_the_time_of_its_bits() -> None:
    bus = SimulatedBus()
    a, b = bus.node("a"), bus.node("b")
    frame = CanFrame(0x100, bytes(8))
    a.send(frame, 5 * MS)
    bus.advance_to(10 * MS)
    (sent,) = bus.transmissions
    assert sent.start_ns == 5 * MS
    assert sent.end_ns == 5 * MS + len(wire_bits(frame).bits) * BIT
    assert [(r.frame, r.sender, r.time_ns) for r in b.received] == [(frame, "a", sent.end_ns - BIT)]
    assert bus.load(0, 10 * MS) == pytest.approx(length_of(frame).bits * BIT / (10 * MS))


def test_back_to_back_frames_keep_three_bits_apart_and_the_data_phase_is_faster() -> None:
    bus = SimulatedBus(500_000, 2_000_000)
    a, _ = bus.node("a"), bus.node("b")
    frame = CanFrame(0x100, bytes(64), fd=True, bit_rate_switch=True)
    a.send(frame)
    a.send(frame)
    bus.advance_to(5 * MS)
    first, second = bus.transmissions
    assert second.start_ns - first.end_ns == 3 * BIT
    wire = wire_bits(frame)
    assert first.end_ns == wire.nominal_bits * BIT + wire.data_phase * 500
    assert first.end_ns < len(wire.bits) * BIT / 3


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32))
def test_shortcut_and_bit_by_bit_agree(seed: int) -> None:
    """Several nodes, any frames, no errors: the frame-length shortcut gives what stepping every bit gives."""
    rng = random.Random(seed)
    frames = {arbitration_key(f): f for f in (random_frame(rng) for _ in range(rng.randrange(1, 5)))}.values()
    bus = SimulatedBus()
    for index, frame in enumerate(frames):
        bus.node(f"n{index}").send(frame)
    bus.node("listener")
    bus.advance_to(5 * MS)
    first = bus.transmissions[0]
    stations = [Station(f"n{i}", ErrorCounters(), f) for i, f in enumerate(frames)]
    stations.append(Station("listener", ErrorCounters()))
    run = run_bits(stations, Undisturbed())
    ends = run.ends_ns(0, BIT, 500)
    (winner,) = [s for s in stations if s.log.sent is not None]
    assert winner.log.sent is not None
    assert (winner.name, ends[winner.log.sent]) == (first.sender, first.end_ns)
    assert ends[-1] == first.end_ns + 3 * BIT
    for station in stations:
        assert not station.log.errors
        if station is not winner:
            assert [f for _, f in station.log.received] == [first.frame]
            assert ends[station.log.received[0][0]] == first.end_ns - BIT


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32))
def test_highest_priority_always_goes_first_and_nothing_is_lost(seed: int) -> None:
    rng = random.Random(seed)
    bus = SimulatedBus()
    nodes = [bus.node(f"n{i}") for i in range(3)]
    frames = list({arbitration_key(f): f for f in (random_frame(rng) for _ in range(20))}.values())
    for frame in frames:
        rng.choice(nodes).send(frame, rng.randrange(3 * MS))
    bus.advance_to(100 * MS)
    assert sorted(t.frame.name for t in bus.transmissions) == sorted(f.name for f in frames)
    for index, sent in enumerate(bus.transmissions):
        for later in bus.transmissions[index + 1 :]:
            if later.queued_ns <= sent.start_ns:
                assert arbitration_key(sent.frame) < arbitration_key(later.frame)
    ordered = sorted(bus.transmissions, key=lambda t: t.start_ns)
    for one, two in pairwise(ordered):
        assert two.start_ns >= one.end_ns + 3 * BIT


def test_fifo_queue_inverts_priorities() -> None:
    responses = {}
    for rule in ("priority", "fifo"):
        bus = SimulatedBus()
        node, _ = bus.node("a", queue=rule), bus.node("b")  # type: ignore[arg-type]
        for identifier in (0x700, 0x600, 0x100):
            node.send(CanFrame(identifier, bytes(8)))
        bus.advance_to(10 * MS)
        responses[rule] = [t.frame.identifier for t in bus.transmissions]
    assert responses == {"priority": [0x100, 0x600, 0x700], "fifo": [0x700, 0x600, 0x100]}


@pytest.mark.parametrize("bit", [3, 15, 30, 60, 90])
def test_a_bit_error_is_signalled_by_everyone_and_the_frame_repeated(bit: int) -> None:
    bus = SimulatedBus()
    a, b = bus.node("a"), bus.node("b")
    frame = CanFrame(0x2AA, b"\x5a" * 8)
    bus.flip_bit(bit, identifier=0x2AA)
    a.send(frame)
    bus.advance_to(10 * MS)
    (sent,) = bus.transmissions
    assert sent.attempts == 2
    assert [r.frame for r in b.received] == [frame]
    assert a.counters.transmit == 8 - 1
    assert bus.error_frames == 1
    # the flag begins after the bit: 6 to 12 dominant bits, 8 delimiter, 3 intermission
    lost = sent.start_ns // BIT - (bit + 1)
    assert 6 + 8 + 3 <= lost <= 12 + 8 + 3


def test_an_error_that_one_receiver_alone_sees_stops_the_frame_for_all() -> None:
    bus = SimulatedBus()
    a, b, c = bus.node("a"), bus.node("b"), bus.node("c")
    bus.flip_bit(30, node="b")
    a.send(CanFrame(0x2AA, b"\x5a" * 8))
    bus.advance_to(10 * MS)
    assert bus.transmissions[0].attempts == 2
    assert len(b.received) == len(c.received) == 1
    assert b.counters.receive == 1 + 8 - 1  # it was first: it sees the others' flags after its own
    assert c.counters.receive == 0
    assert a.counters.transmit == 7


def test_last_bit_of_end_of_frame_duplicates_the_message() -> None:
    """The known weakness of CAN: receivers have taken the frame, the transmitter sends it again."""
    bus = SimulatedBus()
    a, b = bus.node("a"), bus.node("b")
    frame = CanFrame(0x2AA, b"\x5a" * 8)
    bus.flip_bit(len(wire_bits(frame).bits) - 1)
    a.send(frame)
    bus.advance_to(10 * MS)
    assert [r.frame for r in b.received] == [frame, frame]
    assert bus.transmissions[0].attempts == 2


def test_a_lone_node_becomes_error_passive_and_never_bus_off() -> None:
    bus = SimulatedBus()
    a = bus.node("a")
    other = bus.node("b")
    other.connected = False
    a.send(CanFrame(0x100, b"12"))
    bus.advance_to(30 * MS)
    assert a.state is ErrorState.PASSIVE
    assert a.counters.transmit == 128
    assert set(bus.errors) == {ErrorKind.ACK}
    other.connected = True
    bus.advance_to(40 * MS)
    assert [r.frame.data for r in other.received] == [b"12"]
    assert a.counters.transmit == 127
    assert a.state is ErrorState.ACTIVE


def test_errors_in_a_row_lead_to_bus_off_and_recovery_takes_128_times_11_bits() -> None:
    bus = SimulatedBus()
    a, b = bus.node("a"), bus.node("b")
    bus.flip_bit(25, count=1000)
    a.send(CanFrame(0x100, b"\x11" * 8))
    bus.advance_to(6 * MS)
    states = [(e.time_ns, e.detail) for e in bus.events if e.what == "state" and e.node == "a"]
    assert [detail for _, detail in states[:2]] == ["error passive", "bus off"]
    assert a.counters.off
    off_at = states[1][0]
    bus._faults.flips.clear()
    bus.advance_to(20 * MS)
    (back_at,) = [e.time_ns for e in bus.events if e.node == "a" and e.what == "state" and e.time_ns > off_at][:1]
    wait = RECOVERY_SEQUENCES * RECOVERY_BITS * BIT
    assert wait - 20 * BIT <= back_at - off_at <= wait
    assert a.state is ErrorState.ACTIVE
    assert [r.frame.data for r in b.received] == [b"\x11" * 8]


def test_recovery_on_a_busy_bus_waits_for_the_frames_of_others() -> None:
    def recovery_time(busy: bool) -> int:
        bus = SimulatedBus()
        a, b, _ = bus.node("a"), bus.node("b"), bus.node("c")
        a.counters.transmit, a.counters.off = 256, True
        a.recover()
        if busy:
            b.send_cyclic(CanFrame(0x123, b"\x55" * 8), 250_000, start_ns=0, end_ns=80 * MS)
        bus.advance_to(100 * MS)
        return next(e.time_ns for e in bus.events if e.node == "a")

    assert recovery_time(False) == 128 * 11 * BIT
    # 125 bits per frame hold two sequences at most: the frame's end and intermission, and the pause
    assert recovery_time(True) > 4 * recovery_time(False)


def test_without_recovery_a_node_stays_off() -> None:
    bus = SimulatedBus()
    a, _ = bus.node("a"), bus.node("b")
    a.auto_recover = False
    bus.flip_bit(25, count=32)
    a.send(CanFrame(0x100, b"\x11" * 8))
    bus.advance_to(100 * MS)
    assert a.counters.off
    a.recover()
    bus.advance_to(200 * MS)
    assert a.state is ErrorState.ACTIVE
    assert len(bus.transmissions) == 1


def test_error_passive_transmitter_lets_others_go_first() -> None:
    bus = SimulatedBus()
    a, b, _ = bus.node("a"), bus.node("b"), bus.node("c")
    a.counters.transmit = 200
    a.send(CanFrame(0x001, b"1"))
    a.send(CanFrame(0x002, b"2"))
    b.send(CanFrame(0x700, b"3"), 1)
    bus.advance_to(10 * MS)
    assert [t.frame.identifier for t in bus.transmissions] == [0x001, 0x700, 0x002]
    first, second, _ = bus.transmissions
    assert second.start_ns == first.end_ns + 3 * BIT


def test_a_short_to_dominant_stops_everything_and_ends() -> None:
    bus = SimulatedBus()
    a, b = bus.node("a"), bus.node("b")
    a.send_cyclic(CanFrame(0x100, b"1234"), MS, start_ns=0, end_ns=60 * MS)
    bus.hold_dominant(10 * MS + 50_000, 30 * MS)
    bus.advance_to(100 * MS)
    assert not [t for t in bus.transmissions if 10 * MS < t.end_ns < 30 * MS]
    assert a.sent == len(b.received) == 60
    assert "bus off" in [e.detail for e in bus.events if e.node == "a"]
    assert b.state is ErrorState.ACTIVE


def test_babbling_idiot_starves_what_is_below_it() -> None:
    bus = SimulatedBus()
    a, _ = bus.node("a"), bus.node("b")
    a.send_cyclic(CanFrame(0x200, b"1"), MS, start_ns=0, end_ns=30 * MS)
    bus.babble(CanFrame(0x000, bytes(8)), 10 * MS, 20 * MS)
    bus.advance_to(40 * MS)
    ends = [t.end_ns for t in bus.transmissions if t.sender == "a"]
    assert len(ends) == 30
    assert not [t for t in ends if 10.5 * MS < t < 20 * MS]
    assert bus.load(10 * MS, 20 * MS) > 0.99
    assert bus.load(31 * MS, 40 * MS) == 0


def test_same_identifier_from_two_nodes_ends_in_errors() -> None:
    bus = SimulatedBus()
    a, b, _ = bus.node("a"), bus.node("b"), bus.node("c")
    a.send(CanFrame(0x100, b"\x00"))
    b.send(CanFrame(0x100, b"\xff"))
    bus.advance_to(MS)
    assert bus.errors[ErrorKind.BIT] > 0
    bus2 = SimulatedBus()
    a, b, c = bus2.node("a"), bus2.node("b"), bus2.node("c")
    a.send(CanFrame(0x100, b"\x00"))
    b.send(CanFrame(0x100, b"\x00"))
    bus2.advance_to(MS)
    assert not bus2.errors
    assert len(c.received) == 1  # one frame on the wire, both think it is theirs


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 1000), st.sampled_from([1e-4, 1e-3, 5e-3, 2e-2]))
def test_under_noise_every_frame_arrives_once_or_the_node_is_off(seed: int, rate: float) -> None:
    """Frames are never altered; only an error in the very last bits may repeat one."""
    bus = SimulatedBus()
    a, b = bus.node("a"), bus.node("b")
    bus.set_bit_error_rate(rate, seed=seed)
    sent = [CanFrame(0x100 + i % 7, i.to_bytes(4, "little")) for i in range(60)]
    for index, frame in enumerate(sent):
        a.send(frame, index * MS)
    bus.advance_to(60 * MS)
    bus.set_bit_error_rate(0)
    bus.advance_to(100 * MS)
    got = [r.frame for r in b.received]
    assert set(got) == set(sent)
    assert len(bus.transmissions) == len(sent)
    assert sum(t.attempts - 1 for t in bus.transmissions) == bus.error_frames
    assert len(got) - len(sent) <= bus.error_frames


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32), st.sampled_from([1e-2, 5e-2, 0.3]))
def test_no_noise_however_bad_stops_the_simulation(seed: int, rate: float) -> None:
    """Frames of three nodes under noise that breaks flags and delimiters too; afterwards all of them get through."""
    rng = random.Random(seed)
    bus = SimulatedBus()
    nodes = [bus.node(n, capacity=100) for n in "abc"]
    bus.set_bit_error_rate(rate, seed=seed)
    for _ in range(20):
        rng.choice(nodes).send(random_frame(rng), rng.randrange(10 * MS))
    bus.advance_to(15 * MS)
    bus.set_bit_error_rate(0)
    bus.advance_to(100 * MS)
    assert len(bus.transmissions) == 20
    assert all(node.state is not ErrorState.BUS_OFF for node in nodes)


def test_equal_seeds_give_equal_runs() -> None:
    def run() -> tuple[object, ...]:
        bus = SimulatedBus()
        nodes = [bus.node(n) for n in "abc"]
        bus.set_bit_error_rate(1e-3, seed=5)
        rng = random.Random(9)
        for _ in range(60):
            rng.choice(nodes).send(random_frame(rng), rng.randrange(20 * MS))
        bus.advance_to(60 * MS)
        return bus.transmissions, bus.events, bus.load(0, 60 * MS)

    assert run() == run()


def test_tampering_and_full_queues_are_the_senders_faults() -> None:
    bus = SimulatedBus()
    a, b = bus.node("a", capacity=2), bus.node("b")
    a.tamper = lambda frame: None if frame.identifier == 1 else CanFrame(frame.identifier, b"bad")
    a.send(CanFrame(1, b"gone"))
    for _ in range(3):
        a.send(CanFrame(2, b"good"))
    bus.advance_to(5 * MS)
    assert [r.frame.data for r in b.received] == [b"bad", b"bad"]
    assert a.refused == 1
    assert [e.what for e in bus.events] == ["refused"]


def test_an_error_passive_fd_node_says_so() -> None:
    bus = SimulatedBus()
    a, b = bus.node("a"), bus.node("b")
    a.counters.transmit = 200
    a.send(CanFrame(5, bytes(8), fd=True))
    bus.advance_to(5 * MS)
    assert b.received[0].frame.error_state_indicator


def test_what_happened_is_told_in_order_and_not_before_it_happened() -> None:
    bus = SimulatedBus()
    a, _ = bus.node("a"), bus.node("b")
    told: list[tuple[int, int]] = []
    bus.listeners.append(lambda sent: told.append((bus.now_ns, sent.end_ns)))
    bus.event_listeners.append(lambda event: told.append((bus.now_ns, event.time_ns)))
    bus.flip_bit(30)
    a.send(CanFrame(0x100, b"\x01\x02"))
    a.send(CanFrame(0x18DAF110, b"", extended=True))
    bus.advance_to(100_000)
    assert not bus.transmissions
    bus.advance_to(10 * MS)
    assert len(told) == 2 + len(bus.events)
    assert all(now == then for now, then in told)
    log = bus.log()
    assert len(log) == len(told)
    assert "error: bit error as transmitter" in log[0]
    assert "100 [2] 01 02 (attempt 2)" in log[-2]
    assert "18DAF110 [0]" in log[-1]


def test_wrong_use_is_refused_by_name() -> None:
    bus = SimulatedBus(500_000, None)
    a = bus.node("a")
    with pytest.raises(ValueError, match="one only"):
        a.send(CanFrame(1, b"", fd=True, bit_rate_switch=True))
    with pytest.raises(ValueError, match="bus is classic"):
        SimulatedBus(500_000, None, fd=False).node("a").send(CanFrame(1, b"", fd=True))
    bus.advance_to(10)
    with pytest.raises(ValueError, match="gone by"):
        bus.advance_to(9)
    with pytest.raises(ValueError, match="gone by"):
        a.send(CanFrame(1), 5)
    with pytest.raises(ValueError, match="a node 'a' already"):
        bus.node("a")
    with pytest.raises(ValueError, match="whole number"):
        bit_time_ns(83_333)


def test_the_bus_and_its_analysis_need_no_extra() -> None:
    program = (
        "import sys\n"
        "for name in ('can', 'cantools', 'isotp', 'udsoncan', 'cryptography', 'serial', 'cobs'):\n"
        "    sys.modules[name] = None\n"
        "from upbeam.hw_sim.can import SimulatedBus, response_times, Receiver, encode_frame\n"
        "SimulatedBus().advance_to(1)\n"
    )
    subprocess.run([sys.executable, "-c", program], check=True)
