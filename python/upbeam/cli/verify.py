"""``upbeam verify``: do all backends of this machine give the same bits?"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal

import typer

from upbeam.hw_sim.fpga import ToolError
from upbeam.hw_sim.fpga.backend import rtl_backend
from upbeam.kernels.opencl import OpenClError
from upbeam.model.frames import Frame
from upbeam.quant.verify import (
    GOLDEN,
    RANDOM_COLUMNS,
    Backend,
    BackendResult,
    Count,
    VectorSet,
    extreme_set,
    firing_set,
    golden_mismatch,
    golden_set,
    image_set,
    random_set,
    reference_backend,
    stream_set,
)
from upbeam.quant.verify import verify as compare_backends
from upbeam.runtime.upsampler import Model, load_model
from upbeam.runtime.verify import cpu_backends, opencl_backends

from .common import JsonOption, UserError, emit_json, message, progress_bar, show, table
from .frames import SIMULATED, FrameSet, model_frames

__all__ = ["verify"]

SIMULATED_FRAMES = 2
REFERENCE = "numpy"
NOTE = (
    "measured here: windows compared, and in words where any differ. Every output row is compared, distance and "
    "intensity. Integer backends stand against the NumPy reference of the contract, which stands against the digest in "
    "the model file; float ones against the first of their own. -: what others are compared with, or what a backend "
    "does not do."
)


def verify(
    model: Annotated[
        str | None, typer.Argument(help="A .ubm file or a shipped model's name; hdl-64e if omitted.")
    ] = None,
    frames: Annotated[
        str, typer.Option(help="'sim', a KITTI .bin file, a folder of them, or a capture (.pcap, .db3).")
    ] = SIMULATED,
    limit: Annotated[int | None, typer.Option(min=1, help=f"At most so many frames (sim: {SIMULATED_FRAMES}).")] = None,
    random: Annotated[int, typer.Option(min=1, help="Random columns, at least.")] = RANDOM_COLUMNS,
    seed: Annotated[int, typer.Option(min=0, help="Of the random columns, and of the simulator.")] = 0,
    as_json: JsonOption = False,
) -> None:
    """Run every backend on golden, recorded or simulated, random and extreme columns; status 1 where one bit
    differs."""
    loaded = load_model(model)
    found = model_frames(
        frames, loaded.file, limit=limit, seed=seed, simulated=SIMULATED_FRAMES, what="frames", quiet=as_json
    )
    sets = _sets(loaded, found, random, seed)
    results: dict[str, dict[str, BackendResult]] = {}
    notes: list[str] = []
    for precision in loaded.file.precisions:
        results[precision] = _verify(loaded, precision, sets, notes, quiet=as_json)
    exact = all(result.exact for group in results.values() for result in group.values())
    if as_json:
        emit_json(_summary(loaded, model, exact, results, sets, found, notes))
    else:
        for precision, group in results.items():
            show(table(f"{precision}: windows compared", ["backend", *(s.name for s in sets)], _rows(group, sets)))
        for text in (*_mismatches(results), *notes, NOTE, "every bit agrees" if exact else "NOT EXACT"):
            message(text)
    if not exact:
        raise SystemExit(1)


def _sets(model: Model, found: FrameSet, random: int, seed: int) -> list[VectorSet]:
    images = [_given(frame, model) for frame in found.frames]
    rules = model.rules
    columns = random_set(rules, random, seed)
    offset = [firing_set("firing", columns.images)] if rules.azimuth_offset_deg.any() else []
    streamed = [stream_set("stream", images), *offset]
    return [golden_set(rules), image_set("frames", images), *streamed, columns, extreme_set(rules)]


def _given(frame: Frame, model: Model) -> Any:
    """The rows that a sensor would give, of the model's width."""
    shape, wanted = frame.distance[frame.given].shape, (32, model.columns)
    if frame.distance_unit_m != model.distance_unit_m:
        raise UserError(
            f"frame {frame.name} counts in {frame.distance_unit_m * 1000:g} mm, the model in "
            f"{model.distance_unit_m * 1000:g} mm"
        )
    if shape[1] < wanted[1] or shape[0] != wanted[0]:
        raise UserError(f"frame {frame.name} gives {shape[0]} rows x {shape[1]} columns, expected {wanted}")
    turn = slice(0, model.columns)
    return frame.distance[frame.given][:, turn], frame.intensity[frame.given][:, turn]


