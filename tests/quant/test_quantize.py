"""Quantised networks beside the float ones they come from, on simulated windows; what cannot be quantised."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from upbeam import load_model
from upbeam.cli.sources import recipe_frames
from upbeam.model.network import FoldedNetwork
from upbeam.model.recipe import load_recipe
from upbeam.quant.integer import OverflowProofError, largest_inputs, network
from upbeam.quant.quantize import Calibration, calibration_windows, difference_network, quantize, quantize_network
from upbeam.quant.ubm import read_ubm


@pytest.fixture(scope="module")
def model():
    return load_model("hdl-64e").file


def simulated(model, seed: int, frames: int = 3) -> Calibration:
    recipe = load_recipe("default")
    sources = (replace(recipe.data[0], frames=frames, seed=seed),)
    return calibration_windows(recipe_frames(recipe, model.rules, sources), model.rules, 8_000)


@pytest.fixture(scope="module")
def calibration(model):
    return simulated(model, 5)


@pytest.fixture(scope="module")
def unseen(model):
    return simulated(model, 6)


def error_mm(net, made, precision, windows, unit_m) -> np.ndarray:
    """Of whole counts, as the runtime gives them."""
    m = windows.min(axis=1) * net.skip
    exact = np.floor(net.rest(windows) + 0.5) + m
    return np.abs(network(made, precision, windows).y - exact) * unit_m * 1000


@pytest.mark.parametrize(
    ("precision", "bits", "mean_mm", "p999_mm"), [("int16", 16, 2.5, 12), ("int16", 8, 6, 200), ("int8", 8, 8, 250)]
)
def test_distance_error_on_unseen_windows(model, calibration, unseen, precision, bits, mean_mm, p999_mm):
    net = difference_network(model.folded[0], model.rules.distance_unit_m)
    limits = largest_inputs(model.rules, "distance")
    made = quantize_network(net, precision, calibration.distance, limits, "test", weight_bits=bits)
    error = error_mm(net, made, precision, unseen.distance, model.rules.distance_unit_m)
    assert error.mean() < mean_mm
    assert np.quantile(error, 0.999) < p999_mm
    assert bits == 8 or error.max() <= 20
    if bits == 8:
        grid = np.bitwise_or.reduce(np.abs(made.weight), axis=None)
        assert np.abs(made.weight).max() // (grid & -grid) <= 127


def test_descent_is_closer_than_nearest(model, calibration, unseen):
    net = difference_network(model.folded[0], model.rules.distance_unit_m)
    limits = largest_inputs(model.rules, "distance")
    mean = {}
    for rounding in ("nearest", "descent"):
        made = quantize_network(net, "int8", calibration.distance, limits, "test", rounding=rounding)
        mean[rounding] = error_mm(net, made, "int8", unseen.distance, 0.002).mean()
    assert mean["descent"] < mean["nearest"]


def test_whole_model(model, calibration, unseen, tmp_path):
    made = quantize(model, calibration)
    again = read_ubm(made.to_bytes())
    assert again.precisions == ["fp32", "int16", "int8"]
    exact = difference_network(model.folded[1], 1.0)
    windows = unseen.intensity
    y = np.clip(np.floor(exact.rest(windows) + 0.5) + windows.min(axis=1) * exact.skip, 0, 255)
    for precision in ("int16", "int8"):
        grey = network(again.integer(precision).intensity, precision, windows).y
        assert np.abs(np.clip(grey, 0, 255) - y).max() <= 2
    assert quantize(model, calibration).to_bytes() == made.to_bytes()


def raw_network(rng: np.random.Generator, scale: float = 1.0) -> FoldedNetwork:
    """As imported weights are: pixels, not differences; the slope 0.01; no skip."""
    weight = rng.normal(0.1, 0.05, (12, 7)) * scale
    return FoldedNetwork(weight, rng.normal(size=12), rng.normal(0.1, 0.05, 12), 0.1, 0.0, 0.01)


def test_imported_weights_on_raw_pixels(model, calibration, rng):
    """Their hidden values are whole ranges: coarser, but every precision takes them."""
    net = difference_network(raw_network(rng), model.rules.distance_unit_m)
    limits = largest_inputs(model.rules, "distance")
    for precision, mean_mm in (("int16", 8), ("int8", 60)):
        made = quantize_network(net, precision, calibration.distance, limits, "test")
        assert made.slope == 328  # 41 / 4096
        assert error_mm(net, made, precision, calibration.distance, 0.002).mean() < mean_mm


def test_weights_beyond_the_contract_are_refused_by_name(model, calibration, rng):
    wild = replace(model, folded=(raw_network(rng, 1e6), model.folded[1]))
    with pytest.raises(OverflowProofError, match="int16 distance network: no scale makes it fit the contract"):
        quantize(wild, calibration)


def test_zero_weights_are_no_trouble(model, calibration):
    dead = FoldedNetwork(np.zeros((2, 7)), np.zeros(2), np.zeros(2), 0.25, 1.0, 0.0)
    net = difference_network(dead, model.rules.distance_unit_m)
    limits = largest_inputs(model.rules, "distance")
    for precision in ("int16", "int8"):
        made = quantize_network(net, precision, calibration.distance, limits, "test")
        assert error_mm(net, made, precision, calibration.distance, 0.002).max() <= 2


def test_no_window_no_calibration(model):
    with pytest.raises(ValueError, match="no calibration window"):
        calibration_windows([], model.rules)
