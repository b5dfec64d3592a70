"""How a spinning sensor turns: its azimuth as a closed function of time, so that any moment can be asked for."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

__all__ = ["Motor"]

FloatArray = NDArray[np.float64]

_PERIODS_S = np.array([0.73, 2.3, 7.1])
"""Of the wander's parts: a load that changes within a turn or two, bearings, temperature. Incommensurate."""
_WEIGHTS = np.array([0.25, 0.35, 0.4])


@dataclass(frozen=True)
class Motor:
    """Speed ``rate_hz * (1 + wander * s(t))`` with a smooth ``s`` in [-1, 1] drawn from the seed."""

    rate_hz: float
    """Turns per second, 5 to 20 on real sensors."""
    wander: float = 0.0
    """Largest relative deviation of the speed, 0 to 0.5; 0.1 has been seen on cold sensors."""
    start_turns: float = 0.0
    """Azimuth at time 0, in turns."""
    seed: int = 0
    _phase: FloatArray = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if not 1 <= self.rate_hz <= 100:
            raise ValueError(f"rate of {self.rate_hz} turns per second: expected 1 to 100")
        if not 0 <= self.wander <= 0.5:
            raise ValueError(f"wander {self.wander}: expected 0 to 0.5 of the speed")
        phase = np.random.default_rng([self.seed, 0x407]).uniform(0, 2 * np.pi, len(_PERIODS_S))
        object.__setattr__(self, "_phase", phase)

    def rate_at(self, time_s: FloatArray) -> FloatArray:
        """Turns per second at given times."""
        angle = 2 * np.pi * time_s[..., None] / _PERIODS_S + self._phase
        return np.asarray(self.rate_hz * (1 + self.wander * (np.sin(angle) @ _WEIGHTS)))

    def turns(self, time_s: FloatArray) -> FloatArray:
        """Turns since azimuth 0 at given times: the integral of the speed, rising."""
        angle = 2 * np.pi * time_s[..., None] / _PERIODS_S
        swing = (np.cos(self._phase) - np.cos(angle + self._phase)) * _PERIODS_S / (2 * np.pi)
        return np.asarray(self.start_turns + self.rate_hz * (time_s + self.wander * (swing @ _WEIGHTS)))
