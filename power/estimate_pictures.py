"""Pictures of the report of estimates: readable in black and white, everything named where it stands."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from .estimate import Estimate
from .files import packaged
from .pictures import GENERATED, GRID, MEASURED, _figure, _plain_ticks, _styled

__all__ = ["Roof", "RooflinePoint", "pareto_rows", "plot_latency", "plot_pareto", "plot_power", "plot_roofline"]

_STYLES = ("-", "--", "-.", ":")


# -------------------------------------------------------------------------------------------------------- intervals


@_styled
def plot_latency(estimates: Sequence[Estimate], deadline_ms: float) -> Figure:
    """Each device's interval, logarithmic, and the deadline."""
    figure = _figure(0.26 * len(estimates) + 1.1)
    axes = figure.add_subplot()
    for place, one in enumerate(estimates):
        value, low, high = one.latency_ms.figure.span("ms")
        filled = one.latency_ms.figure.kind == "measured here"
        _interval(axes, place, value, low, high, filled=filled)
    axes.axvline(deadline_ms, color="black", linewidth=1.4)
    axes.annotate(
        f"deadline {deadline_ms:g} ms", (deadline_ms, -0.75), xytext=(-4, 0), textcoords="offset points", ha="right",
        va="center", fontsize=8.5,
    )  # fmt: skip
    _names(axes, [f"{e.device.name} {e.implementation}" for e in estimates])
    axes.set_xlim(right=2 * deadline_ms)
    axes.set_xlabel("computing of a frame, both images (ms); filled: measured here, open: modelled; line: its interval")
    return figure


@_styled
def plot_power(estimates: Sequence[Estimate]) -> Figure:
    """Mean power of the whole over a turn (square), and what our work adds to it (dot), W."""
    known = [e for e in estimates if e.power_w.figure.known and e.increment_w is not None]
    figure = _figure(0.26 * len(known) + 1.1)
    axes = figure.add_subplot()
    for place, one in enumerate(known):
        assert one.increment_w is not None
        _interval(axes, place, *one.power_w.figure.span("W"), marker="s", colour=MEASURED)
        _interval(axes, place, *one.increment_w.figure.span("W"), marker="o", colour=GENERATED)
    _names(axes, [f"{e.device.name} {e.implementation}" for e in known])
    axes.set_xlabel("W; square: the whole inside its boundary, mean over a turn; circle: what our work adds to it")
    return figure


def _interval(
    axes: Axes, place: int, value: float, low: float, high: float, *, filled: bool = False, marker: str = "o",
    colour: str = MEASURED,
) -> None:  # fmt: skip
    axes.plot([low, high], [place, place], color=colour, linewidth=1.6, solid_capstyle="butt")
    axes.plot(value, place, marker=marker, markersize=6, color=colour, markerfacecolor=colour if filled else "white")


def _names(axes: Axes, names: Sequence[str]) -> None:
    axes.set_xscale("log")
    _plain_ticks(axes.xaxis)
    axes.set_yticks(range(len(names)), labels=names)
    axes.set_ylim(len(names) - 0.4, -1.1)
    axes.grid(axis="x", which="both", color=GRID, linewidth=0.5)
    axes.set_axisbelow(True)


# --------------------------------------------------------------------------------------------------------- roofline


@dataclass(frozen=True)
class Roof:
    """What a device could do: multiply-accumulates and bytes a second."""

    name: str
    peak_macs: float
    bytes_per_s: float


@dataclass(frozen=True)
class RooflinePoint:
    """A way of doing the work."""

    name: str
    macs_per_byte: float
    macs_per_s: float | None
    """what is reached, or None: only its place is drawn"""


