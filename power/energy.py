"""Power while computing: static plus dynamic, fitted on measured rows, with its leave-one-out error.

    power = static(device) + dynamic(family) x (node / reference node) x multiply-accumulates per second

``static`` is each device's own; ``dynamic``, the energy of a multiply-accumulate, is shared by the devices of a family
and scaled with the feature size. The shared slope is the pooled one within devices (analysis of covariance), at
least 0. Latency from multiply-accumulates alone is the device's (or its family's) geometric mean rate, or its share of
peak: architecture decides it, so its error is large, and is printed.

Everything is judged by leaving each row out and predicting it from the others, as a factor (1 is perfect), beside the
constant: this device always draws what its other rows drew.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

from upbeam.model.toml_file import parse_toml

from . import catalogue
from .catalogue import CatalogueError
from .figures import Figure
from .files import packaged

__all__ = [
    "EnergyModel",
    "LeaveOneOut",
    "Row",
    "as_table",
    "fit",
    "leave_one_out",
    "measured_rows",
    "peak_share",
    "skill",
    "worst_factors",
]

REFERENCE_NODE_NM = 28.0
_LEAST = 1e-9
"""A power or time of nothing counts as this: factors stay finite."""
LEAST_FACTOR = 1.05
"""No estimate claims to be better than this, whatever its error on few rows."""
_UNKNOWN_POWER_FACTOR = 2.0
"""For devices without any row."""


@dataclass(frozen=True)
class Row:
    """A device at work (or idle: ``macs`` 0), measured."""

    device: str
    title: str
    family: str
    boundary: str
    node_nm: float
    workload: str
    macs: float
    latency_ms: float
    """of one inference, back to back; 1 for idle rows"""
    power_w: float
    source: str
    energy_uj: float | None = None
    note: str = ""
    by_user: bool = False
    """measured with ``--calibrate``, not shipped"""

    @property
    def rate(self) -> float:
        """Multiply-accumulates a second."""
        return self.macs / self.latency_ms * 1e3

    @property
    def scaled_rate(self) -> float:
        return self.rate * self.node_nm / REFERENCE_NODE_NM

    @property
    def is_idle(self) -> bool:
        return self.macs == 0

    @property
    def energy_mj(self) -> float:
        """Power times latency."""
        return self.power_w * self.latency_ms


@cache
def measured_rows() -> tuple[Row, ...]:
    """The rows that come with the package (``power/measurements/rows.toml``), and the measured idle powers of the
    catalogue for devices that have a row. Raises CatalogueError."""
    path = packaged("measurements", "rows.toml")
    data = parse_toml(path.name, path.read_text(encoding="utf-8"))
    rows = []
    for entry in data["row"]:
        source = data["sources"][entry["source"]]
        rows.append(Row(**{**entry, "source": f"{source['by']}: {source['how']}"}))
    return (*rows, *_idle_rows(rows))


def _idle_rows(rows: Sequence[Row]) -> Iterable[Row]:
    for name in dict.fromkeys(row.device for row in rows):
        if name not in catalogue.device_names():
            continue
        idle = catalogue.device(name).figures.get("power.idle")
        if idle is not None and idle.kind.startswith("measured"):
            like = next(row for row in rows if row.device == name)
            yield replace(like, workload="idle", macs=0.0, latency_ms=1.0, power_w=idle.get("W"), source=idle.source,
                          energy_uj=None, note="")  # fmt: skip


# --------------------------------------------------------------------------------------------------------- the fit


@dataclass(frozen=True)
class EnergyModel:
    """Fitted on ``rows``. Devices are the rows' and any other of the catalogue."""

    rows: tuple[Row, ...]
    dynamic_j: dict[str, float]
    """family -> energy of a multiply-accumulate at the reference node"""
    static_w: dict[str, float]
    """device -> static power"""
    own_dynamic_j: dict[str, float]
    """device -> the same of its own, where its user measured it at two rates"""

    def dynamic_of(self, like: Row) -> float:
        """Of the device of ``like``, or its family; 0 where neither was measured."""
        return self.own_dynamic_j.get(like.device, self.dynamic_j.get(like.family, 0.0))

    def power_w(self, like: Row) -> float:
        """Of the device and family of ``like`` at its rate. Raises CatalogueError without a row of the device."""
        if like.device not in self.static_w:
            raise CatalogueError(f"{like.device}: no measured row")
        return self.static_w[like.device] + self.dynamic_of(like) * like.scaled_rate

    def rate(self, like: Row) -> float:
        """Multiply-accumulates a second that the device reaches, from its other workloads: geometric mean; of its
        family where it has none of its own, by share of peak where the catalogue has one."""
        work = [row for row in self.rows if not row.is_idle and row.family == like.family]
        own = [row.rate for row in work if row.device == like.device]
        if own:
            return _geometric_mean(own)
        peak = peak_rate(like.device)
        shares = [row.rate / p for row in work if (p := peak_rate(row.device)) is not None]
        if peak is not None and shares:
            return peak * _geometric_mean(shares)
        if not work:
            raise CatalogueError(f"{like.device}: no row of its family {like.family}")
        return _geometric_mean([row.rate for row in work])


