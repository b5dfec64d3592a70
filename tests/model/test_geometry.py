"""Points and range images: the convention, its extremes, and real frames."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from upbeam.model.beams import beam_table
from upbeam.model.geometry import (
    GeometryError,
    azimuth_deg,
    bin_elevation,
    column_of,
    elevation_deg,
    project,
    recover_rings,
    to_counts,
    to_metres,
    to_points,
)

CUTS = st.one_of(st.sampled_from([0.0, 180.0, 359.999, -90.0, 1e-12]), st.floats(-720, 720))
UNITS = st.sampled_from([0.0001, 0.002, 0.004, 0.1])


def one_point(x: float, y: float, z: float, intensity: float = 0.5) -> np.ndarray:
    return np.array([[x, y, z, intensity]], dtype=np.float32)


def slow_project(points, rows, beams, columns, unit, cut):
    """The convention, point by point, in Python's own arithmetic."""
    distance, index, best = np.zeros((beams, columns), int), np.full((beams, columns), -1), {}
    for i, (x, y, z, _) in enumerate(points.astype(float).tolist()):
        r = np.sqrt(x * x + y * y + z * z)
        count = int(np.floor(r / unit + 0.5))
        if rows[i] < 0 or not 0 < count <= 65535:
            continue
        azimuth = -np.degrees(np.arctan2(y, x)) % 360.0 % 360.0
        column = int((azimuth - cut) % 360.0 * columns / 360.0) % columns
        pixel = (rows[i], column)
        if r < best.get(pixel, np.inf):
            best[pixel], distance[pixel], index[pixel] = r, count, i
    return distance, index


# ---------------------------------------------------------------------------------------------------- the convention


@pytest.mark.parametrize(
    ("x", "y", "azimuth"),
    [(1, 0, 0), (1, -1, 45), (0, -1, 90), (-1, -1, 135), (-1, 0, 180), (-1, -0.0, 180), (0, 1, 270), (1, 1, 315)],
)
def test_azimuth_is_clockwise_from_ahead(x, y, azimuth):
    assert azimuth_deg(one_point(x, y, 3))[0] == azimuth


@pytest.mark.parametrize(("z", "elevation"), [(0, 0), (1, 45), (-1, -45), (1e30, 90), (-1e30, -90)])
def test_elevation_is_above_the_horizon(z, elevation):
    assert elevation_deg(one_point(0.6, -0.8, z))[0] == pytest.approx(elevation, abs=1e-5)
    assert elevation_deg(one_point(0, 0, 0))[0] == 0


def test_columns_run_clockwise_from_the_cut():
    behind_left, behind_right = one_point(-1, 0.001, 0), one_point(-1, -0.001, 0)
    assert column_of(azimuth_deg(behind_left), 2048).tolist() == [0]
    assert column_of(azimuth_deg(behind_right), 2048).tolist() == [2047]
    assert column_of([0, 90, 180, 270, 359.9], 4, cut_deg=0).tolist() == [0, 1, 2, 3, 3]
    assert column_of([180, 269.9, 270, 0, 179.9], 4).tolist() == [0, 0, 1, 2, 3]


def test_a_whole_turn_reached_by_rounding_is_the_seam():
    assert azimuth_deg(one_point(1, 1e-30, 0))[0] == 0.0
    assert np.mod(-1e-20, 360.0) == 360.0  # what the guards are for
    assert column_of([-1e-20, 360.0, 720.0, np.nextafter(360, 0)], 65535, cut_deg=0).tolist() == [0, 0, 0, 65534]
    just_before = np.nextafter(180.0, 0)
    assert column_of([just_before], 7, cut_deg=180.0)[0] in {0, 6}


@given(azimuth=st.floats(-1e4, 1e4), columns=st.integers(4, 65535), cut=CUTS)
@example(azimuth=-5e-324, columns=4, cut=0.0)
def test_columns_are_within_the_turn(azimuth, columns, cut):
    assert 0 <= column_of([azimuth], columns, cut)[0] < columns


@given(columns=st.integers(4, 65535), cut=CUTS)
def test_column_middles_are_in_their_columns(columns, cut):
    middles = cut + (np.arange(columns) + 0.5) * 360 / columns
    assert np.array_equal(column_of(middles % 360, columns, cut), np.arange(columns))


def test_the_paper_s_equations_2_to_4_are_this_convention_turned_by_90_degrees(rng):
    points = rng.normal(size=(100, 4)).astype(np.float32)
    r = np.linalg.norm(points[:, :3].astype(float), axis=1)
    phi, theta = np.radians(azimuth_deg(points) + 90), np.radians(elevation_deg(points))
    # Eq. (2) and (3) with the paper's x and y: from y towards x, so its sine and cosine stand the other way round.
    x, y = r * np.cos(theta) * np.sin(phi), r * np.cos(theta) * np.cos(phi)
    assert np.allclose(np.c_[x, y, r * np.sin(theta)], points[:, :3], atol=1e-6)


