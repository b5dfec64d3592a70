"""How far generated points are from real ones: every definition in one place (``docs/metrics.md`` gives the sources).

Generated rows are compared with the recorded rows they stand for, both as points at their pixel's centre (same
elevation and azimuth on both sides). The truth is what lies within the range limits; other pixels of it count as no
return. ``d(p, Q)`` is the distance to the nearest point of Q, in metres; *both ways* adds the mean over generated p of
d(p, real) and the mean over real q of d(q, generated).

``Truth`` holds a frame's hidden rows with their KD-tree, so that all methods share it.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from .frames import Frame
from .geometry import to_points
from .rules import ROWS, Rules

__all__ = [
    "BANDS_M",
    "GENERATED",
    "GHOST_DISTANCE_M",
    "HIT_DISTANCE_M",
    "VOXEL_M",
    "CloudMetrics",
    "FrameMetrics",
    "PartMetrics",
    "Prediction",
    "Truth",
    "VoxelOverlap",
    "chamfer_m2",
    "chamfer_origin_m2",
    "compare_rows",
    "voxel_overlap",
]

GHOST_DISTANCE_M = 0.5
"""A generated point farther than this from every real one is a ghost; a real one so far from every generated one is
missed."""
HIT_DISTANCE_M = 0.1
"""Points nearer than this agree, for the precision and recall of points."""
VOXEL_M = 0.1
"""Side of a voxel."""
BANDS_M = ((0.0, 10.0), (10.0, 20.0), (20.0, 40.0), (40.0, 80.0))
"""Range bands: low <= range < high, the last one closed."""
GENERATED = slice(1, -1, 2)
"""Of 64 rows, those a network makes. Row 63 is never scored."""

U16 = NDArray[np.uint16]
U8 = NDArray[np.uint8]
FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]


@dataclass(frozen=True)
class FrameMetrics:
    """One method on one frame, generated rows only. What two nearest-neighbour queries give."""

    chamfer_m2: float
    """mean of squares both ways (the paper's code, TULIP's code)"""
    chamfer_sum_m2: float
    """sum of squares both ways (the paper's Eq. 8 as printed): grows with the number of points"""
    chamfer_m: float
    """mean of distances both ways, not squared"""
    chamfer_origin_m2: float
    """mean of squares both ways over all pixels, each empty one as a point at the sensor's origin: what comes of
    projecting a whole image, as published code does"""
    mae_m: float
    """mean |generated - real| over pixels with a real return; a pixel not generated counts with its full distance"""
    mae_both_m: float
    """the same over pixels where both exist: dropping points cannot buy it"""
    mae_all_m: float
    """the same over all pixels, no return as 0 m on both sides"""
    median_m: float
    """median of the absolute errors that ``mae_m`` averages"""
    ghost_share: float
    """share of generated points with d(p, real) > 0.5 m"""
    missed_share: float
    """share of real points with d(q, generated) > 0.5 m"""
    point_precision: float
    """share of generated points with d(p, real) <= 0.1 m"""
    point_recall: float
    """share of real points with d(q, generated) <= 0.1 m"""
    coverage: float
    """share of real returns whose pixel was generated"""
    intensity_mae: float
    """mean |generated - real| in 8-bit steps, over pixels where both exist"""

    def as_dict(self) -> dict[str, float]:
        return asdict(self)


@dataclass(frozen=True)
class CloudMetrics:
    """What costs more: voxels, and the whole cloud (given rows, which are equal on both sides, and judged rows)."""

    voxel_iou: float
    """voxels of 0.1 m that hold points of both / of either, generated rows only, grid anchored at the origin"""
    voxel_precision: float
    """of the voxels with generated points, the share that holds a real one"""
    voxel_recall: float
    """of the voxels with real points, the share that holds a generated one"""
    voxel_f1: float
    """harmonic mean of the two"""
    cloud_chamfer_m2: float
    cloud_chamfer_sum_m2: float
    cloud_chamfer_m: float
    cloud_chamfer_origin_m2: float
    cloud_voxel_iou: float
    cloud_voxel_precision: float
    cloud_voxel_recall: float
    cloud_voxel_f1: float


@dataclass(frozen=True)
class PartMetrics:
    """One method on a part of a frame: a range band or a kind of surface. NaN where the part holds nothing to judge.

    A real point belongs to the band of its range and to its own label; a generated one to the band of its own range
    and to the label of its nearest real point. Neighbours are searched in the whole frame.
    """

    chamfer_m2: float
    mae_m: float
    mae_both_m: float
    ghost_share: float
    missed_share: float
    coverage: float
    real_points: int


@dataclass(frozen=True)
class VoxelOverlap:
    iou: float
    precision: float
    recall: float
    f1: float


class Truth:
    """The hidden rows of one frame, ready to judge any number of methods."""

    def __init__(self, frame: Frame, rules: Rules) -> None:
        """``rules``: range limits, in counts of the frame's unit. Raises ValueError where nothing is to judge."""
        self.frame = frame
        self._rules = rules
        self.distance, self.intensity = self._within_limits(frame.truth)
        self.valid: BoolArray = self.distance > 0
        if not self.valid.any():
            raise ValueError(f"nothing to compare: the judged rows of frame {frame.name} hold no return")
        self.points = self.points_of(self.distance)
        self.tree = cKDTree(self.points)

    def points_of(self, distance: U16, rows: slice | None = None) -> FloatArray:
        """Points of an image of the judged rows (or of others), ``float64[N, 3]``, in the order of ``nonzero``."""
        rows = self.frame.truth if rows is None else rows
        points, _, _ = to_points(
            distance,
            np.zeros(distance.shape, np.uint8),
            self.frame.elevation_deg[rows],
            self.frame.distance_unit_m,
            self.frame.cut_deg,
            self.frame.row_height_m[rows],
        )
        return points[:, :3].astype(np.float64)

    @property
    def surface(self) -> U8 | None:
        """Label of each real point, ``[N]``, where the frame has labels."""
        labels = self.frame.surface
        return None if labels is None else labels[self.frame.truth][self.valid]

    @cached_property
    def given(self) -> FloatArray:
        """Points of the rows that methods were given, ``[N, 3]``."""
        return self.points_of(self._within_limits(self.frame.given)[0], self.frame.given)

    @cached_property
    def given_tree(self) -> Any:
        return cKDTree(self.given)

    @cached_property
    def to_given(self) -> FloatArray:
        """d(q, given) of each real point."""
        return _nearest(self.given_tree, self.points)[0]

    def _within_limits(self, rows: slice) -> tuple[U16, U8]:
        distance = self.frame.distance[rows]
        valid = self._rules.valid(distance)
        return np.where(valid, distance, 0).astype(np.uint16), self.frame.intensity[rows]


class Prediction:
    """One method's rows against a frame's truth: two nearest-neighbour queries, from which the metrics follow."""

    def __init__(self, truth: Truth, distance: U16, intensity: U8) -> None:
        """Counts and intensities of the judged rows. Raises ValueError for other shapes and for an empty image."""
        if distance.shape != truth.distance.shape or intensity.shape != distance.shape:
            raise ValueError(
                f"generated rows are {list(distance.shape)} and {list(intensity.shape)}, "
                f"expected {list(truth.distance.shape)}"
            )
        self.truth = truth
        self.distance, self.intensity = distance, intensity
        self.made: BoolArray = distance > 0
        if not self.made.any():
            raise ValueError(f"nothing to compare: no point was generated in frame {truth.frame.name}")
        self.points = truth.points_of(distance)
        self.to_real, self.nearest_real = _nearest(truth.tree, self.points)
        self.to_generated, _ = _nearest(cKDTree(self.points), truth.points)
        self.error_m: FloatArray = np.abs(distance.astype(np.float64) - truth.distance) * truth.frame.distance_unit_m

    @cached_property
    def to_given(self) -> FloatArray:
        """d(p, given) of each generated point."""
        return _nearest(self.truth.given_tree, self.points)[0]

    def metrics(self) -> FrameMetrics:
        real, made = self.truth.valid, self.made
        both = made & real
        grey = np.abs(self.intensity.astype(np.float64) - self.truth.intensity)
        return FrameMetrics(
            chamfer_m2=float(np.mean(self.to_real**2) + np.mean(self.to_generated**2)),
            chamfer_sum_m2=float(np.sum(self.to_real**2) + np.sum(self.to_generated**2)),
            chamfer_m=float(np.mean(self.to_real) + np.mean(self.to_generated)),
            chamfer_origin_m2=chamfer_origin_m2(
                (self.points, self.to_real, int(np.count_nonzero(~made))),
                (self.truth.points, self.to_generated, int(np.count_nonzero(~real))),
            ),
            mae_m=_mean(self.error_m[real]),
            mae_both_m=_mean(self.error_m[both]),
            mae_all_m=_mean(self.error_m),
            median_m=float(np.median(self.error_m[real])),
            ghost_share=_mean(self.to_real > GHOST_DISTANCE_M),
            missed_share=_mean(self.to_generated > GHOST_DISTANCE_M),
            point_precision=_mean(self.to_real <= HIT_DISTANCE_M),
            point_recall=_mean(self.to_generated <= HIT_DISTANCE_M),
            coverage=_mean(made[real]),
            intensity_mae=_mean(grey[both]),
        )

    def cloud_metrics(self) -> CloudMetrics:
        """Given points are their own nearest neighbours: only judged rows can be off, and given ones can be nearer."""
        truth, given = self.truth, self.truth.given
        rows = voxel_overlap(self.points, truth.points)
        cloud_p, cloud_q = np.concatenate([given, self.points]), np.concatenate([given, truth.points])
        cloud = voxel_overlap(cloud_p, cloud_q)
        zero = np.zeros(len(given))
        to_real = np.concatenate([zero, np.minimum(self.to_real, self.to_given)])
        to_generated = np.concatenate([zero, np.minimum(self.to_generated, truth.to_given)])
        empty_given = truth.frame.distance[truth.frame.given].size - len(given)
        return CloudMetrics(
            voxel_iou=rows.iou,
            voxel_precision=rows.precision,
            voxel_recall=rows.recall,
            voxel_f1=rows.f1,
            cloud_chamfer_m2=float(np.mean(to_real**2) + np.mean(to_generated**2)),
            cloud_chamfer_sum_m2=float(np.sum(to_real**2) + np.sum(to_generated**2)),
            cloud_chamfer_m=float(np.mean(to_real) + np.mean(to_generated)),
            cloud_chamfer_origin_m2=chamfer_origin_m2(
                (cloud_p, to_real, empty_given + int(np.count_nonzero(~self.made))),
                (cloud_q, to_generated, empty_given + int(np.count_nonzero(~truth.valid))),
            ),
            cloud_voxel_iou=cloud.iou,
            cloud_voxel_precision=cloud.precision,
            cloud_voxel_recall=cloud.recall,
            cloud_voxel_f1=cloud.f1,
        )

    def by_band(self) -> dict[str, PartMetrics]:
        """Keys ``0-10 m`` and so on."""
        unit = self.truth.frame.distance_unit_m
        real, made = (image[image > 0] * unit for image in (self.truth.distance, self.distance))
        return {
            f"{low:g}-{high:g} m": self._part(_in_band(real, low, high), _in_band(made, low, high))
            for low, high in BANDS_M
        }

    def by_surface(self) -> dict[int, PartMetrics]:
        """Keys: the frame's labels that occur; empty for a frame without labels."""
        labels = self.truth.surface
        if labels is None:
            return {}
        of_generated = labels[self.nearest_real]
        return {int(label): self._part(labels == label, of_generated == label) for label in np.unique(labels)}

    def _part(self, of_real: BoolArray, of_generated: BoolArray) -> PartMetrics:
        """``of_real``, ``of_generated``: which of the real and of the generated points belong to the part."""
        error, covered = self.error_m[self.truth.valid][of_real], self.made[self.truth.valid][of_real]
        to_real, to_generated = self.to_real[of_generated], self.to_generated[of_real]
        return PartMetrics(
            chamfer_m2=_mean(to_real**2) + _mean(to_generated**2),
            mae_m=_mean(error),
            mae_both_m=_mean(error[covered]),
            ghost_share=_mean(to_real > GHOST_DISTANCE_M),
            missed_share=_mean(to_generated > GHOST_DISTANCE_M),
            coverage=_mean(covered),
            real_points=int(np.count_nonzero(of_real)),
        )


def compare_rows(generated: tuple[U16, U8], real: tuple[U16, U8], rules: Rules) -> FrameMetrics:
    """Generated against real rows of the model's own sensor: counts and intensities ``[31, W]`` each."""
    shape = ROWS, real[0].shape[1]
    distance, intensity = np.zeros(shape, np.uint16), np.zeros(shape, np.uint8)
    distance[GENERATED], intensity[GENERATED] = real
    frame = Frame(
        "given", distance, intensity, rules.distance_unit_m, rules.row_elevation_deg, rules.row_height_m, rules.cut_deg
    )
    return Prediction(Truth(frame, rules), *generated).metrics()


def chamfer_m2(generated: FloatArray, real: FloatArray) -> tuple[float, FloatArray]:
    """Mean of squares, both ways added; also d(p, real) of each generated point. Points ``[N, 3]``, neither set
    empty."""
    if len(generated) == 0 or len(real) == 0:
        raise ValueError("the Chamfer distance of an empty cloud is not defined")
    to_real = _nearest(cKDTree(real), generated)[0]
    to_generated = _nearest(cKDTree(generated), real)[0]
    return float(np.mean(to_real**2) + np.mean(to_generated**2)), to_real


Side = tuple[FloatArray, FloatArray, int]
"""Points [N, 3], their distances to the other side's points, and how many empty pixels the side has."""


def chamfer_origin_m2(generated: Side, real: Side) -> float:
    """Mean of squares both ways where every empty pixel is a point at the origin.

    From the distances without those points: an origin on the other side can only be nearer, and an empty pixel is at
    distance 0 from another one.
    """
    return _one_way_origin(generated, real) + _one_way_origin(real, generated)


def _one_way_origin(side: Side, other: Side) -> float:
    points, distance, empty = side
    squares = distance**2
    if other[2]:
        squares = np.minimum(squares, np.sum(points**2, axis=1))
    from_origin = 0.0 if other[2] else float(np.min(np.sum(other[0] ** 2, axis=1)))
    return float((np.sum(squares) + empty * from_origin) / (len(points) + empty))


def voxel_overlap(
    generated: FloatArray, real: FloatArray, size_m: float = VOXEL_M, anchor: FloatArray | None = None
) -> VoxelOverlap:
    """Voxels that hold points of both clouds ``[N, 3]`` against those that hold points of one; neither cloud empty.

    ``anchor``: a corner of the grid; the origin without one.
    """
    corner = np.zeros(3) if anchor is None else anchor
    made, present = _voxels(generated, corner, size_m), _voxels(real, corner, size_m)
    both = len(np.intersect1d(made, present, assume_unique=True))
    precision, recall = both / len(made), both / len(present)
    f1 = 2 * precision * recall / (precision + recall) if both else 0.0
    return VoxelOverlap(both / (len(made) + len(present) - both), precision, recall, f1)


def _voxels(points: FloatArray, anchor: FloatArray, size_m: float) -> NDArray[np.int64]:
    """One number for each voxel that holds a point. 2^20 voxels a side: 52 km either way at 0.1 m."""
    index = np.floor((points - anchor) / size_m).astype(np.int64) + (1 << 19)
    return np.unique((index[:, 0] << 40) | (index[:, 1] << 20) | index[:, 2])


def _nearest(tree: Any, points: FloatArray) -> tuple[FloatArray, NDArray[np.int64]]:
    """Distance to, and index of, the nearest point of a tree, for each of ``points``."""
    distance, index = tree.query(points)
    return np.asarray(distance, dtype=np.float64), np.asarray(index, dtype=np.int64)


def _in_band(range_m: NDArray[Any], low: float, high: float) -> BoolArray:
    last = high == BANDS_M[-1][1]
    return (range_m >= low) & ((range_m <= high) if last else (range_m < high))


def _mean(values: NDArray[Any]) -> float:
    """NaN of nothing, without numpy's warning."""
    return float(np.mean(values)) if values.size else float("nan")
