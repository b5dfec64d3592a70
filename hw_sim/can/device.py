"""The device's C bus library as a node of the simulated bus, all on the bus's virtual clock."""

from __future__ import annotations

from typing import Protocol

from .bus import Node, Received, SimulatedBus
from .frame import CanFrame
from .wire import FLAG_BRS, FLAG_EXTENDED, FLAG_FD

STEP_NS = 10_000_000
"""The library asks to be stepped every 10 ms or more often."""


class Device(Protocol):
    """What is asked of a device: :class:`upbeam.runtime.bus.Device` and whatever steps the daemon's core have it."""

    def can(self, id: int, data: bytes, flags: int, now_ns: int) -> bool:
        """A frame received."""

    def step(self, now_ns: int) -> None:
        """Time goes on."""

    def take_can(self) -> list[tuple[int, int, bytes]]:
        """Frames to send: identifier, flags, data."""


class DeviceNode:
    """Joins a device and a node: frames in as they arrive, a step every ``step_ns``, frames out as they come.

    ``start`` and ``stop`` are power on and off: a device that is off neither hears nor acknowledges.
    """

    def __init__(self, bus: SimulatedBus, node: Node, device: Device, step_ns: int = STEP_NS) -> None:
        self.bus, self.node, self.device = bus, node, device
        self.step_ns = step_ns
        self.running = False
        self._life = 0
        node.listeners.append(self._on_frame)
        self.start()

    def start(self, device: Device | None = None) -> None:
        """Power on, with a new device if given; the first step is now."""
        self.device = device or self.device
        self.running = self.node.connected = True
        self._life += 1
        life = self._life
        self.bus.call_at(self.bus.now_ns, lambda: self._step(life))

    def stop(self) -> None:
        """Power off: what waits to be sent is lost."""
        self.running = self.node.connected = False
        self.node.flush()

    def _step(self, life: int) -> None:
        if not self.running or life != self._life:
            return
        self.device.step(self.bus.now_ns)
        self._send()
        self.bus.call_at(self.bus.now_ns + self.step_ns, lambda: self._step(life))

    def _on_frame(self, received: Received) -> None:
        frame = received.frame
        if not self.running or frame.remote:
            return
        flags = FLAG_FD * frame.fd | FLAG_BRS * frame.bit_rate_switch | FLAG_EXTENDED * frame.extended
        if self.device.can(frame.identifier, frame.data, flags, self.bus.now_ns):
            self.device.step(self.bus.now_ns)
        self._send()

    def _send(self) -> None:
        for identifier, flags, data in self.device.take_can():
            extended, fd, switch = (bool(flags & flag) for flag in (FLAG_EXTENDED, FLAG_FD, FLAG_BRS))
            self.node.send(CanFrame(identifier, data, extended, fd, switch))
