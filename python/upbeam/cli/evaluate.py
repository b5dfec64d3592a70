"""``upbeam evaluate``: accuracy of the model beside every baseline, on recorded or simulated frames."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from itertools import islice
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray

from upbeam.model.baselines import BASELINES, Method
from upbeam.model.beams import beam_table
from upbeam.model.evaluate import Evaluation
from upbeam.model.evaluate import evaluate as run_evaluation
from upbeam.model.frames import Frame, kitti_files, kitti_frames
from upbeam.model.metrics import GENERATED
from upbeam.model.rules import Rules
from upbeam.runtime.upsampler import Model, Upsampler, load_model

from .common import JsonOption, UserError, emit_json, message, progress_bar, show, table
from .sources import frame_of_scan, simulated_scans

__all__ = ["evaluate", "evaluate_folder", "evaluation_table", "model_method"]

U16 = NDArray[np.uint16]
U8 = NDArray[np.uint8]


def evaluate(
    source: Annotated[str, typer.Argument(help="'sim', a KITTI .bin file, or a folder of them.")],
    model: Annotated[str | None, typer.Option(help="A .ubm model instead of the shipped one.")] = None,
    frames: Annotated[int | None, typer.Option(min=1, help="At most so many frames (sim: 20).")] = None,
    rows: Annotated[str, typer.Option(help="ring or elevation (the paper's binning).")] = "ring",
    seed: Annotated[int, typer.Option(min=0, help="Of the simulator; training used 1000 and up.")] = 1,
    as_json: JsonOption = False,
) -> None:
    """Compare generated rows with the real ones that were hidden: even rows in, odd rows 1 to 61 judged."""
    if rows not in ("ring", "elevation"):
        raise UserError(f"--rows {rows}: expected ring or elevation")
    loaded = load_model(model)
    found, total = _frames(source, loaded, frames, "ring" if rows == "ring" else "elevation", seed)
    result = _run(found, total, loaded, quiet=as_json)
    if as_json:
        emit_json({"source": source, "rows": rows, **evaluation_dict(result, loaded)})
    else:
        show(evaluation_table(result, f"{source}: {len(result.frames)} frames, {rows} rows, generated rows only"))
        message(
            "measured on these frames. x: ratio to valid-mean. Chamfer: m2, mean of squares, both ways; "
            "MAE: metres, where a return exists; grey: intensity MAE, 8-bit steps; "
            "ghosts: generated points over 0.5 m from any real one; cover: real returns that got a point."
        )


def evaluate_folder(folder: str, model: Model) -> Evaluation:
    """Every method on every KITTI frame of a folder, ring rows."""
    return _run(kitti_frames(folder, model.rules), len(kitti_files(folder)), model)


def model_method(model: Model) -> Method:
    """The C runtime behind the interface of the baselines."""
    upsampler = Upsampler(model)

    def run(distance: U16, intensity: U8, rules: Rules) -> tuple[U16, U8]:
        d, i = upsampler(distance, intensity)
        return d[GENERATED], i[GENERATED]

    return run


def _frames(source: str, model: Model, limit: int | None, rows: Any, seed: int) -> tuple[Iterable[Frame], int]:
    if source == "sim":
        base = model.rules.sensor.removesuffix("/2")
        if base == model.rules.sensor:
            raise UserError(
                f"the model is made for {base}: its generated rows have no simulated truth; give recorded frames"
            )
        count = limit or 20
        scans = simulated_scans(beam_table(base), columns=model.columns, frames=count, seed=seed, frames_per_scene=1)
        return map(frame_of_scan, scans), count
    total = len(kitti_files(source))
    return islice(kitti_frames(source, model.rules, rows=rows), limit), min(total, limit or total)


def _run(frames: Iterable[Frame], total: int, model: Model, *, quiet: bool = False) -> Evaluation:
    methods: Mapping[str, Method] = {**BASELINES, "upbeam-fp32": model_method(model)}
    with progress_bar("evaluating frames", total, quiet=quiet) as advance:
        return run_evaluation(frames, methods, model.rules, lambda _: advance())


def evaluation_dict(result: Evaluation, model: Model) -> dict[str, Any]:
    return {"frames": len(result.frames), "methods": result.means(), "model_crc32": f"{model.crc32:08x}"}


def evaluation_table(result: Evaluation, title: str) -> Any:
    means = result.means()
    base = means["valid-mean"]

    def pair(m: dict[str, float], key: str, digits: int) -> list[str]:
        return [f"{m[key]:.{digits}f}", f"{m[key] / base[key]:.2f}"]

    rows = [
        [
            name,
            *pair(m, "chamfer_m2", 3),
            *pair(m, "mae_m", 3),
            *pair(m, "intensity_mae", 1),
            f"{100 * m['ghost_share']:.1f} %",
            f"{100 * m['coverage']:.1f} %",
        ]
        for name, m in means.items()
    ]
    return table(title, ["method", "Chamfer", "x", "MAE", "x", "grey", "x", "ghosts", "cover"], rows)
