"""Packets of Velodyne sensors: what they are, decoding, encoding, calibration, captures (docs/packets.md).

The codecs are the C library's (``runtime/include/upbeam/packets.h``); here they take and give NumPy arrays.
"""

from .calibration import Calibration, read_calibration, write_calibration
from .capture import CaptureError, Datagram, PacketReader, PcapWriter
from .codec import (
    DUAL,
    EMPTY,
    INTERPOLATED,
    JUMP,
    SECOND,
    AzimuthTracker,
    Decoded,
    Decoder,
    Encoder,
    Firings,
    PacketError,
    PacketInfo,
    Points,
    Position,
    SensorInfo,
    Steps,
    firing_points,
    identify,
    read_record,
    sensor_info,
    sensor_names,
    write_record,
)

__all__ = [
    "DUAL",
    "EMPTY",
    "INTERPOLATED",
    "JUMP",
    "SECOND",
    "AzimuthTracker",
    "Calibration",
    "CaptureError",
    "Datagram",
    "Decoded",
    "Decoder",
    "Encoder",
    "Firings",
    "PacketError",
    "PacketInfo",
    "PacketReader",
    "PcapWriter",
    "Points",
    "Position",
    "SensorInfo",
    "Steps",
    "firing_points",
    "identify",
    "read_calibration",
    "read_record",
    "sensor_info",
    "sensor_names",
    "write_calibration",
    "write_record",
]