def _verify(
    model: Model, precision: str, sets: Sequence[VectorSet], notes: list[str], *, quiet: bool
) -> dict[str, BackendResult]:
    backends = [*cpu_backends(model, precision), *_opencl(model, precision, notes), *_rtl(model, precision, notes)]
    if precision == "fp32":
        reference, *backends = backends
        first = BackendResult({vectors.name: None for vectors in sets})
        notes += [] if backends else [f"fp32: this machine has the {reference.name} kernel only, nothing to compare"]
    else:
        reference, first = _reference(model, "int16" if precision == "int16" else "int8", sets, notes)
    with progress_bar(f"verifying {precision}", len(sets) * len(backends), quiet=quiet) as advance:
        found = compare_backends(reference, backends, sets, model.rules, lambda name: advance(note=name))
    return {reference.name: first, **found}


def _opencl(model: Model, precision: str, notes: list[str]) -> list[Backend]:
    try:
        return opencl_backends(model, precision)
    except OpenClError as error:
        notes.append(f"{precision}: no OpenCL: {error}")
        return []


def _rtl(model: Model, precision: str, notes: list[str]) -> list[Backend]:
    """The FPGA core, simulated: integers only."""
    if precision == "fp32":
        return []
    try:
        return [rtl_backend(model.data, model.name, precision)]
    except ToolError as error:
        notes.append(f"{precision}: no RTL simulation: {error}")
        return []


def _reference(
    model: Model, precision: Literal["int16", "int8"], sets: Sequence[VectorSet], notes: list[str]
) -> tuple[Backend, BackendResult]:
    """The NumPy reference is itself held against the digest that the model file keeps of it."""
    integer = model.file.integer(precision)
    assert integer is not None  # one of the file's precisions
    result = BackendResult({vectors.name: None for vectors in sets})
    try:
        result.first = golden_mismatch(model.file, precision)
        result.sets[GOLDEN] = Count(sets[0].windows, 0 if result.first is None else sets[0].windows)
    except KeyError:
        notes.append(f"{precision}: the file holds no digest of its golden vectors, the reference stands alone")
    return reference_backend(integer, model.rules, REFERENCE), result


# -------------------------------------------------------------------------------------------------------- results


def _rows(group: Mapping[str, BackendResult], sets: Sequence[VectorSet]) -> list[list[str]]:
    return [[name, *(_cell(result.sets[s.name]) for s in sets)] for name, result in group.items()]


def _cell(count: Count | None) -> str:
    if count is None:
        return "-"
    return f"{count.windows}" if count.differing == 0 else f"{count.differing} of {count.windows} DIFFER"


def _mismatches(results: Mapping[str, Mapping[str, BackendResult]]) -> list[str]:
    return [
        f"{precision} {name}: {result.first.text()}"
        for precision, group in results.items()
        for name, result in group.items()
        if result.first is not None
    ]


def _summary(
    loaded: Model,
    model: str | None,
    exact: bool,
    results: Mapping[str, Mapping[str, BackendResult]],
    sets: Sequence[VectorSet],
    found: FrameSet,
    notes: list[str],
) -> dict[str, Any]:
    return {
        "exact": exact,
        "model": model or "(shipped)",
        "crc32": f"{loaded.crc32:08x}",
        "frames": len(found.frames),
        "source": found.text,
        "columns": {s.name: sum(image[0].shape[1] for image in s.images) for s in sets},
        "backends": {
            f"{precision} {name}": {
                "precision": precision,
                "exact": result.exact,
                "sets": {key: None if c is None else vars(c) for key, c in result.sets.items()},
                "first_mismatch": None if result.first is None else vars(result.first),
            }
            for precision, group in results.items()
            for name, result in group.items()
        },
        "notes": notes,
    }
