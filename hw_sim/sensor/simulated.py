"""A Velodyne sensor on a bench's clock: firings in, UDP datagrams out, paced by the azimuth as a real one is.

Packets do not know of frames: a turn of 904.2 firings is 75.35 packets, and the speed wanders.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np

from upbeam.model.beams import BeamTable, beam_table
from upbeam.runtime.packets import Encoder

from .datagram import DATA_PORT, POSITION_PORT, Datagram
from .encoding import encode_chunk, encode_position
from .motor import Motor
from .sources import FiringSource, QuickRoom, Returns

__all__ = ["SENSORS", "SensorConfig", "SimulatedSensor", "merge"]

SENSORS = {"hdl-32e": 12, "vlp-32c": 12, "vlp-16": 24}
"""Sensors that can be simulated, and firings in a packet with one return."""
RETURN_MODES = ("strongest", "last", "dual")
_HOUR_US = 3_600_000_000
_table = lru_cache(maxsize=None)(beam_table)
_CHUNK_PACKETS = 8
"""Packets made at once: enough to pay for the array calls, short enough for a sender in real time."""


@dataclass(frozen=True)
class SensorConfig:
    """A sensor's settings. Errors: ValueError that names the field."""

    model: str = "vlp-32c"
    """One of ``SENSORS``."""
    rate_hz: float = 20.0
    """Turns per second, 5 to 20."""
    wander: float = 0.0
    """Largest relative deviation of the speed, 0 to 0.5."""
    columns: int | None = None
    """Firings per turn at the nominal speed. None: what the sensor's firing cycle gives. Set for stress only: real
    sensors do not fire faster."""
    returns: Literal["strongest", "last", "dual"] = "strongest"
    start_azimuth_deg: float = 0.0
    """Clockwise; a start that is not the cut begins with a partial turn, as real streams do."""
    start_toh_us: int = 0
    """Microseconds since the full hour at the bench's time 0; 3_599_500_000 rolls over after half a second."""
    position_hz: float = 10.0
    """Position packets per second; 0: none."""
    latency_ns: int = 0
    """From a packet's last firing to its leaving."""
    seed: int = 0

    def __post_init__(self) -> None:
        if self.model not in SENSORS:
            raise ValueError(f"sensor {self.model!r}: expected one of {', '.join(SENSORS)}")
        if not 5 <= self.rate_hz <= 20:
            raise ValueError(f"rate_hz {self.rate_hz}: expected 5 to 20 turns per second")
        if self.columns is not None and not 16 <= self.columns <= 65535:
            raise ValueError(f"columns {self.columns}: expected 16 to 65535, or None for the sensor's own")
        if self.returns not in RETURN_MODES:
            raise ValueError(f"returns {self.returns!r}: expected {', '.join(RETURN_MODES)}")
        if not 0 <= self.start_toh_us < _HOUR_US:
            raise ValueError(f"start_toh_us {self.start_toh_us}: expected 0 to {_HOUR_US - 1}")
        if not 0 <= self.position_hz <= 1000 or self.latency_ns < 0:
            raise ValueError(f"position_hz {self.position_hz}, latency_ns {self.latency_ns}: expected 0 or more")

    @property
    def beams(self) -> BeamTable:
        return _table(self.model)

    @property
    def firing_ns(self) -> float:
        """From one firing to the next."""
        if self.columns is not None:
            return 1e9 / (self.rate_hz * self.columns)
        return self.beams.firing_cycle_us * 1e3

    @property
    def firings_per_turn(self) -> float:
        """At the nominal speed; seldom a whole number."""
        return 1e9 / (self.rate_hz * self.firing_ns)

    @property
    def firings_per_packet(self) -> int:
        return SENSORS[self.model] // (2 if self.returns == "dual" else 1)


class SimulatedSensor:
    """Iterates over the datagrams of a sensor, without end, in order of time; every iteration begins anew.

    The same configuration and source give the same bytes at the same times. ``source`` None: ``QuickRoom``.
    """

    def __init__(self, config: SensorConfig | None = None, source: FiringSource | None = None) -> None:
        self.config = config or SensorConfig()
        self.source = source or QuickRoom(self.config.beams, self.config.seed)
        if self.source.beams.name != self.config.model:
            raise ValueError(f"source of {self.source.beams.name}: expected of the sensor, {self.config.model}")
        self.motor = Motor(
            self.config.rate_hz, self.config.wander, self.config.start_azimuth_deg / 360.0, self.config.seed
        )

    def __iter__(self) -> Iterator[Datagram]:
        return merge(self._data(), self._positions())

    def until(self, time_ns: int) -> Iterator[Datagram]:
        """The datagrams that leave before ``time_ns``."""
        for datagram in self:
            if datagram.time_ns >= time_ns:
                return
            yield datagram

    def _data(self) -> Iterator[Datagram]:
        config = self.config
        per_packet, firing_ns = config.firings_per_packet, config.firing_ns
        encoder = Encoder(config.model, return_mode=config.returns)
        span_ns = round(per_packet * firing_ns) + config.latency_ns
        first = 0
        while True:
            count = per_packet * _CHUNK_PACKETS
            firing = np.arange(first, first + count + 1, dtype=np.int64)
            start_ns = np.floor(firing * firing_ns).astype(np.int64)
            turns = self.motor.turns(start_ns * 1e-9)
            # A sensor truncates its encoder's angle to hundredths of a degree.
            azimuth = np.floor((turns[:-1] % 1.0) * 36000).astype(np.int64) % 36000 * 10
            seen = self.source.returns(turns, firing)
            last = _last_returns(seen) if config.returns == "dual" else None
            seen = Returns(seen.distance[:-1], seen.intensity[:-1])
            clock_ns = (config.start_toh_us * 1000 + start_ns[:-1]) % (_HOUR_US * 1000)
            payloads = encode_chunk(encoder, clock_ns, azimuth, seen, last)
            for leaves_ns, payload in zip(start_ns[:-1:per_packet] + span_ns, payloads, strict=True):
                yield Datagram(int(leaves_ns), DATA_PORT, payload)
            first += count

    def _positions(self) -> Iterator[Datagram]:
        config = self.config
        k = 0
        while config.position_hz > 0:
            time_ns = round((k + 0.5) * 1e9 / config.position_hz)
            yield Datagram(time_ns, POSITION_PORT, encode_position(self.toh_us(time_ns)))
            k += 1

    def toh_us(self, time_ns: int) -> int:
        """The sensor's clock, microseconds since the full hour."""
        return (self.config.start_toh_us + time_ns // 1000) % _HOUR_US


def _last_returns(seen: Returns) -> Returns:
    """Of all firings but the last. Where the next firing sees something at least 500 counts deeper the beam's spot
    lies on both: the last return is the deeper one. Elsewhere there is one return, sent twice."""
    near, deep = seen.distance[:-1], seen.distance[1:]
    both = (near > 0) & (deep.astype(np.int64) - near > 500)
    return Returns(np.where(both, deep, near), np.where(both, seen.intensity[1:], seen.intensity[:-1]))


def merge(*streams: Iterator[Datagram]) -> Iterator[Datagram]:
    """Several streams as one in order of time; of equal times the earlier argument comes first."""
    return heapq.merge(*streams, key=lambda datagram: datagram.time_ns)
