"""Where frames come from: the simulator, a folder of recorded ones, a capture. Handed down to training, evaluation and
streams."""

from __future__ import annotations

import csv
import os
from collections.abc import Iterator, Sequence
from functools import lru_cache
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from upbeam.hw_sim import Scan, simulate_frames, simulate_parallel
from upbeam.model.beams import BeamTable
from upbeam.model.frames import Frame, bin_elevation_deg, kitti_files, kitti_frames
from upbeam.model.geometry import bin_elevation, project
from upbeam.model.recipe import BaseRecipe, DataRecipe
from upbeam.model.recordings import Capture, open_capture, training_frames
from upbeam.model.rules import ROWS, Rules

from .common import UserError

__all__ = [
    "describe_source",
    "frame_of_scan",
    "kitti_files_of_drives",
    "may_ship",
    "recipe_frames",
    "recorded_frame_of_scan",
    "simulated_scans",
    "source_frames",
]


def simulated_scans(
    beams: BeamTable,
    *,
    columns: int,
    frames: int,
    seed: int,
    rate_hz: float = 20.0,
    frames_per_scene: int | None = None,
    align: bool = True,
) -> Iterator[Scan]:
    """Simulated turns in order, made by all cores where that is faster than starting them."""
    settings = {
        "columns": columns, "frames": frames, "seed": seed, "rate_hz": rate_hz,
        "frames_per_scene": frames_per_scene, "align": align,
    }  # fmt: skip
    if frames < 16 or (os.cpu_count() or 1) < 2:
        return simulate_frames(beams, **settings)  # type: ignore[arg-type]
    return simulate_parallel(beams, **settings)  # type: ignore[arg-type]


def frame_of_scan(scan: Scan) -> Frame:
    aligned = scan.aligned()
    beams = aligned.beams
    return Frame(
        f"sim-{scan.frame:06d}",
        aligned.distance,
        aligned.intensity,
        aligned.distance_unit_m,
        beams.elevation_deg,
        beams.vertical_offset_m,
        aligned.cut_deg,
        aligned.surface,
    )


def recorded_frame_of_scan(scan: Scan, columns: int, cut_deg: float, *, elevation_rows: bool = False) -> Frame:
    """The scan's points put into an image as a recorded cloud's are: the nearest return wins a pixel.

    By ring, distances are the lasers' own paths; by the paper's elevation bins, distances from the sensor's origin.
    """
    beams, points = scan.beams, scan.points()
    if elevation_rows:
        rows, elevation, heights = bin_elevation(points), bin_elevation_deg(), np.zeros(ROWS)
    else:
        rows, elevation, heights = np.nonzero(scan.distance > 0)[0], beams.elevation_deg, beams.vertical_offset_m
    image = project(points, rows, len(elevation), columns, scan.distance_unit_m, cut_deg, heights)
    surfaces = np.append(scan.surface[scan.distance > 0], np.uint8(0))  # index -1, no return, takes the last
    return Frame(
        f"sim-{scan.frame:06d}",
        image.distance,
        image.intensity,
        scan.distance_unit_m,
        elevation,
        heights,
        image.cut_deg,
        surfaces[image.index],
    )


def source_frames(source: DataRecipe) -> int:
    """How many frames a source gives. Raises CloudError or UserError where a folder or a capture holds none."""
    if source.source == "simulator":
        return source.frames
    if source.source == "kitti":
        return len(_kitti_files(source))
    turns = _capture(source).stats.turns
    return min(turns, source.frames or turns)


def describe_source(source: DataRecipe) -> str:
    """For a model's provenance."""
    if source.source == "simulator":
        how = "" if source.projection == "aligned" else f", projected as recordings are at {source.rate_hz:g} Hz"
        return f"upbeam simulator, {source.frames} frames, seed {source.seed}{how}"
    if source.source == "capture":
        capture = _capture(source)
        ship = "may ship" if source.may_ship else "may not ship"
        return (
            f"capture {capture.path.name} of a {capture.beams.name}, {source_frames(source)} turns, {source.hide} "
            f"beams hidden (licence {source.licence or 'not stated'}; {ship})"
        )
    drives = f", only {', '.join(source.only_drives)}" if source.only_drives else ""
    drives += f", without {', '.join(source.without_drives)}" if source.without_drives else ""
    return f"KITTI-format recordings, {source_frames(source)} frames{drives} (non-commercial licence)"


