"""Window extraction, empty-pixel rule, edges, limits and the last row against a pixel-by-pixel reading of the
documentation."""

from __future__ import annotations

import numpy as np
import pytest

from upbeam.model.beams import beam_table, uniform_beam_table
from upbeam.model.network import FoldedNetwork
from upbeam.model.rules import BEAMS, Rules, RulesError, extract_windows, upsample_reference


def make_rules(**changes):
    return Rules.for_beams(uniform_beam_table(64, 2.0, -24.0), columns=changes.pop("columns", 16), **changes)


def random_image(rng, rows=BEAMS, columns=16, empty=0.4):
    distance = rng.integers(0, 50_000, (rows, columns)).astype(np.uint16)
    distance[rng.random(distance.shape) < empty] = 0
    return distance, rng.integers(0, 256, distance.shape).astype(np.uint8)


def window_by_hand(distance, intensity, rules, row, column):
    """docs/model-format.md, "What the rules mean", one window at a time."""

    def pixel(r, c):
        inside = 0 <= c < distance.shape[1]
        d = int(distance[r, c]) if inside else 0
        return (d, int(intensity[r, c])) if inside and rules.min_count <= d <= rules.row_max_count[2 * r] else (0, 0)

    columns = []
    for c in (column - 1, column, column + 1):
        top, bottom = pixel(row, c), pixel(row + 1, c)
        if rules.empty == "fill":
            top, bottom = (top if top[0] else bottom), (bottom if bottom[0] else top)
        columns.append((top, bottom))
    seen = any(t[0] or b[0] for t, b in columns)
    if rules.empty == "fill" and seen:
        left, middle, right = columns
        got = [bool(t[0]) for t, _ in columns]
        between = tuple(tuple(map(min, zip(a, b, strict=True))) for a, b in zip(left, right, strict=True))
        columns = [
            left if got[0] else middle if got[1] else right,
            middle if got[1] else between if got[0] and got[2] else left if got[0] else right,
            right if got[2] else middle if got[1] else left,
        ]
    order = [(c, r) for r in (0, 1) for c in range(3)]
    return [columns[c][r][0] for c, r in order], [columns[c][r][1] for c, r in order], seen


@pytest.mark.parametrize("empty", ["none", "fill"])
@pytest.mark.parametrize("share", [0.0, 0.4, 0.9])
def test_windows_match_the_documentation_pixel_by_pixel(rng, empty, share):
    rules = make_rules(empty=empty)
    distance, intensity = random_image(rng, columns=11, empty=share)
    windows = extract_windows(distance, intensity, rules)
    for row in range(BEAMS - 1):
        for column in range(11):
            d, i, seen = window_by_hand(distance, intensity, rules, row, column)
            assert windows.distance[row, column].tolist() == d
            assert windows.intensity[row, column].tolist() == i
            assert windows.any_return[row, column] == seen


def test_a_closed_turn_continues_across_the_cut(rng):
    rules = make_rules()
    distance, intensity = random_image(rng)
    turned = extract_windows(np.roll(distance, 5, 1), np.roll(intensity, 5, 1), rules, wrap=True)
    windows = extract_windows(distance, intensity, rules, wrap=True)
    assert np.array_equal(np.roll(windows.distance, 5, 1), turned.distance)


def constant_network(value, skip=0.0):
    return FoldedNetwork(np.zeros((1, 7)), np.zeros(1), np.zeros(1), value, skip, 0.01)


def test_sensor_rows_leave_verbatim_also_beyond_the_limits(rng):
    rules = make_rules()
    distance, intensity = random_image(rng)
    distance[3, 4], distance[5, 6] = 1, 65535
    out, grey = upsample_reference(distance, intensity, (constant_network(10.0), constant_network(7.4)), rules)
    assert np.array_equal(out[0::2], distance)
    assert np.array_equal(grey[0::2], intensity)


