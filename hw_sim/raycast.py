"""Casts a turn's rays into a scene: each primitive meets only the rays of the window it can be seen in."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .ground import Ground
from .primitives import PrimitiveSet, Shape

__all__ = ["GROUND", "NOTHING", "Rays", "cast", "cast_ground", "intersect"]

F32 = NDArray[np.float32]
Array = NDArray[Any]

NOTHING = -2
GROUND = -1
_NEAREST_M = 1.0
"""Steps of the ground search begin here, in metres of horizontal distance."""


@dataclass(frozen=True)
class Rays:
    """One turn of laser shots, ``float32[beams, columns]``, in a frame whose origin is near the sensor's vehicle.

    A column here holds the shots whose azimuth, relative to the vehicle, lies within half a column of its centre.
    ``path`` and ``heading`` describe the vehicle during the turn for the window search: knots in time order.
    """

    ox: F32
    oy: F32
    oz: F32
    dx: F32
    dy: F32
    dz: F32
    time: F32
    """Seconds from the middle of the turn."""
    elevation_tan: NDArray[np.float64]
    """Tangent of the beams' elevations in the vehicle's frame, falling, [beams]."""
    path: NDArray[np.float64]
    """x, y of the vehicle at ``knots``, [K, 2]."""
    heading: NDArray[np.float64]
    """Yaw at ``knots``, [K]."""
    knots: NDArray[np.float64]
    """Seconds from the middle of the turn, [K], covering every shot."""
    tilt: tuple[float, float]
    """Slope of the vehicle's floor along world x and y."""
    cut_rad: float
    """Azimuth of the left edge of column 0, clockwise."""
    azimuth_slack_rad: float
    """How far a shot's azimuth may lie from its column's centre."""
    period_s: float

    @property
    def shape(self) -> tuple[int, int]:
        return (self.dx.shape[0], self.dx.shape[1])


def cast(
    rays: Rays,
    ground: Ground | None,
    primitives: PrimitiveSet,
    chance: F32,
    max_range_m: float,
    *,
    windows: bool = True,
) -> tuple[F32, NDArray[np.int32]]:
    """First hit of every ray.

    ``chance`` in (0, 1), ``float32[beams, columns]``, decides where rays stop in foliage. Returns the distance along
    the ray (inf = none) and the index of the primitive (``GROUND``, ``NOTHING``), both ``[beams, columns]``. With
    ``windows=False`` every primitive meets every ray: slow, the reference for tests.
    """
    depth = cast_ground(rays, ground, max_range_m) if ground is not None else np.full(rays.shape, np.inf, np.float32)
    hit = np.where(np.isfinite(depth), np.int32(GROUND), np.int32(NOTHING))
    if len(primitives) == 0:
        return depth, hit
    near, boxes = _windows(rays, primitives, max_range_m)
    if not windows:
        boxes = np.tile(np.array([0, rays.shape[0], 0, rays.shape[1]]), (len(primitives), 1))
        near = np.zeros(len(primitives))
    lists = _as_lists(primitives)
    columns = rays.shape[1]
    with np.errstate(all="ignore"):
        for i in np.argsort(near, kind="stable").tolist():
            r0, r1, c0, c1 = boxes[i].tolist()
            if r0 >= r1:
                continue
            for a, b in ((c0, min(c1, columns)), (0, c1 - columns)):
                if a < b:
                    _meet(rays, lists[i], i, near[i], (slice(r0, r1), slice(a, b)), chance, depth, hit)
    depth[depth > max_range_m] = np.inf
    hit[~np.isfinite(depth)] = NOTHING
    return depth, hit


_Row = tuple[int, float, list[float], list[float], list[float], list[float], float]


def _as_lists(p: PrimitiveSet) -> list[_Row]:
    return list(
        zip(
            p.shape.tolist(),
            p.yaw.tolist(),
            p.centre.tolist(),
            p.half.tolist(),
            p.taper.tolist(),
            p.velocity.tolist(),
            p.density.tolist(),
            strict=True,
        )
    )


