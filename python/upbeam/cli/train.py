"""``upbeam train``: a recipe in, a model file out."""

from __future__ import annotations

import csv
import datetime
import platform
from collections.abc import Callable
from pathlib import Path
from time import monotonic
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

import upbeam
from upbeam.model.baselines import BASELINES
from upbeam.model.evaluate import evaluate as run_evaluation
from upbeam.model.recipe import DataRecipe, Recipe, load_recipe, recipe_names
from upbeam.model.rules import Rules
from upbeam.quant.ubm import ModelFile, write_ubm
from upbeam.runtime.upsampler import load_model

from .common import JsonOption, UserError, emit_json, message, progress_bar, show, table
from .evaluate import evaluate_folder, evaluation_dict, evaluation_table
from .sources import recipe_frames, source_frames

if TYPE_CHECKING:
    from upbeam.model.train import TrainingData, TrainingResult

__all__ = ["train"]

Losses = dict[str, list[tuple[int, float]]]


def train(
    recipe: Annotated[str, typer.Option(help=f"A recipe ({', '.join(recipe_names())}) or a .yaml file.")] = "default",
    out: Annotated[
        Path,
        typer.Option(
            help="The model file to write (.ubm; .pt for networks that a model file cannot hold); the losses go beside "
            "it as .csv and .png."
        ),
    ] = Path("model.ubm"),
    evaluate: Annotated[str | None, typer.Option(help="A folder of KITTI .bin frames to judge the result on.")] = None,
    checkpoint: Annotated[
        Path | None, typer.Option(help="A file to keep the run's state in; where it exists, the run goes on from it.")
    ] = None,
    checkpoint_every: Annotated[int, typer.Option(min=1, help="Steps between two checkpoints.")] = 500,
    device: Annotated[str, typer.Option(help="auto (a GPU where there is one), cpu or cuda.")] = "auto",
    as_json: JsonOption = False,
) -> None:
    """Fit the distance and the intensity network. Needs PyTorch: pip install 'upbeam[train]'."""
    chosen = load_recipe(recipe)
    _check_files(chosen, out, checkpoint, evaluate)
    try:
        import torch  # noqa: F401
    except ImportError:
        raise UserError("training needs PyTorch: pip install 'upbeam[train]' (make test-train installs it)") from None
    from upbeam.model.train import pick_device

    pick_device(device)
    rules = chosen.make_rules()
    data = _collect(chosen, rules, quiet=as_json)
    begin = monotonic()
    result = _train(chosen, rules, data, device, checkpoint, checkpoint_every, quiet=as_json)
    seconds = monotonic() - begin
    provenance = _provenance(chosen, result, device)
    summary = {"model": str(out), "seconds": round(seconds, 1), **provenance, **_write(out, rules, result, provenance)}
    message(f"{out}: trained on {result.samples} {_unit(chosen)} in {seconds:.0f} s")
    if chosen.validation:
        summary["validation"] = _validate(chosen, rules, result, quiet=as_json)
    if evaluate is not None:
        model = load_model(out)
        judged = evaluate_folder(evaluate, model)
        summary["evaluation"] = evaluation_dict(judged, model)
        if not as_json:
            show(evaluation_table(judged, f"{evaluate}: {len(judged.frames)} frames, generated rows only"))
    if as_json:
        emit_json(summary)


def _check_files(recipe: Recipe, out: Path, checkpoint: Path | None, evaluate: str | None) -> None:
    """Before hours of training rather than after."""
    exportable = all(network.exportable for network in recipe.networks.values())
    if exportable and out.suffix != ".ubm":
        raise UserError(f"{out}: a model file ends in .ubm")
    if not exportable and out.suffix != ".pt":
        raise UserError(
            f"recipe {recipe.name} has networks of more than one hidden layer, which a model file cannot hold: "
            f"--out {out} must end in .pt"
        )
    if not exportable and evaluate is not None:
        raise UserError(
            "--evaluate needs a model file; networks of more than one hidden layer: name frames in validation"
        )
    for path in (out, checkpoint):
        if path is not None and not path.parent.is_dir():
            raise UserError(f"{path}: the folder {path.parent} does not exist")


