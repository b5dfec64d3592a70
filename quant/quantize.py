"""Float networks -> integer networks.

1. The network on window differences, in sensor counts (``DifferenceNetwork``).
2. Scales. A hidden unit may be scaled by any factor if its output weight is divided by it. The larger the factor, the
   finer the hidden value; the proof of the contract and the widths of the weights bound it. With 8-bit weights the
   factors are also chosen so that the divided output weight is whole.
3. Rounding. Nearest for 16 bits. For 8 bits each weight is moved by single steps while that brings the output closer
   to the float network's on calibration windows (coordinate descent): a few seconds, no gradients, no labels.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import islice
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from upbeam.model.frames import Frame
from upbeam.model.network import WINDOW, FoldedNetwork
from upbeam.model.rules import Rules, extract_windows

from .integer import (
    HIDDEN_SHIFT,
    MAX_SHIFT_IN,
    MAX_SHIFT_OUT,
    NETWORK_NAMES,
    IntegerModel,
    IntegerNetwork,
    OverflowProofError,
    Precision,
    block_code,
    largest_code,
    largest_inputs,
    prove,
    round_shift,
)
from .ubm import ModelFile

__all__ = [
    "Calibration",
    "DifferenceNetwork",
    "Rounding",
    "calibration_windows",
    "difference_network",
    "quantize",
    "quantize_network",
]

FloatArray = NDArray[np.float64]
I64 = NDArray[np.int64]
Rounding = Literal["nearest", "descent"]

CALIBRATION_WINDOWS = 40_000
_ROOM = 0.97
"""Share of the accumulator that scales may fill: descent moves weights afterwards."""
_LEAST_SHARE = 0.3
"""A unit's scale is at least this share of the largest possible one: below, weights lose more than the output weight
gains."""


@dataclass(frozen=True)
class Calibration:
    """Windows after the rules, ``[N, 6]`` counts and intensities, each with a return."""

    distance: I64
    intensity: I64


@dataclass(frozen=True)
class DifferenceNetwork:
    """A folded network on differences ``d`` and the minimum ``m``, in counts (or 8-bit intensities):
    ``y = skip m + offset + output . leaky(weight d + minimum m + bias)``."""

    weight: FloatArray
    """[H, 6]"""
    minimum: FloatArray
    bias: FloatArray
    output: FloatArray
    offset: float
    slope: float
    skip: int

    @property
    def hidden(self) -> int:
        return len(self.bias)

    def sums(self, windows: ArrayLike) -> FloatArray:
        """Windows ``[N, 6]`` -> ``[N, H]`` hidden sums."""
        x = np.asarray(windows, dtype=np.float64)
        m = x.min(axis=-1, keepdims=True)
        return np.asarray((x - m) @ self.weight.T + m * self.minimum + self.bias)

    def rest(self, windows: ArrayLike) -> FloatArray:
        """The output less ``skip m``, ``[N]``."""
        sums = self.sums(windows)
        return np.asarray(np.where(sums > 0, sums, self.slope * sums) @ self.output + self.offset)


def difference_network(network: FoldedNetwork, unit: float) -> DifferenceNetwork:
    """``unit``: size of a count in what the network sees (metres a count, or 1)."""
    return DifferenceNetwork(
        weight=network.weight[:, :WINDOW] * 1.0,
        minimum=network.weight.sum(axis=1),
        bias=network.bias / unit,
        output=network.output_weight * 1.0,
        offset=network.output_bias / unit,
        slope=network.slope,
        skip=int(network.skip),
    )


def calibration_windows(
    frames: Iterable[Frame], rules: Rules, count: int = CALIBRATION_WINDOWS, seed: int = 0
) -> Calibration:
    """``count`` windows drawn from all frames alike."""
    distance, intensity = [], []
    for frame in frames:
        windows = extract_windows(frame.distance[frame.given], frame.intensity[frame.given], rules)
        distance.append(windows.distance[windows.any_return].astype(np.int64))
        intensity.append(windows.intensity[windows.any_return].astype(np.int64))
    if not distance or not sum(map(len, distance)):
        raise ValueError("no calibration window: the frames hold no return within the model's range limits")
    d, i = np.concatenate(distance), np.concatenate(intensity)
    drawn = np.random.default_rng(seed).permutation(len(d))[:count]
    return Calibration(d[drawn], i[drawn])


def quantize(
    model: ModelFile,
    calibration: Calibration,
    precisions: Iterable[Precision] = ("int16", "int8"),
    rounding: Rounding = "descent",
) -> ModelFile:
    """The model with integer networks. Raises OverflowProofError where a network has no place in the contract."""
    made: dict[Precision, IntegerModel] = {}
    for precision in precisions:
        networks = []
        for name, folded in zip(NETWORK_NAMES, model.folded, strict=True):
            net = difference_network(folded, model.rules.distance_unit_m if name == "distance" else 1.0)
            windows, limits = getattr(calibration, name), largest_inputs(model.rules, name)
            where = f"{precision} {name} network"
            networks.append(quantize_network(net, precision, windows, limits, where, rounding=rounding))
        made[precision] = IntegerModel(precision, networks[0], networks[1])
    return replace(model, int16=made.get("int16", model.int16), int8=made.get("int8", model.int8))


def quantize_network(
    net: DifferenceNetwork,
    precision: Precision,
    windows: I64,
    limits: tuple[int, int],
    where: str,
    *,
    weight_bits: int | None = None,
    rounding: Rounding = "descent",
) -> IntegerNetwork:
    """One network. ``limits``: largest input and largest difference. ``weight_bits`` of 8 with ``int16`` is W8A16:
    weights of 8 bits (times a power of two), differences of 16."""
    if weight_bits is None:
        weight_bits = 8 if precision == "int8" else 16
    plan = _Plan(net, precision, windows, limits, weight_bits)
    found = _best_scales(plan)
    if not found:
        raise OverflowProofError(f"{where}: no scale makes it fit the contract: weights or biases are too large")
    if rounding == "descent" and weight_bits == 8:
        found = sorted((_descend(plan, one) for one in found), key=lambda one: one.cost)
    made = _recentred(plan, found[0])
    prove(made, precision, *limits, where)
    return made


# ------------------------------------------------------------------------------------------------------ scales


class _Plan:
    """What stays the same while parameters are searched."""

    def __init__(
        self, net: DifferenceNetwork, precision: Precision, windows: I64, limits: tuple[int, int], weight_bits: int
    ) -> None:
        self.net, self.precision, self.limits = net, precision, limits
        self.largest_weight = 2 ** (weight_bits - 1) - 1
        self.narrow = weight_bits == 8
        self.slope = min(32767, round(net.slope * 32768))
        self.m = windows.min(axis=1)
        d = windows - self.m[:, None]
        s, q = block_code(d) if precision == "int8" else (np.zeros_like(self.m), d)
        self.coded = q << s[:, None]
        self.target = net.rest(windows)
        self.code = largest_code(precision, limits[1])[0]
        self.moment = self._moments(d, windows)

    def _moments(self, d: I64, windows: I64) -> FloatArray:
        """[H, 6, 6]: mean of d d^T over the windows where a unit passes its sum on."""
        gate = np.where(self.net.sums(windows) > 0, 1.0, self.net.slope)
        x = d.astype(np.float64)
        return np.stack([(x * g[:, None] ** 2).T @ x / len(x) for g in gate.T])

    def j(self) -> int:
        """The largest shift that an input stands in 16 bits."""
        return int(min(MAX_SHIFT_IN, 16 - self.limits[0].bit_length()))

    def largest_scales(self, grid: int, j: int) -> FloatArray:
        """[H]: sums in integers are at most so many times the real ones. ``grid``: weights are multiples of its power
        of two."""
        net = self.net

        def reach(sign: int) -> FloatArray:
            differences = np.maximum(sign * net.weight, 0).sum(axis=1) * self.code
            minimum = np.maximum(sign * net.minimum, 0) * self.limits[0]
            return np.asarray(differences + minimum + np.maximum(sign * net.bias, 0))

        sums = _ROOM * (2.0**31 - 2.0**16) / np.maximum(np.maximum(reach(1), reach(-1)), 1e-30)
        weights = self.largest_weight * 2.0**grid / np.maximum(np.abs(net.weight).max(axis=1), 1e-30)
        minimum = 32766 * 2.0**j / np.maximum(np.abs(net.minimum), 1e-30)
        bias = (2.0**31 - 1) / np.maximum(np.abs(net.bias), 1e-30)
        return np.asarray(np.minimum.reduce([sums, weights, minimum, bias]))


@dataclass
class _Found:
    cost: float
    """Expected squared error of the output, or after descent ``_cost``."""
    weight: I64
    minimum: I64
    bias: I64
    output: I64
    offset: float
    grid: int
    j: int
    t: int


def _best_scales(plan: _Plan) -> list[_Found]:
    """Tries all shifts; those with the least expected squared errors of the output, the best first."""
    found: list[_Found] = []
    j = plan.j()
    for grid in range(MAX_SHIFT_IN + 1) if plan.narrow else [plan.j()]:
        largest = plan.largest_scales(grid, j)
        for t in range(MAX_SHIFT_OUT + 1):
            scales = _narrow_scales(plan, grid, largest, t) if plan.narrow else _wide_scales(plan, largest, t)
            if scales is not None:
                found.append(_rounded(plan, *scales, grid, j, t))
    fitting = (one for one in sorted(found, key=lambda one: one.cost) if _fits(plan, one))
    return list(islice(fitting, _CANDIDATES))


def _wide_scales(plan: _Plan, largest: FloatArray, t: int) -> tuple[float, FloatArray, I64] | None:
    exact = plan.net.output * 2.0 ** (HIDDEN_SHIFT + t) / largest
    if np.abs(exact).max() > plan.largest_weight:
        return None
    output = np.round(exact)
    level = (2.0**HIDDEN_SHIFT / largest) ** 2 / 12 * plan.net.output**2
    lost = ((output - exact) / 2.0**t * 32767) ** 2 / 12
    return float((level + lost).sum()), largest, output.astype(np.int64)


def _narrow_scales(plan: _Plan, grid: int, largest: FloatArray, t: int) -> tuple[float, FloatArray, I64] | None:
    """Whole output weights first; the scales follow from them."""
    net = plan.net
    cost, scale, output = 0.0, np.ones(net.hidden), np.zeros(net.hidden, dtype=np.int64)
    for h in range(net.hidden):
        factor = abs(net.output[h]) * 2.0 ** (HIDDEN_SHIFT + t)
        least = int(np.ceil(factor / largest[h]))
        if least > plan.largest_weight:
            return None
        V = np.arange(max(1, least), min(plan.largest_weight, max(1, int(least / _LEAST_SHARE))) + 1)
        scales = factor / V
        ideal = net.weight[h] * scales[:, None] / 2.0**grid
        error = (np.round(ideal) - ideal) * 2.0**grid / np.maximum(scales[:, None], 1e-30)
        missed = (
            np.einsum("ni,ij,nj->n", error, plan.moment[h], error)
            + (2.0**HIDDEN_SHIFT / np.maximum(scales, 1e-30)) ** 2 / 12
        )
        costs = net.output[h] ** 2 * missed
        at = int(np.argmin(costs))
        cost += float(costs[at])
        scale[h], output[h] = scales[at], int(np.sign(net.output[h])) * V[at]
    return cost, scale, output


def _rounded(plan: _Plan, cost: float, scale: FloatArray, output: I64, grid: int, j: int, t: int) -> _Found:
    net = plan.net

    def whole(x: FloatArray) -> I64:
        return np.round(x).astype(np.int64)

    return _Found(
        cost=cost,
        weight=whole(net.weight * scale[:, None] / 2.0**grid),
        minimum=whole(net.minimum * scale / 2.0**j),
        bias=whole(net.bias * scale),
        output=output,
        offset=net.offset * 2.0**t,
        grid=grid,
        j=j,
        t=t,
    )


def _network(plan: _Plan, f: _Found) -> IntegerNetwork:
    """In int8 and in wide weights the grid is the contract's k; W8A16 stores the multiples themselves."""
    stored = plan.narrow and plan.precision == "int16"
    return IntegerNetwork(
        weight=f.weight << f.grid if stored else f.weight,
        minimum=f.minimum,
        bias=f.bias,
        output=f.output,
        offset=round(f.offset),
        slope=plan.slope,
        skip=plan.net.skip,
        k=0 if stored else f.grid,
        j=f.j,
        t=f.t,
    )


