"""Everything that happened on the bench during one scenario, in the order it happened: what the judge looks at."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from upbeam.hw_sim.can import CanFrame
from upbeam.hw_sim.can.commander import Response
from upbeam.hw_sim.can.database import Decoded
from upbeam.hw_sim.sensor import Datagram
from upbeam.runtime.daemon import Columns, read_columns

from .dut import Output

__all__ = ["Boot", "Done", "Event", "Record"]


@dataclass(frozen=True)
class Event:
    """An event of the device (``upb_event``), with the names of its numbers."""

    time_ns: int
    kind: str
    a: int
    b: int
    value: int
    frame: int
    fault: str = ""
    """Of a fault's event: its name."""


@dataclass(frozen=True)
class Done:
    """Something the bench did: a fault's begin or end, an action, power on or off."""

    time_ns: int
    what: str


@dataclass
class Boot:
    """From power on to power off, or to the end."""

    start_ns: int
    end_ns: int | None = None
    delivered: int = 0
    """Datagrams on the data port."""
    positions: int = 0
    status: dict[str, Any] = field(default_factory=dict)
    """The last."""


@dataclass
class Record:
    """One run of one scenario."""

    scenario: str
    dut: str
    virtual: bool
    delivered: list[Datagram] = field(default_factory=list)
    """To the device, powered."""
    unheard: int = 0
    """Datagrams that came while it had no power, or to a port where nobody listens."""
    boots: list[Boot] = field(default_factory=list)
    outputs: list[Output] = field(default_factory=list)
    done: list[Done] = field(default_factory=list)
    heard: list[Decoded] = field(default_factory=list)
    """CAN frames as the tester took them off the bus."""
    serial: list[tuple[int, CanFrame]] = field(default_factory=list)
    """Records of the serial console as the tester read them."""
    serial_refused: int = 0
    """Records of the device that the tester could not read."""
    answers: list[tuple[int, str, Response]] = field(default_factory=list)
    """To commands: time, channel, answer."""
    diagnostics: list[tuple[int, str, Any]] = field(default_factory=list)
    """What diagnostics gave: time, action, result."""
    bus_load: float = 0.0
    samples: list[tuple[int, dict[str, int]]] = field(default_factory=list)
    """Packets dropped by cause, at each tick at which they changed."""
    seconds: float = 0.0
    """Wall time of the run."""
    not_possible: str = ""
    """Why it could not be run on this device; empty: it was."""

    def of_kind(self, kind: str) -> list[Output]:
        """Outputs of one kind, in order."""
        return [output for output in self.outputs if output.kind == kind]

    @cached_property
    def ledger(self) -> list[Output]:
        return self.of_kind("ledger")

    @cached_property
    def columns(self) -> list[tuple[int, Columns]]:
        """Of the column stream: when each datagram left, and what it holds."""
        return [(output.time_ns, read_columns(output.payload)) for output in self.of_kind("column_stream")]

    @cached_property
    def output_times(self) -> NDArray[np.int64]:
        """When datagrams of the column stream left."""
        return np.array([output.time_ns for output in self.of_kind("column_stream")], dtype=np.int64)

    @property
    def status(self) -> dict[str, Any]:
        """The device's last status."""
        return self.boots[-1].status
