"""Baselines by hand and against direct loops."""

from __future__ import annotations

import numpy as np
import pytest

from upbeam.model.baselines import BASELINES, bilinear, nearest, valid_mean, window_mean
from upbeam.model.beams import uniform_beam_table
from upbeam.model.rules import Rules

RULES = Rules.for_beams(uniform_beam_table(64, 2.0, -24.0), columns=16)


def image(rng, empty=0.3):
    distance = rng.integers(1500, 40_001, (32, 16)).astype(np.uint16)
    distance[rng.random(distance.shape) < empty] = 0
    return distance, rng.integers(0, 256, distance.shape).astype(np.uint8)


@pytest.mark.parametrize(("method", "reach"), [(valid_mean, 0), (window_mean, 1)])
def test_means_of_valid_pixels_against_a_loop(rng, method, reach):
    distance, intensity = image(rng)
    d, i = method(distance, intensity, RULES)
    for row in range(31):
        for column in range(16):
            around = range(max(0, column - reach), min(16, column + reach + 1))
            cells = [(r, c) for r in (row, row + 1) for c in around]
            seen = [(int(distance[x]), int(intensity[x])) for x in cells if distance[x]]
            mean = [int(np.floor(np.mean(v) + 0.5)) for v in zip(*seen, strict=True)] if seen else [0, 0]
            assert [d[row, column], i[row, column]] == mean


def test_bilinear_averages_zeros_in():
    distance, grey = np.full((32, 16), 8000, np.uint16), np.full((32, 16), 100, np.uint8)
    distance[1] = 0
    d, i = bilinear(distance, grey, RULES)
    assert set(d[0]) == {4000}
    assert set(i[0]) == {50}
    assert set(d[5]) == {8000}


def test_nearest_repeats_the_row_above(rng):
    distance, intensity = image(rng)
    d, _ = nearest(distance, intensity, RULES)
    assert np.array_equal(d, distance[:-1])


@pytest.mark.parametrize("name", list(BASELINES))
def test_out_of_range_input_is_never_seen_nor_given(rng, name):
    distance, intensity = image(rng)
    distance[rng.random(distance.shape) < 0.5] = 65535
    d, i = BASELINES[name](distance, intensity, RULES)
    assert np.all((d == 0) | ((d >= RULES.min_count) & (d <= RULES.max_count)))
    assert not i[d == 0].any()
