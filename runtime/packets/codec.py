"""Decoding and encoding packets, for NumPy. See ``runtime/include/upbeam/packets.h`` for every unit and rule."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields
from enum import IntEnum
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from . import _packets
from ._packets import PacketError
from .calibration import Calibration

__all__ = [
    "DUAL",
    "EMPTY",
    "INTERPOLATED",
    "JUMP",
    "SECOND",
    "AzimuthTracker",
    "Decoded",
    "Decoder",
    "Encoder",
    "Firings",
    "PacketError",
    "PacketInfo",
    "Points",
    "Position",
    "SensorInfo",
    "Status",
    "Steps",
    "firing_points",
    "identify",
    "read_record",
    "sensor_info",
    "sensor_names",
    "write_record",
]

SECOND, INTERPOLATED, JUMP, EMPTY, DUAL = 1, 2, 4, 8, 16
"""``UPB_FIRING_*``: flags of a firing."""

_RETURN_MODES = {"strongest": 0x37, "last": 0x38, "dual": 0x39}
_MODE_NAMES = {number: name for name, number in _RETURN_MODES.items()}


class Status(IntEnum):
    """``upb_packet_status``: why a packet was refused."""

    OK = 0
    ARGUMENT = 1
    SIZE = 2
    FLAG = 3
    AZIMUTH = 4
    TIME = 5
    RETURN_MODE = 6
    MODEL = 7
    SENSOR = 8
    POSITION = 9
    CALIBRATION = 10
    RETURN_PAIR = 11
    VLS_128 = 12
    VLP_32AB = 13
    PUCK_HIRES = 14
    VELARRAY = 15
    OUSTER = 16

    @property
    def text(self) -> str:
        """What it means, in a sentence."""
        return str(_packets.STATUS_TEXTS[self])


@dataclass(frozen=True)
class SensorInfo:
    """``upb_sensor_info``. A sensor with 0 beams is recognised and refused."""

    name: str
    beams: int
    distance_unit_um: int
    firing_cycle_ns: int
    packet_firings: int
    """Firings of a single-return packet."""
    model: int
    """Last byte of its packets; 0: has none."""


_SENSORS = {info.name: info for info in (SensorInfo(*values) for values in _packets.sensors())}


def sensor_names() -> list[str]:
    """The sensors that are decoded."""
    return [name for name, info in _SENSORS.items() if info.beams]


def sensor_info(name: str) -> SensorInfo:
    """Of a sensor decoded or refused by name. Raises PacketError for another."""
    if name not in _SENSORS:
        raise PacketError(f"sensor {name!r}, expected one of {', '.join(_SENSORS)}", int(Status.ARGUMENT))
    return _SENSORS[name]


@dataclass(frozen=True)
class PacketInfo:
    """What one payload tells about itself."""

    status: Status
    kind: Literal["unknown", "data", "position"]
    sensor: str
    """``auto``: unknown. ``hdl-64e-s3`` stands for both series."""
    return_mode: str
    """``strongest``, ``last``, ``dual``, or empty."""
    block: int
    """Of an error: where."""
    got: int
    """Of an error: the value found."""
    azimuth_mdeg: int
    time_us: int


def identify(payload: bytes) -> PacketInfo:
    """What a UDP payload is, and whether all of it can be. Raises nothing."""
    status, kind, sensor, mode, block, got, azimuth, time_us = _packets.identify(payload)
    kinds: tuple[Literal["unknown", "data", "position"], ...] = ("unknown", "data", "position")
    return PacketInfo(Status(status), kinds[kind], sensor, _MODE_NAMES.get(mode, ""), block, got, azimuth, time_us)


# ----------------------------------------------------------------------------------------------------------- firings


@dataclass(frozen=True, eq=False)
class Firings:
    """``upb_firing`` as arrays of equal length: one shot of all lasers each."""

    time_ns: NDArray[np.uint64]
    azimuth_mdeg: NDArray[np.uint32]
    rate_mdeg_s: NDArray[np.uint32]
    flags: NDArray[np.uint16]
    return_kind: NDArray[np.uint8]
    """0x37 strongest, 0x38 last: what the sensor says of the block."""
    distance: NDArray[np.uint16]
    """``[firings, beams]`` counts, top beam first; 0 is no return."""
    intensity: NDArray[np.uint8]
    """``[firings, beams]``"""

    @classmethod
    def of(
        cls,
        distance: NDArray[np.uint16],
        intensity: NDArray[np.uint8],
        *,
        azimuth_mdeg: Any,
        time_ns: Any,
        rate_mdeg_s: Any = 0,
        flags: Any = 0,
    ) -> Firings:
        """Firings from images ``[firings, beams]``; the rest may be one value for all."""
        n = len(distance)
        return cls(
            _spread(time_ns, n, np.uint64),
            _spread(azimuth_mdeg, n, np.uint32),
            _spread(rate_mdeg_s, n, np.uint32),
            _spread(flags, n, np.uint16),
            np.zeros(n, np.uint8),
            np.ascontiguousarray(distance, np.uint16),
            np.ascontiguousarray(intensity, np.uint8),
        )

    def __len__(self) -> int:
        return len(self.time_ns)

    def __getitem__(self, which: Any) -> Firings:
        """Some of them: a slice, a mask, or indices."""
        return Firings(*(getattr(self, f.name)[which] for f in fields(self)))

    @property
    def primary(self) -> Firings:
        """Without the second returns of dual-return packets: one firing an azimuth, for the network."""
        return self[(self.flags & SECOND) == 0]

    def _arrays(self) -> tuple[Any, ...]:
        arrays = (self.time_ns, self.azimuth_mdeg, self.rate_mdeg_s, self.flags, self.distance, self.intensity)
        return tuple(np.ascontiguousarray(a) for a in arrays)


def _spread(values: Any, n: int, dtype: Any) -> Any:
    return np.ascontiguousarray(np.broadcast_to(np.asarray(values, dtype=dtype), (n,)))


@dataclass(frozen=True, eq=False)
class Decoded:
    """Of a run of payloads."""

    firings: Firings
    packet: NDArray[np.uint32]
    """Of each firing: the payload it came from."""
    status: NDArray[np.uint8]
    """Of each payload: ``Status``."""


class Decoder:
    """Packets of one sensor to firings.

    ``sensor``: a name, or ``auto`` for the first good packet's. ``pick``: of dual returns the primary is by beam the
    brighter one (``strongest``) or the block of ``last`` returns. ``keep_calibration``: an HDL-64E's own record does
    not replace the table.
    """

    def __init__(
        self,
        sensor: str = "auto",
        *,
        pick: Literal["strongest", "last"] = "strongest",
        calibration: Calibration | None = None,
        keep_calibration: bool = False,
    ) -> None:
        lasers = None if calibration is None else np.ascontiguousarray(calibration.lasers, np.int64)
        two_point = calibration is not None and calibration.two_point
        picks = ("strongest", "last")
        if pick not in picks:
            raise PacketError(f"pick {pick!r}, expected strongest or last", int(Status.ARGUMENT))
        self._decoder = _packets.Decoder(sensor, picks.index(pick), lasers, two_point, keep_calibration)

    def decode(self, payload: bytes) -> Firings:
        """One payload's firings, none for a position packet. Raises PacketError, its ``args[1]`` the Status."""
        decoded = self.decode_all([payload])
        status = Status(int(decoded.status[0]))
        if status is not Status.OK:
            raise PacketError(f"packet of {len(payload)} bytes: {status.text}", int(status))
        return decoded.firings

    def decode_all(self, payloads: Iterable[bytes]) -> Decoded:
        """Many payloads' firings; those refused are told by ``status`` and counted by ``stats``."""
        firings, packet, status = self._decoder.decode(list(payloads))
        return Decoded(Firings(*firings), packet, status)

    @property
    def sensor(self) -> str:
        """``auto`` until the first good packet."""
        return str(self._decoder.sensor)

    @property
    def calibration(self) -> Calibration:
        """In use; an HDL-64E's own once its record was read. Raises PacketError before the sensor is known."""
        if self.sensor == "auto":
            raise PacketError("no packet yet: the sensor is unknown", int(Status.SENSOR))
        return Calibration._of(self._decoder.calibration)

    @property
    def status(self) -> dict[str, Any]:
        """What an HDL-64E tells of itself (``upb_hdl64e_status``)."""
        return dict(self._decoder.status)

    @property
    def stats(self) -> dict[str, Any]:
        """Counts: ``packets`` by Status name, ``positions``, ``firings``, ``jumps``, ``hours``, ``records`` ..."""
        stats = dict(self._decoder.stats)
        stats["packets"] = {Status(k).name: n for k, n in enumerate(stats["packets"]) if n}
        return stats


