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

from .dut import Output

__all__ = ["COLUMN", "HEADER", "Boot", "Done", "Event", "Record"]

HEADER = np.dtype(
    [("magic", "S4"), ("version", "u1"), ("header_bytes", "u1"), ("columns", "u1"), ("rows", "u1"), ("sequence", "<u4"),
     ("model_crc32", "<u4"), ("frame", "<u8"), ("unit_um", "<u4"), ("turn_columns", "<u4")]
)  # fmt: skip
"""A column stream datagram's header, read from its description (docs/column-stream.md) apart from the product's."""
COLUMN = np.dtype(
    [("column", "<u4"), ("azimuth_mdeg", "<u4"), ("time_ns", "<u8"), ("flags", "<u4"), ("distance", "<u2", (64,)),
     ("intensity", "u1", (64,))]
)  # fmt: skip


@dataclass(frozen=True)
class Event:
    """An event of the device (``upb_event``)."""

    time_ns: int
    kind: str
    a: int
    b: int
    value: int
    frame: int
    fault: str
    """Of a fault's event: its name; else empty."""


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
    has_serial: bool = True
    """Whether the tester had a serial line to the device."""
    bus_load: float = 0.0
    samples: list[tuple[int, dict[str, int]]] = field(default_factory=list)
    """Packets dropped by cause, at each tick at which they changed."""
    lateness_ns: list[int] = field(default_factory=list)
    """On the real clock: how late each thing was done."""
    seconds: float = 0.0
    """Wall time of the run."""
    not_possible: str = ""
    """Why it could not be run on this device; empty: it was."""

    def of_kind(self, kind: str) -> list[Output]:
        """Outputs of one kind, in order."""
        return [output for output in self.outputs if output.kind == kind]

    @cached_property
    def events(self) -> list[Event]:
        """The device's, in order."""
        return [
            Event(o.time_ns, e["kind"], e["a"], e["b"], e["value"], e["frame"], e.get("fault", ""))
            for o in self.of_kind("event")
            for e in [o.payload]
        ]

    @cached_property
    def ledger(self) -> list[dict[str, Any]]:
        """Records of closed frames, in order."""
        return [output.payload for output in self.of_kind("ledger")]

    @cached_property
    def headers(self) -> NDArray[Any]:
        """Of the column stream's datagrams (``HEADER``)."""
        heads = b"".join(output.payload[: HEADER.itemsize] for output in self.of_kind("columns"))
        return np.frombuffer(heads, HEADER)

    @cached_property
    def columns(self) -> NDArray[Any]:
        """All columns that left (``COLUMN``), in order."""
        bodies = b"".join(output.payload[HEADER.itemsize :] for output in self.of_kind("columns"))
        return np.frombuffer(bodies, COLUMN)

    @cached_property
    def column_datagram(self) -> NDArray[np.int64]:
        """Of each column: its datagram."""
        return np.repeat(np.arange(len(self.headers)), self.headers["columns"])

    @cached_property
    def output_ns(self) -> NDArray[np.int64]:
        """When datagrams of the column stream left."""
        return np.array([output.time_ns for output in self.of_kind("columns")], dtype=np.int64)

    @property
    def status(self) -> dict[str, Any]:
        """The device's last status."""
        return self.boots[-1].status
