"""Candidates that do the same work, checked first, then timed by turns."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

__all__ = ["Candidate", "Entry", "Timer", "alternate"]

BURST_NS = 4e6
"""One turn of a candidate takes about so long, but at least one repetition."""
MOST = 24
"""Repetitions of one turn at most."""


class Timer(Protocol):
    def __call__(self, repeats: int, /) -> NDArray[np.uint64]:
        """Nanoseconds of each of ``repeats`` runs, one frame (both images) each."""


@dataclass
class Candidate:
    """Something that can be timed. ``check`` raises ``DifferenceError`` (or anything else) if its output is wrong."""

    name: str
    precision: str
    threads: int
    does: str
    """which part of the work, in words: the rules, or windows given"""
    time: Timer
    check: Callable[[], None]
    group: str = ""
    """``ours``, ``compiler``, or the peer's name"""
    detail: dict[str, Any] = field(default_factory=dict)
    """more for the JSON"""


@dataclass
class Entry:
    """A candidate's times."""

    candidate: Candidate
    ns: list[float]

    @property
    def ms_min(self) -> float:
        return min(self.ns) / 1e6

    @property
    def ms_median(self) -> float:
        return float(np.median(self.ns)) / 1e6


def alternate(
    candidates: Sequence[Candidate], rounds: int, advance: Callable[[], None] = lambda: None
) -> tuple[list[Entry], list[str]]:
    """Checks every candidate, then gives each a turn in every round. Returns times and, for those refused, one line.

    Nothing is timed before its output has been compared. The first repetition of each turn warms caches and is dropped.
    """
    entries: list[Entry] = []
    bursts: list[int] = []
    refused: list[str] = []
    for candidate in candidates:
        try:
            candidate.check()
            least = float(np.min(candidate.time(2)))
        except Exception as error:
            refused.append(f"{candidate.name}: refused, not timed: {' '.join(str(error).split())[:300]}")
            continue
        entries.append(Entry(candidate, []))
        bursts.append(int(np.clip(BURST_NS / max(least, 1.0), 1, MOST)))
    for _ in range(rounds):
        for entry, burst in zip(entries, bursts, strict=True):
            entry.ns += [float(x) for x in entry.candidate.time(burst + 1)[1:]]
        advance()
    return entries, refused
