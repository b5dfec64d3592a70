"""Faults of the network between sensor and device: datagrams lost, late, doubled, damaged, and foreign ones."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from upbeam.hw_sim.sensor.datagram import DATA_PORT, Datagram, is_data
from upbeam.model.beams import BeamTable

from .base import PacketFault, Step, fault

__all__ = [
    "BurstLoss", "Corrupt", "Duplicate", "Flood", "Jitter", "Loss", "Reorder", "Silence", "Truncate", "WrongPort",
    "WrongSize",
]  # fmt: skip


def _ms(value: float) -> int:
    return round(value * 1e6)


@fault("network", "loss")
@dataclass(frozen=True, kw_only=True)
class Loss(PacketFault):
    """Datagrams are lost independently of each other."""

    rate: float = 0.05
    """Share lost, 0 to 1."""

    def begin(self, beams: BeamTable, rng: np.random.Generator) -> Step:
        self.within("rate", 0, 1)
        return lambda datagram: () if rng.random() < self.rate else (datagram,)


@fault("network", "burst_loss")
@dataclass(frozen=True, kw_only=True)
class BurstLoss(PacketFault):
    """Losses in bursts: the two-state chain of Gilbert and Elliott, stepped once a datagram."""

    enter: float = 0.01
    """Chance to go from the good state to the bad one."""
    leave: float = 0.1
    """Chance to go back; bursts last 1 / leave datagrams on average."""
    loss_good: float = 0.0
    loss_bad: float = 1.0

    def begin(self, beams: BeamTable, rng: np.random.Generator) -> Step:
        for name in ("enter", "leave", "loss_good", "loss_bad"):
            self.within(name, 0, 1)
        bad = False

        def step(datagram: Datagram) -> Iterable[Datagram]:
            nonlocal bad
            bad = rng.random() >= self.leave if bad else rng.random() < self.enter
            return () if rng.random() < (self.loss_bad if bad else self.loss_good) else (datagram,)

        return step


@fault("network", "silence")
@dataclass(frozen=True, kw_only=True)
class Silence(PacketFault):
    """Nothing arrives: a cable pulled, a switch that restarts."""

    def begin(self, beams: BeamTable, rng: np.random.Generator) -> Step:
        return lambda datagram: ()


@fault("network", "duplicate")
@dataclass(frozen=True, kw_only=True)
class Duplicate(PacketFault):
    """Datagrams arrive twice."""

    rate: float = 0.1
    delay_ms: float = 0.2
    """Of the second copy."""

    def begin(self, beams: BeamTable, rng: np.random.Generator) -> Step:
        self.within("rate", 0, 1)
        self.within("delay_ms", 0, 1000)

        def step(datagram: Datagram) -> Iterable[Datagram]:
            if rng.random() >= self.rate:
                return (datagram,)
            return (datagram, datagram._replace(time_ns=datagram.time_ns + _ms(self.delay_ms)))

        return step


@fault("network", "reorder")
@dataclass(frozen=True, kw_only=True)
class Reorder(PacketFault):
    """Some datagrams take a longer way and arrive behind later ones."""

    rate: float = 0.05
    delay_ms: float = 1.0
    """Of those that are held back; packets of a 32-beam sensor are 0.55 to 0.66 ms apart."""

    def begin(self, beams: BeamTable, rng: np.random.Generator) -> Step:
        self.within("rate", 0, 1)
        self.within("delay_ms", 0, 1000)

        def step(datagram: Datagram) -> Iterable[Datagram]:
            late = _ms(self.delay_ms) if rng.random() < self.rate else 0
            return (datagram._replace(time_ns=datagram.time_ns + late),)

        return step


@fault("network", "jitter")
@dataclass(frozen=True, kw_only=True)
class Jitter(PacketFault):
    """Datagrams wait in a queue that empties now and then: late by up to ``max_ms``, in order."""

    lasting = True  # what waits at the end is not overtaken
    max_ms: float = 5.0

    def begin(self, beams: BeamTable, rng: np.random.Generator) -> Step:
        self.within("max_ms", 0, 1000)
        last = 0

        def step(datagram: Datagram) -> Iterable[Datagram]:
            nonlocal last
            wait = int(rng.random() * _ms(self.max_ms)) if self.active(datagram.time_ns) else 0
            last = max(last, datagram.time_ns + wait)
            return (datagram._replace(time_ns=last),)

        return step


@fault("network", "truncate")
@dataclass(frozen=True, kw_only=True)
class Truncate(PacketFault):
    """Datagrams end early, anywhere."""

    rate: float = 0.1

    def begin(self, beams: BeamTable, rng: np.random.Generator) -> Step:
        self.within("rate", 0, 1)

        def step(datagram: Datagram) -> Iterable[Datagram]:
            if rng.random() >= self.rate or not datagram.payload:
                return (datagram,)
            return (datagram._replace(payload=datagram.payload[: int(rng.integers(len(datagram.payload)))]),)

        return step


@fault("network", "wrong_size")
@dataclass(frozen=True, kw_only=True)
class WrongSize(PacketFault):
    """Datagrams of another device or firmware on the sensor's port: ``size`` bytes, mostly the sensor's own content."""

    rate: float = 0.1
    size: int = 1248

    def begin(self, beams: BeamTable, rng: np.random.Generator) -> Step:
        self.within("rate", 0, 1)
        self.within("size", 0, 65507)

        def step(datagram: Datagram) -> Iterable[Datagram]:
            if rng.random() >= self.rate:
                return (datagram,)
            padding = bytes(max(0, self.size - len(datagram.payload)))
            return (datagram._replace(payload=(datagram.payload + padding)[: self.size]),)

        return step


@fault("network", "corrupt")
@dataclass(frozen=True, kw_only=True)
class Corrupt(PacketFault):
    """Block flags of data packets are overwritten: right size, wrong content. UDP's own checksum misses 1 in 65,536
    damaged datagrams, and some sensors send none."""

    rate: float = 0.05

    def begin(self, beams: BeamTable, rng: np.random.Generator) -> Step:
        self.within("rate", 0, 1)

        def step(datagram: Datagram) -> Iterable[Datagram]:
            if not is_data(datagram) or rng.random() >= self.rate:
                return (datagram,)
            payload = bytearray(datagram.payload)
            at = 100 * int(rng.integers(12))
            payload[at : at + 2] = b"\x00\x00"
            return (datagram._replace(payload=bytes(payload)),)

        return step


@fault("network", "wrong_port")
@dataclass(frozen=True, kw_only=True)
class WrongPort(PacketFault):
    """Data packets go to another port: a sensor configured anew. The device hears nothing."""

    def begin(self, beams: BeamTable, rng: np.random.Generator) -> Step:
        return lambda datagram: (
            datagram._replace(port=datagram.port + 1 if datagram.port == DATA_PORT else datagram.port),
        )


@fault("network", "flood")
@dataclass(frozen=True, kw_only=True)
class Flood(PacketFault):
    """Between two of the sensor's datagrams come ``times`` others of random content and size on its port."""

    times: int = 10

    def begin(self, beams: BeamTable, rng: np.random.Generator) -> Step:
        self.within("times", 1, 1000)

        def step(datagram: Datagram) -> Iterable[Datagram]:
            yield datagram
            for k in range(self.times):
                # Within the half millisecond until the next one of the sensor's.
                at = datagram.time_ns + 400_000 * (k + 1) // (self.times + 1)
                yield Datagram(at, DATA_PORT, rng.bytes(int(rng.integers(1, 1473))))

        return step
