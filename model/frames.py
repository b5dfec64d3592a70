"""Frames to train and evaluate on: 64-row range images whose even rows are the input and odd rows the truth."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from .geometry import RangeImage, bin_elevation, project, recover_rings
from .io import CloudError, read_cloud
from .rules import ROWS, Rules

__all__ = ["Frame", "RowRule", "image_of_cloud", "kitti_files", "kitti_frames"]

RowRule = Literal["ring", "elevation"]


@dataclass(frozen=True)
class Frame:
    """A range image with the truth in it, azimuth aligned."""

    name: str
    distance: NDArray[np.uint16]
    """[64, W] counts, 0 = no return"""
    intensity: NDArray[np.uint8]
    """[64, W]"""
    distance_unit_m: float


def kitti_files(folder: str | Path) -> list[Path]:
    """A ``.bin`` file, or those of a folder in name order. Raises CloudError where there are none."""
    path = Path(folder)
    files = [path] if path.is_file() else sorted(path.glob("*.bin"))
    if not files:
        raise CloudError(path, "no .bin frames", "folder", "a file or a folder of KITTI .bin files")
    return files


def image_of_cloud(
    points: NDArray[np.float32], where: str | Path, rules: Rules, *, columns: int | None = None, rows: RowRule = "ring"
) -> RangeImage:
    """A 64-row image of a cloud stored laser by laser (``ring``), or by the paper's elevation bins (``elevation``).

    Of rings, distances are the lasers' own paths, as the sensor's packets would give them; of elevation bins, distances from the
    sensor's origin, as the paper's. Raises CloudError naming ``where``.
    """
    try:
        index = recover_rings(points, ROWS) if rows == "ring" else bin_elevation(points)
        heights = rules.row_height_m if rows == "ring" else None
        return project(points, index, ROWS, columns or rules.columns, rules.distance_unit_m, rules.cut_deg, heights)
    except CloudError:
        raise
    except ValueError as error:
        raise CloudError(where, str(error), "points", "a full 64-beam frame in laser order (or elevation rows)") from None


def kitti_frames(
    folder: str | Path, rules: Rules, *, columns: int | None = None, rows: RowRule = "ring"
) -> Iterator[Frame]:
    """Every frame of a folder of KITTI ``.bin`` files."""
    for path in kitti_files(folder):
        image = image_of_cloud(read_cloud(path).points, path, rules, columns=columns, rows=rows)
        yield Frame(path.stem, image.distance, image.intensity, rules.distance_unit_m)
