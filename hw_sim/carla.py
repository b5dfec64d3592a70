"""Clouds saved by the CARLA simulator, turned into this project's frame.

CARLA's lidar frame is left-handed: x forward, y right, z up. Ours is right-handed: x forward, y left, z up.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from upbeam.model.io import CloudError, read_cloud

__all__ = ["read_carla"]


def read_carla(path: str | Path) -> NDArray[np.float32]:
    """Read a ``.ply`` (as ``save_to_disk`` writes it: properties x, y, z, I; ASCII or binary) or a raw ``.bin`` cloud.

    ``.bin`` holds little-endian float32 ``x, y, z, intensity`` rows. Returns ``float32[N, 4]`` in file order:
    x forward, y left (CARLA's y with its sign changed), z up in metres, intensity 0..1. Raises CloudError, a ValueError
    that names the file, the fault and its place, for a file that is cut short, empty, not finite, or of another kind.
    """
    path = Path(path)
    if path.suffix.lower() not in (".ply", ".bin"):
        raise CloudError(path, f"suffix {path.suffix!r}", "name", "a CARLA cloud, .ply or .bin")
    points = np.array(read_cloud(path, intensity_scale=1.0).points, dtype=np.float32)
    points[:, 1] *= -1
    return points
