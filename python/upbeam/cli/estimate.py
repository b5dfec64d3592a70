"""``upbeam estimate``: latency, memory, power and energy on a device, with interval, boundary and error."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from upbeam.power.calibrate import Calibration, Work, calibrate, power_change, read_rows, with_rows, write_rows
from upbeam.power.catalogue import Device, device_names
from upbeam.power.catalogue import device as find_device
from upbeam.power.cycles.fpga import FpgaCore
from upbeam.power.cycles.host import HostRun, core_of, measure_host, pairs_of, predictions, worst_error
from upbeam.power.energy import as_table
from upbeam.power.estimate import (
    IMPLEMENTATIONS,
    Bounded,
    Estimate,
    Knowledge,
    Load,
    estimate_load,
    estimate_macs,
)
from upbeam.power.host import estimate_host
from upbeam.power.ops import count_model
from upbeam.runtime.upsampler import PRECISIONS, Model, load_model

from .common import JsonOption, UserError, binary_bytes, emit_json, err, message, show, table
from .fpga import built_cores, show_sweep, synthesise

__all__ = ["estimate", "load_of"]

GOAL = 0.20
"""Largest error of the CPU model that ``--validate-cpu`` accepts."""


def estimate(
    device: Annotated[str | None, typer.Option(help="A name of --list-devices, or a .toml file of your own.")] = None,
    macs: Annotated[
        float | None, typer.Option(help="Any workload instead of ours: multiply-accumulates of one inference.")
    ] = None,
    latency_ms: Annotated[float | None, typer.Option(help="With --macs: time of one inference, where known.")] = None,
    mode: Annotated[str | None, typer.Option(help="Power mode of the device.")] = None,
    on: Annotated[str | None, typer.Option(help="cpu, gpu or fpga; the device's own way if omitted.")] = None,
    model: Annotated[str | None, typer.Option(help="A .ubm file or a shipped model's name.")] = None,
    precision: Annotated[str, typer.Option(help=", ".join(PRECISIONS) + ".")] = "int8",
    columns: Annotated[int | None, typer.Option(min=4, max=65535, help="Columns instead of the model's.")] = None,
    rate: Annotated[float, typer.Option(help="Turns per second.")] = 20.0,
    deadline_ms: Annotated[float, typer.Option(help="For the verdict.")] = 50.0,
    lanes: Annotated[int | None, typer.Option(help="FPGA: windows side by side.")] = None,
    fold: Annotated[int | None, typer.Option(help="FPGA: clocks of a window.")] = None,
    rows: Annotated[Path | None, typer.Option(help="Measured rows of your own, as --save writes them.")] = None,
    log: Annotated[Path | None, typer.Option("--calibrate", help="A tegrastats log of the device at work.")] = None,
    idle_log: Annotated[Path | None, typer.Option(help="With --calibrate: a log of the device at rest.")] = None,
    interval_s: Annotated[float | None, typer.Option(help="Of logs without time stamps.")] = None,
    save: Annotated[Path | None, typer.Option(help="With --calibrate: write the rows for --rows.")] = None,
    measure: Annotated[float | None, typer.Option(help="host: measure power, so many seconds twice.")] = None,
    every: Annotated[bool, typer.Option("--all", help="Every device.")] = False,
    report: Annotated[Path | None, typer.Option(help="With --all: folder for estimate.html and .json.")] = None,
    list_devices: Annotated[bool, typer.Option("--list-devices", help="List the devices, and end.")] = False,
    errors: Annotated[bool, typer.Option("--errors", help="Leave-one-out errors of the power model, and end.")] = False,
    validate_cpu: Annotated[
        bool, typer.Option("--validate-cpu", help="Calibrate the CPU model here, predict all other kernels, and end.")
    ] = False,
    build: Annotated[
        bool, typer.Option("--synthesise", help="FPGA: build the core with open tools (minutes), and end.")
    ] = False,
    seeds: Annotated[int, typer.Option(min=1, max=99, help="With --synthesise: place and route runs.")] = 5,
    fpga_sweep: Annotated[
        bool, typer.Option("--fpga-sweep", help="Every LANES and FOLD on every FPGA with open tools, and end.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Latency, power and energy of our load, or of any workload, on a device: modelled, with the error beside it."""
    if fpga_sweep:
        show_sweep(load_model(model), precision, rate, report, as_json)
        return
    if build:
        synthesise(load_model(model), str(device), precision, fold, lanes or 1, seeds, as_json)
        return
    _check(device, every, macs, latency_ms, report, log, measure, list_devices or errors or validate_cpu)
    if list_devices:
        _list_devices(as_json)
        return
    known = Knowledge.of()
    if rows is not None:
        known = with_rows(known, read_rows(rows))
    if errors:
        _show_errors(known, as_json)
        return
    loaded = load_model(model)
    if validate_cpu:
        _validate_cpu(loaded, as_json)
        return
    load = load_of(loaded, precision, columns, rate, deadline_ms)
    if every:
        _every(loaded, load, known, report, as_json)
        return
    chosen = find_device(str(device))
    if log is not None:
        work = Work(load, macs, latency_ms)
        found = calibrate(chosen, log, work, idle_log=idle_log, interval_s=interval_s, known=known, mode=mode)
        if save is not None:
            write_rows(save, found.rows)
        _show_calibration(found, as_json)
        return
    if macs is not None:
        one = estimate_macs(chosen, macs, latency_ms, known=known, mode=mode)
    elif chosen.family == "host":
        with err.status("measuring ...") as status:
            one = estimate_host(chosen, load, loaded, measure_s=measure, advance=status.update)
    else:
        core = None
        if lanes is not None or fold is not None:
            core = FpgaCore(lanes or 1, fold or 1, load.count.folded_hidden, load.fpga_precision)
        one = estimate_load(
            chosen, load, known=known, implementation=on, mode=mode, core=core, built=built_cores(loaded)
        )
    if as_json:
        emit_json({**one.as_dict(), "model_crc32": f"{loaded.crc32:08x}"})
    else:
        show_estimate(one)


