"""A CAN bus on virtual time: arbitration, bit times, errors and their counters, load.

An undisturbed frame takes the time of its own bits, stuffing included; whatever is disturbed is stepped bit by bit
with every node (:mod:`.station`), and both ways agree to the nanosecond where both apply (a test holds them to it).

What is modelled: ISO 11898-1 from start of frame to intermission, error and overload frames, fault confinement,
bus-off and recovery. What is not: propagation delay and oscillator tolerance (all nodes sample the same instant), a
frame whose start falls into another node's third intermission bit, noise on the idle bus (a bus held dominant is
modelled), wake-up, and the exact bit in which a CAN FD node in error returns to the nominal rate (here: when no
transmitter is in its data phase any more).
"""

from __future__ import annotations

import heapq
import random
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

from .bits import EOF_BITS, INTERMISSION_BITS, RECESSIVE, arbitration_key, wire_bits
from .frame import CanFrame
from .station import ErrorCounters, ErrorKind, ErrorState, Station, run_bits

NS_PER_S = 1_000_000_000
RECOVERY_SEQUENCES = 128
RECOVERY_BITS = 11
SUSPEND_BITS = 8


@dataclass(frozen=True, slots=True)
class Received:
    """A frame that a node took off the bus, at ``time_ns`` (its last but one bit)."""

    time_ns: int
    frame: CanFrame
    sender: str


@dataclass(frozen=True, slots=True)
class Transmission:
    """A frame that was sent and acknowledged."""

    frame: CanFrame
    sender: str
    queued_ns: int
    start_ns: int
    end_ns: int
    """End of its last bit; the bus is free :data:`INTERMISSION_BITS` later."""
    attempts: int

    @property
    def response_ns(self) -> int:
        """From queuing to the end of the frame."""
        return self.end_ns - self.queued_ns


@dataclass(frozen=True, slots=True)
class BusEvent:
    """Something to note beside frames: an error seen by a node, a change of its state, a frame it refused."""

    time_ns: int
    node: str
    what: Literal["error", "state", "refused"]
    detail: str


@dataclass(slots=True)
class _Queued:
    frame: CanFrame
    queued_ns: int
    order: int
    attempts: int = 0

    def key(self) -> tuple[tuple[int, ...], int]:
        return arbitration_key(self.frame), self.order


class Node:
    """One controller on the bus, made by :meth:`SimulatedBus.node`.

    ``queue``: "priority" sends the queued frame that would win arbitration (enough mailboxes), "fifo" the oldest
    (priority inversion: the response-time analysis does not cover it). A frame beyond ``capacity`` is refused and
    counted in ``refused``.
    """

    def __init__(self, bus: SimulatedBus, name: str, queue: Literal["priority", "fifo"], capacity: int) -> None:
        self._bus = bus
        self.name = name
        self.queue_rule = queue
        self.capacity = capacity
        self.counters = ErrorCounters()
        self.connected = True
        self.auto_recover = True
        self.tamper: Callable[[CanFrame], CanFrame | None] | None = None
        self.received: list[Received] = []
        self.listeners: list[Callable[[Received], None]] = []
        self.refused = 0
        self.sent = 0
        self._queue: list[_Queued] = []
        self._suspended_until = 0
        self._recovering_from: int | None = None
        self._sequences = 0

    @property
    def state(self) -> ErrorState:
        """Error active, error passive or bus-off."""
        return self.counters.state

    @property
    def waiting(self) -> int:
        """Frames queued and not yet sent."""
        return len(self._queue)

    def send(self, frame: CanFrame, time_ns: int | None = None) -> None:
        """Queue a frame at ``time_ns`` (now). :raises ValueError: time gone by, or FD on a classic bus."""
        self._bus._send(self, frame, self._bus.now_ns if time_ns is None else time_ns)

    def send_cyclic(self, frame: CanFrame, period_ns: int, *, start_ns: int, end_ns: int) -> None:
        """Queue ``frame`` every ``period_ns`` from ``start_ns`` up to, not at, ``end_ns``."""
        for time_ns in range(start_ns, end_ns, period_ns):
            self.send(frame, time_ns)

    def flush(self) -> int:
        """Forget what is queued; how many frames that were."""
        count = len(self._queue)
        self._queue.clear()
        return count

    def recover(self) -> None:
        """Leave bus-off after 128 times 11 recessive bits from now (done by itself unless ``auto_recover`` is off)."""
        if self.counters.off and self._recovering_from is None:
            self._recovering_from, self._sequences = self._bus.now_ns, 0

    def _next(self) -> _Queued | None:
        if not self._queue or not self.connected or self.counters.off:
            return None
        return self._queue[0] if self.queue_rule == "fifo" else min(self._queue, key=_Queued.key)


