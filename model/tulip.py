"""TULIP's protocol: 16 rows in, 64 rows out, 1024 columns, so that its published tables can be read beside ours.

After Yang, Pfreundschuh, Siegwart, Hutter, Moghadam, Patil, "TULIP: Transformer for Upsampling of LiDAR Point Clouds",
CVPR 2024, as its public code evaluates KITTI (``docs/metrics.md`` says what is the same and what is not):

* image: row = round((elevation + 24.8) / (26.8 / 63)), 64 rows from -24.8 to +2.0 degrees, 1024 columns;
* input: rows 0, 4, ..., 60 counted from the bottom; they replace those of the result before points are made;
* generated pixels outside 2 to 80 m become empty; the truth is not limited (KITTI reaches 120 m at most);
* MAE over all 64 x 1024 pixels, no return = 0 m; Chamfer as the mean of squares both ways and voxels of 0.1 m over
  points of all pixels, the empty ones at the origin; voxels anchored at the smallest coordinates of both clouds.

Our networks double rows: they run twice (16 -> 31 -> 61 rows). The three rows above the topmost given one repeat it,
for every method.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from .baselines import Method
from .evaluate import with_limits
from .frames import Frame, kitti_files
from .geometry import elevation_deg, project, to_points
from .io import CloudError, read_cloud
from .metrics import VOXEL_M, chamfer_origin_m2, voxel_overlap
from .rules import Rules

__all__ = ["COLUMNS", "TulipMetrics", "evaluate_tulip", "tulip_frames", "tulip_rows", "tulip_rules", "upsample_4x"]

COLUMNS = 1024
ROWS = 64
FACTOR = 4
BOTTOM_DEG, SPAN_DEG = -24.8, 26.8
MIN_M, MAX_M, FARTHEST_M = 2.0, 80.0, 120.0
ELEVATION_DEG = BOTTOM_DEG + SPAN_DEG * np.arange(ROWS)[::-1] / (ROWS - 1)
"""[64] of the rows, top first as everywhere here (TULIP counts them from the bottom)."""
GIVEN = slice(FACTOR - 1, None, FACTOR)
"""Rows 0, 4, ..., 60 from the bottom, counted from the top."""

U16 = NDArray[np.uint16]
U8 = NDArray[np.uint8]
FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class TulipMetrics:
    """One method on one frame."""

    mae_all_m: float
    """metres; over all pixels, given rows included (there our error is 0)"""
    chamfer_origin_m2: float
    voxel_iou: float
    voxel_precision: float
    voxel_recall: float
    voxel_f1: float

    def as_dict(self) -> dict[str, float]:
        return asdict(self)


def tulip_rules(rules: Rules) -> Rules:
    """The limits of the protocol: 2 to 80 m."""
    low, high = (int(np.floor(limit / rules.distance_unit_m + 0.5)) for limit in (MIN_M, MAX_M))
    return with_limits(rules, low, min(65535, high))


def tulip_rows(points: NDArray[Any]) -> NDArray[np.int64]:
    """Row of each of ``points[N, 3 or more]``, 0 = top; -1 outside the image."""
    from_bottom = np.rint((elevation_deg(points) - BOTTOM_DEG) * (ROWS - 1) / SPAN_DEG).astype(np.int64)
    return np.where((from_bottom >= 0) & (from_bottom < ROWS), ROWS - 1 - from_bottom, -1)


def tulip_frames(folder: str | Path, rules: Rules) -> Iterator[Frame]:
    """Every ``.bin`` file of a folder as a 64 x 1024 image. Raises CloudError naming the file."""
    for path in kitti_files(folder):
        points = read_cloud(path).points
        try:
            near = points[np.linalg.norm(points[:, :3], axis=1) <= FARTHEST_M]
            image = project(near, tulip_rows(near), ROWS, COLUMNS, rules.distance_unit_m)
        except ValueError as error:
            raise CloudError(path, str(error), "points", "a KITTI frame") from None
        yield Frame(path.stem, image.distance, image.intensity, rules.distance_unit_m, ELEVATION_DEG, np.zeros(ROWS))


def upsample_4x(method: Method, distance: U16, intensity: U8, rules: Rules) -> tuple[U16, U8]:
    """Given rows ``[16, W]`` -> ``[64, W]``: the method twice, given rows kept to the bit, the top one repeated."""
    d, i = _double(method, *_double(method, distance, intensity, rules), rules)
    missing = ((FACTOR - 1, 0), (0, 0))
    return np.pad(d, missing, mode="edge"), np.pad(i, missing, mode="edge")


def _double(method: Method, distance: U16, intensity: U8, rules: Rules) -> tuple[U16, U8]:
    """Rows [B, W] -> [2 B - 1, W]."""
    made = method(distance, intensity, rules)
    out = tuple(np.zeros((2 * len(distance) - 1, distance.shape[1]), x.dtype) for x in (distance, intensity))
    for image, given, between in zip(out, (distance, intensity), made, strict=True):
        image[0::2], image[1::2] = given, between
    return out[0], out[1]


def evaluate_tulip(
    frames: Iterable[Frame],
    methods: Mapping[str, Method],
    rules: Rules,
    on_frame: Callable[[Frame], None] = lambda frame: None,
) -> dict[str, list[TulipMetrics]]:
    """Frames of ``tulip_frames``, rules of ``tulip_rules``; one entry a frame. Raises ValueError for no frames."""
    result: dict[str, list[TulipMetrics]] = {name: [] for name in methods}
    seen = 0
    for frame in frames:
        truth = _points(frame, frame.distance)
        tree = cKDTree(truth)
        for name, method in methods.items():
            made, _ = upsample_4x(method, frame.distance[GIVEN], frame.intensity[GIVEN], rules)
            result[name].append(_compare(frame, made, truth, tree))
        seen += 1
        on_frame(frame)
    if not seen:
        raise ValueError("no frames to evaluate")
    return result


def _points(frame: Frame, distance: U16) -> FloatArray:
    grey = np.zeros(distance.shape, np.uint8)
    points, _, _ = to_points(distance, grey, frame.elevation_deg, frame.distance_unit_m, frame.cut_deg)
    return points[:, :3].astype(np.float64)


def _compare(frame: Frame, made: U16, truth: FloatArray, tree: Any) -> TulipMetrics:
    points = _points(frame, made)
    if not len(points) or not len(truth):
        raise ValueError(f"nothing to compare: frame {frame.name} holds no return")
    error = np.abs(made.astype(np.float64) - frame.distance) * frame.distance_unit_m
    chamfer = chamfer_origin_m2(
        (points, tree.query(points)[0], made.size - len(points)),
        (truth, cKDTree(points).query(truth)[0], made.size - len(truth)),
    )
    made_cloud, true_cloud = (_with_origin(cloud, made.size) for cloud in (points, truth))
    voxels = voxel_overlap(made_cloud, true_cloud, VOXEL_M, np.minimum(made_cloud.min(axis=0), true_cloud.min(axis=0)))
    return TulipMetrics(float(error.mean()), chamfer, voxels.iou, voxels.precision, voxels.recall, voxels.f1)


def _with_origin(points: FloatArray, pixels: int) -> FloatArray:
    """The points, and the origin where some pixel is empty."""
    return points if len(points) == pixels else np.vstack([points, np.zeros((1, 3))])