def _check(
    device: str | None, every: bool, macs: float | None, latency_ms: float | None, report: Path | None,
    log: Path | None, measure: float | None, ends: bool,
) -> None:  # fmt: skip
    if not ends and (device is None) == (not every):
        raise UserError("give --device NAME, or --all; --list-devices names them")
    if macs is not None and not 0 < macs < 1e18:
        raise UserError(f"--macs {macs:g}: expected a number above 0")
    if latency_ms is not None and (macs is None or not 0 < latency_ms < 1e12):
        raise UserError("--latency-ms goes with --macs, and is above 0")
    if report is not None and not every:
        raise UserError("--report goes with --all")
    if every and (macs is not None or log is not None):
        raise UserError("--all is about our own load: --macs and --calibrate go with --device")
    if measure is not None and (device != "host" or not 10 <= measure <= 3600):
        raise UserError("--measure goes with --device host, and takes 10 to 3600 seconds")


def load_of(
    model: Model, precision: str = "int8", columns: int | None = None, rate: float = 20.0, deadline_ms: float = 50.0
) -> Load:
    """Our load of a model: what is to be computed, how often, and its memory."""
    if not (0.001 <= rate <= 1000 and 0 < deadline_ms < 1e9):
        raise UserError(f"--rate {rate:g} and --deadline-ms {deadline_ms:g}: expected 0.001 to 1000, and above 0")
    width = columns or model.columns
    memory = model.sizes(precision, columns=width)
    count = count_model(model.file, width)
    return Load(count, pairs_of(model.file), precision, rate, deadline_ms, memory)


# ------------------------------------------------------------------------------------------------------- one device


def show_estimate(one: Estimate) -> None:
    mode = f", mode {one.mode.name}" if one.mode else ""
    rows = [
        _row("latency", one.latency_ms, "ms"), _row("power", one.power_w, "W"), _row("energy", one.energy_mj, "mJ")
    ]  # fmt: skip
    if one.increment_w is not None and one.increment_mj is not None:
        rows += [_row("added power", one.increment_w, "W"), _row("added energy", one.increment_mj, "mJ")]
    title = f"{one.device.title}{mode}, {one.implementation}: {one.workload}"
    show(table(title, ["", "value", "low", "high", "kind"], [row for row in rows if row]))
    for line in _sentences(one):
        show(line)


def _row(name: str, bounded: Bounded, unit: str) -> list[str]:
    figure = bounded.figure
    if not figure.known:
        return []
    value, low, high = (_short(x) for x in figure.span(unit))
    return [f"{name} ({unit})", value, low, high, figure.kind]


def _sentences(one: Estimate) -> list[str]:
    lines = []
    if one.met is not None and one.margin_ms is not None:
        value, low, high = one.margin_ms.span("ms")
        lines.append(f"Deadline {one.deadline_ms:g} ms: {one.met}; margin {value:.3g} ms ({low:.3g} to {high:.3g}).")
    if one.sensors is not None:
        lines.append(f"Sensors that fit: {one.sensors[0]} ({one.sensors[1]} to {one.sensors[2]}).")
    if one.memory:
        lines.append(memory_line(one.memory))
    lines += [f"What dominates: {one.dominates}.", _error_line(one)]
    for name, bounded in (("Latency", one.latency_ms), ("Power", one.power_w)):
        boundary = f", {bounded.boundary}" if bounded.figure.known else ""
        lines.append(f"{name}{boundary}: {bounded.figure.source}.")
    return [*lines, *one.notes]


