"""Firings to payloads, by the codec of the runtime."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from upbeam.runtime.packets import SECOND, Encoder, Firings, Position

from .sources import Returns

__all__ = ["change_position", "encode_chunk", "encode_position"]

_PPS_LOCKED = 2


def encode_chunk(
    encoder: Encoder, time_ns: NDArray[np.int64], azimuth_mdeg: NDArray[np.int64], seen: Returns, last: Returns | None
) -> list[bytes]:
    """Packets of firings that fill a whole number of them; ``last``: their other returns, in dual return."""
    distance, intensity, flags = seen.distance, seen.intensity, np.zeros(len(time_ns), np.uint16)
    if last is not None:
        distance = _interleave(distance, last.distance)
        intensity = _interleave(intensity, last.intensity)
        flags = np.tile(np.array([0, SECOND], np.uint16), len(time_ns))
        time_ns, azimuth_mdeg = np.repeat(time_ns, 2), np.repeat(azimuth_mdeg, 2)
    return encoder.encode(Firings.of(distance, intensity, azimuth_mdeg=azimuth_mdeg, time_ns=time_ns, flags=flags))


def _interleave(first: NDArray[Any], second: NDArray[Any]) -> NDArray[Any]:
    return np.stack([first, second], axis=1).reshape(-1, first.shape[1])


def encode_position(toh_us: int) -> bytes:
    """A position packet of a healthy sensor."""
    return Position(time_us=toh_us, pps=_PPS_LOCKED).encode()


def change_position(payload: bytes, change: Callable[[Position], dict[str, Any]]) -> bytes:
    """The position packet with fields changed; ``change`` gives the new ones."""
    position = Position.decode(payload)
    return replace(position, **change(position)).encode()
