"""What travels from a sensor to the device: UDP datagrams, and a view into data packets.

On the bench a datagram's time is when it leaves, in nanoseconds of the bench's clock, which starts at 0 with the
sensor. Its port is ``DATA_PORT`` or ``POSITION_PORT`` unless a fault chose another.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from upbeam.runtime.packets import Datagram

__all__ = ["DATA_BYTES", "DATA_PORT", "POSITION_BYTES", "POSITION_PORT", "Datagram", "blocks", "is_data", "is_position"]

DATA_PORT = 2368
POSITION_PORT = 8308
DATA_BYTES = 1206
POSITION_BYTES = 512

BLOCK = np.dtype([("flag", "<u2"), ("azimuth", "<u2"), ("returns", [("distance", "<u2"), ("intensity", "u1")], (32,))])
"""One of a data packet's twelve blocks, 100 bytes: azimuth in 0.01 degrees, distance in the sensor's counts."""
TAIL = np.dtype([("toh_us", "<u4"), ("return_mode", "u1"), ("model", "u1")])
"""What follows the blocks: microseconds since the hour, return mode, model."""
PACKET = np.dtype([("blocks", BLOCK, (12,)), ("tail", TAIL)])


def is_data(datagram: Datagram) -> bool:
    """A whole data packet: other sizes are what a fault made of one, and are not looked into."""
    return datagram.port == DATA_PORT and len(datagram.payload) == DATA_BYTES


def is_position(datagram: Datagram) -> bool:
    return datagram.port == POSITION_PORT and len(datagram.payload) == POSITION_BYTES


def blocks(payload: bytes | bytearray) -> NDArray[Any]:
    """A data packet as a structured scalar array (``PACKET``): a copy that may be written to where ``payload`` is
    ``bytes``, a view where it is a ``bytearray``.

    This reads the maker's manual on its own, apart from the C codec, so that the bench can judge the codec by it.
    """
    if len(payload) != DATA_BYTES:
        raise ValueError(f"data packet of {len(payload)} bytes: expected {DATA_BYTES}")
    view = np.frombuffer(payload, dtype=PACKET)
    return view.copy() if isinstance(payload, bytes) else view
