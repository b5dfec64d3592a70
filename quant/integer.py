"""The integer networks in NumPy: the oracle of every other implementation. Clear, not fast.

``docs/numeric-contract.md`` is the contract; names and step numbers here are the ones there. All arithmetic is done in
64 bits, so that nothing can wrap; ``prove`` shows that 32 bits are enough, and ``network`` checks that they were.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from upbeam.model.network import WINDOW
from upbeam.model.rules import U8, U16, Rules, extract_windows, image_pair, interleave_rows, kept_counts

__all__ = [
    "CONTRACTS",
    "NETWORK_NAMES",
    "IntegerModel",
    "IntegerNetwork",
    "NetworkName",
    "OverflowProofError",
    "Precision",
    "Trace",
    "block_code",
    "largest_inputs",
    "network",
    "prove",
    "round_shift",
    "upsample_integer",
]

Precision = Literal["int16", "int8"]
NetworkName = Literal["distance", "intensity"]
NETWORK_NAMES: tuple[NetworkName, ...] = ("distance", "intensity")
CONTRACTS: dict[Precision, str] = {"int16": "upbeam.int16.v1", "int8": "upbeam.int8.v1"}

I64 = NDArray[np.int64]

CODE_BITS = 8
"""Of a coded difference in int8."""
HIDDEN_SHIFT = 16
SLOPE_SHIFT = 15
LARGEST_INTENSITY = 255
MAX_SHIFT_IN, MAX_SHIFT_OUT, MAX_SHIFT_SUM = 16, 24, 24


class OverflowProofError(ValueError):
    """A network whose sums could overflow, or whose parameters have no place in the contract: names the network, the
    unit and the bound."""


@dataclass(frozen=True)
class IntegerNetwork:
    """Parameters of one network, as int64 arrays of values that fit the contract's types."""

    weight: I64
    """W [H, 6]"""
    minimum: I64
    """M [H]"""
    bias: I64
    """B [H]"""
    output: I64
    """V [H]"""
    offset: int
    """C"""
    slope: int
    """in 1/32768"""
    skip: int
    k: int
    j: int
    t: int

    def __post_init__(self) -> None:
        for name in ("weight", "minimum", "bias", "output"):
            object.__setattr__(self, name, np.asarray(getattr(self, name), dtype=np.int64))
        if self.weight.ndim != 2 or self.weight.shape[1] != WINDOW or len(self.weight) != len(self.bias):
            raise ValueError(f"weight has shape {list(self.weight.shape)}, expected [{len(self.bias)}, {WINDOW}]")
        if self.minimum.shape != self.bias.shape or self.output.shape != self.bias.shape:
            raise ValueError("minimum, bias and output must have one value for each hidden unit")

    @property
    def hidden(self) -> int:
        return len(self.bias)

    @property
    def multiply_adds(self) -> int:
        """Per window: differences, minimum and output of each unit."""
        return self.hidden * (WINDOW + 2)

    def output_counts(self, trace_output: ArrayLike) -> NDArray[np.float64]:
        """``Y`` before its rounding, in counts: for error statistics only."""
        return np.asarray(trace_output, dtype=np.float64) / 2.0**self.t


@dataclass(frozen=True)
class IntegerModel:
    """Both networks of a precision."""

    precision: Precision
    distance: IntegerNetwork
    intensity: IntegerNetwork

    @property
    def contract(self) -> str:
        return CONTRACTS[self.precision]

    def __iter__(self) -> Iterator[IntegerNetwork]:
        return iter((self.distance, self.intensity))


@dataclass(frozen=True)
class Trace:
    """Every step of a network, for windows ``[...]``."""

    m: I64
    d: I64
    """[..., 6]"""
    s: I64
    q: I64
    """[..., 6]"""
    S: I64
    """[..., H]"""
    a: I64
    z: I64
    Y: I64
    r: I64
    y: I64


# -------------------------------------------------------------------------------------------------- arithmetic


