"""Operations of our vector kernels, kind by kind: what the CPU model counts.

The counts are those of ``power/bench/c/bench_loops_template.h``, which runs them on x86; a test holds both against each
other. They are written out here as well because a model of NEON, or of a machine without AVX-512, needs them where that
code cannot be compiled. A *block* is one vector of 16-bit windows; a column has 32 windows, 31 of which count.
"""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["ISAS", "Isa", "KernelOps", "kernel_ops"]

WINDOWS = 32


@dataclass(frozen=True)
class Isa:
    """What of an instruction set changes the counts."""

    name: str
    windows: int
    """16-bit lanes of a vector: windows of a block"""
    masks: bool
    """compares write masks, and a compare under a mask is one instruction"""
    fused_dot: bool
    """a dot product with its addition is one instruction"""
    weight_reads: int
    """how often an integer kernel reads a weight for the two halves of a block"""
    float_limit_shuffles: int

    @property
    def blocks(self) -> int:
        return WINDOWS // self.windows


ISAS = {
    isa.name: isa
    for isa in (
        Isa("neon", 8, False, False, 2, 2),
        Isa("neon-dot", 8, False, True, 2, 2),
        Isa("avx2", 16, False, False, 2, 2),
        Isa("avx512", 32, True, False, 1, 3),
        Isa("avx512-vnni", 32, True, True, 1, 3),
    )
}


@dataclass(frozen=True)
class KernelOps:
    """Operations of one block: ``pair`` for two hidden units of one network, ``leaky`` besides if the rectifier has a
    slope, ``rest`` for everything else of both networks."""

    pair: dict[str, int]
    leaky: dict[str, int]
    rest: dict[str, int]


def kernel_ops(isa: str, precision: str) -> KernelOps:
    """Raises ValueError for an instruction set or precision that no counts are kept of."""
    if isa not in ISAS:
        raise ValueError(f"no operation counts for {isa!r}, known: {', '.join(ISAS)}")
    found = ISAS[isa]
    if precision == "fp32":
        return _float_ops(found)
    if precision in ("int16", "int8"):
        return _integer_ops(found, precision)
    raise ValueError(f"precision {precision!r}, expected fp32, int16 or int8")


def _float_ops(isa: Isa) -> KernelOps:
    pair = {"multiply_add": 2 * 2 * (7 + 1), "minmax": 2 * 2, "load": 2 * 9}
    extra = {
        "add": 2 * 2 * 7 + 2 * 2,  # words to floats, a half
        "minmax": 2 * 2,
        "convert": 2 * 2 + 2 * 2,  # rounded down; limits of the generated row
        "shuffle": 2 * 2 * 7 + 2 * isa.float_limit_shuffles,
        "load": 2 * 2,
    }
    return KernelOps(pair, {"multiply": 2 * 2}, _sum(_rules(isa), extra))


def _integer_ops(isa: Isa, precision: str) -> KernelOps:
    pair = {
        "multiply_add": 2 * (2 * 4 + 1),
        "minmax": 2,
        "blend": 2,
        "shift": 2,
        "load": isa.weight_reads * (2 * (4 + 1) + 1),
    }
    extra = {"add": 2, "logic": 2, "shift": 1 + 1 + 1 + 2 * 2, "shuffle": 2 * 2 * 4, "load": 2}
    if precision == "int8":
        code = {"add": -1 + 1 + 6, "minmax": 6, "logic": 2 + 3 + 6, "shift": 2, "shuffle": 2}
        extra = _sum(extra, code)
    return KernelOps(pair, {"multiply": 2}, _sum(_rules(isa), extra))


def _rules(isa: Isa) -> dict[str, int]:
    """A column prepared, windows of both networks gathered, outputs given: the same for every precision."""
    return {
        "add": 2 * 6 + 2 * 2 + 2,
        "minmax": 2 * 5 + 1 + 4,
        "compare": 2 + 2 + 2 + 3 + 1,
        "blend": 4 + 4 * 4 + 2 + 2,
        "logic": 0 if isa.masks else (1 + 2) + (3 + 1) + 2,
        "shuffle": 1 + 2 + 2 * 2 + 3 + 1,
        "load": 1 + 12 + 1 + 2,
        "store": 4 + 1 + 1,
    }


def _sum(one: dict[str, int], other: dict[str, int]) -> dict[str, int]:
    return {kind: one.get(kind, 0) + other.get(kind, 0) for kind in dict.fromkeys((*one, *other))}
