"""A spinning LiDAR in a scene: every sample is measured at its own time, from where the vehicle then is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from upbeam.model.beams import BeamTable

from .ground import Ground
from .raycast import Rays, cast
from .scene import Scene
from .shading import Shading, shade

__all__ = ["Lidar", "LidarConfig", "Scan"]

F32 = NDArray[np.float32]
FloatArray = NDArray[np.float64]

Alignment = Literal["firing", "azimuth"]

_DARK = 0.07
"""Share of light below which a return is graded 0."""
_OWN_VEHICLE = ((0.0, -25.5, 24.0, 3.6), (180.0, -25.5, 24.0, 3.2), (68.0, -20.8, 15.0, 3.3), (129.0, -18.8, 5.5, 2.6),
                (201.0, -18.6, 5.5, 2.6), (231.0, -24.2, 14.0, 2.0), (310.0, -25.0, 22.0, 1.8))  # fmt: skip
"""What the sensor's own vehicle and rack hide: (azimuth, elevation, half widths of both) in degrees."""


@dataclass(frozen=True)
class LidarConfig:
    """What sensor, how it spins, and how it errs. Errors: ValueError that names the field."""

    beams: BeamTable
    columns: int = 2048
    """Firings per turn, 16 to 65535."""
    rate_hz: float = 20.0
    """Turns a second, 0.1 to 100."""
    distance_unit_m: float | None = None
    """Size of one count; None: the beam table's."""
    align: bool = True
    """True: each laser is sampled where it points at a column's centre. False: raw firing columns."""
    range_from_origin: bool = False
    """True: distance from the sensor's origin (a range image of KITTI's points); False: the laser's own path."""
    cut_deg: float = 180.0
    """Azimuth where a turn begins, clockwise; 180 = behind."""
    sensor_height_m: float = 1.73
    """Of the sensor's origin above the ground."""
    min_range_m: float = 1.0
    max_range_m: float = 120.0
    range_noise_m: float = 0.008
    """Standard deviation of one distance."""
    beam_bias_m: float = 0.006
    """Standard deviation of the beams' constant errors."""
    dropout: float = 0.03
    """Chance that a good return is lost anyway, 0 to 1."""
    dropout_weak: float = 1.0
    """Scales losses that come with range, grazing incidence and dark surfaces; 0 turns them off."""
    glass: bool = True
    """Whether glass and mirrors lose returns."""
    mixed_pixels: float = 0.35
    """Chance that a pixel at a depth edge mixes both surfaces, 0 to 1."""
    intensity_noise: float = 0.13
    """Relative standard deviation of one intensity."""
    gain_spread: float = 0.12
    """Relative standard deviation of the beams' gains."""
    own_vehicle: bool = True
    """Whether the vehicle hides parts of the lowest beams."""
    facade_relief: bool = True
    """Whether windows stand back in walls."""
    seed: int = 0

    def __post_init__(self) -> None:
        _within("columns", self.columns, 16, 65535)
        _within("rate_hz", self.rate_hz, 0.1, 100)
        _within("max_range_m", self.max_range_m, 2, 1000)
        _within("min_range_m", self.min_range_m, 0, self.max_range_m)
        _within("sensor_height_m", self.sensor_height_m, 0.05, 50)
        for name in ("dropout", "mixed_pixels"):
            _within(name, getattr(self, name), 0, 1)
        for name in ("range_noise_m", "beam_bias_m", "dropout_weak", "intensity_noise", "gain_spread", "seed"):
            _within(name, getattr(self, name), 0, np.inf)
        _within("distance_unit_m", self.unit_m, 1e-4, 0.1)

    @property
    def unit_m(self) -> float:
        """Size of one distance count in metres."""
        return self.beams.distance_unit_m if self.distance_unit_m is None else self.distance_unit_m

    def ideal(self) -> LidarConfig:
        """The same sensor without any error, loss or relief: geometry only."""
        return replace(
            self, range_noise_m=0.0, beam_bias_m=0.0, dropout=0.0, dropout_weak=0.0, glass=False, mixed_pixels=0.0,
            intensity_noise=0.0, gain_spread=0.0, own_vehicle=False, facade_relief=False,
        )  # fmt: skip