# ------------------------------------------------------------------------------------------------------------- counts


def test_counts_round_half_up_and_count_what_is_beyond():
    counts, beyond = to_counts(np.array([0, 0.0009, 0.001, 0.003, 131.07, 131.0709, 131.0711, 1e30]), 0.002)
    assert counts.tolist() == [0, 0, 1, 2, 65535, 65535, 0, 0]
    assert counts.dtype == np.uint16
    assert beyond == 2


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, -1e-9])
def test_counts_name_the_distance_that_is_none(bad):
    distances = np.ones((3, 5), dtype=np.float32)
    distances[2, 1] = bad
    with pytest.raises(GeometryError, match=r"distance \(2, 1\) is .*: expected finite metres, 0 or more"):
        to_counts(distances, 0.002)


@pytest.mark.parametrize("unit", [0, -0.002, np.nan, np.inf, 0.2, 1e-5])
def test_counts_refuse_a_unit_that_is_none(unit):
    with pytest.raises(GeometryError, match="distance_unit_m"):
        to_counts([1.0], unit)


@given(unit=UNITS)
def test_metres_of_every_count_give_the_count_again(unit):
    counts = np.arange(65536, dtype=np.uint16)
    again, beyond = to_counts(to_metres(counts, unit), unit)
    assert np.array_equal(again, counts)
    assert beyond == 0


# --------------------------------------------------------------------------------------------------------- projection


def test_the_nearest_return_wins_and_of_equals_the_first():
    points = np.array([[9, 0, 0, 0.1], [5, 0, 0, 0.2], [5, 0, 0, 0.3], [7, 0, 0, 0.4]], dtype=np.float32)
    image = project(points, np.zeros(4, int), 2, 8, 0.002)
    assert image.index[0].tolist() == [-1, -1, -1, -1, 1, -1, -1, -1]
    assert image.distance[0, 4] == 2500
    assert image.intensity[0, 4] == 51
    assert image.metres()[0, 4] == np.float32(5)
    assert image.stats.collisions == 3
    assert image.fill == pytest.approx(1 / 16)


def test_every_point_is_counted_once():
    points = np.array(
        [[0, 0, 0, 0], [200, 0, 0, 1], [1, 0, 0, 1], [2, 0, 0, 1], [0, 1, 0, 1], [200, 0, 0, 1]], dtype=np.float32
    )
    stats = project(points, np.array([0, 0, 0, 0, -1, -1]), 1, 4, 0.002).stats
    assert (stats.no_return, stats.beyond_count_range, stats.collisions, stats.outside) == (1, 1, 1, 2)
    assert stats.empty_share == 0.75


def test_the_farthest_count_is_a_return_and_the_next_is_none():
    points = np.array([[131.07, 0, 0, 1], [-131.0711, 0, 0, 1]], dtype=np.float32)
    image = project(points, np.zeros(2, int), 1, 4, 0.002)
    assert image.distance.tolist() == [[0, 0, 65535, 0]]
    assert image.stats.beyond_count_range == 1


def test_an_empty_cloud_is_an_empty_image():
    image = project(np.empty((0, 4), np.float32), np.empty(0, int), 32, 1024, 0.002)
    assert not image.distance.any()
    assert (image.index == -1).all()
    assert image.stats.empty_share == 1.0


@settings(max_examples=60)
@given(seed=st.integers(0, 2**32), columns=st.sampled_from([4, 5, 17, 360]), cut=CUTS, unit=UNITS)
def test_projection_is_the_convention_point_by_point(seed, columns, cut, unit):
    rng = np.random.default_rng(seed)
    points = np.c_[rng.normal(size=(200, 3)) * unit * 30000, rng.random(200)].astype(np.float32)
    points[:20, :3] = np.round(points[:20, :3])  # ties and zeros
    rows = rng.integers(-1, 3, 200)
    image = project(points, rows, 3, columns, unit, cut)
    distance, index = slow_project(points, rows, 3, columns, unit, cut)
    assert np.array_equal(image.distance, distance)
    assert np.array_equal(image.index, index)
    won = image.index >= 0
    assert np.array_equal(image.intensity[won], np.floor(points[image.index[won], 3].astype(float) * 255 + 0.5))
    stats = image.stats
    parts = stats.collisions + stats.beyond_count_range + stats.no_return + stats.outside
    assert stats.points == 200 == won.sum() + parts


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"points": np.full((2, 4), np.nan, np.float32)}, r"point 0 is \[nan nan nan\]: expected finite"),
        ({"points": np.array([[1, 0, 0, 1], [1, 0, 0, 1.01]], np.float32)}, "intensity of point 1 is 1.0"),
        ({"points": np.array([[1, 0, 0, 1], [1, 0, 0, np.nan]], np.float32)}, "intensity of point 1 is nan"),
        ({"points": np.ones((2, 3), np.float32)}, "3 columns: expected 4"),
        ({"points": np.ones((2, 4), np.int32)}, "expected floating point"),
        ({"rows": np.array([0, 2])}, "row of point 1 is 2: expected -1 to 1"),
        ({"rows": np.array([-2, 0])}, "row of point 0 is -2"),
        ({"rows": np.array([0.0, 1.0])}, "expected 2 whole numbers"),
        ({"rows": np.array([0])}, "expected 2 whole numbers"),
        ({"beams": 0}, "beams is 0"),
        ({"columns": 3}, "3 columns: expected 4 to 65535"),
        ({"distance_unit_m": 0}, "distance_unit_m is 0"),
        ({"cut_deg": np.nan}, "cut_deg is nan"),
        ({"vertical_offset_m": [0.0]}, "vertical_offset_m has shape"),
    ],
)
def test_what_cannot_be_projected_is_named(change, match):
    good = {"points": np.ones((2, 4), np.float32), "rows": np.array([0, 1]), "beams": 2, "columns": 4}
    project(**good, distance_unit_m=0.002)
    with pytest.raises(GeometryError, match=match):
        project(**{"distance_unit_m": 0.002, **good, **change})


