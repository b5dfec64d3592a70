"""
Packet codecs (runtime/include/upbeam/packets.h). Use upbeam.runtime.packets.
"""

from collections.abc import Sequence
from typing import Annotated

import numpy
from numpy.typing import NDArray

class PacketError(ValueError):
    """
    A packet, calibration or argument that cannot be. args: a sentence, the status's number.
    """

LASER_FIELDS: tuple = ...

STATUS_TEXTS: tuple = ...

def sensors() -> list:
    """
    (name, beams, distance_unit_um, firing_cycle_ns, packet_firings, model) of each.
    """

def identify(payload: bytes) -> tuple: ...
def default_calibration(sensor: str) -> tuple: ...
def row_calibration(
    row_elevation_mdeg: Annotated[NDArray[numpy.int32], dict(shape=(None,), order="C", device="cpu", writable=False)],
    turn_columns: int,
) -> tuple: ...
def sorted_calibration(
    sensor: str,
    lasers: Annotated[NDArray[numpy.int64], dict(shape=(None, None), order="C", device="cpu", writable=False)],
    two_point: bool,
) -> tuple: ...
def write_record(
    sensor: str,
    lasers: Annotated[NDArray[numpy.int64], dict(shape=(None, None), order="C", device="cpu", writable=False)],
    two_point: bool,
    status: dict,
) -> bytes: ...
def read_record(record: bytes) -> tuple: ...
def decode_position(payload: bytes) -> dict: ...
def encode_position(values: dict) -> bytes: ...
def points(
    sensor: str,
    lasers: Annotated[NDArray[numpy.int64], dict(shape=(None, None), order="C", device="cpu", writable=False)],
    two_point: bool,
    time_ns: Annotated[NDArray[numpy.uint64], dict(shape=(None,), order="C", device="cpu", writable=False)],
    azimuth_mdeg: Annotated[NDArray[numpy.uint32], dict(shape=(None,), order="C", device="cpu", writable=False)],
    rate_mdeg_s: Annotated[NDArray[numpy.uint32], dict(shape=(None,), order="C", device="cpu", writable=False)],
    flags: Annotated[NDArray[numpy.uint16], dict(shape=(None,), order="C", device="cpu", writable=False)],
    distance: Annotated[NDArray[numpy.uint16], dict(shape=(None, None), order="C", device="cpu", writable=False)],
    intensity: Annotated[NDArray[numpy.uint8], dict(shape=(None, None), order="C", device="cpu", writable=False)],
) -> tuple: ...

class Decoder:
    def __init__(
        self,
        sensor: str,
        pick: int,
        lasers: Annotated[NDArray[numpy.int64], dict(shape=(None, None), order="C", device="cpu", writable=False)]
        | None,
        two_point: bool,
        keep_calibration: bool,
    ) -> None: ...
    def decode(self, payloads: Sequence[bytes]) -> tuple: ...
    @property
    def sensor(self) -> str: ...
    @property
    def calibration(self) -> tuple: ...
    @property
    def status(self) -> dict: ...
    @property
    def stats(self) -> dict: ...

class Encoder:
    def __init__(
        self,
        sensor: str,
        return_mode: int,
        lasers: Annotated[NDArray[numpy.int64], dict(shape=(None, None), order="C", device="cpu", writable=False)]
        | None,
        two_point: bool,
        distance_unit_um: int,
        status: dict,
    ) -> None: ...
    def encode(
        self,
        time_ns: Annotated[NDArray[numpy.uint64], dict(shape=(None,), order="C", device="cpu", writable=False)],
        azimuth_mdeg: Annotated[NDArray[numpy.uint32], dict(shape=(None,), order="C", device="cpu", writable=False)],
        rate_mdeg_s: Annotated[NDArray[numpy.uint32], dict(shape=(None,), order="C", device="cpu", writable=False)],
        flags: Annotated[NDArray[numpy.uint16], dict(shape=(None,), order="C", device="cpu", writable=False)],
        distance: Annotated[NDArray[numpy.uint16], dict(shape=(None, None), order="C", device="cpu", writable=False)],
        intensity: Annotated[NDArray[numpy.uint8], dict(shape=(None, None), order="C", device="cpu", writable=False)],
    ) -> list: ...
    def set_status(self, values: dict) -> None: ...
    def set_record(
        self,
        lasers: Annotated[NDArray[numpy.int64], dict(shape=(None, None), order="C", device="cpu", writable=False)],
        two_point: bool,
    ) -> None: ...
    def drop(self) -> int: ...
    @property
    def pending(self) -> int: ...
    @property
    def status(self) -> dict: ...
    @property
    def stats(self) -> dict: ...

class Tracker:
    def __init__(self, cut_mdeg: int, cycle_ns: int) -> None: ...
    def track(
        self,
        time_ns: Annotated[NDArray[numpy.uint64], dict(shape=(None,), order="C", device="cpu", writable=False)],
        azimuth_mdeg: Annotated[NDArray[numpy.uint32], dict(shape=(None,), order="C", device="cpu", writable=False)],
        rate_mdeg_s: Annotated[NDArray[numpy.uint32], dict(shape=(None,), order="C", device="cpu", writable=False)],
    ) -> tuple: ...
    @property
    def turn_firings(self) -> int: ...
