"""Frames to train and evaluate on: 64-row range images whose even rows are the input and odd rows the truth."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from .geometry import GeometryError, IndexArray, RangeImage, bin_elevation, elevation_deg, project, recover_rings
from .io import Cloud, CloudError, read_cloud
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
    cloud: Cloud, where: str | Path, rules: Rules, *, columns: int | None = None, rows: RowRule = "ring"
) -> RangeImage:
    """A 64-row image of a cloud by its rings (the file's own, else from the order of the points), or by the paper's
    elevation bins.

    Of rings, distances are the lasers' own paths, as the sensor's packets would give them; of elevation bins,
    distances from the sensor's origin, as the paper's. Raises CloudError naming ``where``.
    """
    try:
        points = cloud.points
        index = _rings(cloud) if rows == "ring" else bin_elevation(points)
        heights = rules.row_height_m if rows == "ring" else None
        return project(points, index, ROWS, columns or rules.columns, rules.distance_unit_m, rules.cut_deg, heights)
    except CloudError:
        raise
    except ValueError as error:
        raise CloudError(
            where, str(error), "points", "a full 64-beam frame in laser order (or elevation rows)"
        ) from None


def _rings(cloud: Cloud) -> IndexArray:
    """Rows from the top; drivers number rings from either end, so the file's numbers are ranked by elevation."""
    if cloud.ring is None:
        return recover_rings(cloud.points, ROWS)
    numbers, index = np.unique(cloud.ring, return_inverse=True)
    if len(numbers) != ROWS:
        raise GeometryError(f"the file's ring numbers name {len(numbers)} rings, expected {ROWS}")
    elevation = elevation_deg(cloud.points)
    medians = [np.median(elevation[index == ring]) for ring in range(ROWS)]
    rank = np.empty(ROWS, dtype=np.int64)
    rank[np.argsort(medians)[::-1]] = np.arange(ROWS)
    return rank[index]


def kitti_frames(
    folder: str | Path, rules: Rules, *, columns: int | None = None, rows: RowRule = "ring"
) -> Iterator[Frame]:
    """Every frame of a folder of KITTI ``.bin`` files."""
    for path in kitti_files(folder):
        image = image_of_cloud(read_cloud(path), path, rules, columns=columns, rows=rows)
        yield Frame(path.stem, image.distance, image.intensity, rules.distance_unit_m)
