"""``upbeam export``: a model for other programs: ONNX, C, RTL."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, cast

import typer

from upbeam.quant.export.source import NETWORKS, NetworkName, Source
from upbeam.quant.integer import CONTRACTS, Precision
from upbeam.quant.quantize import calibration_windows
from upbeam.runtime.upsampler import load_model

from .common import JsonOption, UserError, emit_json, message
from .frames import SIMULATED, model_frames

__all__ = ["export"]

ONNX_FLOAT = ("onnx-dense", "onnx-folded", "onnx-image")
ONNX_QDQ = "onnx-qdq"
ONNX = (*ONNX_FLOAT, ONNX_QDQ)
TARGETS = (*ONNX, "c", "rtl")
BOTH = "both"
SIMULATED_FRAMES = 12
DEFAULT_METHOD = "percentile"


@dataclass(frozen=True)
class _Options:
    """As given; None where not."""

    network: str | None
    precision: str | None
    calibrate: str | None
    frames: int | None
    seed: int | None
    method: str | None
    fold: int | None
    lanes: int | None


def export(
    model: Annotated[str, typer.Argument(help="A .ubm file or a shipped model's name.")],
    to: Annotated[str, typer.Option(help=", ".join(TARGETS))],
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", help="File, or for rtl a new folder. Named after the model if omitted."),
    ] = None,
    network: Annotated[str | None, typer.Option(help="ONNX: distance, intensity or both (if omitted).")] = None,
    precision: Annotated[
        str | None, typer.Option(help="c, rtl: int16 or int8; all that the model has if omitted.")
    ] = None,
    calibrate: Annotated[
        str | None,
        typer.Option(help="onnx-qdq: 'sim' (if omitted), a KITTI .bin file, a folder of them, or a capture."),
    ] = None,
    frames: Annotated[
        int | None, typer.Option(min=1, help=f"onnx-qdq: at most so many frames of it (sim: {SIMULATED_FRAMES}).")
    ] = None,
    seed: Annotated[
        int | None, typer.Option(min=0, help="onnx-qdq: of the simulator, and of the windows drawn (500 if omitted).")
    ] = None,
    method: Annotated[
        str | None, typer.Option(help=f"onnx-qdq: minmax, percentile or entropy ({DEFAULT_METHOD} if omitted).")
    ] = None,
    fold: Annotated[
        int | None, typer.Option(help="rtl: clocks of a window (one hidden unit a clock if omitted).")
    ] = None,
    lanes: Annotated[int | None, typer.Option(help="rtl: windows side by side, a divisor of the fold.")] = None,
    as_json: JsonOption = False,
) -> None:
    """Write a model as an ONNX graph, a C header or RTL memories. What each holds: docs/export.md."""
    options = _Options(network, precision, calibrate, frames, seed, method, fold, lanes)
    _check(to, options)
    loaded = load_model(model)
    source = Source.of(loaded.data, Path(model).name.removesuffix(".ubm"))
    path = output or Path(_default_name(source, to))
    if to != "rtl":
        _check_file(path)
    summary = {"model": source.name, "model_crc32": f"{source.crc32:08x}", "to": to, "output": str(path)}
    if to == "rtl":
        summary |= _write_rtl(source, path, options)
    elif to == "c":
        summary |= _write_c(source, path, _precisions(options))
    else:
        summary |= _write_onnx(source, to, path, options, quiet=as_json)
    if as_json:
        emit_json(summary)
    else:
        message(f"{path}: {summary['bytes']} bytes, {summary['text']} ({source.name}, CRC-32 {source.crc32:08x})")


def _check(to: str, options: _Options) -> None:
    """An option that would do nothing is an error."""
    if to not in TARGETS:
        raise UserError(f"--to {to}: expected {', '.join(TARGETS)}")
    uses: Mapping[str, Sequence[str]] = {
        "network": ONNX,
        "precision": ("c", "rtl"),
        **dict.fromkeys(("calibrate", "frames", "seed", "method"), (ONNX_QDQ,)),
        **dict.fromkeys(("fold", "lanes"), ("rtl",)),
    }
    for name, targets in uses.items():
        if getattr(options, name) is not None and to not in targets:
            raise UserError(f"--{name} has no meaning for --to {to}, only for {', '.join(targets)}")
    if options.network not in (None, BOTH, *NETWORKS):
        raise UserError(f"--network {options.network}: expected {', '.join(NETWORKS)} or {BOTH}")
    if options.precision not in (None, *CONTRACTS):
        raise UserError(f"--precision {options.precision}: expected {' or '.join(CONTRACTS)}")


def _default_name(source: Source, to: str) -> str:
    if to in ONNX:
        return f"{source.name}-{to.removeprefix('onnx-')}.onnx"
    return f"{source.name}.h" if to == "c" else f"{source.name}-rtl"


def _check_file(path: Path) -> None:
    """Before any work."""
    if path.is_dir():
        raise UserError(f"{path} is a folder, expected a file to write")
    if not path.parent.is_dir():
        raise UserError(f"{path}: the folder {path.parent} does not exist")


def _precisions(options: _Options) -> list[Precision] | None:
    return None if options.precision is None else [cast(Precision, options.precision)]


def _write_c(source: Source, path: Path, precisions: list[Precision] | None) -> dict[str, Any]:
    from upbeam.quant.export.c_header import c_header

    text = c_header(source, precisions)
    path.write_text(text, encoding="ascii")
    found = source.precisions if precisions is None else precisions
    arrays = (
        f"the model file and its {' and '.join(found)} networks" if found else "the model file (no integer networks)"
    )
    return {"bytes": len(text), "precisions": found, "text": f"C header with {arrays}"}


def _write_rtl(source: Source, folder: Path, options: _Options) -> dict[str, Any]:
    from upbeam.quant.export.rtl import write_rtl

    lanes = 1 if options.lanes is None else options.lanes
    manifest = write_rtl(source, folder, _precisions(options), fold=options.fold, lanes=lanes)
    files = {name: size for made in manifest["precisions"].values() for name, size in made["files"].items()}
    found = list(manifest["precisions"])
    text = f"{len(files)} files of the {' and '.join(found)} networks"
    return {"bytes": sum(files.values()), "precisions": found, "files": files, "text": text}


def _write_onnx(source: Source, to: str, path: Path, options: _Options, *, quiet: bool) -> dict[str, Any]:
    from upbeam.quant.export import onnx_builder, onnx_graphs

    onnx_builder.require("onnx")
    networks = NETWORKS if options.network in (None, BOTH) else (cast(NetworkName, options.network),)
    extra: dict[str, Any] = {}
    if to == ONNX_QDQ:
        model, extra = _qdq(source, networks, options, quiet=quiet)
    elif to == "onnx-image":
        model = onnx_graphs.image_model(source, networks)
    elif to == "onnx-dense":
        model = onnx_graphs.dense_model(source, networks)
    else:
        model = onnx_graphs.folded_model(source, networks)
    data = model.SerializeToString()
    path.write_bytes(data)
    return {
        "bytes": len(data),
        "opset": onnx_builder.OPSET,
        "ir_version": onnx_builder.IR_VERSION,
        "inputs": [value.name for value in model.graph.input],
        "outputs": [value.name for value in model.graph.output],
        "text": f"{to} with {len(model.graph.node)} nodes of opset {onnx_builder.OPSET}",
        **extra,
    }


def _qdq(
    source: Source, networks: Sequence[NetworkName], options: _Options, *, quiet: bool
) -> tuple[Any, dict[str, Any]]:
    from upbeam.quant.export.onnx_qdq import METHODS, qdq_model

    method = options.method or DEFAULT_METHOD
    if method not in METHODS:
        raise UserError(f"--method {method}: expected {', '.join(METHODS)}")
    seed = 500 if options.seed is None else options.seed
    found = model_frames(
        options.calibrate or SIMULATED, source.file, limit=options.frames, seed=seed, simulated=SIMULATED_FRAMES,
        what="calibration frames", quiet=quiet,
    )  # fmt: skip
    calibration = calibration_windows(found.frames, source.file.rules, seed=seed)
    used = {"calibration": found.text, "windows": len(calibration.distance), "method": method}
    return qdq_model(source, calibration, method, networks, found.text), used
