"""Methods without training, behind one interface: what any network must beat.

A method takes counts and intensities ``[B, W]`` of azimuth-aligned rows and gives the ``B - 1`` rows between them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from .rules import Rules

__all__ = ["BASELINES", "Method", "bilinear", "nearest", "valid_mean", "window_mean"]

U16 = NDArray[np.uint16]
U8 = NDArray[np.uint8]
FloatArray = NDArray[np.float64]
Method = Callable[[U16, U8, Rules], tuple[U16, U8]]
"""(distance counts [B, W], intensity [B, W], rules) -> the same of the generated rows [B - 1, W]."""


def nearest(distance: U16, intensity: U8, rules: Rules) -> tuple[U16, U8]:
    """Each generated pixel repeats the one above it."""
    d, i = _limited(distance, intensity, rules)
    return _finish(d[:-1], i[:-1], rules)


def bilinear(distance: U16, intensity: U8, rules: Rules) -> tuple[U16, U8]:
    """Mean of the pixels above and below, an empty one counted as 0: image resampling as the paper compares with."""
    d, i = _limited(distance, intensity, rules)
    return _finish((d[:-1] + d[1:]) / 2, (i[:-1] + i[1:]) / 2, rules)


def valid_mean(distance: U16, intensity: U8, rules: Rules) -> tuple[U16, U8]:
    """Mean of the valid ones of the pixels above and below: three lines of NumPy, and what every ratio is taken to."""
    d, i = _limited(distance, intensity, rules)
    count = np.maximum((d[:-1] > 0).astype(np.float64) + (d[1:] > 0), 1.0)
    return _finish((d[:-1] + d[1:]) / count, (i[:-1] + i[1:]) / count, rules)


def window_mean(distance: U16, intensity: U8, rules: Rules) -> tuple[U16, U8]:
    """Mean of the valid pixels of the 2 x 3 window: covers more, and blurs edges more."""
    d, i = _limited(distance, intensity, rules)
    count = np.maximum(_window_sum((d > 0).astype(np.float64)), 1.0)
    return _finish(_window_sum(d) / count, _window_sum(i) / count, rules)


BASELINES: Mapping[str, Method] = {
    "nearest": nearest,
    "bilinear": bilinear,
    "valid-mean": valid_mean,
    "window-mean": window_mean,
}


def _limited(distance: U16, intensity: U8, rules: Rules) -> tuple[FloatArray, FloatArray]:
    valid = rules.valid(distance)
    return np.where(valid, distance, 0).astype(np.float64), np.where(valid, intensity, 0).astype(np.float64)


def _window_sum(x: FloatArray) -> FloatArray:
    pair = x[:-1] + x[1:]
    padded = np.pad(pair, ((0, 0), (1, 1)))
    return padded[:, :-2] + padded[:, 1:-1] + padded[:, 2:]


def _finish(distance: FloatArray, intensity: FloatArray, rules: Rules) -> tuple[U16, U8]:
    rounded = np.floor(distance + 0.5)
    keep = (rounded >= rules.min_count) & (rounded <= rules.max_count)
    grey = np.clip(np.floor(intensity + 0.5), 0, 255)
    return np.where(keep, rounded, 0).astype(np.uint16), np.where(keep, grey, 0).astype(np.uint8)
