"""``upbeam train`` of a recipe of Shan's U-Net: weights for ``upbeam evaluate --with``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from time import monotonic
from typing import Any

from upbeam.model.frames import Frame
from upbeam.model.recipe import DataRecipe, UNetRecipe
from upbeam.model.shan import ShanNet, save_shan, shan_method, train_shan
from upbeam.model.train import pick_device

from .common import message, progress_bar
from .sources import recipe_frames, source_frames
from .train import common_provenance, counted, validate, write_log

__all__ = ["train_unet"]

Log = list[tuple[int, float]]


def train_unet(
    recipe: UNetRecipe, out: Path, device: str, changes: Mapping[str, int], *, quiet: bool
) -> dict[str, Any]:
    """Writes the weights, and the losses beside them; gives the summary for JSON."""
    rules = recipe.make_rules()
    data = _frames("training", recipe, recipe.data, quiet=quiet)
    kept_back = _frames("validation", recipe, recipe.validation, quiet=quiet)
    begin = monotonic()
    network, losses, held = _fit(recipe, data, kept_back, device, quiet=quiet)
    seconds = monotonic() - begin
    weights = sum(parameter.numel() for parameter in network.parameters())
    provenance = common_provenance(recipe, device, changes, {"unet": asdict(recipe.unet), "weights": weights})
    save_shan(out, network, provenance)
    write_log(out, {"range": losses}, {"range": held} if held else {})
    message(f"{out}: {recipe.unet.steps} steps on {len(data)} frames in {seconds:.0f} s")
    summary = {"model": str(out), "seconds": round(seconds, 1), **provenance, "bytes": out.stat().st_size}
    if recipe.validation:
        summary["validation"] = validate(recipe, rules, {recipe.name: shan_method(network)}, quiet=quiet)
    return summary


def _frames(what: str, recipe: UNetRecipe, sources: tuple[DataRecipe, ...], *, quiet: bool) -> list[Frame]:
    if not sources:
        return []
    with progress_bar(f"making {what} frames", sum(map(source_frames, sources)), quiet=quiet) as advance:
        return list(counted(recipe_frames(recipe, recipe.make_rules(), sources), advance))


def _fit(
    recipe: UNetRecipe, data: Sequence[Frame], kept_back: Sequence[Frame], device: str, *, quiet: bool
) -> tuple[ShanNet, Log, Log]:
    """The network, its losses, and those on the validation frames."""
    losses: Log = []
    held: Log = []
    with progress_bar("training the U-Net", recipe.unet.steps, quiet=quiet) as advance:

        def show_progress(step: int, steps: int, loss: float, validation: float | None) -> None:
            advance(step - (losses[-1][0] if losses else 0), _note(loss, validation))
            losses.append((step, loss))
            if validation is not None:
                held.append((step, validation))

        network = train_shan(
            data,
            recipe.make_rules(),
            **asdict(recipe.unet),
            seed=recipe.seed,
            validation=kept_back,
            progress=show_progress,
            device=pick_device(device),
        )
    return network, losses, held


def _note(loss: float, validation: float | None) -> str:
    return f"loss {loss:.4f}" + ("" if validation is None else f", kept back {validation:.4f}")