def may_ship(source: DataRecipe) -> bool:
    """Weights trained on it may be shipped under our licence."""
    return source.source == "simulator" or source.may_ship


def recipe_frames(recipe: BaseRecipe, rules: Rules, sources: tuple[DataRecipe, ...] | None = None) -> Iterator[Frame]:
    """The frames of ``sources``: those a recipe trains on unless told otherwise."""
    for source in recipe.data if sources is None else sources:
        if source.source == "kitti":
            for path in _kitti_files(source):
                yield from kitti_frames(path, rules, rows=recipe.rows)
        elif source.source == "capture":
            width = source.columns or recipe.columns
            frames = training_frames(_capture(source), rules, columns=width, hide=source.hide)
            yield from islice(frames, source.frames or None)
        else:
            yield from _simulated_frames(source, recipe, rules)


def _capture(source: DataRecipe) -> Capture:
    if Path(source.path).suffix.lower() == ".bag":
        raise UserError(f"{source.path}: a ROS 1 bag; rosbags-convert makes a ROS 2 bag of it, whose .db3 is read")
    places = [Path(source.path)]
    if os.environ.get("UPBEAM_DATA") and not places[0].is_absolute():
        places.append(Path(os.environ["UPBEAM_DATA"]) / source.path)
    for place in places:
        if place.is_file():
            return _opened(place.resolve(), place.stat().st_mtime_ns, source.sensor or None)
    raise UserError(f"no capture {' nor '.join(map(str, places))} (a path may begin in the folder UPBEAM_DATA names)")


@lru_cache(maxsize=2)
def _opened(path: Path, changed_ns: int, sensor: str | None) -> Capture:
    """Counting a capture's turns means reading it; ``changed_ns`` tells another file of the same name."""
    return open_capture(path, sensor=sensor)


def _simulated_frames(source: DataRecipe, recipe: BaseRecipe, rules: Rules) -> Iterator[Frame]:
    beams, columns = recipe.simulated_beams(), source.columns or recipe.columns
    same: dict[str, Any] = {"frames": source.frames, "seed": source.seed, "frames_per_scene": source.frames_per_scene}
    if source.projection == "aligned":
        yield from map(frame_of_scan, simulated_scans(beams, columns=columns, **same))
        return
    for scan in simulated_scans(beams, columns=source.firing_columns, rate_hz=source.rate_hz, align=False, **same):
        yield recorded_frame_of_scan(scan, columns, rules.cut_deg, elevation_rows=recipe.rows == "elevation")


def _kitti_files(source: DataRecipe) -> list[Path]:
    """The source's files in name order, of the drives it asks for; at most ``frames`` of them if that is above 0."""
    folder = Path(source.folder) if source.folder else _default_folder()
    files = kitti_files_of_drives(folder, source.only_drives, source.without_drives)
    return files[: source.frames or None]


def kitti_files_of_drives(folder: Path, only: Sequence[str] = (), without: Sequence[str] = ()) -> list[Path]:
    """A folder's files in name order, of the drives of its ``drives.tsv`` that are asked for. Raises UserError for a
    drive it does not name, or where no file is left."""
    files = kitti_files(folder)
    drives = _drives(folder)
    for name in (*only, *without):
        if name not in drives.values():
            raise UserError(f"{folder / 'drives.tsv'}: no frame of drive {name!r}, which was asked for")
    if only:
        files = [path for path in files if drives.get(path.stem) in only]
    files = [path for path in files if drives.get(path.stem) not in without]
    if not files:
        raise UserError(f"{folder}: no frame is left of the drives that were asked for")
    return files


def _default_folder() -> Path:
    data = os.environ.get("UPBEAM_DATA")
    if not data:
        raise UserError("the recipe names no folder of frames: set UPBEAM_DATA to a folder that holds kitti/frames")
    return Path(data) / "kitti" / "frames"


def _drives(folder: Path) -> dict[str, str]:
    """Frame name -> drive, from ``drives.tsv``; frames it does not list are drives of their own."""
    table = folder / "drives.tsv"
    if not table.is_file():
        return {}
    with table.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file, delimiter="\t"))
    if rows and not {"frame", "drive"} <= set(rows[0]):
        raise UserError(f"{table}: expected the columns frame and drive")
    return {row["frame"]: row["drive"] for row in rows}
