"""Clocks of the FPGA core of ``kernels/rtl``, exact: what its simulation counts, for every FOLD and LANES.

The pipeline runs freely: a slot comes every ``interval`` clocks, and what a beat needs after its slot is a constant. So
every figure is a sum. ``tests/hw_sim/test_fpga_cycles.py`` holds each against the simulated core; docs/fpga.md derives
them. Clock 0 is the first after reset, as the simulation counts.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil, log2

from upbeam.model.rules import BEAMS, Rules
from upbeam.quant.export.rtl_schedule import Configuration
from upbeam.quant.integer import Precision

__all__ = ["CoreCycles"]

WINDOW_STAGES = 3
"""From the slot of a beat to its window: receiver, memories, window registers."""
FILL_STAGES = 3
MINIMUM_STAGES = 3
CODE_STAGES = 3
OUTPUT_STAGES = 3
FIFO_CLOCKS = 2
LANE_CLOCKS = 2
"""With more than one lane: to keep a window, to choose a total."""
FIRST_SLOT = 1
FIRST_ACCEPTED = 2
"""Clock at which a source that is there from the start is first served."""
SKID_BEATS = 2
"""Beats that are accepted ahead of their slots."""


@dataclass(frozen=True)
class CoreCycles:
    """Of one configuration. Nothing here holds the source or the sink up unless said."""

    configuration: Configuration
    precision: Precision
    fill: bool = True
    """the rule for empty pixels"""
    seam: bool = True
    """the rule for edges"""

    @classmethod
    def of(cls, configuration: Configuration, precision: Precision, rules: Rules) -> CoreCycles:
        return cls(configuration, precision, rules.empty == "fill", rules.edge == "seam")

    @property
    def interval(self) -> int:
        """Clocks from one beat to the next, and from one window to the next."""
        return self.configuration.interval

    @property
    def network(self) -> int:
        """Clocks from a window's differences to its sum Y, both in registers."""
        c = self.configuration
        lanes = LANE_CLOCKS if c.lanes > 1 else 0
        if c.phases > 1:
            return c.fold + c.behind * c.phases + 3 + lanes
        return c.fold + 5 + (c.fold > 1) + c.rectify + ceil(log2(c.units)) + lanes

    @property
    def pipeline(self) -> int:
        """Clocks from the slot of a beat to its output beat in the FIFO."""
        fill = FILL_STAGES if self.fill else 0
        code = CODE_STAGES if self.precision == "int8" else 0
        return WINDOW_STAGES + fill + MINIMUM_STAGES + code + self.network + OUTPUT_STAGES

    @property
    def beat(self) -> int:
        """Clocks from the slot of a beat to its output beat at the port."""
        return self.pipeline + FIFO_CLOCKS

    # ---------------------------------------------------------------------------------------------- a column

    @property
    def column_latency(self) -> int:
        """From the last beat of column c + 1 accepted to the last beat of column c given, at full rate: that beat waits
        behind those accepted ahead of it."""
        return SKID_BEATS * self.interval - 1 + self.interval + self.beat

    @property
    def column_latency_paced(self) -> tuple[int, int]:
        """The same where the source is slower than the core: least and most, as the beat meets its slot."""
        least = 1 + self.interval + self.beat
        return least, least + self.interval - 1

    @property
    def column(self) -> int:
        """From one column to the next, sustained."""
        return BEAMS * self.interval

    # ----------------------------------------------------------------------------------------------- a frame

    @property
    def first_slot(self) -> int:
        """Clock at which the first beat enters, of a source that is there from the start: one slot is spent on finding
        the frame."""
        waited = ceil((FIRST_ACCEPTED + 1 - FIRST_SLOT) / self.interval) * self.interval
        return FIRST_SLOT + waited + self.interval

    def stream(self, frames: int, columns: int) -> int:
        """First beat accepted to last beat given, both included, of ``frames`` frames and an edge after the last."""
        edges = 1 if self.seam else frames
        slots = BEAMS * (frames * columns + edges) + 1  # one more: beat 31 follows its column's last window
        return self.first_slot - FIRST_ACCEPTED + (slots - 1) * self.interval + self.beat + 1

    def frame(self, columns: int) -> int:
        """``stream`` of one frame."""
        return self.stream(1, columns)

    def frames_per_second(self, clock_hz: float, columns: int) -> float:
        """Sustained."""
        edges = 0 if self.seam else 1
        return clock_hz / (BEAMS * (columns + edges) * self.interval)

    # ----------------------------------------------------------------------------------------- back-pressure

    def stream_bounds(self, frames: int, columns: int, gaps: int, stalls: int) -> tuple[int, int]:
        """Least and most of ``stream`` where the source offered nothing at ``gaps`` clocks and the sink was not ready
        at ``stalls`` clocks before the last beat.

        A slot is lost only where a whole interval passed without an offer, or to a FIFO that filled while whole
        intervals passed without a ready sink; what is on the way when that begins and ends is the last term."""
        free = self.stream(frames, columns)
        soonest = 1 + self.interval  # the first beat comes right before a slot
        on_the_way = self.beat + SKID_BEATS * self.interval
        return free - (self.first_slot - FIRST_ACCEPTED) + soonest, free + gaps + stalls + on_the_way
