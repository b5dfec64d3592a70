"""Rails and their total; recordings of power, and what may be said of them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from upbeam.power.figures import Figure

__all__ = ["LEAST_S", "TOTALS", "MeasureError", "Recording", "increment", "total_power"]

TOTALS = ("POM_5V_IN", "VDD_IN", "VIN")
"""Rails that are the whole input of a module or board: parts are never added to one of them."""
LEAST_S = 10.0
"""A recording shorter than this says nothing: sensors are smoothed and slow."""


class MeasureError(ValueError):
    """What cannot be measured, or a record that says nothing: names the sensor or file, and why."""


@dataclass(frozen=True)
class Recording:
    """Samples of the total power, W, evenly in time."""

    watts: tuple[float, ...]
    seconds: float
    boundary: str
    source: str
    rails: Mapping[str, float]
    """mean of each rail, W"""
    skipped: int = 0
    """lines or readings without a power"""

    def __post_init__(self) -> None:
        if not self.watts:
            raise MeasureError(f"{self.source}: no power was read")
        if not all(math.isfinite(w) and w >= 0 for w in self.watts):
            raise MeasureError(f"{self.source}: a power below 0 or not finite")

    @property
    def mean_w(self) -> float:
        return sum(self.watts) / len(self.watts)

    @property
    def half_width_w(self) -> float:
        """Of a 95 % interval of the mean. Neighbouring samples are alike: blocks of a tenth of the record are compared,
        not samples."""
        blocks = min(10, len(self.watts))
        if blocks < 2:
            return math.inf
        size = len(self.watts) // blocks
        means = [sum(self.watts[k * size : (k + 1) * size]) / size for k in range(blocks)]
        middle = sum(means) / blocks
        variance = sum((m - middle) ** 2 for m in means) / (blocks - 1)
        return _STUDENT_95[blocks - 1] * math.sqrt(variance / blocks)

    def figure(self) -> Figure:
        """Mean power. Raises MeasureError for a record too short to say anything."""
        self.check()
        half = self.half_width_w
        low = max(0.0, self.mean_w - half)
        return Figure(self.mean_w, low, self.mean_w + half, "W", "measured here", self.source)

    def check(self) -> None:
        if self.seconds < LEAST_S:
            raise MeasureError(f"{self.source}: {self.seconds:.3g} s, expected at least {LEAST_S:g} s")
        if not math.isfinite(self.half_width_w):
            raise MeasureError(f"{self.source}: one sample, expected at least 2")


_STUDENT_95 = {1: 12.706, 2: 4.303, 3: 3.182, 4: 2.776, 5: 2.571, 6: 2.447, 7: 2.365, 8: 2.306, 9: 2.262}
"""Quantile 0.975 of Student's distribution by degrees of freedom."""


def total_power(rails: Mapping[str, float]) -> tuple[float, str]:
    """The power of the whole, W, and its boundary in words. Raises MeasureError without any rail."""
    if not rails:
        raise MeasureError("no rails: no power")
    for name in TOTALS:
        if name in rails:
            return rails[name], f"input rail {name}, which holds all others"
    return sum(rails.values()), f"sum of {len(rails)} rails: {', '.join(rails)}"


def increment(load: Recording, idle: Recording) -> Figure:
    """What a load adds to the idle device, W. Both must be of one boundary. An increment within its error keeps its
    sign: the interval says that it may be nothing."""
    if load.boundary != idle.boundary:
        raise MeasureError(f"load is measured at {load.boundary!r}, idle at {idle.boundary!r}: cannot be subtracted")
    load.check()
    idle.check()
    half = math.hypot(load.half_width_w, idle.half_width_w)
    value = load.mean_w - idle.mean_w
    return Figure(value, value - half, value + half, "W", "measured here", f"{load.source} less {idle.source}")


def mean_rails(samples: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Mean of each rail over the samples that have it."""
    names = dict.fromkeys(name for sample in samples for name in sample)
    found = {}
    for name in names:
        values = [sample[name] for sample in samples if name in sample]
        found[name] = sum(values) / len(values)
    return found
