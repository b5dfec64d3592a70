"""Faults of the sensor itself, written into its packets: so they act on a recording as on the simulated sensor.

The drift of two clocks against each other is shown on the sensor's; which of the two is off cannot be told from here.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from upbeam.hw_sim.sensor.datagram import Datagram, blocks, is_data, is_position
from upbeam.hw_sim.sensor.encoding import change_position
from upbeam.model.beams import BeamTable

from .base import PacketFault, Step, fault

__all__ = [
    "AllZero", "AzimuthJump", "ClockDrift", "DeadLaser", "PpsLost", "Rpm", "Saturated", "StuckAzimuth", "StuckRing",
    "ThermalShutdown", "TimeJump", "WrongModel", "beam_cells", "edit",
]  # fmt: skip

_HOUR_US = 3_600_000_000


def edit(datagram: Datagram, change: Callable[[NDArray[Any]], None]) -> Datagram:
    """The data packet with its blocks and tail changed in place by ``change``; other datagrams as they are."""
    if not is_data(datagram):
        return datagram
    packet = blocks(datagram.payload)
    change(packet)
    return datagram._replace(payload=packet.tobytes())


def beam_cells(beams: BeamTable, beam: int) -> list[int]:
    """Where a beam's returns stand among a block's 32: two places in a VLP-16's, which holds two firings."""
    if not 0 <= beam < beams.beams:
        raise ValueError(f"beam {beam}: expected 0 (top) to {beams.beams - 1} of the {beams.name}")
    slot = int(beams.laser_id[beam])
    return [slot + k * beams.beams for k in range(32 // beams.beams)]


@fault("sensor", "stuck_azimuth")
@dataclass(frozen=True, kw_only=True)
class StuckAzimuth(PacketFault):
    """The encoder stands still while the sensor turns and fires on: every block has the first one's azimuth."""

    def begin(self, beams: BeamTable, rng: np.random.Generator) -> Step:
        held: int | None = None

        def change(packet: NDArray[Any]) -> None:
            nonlocal held
            held = int(packet["blocks"]["azimuth"][0, 0]) if held is None else held
            packet["blocks"]["azimuth"] = held

        return lambda datagram: (edit(datagram, change),)


@fault("sensor", "azimuth_jump")
@dataclass(frozen=True, kw_only=True)
class AzimuthJump(PacketFault):
    """The encoder slipped: all azimuths are off by ``degrees`` while it lasts."""

    degrees: float = 30.0

    def begin(self, beams: BeamTable, rng: np.random.Generator) -> Step:
        self.within("degrees", -180, 180)
        shift = round(self.degrees * 100)

        def change(packet: NDArray[Any]) -> None:
            azimuth = packet["blocks"]["azimuth"]
            packet["blocks"]["azimuth"] = (azimuth.astype(np.int64) + shift) % 36000

        return lambda datagram: (edit(datagram, change),)


@fault("sensor", "rpm")
@dataclass(frozen=True, kw_only=True)
class Rpm(PacketFault):
    """The motor runs at ``scale`` times its speed: azimuths advance by that, the firing cycle stays.

    What the lasers see is not turned along: the speed is the fault, the scene is of no matter. At its end the azimuth
    goes on from where it is.
    """

    lasting = True

    scale: float = 0.8

    def begin(self, beams: BeamTable, rng: np.random.Generator) -> Step:
        self.within("scale", 0.1, 3)
        last: int | None = None
        turned = 0

        def change(packet: NDArray[Any], active: bool) -> None:
            nonlocal last, turned
            azimuth = packet["blocks"]["azimuth"][0].astype(np.int64)
            steps = np.diff(azimuth, prepend=azimuth[0] if last is None else last) % 36000
            total = turned + np.cumsum(steps) * active
            turned, last = int(total[-1]), int(azimuth[-1])
            extra = np.floor(total * (self.scale - 1) + 0.5).astype(np.int64)
            packet["blocks"]["azimuth"][0] = (azimuth + extra) % 36000

        return lambda datagram: (edit(datagram, lambda packet: change(packet, self.active(datagram.time_ns))),)


@fault("sensor", "dead_laser")
@dataclass(frozen=True, kw_only=True)
class DeadLaser(PacketFault):
    """One beam returns nothing."""

    beam: int = 15
    """0 = top."""

    def begin(self, beams: BeamTable, rng: np.random.Generator) -> Step:
        cells = beam_cells(beams, self.beam)

        def change(packet: NDArray[Any]) -> None:
            packet["blocks"]["returns"][:, :, cells] = 0

        return lambda datagram: (edit(datagram, change),)


@fault("sensor", "stuck_ring")
@dataclass(frozen=True, kw_only=True)
class StuckRing(PacketFault):
    """One beam's receiver gives the same count and intensity for every firing."""

    beam: int = 15
    count: int = 2500
    intensity: int = 40

    def begin(self, beams: BeamTable, rng: np.random.Generator) -> Step:
        self.within("count", 1, 65535)
        self.within("intensity", 0, 255)
        cells = beam_cells(beams, self.beam)

        def change(packet: NDArray[Any]) -> None:
            packet["blocks"]["returns"]["distance"][:, :, cells] = self.count
            packet["blocks"]["returns"]["intensity"][:, :, cells] = self.intensity

        return lambda datagram: (edit(datagram, change),)


@fault("sensor", "all_zero")
@dataclass(frozen=True, kw_only=True)
class AllZero(PacketFault):
    """The sensor turns and sends, and no beam returns anything: lasers off, a cap left on."""

    def begin(self, beams: BeamTable, rng: np.random.Generator) -> Step:
        def change(packet: NDArray[Any]) -> None:
            packet["blocks"]["returns"] = 0

        return lambda datagram: (edit(datagram, change),)


@fault("sensor", "saturated")
@dataclass(frozen=True, kw_only=True)
class Saturated(PacketFault):
    """The receiver saturates: every return has intensity 255."""

    def begin(self, beams: BeamTable, rng: np.random.Generator) -> Step:
        def change(packet: NDArray[Any]) -> None:
            returns = packet["blocks"]["returns"]
            returns["intensity"] = np.where(returns["distance"] > 0, 255, 0)

        return lambda datagram: (edit(datagram, change),)


@fault("sensor", "time_jump")
@dataclass(frozen=True, kw_only=True)
class TimeJump(PacketFault):
    """The sensor's clock jumps by ``ms`` and back at the end: a GPS fix gained or lost."""

    ms: float = 500.0

    def begin(self, beams: BeamTable, rng: np.random.Generator) -> Step:
        self.within("ms", -3.6e6, 3.6e6)
        return lambda datagram: (_shift_clock(datagram, round(self.ms * 1000)),)


@fault("compute", "clock_drift")
@dataclass(frozen=True, kw_only=True)
class ClockDrift(PacketFault):
    """The sensor's clock runs ``ppm`` faster than the device's: without PPS a crystal is off by up to 100 ppm, and one
    of the two is broken above that. What it gained it keeps."""

    lasting = True
    ppm: float = 1000.0

    def begin(self, beams: BeamTable, rng: np.random.Generator) -> Step:
        self.within("ppm", -1e5, 1e5)

        def step(datagram: Datagram) -> Iterable[Datagram]:
            drifted_ns = min(datagram.time_ns, self.until_s * 1e9) - self.from_s * 1e9
            return (_shift_clock(datagram, round(drifted_ns * self.ppm * 1e-9)),)

        return step


def _shift_clock(datagram: Datagram, shift_us: int) -> Datagram:
    def change(packet: NDArray[Any]) -> None:
        packet["tail"]["toh_us"] = (int(packet["tail"]["toh_us"][0]) + shift_us) % _HOUR_US

    if is_position(datagram):
        return datagram._replace(
            payload=change_position(datagram.payload, lambda p: {"time_us": (p.time_us + shift_us) % _HOUR_US})
        )
    return edit(datagram, change)


@fault("sensor", "thermal_shutdown")
@dataclass(frozen=True, kw_only=True)
class ThermalShutdown(PacketFault):
    """Too hot: the sensor stops its lasers and its data packets; position packets go on and say why."""

    def begin(self, beams: BeamTable, rng: np.random.Generator) -> Step:
        def step(datagram: Datagram) -> Iterable[Datagram]:
            if is_position(datagram):
                return (
                    datagram._replace(payload=change_position(datagram.payload, lambda _: {"thermal_shutdown": 1})),
                )
            return () if is_data(datagram) else (datagram,)

        return step


@fault("sensor", "pps_lost")
@dataclass(frozen=True, kw_only=True)
class PpsLost(PacketFault):
    """Position packets say that the pulse per second is gone."""

    def begin(self, beams: BeamTable, rng: np.random.Generator) -> Step:
        def step(datagram: Datagram) -> Iterable[Datagram]:
            if not is_position(datagram):
                return (datagram,)
            return (datagram._replace(payload=change_position(datagram.payload, lambda _: {"pps": 0})),)

        return step


@fault("sensor", "wrong_model")
@dataclass(frozen=True, kw_only=True)
class WrongModel(PacketFault):
    """Packets name another sensor: the wrong one was built in."""

    model_byte: int = 0x21
    """0x21 HDL-32E, 0x22 VLP-16, 0x28 VLP-32C, 0xA1 VLS-128; others are unknown."""

    def begin(self, beams: BeamTable, rng: np.random.Generator) -> Step:
        self.within("model_byte", 0, 255)

        def change(packet: NDArray[Any]) -> None:
            packet["tail"]["model"] = self.model_byte

        return lambda datagram: (edit(datagram, change),)
