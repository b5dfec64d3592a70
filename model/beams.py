"""Beam tables: where each laser of a spinning LiDAR points, and when it fires.

Beam 0 is the top one. Azimuths are clockwise seen from above, as Velodyne packets count them.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

__all__ = ["BeamTable", "BeamTableError", "beam_table", "beam_table_names", "between_rows", "uniform_beam_table"]

FloatArray = NDArray[np.float64]

MAX_BEAMS = 128
_PER_BEAM = (
    "elevation_deg",
    "azimuth_offset_deg",
    "firing_time_us",
    "vertical_offset_m",
    "horizontal_offset_m",
    "laser_id",
)


class BeamTableError(ValueError):
    """A beam table that cannot be: names the table, the key and what was expected."""


@dataclass(frozen=True)
class BeamTable:
    """Geometry and timing of one sensor's lasers. Every array is ``float64[beams]``, top beam first."""

    name: str
    elevation_deg: FloatArray
    """Above the horizon, strictly falling, within [-90, 90]."""
    azimuth_offset_deg: FloatArray
    """Clockwise, from the firing's azimuth to the laser's."""
    firing_time_us: FloatArray
    """After the start of the firing cycle, in [0, firing_cycle_us)."""
    vertical_offset_m: FloatArray
    """Height of the laser's origin over the sensor's."""
    horizontal_offset_m: FloatArray
    """Sideways shift of the laser's origin, to the right of its direction."""
    laser_id: FloatArray
    """The maker's number of the laser: its place in a packet's block."""
    distance_unit_m: float
    """Size of one distance count."""
    firing_cycle_us: float
    columns: int
    """Columns per turn the table is used at unless told otherwise."""

    def __post_init__(self) -> None:
        n = len(self.elevation_deg)
        if not 2 <= n <= MAX_BEAMS:
            raise BeamTableError(f"beam table {self.name!r}: {n} beams, expected 2 to {MAX_BEAMS}")
        for key in _PER_BEAM:
            values = np.asarray(getattr(self, key), dtype=np.float64)
            if values.shape != (n,) or not np.all(np.isfinite(values)):
                raise BeamTableError(
                    f"beam table {self.name!r}: {key} must be {n} finite numbers, one a beam, got shape {values.shape}"
                )
            values.setflags(write=False)
            object.__setattr__(self, key, values)
        if np.any(np.diff(self.elevation_deg) >= 0) or np.any(np.abs(self.elevation_deg) > 90):
            raise BeamTableError(
                f"beam table {self.name!r}: elevation_deg must fall strictly, top beam first, within +-90"
            )
        if np.any(np.abs(self.azimuth_offset_deg) >= 90):
            raise BeamTableError(f"beam table {self.name!r}: azimuth_offset_deg must lie within +-90")
        if not 1e-4 <= self.distance_unit_m <= 0.1:
            raise BeamTableError(
                f"beam table {self.name!r}: distance_unit_m {self.distance_unit_m} is not in [0.0001, 0.1]"
            )
        if not 4 <= self.columns <= 65535:
            raise BeamTableError(f"beam table {self.name!r}: columns {self.columns} is not in [4, 65535]")

    @property
    def beams(self) -> int:
        return len(self.elevation_deg)

    def rows(self, index: slice, name: str | None = None) -> BeamTable:
        """A table of some of the beams, e.g. ``slice(0, None, 2)`` for the paper's 32 channels."""
        return replace(
            self,
            name=name or f"{self.name}[{index.start or 0}::{index.step or 1}]",
            **{key: getattr(self, key)[index] for key in _PER_BEAM},
        )

    def aligned(self) -> BeamTable:
        """The same beams after destaggering: all lasers of a column share its azimuth."""
        return replace(self, azimuth_offset_deg=np.zeros(self.beams))

    def doubled(self) -> BeamTable:
        """A table with a virtual beam half way below each: what a sensor of twice the beams would see, to train on.

        A virtual beam fires with the beam above it."""
        repeated: dict[str, Any] = {key: np.repeat(getattr(self, key), 2) for key in _PER_BEAM}
        repeated["elevation_deg"] = between_rows(self.elevation_deg)
        repeated["vertical_offset_m"] = between_rows(self.vertical_offset_m)
        repeated["laser_id"] = np.arange(2 * self.beams, dtype=np.float64)
        return replace(self, name=f"{self.name}*2", **repeated)

    def column_offsets(self, columns: int) -> NDArray[np.int64]:
        """Azimuth offsets in whole columns of a turn of ``columns``, rounded half up."""
        return np.floor(self.azimuth_offset_deg * columns / 360.0 + 0.5).astype(np.int64)


