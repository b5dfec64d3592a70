"""``upbeam quantize``: float networks -> integer networks in the same file, and how far they are from them."""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, cast, get_args

import numpy as np
import typer
from numpy.typing import NDArray

import upbeam
from upbeam.model.baselines import BASELINES
from upbeam.model.evaluate import BASE, Interval
from upbeam.model.frames import Frame
from upbeam.quant.accuracy import FLOAT, Comparison, Summary, Variant, compare, integer_variant
from upbeam.quant.export import ExportError
from upbeam.quant.integer import CONTRACTS, OverflowProofError, Precision
from upbeam.quant.quantize import Calibration, Rounding, calibration_windows
from upbeam.quant.quantize import quantize as quantize_model
from upbeam.quant.schemes import narrow_variant, network_problems, scheme_variants, widest_unit
from upbeam.quant.sizes import weight_bytes
from upbeam.quant.ubm import ModelFile, write_ubm
from upbeam.quant.verify import golden_digests
from upbeam.runtime.upsampler import load_model

from .common import JsonOption, UserError, emit_json, message, progress_bar, show, table
from .evaluate import Table
from .frames import SIMULATED, FrameSet, model_frames

__all__ = ["NOTE", "Result", "quantize"]

I64 = NDArray[np.int64]

SIMULATED_FRAMES = 12
"""Made where none are given: three quarters to calibrate on, the rest to judge on."""
KEPT_BACK = 4
"""Every so many-th frame of the calibration's source is judged on instead, where no other frames are named."""
PEER_MODULE = "upbeam.quant.export.onnx_qdq"
PEER_METHODS = ("minmax", "percentile", "entropy")
PEER = "ORT"
PEER_GRAPHS = {"folded": "", "difference": ", d."}
"""The exported graph (pixels in), and the one that suits it best: differences in, the minimum added in float."""
NARROW = "W8A16"
NOTE = (
    "measured on these frames with the reference of the integer contract. Against float: generated points of the "
    "integer networks less those of the float ones, mm; moved: by more than 10 cm; coarse: windows whose differences "
    "their code rounds; cut: windows with a difference it limits; flips: points that only one of the two generates; "
    "ghosts: points over 0.5 m from any real one that float does not make, and those it makes and they do not; "
    "bytes: weights of both networks."
)


@dataclass(frozen=True)
class Result:
    """What was made and what was measured of it."""

    file: ModelFile
    comparison: Comparison
    shown: dict[str, Variant]
    """what the comparison ran"""
    judged: FrameSet
    weights: dict[str, int]
    """bytes by precision"""
    notes: list[str]


