"""What training minimises: pixelwise errors, and the Chamfer distance of generated rows as points. Needs PyTorch."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from .recipe import Loss

__all__ = [
    "PixelGeometry",
    "chamfer",
    "nearest_exact",
    "nearest_in_window",
    "pixel_errors",
]

FloatArray = NDArray[np.float64]

_FAR = 1e6
"""Metres: where points that do not exist are put, so that nothing finds them."""


def pixel_errors(error: Tensor, loss: Loss) -> Tensor:
    """Each pixel's loss, same shape as ``error`` (metres or 8-bit steps); not for ``chamfer``."""
    if loss.kind == "l1":
        return error.abs()
    square = error**2
    if loss.kind == "charbonnier":
        return (square + loss.scale_m**2) ** (loss.power / 2)
    if loss.kind == "robust":
        return square / (1 + square / loss.knee_m**2)
    raise ValueError(f"{loss.kind} is no loss of single pixels")


@dataclass(frozen=True)
class PixelGeometry:
    """Turns distances into points: ``point = distance * direction + origin``, in metres."""

    direction: Tensor
    """[R, W, 3] unit vectors through the middles of the pixels."""
    origin: Tensor
    """[R, 1, 3] of each row's laser."""

    @classmethod
    def of_rows(
        cls,
        elevation_deg: FloatArray,
        height_m: FloatArray,
        columns: int,
        cut_deg: float,
        device: torch.device | None = None,
    ) -> PixelGeometry:
        """Of rows ``[R]`` at these elevations and laser heights; the conventions of ``geometry.to_points``."""
        elevation = np.radians(elevation_deg)[:, None]
        azimuth = np.radians(cut_deg + (np.arange(columns) + 0.5) * 360.0 / columns)[None]
        up = np.broadcast_to(np.sin(elevation), (len(elevation), columns))
        direction = np.stack([np.cos(elevation) * np.cos(azimuth), -np.cos(elevation) * np.sin(azimuth), up], axis=-1)
        origin = np.zeros((len(elevation), 1, 3))
        origin[:, 0, 2] = height_m
        return cls(*(torch.from_numpy(x.astype(np.float32)).to(device) for x in (direction, origin)))

    def points(self, distance: Tensor) -> Tensor:
        """``distance[R, W]`` -> ``[R, W, 3]``."""
        return distance[..., None] * self.direction + self.origin


def chamfer(distance: Tensor, made: Tensor, truth: Tensor, real: Tensor, geometry: PixelGeometry, loss: Loss) -> Tensor:
    """Mean of squared nearest-neighbour distances, both ways added, in m2: of generated to real points, and back.

    ``distance[R, W]`` has a gradient; ``made`` and ``real`` say which pixels are points. Neighbours are looked for
    without a gradient, exactly or among the pixels around (``loss.search``); there, a point that finds none takes no
    part. Mean of squares and not their sum: as the paper's authors compute it; their Eq. (8) prints a sum.
    """
    generated, target = geometry.points(distance), geometry.points(truth)
    with torch.no_grad():
        if loss.search == "exact":
            ours, theirs = _Distinct.of(distance, made), _Distinct.of(truth, real)
            to_target = _exact_in_image(generated, ours, target, theirs)
            to_generated = _exact_in_image(target, theirs, generated, ours)
        else:
            reach = loss.search_rows, loss.search_columns
            to_target, to_generated = nearest_in_window(generated, made, target, real, *reach)
    return _mean_square(generated, target, to_target) + _mean_square(target, generated, to_generated)


def _mean_square(points: Tensor, others: Tensor, nearest: Tensor) -> Tensor:
    """Mean squared distance of the points that have a nearest one; 0 (with a gradient of 0) if none has."""
    found = nearest.reshape(-1) >= 0
    gap = points.reshape(-1, 3)[found] - others.reshape(-1, 3)[nearest.reshape(-1)[found]]
    return (gap**2).sum() / max(1, len(gap))


