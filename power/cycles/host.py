"""The CPU model of this machine: calibrated on plain C and AVX2, held against every other kernel in the same run."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from upbeam.model.network import FoldedNetwork
from upbeam.model.rules import BEAMS, U8, U16
from upbeam.power.bench import _native
from upbeam.power.bench.bench import make_work
from upbeam.power.bench.machine import unit_pairs
from upbeam.power.bench.ours import Kind, make_job, usable_cpus
from upbeam.quant.ubm import ModelFile
from upbeam.runtime.upsampler import Model

from .cpu import CpuCore, cpu_cycles
from .kernel_ops import ISAS, kernel_ops

__all__ = [
    "CALIBRATION_WIDTHS",
    "Case",
    "HostRun",
    "core_of",
    "measure_host",
    "pairs_of",
    "predictions",
    "widened",
    "worst_error",
]

CALIBRATION_WIDTHS = (4, 24)
"""Hidden units of the two float networks that the model is calibrated on, in plain C and AVX2."""
OTHER_WIDTHS = (6, 8, 12, 16)
PRECISIONS = ("fp32", "int16", "int8")
COLUMNS = 256
"""Of a frame that is timed: even plain C takes less than a time slice of a shared machine."""
REPEATS = 9
PLACES = 3


@dataclass(frozen=True)
class Case:
    """One kernel: least time of a column, measured."""

    hidden: int
    isa: str
    precision: str
    work: str
    """``kernels`` or ``push``"""
    ns: float

    @property
    def is_calibration(self) -> bool:
        """Of these the model knows the time; of all others it does not."""
        known = self.isa in ("scalar", "avx2") and self.precision == "fp32" and self.hidden in CALIBRATION_WIDTHS
        return known and (self.work == "kernels" or self.isa == "avx2")


@dataclass(frozen=True)
class HostRun:
    """Micro-benchmarks of the machine and times of the kernels, taken by turns: least values."""

    clock_ghz: float
    multiply_ns: dict[str, float]
    """of a full vector's fused multiply-add, by instruction set"""
    dot_ns: dict[str, float]
    load_ns: float
    rest_ns: float
    """of the rules' operations of one AVX2 block, without their dependencies"""
    cases: tuple[Case, ...]

    def as_dict(self) -> dict[str, Any]:
        return {**asdict(self), "cases": [list(asdict(c).values()) for c in self.cases]}

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> HostRun:
        return cls(**{**data, "cases": tuple(Case(*c) for c in data["cases"])})


def widened(file: ModelFile, hidden: int) -> ModelFile:
    """The model with ``hidden`` units in both networks: its own repeated, for their speed alone."""

    def widen(net: FoldedNetwork) -> FoldedNetwork:
        unit = np.arange(hidden) % net.hidden
        times = np.bincount(unit, minlength=net.hidden)[unit]
        weights = net.output_weight[unit] / times
        return replace(net, weight=net.weight[unit], bias=net.bias[unit], output_weight=weights)

    distance, intensity = (widen(net) for net in file.folded)
    return replace(file, folded=(distance, intensity), dense=None, int16=None, int8=None)


# ------------------------------------------------------------------------------------------------------ measuring


def measure_host(file: ModelFile, *, rounds: int = 16, widths: Sequence[int] = OTHER_WIDTHS) -> HostRun:
    """Takes seconds. Raises ValueError on machines without AVX2: there is nothing to calibrate on."""
    loops = {(isa, kind): per_round for isa, kind, per_round in _native.loop_names()}
    if ("avx2", "fma_f32") not in loops:
        raise ValueError("this machine has no AVX2: the CPU model cannot be calibrated here")
    jobs = _jobs(file, (*CALIBRATION_WIDTHS, *widths))
    least = dict.fromkeys(jobs, np.inf)
    machine = _Machine(loops)
    for _ in range(rounds):
        machine.measure()
        for key, job in ((key, job) for key, placed in jobs.items() for job in placed):
            least[key] = min(least[key], float(np.min(job.time(REPEATS)[1:])) / COLUMNS)
    return machine.run(tuple(Case(*key, ns) for key, ns in least.items()))


def _jobs(file: ModelFile, widths: Iterable[int]) -> dict[tuple[int, str, str, str], list[_native.Job]]:
    """Each several times: where its memory happens to lie makes a push up to a fifth slower."""
    frame = _flat_frame(file)
    jobs: dict[tuple[int, str, str, str], list[_native.Job]] = {}
    kinds: tuple[Kind, ...] = ("kernels", "push")
    for hidden in sorted(set(widths)):
        work, _ = make_work(widened(file, hidden), frame)
        for isa in usable_cpus(Model(work.ubm)):
            for precision in PRECISIONS if isa != "scalar" else PRECISIONS[:1]:
                for kind in kinds:
                    jobs[hidden, isa, precision, kind] = [make_job(work, precision, isa, kind) for _ in range(PLACES)]
    return jobs


