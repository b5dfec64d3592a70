"""How far generated points are from real ones.

All metrics compare generated rows with the recorded rows they stand for, both as points at their pixel's centre (same
elevation and azimuth on both sides), distances within the model's range limits. ``d(p, Q)`` is the distance to the
nearest point of Q.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from .geometry import to_points
from .rules import Rules

__all__ = ["GHOST_DISTANCE_M", "FrameMetrics", "chamfer_m2", "compare_rows"]

GHOST_DISTANCE_M = 0.5
"""A generated point farther than this from every real one is a ghost."""

GENERATED = slice(1, -1, 2)
"""Of 64 rows, those a network makes. Row 63 is never scored."""

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class FrameMetrics:
    """One method on one frame, generated rows only."""

    chamfer_m2: float
    """mean over generated p of d(p, real)^2 + mean over real q of d(q, generated)^2 (the paper's code)"""
    mae_m: float
    """mean |generated - real| over pixels with a real return; a pixel not generated counts with its full distance"""
    mae_both_m: float
    """the same over pixels where both exist: dropping points cannot buy it"""
    ghost_share: float
    """share of generated points with d(p, real) > 0.5 m"""
    coverage: float
    """share of real returns whose pixel was generated"""
    intensity_mae: float
    """mean |generated - real| in 8-bit steps, over pixels where both exist"""

    def as_dict(self) -> dict[str, float]:
        return asdict(self)


def chamfer_m2(generated: FloatArray, real: FloatArray) -> tuple[float, FloatArray]:
    """Mean of squares, both ways added; also d(p, real) of each generated point. Points ``[N, 3]``, neither set
    empty."""
    if len(generated) == 0 or len(real) == 0:
        raise ValueError("the Chamfer distance of an empty cloud is not defined")
    to_real = cKDTree(real).query(generated, workers=-1)[0]
    to_generated = cKDTree(generated).query(real, workers=-1)[0]
    return float(np.mean(to_real**2) + np.mean(to_generated**2)), to_real


def compare_rows(
    generated: tuple[NDArray[np.uint16], NDArray[np.uint8]],
    real: tuple[NDArray[np.uint16], NDArray[np.uint8]],
    rules: Rules,
    rows: slice = GENERATED,
) -> FrameMetrics:
    """Generated against real rows, counts and intensities ``[R, W]`` each: those of the model's 64 that ``rows``
    names."""
    unit = rules.distance_unit_m
    geometry = rules.row_elevation_deg[rows], unit, rules.cut_deg, rules.row_height_m[rows]
    real_valid = rules.valid(real[0])
    made = generated[0] > 0
    if not made.any() or not real_valid.any():
        raise ValueError("nothing to compare: the generated or the real rows hold no return")
    points = [
        to_points(np.where(keep, d, 0).astype(np.uint16), i, *geometry)[0][:, :3].astype(np.float64)
        for (d, i), keep in ((generated, made), (real, real_valid))
    ]
    chamfer, to_real = chamfer_m2(points[0], points[1])
    error = np.abs(generated[0].astype(np.float64) - real[0]) * unit
    both = made & real_valid
    grey = np.abs(generated[1].astype(np.float64) - real[1])
    return FrameMetrics(
        chamfer_m2=chamfer,
        mae_m=float(error[real_valid].mean()),
        mae_both_m=float(error[both].mean()) if both.any() else float("nan"),
        ghost_share=float(np.mean(to_real > GHOST_DISTANCE_M)),
        coverage=float(made[real_valid].mean()),
        intensity_mae=float(grey[both].mean()) if both.any() else float("nan"),
    )
