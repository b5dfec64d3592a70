"""Columns as beats of the core's AXI4-Streams, and back."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from upbeam.model.rules import BEAMS, ROWS

__all__ = ["ENDS", "LAST", "STARTS", "OutputColumns", "column_beats", "image_beats", "output_columns"]

U8 = NDArray[np.uint8]
U16 = NDArray[np.uint16]
U32 = NDArray[np.uint32]
U64 = NDArray[np.uint64]

LAST = np.uint32(1 << 24)
"""tlast: beam 31."""
STARTS = np.uint32(1 << 25)
"""tuser[0]: the first beat of a frame."""
ENDS = np.uint32(1 << 26)
"""tuser[1]: the stream ends after this column, an edge."""


def column_beats(distance: U16, intensity: U8) -> U32:
    """Columns ``[32, N]`` -> beats ``[N, 32]`` without frame marks."""
    words: U32 = distance.T.astype(np.uint32) | intensity.T.astype(np.uint32) << np.uint32(16)
    words[:, BEAMS - 1] |= LAST
    return words


def image_beats(distance: U16, intensity: U8, turn: int, *, ends: bool = True) -> U32:
    """Frames of ``turn`` columns each, side by side ``[32, N]`` -> beats ``[32 N]``; ``ends``: with an edge after."""
    words = column_beats(distance, intensity)
    words[::turn, 0] |= STARTS
    if ends:
        words[-1, BEAMS - 1] |= ENDS
    return words.reshape(-1)


@dataclass(frozen=True)
class OutputColumns:
    """Output beats as columns."""

    distance: U16
    """[64, N]"""
    intensity: U8
    """[64, N]"""
    starts: NDArray[np.bool_]
    """[N] first column of a frame"""
    incomplete: NDArray[np.bool_]
    """[N] came short; empty from the missing beam on"""


def output_columns(beats: U64) -> OutputColumns:
    """Beats ``[32 N]`` in the harness's format. Raises ValueError where they are no whole columns or wrongly marked."""
    if len(beats) % BEAMS:
        raise ValueError(f"{len(beats)} output beats, expected whole columns of {BEAMS}")
    b = beats.reshape(-1, BEAMS)
    last, starts, incomplete = ((b >> np.uint64(bit)) & np.uint64(1) for bit in (48, 49, 50))
    if np.any(last[:, :-1]) or not np.all(last[:, -1]):
        raise ValueError("tlast must mark beat 31 of each output column and no other")
    if np.any(starts[:, 1:]):
        raise ValueError("tuser[0] must mark the first beat of a column only")
    distance, intensity = np.zeros((ROWS, len(b)), np.uint16), np.zeros((ROWS, len(b)), np.uint8)
    for row, shift in ((0, 0), (1, 24)):
        distance[row::2] = (b.T >> np.uint64(shift)) & np.uint64(0xFFFF)
        intensity[row::2] = (b.T >> np.uint64(shift + 16)) & np.uint64(0xFF)
    return OutputColumns(distance, intensity, starts[:, 0] != 0, np.any(incomplete != 0, axis=1))
