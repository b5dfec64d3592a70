"""Console client over pyserial: frames in and out, request and response, every wait with a monotonic deadline."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from types import TracebackType
from typing import Protocol

import serial

from ..can.commander import Commander, Response
from ..can.frame import CanFrame
from .framing import RecordParser, encode_record

POLL_S = 0.02
"""Longest single read: a deadline is overrun by at most this."""


class Port(Protocol):
    """What the client needs of a pyserial port."""

    timeout: float | None

    def read(self, size: int = 1, /) -> bytes:
        """At most ``size`` bytes, as many as come within ``timeout``."""

    def write(self, data: bytes, /) -> int | None:
        """Send."""

    def close(self) -> None:
        """Close."""


class ConsoleTimeoutError(TimeoutError):
    """Nothing suitable came in time; the message says what did come."""


class ConsoleClient:
    """Frames over a serial line. Not thread-safe.

    :param port: an open pyserial port (device, pty, ``loop://``), or anything like it.
    :param clock: seconds, monotonic; tests give a virtual one.
    """

    def __init__(self, port: Port, clock: Callable[[], float] = time.monotonic) -> None:
        self.port = port
        self.parser = RecordParser()
        self._clock = clock
        self._frames: deque[CanFrame] = deque()
        port.timeout = POLL_S
        port.write(b"\0")  # ends whatever half record the other side has

    @classmethod
    def open(cls, url: str, baudrate: int = 115_200) -> ConsoleClient:
        """Open a device (``/dev/ttyUSB0``), a pty or a pyserial URL (``loop://``, ``socket://host:port``)."""
        return cls(serial.serial_for_url(url, baudrate=baudrate, timeout=POLL_S, write_timeout=1.0))

    def __enter__(self) -> ConsoleClient:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the port."""
        self.port.close()

    def send(self, frame: CanFrame) -> None:
        """Send one record."""
        self.port.write(encode_record(frame))

    def receive(self, timeout_s: float) -> CanFrame | None:
        """Next frame; None if none is complete within ``timeout_s``, however many bytes trickle in."""
        deadline = self._clock() + timeout_s
        while not self._frames:
            self._read_some(max(0.0, deadline - self._clock()))
            if not self._frames and self._clock() >= deadline:
                return None
        return self._frames.popleft()

    def _read_some(self, left_s: float) -> None:
        self.port.timeout = min(POLL_S, left_s)
        waiting = int(getattr(self.port, "in_waiting", 0))
        self._frames.extend(self.parser.feed(self.port.read(max(1, min(waiting, 4096)))))

    def wait_for(self, accept: Callable[[CanFrame], bool], timeout_s: float) -> CanFrame:
        """First frame that ``accept`` takes; others are dropped. :raises ConsoleTimeoutError: none came in time."""
        deadline = self._clock() + timeout_s
        others = 0
        while (frame := self.receive(max(0.0, deadline - self._clock()))) is not None:
            if accept(frame):
                return frame
            others += 1
        raise ConsoleTimeoutError(
            f"no suitable frame in {timeout_s} s: {others} others, {self.parser.refused} records refused"
        )

    def command(self, commander: Commander, frame: CanFrame, timeout_s: float = 1.0) -> Response:
        """Send a command that ``commander`` built and wait for its answer.

        Sent once: its freshness counter is used up. :raises ConsoleTimeoutError: no answer.
        """
        freshness = int.from_bytes(frame.data[4:8], "little")
        answers: list[Response] = []

        def is_answer(candidate: CanFrame) -> bool:
            response = commander.response(candidate)
            if response is None or response.freshness != freshness:
                return False
            answers.append(response)
            return True

        self.send(frame)
        self.wait_for(is_answer, timeout_s)
        return answers[0]
