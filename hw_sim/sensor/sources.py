"""What a simulated sensor sees: returns for any firing, from a quick room for tests or from the ray-cast streets."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from upbeam.hw_sim.lidar import Scan
from upbeam.model.beams import BeamTable

__all__ = ["FiringSource", "QuickRoom", "Returns", "ScanLoop"]

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Returns:
    """What some firings brought back, beam 0 = top."""

    distance: NDArray[np.uint16]
    """Counts of the sensor's unit, 0 = no return, [firings, beams]."""
    intensity: NDArray[np.uint8]
    """[firings, beams]"""


class FiringSource(Protocol):
    """Answers what firings see; the same question gives the same bits."""

    @property
    def beams(self) -> BeamTable: ...

    def returns(self, turns: FloatArray, firing: NDArray[np.int64]) -> Returns:
        """Of firings at ``turns`` (azimuth in turns since the source's first cut, rising) with running numbers
        ``firing``."""
        ...


@dataclass(frozen=True)
class QuickRoom:
    """A walled yard with a few poles that walk round it: cheap, deterministic, every beam sees something.

    Dark ground, walls of a quarter's reflectivity, bright poles, graded as Velodyne does: 0..100 in per cent. Returns
    carry noise that depends on seed, firing and beam alone, as a real sensor's do: without it a beam that
    looks at level ground would be indistinguishable from one that is stuck.
    """

    beams: BeamTable
    seed: int = 0
    half_length_m: float = 55.0
    half_width_m: float = 18.0
    wall_m: float = 5.0
    """Height of the walls over the ground."""
    sensor_height_m: float = 1.8
    noise_m: float = 0.012
    """Largest deviation of a distance, uniform."""

    def returns(self, turns: FloatArray, firing: NDArray[np.int64]) -> Returns:
        table = self.beams
        azimuth = 2 * np.pi * turns[:, None] + np.radians(table.azimuth_offset_deg)[None, :]
        flat = self._walls(azimuth)
        flat = np.where(self._pole(azimuth, turns), np.minimum(flat, 7.0), flat)
        elevation = np.radians(table.elevation_deg)[None, :]
        slant = flat / np.cos(elevation)
        with np.errstate(divide="ignore"):
            ground = np.where(elevation < 0, self.sensor_height_m / np.sin(-elevation), np.inf)
        sky = flat * np.tan(elevation) > self.wall_m - self.sensor_height_m
        metres = np.minimum(slant, ground)
        chance = _chance(self.seed, firing, table.beams)
        metres = metres + (chance - 0.5) * (2 * self.noise_m)
        counts = np.floor(metres / table.distance_unit_m + 0.5)
        counts[(sky & (metres < ground)) | (counts > 65535) | (chance < 0.02)] = 0
        bright = np.where(ground < slant, 10.0, np.where(flat < 8.0, 80.0, 25.0)) + 16 * ((chance * 64) % 1)
        intensity = np.where(counts > 0, bright, 0)
        return Returns(counts.astype(np.uint16), intensity.astype(np.uint8))

    def _walls(self, azimuth: FloatArray) -> FloatArray:
        with np.errstate(divide="ignore"):
            along = self.half_length_m / np.abs(np.cos(azimuth))
            across = self.half_width_m / np.abs(np.sin(azimuth))
        return np.asarray(np.minimum(along, across))

    def _pole(self, azimuth: FloatArray, turns: FloatArray) -> NDArray[np.bool_]:
        """Five poles, each 2 degrees wide, 3 degrees further with every turn."""
        place = (np.degrees(azimuth) - 3.0 * turns[:, None]) % 72.0
        return np.asarray(place < 2.0)


def _chance(seed: int, firing: NDArray[np.int64], beams: int) -> FloatArray:
    """Uniform numbers in [0, 1) from seed, firing and beam (the finaliser of splitmix64)."""
    with np.errstate(over="ignore"):
        key = firing.astype(np.uint64)[:, None] * np.uint64(256) + np.arange(beams, dtype=np.uint64)[None, :]
        key = (key + np.uint64(seed % 2**32)) * np.uint64(0x9E3779B97F4A7C15)
        key = (key ^ (key >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        key = (key ^ (key >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        key ^= key >> np.uint64(31)
    return np.asarray((key >> np.uint64(40)).astype(np.float64) / float(1 << 24))


class ScanLoop:
    """Simulated turns (``simulate_frames(..., align=False)``), one after the other, then from the first again.

    A firing takes the column its azimuth falls into: at the sensor's own speed and the scan's width that is at most
    half a column off, as the firing cycle does not divide a turn.
    """

    def __init__(self, scans: Iterable[Scan]) -> None:
        self._scans: Sequence[Scan] = list(scans)
        if not self._scans:
            raise ValueError("no scans: expected one or more")
        first = self._scans[0]
        for scan in self._scans:
            if scan.alignment != "firing":
                raise ValueError(f"scan {scan.frame} is {scan.alignment} aligned: expected raw firings (align=False)")
            if scan.columns != first.columns or scan.beams.name != first.beams.name:
                raise ValueError(
                    f"scan {scan.frame}: {scan.beams.name} x {scan.columns}, the first is {first.beams.name} x "
                    f"{first.columns}"
                )
        self.beams = first.beams
        self._cut_turns = first.cut_deg / 360.0
        self._distance = np.stack([scan.distance.T for scan in self._scans])
        self._intensity = np.stack([scan.intensity.T for scan in self._scans])

    def returns(self, turns: FloatArray, firing: NDArray[np.int64]) -> Returns:
        at = turns - self._cut_turns
        turn = np.floor(at)
        width = self._distance.shape[1]
        column = np.minimum(((at - turn) * width).astype(np.int64), width - 1)
        frame = turn.astype(np.int64) % len(self._scans)
        return Returns(self._distance[frame, column], self._intensity[frame, column])