def between_rows(per_beam: FloatArray) -> FloatArray:
    """A quantity of ``n`` beams for ``2n`` output rows: row ``2k`` is beam ``k``, row ``2k+1`` half way to beam
    ``k+1``.

    The last row continues by half the last step: a place for a repeated or empty row.
    """
    x = np.asarray(per_beam, dtype=np.float64)
    out = np.empty(2 * len(x))
    out[0::2] = x
    out[1:-1:2] = (x[:-1] + x[1:]) / 2
    out[-1] = x[-1] + (x[-1] - x[-2]) / 2
    return out


def uniform_beam_table(
    beams: int, top_deg: float, bottom_deg: float, *, columns: int = 2048, distance_unit_m: float = 0.002
) -> BeamTable:
    """Beams at equal elevation steps, one azimuth a firing, fired one after another through a 48 us cycle."""
    zeros = np.zeros(beams)
    return BeamTable(
        name=f"uniform-{beams}",
        elevation_deg=np.linspace(top_deg, bottom_deg, beams),
        azimuth_offset_deg=zeros,
        firing_time_us=np.arange(beams, dtype=np.float64) * (48.0 / beams),
        vertical_offset_m=zeros,
        horizontal_offset_m=zeros,
        laser_id=np.arange(beams, dtype=np.float64),
        distance_unit_m=distance_unit_m,
        firing_cycle_us=48.0,
        columns=columns,
    )


def beam_table_names() -> list[str]:
    """Names ``beam_table`` knows."""
    folder = resources.files(__package__).joinpath("beam_tables")
    shipped = sorted(p.name.removesuffix(".yaml") for p in folder.iterdir() if p.name.endswith(".yaml"))
    return [*shipped, "hdl-64e/2"]


def beam_table(name: str | Path) -> BeamTable:
    """A shipped table by name (see ``beam_table_names``), with ``*2`` its doubled form, or a YAML file."""
    path = Path(name)
    if path.suffix in {".yaml", ".yml"}:
        try:
            text = path.read_text(encoding="utf-8")
        except OSError as error:
            raise BeamTableError(f"beam table {path}: {error.strerror}") from None
        return _parse(text, str(path))
    if str(name).endswith("*2"):
        return beam_table(str(name).removesuffix("*2")).doubled()
    if str(name) == "hdl-64e/2":
        return beam_table("hdl-64e").rows(slice(0, None, 2), "hdl-64e/2")
    if str(name) not in beam_table_names():
        raise BeamTableError(f"no beam table {str(name)!r}; known: {', '.join(beam_table_names())}, or a .yaml file")
    shipped = resources.files(__package__).joinpath("beam_tables").joinpath(f"{name}.yaml")
    return _parse(shipped.read_text(encoding="utf-8"), str(name))


def _parse(text: str, where: str) -> BeamTable:
    try:
        raw = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise BeamTableError(f"beam table {where}: not YAML: {' '.join(str(error).split())}") from None
    if not isinstance(raw, dict):
        raise BeamTableError(f"beam table {where}: expected a mapping of keys, got {type(raw).__name__}")
    optional = {"azimuth_offset_deg", "firing_time_us", "vertical_offset_m", "horizontal_offset_m", "laser_id"}
    known = {"name", "distance_unit_m", "firing_cycle_us", "columns", *_PER_BEAM}
    _refuse("unknown key", set(raw) - known, where)
    _refuse("missing key", known - optional - set(raw), where)
    try:
        beams = len(raw["elevation_deg"])
        per_beam = {
            key: np.asarray(raw.get(key, range(beams) if key == "laser_id" else [0.0] * beams), dtype=np.float64)
            for key in _PER_BEAM
        }
        return BeamTable(
            name=str(raw["name"]),
            distance_unit_m=float(raw["distance_unit_m"]),
            firing_cycle_us=float(raw["firing_cycle_us"]),
            columns=int(raw["columns"]),
            **per_beam,
        )
    except (TypeError, ValueError) as error:
        if isinstance(error, BeamTableError):
            raise
        raise BeamTableError(f"beam table {where}: {error}") from None


def _refuse(what: str, keys: Iterable[str], where: str) -> None:
    names = sorted(str(key) for key in keys)
    if names:
        raise BeamTableError(f"beam table {where}: {what} {', '.join(names)}")