def _fits(plan: _Plan, found: _Found) -> bool:
    try:
        prove(_network(plan, found), plan.precision, *plan.limits, "")
    except OverflowProofError:
        return False
    return True


# ---------------------------------------------------------------------------------------------------- rounding


def _hidden(plan: _Plan, f: _Found, h: int) -> I64:
    """[N] rectified values of a unit: steps 4 to 6 of the contract."""
    sums = ((plan.coded @ f.weight[h]) << f.grid) + ((plan.m * f.minimum[h]) << f.j) + f.bias[h]
    a = round_shift(sums, HIDDEN_SHIFT)
    return np.asarray(np.maximum(a, round_shift(a * plan.slope, 15)))


def _recentred(plan: _Plan, f: _Found) -> IntegerNetwork:
    """With the output bias that leaves no median error on the calibration windows."""
    made = sum(f.output[h] * _hidden(plan, f, h) for h in range(plan.net.hidden))
    f.offset = float(np.median(plan.target * 2.0**f.t - made))
    return _network(plan, f)


def _cost(error: FloatArray) -> float:
    """Mean error, and a little of the root mean square for the tail."""
    return float(np.abs(error).mean() + 0.05 * np.sqrt((error**2).mean()))


_CANDIDATES = 4
"""Pairs of shifts that descent starts from."""
_PASSES = 6
_SMALL_STEPS = {"bias": (1 << 12, 1 << 15, 1 << 17), "minimum": (1, 8, 64)}


