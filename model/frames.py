"""Frames to train and evaluate on: 64-row range images whose even rows are the input and odd rows the truth."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from .geometry import GeometryError, IndexArray, RangeImage, bin_elevation, elevation_deg, project, recover_rings
from .io import Cloud, CloudError, read_cloud
from .rules import ROWS, Rules

__all__ = [
    "Frame",
    "RowRule",
    "bin_elevation_deg",
    "every_other_row",
    "image_of_cloud",
    "in_counts_of",
    "kitti_files",
    "kitti_frames",
]

RowRule = Literal["ring", "elevation"]


@dataclass(frozen=True)
class Frame:
    """A range image with the truth in it, azimuth aligned, of any sensor: R rows, top first, R >= 3.

    Even rows are the input; the truth are the odd rows that lie between two of them. Of an even R the last row is
    never judged.
    """

    name: str
    distance: NDArray[np.uint16]
    """[R, W] counts, 0 = no return"""
    intensity: NDArray[np.uint8]
    """[R, W]"""
    distance_unit_m: float
    elevation_deg: NDArray[np.float64]
    """[R], above the horizon"""
    row_height_m: NDArray[np.float64]
    """[R] height of each row's laser origin over the sensor's"""
    cut_deg: float = 180.0
    """azimuth at which column 0 begins"""
    surface: NDArray[np.uint8] | None = None
    """[R, W] what each return came from, where that is known: the simulator's labels, 0 = no return"""

    def __post_init__(self) -> None:
        shape = self.distance.shape
        if len(shape) != 2 or shape[0] < 3 or self.intensity.shape != shape:
            raise GeometryError(
                f"frame {self.name}: distance {list(shape)} and intensity {list(self.intensity.shape)}, "
                "expected equal shapes [rows, columns] of 3 rows or more"
            )
        for name in ("elevation_deg", "row_height_m"):
            if np.shape(getattr(self, name)) != (shape[0],):
                raise GeometryError(f"frame {self.name}: {name} must be {shape[0]} numbers, one a row")
        if self.surface is not None and self.surface.shape != shape:
            raise GeometryError(f"frame {self.name}: surface {list(self.surface.shape)}, expected {list(shape)}")

    @property
    def rows(self) -> int:
        return int(self.distance.shape[0])

    @property
    def truth(self) -> slice:
        """The rows that are judged: odd ones between two even ones."""
        return slice(1, self.rows - 1 if self.rows % 2 == 0 else self.rows, 2)

    @property
    def given(self) -> slice:
        """The rows that methods see."""
        return slice(0, None, 2)


def every_other_row(frame: Frame) -> Frame:
    """The given rows alone, as a sensor of half the beams would have recorded them."""
    rows = frame.given
    return replace(
        frame,
        distance=frame.distance[rows],
        intensity=frame.intensity[rows],
        elevation_deg=frame.elevation_deg[rows],
        row_height_m=frame.row_height_m[rows],
        surface=None if frame.surface is None else frame.surface[rows],
    )


def in_counts_of(frame: Frame, distance_unit_m: float) -> Frame:
    """The frame with distances in counts of another unit, rounded half up; beyond 65535 there is no return."""
    if frame.distance_unit_m == distance_unit_m:
        return frame
    counts = np.floor(frame.distance * (frame.distance_unit_m / distance_unit_m) + 0.5)
    fits = (counts > 0) & (counts <= 65535)
    return replace(
        frame,
        distance=np.where(fits, counts, 0).astype(np.uint16),
        intensity=np.where(fits, frame.intensity, 0).astype(np.uint8),
        distance_unit_m=distance_unit_m,
        surface=None if frame.surface is None else np.where(fits, frame.surface, 0).astype(np.uint8),
    )


def bin_elevation_deg(top_deg: float = 2.0, bottom_deg: float = -24.9, rows: int = ROWS) -> NDArray[np.float64]:
    """Middles of the rows of ``geometry.bin_elevation``, ``float64[rows]``."""
    return top_deg - (np.arange(rows) + 0.5) * (top_deg - bottom_deg) / rows


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
    """Every frame of a folder of KITTI ``.bin`` files. Of elevation rows, points stand in the middle of their bins."""
    if rows == "ring":
        elevation, height = rules.row_elevation_deg, rules.row_height_m
    else:
        elevation, height = bin_elevation_deg(), np.zeros(ROWS)
    for path in kitti_files(folder):
        image = image_of_cloud(read_cloud(path), path, rules, columns=columns, rows=rows)
        yield Frame(path.stem, image.distance, image.intensity, rules.distance_unit_m, elevation, height, image.cut_deg)
