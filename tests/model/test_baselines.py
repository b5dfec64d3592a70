"""Baselines by hand and against direct loops."""

from __future__ import annotations

import numpy as np
import pytest

from upbeam.model.baselines import (
    BASELINES,
    EDGE_THRESHOLD,
    bicubic,
    bilinear,
    edge_aware,
    nearest,
    valid_mean,
    window_mean,
    you_kim,
)
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


def rounded(d, i):
    d = int(np.floor(d + 0.5))
    if not RULES.min_count <= d <= RULES.max_count:
        return [0, 0]
    return [d, int(np.clip(np.floor(i + 0.5), 0, 255))]


def test_bicubic_against_a_loop(rng):
    """Keys' kernel (a = -0.5) at distances 0.5 and 1.5: 9/16 and -1/16; rows outside left out."""
    distance, intensity = image(rng, empty=0.1)
    intensity[distance == 0] = 0
    d, i = bicubic(distance, intensity, RULES)
    for row in range(31):
        taps = {r: w for r, w in zip(range(row - 1, row + 3), (-1, 9, 9, -1), strict=True) if 0 <= r < 32}
        for column in range(16):
            mean = [
                sum(w * float(x[r, column]) for r, w in taps.items()) / sum(taps.values())
                for x in (distance, intensity)
            ]
            assert np.allclose([d[row, column], i[row, column]], rounded(*mean), atol=1e-9 if len(taps) == 4 else 1)


def test_edge_aware_against_a_loop(rng):
    near, far = rng.integers(2000, 4000, (32, 16)), rng.integers(8000, 9000, (32, 16))
    distance = np.where(rng.random((32, 16)) < 0.5, near, far).astype(np.uint16)
    distance[rng.random(distance.shape) < 0.2] = 0
    intensity = rng.integers(0, 256, distance.shape).astype(np.uint8)
    d, i = edge_aware(distance, intensity, RULES)
    kinds = set()
    for row in range(31):
        for column in range(16):
            cells = {c: (float(distance[c]), float(intensity[c])) for c in ((row, column), (row + 1, column))}
            (a, ga), (b, gb) = cells.values()
            if a and b and abs(a - b) > EDGE_THRESHOLD * min(a, b):
                beside = [
                    float(distance[r, c]) for r in (row, row + 1) for c in (column - 1, column + 1) if 0 <= c < 16
                ]
                up = sum(abs(x - a) < abs(x - b) for x in beside if x)
                down = sum(abs(x - b) < abs(x - a) for x in beside if x)
                kinds.add((up > down) - (up < down))
                above = up > down if up != down else a < b
                expected = (a, ga) if above else (b, gb)
            else:
                seen = [pair for pair in cells.values() if pair[0]] or [(0.0, 0.0)]
                expected = tuple(np.mean(seen, axis=0))
            assert [d[row, column], i[row, column]] == rounded(*expected)
    assert kinds == {-1, 0, 1}


def test_you_kim_against_a_loop(rng):
    distance, intensity = image(rng, empty=0.5)
    distance[:, :8] = np.where(distance[:, :8] > 0, 2500 + distance[:, :8] // 20, 0)  # near enough to mix
    d, i = you_kim(distance, intensity, RULES)
    for row in range(31):
        for column in range(16):
            window = [(r, c) for r in (row, row + 1) for c in (column - 1, column, column + 1) if 0 <= c < 16]
            seen = [(r, c) for r, c in window if distance[r, c]]
            expected = [0.0, 0.0]
            if seen:
                metres = [float(distance[x]) * RULES.distance_unit_m for x in seen]
                apart = [1.0 if c == column else 2**0.5 for _, c in seen]
                weights = [
                    np.exp(-0.5 * a) * 2 / (1 + np.exp(r - min(metres))) for a, r in zip(apart, metres, strict=True)
                ]
                expected = [
                    np.average([float(x[cell]) for cell in seen], weights=weights) for x in (distance, intensity)
                ]
            assert np.allclose([d[row, column], i[row, column]], expected, atol=0.5 + 1e-6)


def test_an_edge_is_not_filled_with_air():
    """A pole before a wall: the mean stands between them, the edge-aware point on one of the two."""
    distance, grey = np.full((32, 16), 20_000, np.uint16), np.full((32, 16), 100, np.uint8)
    distance[11:] = 3000
    assert set(valid_mean(distance, grey, RULES)[0][10]) == {11_500}
    assert set(edge_aware(distance, grey, RULES)[0][10]) == {3000}


@pytest.mark.parametrize("name", list(BASELINES))
def test_out_of_range_input_is_never_seen_nor_given(rng, name):
    distance, intensity = image(rng)
    distance[rng.random(distance.shape) < 0.5] = 65535
    d, i = BASELINES[name](distance, intensity, RULES)
    assert np.all((d == 0) | ((d >= RULES.min_count) & (d <= RULES.max_count)))
    assert not i[d == 0].any()
