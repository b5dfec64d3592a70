"""Faults of the medium: what fog, foreign sensors and dirt do to returns. Modelled, not measured: each model is stated.

Returns are changed in the packets, so an intensity is the sensor's: Velodyne's 0..100 is diffuse reflectivity in
per cent, above are retroreflectors.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from upbeam.model.beams import BeamTable

from .base import PacketFault, Step, fault
from .sensor import beam_cells, edit

__all__ = ["FOG_VISIBILITY_M", "BeamsMissing", "Crosstalk", "Fog", "FogOptics"]


@fault("physics", "beams_missing")
@dataclass(frozen=True, kw_only=True)
class BeamsMissing(PacketFault):
    """Every ``every``-th beam returns nothing: dirt on a lens, a bank of receivers lost."""

    every: int = 4

    def begin(self, beams: BeamTable, rng: np.random.Generator) -> Step:
        self.within("every", 2, beams.beams)
        cells = [cell for beam in range(0, beams.beams, self.every) for cell in beam_cells(beams, beam)]

        def change(packet: NDArray[Any]) -> None:
            packet["blocks"]["returns"][:, :, cells] = 0

        return lambda datagram: (edit(datagram, change),)


@fault("physics", "crosstalk")
@dataclass(frozen=True, kw_only=True)
class Crosstalk(PacketFault):
    """Another sensor's pulses: a share of samples shows a return anywhere before the true one (anywhere within reach
    where there was none), as bright as the pulse that strayed in."""

    rate: float = 0.02
    reach_m: float = 100.0

    def begin(self, beams: BeamTable, rng: np.random.Generator) -> Step:
        self.within("rate", 0, 1)
        self.within("reach_m", 1, 260)
        reach = min(65535, round(self.reach_m / beams.distance_unit_m))

        def change(packet: NDArray[Any]) -> None:
            returns = packet["blocks"]["returns"]
            distance = returns["distance"]
            hit = rng.random(distance.shape) < self.rate
            before = np.where(distance > 0, distance, reach)
            stray = 1 + np.floor(rng.random(distance.shape) * (before - 1)).astype(np.uint16)
            returns["distance"] = np.where(hit, stray, distance)
            returns["intensity"] = np.where(hit, rng.integers(1, 256, distance.shape), returns["intensity"])

        return lambda datagram: (edit(datagram, change),)


FOG_VISIBILITY_M = {"light": 200.0, "moderate": 60.0, "dense": 30.0}
"""Meteorological optical range of the three severities, metres: where 5 % of the contrast is left."""


@dataclass(frozen=True)
class FogOptics:
    """A sensor in homogeneous fog, single scattering, one echo kept: the strongest.

    With meteorological optical range V the extinction is ``alpha = ln(20) / V`` per metre and the backscatter
    ``beta = 0.046 / V`` per metre and steradian (Rasshofer, Spies, Spies 2011). A diffuse target of reflectivity rho at
    range R returns ``rho / pi / R^2 * exp(-2 alpha R)``; fog at range r returns
    ``beta * pulse / 2 / r^2 * exp(-2 alpha r)``, times an exponential deviate (speckle). The receiver's gain rises with
    the square of the range up to ``full_gain_m``; what stays below the power of a 10 % target at ``reach_10_m`` in
    clear air is lost.
    """

    visibility_m: float
    reach_10_m: float = 80.0
    """Clear-air range for a target of 10 % reflectivity (data sheets: 80 to 120 m)."""
    full_gain_m: float = 15.0
    """Assumption: near returns are attenuated, or every sensor would be blind in its own fog."""
    overlap_m: float = 4.0
    """Assumption: nearer than this, receiver and laser do not look at the same place."""
    pulse_m: float = 1.8
    """Length of the pulse: 6 ns."""

    @property
    def extinction(self) -> float:
        """alpha, per metre."""
        return float(np.log(20.0) / self.visibility_m)

    def received(self, metres: NDArray[np.float64], reflectivity: NDArray[np.float64]) -> NDArray[np.float64]:
        """Power of diffuse targets after the receiver's gain; 0 where there is none (0 m)."""
        r = np.maximum(metres, 0.1)
        power = reflectivity / np.pi / r**2 * np.exp(-2 * self.extinction * r) * self._gain(r)
        return np.where(metres > 0, power, 0.0)

    def threshold(self) -> float:
        """Least power that is seen."""
        return 0.1 / np.pi / self.reach_10_m**2

    def backscatter(
        self, shape: tuple[int, ...], rng: np.random.Generator
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Range and received power of the fog's own echo. Its range has the survival function
        ``overlap_m / r * exp(-2 alpha (r - overlap_m))``: power falls with the square and with extinction."""
        pareto = self.overlap_m / (1.0 - rng.random(shape))
        metres = np.minimum(pareto, self.overlap_m + rng.exponential(1 / (2 * self.extinction), shape))
        beta = 0.046 / self.visibility_m
        at = self.overlap_m
        peak = beta * self.pulse_m / 2 / at**2 * np.exp(-2 * self.extinction * at) * self._gain(np.asarray(at))
        return metres, peak * rng.exponential(1.0, shape)

    def _gain(self, metres: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(np.minimum(1.0, (metres / self.full_gain_m) ** 2))


@fault("physics", "fog")
@dataclass(frozen=True, kw_only=True)
class Fog(PacketFault):
    """Fog of three severities, see ``FogOptics``: weak and far returns are lost, others darken, some are the fog's."""

    severity: str = "moderate"
    """light, moderate or dense."""

    def begin(self, beams: BeamTable, rng: np.random.Generator) -> Step:
        if self.severity not in FOG_VISIBILITY_M:
            raise ValueError(f"fog: severity {self.severity!r}: expected one of {', '.join(FOG_VISIBILITY_M)}")
        optics = FogOptics(FOG_VISIBILITY_M[self.severity])
        unit = beams.distance_unit_m

        def change(packet: NDArray[Any]) -> None:
            returns = packet["blocks"]["returns"]
            counts, intensity = fog_returns(optics, returns["distance"], returns["intensity"], unit, rng)
            returns["distance"], returns["intensity"] = counts, intensity

        return lambda datagram: (edit(datagram, change),)


def fog_returns(
    optics: FogOptics, counts: NDArray[np.uint16], intensity: NDArray[np.uint8], unit_m: float, rng: np.random.Generator
) -> tuple[NDArray[np.uint16], NDArray[np.uint8]]:
    """Clear-air returns as the sensor would have seen them in fog."""
    metres = counts.astype(np.float64) * unit_m
    hard = optics.received(metres, np.maximum(intensity, 1) / 100.0)
    fog_m, soft = optics.backscatter(counts.shape, rng)
    # Fog behind a target is not lit.
    soft = np.where((metres > 0) & (fog_m > metres), 0.0, soft)
    seen = np.maximum(hard, soft) >= optics.threshold()
    of_fog = seen & (soft > hard)
    dimmed = np.floor(intensity * np.exp(-2 * optics.extinction * metres) + 0.5)
    out = np.where(of_fog, np.floor(fog_m / unit_m + 0.5), np.where(seen, counts, 0))
    out = np.where(out > 65535, 0, out)
    # An echo of fog is the power of a target darker than 1 %.
    return out.astype(np.uint16), np.where(out > 0, np.where(of_fog, 0, dimmed), 0).astype(np.uint8)
