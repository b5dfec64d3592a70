"""What surrounds the two networks: the sensor they were made for, range limits, edges, empty pixels, the last row.

Every implementation obeys the same rules; ``docs/model-format.md`` states them and this module is their NumPy form.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .beams import BeamTable, between_rows
from .network import WINDOW, FoldedNetwork

__all__ = [
    "BEAMS",
    "ROWS",
    "Rules",
    "RulesError",
    "Windows",
    "extract_windows",
    "interleave_rows",
    "upsample_reference",
]

BEAMS = 32
ROWS = 2 * BEAMS
PAIRS = BEAMS - 1
"""Windows of a column: pairs of neighbouring beams."""

U16 = NDArray[np.uint16]
U8 = NDArray[np.uint8]
FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
T = TypeVar("T", bound=np.generic)


class RulesError(ValueError):
    """An impossible rule: names it and says what was expected."""


@dataclass(frozen=True)
class Rules:
    """Sensor and rules of a model. Angles in degrees, distances in sensor counts of ``distance_unit_m``."""

    sensor: str
    columns: int
    """Per turn."""
    distance_unit_m: float
    row_elevation_deg: FloatArray
    """[64] of the output rows, top first."""
    azimuth_offset_deg: FloatArray
    """[32] of the input beams, clockwise from the firing's azimuth."""
    row_height_m: FloatArray
    """[64] height of each output row's laser origin over the sensor's; of a generated row, what makes its points
    fit."""
    min_count: int
    max_count: int
    row_max_count: NDArray[np.int64]
    """[64] farthest count the networks see in an input row (even) or give in a generated one (odd), at most
    ``max_count``. A beam that points down meets the ground: what returns from several times as far is a mirror
    image."""
    cut_deg: float = 180.0
    edge: Literal["zero", "seam"] = "seam"
    last_row: Literal["repeat", "empty"] = "empty"
    empty: Literal["none", "fill"] = "fill"

    def __post_init__(self) -> None:
        for name, size in (("row_elevation_deg", ROWS), ("azimuth_offset_deg", BEAMS), ("row_height_m", ROWS)):
            array = np.asarray(getattr(self, name), dtype=np.float64)
            if array.shape != (size,) or not np.all(np.isfinite(array)):
                raise RulesError(f"{name} must be {size} finite numbers, got shape {list(array.shape)}")
            object.__setattr__(self, name, array)
        if np.any(np.diff(self.row_elevation_deg) >= 0):
            raise RulesError("row_elevation_deg must fall strictly, top row first")
        if not 1 <= self.min_count <= self.max_count <= 65535:
            raise RulesError(
                f"range limits {self.min_count}..{self.max_count} counts, expected 1 <= min <= max <= 65535"
            )
        limits = np.asarray(self.row_max_count, dtype=np.int64)
        if limits.shape != (ROWS,) or np.any(limits < self.min_count) or np.any(limits > self.max_count):
            raise RulesError(f"row_max_count must be {ROWS} counts within {self.min_count}..{self.max_count}")
        object.__setattr__(self, "row_max_count", limits)
        if not 4 <= self.columns <= 65535:
            raise RulesError(f"columns {self.columns}, expected 4 to 65535")
        if not 0 <= self.cut_deg < 360:
            raise RulesError(f"cut_deg {self.cut_deg}, expected 0 to 360")
        for name, allowed in (
            ("edge", ("zero", "seam")),
            ("last_row", ("repeat", "empty")),
            ("empty", ("none", "fill")),
        ):
            if getattr(self, name) not in allowed:
                raise RulesError(f"{name} {getattr(self, name)!r}, expected {' or '.join(allowed)}")

    @classmethod
    def for_beams(
        cls,
        beams: BeamTable,
        *,
        columns: int | None = None,
        min_m: float = 3.0,
        max_m: float = 80.0,
        sensor_height_m: float = 1.73,
        ground_reach: float = 4.0,
        edge: Literal["zero", "seam"] = "seam",
        last_row: Literal["repeat", "empty"] = "empty",
        empty: Literal["none", "fill"] = "fill",
    ) -> Rules:
        """Rules for a 32-beam table (generated rows half way between beams) or a 64-beam one (every other beam is
        input).

        A row that points down is limited to ``ground_reach`` times its way to flat ground ``sensor_height_m`` below
        (0: no such limit). Measured on 26 KITTI frames: factors of 2 to 6 remove the same mirror images."""
        if beams.beams not in (BEAMS, ROWS):
            raise RulesError(f"beam table {beams.name!r} has {beams.beams} beams, expected {BEAMS} or {ROWS}")
        native = beams.beams == BEAMS
        step = slice(None) if native else slice(0, None, 2)
        unit = beams.distance_unit_m
        low, high = int(np.floor(min_m / unit + 0.5)), min(65535, int(np.floor(max_m / unit + 0.5)))
        elevation = between_rows(beams.elevation_deg) if native else beams.elevation_deg
        height = between_rows(beams.vertical_offset_m) if native else beams.vertical_offset_m
        return cls(
            sensor=beams.name if native else _half_name(beams.name),
            columns=columns or beams.columns,
            distance_unit_m=unit,
            row_elevation_deg=elevation,
            azimuth_offset_deg=beams.azimuth_offset_deg[step],
            row_height_m=height,
            min_count=low,
            max_count=high,
            row_max_count=ground_limits(elevation, sensor_height_m + height, ground_reach, unit, (low, high)),
            edge=edge,
            last_row=last_row,
            empty=empty,
        )

    @property
    def min_m(self) -> float:
        return self.min_count * self.distance_unit_m

    @property
    def max_m(self) -> float:
        return self.max_count * self.distance_unit_m

    def valid(self, counts: NDArray[np.uint16]) -> BoolArray:
        """Returns within the range limits, of any row: what is judged."""
        return (counts >= self.min_count) & (counts <= self.max_count)

    def seen(self, counts: NDArray[np.uint16]) -> BoolArray:
        """Returns ``[rows, W]`` of input rows that the networks see: also within the row's own limit.

        An image of other than 32 rows is not the sensor's: its rows have no limits of their own."""
        return self.valid(counts) & (counts <= self._row_limits(counts, slice(0, None, 2)))

    def given(self, counts: FloatArray | NDArray[np.int64]) -> BoolArray:
        """Generated whole counts ``[rows, W]`` that are returns; as for ``seen``."""
        within = (counts >= self.min_count) & (counts <= self.max_count)
        return within & (counts <= self._row_limits(counts, slice(1, -1, 2)))

    def _row_limits(self, image: NDArray[Any], rows: slice) -> NDArray[np.int64]:
        limits = self.row_max_count[rows]
        return limits[:, None] if len(image) == len(limits) else np.array([[self.max_count]])


