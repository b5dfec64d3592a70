"""The 8-bit codes that were weighed against each other before the contract chose one: measured, not asserted.

Each code turns a window into what its bits can still tell. Decoded windows run through the same network with weights
of 8 bits, so that only the code differs. Nothing here runs on a device.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from .accuracy import Variant, float_variant
from .integer import IntegerNetwork, Precision, bit_length, largest_inputs, network, round_shift
from .quantize import Calibration, DifferenceNetwork, Rounding, difference_network, quantize_network
from .ubm import ModelFile

__all__ = [
    "CodeTable",
    "Scheme",
    "block_scheme",
    "codes",
    "companded_scheme",
    "exact_scheme",
    "linear_scheme",
    "metres_scheme",
    "minifloat_scheme",
    "narrow_variant",
    "network_problems",
    "scheme_variants",
    "two_range_scheme",
    "widest_unit",
]

I64 = NDArray[np.int64]
FloatArray = NDArray[np.float64]
Decode = Callable[[I64], I64]
"""Windows ``[..., 6]`` of counts -> what their codes say, in counts."""

LEVELS = 256
_MU = 255.0
_MANTISSA_BITS = 4
_STEPS = 400
"""Steps that the search for the least squared error tries."""


@dataclass(frozen=True)
class Scheme:
    name: str
    bits: int
    """of one difference, or of one pixel"""
    decode: Decode


# -------------------------------------------------------------------------------------------------------- codes


def exact_scheme() -> Scheme:
    """16 bits: what codes are compared with."""
    return Scheme("16-bit differences", 16, lambda windows: windows)


def linear_scheme(name: str, step: float) -> Scheme:
    """Differences in steps of ``step`` counts; those beyond 255 steps are cut."""
    return Scheme(
        f"linear, {name}", 8, _of_differences(lambda d: np.minimum(LEVELS - 1, d / step + 0.5).astype(int) * step)
    )


def companded_scheme(largest: int, mu: float = _MU) -> Scheme:
    """Each difference by a mu-law: fine where it is small, coarse where it is large."""

    def decode(d: I64) -> FloatArray:
        code = np.floor(np.log1p(mu * np.minimum(d, largest) / largest) / np.log1p(mu) * (LEVELS - 1) + 0.5)
        return np.asarray(np.expm1(code / (LEVELS - 1) * np.log1p(mu)) * (largest / mu))

    return Scheme("companded, mu-law", 8, _of_differences(decode))


def minifloat_scheme() -> Scheme:
    """Each difference by itself as 4 bits of exponent and 4 of mantissa: piecewise linear, exact below 32 counts."""

    def decode(d: I64) -> I64:
        s = np.maximum(0, bit_length(d) - _MANTISSA_BITS - 1)
        return np.asarray(round_shift(d, s) << s)

    return Scheme("companded, 4 + 4 bits", 8, _of_differences(decode))


def two_range_scheme(fine: int, coarse: int) -> Scheme:
    """A window has steps of ``2^fine`` counts if its differences fit, else of ``2^coarse``, cut at 255 of them."""

    def decode(d: I64) -> I64:
        fits = round_shift(d.max(axis=-1, keepdims=True), fine) < LEVELS
        s = np.where(fits, fine, coarse)
        return np.asarray(np.minimum(LEVELS - 1, round_shift(d, s)) << s)

    return Scheme(f"two ranges, 2^{fine} and 2^{coarse}", 8, _of_differences(decode))


def block_scheme(bits: int) -> Scheme:
    """The contract's block code with ``bits`` of 8: a window shares the least power of two that lets its differences
    fit."""

    def decode(d: I64) -> I64:
        s = np.maximum(0, bit_length(d.max(axis=-1, keepdims=True)) - bits)
        return np.asarray(np.minimum(2**bits - 1, round_shift(d, s)) << s)

    return Scheme(f"block, {bits} bits", bits, _of_differences(decode))


def metres_scheme(largest: int) -> Scheme:
    """Naive int8: each pixel's range itself in 256 steps of the whole range."""
    step = largest / (LEVELS - 1)
    return Scheme("naive int8 ranges", 8, lambda windows: _whole(np.floor(windows / step + 0.5) * step))


def _of_differences(decode: Callable[[I64], NDArray[np.generic]]) -> Decode:
    """The minimum goes its own, exact way."""

    def decoded(windows: I64) -> I64:
        m = windows.min(axis=-1, keepdims=True)
        made: I64 = m + _whole(decode(windows - m))
        return made

    return decoded


def _whole(values: NDArray[np.generic]) -> I64:
    whole: FloatArray = np.floor(np.asarray(values, dtype=np.float64) + 0.5)
    return whole.astype(np.int64)


# -------------------------------------------------------------------------------------------------- calibration


def codes(calibration: Calibration, limits: tuple[int, int]) -> list[Scheme]:
    """Every code, its steps chosen on the calibration's distance windows. ``limits``: largest input, largest
    difference."""
    windows = calibration.distance
    d = windows - windows.min(axis=1, keepdims=True)
    return [
        exact_scheme(),
        metres_scheme(limits[0]),
        *(linear_scheme(name, step) for name, step in _linear_steps(d)),
        companded_scheme(limits[1]),
        minifloat_scheme(),
        _best_two_range(d),
        block_scheme(7),
        block_scheme(8),
    ]


