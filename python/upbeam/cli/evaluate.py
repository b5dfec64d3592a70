"""``upbeam evaluate``: accuracy of models beside every baseline, on recorded or simulated frames."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray

from upbeam.hw_sim.primitives import Surface
from upbeam.model.baselines import BASELINES, Method
from upbeam.model.beams import beam_table
from upbeam.model.evaluate import BASE, Evaluation, Interval, in_unit, paired_ratio, with_limits
from upbeam.model.evaluate import evaluate as run_evaluation
from upbeam.model.frames import Frame, RowRule, kitti_files, kitti_frames
from upbeam.model.metrics import BANDS_M
from upbeam.model.network import NetworkError
from upbeam.model.rules import BEAMS, Rules, upsample_reference
from upbeam.model.tulip import TulipMetrics, evaluate_tulip, tulip_frames, tulip_rules
from upbeam.runtime.upsampler import Model, Upsampler, load_model

from .common import JsonOption, UserError, emit_json, message, progress_bar, show, table
from .sources import frame_of_scan, kitti_files_of_drives, simulated_scans

__all__ = [
    "Table",
    "band_names",
    "evaluate",
    "evaluate_folder",
    "evaluation_dict",
    "evaluation_table",
    "model_method",
    "ratio_text",
]

U16 = NDArray[np.uint16]
U8 = NDArray[np.uint8]
FloatArray = NDArray[np.float64]

SHIPPED = "upbeam-fp32"
CAPTURES = (".pcap", ".db3")
PASSES = 50
"""Of Shan's U-Net, as published (``shan.PASSES``; here so that no command needs PyTorch to start)."""
NAME_WIDTH = 13
ACCURACY = ("Chamfer", "MAE", "both", "ghosts", "cover")
SURFACES = {int(s): s.name.lower() for s in Surface}
"""Names of the simulator's labels."""
NOTE = (
    "measured on these frames. Chamfer: m2, mean of squares, both ways; MAE: metres where a return exists; both: where "
    "both exist; grey: intensity MAE, 8-bit steps; ghosts, missed: over 0.5 m from any point of the other side; cover: "
    f"real returns that got a point. Ratios are to {BASE} on the same frames, ± half a 95 % interval over frames."
)
TULIP_NOTE = (
    "measured on these frames by TULIP's protocol: 16 x 1024 in, 64 x 1024 out, 80 m; MAE: metres, all pixels, no "
    "return = 0; Chamfer: m2, mean of squares, both ways; empty pixels at the origin; voxels of 0.1 m. "
    "docs/metrics.md says what differs."
)


@dataclass(frozen=True)
class Table:
    """Cells as text; the first of each row is its name."""

    title: str
    columns: list[str]
    rows: list[list[str]]
    note: str = ""


@dataclass(frozen=True)
class _Source:
    """Frames, how many at most, and what they are."""

    frames: Iterable[Frame]
    count: int
    rows: str


