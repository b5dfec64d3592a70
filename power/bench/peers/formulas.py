"""The networks and the rules as element-wise code, written once for every array library (NumPy, JAX, PyTorch)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from upbeam.model.network import FoldedNetwork, WindowNetwork
from upbeam.model.rules import PAIRS, Rules
from upbeam.quant.quantize import DifferenceNetwork, difference_network

from ..work import Work

__all__ = [
    "ImageRules", "PlainNetwork", "fused_image", "fused_windows", "paper_graph", "paper_weights", "product_windows",
    "row_limits",
]  # fmt: skip

Array = Any
"""Of the library ``xp``."""


@dataclass(frozen=True)
class PlainNetwork:
    """A folded network in Python's own numbers: compilers take these for constants."""

    weight: tuple[tuple[float, ...], ...]
    """[H][7], the minimum's last"""
    bias: tuple[float, ...]
    output: tuple[float, ...]
    offset: float
    slope: float
    skip: float
    positive: bool

    @classmethod
    def folded(cls, net: FoldedNetwork) -> PlainNetwork:
        """On pixels, in the units of the model file."""
        return cls(
            _numbers(net.weight), tuple(net.bias.tolist()), tuple(net.output_weight.tolist()), float(net.output_bias),
            float(net.slope), float(net.skip), net.positive,
        )  # fmt: skip

    @classmethod
    def differences(cls, net: FoldedNetwork, unit: float) -> PlainNetwork:
        """On differences from the minimum, in counts."""
        made: DifferenceNetwork = difference_network(net, unit)
        weight = [[*row, last] for row, last in zip(made.weight.tolist(), made.minimum.tolist(), strict=True)]
        return cls(
            tuple(map(tuple, weight)), tuple(made.bias.tolist()), tuple(made.output.tolist()), float(made.offset),
            float(made.slope), float(made.skip), False,
        )  # fmt: skip


def _numbers(matrix: Any) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(float(x) for x in row) for row in matrix)


@dataclass(frozen=True)
class ImageRules:
    """What ``fused_image`` needs of a model, in Python's own numbers."""

    networks: tuple[PlainNetwork, PlainNetwork]
    min_count: float

    @classmethod
    def of(cls, work: Work) -> ImageRules:
        """Raises ValueError for another rule than ``fill``."""
        rules = work.file.rules
        if rules.empty != "fill":
            raise ValueError("element-wise code knows the rule 'fill' for empty pixels only")
        distance, intensity = work.file.folded
        networks = PlainNetwork.differences(distance, rules.distance_unit_m), PlainNetwork.differences(intensity, 1.0)
        return cls(networks, float(rules.min_count))


def fused_windows(xp: Any, taps: Sequence[Array], net: PlainNetwork) -> Array:
    """Six pixels (each ``[N]``) -> ``[N]``, unit by unit: for compilers that fuse element-wise code."""
    minimum = _least(xp, taps)
    y = _units(xp, (*taps, minimum), net) + net.skip * minimum
    return _no_less(xp, y, 0.0) if net.positive else y


def product_windows(xp: Any, taps: Array, weight: Array, bias: Array, output: Array, net: FoldedNetwork) -> Array:
    """Windows and minima ``[7, N]`` -> ``[1, N]`` as two matrix products."""
    hidden = weight @ taps + bias
    y = output @ xp.maximum(hidden, float(net.slope) * hidden) + float(net.output_bias) + float(net.skip) * taps[6:7]
    return _no_less(xp, y, 0.0) if net.positive else y


def paper_graph(xp: Any, x: Array, weights: dict[str, Array], net: WindowNetwork) -> Array:
    """Windows ``[N, 6]`` -> ``[N]``, layer by layer as trained and published."""
    if net.scale != 1:
        x = x * float(net.scale)
    minimum = xp.min(x, 1)
    minimum = (minimum if not hasattr(minimum, "values") else minimum.values)[:, None]
    pixels = x - minimum if net.inputs == "difference" else x
    first = pixels[:, None, :] * weights["conv1"] + weights["conv1_bias"]
    second = xp.matmul(weights["conv2"], first) + weights["conv2_bias"]
    flat = second.reshape(second.shape[0], -1)
    hidden = xp.matmul(xp.concatenate([flat, minimum], 1), weights["linear_1"]) + weights["linear_1_bias"]
    hidden = xp.maximum(hidden, float(net.slope) * hidden)
    y = xp.matmul(hidden, weights["linear_2"]) + float(net.linear_2_bias)
    if net.output == "residual":
        y = y + minimum[:, 0]
    y = _no_less(xp, y, 0.0)
    return y / float(net.scale) if net.scale != 1 else y


