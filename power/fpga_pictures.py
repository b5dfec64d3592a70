"""The picture of the FPGA sweep."""

from __future__ import annotations

from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from .fpga_sweep import PARTS, ROUTED, Sweep
from .pictures import GRID, _figure, _styled

__all__ = ["plot_fpga_sweep"]

_MARKS = ("^", "v", "o", "s")
_COLOURS = ("#4c78a8", "#1b1b1b", "#e8710a", "#54a24b")


@_styled
def plot_fpga_sweep(found: Sweep) -> Figure:
    """LUTs against frames per second of every core, both logarithmic: filled where routed, hollow where fitted; each
    part's Pareto front as a line."""
    figure = _figure(4.2)
    axes = figure.add_subplot()
    front = found.front
    for part, mark, colour in zip(PARTS, _MARKS, _COLOURS, strict=True):
        points = [p for p in found.points if p.part == part]
        for routed in (False, True):
            drawn = [p for p in points if (p.luts_label == ROUTED) == routed]
            axes.scatter(
                [p.luts for p in drawn], [p.frames_per_second for p in drawn], s=42 if routed else 14, marker=mark,
                facecolors=colour if routed else "none", edgecolors=colour, linewidths=0.7, zorder=3 if routed else 2,
                label=f"{part}, {'routed' if routed else 'fitted'}" if drawn else None,
            )  # fmt: skip
        best = sorted((p.luts, p.frames_per_second) for p in front if p.part == part)
        axes.plot([x for x, _ in best], [y for _, y in best], color=colour, linewidth=0.8, zorder=1)
    axes.axhline(found.rate_hz, color="#b00020", linewidth=1.0)
    axes.annotate(
        f"{found.rate_hz:g} Hz", (1, found.rate_hz), xycoords=("axes fraction", "data"), ha="right", va="bottom"
    )
    axes.set_xscale("log")
    axes.set_yscale("log")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
        axis.set_minor_formatter(FuncFormatter(lambda x, _: f"{x:g}" if str(f"{x:g}")[0] in "25" else ""))
    axes.grid(color=GRID, linewidth=0.5)
    axes.set_xlabel("LUTs (logic cells)")
    axes.set_ylabel(f"frames of {found.columns} columns a second")
    axes.set_title("FPGA cores, both networks")
    axes.legend(frameon=False, fontsize=8, loc="upper left", ncols=2)
    return figure
