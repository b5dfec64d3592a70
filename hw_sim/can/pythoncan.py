"""Our frames and buses as python-can sees them.

:class:`SimulatedInterface` is a node of the simulated bus on virtual time; :class:`UdpInterface` speaks the daemon's
datagrams (one frame each); :class:`Bridge` joins any two python-can buses, for instance the daemon's datagrams with
``udp_multicast`` or ``virtual``. Of these only the simulated bus has bit times, arbitration and errors: ``virtual``
is a queue within one process, ``udp_multicast`` is a network of datagrams (unordered, lossy), and so is our own.
"""

from __future__ import annotations

import socket
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path

import can
from can.interfaces.udp_multicast import UdpMulticastBus

from .bus import NS_PER_S, Node, Received, SimulatedBus
from .frame import CanFrame
from .wire import MAX_BYTES, decode_frame, encode_frame

Advance = Callable[[int], bool]
"""Moves virtual time on to the next event, at most to the ns given; False if nothing happened before that."""


def to_message(frame: CanFrame, time_ns: int = 0, *, channel: str | int | None = None) -> can.Message:
    """A received frame as python-can has it; the timestamp is ``time_ns`` in seconds."""
    return can.Message(
        timestamp=time_ns / NS_PER_S,
        arbitration_id=frame.identifier,
        is_extended_id=frame.extended,
        is_remote_frame=frame.remote,
        is_fd=frame.fd,
        bitrate_switch=frame.bit_rate_switch,
        error_state_indicator=frame.error_state_indicator,
        channel=channel,
        dlc=frame.remote_length if frame.remote else len(frame.data),
        data=frame.data,
        check=True,
    )


def from_message(message: can.Message) -> CanFrame:
    """The frame in a message. :raises ValueError: an error frame, or anything that no controller could send."""
    if message.is_error_frame:
        raise ValueError("an error frame carries no data")
    return CanFrame(
        message.arbitration_id,
        bytes(message.data),
        extended=message.is_extended_id,
        fd=message.is_fd,
        bit_rate_switch=message.bitrate_switch,
        error_state_indicator=message.error_state_indicator,
        remote=message.is_remote_frame,
        remote_length=message.dlc if message.is_remote_frame else 0,
    )


class SimulatedInterface(can.BusABC):
    """A node of a :class:`SimulatedBus` as a python-can bus, on virtual time and in one thread.

    ``recv(timeout)`` moves the virtual clock on until a frame comes or ``timeout`` virtual seconds (None: 60) have
    gone by; it never waits for the real clock. Not for :class:`can.Notifier` nor ``send_periodic``, which have
    threads of their own and live on the real clock. ``advance`` moves the clock where more than the bus lives on it.
    """

    FOREVER_S = 60.0

    def __init__(self, bus: SimulatedBus, node: Node, advance: Advance | None = None) -> None:
        self.bus = bus
        self.node = node
        self._advance = advance or bus.advance_next
        self._pending: deque[Received] = deque()
        self._listener = self._pending.append
        node.listeners.append(self._listener)
        super().__init__(channel=node.name)
        self.channel_info = f"simulated bus, node {node.name}"

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Queue a frame now. :raises can.CanOperationError: the node is bus-off or its queue is full."""
        refused = self.node.refused
        if self.node.counters.off:
            raise can.CanOperationError(f"node {self.node.name} is bus-off")
        self.node.send(from_message(msg))
        if self.node.refused != refused:
            raise can.CanOperationError(f"node {self.node.name}: transmit queue is full")

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """Next frame; None after ``timeout`` virtual seconds."""
        limit = self.bus.now_ns + round((self.FOREVER_S if timeout is None else timeout) * NS_PER_S)
        while True:
            while self._pending:
                received = self._pending.popleft()
                message = to_message(received.frame, received.time_ns, channel=self.node.name)
                if self._matches_filters(message):
                    return message
            if not self._advance(limit) and not self._pending:
                return None

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        return self.recv(timeout), True

    def shutdown(self) -> None:
        """Leave the bus."""
        if self._listener in self.node.listeners:
            self.node.listeners.remove(self._listener)
        super().shutdown()


class UdpInterface(can.BusABC):
    """The daemon's CAN datagrams as a python-can bus, on the real clock.

    Sends to ``peer`` and receives at ``local`` (host, port; port 0: any free one). Datagrams that hold no frame are
    counted in ``malformed``; ``refused`` counts what was sent while nobody listened at ``peer``.
    """

    def __init__(self, peer: tuple[str, int] | None = None, local: tuple[str, int] = ("127.0.0.1", 0)) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(local)
        self.peer = peer
        self.malformed = 0
        self.refused = 0
        super().__init__(channel=f"udp:{self.address[0]}:{self.address[1]}")
        self.channel_info = f"CAN frames in UDP datagrams at {self.address[0]}:{self.address[1]}"

    @property
    def address(self) -> tuple[str, int]:
        """Where this end receives."""
        host, port = self._socket.getsockname()
        return str(host), int(port)

    def fileno(self) -> int:
        """For ``select``."""
        return self._socket.fileno()

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send one datagram. :raises can.CanOperationError: no peer was given."""
        if self.peer is None:
            raise can.CanOperationError("no peer to send to")
        try:
            self._socket.sendto(encode_frame(from_message(msg)), self.peer)
        except ConnectionRefusedError:
            self.refused += 1

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        limit = None if timeout is None else time.monotonic() + timeout
        while True:
            left = None if limit is None else max(limit - time.monotonic(), 0.0)
            self._socket.settimeout(left)
            try:
                data = self._socket.recv(MAX_BYTES + 1)
                return to_message(decode_frame(data), time.time_ns(), channel=self.channel_info), False
            except ConnectionRefusedError:
                self.refused += 1
            except ValueError:
                self.malformed += 1
            except (TimeoutError, BlockingIOError):
                return None, False

    def shutdown(self) -> None:
        """Close the socket."""
        super().shutdown()
        self._socket.close()


