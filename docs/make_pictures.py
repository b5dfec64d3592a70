"""Makes the pictures of README.md and docs/accuracy.md.

``.venv/bin/python docs/make_pictures.py`` draws them all: range images and a cloud of simulated frames, and the Pareto
front from the measured figures in ``power/measurements/pareto.csv``. ``--measured FILE.json ...`` first takes these
figures anew from what ``upbeam evaluate --json`` printed; ``power/measurements/pareto.csv`` begins with the commands.
"""

from __future__ import annotations

import argparse
import csv
import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import upbeam
from upbeam.hw_sim import simulate_frames
from upbeam.model.beams import beam_table
from upbeam.model.geometry import to_metres, to_points
from upbeam.power.report import Panel, plot_close_up, plot_range_images

FOLDER = Path(__file__).with_name("images")
FIGURES = Path(__file__).parents[1] / "power" / "measurements" / "pareto.csv"
SEED = 11
SIMPLE = ("valid-mean", "edge-aware")
"""Methods without a network, drawn at 0 multiply-adds."""
METRICS = {"chamfer": "chamfer_m2", "mae": "mae_m"}
TITLES = {"chamfer": "Chamfer distance", "mae": "mean absolute error"}
COMMANDS = """\
# KITTI, 26 frames, ring rows: ratios to valid-mean with 95 % intervals over frames. Measured with
#   for h in 4 6; do upbeam train --recipe hidden-$h --out build/accuracy/hidden-$h.ubm; done
#   upbeam train --recipe paper-ring --out build/accuracy/paper-ring.ubm
#   upbeam evaluate $UPBEAM_DATA/kitti/frames --with quant/models/hdl-64e-8.ubm --with build/accuracy/hidden-4.ubm \\
#     --with build/accuracy/hidden-6.ubm --with build/accuracy/paper-ring.ubm --json > build/accuracy/pareto.json
#   .venv/bin/python docs/make_pictures.py --measured build/accuracy/pareto.json
"""


@dataclass(frozen=True)
class Point:
    """A method's cost and its ratios to valid-mean."""

    method: str
    multiply_adds: int
    """Per window, as executed: folded."""
    frames: int
    chamfer: float
    chamfer_low: float
    chamfer_high: float
    mae: float
    mae_low: float
    mae_high: float


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--measured", nargs="+", type=Path, default=[], metavar="FILE.json")
    measured: list[Path] = parser.parse_args(arguments).measured
    if measured:
        write_points(FIGURES, [point for path in measured for point in points_of(json.loads(path.read_text()))])
    draw_pareto(FOLDER / "pareto.png", read_points(FIGURES))
    draw_example()


def draw_example() -> None:
    model = upbeam.load_model()
    (scan,) = simulate_frames(beam_table("hdl-64e"), columns=model.columns, frames=1, seed=SEED, scene="suburb")
    distance, intensity = upbeam.Upsampler(model)(scan.distance[::2], scan.intensity[::2])
    images = (
        ("in: 32 beams (simulated)", scan.distance[::2]),
        ("out: 64 rows", distance),
        ("what a 64-beam sensor would have seen", scan.distance),
    )
    panels = [Panel(title, to_metres(image, model.distance_unit_m)) for title, image in images]
    (FOLDER / "range_images.png").write_bytes(plot_range_images(panels, half_angle_deg=60))
    rules = model.rules
    points, row, _ = to_points(
        distance, intensity, rules.row_elevation_deg, rules.distance_unit_m, rules.cut_deg, rules.row_height_m
    )
    made = upbeam.generated_rows()[row]
    xyz = points[:, :3].astype(np.float64)
    (FOLDER / "cloud.png").write_bytes(plot_close_up(xyz[~made], xyz[made]))


# ---------------------------------------------------------------------------------------------------- Pareto front


def points_of(evaluation: dict[str, Any]) -> Iterator[Point]:
    """Of one ``upbeam evaluate --json``: the simple methods, then every model in it."""
    models = evaluation["models"]
    for method in (*SIMPLE, *models):
        work = models[method]["multiply_adds_per_window"] if method in models else 0
        ratios = [evaluation["ratio"][method][key] for key in METRICS.values()]
        ends = [ratio[end] for ratio in ratios for end in ("value", "low", "high")]
        yield Point(method, work, evaluation["frames"], *ends)