def peak_rate(device: str) -> float | None:
    """The catalogue's peak, MAC/s."""
    if device not in catalogue.device_names():
        return None
    peak = catalogue.device(device).figures.get("gpu.peak")
    return None if peak is None else peak.get("MAC/s")


def peak_share(rows: Sequence[Row]) -> Figure:
    """Share of peak that large networks reach on GPUs of the catalogue: geometric mean and range."""
    shares = [r.rate / p for r in rows if r.family == "jetson-gpu" and not r.is_idle and (p := peak_rate(r.device))]
    source = f"{len(shares)} public submissions (power/measurements/rows.toml)"
    return Figure(_geometric_mean(shares), min(shares), max(shares), "1", "modelled", source)


def fit(rows: Sequence[Row]) -> EnergyModel:
    """Static power of each device, dynamic energy of each family."""
    dynamic = {family: _slope([r for r in rows if r.family == family]) for family in _in_order(r.family for r in rows)}
    static, own_dynamic = {}, {}
    for device in _in_order(row.device for row in rows):
        own = [row for row in rows if row.device == device]
        if all(row.by_user for row in own) and len({row.rate for row in own}) > 1:
            own_dynamic[device] = _slope(own)
        slope = own_dynamic.get(device, dynamic[own[0].family])
        static[device] = max(0.0, _mean([row.power_w - slope * row.scaled_rate for row in own]))
    return EnergyModel(tuple(rows), dynamic, static, own_dynamic)


def _slope(rows: Sequence[Row]) -> float:
    """Pooled within devices: each device may have its own static power. At least 0; 0 without two rows of a device."""
    above = below = 0.0
    for device in _in_order(row.device for row in rows):
        own = [row for row in rows if row.device == device]
        rate, power = _mean([row.scaled_rate for row in own]), _mean([row.power_w for row in own])
        above += sum((row.scaled_rate - rate) * (row.power_w - power) for row in own)
        below += sum((row.scaled_rate - rate) ** 2 for row in own)
    return max(0.0, above / below) if below else 0.0


# --------------------------------------------------------------------------------------------------- leave one out