class Encoder:
    """Firings to packets of one sensor.

    ``distance_unit_um``: of the firings' counts, a multiple of the sensor's (4 mm counts are doubled for an HDL-64E).
    ``status``: an HDL-64E's first state, fields of ``upb_hdl64e_status``.
    """

    def __init__(
        self,
        sensor: str,
        *,
        return_mode: Literal["strongest", "last", "dual"] = "strongest",
        calibration: Calibration | None = None,
        distance_unit_um: int = 0,
        status: Mapping[str, Any] | None = None,
    ) -> None:
        if return_mode not in _RETURN_MODES:
            text = f"return mode {return_mode!r}, expected one of {', '.join(_RETURN_MODES)}"
            raise PacketError(text, int(Status.RETURN_MODE))
        lasers = None if calibration is None else np.ascontiguousarray(calibration.lasers, np.int64)
        two_point = calibration is not None and calibration.two_point
        mode = _RETURN_MODES[return_mode]
        self._encoder = _packets.Encoder(sensor, mode, lasers, two_point, distance_unit_um, dict(status or {}))

    def encode(self, firings: Firings) -> list[bytes]:
        """The packets these firings complete; the rest waits (``pending``). In dual return each primary is followed by
        its second, flagged ``SECOND``. Raises PacketError for the first firing that cannot be taken; those before it
        were.
        """
        return list(self._encoder.encode(*firings._arrays()))

    @property
    def pending(self) -> int:
        """Firings that wait for a packet to fill."""
        return int(self._encoder.pending)

    def drop(self) -> int:
        """Drops those, e.g. after a gap; returns how many."""
        return int(self._encoder.drop())

    def set_status(self, **values: Any) -> None:
        """Changes fields of an HDL-64E's status from the next packet on."""
        self._encoder.set_status(values)

    def set_record(self, calibration: Calibration) -> None:
        """HDL-64E: another table, e.g. for another speed; its record begins anew."""
        self._encoder.set_record(np.ascontiguousarray(calibration.lasers, np.int64), calibration.two_point)

    @property
    def stats(self) -> dict[str, int]:
        """``packets``, ``firings``, and returns ``too_far`` for the sensor's counts: written as none."""
        return dict(self._encoder.stats)


