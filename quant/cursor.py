"""Bounded reading of a model file's sections."""

from __future__ import annotations

import struct
from typing import Literal

import numpy as np
from numpy.typing import NDArray

__all__ = ["MAX_WEIGHT", "Cursor", "UbmError"]

MAX_WEIGHT = 1e6
"""Largest magnitude of a float in a file."""


class UbmError(ValueError):
    """A file that is not a sound model: says what is wrong and where."""


class Cursor:
    """Reads a section front to back; every read is bounded by its end."""

    def __init__(self, tag: str, data: bytes) -> None:
        self.tag, self.data, self.at = tag, data, 0

    def take(self, count: int) -> bytes:
        if self.at + count > len(self.data):
            raise UbmError(f"section {self.tag} ends after {len(self.data)} bytes, expected at least {self.at + count}")
        self.at += count
        return self.data[self.at - count : self.at]

    def u32(self, what: str, low: int, high: int) -> int:
        value = int(struct.unpack("<I", self.take(4))[0])
        if not low <= value <= high:
            raise UbmError(f"section {self.tag}: {what} is {value}, expected {low} to {high}")
        return value

    def floats(self, what: str, *shape: int, limit: float = MAX_WEIGHT) -> NDArray[np.float64]:
        stored = np.frombuffer(self.take(4 * int(np.prod(shape))), dtype="<f4")
        if not np.all(np.isfinite(stored)) or np.any(np.abs(stored) > np.float32(limit)):
            raise UbmError(f"section {self.tag}: {what} holds a value that is not finite or beyond +-{limit:g}")
        return stored.astype(np.float64).reshape(shape)

    def end(self) -> None:
        if self.at != len(self.data):
            raise UbmError(f"section {self.tag} has {len(self.data)} bytes, expected {self.at}")

    def integers(self, what: str, kind: Literal["<i1", "<i2", "<i4"], *shape: int) -> NDArray[np.int64]:
        """Two's complement integers; ``what`` is for whoever reads the code, all values are possible."""
        dtype = np.dtype(kind)
        return np.frombuffer(self.take(dtype.itemsize * int(np.prod(shape))), dtype).astype(np.int64).reshape(shape)

    def zeros(self, count: int) -> None:
        if any(self.take(count)):
            raise UbmError(f"section {self.tag}: padding before byte {self.at} is not 0")