def write_points(path: Path, points: Sequence[Point]) -> None:
    """Each method once: the simple ones stand in every evaluation."""
    once = {point.method: point for point in points}
    if len({point.frames for point in once.values()}) != 1:
        raise SystemExit("the evaluations are of different numbers of frames: their ratios cannot stand side by side")
    with path.open("w", newline="", encoding="utf-8") as file:
        file.write(COMMANDS)
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow([field.name for field in fields(Point)])
        for point in once.values():
            writer.writerow([f"{v:.4f}" if isinstance(v, float) else v for v in asdict(point).values()])


def read_points(path: Path) -> list[Point]:
    lines = [line for line in path.read_text(encoding="utf-8").splitlines() if not line.startswith("#")]
    points = []
    for row in csv.DictReader(lines):
        numbers = [float(row[field.name]) for field in fields(Point)[3:]]
        points.append(Point(row["method"], int(row["multiply_adds"]), int(row["frames"]), *numbers))
    return points


def draw_pareto(path: Path, points: Sequence[Point]) -> None:
    style = {"font.family": "DejaVu Sans", "font.size": 9.5, "axes.spines.top": False, "axes.spines.right": False}
    with rc_context(style):
        figure = Figure(figsize=(11, 4.2), dpi=130, layout="constrained", facecolor="white")
        for axes, metric in zip(figure.subplots(1, 2), METRICS, strict=True):
            _draw_metric(axes, metric, points)
        figure.suptitle(f"{points[0].frames} KITTI frames, generated rows, bars: 95 % over frames (measured)", x=0.27)
        figure.savefig(path, metadata={"Software": None})


def _draw_metric(axes: Axes, metric: str, points: Sequence[Point]) -> None:
    kinds = {
        "no network": ("s", "#1b1b1b", [p for p in points if p.method in SIMPLE]),
        "ours by hidden units, trained on the simulator": ("o", "#e8710a", [p for p in points if _ours(p)]),
        "the paper's network, trained on 16 of these frames": ("D", "#4c78a8", [p for p in points if _papers(p)]),
    }
    for label, (marker, colour, chosen) in kinds.items():
        chosen = sorted(chosen, key=lambda point: point.multiply_adds)
        x = [point.multiply_adds for point in chosen]
        y = np.array([[getattr(p, f"{metric}{end}") for p in chosen] for end in ("", "_low", "_high")])
        axes.errorbar(x, y[0], [y[0] - y[1], y[2] - y[0]], fmt=marker, color=colour, capsize=4, label=label)
        if label.startswith("ours"):
            axes.plot(x, y[0], color=colour, linewidth=0.8, alpha=0.5)
        for point, value, low in zip(chosen, y[0], y[1], strict=True):
            below = _ours(point)  # where no other point's bar is
            place, shift = (low, (0, -14)) if below else (value, (8, -13 if point.method == "edge-aware" else 5))
            where = {"xytext": shift, "textcoords": "offset points", "ha": "center" if below else "left"}
            axes.annotate(_name(point), (point.multiply_adds, place), **where)
    axes.axhline(1, color="#9aa0a6", linewidth=0.8, linestyle="--", zorder=0)
    axes.set(title=TITLES[metric], xlabel="multiply-adds per window (folded)", ylabel="ratio to valid-mean")
    axes.set_xlim(-6, 128)
    axes.margins(y=0.1)
    axes.set_xticks([0, *sorted({point.multiply_adds for point in points if point.multiply_adds})])
    axes.grid(axis="y", color="#d9d9d9", linewidth=0.5)
    if metric == "chamfer":
        axes.legend(frameon=False, fontsize=8.5, loc="best")


def _papers(point: Point) -> bool:
    return point.method.startswith("paper")


def _ours(point: Point) -> bool:
    return point.method not in SIMPLE and not _papers(point)


def _name(point: Point) -> str:
    """Ours by their hidden units: 8 multiply-adds each."""
    return str(point.multiply_adds // 8) if _ours(point) else point.method


if __name__ == "__main__":
    main()
