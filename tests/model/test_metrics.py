"""Metrics against brute force and by hand."""

from __future__ import annotations

import numpy as np
import pytest

from upbeam.model.beams import uniform_beam_table
from upbeam.model.metrics import chamfer_m2, compare_rows
from upbeam.model.rules import Rules

RULES = Rules.for_beams(uniform_beam_table(64, 2.0, -24.0), columns=360)


def brute_chamfer(p, q):
    squares = ((p[:, None] - q[None]) ** 2).sum(-1)
    return squares.min(1).mean() + squares.min(0).mean(), np.sqrt(squares.min(1))


def test_chamfer_against_brute_force(rng):
    p, q = rng.normal(size=(200, 3)), rng.normal(size=(150, 3))
    value, to_real = chamfer_m2(p, q)
    expected, nearest = brute_chamfer(p, q)
    assert value == pytest.approx(expected)
    assert to_real == pytest.approx(nearest)


def test_chamfer_of_nothing_is_refused():
    with pytest.raises(ValueError, match="empty"):
        chamfer_m2(np.zeros((0, 3)), np.zeros((1, 3)))


def rows(value, grey=0):
    return np.full((31, 360), value, np.uint16), np.full((31, 360), grey, np.uint8)


def test_a_perfect_answer_costs_nothing():
    m = compare_rows(rows(5000, 9), rows(5000, 9), RULES)
    assert (m.chamfer_m2, m.mae_m, m.ghost_share, m.coverage, m.intensity_mae) == (0, 0, 0, 1, 0)


def test_by_hand():
    """A quarter of the pixels is 2 m too near, a quarter is not generated, intensity is 3 too low."""
    generated, real = rows(5000, 10), rows(5000, 13)
    generated[0][:, :90] = 4000
    generated[0][:, 90:180] = 0
    m = compare_rows(generated, real, RULES)
    assert m.mae_m == pytest.approx(0.25 * 2 + 0.25 * 10)
    assert m.mae_both_m == pytest.approx(2 / 3)
    assert m.coverage == pytest.approx(0.75)
    assert m.intensity_mae == pytest.approx(3)
    # A point 2 m before a shell of 10 m is a ghost everywhere.
    assert m.ghost_share == pytest.approx(1 / 3)


def test_real_points_beyond_the_limits_do_not_count():
    generated, real = rows(5000), rows(5000)
    real[0][:, :180] = 100
    m = compare_rows(generated, real, RULES)
    assert m.mae_m == 0
    assert m.ghost_share > 0.4


def test_points_stand_where_their_rows_point(rng):
    """The Chamfer distance of two shells, from points made by hand."""
    generated, real = rows(5000), rows(5500)
    m = compare_rows(generated, real, RULES)
    el, az = np.meshgrid(np.radians(RULES.row_elevation_deg[1:-1:2]), np.radians(np.arange(360) + 0.5), indexing="ij")
    unit = np.stack([np.cos(el) * np.cos(az), np.cos(el) * np.sin(az), np.sin(el)], -1).reshape(-1, 3)
    expected, _ = brute_chamfer(10 * unit[::7], 11 * unit)
    assert m.chamfer_m2 == pytest.approx(2 * 1.0, rel=0.01)
    assert expected == pytest.approx(2.0, rel=0.2)
