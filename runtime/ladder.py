"""The degradation ladder in NumPy: generated rows without a network, to the bit what ``upb_stream_set_mode`` gives."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from upbeam.model.baselines import nearest, valid_mean
from upbeam.model.rules import PAIRS, Rules

__all__ = ["LADDER", "ladder_rows"]

U16 = NDArray[np.uint16]
U8 = NDArray[np.uint8]

LADDER = ("network", "valid_mean", "repeat", "pass_through")
"""Modes from dearest to cheapest: the names of ``upb_mode``."""


def ladder_rows(mode: str, distance: U16, intensity: U8, rules: Rules) -> tuple[U16, U8]:
    """Generated rows ``[31, W]`` of azimuth-aligned counts and intensities ``[32, W]`` in a mode but ``network``.

    The baseline of the same name on what the networks would see (each row within its own limit), and nothing beyond the
    generated row's limit. Halves round up.
    """
    if mode == "pass_through":
        shape = (PAIRS, distance.shape[1])
        return np.zeros(shape, np.uint16), np.zeros(shape, np.uint8)
    method = {"valid_mean": valid_mean, "repeat": nearest}[mode]
    limits = np.asarray(rules.row_max_count)
    seen = rules.valid(distance) & (distance <= limits[0::2, None])
    made, grey = method(
        np.where(seen, distance, 0).astype(np.uint16), np.where(seen, intensity, 0).astype(np.uint8), rules
    )
    given = made <= limits[1 : 2 * PAIRS : 2, None]
    return np.where(given, made, 0).astype(np.uint16), np.where(given, grey, 0).astype(np.uint8)
