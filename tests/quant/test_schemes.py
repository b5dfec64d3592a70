"""The codes that were compared: what each can hold, and that the contract's is among them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import upbeam
from upbeam.cli.frames import model_frames
from upbeam.quant.accuracy import compare
from upbeam.quant.integer import OverflowProofError, block_code
from upbeam.quant.quantize import Calibration, calibration_windows, quantize
from upbeam.quant.schemes import (
    block_scheme,
    codes,
    companded_scheme,
    linear_scheme,
    metres_scheme,
    minifloat_scheme,
    scheme_variants,
    two_range_scheme,
    widest_unit,
)

LIMITS = (40_000, 38_500)


@pytest.fixture(scope="module")
def windows():
    rng = np.random.default_rng(3)
    level = rng.integers(1500, 20_000, (3000, 1))
    spread = (2.0 ** rng.uniform(0, 14, (3000, 1)) * rng.random((3000, 6))).astype(int)
    return level + spread


@pytest.fixture(scope="module")
def calibration(windows):
    return Calibration(windows, windows % 256)


def differences(windows):
    return windows - windows.min(axis=1, keepdims=True)


def test_every_code_keeps_the_minimum_and_flat_windows(calibration, windows):
    flat = np.full((1, 6), 12_345)
    for scheme in codes(calibration, LIMITS):
        decoded = scheme.decode(windows)
        assert decoded.dtype == np.int64
        if scheme.name != metres_scheme(40_000).name:
            assert np.array_equal(decoded.min(axis=1), windows.min(axis=1)), scheme.name
            assert np.array_equal(scheme.decode(flat), flat), scheme.name


def test_no_code_has_more_values_than_its_bits(calibration, windows):
    """Of one window's spread: differences from 0 to 20,000 beside one of 20,000."""
    ramp = np.full((20_001, 6), 5000)
    ramp[:, 1] += np.arange(20_001)
    ramp[:, 2] += 20_000
    for scheme in codes(calibration, LIMITS)[1:]:
        assert len(np.unique(scheme.decode(ramp)[:, 1])) <= 2**scheme.bits, scheme.name


def test_the_block_code_of_8_bits_is_the_contract_s(windows):
    s, q = block_code(differences(windows))
    expected = windows.min(axis=1, keepdims=True) + (q << s[:, None])
    assert np.array_equal(block_scheme(8).decode(windows), expected)


@pytest.mark.parametrize(
    ("scheme", "exact_below", "share"),
    [(block_scheme(8), 256, 1 / 256), (block_scheme(7), 128, 1 / 128), (two_range_scheme(3, 8), 0, None)],
)
def test_shared_steps_are_as_fine_as_the_spread_allows(windows, scheme, exact_below, share):
    d = differences(windows)
    error = np.abs(scheme.decode(windows) - windows).max(axis=1)
    largest = d.max(axis=1)
    assert not error[largest < exact_below].any()
    if share is not None:
        assert np.all(error <= np.maximum(1, largest * share))
    else:
        assert np.all(error <= np.where(largest < 2040, 4, 128))


def test_steps_of_one_difference_follow_its_own_size(windows):
    d = differences(windows)
    for scheme, share in ((minifloat_scheme(), 1 / 32), (companded_scheme(38_500), 0.03)):
        error = np.abs(scheme.decode(windows) - windows)
        assert np.all(error <= np.maximum(5, d * share)), scheme.name
    small = np.array([[100, 101, 105, 110, 120, 131]])
    assert np.array_equal(minifloat_scheme().decode(small), small)


def test_linear_steps_cut_what_they_cannot_hold():
    decoded = linear_scheme("x", 10.0).decode(np.array([[0, 4, 5, 2549, 2555, 30_000]]))
    assert decoded.tolist() == [[0, 0, 10, 2550, 2550, 2550]]


def test_the_least_squares_step_is_the_best_of_the_linear_ones(calibration, windows):
    linear = [scheme for scheme in codes(calibration, LIMITS) if scheme.name.startswith("linear")]
    errors = {scheme.name: np.mean((scheme.decode(windows) - windows) ** 2.0) for scheme in linear}
    assert min(errors, key=errors.get) == "linear, least squares"
    assert len(errors) == 4


def test_the_contract_s_code_beats_linear_steps_and_naive_ranges():
    file = upbeam.load_model().file
    frames = model_frames("sim", file, limit=3, seed=60, simulated=3, what="frames", quiet=True).frames
    table = scheme_variants(file, calibration_windows(frames[:2], file.rules, 5000))
    assert set(table.labels) == set(table.variants)
    means = {name: s.mean_mm for name, s in compare(file, frames[2:], table.variants, truth=False).summaries().items()}
    assert means["16-bit differences; float weights"] == 0
    for weights in ("float", "8-bit, nearest", "8-bit, descent"):
        of = {label[0]: means[name] for name, label in table.labels.items() if label[2] == weights}
        assert of["block, 8 bits"] < min(value for name, value in of.items() if name.startswith("linear")) / 2
        assert of["block, 8 bits"] < of["naive int8 ranges"] / 5
        assert of["block, 8 bits"] < of["block, 7 bits"]


def test_the_unit_that_makes_a_model_too_large_is_named(calibration):
    file = upbeam.load_model().file
    weight = file.folded[0].weight.copy()
    weight[5] *= 1e5
    large = replace(file, folded=(replace(file.folded[0], weight=weight), file.folded[1]))
    with pytest.raises(OverflowProofError):
        quantize(large, calibration, ["int8"], "nearest")
    text = widest_unit(large, "int8")
    assert text.startswith("hidden unit 5 of the distance network")
    assert "4.16e+06" in text
