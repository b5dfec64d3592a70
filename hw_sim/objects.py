"""Things that stand or move in a street, built around the origin: front along x, left along y, foot at z = 0."""

from __future__ import annotations

import numpy as np

from .primitives import Material, PrimitiveSet, PrimitiveSetBuilder, Shape

__all__ = ["bush", "car", "cyclist", "house", "lamp_post", "pedestrian", "road_sign", "tree", "truck", "van"]

Rng = np.random.Generator


def _paint(rng: Rng) -> float:
    """Reflectivity of a car's paint: many are nearly black to the laser."""
    return float(rng.choice([0.03, 0.08, 0.2, 0.45, 0.7], p=[0.3, 0.15, 0.2, 0.2, 0.15]))


def car(rng: Rng) -> PrimitiveSet:
    """Body, tapered cabin and two axles."""
    b = PrimitiveSetBuilder()
    length, width = rng.uniform(3.7, 4.8), rng.uniform(1.65, 1.88)
    waist, roof = rng.uniform(0.85, 1.0), rng.uniform(1.4, 1.65)
    paint = _paint(rng)
    b.add(
        Shape.BOX, Material.CAR_PAINT, (0, 0, (0.25 + waist) / 2), (length / 2, width / 2, (waist - 0.25) / 2),
        taper=(0.04, 0.02), reflectivity=paint,
    )  # fmt: skip
    cabin = rng.uniform(0.30, 0.38) * length
    b.add(
        Shape.BOX, Material.CAR_CABIN, (-0.06 * length, 0, (waist + roof) / 2),
        (cabin, width * 0.44, (roof - waist) / 2),
        taper=(0.22, 0.1), reflectivity=paint,
    )  # fmt: skip
    for axle in (0.3 * length, -0.3 * length):
        b.box(Material.TYRE, (axle - 0.3, -width * 0.49, 0.0), (axle + 0.3, width * 0.49, 0.4), reflectivity=0.06)
    return b.build()


def van(rng: Rng) -> PrimitiveSet:
    """A delivery van: high body, short sloped nose."""
    b = PrimitiveSetBuilder()
    length, width, height = rng.uniform(4.8, 5.9), rng.uniform(1.9, 2.05), rng.uniform(1.9, 2.6)
    paint = _paint(rng) + 0.15
    b.box(
        Material.TRUCK_BODY, (-length / 2, -width / 2, 0.35), (length / 2 - 1.2, width / 2, height), reflectivity=paint
    )
    b.box(Material.CAR_PAINT, (length / 2 - 1.2, -width / 2, 0.35), (length / 2, width / 2, 1.15), reflectivity=paint)
    b.add(
        Shape.BOX, Material.CAR_CABIN, (length / 2 - 1.3, 0, (1.15 + height) / 2),
        (0.7, width * 0.47, (height - 1.15) / 2),
        taper=(0.4, 0.06), reflectivity=paint,
    )  # fmt: skip
    for axle in (0.32 * length, -0.32 * length):
        b.box(Material.TYRE, (axle - 0.34, -width * 0.48, 0), (axle + 0.34, width * 0.48, 0.5), reflectivity=0.06)
    return b.build()


def truck(rng: Rng) -> PrimitiveSet:
    """Cab, box body standing on axles."""
    b = PrimitiveSetBuilder()
    length, width, height = rng.uniform(7.0, 13.0), 2.5, rng.uniform(3.2, 4.0)
    shade = float(rng.uniform(0.3, 0.8))
    b.box(
        Material.TRUCK_BODY, (-length / 2, -width / 2, 1.0), (length / 2 - 2.4, width / 2, height), reflectivity=shade
    )
    b.add(
        Shape.BOX, Material.TRUCK_BODY, (length / 2 - 1.1, 0, 1.7), (1.1, width / 2 - 0.05, 1.25),
        taper=(0.08, 0.02), reflectivity=_paint(rng) + 0.1,
    )  # fmt: skip
    b.box(Material.METAL, (-length / 2 + 0.2, -0.5, 0.6), (length / 2 - 1.0, 0.5, 1.0), reflectivity=0.15)
    for axle in (length / 2 - 1.3, -length / 2 + 1.4, -length / 2 + 2.6):
        b.box(Material.TYRE, (axle - 0.48, -width * 0.48, 0), (axle + 0.48, width * 0.48, 0.95), reflectivity=0.06)
    return b.build()


def pedestrian(rng: Rng) -> PrimitiveSet:
    """Two legs in mid step, a trunk and a head."""
    b = PrimitiveSetBuilder()
    tall, cloth = rng.uniform(1.5, 1.9), float(rng.uniform(0.15, 0.6))
    step = rng.uniform(0.05, 0.22)
    hip = 0.48 * tall
    for side in (1, -1):
        b.pole(Material.CLOTH, side * step, side * 0.09, 0.08, 0.0, hip, reflectivity=cloth * 0.8)
    b.add(Shape.CYLINDER, Material.CLOTH, (0, 0, 0.66 * tall), (0.15, 0.24, 0.19 * tall), reflectivity=cloth)
    b.add(Shape.ELLIPSOID, Material.CLOTH, (0, 0, 0.92 * tall), (0.11, 0.09, 0.08 * tall), reflectivity=0.45)
    return b.build()


