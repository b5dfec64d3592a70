"""``upbeam train``: a recipe in, a model file out."""

from __future__ import annotations

import csv
import datetime
import platform
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from time import monotonic
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

import upbeam
from upbeam.model.baselines import BASELINES, Method
from upbeam.model.evaluate import evaluate as run_evaluation
from upbeam.model.frames import Frame
from upbeam.model.recipe import (
    AnyRecipe,
    BaseRecipe,
    DataRecipe,
    Recipe,
    UNetRecipe,
    load_any_recipe,
    recipe_names,
    with_length,
    with_simulated_data,
)
from upbeam.model.rules import Rules
from upbeam.quant.ubm import ModelFile, write_ubm
from upbeam.runtime.upsampler import load_model

from .common import JsonOption, UserError, emit_json, message, progress_bar, show, table
from .evaluate import evaluate_folder, evaluation_dict, evaluation_table
from .sources import describe_source, may_ship, recipe_frames, source_frames

if TYPE_CHECKING:
    from upbeam.model.train import TrainingData, TrainingResult

__all__ = ["Losses", "common_provenance", "counted", "train", "validate", "write_log"]

Losses = Mapping[str, list[tuple[int, float]]]
"""Per network: (step, loss)."""


def train(
    recipe: Annotated[str, typer.Option(help=f"A recipe ({', '.join(recipe_names())}) or a .yaml file.")] = "default",
    out: Annotated[
        Path,
        typer.Option(
            help="The model file to write (.ubm; .pt for what a model file cannot hold, Shan's U-Net too); the losses "
            "go beside it as .csv (network, step, loss, validation_loss) and .png."
        ),
    ] = Path("model.ubm"),
    evaluate: Annotated[str | None, typer.Option(help="A folder of KITTI .bin frames to judge the result on.")] = None,
    checkpoint: Annotated[
        Path | None, typer.Option(help="A file to keep the run's state in; where it exists, the run goes on from it.")
    ] = None,
    checkpoint_every: Annotated[int, typer.Option(min=1, help="Steps between two checkpoints.")] = 500,
    device: Annotated[str, typer.Option(help="auto (a GPU where there is one), cpu or cuda.")] = "auto",
    epochs: Annotated[
        int | None,
        typer.Option(min=1, help="Instead of the recipe's, of the distance network; the other's change in proportion."),
    ] = None,
    steps: Annotated[int | None, typer.Option(min=1, help="Instead of the recipe's.")] = None,
    simulated: Annotated[
        int | None,
        typer.Option(min=1, help="So many simulated frames instead of the recipe's data, half as many to validate on."),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Fit the distance and the intensity network, or Shan's U-Net. Needs PyTorch: pip install 'upbeam[train]'."""
    chosen = with_length(load_any_recipe(recipe), epochs=epochs, steps=steps)
    if simulated is not None:
        chosen = with_simulated_data(chosen, simulated)
    given = {"epochs": epochs, "steps": steps, "simulated": simulated}
    changes = {key: value for key, value in given.items() if value is not None}
    _check_files(chosen, out, checkpoint, evaluate)
    try:
        import torch  # noqa: F401
    except ImportError:
        raise UserError("training needs PyTorch: pip install 'upbeam[train]' (make test-train installs it)") from None
    from upbeam.model.train import pick_device

    pick_device(device)
    if isinstance(chosen, UNetRecipe):
        from .train_shan import train_unet

        summary = train_unet(chosen, out, device, changes, quiet=as_json)
    else:
        summary = _train_windows(
            chosen, out, device, changes, checkpoint, checkpoint_every, evaluate=evaluate, quiet=as_json
        )
    if as_json:
        emit_json(summary)


def _train_windows(
    recipe: Recipe,
    out: Path,
    device: str,
    changes: Mapping[str, int],
    checkpoint: Path | None,
    checkpoint_every: int,
    *,
    evaluate: str | None,
    quiet: bool,
) -> dict[str, Any]:
    from upbeam.model.train import VALIDATION_WINDOWS, torch_method

    rules = recipe.make_rules()
    data = _collect(recipe, rules, recipe.data, recipe.windows, quiet=quiet)
    held = None
    if recipe.validation:
        held = _collect(recipe, rules, recipe.validation, VALIDATION_WINDOWS, quiet=quiet)
    begin = monotonic()
    result = _train(recipe, rules, data, held, device, checkpoint, checkpoint_every, quiet=quiet)
    seconds = monotonic() - begin
    provenance = _provenance(recipe, result, device, changes)
    summary = {"model": str(out), "seconds": round(seconds, 1), **provenance, **_write(out, rules, result, provenance)}
    message(f"{out}: trained on {result.samples} {_unit(recipe)} in {seconds:.0f} s")
    if recipe.validation:
        summary["validation"] = validate(recipe, rules, {recipe.name: torch_method(result.modules)}, quiet=quiet)
    if evaluate is not None:
        model = load_model(out)
        judged = evaluate_folder(evaluate, model)
        summary["evaluation"] = evaluation_dict(judged, model)
        if not quiet:
            show(evaluation_table(judged, f"{evaluate}: {len(judged.frames)} frames, generated rows only"))
    return summary


def _check_files(recipe: AnyRecipe, out: Path, checkpoint: Path | None, evaluate: str | None) -> None:
    """Before hours of training rather than after."""
    what = _not_exportable(recipe)
    if what is None and out.suffix != ".ubm":
        raise UserError(f"{out}: a model file ends in .ubm")
    if what is not None and out.suffix != ".pt":
        raise UserError(f"recipe {recipe.name} has {what}, which a model file cannot hold: --out {out} must end in .pt")
    if what is not None and evaluate is not None:
        raise UserError(f"--evaluate needs a model file; {what}: upbeam evaluate FOLDER --with {out}")
    if checkpoint is not None and isinstance(recipe, UNetRecipe):
        raise UserError("--checkpoint is of the window networks; the U-Net's minutes are not kept")
    for path in (out, checkpoint):
        if path is not None and not path.parent.is_dir():
            raise UserError(f"{path}: the folder {path.parent} does not exist")


def _not_exportable(recipe: AnyRecipe) -> str | None:
    if isinstance(recipe, UNetRecipe):
        return "a U-Net"
    hidden = all(network.exportable for network in recipe.networks.values())
    return None if hidden else "networks of more than one hidden layer"


def _collect(
    recipe: Recipe, rules: Rules, sources: tuple[DataRecipe, ...], windows: int, *, quiet: bool
) -> TrainingData:
    """Windows drawn from the frames of ``sources``, or the frames themselves."""
    from upbeam.model.train import collect_samples

    count = sum(source_frames(source) for source in sources)
    what = "training" if sources is recipe.data else "validation"
    with progress_bar(f"making {what} frames", count, quiet=quiet) as advance:
        frames = counted(recipe_frames(recipe, rules, sources), advance)
        if recipe.training.batch_images:
            return list(frames)
        return collect_samples(frames, rules, windows, count, recipe.seed)


def counted(frames: Iterable[Frame], advance: Callable[[], None]) -> Iterator[Frame]:
    for frame in frames:
        advance()
        yield frame


def _train(
    recipe: Recipe,
    rules: Rules,
    data: TrainingData,
    held: TrainingData | None,
    device: str,
    checkpoint: Path | None,
    every: int,
    *,
    quiet: bool,
) -> TrainingResult:
    from upbeam.model.train import total_steps, train_networks

    with progress_bar("training two networks", total_steps(recipe, data), quiet=quiet) as advance:
        done = {"distance": 0, "intensity": 0}
        kept_back: dict[str, str] = {}

        def show_progress(name: str, step: int, steps: int, loss: float, validation: float | None) -> None:
            if validation is not None:
                kept_back[name] = f", kept back {validation:.4f}"
            advance(step - done[name], f"{name} loss {loss:.4f}{kept_back.get(name, '')}")
            done[name] = step

        return train_networks(
            recipe,
            data,
            rules,
            show_progress,
            device=device,
            checkpoint=checkpoint,
            checkpoint_every=every,
            validation=held,
        )


def _write(out: Path, rules: Rules, result: TrainingResult, provenance: dict[str, Any]) -> dict[str, Any]:
    """The model, its losses as a table and as a picture."""
    from upbeam.model.train import save_networks

    write_log(out, result.losses, result.validation)
    if out.suffix == ".pt":
        save_networks(out, result.modules, rules, provenance)
        return {"bytes": out.stat().st_size}
    data = write_ubm(out, ModelFile.from_dense(rules, result.networks, provenance=provenance))
    return {"bytes": len(data), "crc32": f"{load_model(out).crc32:08x}"}


def _provenance(recipe: Recipe, result: TrainingResult, device: str, changes: Mapping[str, int]) -> dict[str, Any]:
    return common_provenance(recipe, device, changes, {"samples": result.samples, "sample": _unit(recipe)})


def common_provenance(
    recipe: BaseRecipe, device: str, changes: Mapping[str, int], extent: Mapping[str, Any]
) -> dict[str, Any]:
    """``changes``: what the command line changed of the recipe; ``extent``: how much was trained on."""
    import torch

    from upbeam.model.train import pick_device

    return {
        "recipe": recipe.name,
        **({"changes": dict(changes)} if changes else {}),
        "seed": recipe.seed,
        "data": [describe_source(source) for source in recipe.data],
        "frames": sum(source_frames(source) for source in recipe.data),
        **extent,
        "trained": datetime.datetime.now(datetime.timezone.utc).date().isoformat(),
        "versions": {"upbeam": upbeam.__version__, "torch": torch.__version__, "numpy": np.__version__},
        "machine": platform.machine(),
        "device": pick_device(device).type,
        "licence": "Apache-2.0" if all(map(may_ship, recipe.data)) else "as the training data's",
    }


def _unit(recipe: Recipe) -> str:
    return "images" if recipe.training.batch_images else "windows"


def validate(recipe: BaseRecipe, rules: Rules, trained: Mapping[str, Method], *, quiet: bool) -> dict[str, Any]:
    """What was trained beside the baselines, on frames that were kept back."""
    methods = {**BASELINES, **trained}
    total = sum(source_frames(source) for source in recipe.validation)
    with progress_bar("judging on frames kept back", total, quiet=quiet) as advance:
        frames = recipe_frames(recipe, rules, recipe.validation)
        judged = run_evaluation(frames, methods, rules, lambda _: advance())
    means = judged.means()
    if not quiet:
        shown = ("chamfer_m2", "mae_m", "intensity_mae", "ghost_share")
        rows = [[name, *(f"{m[key]:.3f}" for key in shown)] for name, m in means.items()]
        title = f"{total} frames kept back, {recipe.rows} rows, generated rows only (measured)"
        show(table(title, ["method", "Chamfer m2", "MAE m", "grey", "ghost share"], rows))
    data = [describe_source(source) for source in recipe.validation]
    return {"frames": len(judged.frames), "data": data, "methods": means}


def write_log(out: Path, losses: Losses, held: Losses) -> None:
    """Losses, and those of the validation frames (``held``, empty where there are none), beside ``out`` as a table and
    as a picture."""
    _write_table(out.with_suffix(".csv"), losses, held)
    _plot_log(out.with_suffix(".png"), losses, held)


def _write_table(path: Path, losses: Losses, held: Losses) -> None:
    """``validation_loss`` stands at the steps at which it was measured."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["network", "step", "loss", "validation_loss"])
        for name, rows in losses.items():
            measured = {step: f"{loss:.6g}" for step, loss in held.get(name, ())}
            writer.writerows([name, step, f"{loss:.6g}", measured.get(step, "")] for step, loss in rows)


def _plot_log(path: Path, losses: Losses, held: Losses) -> None:
    """Over steps, of every network: as it was trained (mean since the point before), and on frames kept back."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 3.2), layout="constrained")
    panels = figure.subplots(1, len(losses), squeeze=False)[0]
    for axes, (name, rows) in zip(panels, losses.items(), strict=True):
        axes.plot(*zip(*rows, strict=True), linewidth=1.2, label="training")
        if held.get(name):
            axes.plot(*zip(*held[name], strict=True), linewidth=1.2, linestyle="--", label="frames kept back")
            axes.legend(frameon=False)
        axes.set(title=f"{name} network", xlabel="step", ylabel="loss", yscale="log")
        axes.grid(alpha=0.3, which="both")
    figure.savefig(path, dpi=110)