def _error_line(one: Estimate) -> str:
    e = one.errors
    if e.rows == 0:
        more = (
            ""
            if e.latency_from_macs is None
            else (f"; latency from MACs alone: {_number(e.latency_from_macs)} on other devices of its family")
        )
        return f"Leave-one-out error: no measured row of this device to judge by{more}."
    skill = ", ".join(f"{k} {_number(v)}" for k, v in e.skill.items())
    return (
        f"Leave-one-out over {e.rows} rows ({e.of}), worst factor: power, and energy with the latency given, "
        f"{_number(e.power)}; latency from MACs alone {_number(e.latency_from_macs)}; energy from MACs alone "
        f"{_number(e.energy_from_macs)}. Skill against the constant: {skill}."
    )


def _number(value: float | None) -> str:
    return "unknown" if value is None else f"{value:.3g}"


def _bound(value: float) -> str:
    return f"{value:.2g}" if abs(value) < 100 else f"{value:.0f}"


def _factor(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}" if value < 10 else f"{value:.0f}"


def _short(value: float) -> str:
    return f"{value:.3g}" if abs(value) < 1e4 else f"{value:.4g}"


def memory_line(memory: Mapping[str, Any]) -> str:
    """Bytes with binary prefixes; of an FPGA what of the part is used, bits named."""
    if "luts_of" in memory:
        luts = memory["luts"]
        interval = "" if luts["low"] == luts["high"] else f", {luts['low']:.0f} to {luts['high']:.0f}"
        how = f"assumption: {luts['source']}" if luts["kind"] == "assumption" else luts["source"]
        return (
            f"Memory: {memory['ram_bits']} of {memory['ram_bits_of']} bits of RAM. "
            f"LUTs: {luts['value']:.0f} of {memory['luts_of']} ({100 * luts['value'] / memory['luts_of']:.0f} %"
            f"{interval}; {how}). "
            f"Multipliers: {memory['multipliers']} of {memory['multipliers_of']}. Fits: {memory['fits']}."
        )
    names = {"bytes": "moved a frame", "of": "memory of the device"}
    return "Memory: " + ", ".join(f"{names.get(k, k)} {binary_bytes(v)}" for k, v in memory.items()) + "."


# ------------------------------------------------------------------------------------------------------ all devices


def estimates_of_all(model: Model, load: Load, known: Knowledge) -> list[Estimate]:
    """Our load on every device, every way it can run there; the host is measured."""
    found = []
    for name in device_names():
        chosen = find_device(name)
        for way in IMPLEMENTATIONS[chosen.family]:
            if chosen.family == "host":
                found.append(estimate_host(chosen, load, model))
            else:
                found.append(estimate_load(chosen, load, known=known, implementation=way, built=built_cores(model)))
    return found


def _every(model: Model, load: Load, known: Knowledge, report: Path | None, as_json: bool) -> None:
    found = estimates_of_all(model, load, known)
    data: dict[str, Any] = {
        "devices": [one.as_dict() for one in found],
        "leave_one_out": as_table(known.results),
        "model_crc32": f"{model.crc32:08x}",
    }
    if report is not None:
        from .estimate_report import write_estimate_report

        data["report"] = str(write_estimate_report(report, model, load, known, found))
    if as_json:
        emit_json(data)
        return
    show(_overview(found, load))
    if report is not None:
        message(f"report: {data['report']}")


def _overview(found: Sequence[Estimate], load: Load) -> Any:
    rows = [
        [
            f"{one.device.name} {one.implementation}", str(one.met), _interval(one.latency_ms, "ms"),
            _interval(one.power_w, "W", "*" if one.power_w.figure.kind == "assumption" else ""),
            "-" if one.increment_w is None else _interval(one.increment_w, "mW"),
        ]
        for one in found
    ]  # fmt: skip
    title = (
        f"Both images of a 32 x {load.columns} frame at {load.rate_hz:g} Hz, deadline {load.deadline_ms:g} ms; "
        "*: an assumption"
    )
    return table(title, ["", "met", "ms", "W", "mW added"], rows)


def _interval(bounded: Bounded, unit: str, mark: str = "") -> str:
    if not bounded.figure.known:
        return "-"
    value, low, high = bounded.figure.span(unit)
    return f"{_short(value)}{mark} ({_bound(low)}..{_bound(high)})"


