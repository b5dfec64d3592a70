"""``upbeam upsample``: one recorded frame in, the upsampled one out."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray

from upbeam.model.frames import RowRule, image_of_cloud
from upbeam.model.geometry import to_counts, to_metres, to_points
from upbeam.model.io import CloudError, RangeArrays, read_cloud, read_npy, write_bin, write_npz, write_pcd, write_ply
from upbeam.model.rules import BEAMS, ROWS
from upbeam.runtime.upsampler import BACKENDS, PRECISIONS, Model, Upsampler, generated_rows, load_model

from .common import JsonOption, UserError, emit_json, message

__all__ = ["upsample"]

FORMATS = (".npz", ".bin", ".ply", ".pcd")
F32 = NDArray[np.float32]


def upsample(
    source: Annotated[Path, typer.Argument(metavar="IN", help=".bin, .ply or .pcd cloud, or .npy/.npz range image.")],
    output: Annotated[Path, typer.Option("-o", "--output", help=".npz, .bin, .ply or .pcd.")],
    model: Annotated[str | None, typer.Option(help="A .ubm file, or hdl-32e or vlp-32c instead of hdl-64e.")] = None,
    precision: Annotated[str, typer.Option(help=", ".join(PRECISIONS) + ".")] = "fp32",
    backend: Annotated[str, typer.Option(help=", ".join(BACKENDS) + ".")] = "cpu",
    rows: Annotated[
        str, typer.Option(help="How a cloud's points find their rows: ring (file order) or elevation.")
    ] = "ring",
    sensor_only: Annotated[bool, typer.Option(help="Write only what the sensor measured.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Upsample one frame; of 64 rows every other one is the input. Every original point is kept; generated points
    are marked (mask in .npz, property in .ply/.pcd)."""
    if output.suffix not in FORMATS:
        raise UserError(f"{output}: unknown output format, expected one of {' '.join(FORMATS)}")
    if rows not in ("ring", "elevation"):
        raise UserError(f"--rows {rows}: expected ring or elevation")
    loaded = load_model(model)
    frame = _read(source, loaded, "ring" if rows == "ring" else "elevation")
    upsampler = Upsampler(loaded, precision, backend, columns=_other_width(frame, loaded))
    step = 2 if len(frame.distance) == ROWS else 1
    distance, intensity = upsampler(frame.distance[::step], frame.intensity[::step])
    written = _write(output, frame, (distance, intensity), loaded, sensor_only)
    summary = {"input": str(source), "output": str(output), **written, "model_crc32": f"{loaded.crc32:08x}"}
    if as_json:
        emit_json(summary)
    else:
        message(
            f"{output}: {summary['measured']} measured and {summary['generated']} generated points "
            f"from {summary['input_points']} ({source})"
        )


@dataclass(frozen=True)
class _Frame:
    """A range image, and the cloud it came from, if any."""

    distance: NDArray[np.uint16]
    intensity: NDArray[np.uint8]
    cloud: F32 | None


def _read(source: Path, model: Model, rows: RowRule) -> _Frame:
    if source.suffix.lower() in {".npy", ".npz"}:
        arrays = read_npy(source)
        if isinstance(arrays, RangeArrays):
            return _read_image(source, arrays, model)
    cloud = read_cloud(source)
    image = image_of_cloud(cloud, source, model.rules, rows=rows)
    return _Frame(image.distance, image.intensity, cloud.points)


def _read_image(source: Path, arrays: RangeArrays, model: Model) -> _Frame:
    if arrays.distance.shape[0] not in (BEAMS, ROWS):
        raise CloudError(
            source, f"{arrays.distance.shape[0]} rows", "array", f"{BEAMS} rows, or {ROWS} to take every other of"
        )
    counts = _counts(arrays.distance, model)
    intensity = np.zeros(counts.shape, np.uint8) if arrays.intensity is None else arrays.intensity
    return _Frame(counts, intensity, None)


def _counts(distance: NDArray[Any], model: Model) -> NDArray[np.uint16]:
    return distance if distance.dtype == np.uint16 else to_counts(distance, model.distance_unit_m)[0]


def _other_width(frame: _Frame, model: Model) -> int | None:
    width = frame.distance.shape[1]
    return None if width == model.columns else width


def _write(
    output: Path, frame: _Frame, result: tuple[NDArray[np.uint16], NDArray[np.uint8]], model: Model, sensor_only: bool
) -> dict[str, Any]:
    distance, intensity = result
    made = generated_rows()
    if sensor_only:
        distance, intensity = distance.copy(), intensity.copy()
        distance[made], intensity[made] = 0, 0
    if output.suffix == ".npz":
        _write_image(output, distance, intensity, model)
    points, generated = _points(frame, distance, intensity, model)
    writers = {".bin": write_bin, ".ply": write_ply, ".pcd": write_pcd}
    if output.suffix in writers:
        writers[output.suffix](output, points, generated)
    given = len(frame.cloud) if frame.cloud is not None else int((frame.distance > 0).sum())
    return {"input_points": given, "measured": int((~generated).sum()), "generated": int(generated.sum())}


def _write_image(output: Path, distance: NDArray[np.uint16], intensity: NDArray[np.uint8], model: Model) -> None:
    mask = np.broadcast_to(generated_rows()[:, None], distance.shape) & (distance > 0)
    write_npz(
        output,
        distance=to_metres(distance, model.distance_unit_m),
        intensity=intensity,
        counts=distance,
        generated=mask,
        row_elevation_deg=model.rules.row_elevation_deg,
        distance_unit_m=np.float64(model.distance_unit_m),
        cut_deg=np.float64(model.rules.cut_deg),
    )


def _points(
    frame: _Frame, distance: NDArray[np.uint16], intensity: NDArray[np.uint8], model: Model
) -> tuple[F32, NDArray[np.bool_]]:
    """The recording's own points, untouched, then the generated ones. An image without a cloud becomes points, row
    by row."""
    rules = model.rules
    geometry = rules.row_elevation_deg, rules.distance_unit_m, rules.cut_deg, rules.row_height_m
    if frame.cloud is None:
        points, row, _ = to_points(distance, intensity, *geometry)
        return points, generated_rows()[row]
    made = np.where(generated_rows()[:, None], distance, 0).astype(np.uint16)
    extra, _, _ = to_points(made, intensity, *geometry)
    return np.concatenate([frame.cloud, extra]), np.arange(len(frame.cloud) + len(extra)) >= len(frame.cloud)
