"""Faults of the device: its computer, its buses, its supply. What they do is up to the bench (``Device.disturb``)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from .base import DeviceFault, Moment, fault

__all__ = ["BitFlip", "BusOff", "PowerReset", "SerialNoise", "SlowDown", "Throttle", "WrongCrc"]

REGIONS = ("model", "kept", "stream", "config")
"""Memory that must not change while the device runs (``upb_region``)."""


@fault("compute", "bit_flip")
@dataclass(frozen=True, kw_only=True)
class BitFlip(DeviceFault):
    """A particle turns bits of memory round: weights and their tables, the kept copy of the model file, the stream's
    constants, the configuration."""

    once = True
    region: str = "model"
    bits: int = 1
    """How many, at places drawn from the seed."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.region not in REGIONS:
            raise ValueError(f"bit_flip: region {self.region!r}: expected one of {', '.join(REGIONS)}")
        self.within("bits", 1, 64)

    def settings(self) -> dict[str, Any]:
        return {**super().settings(), "seed": self.seed}


@fault("compute", "slow_down")
@dataclass(frozen=True, kw_only=True)
class SlowDown(DeviceFault):
    """Work takes ``factor`` times as long: another process on the core, a cache that is shared."""

    factor: float = 10.0

    def __post_init__(self) -> None:
        super().__post_init__()
        self.within("factor", 1, 1e6)


@fault("compute", "throttle")
@dataclass(frozen=True, kw_only=True)
class Throttle(DeviceFault):
    """The processor gets too hot and slows in steps, to ``factor`` at the end of the first half, then back."""

    factor: float = 4.0
    steps: int = 4

    def __post_init__(self) -> None:
        super().__post_init__()
        self.within("factor", 1, 1e6)
        self.within("steps", 1, 100)
        if self.until_s == float("inf"):
            raise ValueError("throttle: expected an end, until_s or until_frame")

    def moments(self) -> list[Moment]:
        half = (self.until_s - self.from_s) / 2
        rise = [1 + (self.factor - 1) * (k + 1) / self.steps for k in range(self.steps)]
        times = [self.from_s + half * k / self.steps for k in range(self.steps)]
        up = [Moment(t, "slow_down", {"factor": f}) for t, f in zip(times, rise, strict=True)]
        down = [
            Moment(t + half, "slow_down", {"factor": f}) for t, f in zip(times[1:], reversed(rise[:-1]), strict=True)
        ]
        return [*up, *down, Moment(self.until_s, "slow_down", None)]


@fault("bus", "bus_off")
@dataclass(frozen=True, kw_only=True)
class BusOff(DeviceFault):
    """The CAN controller is bus-off: it sends nothing and hears nothing."""


@fault("bus", "wrong_crc")
@dataclass(frozen=True, kw_only=True)
class WrongCrc(DeviceFault):
    """CAN frames of the device reach the tester with a damaged E2E checksum: a gateway that writes where it must not
    (bit errors on the wire are the CAN controller's to find)."""

    share: float = 1.0
    """Of the frames, in turn: 0.25 is every fourth."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.within("share", 0.01, 1)


@fault("bus", "serial_noise")
@dataclass(frozen=True, kw_only=True)
class SerialNoise(DeviceFault):
    """Random bytes on the serial line to the device: wrong baud rate, a plug pulled and put back."""

    bytes_per_s: float = 1000.0

    def __post_init__(self) -> None:
        super().__post_init__()
        self.within("bytes_per_s", 1, 1e6)

    def settings(self) -> dict[str, Any]:
        return {**super().settings(), "seed": self.seed}


@fault("power", "reset")
@dataclass(frozen=True, kw_only=True)
class PowerReset(DeviceFault):
    """The supply breaks down for ``off_ms`` in the middle of whatever the device is doing; only stored memory stays."""

    once = True
    off_ms: float = 20.0

    def __post_init__(self) -> None:
        super().__post_init__()
        self.within("off_ms", 0, 60_000)