def _within(name: str, value: float, low: float, high: float) -> None:
    if not low <= value <= high:
        raise ValueError(f"LidarConfig.{name} = {value}: expected {low} to {high}")


@dataclass(frozen=True)
class Scan:
    """One turn of the sensor."""

    distance: NDArray[np.uint16]
    """Counts of ``distance_unit_m``, 0 = no return, [beams, columns]."""
    intensity: NDArray[np.uint8]
    """[beams, columns]; 0 where nothing returned, and where a return was too weak to grade."""
    surface: NDArray[np.uint8]
    """``Surface`` of what returned, 0 where nothing did, [beams, columns]."""
    time_s: float
    """Start of the turn."""
    frame: int
    rate_hz: float
    beams: BeamTable
    alignment: Alignment
    """"firing": column j holds the j-th firing, laser b points ``azimuth_offset_deg[b]`` further. "azimuth": column c
    holds what every laser saw at the column's centre azimuth."""
    distance_unit_m: float
    cut_deg: float
    range_from_origin: bool
    overflow: int = 0
    """Returns beyond 65535 counts, stored as 0."""

    @property
    def columns(self) -> int:
        return int(self.distance.shape[1])

    def distance_m(self) -> F32:
        """Distances in metres, 0 = no return."""
        return np.asarray(self.distance.astype(np.float32) * np.float32(self.distance_unit_m))

    def azimuth_deg(self) -> FloatArray:
        """Azimuth every sample was taken at, clockwise in [0, 360), ``[beams, columns]``."""
        centre = self.cut_deg + (np.arange(self.columns) + 0.5) * 360.0 / self.columns
        offset = self.beams.azimuth_offset_deg if self.alignment == "firing" else np.zeros(self.beams.beams)
        return np.asarray((centre[None] + offset[:, None]) % 360.0)

    def aligned(self) -> Scan:
        """The scan destaggered: pixel (b, c) is firing column ``c - column_offset_b``, circular within the turn.

        ``column_offset_b`` is ``beams.column_offsets(columns)[b]``. Samples move by whole columns, so that an azimuth
        error of up to half a column stays; pixels near the cut come from the turn's other end. An aligned scan is
        returned as it is.
        """
        if self.alignment == "azimuth":
            return self
        shift = self.beams.column_offsets(self.columns)
        index = (np.arange(self.columns)[None] - shift[:, None]) % self.columns
        return replace(
            self,
            alignment="azimuth",
            distance=np.take_along_axis(self.distance, index, axis=1),
            intensity=np.take_along_axis(self.intensity, index, axis=1),
            surface=np.take_along_axis(self.surface, index, axis=1),
        )

    def points(self) -> F32:
        """Returns as ``float32[N, 4]``: x, y, z (forward, left, up of the sensor; metres) and intensity 0..1."""
        keep = self.distance > 0
        d, intensity = self.distance_m()[keep].astype(np.float64), self.intensity[keep] / 255.0
        row, _ = np.nonzero(keep)
        azimuth = np.radians(self.azimuth_deg()[keep])
        elevation = np.radians(self.beams.elevation_deg)[row]
        up, right = self.beams.vertical_offset_m[row], self.beams.horizontal_offset_m[row]
        if self.range_from_origin:
            b, q = np.sin(elevation) * up, up**2 + right**2
            d = -b + np.sqrt(np.maximum(b * b - q + d * d, 0))
        flat = d * np.cos(elevation)
        x = flat * np.cos(azimuth) - right * np.sin(azimuth)
        y = -flat * np.sin(azimuth) - right * np.cos(azimuth)
        return np.column_stack([x, y, d * np.sin(elevation) + up, intensity]).astype(np.float32)


