"""A CAN controller at the level of bits: it drives one bit, sees one bit, and acts on what it saw.

Sending, arbitration, receiving, acknowledging, error and overload flags, fault confinement (ISO 11898-1:2015 clause
"fault confinement"). Stations step together in :func:`run_bits`; the bus is the wired AND of what they drive.
"""

from __future__ import annotations

import enum
from collections import deque
from collections.abc import Generator, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Protocol

from .bits import (
    CRC15,
    CRC17,
    CRC17_MAX_BYTES,
    CRC21,
    DOMINANT,
    EOF_BITS,
    FIXED_STUFF_STEP,
    INTERMISSION_BITS,
    RECESSIVE,
    STUFF_COUNT_BITS,
    STUFF_RUN,
    WireBits,
    from_bits,
    stuff_count_bits,
    wire_bits,
)
from .frame import CLASSIC_MAX_BYTES, FD_LENGTHS, CanFrame

FLAG_BITS = 6
DELIMITER_BITS = 8
EXTRA_DOMINANT_BITS = 8
"""Dominant bits after its own flag that a node tolerates before it counts another error."""
PASSIVE_ABOVE = 127
BUS_OFF_ABOVE = 255
RECEIVE_AFTER_PASSIVE = 119
"""Where a receive counter above 127 lands after a good frame (the standard leaves 119 to 127 free)."""

Bits = Generator[int, int, None]


class ErrorState(enum.Enum):
    """Fault confinement state of a node."""

    ACTIVE = "error active"
    PASSIVE = "error passive"
    BUS_OFF = "bus off"


class ErrorKind(enum.Enum):
    """What a node can find wrong with the bits it sees."""

    BIT = "bit"
    STUFF = "stuff"
    FORM = "form"
    CRC = "crc"
    ACK = "ack"


class WireError(Exception):
    """A node saw an error; ``counted`` is False for the one that the standard exempts from the counter."""

    def __init__(self, kind: ErrorKind, *, counted: bool = True) -> None:
        super().__init__(kind.value)
        self.kind = kind
        self.counted = counted


class _BusOffError(Exception):
    """The node's transmit counter passed 255: it lets go of the bus at once."""


@dataclass(slots=True)
class ErrorCounters:
    """Transmit and receive error counter of one node."""

    transmit: int = 0
    receive: int = 0
    off: bool = False

    @property
    def state(self) -> ErrorState:
        """Error active, error passive or bus-off."""
        if self.off:
            return ErrorState.BUS_OFF
        return ErrorState.PASSIVE if max(self.transmit, self.receive) > PASSIVE_ABOVE else ErrorState.ACTIVE

    def sent(self) -> None:
        """A frame was sent and acknowledged."""
        self.transmit = max(0, self.transmit - 1)

    def received(self) -> None:
        """A frame was received without error."""
        if self.receive > PASSIVE_ABOVE:
            self.receive = RECEIVE_AFTER_PASSIVE
        else:
            self.receive = max(0, self.receive - 1)

    def fail(self, *, transmitting: bool, by: int) -> None:
        """Add ``by`` to the counter of the present role; past 255 sent errors the node is bus-off."""
        if not transmitting:
            self.receive = min(self.receive + by, BUS_OFF_ABOVE)
            return
        self.transmit += by
        if self.transmit > BUS_OFF_ABOVE:
            self.off = True

    def recover(self) -> None:
        """After 128 sequences of 11 recessive bits."""
        self.transmit = self.receive = 0
        self.off = False


@dataclass(slots=True)
class StationLog:
    """What happened at one station, with the index of the bit it happened at."""

    sent: int | None = None
    received: list[tuple[int, CanFrame]] = field(default_factory=list)
    errors: list[tuple[int, ErrorKind, bool]] = field(default_factory=list)
    """Index, kind, whether the station was transmitting."""

    @property
    def transmitted(self) -> bool:
        """Whether the station won arbitration: it sent its frame, or met an error while sending."""
        return self.sent is not None or any(sending for _, _, sending in self.errors)