@dataclass(frozen=True)
class LeaveOneOut:
    """A row, and what the others say of it. None where they say nothing."""

    row: Row
    power_w: float | None
    """given its latency"""
    latency_ms: float | None
    """from its multiply-accumulates alone"""
    constant_power_w: float | None
    """the mean of the device's other workloads, or its idle power"""
    constant_latency_ms: float | None
    """the geometric mean of the device's other workloads"""

    @property
    def energy_mj(self) -> float | None:
        """From multiply-accumulates alone."""
        if self.latency_ms is None or self.power_from_macs_w is None:
            return None
        return self.latency_ms * self.power_from_macs_w

    power_from_macs_w: float | None = None

    @property
    def constant_energy_mj(self) -> float | None:
        if self.constant_power_w is None or self.constant_latency_ms is None:
            return None
        return self.constant_power_w * self.constant_latency_ms

    def factor(self, what: str) -> float | None:
        """How many times the estimate of ``what`` is off, at least 1."""
        true = {"power": self.row.power_w, "latency": self.row.latency_ms, "energy": self.row.energy_mj}
        guess = {"power": self.power_w, "latency": self.latency_ms, "energy": self.energy_mj}
        return _factor(guess[what], true[what])

    def constant_factor(self, what: str) -> float | None:
        true = {"power": self.row.power_w, "latency": self.row.latency_ms, "energy": self.row.energy_mj}
        guess = {
            "power": self.constant_power_w, "latency": self.constant_latency_ms, "energy": self.constant_energy_mj
        }  # fmt: skip
        return _factor(guess[what], true[what])


def leave_one_out(rows: Sequence[Row]) -> list[LeaveOneOut]:
    """Each row predicted by a model fitted on all others. An idle row has a power only."""
    found = []
    for k, row in enumerate(rows):
        others = [*rows[:k], *rows[k + 1 :]]
        model = fit(others)
        own = [r for r in others if r.device == row.device]
        work = [r for r in own if not r.is_idle]
        power = latency = from_macs = None
        if own and row.family in model.dynamic_j:
            power = model.power_w(row)
        if not row.is_idle and any(r.family == row.family and not r.is_idle for r in others):
            latency = row.macs / model.rate(row) * 1e3
            from_macs = model.power_w(replace(row, latency_ms=latency)) if own else None
        constant_power = _mean([r.power_w for r in work or own]) if own else None
        constant_latency = _geometric_mean([r.latency_ms for r in work]) if work and not row.is_idle else None
        found.append(LeaveOneOut(row, power, latency, constant_power, constant_latency, from_macs))
    return found


def worst_factors(results: Sequence[LeaveOneOut], device: str) -> dict[str, float | None]:
    """Of a device's rows: the largest factor of power (with the latency given; energy then has the same), and of
    latency and energy from multiply-accumulates alone."""
    own = [x for x in results if x.row.device == device]
    return {what: _worst(x.factor(what) for x in own) for what in ("power", "latency", "energy")}


def skill(results: Sequence[LeaveOneOut], what: str) -> float | None:
    """1 - error of the model / error of the constant, both root mean squares of the logarithm of their factors, over
    the rows that both say something about. 0: no better than the constant; below: worse. None: nothing to compare."""
    pairs = [(x.factor(what), x.constant_factor(what)) for x in results]
    both = [(math.log(m), math.log(c)) for m, c in pairs if m is not None and c is not None]
    if not both:
        return None
    model, constant = (math.sqrt(_mean([x[k] ** 2 for x in both])) for k in (0, 1))
    return 1 - model / constant if constant > 0 else None


def _worst(factors: Iterable[float | None]) -> float | None:
    return max((f for f in factors if f is not None), default=None)


def _factor(guess: float | None, true: float) -> float | None:
    if guess is None:
        return None
    guess, true = (max(x, _LEAST) for x in (guess, true))
    return max(guess / true, true / guess)


def _mean(values: Sequence[float]) -> float:
    return sum(values) / len(values)


def _geometric_mean(values: Sequence[float]) -> float:
    return math.exp(_mean([math.log(v) for v in values]))


def _in_order(names: Iterable[str]) -> list[str]:
    return list(dict.fromkeys(names))


def as_table(results: Sequence[LeaveOneOut]) -> list[dict[str, Any]]:
    """For JSON and reports."""
    whats = ("power", "latency", "energy")
    return [
        {
            "device": x.row.device,
            "workload": x.row.workload,
            "boundary": x.row.boundary,
            "measured_w": x.row.power_w,
            "measured_ms": None if x.row.is_idle else x.row.latency_ms,
            **{f"{what}_factor": x.factor(what) for what in whats},
            **{f"constant_{what}_factor": x.constant_factor(what) for what in whats},
        }
        for x in results
    ]