def evaluate(
    source: Annotated[
        str, typer.Argument(help="'sim', a KITTI .bin file, a folder of them, or a capture (.pcap, .db3).")
    ],
    model: Annotated[
        list[str] | None,
        typer.Option(help="A .ubm model instead of the shipped one; may be given several times."),
    ] = None,
    beside: Annotated[
        list[str] | None,
        typer.Option(
            "--with",
            help="Another method beside all others: a .ubm model, or a .pt file of upbeam train; several times.",
        ),
    ] = None,
    passes: Annotated[int, typer.Option(min=2, help="Monte-Carlo passes of Shan's U-Net.")] = PASSES,
    frames: Annotated[int | None, typer.Option(min=1, help="At most so many frames (sim: 20).")] = None,
    drive: Annotated[
        list[str] | None, typer.Option(help="Only frames of this drive of the folder's drives.tsv; several times.")
    ] = None,
    rows: Annotated[str, typer.Option(help="ring or elevation (the paper's binning).")] = "ring",
    columns: Annotated[
        int | None, typer.Option(min=4, max=65535, help="Width of the images, where not the model's.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of the simulator; training used 1000 and up.")] = 1,
    full: Annotated[bool, typer.Option("--full", help="Voxels and whole clouds as well.")] = False,
    bands: Annotated[bool, typer.Option("--bands", help="By range band, and by surface in simulation.")] = False,
    protocol: Annotated[str, typer.Option(help="upbeam, or tulip: 16 -> 64 rows x 1024, KITTI.")] = "upbeam",
    report: Annotated[Path | None, typer.Option(help="Folder for evaluate.html with pictures of one frame.")] = None,
    as_json: JsonOption = False,
) -> None:
    """Compare generated rows with the real ones that were hidden: even rows in, odd rows between them judged."""
    if rows not in ("ring", "elevation"):
        raise UserError(f"--rows {rows}: expected ring or elevation")
    if protocol not in ("upbeam", "tulip"):
        raise UserError(f"--protocol {protocol}: expected upbeam or tulip")
    models = _models(model or [])
    first = next(iter(models.values()))
    methods = _methods(models)
    others, unets = _beside(beside or [], models, methods, passes)
    if protocol == "tulip":
        if report is not None or full or bands or columns or rows != "ring":
            raise UserError(
                "--protocol tulip sets its own rows, columns and metrics: no --report, --full, --bands, ..."
            )
        if drive:
            raise UserError("--protocol tulip judges every frame of a folder: no --drive")
        _tulip(source, methods, first, frames, as_json=as_json)
        return
    found = _source(source, first, frames, "ring" if rows == "ring" else "elevation", columns, seed, drive or ())
    pictured: list[Frame] = []

    def keep_first(frame: Frame) -> None:
        if not pictured:
            pictured.append(frame)

    result = _run(found, methods, first, keep_first, full=full, parts=bands or report is not None, quiet=as_json)
    summary = {
        "source": source,
        "rows": found.rows,
        "columns": int(pictured[0].distance.shape[1]),
        "models": {name: _model_dict(m) for name, m in {**models, **others}.items()},
        **({"monte_carlo_passes": dict.fromkeys(unets, passes)} if unets else {}),
        **({"drives": drive} if drive else {}),
        **evaluation_dict(result, first),
    }
    title = f"{source}: {len(result.frames)} frames, {found.rows} rows"
    if report is not None:
        from .evaluate_report import write_evaluation_report  # loads matplotlib

        chosen = {name: methods[name] for name in (BASE, *models, *(n for n in methods if n not in BASELINES))}
        tables = _tables(result, title, bands=True, full=full)
        path = write_evaluation_report(report, title, result, summary, tables, pictured[0], chosen, first.rules)
        message(f"report: {path}")
    if as_json:
        emit_json(summary)
    else:
        for part in _tables(result, title, bands=bands, full=full):
            show(_rich(part))
        message(NOTE + (f" {', '.join(unets)}: {passes} Monte-Carlo passes." if unets else ""))


def _model_dict(model: Model) -> dict[str, Any]:
    return {
        "crc32": f"{model.crc32:08x}",
        "sensor": model.rules.sensor,
        "multiply_adds_per_window": model.file.folded[0].multiply_adds,
    }


def evaluate_folder(folder: str, model: Model) -> Evaluation:
    """Every method on every KITTI frame of a folder, ring rows."""
    source = _Source(kitti_frames(folder, model.rules), len(kitti_files(folder)), "ring")
    return _run(source, _methods({SHIPPED: model}), model)


def model_method(model: Model) -> Method:
    """A model behind the interface of the baselines, under the caller's range limits.

    The C runtime computes frames of 32 given rows in the model's own unit and limits; any other frame is computed by
    the reference, which takes any number of rows.
    """
    upsamplers: dict[int, Upsampler] = {}

    def run(distance: U16, intensity: U8, rules: Rules) -> tuple[U16, U8]:
        own = in_unit(model.rules, rules.distance_unit_m)
        if own is model.rules and len(distance) == BEAMS and _same_limits(own, rules):
            width = distance.shape[1]
            if width not in upsamplers:
                upsamplers[width] = Upsampler(model, columns=None if width == model.columns else width)
            d, i = upsamplers[width](distance, intensity)
        else:
            limited = with_limits(own, rules.min_count, rules.max_count)
            d, i = upsample_reference(distance, intensity, model.file.folded, limited)
        return d[1:-1:2], i[1:-1:2]

    return run


