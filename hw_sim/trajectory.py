"""How the sensor's vehicle moves."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .ground import Ground

__all__ = ["Trajectory"]

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Trajectory:
    """Place and direction of the vehicle over time, linear between knots and beyond the ends.

    ``time_s`` rises; ``x``, ``y`` in metres; ``yaw`` in radians counter-clockwise, unwrapped; all ``float64[knots]``.
    """

    time_s: FloatArray
    x: FloatArray
    y: FloatArray
    yaw: FloatArray

    def at(self, time_s: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """``x``, ``y``, ``yaw`` at given times."""
        i = np.clip(np.searchsorted(self.time_s, time_s) - 1, 0, len(self.time_s) - 2)
        share = (time_s - self.time_s[i]) / (self.time_s[i + 1] - self.time_s[i])
        x, y, yaw = (v[i] + share * (v[i + 1] - v[i]) for v in (self.x, self.y, self.yaw))
        return x, y, yaw

    @staticmethod
    def arc(
        speed: float = 0.0,
        yaw_rate: float = 0.0,
        *,
        x: float = 0.0,
        y: float = 0.0,
        yaw: float = 0.0,
        seconds: float = 40.0,
    ) -> Trajectory:
        """Constant ``speed`` (m/s) and ``yaw_rate`` (rad/s, counter-clockwise) from a place at time 0."""
        t = np.arange(-1.0, seconds + 0.01, 0.01)
        heading = yaw + yaw_rate * t
        if abs(yaw_rate) < 1e-9:
            return Trajectory(t, x + speed * t * np.cos(yaw), y + speed * t * np.sin(yaw), heading)
        radius = speed / yaw_rate
        return Trajectory(
            t, x + radius * (np.sin(heading) - np.sin(yaw)), y - radius * (np.cos(heading) - np.cos(yaw)), heading
        )

    @staticmethod
    def along(ground: Ground, lane: float, speed: float, *, x: float = 0.0, seconds: float = 40.0) -> Trajectory:
        """Along the road, ``lane`` metres left of its middle."""
        t = np.arange(-1.0, seconds + 0.02, 0.02)
        px = x + speed * t
        return Trajectory(t, px, ground.centre_line(px) + lane, ground.heading(px))
