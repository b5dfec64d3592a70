"""What ``upbeam quantize --report`` writes: tables and pictures as one HTML file and PNGs, the figures as JSON."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from upbeam.model.frames import Frame
from upbeam.model.geometry import to_metres
from upbeam.model.rules import Rules, extract_windows
from upbeam.power.pictures import Panel, plot_range_images
from upbeam.power.quant_pictures import ErrorSample, plot_error_growth, plot_log_error_maps
from upbeam.power.report import Picture, page_template
from upbeam.quant.accuracy import Errors, Variant, float_variant, generate
from upbeam.quant.ubm import ModelFile

from .evaluate import Table
from .quantize import PEER

if TYPE_CHECKING:
    from .quantize import Result

__all__ = ["write_quantize_report"]

FloatArray = NDArray[np.float64]


def write_quantize_report(folder: Path, result: Result, summary: Mapping[str, Any], tables: list[Table]) -> Path:
    """Writes ``quantize.html``, ``quantize.json`` (``summary``) and the pictures into ``folder``; gives the HTML's
    path."""
    pictures = _pictures(result)
    html = page_template("evaluate.html").render(
        command="quantize",
        title=f"{result.file.rules.sensor}: {result.judged.text}",
        lead="Integer networks beside the float ones they were made of. All figures are measured on these frames.",
        tables=tables,
        pictures=list(pictures.values()),
    )
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "quantize.md").write_text("\n".join(map(_markdown, tables)), encoding="utf-8")
    (folder / "quantize.json").write_text(json.dumps(summary, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    for name, picture in pictures.items():
        (folder / f"{name}.png").write_bytes(picture.png)
    path = folder / "quantize.html"
    path.write_text(html, encoding="utf-8")
    return path


def _markdown(part: Table) -> str:
    """For documentation."""
    head = [part.columns, ["---"] * len(part.columns)]
    lines = ["| " + " | ".join(row) + " |" for row in (*head, *part.rows)]
    return "\n".join([f"**{part.title}**", "", *lines, ""])


def _pictures(result: Result) -> dict[str, Picture]:
    """By the name of their file."""
    frame, rules = result.judged.frames[0], result.file.rules
    shown = _shown(result)
    samples = [_sample(name, result.comparison.errors[name]) for name in shown]
    return {
        "error_map": Picture(
            f"Where the error lies, frame {frame.name}",
            plot_log_error_maps(_error_panels(frame, result.file, shown), cut_deg=rules.cut_deg),
            "Generated points less those of the float networks. Grey: one of the two generates nothing.",
        ),
        "error_growth": Picture(
            "What the error grows with, all frames",
            plot_error_growth(samples),
            "The block code is exact where a window's returns differ little, else it keeps eight bits.",
        ),
        "distance": Picture(
            f"Frame {frame.name}, distances",
            plot_range_images(_distance_panels(frame, result.file, shown), "distance", cut_deg=rules.cut_deg),
            "Generated rows.",
        ),
    }


def _shown(result: Result) -> dict[str, Variant]:
    """Ours, and of the peers the one that is nearest to float."""
    means = {name: s.mean_mm for name, s in result.comparison.summaries().items()}
    peers = sorted((name for name in means if name.startswith(PEER)), key=means.__getitem__)
    return {name: variant for name, variant in result.shown.items() if name not in peers[1:]}


def _generated(frame: Frame, file: ModelFile, variants: Mapping[str, Variant]) -> dict[str, NDArray[np.uint16]]:
    """Float's rows first."""
    windows = extract_windows(frame.distance[frame.given], frame.intensity[frame.given], file.rules)
    every = {"float": float_variant(file.folded, file.rules.distance_unit_m), **variants}
    return {name: generate(variant, windows, file.rules)[0] for name, variant in every.items()}


def _error_panels(frame: Frame, file: ModelFile, variants: Mapping[str, Variant]) -> list[Panel]:
    made = _generated(frame, file, variants)
    exact = made.pop("float")
    return [Panel(f"{name} less float", _error_mm(exact, rows, file.rules)) for name, rows in made.items()]


def _error_mm(exact: NDArray[np.uint16], made: NDArray[np.uint16], rules: Rules) -> FloatArray:
    error = np.abs(made.astype(np.float64) - exact) * (1000 * rules.distance_unit_m)
    return np.where((exact > 0) & (made > 0), error, np.nan)


def _distance_panels(frame: Frame, file: ModelFile, variants: Mapping[str, Variant]) -> list[Panel]:
    return [
        Panel(name, to_metres(rows, file.rules.distance_unit_m))
        for name, rows in _generated(frame, file, variants).items()
    ]


def _sample(name: str, errors: Errors) -> ErrorSample:
    both, unit = errors.both, errors.unit_m
    return ErrorSample(
        name,
        np.abs(errors.error_counts[both]) * (1000 * unit),
        errors.range_counts[both].astype(np.float64) * unit,
        errors.spread_counts[both].astype(np.float64) * unit,
    )
