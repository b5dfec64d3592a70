"""Packets of a simulated or recorded sensor, sent or written: what ``upbeam simulate --udp`` and ``--pcap`` do."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from upbeam.hw_sim import simulate_frames
from upbeam.hw_sim.faults import Fault, apply_faults, make_fault
from upbeam.hw_sim.sensor import SENSORS, RecordedSensor, ScanLoop, SensorConfig, SimulatedSensor, send_udp
from upbeam.model.toml_file import read_toml
from upbeam.runtime.packets import Datagram, PcapWriter

from .common import UserError

__all__ = ["PacketSettings", "send_packets", "write_packets"]

SCENE_TURNS = 20
"""Turns of a street that are made before sending and played in a loop."""
EPOCH_NS = 946_684_800_000_000_000
"""2000-01-01, of captures."""


@dataclass(frozen=True)
class PacketSettings:
    """Options of the command."""

    sensor: str
    rate: float
    wander: float
    columns: int | None
    returns: str
    seed: int
    frames: int
    source: str
    faults: Path | None


def send_packets(settings: PacketSettings, address: str) -> dict[str, Any]:
    """Sends ``frames`` turns to HOST:PORT in real time; how many packets, and how late."""
    host, _, port = address.rpartition(":")
    if not host or not port.isdigit() or not 0 < int(port) < 65536:
        raise UserError(f"--udp {address}: expected HOST:PORT, a port from 1 to 65535")
    stream, name = _stream(settings)
    report = send_udp(stream, host, int(port))
    return {"sensor": name, "frames": settings.frames, "to": address, **vars(report)}


def write_packets(settings: PacketSettings, path: Path) -> dict[str, Any]:
    """Writes ``frames`` turns as a capture."""
    stream, name = _stream(settings)
    count = 0
    with PcapWriter(path) as pcap:
        for datagram in stream:
            pcap.write(datagram.payload, datagram.time_ns + EPOCH_NS, datagram.port)
            count += 1
    return {"sensor": name, "frames": settings.frames, "file": str(path), "datagrams": count}


def _stream(settings: PacketSettings) -> tuple[Iterator[Datagram], str]:
    """The datagrams, and the sensor's name."""
    sensor = _sensor(settings)
    beams = sensor.beams if isinstance(sensor, RecordedSensor) else sensor.config.beams
    until_ns = round(settings.frames / settings.rate * 1e9)
    return apply_faults(sensor.until(until_ns), _faults(settings), beams, seed=settings.seed), beams.name


def _sensor(settings: PacketSettings) -> SimulatedSensor | RecordedSensor:
    if settings.source not in ("sim", "room"):
        return RecordedSensor.open(settings.source)
    if settings.sensor not in SENSORS:
        raise UserError(f"--sensor {settings.sensor}: packets are made of {', '.join(SENSORS)}")
    config = SensorConfig(
        model=settings.sensor, rate_hz=settings.rate, wander=settings.wander, columns=settings.columns,
        returns=settings.returns, start_azimuth_deg=180.0, seed=settings.seed,  # type: ignore[arg-type]
    )  # fmt: skip
    if settings.source == "room":
        return SimulatedSensor(config)
    scans = simulate_frames(
        config.beams, columns=round(config.firings_per_turn), frames=min(settings.frames, SCENE_TURNS),
        seed=settings.seed, rate_hz=settings.rate, align=False,
    )  # fmt: skip
    return SimulatedSensor(config, ScanLoop(scans))


def _faults(settings: PacketSettings) -> list[Fault]:
    if settings.faults is None:
        return []
    table = read_toml(settings.faults)
    if set(table) != {"fault"}:
        raise UserError(f"{settings.faults}: expected [[fault]] tables, nothing else")
    return [make_fault(fault, rate_hz=settings.rate) for fault in table["fault"]]
