"""``upbeam stream``: a sensor's feed through the upsampler, every frame held to its deadline."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray

from upbeam.model.beams import beam_table, beam_table_names
from upbeam.model.frames import image_of_cloud, kitti_files
from upbeam.model.io import read_cloud
from upbeam.model.rules import BEAMS, ROWS
from upbeam.power.catalogue import device as find_device
from upbeam.power.deploy import SERVICES, Service, target_service
from upbeam.runtime.live import LiveConfig, LiveProgress, LiveResult, firing_columns, run_live
from upbeam.runtime.upsampler import CPUS, PRECISIONS, Model, load_model

from .common import JsonOption, UserError, emit_json, message, progress_bar, show, table
from .estimate import load_of
from .fpga import built_cores
from .sources import simulated_scans

__all__ = ["stream"]

U16 = NDArray[np.uint16]
U8 = NDArray[np.uint8]

VIRTUAL_COLUMN_US = 2.0
"""Default service time of the virtual clock: a modelled, round figure, several times what a workstation core needs."""


@dataclass(frozen=True)
class _Feed:
    """What is played, and what it is compared with."""

    name: str
    images: tuple[U16, U8]
    """[F, 32, W] azimuth-aligned, or firing columns where ``aligned`` is False"""
    truth: tuple[U16, U8] | None
    """[64, W] of the frame that is pictured, where the source has it"""
    pictured: int
    aligned: bool
    sensor: str


def stream(
    source: Annotated[str, typer.Option(help="'sim', a KITTI .bin frame or a folder of them.")] = "sim",
    rate: Annotated[float, typer.Option(help="Turns per second.")] = 20.0,
    frames: Annotated[
        int | None, typer.Option(min=1, help="Frames to play (sim: 200; recordings: all, repeated if more).")
    ] = None,
    model: Annotated[str | None, typer.Option(help="A .ubm file, or hdl-32e or vlp-32c instead of hdl-64e.")] = None,
    backend: Annotated[str, typer.Option(help="cpu.")] = "cpu",
    precision: Annotated[str, typer.Option(help=", ".join(PRECISIONS) + ".")] = "fp32",
    cpu: Annotated[str, typer.Option(help=f"Force an instruction set: {', '.join(CPUS[1:])}.")] = "auto",
    deadline_ms: Annotated[float, typer.Option(help="From the last input column to the last output column.")] = 50.0,
    clock: Annotated[str, typer.Option(help="real, or virtual (deterministic, modelled service time).")] = "real",
    column_us: Annotated[float, typer.Option(help="Virtual clock: service time of a column.")] = VIRTUAL_COLUMN_US,
    target: Annotated[
        str | None, typer.Option(help="Virtual clock: service time and jitter of a device (upbeam estimate).")
    ] = None,
    mode: Annotated[str | None, typer.Option(help="With --target: its power mode.")] = None,
    service: Annotated[str, typer.Option(help=f"With --target: {', '.join(SERVICES)} of its interval.")] = "central",
    sensor: Annotated[
        str | None, typer.Option(help=f"Simulated sensor ({', '.join(beam_table_names())}); the model's if omitted.")
    ] = None,
    any_sensor: Annotated[
        bool, typer.Option("--any-sensor", help="Accept a sensor that the model was not made for.")
    ] = False,
    seed: Annotated[int, typer.Option(min=0, help="Of the simulator.")] = 0,
    report: Annotated[Path | None, typer.Option(help="Folder for report.html and report.json.")] = None,
    fail_on_miss: Annotated[
        bool, typer.Option("--fail-on-miss", help="Exit with status 1 if a frame missed its deadline.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Play a 20 Hz feed packet by packet through the column stream and judge every frame."""
    if backend != "cpu":
        raise UserError(f"--backend {backend}: a stream runs on the cpu; whole images also on others (upsample)")
    if clock not in ("real", "virtual"):
        raise UserError(f"--clock {clock}: expected real or virtual")
    if (target is not None and clock != "virtual") or (target is None and (mode is not None or service != "central")):
        raise UserError("--target goes with --clock virtual, --mode and --service with --target")
    loaded = load_model(model)
    config = LiveConfig(
        rate_hz=rate, frames=frames, deadline_ms=deadline_ms, clock="real" if clock == "real" else "virtual", cpu=cpu,
        precision=precision, any_sensor=any_sensor, service_column_us=column_us if clock == "virtual" else None,
    )  # fmt: skip
    deployed = None
    if target is not None:
        load = load_of(loaded, precision, None, rate, deadline_ms)
        deployed = target_service(
            find_device(target), load, config.columns_per_packet, mode=mode, service=service, seed=seed,
            built=built_cores(loaded),
        )  # fmt: skip
        config = replace(config, service_column_us=None, service_us=deployed.service_us)
    feed = _feed(source, loaded, sensor, any_sensor, frames, rate, seed, quiet=as_json)
    result = _play(feed, loaded, config, quiet=as_json)
    summary = _summary(feed, loaded, result)
    if deployed is not None:
        summary["target"] = _on_target(deployed, result)
    if report is not None:
        from .stream_report import write_stream_report

        source_facts = {key: str(summary[key]) for key in ("source", "sensor", "kind", "backend", "precision")}
        if deployed is not None:
            source_facts |= _target_facts(summary["target"])
        page = write_stream_report(report, feed.images, feed.truth, feed.pictured, loaded, result, source_facts)
        summary["report"] = str(page)
    if as_json:
        emit_json(summary)
    else:
        _print(summary, result)
    if fail_on_miss and result.misses:
        raise typer.Exit(1)


