"""What ``upbeam stream --report`` puts into the report: pictures of one frame, counts, the machine."""

from __future__ import annotations

import datetime
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from upbeam.model.baselines import valid_mean
from upbeam.model.geometry import to_metres, to_points
from upbeam.model.metrics import GENERATED, FrameMetrics, compare_rows
from upbeam.power.ops import count_model
from upbeam.power.report import Panel, Picture, plot_birds_eye, plot_close_up, plot_range_images, write_report
from upbeam.runtime.live import LiveImage, LiveResult
from upbeam.runtime.upsampler import Model, generated_rows

from .doctor import environment

__all__ = ["write_stream_report"]

U16 = NDArray[np.uint16]
U8 = NDArray[np.uint8]
Image = tuple[U16, U8]


def write_stream_report(
    folder: Path,
    images: Image,
    truth: Image | None,
    pictured: int,
    model: Model,
    result: LiveResult,
    source: dict[str, str],
) -> Path:
    """``images``: all input frames ``[F, 32, W]``; ``truth``: the 64 real rows of frame ``pictured``, if the source
    has them."""
    image = result.images.get(pictured) or result.last
    shown = image.frame % len(images[0]) if image else 0
    given = images[0][shown], images[1][shown]
    real = truth if shown == pictured else None
    data = {
        "title": f"upbeam stream: {source['source']}",
        "generated_at": datetime.datetime.now(datetime.timezone.utc).isoformat(timespec="seconds"),
        "live": result.to_dict(),
        "operations": _operations(model),
        "memory": _memory(model, result),
        "model": _model(model),
        "source": source,
        "environment": environment(),
        "notes": _notes(given, image, real, model),
    }
    pictures = _pictures(given, image, real, model) if image else []
    return write_report(folder, data, pictures)


def _operations(model: Model) -> dict[str, Any]:
    counts = count_model(model.file, model.columns).as_dict()
    layers = {
        f"{x['graph']} {x['name']}": f"{x['macs_per_window']} MACs, {x['parameters']} parameters"
        for x in counts.pop("layers")
    }
    return {k: v for k, v in counts.items() if not isinstance(v, (dict, list))} | layers


def _memory(model: Model, result: LiveResult) -> dict[str, Any]:
    return {
        "model file (bytes)": len(model.data),
        "weights executed, both networks (bytes)": sum(4 * network.parameters for network in model.file.folded),
        "stream state (bytes)": result.state_bytes,
        "stream memory (bytes)": result.stream_bytes,
        "delay of an output column (columns)": result.delay_columns,
    }


def _model(model: Model) -> dict[str, Any]:
    rules = model.rules
    return {
        "crc32": f"{model.crc32:08x}",
        "sensor": rules.sensor,
        "columns": rules.columns,
        "limits (m)": f"{rules.min_m:g} to {rules.max_m:g}",
        "edge, last row, empty pixels": f"{rules.edge}, {rules.last_row}, {rules.empty}",
        "provenance": model.file.provenance,
    }


def _notes(given: Image, image: LiveImage | None, real: Image | None, model: Model) -> list[str]:
    notes = [
        "Generated rows are estimates between two measured beams, never measurements; every output tells which.",
        "Latency: from the last input column received to the last output column complete, both images. "
        "Under the seam rule a frame's last column waits for the next turn's first packet.",
    ]
    if image is None or real is None:
        return notes
    truth = real[0][GENERATED], real[1][GENERATED]
    ours = compare_rows((image.distance[GENERATED], image.intensity[GENERATED]), truth, model.rules)
    mean = compare_rows(valid_mean(*given, model.rules), truth, model.rules)
    notes.append(
        "The pictured frame against the rows that were hidden (one frame, measured): "
        f"{_accuracy(ours)}; the mean of the valid neighbours: {_accuracy(mean)}."
    )
    return notes


def _accuracy(m: FrameMetrics) -> str:
    return f"Chamfer {m.chamfer_m2:.3f} m2, ghost points {100 * m.ghost_share:.1f} %, MAE {m.mae_m:.3f} m"


def _pictures(given: Image, image: LiveImage, real: Image | None, model: Model) -> list[Picture]:
    unit, cut = model.distance_unit_m, model.rules.cut_deg
    stacks: dict[str, list[NDArray[Any]]] = {
        "distance": [to_metres(given[0], unit), to_metres(image.distance, unit)],
        "intensity": [_grey(*given), _grey(image.distance, image.intensity)],
    }
    if real is not None:
        stacks["distance"].append(to_metres(real[0], unit))
        stacks["intensity"].append(_grey(*real))
    titles = ("the sensor's 32 rows", "upsampled: 64 rows", "the real 64 rows")
    pictures = [
        Picture(f"Frame {image.frame}, {kind}", plot_range_images(_panels(stack, titles), kind, cut_deg=cut), "Ahead.")
        for kind, stack in stacks.items()
    ]
    measured, generated = _clouds(image, model)
    pictures.append(Picture("The cloud from above", plot_birds_eye(measured, generated)))
    pictures.append(Picture("The cloud ahead", plot_close_up(measured, generated)))
    return pictures


def _panels(stack: Sequence[NDArray[Any]], titles: Sequence[str]) -> list[Panel]:
    return [Panel(title, image) for title, image in zip(titles, stack, strict=False)]


def _grey(distance: U16, intensity: U8) -> NDArray[np.float64]:
    return np.where(distance > 0, intensity.astype(np.float64), np.nan)


def _clouds(image: LiveImage, model: Model) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    rules = model.rules
    geometry = rules.row_elevation_deg, rules.distance_unit_m, rules.cut_deg, rules.row_height_m
    points, row, _ = to_points(image.distance, image.intensity, *geometry)
    made = generated_rows()[row]
    xyz = points[:, :3].astype(np.float64)
    return xyz[~made], xyz[made]