class Lidar:
    """A sensor on the vehicle of a scene."""

    def __init__(self, config: LidarConfig, scene: Scene) -> None:
        self.config, self.scene = config, scene
        self._shots = _Shots(config)
        rng = np.random.default_rng([config.seed, 0xBEA])
        beams = config.beams.beams
        self._bias = (rng.standard_normal(beams) * config.beam_bias_m).astype(np.float32)
        self._gain = np.exp(rng.standard_normal(beams) * config.gain_spread).astype(np.float32)
        weak = rng.random(beams) < 0.6 * config.gain_spread
        self._gain *= np.where(weak, np.float32(0.4), np.float32(1))
        self._hidden = _hidden_by_vehicle(config) if config.own_vehicle else None

    def scan(self, frame_index: int) -> Scan:
        """The ``frame_index``-th turn (>= 0), beginning at ``frame_index / rate_hz`` seconds.

        Depends on the seed, the scene and the index alone. ValueError for a negative index.
        """
        if frame_index < 0:
            raise ValueError(f"frame index {frame_index}: expected 0 or more")
        config = self.config
        rng = np.random.default_rng([config.seed, frame_index])
        start = frame_index / config.rate_hz
        rays, ground, (x, y, z) = self._rays(start + 0.5 / config.rate_hz)
        reach = config.max_range_m + 5.0
        found = self.scene.primitives(start + 0.5 / config.rate_hz, x, y, reach)
        found = replace(found, centre=found.centre - np.array([x, y, z]))
        chance = rng.random(rays.shape, dtype=np.float32)
        depth, hit = cast(rays, ground, found, chance, config.max_range_m)
        shading = shade(rays, ground, found, depth, hit)
        return self._measure(frame_index, start, depth, shading, rng)

    def _rays(self, middle_s: float) -> tuple[Rays, Ground | None, tuple[float, float, float]]:
        """The turn's shots around the vehicle's place in the middle of the turn."""
        config, shots = self.config, self._shots
        period = 1 / config.rate_hz
        reach = period / 2 + shots.overhang_s
        knots = np.linspace(-reach, reach, 9)
        px, py, yaw = self.scene.ego.at(middle_s + knots)
        x, y = float(px[4]), float(py[4])
        ground = self.scene.ground
        z, tilt = 0.0, (0.0, 0.0)
        heights = np.zeros(9)
        if ground is not None:
            heights = np.asarray(ground.height(px, py), dtype=np.float64)
            z = float(heights[4])
            gx, gy = ground.gradient(np.asarray(x), np.asarray(y))
            tilt = (float(gx), float(gy))
            ground = ground.seen_from(x, y, z)
        path = np.column_stack([px - x, py - y, heights - z])
        rays = shots.rays(knots, path, yaw, tilt, period)
        return rays, ground, (x, y, z)

    def _measure(self, frame: int, start: float, depth: F32, shading: Shading, rng: np.random.Generator) -> Scan:
        config = self.config
        distance = depth + shading.deeper if config.facade_relief else depth
        if config.mixed_pixels > 0:
            distance = _mix_edges(distance, config.mixed_pixels, rng)
        strength = _strength(shading)
        noise = rng.standard_normal(distance.shape, dtype=np.float32)
        lost = self._lost(distance, shading, strength, rng)
        intensity = self._grade(strength, distance, rng)
        measured = distance + noise * np.float32(config.range_noise_m) + self._bias[:, None]
        lost |= ~(measured >= config.min_range_m) | (measured > config.max_range_m)
        if config.range_from_origin:
            measured = self._shots.from_origin(measured)
        counts = np.floor(np.where(lost, 0, measured).astype(np.float64) / config.unit_m + 0.5)
        over = counts > 65535
        counts[over] = 0
        kept = counts > 0
        planes = (
            counts.astype(np.uint16),
            np.where(kept, intensity, 0).astype(np.uint8),
            np.where(kept, shading.surface, 0).astype(np.uint8),
        )
        if not config.align:
            planes = tuple(np.take_along_axis(plane, self._shots.firing_index, axis=1) for plane in planes)  # type: ignore[assignment]
        return Scan(
            *planes,
            time_s=start,
            frame=frame,
            rate_hz=config.rate_hz,
            beams=config.beams,
            alignment="azimuth" if config.align else "firing",
            distance_unit_m=config.unit_m,
            cut_deg=config.cut_deg,
            range_from_origin=config.range_from_origin,
            overflow=int(over.sum()),
        )

    def _lost(self, distance: F32, shading: Shading, strength: F32, rng: np.random.Generator) -> NDArray[np.bool_]:
        """Which samples return nothing."""
        config = self.config
        with np.errstate(all="ignore"):
            reach = np.float32(0.9) * (distance / np.float32(60.0)) ** 2 / np.maximum(strength, np.float32(1e-3))
            kept = (1 - config.dropout) * np.exp(-np.float32(config.dropout_weak) * np.float32(0.04) * reach * reach)
        if config.glass:
            kept = kept * (1 - shading.loss)
        lost = ~np.isfinite(distance) | (rng.random(distance.shape, dtype=np.float32) >= kept)
        if self._hidden is not None:
            # The edge of what the vehicle hides differs from beam to beam and flickers.
            ragged = rng.normal(0, 0.22, (distance.shape[0], 1)).astype(np.float32)
            lost |= self._hidden + ragged < 1
        return np.asarray(lost)

    def _grade(self, strength: F32, distance: F32, rng: np.random.Generator) -> F32:
        """Intensity 0..255 as the sensor reports it."""
        config = self.config
        with np.errstate(all="ignore"):
            # The receiver is made for middle distances: close by its optics see little of the spot.
            fall = np.exp(-((distance / np.float32(70.0)) ** 2)) * np.clip((distance - 2.6) / np.float32(3.2), 0.1, 1)
            noise = rng.standard_normal(distance.shape, dtype=np.float32) * np.float32(config.intensity_noise)
            value = strength * fall * self._gain[:, None] * (1 + noise) * np.float32(1.25) - np.float32(_DARK) * (
                1 + np.minimum(distance / np.float32(22.0), 1.9) ** 2
            )
            # Now and then the pulse returns but is graded 0.
            value *= rng.random(distance.shape, dtype=np.float32) >= config.intensity_noise * np.float32(0.3)
        value = np.nan_to_num(value, nan=0.0, posinf=0.0)
        return np.asarray(np.floor(np.clip(value, 0, 1) * 255 + np.float32(0.5)))