def _meet(
    rays: Rays, row: _Row, index: int, near: float, window: tuple[slice, slice], chance: F32, depth: F32, hit: Array
) -> None:
    held = depth[window]
    if near > held.max():
        return
    t_in, t_out = intersect(rays, row, window)
    density = row[6]
    if density > 0:
        t_in = _stop_in_leaves(rays, t_in, t_out, chance[window], window, density, index)
    closer = (t_in < t_out) & (t_in > 0) & (t_in < held)
    np.copyto(held, t_in, where=closer)
    np.copyto(hit[window], np.int32(index), where=closer)


def _stop_in_leaves(
    rays: Rays, t_in: Array, t_out: Array, chance: Array, window: tuple[slice, slice], density: float, index: int
) -> Array:
    """Free path in leaves that stand in clumps about half a metre wide."""
    t_in = np.maximum(t_in, np.float32(0.3))
    x = rays.ox[window] + t_in * rays.dx[window]
    y = rays.oy[window] + t_in * rays.dy[window]
    z = rays.oz[window] + t_in * rays.dz[window]
    clump = np.sin(5.3 * x + 3.1 * z + index) * np.sin(4.7 * y - 2.3 * z) + 0.6 * np.sin(9.1 * z + 0.7 * index)
    u = chance + np.float32(0.618034 * (index % 1597) % 1.0)
    u -= np.floor(u)
    path = -np.log(np.maximum(u, np.float32(1e-6))) / np.float32(density)
    return np.asarray(t_in + path * np.exp(-1.4 * clump), dtype=np.float32)


def intersect(rays: Rays, row: _Row, window: tuple[slice, slice]) -> tuple[Array, Array]:
    """Where rays enter and leave one primitive, metres along the ray; enter >= leave where they miss."""
    shape, yaw, (cx, cy, cz), (hx, hy, hz), (kx, ky), (vx, vy, vz), _ = row
    c, s = float(np.cos(yaw)), float(np.sin(yaw))
    ox, oy, oz = rays.ox[window], rays.oy[window], rays.oz[window]
    if vx or vy or vz:
        t = rays.time[window]
        ox, oy, oz = ox - t * vx, oy - t * vy, oz - t * vz
    dx, dy = rays.dx[window], rays.dy[window]
    px = ox * (c / hx) + oy * (s / hx) - (cx * c + cy * s) / hx
    py = oy * (c / hy) - ox * (s / hy) - (cy * c - cx * s) / hy
    pz = oz * (1 / hz) - cz / hz
    ux = dx * (c / hx) + dy * (s / hx)
    uy = dy * (c / hy) - dx * (s / hy)
    uz = rays.dz[window] * (1 / hz)
    if shape == Shape.BOX:
        t_in, t_out = _slab(pz, uz)
        t_in, t_out = _faces(px, ux, pz, uz, kx, t_in, t_out)
        return _faces(py, uy, pz, uz, ky, t_in, t_out)
    if shape == Shape.CYLINDER:
        return _round(ux * ux + uy * uy, px * ux + py * uy, px * px + py * py, *_slab(pz, uz))
    a, b, q = ux * ux + uy * uy + uz * uz, px * ux + py * uy + pz * uz, px * px + py * py + pz * pz
    return _round(a, b, q, None, None)


def _slab(p: Array, u: Array) -> tuple[Array, Array]:
    inverse = 1 / u
    middle, reach = -p * inverse, np.abs(inverse)
    return middle - reach, middle + reach


def _faces(p: Array, u: Array, pz: Array, uz: Array, k: float, t_in: Array, t_out: Array) -> tuple[Array, Array]:
    """Clip by the two faces ``|p| + k pz <= 1``."""
    if k == 0:
        a, b = _slab(p, u)
        return np.maximum(t_in, a), np.minimum(t_out, b)
    for sign in (1.0, -1.0):
        along = sign * u + k * uz
        t = (1 - sign * p - k * pz) / along
        t_in = np.where(along < 0, np.maximum(t_in, t), t_in)
        t_out = np.where(along > 0, np.minimum(t_out, t), t_out)
    return t_in, t_out