# --------------------------------------------------------------------------------------------------------- round trip


@st.composite
def images(draw):
    """A range image of any width, with extremes, and all that is needed to make points of it."""
    beams = draw(st.integers(1, 5))
    columns = draw(st.one_of(st.sampled_from([4, 1024, 2048, 4096]), st.integers(4, 4096)))
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    distance = rng.choice([0, 1, 2, 65534, 65535, *rng.integers(0, 65536, 60)], (beams, columns)).astype(np.uint16)
    intensity = rng.integers(0, 256, (beams, columns)).astype(np.uint8)
    intensity[distance == 0] = 0
    return {
        "distance_counts": distance,
        "intensity": intensity,
        "elevation_deg": draw(st.lists(st.floats(-90, 90), min_size=beams, max_size=beams)),
        "distance_unit_m": draw(UNITS),
        "cut_deg": draw(CUTS),
        "vertical_offset_m": draw(st.none() | st.lists(st.floats(-0.5, 0.5), min_size=beams, max_size=beams)),
    }


@given(image=images())
def test_project_undoes_to_points(image):
    points, rows, columns = to_points(**image)
    beams, width = image["distance_counts"].shape
    again = project(points, rows, beams, width, image["distance_unit_m"], image["cut_deg"], image["vertical_offset_m"])
    assert points.dtype == np.float32
    assert np.array_equal(again.distance, image["distance_counts"])
    assert np.array_equal(again.intensity, image["intensity"])
    assert again.stats.collisions == again.stats.no_return == again.stats.beyond_count_range == 0
    assert np.array_equal(again.index[rows, columns], np.arange(len(points)))  # row by row
    assert np.all(np.diff(rows * width + columns) > 0)


def test_points_stand_where_the_row_and_column_point():
    distance = np.zeros((2, 4), np.uint16)
    distance[1, 2] = 5000
    points, rows, columns = to_points(distance, np.full((2, 4), 255, np.uint8), [10, -30], 0.002, 0.0, [0.0, 0.25])
    assert (rows.tolist(), columns.tolist()) == ([1], [2])
    side = 10 * np.cos(np.radians(30)) * np.sqrt(0.5)
    assert points[0] == pytest.approx([-side, side, -5 + 0.25, 1.0])  # azimuth 225: behind, left


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"intensity": np.zeros((2, 5), np.uint8)}, "both alike"),
        ({"distance_counts": np.zeros((2, 4), np.float32)}, "expected uint16 counts"),
        ({"elevation_deg": [1.0]}, "elevation_deg has shape"),
        ({"elevation_deg": [1.0, np.nan]}, "expected 2 finite numbers"),
    ],
)
def test_an_image_that_is_none_is_named(change, match):
    image = {"distance_counts": np.zeros((2, 4), np.uint16), "intensity": np.zeros((2, 4), np.uint8)}
    with pytest.raises(GeometryError, match=match):
        to_points(**{**image, "elevation_deg": [1.0, 0.0], "distance_unit_m": 0.002, **change})


# --------------------------------------------------------------------------------------------------------------- rows


def sweep(rings: int, points_per_ring: int) -> np.ndarray:
    """A cloud in KITTI's file order: counter-clockwise, from just past ahead."""
    angle = np.tile(np.radians((np.arange(points_per_ring) + 0.5) * 360 / points_per_ring), rings)
    return np.c_[np.cos(angle), np.sin(angle), np.zeros_like(angle), np.zeros_like(angle)].astype(np.float32)


