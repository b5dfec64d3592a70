"""Metrics against brute force and by hand."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest

from upbeam.model.baselines import valid_mean
from upbeam.model.beams import uniform_beam_table
from upbeam.model.evaluate import in_unit
from upbeam.model.frames import Frame
from upbeam.model.geometry import GeometryError
from upbeam.model.metrics import (
    FrameMetrics,
    Prediction,
    Truth,
    chamfer_m2,
    chamfer_origin_m2,
    compare_rows,
    voxel_overlap,
)
from upbeam.model.rules import Rules

RULES = Rules.for_beams(uniform_beam_table(64, 2.0, -24.0), columns=360)


def distances(p, q):
    return np.sqrt(((p[:, None] - q[None]) ** 2).sum(-1))


def brute_chamfer(p, q):
    d = distances(p, q)
    return (d.min(1) ** 2).mean() + (d.min(0) ** 2).mean(), d.min(1)


def small_frame(rng, rows=9, columns=40, surface=False):
    """Walls with holes; some returns beyond the limits."""
    distance = rng.integers(2000, 20_000, (rows, columns)).astype(np.uint16)
    distance[rng.random(distance.shape) < 0.3] = 0
    distance[rng.random(distance.shape) < 0.05] = 45_000
    grey = rng.integers(0, 256, distance.shape).astype(np.uint8)
    labels = np.where(distance > 0, 1 + (np.arange(rows)[:, None] // 2 + np.arange(columns)) % 3, 0)
    return Frame(
        "small", distance, grey, 0.002, np.linspace(2, -10, rows), np.linspace(0.1, -0.1, rows), 90.0,
        labels.astype(np.uint8) if surface else None,
    )  # fmt: skip


def predicted(frame):
    made = valid_mean(frame.distance[frame.given], frame.intensity[frame.given], RULES)
    return Prediction(Truth(frame, RULES), *made), made


def all_pixels(frame, distance, rows, *, origin):
    """Points pixel by pixel, written out; empty pixels at the origin, or left out."""
    points = []
    for r, row in zip(range(frame.rows)[rows], distance, strict=True):
        for c, count in enumerate(row):
            if RULES.min_count <= count <= RULES.max_count:
                d, el = count * 0.002, np.radians(frame.elevation_deg[r])
                az = np.radians(frame.cut_deg + (c + 0.5) * 360 / len(row))
                flat = d * np.cos(el)
                points.append((flat * np.cos(az), -flat * np.sin(az), d * np.sin(el) + frame.row_height_m[r]))
            elif origin:
                points.append((0.0, 0.0, 0.0))
    return np.array(points)


def test_chamfer_against_brute_force(rng):
    p, q = rng.normal(size=(200, 3)), rng.normal(size=(150, 3))
    value, to_real = chamfer_m2(p, q)
    expected, nearest = brute_chamfer(p, q)
    assert value == pytest.approx(expected)
    assert to_real == pytest.approx(nearest)


def test_chamfer_of_nothing_is_refused():
    with pytest.raises(ValueError, match="empty"):
        chamfer_m2(np.zeros((0, 3)), np.zeros((1, 3)))


@pytest.mark.parametrize(("empty_p", "empty_q"), [(0, 0), (7, 0), (0, 5), (3, 11)])
def test_the_origin_convention_against_brute_force(rng, empty_p, empty_q):
    p, q = rng.normal(0, 3, (60, 3)), rng.normal(1, 3, (50, 3))
    value = chamfer_origin_m2((p, brute_chamfer(p, q)[1], empty_p), (q, brute_chamfer(q, p)[1], empty_q))
    padded = [np.vstack([x, np.zeros((n, 3))]) for x, n in ((p, empty_p), (q, empty_q))]
    assert value == pytest.approx(brute_chamfer(*padded)[0])


def test_voxels_against_sets(rng):
    p, q = rng.normal(0, 0.4, (300, 3)), rng.normal(0.1, 0.4, (200, 3))
    anchor = np.array([0.03, -5.0, 0.01])
    sets = [{tuple(np.floor((x - anchor) / 0.1).astype(int)) for x in cloud} for cloud in (p, q)]
    both, either = len(sets[0] & sets[1]), len(sets[0] | sets[1])
    found = voxel_overlap(p, q, 0.1, anchor)
    assert 0 < both < either
    assert found.iou == pytest.approx(both / either)
    assert found.precision == pytest.approx(both / len(sets[0]))
    assert found.recall == pytest.approx(both / len(sets[1]))
    assert found.f1 == pytest.approx(2 * both / (len(sets[0]) + len(sets[1])))


def test_voxels_that_do_not_meet():
    found = voxel_overlap(np.zeros((1, 3)), np.full((1, 3), -0.01))
    assert (found.iou, found.precision, found.recall, found.f1) == (0, 0, 0, 0)


def test_every_metric_of_a_small_frame_against_brute_force(rng):
    frame = small_frame(rng)
    result, (made, _) = predicted(frame)
    real = frame.distance[frame.truth]
    p, q = all_pixels(frame, made, frame.truth, origin=False), all_pixels(frame, real, frame.truth, origin=False)
    d = distances(p, q)
    to_real, to_generated = d.min(1), d.min(0)
    ok = RULES.valid(real)
    error = np.abs(np.where(ok, real, 0).astype(float) - made) * 0.002
    expected = {
        "chamfer_m2": (to_real**2).mean() + (to_generated**2).mean(),
        "chamfer_sum_m2": (to_real**2).sum() + (to_generated**2).sum(),
        "chamfer_m": to_real.mean() + to_generated.mean(),
        "chamfer_origin_m2": brute_chamfer(
            all_pixels(frame, made, frame.truth, origin=True), all_pixels(frame, real, frame.truth, origin=True)
        )[0],
        "mae_m": error[ok].mean(),
        "mae_both_m": error[ok & (made > 0)].mean(),
        "mae_all_m": error.mean(),
        "median_m": np.median(error[ok]),
        "ghost_share": (to_real > 0.5).mean(),
        "missed_share": (to_generated > 0.5).mean(),
        "point_precision": (to_real <= 0.1).mean(),
        "point_recall": (to_generated <= 0.1).mean(),
        "coverage": (made > 0)[ok].mean(),
    }
    found = result.metrics().as_dict()
    assert set(found) - set(expected) == {"intensity_mae"}
    for key, value in expected.items():
        assert found[key] == pytest.approx(value, rel=1e-5, abs=1e-9), key


def test_whole_clouds_against_brute_force(rng):
    frame = small_frame(rng)
    result, (made, _) = predicted(frame)
    given = frame.distance[frame.given]
    clouds = {}
    for origin in (False, True):
        below = all_pixels(frame, given, frame.given, origin=origin)
        for side, rows in (("p", made), ("q", frame.distance[frame.truth])):
            clouds[side, origin] = np.vstack([below, all_pixels(frame, rows, frame.truth, origin=origin)])
    d = distances(clouds["p", False], clouds["q", False])
    found = result.cloud_metrics()
    assert found.cloud_chamfer_m2 == pytest.approx((d.min(1) ** 2).mean() + (d.min(0) ** 2).mean(), rel=1e-5)
    assert found.cloud_chamfer_sum_m2 == pytest.approx((d.min(1) ** 2).sum() + (d.min(0) ** 2).sum(), rel=1e-5)
    assert found.cloud_chamfer_m == pytest.approx(d.min(1).mean() + d.min(0).mean(), rel=1e-5)
    assert found.cloud_chamfer_origin_m2 == pytest.approx(
        brute_chamfer(clouds["p", True], clouds["q", True])[0], rel=1e-5
    )
    assert found.cloud_voxel_iou > found.voxel_iou >= 0  # given rows are equal on both sides


def test_bands_and_surfaces_are_parts_of_the_whole(rng):
    """Weighted by their points, bands (and labels) give the whole frame's figures again."""
    frame = small_frame(rng, surface=True)
    result, _ = predicted(frame)
    whole = result.metrics()
    for parts in (result.by_band(), result.by_surface()):
        held = [part for part in parts.values() if part.real_points]
        points = np.array([part.real_points for part in held])
        assert points.sum() == len(result.truth.points)
        for key in ("mae_m", "missed_share", "coverage"):
            assert np.average([getattr(part, key) for part in held], weights=points) == pytest.approx(
                getattr(whole, key)
            )
    assert set(result.by_surface()) == {1, 2, 3}
    assert list(result.by_band()) == ["0-10 m", "10-20 m", "20-40 m", "40-80 m"]
    assert np.isnan(result.by_band()["40-80 m"].mae_m)
    assert predicted(small_frame(rng))[0].by_surface() == {}


