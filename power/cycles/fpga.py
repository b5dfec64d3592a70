"""The streaming FPGA core as a target: which one fits a part, and what its clocks are worth at a clock rate.

Clocks are exact (``fpga_core``); how they come about: docs/fpga.md.
"""

from __future__ import annotations

from dataclasses import dataclass

from upbeam.power.figures import Figure
from upbeam.quant.export.rtl_schedule import Configuration, ConfigurationError, folds
from upbeam.quant.integer import Precision

from .fpga_core import CoreCycles

__all__ = ["FpgaCore", "FpgaCoreError", "smallest_core"]

NETWORKS = 2
"""Side by side."""


class FpgaCoreError(ValueError):
    """Parameters that make no core."""


@dataclass(frozen=True)
class FpgaCore:
    """A configuration, both networks. ``hidden``: of the wider one. Raises FpgaCoreError for what cannot be built."""

    lanes: int = 1
    fold: int = 1
    hidden: int = 12
    precision: Precision = "int8"

    def __post_init__(self) -> None:
        try:
            Configuration(self.hidden, self.fold, self.lanes)
        except ConfigurationError as error:
            raise FpgaCoreError(str(error)) from None

    @property
    def cycles(self) -> CoreCycles:
        """Of shipped models: rule ``fill``, edge ``seam``, rectifiers without a slope."""
        return CoreCycles(Configuration(self.hidden, self.fold, self.lanes), self.precision)

    @property
    def multipliers(self) -> int:
        """Of all lanes and both networks; FOLD 1 has none, its products are shifts and adds."""
        return 0 if self.fold == 1 else NETWORKS * self.lanes * self.cycles.configuration.multipliers

    @property
    def column_cycles(self) -> int:
        """From one column to the next, sustained."""
        return self.cycles.column

    def frame_cycles(self, columns: int) -> int:
        """First input beat to last output beat of ``columns`` columns and the edge that completes them."""
        if columns < 1:
            raise FpgaCoreError(f"columns {columns}, expected at least 1")
        return self.cycles.frame(columns)

    @property
    def column_latency_cycles(self) -> int:
        """Last input beat of the next column to the last output beat of a column."""
        return self.cycles.column_latency

    def latency(self, clock: Figure, columns: int) -> Figure:
        """Time of a frame at a clock: what the core needs, were the columns there at once."""
        mhz, slow, fast = clock.span("MHz")
        cycles = self.frame_cycles(columns)
        source = f"{cycles} cycles (LANES {self.lanes}, FOLD {self.fold}), as simulated; clock: {clock.source}"
        kind = "simulated" if clock.kind == "simulated" else "modelled"
        return Figure(cycles / mhz / 1e3, cycles / fast / 1e3, cycles / slow / 1e3, "ms", kind, source)


def smallest_core(
    multipliers: int, hidden: int, share: float = 0.8, *, precision: Precision = "int8", known: int | None = None
) -> FpgaCore:
    """One lane, both networks, with the least ``fold`` above 1 whose multipliers fit in ``share`` of those there are,
    or in the eight of the smallest parts. ``known``: no more of them than this, the most of a core whose LUTs are
    known. Raises FpgaCoreError where not even one multiplier is free for each
    network."""
    usable = max(min(multipliers, 8), int(multipliers * share))
    usable = usable if known is None else min(usable, known)
    for fold in (f for f in folds(hidden) if f > 1):
        core = FpgaCore(1, fold, hidden, precision)
        if core.multipliers <= usable:
            return core
    raise FpgaCoreError(f"{multipliers} multipliers: a core of both networks needs at least 2 in {share:.0%} of them")
