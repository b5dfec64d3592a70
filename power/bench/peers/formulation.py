"""What a peer offers: ways to do the work, each of which says which part of it that is."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ..work import Work

__all__ = [
    "IMAGE",
    "NO_RULES",
    "TILES",
    "TILES_QUICK",
    "WINDOWS",
    "WINDOWS_AND_MINIMA",
    "WINDOWS_BY_CONVOLUTION",
    "Formulation",
    "Peer",
    "join_tiles",
    "tiles_of",
    "transposed",
]

F32 = NDArray[np.float32]

NO_RULES = "no rules, no rounding"
WINDOWS = f"windows given; both networks; {NO_RULES}"
WINDOWS_AND_MINIMA = f"windows and their minima given; both networks; {NO_RULES}"
WINDOWS_BY_CONVOLUTION = f"windows given side by side, minima by pooling; both networks; {NO_RULES}"
IMAGE = "all rules, both networks: counts of image rows in, generated counts out"

TILES = (1024, 2048, 4096, 7936, 16384, 32768, 65536)
"""Windows of a tile that are tried; the fastest is timed."""
TILES_QUICK = (7936,)


@dataclass
class Formulation:
    """One way. ``family``: those of one family differ in a setting only, and the fastest of them stands for all.

    ``run`` does one frame, waits for its end, and keeps what it needs for ``output``: network outputs ``[N]`` (counts,
    intensities) for ``windows``, generated points ``[31, W]`` for ``image``."""

    name: str
    family: str
    kind: Literal["windows", "image"]
    does: str
    run: Callable[[], Any]
    output: Callable[[], tuple[NDArray[Any], NDArray[Any]]]
    own_clock: Callable[[], float] | None = None
    """Nanoseconds of the last run by the peer's own events, where those are meant"""
    detail: dict[str, Any] = field(default_factory=dict)


Peer = Callable[[Work, int, bool], Iterator[Formulation]]
"""Work, threads, quick -> formulations. Imports its packages when called; settings that must stand before that are in
``pool``."""


def transposed(work: Work) -> list[F32]:
    """For each network the windows and their minima ``[7, N]``: what matrix products like best."""
    return [np.ascontiguousarray(np.concatenate([x, x.min(axis=1, keepdims=True)], 1).T) for x in work.window_inputs]


def tiles_of(values: F32, tile: int, axis: int) -> list[F32]:
    """Contiguous parts of at most ``tile`` windows."""
    count = values.shape[axis]
    cut = [slice(k, min(k + tile, count)) for k in range(0, count, tile)]
    return [np.ascontiguousarray(values[:, part] if axis else values[part]) for part in cut]


def join_tiles(work: Work, outputs: list[list[Any]]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Outputs of both networks' tiles, metres and intensities -> ``[N]`` counts and intensities."""
    flat = [np.concatenate([np.asarray(x, dtype=np.float64).reshape(-1) for x in parts]) for parts in outputs]
    return flat[0] / work.file.rules.distance_unit_m, flat[1]