def _flat_frame(file: ModelFile) -> tuple[U16, U8]:
    """The same everywhere: plain C branches on what it sees, and how well a processor guesses is no matter of operation
    counts. Vector kernels take the same time for any frame."""
    shape = (BEAMS, COLUMNS)
    return np.full(shape, round(10 / file.rules.distance_unit_m), np.uint16), np.full(shape, 50, np.uint8)


class _Machine:
    """Least times of the micro-benchmarks."""

    def __init__(self, loops: dict[tuple[str, str], int]) -> None:
        self._loops = loops
        self._clock = 0.0
        self._ns: dict[tuple[str, str], float] = {}

    def measure(self) -> None:
        self._clock = max(self._clock, _native.clock_ghz(2))
        for isa, kind in self._loops:
            if kind in ("fma_f32", "dot_int16") or (isa, kind) == ("avx2", "load"):
                self._keep((isa, kind), _native.loop_ns(isa, kind, 4096, 2))
        self._keep(("avx2", "rest"), _native.mix_ns("avx2", "fp32", 0, 0, 2))

    def _keep(self, key: tuple[str, str], ns: float) -> None:
        self._ns[key] = min(self._ns.get(key, np.inf), ns)

    def run(self, cases: tuple[Case, ...]) -> HostRun:
        vector = {isa: 2 * ISAS[isa].windows for isa, _ in self._loops}  # bytes
        multiply = {i: ns / (self._loops[i, k] / vector[i] * 4) for (i, k), ns in self._ns.items() if k == "fma_f32"}
        dot = {i: ns / (self._loops[i, k] / vector[i] * 2) for (i, k), ns in self._ns.items() if k == "dot_int16"}
        load = self._ns["avx2", "load"] / (self._loops["avx2", "load"] / vector["avx2"])
        return HostRun(self._clock, multiply, dot, load, self._ns["avx2", "rest"], cases)


# ----------------------------------------------------------------------------------------------------- calibrating


def core_of(run: HostRun) -> CpuCore:
    """The calibrated core. Uses of ``run.cases`` only those that ``Case.is_calibration`` marks."""
    known = {(c.isa, c.hidden, c.work): c.ns * run.clock_ghz for c in run.cases if c.is_calibration}
    few, many = CALIBRATION_WIDTHS
    clock = run.clock_ghz
    bare = CpuCore(
        name="this machine",
        kind="modelled",
        source="calibrated here on plain C and the AVX2 float kernel",
        mixed_per_cycle=sum(kernel_ops("avx2", "fp32").rest.values()) / (run.rest_ns * clock),
        exposed_cycles=0.0,
        push_cycles=max(0.0, sum(known["avx2", h, "push"] - known["avx2", h, "kernels"] for h in (few, many)) / 2),
        multiply_per_cycle={isa: 1 / (ns * clock) for isa, ns in run.multiply_ns.items()},
        dot_per_cycle={isa: 1 / (ns * clock) for isa, ns in run.dot_ns.items()},
        # A dot product whose addition is apart is two operations: the best rate of them is what the ports take.
        vector_per_cycle=max(2 / (ns * clock) for isa, ns in run.dot_ns.items() if not ISAS[isa].fused_dot),
        loads_per_cycle=1 / (run.load_ns * clock),
        scalar=_line((few, known["scalar", few, "kernels"]), (many, known["scalar", many, "kernels"])),
    )
    low, high = (cpu_cycles(bare, "avx2", "fp32", (h, 0)) for h in (few, many))
    slope = (known["avx2", many, "kernels"] - known["avx2", few, "kernels"]) / (high - low)
    fitted = replace(bare, loop_efficiency=1 / slope)
    left = known["avx2", few, "kernels"] - cpu_cycles(fitted, "avx2", "fp32", (few, 0))
    return replace(fitted, exposed_cycles=max(0.0, left) / ISAS["avx2"].blocks)


def _line(one: tuple[int, float], other: tuple[int, float]) -> tuple[float, float]:
    slope = (other[1] - one[1]) / (other[0] - one[0])
    return one[1] - slope * one[0], slope


def predictions(run: HostRun) -> list[tuple[Case, float]]:
    """Every case that the calibration has not seen, and the model's time for it, ns of a column."""
    core = core_of(run)
    found = []
    for case in run.cases:
        if not case.is_calibration:
            cycles = cpu_cycles(core, case.isa, case.precision, (case.hidden, 0))
            found.append((case, (cycles + core.push_cycles * (case.work == "push")) / run.clock_ghz))
    return found


def worst_error(run: HostRun) -> tuple[Case, float]:
    """The case that the model misses most, and by what share of the measured time (signed)."""
    return max(((case, ns / case.ns - 1) for case, ns in predictions(run)), key=lambda x: abs(x[1]))


def pairs_of(file: ModelFile) -> tuple[int, int]:
    """Pairs of hidden units without and with a slope, both networks."""
    return unit_pairs(file.folded)