def paper_weights(net: WindowNetwork) -> dict[str, Any]:
    """Arrays as ``paper_graph`` takes them, float64."""
    return {
        "conv1": net.conv1_weight[:, None],
        "conv1_bias": net.conv1_bias[:, None],
        "conv2": net.conv2_weight,
        "conv2_bias": net.conv2_bias[:, None],
        "linear_1": net.linear_1_weight.T,
        "linear_1_bias": net.linear_1_bias,
        "linear_2": net.linear_2_weight,
    }


def fused_image(xp: Any, rules: ImageRules, distance: Array, intensity: Array, row_max: Array) -> tuple[Array, Array]:
    """Images ``[32, W]`` of float counts and intensities -> generated ``[31, W]``, all rules of the model file.

    ``row_max``: ``[64, 1]``, farthest counts. Both ends are edges."""
    seen = (distance >= rules.min_count) & (distance <= row_max[0::2])
    zero = distance * 0
    d, i = xp.where(seen, distance, zero), xp.where(seen, intensity, zero)
    top, bottom = seen[:PAIRS], seen[1:]
    far = (xp.where(top, d[:PAIRS], d[1:]), xp.where(bottom, d[1:], d[:PAIRS]))
    grey = (xp.where(top, i[:PAIRS], i[1:]), xp.where(bottom, i[1:], i[:PAIRS]))
    present = [x > 0 for x in _columns(xp, far[0])]
    counts, least = _generated(xp, far, present, rules.networks[0])
    given = (counts >= rules.min_count) & (counts <= row_max[1:-1:2]) & (least > 0)
    shade, _ = _generated(xp, grey, present, rules.networks[1])
    shade = _no_more(xp, _no_less(xp, shade, 0.0), 255.0)
    nothing = counts * 0
    return xp.where(given, counts, nothing), xp.where(given, shade, nothing)


def row_limits(rules: Rules) -> Any:
    return rules.row_max_count.reshape(-1, 1)


def _generated(xp: Any, rows: Sequence[Array], present: Sequence[Array], net: PlainNetwork) -> tuple[Array, Array]:
    taps = [x for row in rows for x in _filled(xp, _columns(xp, row), present)]
    least = _least(xp, taps)
    inputs = [*(x - least for x in taps), least]
    return xp.floor(_units(xp, inputs, net) + 0.5) + net.skip * least, least


def _columns(xp: Any, row: Array) -> list[Array]:
    """Left, middle, right; beyond the ends everything is empty."""
    edge = row[:, :1] * 0
    padded = xp.concatenate([edge, row, edge], 1)
    return [padded[:, :-2], row, padded[:, 2:]]


def _filled(xp: Any, three: Sequence[Array], present: Sequence[Array]) -> list[Array]:
    left, middle, right = three
    has_left, has_middle, has_right = present
    between = xp.where(has_left, xp.where(has_right, xp.minimum(left, right), left), right)
    return [
        xp.where(has_left, left, xp.where(has_middle, middle, right)),
        xp.where(has_middle, middle, between),
        xp.where(has_right, right, xp.where(has_middle, middle, left)),
    ]


def _least(xp: Any, taps: Sequence[Array]) -> Array:
    a, b, c, d, e, f = taps
    return xp.minimum(xp.minimum(xp.minimum(a, b), xp.minimum(c, d)), xp.minimum(e, f))


def _units(xp: Any, x: Sequence[Array], net: PlainNetwork) -> Array:
    y: Array = net.offset
    for weight, bias, output in zip(net.weight, net.bias, net.output, strict=True):
        total: Array = bias
        for one, value in zip(weight, x, strict=True):
            total = total + one * value
        y = y + output * xp.maximum(total, net.slope * total)
    return y


def _no_less(xp: Any, x: Array, least: float) -> Array:
    return xp.where(x > least, x, x * 0 + least)


def _no_more(xp: Any, x: Array, most: float) -> Array:
    return xp.where(x < most, x, x * 0 + most)
