"""The simulated core: beats in, beats out, the clock of each."""

from __future__ import annotations

import subprocess
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from upbeam.quant.export.rtl import configuration, core_headers
from upbeam.quant.export.source import Source
from upbeam.quant.integer import Precision

from .beats import U8, U16, U32, U64, OutputColumns, image_beats, output_columns
from .simulators import Simulator, Trace, build

__all__ = ["EVENTS", "RtlCore", "Run", "SimulationError", "Traffic"]

EVENTS = (
    "columns", "frames", "short_columns", "long_columns", "short_frames", "long_frames", "dropped_beats", "overruns",
)  # fmt: skip
_MAGIC = 0x31425055
_FOREVER = 1 << 62
_FAILURES = {
    1: "m_axis_tvalid fell before m_axis_tready",
    2: "m_axis data changed before m_axis_tready",
    3: "the run did not end within max_clocks",
}
_HEAD = np.dtype(
    [
        ("magic", "<u4"), ("failed", "<u4"), ("accepted", "<u8"), ("given", "<u8"), ("clocks", "<u8"),
        ("gaps", "<u8"), ("stalls", "<u8"), ("events", "<u8", len(EVENTS)),
    ]
)  # fmt: skip
_GIVEN = np.dtype([("beat", "<u8"), ("clock", "<u4"), ("rose", "<u4")])


class SimulationError(RuntimeError):
    """The core broke a rule of AXI4-Stream, or the simulator failed."""


@dataclass(frozen=True)
class Traffic:
    """What surrounds the core. The same seed gives the same clocks."""

    gap: float = 0.0
    """share of the clocks at which the source offers nothing new"""
    stall: float = 0.0
    """share of the clocks at which the sink is not ready"""
    stuck: tuple[int, int | None] = (0, 0)
    """clocks from, until (None: for ever): the sink takes nothing at all"""
    seed: int = 1


@dataclass(frozen=True)
class Run:
    """Of one simulation. Clock 0 is the first after reset."""

    accepted: U32
    """clock of each accepted input beat"""
    beats: U64
    """output beats: bits 0..47 tdata, 48 tlast, 49..50 tuser"""
    given: U32
    """clock at which each was taken"""
    offered: U32
    """clock at which each was first valid"""
    clocks: int
    gaps: int
    """clocks at which the source offered nothing, before its last beat"""
    stalls: int
    """clocks at which the sink was not ready, before its last beat"""
    events: dict[str, int] = field(default_factory=dict)

    @property
    def columns(self) -> OutputColumns:
        return output_columns(self.beats)


class RtlCore:
    """A simulated core of one model, precision, FOLD and LANES. Built once, kept in the user's cache."""

    def __init__(
        self,
        source: Source,
        precision: Precision,
        *,
        fold: int | None = None,
        lanes: int = 1,
        simulator: Simulator = "verilator",
        trace: Trace | None = None,
    ) -> None:
        """``fold`` omitted: one hidden unit a clock. ``trace``: what ``run`` can write.

        Raises ExportError, ConfigurationError and ToolError."""
        self.configuration = configuration(source.integer(precision), fold=fold, lanes=lanes)
        headers = core_headers(source, precision, fold=fold, lanes=lanes)
        self.program: Path = build(headers, simulator, trace=trace)
        self.trace = trace

    def run(
        self,
        beats: U32,
        columns: int,
        traffic: Traffic | None = None,
        *,
        trace: Path | None = None,
        timeout_s: float = 600,
    ) -> Run:
        """``beats``: see ``beats.py``; ``columns`` of a frame. Raises SimulationError where the core breaks a rule of
        AXI4-Stream or the simulator fails."""
        if trace is not None and not self.trace:
            raise ValueError("this simulator was built without trace")
        t = traffic or Traffic()
        options = {
            "columns": columns,
            "seed": t.seed,
            "gap": round(t.gap * 65536),
            "stall": round(t.stall * 65536),
            "stuck-from": t.stuck[0],
            "stuck-until": _FOREVER if t.stuck[1] is None else t.stuck[1],
            "quiet": 80 * self.configuration.interval + 500,
        }
        command = [str(self.program), *(text for key, value in options.items() for text in (f"--{key}", str(value)))]
        if trace is not None:
            command += ["--trace", str(trace)]
        done = subprocess.run(
            command,
            input=np.ascontiguousarray(beats, "<u4").tobytes(),
            capture_output=True,
            timeout=timeout_s,
            check=False,
        )
        if done.returncode:
            raise SimulationError(f"the simulator ended with status {done.returncode}: {done.stderr.decode()}".rstrip())
        return _parse(done.stdout)

    def image(self, distance: U16, intensity: U8, traffic: Traffic | None = None) -> tuple[U16, U8]:
        """An image of its own ``[32, W]`` -> ``[64, W]``: both ends are edges."""
        width = distance.shape[1]
        made = self.run(image_beats(distance, intensity, width), width, traffic).columns
        return made.distance, made.intensity


def _parse(data: bytes) -> Run:
    head = np.frombuffer(data, _HEAD, 1)[0]
    if head["magic"] != _MAGIC:
        raise SimulationError("the simulator's answer does not begin with its mark")
    if head["failed"]:
        raise SimulationError(_FAILURES[int(head["failed"])])
    accepted: NDArray[np.uint32] = np.frombuffer(data, "<u4", int(head["accepted"]), _HEAD.itemsize)
    given = np.frombuffer(data, _GIVEN, int(head["given"]), _HEAD.itemsize + accepted.nbytes)
    events = {name: int(count) for name, count in zip(EVENTS, head["events"], strict=True)}
    clocks, gaps, stalls = (int(head[name]) for name in ("clocks", "gaps", "stalls"))
    return Run(accepted, given["beat"], given["clock"], given["rose"], clocks, gaps, stalls, events)