def _round(a: Array, b: Array, q: Array, t_in: Array | None, t_out: Array | None) -> tuple[Array, Array]:
    """Clip by the unit circle or sphere: ``a t^2 + 2 b t + q <= 1``."""
    root = np.sqrt(b * b - a * (q - 1))
    inverse = 1 / a
    first, last = (-b - root) * inverse, (root - b) * inverse
    # A miss has root nan; fmax would hide it, maximum keeps it, and nan compares false later.
    return (first if t_in is None else np.maximum(t_in, first)), (last if t_out is None else np.minimum(t_out, last))


# --- windows -------------------------------------------------------------------------------------------------------


def _windows(rays: Rays, p: PrimitiveSet, max_range_m: float) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Nearest distance and pixel window (row from, to, column from, to) of every primitive; columns may pass W."""
    corners, grown = _footprints(p)
    whole = np.full(len(p), rays.knots[0]), np.full(len(p), rays.knots[-1])
    low, high, _, _, inside = _azimuth_span(rays, p, corners, grown, *whole)
    start, end = _times_of(rays, low, high)
    start, end = np.where(inside, whole[0], start), np.where(inside, whole[1], end)
    low, high, near, far, inside = _azimuth_span(rays, p, corners, grown, start, end)
    rows = _row_span(rays, p, corners, near, far, grown)
    bend = np.hypot(*rays.tilt) * np.maximum(np.abs(rays.elevation_tan).max(), 0.1)
    margin = rays.azimuth_slack_rad + bend + np.arcsin(np.clip(0.05 / np.maximum(near, 0.05), 0, 1))
    columns = _column_span(rays, low - margin, high + margin, inside)
    rows[near > max_range_m] = 0
    return near, np.column_stack([rows, columns])


def _footprints(p: PrimitiveSet) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Corners of the footprints about the centre, [N, 4, 2], and the half sizes with taper, [N, 2]."""
    grown = p.half[:, :2] * (1 + np.where(p.shape[:, None] == Shape.BOX, np.abs(p.taper), 0))
    c, s = np.cos(p.yaw), np.sin(p.yaw)
    signs = np.array([(1, 1), (1, -1), (-1, -1), (-1, 1)], dtype=np.float64)
    local = signs[None] * grown[:, None]
    x = c[:, None] * local[..., 0] - s[:, None] * local[..., 1]
    y = s[:, None] * local[..., 0] + c[:, None] * local[..., 1]
    return np.stack([x, y], axis=-1), grown


def _azimuth_span(
    rays: Rays, p: PrimitiveSet, corners: Array, grown: Array, start: Array, end: Array
) -> tuple[Array, Array, Array, Array, Array]:
    """Clockwise azimuths [low, high] (unwrapped) covered between two times, distances near and far, and "around us"."""
    low, high = np.full(len(p), np.inf), np.full(len(p), -np.inf)
    near, far, inside = np.full(len(p), np.inf), np.zeros(len(p)), np.zeros(len(p), bool)
    c, s = np.cos(p.yaw), np.sin(p.yaw)
    reference = None
    for time in (start, (start + end) / 2, end):
        sx, sy = (np.interp(time, rays.knots, rays.path[:, k]) for k in (0, 1))
        yaw = np.interp(time, rays.knots, rays.heading)
        mx, my = p.centre[:, 0] + p.velocity[:, 0] * time - sx, p.centre[:, 1] + p.velocity[:, 1] * time - sy
        middle = yaw - np.arctan2(my, mx)
        reference = middle if reference is None else reference
        middle = reference + _wrap(middle - reference)
        x, y = mx[:, None] + corners[..., 0], my[:, None] + corners[..., 1]
        azimuth = middle[:, None] + _wrap(yaw[:, None] - np.arctan2(y, x) - middle[:, None])
        low, high = np.minimum(low, azimuth.min(1)), np.maximum(high, azimuth.max(1))
        out_x = np.maximum(np.abs(c * mx + s * my) - grown[:, 0], 0)
        out_y = np.maximum(np.abs(c * my - s * mx) - grown[:, 1], 0)
        near, far = np.minimum(near, np.hypot(out_x, out_y)), np.maximum(far, np.hypot(x, y).max(1))
    # The three times are samples: between them the vehicle can come closer by at most half a step.
    step = np.hypot(*(rays.path[-1] - rays.path[0])) * (end - start) / (rays.knots[-1] - rays.knots[0]) / 4
    near = np.maximum(near - step - 0.05, 0)
    inside = (near < 0.3) | (high - low > np.pi)
    return low, high, near, far, inside


