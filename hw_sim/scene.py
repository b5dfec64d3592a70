"""Procedural street scenes: a seed gives a road, what stands along it, what moves on it, and the vehicle's drive."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from . import objects
from .ground import Ground
from .primitives import Material, PrimitiveSet, PrimitiveSetBuilder
from .trajectory import Trajectory

__all__ = ["SCENE_KINDS", "Mover", "Scene", "street_scene"]

Rng = np.random.Generator

SCENE_KINDS = ("city", "suburb", "highway", "rural")
_VIEW_M = 135.0


@dataclass(frozen=True)
class Mover:
    """One thing that moves along the road at constant speed, on the road's surface."""

    parts: PrimitiveSet
    """Built around the origin, front along x."""
    x: float
    """Along the road at time 0."""
    lane: float
    """Metres left of the road's middle."""
    speed: float
    """Metres a second along x; negative drives towards -x, front first."""


@dataclass(frozen=True)
class Scene:
    """Everything a sensor can meet."""

    ground: Ground | None = field(default_factory=Ground)
    ego: Trajectory = field(default_factory=Trajectory.arc)
    static: PrimitiveSet = field(default_factory=PrimitiveSet.empty)
    movers: tuple[Mover, ...] = ()
    kind: str = "custom"

    def primitives(self, time_s: float, x: float, y: float, reach_m: float) -> PrimitiveSet:
        """What stands or drives within ``reach_m`` of (x, y) at a time, movers with their velocities."""
        size = np.hypot(self.static.half[:, 0], self.static.half[:, 1])
        distance = np.hypot(self.static.centre[:, 0] - x, self.static.centre[:, 1] - y)
        parts = [self.static[distance - size < reach_m]]
        for mover in self.movers:
            if abs(mover.x + mover.speed * time_s - x) < reach_m + 15:
                parts.append(self._placed(mover, time_s))
        return PrimitiveSet.joined(parts)

    def _placed(self, mover: Mover, time_s: float) -> PrimitiveSet:
        x = mover.x + mover.speed * time_s
        if self.ground is None:
            return mover.parts.placed(x, mover.lane, 0.0, 0.0 if mover.speed >= 0 else np.pi, abs(mover.speed))
        along = np.float64(x)
        y = float(self.ground.centre_line(along)) + mover.lane
        heading = float(self.ground.heading(along)) + (0.0 if mover.speed >= 0 else np.pi)
        return mover.parts.placed(x, y, self.ground.at(x, y), heading, abs(mover.speed))


def street_scene(kind: str, seed: int, *, seconds: float = 35.0, ego_speed: float | None = None) -> Scene:
    """A street of one of ``SCENE_KINDS``, long enough for a drive of ``seconds``.

    The same arguments give the same scene, bit for bit. ``ego_speed`` in m/s; by default drawn to fit the kind.
    ValueError for an unknown kind or a duration outside (0, 600].
    """
    if kind not in SCENE_KINDS:
        raise ValueError(f"no scene kind {kind!r}; known: {', '.join(SCENE_KINDS)}")
    if not 0 < seconds <= 600:
        raise ValueError(f"scene of {seconds} s: expected more than 0 and at most 600")
    rng = np.random.default_rng([seed, SCENE_KINDS.index(kind), 0x5CE])
    style = _STYLES[kind]
    speed = float(rng.uniform(*style.ego_speed)) if ego_speed is None else ego_speed
    street = _Street(rng, style, -_VIEW_M, max(0.0, speed * seconds) + _VIEW_M)
    street.furnish()
    # Clear of the parked cars on a street, in the middle of its own half elsewhere.
    lane = -(max(1.3, street.half - 4.5) if street.parked else street.half * (0.5 if style.lanes == 1 else 0.25))
    movers = _traffic(rng, style, street, lane, speed, seconds)
    ego = Trajectory.along(street.ground, lane, speed, seconds=seconds + 1)
    return Scene(street.ground, ego, street.built(), tuple(movers), kind)


