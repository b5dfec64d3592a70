"""The device under test as the bench sees it: bytes and times in, bytes and times out, and what can be done to it."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol

import numpy as np

from upbeam.hw_sim.can import CanFrame
from upbeam.hw_sim.sensor import DATA_PORT, POSITION_PORT, Datagram
from upbeam.runtime.daemon import HDL_32E, VLP_32C, Daemon, DaemonError
from upbeam.runtime.upsampler import shipped_models

from .models import model_file

__all__ = ["DATA_SOURCE", "KEY", "Dut", "InProcessDut", "NotPossibleError", "Output"]

DATA_SOURCE = 0xC0A801C9
"""192.168.1.201, where Velodyne sensors send from."""
KEY = bytes(range(1, 17))
"""Of the bench's commands."""
SENSORS = {"hdl-32e": HDL_32E, "vlp-32c": VLP_32C}
SERVICE_NS = (120_000, 60_000, 40_000, 30_000)
"""Work on a packet by mode on virtual time, unless a scenario says otherwise: modelled, a slow core at a fifth of its
load. Packets come every 553 us (HDL-32E) or 664 us (VLP-32C)."""


class NotPossibleError(Exception):
    """This device cannot do what a scenario asks of it: the scenario is not run on it, and counted so."""


class Output(NamedTuple):
    """Something that left the device."""

    kind: str
    """columns, hdl64, can, serial, ledger or event."""
    time_ns: int
    """Of the bench's clock."""
    payload: Any
    """Bytes; of can a ``CanFrame``; of ledger and event a dict by the fields of the C structs."""


class Dut(Protocol):
    """A device under test. Times are the bench's, never falling."""

    name: str
    virtual: bool
    """Whether time is what the bench says."""
    can_do: frozenset[str]
    """Disturbances it knows (``DeviceFault``)."""

    def power_on(self, time_ns: int) -> None: ...

    def power_off(self, time_ns: int) -> dict[str, Any]:
        """Cuts the supply; gives the last status."""
        ...

    def datagram(self, datagram: Datagram) -> None: ...

    def can(self, frame: CanFrame, time_ns: int) -> None: ...

    def serial(self, data: bytes, time_ns: int) -> None: ...

    def tick(self, time_ns: int) -> None:
        """Time passes."""
        ...

    def bus_off(self, off: bool) -> None:
        """Whether its CAN controller takes no frames."""
        ...

    def disturb(self, what: str, settings: dict[str, Any] | None) -> None:
        """Begins a disturbance, or ends it (None)."""
        ...

    def swap_model(self, ubm: bytes, time_ns: int) -> None: ...

    def take(self) -> list[Output]:
        """What has left since the last call, in order of time."""
        ...

    def status(self) -> dict[str, Any]:
        """Counters and state, the names of ``upb_daemon_status`` and ``upb_daemon_counters``."""
        ...

    def end(self, time_ns: int) -> None:
        """A clean end."""
        ...


@dataclass
class InProcessDut:
    """The daemon's core in this process, on virtual time."""

    settings: Mapping[str, Any]
    """Fields of ``upb_daemon_config``; ``sensor`` by name; ``model``: the name of a shipped model."""
    sabotage: str | None = None
    """Name of a detection or reaction that is taken out."""
    name: str = "inprocess"
    virtual: bool = True
    can_do: frozenset[str] = frozenset({"bit_flip", "slow_down", "bus_off", "wrong_crc", "serial_noise", "reset"})
    _stored: dict[int, bytes] = field(default_factory=dict)
    _daemon: Daemon | None = None
    _service_ns: Sequence[int] = SERVICE_NS

    def power_on(self, time_ns: int) -> None:
        settings = dict(self.settings)
        sensor = str(settings.pop("sensor", "vlp-32c"))
        model = str(settings.pop("model", sensor))
        self._service_ns = settings.setdefault("service_ns", list(SERVICE_NS))
        self._daemon = Daemon(
            model_file(model), {"sensor": SENSORS[sensor], **settings}, key=KEY, stored=self._stored,
            models=[model_file(f"another {model}"), *(model_file(name) for name in shipped_models())],
            sabotage=() if self.sabotage is None else (self.sabotage,),
        )  # fmt: skip
        self._daemon.tick(time_ns)

    def power_off(self, time_ns: int) -> dict[str, Any]:
        status = self.status()
        self._stored = self.daemon.stored()
        self._daemon = None
        return status

    @property
    def daemon(self) -> Daemon:
        """Raises RuntimeError while it has no power."""
        if self._daemon is None:
            raise RuntimeError("the device has no power")
        return self._daemon

    def datagram(self, datagram: Datagram) -> None:
        if datagram.port == DATA_PORT:
            self.daemon.packet(datagram.payload, datagram.time_ns, DATA_SOURCE)
        elif datagram.port == POSITION_PORT:
            self.daemon.position(datagram.payload, datagram.time_ns, DATA_SOURCE)

    def can(self, frame: CanFrame, time_ns: int) -> None:
        flags = frame.fd | frame.bit_rate_switch << 1 | frame.extended << 2
        self.daemon.can(frame.identifier, frame.data, time_ns, flags)

    def serial(self, data: bytes, time_ns: int) -> None:
        self.daemon.serial(data, time_ns)

    def tick(self, time_ns: int) -> None:
        self.daemon.tick(time_ns)

    def bus_off(self, off: bool) -> None:
        self.daemon.set_links(can=not off)

    def disturb(self, what: str, settings: dict[str, Any] | None) -> None:
        if what == "slow_down":
            factor = settings["factor"] if settings else 1.0
            self.daemon.set_service([round(ns * factor) for ns in self._service_ns])
        elif what == "bit_flip" and settings is not None:
            rng = np.random.default_rng([settings["seed"], 0xB17])
            for _ in range(settings["bits"]):
                size = self.daemon.region_bytes(settings["region"])
                self.daemon.flip_bit(settings["region"], int(rng.integers(8 * size)))
        else:
            raise NotPossibleError(f"{self.name}: cannot do {what}")

    def swap_model(self, ubm: bytes, time_ns: int) -> None:
        with contextlib.suppress(DaemonError):  # a refusal is an event and a counter: those are judged
            self.daemon.swap_model(ubm, time_ns)

    def take(self) -> list[Output]:
        left = self.daemon.take()
        out = [Output("columns", *item) for item in left.columns]
        out += [Output("hdl64", *item) for item in left.hdl64]
        out += [Output("can", f.time_ns, _frame(f.id, f.flags, f.data)) for f in left.can]
        out += [Output("serial", *item) for item in left.serial]
        out += [Output("ledger", record["output_ns"], record) for record in left.ledger]
        out += [Output("event", event["time_ns"], event) for event in left.events]
        out.sort(key=lambda output: output.time_ns)
        return out

    def status(self) -> dict[str, Any]:
        return {**self.daemon.status, **self.daemon.counters, "latency": self.daemon.latency_ns}

    def end(self, time_ns: int) -> None:
        self.daemon.end(time_ns)


def _frame(identifier: int, flags: int, data: bytes) -> CanFrame:
    return CanFrame(identifier, data, extended=bool(flags & 4), fd=bool(flags & 1), bit_rate_switch=bool(flags & 2))
