"""The ground of a scene: a road with kerbs on gently rolling land."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["Ground"]

Array = NDArray[Any]


@dataclass(frozen=True)
class Ground:
    """Height of the land over (x, y), and the road that runs along x on it. Metres.

    The smooth surface is ``z0 + slope . (x, y) + sum of waves``; the pavement beside the road stands
    ``kerb_height`` above it. The road's centre line is
    ``y = bend_amplitude * sin(bend_rate * x + bend_phase) + bend_shift``.
    """

    z0: float = 0.0
    slope: tuple[float, float] = (0.0, 0.0)
    waves: tuple[tuple[float, float, float, float], ...] = ()
    """(amplitude in m, radians per m along x, along y, phase) each."""
    road_half_width: float = 5.0
    kerb_height: float = 0.0
    bend_amplitude: float = 0.0
    bend_rate: float = 0.0
    bend_phase: float = 0.0
    bend_shift: float = 0.0
    crossings: tuple[tuple[float, float], ...] = field(default=())
    """Side streets without kerb: (x of the centre, half width) each."""
    lane_marks: tuple[float, ...] = ()
    """Distances of painted lines from the centre line."""
    paved: bool = True
    """Whether stone lies beside the road, or grass."""
    shift_x: float = 0.0
    """x of this frame's origin in the scene: keeps the dashes of lane marks in place."""

    def height(self, x: Array, y: Array) -> Array:
        """Smooth height (without the kerb) at ``x``, ``y``, in their own dtype."""
        z = self.slope[0] * x + self.slope[1] * y + self.z0
        for amplitude, kx, ky, phase in self.waves:
            z = z + amplitude * np.sin(kx * x + ky * y + phase)
        return np.asarray(z)

    def gradient(self, x: Array, y: Array) -> tuple[Array, Array]:
        """Slope of ``height`` along x and along y."""
        gx, gy = x * 0 + self.slope[0], y * 0 + self.slope[1]
        for amplitude, kx, ky, phase in self.waves:
            c = amplitude * np.cos(kx * x + ky * y + phase)
            gx, gy = gx + kx * c, gy + ky * c
        return np.asarray(gx), np.asarray(gy)

    def centre_line(self, x: Array) -> Array:
        """y of the road's middle at ``x``."""
        return np.asarray(self.bend_amplitude * np.sin(self.bend_rate * x + self.bend_phase) + self.bend_shift)

    def heading(self, x: Array) -> Array:
        """Direction of the road at ``x``, radians counter-clockwise from x."""
        return np.asarray(
            np.arctan(self.bend_amplitude * self.bend_rate * np.cos(self.bend_rate * x + self.bend_phase))
        )

    def in_crossing(self, x: Array) -> NDArray[np.bool_]:
        """Where a side street opens."""
        inside = np.zeros(np.shape(x), dtype=bool)
        for centre, half in self.crossings:
            inside |= np.abs(x - centre) < half
        return inside

    def at(self, x: float, y: float) -> float:
        """Height of the surface one stands on, pavement included."""
        z = float(self.height(np.float64(x), np.float64(y)))
        off_road = abs(y - float(self.centre_line(np.float64(x)))) >= self.road_half_width
        raised = off_road and not bool(self.in_crossing(np.asarray(x)))
        return z + (self.kerb_height if raised else 0.0)

    def seen_from(self, x: float, y: float, z: float) -> Ground:
        """The same ground in coordinates whose origin is (x, y, z)."""
        return replace(
            self,
            z0=self.z0 + self.slope[0] * x + self.slope[1] * y - z,
            waves=tuple((a, kx, ky, phase + kx * x + ky * y) for a, kx, ky, phase in self.waves),
            bend_phase=self.bend_phase + self.bend_rate * x,
            bend_shift=self.bend_shift - y,
            crossings=tuple((c - x, h) for c, h in self.crossings),
            shift_x=self.shift_x + x,
        )
