"""The picture of a benchmark: everybody's time for the same frame."""

from __future__ import annotations

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from upbeam.power.pictures import GRID, _figure, _plain_ticks, _styled

from .bench import Benchmark
from .contest import Entry
from .peers.formulation import NO_RULES
from .tables import short_name

__all__ = ["plot_times"]

_COLOURS = {"ours": "#e8710a", "compiler": "#8c8c8c", "opencl": "#f2b37a"}
_PEER = "#4c78a8"
_LEGEND = {
    "ours": "upbeam on the CPU",
    "opencl": "upbeam OpenCL",
    "compiler": "plain C, compiler",
    "peer": "other runtimes",
}


@_styled
def plot_times(run: Benchmark) -> Figure:
    """One bar for each candidate, fastest first, one thread; a ring where more threads were measured. Bars end at the
    median, the white tick is the minimum. Axis logarithmic."""
    single = sorted((e for e in run.entries if _is_drawn(run, e)), key=lambda e: e.ms_median)
    figure = _figure(0.235 * len(single) + 1.5)
    axes = figure.subplots()
    least = min((e.ms_min for e in run.entries), default=1.0)
    axes.set_xscale("log")
    _plain_ticks(axes.xaxis)
    axes.set_xlim(least / 2, 1.6 * max((e.ms_median for e in run.entries), default=1.0))
    for place, entry in enumerate(single):
        _draw(axes, place, entry, run.entries, least / 2)
    bound = run.peaks.bound("fp32", run.cpu)
    if bound is not None:
        axes.axvline(bound.ns_per_column * run.work.columns / 1e6, color="black", linestyle="--", linewidth=1)
    axes.set_yticks(range(len(single)), labels=[short_name(e.candidate.name) for e in single], fontsize=8)
    axes.set_ylim(len(single) - 0.4, -0.6)
    axes.set_xlabel(
        f"ms for both images of a 32 x {run.work.columns} frame (logarithmic), one thread\nbar: median, white: minimum"
        ", ring: more threads; dashed: port bound of the float kernel.\nWhat each does of the work: see the table."
    )
    axes.grid(axis="x", which="both", color=GRID, linewidth=0.5)
    axes.set_axisbelow(True)
    axes.legend(
        handles=[
            *(Patch(color=_COLOURS.get(key, _PEER), label=text) for key, text in _LEGEND.items()),
            Patch(facecolor="#bbbbbb", edgecolor="white", hatch="////", label="less work: no rules"),
        ],
        loc="upper right", framealpha=0.95,
    )  # fmt: skip
    return figure


def _is_drawn(run: Benchmark, entry: Entry) -> bool:
    """One thread; of our slower instruction sets the kernels only."""
    detail = entry.candidate.detail
    is_minor = entry.candidate.group == "ours" and detail["kind"] != "kernels" and detail["cpu"] != run.cpu
    return entry.candidate.threads == 1 and not is_minor


def _draw(axes: Axes, place: int, entry: Entry, entries: list[Entry], left: float) -> None:
    colour = _COLOURS.get(entry.candidate.group, _PEER)
    hatch = "////" if NO_RULES in entry.candidate.does else None
    axes.barh(
        place, entry.ms_median - left, left=left, color=colour, height=0.78, hatch=hatch, edgecolor="white", linewidth=0
    )
    axes.vlines(entry.ms_min, place - 0.39, place + 0.39, color="white", linewidth=1.6)
    others = [e for e in entries if e.candidate.threads > 1 and _same_way(e, entry)]
    for other in others:
        axes.plot(other.ms_median, place, marker="o", markersize=4, markerfacecolor="white", color="black")
    near = [e.ms_median for e in others if e.ms_median < 2 * entry.ms_median]
    axes.annotate(
        f"{entry.ms_median:.3g}", (max([entry.ms_median, *near]), place), xytext=(5, 0), textcoords="offset points",
        va="center", fontsize=7.5,
    )  # fmt: skip


def _same_way(one: Entry, other: Entry) -> bool:
    """The same formulation: its setting, as the size of tiles, may be another for more threads."""
    a, b = one.candidate, other.candidate
    return (a.group, a.detail.get("family", a.name)) == (b.group, b.detail.get("family", b.name))