def round_shift(value: Any, bits: Any) -> Any:
    """Half up: ``floor(value / 2^bits + 1/2)``."""
    half = np.where(np.asarray(bits) > 0, np.left_shift(1, np.maximum(np.asarray(bits) - 1, 0)), 0)
    return (value + half) >> bits


def bit_length(values: ArrayLike) -> I64:
    """bits(0) = 0, bits(1) = 1, bits(255) = 8, bits(256) = 9, up to 2^16."""
    return np.searchsorted(np.left_shift(1, np.arange(17)), np.asarray(values), side="right").astype(np.int64)


def block_code(differences: I64) -> tuple[I64, I64]:
    """Step 3 of int8: differences ``[..., 6]`` -> shift ``[...]`` and codes ``[..., 6]``."""
    s = np.maximum(0, bit_length(differences.max(axis=-1)) - CODE_BITS)
    q = np.minimum(2**CODE_BITS - 1, round_shift(differences, s[..., None]))
    return s, q


def network(parameters: IntegerNetwork, precision: Precision, windows: ArrayLike) -> Trace:
    """Steps 1 to 9 for windows ``[..., 6]`` of counts or intensities."""
    n = parameters
    x = np.asarray(windows, dtype=np.int64)
    m = x.min(axis=-1)
    d = x - m[..., None]
    s, q = block_code(d) if precision == "int8" else (np.zeros_like(m), d)
    S = ((q @ n.weight.T) << (s[..., None] + n.k)) + ((m[..., None] * n.minimum) << n.j) + n.bias
    a = round_shift(S, HIDDEN_SHIFT)
    z = np.maximum(a, round_shift(a * n.slope, SLOPE_SHIFT))
    Y = z @ n.output + n.offset
    r = round_shift(Y, n.t)
    _check(S, a, Y)
    return Trace(m, d, s, q, S, a, z, Y, r, r + n.skip * m)


def _check(S: I64, a: I64, Y: I64) -> None:
    for name, values, bits in (("S", S, 32), ("a", a, 16), ("Y", Y, 31)):
        limit = 1 << (bits - 1)
        if values.size and (values.min() < -limit or values.max() >= limit):
            raise OverflowProofError(f"{name} is {values.min()} to {values.max()}, beyond {bits} bits")


def upsample_integer(
    distance: ArrayLike, intensity: ArrayLike, model: IntegerModel, rules: Rules, *, wrap: bool = False
) -> tuple[U16, U8]:
    """Counts and intensities ``[32, W]`` -> ``[64, W]``, as ``upsample_reference`` does in float."""
    d, i = image_pair(distance, intensity)
    windows = extract_windows(d, i, rules, wrap=wrap)
    far = network(model.distance, model.precision, windows.distance)
    grey = network(model.intensity, model.precision, windows.intensity)
    generated = kept_counts(far.y, windows, rules)
    shade = np.where(generated > 0, np.clip(grey.y, 0, LARGEST_INTENSITY), 0).astype(np.uint8)
    return interleave_rows(d, generated, rules), interleave_rows(i, shade, rules)


# -------------------------------------------------------------------------------------------------- the proof


def largest_inputs(rules: Rules, which: NetworkName) -> tuple[int, int]:
    """X and D: the largest input of a network and the largest difference within a window."""
    if which == "intensity":
        return LARGEST_INTENSITY, LARGEST_INTENSITY
    return rules.max_count, rules.max_count - (rules.min_count if rules.empty == "fill" else 0)


def largest_code(precision: Precision, largest_difference: int) -> tuple[int, int]:
    """Q, the largest ``q << s``, and the largest ``s``."""
    if precision == "int16":
        return largest_difference, 0
    s = max(0, largest_difference.bit_length() - CODE_BITS)
    return (min(255 << s, largest_difference + (1 << (s - 1))), s) if s else (largest_difference, 0)