@dataclass(frozen=True)
class _Style:
    """How a kind of street looks. Lengths in metres, densities as shares or per metre."""

    half: tuple[float, float]
    lanes: int
    kerb: float
    ego_speed: tuple[float, float]
    setback: tuple[float, float]
    building_share: float
    building_length: tuple[float, float]
    building_height: tuple[float, float]
    gap: tuple[float, float]
    parked: float
    tree_step: tuple[float, float]
    hedge_share: float
    pole_step: float
    people: float
    traffic_step: tuple[float, float]
    roll: float
    bend: float
    crossing_step: float


_STYLES = {
    "city": _Style(
        half=(5.8, 6.5), lanes=1, kerb=0.13, ego_speed=(4, 12), setback=(0.2, 3.0), building_share=0.92,
        building_length=(9, 26), building_height=(7, 18), gap=(0.0, 3.0), parked=0.7, tree_step=(9, 30),
        hedge_share=0.4, pole_step=22, people=0.05, traffic_step=(14, 60), roll=0.15, bend=3.0, crossing_step=90,
    ),
    "suburb": _Style(
        half=(5.9, 6.4), lanes=1, kerb=0.1, ego_speed=(5, 12), setback=(1.5, 5.0), building_share=0.85,
        building_length=(8, 15), building_height=(4, 9), gap=(1.0, 7.0), parked=0.55, tree_step=(6, 18),
        hedge_share=0.6, pole_step=28, people=0.02, traffic_step=(30, 120), roll=0.4, bend=8.0, crossing_step=110,
    ),
    "highway": _Style(
        half=(8.0, 12.0), lanes=2, kerb=0.0, ego_speed=(16, 28), setback=(4.0, 9.0), building_share=0.15,
        building_length=(15, 40), building_height=(6, 12), gap=(20.0, 60.0), parked=0.0, tree_step=(4, 9),
        hedge_share=0.85, pole_step=50, people=0.0, traffic_step=(25, 90), roll=0.5, bend=15.0, crossing_step=1e9,
    ),
    "rural": _Style(
        half=(3.0, 4.2), lanes=1, kerb=0.0, ego_speed=(8, 20), setback=(2.0, 7.0), building_share=0.2,
        building_length=(8, 20), building_height=(4, 9), gap=(15.0, 50.0), parked=0.0, tree_step=(3, 9),
        hedge_share=0.85, pole_step=45, people=0.004, traffic_step=(50, 160), roll=0.7, bend=14.0, crossing_step=200,
    ),
}  # fmt: skip


