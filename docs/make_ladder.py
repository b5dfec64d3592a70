"""Prints figures of docs/upbeamd.md: what a rung of the degradation ladder costs to compute and in accuracy, and what a
packet costs the daemon's core.

    .venv/bin/python docs/make_ladder.py [FOLDER OF KITTI FRAMES]

Times are of this machine: the least of many repetitions, modes taking turns. Accuracy as `upbeam evaluate` judges it,
on the frames of drive-a (no training uses them), or on simulated frames where there is no folder.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from functools import partial
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

import upbeam
from upbeam.cli.evaluate import model_method
from upbeam.cli.sources import frame_of_scan, kitti_files_of_drives, simulated_scans
from upbeam.model.beams import beam_table
from upbeam.model.evaluate import evaluate
from upbeam.model.frames import Frame, kitti_frames
from upbeam.runtime import _native
from upbeam.runtime.daemon import Daemon
from upbeam.runtime.ladder import LADDER, ladder_rows
from upbeam.runtime.packets import Encoder, Firings, sensor_info

COLUMNS, REPEATS = 2048, 60
PRECISIONS = ("fp32", "int16", "int8")


def least_ns(streams: dict[Any, Any], image: tuple[Any, Any]) -> dict[Any, float]:
    """Nanoseconds a column, the least of all repetitions; streams take turns."""
    least = dict.fromkeys(streams, float("inf"))
    for _ in range(REPEATS):
        for key, stream in streams.items():
            begin = time.perf_counter_ns()
            stream.image(*image)
            least[key] = min(least[key], (time.perf_counter_ns() - begin) / COLUMNS)
    return least


def costs() -> None:
    rng = np.random.default_rng(1)
    image = rng.integers(1500, 20000, (32, COLUMNS)).astype(np.uint16), rng.integers(0, 256, (32, COLUMNS), np.uint8)
    model = _native.Model(resources.files("upbeam.quant").joinpath("models").joinpath("hdl-64e.ubm").read_bytes())
    streams = {}
    for cpu in ("auto", "scalar"):
        for mode in LADDER:
            for precision in PRECISIONS:
                stream = _native.Stream(model, precision=precision, cpu=cpu, columns=COLUMNS, aligned=True)
                stream.set_mode(mode)
                streams[cpu, mode, precision] = stream
    least = least_ns(streams, image)
    for cpu in ("auto", "scalar"):
        print(f"\n{cpu} ({streams[cpu, 'network', 'fp32'].stats()['cpu']}): ns a column, {', '.join(PRECISIONS)}")
        for mode in LADDER:
            print(f"  {mode:13}", *(f"{least[cpu, mode, p]:7.1f}" for p in PRECISIONS))


def work() -> None:
    """Microseconds of the core on a packet of 12 firings, the call from Python included: least of all repetitions."""
    rng = np.random.default_rng(1)
    count = 1808 * 12
    info = sensor_info("hdl-32e")
    turn = np.arange(count) * info.firing_cycle_ns
    firings = Firings.of(
        rng.integers(1500, 20000, (count, 32)).astype(np.uint16),
        rng.integers(0, 256, (count, 32)).astype(np.uint8),
        azimuth_mdeg=turn * 36 // 10_000 // 10 * 10 % 360_000,
        time_ns=turn,
    )
    packets = Encoder("hdl-32e").encode(firings)
    sent = turn[11::12] + info.firing_cycle_ns
    model = resources.files("upbeam.quant").joinpath("models").joinpath("hdl-32e.ubm").read_bytes()
    print(f"\nint16, HDL-32E, microseconds of {12 * info.firing_cycle_ns / 1e3:.0f} on a packet")
    for outputs in ((), ("columns",), ("columns", "hdl64"), ("columns", "hdl64", "can", "serial")):
        least = float("inf")
        for _ in range(8):
            daemon = Daemon(model, {"ledger_capacity": 64}, outputs=outputs)
            begin = time.perf_counter_ns()
            for data, now in zip(packets, sent.tolist(), strict=True):
                daemon.packet(data, now)
            least = min(least, (time.perf_counter_ns() - begin) / len(packets))
        print(f"  {', '.join(outputs) or 'no output':28} {least / 1e3:6.2f}")


def frames(folder: str | None, model: Any) -> Iterator[Frame]:
    if folder:
        files = kitti_files_of_drives(Path(folder), ["drive-a"])
        return (frame for file in files for frame in kitti_frames(file, model.rules))
    scans = simulated_scans(beam_table("hdl-64e"), columns=model.columns, frames=10, seed=1, frames_per_scene=1)
    return map(frame_of_scan, scans)


def accuracy(folder: str | None) -> None:
    model = upbeam.load_model()
    methods = {"network": model_method(model)} | {mode: partial(ladder_rows, mode) for mode in LADDER[1:3]}
    result = evaluate(frames(folder, model), methods, model.rules)
    print(f"\n{len(result.frames)} frames of {folder or 'the simulator'}")
    names = ("chamfer_m2", "mae_m", "ghost_share", "coverage", "median_m")
    print(" " * 13, *(f"{name:>12}" for name in names))
    for mode, means in result.means().items():
        print(f"{mode:13}", *(f"{means[name]:12.4f}" for name in names))


if __name__ == "__main__":
    costs()
    work()
    accuracy(sys.argv[1] if len(sys.argv) > 1 else None)