def quantize(
    model: Annotated[
        str | None, typer.Argument(help="A .ubm file or a shipped model's name; hdl-64e if omitted.")
    ] = None,
    output: Annotated[Path | None, typer.Option("-o", "--output", help="The .ubm file to write.")] = None,
    precision: Annotated[
        list[str] | None, typer.Option(help="int16 or int8; may be given several times. Both if omitted.")
    ] = None,
    calibrate: Annotated[
        str, typer.Option(help="'sim', a KITTI .bin file, a folder of them, or a capture (.pcap, .db3).")
    ] = SIMULATED,
    frames: Annotated[
        int | None, typer.Option(min=1, help=f"At most so many frames of it (sim: {SIMULATED_FRAMES}).")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of the simulator, and of the windows drawn.")] = 500,
    rounding: Annotated[
        str, typer.Option(help="Of 8-bit weights: descent (single steps that bring the output closer), or nearest.")
    ] = "descent",
    evaluate: Annotated[
        str | None, typer.Option(help="Other frames to judge on, as for --calibrate: with W8A16 and peers beside.")
    ] = None,
    compare_schemes: Annotated[
        bool, typer.Option("--compare-schemes", help="Measure other 8-bit codes on the frames judged, too.")
    ] = False,
    report: Annotated[Path | None, typer.Option(help="Folder for quantize.html, .json and pictures.")] = None,
    as_json: JsonOption = False,
) -> None:
    """Make the integer networks of a model, prove that they cannot overflow, and say how far from float they are."""
    loaded = load_model(model)
    wanted, how = _checked(output, precision, rounding, evaluate or report or compare_schemes)
    found = model_frames(
        calibrate, loaded.file, limit=frames, seed=seed, simulated=SIMULATED_FRAMES, what="calibration frames",
        quiet=as_json,
    )  # fmt: skip
    used, judged = _frames(found, evaluate, loaded.file, seed, quiet=as_json)
    calibration = calibration_windows(used.frames, loaded.rules, seed=seed)
    made = _quantised(loaded.file, calibration, wanted, how, quiet=as_json)
    result = _judge(made, calibration, wanted, judged, peers=bool(evaluate or report), quiet=as_json)
    result = replace(result, file=_described(result, wanted, used, calibration, seed, how))
    summary = _summary(result, wanted, used)
    if output is not None:
        data = write_ubm(output, result.file)
        summary |= {"model": str(output), "bytes": len(data), "crc32": f"{load_model(output).crc32:08x}"}
    schemes = _schemes(made, calibration, judged, quiet=as_json) if compare_schemes else None
    if schemes is not None:
        summary["schemes"] = schemes.data
    if report is not None:
        from .quantize_report import write_quantize_report  # loads matplotlib

        message(
            f"report: {write_quantize_report(report, result, summary, [*tables(result), *_scheme_tables(schemes)])}"
        )
    if as_json:
        emit_json(summary)
        return
    for part in (*tables(result), *_scheme_tables(schemes)):
        show(table(part.title, part.columns, part.rows))
    for note in (NOTE, *result.notes):
        message(note)
    if output is not None:
        message(f"{output}: {summary['bytes']} bytes, {', '.join(['fp32', *wanted])}")


def _checked(
    output: Path | None, precision: list[str] | None, rounding: str, judged: object
) -> tuple[list[Precision], Rounding]:
    """Before minutes of work rather than after."""
    if output is None and not judged:
        raise UserError("nothing to do: name the file to write (-o OUT.ubm), or frames to judge on (--evaluate FOLDER)")
    if output is not None and output.suffix != ".ubm":
        raise UserError(f"{output}: a model file ends in .ubm")
    if output is not None and not output.parent.is_dir():
        raise UserError(f"{output}: the folder {output.parent} does not exist")
    for name in precision or ():
        if name not in CONTRACTS:
            raise UserError(f"--precision {name}: expected {' or '.join(CONTRACTS)}")
    if rounding not in get_args(Rounding):
        raise UserError(f"--rounding {rounding}: expected {' or '.join(get_args(Rounding))}")
    wanted = [name for name in CONTRACTS if not precision or name in precision]
    return wanted, cast(Rounding, rounding)


def _frames(
    found: FrameSet, evaluate: str | None, file: ModelFile, seed: int, *, quiet: bool
) -> tuple[FrameSet, FrameSet]:
    """To calibrate on, and to judge on."""
    if evaluate is not None:
        options: dict[str, Any] = {"limit": None, "seed": seed + 1000, "simulated": SIMULATED_FRAMES, "quiet": quiet}
        return found, model_frames(evaluate, file, what="frames to judge on", **options)
    if len(found.frames) < KEPT_BACK:
        return found, replace(found, text=f"{found.text}: those it was calibrated on")
    kept = found.frames[KEPT_BACK - 1 :: KEPT_BACK]
    used = [frame for k, frame in enumerate(found.frames) if k % KEPT_BACK != KEPT_BACK - 1]
    return FrameSet(used, f"{found.text}, {len(used)} of them"), FrameSet(kept, f"{found.text}, the other {len(kept)}")


def _quantised(
    file: ModelFile, calibration: Calibration, wanted: list[Precision], rounding: Rounding, *, quiet: bool
) -> ModelFile:
    with progress_bar("quantising", len(wanted), quiet=quiet) as advance:
        for precision in wanted:
            try:
                file = quantize_model(file, calibration, [precision], rounding)
            except OverflowProofError as error:
                raise UserError(f"{error}; {widest_unit(file, precision)}") from None
            advance(note=precision)
    return file


# --------------------------------------------------------------------------------------------------------- judge


def _judge(
    file: ModelFile,
    calibration: Calibration,
    wanted: list[Precision],
    judged: FrameSet,
    *,
    peers: bool,
    quiet: bool,
) -> Result:
    variants: dict[str, Variant] = {}
    for precision in wanted:
        model = file.integer(precision)
        assert model is not None  # just made
        variants[precision] = integer_variant(model)
    notes: list[str] = []
    if peers:
        variants[NARROW] = narrow_variant(file, calibration)
        found, problem = _peers(file, calibration)
        variants |= found
        notes += [problem] if problem else []
    with progress_bar("comparing with float", len(judged.frames), quiet=quiet) as advance:
        comparison = compare(
            file, judged.frames, variants, baselines={BASE: BASELINES[BASE]}, on_frame=lambda _: advance()
        )
    return Result(file, comparison, variants, judged, weight_bytes(file.to_bytes()), notes)


def _peers(file: ModelFile, calibration: Calibration) -> tuple[dict[str, Variant], str]:
    """ONNX Runtime's own static int8 of the same networks, for each way it calibrates; or why there is none."""
    try:
        make = importlib.import_module(PEER_MODULE).peer_static_int8
        return {
            f"{PEER} {method}{note}": _peer(make, file, calibration, method, graph)
            for graph, note in PEER_GRAPHS.items()
            for method in PEER_METHODS
        }, ""
    except (ImportError, ExportError) as error:
        return {}, f"no comparison with ONNX Runtime's own static int8, onnxruntime not installed: {error}"


def _peer(make: Callable[..., Any], file: ModelFile, calibration: Calibration, method: str, graph: str) -> Variant:
    networks = []
    for _, net, windows, _ in network_problems(file, calibration):
        run = make(net, windows, method, graph)

        def outputs(windows: I64, run: Any = run, skip: int = net.skip) -> NDArray[Any]:
            flat = run(windows.reshape(-1, windows.shape[-1]))
            return np.asarray(np.reshape(flat, windows.shape[:-1]) + skip * windows.min(axis=-1))

        networks.append(outputs)
    return Variant(networks[0], networks[1])


# ------------------------------------------------------------------------------------------------------ the file


def _described(
    result: Result, wanted: list[Precision], used: FrameSet, calibration: Calibration, seed: int, rounding: Rounding
) -> ModelFile:
    """The file with where its integer networks come from and what was measured of them. The same bytes every time."""
    summaries = result.comparison.summaries()
    origin = {
        "calibration": used.text,
        "windows": len(calibration.distance),
        "seed": seed,
        "rounding": rounding,
        "precisions": wanted,
        "versions": {"upbeam": upbeam.__version__, "numpy": np.__version__},
    }
    measured: dict[str, Any] = {name: _rounded(summaries[name]) for name in wanted}
    measured["against_float_on"] = result.judged.text
    file = result.file
    return replace(
        file,
        provenance={**file.provenance, "quantisation": origin},
        metrics={**file.metrics, "quantisation": measured, "golden": golden_digests(file)},
    )


def _rounded(summary: Summary) -> dict[str, float | None]:
    values = _plain(summary.as_dict())
    return {key: float(f"{value:.4g}") if isinstance(value, float) else value for key, value in values.items()}


def _plain(values: Mapping[str, float]) -> dict[str, float | None]:
    return {key: value if math.isfinite(value) else None for key, value in values.items()}


# -------------------------------------------------------------------------------------------------------- results


def _summary(result: Result, wanted: list[Precision], used: FrameSet) -> dict[str, Any]:
    comparison = result.comparison
    return {
        "sensor": result.file.rules.sensor,
        "calibration": used.text,
        "judged_on": result.judged.text,
        "frames": len(comparison.frames),
        "provenance": result.file.provenance["quantisation"],
        "precisions": {name: {"contract": CONTRACTS[name], "weight_bytes": result.weights[name]} for name in wanted},
        "weight_bytes_fp32": result.weights["fp32"],
        "against_float": {
            name: {
                **_plain(errors.summary().as_dict()),
                "bands": {band: _plain(s.as_dict()) for band, s in errors.by_band().items()},
                "ghosts_added": comparison.ghosts[name].added,
                "ghosts_removed": comparison.ghosts[name].removed,
                "ghosts_float": comparison.ghosts[name].float_ghosts,
            }
            for name, errors in comparison.errors.items()
        },
        "against_truth": _truth(comparison),
        "notes": result.notes,
    }


def _truth(comparison: Comparison) -> dict[str, Any]:
    evaluation = comparison.evaluation
    assert evaluation is not None
    return {
        "methods": {name: _plain(metrics) for name, metrics in evaluation.means().items()},
        "ratio_to_float": {
            name: {key: {"value": _finite(r.value), "low": r.low, "high": r.high} for key, r in ratios.items()}
            for name, ratios in evaluation.ratios(FLOAT).items()
            if name != FLOAT
        },
    }


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def tables(result: Result) -> list[Table]:
    return [
        _float_table(result),
        _window_table(result),
        _band_table(result),
        _truth_table(result),
        _ratio_table(result),
    ]


def _float_table(result: Result) -> Table:
    rows = [
        [
            name,
            *(_millimetres(value) for value in (s.mean_mm, s.p99_mm, s.p999_mm, s.max_mm)),
            _percent(s.moved_share),
            f"{s.intensity_mean:.2f}",
            str(result.weights.get(name, "-")),
        ]
        for name, s in result.comparison.summaries().items()
    ]
    columns = ["mm", "mean", "p99", "p99.9", "max", "moved", "grey", "bytes"]
    return Table(f"against float: {result.judged.text}", columns, rows)


def _window_table(result: Result) -> Table:
    rows = []
    for name, s in result.comparison.summaries().items():
        ghosts = result.comparison.ghosts[name]
        changes = _signed(s.added, s.removed), _signed(ghosts.added, ghosts.removed)
        code = ["-", "-"] if name.startswith(PEER) else [_percent(s.coarse_share), _percent(s.cut_share)]
        rows.append([name, *code, *changes, f"{ghosts.float_ghosts}"])
    columns = ["windows and points", "coarse", "cut", "flips", "ghosts", "of float"]
    some = next(iter(result.comparison.summaries().values()))
    return Table(f"of {some.windows} windows with a return", columns, rows)


def _band_table(result: Result) -> Table:
    """Mean, 99.9th percentile and largest error by range; peers' are in the JSON."""
    bands = {name: errors.by_band() for name, errors in result.comparison.errors.items() if not name.startswith(PEER)}
    names = list(next(iter(bands.values())))
    rows = [
        [name, *(f"{s.mean_mm:.1f} / {s.p999_mm:.0f} / {s.max_mm:.0f}" for s in found.values())]
        for name, found in bands.items()
    ]
    return Table("against float by range: mean / p99.9 / max, mm", ["", *names], rows)


def _truth_table(result: Result) -> Table:
    evaluation = result.comparison.evaluation
    assert evaluation is not None
    rows = [
        [name, f"{m['chamfer_m2']:.4f}", f"{m['mae_m']:.4f}", _percent(m["ghost_share"]), f"{m['intensity_mae']:.2f}"]
        for name, m in evaluation.means().items()
    ]
    return Table("against the truth", ["method", "Chamfer m2", "MAE m", "ghosts", "grey"], rows)


def _ratio_table(result: Result) -> Table:
    evaluation = result.comparison.evaluation
    assert evaluation is not None
    keys = {"Chamfer": "chamfer_m2", "MAE": "mae_m", "ghosts": "ghost_share"}
    rows = [
        [name, *(exact_ratio(ratios[key]) for key in keys.values())]
        for name, ratios in evaluation.ratios(FLOAT).items()
        if name != FLOAT
    ]
    return Table("ratio to float, ± half a 95 % interval over frames (paired)", ["method", *keys], rows)


def exact_ratio(ratio: Interval) -> str:
    """``1.0004 ±0.0003``"""
    if not math.isfinite(ratio.value):
        return "-"
    width = ratio.half_width
    return f"{ratio.value:.4f}" if width is None else f"{ratio.value:.4f} ±{width:.4f}"


def _millimetres(value: float) -> str:
    return f"{value:.1f}" if value < 100 else f"{value:.0f}"


def _percent(share: float) -> str:
    return "-" if not math.isfinite(share) else f"{100 * share:.2f}%"


def _signed(added: int, removed: int) -> str:
    return f"+{added} -{removed}"


# -------------------------------------------------------------------------------------------------------- schemes


@dataclass(frozen=True)
class _Schemes:
    data: list[dict[str, Any]]
    rows: list[list[str]]
    frames: str


def _schemes(file: ModelFile, calibration: Calibration, judged: FrameSet, *, quiet: bool) -> _Schemes:
    codes = scheme_variants(file, calibration)
    with progress_bar("comparing codes", len(judged.frames), quiet=quiet) as advance:

        def seen(frame: Frame) -> None:
            advance()

        comparison = compare(file, judged.frames, codes.variants, on_frame=seen)
    evaluation = comparison.evaluation
    assert evaluation is not None
    ratios = evaluation.ratios(FLOAT)
    data, rows = [], []
    for name, summary in comparison.summaries().items():
        code, bits, weights = codes.labels[name]
        chamfer, mae = ratios[name]["chamfer_m2"], ratios[name]["mae_m"]
        data.append({
            "code": code, "bits": bits, "weights": weights, **_plain(summary.as_dict()),
            "chamfer_ratio": _finite(chamfer.value), "mae_ratio": _finite(mae.value),
        })  # fmt: skip
        rows.append([
            code, weights, f"{summary.mean_mm:.1f}", f"{summary.p999_mm:.0f}", exact_ratio(chamfer), exact_ratio(mae),
        ])  # fmt: skip
    return _Schemes(data, rows, judged.text)


def _scheme_tables(schemes: _Schemes | None) -> list[Table]:
    if schemes is None:
        return []
    columns = ["code of a difference", "weights", "mean", "p99.9", "Chamfer", "MAE"]
    return [Table(f"8-bit codes, mm and ratios to float: {schemes.frames}", columns, schemes.rows)]