def _collect(recipe: Recipe, rules: Rules, *, quiet: bool) -> TrainingData:
    """Windows drawn from the recipe's frames, or the frames themselves."""
    from upbeam.model.train import collect_samples

    count = sum(source_frames(source) for source in recipe.data)
    with progress_bar("making training frames", count, quiet=quiet) as advance:
        frames = _counted(recipe_frames(recipe, rules), advance)
        if recipe.training.batch_images:
            return list(frames)
        return collect_samples(frames, rules, recipe.windows, count, recipe.seed)


def _counted(frames: Any, advance: Callable[[], None]) -> Any:
    for frame in frames:
        advance()
        yield frame


def _train(
    recipe: Recipe, rules: Rules, data: TrainingData, device: str, checkpoint: Path | None, every: int, *, quiet: bool
) -> TrainingResult:
    from upbeam.model.train import total_steps, train_networks

    with progress_bar("training two networks", total_steps(recipe, data), quiet=quiet) as advance:
        done = {"distance": 0, "intensity": 0}

        def show_progress(name: str, step: int, steps: int, loss: float) -> None:
            advance(step - done[name], f"{name} loss {loss:.4f}")
            done[name] = step

        return train_networks(
            recipe, data, rules, show_progress, device=device, checkpoint=checkpoint, checkpoint_every=every
        )


def _write(out: Path, rules: Rules, result: TrainingResult, provenance: dict[str, Any]) -> dict[str, Any]:
    """The model, its losses as a table and as a picture."""
    from upbeam.model.train import save_networks

    _write_log(out.with_suffix(".csv"), result.losses)
    _plot_log(out.with_suffix(".png"), result.losses)
    if out.suffix == ".pt":
        save_networks(out, result.modules)
        return {"bytes": out.stat().st_size}
    data = write_ubm(out, ModelFile.from_dense(rules, result.networks, provenance=provenance))
    return {"bytes": len(data), "crc32": f"{load_model(out).crc32:08x}"}


def _provenance(recipe: Recipe, result: TrainingResult, device: str) -> dict[str, Any]:
    import torch

    from upbeam.model.train import pick_device

    return {
        "recipe": recipe.name,
        "seed": recipe.seed,
        "data": [_describe(source) for source in recipe.data],
        "frames": sum(source_frames(source) for source in recipe.data),
        "samples": result.samples,
        "sample": _unit(recipe),
        "trained": datetime.datetime.now(datetime.timezone.utc).date().isoformat(),
        "versions": {"upbeam": upbeam.__version__, "torch": torch.__version__, "numpy": np.__version__},
        "machine": platform.machine(),
        "device": pick_device(device).type,
        "licence": "Apache-2.0" if all(s.source == "simulator" for s in recipe.data) else "as the training data's",
    }


def _unit(recipe: Recipe) -> str:
    return "images" if recipe.training.batch_images else "windows"


def _describe(source: DataRecipe) -> str:
    if source.source == "simulator":
        how = "" if source.projection == "aligned" else f", projected as recordings are at {source.rate_hz:g} Hz"
        return f"upbeam simulator, {source.frames} frames, seed {source.seed}{how}"
    drives = f", only {', '.join(source.only_drives)}" if source.only_drives else ""
    drives += f", without {', '.join(source.without_drives)}" if source.without_drives else ""
    return f"KITTI-format recordings, {source_frames(source)} frames{drives} (non-commercial licence)"


def _validate(recipe: Recipe, rules: Rules, result: TrainingResult, *, quiet: bool) -> dict[str, Any]:
    """The trained networks beside the baselines, on frames that were kept back; computed in float64."""
    from upbeam.model.train import torch_method

    methods = {**BASELINES, recipe.name: torch_method(result.modules)}
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
    return {"frames": len(judged.frames), "data": [_describe(source) for source in recipe.validation], "methods": means}


def _write_log(path: Path, log: Losses) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["network", "step", "loss"])
        writer.writerows([name, step, f"{loss:.6g}"] for name, rows in log.items() for step, loss in rows)


def _plot_log(path: Path, log: Losses) -> None:
    """Losses over steps, both networks, as they were trained (mean since the point before)."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 3.2), layout="constrained")
    for axes, (name, rows) in zip(figure.subplots(1, len(log)), log.items(), strict=True):
        axes.plot(*zip(*rows, strict=True), linewidth=1.2)
        axes.set(title=f"{name} network", xlabel="step", ylabel="training loss", yscale="log")
        axes.grid(alpha=0.3, which="both")
    figure.savefig(path, dpi=110)