def _strength(shading: Shading) -> F32:
    """Share of light that comes back: rough surfaces keep a good part of it at grazing incidence."""
    return np.asarray(shading.reflectivity * (np.float32(0.7) + np.float32(0.3) * shading.cosine), dtype=np.float32)


def _mix_edges(distance: F32, share: float, rng: np.random.Generator) -> F32:
    """Beams are wide: a pixel beside a depth edge may hold the other surface, or a place between close ones."""
    right = np.roll(distance, -1, axis=1)
    with np.errstate(invalid="ignore"):
        gap = right - distance
        step = np.abs(gap)
        # A slanted wall changes as much on the other side of the pixel: that is no edge.
        edge = np.flatnonzero((step > 0.4) & np.isfinite(gap) & ~(step < 3 * np.roll(step, 1, axis=1)))
    edge = edge[rng.random(len(edge)) < share]
    weight = rng.random(len(edge), dtype=np.float32)
    jump = gap.ravel()[edge]
    weight = np.where(np.abs(jump) < 2.5, weight, np.round(weight))
    out = distance.copy()
    out.ravel()[edge] += weight * jump
    return np.asarray(out)


def _hidden_by_vehicle(config: LidarConfig) -> F32:
    """Below 1 where the vehicle itself stands in the way, ``[beams, columns]`` in azimuth columns."""
    azimuth = config.cut_deg + (np.arange(config.columns) + 0.5) * 360.0 / config.columns
    cover = np.full((config.beams.beams, config.columns), 9.0)
    for at, el, wide, tall in _OWN_VEHICLE:
        da = ((azimuth - at + 180) % 360 - 180) / wide
        de = (config.beams.elevation_deg - el) / tall
        cover = np.minimum(cover, da[None] ** 2 + de[:, None] ** 2)
    return cover.astype(np.float32)


