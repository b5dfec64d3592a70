"""Service times of a target for the virtual clock: how long it would take for each packet, with its jitter."""

from __future__ import annotations

from dataclasses import dataclass
from math import log
from typing import Any

import numpy as np

from .catalogue import CatalogueError, Device
from .estimate import Load, core_clock, cpu_column_time, default_core
from .figures import Figure
from .fpga_built import BuiltCores

__all__ = ["SERVICES", "Service", "target_service"]

SERVICES = ("central", "low", "high")
_PACKETS = 4093
"""Service times that are drawn, then repeated: a prime, so that they do not fall into step with the frames."""
_QUANTILE_95 = 1.6449
"""Of the normal distribution: low and high of a wake-up are its 5 % and 95 %."""


@dataclass(frozen=True)
class Service:
    """What the virtual clock advances by: microseconds for each packet, to be repeated."""

    device: Device
    mode: str | None
    column_us: Figure
    wakeup_us: Figure
    service_us: tuple[float, ...]
    used: str
    """``central``, ``low`` or ``high`` of the column's interval"""
    cores: int
    seed: int

    def sensors(self, rate_hz: float, columns: int) -> dict[str, int]:
        """Sensors of this rate that fit on all cores, each core no longer busy computing than a turn lasts. Waking up
        delays a packet, but occupies no core."""
        turn_us = 1e6 / rate_hz
        value, low, high = (int(turn_us / (columns * us)) * self.cores for us in self.column_us.span("us"))
        return {"value": value, "low": high, "high": low}

    def as_dict(self) -> dict[str, Any]:
        return {
            "device": self.device.name,
            "mode": self.mode,
            "column_us": self.column_us.as_dict(),
            "wakeup_us": self.wakeup_us.as_dict(),
            "service": self.used,
            "cores": self.cores,
            "jitter_seed": self.seed,
        }


def target_service(
    device: Device,
    load: Load,
    packet_columns: int,
    *,
    mode: str | None = None,
    service: str = "central",
    seed: int = 0,
    built: BuiltCores | None = None,
) -> Service:
    """Of a device of the catalogue: a CPU's columns and the wake-up of its thread, drawn log-normally from ``seed``; an
    FPGA's cycles, which do not vary, at the clock that ``built`` knows of its core. The same arguments give the same
    numbers. Raises CatalogueError."""
    if service not in SERVICES:
        raise CatalogueError(f"service {service!r}, expected one of {', '.join(SERVICES)}")
    if device.family == "host":
        raise CatalogueError("host: --clock real measures this machine; targets are for others")
    chosen = device.mode(mode)
    if device.family == "fpga":
        column, cores = _fpga_column(device, load, built), 1
        wakeup = Figure.exact(0.0, "us", "modelled", "a core of its own does not wait for a thread")
    else:
        column = cpu_column_time(device, load, chosen).push.to("us")
        wakeup = device.figure("scheduling.wakeup").to("us")
        cores = int(chosen.figures["cpu_cores"].get("1")) if chosen else 1
    us = column.span("us")[SERVICES.index(service)]
    packets = tuple(float(x) for x in us * packet_columns + _wakeups(wakeup, seed))
    return Service(device, chosen.name if chosen else None, column, wakeup, packets, service, cores, seed)


def _fpga_column(device: Device, load: Load, built: BuiltCores | None) -> Figure:
    core = default_core(device, load, built)
    clock = core_clock(device, core, built)
    mhz, slow, fast = clock.span("MHz")
    cycles = core.column_cycles
    source = f"{cycles} cycles a column (LANES {core.lanes}, FOLD {core.fold}); clock, {clock.kind}: {clock.source}"
    return Figure(cycles / mhz, cycles / fast, cycles / slow, "us", "modelled", source)


def _wakeups(wakeup: Figure, seed: int) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Rounded to nanoseconds, so that they do not depend on a library's last bit."""
    value, low, high = wakeup.span("us")
    if high <= 0:
        return np.zeros(_PACKETS)
    normal = np.random.Generator(np.random.PCG64(seed)).standard_normal(_PACKETS)
    # Two halves: below the central value and above it, each with its own width.
    width = np.where(normal < 0, log(value / low), log(high / value)) / _QUANTILE_95
    return np.round(value * np.exp(normal * width), 3)