@dataclass(frozen=True, slots=True)
class _Flip:
    """Invert one bit (counted from start of frame) of the frames with ``identifier`` (None: any)."""

    bit: int
    identifier: int | None
    node: str | None
    count: int


@dataclass(slots=True)
class BusFaults:
    """What disturbs the bus; all of it deterministic."""

    flips: list[_Flip] = field(default_factory=list)
    held_dominant: list[tuple[int, int]] = field(default_factory=list)
    bit_error_rate: float = 0.0
    rng: random.Random = field(default_factory=lambda: random.Random(0))
    until_flip: int | None = None

    def draw(self) -> int:
        """Good bits before the next wrong one, geometrically distributed."""
        if self.until_flip is None:
            self.until_flip = 0
            while self.rng.random() >= self.bit_error_rate:
                self.until_flip += 1
        return self.until_flip


class SimulatedBus:
    """A bus with nodes, moved on by :meth:`advance_to`. All times are integer ns of one virtual clock.

    ``transmissions`` and ``events`` hold what has happened so far, in order of time, and ``listeners`` and
    ``event_listeners`` are called as it happens; ``errors`` counts errors by kind as each node saw them. What becomes
    of a frame is settled when it begins: error counters and states of nodes change then, up to one frame early.

    ``nominal_bit_rate`` and ``data_bit_rate`` in bit/s; without a data bit rate FD frames with bit rate switch are
    refused (``fd=False``: every FD frame). A bit time must be a whole number of ns.
    """

    def __init__(
        self, nominal_bit_rate: int = 500_000, data_bit_rate: int | None = 2_000_000, *, fd: bool = True
    ) -> None:
        self.nominal_bit_ns = bit_time_ns(nominal_bit_rate)
        self.data_bit_ns = bit_time_ns(data_bit_rate or nominal_bit_rate)
        self.switches = data_bit_rate is not None and fd
        self.fd = fd
        self.now_ns = 0
        self.nodes: dict[str, Node] = {}
        self.transmissions: list[Transmission] = []
        self.events: list[BusEvent] = []
        self.errors: Counter[ErrorKind] = Counter()
        self.error_frames = 0
        self.listeners: list[Callable[[Transmission], None]] = []
        self.event_listeners: list[Callable[[BusEvent], None]] = []
        self._faults = BusFaults()
        self._heap: list[tuple[int, int, Callable[[], None]]] = []
        self._order = 0
        self._free_at = 0
        self._last_dominant = 0
        self._busy: list[tuple[int, int]] = []

    # ------------------------------------------------------------------------------------------- set up

    def node(self, name: str, *, queue: Literal["priority", "fifo"] = "priority", capacity: int = 64) -> Node:
        """Add a node. :raises ValueError: the name is taken."""
        if name in self.nodes:
            raise ValueError(f"there is a node {name!r} already")
        self.nodes[name] = Node(self, name, queue, capacity)
        return self.nodes[name]

    def call_at(self, time_ns: int, action: Callable[[], None]) -> None:
        """Run ``action`` when the clock reaches ``time_ns``. :raises ValueError: time gone by."""
        if time_ns < self.now_ns:
            raise ValueError(f"time {time_ns} ns has gone by, it is {self.now_ns} ns")
        self._order += 1
        heapq.heappush(self._heap, (time_ns, self._order, action))

    # ------------------------------------------------------------------------------------------- faults

    def flip_bit(self, bit: int, *, identifier: int | None = None, node: str | None = None, count: int = 1) -> None:
        """Invert bit ``bit`` (0: start of frame) of the next ``count`` frames with ``identifier`` (None: any).

        For all nodes, or with ``node`` only in what that one samples.
        """
        self._faults.flips.append(_Flip(bit, identifier, node, count))

    def set_bit_error_rate(self, rate: float, *, seed: int = 0) -> None:
        """Invert every bit of frames, for all nodes, with probability ``rate`` (0: no more)."""
        if not 0 <= rate < 1:
            raise ValueError(f"bit error rate {rate} is not within 0 <= rate < 1")
        self._faults.bit_error_rate = rate
        self._faults.rng = random.Random(seed)
        self._faults.until_flip = None

    def hold_dominant(self, start_ns: int, end_ns: int) -> None:
        """A short: the bus is dominant from ``start_ns`` to ``end_ns``."""
        if not self.now_ns <= start_ns < end_ns:
            raise ValueError(f"dominant from {start_ns} to {end_ns} ns, it is {self.now_ns} ns")
        self._faults.held_dominant.append((start_ns, end_ns))

    def babble(self, frame: CanFrame, start_ns: int, end_ns: int, *, name: str = "babbler") -> Node:
        """A babbling idiot: a node that always has ``frame`` to send from ``start_ns`` to ``end_ns``."""
        rogue = self.nodes.get(name) or self.node(name, queue="fifo", capacity=2)

        def keep_full() -> None:
            if self.now_ns >= end_ns:
                rogue.flush()
                return
            while rogue.waiting < rogue.capacity:
                self._enqueue(rogue, frame)
            step = wire_bits(frame).duration_ns(self.nominal_bit_ns, self.data_bit_ns)
            self.call_at(min(self.now_ns + step, end_ns), keep_full)

        self.call_at(start_ns, keep_full)
        return rogue

    # --------------------------------------------------------------------------------------------- time

    def advance_to(self, time_ns: int) -> None:
        """Let everything happen up to and at ``time_ns``. A frame that began before may end after it."""
        if time_ns < self.now_ns:
            raise ValueError(f"time {time_ns} ns has gone by, it is {self.now_ns} ns")
        while True:
            event = self._heap[0][0] if self._heap else None
            start = self._next_start()
            recovery = self._next_recovery()
            times = [t for t in (event, start, recovery and recovery[0]) if t is not None]
            if not times or min(times) > time_ns:
                break
            self.now_ns = min(times)
            if event == self.now_ns:
                heapq.heappop(self._heap)[2]()
            elif recovery is not None and recovery[0] == self.now_ns:
                self._recovered(recovery[1])
            else:
                self._use_bus()
        self.now_ns = time_ns

    def advance(self, duration_ns: int) -> None:
        """As :meth:`advance_to`, from now."""
        self.advance_to(self.now_ns + duration_ns)

    def advance_next(self, limit_ns: int) -> bool:
        """Move on to the next thing that happens, at most to ``limit_ns``; False if nothing did before the limit."""
        upcoming = self.next_event_ns()
        if upcoming is None or upcoming > limit_ns:
            self.advance_to(max(limit_ns, self.now_ns))
            return False
        self.advance_to(upcoming)
        return True

    def next_event_ns(self) -> int | None:
        """When something happens next; None if never (nothing queued, planned or recovering)."""
        recovery = self._next_recovery()
        times = [self._heap[0][0] if self._heap else None, self._next_start(), recovery[0] if recovery else None]
        return min((t for t in times if t is not None), default=None)

    def log(self) -> list[str]:
        """Everything that happened, a line each: time in ms, node, frame or event."""
        lines = [(t.end_ns, f"{t.sender:<12} {_text(t)}") for t in self.transmissions]
        lines += [(e.time_ns, f"{e.node:<12} {e.what}: {e.detail}") for e in self.events]
        return [f"{time_ns / 1e6:12.6f} {line}" for time_ns, line in sorted(lines, key=lambda item: item[0])]

    def load(self, start_ns: int, end_ns: int) -> float:
        """Share of the time from start to end that the bus was taken: frames, error frames, intermissions."""
        if end_ns <= start_ns:
            raise ValueError(f"no time between {start_ns} and {end_ns} ns")
        busy = sum(max(0, min(end, end_ns) - max(start, start_ns)) for start, end in self._busy)
        return busy / (end_ns - start_ns)

    # ----------------------------------------------------------------------------------------- internals

    def _send(self, node: Node, frame: CanFrame, time_ns: int) -> None:
        if frame.fd and not self.fd:
            raise ValueError(f"frame {frame.name} is CAN FD, the bus is classic")
        if frame.bit_rate_switch and not self.switches:
            raise ValueError(f"frame {frame.name} switches the bit rate, the bus has one only")
        if time_ns == self.now_ns:
            self._enqueue(node, frame)
        else:
            self.call_at(time_ns, lambda: self._enqueue(node, frame))

    def _enqueue(self, node: Node, frame: CanFrame) -> None:
        changed = node.tamper(frame) if node.tamper else frame
        if changed is None:
            return
        if len(node._queue) >= node.capacity:
            node.refused += 1
            self._note(self.now_ns, node.name, "refused", f"{frame.name}: {node.capacity} frames wait already")
            return
        self._order += 1
        node._queue.append(_Queued(changed, self.now_ns, self._order))

    def _next_start(self) -> int | None:
        """When the bus is next taken: by a frame, or by a dominant level from outside."""
        ready = [max(self._free_at, n._suspended_until, self.now_ns) for n in self.nodes.values() if n._next()]
        held = [max(start, self._free_at) for start, end in self._faults.held_dominant if end > self._free_at]
        if not any(n.connected and not n.counters.off for n in self.nodes.values()):
            held = []
        return min(ready + held, default=None)

    def _use_bus(self) -> None:
        """One use of the bus from now: arbitration, the frame, what became of it."""
        start = self.now_ns
        self._count_recovery(start)
        listening = [n for n in self.nodes.values() if n.connected and not n.counters.off]
        contenders = {n.name: q for n in listening if n._suspended_until <= start and (q := n._next())}
        flips = self._flips_for(contenders)
        if len(listening) > 1 and contenders and not flips and self._fast(listening, contenders, start):
            return
        self._bit_by_bit(listening, contenders, flips, start)

    def _flips_for(self, contenders: dict[str, _Queued]) -> list[_Flip]:
        """Planned flips that meet the frame which wins; each is used up once per frame."""
        if not contenders or not self._faults.flips:
            return []
        winner = min(contenders.values(), key=lambda q: arbitration_key(q.frame)).frame.identifier
        hit = [f for f in self._faults.flips if f.identifier in (None, winner)]
        kept = [f for f in self._faults.flips if f not in hit]
        again = [_Flip(f.bit, f.identifier, f.node, f.count - 1) for f in hit if f.count > 1]
        self._faults.flips = kept + again
        return hit

    def _fast(self, listening: list[Node], contenders: dict[str, _Queued], start: int) -> bool:
        """An undisturbed frame by its length alone; False if this needs a look at every bit."""
        name, queued = min(contenders.items(), key=lambda item: arbitration_key(item[1].frame))
        key = arbitration_key(queued.frame)
        if sum(arbitration_key(q.frame) == key for q in contenders.values()) > 1:
            return False
        wire = wire_bits(self._as_sent(self.nodes[name], queued.frame))
        end = start + wire.duration_ns(self.nominal_bit_ns, self.data_bit_ns)
        free = end + INTERMISSION_BITS * self.nominal_bit_ns
        if any(a < free and b > start for a, b in self._faults.held_dominant):
            return False
        if self._faults.bit_error_rate:
            if self._faults.draw() < len(wire.bits):
                return False
            self._faults.until_flip = self._faults.draw() - len(wire.bits)
        for other in contenders.values():
            other.attempts += 1
        before = {n.name: n.state for n in listening}
        sender = self.nodes[name]
        sender.counters.sent()
        self._finish_sent(sender, queued, start, end)
        got = self._as_sent(sender, queued.frame)
        for node in listening:
            if node is not sender:
                node.counters.received()
                self._deliver(node, got, name, end - self.nominal_bit_ns)
        self._note_states(before, end)
        self._release(start, free, end - (EOF_BITS + 1) * self.nominal_bit_ns, [sender])
        return True

    def _as_sent(self, node: Node, frame: CanFrame) -> CanFrame:
        """An FD controller that is error passive says so in ESI."""
        if not frame.fd or node.state is not ErrorState.PASSIVE or frame.error_state_indicator:
            return frame
        return CanFrame(frame.identifier, frame.data, frame.extended, True, frame.bit_rate_switch, True)

    def _bit_by_bit(
        self, listening: list[Node], contenders: dict[str, _Queued], flips: list[_Flip], start: int
    ) -> None:
        stations = []
        for node in listening:
            queued = contenders.get(node.name)
            frame = self._as_sent(node, queued.frame) if queued else None
            stations.append(Station(node.name, node.counters, frame))
            if queued:
                queued.attempts += 1
        before = {n.name: n.state for n in listening}
        length = max((len(s.wire.bits) for s in stations if s.wire), default=0)
        run = run_bits(stations, _BusDisturbance(self, flips, start, length))
        ends = run.ends_ns(start, self.nominal_bit_ns, self.data_bit_ns)
        self._take_logs(stations, contenders, ends, start)
        self._note_states(before, ends[-1])
        dominant = max((i for i, level in enumerate(run.levels) if level == 0), default=-1)
        free = ends[-1]
        transmitters = [self.nodes[s.name] for s in stations if s.log.transmitted]
        self._release(start, free, ends[dominant] if dominant >= 0 else start, transmitters)

    def _take_logs(self, stations: list[Station], contenders: dict[str, _Queued], ends: list[int], start: int) -> None:
        senders = {s.log.sent: s.name for s in stations if s.log.sent is not None}
        transmitting = [s.name for s in stations if s.wire is not None]
        for station in stations:
            node = self.nodes[station.name]
            if station.log.sent is not None:
                self._finish_sent(node, contenders[node.name], start, ends[station.log.sent])
            for index, frame in station.log.received:
                source = next(iter(senders.values()), transmitting[0] if len(transmitting) == 1 else "")
                self._deliver(node, frame, source, ends[index])
            for index, kind, sending in station.log.errors:
                self.errors[kind] += 1
                role = "transmitter" if sending else "receiver"
                self._note(ends[index], node.name, "error", f"{kind.value} error as {role}")
        self.error_frames += any(s.log.errors for s in stations)

    def _finish_sent(self, node: Node, queued: _Queued, start: int, end: int) -> None:
        node._queue.remove(queued)
        sent = Transmission(queued.frame, node.name, queued.queued_ns, start, end, max(1, queued.attempts))

        def record() -> None:
            node.sent += 1
            self.transmissions.append(sent)
            for listener in self.listeners:
                listener(sent)

        self.call_at(end, record)

    def _deliver(self, node: Node, frame: CanFrame, sender: str, time_ns: int) -> None:
        received = Received(time_ns, frame, sender)

        def hand_over() -> None:
            node.received.append(received)
            for listener in node.listeners:
                listener(received)

        self.call_at(time_ns, hand_over)

    def _release(self, start: int, free: int, last_dominant: int, transmitters: list[Node]) -> None:
        self._free_at = free
        self._last_dominant = last_dominant
        if self._busy and self._busy[-1][1] == start:
            self._busy[-1] = (self._busy[-1][0], free)
        else:
            self._busy.append((start, free))
        for node in transmitters:  # one that is error passive lets the others go first
            if node.state is ErrorState.PASSIVE:
                node._suspended_until = free + SUSPEND_BITS * self.nominal_bit_ns

    def _note(self, time_ns: int, node: str, what: Literal["error", "state", "refused"], detail: str) -> None:
        event = BusEvent(time_ns, node, what, detail)

        def record() -> None:
            self.events.append(event)
            for listener in self.event_listeners:
                listener(event)

        self.call_at(time_ns, record)

    def _note_states(self, before: dict[str, ErrorState], time_ns: int) -> None:
        for name, old in before.items():
            node = self.nodes[name]
            if node.state is old:
                continue
            self._note(time_ns, name, "state", node.state.value)
            if node.counters.off and node.auto_recover:
                node._recovering_from, node._sequences = time_ns, 0

    # ------------------------------------------------------------------------------------------ recovery

    def _sequences_until(self, node: Node, time_ns: int) -> int:
        """Sequences of 11 recessive bits of the present recessive run that ``node`` has seen at ``time_ns``."""
        begin = max(self._last_dominant, node._recovering_from or 0)
        return max(0, time_ns - begin) // (RECOVERY_BITS * self.nominal_bit_ns)

    def _count_recovery(self, start: int) -> None:
        for node in self.nodes.values():
            if node._recovering_from is not None:
                node._sequences += self._sequences_until(node, start)

    def _next_recovery(self) -> tuple[int, Node] | None:
        """The first node to leave bus-off if nobody takes the bus before, and when."""
        best: tuple[int, Node] | None = None
        for node in self.nodes.values():
            if node._recovering_from is None or not node.connected:
                continue
            begin = max(self._last_dominant, node._recovering_from)
            missing = max(0, RECOVERY_SEQUENCES - node._sequences)
            time_ns = max(self.now_ns, begin + missing * RECOVERY_BITS * self.nominal_bit_ns)
            if best is None or time_ns < best[0]:
                best = (time_ns, node)
        return best

    def _recovered(self, node: Node) -> None:
        node.counters.recover()
        node._recovering_from = None
        self._note(self.now_ns, node.name, "state", node.state.value)


