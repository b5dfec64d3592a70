"""``upbeam train``: a recipe in, a model file out."""

from __future__ import annotations

import csv
import datetime
import platform
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

import upbeam
from upbeam.model.beams import beam_table
from upbeam.model.frames import Frame
from upbeam.model.recipe import Recipe, load_recipe, recipe_names
from upbeam.quant.ubm import ModelFile, write_ubm
from upbeam.runtime.upsampler import load_model

from .common import JsonOption, UserError, emit_json, message, progress_bar, show
from .evaluate import evaluate_folder, evaluation_dict, evaluation_table
from .sources import recipe_frames

__all__ = ["train"]


def train(
    recipe: Annotated[str, typer.Option(help=f"A recipe ({', '.join(recipe_names())}) or a .yaml file.")] = "default",
    out: Annotated[Path, typer.Option(help="The model file to write; its loss log goes beside it as .csv.")] = Path(
        "model.ubm"
    ),
    evaluate: Annotated[str | None, typer.Option(help="A folder of KITTI .bin frames to judge the result on.")] = None,
    as_json: JsonOption = False,
) -> None:
    """Fit the distance and the intensity network. Needs PyTorch: pip install 'upbeam[train]'."""
    if out.suffix != ".ubm":
        raise UserError(f"{out}: a model file ends in .ubm")
    if not out.parent.is_dir():
        raise UserError(f"{out}: the folder {out.parent} does not exist")
    chosen = load_recipe(recipe)
    file, log = _train(chosen, quiet=as_json)
    data = write_ubm(out, file)
    _write_log(out.with_suffix(".csv"), log)
    model = load_model(out)
    summary: dict[str, Any] = {"model": str(out), "bytes": len(data), "crc32": f"{model.crc32:08x}", **file.provenance}
    message(f"{out}: {len(data)} bytes, crc32 {model.crc32:08x}, {file.provenance['samples']} training windows")
    if evaluate is not None:
        result = evaluate_folder(evaluate, model)
        summary["evaluation"] = evaluation_dict(result, model)
        if not as_json:
            show(evaluation_table(result, f"{evaluate}: {len(result.frames)} frames, generated rows only"))
    if as_json:
        emit_json(summary)


def _train(recipe: Recipe, *, quiet: bool) -> tuple[ModelFile, dict[str, list[tuple[int, float]]]]:
    try:
        import torch

        from upbeam.model.train import collect_samples, train_networks
    except ImportError:
        raise UserError("training needs PyTorch: pip install 'upbeam[train]' (make test-train installs it)") from None
    rules = recipe.make_rules()
    frames = sum(source.frames for source in recipe.data)
    with progress_bar("making training frames", frames, quiet=quiet) as advance:

        def counted(frame: Frame) -> Frame:
            advance()
            return frame

        source = map(counted, recipe_frames(recipe, beam_table(recipe.beams), rules))
        samples = collect_samples(source, rules, recipe.windows, frames, recipe.seed)
    steps = recipe.training.steps
    with progress_bar("training two networks", 2 * steps, quiet=quiet) as advance:
        done = {"distance": 0, "intensity": 0}

        def show_progress(name: str, step: int, steps: int, loss: float) -> None:
            advance(step - done[name], f"{name} loss {loss:.4f}")
            done[name] = step

        result = train_networks(recipe, samples, rules, show_progress)
    provenance = {
        "recipe": recipe.name,
        "seed": recipe.seed,
        "data": [_describe(source) for source in recipe.data],
        "frames": frames,
        "samples": result.samples,
        "trained": datetime.datetime.now(datetime.timezone.utc).date().isoformat(),
        "versions": {"upbeam": upbeam.__version__, "torch": torch.__version__, "numpy": np.__version__},
        "machine": platform.machine(),
        "licence": "Apache-2.0" if all(s.source == "simulator" for s in recipe.data) else "as the training data's",
    }
    return ModelFile.from_dense(rules, result.networks, provenance=provenance), result.losses


def _describe(source: Any) -> str:
    if source.source == "simulator":
        return f"upbeam simulator, {source.frames} frames, seed {source.seed}"
    return f"KITTI-format recordings, {source.frames} frames (non-commercial licence)"


def _write_log(path: Path, log: dict[str, list[tuple[int, float]]]) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["network", "step", "loss"])
        writer.writerows([name, step, f"{loss:.6g}"] for name, rows in log.items() for step, loss in rows)
