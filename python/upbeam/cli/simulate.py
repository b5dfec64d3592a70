"""``upbeam simulate``: simulated turns as files, or packets of a sensor on the network."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from upbeam.hw_sim import Scan
from upbeam.model.beams import beam_table, beam_table_names
from upbeam.model.io import write_bin, write_npz

from .common import JsonOption, UserError, emit_json, message, progress_bar
from .packets import PacketSettings, send_packets, write_packets
from .sources import simulated_scans

__all__ = ["simulate"]


def simulate(
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="Folder to write frames to; made if absent.")
    ] = None,
    frames: Annotated[int, typer.Option(min=1, max=100_000, help="Turns to simulate.")] = 10,
    sensor: Annotated[
        str, typer.Option(help=f"Beam table: {', '.join(beam_table_names())}, or a .yaml file.")
    ] = "hdl-64e",
    columns: Annotated[
        int | None, typer.Option(min=16, max=65535, help="Firings per turn; the sensor's own if omitted.")
    ] = None,
    rate: Annotated[float, typer.Option(help="Turns per second.")] = 20.0,
    seed: Annotated[int, typer.Option(min=0)] = 0,
    kind: Annotated[str, typer.Option("--format", help=".bin cloud (KITTI) or .npz range image.")] = "bin",
    udp: Annotated[
        str | None, typer.Option("--udp", metavar="HOST:PORT", help="Send a sensor's packets in real time instead.")
    ] = None,
    pcap: Annotated[Path | None, typer.Option("--pcap", help="Write a sensor's packets as a capture instead.")] = None,
    source: Annotated[
        str, typer.Option(help="Of packets: sim (streets), room (quick), or a recording to play in a loop.")
    ] = "sim",
    returns: Annotated[str, typer.Option(help="Of packets: strongest, last or dual.")] = "strongest",
    wander: Annotated[float, typer.Option(help="Of packets: largest deviation of the speed, 0 to 0.5.")] = 0.0,
    faults: Annotated[Path | None, typer.Option(help="Of packets: a .toml file with [[fault]] tables.")] = None,
    as_json: JsonOption = False,
) -> None:
    """Write the frames of one simulated drive, azimuth aligned; or play a sensor: its packets on the network."""
    if udp is not None or pcap is not None:
        settings = PacketSettings(sensor, rate, wander, columns, returns, seed, frames, source, faults)
        report = send_packets(settings, udp) if udp is not None else write_packets(settings, pcap)  # type: ignore[arg-type]
        if as_json:
            emit_json(report)
        else:
            message("  ".join(f"{key} {value}" for key, value in report.items()))
        return
    if output is None:
        raise UserError("expected --output FOLDER, --udp HOST:PORT or --pcap FILE")
    _write_frames(output, frames, sensor, columns, rate, seed, kind, as_json)


def _write_frames(
    output: Path, frames: int, sensor: str, columns: int | None, rate: float, seed: int, kind: str, as_json: bool
) -> None:
    if kind not in ("bin", "npz"):
        raise UserError(f"--format {kind}: expected bin or npz")
    beams = beam_table(sensor)
    width = columns or beams.columns
    scans = simulated_scans(beams, columns=width, frames=frames, seed=seed, rate_hz=rate)
    output.mkdir(parents=True, exist_ok=True)
    with progress_bar("simulating turns", frames, quiet=as_json) as advance:
        for number, scan in enumerate(scans):
            _write(output / f"{number:06d}.{kind}", scan)
            advance()
    if as_json:
        emit_json({"folder": str(output), "frames": frames, "sensor": beams.name, "columns": width, "seed": seed})
    else:
        message(f"{output}: {frames} frames of {beams.name}, {beams.beams} x {width}, seed {seed}")


def _write(path: Path, scan: Scan) -> None:
    if path.suffix == ".bin":
        points = scan.points()
        write_bin(path, points, np.zeros(len(points), dtype=bool))
        return
    write_npz(
        path, distance=scan.distance, intensity=scan.intensity, surface=scan.surface,
        distance_unit_m=np.float64(scan.distance_unit_m), elevation_deg=scan.beams.elevation_deg,
        cut_deg=np.float64(scan.cut_deg),
    )  # fmt: skip