def _same_limits(a: Rules, b: Rules) -> bool:
    return (a.min_count, a.max_count) == (b.min_count, b.max_count)


def _models(paths: Sequence[str]) -> dict[str, Model]:
    """Models by the name of their method: the file's stem, or the shipped one's."""
    if not paths:
        return {SHIPPED: load_model()}
    models: dict[str, Model] = {}
    for path in paths:
        name = Path(path).stem
        if name in models or name in BASELINES:
            raise UserError(f"--model {path}: another method is called {name}; rename the file")
        models[name] = load_model(path)
    return models


def _beside(
    paths: Sequence[str], models: Mapping[str, Model], methods: dict[str, Method], passes: int
) -> tuple[dict[str, Model], list[str]]:
    """Adds the files' methods to ``methods`` by their stems; gives the models among them, and the U-Nets' names."""
    found: dict[str, Model] = {}
    unets: list[str] = []
    for path in paths:
        name = Path(path).stem
        if name in methods:
            raise UserError(f"--with {path}: another method is called {name}; rename the file")
        if Path(path).suffix != ".pt":
            found[name] = load_model(path)
            methods[name] = model_method(found[name])
            continue
        methods[name], is_unet = _torch_file(path, passes)
        if is_unet:
            unets.append(name)
    return found, unets


def _torch_file(path: str, passes: int) -> tuple[Method, bool]:
    """The method of a .pt file of ``upbeam train``, and whether it is Shan's U-Net, which uses a GPU where there is
    one."""
    if not Path(path).is_file():
        raise UserError(f"{path}: no such file")
    try:
        import torch  # noqa: F401
    except ImportError:
        raise UserError(f"{path} needs PyTorch: pip install 'upbeam[train]'") from None
    from upbeam.model.shan import is_shan, load_shan, shan_method
    from upbeam.model.train import networks_method, pick_device

    if is_shan(path):
        return shan_method(load_shan(path).to(pick_device("auto")), passes), True
    try:
        return networks_method(path), False
    except NetworkError as error:
        raise UserError(f"{error}; expected a file of upbeam train") from None


def _methods(models: Mapping[str, Model]) -> dict[str, Method]:
    return {**BASELINES, **{name: model_method(model) for name, model in models.items()}}


# --------------------------------------------------------------------------------------------------------- frames


def _source(
    source: str,
    model: Model,
    limit: int | None,
    rows: RowRule,
    columns: int | None,
    seed: int,
    drives: Sequence[str] = (),
) -> _Source:
    capture = Path(source).suffix.lower() in CAPTURES
    if drives and (source == "sim" or capture or not Path(source).is_dir()):
        raise UserError(f"--drive is of a folder of KITTI frames, {source} is none")
    if source == "sim":
        return _simulated(model, limit or 20, columns, seed)
    if capture:
        from upbeam.model.recordings import capture_frames

        found = list(islice(capture_frames(source, columns=columns), limit))
        return _Source(found, len(found), "laser")
    files = (kitti_files_of_drives(Path(source), drives) if drives else kitti_files(source))[:limit]
    made = (frame for file in files for frame in kitti_frames(file, model.rules, columns=columns, rows=rows))
    return _Source(made, len(files), rows)


def _simulated(model: Model, count: int, columns: int | None, seed: int) -> _Source:
    base = model.rules.sensor.removesuffix("/2")
    if base == model.rules.sensor:
        raise UserError(
            f"the model is made for {base}: its generated rows have no simulated truth; give recorded frames"
        )
    width = columns or model.columns
    scans = simulated_scans(beam_table(base), columns=width, frames=count, seed=seed, frames_per_scene=1)
    return _Source(map(frame_of_scan, scans), count, "ring")