def _half_name(name: str) -> str:
    """Of every other beam of a table: a doubled table's are the sensor's own."""
    return name.removesuffix("*2") if name.endswith("*2") else f"{name}/2"


def ground_limits(
    elevation_deg: FloatArray, height_m: FloatArray, reach: float, unit_m: float, limits: tuple[int, int]
) -> NDArray[np.int64]:
    """Farthest count of each row within ``limits``: ``reach`` times the way to flat ground, if it points down."""
    if reach < 0 or not np.isfinite(reach):
        raise RulesError(f"ground_reach {reach}, expected 0 (no limit) or a positive factor")
    counts = np.full(len(elevation_deg), limits[1], dtype=np.int64)
    down = np.sin(np.radians(-elevation_deg))
    limited = (down > 1e-6) & (height_m > 0) & (reach > 0)
    way = reach * height_m[limited] / down[limited]
    counts[limited] = np.clip(np.floor(np.minimum(way / unit_m, limits[1])), *limits).astype(np.int64)
    return counts


@dataclass(frozen=True)
class Windows:
    """Network inputs of an image, after limits and empty-pixel rule: counts and intensities, ``[31, W, 6]``."""

    distance: FloatArray
    intensity: FloatArray
    any_return: BoolArray
    """``[31, W]``: the window holds at least one valid pixel."""


def extract_windows(distance: U16, intensity: U8, rules: Rules, *, wrap: bool = False) -> Windows:
    """Windows of an image ``[rows, W]``; both its ends are edges, or it is a closed turn (``wrap``).

    Any number of rows >= 2 is taken: ``rows - 1`` pairs.
    """
    valid = rules.seen(distance)
    d = np.where(valid, distance, 0).astype(np.float64)
    i = np.where(valid, intensity, 0).astype(np.float64)
    any_return = _neighbours(valid, wrap)
    present = np.any(any_return[:-1] | any_return[1:], axis=-1)
    if rules.empty == "none":
        return Windows(_pair(_neighbours(d, wrap)), _pair(_neighbours(i, wrap)), present)
    return Windows(_fill(d, valid, wrap), _fill(i, valid, wrap), present)


