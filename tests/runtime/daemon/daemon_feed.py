"""A sensor for the daemon's tests: firings of a smooth made-up scene as packets, on virtual time."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from upbeam.runtime.daemon import HDL_32E, VLP_32C, Daemon, Outputs
from upbeam.runtime.packets import DUAL, SECOND, Encoder, Firings, Position, sensor_info

MODELS = Path(__file__).resolve().parents[3] / "quant" / "models"
SENSORS = {"hdl-32e": HDL_32E, "vlp-32c": VLP_32C}
MS = 1_000_000


def sensor_settings() -> dict[str, object]:
    """Of upbeamd, for a run that is to be judged as it would be on a vehicle."""
    return {
        "ladder_mean_ms": 5,
        "ladder_repeat_ms": 10,
        "ladder_pass_ms": 20,
        "stale_ms": 40,
        "timeout_ms": 50,
        "rpm": 0,
    }


def model_file(sensor: str = "hdl-32e") -> bytes:
    return (MODELS / f"{sensor}.ubm").read_bytes()


@dataclass(frozen=True)
class Packet:
    time_ns: int
    """The sensor's clock when its last firing was done: when it is sent."""
    data: bytes


_MADE: dict[Any, tuple[list[Packet], Firings | None]] = {}
"""Feeds that were made: many tests use the same."""


@dataclass
class Feed:
    """Firings ``n`` of an endless turn: azimuths, times, a scene that depends on both, and packets of them."""

    sensor: str = "hdl-32e"
    rpm: float = 600.0
    dual: bool = False
    start_deg: float = 181.0
    start_ns: int = 5 * 10**9
    seed: int = 1
    noise: int = 3
    firings: Firings | None = field(default=None, init=False)

    @property
    def cycle_ns(self) -> int:
        return sensor_info(self.sensor).firing_cycle_ns

    @property
    def columns(self) -> float:
        """Firings of a turn."""
        return 60e9 / (self.rpm * self.cycle_ns)

    def scene(self, azimuth_deg: NDArray[np.float64]) -> tuple[NDArray[np.uint16], NDArray[np.uint8]]:
        rng = np.random.default_rng(self.seed)
        beam = np.arange(32)[None, :]
        wave = 8.0 + 5.0 * np.sin(np.radians(azimuth_deg))[:, None] + 0.3 * (31 - beam)
        unit = 0.004 if self.sensor == "vlp-32c" else 0.002
        counts = np.round(wave / unit).astype(np.int64) + rng.integers(-self.noise, self.noise + 1, (len(wave), 32))
        counts[rng.random(counts.shape) < 0.1] = 0
        return counts.astype(np.uint16), np.where(counts > 0, 40 + beam, 0).astype(np.uint8)

    def make(self, turns: float) -> list[Packet]:
        """Packets of so many turns; ``firings`` are then what they hold."""
        key = (self.sensor, self.rpm, self.dual, self.start_deg, self.start_ns, self.seed, self.noise, turns)
        if key not in _MADE:
            _MADE[key] = (self._make(turns), self.firings)
        packets, self.firings = _MADE[key]
        return list(packets)

    def _make(self, turns: float) -> list[Packet]:
        per_packet = sensor_info(self.sensor).packet_firings // (2 if self.dual else 1)
        count = int(turns * self.columns) // per_packet * per_packet
        n = np.arange(count)
        azimuth = self.start_deg + n * 360.0 / self.columns
        mdeg = np.round(azimuth % 360.0 * 100).astype(np.int64) % 36000 * 10
        times = self.start_ns + n * self.cycle_ns
        distance, intensity = self.scene(azimuth)
        primary = Firings.of(distance, intensity, azimuth_mdeg=mdeg, time_ns=times, flags=DUAL if self.dual else 0)
        self.firings = primary
        encoder = Encoder(self.sensor, return_mode="dual" if self.dual else "strongest")
        packets = encoder.encode(self._with_seconds(primary) if self.dual else primary)
        sent = times[per_packet - 1 :: per_packet] + self.cycle_ns
        return [Packet(int(t), data) for t, data in zip(sent, packets, strict=True)]

    def _with_seconds(self, primary: Firings) -> Firings:
        order = np.repeat(np.arange(len(primary)), 2)
        doubled = primary[order]
        second = np.arange(len(order)) % 2 == 1
        distance = doubled.distance.copy()
        intensity = doubled.intensity.copy()
        distance[second] = np.where(distance[second] > 0, distance[second] + 500, 0)
        intensity[second] = intensity[second] // 2
        return Firings.of(
            distance,
            intensity,
            azimuth_mdeg=doubled.azimuth_mdeg,
            time_ns=doubled.time_ns,
            flags=np.where(second, SECOND | DUAL, DUAL),
        )


def run(daemon: Daemon, packets: list[Packet], *, delay_ns: int = 50_000, tick_ns: int = 10 * MS) -> int:
    """Feed packets as they are sent, ticks between. Gives the time of the last."""
    due = packets[0].time_ns + delay_ns
    for packet in packets:
        now = packet.time_ns + delay_ns
        while due <= now:
            daemon.tick(due)
            due += tick_ns
        daemon.packet(packet.data, now)
    return packets[-1].time_ns + delay_ns


def finish(daemon: Daemon, now_ns: int) -> Outputs:
    daemon.end(now_ns)
    return daemon.take()


def position(time_ns: int, **fields: object) -> bytes:
    values: dict[str, object] = {"pps": 2, **fields}
    return Position(time_us=time_ns // 1000 % 3_600_000_000, **values).encode()  # type: ignore[arg-type]
