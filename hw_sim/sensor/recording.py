"""A recording played as a sensor: its packets again and again, on the bench's clock, the sensor's clock running on."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from upbeam.model.beams import BeamTable, beam_table
from upbeam.runtime.packets import PacketReader, sensor_info

from .datagram import DATA_BYTES, DATA_PORT, PACKET, Datagram
from .simulated import SENSORS

__all__ = ["RecordedSensor"]

_HOUR_US = 3_600_000_000
_TURN_MIN_US = 40_000
"""A turn at 25 Hz: a loop is longer."""


class RecordedSensor:
    """Iterates over a recording's data packets without end, in order of time; every iteration begins anew.

    Packets leave in the order and at the distances of the sensor's own clock, whatever the capture's times were. The
    loop goes from the first packet to the last one before the same azimuth, so that its seam is a step like any other;
    of that clock a multiple of the loop's length is added. Payloads are otherwise the recorded ones.
    """

    def __init__(self, payloads: Iterable[bytes], *, start_toh_us: int | None = None) -> None:
        """Of ``payloads`` the data packets count. ``start_toh_us``: the sensor's clock at the bench's time 0; None: as
        recorded. ValueError: packets of several sensors, of one that cannot be simulated, or less than a turn."""
        kept = [payload for payload in payloads if len(payload) == DATA_BYTES]
        self.beams = _sensor(kept)
        view = np.frombuffer(b"".join(kept), dtype=PACKET)
        self._clock_us = _unwrap(view["tail"]["toh_us"].astype(np.int64))
        end = _seam(view["blocks"]["azimuth"][:, 0].astype(np.int64), self._clock_us)
        self._payloads: Sequence[bytes] = kept[:end]
        first = self._clock_us[0]
        self._length_us = int(self._clock_us[end] - first)
        self._shift_us = 0 if start_toh_us is None else int(start_toh_us - first)

    @classmethod
    def open(cls, path: str | Path, *, start_toh_us: int | None = None) -> RecordedSensor:
        """A ``.pcap`` or ``.pcapng`` capture, or a ROS 2 bag (folder or ``.db3``). Errors: ValueError."""
        return cls((datagram.payload for datagram in PacketReader(path)), start_toh_us=start_toh_us)

    @property
    def loop_s(self) -> float:
        """After which the recording begins again."""
        return self._length_us * 1e-6

    def __iter__(self) -> Iterator[Datagram]:
        round_us = 0
        while True:
            for payload, clock_us in zip(self._payloads, self._clock_us, strict=False):
                bench_us = int(clock_us - self._clock_us[0]) + round_us
                yield Datagram(bench_us * 1000, DATA_PORT, self._rewritten(payload, int(clock_us) + round_us))
            round_us += self._length_us

    def until(self, time_ns: int) -> Iterator[Datagram]:
        """The datagrams that leave before ``time_ns``."""
        for datagram in self:
            if datagram.time_ns >= time_ns:
                return
            yield datagram

    def _rewritten(self, payload: bytes, clock_us: int) -> bytes:
        toh = (clock_us + self._shift_us) % _HOUR_US
        return payload[:1200] + toh.to_bytes(4, "little") + payload[1204:]


def _sensor(payloads: Sequence[bytes]) -> BeamTable:
    found = sorted({payload[-1] for payload in payloads})
    names = {sensor_info(name).model: name for name in SENSORS}
    if len(found) != 1 or found[0] not in names:
        listed = ", ".join(f"0x{code:02x}" for code in found) or "none"
        raise ValueError(f"data packets of model {listed}: expected those of one of {', '.join(SENSORS)}")
    return beam_table(names[found[0]])


def _unwrap(clock_us: NDArray[np.int64]) -> NDArray[np.int64]:
    """Clock without its hourly rollover, never falling: swapped packets leave together."""
    step = np.mod(np.diff(clock_us) + _HOUR_US // 2, _HOUR_US) - _HOUR_US // 2
    return np.asarray(np.maximum.accumulate(np.concatenate((clock_us[:1], clock_us[0] + np.cumsum(step)))))


def _seam(azimuth_cdeg: NDArray[np.int64], clock_us: NDArray[np.int64]) -> int:
    """The last packet, as an index, that begins where the first one did; the loop goes up to before it."""
    away = np.mod(azimuth_cdeg - azimuth_cdeg[0] + 18000, 36000) - 18000
    step = float(np.median(np.mod(np.diff(azimuth_cdeg), 36000))) if len(azimuth_cdeg) > 1 else 0.0
    near = np.flatnonzero((np.abs(away) <= step / 2 + 1) & (clock_us - clock_us[0] > _TURN_MIN_US))
    if not len(near):
        raise ValueError(f"{len(azimuth_cdeg)} data packets: expected a whole turn")
    last_turn = near[clock_us[near] > clock_us[near[-1]] - 10_000]
    return int(last_turn[np.argmin(np.abs(away[last_turn]))])
