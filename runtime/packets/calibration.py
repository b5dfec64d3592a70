"""Per-unit tables of lasers, and the YAML files that drivers keep them in."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import ArrayLike, NDArray

from . import _packets
from ._packets import PacketError

__all__ = ["LASER_FIELDS", "Calibration", "read_calibration", "write_calibration"]

LASER_FIELDS: tuple[str, ...] = tuple(_packets.LASER_FIELDS)
"""Columns of ``Calibration.lasers``: the fields of ``upb_laser``."""

_MDEG = 180e3 / math.pi
# A driver's key: our field, and how many of our units one of its is. A driver's rotation is counted backwards.
_DRIVER_KEYS = {
    "vert_correction": ("elevation_mdeg", _MDEG),
    "rot_correction": ("azimuth_offset_mdeg", -_MDEG),
    "dist_correction": ("distance_correction_um", 1e6),
    "dist_correction_x": ("distance_x_um", 1e6),
    "dist_correction_y": ("distance_y_um", 1e6),
    "vert_offset_correction": ("vertical_offset_um", 1e6),
    "horiz_offset_correction": ("horizontal_offset_um", 1e6),
    "focal_distance": ("focal_distance_um", 1e6),
    "focal_slope": ("focal_slope_e4", 1e4),
    "min_intensity": ("min_intensity", 1.0),
    "max_intensity": ("max_intensity", 1.0),
    "laser_id": ("laser_id", 1.0),
}


@dataclass(frozen=True, eq=False)
class Calibration:
    """Where each laser of one unit points, and what its raw values need. Top beam first."""

    sensor: str
    """``hdl-32e``, ``vlp-32c``, ``vlp-16``, ``hdl-64e-s2`` or ``hdl-64e-s3``."""
    lasers: NDArray[np.int64]
    """``[beams, 13]``, the columns named by ``LASER_FIELDS``: thousandths of a degree, nanoseconds, micrometres."""
    two_point: bool = False
    """The distance corrections near the sensor count (HDL-64E)."""

    @classmethod
    def nominal(cls, sensor: str) -> Calibration:
        """The table shipped for a sensor. Raises PacketError for one that is not decoded."""
        return cls._of(_packets.default_calibration(sensor))

    @classmethod
    def of_rows(cls, row_elevation_deg: ArrayLike, turn_columns: int) -> Calibration:
        """The HDL-64E S3 that 64-row columns are written as (``upb_packet_calibration_rows``).

        ``row_elevation_deg``: 64, falling. ``turn_columns``: columns of a full turn at nominal speed, 4 to 65535.
        """
        mdeg = np.ascontiguousarray(np.round(np.asarray(row_elevation_deg, dtype=np.float64) * 1e3), dtype=np.int32)
        return cls._of(_packets.row_calibration(mdeg, turn_columns))

    @classmethod
    def _of(cls, values: tuple[str, bool, Any]) -> Calibration:
        sensor, two_point, lasers = values
        return cls(sensor, lasers, two_point)

    @property
    def beams(self) -> int:
        return len(self.lasers)

    def column(self, name: str) -> NDArray[np.int64]:
        """One field of all beams, e.g. ``elevation_mdeg``."""
        return self.lasers[:, LASER_FIELDS.index(name)]

    def with_column(self, name: str, values: ArrayLike) -> Calibration:
        """The same table with one field replaced."""
        lasers = self.lasers.copy()
        lasers[:, LASER_FIELDS.index(name)] = values
        return replace(self, lasers=lasers)

    def sorted(self) -> Calibration:
        """The same lasers, top beam first, checked. Raises PacketError for a table that cannot be."""
        return self._of(_packets.sorted_calibration(self.sensor, self.lasers, self.two_point))


def read_calibration(path: str | Path, sensor: str) -> Calibration:
    """A driver's YAML file (``lasers``: ``laser_id``, ``vert_correction`` in radians, ...; metres) for a sensor.

    What it does not tell, firing times above all, is the nominal table's of the same laser. Raises PacketError for a
    file that is none, lacks a laser, or cannot be.
    """
    lasers = _lasers_of(Path(path))
    nominal = Calibration.nominal(sensor)
    ids = sorted(int(laser.get("laser_id", -1)) for laser in lasers)
    if ids != list(range(nominal.beams)):
        raise PacketError(f"{path}: lasers {ids}, expected 0 to {nominal.beams - 1} once each", 10)
    table = nominal.lasers[np.argsort(nominal.column("laser_id"))].copy()
    for laser in lasers:
        row = table[int(laser["laser_id"])]
        for key, (field, scale) in _DRIVER_KEYS.items():
            if key in laser:
                row[LASER_FIELDS.index(field)] = _whole(path, laser, key, scale)
            elif field.endswith("_um"):
                row[LASER_FIELDS.index(field)] = 0
    two_point = any("dist_correction_x" in laser for laser in lasers)
    return Calibration(sensor, table, two_point).sorted()


def write_calibration(calibration: Calibration, path: str | Path) -> None:
    """The table as the YAML file that drivers read (ROS, velodyne-decoder)."""
    unit_m = next(s[2] for s in _packets.sensors() if s[0] == calibration.sensor) * 1e-6
    lasers = []
    for row in sorted(calibration.lasers.tolist(), key=lambda r: int(r[LASER_FIELDS.index("laser_id")])):
        laser: dict[str, float | int] = {}
        for key, (field, scale) in _DRIVER_KEYS.items():
            value = row[LASER_FIELDS.index(field)]
            two_point_key = key.startswith("dist_correction_")
            if not two_point_key or calibration.two_point:
                laser[key] = int(value) if scale == 1.0 else round(value / scale, 9)
        lasers.append(laser)
    text = yaml.safe_dump(
        {"distance_resolution": round(unit_m, 6), "num_lasers": calibration.beams, "lasers": lasers}, sort_keys=False
    )
    Path(path).write_text(text, encoding="utf-8")


def _lasers_of(path: Path) -> list[dict[str, Any]]:
    try:
        raw = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise PacketError(f"{path}: {' '.join(str(error).split())}", 10) from None
    lasers = raw.get("lasers") if isinstance(raw, dict) else None
    if not isinstance(lasers, list) or not all(isinstance(laser, dict) for laser in lasers):
        raise PacketError(f"{path}: no list of lasers, expected a driver's calibration file", 10)
    return lasers


def _whole(path: str | Path, laser: dict[str, Any], key: str, scale: float) -> int:
    value = laser[key]
    if not isinstance(value, (int, float)) or not math.isfinite(value):
        raise PacketError(f"{path}: laser {laser.get('laser_id')}: {key} is {value!r}, expected a number", 10)
    return math.floor(value * scale + 0.5)