@given(rings=st.integers(1, 64), points=st.integers(3, 50))
def test_rings_come_back_from_the_file_order(rings, points):
    assert np.array_equal(recover_rings(sweep(rings, points), rings), np.repeat(np.arange(rings), points))


def test_a_cloud_with_other_rings_is_refused():
    with pytest.raises(GeometryError, match="make 63 rings, expected 64"):
        recover_rings(sweep(63, 20))
    with pytest.raises(GeometryError, match="0 points in file order make 0 rings, expected 64"):
        recover_rings(np.empty((0, 4), np.float32))


def test_bins_are_uniform_in_elevation():
    def at(elevation):
        return one_point(np.cos(np.radians(elevation)), 0, np.sin(np.radians(elevation)))

    assert [bin_elevation(at(e), 2.0, -2.0, 4)[0] for e in (2.1, 1.9, 0.5, -0.5, -1.9, -2.1)] == [-1, 0, 1, 2, 3, -1]
    with pytest.raises(GeometryError, match="top > bottom"):
        bin_elevation(at(0), -3.0, 2.0)


def test_uniform_bins_share_and_leave_rows():
    elevation = np.radians(beam_table("hdl-64e").elevation_deg)
    beams = np.c_[np.cos(elevation), 0 * elevation, np.sin(elevation)]
    row = bin_elevation(beams)
    used, beams_in_row = np.unique(row[row >= 0], return_counts=True)
    assert np.count_nonzero(row < 0) == 1
    assert 64 - len(used) == 7
    assert (np.count_nonzero(beams_in_row > 1), beams_in_row[beams_in_row > 1].sum()) == (6, 12)


# -------------------------------------------------------------------------------------------------------- real frames


@pytest.fixture(scope="module")
def frames(data_dir: Path) -> dict[str, np.ndarray]:
    files = sorted((data_dir / "kitti").glob("frames/*.bin")) + sorted((data_dir / "kitti").glob("sequence/*.bin"))
    assert len(files) >= 30, f"only {len(files)} frames in {data_dir}"
    return {file.stem: np.fromfile(file, dtype="<f4").reshape(-1, 4) for file in files}


def test_every_real_frame_has_64_rings_that_point_where_the_sensor_s_lasers_do(frames):
    table = beam_table("hdl-64e")
    off = []
    for points in frames.values():
        ring = recover_rings(points)
        assert np.all(np.bincount(ring, minlength=64) > 100)
        lowered = points[:, :3].astype(float)
        lowered[:, 2] -= table.vertical_offset_m[ring]
        elevation = elevation_deg(lowered)
        off.append([np.median(elevation[ring == k]) - table.elevation_deg[k] for k in range(64)])
    print(f"\nelevation of a ring less its laser's: {np.min(off):+.3f} to {np.max(off):+.3f} degrees (measured)")
    assert np.max(np.abs(off)) < 0.15  # beams are 0.25 to 0.68 degrees apart


def test_rings_fill_more_of_a_real_image_than_elevation_bins(frames):
    rings, bins = [], []
    for points in frames.values():
        by_ring = project(points, recover_rings(points), 64, 2048, 0.002)
        by_bin = project(points, bin_elevation(points), 64, 2048, 0.002)
        assert by_ring.stats.outside == by_ring.stats.no_return == by_ring.stats.beyond_count_range == 0
        rings.append(by_ring.fill)
        bins.append(by_bin.fill)
    print(f"\nfill of {len(frames)} frames at 2048 columns: rings {np.mean(rings):.3f}, bins {np.mean(bins):.3f}")
    assert np.min(np.subtract(rings, bins)) > 0.08
    assert np.mean(rings) == pytest.approx(0.82, abs=0.02)
    assert np.mean(bins) == pytest.approx(0.70, abs=0.02)


def test_a_real_image_survives_the_way_through_points(frames):
    points = next(iter(frames.values()))
    image = project(points, recover_rings(points), 64, 2048, 0.002)
    elevation = beam_table("hdl-64e").elevation_deg
    again = project(*to_points(image.distance, image.intensity, elevation, 0.002)[:2], 64, 2048, 0.002)
    assert np.array_equal(again.distance, image.distance)
    assert np.array_equal(again.intensity, image.intensity)
    won = image.index[image.index >= 0]
    assert len(np.unique(won)) == len(won) == len(points) - image.stats.collisions


def test_projection_time_of_a_real_frame(frames):
    points = max(frames.values(), key=len)
    ring = recover_rings(points)
    times = []
    for _ in range(5):
        start = time.perf_counter()
        image = project(points, ring, 64, 2048, 0.002)
        times.append(time.perf_counter() - start)
    print(f"\nprojection of {len(points)} points: {min(times) * 1e3:.1f} ms (measured, best of 5)")
    assert image.stats.points == len(points)
