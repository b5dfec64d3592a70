"""Cycles of the streaming FPGA core, free of back-pressure.

The schedule that is modelled:

* One beam (distance and intensity) enters per clock: a column is 32 input beats, and never comes faster.
* A column has 31 windows. ``lanes`` windows are computed side by side, each takes ``fold`` clocks of its lane: the
  windows of a column take ``ceil(31 / lanes) * fold`` clocks.
* Reading the next column and computing the last overlap: a column takes the longer of both.
* The output of a column needs the column after it. From that column's last input beat to the last output beat:
  its windows, the pipeline's stages, and one clock for each register at the borders.
* Both networks stand side by side (``networks=2``) or take turns in one datapath (``shared``), which doubles the clocks
  of a window.

``PIPELINE`` is the depth of the datapath; the core's generator decides it. All that would have to change with the core
is in ``FpgaCore.column_cycles``, ``frame_cycles`` and ``column_latency_cycles``.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil

from upbeam.model.rules import BEAMS, PAIRS
from upbeam.power.figures import Figure

__all__ = ["PIPELINE", "FpgaCore", "FpgaCoreError", "smallest_core"]

PIPELINE = 24
"""Stages from a window's last pixel to its output: assumed until a core is simulated."""
TAPS = 8
"""Products of a hidden unit: six pixels, their minimum, the output weight."""


class FpgaCoreError(ValueError):
    """Parameters that make no core."""


@dataclass(frozen=True)
class FpgaCore:
    """A configuration. ``hidden``: of each of the networks."""

    lanes: int = 1
    fold: int = 1
    hidden: int = 12
    shared: bool = False
    """one datapath computes distance, then intensity"""
    pipeline: int = PIPELINE

    def __post_init__(self) -> None:
        if not 1 <= self.lanes <= PAIRS:
            raise FpgaCoreError(f"lanes {self.lanes}, expected 1 to {PAIRS}")
        if not 1 <= self.fold <= TAPS * self.hidden:
            raise FpgaCoreError(f"fold {self.fold}, expected 1 to {TAPS * self.hidden} (all products of a window)")
        if self.hidden < 1 or self.pipeline < 1:
            raise FpgaCoreError(f"hidden {self.hidden} and pipeline {self.pipeline} must be at least 1")

    @property
    def multipliers(self) -> int:
        """Of all lanes and both networks: the products of a window spread over ``fold`` clocks."""
        per_window = ceil(TAPS * self.hidden / self.fold)
        return self.lanes * per_window * (1 if self.shared else 2)

    @property
    def window_cycles(self) -> int:
        """Clocks that a lane is busy with one window."""
        return self.fold * (2 if self.shared else 1)

    @property
    def column_cycles(self) -> int:
        """From one column to the next, sustained."""
        return max(BEAMS, self._compute_cycles)

    @property
    def _compute_cycles(self) -> int:
        return ceil(PAIRS / self.lanes) * self.window_cycles

    def frame_cycles(self, columns: int) -> int:
        """First input beat to last output beat of ``columns`` columns and the one that completes them."""
        if columns < 1:
            raise FpgaCoreError(f"columns {columns}, expected at least 1")
        return columns * self.column_cycles + self.column_latency_cycles

    @property
    def column_latency_cycles(self) -> int:
        """Last input beat of the next column to the last output beat of a column."""
        return self._compute_cycles + self.pipeline

    def latency(self, clock: Figure, columns: int) -> Figure:
        """Time of a frame at a clock: what the core needs, were the columns there at once."""
        mhz, slow, fast = clock.span("MHz")
        cycles = self.frame_cycles(columns)
        source = (
            f"{cycles} cycles (LANES {self.lanes}, FOLD {self.fold}, pipeline of {self.pipeline} stages assumed); "
            f"clock: {clock.source}"
        )
        return Figure(cycles / mhz / 1e3, cycles / fast / 1e3, cycles / slow / 1e3, "ms", "modelled", source)


def smallest_core(multipliers: int, hidden: int, share: float = 0.8) -> FpgaCore:
    """One lane, both networks, with the least ``fold`` whose multipliers fit in ``share`` of those there are, or in the
    eight of the smallest parts. Raises FpgaCoreError where not even one multiplier is free for each network."""
    usable = max(min(multipliers, 8), int(multipliers * share))
    for fold in range(1, TAPS * hidden + 1):
        core = FpgaCore(1, fold, hidden)
        if core.multipliers <= usable:
            return core
    raise FpgaCoreError(f"{multipliers} multipliers: a core of both networks needs at least 2 in {share:.0%} of them")
