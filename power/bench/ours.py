"""Our own kernels and streams on the CPU: candidates, column latency, cost against width."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np

from upbeam.model.rules import PAIRS
from upbeam.runtime._native import CPUS, PRECISIONS
from upbeam.runtime.upsampler import Model, Upsampler

from . import _native
from .contest import Candidate
from .work import Work, check_image

__all__ = ["ColumnLatency", "Width", "column_latency", "fastest_cpu", "kernel_candidates", "usable_cpus", "widths"]

Kind = Literal["kernels", "push", "frame"]
_KINDS: tuple[Kind, ...] = ("kernels", "push", "frame")
_DOES = {
    "kernels": "all rules, both networks: counts of columns in, generated counts out",
    "push": "the whole step of a stream: all rules, both networks, columns of 64 rows out",
    "frame": "the whole-frame call: image rows in, image rows out",
}


def usable_cpus(model: Model) -> list[str]:
    """Instruction sets that this machine and this build have, slowest first; ``auto`` is the last."""
    found = []
    for cpu in CPUS[1:]:
        try:
            Upsampler(model, columns=16, cpu=cpu)
        except ValueError:
            continue
        found.append(cpu)
    best = fastest_cpu(model)
    return sorted(found, key=lambda cpu: cpu == best)


def fastest_cpu(model: Model) -> str:
    """What ``auto`` takes."""
    return Upsampler(model, columns=16).cpu


def kernel_candidates(work: Work, precision: str, cpu: str, threads: Sequence[int] = (1,)) -> list[Candidate]:
    """The kernels alone for each number of threads, and on one thread the streaming step and the whole-frame call."""
    made = [_candidate(work, precision, cpu, "kernels", n) for n in threads]
    return made + [_candidate(work, precision, cpu, kind, 1) for kind in _KINDS[1:]]


def make_job(work: Work, precision: str, cpu: str, kind: Kind, threads: int = 1) -> _native.Job:
    """Raises ValueError for what the model or this machine does not have."""
    return _native.Job(
        work.ubm, PRECISIONS.index(precision), CPUS.index(cpu), _KINDS.index(kind), threads, *work.column_major
    )


def _candidate(work: Work, precision: str, cpu: str, kind: Kind, threads: int) -> Candidate:
    job = make_job(work, precision, cpu, kind, threads)

    def check() -> None:
        if kind == "kernels":
            job.time(1)
            distance, intensity = job.output()
            check_image(work, precision, distance[:, :PAIRS].T, intensity[:, :PAIRS].T)
        else:
            check_image(work, precision, *_streamed(work, precision, cpu))

    name = f"upbeam {precision} {cpu}" + ("" if kind == "kernels" else f" {kind}")
    return Candidate(name, precision, threads, _DOES[kind], job.time, check, "ours", {"kind": kind, "cpu": cpu})


def _streamed(work: Work, precision: str, cpu: str) -> tuple[Any, Any]:
    """What the public stream gives for the frame: its own rows untouched, the generated ones returned."""
    up = Upsampler(Model(work.ubm), precision, columns=work.columns, cpu=cpu)
    distance, intensity = up(work.distance, work.intensity)
    if not (np.array_equal(distance[::2], work.distance) and np.array_equal(intensity[::2], work.intensity)):
        raise ValueError("the sensor's rows changed")
    return distance[1:-1:2], intensity[1:-1:2]


# --------------------------------------------------------------------------------------------------- single columns


@dataclass(frozen=True)
class ColumnLatency:
    """From pushing a column to the call that hands out the finished one, computing only; nanoseconds."""

    precision: str
    cpu: str
    paced: bool
    """columns come as a 20 Hz sensor sends them; else one right after the other"""
    columns: int
    p50_ns: int
    p99_ns: int
    p999_ns: int
    max_ns: int
    timer_ns: int
    """reading the clock twice: part of every figure"""

    def as_dict(self) -> dict[str, Any]:
        return asdict(self)


def column_latency(
    work: Work, precision: str, cpu: str, *, pushes: int, paced: bool, rate_hz: float = 20.0
) -> ColumnLatency:
    """Of the last column of three: the output is that of the column before, one column behind (aligned columns)."""
    interval = round(1e9 / (rate_hz * work.columns)) if paced else 0
    found = make_job(work, precision, cpu, "push").latency(pushes, interval)
    return ColumnLatency(precision, cpu, paced, **found)


# ------------------------------------------------------------------------------------------------------------ widths


@dataclass(frozen=True)
class Width:
    columns: int
    precision: str
    cpu: str
    kernels_ns_per_column: float
    push_ns_per_column: float


def widths(work: Work, precision: str, cpu: str, columns: Sequence[int], repeats: int) -> list[Width]:
    """The frame repeated or cut to other widths. Least of ``repeats`` turns, widths by turns."""
    jobs = []
    for count in columns:
        tiles = -(-count // work.columns)
        frame = (np.ascontiguousarray(np.tile(x, (1, tiles))[:, :count]) for x in (work.distance, work.intensity))
        wide = Work(work.ubm, *frame)
        jobs.append([make_job(wide, precision, cpu, kind) for kind in ("kernels", "push")])
    least = np.full((len(jobs), 2), np.inf)
    for _ in range(repeats):
        for k, pair in enumerate(jobs):
            for n, job in enumerate(pair):
                least[k, n] = min(least[k, n], float(np.min(job.time(3)[1:])))
    return [Width(n, precision, cpu, *(ns / n).tolist()) for n, ns in zip(columns, least, strict=True)]