def _linear_steps(d: I64) -> Iterator[tuple[str, float]]:
    yield "min-max", float(d.max()) / (LEVELS - 1)
    for share in (99.0, 99.9):
        yield f"{share:g}th percentile", max(1.0, float(np.percentile(d, share)) / (LEVELS - 1))
    steps = np.geomspace(1.0, max(2.0, float(d.max()) / (LEVELS - 1)), _STEPS)
    yield "least squares", float(steps[np.argmin([_squared_error(d, linear_scheme("", step)) for step in steps])])


def _best_two_range(d: I64) -> Scheme:
    pairs = [two_range_scheme(fine, coarse) for fine in range(6) for coarse in range(fine + 1, 9)]
    return pairs[int(np.argmin([_squared_error(d, scheme) for scheme in pairs]))]


def _squared_error(d: I64, scheme: Scheme) -> float:
    return float(np.mean((scheme.decode(d) - d).astype(np.float64) ** 2))


# ----------------------------------------------------------------------------------------------------- variants


@dataclass(frozen=True)
class CodeTable:
    """A comparison of codes ready to run: variants by name, and what each is."""

    variants: dict[str, Variant]
    labels: dict[str, tuple[str, int, str]]
    """code, its bits, weights: ``float``, ``8-bit, nearest`` or ``8-bit, descent``"""


def scheme_variants(file: ModelFile, calibration: Calibration) -> CodeTable:
    """Each code with float weights, and with weights of 8 bits by nearest rounding and by descent.

    With float weights the error is the code's own. The 8-bit weights are found on exact differences, but those of
    ``block, 8 bits`` by descent, which are found on its codes: they are the contract's int8 network.
    """
    unit = file.rules.distance_unit_m
    exact = float_variant(file.folded, unit)
    networks = _narrow_networks(file, calibration)
    table = CodeTable({}, {})
    for scheme in codes(calibration, largest_inputs(file.rules, "distance")):
        for weights, made in networks.items():
            name = f"{scheme.name}; {weights} weights"
            table.variants[name] = _coded(scheme, exact if made is None else made)
            table.labels[name] = scheme.name, scheme.bits, weights
    table.variants["block, 8 bits; 8-bit, descent weights"] = _contract_int8(file, calibration)
    return table


def narrow_variant(file: ModelFile, calibration: Calibration, rounding: Rounding = "descent") -> Variant:
    """W8A16: weights of 8 bits, differences of 16."""
    found = [
        quantize_network(net, "int16", windows, limits, f"W8A16 {name} network", weight_bits=8, rounding=rounding)
        for name, net, windows, limits in network_problems(file, calibration)
    ]
    return _sixteen_bit(found[0], found[1])


def _narrow_networks(file: ModelFile, calibration: Calibration) -> Mapping[str, Variant | None]:
    return {
        "float": None,
        "8-bit, nearest": narrow_variant(file, calibration, "nearest"),
        "8-bit, descent": narrow_variant(file, calibration, "descent"),
    }


def _contract_int8(file: ModelFile, calibration: Calibration) -> Variant:
    found = [
        quantize_network(net, "int8", windows, limits, f"int8 {name} network")
        for name, net, windows, limits in network_problems(file, calibration)
    ]
    return Variant(
        lambda windows: network(found[0], "int8", windows).y, lambda windows: network(found[1], "int8", windows).y
    )


def _sixteen_bit(distance: IntegerNetwork, intensity: IntegerNetwork) -> Variant:
    return Variant(
        lambda windows: network(distance, "int16", windows).y, lambda windows: network(intensity, "int16", windows).y
    )


def network_problems(
    file: ModelFile, calibration: Calibration
) -> Iterator[tuple[str, DifferenceNetwork, I64, tuple[int, int]]]:
    """Both networks: name, float network on differences, calibration windows, limits (largest input, largest
    difference)."""
    limits = largest_inputs(file.rules, "distance"), largest_inputs(file.rules, "intensity")
    unit = file.rules.distance_unit_m
    yield "distance", difference_network(file.folded[0], unit), calibration.distance, limits[0]
    yield "intensity", difference_network(file.folded[1], 1.0), calibration.intensity, limits[1]


def _coded(scheme: Scheme, variant: Variant) -> Variant:
    """Only the distance is coded: an intensity has 8 bits by nature."""
    return Variant(lambda windows: variant.distance(scheme.decode(windows)), variant.intensity)


def widest_unit(file: ModelFile, precision: Precision) -> str:
    """Of a model that fits no scale: the network and the hidden unit that reach farthest beyond what the contract
    holds.

    A hidden value has 16 bits and its output weight 8 or 16: their product is the most that a unit can add to the
    output.
    """
    most = (127 if precision == "int8" else 32767) * 32767
    worst: tuple[float, str, int] = (0.0, "", 0)
    units: dict[Literal["distance", "intensity"], float] = {"distance": file.rules.distance_unit_m, "intensity": 1.0}
    for (name, unit), folded in zip(units.items(), file.folded, strict=True):
        net = difference_network(folded, unit)
        largest_input, largest_difference = largest_inputs(file.rules, name)
        reach = np.maximum(*(
            np.maximum(sign * net.weight, 0).sum(axis=1) * largest_difference
            + np.maximum(sign * net.minimum, 0) * largest_input
            + np.maximum(sign * net.bias, 0)
            for sign in (1, -1)
        )) * np.abs(net.output)  # fmt: skip
        unit_at = int(np.argmax(reach))
        worst = max(worst, (float(reach[unit_at]), name, unit_at))
    reached, network_name, at = worst
    return (
        f"hidden unit {at} of the {network_name} network can add {reached:.3g} to the output, at most {most:.3g} fits"
    )
