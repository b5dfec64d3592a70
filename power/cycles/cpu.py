"""Latency of our kernels on a CPU, from operation counts and what a core does in a cycle.

A column is ``blocks`` vectors of windows. For each block

    cycles = pairs of hidden units x cycles of a pair / loop efficiency      the loop over hidden units
           + other operations / mixed operations a cycle                     rules, packing, output
           + exposed                                                         steps that wait for each other

``cycles of a pair`` is the scarcest resource of the loop: multiply-adds, vector operations or loads. What a core does
in a cycle is measured by micro-benchmarks (loops of independent instructions); two numbers, the efficiency of the loop
and the exposed cycles, come from the AVX2 float kernel at two widths. Nothing is fitted on the kernels that are
predicted: AVX-512, integers, other widths. Where nothing can be run, pair cycles are those of a static analysis
(docs/performance.md) and the rest is an assumption, with an interval that says so.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from upbeam.power.figures import Figure

from .kernel_ops import ISAS, kernel_ops

__all__ = ["CpuCore", "CpuTime", "cpu_cycles", "cpu_time"]

CALIBRATED_WITHIN = 1.2
"""The interval of a calibrated core: the goal that ``upbeam estimate --validate-cpu`` holds it to."""


@dataclass(frozen=True)
class CpuCore:
    """What one core does. Rates are operations of full vectors a cycle."""

    name: str
    kind: str
    source: str
    mixed_per_cycle: float
    """operations of the rules, of all kinds together"""
    exposed_cycles: float
    """a block: dependent steps that nothing hides"""
    push_cycles: float
    """a column: the sensor's rows interleaved, the sink called"""
    loop_efficiency: float = 1.0
    multiply_per_cycle: Mapping[str, float] = field(default_factory=dict)
    """of each instruction set: fused multiply-adds of floats"""
    dot_per_cycle: Mapping[str, float] = field(default_factory=dict)
    """of each instruction set: 16-bit dot products with their addition"""
    vector_per_cycle: float = 4.0
    """vector operations of any kind, loads aside"""
    loads_per_cycle: float = 2.0
    pair_cycles: Mapping[str, float] = field(default_factory=dict)
    """of each precision, instead of the rates: cycles for two hidden units and one block"""
    scalar: tuple[float, float] | None = None
    """plain C, float: cycles of a column without hidden units, and for each unit of both networks"""
    low: float = CALIBRATED_WITHIN
    """the true time is at least the estimate over this"""
    high: float = CALIBRATED_WITHIN
    """and at most the estimate times this"""


@dataclass(frozen=True)
class CpuTime:
    """Computing for one column, on one core. ``kernels``: preparing and both networks; ``push``: the streaming step."""

    kernels: Figure
    push: Figure

    def frame(self, columns: int) -> Figure:
        """Computing of a frame of ``columns`` pushed columns."""
        value, low, high = (x * columns for x in self.push.span("ms"))
        return Figure(value, low, high, "ms", self.push.kind, self.push.source)


COLUMN_BYTES = (32 + 64) * 3
"""In from and out to memory, for a column; everything else stays in a first-level cache."""


def cpu_time(
    core: CpuCore, isa: str, precision: str, pairs: tuple[int, int], clock_ghz: float, gb_per_s: float | None = None
) -> CpuTime:
    """``pairs``: of hidden units without and with a slope, both networks together (``unit_pairs``). ``gb_per_s``: of
    memory, which bounds the time from below. Raises ValueError for an instruction set the core has no figures of."""
    if not clock_ghz > 0:
        raise ValueError(f"clock {clock_ghz} GHz, expected above 0")
    cycles = cpu_cycles(core, isa, precision, pairs)
    least = 0.0 if gb_per_s is None else COLUMN_BYTES / gb_per_s
    return CpuTime(*(_time(core, isa, precision, x, clock_ghz, least) for x in (cycles, cycles + core.push_cycles)))


def _time(core: CpuCore, isa: str, precision: str, cycles: float, clock_ghz: float, least_ns: float) -> Figure:
    ns = max(cycles / clock_ghz, least_ns)
    source = f"operation counts of the {precision} kernel, {core.name} {isa} at {clock_ghz:.2f} GHz: {core.source}"
    return Figure(ns, ns / core.low, ns * core.high, "ns", core.kind, source)


def cpu_cycles(core: CpuCore, isa: str, precision: str, pairs: tuple[int, int]) -> float:
    """Of one column, kernels only."""
    if isa == "scalar":
        return _scalar_cycles(core, pairs)
    plain, leaky = pairs
    ops, blocks = kernel_ops(isa, precision), ISAS[isa].blocks
    pair = _pair_cycles(core, isa, precision)
    slope = leaky * sum(ops.leaky.values()) / core.mixed_per_cycle
    rest = sum(ops.rest.values()) / core.mixed_per_cycle + core.exposed_cycles
    return blocks * ((plain + leaky) * pair / core.loop_efficiency + slope + rest)


def _pair_cycles(core: CpuCore, isa: str, precision: str) -> float:
    if core.pair_cycles:
        if precision not in core.pair_cycles:
            raise ValueError(f"{core.name}: no cycles of a pair in {precision}")
        return core.pair_cycles[precision]
    rates = core.multiply_per_cycle if precision == "fp32" else core.dot_per_cycle
    if isa not in rates:
        raise ValueError(f"{core.name}: no rates of {isa}, known: {', '.join(rates)}")
    counts = kernel_ops(isa, precision).pair
    apart = precision != "fp32" and not ISAS[isa].fused_dot
    vector = sum(counts.values()) - counts["load"] + (counts["multiply_add"] if apart else 0)
    return max(
        counts["multiply_add"] / rates[isa],
        vector / core.vector_per_cycle,
        counts["load"] / core.loads_per_cycle,
    )


def _scalar_cycles(core: CpuCore, pairs: tuple[int, int]) -> float:
    """Plain C in float. Integers of plain C are the compiler's own vectorisation: no counts of ours."""
    if core.scalar is None:
        raise ValueError(f"{core.name}: plain C was not calibrated")
    base, unit = core.scalar
    return base + unit * sum(pairs)
