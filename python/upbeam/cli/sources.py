"""Where frames come from: the simulator, or a folder of recorded ones. Handed down to training, evaluation and
streams."""

from __future__ import annotations

import os
from collections.abc import Iterator

from upbeam.hw_sim import Scan, simulate_frames, simulate_parallel
from upbeam.model.beams import BeamTable
from upbeam.model.frames import Frame, kitti_frames
from upbeam.model.recipe import DataRecipe, Recipe
from upbeam.model.rules import Rules

__all__ = ["frame_of_scan", "recipe_frames", "simulated_scans"]


def simulated_scans(
    beams: BeamTable,
    *,
    columns: int,
    frames: int,
    seed: int,
    rate_hz: float = 20.0,
    frames_per_scene: int | None = None,
    align: bool = True,
) -> Iterator[Scan]:
    """Simulated turns in order, made by all cores where that is faster than starting them."""
    settings = {
        "columns": columns, "frames": frames, "seed": seed, "rate_hz": rate_hz,
        "frames_per_scene": frames_per_scene, "align": align,
    }  # fmt: skip
    if frames < 16 or (os.cpu_count() or 1) < 2:
        return simulate_frames(beams, **settings)  # type: ignore[arg-type]
    return simulate_parallel(beams, **settings)  # type: ignore[arg-type]


def frame_of_scan(scan: Scan) -> Frame:
    aligned = scan.aligned()
    return Frame(f"sim-{scan.frame:06d}", aligned.distance, aligned.intensity, aligned.distance_unit_m)


def recipe_frames(recipe: Recipe, beams: BeamTable, rules: Rules) -> Iterator[Frame]:
    """The training frames that a recipe names."""
    for source in recipe.data:
        yield from _source_frames(source, recipe, beams, rules)


def _source_frames(source: DataRecipe, recipe: Recipe, beams: BeamTable, rules: Rules) -> Iterator[Frame]:
    if source.source == "kitti":
        for _, frame in zip(range(source.frames), kitti_frames(source.folder, rules), strict=False):
            yield frame
        return
    scans = simulated_scans(
        beams, columns=recipe.columns, frames=source.frames, seed=source.seed, frames_per_scene=source.frames_per_scene
    )
    yield from map(frame_of_scan, scans)
