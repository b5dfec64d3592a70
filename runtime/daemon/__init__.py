"""The core of ``upbeamd`` in Python, on virtual time: bytes and times in, bytes, records and events out.

    daemon = Daemon(model_bytes, settings={"sensor": HDL_32E, "service_ns": [200_000] * 4}, outputs=("columns", "can"))
    daemon.packet(payload, received_ns)
    daemon.tick(now_ns)
    out = daemon.take()

Time is virtual: work on a packet begins when it was received or when the work before has ended, and takes
``service_ns`` of the mode. The same calls give the same bytes, records and events. docs/upbeamd.md has the settings.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from . import _daemon
from ._daemon import DaemonError, check_names, default_settings, drop_names
from .column_stream import Column, ColumnStreamError, frames, read_columns

__all__ = [
    "HDL_32E",
    "MODES",
    "REGIONS",
    "UPBEAMD",
    "VERDICTS",
    "VLP_32C",
    "CanFrame",
    "Column",
    "ColumnStreamError",
    "Daemon",
    "DaemonError",
    "Outputs",
    "check_names",
    "default_settings",
    "drop_names",
    "frames",
    "read_columns",
]

UPBEAMD: Path = Path(_daemon.__file__).with_name("upbeamd")
"""The process, built with the package (on Linux)."""
HDL_32E, VLP_32C = 1, 2
"""Values of the setting ``sensor``: ``upb_sensor`` of packets.h."""
MODES = ("network", "valid_mean", "repeat", "pass_through")
VERDICTS = ("met", "missed", "partial")
REGIONS = ("model", "kept", "stream", "config")
"""Memory that must not change: for :meth:`Daemon.flip_bit`."""


@dataclass(frozen=True)
class CanFrame:
    """A CAN frame that the daemon sent. ``flags``: 1 FD, 2 bit rate switch, 4 extended identifier."""

    time_ns: int
    id: int
    data: bytes
    flags: int = 0


@dataclass(frozen=True)
class Outputs:
    """What left since the last :meth:`Daemon.take`, each in order; times are when the bytes were complete."""

    columns: list[tuple[int, bytes]]
    """Datagrams of the column stream (:func:`read_columns`)."""
    hdl64: list[tuple[int, bytes]]
    """HDL-64E S3 packets of 1206 bytes."""
    can: list[CanFrame]
    serial: list[tuple[int, bytes]]
    ledger: list[dict[str, Any]]
    """Records of closed frames: ``verdict`` and ``mode`` by name."""
    events: list[dict[str, Any]]
    """``kind``, ``time_ns``, ``frame``, ``value``, ``a``, ``b``; ``fault`` by name where the event is of one."""


class Daemon:
    """One daemon. ``settings`` are fields of ``upb_daemon_config`` (:func:`default_settings` has all of them).

    ``sabotage`` names detections and reactions to take out (:func:`check_names`). ``stored`` is what :meth:`stored`
    of the daemon before gave: a restart with memory. ``models`` are files that a command may ask for by checksum.
    """

    def __init__(
        self,
        ubm: bytes | Path,
        settings: Mapping[str, int | Sequence[int]] | None = None,
        *,
        outputs: Iterable[str] = ("columns", "hdl64", "can", "serial"),
        key: bytes = b"",
        stored: Mapping[int, bytes] | None = None,
        models: Iterable[bytes] = (),
        sabotage: Iterable[str] = (),
    ) -> None:
        chosen = dict(settings or {})
        for name in sabotage:
            if name not in check_names():
                raise DaemonError(f"nothing to sabotage is called {name!r}")
            mask = chosen.get("sabotage", 0)
            assert isinstance(mask, int)
            chosen["sabotage"] = mask | 1 << check_names().index(name)
        content = ubm.read_bytes() if isinstance(ubm, Path) else ubm
        self._core = _daemon.Daemon(content, chosen, list(outputs), key, dict(stored or {}), list(models))

    def packet(self, data: bytes, received_ns: int, source: int = 0) -> None:
        """A datagram on the data port; ``source`` is the sender's IPv4 address as a number."""
        self._core.packet(data, received_ns, source)

    def position(self, data: bytes, received_ns: int, source: int = 0) -> None:
        """A datagram on the position port."""
        self._core.position(data, received_ns, source)

    def can(self, frame_id: int, data: bytes, received_ns: int, flags: int = 0) -> None:
        """A CAN frame received."""
        self._core.can(frame_id, data, received_ns, flags)

    def serial(self, data: bytes, received_ns: int) -> None:
        """Bytes received on the serial line."""
        self._core.serial(data, received_ns)

    def queue_full(self, packets: int, now_ns: int) -> None:
        """So many data packets were dropped before the step."""
        self._core.queue_full(packets, now_ns)

    def tick(self, now_ns: int) -> None:
        """Time passes: call it every 10 ms or more often."""
        self._core.tick(now_ns)

    def swap_model(self, ubm: bytes, now_ns: int) -> None:
        """Use another model from the next frame on; :class:`DaemonError` tells why a file is refused."""
        self._core.swap_model(ubm, now_ns)

    def set_floor(self, mode: str, now_ns: int) -> None:
        """Never a better mode than this."""
        self._core.set_floor(MODES.index(mode), now_ns)

    def set_service(self, service_ns: Sequence[int]) -> None:
        """Work on a packet from now on, by mode, nanoseconds."""
        self._core.set_service(list(service_ns))

    def set_links(self, *, can: bool = True, serial: bool = True) -> None:
        """Whether the buses take frames."""
        self._core.set_links(can, serial)

    def end(self, now_ns: int) -> None:
        """Hand out what is pending, close the last frame."""
        self._core.end(now_ns)

    def take(self) -> Outputs:
        """What left since the last call."""
        core = self._core
        records = [r | {"verdict": VERDICTS[r["verdict"]], "mode": MODES[r["mode"]]} for r in core.take_ledger()]
        return Outputs(
            columns=core.take_columns(),
            hdl64=core.take_hdl64(),
            can=[CanFrame(*frame) for frame in core.take_can()],
            serial=core.take_serial(),
            ledger=records,
            events=core.take_events(),
        )

    def flip_bit(self, region: str, bit: int) -> None:
        """Damage memory that must not change (a name of ``REGIONS``): for fault injection."""
        self._core.flip_bit(REGIONS.index(region), bit)

    def region_bytes(self, region: str) -> int:
        """Size of such memory."""
        return int(self._core.region_bytes(REGIONS.index(region)))

    def calibration(self) -> list[tuple[int, int]]:
        """[64] (elevation, azimuth offset) of the HDL-64E it shows, thousandths of a degree, top row first."""
        return [(int(a), int(b)) for a, b in self._core.calibration()]

    def stored(self) -> dict[int, bytes]:
        """What the bus keeps over restarts."""
        return {int(k): bytes(v) for k, v in self._core.stored().items()}

    @property
    def resets(self) -> list[int]:
        """Resets that were asked for over diagnostics, by type."""
        return [int(t) for t in self._core.resets()]

    @property
    def counters(self) -> dict[str, Any]:
        """``upb_daemon_counters``; ``packets_dropped`` by cause."""
        return dict(self._core.counters())

    @property
    def status(self) -> dict[str, Any]:
        """``upb_daemon_status`` without the counters; ``mode`` and faults by name."""
        status = dict(self._core.status())
        return status | {"mode": MODES[status["mode"]]}

    @property
    def mode(self) -> str:
        return str(self.status["mode"])

    @property
    def faults(self) -> list[str]:
        """Active faults by name."""
        return list(self._core.status()["faults"])

    @property
    def latency_ns(self) -> dict[str, int]:
        """``count``, ``p50``, ``p99``, ``p999``, ``max`` of the frames judged."""
        return dict(self._core.latency())

    @property
    def memory_bytes(self) -> int:
        return int(self._core.memory_bytes())