class Station:
    """One controller during one use of the bus. ``frame``: what it wants to send, None to listen."""

    def __init__(self, name: str, counters: ErrorCounters, frame: CanFrame | None = None) -> None:
        self.name = name
        self.counters = counters
        self.wire: WireBits | None = wire_bits(frame) if frame is not None else None
        self.log = StationLog()
        self.idle = False
        self.index = -1
        self.sending_at: int | None = None  # index into wire.bits while it transmits
        self._transmitting = False
        self._replay: deque[int] = deque()
        self._program = self._run()
        self.drive = next(self._program)

    @property
    def at_data_rate(self) -> bool:
        """Whether the bit now driven is one of the data phase."""
        if self.wire is None or self.sending_at is None:
            return False
        return self.wire.nominal_head <= self.sending_at < self.wire.nominal_head + self.wire.data_phase

    def step(self, seen: int) -> None:
        """Take in the bit on the bus as this station sees it; ``drive`` is then its next bit."""
        self.index += 1
        self.drive = self._program.send(seen)

    def _run(self) -> Bits:
        try:
            if self.wire is not None:
                yield from self._guard(self._attempt(self.wire))
            while True:
                yield from self._idle()
                yield from self._guard(self._receive())
        except _BusOffError:
            self.idle, self.sending_at = True, None
            while True:
                yield RECESSIVE

    def _idle(self) -> Bits:
        """Until a start of frame, which the receiver then finds in the replay."""
        if self._replay:
            return
        self.idle = True
        while (yield RECESSIVE) == RECESSIVE:
            pass
        self.idle = False
        self._replay.append(DOMINANT)

    def _guard(self, action: Bits) -> Bits:
        """Run an action, then the intermission; after an error in either its flag and delimiter, and intermission."""
        while True:
            try:
                yield from action
                return
            except WireError as error:
                yield from self._error_frame(error)
                action = self._after_error()

    def _after_error(self) -> Bits:
        self._transmitting, self.sending_at = False, None
        yield from self._intermission()

    def _attempt(self, wire: WireBits) -> Bits:
        if not (yield from self._transmit(wire)):
            yield from self._receive()
            return
        self._transmitting, self.sending_at = False, None
        yield from self._intermission()

    def _transmit(self, wire: WireBits) -> Generator[int, int, bool]:
        """Send; False if arbitration was lost, the bits seen so far then stand in the replay."""
        self._transmitting = True
        for at, bit in enumerate(wire.bits):
            self.sending_at = at
            seen = yield bit
            self._replay.append(seen)
            if at == wire.ack_slot:
                if seen == RECESSIVE:
                    raise WireError(ErrorKind.ACK)
            elif seen != bit:
                if at < wire.arbitration and bit == RECESSIVE:
                    if at in wire.stuff_positions:
                        raise WireError(ErrorKind.STUFF, counted=False)
                    self._transmitting, self.sending_at = False, None
                    return False
                raise WireError(ErrorKind.BIT)
        self._replay.clear()
        self.log.sent = self.index
        self.counters.sent()
        return True

    def _take(self, drive: int = RECESSIVE) -> Generator[int, int, int]:
        if self._replay:
            return self._replay.popleft()
        return (yield drive)

    def _receive(self) -> Bits:
        self._transmitting = False
        reader = _Reader(self._take)
        frame, crc_good = yield from reader.frame()
        yield from self._expect_recessive()  # CRC delimiter
        yield from self._take(DOMINANT if crc_good else RECESSIVE)  # ACK slot
        yield from self._expect_recessive()  # ACK delimiter
        if not crc_good:
            raise WireError(ErrorKind.CRC)
        for _ in range(EOF_BITS - 1):
            yield from self._expect_recessive()
        self.log.received.append((self.index, frame))
        self.counters.received()
        if (yield RECESSIVE) == DOMINANT:  # too late to refuse the frame: overload
            yield from self._flag_and_delimiter()
        yield from self._intermission()

    def _expect_recessive(self) -> Bits:
        if (yield from self._take()) == DOMINANT:
            raise WireError(ErrorKind.FORM)

    def _intermission(self) -> Bits:
        done = 0
        while done < INTERMISSION_BITS:
            seen = yield RECESSIVE
            done += 1
            if seen == RECESSIVE:
                continue
            if done == INTERMISSION_BITS:  # a dominant third bit is a start of frame
                self._replay.append(DOMINANT)
                return
            yield from self._flag_and_delimiter()
            done = 0

    def _fail(self, by: int) -> None:
        self.counters.fail(transmitting=self._transmitting, by=by)
        if self.counters.off:
            raise _BusOffError

    def _error_frame(self, error: WireError) -> Bits:
        """Error flag and delimiter, anew for as long as errors disturb them."""
        pending: WireError | None = error
        while pending is not None:
            self._replay.clear()
            self.sending_at = None
            self.log.errors.append((self.index, pending.kind, self._transmitting))
            try:
                if self.counters.state is ErrorState.PASSIVE:
                    yield from self._passive_flag(pending)
                else:
                    if pending.counted:
                        self._fail(8 if self._transmitting else 1)
                    yield from self._active_flag()
                yield from self._delimiter(after_error=True)
                pending = None
            except WireError as again:
                pending = again

    def _active_flag(self) -> Bits:
        sent = 0
        while sent < FLAG_BITS:
            seen = yield DOMINANT
            sent += 1
            if seen == RECESSIVE:
                self._fail(8)
                sent = 0

    def _passive_flag(self, error: WireError) -> Bits:
        """Six recessive bits, complete once six equal bits were seen.

        A lone node that gets no acknowledge, and hears nobody, stays error passive: its counter stands.
        """
        lonely = self._transmitting and error.kind is ErrorKind.ACK
        if error.counted and not lonely:
            self._fail(8 if self._transmitting else 1)
        run, last = 0, -1
        while run < FLAG_BITS:
            seen = yield RECESSIVE
            run = run + 1 if seen == last else 1
            last = seen
            if seen == DOMINANT and lonely:
                lonely = False
                self._fail(8)

    def _flag_and_delimiter(self) -> Bits:
        """Overload flag and delimiter: counts no error."""
        for _ in range(FLAG_BITS):
            yield DOMINANT
        yield from self._delimiter(after_error=False)

    def _delimiter(self, *, after_error: bool) -> Bits:
        """Wait for the others' flags to end, then eight recessive bits."""
        dominant = 0
        while (yield RECESSIVE) == DOMINANT:
            dominant += 1
            if dominant == 1 and after_error and not self._transmitting:
                self._fail(8)
            if dominant % EXTRA_DOMINANT_BITS == 0:
                self._fail(8)
        for _ in range(DELIMITER_BITS - 2):
            if (yield RECESSIVE) == DOMINANT:
                raise WireError(ErrorKind.FORM)
        if (yield RECESSIVE) == DOMINANT:
            yield from self._flag_and_delimiter()


