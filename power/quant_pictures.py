"""Pictures of what quantisation does: where its error lies, and what it grows with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from numpy.typing import NDArray

from .pictures import GRID, NO_RETURN, Panel, _ahead, _figure, _plain_ticks, _styled

__all__ = ["ErrorSample", "plot_error_growth", "plot_log_error_maps"]

FloatArray = NDArray[np.float64]

_LEAST_MM, _MOST_MM = 1.0, 1000.0
_COLOURS = ("#4c78a8", "#e8710a", "#1b1b1b", "#54a24b", "#b279a2", "#9d755d", "#bab0ac", "#e45756", "#72b7b2")
_LEAST_POINTS = 50
"""A bin with fewer is not drawn: its percentile would be one point's."""


@_styled
def plot_log_error_maps(
    panels: Sequence[Panel], *, half_angle_deg: float = 90.0, cut_deg: float = 180.0, missing: str = "no pair"
) -> Figure:
    """Absolute errors in millimetres, ``image[rows, W]``, one below the other, cropped to the view ahead: white below
    1 mm, black above 1 m, logarithmic between. NaN is grey."""
    figure = _figure(1.6 * len(panels) + 0.5)
    all_axes = np.atleast_1d(figure.subplots(len(panels), 1, sharex=True))
    colours = colormaps["magma_r"].with_extremes(bad=NO_RETURN, under="white")
    for axes, panel in zip(all_axes, panels, strict=True):
        image = np.maximum(panel.image, _LEAST_MM / 2)  # 0 has no logarithm
        azimuth, columns = _ahead(image.shape[1], half_angle_deg, cut_deg)
        drawn = axes.imshow(
            np.ma.masked_invalid(image[:, columns]), cmap=colours, norm=LogNorm(_LEAST_MM, _MOST_MM), aspect="auto",
            interpolation="nearest", extent=(azimuth[0], azimuth[-1], image.shape[0] - 0.5, -0.5),
        )  # fmt: skip
        axes.set_title(panel.title)
        axes.set_ylabel("generated row")
        axes.set_yticks([0, image.shape[0] - 1])
    all_axes[-1].set_xlabel(f"azimuth, degrees to the right of straight ahead (white: below 1 mm; grey: {missing})")
    bar = figure.colorbar(drawn, ax=list(all_axes), pad=0.01, aspect=30, extend="both")
    bar.set_label("|error| against float (mm)")
    bar.set_ticks([1, 10, 100, 1000], labels=["1", "10", "100", "1000"])
    return figure


@dataclass(frozen=True)
class ErrorSample:
    """Absolute errors of one method, with what they may grow with; equal shapes ``[N]``."""

    name: str
    error_mm: FloatArray
    range_m: FloatArray
    spread_m: FloatArray


@_styled
def plot_error_growth(samples: Sequence[ErrorSample]) -> Figure:
    """Mean (solid) and 99th percentile (dashed) of the error over range and over the window's spread, axes
    logarithmic."""
    figure = _figure(4.0)
    left, right = figure.subplots(1, 2, sharey=True)
    ranges, spreads = np.geomspace(3, 80, 13), np.concatenate([[0.0], np.geomspace(0.01, 80, 15)])
    for k, sample in enumerate(samples):
        colour = _COLOURS[k % len(_COLOURS)]
        _draw_growth(left, sample.range_m, sample.error_mm, ranges, colour, sample.name)
        _draw_growth(right, sample.spread_m, sample.error_mm, spreads, colour, sample.name)
    for axes, name in ((left, "range of the point (m)"), (right, "largest difference within the window (m)")):
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.set_xlabel(name)
        axes.grid(which="major", color=GRID, linewidth=0.5)
        axes.set_axisbelow(True)
        _plain_ticks(axes.xaxis)
        _plain_ticks(axes.yaxis)
    left.set_xticks([3, 5, 10, 20, 40, 80])
    left.set_ylabel("|error| against float (mm)")
    left.set_title("By range: mean solid, 99th percentile dashed")
    right.set_title("By how much a window's returns differ")
    figure.legend(*left.get_legend_handles_labels(), loc="outside lower center", ncols=len(samples), frameon=False)
    return figure


def _draw_growth(axes: Axes, x: FloatArray, error: FloatArray, edges: FloatArray, colour: str, name: str) -> None:
    bins = np.digitize(x, edges) - 1
    middle, mean, high = [], [], []
    for k in range(len(edges) - 1):
        found = error[bins == k]
        if len(found) >= _LEAST_POINTS:
            middle.append(np.sqrt(max(edges[k], edges[1] / 2) * edges[k + 1]))
            mean.append(max(found.mean(), _LEAST_MM / 10))
            high.append(max(float(np.percentile(found, 99)), _LEAST_MM / 10))
    axes.plot(middle, mean, color=colour, linewidth=1.6, marker=".", label=name)
    axes.plot(middle, high, color=colour, linewidth=1.0, linestyle="--")