@dataclass(frozen=True)
class Bounds:
    """What the sums of a network can reach, [H] of each unit."""

    S_low: I64
    S_high: I64
    Y_low: int
    Y_high: int


def sum_bounds(n: IntegerNetwork, precision: Precision, largest_input: int, largest_difference: int) -> Bounds:
    """Interval arithmetic over all inputs; exact, in Python's own integers where it could be large."""
    code, _ = largest_code(precision, largest_difference)

    def reach(sign: int) -> I64:
        weights = np.maximum(sign * n.weight, 0).sum(axis=1) * (code << n.k)
        return np.asarray(sign * (weights + np.maximum(sign * n.minimum, 0) * (largest_input << n.j)))

    low, high = reach(-1) + n.bias, reach(1) + n.bias
    z = [_rectified(round_shift(S, HIDDEN_SHIFT), n.slope) * n.output for S in (low, high)]
    Y_low, Y_high = (int(f(z[0], z[1]).sum()) + n.offset for f in (np.minimum, np.maximum))
    return Bounds(low, high, Y_low, Y_high)


def _rectified(a: I64, slope: int) -> I64:
    return np.asarray(np.maximum(a, round_shift(a * slope, SLOPE_SHIFT)))


def prove(n: IntegerNetwork, precision: Precision, largest_input: int, largest_difference: int, where: str) -> Bounds:
    """Shows that nothing overflows for any input, or raises OverflowProofError.

    ``where`` names the network in the message."""
    _check_parameters(n, precision, largest_input, largest_difference, where)
    bounds = sum_bounds(n, precision, largest_input, largest_difference)
    half = 1 << (HIDDEN_SHIFT - 1)
    for h in range(n.hidden):
        low, high = int(bounds.S_low[h]), int(bounds.S_high[h])
        if low < -(2**31) or high + half >= 2**31:
            raise OverflowProofError(
                f"{where}: the sum S of hidden unit {h} can reach {low} to {high}, beyond 32 bits (-2^31 to 2^31 - 1)"
            )
    rounding = 1 << (n.t - 1) if n.t else 0
    if bounds.Y_low < -(2**30) or bounds.Y_high + rounding >= 2**30:
        raise OverflowProofError(
            f"{where}: the output Y can reach {bounds.Y_low} to {bounds.Y_high}, beyond 31 bits (-2^30 to 2^30 - 1)"
        )
    return bounds


def _check_parameters(n: IntegerNetwork, precision: Precision, largest: int, difference: int, where: str) -> None:
    narrow = 8 if precision == "int8" else 16
    for name, values, bits in (("W", n.weight, narrow), ("V", n.output, narrow), ("M", n.minimum, 16)):
        limit = 2 ** (bits - 1)
        if np.any(values < -limit) or np.any(values >= limit):
            raise OverflowProofError(f"{where}: {name} is {values.min()} to {values.max()}, beyond {bits} bits")
    for name, values in (("B", n.bias), ("C", np.array([n.offset]))):
        if np.any(values < -(2**31)) or np.any(values >= 2**31):
            raise OverflowProofError(f"{where}: {name} does not fit 32 bits")
    for name, value, top in (
        ("hidden units", n.hidden, 32),
        ("slope", n.slope, 32767),
        ("skip", n.skip, 1),
        ("k", n.k, MAX_SHIFT_IN),
        ("j", n.j, MAX_SHIFT_IN),
        ("t", n.t, MAX_SHIFT_OUT),
        ("s + k", largest_code(precision, difference)[1] + n.k, MAX_SHIFT_SUM),
    ):
        if not 0 <= value <= top:
            raise OverflowProofError(f"{where}: {name} is {value}, expected 0 to {top}")
    inner = n.k if precision == "int16" else max(0, n.k - CODE_BITS)
    for name, value, shift in (("j", n.j, n.j), ("k", n.k, inner)):
        if largest << shift > 65535:
            raise OverflowProofError(f"{where}: {name} is {value}: an input of {largest} then needs more than 16 bits")
