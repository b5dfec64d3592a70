"""Datagrams on a real network, each at its time, and a record of how late they left."""

from __future__ import annotations

import socket
import time
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from .datagram import DATA_PORT, Datagram

__all__ = ["SendReport", "send_udp"]

_AHEAD = 256
"""Datagrams made before the first is sent, and kept in store while there is time: 0.15 s of a 32-beam sensor."""
_SLACK_NS = 300_000
"""With more time than this until the next datagram, one more is made first."""


@dataclass(frozen=True)
class SendReport:
    """What left, and how punctually. Measured on this machine, by its monotonic clock."""

    datagrams: int
    seconds: float
    late_p50_us: float
    late_p99_us: float
    late_max_us: float
    refused: int
    """Sends that the system refused (nobody listens on the port, no buffer)."""


def send_udp(
    stream: Iterable[Datagram],
    host: str,
    port: int = DATA_PORT,
    *,
    position_port: int | None = None,
    on_start: Callable[[int], None] | None = None,
) -> SendReport:
    """Sends a stream to ``host`` in real time, until it ends.

    Data go to ``port``; others to ``position_port``, or keep their distance from the data port (8308 to port + 5940).
    Each datagram has its deadline on the monotonic clock: one that is late leaves at once and delays no other.
    ``on_start`` gets the monotonic nanoseconds of the stream's time 0. Errors: OSError for an address that cannot be.
    """
    waiting: deque[Datagram] = deque()
    source = iter(stream)
    late: list[int] = []
    refused = 0
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp:
        address = socket.gethostbyname(host)
        _refill(waiting, source, _AHEAD)
        start = time.monotonic_ns() - (waiting[0].time_ns if waiting else 0)
        if on_start is not None:
            on_start(start)
        while waiting:
            datagram = waiting.popleft()
            _wait(start + datagram.time_ns, waiting, source)
            try:
                udp.sendto(datagram.payload, (address, _port(datagram.port, port, position_port)))
            except (ConnectionRefusedError, BlockingIOError):
                refused += 1
            late.append(time.monotonic_ns() - start - datagram.time_ns)
            if not waiting:
                _refill(waiting, source, 1)
        seconds = (time.monotonic_ns() - start) * 1e-9
    p50, p99, worst = np.percentile(late, [50, 99, 100]) / 1e3 if late else (0.0, 0.0, 0.0)
    return SendReport(len(late), seconds, float(p50), float(p99), float(worst), refused)


def _refill(waiting: deque[Datagram], source: Iterable[Datagram], count: int) -> None:
    for _, datagram in zip(range(count), source, strict=False):
        waiting.append(datagram)


def _wait(due_ns: int, waiting: deque[Datagram], source: Iterable[Datagram]) -> None:
    """Sleeps until the deadline; makes datagrams ahead while there is time for it."""
    while (left := due_ns - time.monotonic_ns()) > 0:
        if left > _SLACK_NS and len(waiting) < _AHEAD:
            before = len(waiting)
            _refill(waiting, source, 1)
            if len(waiting) > before:
                continue
        time.sleep(left * 1e-9)


def _port(own: int, port: int, position_port: int | None) -> int:
    if own == DATA_PORT:
        return port
    return position_port if position_port is not None else port + own - DATA_PORT