class _Take(Protocol):
    def __call__(self, drive: int = RECESSIVE) -> Generator[int, int, int]: ...


class _Reader:
    """Takes stuffed bits in and gives a frame and whether its CRC was right."""

    def __init__(self, take: _Take) -> None:
        self._take = take
        self._run = 0
        self._last = -1
        self._stuffed: list[int] = []  # as on the wire
        self._plain: list[int] = []

    def _note(self, bit: int) -> None:
        self._run = self._run + 1 if bit == self._last else 1
        self._last = bit
        self._stuffed.append(bit)

    def _stuff_bit(self) -> Bits:
        bit = yield from self._take()
        if bit == self._last:
            raise WireError(ErrorKind.STUFF)
        self._note(bit)

    def _field(self, width: int) -> Generator[int, int, int]:
        value = 0
        for _ in range(width):
            if self._run == STUFF_RUN:
                yield from self._stuff_bit()
            bit = yield from self._take()
            self._note(bit)
            self._plain.append(bit)
            value = value << 1 | bit
        return value

    def frame(self) -> Generator[int, int, tuple[CanFrame, bool]]:
        """SOF to the last bit of the CRC field."""
        yield from self._field(1)
        identifier = yield from self._field(11)
        remote = yield from self._field(1)
        extended = bool((yield from self._field(1)))
        if extended:
            identifier = identifier << 18 | (yield from self._field(18))
            remote = yield from self._field(1)
        fd = bool((yield from self._field(1)))
        if fd:
            return (yield from self._fd(identifier, extended))
        if extended:
            yield from self._field(1)  # r0
        code = yield from self._field(4)
        length = 0 if remote else min(code, CLASSIC_MAX_BYTES)
        data = yield from self._data(length)
        expected = CRC15.of(self._plain)
        crc = yield from self._field(CRC15.width)
        if self._run == STUFF_RUN:
            yield from self._stuff_bit()
        asked = min(code, CLASSIC_MAX_BYTES) if remote else 0
        return CanFrame(identifier, data, extended, remote=bool(remote), remote_length=asked), crc == expected

    def _data(self, length: int) -> Generator[int, int, bytes]:
        data = bytearray()
        for _ in range(length):
            data.append((yield from self._field(8)))
        return bytes(data)

    def _fd(self, identifier: int, extended: bool) -> Generator[int, int, tuple[CanFrame, bool]]:
        if (yield from self._field(1)) == RECESSIVE:  # res: no format that we know
            raise WireError(ErrorKind.FORM)
        switch = bool((yield from self._field(1)))
        indicator = bool((yield from self._field(1)))
        data = yield from self._data(FD_LENGTHS[(yield from self._field(4))])
        rule = CRC17 if len(data) <= CRC17_MAX_BYTES else CRC21
        count = stuff_count_bits(len(self._stuffed) - len(self._plain))
        expected = rule.of(self._stuffed + count)
        got = yield from self._fixed_stuffed(STUFF_COUNT_BITS + rule.width)
        good = got[:STUFF_COUNT_BITS] == count and from_bits(got[STUFF_COUNT_BITS:]) == expected
        return CanFrame(identifier, data, extended, True, switch, indicator), good

    def _fixed_stuffed(self, width: int) -> Generator[int, int, list[int]]:
        bits: list[int] = []
        for index in range(width):
            if index % FIXED_STUFF_STEP == 0:
                yield from self._stuff_bit()
            bit = yield from self._take()
            self._note(bit)
            bits.append(bit)
        return bits