class _Shots:
    """Azimuth and time of every sample of a turn, ``[beams, columns]``, laid out by the column a laser points at."""

    def __init__(self, config: LidarConfig) -> None:
        table, width = config.beams, config.columns
        self.table, self.config = table, config
        period = 1 / config.rate_hz
        shift = table.column_offsets(width)
        column = np.arange(width)
        offset = table.azimuth_offset_deg[:, None]
        if config.align:
            azimuth = np.broadcast_to((column + 0.5) * (360.0 / width), (table.beams, width))
            time = ((column[None] + 0.5) / width - offset / 360.0) * period
        else:
            firing = (column[None] - shift[:, None]) % width
            azimuth = (firing + 0.5) * (360.0 / width) + offset
            # A firing cycle longer than a column's time is shortened to fit.
            stretch = min(1.0, period / width / (table.firing_cycle_us * 1e-6)) if table.firing_cycle_us > 0 else 1.0
            time = firing * (period / width) + table.firing_time_us[:, None] * 1e-6 * stretch
        self.firing_index = (column[None] + shift[:, None]) % width
        self.azimuth = np.radians(azimuth + config.cut_deg)
        self.time = time - period / 2
        self.overhang_s = float(max(np.abs(offset).max() / 360.0 * period, np.abs(self.time).max() - period / 2) + 1e-6)
        self.slack_rad = float(np.radians(360.0 / width))
        elevation = np.radians(table.elevation_deg)[:, None]
        self.cos, self.sin, self.tan = np.cos(elevation), np.sin(elevation), np.tan(elevation[:, 0])

    def rays(
        self, knots: FloatArray, path: FloatArray, yaw: FloatArray, tilt: tuple[float, float], period: float
    ) -> Rays:
        """World rays of a turn whose vehicle passes ``path`` (x, y, z at ``knots``) on a floor of slope ``tilt``."""
        time = self.time
        x, y, z = (_quadratic(knots, path[:, k], time) for k in range(3))
        angle = (_quadratic(knots, yaw, time) - self.azimuth).astype(np.float32)
        c, s = np.cos(angle), np.sin(angle)
        matrix = _tilt_matrix(tilt)
        direction = _turned(matrix, c * self.cos, s * self.cos, np.broadcast_to(self.sin, c.shape))
        right, up = (
            self.table.horizontal_offset_m[:, None],
            self.table.vertical_offset_m[:, None] + self.config.sensor_height_m,
        )
        laser = _turned(matrix, s * right, -c * right, np.broadcast_to(up, c.shape))
        ox, oy, oz = ((p + q).astype(np.float32) for p, q in zip((x, y, z), laser, strict=True))
        # A ray exactly along an axis would divide by zero.
        dx, dy, dz = (np.where(v == 0, 1e-12, v).astype(np.float32) for v in direction)
        return Rays(
            ox=ox,
            oy=oy,
            oz=oz,
            dx=dx,
            dy=dy,
            dz=dz,
            time=time.astype(np.float32),
            elevation_tan=self.tan,
            path=path[:, :2],
            heading=yaw,
            knots=knots,
            tilt=tilt,
            cut_rad=float(np.radians(self.config.cut_deg)),
            azimuth_slack_rad=self.slack_rad,
            period_s=period,
        )

    def from_origin(self, distance: F32) -> F32:
        """Distance from the sensor's origin of points at a distance along their laser."""
        up, right = self.table.vertical_offset_m[:, None], self.table.horizontal_offset_m[:, None]
        with np.errstate(invalid="ignore"):
            squared = distance**2 + 2 * distance * self.sin * up + up**2 + right**2
        return np.asarray(np.sqrt(squared), dtype=np.float32)


def _quadratic(knots: FloatArray, values: FloatArray, time: FloatArray) -> FloatArray:
    """Parabola through the first, middle and last of ``values``, at ``time``."""
    half = knots[-1]
    u = time / half
    bow = (values[0] + values[-1]) / 2 - values[4]
    return np.asarray(values[4] + u * ((values[-1] - values[0]) / 2 + u * bow))


def _tilt_matrix(tilt: tuple[float, float]) -> FloatArray:
    """Rotation that takes z to the normal of a floor with this slope, without turning about z."""
    n = np.array([-tilt[0], -tilt[1], 1.0])
    n /= np.linalg.norm(n)
    cross = np.array([[0, 0, n[0]], [0, 0, n[1]], [-n[0], -n[1], 0]])
    return np.asarray(np.eye(3) + cross + cross @ cross / (1 + n[2]))


def _turned(m: FloatArray, x: FloatArray, y: FloatArray, z: FloatArray) -> Sequence[FloatArray]:
    return [m[k, 0] * x + m[k, 1] * y + m[k, 2] * z for k in range(3)]