# ------------------------------------------------------------------------------------------------------------ points


@dataclass(frozen=True, eq=False)
class Points:
    """Returns of firings in space, firing by firing, top beam first."""

    xyz: NDArray[np.float32]
    """``[points, 3]`` metres: front, left, up."""
    intensity: NDArray[np.uint8]
    beam: NDArray[np.uint8]
    firing: NDArray[np.uint32]
    azimuth_mdeg: NDArray[np.uint32]
    """Of the laser when it fired."""
    distance_um: NDArray[np.uint32]
    """Corrected."""


def firing_points(calibration: Calibration, firings: Firings) -> Points:
    """Where the returns lie. Raises PacketError for a calibration that cannot be."""
    lasers = np.ascontiguousarray(calibration.lasers, np.int64)
    return Points(*_packets.points(calibration.sensor, lasers, calibration.two_point, *firings._arrays()))


# ------------------------------------------------------------------------------------------------------------ record


def write_record(calibration: Calibration, status: Mapping[str, Any] | None = None) -> bytes:
    """The 1820 bytes an HDL-64E sends of itself."""
    lasers = np.ascontiguousarray(calibration.lasers, np.int64)
    return bytes(_packets.write_record(calibration.sensor, lasers, calibration.two_point, dict(status or {})))


def read_record(record: bytes) -> tuple[Calibration, dict[str, Any]]:
    """The table and the status in them. Raises PacketError for a wrong checksum or impossible values."""
    calibration, status = _packets.read_record(record)
    return Calibration._of(calibration), dict(status)


@dataclass(frozen=True)
class Position:
    """``upb_position``: a position packet's content."""

    time_us: int = 0
    pps: int = 0
    """0 absent, 1 syncing, 2 locked, 3 error."""
    thermal_shutdown: int = 0
    temperature_top: int = 0
    temperature_bottom: int = 0
    temperature_at_shutdown: int = 0
    temperature_at_power_up: int = 0
    adc_temperature: int = 0
    adc_temperature_change: int = 0
    adc_seconds: int = 0
    adc_reason: int = 0
    adc_flags: int = 0
    nmea: str = ""
    nmea_valid: bool = field(default=False, compare=False)
    """Of a packet read: its checksum is right."""

    @classmethod
    def decode(cls, payload: bytes) -> Position:
        """Raises PacketError for bytes that are no position packet."""
        return cls(**_packets.decode_position(payload))

    def encode(self) -> bytes:
        """512 bytes. Raises PacketError for a value out of range."""
        values = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "nmea_valid"}
        return bytes(_packets.encode_position(values))


# ---------------------------------------------------------------------------------------------------------- tracking


@dataclass(frozen=True, eq=False)
class Steps:
    """``upb_step`` as arrays: where firings lie in the turn, and what is missing before them."""

    flags: NDArray[np.uint32]
    missing: NDArray[np.uint32]
    firing: NDArray[np.int64]
    angle_mdeg: NDArray[np.int64]
    frame: NDArray[np.uint64]
    rpm_milli: NDArray[np.uint32]

    FIRST, FRAME, LATE, STUCK, TIME_JUMP, RESTART = 1, 2, 4, 8, 16, 32


class AzimuthTracker:
    """Running numbers and frames of primary firings."""

    def __init__(self, sensor: str, cut_deg: float = 180.0) -> None:
        cut_mdeg = round(cut_deg * 1e3) % 360000
        self._tracker = _packets.Tracker(cut_mdeg, sensor_info(sensor).firing_cycle_ns)

    def track(self, firings: Firings) -> Steps:
        """The next firings' places; of primary ones only."""
        time_ns, azimuth_mdeg, rate_mdeg_s = firings._arrays()[:3]
        return Steps(*self._tracker.track(time_ns, azimuth_mdeg, rate_mdeg_s))

    @property
    def turn_firings(self) -> int:
        """Firings in a full turn at the tracked speed; 0: unknown."""
        return int(self._tracker.turn_firings)
