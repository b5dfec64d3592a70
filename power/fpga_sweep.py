"""Which FPGA core on which part: every LANES and FOLD, with clocks (exact), LUTs and clock rate (routed, or fitted to
routed cores), frames per second and energy; and the smallest part that will do.

Routed cores are handed in (``hw_sim.fpga.baselines``): this package does not know how they are made.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from upbeam.quant.export.rtl import configuration
from upbeam.quant.export.rtl_schedule import Configuration, folds
from upbeam.quant.export.source import Source
from upbeam.quant.integer import Precision

from .catalogue import Device, device
from .cycles.fpga import FpgaCore
from .cycles.fpga_core import CoreCycles
from .fpga_activity import core_volts, dynamic_energy, toggles_of_a_turn
from .fpga_built import BuiltCores, Clock, LutFit, multipliers_of

__all__ = ["PARTS", "ROUTED", "Point", "Sweep", "sweep"]

PARTS = ("ice40up5k", "ecp5-12", "ecp5-25", "ecp5-85")
"""With an open place and route, the smallest first."""
ROUTED, FITTED = "routed", "fitted to routed"
LUT_LIMIT = 0.9
"""Of a part, for a core that was not routed: a fuller part may not route."""


@dataclass(frozen=True)
class Point:
    part: str
    fold: int
    lanes: int
    multipliers: int
    """both networks; 0: shifts and adds"""
    clocks: int
    """of a frame, simulated and modelled alike"""
    luts: int
    luts_label: str
    clock_mhz: tuple[float, float, float]
    """central, least, most"""
    clock_label: str
    frames_per_second: float
    margin: float
    """over the rate asked for, at the central clock"""
    column_latency_us: float
    energy_mj: tuple[float, float, float]
    """a turn: central, low, high; modelled"""

    def as_dict(self) -> dict[str, Any]:
        return dict(vars(self))


@dataclass(frozen=True)
class Sweep:
    points: tuple[Point, ...]
    fit_error: float
    """largest error of a routed core's LUTs when the fit does without it, as a share"""
    rate_hz: float
    columns: int

    @property
    def front(self) -> list[Point]:
        """No other point of its part has fewer LUTs and more frames."""
        return [p for p in self.points if not any(_beats(q, p) for q in self.points if q.part == p.part)]

    @property
    def smallest(self) -> Point | None:
        """On the smallest part that carries the load as routed; there, the one with the largest margin."""
        for part in PARTS:
            able = [p for p in self.points if p.part == part and p.clock_label == ROUTED and p.margin >= 1]
            if able:
                return max(able, key=lambda p: p.margin)
        return None

    def sentence(self) -> str:
        p, load = self.smallest, f"{self.rate_hz:g} Hz x {self.columns} columns with both networks"
        if p is None:
            return f"No listed part carries {load} as routed."
        luts = device(p.part).figure("fpga.luts").get("1")
        return (
            f"The smallest listed part that meets {load} is {device(p.part).title}: LANES {p.lanes}, FOLD {p.fold}, "
            f"{p.clock_mhz[0]:.1f} MHz routed ({p.clock_mhz[1]:.1f} to {p.clock_mhz[2]:.1f} over seeds), "
            f"{p.frames_per_second:.1f} frames per second, a margin of {p.margin:.2f}; {100 * p.luts / luts:.0f} % of "
            f"its logic cells, {p.multipliers} multipliers."
        )


def _beats(q: Point, p: Point) -> bool:
    no_worse = q.luts <= p.luts and q.frames_per_second >= p.frames_per_second
    return no_worse and (q.luts < p.luts or q.frames_per_second > p.frames_per_second)


def sweep(
    source: Source,
    precision: Precision,
    routed: Mapping[str, Mapping[str, Any]],
    macs: int,
    rate_hz: float = 20.0,
    activities: Mapping[str, Mapping[str, Any]] | None = None,
) -> Sweep:
    """``routed``: reports of the flow by name, of any model; those of this model and precision count, and so with
    ``activities``; where there is none, energy is that of ``macs`` of a frame. Raises ValueError where too few are
    routed to fit others."""
    ours = [
        r
        for r in routed.values()
        if r["model_crc32"] == f"{source.crc32:08x}" and r["precision"] == precision and "clock_mhz" in r
    ]
    try:
        fit = LutFit.of(ours, max(n.hidden for n in source.integer(precision)))
    except ValueError as error:
        raise ValueError(f"this model in {precision}: {error}") from None
    columns = source.file.rules.columns
    built = BuiltCores.of(source.crc32, {}, activities or {})
    points = []
    for part in PARTS:
        there = device(part)
        for c in _configurations(source, precision, int(there.figure("fpga.multipliers").get("1"))):
            found = [r for r in ours if (r["part"], r["fold"], r["lanes"]) == (part, c.fold, c.lanes)]
            luts, clock, label = _routed(found[0]) if found else _fitted(part, c, fit)
            if clock is None or (luts > LUT_LIMIT * there.figure("fpga.luts").get("1") and not found):
                continue
            cycles = CoreCycles.of(c, precision, source.file.rules)
            core = FpgaCore(c.lanes, c.fold, c.hidden, precision)
            added = _added_joules(there, built.activity(core), macs, columns, clock[0] * 1e6, 1 / rate_hz)
            idle = there.figure("power.idle").span("W")
            fps = cycles.frames_per_second(clock[0] * 1e6, columns)
            energy = tuple(1e3 * (j + w / rate_hz) for j, w in zip(added, idle, strict=True))
            points.append(
                Point(
                    part, c.fold, c.lanes, multipliers_of(c), cycles.frame(columns), luts, label, clock, label, fps,
                    fps / rate_hz, cycles.column_latency / clock[0], (energy[0], energy[1], energy[2]),
                )
            )  # fmt: skip
    return Sweep(tuple(points), fit.error, rate_hz, columns)


def _added_joules(
    part: Device, activity: Mapping[str, Any] | None, macs: int, columns: int, clock_hz: float, turn_s: float
) -> tuple[float, float, float]:
    """Of a turn: of the core's switching activity, else of multiply-accumulates."""
    volts = core_volts(part)
    if activity is not None and volts is not None:
        return dynamic_energy(toggles_of_a_turn(activity, columns, clock_hz, turn_s)[0], volts).span("J")
    value, low, high = (x * macs for x in part.figure("power.mac_energy").span("J/MAC"))
    return value, low, high


def _configurations(source: Source, precision: Precision, multipliers: int) -> Iterator[Configuration]:
    """All that the part has the multipliers for."""
    model = source.integer(precision)
    hidden = max(n.hidden for n in model)
    for fold in folds(hidden):
        for lanes in (n for n in range(1, fold + 1) if fold % n == 0):
            c = configuration(model, fold=fold, lanes=lanes)
            if multipliers_of(c) <= multipliers:
                yield c


def _routed(report: Mapping[str, Any]) -> tuple[int, Clock, str]:
    clock = report["clock_mhz"]
    return report["utilisation"]["luts"]["used"], (clock["median"], clock["least"], clock["most"]), ROUTED


def _fitted(part: str, c: Configuration, fit: LutFit) -> tuple[int, Clock | None, str]:
    return (fit.luts(c), fit.clock_mhz, FITTED) if fit.covers(part, c) else (0, None, FITTED)
