"""Reader of the column stream that ``upbeamd`` sends: docs/column-stream.md has the format to the byte."""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = [
    "INCOMPLETE",
    "INSERTED",
    "LAST",
    "MODES",
    "SECOND",
    "Column",
    "ColumnStreamError",
    "Frame",
    "frames",
    "read_columns",
]

ROWS = 64
INCOMPLETE, LAST, SECOND, INSERTED = 1, 2, 4, 8
"""Flags of a column: a beam's sample is missing; last of its frame; other return of the column before; the firing never
arrived."""
MODES = ("network", "valid_mean", "repeat", "pass_through")
_HEADER = struct.Struct("<4sBBBBIIQII")
_COLUMN = struct.Struct("<IIQI")
_COLUMN_BYTES = _COLUMN.size + 3 * ROWS
_VERSION = 1


class ColumnStreamError(ValueError):
    """Bytes that are no datagram of the column stream: says what was found and what was expected."""


@dataclass(frozen=True)
class Column:
    """One column of 64 rows, and what its datagram says of all of its columns."""

    frame: int
    column: int
    azimuth_mdeg: int
    time_ns: int
    """The sensor's clock, hours counted on."""
    flags: int
    distance: NDArray[np.uint16]
    """[64] counts."""
    intensity: NDArray[np.uint8]
    sequence: int
    """Of the datagram."""
    model_crc32: int
    distance_unit_um: int
    turn_columns: int

    @property
    def mode(self) -> str:
        """How the generated rows were made."""
        return MODES[self.flags >> 8 & 3]

    @property
    def second(self) -> bool:
        """True for the other return of the column before: even rows only."""
        return bool(self.flags & SECOND)


def read_columns(datagram: bytes) -> list[Column]:
    """The columns of a datagram, in order. Raises :class:`ColumnStreamError` for anything else."""
    if len(datagram) < _HEADER.size:
        raise ColumnStreamError(f"{len(datagram)} bytes, a header has {_HEADER.size}")
    magic, version, header_bytes, count, rows, sequence, crc, frame, unit, turn = _HEADER.unpack_from(datagram)
    if magic != b"UPCS":
        raise ColumnStreamError(f"begins with {magic!r}, expected b'UPCS'")
    if version != _VERSION:
        raise ColumnStreamError(f"version {version}, this reader knows {_VERSION}")
    if header_bytes != _HEADER.size or rows != ROWS or count == 0:
        raise ColumnStreamError(f"{header_bytes} header bytes, {rows} rows, {count} columns: expected 32, 64, 1 to 6")
    if len(datagram) != header_bytes + count * _COLUMN_BYTES:
        raise ColumnStreamError(f"{len(datagram)} bytes, {count} columns take {header_bytes + count * _COLUMN_BYTES}")
    columns = []
    for at in range(header_bytes, len(datagram), _COLUMN_BYTES):
        column, azimuth, time_ns, flags = _COLUMN.unpack_from(datagram, at)
        at += _COLUMN.size
        columns.append(
            Column(
                frame=frame,
                column=column,
                azimuth_mdeg=azimuth,
                time_ns=time_ns,
                flags=flags,
                distance=np.frombuffer(datagram, "<u2", ROWS, at).astype(np.uint16),
                intensity=np.frombuffer(datagram, np.uint8, ROWS, at + 2 * ROWS),
                sequence=sequence,
                model_crc32=crc,
                distance_unit_um=unit,
                turn_columns=turn,
            )
        )
    return columns


@dataclass(frozen=True)
class Frame:
    """Columns of one frame side by side."""

    frame: int
    distance: NDArray[np.uint16]
    """[64, n] counts."""
    intensity: NDArray[np.uint8]
    azimuth_mdeg: NDArray[np.uint32]
    time_ns: NDArray[np.uint64]
    flags: NDArray[np.uint32]
    complete: bool
    """Its last column has arrived, and none before it is missing."""


def frames(datagrams: Iterable[bytes]) -> Iterator[Frame]:
    """Frames of datagrams in the order of arrival; second returns are left out. One that is cut off comes as it is."""
    held: list[Column] = []
    for datagram in datagrams:
        for column in read_columns(datagram):
            if column.second:
                continue
            if held and column.frame != held[0].frame:
                yield _frame(held)
                held = []
            held.append(column)
    if held:
        yield _frame(held)


def _frame(columns: list[Column]) -> Frame:
    whole = [c.column for c in columns] == list(range(columns[0].column, columns[0].column + len(columns)))
    return Frame(
        frame=columns[0].frame,
        distance=np.stack([c.distance for c in columns], axis=1),
        intensity=np.stack([c.intensity for c in columns], axis=1),
        azimuth_mdeg=np.array([c.azimuth_mdeg for c in columns], np.uint32),
        time_ns=np.array([c.time_ns for c in columns], np.uint64),
        flags=np.array([c.flags for c in columns], np.uint32),
        complete=bool(whole and columns[0].column == 0),
    )
