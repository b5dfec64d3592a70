"""What a hit looks like to the laser: label, reflectivity, incidence, glass, relief of facades."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .ground import Ground
from .primitives import Material, PrimitiveSet, Shape, Surface, surface_of
from .raycast import GROUND, NOTHING, Rays

__all__ = ["Shading", "shade"]

F32 = NDArray[np.float32]
Array = NDArray[Any]


@dataclass(frozen=True)
class Shading:
    """Per ray, ``[beams, columns]``."""

    surface: NDArray[np.uint8]
    reflectivity: F32
    cosine: F32
    """Of the angle between the ray and the surface's normal, 0..1."""
    loss: F32
    """Chance that glass or a mirror sends the pulse elsewhere, 0..1."""
    deeper: F32
    """Metres to add along the ray where a window or door stands back."""


def shade(rays: Rays, ground: Ground | None, p: PrimitiveSet, depth: F32, hit: NDArray[np.int32]) -> Shading:
    """Look up every hit of ``cast``."""
    out = Shading(np.zeros(rays.shape, np.uint8), *(np.zeros(rays.shape, np.float32) for _ in range(4)))
    if ground is not None:
        _shade_ground(rays, ground, depth, np.flatnonzero(hit.ravel() == GROUND), out)
    if len(p):
        solid = np.flatnonzero(hit.ravel() > NOTHING + 1)
        with np.errstate(all="ignore"):
            _shade_primitives(rays, p, depth, solid, hit.ravel()[solid], out)
    return out


def _hash(*keys: Array) -> F32:
    """Uniform numbers in [0, 1) from whole numbers."""
    h = np.zeros(np.broadcast(*keys).shape, dtype=np.uint32)
    for k in keys:
        h = (h ^ k.astype(np.int32).view(np.uint32)) * np.uint32(0x9E3779B1)
        h ^= h >> np.uint32(15)
        h *= np.uint32(0x85EBCA6B)
        h ^= h >> np.uint32(13)
    return np.asarray((h >> np.uint32(8)).astype(np.float32) * np.float32(2.0**-24))


def _shade_ground(rays: Rays, ground: Ground, depth: F32, at: Array, out: Shading) -> None:
    t = depth.ravel()[at]
    dx, dy, dz = rays.dx.ravel()[at], rays.dy.ravel()[at], rays.dz.ravel()[at]
    x, y = rays.ox.ravel()[at] + t * dx, rays.oy.ravel()[at] + t * dy
    gx, gy = ground.gradient(x, y)
    lateral = y - ground.centre_line(x)
    along = x + np.float32(ground.shift_x % 1200.0)
    off = np.abs(lateral) > ground.road_half_width
    beside = np.float32(0.44 if ground.paved else 0.5)
    patch = _hash(np.floor(along / 2.5), np.floor(lateral / 2.5))
    reflectivity = np.where(off, beside, np.float32(0.38)) * (0.9 + 0.2 * patch)
    for mark in ground.lane_marks:
        painted = (np.abs(lateral - np.float32(mark)) < 0.08) & (along % 9.0 < 4.0)
        reflectivity = np.where(painted, np.float32(0.75), reflectivity)
    edge = np.abs(np.abs(lateral) - np.float32(ground.road_half_width - 0.25)) < 0.07
    if not ground.paved:
        reflectivity = np.where(edge, np.float32(0.7), reflectivity)
    out.surface.ravel()[at] = Surface.GROUND
    out.reflectivity.ravel()[at] = reflectivity
    out.cosine.ravel()[at] = np.clip(gx * dx + gy * dy - dz, 0.0, 1.0)


