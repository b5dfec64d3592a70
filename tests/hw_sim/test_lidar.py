"""The simulated sensor against geometry worked out by hand, and against a slow caster that meets every primitive."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import pytest

from upbeam.hw_sim import (
    SCENE_KINDS,
    Ground,
    Lidar,
    LidarConfig,
    Material,
    Mover,
    PrimitiveSetBuilder,
    Scene,
    Shape,
    Surface,
    Trajectory,
    simulate_frames,
    simulate_parallel,
    street_scene,
)
from upbeam.hw_sim.raycast import GROUND, Rays, cast
from upbeam.model.beams import BeamTable, beam_table, uniform_beam_table

HDL64 = beam_table("hdl-64e")
VLP32 = beam_table("vlp-32c")
FLAT = uniform_beam_table(32, 2.0, -25.0, columns=512)
LEVEL = replace(FLAT, elevation_deg=np.linspace(0.31, -0.31, 32), name="level")


def ideal(beams: BeamTable, **more: object) -> LidarConfig:
    return LidarConfig(beams, **{"columns": 512, **more}).ideal()  # type: ignore[arg-type]


def wall_scene(distance: float, ego: Trajectory | None = None) -> Scene:
    """A long wall across the road, its face ``distance`` ahead of x = 0; no ground."""
    b = PrimitiveSetBuilder()
    b.box(Material.WALL, (distance, -400.0, -50.0), (distance + 1.0, 400.0, 50.0))
    return Scene(None, ego or Trajectory.arc(), b.build())


def box_scene(x: float, y: float, size: float = 1.0) -> Scene:
    b = PrimitiveSetBuilder()
    b.box(Material.WALL, (x - size, y - size, 0.0), (x + size, y + size, 6.0))
    return Scene(None, Trajectory.arc(), b.build())


# --- geometry ------------------------------------------------------------------------------------------------------


def test_flat_ground_is_height_over_sine() -> None:
    config = ideal(HDL64, max_range_m=100.0)
    scan = Lidar(config, Scene(Ground())).scan(0)
    down = HDL64.elevation_deg < -1.2
    height = config.sensor_height_m + HDL64.vertical_offset_m
    expected = height / np.sin(np.radians(-HDL64.elevation_deg))
    got = scan.distance_m()
    np.testing.assert_allclose(got[down], np.repeat(expected[down, None], 512, axis=1), rtol=2e-5, atol=0.0011)
    assert not got[HDL64.elevation_deg > 0].any()
    assert (scan.surface[down] == Surface.GROUND).all()


def test_range_from_origin_is_the_norm_of_the_point() -> None:
    near = Lidar(ideal(HDL64), Scene(Ground())).scan(0)
    origin = Lidar(ideal(HDL64, range_from_origin=True), Scene(Ground())).scan(0)
    norm = np.linalg.norm(near.points()[:, :3], axis=1)
    keep = (near.distance > 0) & (origin.distance > 0)
    assert keep.sum() > 20000
    np.testing.assert_allclose(origin.distance_m()[keep], norm[keep[near.distance > 0]], atol=0.0025)
    np.testing.assert_allclose(origin.points()[:200, 2], -1.73, atol=0.01)
    np.testing.assert_allclose(near.points()[-200:, 2], -1.73, atol=0.01)


def test_wall_ahead_is_where_geometry_says() -> None:
    scan = Lidar(ideal(FLAT), wall_scene(20.0)).scan(0)
    azimuth, elevation = np.radians(scan.azimuth_deg()), np.radians(FLAT.elevation_deg)[:, None]
    ahead = np.cos(azimuth) > 0.3
    expected = np.broadcast_to(20.0 / np.cos(azimuth) / np.cos(elevation), ahead.shape)
    np.testing.assert_allclose(scan.distance_m()[ahead], expected[ahead], atol=0.0025)
    assert not scan.distance[np.cos(azimuth) < 0].any()


@pytest.mark.parametrize(("x", "y", "azimuth"), [(0, 15, 270), (0, -15, 90), (15, 0, 0), (-15, 0.0, 180)])
def test_azimuth_runs_clockwise_from_the_cut(x: float, y: float, azimuth: float) -> None:
    scan = Lidar(ideal(LEVEL), box_scene(x, y)).scan(0)
    columns = np.flatnonzero(scan.distance[16] > 0)
    seen = np.degrees(np.angle(np.exp(1j * np.radians((columns + 0.5) * 360 / 512 + 180 - azimuth)).mean()))
    assert abs(seen) < 0.8
    assert len(columns) == pytest.approx(2 * np.degrees(np.arctan(1 / 14)) * 512 / 360, abs=2)
    if y > 0:  # On the left: 90 degrees clockwise of the cut behind the vehicle.
        assert abs(columns.mean() - 512 / 4) < 1


def test_points_are_where_things_stand() -> None:
    points = Lidar(ideal(VLP32), box_scene(9.0, 12.0)).scan(0).points()
    assert len(points) > 20
    assert np.all(np.abs(points[:, 0] - 9) < 1.01)
    assert np.all(np.abs(points[:, 1] - 12) < 1.01)


def test_solids_at_right_angles() -> None:
    b = PrimitiveSetBuilder()
    b.pole(Material.METAL, 10.0, 0.0, 0.5, 0.0, 4.0)
    b.add(Shape.ELLIPSOID, Material.PLAIN, (0.0, 10.0, 1.73), (2.0, 1.5, 1.0))
    b.add(Shape.BOX, Material.PLAIN, (0.0, -10.0, 1.73), (1.0, 2.0, 1.0), taper=(0.0, 0.5))
    scan = Lidar(ideal(LEVEL, columns=2048), Scene(None, Trajectory.arc(), b.build())).scan(0)
    got = scan.distance_m()[15:17].mean(axis=0)
    for azimuth, expected in ((0, 9.5), (270, 8.5), (90, 8.0)):
        column = int(((azimuth - 180) % 360) * 2048 / 360)
        assert got[column] == pytest.approx(expected, abs=0.012)


# --- columns, offsets, time ----------------------------------------------------------------------------------------


def test_firing_columns_shift_by_the_offset_and_aligned_undoes_it() -> None:
    scene = box_scene(14.0, 3.0, 1.5)
    table = replace(VLP32, elevation_deg=LEVEL.elevation_deg)
    firing = Lidar(ideal(table, align=False, columns=1024), scene).scan(0)
    direct = Lidar(ideal(table, align=True, columns=1024), scene).scan(0)
    shift = table.column_offsets(1024)
    for beam in range(32):
        at = np.flatnonzero(firing.distance[beam]).mean() - np.flatnonzero(direct.distance[beam]).mean()
        assert at == pytest.approx(-shift[beam], abs=1.0)
    back = firing.aligned()
    assert back.alignment == "azimuth"
    assert back.aligned() is back
    both = (back.distance > 0) & (direct.distance > 0)
    assert both.sum() > 0.97 * (direct.distance > 0).sum()
    # Whole columns leave up to half a column of azimuth error: 0.18 degrees, 4 cm on the box's slanted side.
    assert np.median(np.abs(back.distance_m()[both] - direct.distance_m()[both])) < 0.02


def test_moving_vehicle_skews_a_static_wall() -> None:
    speed, rate = 20.0, 10.0
    scan = Lidar(ideal(LEVEL, rate_hz=rate), wall_scene(60.0, Trajectory.arc(speed))).scan(3)
    azimuth = np.radians(scan.azimuth_deg()[16])
    ahead = np.cos(azimuth) > 0.7
    seconds = 3 / rate + (np.arange(512) + 0.5) / 512 / rate
    expected = (60.0 - speed * seconds) / np.cos(azimuth)
    np.testing.assert_allclose(scan.distance_m()[16][ahead], expected[ahead], atol=0.02)


def test_turning_vehicle_sees_a_pole_earlier() -> None:
    rate = 10.0
    still = Lidar(ideal(LEVEL, columns=2048, rate_hz=rate), box_scene(0.0, 15.0)).scan(0)
    scene = replace(box_scene(0.0, 15.0), ego=Trajectory.arc(0.0, 0.5))
    turning = Lidar(ideal(LEVEL, columns=2048, rate_hz=rate), scene).scan(0)
    moved = np.flatnonzero(turning.distance[16]).mean() - np.flatnonzero(still.distance[16]).mean()
    # A quarter turn takes 25 ms; 0.0125 rad to the left brings the box that much clockwise.
    assert moved == pytest.approx(0.5 * 0.025 / (2 * np.pi) * 2048, abs=1.0)


def test_moving_object_is_measured_where_it_is_then() -> None:
    b = PrimitiveSetBuilder()
    b.box(Material.WALL, (-1.0, -1.0, -9.0), (1.0, 1.0, 9.0))
    scene = Scene(None, Trajectory.arc(), movers=(Mover(b.build(), 30.0, 0.0, -10.0),))
    for frame in (0, 7):
        scan = Lidar(ideal(LEVEL, rate_hz=10.0), scene).scan(frame)
        expected = 29.0 - 10.0 * (frame + 0.5) / 10.0
        assert scan.distance_m()[16, 256] == pytest.approx(expected, abs=0.03)


# --- the fast caster against a slow one ----------------------------------------------------------------------------


def _slow_depth(rays: Rays, scene_ground: Ground, primitives, max_range: float, beam: int, column: int) -> float:
    """First hit of one ray by marching along it: inside any solid, or below the ground."""
    t = np.arange(0.3, max_range, 0.01)
    o = np.array([rays.ox[beam, column], rays.oy[beam, column], rays.oz[beam, column]], dtype=np.float64)
    d = np.array([rays.dx[beam, column], rays.dy[beam, column], rays.dz[beam, column]], dtype=np.float64)
    x, y, z = (o[:, None] + d[:, None] * t).reshape(3, -1)
    lateral = np.abs(y - scene_ground.centre_line(x))
    raised = (lateral > scene_ground.road_half_width) & ~scene_ground.in_crossing(x)
    inside = z < scene_ground.height(x, y) + np.where(raised, scene_ground.kerb_height, 0.0)
    for i in np.flatnonzero(primitives.density == 0):
        c, s = np.cos(primitives.yaw[i]), np.sin(primitives.yaw[i])
        at = primitives.centre[i] + np.outer(t * 0 + rays.time[beam, column], primitives.velocity[i])
        qx, qy, qz = x - at[:, 0], y - at[:, 1], z - at[:, 2]
        hx, hy, hz = primitives.half[i]
        px, py, pz = (c * qx + s * qy) / hx, (c * qy - s * qx) / hy, qz / hz
        if primitives.shape[i] == Shape.BOX:
            kx, ky = primitives.taper[i]
            inside |= (np.abs(pz) < 1) & (np.abs(px) + kx * pz < 1) & (np.abs(py) + ky * pz < 1)
        elif primitives.shape[i] == Shape.CYLINDER:
            inside |= (np.abs(pz) < 1) & (px**2 + py**2 < 1)
        else:
            inside |= px**2 + py**2 + pz**2 < 1
    first = np.argmax(inside)
    return float(t[first]) if inside[first] else np.inf


def _cast_inputs(kind: str, align: bool, frame: int, table: BeamTable = HDL64, columns: int = 256):  # type: ignore[no-untyped-def]
    config = LidarConfig(table, columns=columns, align=align, rate_hz=10.0)
    scene = street_scene(kind, 5, seconds=5.0)
    lidar = Lidar(config, scene)
    middle = (frame + 0.5) / config.rate_hz
    rays, ground, (x, y, z) = lidar._rays(middle)
    found = scene.primitives(middle, x, y, 125.0)
    return rays, ground, replace(found, centre=found.centre - np.array([x, y, z]))


@pytest.mark.parametrize("kind", SCENE_KINDS)
@pytest.mark.parametrize("align", [True, False])
def test_windows_lose_no_hit(kind: str, align: bool) -> None:
    for frame in (0, 21):
        rays, ground, found = _cast_inputs(kind, align, frame)
        chance = np.random.default_rng(0).random(rays.shape, dtype=np.float32)
        fast, fast_hit = cast(rays, ground, found, chance, 120.0)
        slow, slow_hit = cast(rays, ground, found, chance, 120.0, windows=False)
        np.testing.assert_array_equal(fast, slow)
        assert (fast_hit != slow_hit).sum() <= 4  # equal depths may name either primitive
        assert (fast_hit > GROUND).any()


def test_windows_lose_no_hit_at_odd_widths() -> None:
    rays, ground, found = _cast_inputs("city", False, 3, VLP32, 1085)
    chance = np.random.default_rng(0).random(rays.shape, dtype=np.float32)
    np.testing.assert_array_equal(
        cast(rays, ground, found, chance, 120.0)[0], cast(rays, ground, found, chance, 120.0, windows=False)[0]
    )


@pytest.mark.parametrize("kind", SCENE_KINDS)
def test_caster_agrees_with_marching(kind: str) -> None:
    rays, ground, found = _cast_inputs(kind, True, 4)
    solid = found[found.density == 0]
    solid = solid[np.hypot(solid.centre[:, 0], solid.centre[:, 1]) < 45]
    depth, _ = cast(rays, ground, solid, np.zeros(rays.shape, np.float32), 40.0)
    rng = np.random.default_rng(1)
    picks = [(int(rng.integers(8, 64)), int(rng.integers(256))) for _ in range(60)]
    want = np.array([_slow_depth(rays, ground, solid, 40.0, b, c) for b, c in picks])
    got = np.array([depth[b, c] for b, c in picks])
    near = want < 39.5
    # Marching in steps of 1 cm misses thin corners; kerbs are built from two planes, not marched.
    close = np.abs(got[near] - want[near]) < 0.03 + 0.003 * want[near]
    assert close.mean() > 0.95, list(
        zip(np.array(picks)[near][~close], got[near][~close], want[near][~close], strict=True)
    )


# --- errors of the sensor ------------------------------------------------------------------------------------------


def test_noise_has_the_stated_size_and_bias_stays() -> None:
    config = replace(ideal(LEVEL), range_noise_m=0.02, beam_bias_m=0.05, seed=3)
    lidar = Lidar(config, wall_scene(20.0))
    truth = Lidar(ideal(LEVEL), wall_scene(20.0)).scan(0).distance_m()[:, 200:312]
    error = np.stack([lidar.scan(k).distance_m()[:, 200:312] - truth for k in range(3)])
    assert error.std(axis=2).mean() == pytest.approx(0.02, rel=0.1)
    bias = error.mean(axis=2)
    np.testing.assert_allclose(bias[0], bias[1], atol=0.01)
    assert 0.02 < bias[0].std() < 0.09


def test_losses_grow_with_range_and_with_grazing() -> None:
    config = replace(ideal(LEVEL), dropout_weak=1.0, dropout=0.02)
    share = [(Lidar(config, wall_scene(d)).scan(0).distance[:, 248:264] > 0).mean() for d in (10.0, 60.0, 110.0)]
    assert share[0] > 0.94
    assert share[0] > share[1] + 0.05 > share[2]
    ground = Lidar(replace(config, beams=HDL64), Scene(Ground())).scan(0).distance > 0
    fill = ground.mean(axis=1)
    assert fill[40:].mean() > 0.96
    assert fill[9] < fill[40:].mean() - 0.05


def test_counts_stay_in_bounds_and_overflow_is_counted() -> None:
    far = Lidar(replace(ideal(LEVEL), max_range_m=500.0, distance_unit_m=0.002), wall_scene(140.0)).scan(0)
    assert far.overflow > 0
    assert not far.distance[16, 256]
    coarse = Lidar(replace(ideal(LEVEL), max_range_m=500.0, distance_unit_m=0.004), wall_scene(140.0)).scan(0)
    assert int(coarse.distance[16, 256]) == pytest.approx(35000, abs=3)
    scan = next(iter(simulate_frames(HDL64, columns=512, frames=1, seed=1)))
    assert scan.distance.dtype == np.uint16
    assert scan.intensity.dtype == np.uint8
    metres = scan.distance_m()[scan.distance > 0]
    assert metres.min() >= 0.99
    assert metres.max() <= 120.5
    assert not scan.intensity[scan.distance == 0].any()
    assert not scan.surface[scan.distance == 0].any()
    assert (scan.surface[scan.distance > 0] > 0).all()


def test_mixed_pixels_lie_between_close_surfaces() -> None:
    b = PrimitiveSetBuilder()
    b.box(Material.WALL, (10.0, -3.0, -9.0), (10.5, 3.0, 9.0))
    b.box(Material.WALL, (11.5, -30.0, -9.0), (12.0, 30.0, 9.0))
    scene = Scene(None, Trajectory.arc(), b.build())
    clean = Lidar(ideal(LEVEL), scene).scan(0)
    mixed = Lidar(replace(ideal(LEVEL), mixed_pixels=1.0), scene).scan(0)
    changed = clean.distance != mixed.distance
    assert 32 <= changed.sum() <= 4 * 32
    assert (mixed.distance_m()[changed] > 10).all()


# --- streams -------------------------------------------------------------------------------------------------------


def test_frames_depend_on_seed_and_index_alone() -> None:
    settings = {"columns": 256, "frames": 4, "rate_hz": 20.0}
    first = list(simulate_frames(VLP32, seed=11, **settings))  # type: ignore[arg-type]
    again = list(simulate_frames(VLP32, seed=11, **settings))  # type: ignore[arg-type]
    other = list(simulate_frames(VLP32, seed=12, **settings))  # type: ignore[arg-type]
    scene = street_scene("city", 4)
    lidar = Lidar(LidarConfig(VLP32, columns=256), scene)
    backwards = [lidar.scan(k) for k in (2, 1, 0)][::-1]
    forwards = [Lidar(LidarConfig(VLP32, columns=256), scene).scan(k) for k in range(3)]
    for a, b in [*zip(first, again, strict=True), *zip(backwards, forwards, strict=True)]:
        for plane in ("distance", "intensity", "surface"):
            np.testing.assert_array_equal(getattr(a, plane), getattr(b, plane))
    assert (first[0].distance != other[0].distance).mean() > 0.5
    assert [s.time_s for s in first] == pytest.approx([0, 0.05, 0.1, 0.15])


def test_parallel_gives_the_same_scans_in_order() -> None:
    settings = {"columns": 128, "frames": 11, "seed": 5, "frames_per_scene": 2}
    one = list(simulate_frames(VLP32, **settings))  # type: ignore[arg-type]
    many = list(simulate_parallel(VLP32, workers=2, **settings))  # type: ignore[arg-type]
    assert len(many) == 11
    for a, b in zip(one, many, strict=True):
        np.testing.assert_array_equal(a.distance, b.distance)
        np.testing.assert_array_equal(a.intensity, b.intensity)


def test_a_drive_lasts_thirty_seconds_among_things() -> None:
    frames = 600
    scene = street_scene("city", 9, seconds=frames / 20 + 1)
    lidar = Lidar(LidarConfig(FLAT, columns=128), scene)
    for frame in (0, 300, 599):
        scan = lidar.scan(frame)
        assert (scan.surface > Surface.GROUND).mean() > 0.05
        assert (scan.distance > 0).mean() > 0.5


@pytest.mark.parametrize("kind", SCENE_KINDS)
def test_streets_hold_what_streets_hold(kind: str) -> None:
    scans = list(simulate_frames(HDL64, columns=512, frames=3, frames_per_scene=1, seed=2, scene=kind))
    seen = np.unique(np.concatenate([s.surface.ravel() for s in scans]))
    assert {Surface.NONE, Surface.GROUND, Surface.VEGETATION} <= set(seen.tolist())
    assert all(0.5 < (s.distance > 0).mean() < 0.97 for s in scans)


def test_bad_arguments_are_named() -> None:
    with pytest.raises(ValueError, match="columns = 3"):
        LidarConfig(FLAT, columns=3)
    with pytest.raises(ValueError, match="dropout = 2"):
        LidarConfig(FLAT, dropout=2)
    with pytest.raises(ValueError, match="no scene kind 'moon'"):
        simulate_frames(FLAT, frames=1, scene="moon")
    with pytest.raises(ValueError, match="frames_per_scene 0"):
        simulate_frames(FLAT, frames=1, frames_per_scene=0)
    with pytest.raises(ValueError, match="no scene kind"):
        street_scene("moon", 0)
    with pytest.raises(ValueError, match="frame index -1"):
        Lidar(LidarConfig(FLAT), Scene()).scan(-1)
    with pytest.raises(ValueError, match="must all be > 0"):
        PrimitiveSetBuilder().box(Material.WALL, (0, 0, 0), (1, 0, 1))


def test_speed_is_reported() -> None:
    begin = time.process_time()
    count = sum(1 for _ in simulate_frames(HDL64, frames=6, frames_per_scene=3, seed=1))
    spent = time.process_time() - begin
    print(f"simulator, measured: {count / spent:.1f} frames of 64 x 2048 per second of CPU time, streets included")
