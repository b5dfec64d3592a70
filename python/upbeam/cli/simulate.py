"""``upbeam simulate``: simulated turns as files."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from upbeam.hw_sim import Scan
from upbeam.model.beams import beam_table, beam_table_names
from upbeam.model.io import write_bin, write_npz

from .common import JsonOption, UserError, emit_json, message, progress_bar
from .sources import simulated_scans

__all__ = ["simulate"]


def simulate(
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder to write to; made if absent.")],
    frames: Annotated[int, typer.Option(min=1, max=100_000, help="Turns to simulate.")] = 10,
    sensor: Annotated[
        str, typer.Option(help=f"Beam table: {', '.join(beam_table_names())}, or a .yaml file.")
    ] = "hdl-64e",
    columns: Annotated[
        int | None, typer.Option(min=16, max=65535, help="Firings per turn; the table's if omitted.")
    ] = None,
    rate: Annotated[float, typer.Option(help="Turns per second.")] = 20.0,
    seed: Annotated[int, typer.Option(min=0)] = 0,
    kind: Annotated[str, typer.Option("--format", help=".bin cloud (KITTI) or .npz range image.")] = "bin",
    as_json: JsonOption = False,
) -> None:
    """Write the frames of one simulated drive, azimuth aligned."""
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
