"""What this machine can do: multiply-adds, dot products, loads, memory, clock; the port bound of a window kernel."""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from upbeam.model.network import FoldedNetwork

from . import _native

__all__ = ["PEAK_OF", "Bound", "Peak", "Peaks", "measure_peaks", "unit_pairs"]

PEAK_OF = {"fp32": "fma_f32", "int16": "dot_int16", "int8": "dot_int16"}
"""Kind of loop that a precision is compared with: int8 kernels multiply 16-bit pairs as well (docs/performance.md)."""
_LEVELS = {"L1": 16 << 10, "L2": 512 << 10}
_MEMORY = 256 << 20
"""Larger than any cache of the machines that are meant."""


@dataclass(frozen=True)
class Peak:
    """One loop of independent instructions, the least time of several measurements."""

    isa: str
    kind: str
    macs_per_ns: float


@dataclass(frozen=True)
class Bound:
    """The instructions of a window kernel without their dependencies, timed: what the ports allow."""

    isa: str
    precision: str
    ns_per_column: float
    instructions_per_column: dict[str, float]

    @property
    def arithmetic_share(self) -> float:
        """Multiply-adds among the instructions that are neither loads nor stores; the rest is rules, rectifier,
        requantising and packing."""
        counts = {k: v for k, v in self.instructions_per_column.items() if k not in ("load", "store")}
        return counts.get("multiply_add", 0.0) / sum(counts.values())


@dataclass(frozen=True)
class Peaks:
    clock_ghz: float
    peaks: tuple[Peak, ...]
    bounds: tuple[Bound, ...]
    load_gb_s: dict[str, float]
    """loads of the widest vectors from L1, from L2, and as a stream from memory"""
    copy_gb_s: float
    """bytes read and written by a copy larger than the caches, together"""

    def peak(self, precision: str, cpu: str) -> float | None:
        """Multiply-adds a nanosecond of this precision's instructions: of the instruction set, or the machine's highest
        where no loop is written for it. None on machines without loops."""
        kind = PEAK_OF[precision]
        own = [p.macs_per_ns for p in self.peaks if p.kind == kind and p.isa == cpu]
        return max(own or [p.macs_per_ns for p in self.peaks if p.kind == kind], default=None)

    def bound(self, precision: str, cpu: str) -> Bound | None:
        return next((b for b in self.bounds if (b.isa, b.precision) == (cpu, precision)), None)

    def as_dict(self) -> dict[str, Any]:
        return {
            "clock_ghz": self.clock_ghz,
            "peaks": [{**vars(p), "macs_per_cycle": p.macs_per_ns / self.clock_ghz} for p in self.peaks],
            "load_gb_s": self.load_gb_s,
            "copy_gb_s": self.copy_gb_s,
            "port_bounds": [{**vars(b), "multiply_add_share": b.arithmetic_share} for b in self.bounds],
        }


def unit_pairs(networks: Iterable[FoldedNetwork]) -> tuple[int, int]:
    """Pairs of hidden units without and with a slope: kernels take two at a time, the last with zeros if need be."""
    plain = leaky = 0
    for network in networks:
        pairs = -(-network.hidden // 2)
        plain, leaky = (plain, leaky + pairs) if network.slope > 0 else (plain + pairs, leaky)
    return plain, leaky


def measure_peaks(pairs: tuple[int, int], *, repeats: int = 15) -> Peaks:
    """``pairs``: of ``unit_pairs``, for the port bounds. Takes some tens of milliseconds a loop."""
    loops = _native.loop_names()
    peaks = tuple(
        Peak(isa, kind, per_round / _native.loop_ns(isa, kind, 4096, repeats))
        for isa, kind, per_round in loops
        if kind != "load"
    )
    return Peaks(
        clock_ghz=_native.clock_ghz(repeats),
        peaks=peaks,
        bounds=tuple(_bound(mix, pairs, repeats) for mix in _native.mixes()),
        load_gb_s=_loads(loops, repeats),
        copy_gb_s=_copy(-(-repeats // 3)),
    )


def _bound(mix: dict[str, Any], pairs: tuple[int, int], repeats: int) -> Bound:
    plain, leaky = pairs
    blocks = 32 / mix["windows"]
    parts = [(plain + leaky, mix["pair"]), (leaky, mix["leaky"]), (1, mix["rest"])]
    counts: dict[str, float] = {}
    for times, part in parts:
        for kind, count in part.items():
            if times:
                counts[kind] = counts.get(kind, 0.0) + blocks * times * count
    ns = blocks * _native.mix_ns(mix["isa"], mix["precision"], plain, leaky, repeats)
    return Bound(mix["isa"], mix["precision"], ns, counts)


def _loads(loops: list[tuple[str, str, int]], repeats: int) -> dict[str, float]:
    widest = [isa for isa, kind, _ in loops if kind == "load"][-1:]
    levels = {**_LEVELS, "memory": _MEMORY}
    return {
        level: 4096 / _native.loop_ns(isa, "load", size, min(repeats, 5) if level == "memory" else repeats)
        for isa in widest
        for level, size in levels.items()
    }


def _copy(repeats: int) -> float:
    source, target = np.ones(_MEMORY // 8), np.zeros(_MEMORY // 8)
    least = np.inf
    for _ in range(repeats):
        start = time.perf_counter_ns()
        np.copyto(target, source)
        least = min(least, time.perf_counter_ns() - start)
    return float(2 * source.nbytes / least)
