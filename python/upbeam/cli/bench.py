"""``upbeam bench``: this machine's limits, our kernels, and others on the same work in the same run."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from upbeam.kernels.opencl import OpenClError, list_devices
from upbeam.power.bench.bench import Benchmark, Settings, benchmark
from upbeam.power.bench.peers import PEERS
from upbeam.power.bench.tables import BenchTable, tables
from upbeam.runtime.upsampler import Model, load_model

from .common import JsonOption, UserError, emit_json, err, message, show, table
from .doctor import environment
from .frames import SIMULATED, model_frames

__all__ = ["bench"]

PICTURE, REPORT, RESULTS = "bench.png", "bench.html", "bench.json"
NOTE = (
    "measured here, in this run, by turns; port bounds are measured loops of the instructions a kernel needs, without "
    "their dependencies. Every output was compared with ours before it was timed."
)


def bench(
    model: Annotated[
        str | None, typer.Option(help="A .ubm file or a shipped model's name; hdl-64e if omitted.")
    ] = None,
    frames: Annotated[str, typer.Option(help="'sim', a KITTI .bin file, or a capture; its first frame.")] = SIMULATED,
    threads: Annotated[
        str | None, typer.Option(help="Numbers of threads, with commas, 1 among them; 1,2 if omitted, 1 if --quick.")
    ] = None,
    peers: Annotated[str, typer.Option(help=f"'all', 'none', or of {', '.join(PEERS)}, with commas.")] = "all",
    columns: Annotated[str, typer.Option(help="Widths to show the cost of, with commas.")] = "512,1024,2048,4096,8192",
    quick: Annotated[bool, typer.Option(help="A few repetitions: shows that all works, not how fast.")] = False,
    report: Annotated[
        Path | None, typer.Option(help=f"Folder for {REPORT}, {RESULTS} and {PICTURE}.", file_okay=False)
    ] = None,
    devices: Annotated[bool, typer.Option("--list-devices", help="List the OpenCL devices, and end.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Measure this machine's limits, our kernels' share of them, and compilers and other runtimes on the same work."""
    if devices:
        _show_devices(as_json)
        return
    settings = _settings(threads or ("1" if quick else "1,2"), peers, columns, quick)
    loaded = load_model(model)
    frame = _frame(frames, loaded, quiet=as_json)
    with err.status("measuring ...") as status:
        run = benchmark(loaded.file, frame, settings, lambda what: status.update(f"measuring: {what} ..."))
    result = {**run.as_dict(), "model_crc32": f"{loaded.crc32:08x}", "frame": frames, "environment": environment()}
    if report is not None:
        _write_report(report, run, result)
    if as_json:
        emit_json(result)
    else:
        for part in tables(run):
            show(table(part.title, part.columns, part.rows))
            if part.note:
                show(f"{part.note}\n")
    for text in (*(f"{PEERS[k].title}: missing, {v}" for k, v in run.missing.items()), *run.notes, NOTE):
        message(text)


def _settings(threads: str, peers: str, columns: str, quick: bool) -> Settings:
    chosen = {"all": tuple(PEERS), "none": ()}.get(peers, tuple(x.strip() for x in peers.split(",")))
    try:
        return Settings(_numbers(threads, "--threads"), chosen, _numbers(columns, "--columns"), quick)
    except ValueError as error:
        raise UserError(str(error)) from None


def _numbers(text: str, option: str) -> tuple[int, ...]:
    try:
        return tuple(int(x) for x in text.split(","))
    except ValueError:
        raise UserError(f"{option} {text!r}: expected whole numbers with commas") from None


def _frame(source: str, model: Model, *, quiet: bool) -> tuple[Any, Any]:
    """The rows that a sensor would give, of the model's width."""
    found = model_frames(source, model.file, limit=1, seed=0, simulated=1, what="frame", quiet=quiet).frames[0]
    rows = (found.distance[found.given], found.intensity[found.given])
    if rows[0].shape[0] != 32 or rows[0].shape[1] < model.columns:
        raise UserError(f"frame {found.name} gives {list(rows[0].shape)}, expected [32, {model.columns}]")
    distance, intensity = (np.ascontiguousarray(x[:, : model.columns]) for x in rows)
    return distance, intensity


def _show_devices(as_json: bool) -> None:
    try:
        found = list_devices()
    except OpenClError as error:
        raise UserError(str(error)) from None
    if as_json:
        emit_json({"devices": [vars(device) for device in found]})
    else:
        for device in found:
            show(str(device))


# ----------------------------------------------------------------------------------------------------------- report


def _write_report(folder: Path, run: Benchmark, result: dict[str, Any]) -> None:
    import json

    from upbeam.power.bench.plot import plot_times
    from upbeam.power.report import Picture, page_template

    folder.mkdir(parents=True, exist_ok=True)
    png = plot_times(run)
    parts = [*tables(run), BenchTable("The machine", ["", "value"], _machine(result["environment"]))]
    html = page_template("evaluate.html").render(
        command="bench",
        title=f"both images of a 32 x {run.work.columns} frame",
        lead=NOTE,
        tables=parts,
        pictures=[Picture("Times", png, "All of one run, by turns.")],
    )
    (folder / PICTURE).write_bytes(png)
    (folder / RESULTS).write_text(json.dumps(result, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    (folder / REPORT).write_text(html, encoding="utf-8")


def _machine(found: dict[str, Any]) -> list[list[str]]:
    keys = ("cpu", "cores", "cpu_features", "system", "upbeam", "python", "packages", "opencl_devices")
    return [[key, _text(found[key])] for key in keys]


def _text(value: Any) -> str:
    if isinstance(value, dict):
        return "; ".join(f"{k} {v}" for k, v in value.items())
    return ", ".join(map(str, value)) if isinstance(value, list) else str(value)