@_styled
def plot_roofline(roofs: Sequence[Roof], points: Sequence[RooflinePoint]) -> Figure:
    """Attainable multiply-accumulates a second against multiply-accumulates for each byte moved."""
    figure = _figure(5.4)
    axes = figure.add_subplot()
    x = np.geomspace(0.1, 300, 400)
    axes.set_xscale("log")
    axes.set_yscale("log")
    for k, roof in enumerate(roofs):
        y = np.minimum(roof.peak_macs, x * roof.bytes_per_s) / 1e9
        axes.plot(x, y, color="#555555", linewidth=1.2, linestyle=_STYLES[k % len(_STYLES)])
    for roof, height in zip(roofs, _apart([roof.peak_macs / 1e9 for roof in roofs], 1.35), strict=True):
        axes.annotate(roof.name, (300, height), xytext=(4, 0), textcoords="offset points", va="center", fontsize=8)
    for point in points:
        axes.axvline(point.macs_per_byte, color=GENERATED, linewidth=0.9, linestyle="--")
        axes.annotate(
            point.name, (point.macs_per_byte, 0.98), xycoords=("data", "axes fraction"), xytext=(-3, 0),
            textcoords="offset points", rotation=90, va="top", ha="right", fontsize=8, backgroundcolor="white",
            zorder=1,
        )  # fmt: skip
        if point.macs_per_s is not None:
            axes.plot(point.macs_per_byte, point.macs_per_s / 1e9, marker="D", markersize=7, color=GENERATED,
                      markeredgecolor="black")  # fmt: skip
    axes.set_xlim(0.1, 300)
    for axis in (axes.xaxis, axes.yaxis):
        _plain_ticks(axis)
    axes.grid(which="major", color=GRID, linewidth=0.5)
    axes.set_axisbelow(True)
    axes.set_xlabel("multiply-accumulates for each byte moved")
    axes.set_ylabel("10^9 multiply-accumulates a second")
    return figure


def _apart(heights: Sequence[float], factor: float) -> list[float]:
    """Ascending heights of labels on a logarithmic axis, pushed up so that none covers the one below."""
    found: list[float] = []
    for height in heights:
        found.append(max(height, found[-1] * factor) if found else height)
    return found


# ----------------------------------------------------------------------------------------------------------- Pareto


def pareto_rows() -> tuple[list[dict[str, Any]], list[str]]:
    """Measured accuracy of each method beside its work (``power/measurements/pareto.csv``), and the file's comments."""
    lines = packaged("measurements", "pareto.csv").read_text(encoding="utf-8").splitlines()
    comments = [line.lstrip("# ") for line in lines if line.startswith("#")]
    rows: list[dict[str, Any]] = []
    for row in csv.DictReader(line for line in lines if not line.startswith("#")):
        rows.append({k: v if k == "method" else float(v) for k, v in row.items()})
    front = [r for r in rows if not any(_beats(other, r) for other in rows)]
    return [{**r, "on_the_front": r in front} for r in rows], comments


def _beats(one: dict[str, Any], other: dict[str, Any]) -> bool:
    """No worse in work and accuracy, better in one."""
    keys = ("multiply_adds", "chamfer")
    return all(one[k] <= other[k] for k in keys) and any(one[k] < other[k] for k in keys)


@_styled
def plot_pareto(rows: Sequence[dict[str, Any]]) -> Figure:
    """Chamfer distance against multiply-adds of a window; the front is filled and joined."""
    figure = _figure(3.4)
    axes = figure.add_subplot()
    front = sorted((r for r in rows if r["on_the_front"]), key=lambda r: float(r["multiply_adds"]))
    axes.plot([r["multiply_adds"] for r in front], [r["chamfer"] for r in front], color=GENERATED, linewidth=1.2)
    for r in rows:
        axes.plot([r["multiply_adds"]] * 2, [r["chamfer_low"], r["chamfer_high"]], color="#555555", linewidth=1)
        axes.plot(r["multiply_adds"], r["chamfer"], marker="o", color=MEASURED,
                  markerfacecolor=MEASURED if r["on_the_front"] else "white")  # fmt: skip
        axes.annotate(r["method"], (r["multiply_adds"], r["chamfer"]), xytext=(6, 3), textcoords="offset points",
                      fontsize=8.5)  # fmt: skip
    axes.set_xlim(-3, 110)
    axes.grid(color=GRID, linewidth=0.5)
    axes.set_axisbelow(True)
    axes.set_xlabel("multiply-adds of a window and network, executed; filled and joined: the front")
    axes.set_ylabel("Chamfer distance / valid-mean's")
    return figure