class _Street:
    """Places things along a road, side by side."""

    def __init__(self, rng: Rng, style: _Style, start: float, end: float) -> None:
        self.rng, self.style, self.start, self.end = rng, style, start, end
        # A street without parked cars is narrower.
        self.parked = style.parked if style.parked == 0 or rng.random() < 0.55 else 0.0
        narrow = style.parked > 0 and self.parked == 0
        self.half = float(rng.uniform(3.2, 4.6) if narrow else rng.uniform(*style.half))
        self.pavement = float(rng.uniform(1.2, 3.0) if style.kerb else rng.uniform(1.0, 3.5))
        self.ground = self._land()
        self._parts: list[PrimitiveSet] = []

    def built(self) -> PrimitiveSet:
        return PrimitiveSet.joined(self._parts)

    def furnish(self) -> None:
        """Put everything in place."""
        for side in (1.0, -1.0):
            setback = float(self.rng.uniform(*self.style.setback))
            self._buildings(side, setback)
            self._border(side, setback)
            self._trees(side, setback)
            self._parked(side)
            self._posts(side)
            self._backdrop(side, setback)
        self._cross_traffic()

    def _land(self) -> Ground:
        rng, style = self.rng, self.style
        waves = []
        for length, share in ((rng.uniform(70, 160), 1.0), (rng.uniform(30, 60), 0.25), (rng.uniform(20, 30), 0.06)):
            turn, rate = rng.uniform(-0.9, 0.9), 2 * np.pi / length
            tall = style.roll * share * rng.uniform(0.3, 1.0)
            waves.append(
                (float(tall), float(rate * np.cos(turn)), float(rate * np.sin(turn)), float(rng.uniform(0, 6.28)))
            )
        crossings, x = [], self.start + float(rng.uniform(30, style.crossing_step))
        while x < self.end:
            crossings.append((x, float(rng.uniform(3.0, 5.0))))
            x += style.crossing_step * float(rng.uniform(0.6, 1.6))
        half = self.half
        return Ground(
            slope=(float(rng.normal(0, 0.01)), float(rng.normal(0, 0.008))),
            waves=tuple(waves),
            road_half_width=half,
            kerb_height=style.kerb,
            bend_amplitude=float(rng.uniform(0.2, 1) * style.bend),
            bend_rate=2 * np.pi / float(rng.uniform(180, 420)),
            bend_phase=float(rng.uniform(0, 6.28)),
            crossings=tuple(crossings),
            lane_marks=(0.0,) if style.lanes == 1 else (-half / 2, 0.0, half / 2),
            paved=style.kerb > 0,
        )

    def _put(self, parts: PrimitiveSet, x: float, lateral: float, turn: float = 0.0) -> None:
        y = float(self.ground.centre_line(np.float64(x))) + lateral
        yaw = float(self.ground.heading(np.float64(x))) + turn
        self._parts.append(parts.placed(x, y, self.ground.at(x, y) - 0.02, yaw))

    def _open(self, x: float, half: float) -> bool:
        """Whether a side street needs this stretch."""
        return any(abs(x - c) < half + h + 1.0 for c, h in self.ground.crossings)

    def _walk(self, step: Callable[[], float]) -> list[float]:
        places, x = [], self.start + step()
        while x < self.end:
            places.append(x)
            x += step()
        return places

    def _buildings(self, side: float, setback: float) -> None:
        rng, style = self.rng, self.style
        x = self.start
        while x < self.end:
            length = float(rng.uniform(*style.building_length))
            middle = x + length / 2
            if rng.random() < style.building_share and not self._open(middle, length / 2):
                back = self.half + self.pavement + setback + float(rng.uniform(-0.3, 1.0))
                parts = objects.house(
                    rng, length, float(rng.uniform(8, 14)), float(rng.uniform(*style.building_height))
                )
                self._put(parts, middle, side * back, 0.0 if side > 0 else np.pi)
            x += length + float(rng.uniform(*style.gap))

    def _border(self, side: float, setback: float) -> None:
        """Walls, fences and hedges between pavement and gardens, in stretches."""
        rng, style = self.rng, self.style
        if setback < 2.0:
            return
        x = self.start
        while x < self.end:
            length = float(rng.uniform(4, 12))
            kind = rng.random()
            if kind < style.hedge_share + 0.25 and not self._open(x + length / 2, length / 2):
                self._put(
                    self._border_piece(length, kind < style.hedge_share),
                    x + length / 2,
                    side * (self.half + self.pavement + 0.6),
                )
            x += length + (float(rng.uniform(0, 5)) if rng.random() < 0.35 else 0.0)

    def _border_piece(self, length: float, hedge: bool) -> PrimitiveSet:
        rng, b = self.rng, PrimitiveSetBuilder()
        tall = float(rng.uniform(0.7, 2.6))
        if hedge:
            thick = float(rng.uniform(0.4, 1.0))
            b.box(
                Material.FOLIAGE,
                (-length / 2, -thick, 0),
                (length / 2, thick, tall),
                reflectivity=0.42,
                density=float(rng.uniform(2, 6)),
            )
        elif rng.random() < 0.5:
            b.box(
                Material.WALL,
                (-length / 2, -0.12, 0),
                (length / 2, 0.12, tall),
                reflectivity=float(rng.uniform(0.25, 0.5)),
            )
        else:
            b.box(Material.WALL, (-length / 2, -0.04, 0.05), (length / 2, 0.04, tall), reflectivity=0.35, density=7.0)
        return b.build()

    def _trees(self, side: float, setback: float) -> None:
        rng = self.rng
        kerb_trees = rng.random() < 0.5
        for x in self._walk(lambda: float(rng.uniform(*self.style.tree_step))):
            if self._open(x, 0.5):
                continue
            garden = self.pavement + setback * float(rng.uniform(0.3, 0.95))
            out = 1.0 if kerb_trees and self.style.kerb else garden
            self._put(
                objects.tree(rng) if rng.random() < 0.7 else objects.bush(rng), x, side * (self.half + max(out, 0.8))
            )

    def _backdrop(self, side: float, setback: float) -> None:
        """What shows through the gaps: rows of trees, thickets and blocks further off."""
        rng = self.rng
        front = self.half + self.pavement + setback
        for near, far, step in ((12.0, 24.0, 7.0), (24.0, 42.0, 6.0), (42.0, 60.0, 8.0)):
            for x in self._walk(lambda: step * float(rng.uniform(0.3, 1.4))):  # noqa: B023 - used at once
                off = front + float(rng.uniform(near, far))
                if near < 40 and self._open(x, 3.0):
                    continue
                kind = rng.random()
                if kind < 0.5:
                    self._put(objects.tree(rng), x, side * off)
                elif kind < 0.85:
                    self._put(objects.bush(rng, float(rng.uniform(2.0, 4.5))), x, side * off)
                else:
                    self._put(
                        objects.house(rng, 12, 10, float(rng.uniform(5, 12))), x, side * off, 0.0 if side > 0 else np.pi
                    )

    def _parked(self, side: float) -> None:
        rng = self.rng
        x = self.start
        while x < self.end:
            if rng.random() < self.parked and not self._open(x, 3.0):
                parts = objects.car(rng) if rng.random() < 0.88 else objects.van(rng)
                turn = float(rng.normal(0, 0.03)) + (np.pi if rng.random() < 0.5 else 0.0)
                self._put(parts, x, side * (self.half - 1.05), turn)
            x += float(rng.uniform(5.8, 8.0))

    def _posts(self, side: float) -> None:
        rng = self.rng
        for x in self._walk(lambda: self.style.pole_step * float(rng.uniform(0.5, 1.5))):
            post = objects.lamp_post(rng) if rng.random() < 0.6 else objects.road_sign(rng)
            self._put(post, x, side * (self.half + 0.5), 0.0 if side < 0 else np.pi)

    def _cross_traffic(self) -> None:
        """Cars waiting in side streets."""
        rng = self.rng
        for x, _ in self.ground.crossings:
            for side in (1.0, -1.0):
                for k in range(int(rng.integers(0, 4))):
                    out = self.half + 5.0 + k * float(rng.uniform(5.5, 9.0))
                    self._put(objects.car(rng), x - side * 1.6, side * out, -side * np.pi / 2)


