"""Streams of simulated scans: one drive, or fresh streets for training, in one process or several."""

from __future__ import annotations

import os
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from typing import Any

import numpy as np

from upbeam.model.beams import BeamTable

from .lidar import Lidar, LidarConfig, Scan
from .scene import SCENE_KINDS, Scene, street_scene

__all__ = ["simulate_frames", "simulate_parallel"]


_SHARES = (0.3, 0.5, 0.07, 0.13)
"""How often each of ``SCENE_KINDS`` is drawn."""


@dataclass(frozen=True)
class _Plan:
    """All that decides every frame of a stream; small, so that it can be sent to other processes."""

    config: LidarConfig
    frames: int
    kinds: tuple[str, ...]
    scene: Scene | None
    frames_per_scene: int | None
    seconds: float

    def lidar(self, block: int) -> Lidar:
        """The sensor in the street of the ``block``-th group of frames."""
        if self.scene is not None:
            return Lidar(self.config, self.scene)
        rng = np.random.default_rng([self.config.seed, block, 0xB10C])
        kind = str(rng.choice(self.kinds, p=_SHARES if len(self.kinds) > 1 else None))
        return Lidar(self.config, street_scene(kind, int(rng.integers(2**62)), seconds=self.seconds))

    def index(self, frame: int) -> tuple[int, int]:
        """Block of a frame, and the turn of that block's drive."""
        if self.frames_per_scene is None:
            return 0, frame
        # Frames of one short-lived street are half a second of driving apart, so that they differ.
        block, k = divmod(frame, self.frames_per_scene)
        return block, k * max(1, round(self.config.rate_hz / 2))


def simulate_frames(
    beams: BeamTable,
    *,
    columns: int = 2048,
    frames: int,
    seed: int = 0,
    rate_hz: float = 20.0,
    scene: str | Scene | None = None,
    frames_per_scene: int | None = None,
    align: bool = True,
    **settings: Any,
) -> Iterator[Scan]:
    """Yield ``frames`` scans; the same arguments give the same bits.

    That holds for one kind of CPU and one NumPy version: vectorised sines differ between them in the last place.
    ``scene``: one of ``SCENE_KINDS``, a ``Scene`` of your own, or None to draw the kind from the seed. With
    ``frames_per_scene=None`` the vehicle drives on without a break, one turn after the other; otherwise every
    ``frames_per_scene`` frames a new street begins, and frames within one street are half a second apart.
    ``settings`` are further fields of ``LidarConfig``. The n-th scan's ``frame`` is its turn in its own drive.
    Errors: ValueError for an unknown kind or an impossible setting, before the first scan.
    """
    plan = _plan(beams, columns, frames, seed, rate_hz, scene, frames_per_scene, align, settings)
    return _frames(plan, range(frames))


def simulate_parallel(
    beams: BeamTable,
    *,
    columns: int = 2048,
    frames: int,
    seed: int = 0,
    rate_hz: float = 20.0,
    scene: str | Scene | None = None,
    frames_per_scene: int | None = None,
    align: bool = True,
    workers: int | None = None,
    **settings: Any,
) -> Iterator[Scan]:
    """The scans of ``simulate_frames``, in the same order, made by ``workers`` processes (None: one per CPU).

    Processes are spawned, so a script that calls this needs the usual ``if __name__ == "__main__"`` guard.
    """
    plan = _plan(beams, columns, frames, seed, rate_hz, scene, frames_per_scene, align, settings)
    workers = workers or os.cpu_count() or 1
    if workers < 1:
        raise ValueError(f"{workers} workers: expected 1 or more")
    return _parallel(plan, workers)


def _plan(
    beams: BeamTable, columns: int, frames: int, seed: int, rate_hz: float,
    scene: str | Scene | None, frames_per_scene: int | None, align: bool, settings: dict[str, Any],
) -> _Plan:  # fmt: skip
    if frames < 0:
        raise ValueError(f"{frames} frames: expected 0 or more")
    if frames_per_scene is not None and frames_per_scene < 1:
        raise ValueError(f"frames_per_scene {frames_per_scene}: expected 1 or more, or None")
    if isinstance(scene, str) and scene not in SCENE_KINDS:
        raise ValueError(f"no scene kind {scene!r}; known: {', '.join(SCENE_KINDS)}")
    config = LidarConfig(beams, columns=columns, rate_hz=rate_hz, seed=seed, align=align, **settings)
    kinds = (scene,) if isinstance(scene, str) else SCENE_KINDS
    drive = frames / rate_hz if frames_per_scene is None else 0.5 * frames_per_scene
    return _Plan(
        config, frames, kinds, scene if isinstance(scene, Scene) else None, frames_per_scene, min(600.0, drive + 2.0)
    )


def _frames(plan: _Plan, which: range) -> Iterator[Scan]:
    held: tuple[int, Lidar] | None = None
    for frame in which:
        block, turn = plan.index(frame)
        if held is None or held[0] != block:
            held = (block, plan.lidar(block))
        yield held[1].scan(turn)


def _chunk(plan: _Plan, which: range) -> list[Scan]:
    return list(_frames(plan, which))


def _parallel(plan: _Plan, workers: int) -> Iterator[Scan]:
    size = plan.frames_per_scene or 16
    size *= max(1, 8 // size)
    chunks = [range(a, min(a + size, plan.frames)) for a in range(0, plan.frames, size)]
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        ahead = 2 * workers
        waiting = [pool.submit(_chunk, plan, c) for c in chunks[:ahead]]
        for k in range(len(chunks)):
            done = waiting.pop(0)
            if k + ahead < len(chunks):
                waiting.append(pool.submit(_chunk, plan, chunks[k + ahead]))
            yield from done.result()
