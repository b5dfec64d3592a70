"""What ``upbeam evaluate --report`` writes: tables and pictures of one frame as one HTML file, the figures as JSON."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from upbeam.model.baselines import Method
from upbeam.model.evaluate import BASE, Evaluation, rules_for
from upbeam.model.frames import Frame
from upbeam.model.geometry import to_metres
from upbeam.model.metrics import Truth
from upbeam.model.rules import Rules
from upbeam.power.pictures import Panel, RatioPanel, plot_birds_eye, plot_error_maps, plot_range_images, plot_ratios
from upbeam.power.report import Picture, page_template

from .evaluate import Table

__all__ = ["write_evaluation_report"]

U16 = NDArray[np.uint16]
FloatArray = NDArray[np.float64]
RATIOS = {"chamfer_m2": "Chamfer", "mae_m": "MAE", "mae_both_m": "MAE, both", "ghost_share": "ghosts"}


def write_evaluation_report(
    folder: Path,
    title: str,
    result: Evaluation,
    summary: Mapping[str, Any],
    tables: list[Table],
    frame: Frame,
    methods: Mapping[str, Method],
    rules: Rules,
) -> Path:
    """Writes ``evaluate.html`` and ``evaluate.json`` (``summary``) into ``folder``; gives the HTML's path.

    ``frame``: the one to picture, with each of ``methods``.
    """
    pictures = [_ratio_picture(result), *_frame_pictures(frame, methods, rules_for(frame, rules))]
    html = page_template("evaluate.html").render(title=title, tables=tables, pictures=pictures)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "evaluate.json").write_text(json.dumps(summary, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    path = folder / "evaluate.html"
    path.write_text(html, encoding="utf-8")
    return path


def _ratio_picture(result: Evaluation) -> Picture:
    ratios = {name: values for name, values in result.ratios().items() if name != BASE}
    panels = [
        RatioPanel(
            title,
            list(ratios),
            [values[key].value for values in ratios.values()],
            [
                None if v.low is None or v.high is None else (v.low, v.high)
                for v in (values[key] for values in ratios.values())
            ],
        )
        for key, title in RATIOS.items()
    ]
    return Picture(f"All methods against {BASE}", plot_ratios(panels, BASE), "Left of the line is better.")


def _frame_pictures(frame: Frame, methods: Mapping[str, Method], limits: Rules) -> list[Picture]:
    truth = Truth(frame, limits)
    made = {
        name: method(frame.distance[frame.given], frame.intensity[frame.given], limits)[0]
        for name, method in methods.items()
    }
    unit, cut = frame.distance_unit_m, frame.cut_deg
    shown = slice(0, 2 * truth.distance.shape[0] + 1)
    panels = [
        Panel("given rows", to_metres(frame.distance[frame.given], unit)),
        *(Panel(name, to_metres(_interleaved(frame, d), unit)) for name, d in made.items()),
        Panel("the real rows", to_metres(frame.distance[shown], unit)),
    ]
    errors = [Panel(name, _signed_error(truth, d)) for name, d in made.items()]
    return [
        Picture(f"Frame {frame.name}, distances", plot_range_images(panels, "distance", cut_deg=cut), "Ahead."),
        Picture(f"Frame {frame.name}, errors", plot_error_maps(errors, cut_deg=cut), "Judged rows only."),
        *(
            Picture(f"{name}, from above", plot_birds_eye(truth.given, truth.points_of(d)), f"Frame {frame.name}.")
            for name, d in made.items()
        ),
    ]


def _interleaved(frame: Frame, made: U16) -> U16:
    """Given and generated rows, ``[2 R + 1, W]`` of R generated ones."""
    out = np.zeros((2 * len(made) + 1, made.shape[1]), np.uint16)
    out[0::2] = frame.distance[frame.given]
    out[1::2] = made
    return out


def _signed_error(truth: Truth, made: U16) -> FloatArray:
    error = (made.astype(np.float64) - truth.distance) * truth.frame.distance_unit_m
    return np.where(truth.valid & (made > 0), error, np.nan)