def cyclist(rng: Rng) -> PrimitiveSet:
    """Two wheels, a frame and a leaning rider."""
    b = PrimitiveSetBuilder()
    cloth = float(rng.uniform(0.2, 0.6))
    for wheel in (0.52, -0.52):
        b.add(Shape.BOX, Material.CLOTH, (wheel, 0, 0.34), (0.3, 0.03, 0.33), reflectivity=0.15, density=4.0)
    b.box(Material.CLOTH, (-0.4, -0.04, 0.35), (0.5, 0.04, 0.75), reflectivity=0.3, density=6.0)
    b.add(Shape.CYLINDER, Material.CLOTH, (-0.1, 0, 0.75), (0.13, 0.17, 0.38), reflectivity=cloth)
    b.add(Shape.ELLIPSOID, Material.CLOTH, (0.08, 0, 1.28), (0.3, 0.21, 0.26), reflectivity=cloth)
    b.add(Shape.ELLIPSOID, Material.CLOTH, (0.25, 0, 1.62), (0.13, 0.1, 0.14), reflectivity=0.45)
    return b.build()


def tree(rng: Rng) -> PrimitiveSet:
    """A trunk and a crown of three or four overlapping porous balls."""
    b = PrimitiveSetBuilder()
    tall, clear = rng.uniform(5.0, 11.0), rng.uniform(1.2, 3.0)
    radius = rng.uniform(0.09, 0.28)
    b.pole(Material.BARK, 0, 0, radius, 0.0, clear + 0.35 * (tall - clear), reflectivity=0.3)
    spread = rng.uniform(0.25, 0.42) * (tall - clear) + 0.6
    leaves = float(rng.uniform(0.45, 1.4))
    for _ in range(int(rng.integers(2, 5))):
        off = rng.normal(0, 0.4 * spread, 2)
        size = spread * rng.uniform(0.55, 1.0)
        z = clear + size * 0.8 + rng.uniform(0, 0.45) * (tall - clear)
        b.add(
            Shape.ELLIPSOID, Material.FOLIAGE, (off[0], off[1], z), (size, size * rng.uniform(0.8, 1.2), size * 0.85),
            reflectivity=float(rng.uniform(0.3, 0.55)), density=leaves,
        )  # fmt: skip
    return b.build()


def bush(rng: Rng, size: float | None = None) -> PrimitiveSet:
    """A few balls of leaves standing on the ground."""
    b = PrimitiveSetBuilder()
    r = float(size if size is not None else rng.uniform(0.5, 1.8))
    shade, leaves = float(rng.uniform(0.35, 0.6)), float(rng.uniform(1.0, 3.5)) / max(1.0, r)
    for _ in range(int(rng.integers(2, 4))):
        off, part = rng.normal(0, 0.35 * r, 2), r * rng.uniform(0.55, 1.0)
        height = part * rng.uniform(0.7, 1.5)
        b.add(
            Shape.ELLIPSOID, Material.FOLIAGE, (off[0], off[1], height * 0.55),
            (part, part * rng.uniform(0.7, 1.4), height),
            yaw=float(rng.uniform(0, 3)), reflectivity=shade, density=leaves,
        )  # fmt: skip
    return b.build()


def house(rng: Rng, length: float, depth: float, height: float) -> PrimitiveSet:
    """Main block with its facade along x (street side at -y), sometimes bays, balconies, steps or an annexe."""
    b = PrimitiveSetBuilder()
    shade = float(rng.uniform(0.3, 0.6))
    b.box(Material.FACADE, (-length / 2, 0, -1.0), (length / 2, depth, height), reflectivity=shade)
    if rng.random() < 0.5 and length > 6:
        at, out = rng.uniform(-0.3, 0.3) * length, rng.uniform(0.3, 1.2)
        b.box(
            Material.FACADE,
            (at - 1.6, -out, 0 if rng.random() < 0.6 else 2.6),
            (at + 1.6, 0.1, height * 0.9),
            reflectivity=shade,
        )
    if rng.random() < 0.4:
        for at in np.arange(-length / 2 + 2, length / 2 - 2, 5.0).tolist():
            b.box(Material.FACADE, (at, -1.0, 2.9), (at + 2.4, 0.0, 3.9), reflectivity=shade * 0.9)
    door = rng.uniform(-0.4, 0.4) * length
    b.box(Material.WALL, (door - 0.8, -0.9, 0), (door + 0.8, 0.05, 0.35), reflectivity=0.35)
    if rng.random() < 0.3:
        b.box(Material.FACADE, (length / 2 - 0.1, 1.5, 0), (length / 2 + 3.0, depth * 0.8, 2.6), reflectivity=shade)
    return b.build()


def lamp_post(rng: Rng) -> PrimitiveSet:
    """A slender post with an arm."""
    b = PrimitiveSetBuilder()
    tall = rng.uniform(4.0, 8.0)
    b.pole(Material.METAL, 0, 0, rng.uniform(0.05, 0.1), 0.0, tall, reflectivity=0.35)
    b.box(Material.METAL, (-0.05, -1.2, tall - 0.1), (0.05, 0.0, tall), reflectivity=0.35)
    return b.build()


def road_sign(rng: Rng) -> PrimitiveSet:
    """A retro-reflecting plate on a post, facing along -x."""
    b = PrimitiveSetBuilder()
    z, size = rng.uniform(1.9, 2.5), rng.uniform(0.25, 0.45)
    b.pole(Material.METAL, 0, 0, 0.035, 0.0, z + size, reflectivity=0.4)
    b.box(Material.SIGN, (-0.06, -size, z - size), (-0.03, size, z + size), reflectivity=float(rng.uniform(1.2, 2.5)))
    return b.build()