def _neighbours(image: NDArray[T], wrap: bool) -> NDArray[T]:
    """[rows, W] -> [rows, W, 3]: left, middle, right."""
    edges = (image[:, -1:], image[:, :1]) if wrap else (np.zeros_like(image[:, :1]),) * 2
    padded = np.concatenate([edges[0], image, edges[1]], axis=1)
    return np.stack([padded[:, :-2], padded[:, 1:-1], padded[:, 2:]], axis=-1)


def _pair(x: NDArray[T]) -> FloatArray:
    """[rows, W, 3] -> [rows - 1, W, 6]."""
    return np.concatenate([x[:-1], x[1:]], axis=-1).astype(np.float64)


def _fill(x: FloatArray, valid: BoolArray, wrap: bool) -> FloatArray:
    top = _neighbours(np.where(valid[:-1], x[:-1], x[1:]), wrap)
    bottom = _neighbours(np.where(valid[1:], x[1:], x[:-1]), wrap)
    seen = _neighbours(valid[:-1] | valid[1:], wrap)
    return np.concatenate([_fill_columns(top, seen), _fill_columns(bottom, seen)], axis=-1)


def _fill_columns(x: FloatArray, seen: BoolArray) -> FloatArray:
    left, middle, right = (x[..., k] for k in range(3))
    has_left, has_middle, has_right = (seen[..., k] for k in range(3))
    between = np.where(has_left & has_right, np.minimum(left, right), np.where(has_left, left, right))
    return np.stack(
        [
            np.where(has_left, left, np.where(has_middle, middle, right)),
            np.where(has_middle, middle, between),
            np.where(has_right, right, np.where(has_middle, middle, left)),
        ],
        axis=-1,
    )


def upsample_reference(
    distance: ArrayLike,
    intensity: ArrayLike,
    networks: tuple[FoldedNetwork, FoldedNetwork],
    rules: Rules,
    *,
    wrap: bool = False,
) -> tuple[U16, U8]:
    """Counts and intensities ``[32, W]`` -> ``[64, W]``, in float64: what every other implementation is compared with.

    The image is azimuth aligned; its ends are edges unless ``wrap``. Even rows are the input's, to the bit.
    """
    d, i = image_pair(distance, intensity)
    windows = extract_windows(d, i, rules, wrap=wrap)
    unit = rules.distance_unit_m
    generated = generated_counts(networks[0](windows.distance * unit) / unit, windows, rules)
    gi = np.clip(np.floor(networks[1](windows.intensity) + 0.5), 0, 255)
    shade = np.where(generated > 0, gi, 0).astype(np.uint8)
    return interleave_rows(d, generated, rules), interleave_rows(i, shade, rules)


def image_pair(distance: ArrayLike, intensity: ArrayLike) -> tuple[U16, U8]:
    """Both images as arrays of one shape. Raises RulesError."""
    d = np.asarray(distance, dtype=np.uint16)
    i = np.asarray(intensity, dtype=np.uint8)
    if d.ndim != 2 or d.shape[0] < 2 or i.shape != d.shape:
        raise RulesError(
            f"distance {list(d.shape)} and intensity {list(i.shape)} must be equal shapes [beams, columns]"
        )
    return d, i


def generated_counts(y_counts: FloatArray, windows: Windows, rules: Rules) -> U16:
    """Network outputs in counts -> generated counts: rounded half up, 0 outside the limits or without any return."""
    return kept_counts(np.floor(y_counts + 0.5), windows, rules)


def kept_counts(whole: FloatArray | NDArray[np.int64], windows: Windows, rules: Rules) -> U16:
    """Whole counts -> generated counts: 0 outside the limits or without any return."""
    keep = rules.given(whole)
    if rules.empty == "fill":
        keep &= windows.any_return
    return np.where(keep, whole, 0).astype(np.uint16)


def interleave_rows(rows: NDArray[T], generated: NDArray[T], rules: Rules) -> NDArray[T]:
    """Sensor rows ``[n, W]`` and the ``[n - 1, W]`` generated between them -> ``[2 n, W]``."""
    out = np.zeros((2 * rows.shape[0], rows.shape[1]), dtype=rows.dtype)
    out[0::2] = rows
    out[1:-1:2] = generated
    if rules.last_row == "repeat":
        out[-1] = rows[-1]
    return out


assert WINDOW == 6  # the order of _fill and _pair