def _run(
    source: _Source,
    methods: Mapping[str, Method],
    model: Model,
    on_frame: Callable[[Frame], None] = lambda frame: None,
    *,
    full: bool = False,
    parts: bool = False,
    quiet: bool = False,
) -> Evaluation:
    with progress_bar("evaluating frames", source.count, quiet=quiet) as advance:

        def seen(frame: Frame) -> None:
            on_frame(frame)
            advance()

        return run_evaluation(
            source.frames, methods, model.rules, seen, full=full, parts=parts, surfaces=SURFACES if parts else None
        )


# --------------------------------------------------------------------------------------------------------- results


def evaluation_dict(result: Evaluation, model: Model) -> dict[str, Any]:
    """For JSON: means per method, ratios with intervals, parts where they were asked for. Undefined values are null."""
    data: dict[str, Any] = {
        "frames": len(result.frames),
        "methods": {name: _plain(metrics) for name, metrics in result.means().items()},
        "ratio_to": BASE,
        "ratio": {name: _intervals(metrics) for name, metrics in result.ratios().items()},
        "model_crc32": f"{model.crc32:08x}",
    }
    if result.parts:
        data["parts"] = {
            part: {name: _plain(metrics) for name, metrics in methods.items()}
            for part, methods in _sorted_parts(result).items()
        }
    return data


def _plain(metrics: Mapping[str, float]) -> dict[str, float | None]:
    return {key: _finite(value) for key, value in metrics.items()}


def _intervals(metrics: Mapping[str, Interval]) -> dict[str, dict[str, float | None]]:
    return {k: {"value": _finite(v.value), "low": v.low, "high": v.high} for k, v in metrics.items()}


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _sorted_parts(result: Evaluation) -> dict[str, dict[str, dict[str, float]]]:
    """Range bands from near to far, then surfaces."""
    means = result.part_means()
    order = [*band_names(), *SURFACES.values()]
    return {part: means[part] for part in sorted(means, key=lambda p: order.index(p) if p in order else len(order))}


def evaluation_table(result: Evaluation, title: str) -> Any:
    """Means over the frames, to be shown."""
    return _rich(_means_table(result, title))


def _tables(result: Evaluation, title: str, *, bands: bool, full: bool) -> list[Table]:
    made = [_means_table(result, title), _ratio_table(result)]
    if full:
        made += [_voxel_table(result), _chamfer_table(result)]
    return made + _part_tables(result) if bands else made


def _rich(part: Table) -> Any:
    return table(part.title, part.columns, [[_short(name), *cells] for name, *cells in part.rows])


def _means_table(result: Evaluation, title: str) -> Table:
    rows = [
        [name, *_accuracy(m), _percent(m["missed_share"]), _number(m["intensity_mae"], 1)]
        for name, m in result.means().items()
    ]
    return Table(title, ["method", *ACCURACY, "missed", "grey"], rows)


def _accuracy(m: Mapping[str, float]) -> list[str]:
    """Cells under ``ACCURACY``."""
    lengths = [_number(m.get(key), 3) for key in ("chamfer_m2", "mae_m", "mae_both_m")]
    return [*lengths, *(_percent(m.get(key)) for key in ("ghost_share", "coverage"))]


def _ratio_table(result: Evaluation) -> Table:
    keys = ("chamfer_m2", "mae_m", "mae_both_m", "ghost_share", "intensity_mae")
    rows = [
        [name, *(ratio_text(ratios[key]) for key in keys)] for name, ratios in result.ratios().items() if name != BASE
    ]
    return Table(f"ratio to {BASE}", ["method", "Chamfer", "MAE", "both", "ghosts", "grey"], rows)