class Bridge:
    """Passes frames between two python-can buses, both ways, whenever :meth:`pump` is called.

    Frames that the other side cannot carry are counted in ``dropped``. python-can's ``udp_multicast`` gives a sender
    its own frames back: such an echo is recognised by its content, dropped and counted in ``echoes``. (Should an
    echo get lost, an equal frame from somebody else is taken for it, once.)
    """

    ECHOES_AWAITED = 256

    def __init__(self, one: can.BusABC, other: can.BusABC) -> None:
        self.one = one
        self.other = other
        self.passed = 0
        self.dropped = 0
        self.echoes = 0
        self._awaited: dict[int, deque[CanFrame]] = {
            id(bus): deque(maxlen=self.ECHOES_AWAITED) for bus in (one, other) if isinstance(bus, UdpMulticastBus)
        }

    def pump(self, timeout: float = 0.0) -> int:
        """Pass on what is waiting, waiting up to ``timeout`` seconds for the first frame; how many were passed."""
        before = self.passed
        wait = timeout
        while self._pass(self.one, self.other, wait) or self._pass(self.other, self.one, 0.0):
            wait = 0.0
        return self.passed - before

    def _pass(self, source: can.BusABC, target: can.BusABC, timeout: float) -> bool:
        message = source.recv(timeout)
        if message is None:
            return False
        try:
            frame = from_message(message)
            if self._is_echo(source, frame):
                return True
            target.send(message)
        except (can.CanError, ValueError):
            self.dropped += 1
            return True
        self.passed += 1
        if id(target) in self._awaited:
            self._awaited[id(target)].append(frame)
        return True

    def _is_echo(self, source: can.BusABC, frame: CanFrame) -> bool:
        awaited = self._awaited.get(id(source), deque())
        if frame not in awaited:
            return False
        awaited.remove(frame)
        self.echoes += 1
        return True


class Transcript:
    """Everything on a simulated bus as a file for CAN tools; the suffix chooses python-can's writer (.blf, .asc ...).

    A frame stands once, at the end of its transmission, with virtual time counted from ``epoch_s``; every error frame
    seen by a node is one error message. Error events carry no data.
    """

    EPOCH_S = 946_684_800  # 2000-01-01: the file format holds absolute times and knows none before 1990

    def __init__(self, bus: SimulatedBus, path: Path) -> None:
        self._bus = bus
        self._path = path
        self.frames = 0
        self.errors = 0

    def write(self) -> None:
        """Write all that the bus has kept so far."""
        entries: list[tuple[int, int, can.Message]] = []
        for sent in self._bus.transmissions:
            message = to_message(sent.frame, 0, channel=0)
            entries.append((sent.end_ns, 0, message))
        for event in self._bus.events:
            if event.what == "error":
                entries.append((event.time_ns, 1, can.Message(is_error_frame=True, channel=0)))
        entries.sort(key=lambda entry: entry[:2])
        with can.Logger(str(self._path)) as writer:
            if hasattr(writer, "start_timestamp"):  # BLF: times count from here, not from the first frame
                writer.start_timestamp = float(self.EPOCH_S)
            for time_ns, _, message in entries:
                message.timestamp = self.EPOCH_S + time_ns / NS_PER_S
                writer.on_message_received(message)
        self.errors = sum(m.is_error_frame for *_, m in entries)
        self.frames = len(entries) - self.errors


def read_transcript(path: Path) -> list[tuple[int, CanFrame]]:
    """Frames of a transcript with virtual time in ns (to the microsecond: the reader's times are floating point)."""
    out = []
    with can.LogReader(str(path)) as reader:
        for message in reader:
            if not message.is_error_frame:
                micros = round((message.timestamp - Transcript.EPOCH_S) * 1e6)
                out.append((micros * 1000, from_message(message)))
    return out


def drain(bus: can.BusABC, limit: int = 10_000) -> list[can.Message]:
    """Messages waiting at a bus, without waiting for more."""
    out: list[can.Message] = []
    while len(out) < limit and (message := bus.recv(0.0)) is not None:
        out.append(message)
    return out