class _BusDisturbance:
    """The faults of a :class:`SimulatedBus` in one use of the bus."""

    def __init__(self, bus: SimulatedBus, flips: list[_Flip], start_ns: int, frame_bits: int) -> None:
        self._faults = bus._faults
        self._everywhere = {f.bit for f in flips if f.node is None}
        self._local = {(f.bit, f.node) for f in flips if f.node is not None}
        self._bit_ns = bus.nominal_bit_ns
        self._start_ns = start_ns
        self._frame_bits = frame_bits

    def level(self, index: int, level: int) -> int:
        """Level on the bus, a short and common bit errors applied."""
        now = self._start_ns + index * self._bit_ns
        if any(a <= now < b for a, b in self._faults.held_dominant):
            return 0
        if self._faults.bit_error_rate and index < self._frame_bits:
            if self._faults.draw() == 0:
                self._faults.until_flip = None
                level ^= RECESSIVE
            else:
                self._faults.until_flip = self._faults.draw() - 1
        return level ^ (index in self._everywhere)

    def seen(self, index: int, station: str, level: int) -> int:
        """What one node samples."""
        return level ^ ((index, station) in self._local)


def _text(sent: Transmission) -> str:
    frame = sent.frame
    kind = ("FD " if frame.fd else "") + ("BRS " if frame.bit_rate_switch else "") + ("remote " if frame.remote else "")
    repeated = f" (attempt {sent.attempts})" if sent.attempts > 1 else ""
    return f"{frame.name} {kind}[{len(frame.data)}] {frame.data.hex(' ')}{repeated}"


def bit_time_ns(bit_rate: int) -> int:
    """Bit time of a bit rate in bit/s. :raises ValueError: it is not a whole number of ns."""
    if bit_rate <= 0 or NS_PER_S % bit_rate:
        raise ValueError(f"a bit at {bit_rate} bit/s does not take a whole number of nanoseconds")
    return NS_PER_S // bit_rate
