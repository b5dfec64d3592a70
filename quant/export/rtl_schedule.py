"""When the RTL core multiplies what: the schedule of ``FOLD`` clocks a window, checked, and the weights in its order.

A window takes eight products for each hidden unit: six of W, one of M, one of V. Up to ``FOLD = hidden`` whole units
run side by side (``units`` a clock); beyond, a unit takes 2, 4 or 8 clocks (``phases``) and its products share
multipliers.
``kernels/rtl/upb_network_*.sv`` execute exactly this; docs/fpga.md has the timing.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from upbeam.quant.integer import HIDDEN_SHIFT, IntegerModel, IntegerNetwork, Precision

__all__ = [
    "PRODUCTS",
    "Configuration",
    "ConfigurationError",
    "Placed",
    "Words",
    "check",
    "configuration",
    "folds",
    "schedule",
    "weight_bits",
    "words",
]

I64 = NDArray[np.int64]

PRODUCTS = 8
"""Of a hidden unit: W[0..5], M, V."""
OF_M, OF_V = 6, 7
PHASES = (2, 4, 8)
MAX_HIDDEN = 32
UNSIGNED_BITS = 16
"""Inputs of this width reach a signed multiplier as ``x - 2^15``."""
SERIAL_WORD_BITS = 16


class ConfigurationError(ValueError):
    """LANES and FOLD that the core does not have, or a schedule that loses a result."""


@dataclass(frozen=True)
class Configuration:
    """What is chosen of a core besides its model. Raises ConfigurationError for what cannot be built."""

    hidden: int
    """units of the wider network; the other is padded with units that give 0"""
    fold: int
    """clocks a window and lane"""
    lanes: int = 1
    leaky: bool = False
    """a rectifier with a slope takes a clock more"""

    def __post_init__(self) -> None:
        if not 1 <= self.hidden <= MAX_HIDDEN:
            raise ConfigurationError(f"{self.hidden} hidden units, expected 1 to {MAX_HIDDEN}")
        if self.fold not in folds(self.hidden):
            multiples = ", ".join(str(p * self.hidden) for p in PHASES)
            raise ConfigurationError(
                f"FOLD {self.fold}: with {self.hidden} hidden units it must be 1 to {self.hidden}, or {multiples}"
            )
        if self.lanes < 1 or self.fold % self.lanes:
            raise ConfigurationError(f"LANES {self.lanes} does not divide FOLD {self.fold}")

    @property
    def interval(self) -> int:
        """Clocks from one window to the next."""
        return self.fold // self.lanes

    @property
    def phases(self) -> int:
        """Clocks a hidden unit; 1: whole units."""
        return 1 if self.fold <= self.hidden else self.fold // self.hidden

    @property
    def units(self) -> int:
        """Hidden units a clock."""
        return -(-self.hidden // self.fold) if self.phases == 1 else 1

    @property
    def padded(self) -> int:
        """Hidden units with those that fill the last clock."""
        return self.units * self.fold if self.phases == 1 else self.hidden

    @property
    def multipliers(self) -> int:
        """Of one network and lane."""
        return PRODUCTS * self.units if self.phases == 1 else PRODUCTS // self.phases

    @property
    def rectify(self) -> int:
        """Clocks of the rectifier."""
        return 2 if self.leaky else 1

    @property
    def behind(self) -> int:
        """Units between a unit's own products and its product with V, where they share multipliers."""
        return -(-(self.rectify + 5) // self.phases)


def folds(hidden: int) -> list[int]:
    """Every FOLD there is for so many hidden units."""
    return [*range(1, hidden + 1), *(p * hidden for p in PHASES)]


def configuration(model: IntegerModel, *, fold: int | None = None, lanes: int = 1) -> Configuration:
    """``fold`` omitted: one hidden unit a clock. Raises ConfigurationError."""
    hidden = max(n.hidden for n in model)
    leaky = any(n.slope > 0 for n in model)
    return Configuration(hidden, hidden if fold is None else fold, lanes, leaky)


def weight_bits(precision: Precision) -> int:
    return 8 if precision == "int8" else 16


# -------------------------------------------------------------------------------------------------- schedule


@dataclass(frozen=True)
class Placed:
    """One product of a window: its step (clocks after the window's first), its multiplier."""

    step: int
    multiplier: int
    unit: int
    product: int


def schedule(c: Configuration) -> list[Placed]:
    """Of one window. Steps from ``fold`` on run beside the next window's first."""
    return list(_parallel(c) if c.phases == 1 else _serial(c))


def _parallel(c: Configuration) -> Iterator[Placed]:
    for unit in range(c.padded):
        step, place = divmod(unit, c.units)
        for product in range(PRODUCTS):
            late = _z_ready(c) if product == OF_V else 0
            yield Placed(step + late, place * PRODUCTS + product, unit, product)


def _serial(c: Configuration) -> Iterator[Placed]:
    for unit in range(c.hidden):
        for product in range(PRODUCTS):
            phase, multiplier = divmod(product, c.multipliers)
            late = c.behind if product == OF_V else 0
            yield Placed((unit + late) * c.phases + phase, multiplier, unit, product)


def _z_ready(c: Configuration) -> int:
    """Clocks from a unit's last own product to the first at which its z can be multiplied: product, three sums and the
    rectifier where units are whole; product, part, sum, S and the rectifier where they are not."""
    return 4 + c.rectify if c.phases == 1 else 4 + c.rectify + 1


def check(c: Configuration, placed: list[Placed]) -> None:
    """Every product once, no multiplier twice at a clock with windows back to back, z read after it is there and before
    the next unit's, V products in the order of the units. Raises ConfigurationError."""
    wanted = {(unit, product) for unit in range(c.padded) for product in range(PRODUCTS)}
    made = [(p.unit, p.product) for p in placed]
    if len(made) != len(wanted) or set(made) != wanted:
        raise ConfigurationError(f"FOLD {c.fold}: {len(set(made))} of {len(wanted)} products, {len(made)} places")
    busy = {(p.step % c.fold, p.multiplier) for p in placed}
    if len(busy) != len(placed):
        raise ConfigurationError(f"FOLD {c.fold}: a multiplier is needed twice at one clock")
    if max(p.multiplier for p in placed) >= c.multipliers:
        raise ConfigurationError(f"FOLD {c.fold}: more than {c.multipliers} multipliers")
    _check_rectified(c, placed)


def _check_rectified(c: Configuration, placed: list[Placed]) -> None:
    last_own = {u: max(p.step for p in placed if p.unit == u and p.product != OF_V) for u in range(c.padded)}
    outputs = {p.unit: p.step for p in placed if p.product == OF_V}
    for unit, step in outputs.items():
        # In a parallel core z is a new unit's every clock; in a serial one every PHASES clocks, counted from the last.
        end_of_unit = last_own[unit] if c.phases == 1 else (unit + 1) * c.phases - 1
        ready = end_of_unit + _z_ready(c)
        if not ready <= step < ready + c.phases:
            raise ConfigurationError(f"FOLD {c.fold}: z of unit {unit} is there at steps {ready}.., read at {step}")
    order = [unit for unit, _ in sorted(outputs.items(), key=lambda item: (item[1], item[0]))]
    if order != sorted(order):
        raise ConfigurationError(f"FOLD {c.fold}: outputs are summed out of order")


# ----------------------------------------------------------------------------------------------------- words


@dataclass(frozen=True)
class Words:
    """Weights of one network as the core's memories hold them: step after step, ``values`` of ``bits`` each."""

    W: I64
    M: I64
    B: I64
    V: I64
    C: int
    bits: tuple[int, int, int, int]
    """of one value of W, M, B, V"""


def words(n: IntegerNetwork, precision: Precision, c: Configuration, input_bits: int) -> Words:
    """In the order of ``schedule(c)``. Serial: W holds everything that is multiplied, M and V are empty.

    B and C hold the halves of the rounding shifts after them; B also what inputs lose that are given to a signed
    multiplier as ``x - 2^15``. All modulo 2^32, as the contract allows partial sums."""
    placed = schedule(c)
    check(c, placed)
    n = _padded(n, c.padded)
    bias = n.bias + (1 << (HIDDEN_SHIFT - 1))
    if input_bits == UNSIGNED_BITS:
        half = 1 << (UNSIGNED_BITS - 1)
        bias = bias + (n.weight.sum(axis=1) * half << n.k) + (n.minimum * half << n.j)
    offset = n.offset + (1 << (n.t - 1) if n.t else 0)
    narrow = 8 if precision == "int8" else 16
    if c.phases == 1:
        return Words(n.weight.reshape(-1), n.minimum, bias, n.output, offset, (narrow, 16, 32, narrow))
    memory = np.zeros((c.fold, c.multipliers), dtype=np.int64)
    for p in placed:
        memory[p.step % c.fold, p.multiplier] = _factor(n, p)
    none = np.zeros(0, dtype=np.int64)
    return Words(memory.reshape(-1), none, bias, none, offset, (SERIAL_WORD_BITS, 16, 32, narrow))


def _factor(n: IntegerNetwork, p: Placed) -> int:
    if p.product == OF_V:
        return int(n.output[p.unit])
    return int(n.minimum[p.unit] if p.product == OF_M else n.weight[p.unit, p.product])


def _padded(n: IntegerNetwork, hidden: int) -> IntegerNetwork:
    """With units that give 0: their output weight is 0."""
    more = hidden - n.hidden
    return replace(
        n,
        weight=np.pad(n.weight, ((0, more), (0, 0))),
        minimum=np.pad(n.minimum, (0, more)),
        bias=np.pad(n.bias, (0, more)),
        output=np.pad(n.output, (0, more)),
    )
