"""Which FPGA core on which part: every LANES and FOLD, with clocks (exact), LUTs and clock rate (routed, or fitted to
routed cores), frames per second and energy; and the smallest part that will do.

Routed cores are handed in (``hw_sim.fpga.baselines``): this package does not know how they are made.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Any

import numpy as np

from upbeam.quant.export.rtl import configuration
from upbeam.quant.export.rtl_schedule import Configuration, folds
from upbeam.quant.export.source import Source
from upbeam.quant.integer import Precision

from .catalogue import device
from .cycles.fpga_core import CoreCycles

__all__ = ["PARTS", "ROUTED", "Point", "Sweep", "sweep"]

PARTS = ("ice40up5k", "ecp5-12", "ecp5-25", "ecp5-85")
"""With an open place and route, the smallest first."""
ROUTED, FITTED = "routed", "fitted to routed"
LUT_LIMIT = 0.9
"""Of a part, for a core that was not routed: a fuller part may not route."""
NETWORKS = 2


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
    source: Source, precision: Precision, routed: Mapping[str, Mapping[str, Any]], macs: int, rate_hz: float = 20.0
) -> Sweep:
    """``routed``: reports of the flow by name, of any model; those of this model and precision count. ``macs`` of a
    frame. Raises ValueError where too few are routed to fit others."""
    ours = [
        r
        for r in routed.values()
        if r["model_crc32"] == f"{source.crc32:08x}" and r["precision"] == precision and "clock_mhz" in r
    ]
    alike = [r for r in ours if r["part"].startswith("ecp5") and _is_fitted(_configuration(r, source, precision))]
    fit, error = _fit(alike, source, precision)
    columns = source.file.rules.columns
    points = []
    for part in PARTS:
        there = device(part)
        for c in _configurations(source, precision, int(there.figure("fpga.multipliers").get("1"))):
            found = [r for r in ours if (r["part"], r["fold"], r["lanes"]) == (part, c.fold, c.lanes)]
            luts, clock, label = _routed(found[0]) if found else _fitted(part, c, fit, ours)
            if clock is None or (luts > LUT_LIMIT * there.figure("fpga.luts").get("1") and not found):
                continue
            cycles = CoreCycles.of(c, precision, source.file.rules)
            mac = there.figure("power.mac_energy").span("J/MAC")
            idle = there.figure("power.idle").span("W")
            fps = cycles.frames_per_second(clock[0] * 1e6, columns)
            energy = tuple(1e3 * (m * macs + w / rate_hz) for m, w in zip(mac, idle, strict=True))
            points.append(
                Point(
                    part, c.fold, c.lanes, _multipliers(c), cycles.frame(columns), luts, label, clock, label, fps,
                    fps / rate_hz, cycles.column_latency / clock[0], (energy[0], energy[1], energy[2]),
                )
            )  # fmt: skip
    return Sweep(tuple(points), error, rate_hz, columns)


def _configurations(source: Source, precision: Precision, multipliers: int) -> Iterator[Configuration]:
    """All that the part has the multipliers for."""
    model = source.integer(precision)
    hidden = max(n.hidden for n in model)
    for fold in folds(hidden):
        for lanes in (n for n in range(1, fold + 1) if fold % n == 0):
            c = configuration(model, fold=fold, lanes=lanes)
            if _multipliers(c) <= multipliers:
                yield c


def _configuration(report: Mapping[str, Any], source: Source, precision: Precision) -> Configuration:
    return configuration(source.integer(precision), fold=report["fold"], lanes=report["lanes"])


def _is_fitted(c: Configuration) -> bool:
    """Multipliers, and lanes of whole hidden units: shifts and adds, and what shares multipliers within several lanes
    (31 % more LUTs than the fit says, routed once), are known as routed or not at all."""
    return c.fold > 1 and (c.phases == 1 or c.lanes == 1)


def _multipliers(c: Configuration) -> int:
    return 0 if c.fold == 1 else NETWORKS * c.lanes * c.multipliers


Clock = tuple[float, float, float]


def _routed(report: Mapping[str, Any]) -> tuple[int, Clock, str]:
    clock = report["clock_mhz"]
    return report["utilisation"]["luts"]["used"], (clock["median"], clock["least"], clock["most"]), ROUTED


def _fitted(
    part: str, c: Configuration, fit: Sequence[float], ours: Sequence[Mapping[str, Any]]
) -> tuple[int, Clock | None, str]:
    """ECP5 only, and no more multipliers than a routed core has; other families are known as routed or not at all."""
    routed = [r for r in ours if r["part"].startswith("ecp5") and r["fold"] > 1]
    alike = [r["clock_mhz"] for r in routed]
    # No extrapolation: not beyond the multipliers of what was routed.
    most_multipliers = max((r["resources"]["multipliers"] for r in routed), default=0)
    unlike = not _is_fitted(c) or _multipliers(c) > most_multipliers
    if not part.startswith("ecp5") or unlike or not alike:
        return 0, None, FITTED
    luts = float(np.dot(fit, _terms(c)))
    clock = (
        median(a["median"] for a in alike),
        min(a["least"] for a in alike),
        max(a["most"] for a in alike),
    )
    return round(luts), clock, FITTED


def _terms(c: Configuration) -> tuple[float, float]:
    """What LUTs grow with: what surrounds the networks, and multipliers with their sums."""
    return 1.0, float(_multipliers(c))


def _fit(ours: Sequence[Mapping[str, Any]], source: Source, precision: Precision) -> tuple[list[float], float]:
    """Least squares, and the largest leave-one-out error."""
    if len(ours) < 4:
        raise ValueError(
            f"{len(ours)} routed ECP5 cores of this model in {precision}: expected 4 or more to fit others"
        )
    terms = np.array([_terms(_configuration(r, source, precision)) for r in ours])
    luts = np.array([float(r["utilisation"]["luts"]["used"]) for r in ours])
    errors = []
    for n in range(len(ours)):
        others = np.arange(len(ours)) != n
        without = np.linalg.lstsq(terms[others], luts[others], rcond=None)[0]
        errors.append(abs(float(terms[n] @ without) - luts[n]) / luts[n])
    return [float(x) for x in np.linalg.lstsq(terms, luts, rcond=None)[0]], float(max(errors))