def _steps(f: _Found, h: int) -> Iterable[tuple[NDArray[np.int64], int | tuple[int, int], int]]:
    """The single steps that a unit's parameters may take: array, place, step."""
    for sign in (1, -1):
        for i in range(WINDOW):
            yield f.weight, (h, i), sign
        for size in _SMALL_STEPS["bias"]:
            yield f.bias, h, sign * size
        for size in _SMALL_STEPS["minimum"]:
            yield f.minimum, h, sign * size


def _descend(plan: _Plan, f: _Found) -> _Found:
    """Coordinate descent over single steps, until a pass changes nothing."""
    units = range(plan.net.hidden)
    z = [_hidden(plan, f, h) for h in units]
    made = sum(f.output[h] * z[h] for h in units)
    target = plan.target * 2.0**f.t

    def error(total: I64) -> FloatArray:
        rest = total - target
        return (rest - np.median(rest)) / 2.0**f.t

    best = _cost(error(made))
    for _ in range(_PASSES):
        before = best
        for h in units:
            for array, place, step in _steps(f, h):
                array[place] += step
                moved = _hidden(plan, f, h)
                total = made + f.output[h] * (moved - z[h])
                cost = _cost(error(total))
                if cost < best and np.abs(f.weight).max() <= plan.largest_weight and _fits(plan, f):
                    best, made, z[h] = cost, total, moved
                else:
                    array[place] -= step
        if best > before * 0.999:
            break
    f.cost = best
    return f