def _shade_primitives(rays: Rays, p: PrimitiveSet, depth: F32, at: Array, index: Array, out: Shading) -> None:
    table = np.column_stack([p.centre, 1 / p.half, np.cos(p.yaw), np.sin(p.yaw), p.taper, p.velocity]).astype(
        np.float32
    )
    row = table[index]
    t, time = depth.ravel()[at], rays.time.ravel()[at]
    dx, dy, dz = rays.dx.ravel()[at], rays.dy.ravel()[at], rays.dz.ravel()[at]
    x = rays.ox.ravel()[at] + t * dx - row[:, 0] - time * row[:, 10]
    y = rays.oy.ravel()[at] + t * dy - row[:, 1] - time * row[:, 11]
    z = rays.oz.ravel()[at] + t * dz - row[:, 2] - time * row[:, 12]
    c, s = row[:, 6], row[:, 7]
    # Hit and direction in the primitive's own axes, the hit in half sizes.
    px, py, pz = (c * x + s * y) * row[:, 3], (c * y - s * x) * row[:, 4], z * row[:, 5]
    ux, uy = c * dx + s * dy, c * dy - s * dx
    shape, material = p.shape[index], p.material[index]
    face, cosine = _incidence(shape, px, py, pz, ux, uy, dz, row)
    cosine = np.where(p.density[index] > 0, np.float32(0.6) + np.float32(0.4) * _hash(at, index), cosine)
    reflectivity = p.reflectivity[index].astype(np.float32)
    loss, deeper = np.zeros_like(t), np.zeros_like(t)

    which = np.flatnonzero(material == Material.FACADE)
    if len(which):
        _facade(which, face, px, py, z, row, cosine, index, reflectivity, loss, deeper)
    which = np.flatnonzero(material == Material.CAR_CABIN)
    glass = (
        (np.abs(pz[which]) < 0.78)
        & (face[which] < 2)
        & (np.abs(np.where(face[which] == 1, px[which], py[which])) < 0.88)
    )
    pillar = (face[which] == 1) & (np.abs(px[which] + 0.1) < 0.07)
    loss[which] = np.where(glass & ~pillar, np.float32(0.9), np.float32(0))
    which = np.flatnonzero(material == Material.CAR_PAINT)
    plate = (face[which] == 0) & (np.abs(py[which]) < 0.28) & (np.abs(pz[which] + 0.35) < 0.18)
    lamp = (face[which] == 0) & (np.abs(py[which]) > 0.7) & (np.abs(pz[which] - 0.35) < 0.25)
    reflectivity[which] = np.where(plate, np.float32(1.4), np.where(lamp, np.float32(0.8), reflectivity[which]))
    paint = np.isin(material, (Material.CAR_PAINT, Material.CAR_CABIN, Material.TRUCK_BODY))
    loss = np.where(paint, np.maximum(loss, 0.75 * (1 - cosine) ** 3 * (1 - reflectivity)), loss)

    out.surface.ravel()[at] = surface_of(material)
    out.reflectivity.ravel()[at] = reflectivity
    out.cosine.ravel()[at] = cosine
    out.loss.ravel()[at] = loss
    out.deeper.ravel()[at] = deeper


def _incidence(shape: Array, px: F32, py: F32, pz: F32, ux: F32, uy: F32, uz: F32, row: F32) -> tuple[Array, F32]:
    """Face met (0: end, 1: side, 2: top or foot) and cosine of incidence."""
    ax, ay, az = np.abs(px) + row[:, 8] * pz, np.abs(py) + row[:, 9] * pz, np.abs(pz)
    box = shape == Shape.BOX
    ends = np.where(ax >= ay, 0, 1)
    face = np.where(
        box, np.where(az > np.maximum(ax, ay), 2, ends), np.where((shape == Shape.CYLINDER) & (az > 0.999), 2, 1)
    )
    nx, ny = px * row[:, 3], py * row[:, 4]
    nz = np.where(shape == Shape.ELLIPSOID, pz * row[:, 5], np.float32(0))
    rounded = np.abs(nx * ux + ny * uy + nz * uz) / np.sqrt(nx * nx + ny * ny + nz * nz + 1e-9)
    kx, ky = row[:, 8] * row[:, 5] / row[:, 3], row[:, 9] * row[:, 5] / row[:, 4]
    slant_x = np.abs(np.sign(px) * ux + kx * uz) / np.sqrt(1 + kx * kx)
    slant_y = np.abs(np.sign(py) * uy + ky * uz) / np.sqrt(1 + ky * ky)
    flat = np.where(face == 0, slant_x, np.where(face == 1, slant_y, np.abs(uz)))
    cosine = np.where(box | (face == 2), np.where(box, flat, np.abs(uz)), rounded)
    return face, np.clip(cosine, 0.0, 1.0).astype(np.float32)


def _facade(
    which: Array,
    face: Array,
    px: F32,
    py: F32,
    z: F32,
    row: F32,
    cosine: F32,
    index: Array,
    reflectivity: F32,
    loss: F32,
    deeper: F32,
) -> None:
    """Rows of windows that stand back in the wall; some are glass that returns nothing."""
    side = face[which] == 1
    along = np.where(side, px[which] / row[which, 3], py[which] / row[which, 4])
    house = index[which]
    style = _hash(house, np.int32(3) * np.ones_like(house))
    pitch = np.float32(1.6) + np.float32(2.0) * style
    column, storey = np.floor(along / pitch), np.floor((z[which] + 500) / np.float32(2.9))
    u, v = along / pitch - column, (z[which] + 500) / np.float32(2.9) - storey
    window = (np.abs(u - 0.5) < 0.16 + 0.16 * style) & (np.abs(v - 0.5) < 0.27) & (face[which] < 2)
    kind = _hash(house, column, storey)
    back = np.where(kind < 0.3, np.float32(0.35), np.float32(0.14)) + np.where(
        kind > 0.95, np.float32(1.6), np.float32(0)
    )
    deeper[which] = np.where(window, back / np.maximum(cosine[which], 0.35), np.float32(0))
    loss[which] = np.where(window & (kind < 0.55), np.float32(0.45), np.float32(0))
    relief = np.float32(0.06) * (_hash(house, np.floor(along * 1.7)) - np.float32(0.5))
    deeper[which] += np.where(face[which] < 2, np.maximum(relief, 0), np.float32(0))
    reflectivity[which] *= np.where(window, np.where(kind > 0.75, np.float32(0.1), np.float32(0.5)), np.float32(1.0))