def _traffic(rng: Rng, style: _Style, street: _Street, lane: float, speed: float, seconds: float) -> list[Mover]:
    """Vehicles that keep their lane's speed, so that none meets another; walkers and cyclists beside them."""
    movers: list[Mover] = []
    lanes = [(lane, speed), (0.4 - lane, -float(rng.uniform(*style.ego_speed)))]
    if style.lanes == 2:
        lanes += [(3 * lane, speed * 0.85), (-3 * lane, lanes[1][1] * 0.85)]
    for at, pace in lanes:
        begin, end = street.start - max(pace, 0) * seconds, street.end + max(-pace, 0) * seconds
        x = begin + float(rng.uniform(0, 40))
        while x < end:
            if at != lane or abs(x) > 11.0:
                kind = rng.random()
                parts = objects.car(rng) if kind < 0.8 else objects.van(rng) if kind < 0.92 else objects.truck(rng)
                movers.append(Mover(parts, x, at, pace))
            x += 9.0 + float(rng.uniform(*style.traffic_step))
    for x in _poisson(rng, style.people, street):
        side = 1.0 if rng.random() < 0.5 else -1.0
        walk = float(rng.uniform(0.8, 1.6)) * (1 if rng.random() < 0.5 else -1)
        out = street.half + float(rng.uniform(0.5, max(0.6, street.pavement)))
        movers.append(Mover(objects.pedestrian(rng), x, side * out, walk))
    for x in _poisson(rng, style.people * 0.2, street):
        side = 1.0 if rng.random() < 0.5 else -1.0
        # Beside the parked cars, or at the kerb: clear of the lanes.
        out = street.half - (2.3 if street.parked else 0.5)
        movers.append(Mover(objects.cyclist(rng), x, side * out, -side * float(rng.uniform(3, 6))))
    return movers


def _poisson(rng: Rng, per_metre: float, street: _Street) -> NDArray[np.float64]:
    return rng.uniform(street.start, street.end, int(rng.poisson(per_metre * (street.end - street.start))))
