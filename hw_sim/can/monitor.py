"""Live table of what a device says on CAN: ``python -m upbeam.hw_sim.can.monitor``.

Reads the daemon's datagrams (``--udp HOST:PORT``, where the daemon sends to), any python-can bus (``--interface
socketcan --channel can0``), a serial console (``--serial URL``) or a transcript (``--read FILE``).
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import can
from rich.console import Console
from rich.live import Live
from rich.table import Table

from .bus import NS_PER_S
from .database import Decoded, Decoder, Value
from .e2e import E2EStatus
from .frame import CanFrame
from .pythoncan import UdpInterface, from_message, read_transcript

Frames = Iterator[tuple[int, CanFrame] | None]
"""Frames with their time in ns; None: nothing came for a moment."""


@dataclass(slots=True)
class Row:
    """What was last heard of one message (of one multiplexed part of it)."""

    last: Decoded
    count: int = 0
    refused: int = 0
    """Frames whose E2E check said: do not use."""
    period_ns: int | None = None


@dataclass(slots=True)
class Monitor:
    """Collects frames; :meth:`signals` and :meth:`table` show them."""

    decoder: Decoder = field(default_factory=Decoder)
    rows: dict[str, Row] = field(default_factory=dict)

    def add(self, frame: CanFrame, time_ns: int) -> Decoded | None:
        """Take in one frame. The E2E verdict of the first frame of a message is not held against it."""
        decoded = self.decoder.decode(frame, time_ns)
        if decoded is None:
            return None
        key = self._key(decoded)
        row = self.rows.get(key)
        if row is None:
            row = self.rows[key] = Row(decoded)
        elif decoded.e2e in (E2EStatus.WRONG_CRC, E2EStatus.REPEATED, E2EStatus.WRONG_SEQUENCE):
            row.refused += 1
        if row.count:
            row.period_ns = time_ns - row.last.time_ns
        row.count += 1
        if decoded.signals:
            row.last = decoded
        return decoded

    @staticmethod
    def _key(decoded: Decoded) -> str:
        for selector in ("CounterIndex", "Fault"):
            if decoded.name != "UPB_Faults" and selector in decoded.signals:
                return f"{decoded.name} {decoded.signals[selector]}"
        return decoded.name

    def signals(self, message: str) -> dict[str, Value]:
        """Last signals of a message, multiplexed ones put together; empty if it was not heard."""
        out: dict[str, Value] = {}
        for key, row in self.rows.items():
            if key.split(" ", maxsplit=1)[0] == message:
                out.update(row.last.signals)
        return out

    def table(self, now_ns: int) -> Table:
        """Everything heard, one line each."""
        table = Table(title="CAN status", expand=False)
        for column, justify in (("message", "left"), ("id", "right"), ("frames", "right"), ("refused", "right")):
            table.add_column(column, justify=justify)  # type: ignore[arg-type]
        table.add_column("period ms", justify="right")
        table.add_column("age ms", justify="right")
        table.add_column("signals")
        for key, row in sorted(self.rows.items(), key=lambda item: (item[1].last.frame.identifier, item[0])):
            period = "" if row.period_ns is None else f"{row.period_ns / 1e6:.1f}"
            age = f"{(now_ns - row.last.time_ns) / 1e6:.0f}"
            cells = (key, row.last.frame.name, str(row.count), str(row.refused), period, age, _text(row.last))
            table.add_row(*cells)
        return table


def _text(decoded: Decoded) -> str:
    shown = {name: value for name, value in decoded.signals.items() if not name.startswith("E2E_")}
    if decoded.name == "UPB_Faults":  # only what is active
        shown = {n: v for n, v in shown.items() if v not in ("NO", "NONE")} or {"faults": "none"}
    return " ".join(f"{name}={value}" for name, value in shown.items())


def frames_of(bus: can.BusABC) -> Frames:
    """Frames of a python-can bus, with the time they were taken in."""
    while True:
        message = bus.recv(0.2)
        if message is None:
            yield None
        elif not message.is_error_frame:
            yield time.monotonic_ns(), from_message(message)


def frames_of_console(url: str) -> Frames:
    """Frames of a serial console."""
    from ..serial.client import ConsoleClient

    with ConsoleClient.open(url) as client:
        while True:
            frame = client.receive(0.2)
            yield None if frame is None else (time.monotonic_ns(), frame)


def frames_of_file(path: Path) -> Frames:
    """Frames of a transcript."""
    yield from read_transcript(path)


def _source(arguments: argparse.Namespace) -> Frames:
    if arguments.read:
        return frames_of_file(arguments.read)
    if arguments.serial:
        return frames_of_console(arguments.serial)
    if arguments.interface:
        return frames_of(can.Bus(interface=arguments.interface, channel=arguments.channel, fd=True))
    host, _, port = arguments.udp.rpartition(":")
    return frames_of(UdpInterface(local=(host or "127.0.0.1", int(port))))


def main(argv: list[str] | None = None) -> int:
    """Command line."""
    parser = argparse.ArgumentParser(prog="python -m upbeam.hw_sim.can.monitor", description=__doc__)
    source = parser.add_mutually_exclusive_group(required=True)
    source.add_argument("--udp", metavar="HOST:PORT", help="receive the daemon's CAN datagrams here")
    source.add_argument("--interface", help="python-can interface, with --channel")
    source.add_argument("--serial", metavar="URL", help="serial console: device or pyserial URL")
    source.add_argument("--read", metavar="FILE", type=Path, help="transcript (.blf, .asc, ...)")
    parser.add_argument("--channel", help="channel of --interface")
    parser.add_argument("--seconds", type=float, default=None, help="end after this time")
    arguments = parser.parse_args(argv)
    monitor = Monitor()
    console = Console()
    try:
        _watch(monitor, _source(arguments), console, arguments)
    except KeyboardInterrupt:
        pass
    except (OSError, ValueError, can.CanError) as error:
        print(f"monitor: {error}", file=sys.stderr)
        return 2
    return 0 if monitor.rows else 1


def _watch(monitor: Monitor, frames: Frames, console: Console, arguments: argparse.Namespace) -> None:
    now_ns = 0
    if arguments.read:
        for item in frames:
            if item is not None:
                now_ns = item[0]
                monitor.add(item[1], now_ns)
        console.print(monitor.table(now_ns))
        return
    end = None if arguments.seconds is None else time.monotonic_ns() + round(arguments.seconds * NS_PER_S)
    with Live(console=console, refresh_per_second=4) as live:
        for item in frames:
            if item is not None:
                monitor.add(item[1], item[0])
            now_ns = time.monotonic_ns()
            live.update(monitor.table(now_ns))
            if end is not None and now_ns >= end:
                return


if __name__ == "__main__":
    raise SystemExit(main())