def _voxel_table(result: Evaluation) -> Table:
    keys = ("iou", "precision", "recall", "f1")
    rows = [
        [name, *(_number(m[f"{cloud}voxel_{key}"], 3) for cloud in ("", "cloud_") for key in keys)]
        for name, m in result.means().items()
    ]
    return Table(
        "voxels of 0.1 m: generated rows, then the whole cloud",
        ["method", *(["IoU", "prec.", "rec.", "F1"] * 2)],
        rows,
    )


def _chamfer_table(result: Evaluation) -> Table:
    keys = ("chamfer_m2", "chamfer_m", "chamfer_origin_m2")
    rows = [
        [name, *(_number(m[f"{cloud}{key}"], 3) for cloud in ("", "cloud_") for key in keys)]
        for name, m in result.means().items()
    ]
    return Table(
        "Chamfer (squares and origin: m2, dist.: m): generated rows, then the whole cloud",
        ["method", *(["squares", "dist.", "origin"] * 2)],
        rows,
    )


def _part_tables(result: Evaluation) -> list[Table]:
    return [
        Table(part, ["method", *ACCURACY], [[name, *_accuracy(m)] for name, m in methods.items()])
        for part, methods in _sorted_parts(result).items()
    ]


def band_names() -> list[str]:
    return [f"{low:g}-{high:g} m" for low, high in BANDS_M]


def ratio_text(ratio: Interval) -> str:
    """``0.75 ±0.03``"""
    if not math.isfinite(ratio.value):
        return "-"
    width = ratio.half_width
    return f"{ratio.value:.2f}" if width is None else f"{ratio.value:.2f} ±{width:.2f}"


def _short(name: str) -> str:
    """Tables fit 80 columns."""
    return name if len(name) <= NAME_WIDTH else name[: NAME_WIDTH - 1] + "…"


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None or not math.isfinite(value) else f"{value:.{digits}f}"


def _percent(value: float | None) -> str:
    return "-" if value is None or not math.isfinite(value) else f"{100 * value:.1f} %"


# ----------------------------------------------------------------------------------------------------------- TULIP


def _tulip(source: str, methods: Mapping[str, Method], model: Model, limit: int | None, *, as_json: bool) -> None:
    if source == "sim" or Path(source).suffix.lower() in CAPTURES:
        raise UserError(f"{source}: TULIP's protocol judges KITTI .bin frames")
    total = len(kitti_files(source))
    rules = tulip_rules(model.rules)
    with progress_bar("evaluating frames", min(total, limit or total), quiet=as_json) as advance:
        frames = islice(tulip_frames(source, rules), limit)
        result = evaluate_tulip(frames, methods, rules, lambda _: advance())
    values = {name: _tulip_values(rows) for name, rows in result.items()}
    count = len(result[BASE])
    if as_json:
        emit_json({"source": source, "protocol": "tulip", "frames": count, **_tulip_dict(values)})
        return
    title = f"{source}: {count} frames, TULIP's protocol"
    show(_rich(Table(title, ["method", "MAE", "Chamfer", "IoU", "prec.", "recall", "F1"], _tulip_rows(values))))
    message(TULIP_NOTE)


def _tulip_values(rows: Sequence[TulipMetrics]) -> dict[str, FloatArray]:
    as_dicts = [row.as_dict() for row in rows]
    return {key: np.asarray([row[key] for row in as_dicts]) for key in as_dicts[0]}


def _tulip_dict(values: Mapping[str, Mapping[str, FloatArray]]) -> dict[str, Any]:
    base = values[BASE]
    return {
        "methods": {name: {k: float(v.mean()) for k, v in metrics.items()} for name, metrics in values.items()},
        "ratio_to": BASE,
        "ratio": {
            name: _intervals({k: paired_ratio(v, base[k]) for k, v in metrics.items()})
            for name, metrics in values.items()
        },
    }


def _tulip_rows(values: Mapping[str, Mapping[str, FloatArray]]) -> list[list[str]]:
    return [
        [_short(name), *(_number(float(v.mean()), 3) for v in metrics.values())] for name, metrics in values.items()
    ]