def _list_devices(as_json: bool) -> None:
    found = [find_device(name) for name in device_names()]
    if as_json:
        emit_json({"devices": [_facts(d) for d in found]})
        return
    rows = [[d.name, d.title, ", ".join(IMPLEMENTATIONS[d.family]), ", ".join(d.modes)] for d in found]
    show(table("Devices", ["name", "", "runs our load on", "power modes"], rows))


def _facts(device: Device) -> dict[str, Any]:
    return {
        "name": device.name,
        "title": device.title,
        "family": device.family,
        "modes": list(device.modes),
        "figures": {name: figure.as_dict() for name, figure in device.every_figure()},
        "texts": dict(device.texts),
        "note": device.note,
    }


# ----------------------------------------------------------------------------------------------- errors, calibration


def _show_errors(known: Knowledge, as_json: bool) -> None:
    rows = as_table(known.results)
    if as_json:
        emit_json({"rows": rows})
        return
    keys = [f"{c}{w}_factor" for w in ("power", "latency", "energy") for c in ("", "constant_")]
    lines = [[f"{r['device']} {r['workload'].split(',')[0]}", *(_factor(r[k]) for k in keys)] for r in rows]
    names = ["row left out", "power", "const", "latency", "const", "energy", "const"]
    show(table("Leave-one-out: how many times off (1 is perfect)", names, lines))
    show(
        "Power is predicted with the latency given; energy with the latency given has the same factor. Latency and "
        "energy are from multiply-accumulates alone. Constant: this device always draws, or takes, what its other "
        "rows did."
    )


def _show_calibration(found: Calibration, as_json: bool) -> None:
    if as_json:
        emit_json(found.as_dict())
        return
    rows = []
    for name, unit in (("latency_ms", "ms"), ("power_w", "W"), ("energy_mj", "mJ")):
        before, after = (getattr(one, name) for one in (found.before, found.after))
        rows.append([f"{name}", _interval(before, unit), before.figure.kind, _interval(after, unit), after.figure.kind])
    show(table(f"{found.device.title}: before and after", ["", "before", "kind", "after", "kind"], rows))
    show(f"Power: {power_change(found.before.power_w.figure, found.after.power_w.figure)}")
    for recording in (found.recording, found.idle):
        if recording is not None:
            show(
                f"{recording.source}: {recording.mean_w:.3f} W +- {recording.half_width_w:.3f} (95 %), "
                f"{recording.seconds:.0f} s, {recording.boundary}; {recording.skipped} lines without it"
            )


# ---------------------------------------------------------------------------------------------------- the CPU model


def _validate_cpu(model: Model, as_json: bool) -> None:
    with err.status("measuring kernels by turns ..."):
        run = measure_host(model.file)
    worst, error = worst_error(run)
    if as_json:
        emit_json(_validation(run))
    else:
        _print_validation(run)
    if abs(error) > GOAL:
        message(f"{worst.precision} {worst.isa}, {worst.hidden} units, {worst.work}: off by {100 * error:+.1f} %")
        raise typer.Exit(1)


def _validation(run: HostRun) -> dict[str, Any]:
    worst, error = worst_error(run)
    return {
        "run": run.as_dict(),
        "core": {**vars(core_of(run))},
        "predictions": [{**vars(case), "predicted_ns": ns, "error": ns / case.ns - 1} for case, ns in predictions(run)],
        "worst": {**vars(worst), "error": error},
        "goal": GOAL,
    }


def _print_validation(run: HostRun) -> None:
    core = core_of(run)
    groups: dict[tuple[str, str, str], list[float]] = {}
    for case, ns in predictions(run):
        groups.setdefault((case.isa, case.precision, case.work), []).append(ns / case.ns - 1)
    rows = [
        [f"{isa} {precision} {work}", f"{len(e)}", f"{100 * min(e):+.1f} %", f"{100 * max(e):+.1f} %"]
        for (isa, precision, work), e in groups.items()
    ]
    show(table("CPU model, predicted less measured, one run", ["kernel", "widths", "least", "most"], rows))
    worst, error = worst_error(run)
    show(
        f"Calibrated on plain C and AVX2 float at {run.clock_ghz:.2f} GHz: loop efficiency {core.loop_efficiency:.3f}, "
        f"{core.mixed_per_cycle:.2f} mixed operations a cycle, {core.exposed_cycles:.1f} exposed cycles a block."
    )
    show(
        f"Worst of {len(predictions(run))}: {worst.isa} {worst.precision} {worst.work}, {worst.hidden} units: "
        f"{100 * error:+.1f} % (goal: {100 * GOAL:.0f} %)"
    )