def _wrap(angle: Array) -> Array:
    return np.asarray((angle + np.pi) % (2 * np.pi) - np.pi)


def _times_of(rays: Rays, low: Array, high: Array) -> tuple[Array, Array]:
    """When the lasers sweep a span of azimuths; the whole turn for a span over the cut."""
    turn = 2 * np.pi
    first = (low - rays.cut_rad) % turn
    last = first + (high - low)
    slack = (rays.knots[-1] - rays.knots[0] - rays.period_s) / 2 + 0.02 * rays.period_s
    begin = (first / turn - 0.5) * rays.period_s - slack
    finish = (last / turn - 0.5) * rays.period_s + slack
    # Near the cut, lasers with an azimuth offset shoot at the other end of the turn.
    edge = 0.01 + slack / rays.period_s
    over = (last > turn * (1 - edge)) | (first < turn * edge)
    return (
        np.where(over, rays.knots[0], np.maximum(begin, rays.knots[0])),
        np.where(over, rays.knots[-1], np.minimum(finish, rays.knots[-1])),
    )


def _row_span(rays: Rays, p: PrimitiveSet, corners: Array, near: Array, far: Array, grown: Array) -> NDArray[np.int64]:
    z_low = p.centre[:, 2] - p.half[:, 2] - float(rays.oz.max()) - 0.02
    z_high = p.centre[:, 2] + p.half[:, 2] - float(rays.oz.min()) + 0.02
    close = np.maximum(near, 0.05)
    tan_low, tan_high = z_low / np.where(z_low < 0, close, far), z_high / np.where(z_high > 0, close, far)
    # On a slope the vehicle's floor rises towards the primitive by tilt . direction.
    xy = p.centre[:, None, :2] + np.concatenate([corners, np.zeros((len(p), 1, 2))], axis=1)
    rise = (xy @ np.array(rays.tilt)) / np.maximum(np.hypot(xy[..., 0], xy[..., 1]), 0.5)
    travel = np.hypot(*(rays.path[-1] - rays.path[0])) / 2
    reach = (np.maximum(grown.max(1), 1.0) + travel) / np.maximum(close, 0.5) * np.hypot(*rays.tilt) * 0.5
    bent = 0.01 * np.maximum(np.abs(tan_low), np.abs(tan_high)) + 2 * np.hypot(*rays.tilt) * np.minimum(
        np.maximum(tan_low**2, tan_high**2), 4.0
    )
    low = tan_low - rise.max(1) - reach - bent - 0.002
    high = tan_high - rise.min(1) + reach + bent + 0.002
    rising = rays.elevation_tan[::-1]
    beams = len(rising)
    first = beams - np.searchsorted(rising, high, side="right")
    last = beams - np.searchsorted(rising, low, side="left")
    return np.column_stack([first, last])


def _column_span(rays: Rays, low: Array, high: Array, inside: Array) -> NDArray[np.int64]:
    columns = rays.shape[1]
    scale = columns / (2 * np.pi)
    first = np.floor((low - rays.cut_rad) * scale - 0.5).astype(np.int64)
    last = np.ceil((high - rays.cut_rad) * scale + 0.5).astype(np.int64) + 1
    width = last - first
    first %= columns
    everything = inside | (width >= columns)
    return np.column_stack([np.where(everything, 0, first), np.where(everything, columns, first + width)])