def _feed(
    source: str, model: Model, sensor: str | None, any_sensor: bool, frames: int | None, rate: float, seed: int, *,
    quiet: bool
) -> _Feed:  # fmt: skip
    if source == "sim":
        return _simulated(model, sensor or model.rules.sensor, any_sensor, frames or 200, rate, seed, quiet)
    if sensor is not None:
        raise UserError("--sensor goes with --source sim: a recording is what it is")
    if Path(source).suffix.lower() in {".pcap", ".pcapng", ".db3"}:
        raise UserError(f"{source}: packet captures cannot be played by this version, give 'sim' or KITTI .bin frames")
    return _recorded(source, model, frames, quiet)


def _simulated(
    model: Model, sensor: str, any_sensor: bool, frames: int, rate: float, seed: int, quiet: bool
) -> _Feed:  # fmt: skip
    if sensor != model.rules.sensor and not any_sensor:
        raise UserError(
            f"--sensor {sensor}: the model was made for {model.rules.sensor}; --any-sensor plays it all the same"
        )
    with_truth = sensor.endswith("/2")
    beams = beam_table(sensor.removesuffix("/2"))
    if with_truth is False and beams.beams != BEAMS:
        raise UserError(
            f"--sensor {sensor}: has {beams.beams} beams, expected {BEAMS} (hdl-64e/2 takes every other of 64)"
        )
    if beams.distance_unit_m != model.distance_unit_m:
        raise UserError(
            f"--sensor {sensor}: counts of {beams.distance_unit_m} m, the model's are {model.distance_unit_m} m"
        )
    step = 2 if with_truth else 1
    distance = np.zeros((frames, BEAMS, model.columns), np.uint16)
    intensity = np.zeros((frames, BEAMS, model.columns), np.uint8)
    pictured, truth = frames // 2, None
    # Recorded range images are azimuth aligned, and so is the model made from them; a native sensor sends firing
    # columns.
    aligned = with_truth
    scans = simulated_scans(beams, columns=model.columns, frames=frames, seed=seed, rate_hz=rate, align=aligned)
    with progress_bar(f"simulating {sensor}", frames, quiet=quiet) as advance:
        for k, scan in enumerate(scans):
            distance[k], intensity[k] = scan.distance[::step], scan.intensity[::step]
            if k == pictured and with_truth:
                truth = scan.distance, scan.intensity
            advance()
    return _Feed(f"simulated {sensor}, seed {seed}", (distance, intensity), truth, pictured, aligned, sensor)


def _recorded(source: str, model: Model, frames: int | None, quiet: bool) -> _Feed:
    files = kitti_files(source)[:frames]
    images = (
        np.zeros((len(files), ROWS, model.columns), np.uint16),
        np.zeros((len(files), ROWS, model.columns), np.uint8),
    )
    with progress_bar("reading frames", len(files), quiet=quiet) as advance:
        for k, path in enumerate(files):
            image = image_of_cloud(read_cloud(path), path, model.rules)
            images[0][k], images[1][k] = image.distance, image.intensity
            advance()
    pictured = len(files) // 2
    truth = images[0][pictured], images[1][pictured]
    return _Feed(
        f"{source} ({len(files)} frames)", (images[0][:, ::2], images[1][:, ::2]), truth, pictured, True, "hdl-64e/2"
    )


