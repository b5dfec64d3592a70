"""FPGA cores that were built: LUTs and clocks as routed, or fitted to routed cores; their switching activity.

Reports and activities are handed in (``hw_sim.fpga.baselines``, ``hw_sim.fpga.activities``): this package does not know
how they are made.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Any

import numpy as np

from upbeam.quant.export.rtl_schedule import Configuration

from .cycles.fpga import FpgaCore
from .figures import Figure

__all__ = ["NETWORKS", "BuiltCores", "Clock", "LutFit", "multipliers_of"]

NETWORKS = 2
FITTED_FAMILY = "ecp5"
"""Parts of one fabric, of which enough cores were routed to fit others."""
_LEAST_REPORTS = 4

Report = Mapping[str, Any]
Clock = tuple[float, float, float]


def multipliers_of(c: Configuration) -> int:
    """Of all lanes and both networks; FOLD 1 has none, its products are shifts and adds."""
    return 0 if c.fold == 1 else NETWORKS * c.lanes * c.multipliers


@dataclass(frozen=True)
class LutFit:
    """LUTs of ECP5 cores with multipliers, a line in their number, and their clocks."""

    coefficients: tuple[float, float]
    """LUTs around the networks; LUTs with each multiplier"""
    error: float
    """largest error of a routed core's LUTs when the fit does without it, as a share"""
    clock_mhz: Clock
    """median of the cores' medians, least and most of any"""
    most_multipliers: int
    cores: int

    @classmethod
    def of(cls, reports: Sequence[Report], hidden: int) -> LutFit:
        """``reports``: of one model and precision, any part. Raises ValueError where fewer than four tell."""
        made = [(r, Configuration(hidden, r["fold"], r["lanes"])) for r in reports if "clock_mhz" in r]
        alike = [(r, c) for r, c in made if _is_fitted(r["part"], c)]
        if len(alike) < _LEAST_REPORTS:
            raise ValueError(f"{len(alike)} routed ECP5 cores: expected {_LEAST_REPORTS} or more to fit others")
        ours = [r for r, _ in alike]
        terms = np.array([_terms(c) for _, c in alike])
        luts = np.array([float(r["utilisation"]["luts"]["used"]) for r in ours])
        errors = []
        for n in range(len(ours)):
            others = np.arange(len(ours)) != n
            without = np.linalg.lstsq(terms[others], luts[others], rcond=None)[0]
            errors.append(abs(float(terms[n] @ without) - luts[n]) / luts[n])
        fixed, each = (float(x) for x in np.linalg.lstsq(terms, luts, rcond=None)[0])
        clocks = [r["clock_mhz"] for r in ours]
        clock = (
            median(c["median"] for c in clocks), min(c["least"] for c in clocks), max(c["most"] for c in clocks)
        )  # fmt: skip
        most = max(r["resources"]["multipliers"] for r in ours)
        return cls((fixed, each), float(max(errors)), clock, most, len(ours))

    def covers(self, part: str, c: Configuration) -> bool:
        """Nothing is extrapolated: no more multipliers than a routed core has."""
        return _is_fitted(part, c) and multipliers_of(c) <= self.most_multipliers

    def luts(self, c: Configuration) -> int:
        return round(float(np.dot(self.coefficients, _terms(c))))


def _is_fitted(part: str, c: Configuration) -> bool:
    """ECP5 with multipliers, and lanes of whole hidden units. Other families, shifts and adds, and what shares
    multipliers within several lanes (31 % more LUTs than the fit says, routed once) are known as routed or not at
    all."""
    return part.startswith(FITTED_FAMILY) and c.fold > 1 and (c.phases == 1 or c.lanes == 1)


def _terms(c: Configuration) -> tuple[float, float]:
    """What LUTs grow with: what surrounds the networks, and multipliers with their sums."""
    return 1.0, float(multipliers_of(c))


