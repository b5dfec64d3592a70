"""Numbers that leave the product: value, interval, unit, how each is known, and from where."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

__all__ = ["KINDS", "UNITS", "Figure", "FigureError", "convert"]

UNITS: dict[str, tuple[str, float]] = {
    "1": ("number", 1.0),
    "%": ("number", 0.01),
    "s": ("time", 1.0),
    "ms": ("time", 1e-3),
    "us": ("time", 1e-6),
    "ns": ("time", 1e-9),
    "Hz": ("rate", 1.0),
    "MHz": ("rate", 1e6),
    "GHz": ("rate", 1e9),
    "W": ("power", 1.0),
    "mW": ("power", 1e-3),
    "uW": ("power", 1e-6),
    "J": ("energy", 1.0),
    "mJ": ("energy", 1e-3),
    "uJ": ("energy", 1e-6),
    "nJ": ("energy", 1e-9),
    "pJ": ("energy", 1e-12),
    "mWh": ("energy", 3.6),
    "B": ("memory", 1.0),
    "KiB": ("memory", 1024.0),
    "MiB": ("memory", 1024.0**2),
    "GiB": ("memory", 1024.0**3),
    "kbit": ("memory", 128.0),
    "B/s": ("bandwidth", 1.0),
    "GB/s": ("bandwidth", 1e9),
    "MAC": ("work", 1.0),
    "MAC/s": ("throughput", 1.0),
    "GMAC/s": ("throughput", 1e9),
    "pJ/MAC": ("energy of work", 1e-12),
    "J/MAC": ("energy of work", 1.0),
    "V": ("voltage", 1.0),
    "bit": ("width", 1.0),
    "nm": ("length", 1e-9),
}
"""Each unit's dimension and its size in that dimension's base unit."""

KINDS = ("data sheet", "measured", "simulated", "modelled", "assumption", "given", "none")
"""``measured`` may be followed by `` by NAME`` or `` here``; ``given``: by the user; ``none``: there is no figure, and
the source says why."""


class FigureError(ValueError):
    """A figure that cannot be: says what is wrong with it."""


def convert(value: float, unit: str, to: str) -> float:
    """``value`` in another unit of the same dimension. Raises FigureError for unknown or foreign units."""
    for name in (unit, to):
        if name not in UNITS:
            raise FigureError(f"unit {name!r} is unknown, expected one of {', '.join(UNITS)}")
    (dimension, size), (wanted, wanted_size) = UNITS[unit], UNITS[to]
    if dimension != wanted:
        raise FigureError(f"{unit} is a {dimension}, {to} a {wanted}")
    return value * (size / wanted_size)


@dataclass(frozen=True)
class Figure:
    """One number with its interval. ``value``, ``low`` and ``high`` are None together: there is no number."""

    value: float | None
    low: float | None
    high: float | None
    unit: str
    kind: str
    source: str

    def __post_init__(self) -> None:
        if self.unit not in UNITS:
            raise FigureError(f"unit {self.unit!r} is unknown, expected one of {', '.join(UNITS)}")
        if self.kind.split(" by ")[0].removesuffix(" here") not in KINDS:
            raise FigureError(f"kind {self.kind!r}, expected {', '.join(KINDS)}, or 'measured by NAME'")
        if not self.source.strip():
            raise FigureError("source is empty: say where the figure is from")
        numbers = (self.value, self.low, self.high)
        if self.kind == "none" or None in numbers:
            if self.kind != "none" or numbers != (None, None, None):
                raise FigureError("a figure without value has kind 'none', and neither value, low nor high")
        elif not all(math.isfinite(x) for x in self._numbers()):
            raise FigureError("value, low and high must be finite")
        elif not self._numbers()[1] <= self._numbers()[0] <= self._numbers()[2]:
            raise FigureError(f"value {self.value:g} is outside of low {self.low:g} to high {self.high:g}")

    @classmethod
    def exact(cls, value: float, unit: str, kind: str, source: str) -> Figure:
        """A figure whose interval is itself."""
        return cls(value, value, value, unit, kind, source)

    @classmethod
    def within(cls, value: float, factor: float, unit: str, kind: str, source: str) -> Figure:
        """A positive figure, right within a factor."""
        return cls(value, value / factor, value * factor, unit, kind, source)

    @classmethod
    def absent(cls, unit: str, why: str) -> Figure:
        return cls(None, None, None, unit, "none", why)

    def _numbers(self) -> tuple[float, float, float]:
        assert self.value is not None
        assert self.low is not None
        assert self.high is not None
        return self.value, self.low, self.high

    @property
    def known(self) -> bool:
        return self.value is not None

    def get(self, unit: str) -> float:
        """The central value in a unit. Raises FigureError if there is none."""
        return self.span(unit)[0]

    def span(self, unit: str) -> tuple[float, float, float]:
        """Value, low and high in a unit. Raises FigureError if there is none."""
        if not self.known:
            raise FigureError(f"no figure: {self.source}")
        value, low, high = (convert(x, self.unit, unit) for x in self._numbers())
        return value, low, high

    def to(self, unit: str) -> Figure:
        """The same in another unit."""
        if not self.known:
            convert(0.0, self.unit, unit)
            return replace(self, unit=unit)
        value, low, high = self.span(unit)
        return replace(self, value=value, low=low, high=high, unit=unit)

    def as_dict(self) -> dict[str, Any]:
        return dict(vars(self))
