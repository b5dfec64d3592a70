"""How long frames can get, and the worst-case response time of a message set.

Response times after R. I. Davis, A. Burns, R. J. Bril, J. J. Lukkien, "Controller Area Network (CAN) schedulability
analysis: refuted, revisited and revised", Real-Time Systems 35 (2007): blocking by one frame of lower priority,
queuing jitter, every instance in the busy period. It holds if each node offers the bus the frame of highest priority
it has (no FIFO queues), and without errors unless ``error_interval_ns`` says how often they may come.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from .bits import (
    CRC15,
    EOF_BITS,
    FIXED_STUFF_STEP,
    INTERMISSION_BITS,
    STUFF_COUNT_BITS,
    STUFF_RUN,
    arbitration_key,
    crc_rule,
    from_bits,
    header_bits,
    wire_bits,
)
from .frame import CanFrame

TRAILER_BITS = 3 + EOF_BITS + INTERMISSION_BITS
"""CRC delimiter, ACK slot, ACK delimiter, end of frame, intermission."""
ERROR_FRAME_BITS = 31
"""Longest error signalling: 6 + 6 flag bits, 8 delimiter, 3 intermission and 8 of suspension (Davis 2007 takes 31)."""


@dataclass(frozen=True, slots=True)
class FrameLength:
    """Bits of a frame with its intermission, by bit rate."""

    nominal: int
    data: int = 0

    def time_ns(self, nominal_bit_ns: int, data_bit_ns: int) -> int:
        """Time that the frame takes the bus."""
        return self.nominal * nominal_bit_ns + self.data * data_bit_ns

    @property
    def bits(self) -> int:
        """All bits."""
        return self.nominal + self.data


def length_of(frame: CanFrame) -> FrameLength:
    """Exact length of one frame, intermission included."""
    wire = wire_bits(frame)
    return FrameLength(wire.nominal_bits + INTERMISSION_BITS, wire.data_phase)


def bound_length(frame: CanFrame) -> FrameLength:
    """The classical bound: as many stuff bits as could be, whatever the fixed bits say.

    Classic: ``g + 8 s + 13 + floor((g + 8 s - 1) / 4)`` with g = 34, extended 54 (135 bits at 8 bytes). CAN FD
    likewise for the bits up to the end of the payload; the stuff bits of its CRC field are fixed.
    """
    header, head = header_bits(frame)
    stuffed = len(header) + 8 * len(frame.data)
    if not frame.fd:
        stuffed += CRC15.width
        return FrameLength(stuffed + (stuffed - 1) // 4 + TRAILER_BITS)
    total = stuffed + (stuffed - 2) // 4 + _crc_field_bits(frame) + TRAILER_BITS
    if not frame.bit_rate_switch:
        return FrameLength(total)
    nominal = head + (head - 1) // 4 + TRAILER_BITS - 1  # the CRC delimiter is the last bit of the data phase
    return FrameLength(nominal, total - nominal)


def _crc_field_bits(frame: CanFrame) -> int:
    field = STUFF_COUNT_BITS + crc_rule(frame).width
    return field + -(-field // FIXED_STUFF_STEP)


def longest_length(frame: CanFrame) -> FrameLength:
    """Exact length of the longest frame with this identifier, format and number of bytes, over all payloads.

    Found by going through every state that the stuffing (and for classic frames the CRC) can be in.
    """
    return _extreme_length(_blank(frame), longest=True)


def shortest_length(frame: CanFrame) -> FrameLength:
    """As :func:`longest_length`: the shortest."""
    return _extreme_length(_blank(frame), longest=False)


def _blank(frame: CanFrame) -> CanFrame:
    return replace(frame, data=bytes(len(frame.data)))


def longest_payload(frame: CanFrame) -> bytes:
    """A payload that makes a classic frame as long as :func:`longest_length` says.

    :raises ValueError: a CAN FD frame.
    """
    if frame.fd:
        raise ValueError(f"frame {frame.name}: only for classic frames")
    header, _ = header_bits(frame)
    states = _CrcStates(longest=True, keep=True)
    for index in range(len(header) + 8 * len(frame.data)):
        states.step((header[index],) if index < len(header) else (0, 1))
    bits = states.best_path()[len(header) :]
    return bytes(from_bits(bits[at : at + 8]) for at in range(0, len(bits), 8))


@lru_cache(maxsize=1024)
def _extreme_length(frame: CanFrame, *, longest: bool) -> FrameLength:
    if frame.fd:
        return _extreme_fd(frame, longest=longest)
    header, _ = header_bits(frame)
    counts = _CrcStates(longest)
    for bit in header:
        counts.step((bit,))
    for _ in range(8 * len(frame.data)):
        counts.step((0, 1))
    stuffed = len(header) + 8 * len(frame.data) + CRC15.width
    return FrameLength(stuffed + counts.finish() + TRAILER_BITS)


class _CrcStates:
    """Most (or fewest) stuff bits on the way to each state: CRC register, last bit, length of the run.

    Kept as int8, negated where the fewest are looked for, so that the greater value is the better one; a state that
    cannot be has a value below ``_NEVER`` whatever stuff bits were added to it.
    """

    _NEVER = -64
    _UNREACHED = -100

    def __init__(self, longest: bool, keep: bool = False) -> None:
        self._step = np.int8(1 if longest else -1)
        self._kept: list[NDArray[np.int8]] | None = [] if keep else None
        self._best: NDArray[np.int8] | None = None  # [run - 1, last bit, register]

    def step(self, bits: tuple[int, ...]) -> None:
        """One more bit, any of ``bits``."""
        after = np.full((STUFF_RUN, 2, 1 << CRC15.width), self._UNREACHED, np.int8)
        if self._best is None:
            after[0, bits[0], CRC15.step(0, bits[0])] = 0
        else:
            for bit in bits:
                after[:, bit, :] = self._move(self._best, bit)[:, _crc_before(bit)]
            if self._kept is not None:
                self._kept.append(self._best)
        self._best = after

    def _move(self, best: NDArray[np.int8], bit: int) -> NDArray[np.int8]:
        """Values by new run length and old register, when ``bit`` comes next."""
        moved = np.empty((STUFF_RUN, best.shape[2]), np.int8)
        stuffed = best[STUFF_RUN - 1] + self._step  # five equal: a stuff bit of the other value stands between
        moved[0] = np.maximum(best[: STUFF_RUN - 1, 1 - bit].max(axis=0), stuffed[bit])
        moved[1] = np.maximum(best[0, bit], stuffed[1 - bit])
        moved[2:] = best[1 : STUFF_RUN - 1, bit]
        return moved

    def finish(self) -> int:
        """Send the CRC of every state; the most (fewest) stuff bits of all."""
        _, counts = self._after_crc()
        return int(self._step) * int(counts.max())

    def _after_crc(self) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
        """Every state that can be (run - 1, last bit, register), and its value once its CRC was sent."""
        assert self._best is not None
        states = np.argwhere(self._best > self._NEVER)
        run, last, register = (states[:, axis].astype(np.int32) for axis in range(3))
        step = np.int32(self._step)
        count = self._best[run, last, register].astype(np.int32)
        run = run + 1
        for shift in range(CRC15.width - 1, -1, -1):
            bit = register >> shift & 1
            full = run == STUFF_RUN
            count = count + full * step
            last = np.where(full, 1 - last, last)
            run = np.where(full, 1, run)
            run = np.where(bit == last, run + 1, 1)
            last = bit
        return states, count + (run == STUFF_RUN) * step

    def best_path(self) -> list[int]:
        """Bits, first to last, that lead to the best end (needs ``keep``)."""
        assert self._kept is not None
        assert self._best is not None
        states, counts = self._after_crc()
        run, last, register = (int(i) for i in states[int(counts.argmax())])
        here, bits = self._best, [last]
        for before in reversed(self._kept):
            value = int(here[run, last, register])
            run, last, register = self._predecessor(before, run, last, register, value)
            bits.append(last)
            here = before
        return bits[::-1]

    @staticmethod
    def _predecessor(before: NDArray[np.int8], run: int, bit: int, register: int, value: int) -> tuple[int, int, int]:
        """A state from which ``bit`` leads to the state given with ``value`` stuff bits."""
        old = int(_crc_before(bit)[register])
        for old_run in range(STUFF_RUN):
            for old_last in (0, 1):
                full = old_run == STUFF_RUN - 1
                level = 1 - old_last if full else old_last
                new_run = (1 if full else old_run + 1) if bit == level else 0
                if new_run == run and int(before[old_run, old_last, old]) + full == value:
                    return old_run, old_last, old
        raise AssertionError("no way back: the tables disagree")


@lru_cache(maxsize=2)
def _crc_before(bit: int) -> NDArray[np.int64]:
    """The register before each register, had ``bit`` been shifted in; the generator is odd, so there is one."""
    register = np.arange(1 << CRC15.width)
    odd = register & 1
    return (register ^ odd * CRC15.polynomial) >> 1 | (bit ^ odd) << (CRC15.width - 1)


def _extreme_fd(frame: CanFrame, *, longest: bool) -> FrameLength:
    """CAN FD: the length of the CRC field is fixed, so only the run of equal bits matters."""
    header, head = header_bits(frame)
    choose = max if longest else min
    total = len(header) + 8 * len(frame.data)
    states: dict[tuple[int, int], int] = {(1, header[0]): 0}  # run, last bit -> stuff bits
    head_stuff = 0
    for index in range(1, total):
        choices = (header[index],) if index < len(header) else (0, 1)
        after: dict[tuple[int, int], int] = {}
        for (run, last), count in states.items():
            if run == STUFF_RUN:
                run, last, count = 1, 1 - last, count + 1
            for bit in choices:
                state = (run + 1 if bit == last else 1, bit)
                after[state] = choose(after.get(state, count), count)
        states = after
        if index == head - 1:
            head_stuff = next(iter(states.values()))
    bits = total + choose(states.values()) + _crc_field_bits(frame) + TRAILER_BITS
    if not frame.bit_rate_switch:
        return FrameLength(bits)
    nominal = head + head_stuff + TRAILER_BITS - 1
    return FrameLength(nominal, bits - nominal)


# ------------------------------------------------------------------------------------- response times


@dataclass(frozen=True, slots=True)
class Message:
    """A message of the set: a frame of its identifier, format and length, and when it is queued.

    ``period_ns`` is the least time between two queuings' due times, ``jitter_ns`` how late after it is due a
    message may be queued, ``deadline_ns`` (from when it is due; the period where None) what is asked for.
    """

    name: str
    frame: CanFrame
    period_ns: int
    jitter_ns: int = 0
    deadline_ns: int | None = None
    sender: str = ""

    def __post_init__(self) -> None:
        if self.period_ns <= 0 or self.jitter_ns < 0:
            raise ValueError(f"{self.name}: period {self.period_ns} ns, jitter {self.jitter_ns} ns")

    @property
    def due_ns(self) -> int:
        """The deadline."""
        return self.period_ns if self.deadline_ns is None else self.deadline_ns


@dataclass(frozen=True, slots=True)
class ResponseTime:
    """Worst case of one message; ``response_ns`` is None where the bus cannot carry what comes before it."""

    message: Message
    longest_ns: int
    blocking_ns: int
    instances: int
    response_ns: int | None

    @property
    def schedulable(self) -> bool:
        """Whether the deadline is always met."""
        return self.response_ns is not None and self.response_ns <= self.message.due_ns


@dataclass(frozen=True, slots=True)
class BusRates:
    """Bit times of a bus, ns."""

    nominal_bit_ns: int
    data_bit_ns: int


def utilisation(messages: Sequence[Message], rates: BusRates, *, exact: bool = True) -> float:
    """Share of the bus that the set can ask for: sum of longest frame time / period."""
    return sum(transmission_ns(m.frame, rates, exact=exact) / m.period_ns for m in messages)


def transmission_ns(frame: CanFrame, rates: BusRates, *, exact: bool = True) -> int:
    """Longest time that a frame of this kind takes the bus, intermission included."""
    length = longest_length(frame) if exact else bound_length(frame)
    return length.time_ns(rates.nominal_bit_ns, rates.data_bit_ns)


def response_times(
    messages: Sequence[Message], rates: BusRates, *, exact: bool = True, error_interval_ns: int | None = None
) -> list[ResponseTime]:
    """Worst-case response time, from due to received, of every message, highest priority first.

    ``exact`` takes the longest frame that the format allows (:func:`longest_length`), else the classical bound.
    ``error_interval_ns``: at most one error in any interval of this length, each costing an error frame and the
    longest frame of at least this priority again. :raises ValueError: two messages with the same identifier.
    """
    ordered = sorted(messages, key=lambda m: arbitration_key(m.frame))
    for one, two in pairwise(ordered):
        if arbitration_key(one.frame) == arbitration_key(two.frame):
            raise ValueError(f"{one.name} and {two.name} have the same identifier {one.frame.name}")
    times = [transmission_ns(m.frame, rates, exact=exact) for m in ordered]
    return [_Analysis(ordered, times, index, rates, error_interval_ns).solve() for index in range(len(ordered))]


class _Analysis:
    """Fixed points for one message of an ordered set (symbols as in the paper)."""

    def __init__(
        self, ordered: Sequence[Message], times: Sequence[int], index: int, rates: BusRates, error_interval: int | None
    ) -> None:
        self._m = ordered[index]
        self._c = times[index]
        self._higher = list(zip(ordered[:index], times[:index], strict=True))
        self._b = max(times[index + 1 :], default=0)
        self._tau = rates.nominal_bit_ns
        self._interval = error_interval
        self._retry = ERROR_FRAME_BITS * self._tau + max([self._c, *times[:index]])

    def solve(self) -> ResponseTime:
        if not self._converges():
            return ResponseTime(self._m, self._c, self._b, 0, None)
        period = self._busy_period()
        instances = _ceil_div(period + self._m.jitter_ns, self._m.period_ns)
        worst = max(self._instance(q) for q in range(instances))
        return ResponseTime(self._m, self._c, self._b, instances, worst)

    def _converges(self) -> bool:
        share = self._c / self._m.period_ns + sum(c / k.period_ns for k, c in self._higher)
        if self._interval is not None:
            share += self._retry / self._interval
        return share < 1

    def _errors(self, window: int) -> int:
        return 0 if self._interval is None else _ceil_div(window, self._interval) * self._retry

    def _busy_period(self) -> int:
        t = self._c
        while True:
            own = _ceil_div(t + self._m.jitter_ns, self._m.period_ns) * self._c
            others = sum(_ceil_div(t + k.jitter_ns, k.period_ns) * c for k, c in self._higher)
            after = self._b + self._errors(t) + own + others
            if after == t:
                return t
            t = after

    def _instance(self, q: int) -> int:
        w = self._b + q * self._c
        while True:
            others = sum(_ceil_div(w + k.jitter_ns + self._tau, k.period_ns) * c for k, c in self._higher)
            after = self._b + q * self._c + self._errors(w + self._c) + others
            if after == w:
                return self._m.jitter_ns + w - q * self._m.period_ns + self._c
            w = after


def _ceil_div(a: int, b: int) -> int:
    return -(-a // b)