@dataclass(frozen=True)
class BuiltCores:
    """Of one model: all that was routed and simulated of it."""

    routed: tuple[Report, ...] = ()
    activities: tuple[Report, ...] = ()

    @classmethod
    def of(cls, crc32: int, reports: Mapping[str, Report], activities: Mapping[str, Report]) -> BuiltCores:
        """``reports`` and ``activities`` by name, of any model."""
        name = f"{crc32:08x}"
        routed = (r for r in reports.values() if r["model_crc32"] == name and "clock_mhz" in r)
        return cls(tuple(routed), tuple(a for a in activities.values() if a["model_crc32"] == name))

    def most_multipliers(self, part: str, precision: str, hidden: int) -> int | None:
        """Of cores whose LUTs are known on a part; None where none is."""
        own = [r["resources"]["multipliers"] for r in self._of(precision) if r["part"] == part]
        fit = self._fit(precision, hidden) if part.startswith(FITTED_FAMILY) else None
        return max([*own, *([fit.most_multipliers] if fit else [])], default=None)

    def luts(self, part: str, core: FpgaCore) -> Figure | None:
        """As routed (simulated), as fitted (modelled), or None."""
        report = self._report(part, core)
        if report is not None:
            return Figure.exact(report["utilisation"]["luts"]["used"], "1", "simulated", _routed(report))
        fit = self._fitted(part, core)
        if fit is None:
            return None
        luts, source = fit.luts(core.cycles.configuration), f"fitted to {fit.cores} routed ECP5 cores of this model"
        source += f"; one left out is off by up to {100 * fit.error:.1f} %"
        return Figure(luts, luts * (1 - fit.error), luts * (1 + fit.error), "1", "modelled", source)

    def clock(self, part: str, core: FpgaCore) -> Figure | None:
        """The median over the router's seeds, with their spread; of one seed the spread of others."""
        report = self._report(part, core)
        if report is not None:
            clock = report["clock_mhz"]
            low, high = clock["least"], clock["most"]
            note = f"{clock['seeds']} seeds"
            if clock["seeds"] == 1:
                slow, fast = self._spread(part)
                low, high = low * slow, high * fast
                note = "1 seed, with the spread of cores routed with several"
            return Figure(clock["median"], low, high, "MHz", "simulated", f"{_routed(report)}, {note}")
        fit = self._fitted(part, core)
        if fit is None:
            return None
        value, least, most = fit.clock_mhz
        source = f"fitted: median, least and most of {fit.cores} routed ECP5 cores of this model (nextpnr's timing)"
        return Figure(value, least, most, "MHz", "modelled", source)

    def activity(self, core: FpgaCore) -> Report | None:
        """Toggles of a frame: of this LANES, FOLD and precision, on whatever part."""
        wanted = (core.precision, core.fold, core.lanes)
        return next((a for a in self.activities if (a["precision"], a["fold"], a["lanes"]) == wanted), None)

    def _of(self, precision: str) -> list[Report]:
        return [r for r in self.routed if r["precision"] == precision]

    def _report(self, part: str, core: FpgaCore) -> Report | None:
        wanted = (part, core.fold, core.lanes)
        return next((r for r in self._of(core.precision) if (r["part"], r["fold"], r["lanes"]) == wanted), None)

    def _fit(self, precision: str, hidden: int) -> LutFit | None:
        try:
            return LutFit.of(self._of(precision), hidden)
        except ValueError:
            return None

    def _fitted(self, part: str, core: FpgaCore) -> LutFit | None:
        fit = self._fit(core.precision, core.hidden)
        return fit if fit is not None and fit.covers(part, core.cycles.configuration) else None

    def _spread(self, part: str) -> tuple[float, float]:
        """Least and most over the median, the widest of a family's cores with several seeds."""
        family = part.split("-")[0]
        clocks = [r["clock_mhz"] for r in self.routed if r["part"].split("-")[0] == family]
        several = [c for c in clocks if c["seeds"] > 1]
        slow = min((c["least"] / c["median"] for c in several), default=1.0)
        return slow, max((c["most"] / c["median"] for c in several), default=1.0)


def _routed(report: Report) -> str:
    return f"routed ({report['tools']['route']}, {report['date']}; not run on a board)"