def test_rounding_limits_and_the_all_empty_window(rng):
    distance, intensity = random_image(rng, empty=0.0)
    distance[:, 8:] = 0
    rules = make_rules(ground_reach=0.0)
    near = upsample_reference(distance, intensity, (constant_network(2.9985), constant_network(7.5)), rules)
    assert set(near[0][1:-1:2, :8].ravel()) == {0}  # 2.9985 m -> 1499.25 -> 1499 < 1500 counts
    kept = upsample_reference(distance, intensity, (constant_network(2.9991), constant_network(7.5)), rules)
    assert set(kept[0][1:-1:2, :8].ravel()) == {1500}
    assert set(kept[1][1:-1:2, :8].ravel()) == {8}  # half up
    assert set(kept[0][1:-1:2, 9:].ravel()) == {0}  # nothing seen: nothing made
    assert set(kept[1][1:-1:2, 9:].ravel()) == {0}
    far = upsample_reference(distance, intensity, (constant_network(80.001), constant_network(300.0)), rules)
    assert set(far[0][1:-1:2, :8].ravel()) == {0}


@pytest.mark.parametrize(("rule", "expected"), [("repeat", "row 62"), ("empty", "nothing")])
def test_last_row(rng, rule, expected):
    distance, intensity = random_image(rng)
    out, grey = upsample_reference(
        distance, intensity, (constant_network(9.0), constant_network(1.0)), make_rules(last_row=rule)
    )
    assert np.array_equal(out[63], distance[31] if expected == "row 62" else np.zeros(16))
    assert np.array_equal(grey[63], intensity[31] if expected == "row 62" else np.zeros(16))


def test_rows_that_point_down_have_limits_of_their_own(rng):
    """Four times the way to flat ground: beyond it the networks see nothing and nothing is generated."""
    rules = make_rules(ground_reach=4.0, sensor_height_m=2.0)
    assert rules.row_max_count[0] == rules.max_count  # points up
    assert rules.row_max_count[63] == int(4 * 2.0 / np.sin(np.radians(24.0)) / 0.002)
    assert make_rules(ground_reach=0.0).row_max_count.tolist() == [40_000] * 64
    distance, intensity = random_image(rng, empty=0.0)
    distance[:] = 12_000  # 24 m: beyond the limit of the lowest rows, 8.0 m / sin(19.5 degrees)
    out, _ = upsample_reference(distance, intensity, (constant_network(24.0), constant_network(5.0)), rules)
    limited = rules.row_max_count[1:-1:2] < 12_000
    assert limited.sum() == 5
    assert set(out[1:-1:2][limited].ravel()) == {0}
    assert set(out[1:-1:2][~limited].ravel()) == {12_000}
    assert np.array_equal(out[::2], distance)
    far_only = extract_windows(distance, intensity, rules)
    assert not far_only.any_return[-1].any()


@pytest.mark.parametrize("reach", [-1.0, np.nan])
def test_an_impossible_reach_is_refused(reach):
    with pytest.raises(RulesError, match="ground_reach"):
        make_rules(ground_reach=reach)


def test_rules_of_beam_tables():
    half = Rules.for_beams(beam_table("hdl-64e"))
    assert half.sensor == "hdl-64e/2"
    assert np.array_equal(half.row_elevation_deg, beam_table("hdl-64e").elevation_deg)
    native = Rules.for_beams(beam_table("vlp-32c"))
    assert native.columns == 904
    assert native.row_elevation_deg[1] == pytest.approx((15 + 10.333) / 2)
    assert (native.min_count, native.max_count) == (750, 20_000)


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"columns": 3}, "columns"),
        ({"min_m": 90.0}, "range limits"),
        ({"edge": "wrap"}, "edge"),
        ({"empty": "mean"}, "empty"),
    ],
)
def test_impossible_rules_are_refused_by_name(changes, named):
    with pytest.raises(RulesError, match=named):
        make_rules(**changes)