def test_a_point_on_a_band_s_edge_is_of_one_band():
    counts = np.full((3, 8), 5000, np.uint16)
    counts[:, 4:] = 40_000
    frame = Frame("edges", counts, np.zeros((3, 8), np.uint8), 0.002, np.array([1.0, 0, -1]), np.zeros(3))
    bands = predicted(frame)[0].by_band()
    assert {name: part.real_points for name, part in bands.items()} == {
        "0-10 m": 0, "10-20 m": 4, "20-40 m": 0, "40-80 m": 4
    }  # fmt: skip


@pytest.mark.parametrize("rows", [3, 8, 9, 64])
def test_judged_rows_lie_between_given_ones(rng, rows):
    frame = small_frame(rng, rows=rows)
    judged = np.arange(rows)[frame.truth]
    assert np.array_equal(judged, np.arange(1, rows - 1, 2))
    assert len(judged) == len(np.arange(rows)[frame.given]) - 1
    assert predicted(frame)[0].metrics().coverage > 0.5


def test_the_unit_does_not_matter(rng):
    """The same scene in counts of 2 and of 4 mm."""
    frame = small_frame(rng)
    even = replace(frame, distance=frame.distance // 4 * 4)
    half = replace(frame, distance=frame.distance // 4 * 2, distance_unit_m=0.004)
    limits = in_unit(RULES, 0.004)
    assert (limits.min_count, limits.max_count) == (750, 20_000)
    made, grey = valid_mean(half.distance[half.given], half.intensity[half.given], limits)
    fine = Prediction(Truth(even, RULES), (made * 2).astype(np.uint16), grey).metrics()
    coarse = Prediction(Truth(half, limits), made, grey).metrics()
    for field in fields(FrameMetrics):
        assert getattr(fine, field.name) == pytest.approx(getattr(coarse, field.name), rel=1e-6), field.name


def test_what_cannot_be_compared_is_refused(rng):
    frame = small_frame(rng)
    truth = Truth(frame, RULES)
    nothing = np.zeros(truth.distance.shape, np.uint16)
    with pytest.raises(ValueError, match="no point was generated in frame small"):
        Prediction(truth, nothing, nothing.astype(np.uint8))
    with pytest.raises(ValueError, match=r"expected \[4, 40\]"):
        Prediction(truth, nothing[:2], nothing[:2].astype(np.uint8))
    with pytest.raises(ValueError, match="frame small hold no return"):
        Truth(replace(frame, distance=np.zeros_like(frame.distance)), RULES)
    with pytest.raises(GeometryError, match="elevation_deg must be 9 numbers"):
        replace(frame, elevation_deg=np.zeros(8))


def rows(value, grey=0):
    return np.full((31, 360), value, np.uint16), np.full((31, 360), grey, np.uint8)


def test_a_perfect_answer_costs_nothing():
    m = compare_rows(rows(5000, 9), rows(5000, 9), RULES).as_dict()
    best = {"coverage", "point_precision", "point_recall"}
    assert {key for key, value in m.items() if value == 1} == best
    assert {key for key, value in m.items() if value == 0} == set(m) - best


def test_by_hand():
    """A quarter of the pixels is 2 m too near, a quarter is not generated, intensity is 3 too low."""
    generated, real = rows(5000, 10), rows(5000, 13)
    generated[0][:, :90] = 4000
    generated[0][:, 90:180] = 0
    m = compare_rows(generated, real, RULES)
    assert m.mae_m == pytest.approx(0.25 * 2 + 0.25 * 10)
    assert m.mae_all_m == pytest.approx(m.mae_m)
    assert m.mae_both_m == pytest.approx(2 / 3)
    assert m.median_m == pytest.approx(1)
    assert m.coverage == pytest.approx(0.75)
    assert m.intensity_mae == pytest.approx(3)
    # A point 2 m before a shell of 10 m is a ghost everywhere; real points above holes are missed.
    assert m.ghost_share == pytest.approx(1 / 3)
    assert m.missed_share == pytest.approx(0.5, abs=0.05)


@pytest.mark.parametrize(("off_m", "ghost", "hit"), [(0.08, 0, 1), (0.12, 0, 0), (0.45, 0, 0), (0.55, 1, 0)])
def test_thresholds_of_ghosts_and_hits(off_m, ghost, hit):
    """A shell moved inwards: every point is that far from the other shell."""
    m = compare_rows(rows(5000), rows(5000 + round(off_m / 0.002)), RULES)
    assert (m.ghost_share, m.missed_share) == (ghost, ghost)
    assert (m.point_precision, m.point_recall) == (hit, hit)


def test_a_generated_point_has_the_label_of_its_nearest_real_point():
    """Left half near and of one kind, right half far and of another; generated: right half 1 m too near."""
    counts = np.full((3, 40), 5000, np.uint16)
    counts[:, 20:] = 15_000
    labels = np.where(counts == 5000, 4, 6).astype(np.uint8)
    frame = Frame("two", counts, np.zeros((3, 40), np.uint8), 0.002, np.array([1.0, 0, -1]), np.zeros(3), 0.0, labels)
    made = counts[1:2].copy()
    made[:, 20:] -= 500
    parts = Prediction(Truth(frame, RULES), made, np.zeros_like(made, np.uint8)).by_surface()
    assert {label: (part.ghost_share, part.real_points) for label, part in parts.items()} == {4: (0, 20), 6: (1, 20)}
    assert parts[4].chamfer_m2 == 0
    assert parts[6].chamfer_m2 == pytest.approx(2, rel=1e-4)


def test_real_points_beyond_the_limits_do_not_count():
    generated, real = rows(5000), rows(5000)
    real[0][:, :180] = 100
    m = compare_rows(generated, real, RULES)
    assert m.mae_m == 0
    assert m.ghost_share > 0.4


def test_points_stand_where_their_rows_point():
    """The Chamfer distance of two shells, from points made by hand."""
    generated, real = rows(5000), rows(5500)
    m = compare_rows(generated, real, RULES)
    el, az = np.meshgrid(np.radians(RULES.row_elevation_deg[1:-1:2]), np.radians(np.arange(360) + 0.5), indexing="ij")
    unit = np.stack([np.cos(el) * np.cos(az), np.cos(el) * np.sin(az), np.sin(el)], -1).reshape(-1, 3)
    expected, _ = brute_chamfer(10 * unit[::7], 11 * unit)
    assert m.chamfer_m2 == pytest.approx(2 * 1.0, rel=0.01)
    assert expected == pytest.approx(2.0, rel=0.2)