# --- ground --------------------------------------------------------------------------------------------------------


def cast_ground(rays: Rays, ground: Ground, max_range_m: float) -> F32:
    """Distance along every ray to the ground, inf where it meets none within range, ``float32[beams, columns]``."""
    flat = np.hypot(rays.dx, rays.dy)
    near, far = _ground_bracket(rays, ground, flat, max_range_m)
    t: F32 = _refine(rays, ground, near / flat, far / flat)
    if ground.kerb_height > 0:
        t = _onto_pavement(rays, ground, t)
    t[t > max_range_m] = np.inf
    return t


def _ground_bracket(rays: Rays, ground: Ground, flat: F32, max_range_m: float) -> tuple[F32, F32]:
    """Horizontal distances between which each ray first goes under the ground (inf, inf: never)."""
    every = max(1, rays.shape[1] // 256)
    steps = np.geomspace(_NEAREST_M, max_range_m * 1.1, 64).astype(np.float32)
    middle = rays.shape[0] // 2
    pick = (middle, slice(None, None, every))
    ux, uy = rays.dx[pick] / flat[pick], rays.dy[pick] / flat[pick]
    x, y = rays.ox[pick][:, None] + ux[:, None] * steps, rays.oy[pick][:, None] + uy[:, None] * steps
    rise = (ground.height(x, y) - rays.oz[pick][:, None]) / steps
    crest = np.maximum.accumulate(rise, axis=1)
    slope = (rays.dz / flat)[:, ::every]
    index = (crest[None] < slope[..., None]).sum(axis=-1)
    edges = np.concatenate([[np.float32(0.5)], steps, [np.float32(np.inf)] * 2]).astype(np.float32)
    wide = np.repeat(index, every, axis=1)[:, : rays.shape[1]]
    return edges[wide], edges[wide + 1]


def _refine(rays: Rays, ground: Ground, near: Array, far: Array) -> Array:
    """Newton steps from the bracket's middle, held near the bracket."""
    never = ~np.isfinite(far)
    t = np.where(never, np.float32(1), (near + far) * np.float32(0.5))
    low, high = np.where(never, np.float32(1), near * 0.8), np.where(never, np.float32(1), far * 1.25)
    for _ in range(4):
        x, y = rays.ox + t * rays.dx, rays.oy + t * rays.dy
        above = rays.oz + t * rays.dz - ground.height(x, y)
        gx, gy = ground.gradient(x, y)
        fall = np.minimum(rays.dz - gx * rays.dx - gy * rays.dy, np.float32(-1e-4))
        t = np.clip(t - above / fall, low, high)
    t[never] = np.inf
    return np.asarray(t, dtype=np.float32)


def _onto_pavement(rays: Rays, ground: Ground, t: F32) -> F32:
    """Lift hits beside the road onto the pavement; a ray that would come up inside the road hits the kerb."""
    safe = np.where(np.isfinite(t), t, np.float32(1))
    x, y = rays.ox + safe * rays.dx, rays.oy + safe * rays.dy
    gx, gy = ground.gradient(x, y)
    fall = np.maximum(gx * rays.dx + gy * rays.dy - rays.dz, np.float32(2e-3))
    beside = (np.abs(y - ground.centre_line(x)) > ground.road_half_width) & ~ground.in_crossing(x)
    on_top = np.maximum(safe - ground.kerb_height / fall, np.float32(0.3))
    lateral = np.abs(y - ground.centre_line(x))
    x_top = rays.ox + on_top * rays.dx
    lateral_top = np.abs(rays.oy + on_top * rays.dy - ground.centre_line(x_top))
    share = (ground.road_half_width - lateral_top) / np.maximum(lateral - lateral_top, np.float32(1e-6))
    kerb = on_top + np.clip(share, 0, 1) * (safe - on_top)
    raised = np.where(lateral_top >= ground.road_half_width, on_top, kerb)
    return np.where(beside & np.isfinite(t), raised, t).astype(np.float32)
