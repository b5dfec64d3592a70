"""Faults as data: what goes wrong, when, and with what seed. Any number of them may act at once.

A fault on the wire is a transform of the sensor's datagrams, the same for a simulated sensor, a recording and a socket.
A fault of the device is handed to the device under test at its beginning and its end.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, fields
from itertools import count
from typing import Any, ClassVar, NamedTuple, TypeVar

import numpy as np

from upbeam.hw_sim.sensor.datagram import Datagram
from upbeam.model.beams import BeamTable

__all__ = ["FAULTS", "DeviceFault", "Fault", "Moment", "PacketFault", "apply_faults", "fault", "make_fault"]

Step = Callable[[Datagram], Iterable[Datagram]]
"""Takes a datagram, gives what the fault makes of it: none, it, others; never earlier than the one taken."""


@dataclass(frozen=True, kw_only=True)
class Fault:
    """One fault, active from ``from_s`` until before ``until_s`` of the bench's clock. Errors: ValueError."""

    kind: ClassVar[str]
    """Its name in scenarios."""
    group: ClassVar[str]
    """network, sensor, physics, compute, bus or power."""

    from_s: float = 0.0
    until_s: float = math.inf
    seed: int = 0

    def __post_init__(self) -> None:
        if not 0 <= self.from_s <= self.until_s:
            raise ValueError(
                f"{self.kind}: active from {self.from_s} s until {self.until_s} s: expected 0 <= from <= until"
            )

    def active(self, time_ns: int) -> bool:
        return self.from_s * 1e9 <= time_ns < self.until_s * 1e9

    def within(self, name: str, low: float, high: float) -> None:
        """Checks a parameter's range."""
        value = getattr(self, name)
        if not low <= value <= high:
            raise ValueError(f"{self.kind}: {name} = {value}: expected {low} to {high}")


@dataclass(frozen=True, kw_only=True)
class PacketFault(Fault):
    """A fault on the way from the sensor to the device, or of the sensor itself."""

    lasting: ClassVar[bool] = False
    """Leaves something behind: its step is also called after the end, and asks ``active`` itself."""

    def begin(self, beams: BeamTable, rng: np.random.Generator) -> Step:
        """What the fault does, with memory of its own; called while active only, unless ``lasting``."""
        raise NotImplementedError


class Moment(NamedTuple):
    """Something that is done to the device at a time."""

    time_s: float
    what: str
    settings: dict[str, Any] | None
    """None: the disturbance ends."""


@dataclass(frozen=True, kw_only=True)
class DeviceFault(Fault):
    """A fault of computer, bus or supply; the bench's device under test carries it out (``Dut.disturb``)."""

    once: ClassVar[bool] = False
    """Strikes at ``from_s`` and is over: ``until_s`` plays no part."""

    def settings(self) -> dict[str, Any]:
        """What the device is told."""
        general = {f.name for f in fields(Fault)}
        return {f.name: getattr(self, f.name) for f in fields(self) if f.name not in general}

    def moments(self) -> list[Moment]:
        """What happens when, in order."""
        begin = Moment(self.from_s, self.kind, self.settings())
        if self.once or math.isinf(self.until_s):
            return [begin]
        return [begin, Moment(self.until_s, self.kind, None)]


FAULTS: dict[str, type[Fault]] = {}
"""Every kind of fault by its name."""
F = TypeVar("F", bound=type[Fault])


def fault(group: str, kind: str) -> Callable[[F], F]:
    """Registers a class as the fault ``kind``."""

    def register(cls: F) -> F:
        cls.kind, cls.group = kind, group
        if kind in FAULTS:
            raise ValueError(f"fault {kind!r} is defined twice")
        FAULTS[kind] = cls
        return cls

    return register


def make_fault(table: dict[str, Any], *, rate_hz: float = 20.0) -> Fault:
    """A fault from a TOML table: ``kind``, its settings, and ``from_s``, ``until_s`` or ``from_frame``,
    ``until_frame`` (turns at ``rate_hz``). Errors: ValueError that names the fault and the key."""
    given = dict(table)
    kind = given.pop("kind", None)
    if kind not in FAULTS:
        raise ValueError(f"fault kind {kind!r}: expected one of {', '.join(sorted(FAULTS))}")
    for end in ("from", "until"):
        if f"{end}_frame" in given:
            if f"{end}_s" in given:
                raise ValueError(f"{kind}: both {end}_s and {end}_frame: expected one of them")
            given[f"{end}_s"] = given.pop(f"{end}_frame") / rate_hz
    cls = FAULTS[kind]
    known = {f.name: f for f in fields(cls)}
    unknown = sorted(set(given) - set(known))
    if unknown:
        raise ValueError(f"{kind}: unknown key {', '.join(unknown)}; known: {', '.join(known)}")
    for key, value in given.items():
        expected = type(known[key].default)
        if not isinstance(value, (int, float) if expected is float else expected) or isinstance(value, bool):
            raise ValueError(f"{kind}: {key} = {value!r}: expected {expected.__name__}")
    return cls(**given)


def apply_faults(
    stream: Iterable[Datagram], faults: Sequence[Fault], beams: BeamTable, *, seed: int = 0
) -> Iterator[Datagram]:
    """The stream as the device sees it: packet faults in the order given, each fed by the one before; device faults
    are left to the device. In order of time; deterministic in ``seed`` and the faults' own seeds."""
    for place, one in enumerate(faults):
        if isinstance(one, PacketFault):
            stream = _apply(iter(stream), one, beams, np.random.default_rng([seed, one.seed, place]))
    return iter(stream)


def _apply(
    stream: Iterator[Datagram], one: PacketFault, beams: BeamTable, rng: np.random.Generator
) -> Iterator[Datagram]:
    """Runs one fault. What it delays waits in a heap; ties keep the order in which they were made."""
    step = one.begin(beams, rng)
    waiting: list[tuple[int, int, Datagram]] = []
    number = count()
    for datagram in stream:
        for made in step(datagram) if _acts(one, datagram.time_ns) else (datagram,):
            heapq.heappush(waiting, (made.time_ns, next(number), made))
        while waiting and waiting[0][0] <= datagram.time_ns:
            yield heapq.heappop(waiting)[2]
    while waiting:
        yield heapq.heappop(waiting)[2]


def _acts(one: PacketFault, time_ns: int) -> bool:
    return one.active(time_ns) or (one.lasting and time_ns >= one.until_s * 1e9)
