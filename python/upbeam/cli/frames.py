"""Frames for a model that is to be quantised or verified: simulated as its training data was, or recorded."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path

from upbeam.model.beams import beam_table_names
from upbeam.model.frames import Frame, kitti_files, kitti_frames
from upbeam.model.recipe import DataRecipe, Recipe, load_recipe, recipe_names
from upbeam.quant.ubm import ModelFile

from .common import UserError, progress_bar
from .sources import recipe_frames

__all__ = ["SIMULATED", "FrameSet", "model_frames"]

SIMULATED = "sim"
CAPTURES = (".pcap", ".db3")


@dataclass(frozen=True)
class FrameSet:
    """Frames, and what they are, for provenance: no names of this machine."""

    frames: list[Frame]
    text: str


def model_frames(
    source: str, file: ModelFile, *, limit: int | None, seed: int, simulated: int, what: str, quiet: bool
) -> FrameSet:
    """Frames of ``source``: ``sim``, a .bin file or a folder of them, or a capture; at most ``limit``, of the
    simulator ``simulated`` unless told otherwise. ``what``: for the progress bar.

    Raises UserError or CloudError naming the source.
    """
    if source == SIMULATED:
        total, text, frames = _simulated(file, limit or simulated, seed)
    elif Path(source).suffix.lower() in CAPTURES:
        from upbeam.model.recordings import capture_frames

        frames = islice(capture_frames(source, columns=file.rules.columns), limit)
        total, text = limit or 0, "recorded packets"
    else:
        available = len(kitti_files(source))
        frames = islice(kitti_frames(source, file.rules), limit)
        total, text = min(available, limit or available), "KITTI-format recordings (non-commercial licence)"
    with progress_bar(what, total, quiet=quiet) as advance:
        found = []
        for frame in frames:
            found.append(frame)
            advance()
    if not found:
        raise UserError(f"{source}: no frames")
    return FrameSet(found, f"{text}, {_count(found)}")


def _count(frames: list[Frame]) -> str:
    return f"{len(frames)} frame{'' if len(frames) == 1 else 's'}"


def _simulated(file: ModelFile, frames: int, seed: int) -> tuple[int, str, Iterator[Frame]]:
    recipe, source = _simulation(file)
    chosen = replace(source, frames=frames, seed=seed)
    how = "" if source.projection == "aligned" else f", projected as recordings are at {source.rate_hz:g} Hz"
    return frames, f"upbeam simulator, seed {seed}{how}", recipe_frames(recipe, file.rules, (chosen,))


def _simulation(file: ModelFile) -> tuple[Recipe, DataRecipe]:
    """The simulator's settings in the model's own recipe; where there are none, the model's sensor with aligned
    lasers."""
    name = file.provenance.get("recipe")
    if name in recipe_names():
        recipe = load_recipe(name)
        rules = recipe.make_rules()
        sources = [source for source in recipe.data if source.source == "simulator"]
        if sources and (rules.sensor, rules.columns) == (file.rules.sensor, file.rules.columns):
            own = [source for source in sources if source.columns in (0, recipe.columns)]
            return recipe, (own or sources)[0]
    sensor = file.rules.sensor
    table = sensor.removesuffix("/2")
    if table not in beam_table_names():
        raise UserError(
            f"the model is made for {sensor or 'a sensor without a name'}, which the simulator does not know: "
            "give recorded frames"
        )
    beams = table if sensor.endswith("/2") else f"{table}*2"
    recipe = replace(load_recipe("default"), beams=beams, columns=file.rules.columns)
    return recipe, DataRecipe("simulator")
