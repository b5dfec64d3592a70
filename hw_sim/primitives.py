"""Solids a ray can meet, as arrays: tapered boxes, upright cylinders and ellipsoids, solid or porous."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

__all__ = ["Material", "PrimitiveSet", "PrimitiveSetBuilder", "Shape", "Surface", "surface_of"]

FloatArray = NDArray[np.float64]


class Surface(IntEnum):
    """What a pixel of ``Scan.surface`` shows."""

    NONE = 0
    GROUND = 1
    BUILDING = 2
    VEHICLE = 3
    PERSON = 4
    POLE = 5
    VEGETATION = 6
    OTHER = 7


class Shape(IntEnum):
    """Shape of a primitive; all are convex and symmetric about their centre, turned by ``yaw`` about z."""

    BOX = 0
    CYLINDER = 1
    ELLIPSOID = 2


class Material(IntEnum):
    """What a primitive is made of: decides its label, its windows and how it loses returns."""

    PLAIN = 0
    FACADE = 1
    WALL = 2
    CAR_PAINT = 3
    CAR_CABIN = 4
    TYRE = 5
    TRUCK_BODY = 6
    CLOTH = 7
    METAL = 8
    SIGN = 9
    BARK = 10
    FOLIAGE = 11


_SURFACE = {
    Material.PLAIN: Surface.OTHER,
    Material.FACADE: Surface.BUILDING,
    Material.WALL: Surface.OTHER,
    Material.CAR_PAINT: Surface.VEHICLE,
    Material.CAR_CABIN: Surface.VEHICLE,
    Material.TYRE: Surface.VEHICLE,
    Material.TRUCK_BODY: Surface.VEHICLE,
    Material.CLOTH: Surface.PERSON,
    Material.METAL: Surface.POLE,
    Material.SIGN: Surface.POLE,
    Material.BARK: Surface.VEGETATION,
    Material.FOLIAGE: Surface.VEGETATION,
}
_SURFACE_TABLE = np.array([_SURFACE[m] for m in Material], dtype=np.uint8)


def surface_of(material: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Labels (``Surface``) of an array of ``Material``."""
    return _SURFACE_TABLE[material]


@dataclass(frozen=True)
class PrimitiveSet:
    """``N`` primitives. Lengths in metres, angles in radians, x and y horizontal, z up, yaw counter-clockwise."""

    shape: NDArray[np.uint8]
    """``Shape``, [N]."""
    material: NDArray[np.uint8]
    """``Material``, [N]."""
    centre: FloatArray
    """[N, 3]."""
    half: FloatArray
    """Half sizes along the primitive's own axes (radii of a cylinder or ellipsoid), all > 0, [N, 3]."""
    taper: FloatArray
    """Of a box: half length and width are ``half * (1 + taper)`` at the foot, ``half * (1 - taper)`` on top, [N, 2]."""
    yaw: FloatArray
    """[N]."""
    velocity: FloatArray
    """Metres a second, [N, 3]."""
    reflectivity: FloatArray
    """Share of light returned, above 1 for retro-reflectors, [N]."""
    density: FloatArray
    """0 = solid; else the mean number of leaves a ray meets in one metre inside, [N]."""

    def __len__(self) -> int:
        return len(self.shape)

    def __getitem__(self, index: slice | NDArray[np.bool_] | NDArray[np.intp]) -> PrimitiveSet:
        return PrimitiveSet(**{f.name: getattr(self, f.name)[index] for f in fields(self)})

    def placed(self, x: float, y: float, z: float, yaw: float = 0.0, speed: float = 0.0) -> PrimitiveSet:
        """The same primitives, built around the origin, turned by ``yaw``, moved to a place, driving along ``yaw``."""
        c, s = np.cos(yaw), np.sin(yaw)
        px, py, pz = self.centre.T
        return replace(
            self,
            centre=np.column_stack([x + c * px - s * py, y + s * px + c * py, z + pz]),
            yaw=self.yaw + yaw,
            velocity=self.velocity + np.array([speed * c, speed * s, 0.0]),
        )

    @staticmethod
    def empty() -> PrimitiveSet:
        return PrimitiveSetBuilder().build()

    @staticmethod
    def joined(parts: list[PrimitiveSet]) -> PrimitiveSet:
        """All primitives of ``parts``, in order."""
        if not parts:
            return PrimitiveSet.empty()
        return PrimitiveSet(
            **{f.name: np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(PrimitiveSet)}
        )


class PrimitiveSetBuilder:
    """Collects primitives one by one."""

    def __init__(self) -> None:
        self._rows: list[tuple[int, int, tuple[float, ...]]] = []

    def add(
        self,
        shape: Shape,
        material: Material,
        centre: tuple[float, float, float],
        half: tuple[float, float, float],
        *,
        yaw: float = 0.0,
        taper: tuple[float, float] = (0.0, 0.0),
        reflectivity: float = 0.4,
        density: float = 0.0,
        velocity: tuple[float, float, float] = (0.0, 0.0, 0.0),
    ) -> None:
        """Add one primitive; see ``PrimitiveSet`` for units. ValueError for a half size that is not positive."""
        if min(half) <= 0:
            raise ValueError(f"primitive {shape.name} {material.name}: half sizes {half} must all be > 0")
        self._rows.append((shape, material, (*centre, *half, *taper, yaw, *velocity, reflectivity, density)))

    def box(
        self, material: Material, low: tuple[float, float, float], high: tuple[float, float, float], **more: float
    ) -> None:
        """Add an upright box between two corners."""
        cx, cy, cz = ((a + b) / 2 for a, b in zip(low, high, strict=True))
        hx, hy, hz = ((b - a) / 2 for a, b in zip(low, high, strict=True))
        self.add(Shape.BOX, material, (cx, cy, cz), (hx, hy, hz), **more)  # type: ignore[arg-type]

    def pole(
        self, material: Material, x: float, y: float, radius: float, low: float, high: float, **more: float
    ) -> None:
        """Add an upright cylinder from height ``low`` to ``high``."""
        self.add(
            Shape.CYLINDER,
            material,
            (x, y, (low + high) / 2),
            (radius, radius, (high - low) / 2),
            **more,  # type: ignore[arg-type]
        )

    def build(self) -> PrimitiveSet:
        rows = self._rows
        v = np.array([r[2] for r in rows], dtype=np.float64).reshape(len(rows), 14)
        return PrimitiveSet(
            shape=np.array([r[0] for r in rows], dtype=np.uint8),
            material=np.array([r[1] for r in rows], dtype=np.uint8),
            centre=v[:, 0:3],
            half=v[:, 3:6],
            taper=v[:, 6:8],
            yaw=v[:, 8],
            velocity=v[:, 9:12],
            reflectivity=v[:, 12],
            density=v[:, 13],
        )
