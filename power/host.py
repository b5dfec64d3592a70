"""Our load on this machine: latency measured, power where there is a sensor."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from upbeam.runtime.upsampler import Model

from .bench._native import Job
from .bench.ours import fastest_cpu, make_job
from .bench.work import Work, synthetic_frame
from .catalogue import Device
from .estimate import Bounded, Errors, Estimate, Load
from .figures import Figure
from .measure import Recording, record
from .measure.rails import increment
from .measure.sensors import find_sensors, no_sensor

__all__ = ["HostTimes", "estimate_host", "measure_times"]

_REPEATS = 60
_BURST = 20
"""Frames between two looks at whether to stop."""
_NO_ROWS = Errors(None, None, None, 0, "no row: measured here", {})


@dataclass(frozen=True)
class HostTimes:
    """Times of a frame's streaming step on one core, ms."""

    cpu: str
    median: float
    least: float
    high: float
    """95 % of the repetitions took no longer"""

    def figure(self) -> Figure:
        source = f"median of {_REPEATS} frames, one core, {self.cpu}; low: the least, high: 95 % of them"
        return Figure(self.median, self.least, self.high, "ms", "measured here", source)


def measure_times(model: Model, load: Load) -> HostTimes:
    """The streaming step of ``load.columns`` columns of a synthetic frame."""
    job, cpu = _job(model, load)
    ms = np.sort(job.time(_REPEATS + 1)[1:].astype(np.float64)) / 1e6
    return HostTimes(cpu, float(np.median(ms)), float(ms[0]), float(ms[int(0.95 * len(ms))]))


def _job(model: Model, load: Load) -> tuple[Job, str]:
    frame = synthetic_frame(load.columns, model.distance_unit_m)
    cpu = fastest_cpu(model)
    return make_job(Work(model.data, *frame), load.precision, cpu, "push"), cpu


def estimate_host(
    device: Device,
    load: Load,
    model: Model,
    *,
    measure_s: float | None = None,
    root: Path = Path("/"),
    advance: Callable[[str], None] = lambda what: None,
) -> Estimate:
    """``measure_s``: measure power at rest, then under load, so many seconds each. Raises MeasureError where that is
    asked for and there is no sensor."""
    latency = measure_times(model, load).figure()
    power, energy, more, more_energy = _absent(root)
    boundary, dominates, notes = "none", "not known: no power was measured", (device.note,)
    if measure_s is not None:
        advance("power at rest")
        idle = record(measure_s, root=root)
        advance("power under load")
        busy, frames_per_second = _record_busy(model, load, measure_s, root)
        # Measured back to back; at the sensor's rate there are so many fewer frames a second.
        more = _scaled(increment(busy, idle), load.rate_hz / frames_per_second)
        base = idle.figure()
        value, low, high = (a + b for a, b in zip(base.span("W"), more.span("W"), strict=True))
        power = Figure(value, low, high, "W", "modelled", f"at rest {base.source}, plus the load's share")
        turn = load.period_ms
        energy, more_energy = (_times(f, turn) for f in (power, more))
        boundary = idle.boundary
        rest = 100 * base.get("W") / power.get("W")
        dominates = f"{rest:.1f} % of it is what the machine draws at rest"
    what = f"both images of a 32 x {load.columns} frame in {load.precision}, one core, {load.rate_hz:g} Hz"
    sensors = tuple(int(load.period_ms / x) for x in (latency.span("ms")[k] for k in (0, 2, 1)))
    return Estimate(
        device, "cpu", None, what, load.macs, Bounded(latency, "computing of a frame on one core"),
        Bounded(power, f"{boundary}, mean over a turn"), Bounded(energy, f"{boundary}, one turn"), _NO_ROWS, dominates,
        Bounded(more, f"{boundary}, over the idle machine"), Bounded(more_energy, f"{boundary}, one frame"),
        load.deadline_ms, (sensors[0], sensors[1], sensors[2]), dict(load.memory), notes,
    )  # fmt: skip


def _scaled(added: Figure, share: float) -> Figure:
    value, low, high = (x * share for x in added.span("W"))
    return Figure(value, low, high, "W", "modelled", f"{added.source}, back to back; scaled to the sensor's rate")


def _times(power: Figure, ms: float) -> Figure:
    value, low, high = (x * ms for x in power.span("W"))
    return Figure(value, low, high, "mJ", power.kind, f"power x {ms:g} ms; power: {power.source}")


def _absent(root: Path) -> tuple[Figure, Figure, Figure, Figure]:
    sensors = find_sensors(root)
    why = f"not measured: --measure 10 measures it with {sensors[0].name}" if sensors else no_sensor(root)
    return tuple(Figure.absent(unit, why) for unit in ("W", "mJ", "W", "mJ"))  # type: ignore[return-value]


def _record_busy(model: Model, load: Load, seconds: float, root: Path) -> tuple[Recording, float]:
    """Power while one thread computes frames back to back, and frames a second."""
    job, _ = _job(model, load)
    stop, frames = threading.Event(), 0

    def work() -> None:
        nonlocal frames
        while not stop.is_set():
            job.time(_BURST)
            frames += _BURST

    thread = threading.Thread(target=work, name="upbeam-load", daemon=True)
    thread.start()
    started = time.monotonic()
    try:
        recording = record(seconds, root=root)
    finally:
        stop.set()
        thread.join()
    return recording, frames / (time.monotonic() - started)
