"""Pictures of runs and of range images, as PNG bytes.

They are readable on paper and without colour: what is measured and what is generated differ in lightness, misses have
a shape of their own, and near is bright.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import wraps
from io import BytesIO
from typing import Any, ParamSpec

import numpy as np
from matplotlib import colormaps, rc_context
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.colors import Colormap, LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.ticker import FuncFormatter, NullFormatter
from numpy.typing import NDArray

__all__ = [
    "Panel",
    "RatioPanel",
    "plot_birds_eye",
    "plot_close_up",
    "plot_error_maps",
    "plot_latency_histogram",
    "plot_range_images",
    "plot_ratios",
    "plot_timeline",
]

FloatArray = NDArray[np.floating[Any]]

WIDTH_IN = 11.0
DPI = 130
MEASURED = "#1b1b1b"
GENERATED = "#e8710a"
GRID = "#d9d9d9"
NO_RETURN = "#9aa0a6"
_NEAR_M, _FAR_M = 3.0, 80.0
_FAR_RATIO = 3.0
_STYLE: dict[Any, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 9.5,
    "axes.titlesize": 10.5,
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#555555",
}


def _figure(height_in: float) -> Figure:
    return Figure(figsize=(WIDTH_IN, height_in), dpi=DPI, layout="constrained", facecolor="white")


def _png(figure: Figure) -> bytes:
    buffer = BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": None})
    return buffer.getvalue()


P = ParamSpec("P")


def _styled(draw: Callable[P, Figure]) -> Callable[P, bytes]:
    """Draws with this module's style, leaves the caller's alone, and gives the PNG."""

    @wraps(draw)
    def styled(*args: P.args, **kwargs: P.kwargs) -> bytes:
        with rc_context(_STYLE):
            return _png(draw(*args, **kwargs))

    return styled


# ------------------------------------------------------------------------------------------------------- latency


@_styled
def plot_latency_histogram(latencies_ms: Sequence[float], deadline_ms: float, label: str = "measured") -> Figure:
    """How often each latency occurred, both axes logarithmic, up to the deadline.

    ``label``: measured, simulated or modelled.
    """
    values = np.maximum(np.asarray(latencies_ms, dtype=np.float64), 1e-4)
    figure = _figure(2.9)
    axes = figure.add_subplot()
    low = values.min() * 0.3 if values.size else deadline_ms / 1000
    high = max(deadline_ms * 1.6, values.max() * 1.2 if values.size else 0.0)
    if values.size:
        axes.hist(values, bins=list(np.geomspace(low, high, 90)), color="#4c78a8", edgecolor="#1f3a57", linewidth=0.4)
        _mark_quantiles(axes, values, high)
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_ylim(0.7, max(10.0, values.size * 1.6))
    axes.set_xlim(low, high)
    axes.grid(axis="x", which="both", color=GRID, linewidth=0.5)
    axes.set_axisbelow(True)
    _mark(axes, deadline_ms, f"deadline {deadline_ms:g} ms", "-")
    _plain_ticks(axes.xaxis)
    _plain_ticks(axes.yaxis)
    axes.set_xlabel("latency of a frame, last input column received to last output column complete (ms)")
    axes.set_ylabel("frames")
    axes.set_title(f"Latency of {values.size} frames ({label})")
    return figure


def _plain_ticks(axis: Axis) -> None:
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def _mark(axes: Axes, x: float, text: str, style: str, side: str = "right", height: float = 0.97) -> None:
    axes.axvline(x, color="black", linewidth=1.2, linestyle=style)
    axes.annotate(
        text,
        (x, height),
        xycoords=("data", "axes fraction"),
        xytext=(-4 if side == "right" else 4, 0),
        textcoords="offset points",
        ha=side,
        va="top",
        fontsize=9,
        bbox={"facecolor": "white", "edgecolor": "none", "pad": 1.0, "alpha": 0.85},
    )


def _mark_quantiles(axes: Axes, values: FloatArray, high: float) -> None:
    ranked = np.sort(values)
    p50, p99 = (float(ranked[-(-n * len(ranked) // 100) - 1]) for n in (50, 99))
    _mark(axes, p50, f"p50 {p50:.3g} ms", ":", side="right", height=0.97)
    _mark(axes, p99, f"p99 {p99:.3g} ms", "--", side="left" if p99 < high / 10 else "right", height=0.8)


@_styled
def plot_timeline(
    ledger: Sequence[dict[str, Any]], deadline_ms: float, stalls: Sequence[dict[str, Any]], label: str = "measured"
) -> Figure:
    """Latency frame by frame with the deadline, and below it the machine's stalls at the time they happened.

    ``ledger`` and ``stalls`` as in ``upbeam.runtime.live.LiveResult``.
    """
    figure = _figure(3.9)
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
    _draw_verdicts(upper, ledger)
    upper.axhline(deadline_ms, color="black", linewidth=1.2)
    upper.annotate(
        f"deadline {deadline_ms:g} ms", (1.0, deadline_ms), xycoords=("axes fraction", "data"), xytext=(-3, -4),
        textcoords="offset points", ha="right", va="top", fontsize=9,
    )  # fmt: skip
    upper.set_yscale("log")
    latencies = [max(r["latency_ns"] / 1e6, 1e-4) for r in ledger]
    upper.set_ylim(min([*latencies, deadline_ms]) * 0.6, max([*latencies, deadline_ms]) * 3)
    upper.grid(axis="y", color=GRID, linewidth=0.5)
    _plain_ticks(upper.yaxis)
    upper.set_ylabel("latency (ms)")
    upper.set_title(f"Frame by frame ({label})")
    if ledger:
        upper.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=3, fontsize=8.5, frameon=False)
    _draw_stalls(lower, stalls)
    lower.set_xlabel("time since the start of the run (s)")
    return figure


def _draw_verdicts(axes: Axes, ledger: Sequence[dict[str, Any]]) -> None:
    styles: dict[str, dict[str, Any]] = {
        "met": {"marker": ".", "color": "#4c78a8", "label": "met"},
        "missed": {"marker": "X", "color": "#c0201f", "markersize": 8, "label": "missed"},
        "partial": {"marker": "s", "color": "#555555", "fillstyle": "none", "label": "partial, not judged"},
    }
    for verdict, style in styles.items():
        chosen = [r for r in ledger if r["verdict"] == verdict]
        if chosen:
            seconds = [r["output_ns"] / 1e9 for r in chosen]
            axes.plot(seconds, [max(r["latency_ns"] / 1e6, 1e-4) for r in chosen], linestyle="none", **style)
    for record in (r for r in ledger if r["verdict"] == "missed"):
        axes.annotate(
            f"frame {record['frame']}", (record["output_ns"] / 1e9, record["latency_ns"] / 1e6), xytext=(6, 4),
            textcoords="offset points", fontsize=8.5, annotation_clip=True,
        )  # fmt: skip


def _draw_stalls(axes: Axes, stalls: Sequence[dict[str, Any]]) -> None:
    axes.set_ylabel("stall (ms)")
    axes.grid(axis="y", color=GRID, linewidth=0.5)
    axes.set_axisbelow(True)
    if not stalls:
        axes.set_yticks([])
        axes.text(0.5, 0.5, "no stall of the machine recorded", transform=axes.transAxes, ha="center", va="center")
        return
    start = [s["start_ns"] / 1e9 for s in stalls]
    axes.vlines(start, 0, [s["duration_ns"] / 1e6 for s in stalls], color="#444444", linewidth=2)
    axes.set_ylim(bottom=0)


# --------------------------------------------------------------------------------------------------- range images


@dataclass(frozen=True)
class Panel:
    """One image of a stack: ``image[rows, W]``, metres (0 = no return) or intensities 0..255."""

    title: str
    image: NDArray[Any]


@_styled
def plot_range_images(
    panels: Sequence[Panel], kind: str = "distance", *, half_angle_deg: float = 90.0, cut_deg: float = 180.0
) -> Figure:
    """Images one below the other, all as tall as the same field of view, cropped to the view ahead.

    ``kind``: ``distance`` (metres, near is bright, logarithmic) or ``intensity`` (0..255). ``cut_deg``: azimuth where
    column 0 begins. Pixels without a return are grey; in intensities a pixel without a return must be NaN to show so.
    """
    if kind not in ("distance", "intensity"):
        raise ValueError(f"kind is {kind!r}, expected 'distance' or 'intensity'")
    figure = _figure(1.75 * len(panels) + 0.4)
    all_axes = np.atleast_1d(figure.subplots(len(panels), 1, sharex=True))
    colours, norm = _scale(kind)
    for axes, panel in zip(all_axes, panels, strict=True):
        image = np.asarray(panel.image, dtype=np.float64)
        azimuth, columns = _ahead(image.shape[1], half_angle_deg, cut_deg)
        shown = np.ma.masked_invalid(image[:, columns])
        if kind == "distance":
            shown = np.ma.masked_less_equal(shown, 0)
        extent = (azimuth[0], azimuth[-1], image.shape[0] - 0.5, -0.5)
        drawn = axes.imshow(shown, cmap=colours, norm=norm, aspect="auto", interpolation="nearest", extent=extent)
        axes.set_title(panel.title)
        axes.set_ylabel("row")
        axes.set_yticks([0, image.shape[0] // 2, image.shape[0] - 1])
    all_axes[-1].set_xlabel("azimuth, degrees to the right of straight ahead (grey: no return)")
    bar = figure.colorbar(drawn, ax=list(all_axes), pad=0.01, aspect=30)
    bar.set_label("distance (m)" if kind == "distance" else "intensity (0..255)")
    if kind == "distance":
        bar.set_ticks([3, 5, 10, 20, 40, 80], labels=["3", "5", "10", "20", "40", "80"])
        bar.ax.minorticks_off()
        bar.ax.invert_yaxis()
    return figure


def _scale(kind: str) -> tuple[Colormap, Normalize]:
    if kind == "distance":
        return colormaps["inferno_r"].with_extremes(bad=NO_RETURN), LogNorm(_NEAR_M, _FAR_M, clip=True)
    return colormaps["magma"].with_extremes(bad=NO_RETURN), Normalize(0, 160, clip=True)


@_styled
def plot_error_maps(
    panels: Sequence[Panel], *, limit_m: float = 2.0, half_angle_deg: float = 90.0, cut_deg: float = 180.0
) -> Figure:
    """Signed errors one below the other, cropped to the view ahead: ``image[rows, W]``, generated - real in metres.

    NaN, where one of the two is missing, is grey. Errors beyond ``limit_m`` have the darkest colour: what is dark is
    wrong, the hue says which way.
    """
    figure = _figure(1.6 * len(panels) + 0.5)
    all_axes = np.atleast_1d(figure.subplots(len(panels), 1, sharex=True))
    colours = colormaps["PuOr"].with_extremes(bad=NO_RETURN)
    for axes, panel in zip(all_axes, panels, strict=True):
        image = np.asarray(panel.image, dtype=np.float64)
        azimuth, columns = _ahead(image.shape[1], half_angle_deg, cut_deg)
        shown = np.ma.masked_invalid(image[:, columns])
        extent = (azimuth[0], azimuth[-1], image.shape[0] - 0.5, -0.5)
        drawn = axes.imshow(
            shown, cmap=colours, norm=Normalize(-limit_m, limit_m), aspect="auto", interpolation="nearest",
            extent=extent,
        )  # fmt: skip
        axes.set_title(panel.title)
        axes.set_ylabel("judged row")
        axes.set_yticks([0, image.shape[0] - 1])
    all_axes[-1].set_xlabel("azimuth, degrees to the right of straight ahead (grey: no pair)")
    bar = figure.colorbar(drawn, ax=list(all_axes), pad=0.01, aspect=30, extend="both")
    bar.set_label("generated - real (m)")
    return figure


def _ahead(columns: int, half_angle_deg: float, cut_deg: float) -> tuple[FloatArray, NDArray[np.int64]]:
    """Azimuths within the angle, left to right, and their columns."""
    middle = (cut_deg + (np.arange(columns) + 0.5) * 360.0 / columns + 180.0) % 360.0 - 180.0
    order = np.argsort(middle, kind="stable")
    inside = order[np.abs(middle[order]) <= half_angle_deg]
    return middle[inside], inside


# -------------------------------------------------------------------------------------------------------- accuracy


@dataclass(frozen=True)
class RatioPanel:
    """One metric: per method its ratio to the base method and its interval (None: not known). NaN is not drawn."""

    title: str
    methods: Sequence[str]
    values: Sequence[float]
    intervals: Sequence[tuple[float, float] | None]


@_styled
def plot_ratios(panels: Sequence[RatioPanel], base: str) -> Figure:
    """Metrics side by side, methods one below the other: left of the line at 1 is better than the base method.

    A ratio beyond 3 is drawn at the edge, with its value.
    """
    figure = _figure(0.32 * len(panels[0].methods) + 1.2)
    for axes, panel in zip(figure.subplots(1, len(panels), sharey=True, squeeze=False)[0], panels, strict=True):
        axes.axvline(1.0, color="black", linewidth=1.2)
        for place, (value, interval) in enumerate(zip(panel.values, panel.intervals, strict=True)):
            if np.isfinite(value):
                _draw_ratio(axes, place, value, interval)
        axes.set_xlim(0, _FAR_RATIO)
        axes.set_title(panel.title)
        axes.grid(axis="x", color=GRID, linewidth=0.5)
        axes.set_axisbelow(True)
        axes.set_yticks(range(len(panel.methods)), labels=list(panel.methods))
        axes.set_ylim(len(panel.methods) - 0.5, -0.5)
    figure.supxlabel(f"ratio to {base} on the same frames, 95 % intervals over frames", fontsize=9.5)
    return figure


def _draw_ratio(axes: Axes, place: int, value: float, interval: tuple[float, float] | None) -> None:
    if value > _FAR_RATIO:
        axes.annotate(f"{value:.1f} >", (_FAR_RATIO, place), ha="right", va="center", fontsize=8.5)
        return
    if interval is not None:
        axes.hlines(place, *interval, color="#4c78a8", linewidth=3, alpha=0.6)
    axes.plot(value, place, marker="o", markersize=5, color=MEASURED)


# ---------------------------------------------------------------------------------------------------------- clouds


@_styled
def plot_birds_eye(
    measured: FloatArray,
    generated: FloatArray,
    *,
    reach_m: float = 40.0,
    close_up: tuple[float, float, float] | None = None,
) -> Figure:
    """The cloud from above, ahead up. ``measured``, ``generated``: ``[N, 3 or more]``, x ahead, y left, z up, metres.

    Left: all within ``reach_m``. Right: a square ``(x, y, half side)`` of it; without one, where most points stand
    above the ground.
    """
    x, y, half = close_up if close_up is not None else _busiest_square(measured, reach_m)
    figure = _figure(5.6)
    wide, near = figure.subplots(1, 2)
    for axes, size in ((wide, 0.25), (near, 3.0)):
        _scatter(axes, measured, generated, size)
        axes.set_aspect("equal")
        axes.set_xlabel("to the right (m)")
        axes.grid(color=GRID, linewidth=0.5)
        axes.set_axisbelow(True)
    wide.set_xlim(-reach_m, reach_m)
    wide.set_ylim(-reach_m, reach_m)
    wide.add_patch(Rectangle((-y - half, x - half), 2 * half, 2 * half, fill=False, linewidth=1.4, zorder=4))
    wide.plot(0, 0, marker="^", color="white", markeredgecolor="black", markersize=9, zorder=5)
    wide.set_ylabel("ahead (m)")
    wide.set_title(f"From above: {len(measured):,} points measured, {len(generated):,} generated")
    near.set_xlim(-y - half, -y + half)
    near.set_ylim(x - half, x + half)
    near.set_title("The square, closer")
    near.legend(loc="upper right", framealpha=0.95)
    return figure


def _scatter(axes: Axes, measured: FloatArray, generated: FloatArray, size: float) -> None:
    """Both kinds from above, in a random order (the same every time): where they are dense, neither hides the other."""
    points = np.concatenate([measured[:, :2], generated[:, :2]])
    colours = np.repeat([MEASURED, GENERATED], [len(measured), len(generated)])
    order = np.random.default_rng(0).permutation(len(points))
    axes.scatter(-points[order, 1], points[order, 0], s=size, c=colours[order].tolist(), linewidths=0)
    for colour, name in ((MEASURED, "measured"), (GENERATED, "generated")):
        axes.plot([], [], marker="o", markersize=6, linestyle="none", color=colour, label=name)


def _busiest_square(points: FloatArray, reach_m: float, half: float = 7.0) -> tuple[float, float, float]:
    """Middle of the square ahead with the most points above the ground.

    Each is weighted by its distance: near objects have more.
    """
    x, y, z = (np.asarray(points[:, k], dtype=np.float64) for k in range(3))
    above = z > np.percentile(z, 20) + 0.6 if len(z) else np.zeros(0, dtype=bool)
    flat = np.hypot(x, y)
    chosen = above & (x > 0.5 * flat) & (flat > 10) & (flat < min(30.0, reach_m))
    if not chosen.any():
        return reach_m / 3, 0.0, half
    edges = np.arange(-reach_m, reach_m + 4, 4.0)
    count, _, _ = np.histogram2d(x[chosen], y[chosen], bins=(edges, edges), weights=flat[chosen])
    i, j = np.unravel_index(int(np.argmax(count)), count.shape)
    return float(edges[i] + 2), float(edges[j] + 2), half


@_styled
def plot_close_up(
    measured: FloatArray, generated: FloatArray, *, behind_m: float = 7.0, height_m: float = 4.0, down_deg: float = 10.0
) -> Figure:
    """The cloud as seen from behind and above the sensor, looking ahead. Arrays as for ``plot_birds_eye``."""
    figure = _figure(4.6)
    axes = figure.add_subplot()
    for points, colour, name, size in ((generated, GENERATED, "generated", 1.3), (measured, MEASURED, "measured", 1.3)):
        u, v, depth = _project(points, behind_m, height_m, np.radians(down_deg))
        axes.scatter(u, v, s=size * np.clip(14.0 / depth, 0.35, 4.0), color=colour, linewidths=0, label=name)
    axes.set_xlim(-0.85, 0.85)
    axes.set_ylim(-0.42, 0.26)
    axes.set_aspect("equal")
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_visible(False)
    axes.set_title(f"Seen from {behind_m:g} m behind and {height_m:g} m above the sensor")
    axes.legend(loc="upper right", markerscale=5, framealpha=0.95)
    return figure


def _project(points: FloatArray, behind_m: float, height_m: float, down: float) -> tuple[FloatArray, ...]:
    """A pinhole camera that looks ahead and down: image coordinates and depth of the points before it."""
    x = np.asarray(points[:, 0], dtype=np.float64) + behind_m
    z = np.asarray(points[:, 2], dtype=np.float64) - height_m
    depth = x * np.cos(down) - z * np.sin(down)
    up = x * np.sin(down) + z * np.cos(down)
    seen = depth > 2.0
    return -points[seen, 1] / depth[seen], up[seen] / depth[seen], depth[seen]