def _play(feed: _Feed, model: Model, config: LiveConfig, *, quiet: bool) -> LiveResult:
    config = replace(config, aligned=feed.aligned, keep_frames=(feed.pictured,))
    columns = firing_columns(feed.images[0]), firing_columns(feed.images[1])
    total = config.frames or len(columns[0])
    with progress_bar(f"streaming {config.rate_hz:g} Hz", total, quiet=quiet) as advance:
        done = 0

        def show_progress(p: LiveProgress) -> None:
            nonlocal done
            advance(
                p.frames - done,
                f"{p.last_latency_ms:.2f} ms, worst {p.max_latency_ms:.2f}, misses {p.misses}",
            )
            done = p.frames

        return run_live(model, *columns, config, show_progress)


def _summary(feed: _Feed, model: Model, result: LiveResult) -> dict[str, Any]:
    return {
        "source": feed.name,
        "sensor": feed.sensor,
        "model_crc32": f"{model.crc32:08x}",
        "backend": "cpu",
        "precision": result.precision,
        "kind": "measured" if result.clock == "real" else "modelled",
        "cpu_instruction_set": result.cpu,
        **result.to_dict(),
    }


def _on_target(service: Service, result: LiveResult) -> dict[str, Any]:
    """What a deployment has to know besides the ledger: the margin, and how many sensors fit."""
    worst = result.latency_ms.get("max")
    return {
        **service.as_dict(),
        "margin_ms": None if worst is None else result.deadline_ms - worst,
        "sensors": service.sensors(result.rate_hz, result.columns),
    }


def _print(summary: dict[str, Any], result: LiveResult) -> None:
    kind = summary["kind"]
    latency = result.latency_ms
    rows = [
        ["frames judged / played", f"{result.counts.get('frames_judged', result.frames)} / {result.frames}"],
        [
            f"missed the {result.deadline_ms:g} ms deadline",
            f"{result.misses} ({result.misses_unexplained} not explained by machine stalls)",
        ],
        *[
            [f"latency {name} ({kind})", f"{latency[name]:.3f} ms"]
            for name in ("p50", "p99", "p999", "max")
            if name in latency
        ],
        [f"compute per column p50 / p99.9 ({kind})", _pair(result.column_compute_us, "us")],
        ["pacer's own lateness p50 / p99.9", _pair(result.pacer_lateness_us, "us")],
        ["packets dropped", f"{result.counts.get('packets_dropped', 0)}"],
        ["instruction set", result.cpu],
    ]
    show(
        table(
            f"{summary['source']} at {result.rate_hz:g} Hz, {result.columns} columns, {result.clock} clock",
            ["", "value"],
            rows,
        )
    )
    if "target" in summary:
        _print_target(summary["target"], result)
    if "report" in summary:
        message(f"report: {summary['report']}")
    if result.stopped:
        message("stopped early")


def _target_facts(target: dict[str, Any]) -> dict[str, str]:
    """For the report."""
    column, sensors = target["column_us"], target["sensors"]
    return {
        "target": f"{target['device']} {target['mode'] or ''}".strip(),
        "column on the target (us)": f"{column['value']:.3g} ({column['low']:.3g} to {column['high']:.3g}), modelled",
        "least margin (ms)": "unknown" if target["margin_ms"] is None else f"{target['margin_ms']:.3f}",
        "sensors that fit": f"{sensors['value']} ({sensors['low']} to {sensors['high']})",
    }


def _print_target(target: dict[str, Any], result: LiveResult) -> None:
    column, wakeup, sensors = target["column_us"], target["wakeup_us"], target["sensors"]
    margin = "unknown" if target["margin_ms"] is None else f"{target['margin_ms']:.3f} ms"
    where = f"{target['device']}{', mode ' + target['mode'] if target['mode'] else ''}"
    show(
        f"On {where} (modelled): a column takes {column['value']:.3g} us ({column['low']:.3g} to {column['high']:.3g}; "
        f"{target['service']} used),\n"
        f"waking up {wakeup['value']:.3g} us ({wakeup['low']:.3g} to {wakeup['high']:.3g}).\n"
        f"Least margin to {result.deadline_ms:g} ms: {margin}. Sensors that fit on {target['cores']} cores: "
        f"{sensors['value']} ({sensors['low']} to {sensors['high']})."
    )


def _pair(values: dict[str, float], unit: str) -> str:
    return f"{values['p50']:.2f} / {values['p999']:.2f} {unit}" if "p999" in values else "-"