@dataclass(frozen=True)
class _Distinct:
    """Pixels that are points, those of distance 0 once a row: thousands of equal points make a k-d tree crawl."""

    index: Tensor
    """[K] flat indices of the distinct points."""
    zero: Tensor
    """[R, W] points of distance 0."""
    first_zero: Tensor
    """[R] flat index of each row's first of them; of a row without any, its first pixel."""

    @classmethod
    def of(cls, distance: Tensor, exists: Tensor) -> _Distinct:
        zero = exists & (distance == 0)
        column = zero.long().argmax(dim=1)
        first = torch.arange(len(zero), device=zero.device) * zero.shape[1] + column
        distinct = exists & ~zero
        distinct[torch.arange(len(zero), device=zero.device), column] |= zero.any(dim=1)
        return cls(torch.nonzero(distinct.reshape(-1))[:, 0], zero, first)


def _exact_in_image(points: Tensor, ours: _Distinct, others: Tensor, theirs: _Distinct) -> Tensor:
    """Flat index ``[R, W]`` of the nearest other point to each point, -1 for none and where there is no point."""
    result = torch.full(ours.zero.shape, -1, dtype=torch.long, device=points.device)
    if len(ours.index) and len(theirs.index):
        nearest = nearest_exact(points.reshape(-1, 3)[ours.index], others.reshape(-1, 3)[theirs.index])
        result.view(-1)[ours.index] = theirs.index[nearest]
        result = torch.where(ours.zero, result.view(-1)[ours.first_zero][:, None], result)
    return result


def nearest_exact(points: Tensor, others: Tensor, block: int = 4096) -> Tensor:
    """Index ``[N]`` of the nearest of ``others[M, 3]`` to each of ``points[N, 3]``, M >= 1: a k-d tree on the CPU, all
    distances in blocks on a GPU."""
    if points.device.type == "cpu":
        tree = cKDTree(others.numpy(), compact_nodes=False, balanced_tree=False)
        return torch.from_numpy(tree.query(points.numpy())[1])
    # The fast form of cdist, through a matrix product, loses centimetres at 80 m.
    plain = "donot_use_mm_for_euclid_dist"
    parts = [torch.cdist(part, others, compute_mode=plain).argmin(dim=1) for part in torch.split(points, block)]
    return torch.cat(parts)


def nearest_in_window(
    a: Tensor, a_exists: Tensor, b: Tensor, b_exists: Tensor, rows: int, columns: int
) -> tuple[Tensor, Tensor]:
    """Nearest neighbours both ways among the pixels within ``rows`` and ``columns``; columns are a closed turn.

    Points ``[R, W, 3]``. Returns flat indices ``[R, W]`` into b for each of a, and into a for each of b; -1 where no
    point is within reach, or where the pixel is none itself. Exact where every nearest point lies in the window, which
    near the sensor it may not: there a column is narrower than an error.
    """
    height, width = a_exists.shape
    # Different far places, so that two missing points are far from one another too.
    pa = torch.where(a_exists[..., None], a, a.new_tensor(_FAR)).permute(2, 0, 1).contiguous()
    pb = torch.where(b_exists[..., None], b, b.new_tensor(-_FAR)).permute(2, 0, 1).contiguous()
    index = torch.arange(height * width, device=a.device).reshape(height, width)
    best = [torch.full((height, width), _FAR, device=a.device, dtype=a.dtype) for _ in range(2)]
    found = [torch.full((height, width), -1, device=a.device) for _ in range(2)]
    for dr in range(-min(rows, height - 1), min(rows, height - 1) + 1):
        mine, theirs = slice(max(0, -dr), height - max(0, dr)), slice(max(0, dr), height - max(0, -dr))
        for dc in range(-min(columns, width // 2), min(columns, width // 2) + 1):
            shifted = torch.roll(pb[:, theirs], -dc, dims=2)
            square = ((pa[:, mine] - shifted) ** 2).sum(dim=0)
            _keep_nearer(best[0][mine], found[0][mine], square, torch.roll(index[theirs], -dc, dims=1))
            back = torch.roll(square, dc, dims=1)
            _keep_nearer(best[1][theirs], found[1][theirs], back, torch.roll(index[mine], dc, dims=1))
    return found[0], found[1]


def _keep_nearer(best: Tensor, found: Tensor, square: Tensor, index: Tensor) -> None:
    """In place, in views of the whole images."""
    nearer = square < best
    torch.where(nearer, square, best, out=best)
    torch.where(nearer, index, found, out=found)
