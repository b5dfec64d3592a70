"""The work that everybody is timed on: both images of one frame, and what must come out."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from upbeam.model.rules import BEAMS, PAIRS, U8, U16, extract_windows
from upbeam.quant.export import Source
from upbeam.quant.ubm import ModelFile
from upbeam.runtime._native import Model as NativeModel
from upbeam.runtime._native import raw_windows, windows_int

__all__ = ["FLIPS", "TOLERANCE", "DifferenceError", "Work", "check_image", "check_windows", "synthetic_frame"]

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

TOLERANCE = 2e-7
"""Of float outputs, relative to the sum of the magnitudes that an output is made of, hundredths of a count. Float32 in
any order is within 4e-8 (measured), bfloat16 is not."""
FLIPS = 1e-3
"""Share of generated points that may differ by one step, where sums are rounded otherwise."""


class DifferenceError(ValueError):
    """Outputs that are not those of our kernels: the candidate is not timed."""


@dataclass(frozen=True)
class Work:
    """A model file and one frame: ``distance`` and ``intensity`` ``[32, W]``, azimuth aligned. Can be sent to another
    process."""

    ubm: bytes
    distance: U16
    intensity: U8

    def __post_init__(self) -> None:
        shape = self.distance.shape
        if len(shape) != 2 or shape[0] != BEAMS or shape[1] < 8 or self.intensity.shape != shape:
            raise ValueError(f"distance {list(shape)} and intensity {list(self.intensity.shape)}, expected [32, W]")

    @property
    def columns(self) -> int:
        return int(self.distance.shape[1])

    @property
    def windows_per_image(self) -> int:
        return PAIRS * self.columns

    @cached_property
    def source(self) -> Source:
        return Source.of(self.ubm, "the model")

    @property
    def file(self) -> ModelFile:
        return self.source.file

    @cached_property
    def column_major(self) -> tuple[U16, U8]:
        """The frame as columns ``[W, 32]``, the way a sensor sends it."""
        return np.ascontiguousarray(self.distance.T), np.ascontiguousarray(self.intensity.T)

    @cached_property
    def window_inputs(self) -> tuple[F32, F32]:
        """Windows after the rules ``[N, 6]``, as the float networks see them: metres; intensities."""
        found = extract_windows(self.distance, self.intensity, self.file.rules)
        unit = self.file.rules.distance_unit_m
        return tuple(  # type: ignore[return-value]
            np.ascontiguousarray(x.reshape(-1, 6), dtype=np.float32)
            for x in (found.distance * unit, found.intensity.astype(np.float64))
        )

    @cached_property
    def raw(self) -> tuple[F64, F64]:
        """What the networks of our plain C kernel give for ``window_inputs``, ``[N]``: counts; intensities."""
        outputs = raw_windows(NativeModel(self.ubm), *self.column_major, cpu="scalar")
        return tuple(x[:, :PAIRS].T.reshape(-1).astype(np.float64) for x in outputs)

    @cached_property
    def magnitude(self) -> tuple[F64, F64]:
        """The scale of rounding errors of ``raw``, in its units."""
        units = (self.file.rules.distance_unit_m, 1.0)
        nets = self.file.folded
        return tuple(  # type: ignore[return-value]
            net.magnitude(x) / unit for net, x, unit in zip(nets, self.window_inputs, units, strict=True)
        )

    def generated(self, precision: str) -> tuple[U16, U8]:
        """The generated points ``[31, W]`` of the reference: the plain C kernel, for integers to the bit."""
        if precision == "fp32":
            from upbeam.runtime._native import Stream

            stream = Stream(NativeModel(self.ubm), cpu="scalar", columns=self.columns, any_sensor=True, aligned=True)
            distance, intensity = stream.image(self.distance, self.intensity)
            return distance[1:-1:2], intensity[1:-1:2]
        distance, intensity = windows_int(NativeModel(self.ubm), precision, *self.column_major, cpu="scalar")
        return distance[:, :PAIRS].T, intensity[:, :PAIRS].T


def check_windows(work: Work, distance: NDArray[np.floating], intensity: NDArray[np.floating]) -> None:
    """Raises DifferenceError unless network outputs ``[N]`` (counts, intensities) are ours up to rounding."""
    for name, got, ours, scale in zip(
        ("distance", "intensity"), (distance, intensity), work.raw, work.magnitude, strict=True
    ):
        values = np.asarray(got, dtype=np.float64).reshape(-1)
        if values.shape != ours.shape:
            raise DifferenceError(f"{name}: {len(values)} outputs, expected {len(ours)}")
        excess = np.abs(values - ours) - (TOLERANCE * scale + 1e-3)
        worst = int(np.argmax(np.where(np.isfinite(excess), excess, np.inf)))
        if not excess[worst] <= 0:
            raise DifferenceError(f"{name} of window {worst}: {values[worst]:.6g}, ours {ours[worst]:.6g}")


def check_image(work: Work, precision: str, distance: NDArray[Any], intensity: NDArray[Any]) -> None:
    """Raises DifferenceError unless generated points ``[31, W]`` are ours: integers to the bit, float up to a step of
    one in a thousand."""
    expected = work.generated(precision)
    allowed = FLIPS if precision == "fp32" else 0.0
    pairs: Any = zip(("distance", "intensity"), (distance, intensity), expected, strict=True)
    for name, got, ours in pairs:
        if got.shape != ours.shape:
            raise DifferenceError(f"{name}: an image {list(got.shape)}, expected {list(ours.shape)}")
        apart = np.asarray(got, dtype=np.float64) != ours
        if np.mean(apart) > allowed:
            row, column = (int(x[0]) for x in np.nonzero(apart))
            raise DifferenceError(
                f"{name}: {np.count_nonzero(apart)} of {apart.size} points differ, the first at window {row}, column "
                f"{column}: {got[row, column]}, ours {ours[row, column]}"
            )


def synthetic_frame(columns: int, unit_m: float, seed: int = 0) -> tuple[U16, U8]:
    """Smooth surfaces some steps apart, a return in ten missing: a frame for tests and for other widths."""
    rng = np.random.default_rng(seed)
    beam, column = np.mgrid[:BEAMS, :columns]
    metres = 12 + 6 * np.sin(column / 90) + 0.4 * (BEAMS - beam) * (column % 400 > 60)
    counts = np.floor(metres / unit_m + rng.uniform(0, 20, metres.shape))
    counts[rng.random(counts.shape) < 0.1] = 0
    return counts.astype(np.uint16), rng.integers(0, 256, counts.shape, dtype=np.uint8)