class Disturbance(Protocol):
    """What a fault does to one use of the bus."""

    def level(self, index: int, level: int) -> int:
        """Level on the bus at bit ``index``, given the wired AND of all stations."""

    def seen(self, index: int, station: str, level: int) -> int:
        """What one station samples."""


class Undisturbed:
    """No fault at all."""

    def level(self, index: int, level: int) -> int:
        """The level as driven."""
        return level

    def seen(self, index: int, station: str, level: int) -> int:
        """The level as it is."""
        return level


@dataclass(frozen=True, slots=True)
class BitRun:
    """One use of the bus: the level of every bit, and whether it went at the data bit rate."""

    levels: bytes
    at_data_rate: bytes

    def ends_ns(self, start_ns: int, nominal_bit_ns: int, data_bit_ns: int) -> list[int]:
        """Time at which each bit ends."""
        ends, now = [], start_ns
        for fast in self.at_data_rate:
            now += data_bit_ns if fast else nominal_bit_ns
            ends.append(now)
        return ends


def run_bits(stations: Sequence[Station], disturbance: Disturbance) -> BitRun:
    """Step all stations from start of frame until every one of them sees an idle bus again."""
    levels, fast = bytearray(), bytearray()
    while True:
        index = len(levels)
        driven = min((station.drive for station in stations), default=RECESSIVE)
        fast.append(any(station.at_data_rate for station in stations))
        level = disturbance.level(index, driven)
        levels.append(level)
        for station in stations:
            station.step(disturbance.seen(index, station.name, level))
        if all(station.idle for station in stations):
            return BitRun(bytes(levels), bytes(fast))


def receive_bits(bits: Iterable[int]) -> tuple[list[CanFrame], list[tuple[int, ErrorKind]]]:
    """What a lone listener makes of bits on the bus: the frames it took and the errors it saw, by bit index."""
    station = Station("listener", ErrorCounters())
    for bit in bits:
        station.step(bit & station.drive)
    return [frame for _, frame in station.log.received], [(at, kind) for at, kind, _ in station.log.errors]
