"""Streams in real time: frames played at a sensor's pace, upsampled, each judged against its deadline.

The clock ``"real"`` is CLOCK_MONOTONIC: latencies are measured. The clock ``"virtual"`` advances by service times the
caller gives: latencies are modelled, and the same on every run.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from upbeam.model.rules import BEAMS

from ._native import LiveConfig as NativeConfig
from ._native import LiveRun as NativeRun
from ._native import live_explains
from .ladder import LADDER
from .upsampler import CPUS, PRECISIONS, Model, need_precision

__all__ = [
    "LiveConfig",
    "LiveConfigError",
    "LiveImage",
    "LiveProgress",
    "LiveResult",
    "explained_by_stalls",
    "firing_columns",
    "quantiles_ms",
    "run_live",
]

U16 = NDArray[np.uint16]
U8 = NDArray[np.uint8]

VERDICTS = ("met", "missed", "partial")
MODES = LADDER
_WAITS = ("block", "poll")
_CHOICES = {"clock": ("real", "virtual"), "precision": PRECISIONS, "cpu": CPUS, "wait": _WAITS}
_POLL_S = 0.1
_NS_PER_US = 1000
_NS_PER_MS = 1_000_000


class LiveConfigError(ValueError):
    """A setting of a run that cannot be: names the setting and what was expected."""


@dataclass(frozen=True)
class LiveConfig:
    """How a run is paced and judged. Raises LiveConfigError."""

    rate_hz: float = 20.0
    """Turns per second, above 0 and at most 100, in steps of 0.001."""
    frames: int | None = None
    """Frames to play; beyond those handed in they start again. None: those handed in, once."""
    deadline_ms: float = 50.0
    """From the last input column to the last output column, above 0."""
    clock: Literal["real", "virtual"] = "real"
    precision: str = "fp32"
    """``fp32``, or ``int16`` or ``int8`` where the model has it."""
    cpu: str = "auto"
    """Force an instruction set, one of ``upsampler.CPUS``."""
    aligned: bool = False
    """The columns are destaggered already: all beams of a column share its azimuth."""
    any_sensor: bool = False
    """Take frames of another width than the model's."""
    columns_per_packet: int = 12
    ring_packets: int = 256
    """Packets that wait for the consumer, a power of two, 2 to 65536; one more is dropped and counted."""
    keep_frames: Sequence[int] = ()
    """Output images to keep besides the last one."""
    wait: Literal["block", "poll"] = "block"
    """How the consumer waits for a packet: woken by the pacer, or looking every ``poll_us``."""
    poll_us: float = 50.0
    pacer_spin_us: float = 50.0
    """The pacer sleeps until this long before a packet is due, then spins."""
    realtime: bool = False
    """Ask for real-time priority; the result tells whether it was granted."""
    lock_memory: bool = False
    """Ask for memory that is never paged out; the result tells whether it was granted."""
    witness: bool = True
    """Record stalls of the machine with one thread a core."""
    stall_threshold_ms: float = 2.0
    drop_packets: Sequence[int] = ()
    """Fault: packets, by number, that never arrive."""
    service_packet_us: float | None = None
    """Virtual clock: time to take a packet, before its first column."""
    service_column_us: float | None = None
    """Virtual clock: time for each column."""
    service_us: Sequence[float] = ()
    """Virtual clock, instead of the two constants: time for each packet, repeated when the run is longer."""
    jitter_us: Sequence[float] = ()
    """Virtual clock: each packet arrives this long after it is due, repeated when the run is longer."""

    def __post_init__(self) -> None:
        _need(math.isfinite(self.rate_hz) and 0.001 <= self.rate_hz <= 100, "rate_hz", self.rate_hz, "0.001 to 100")
        _need(self.frames is None or self.frames >= 1, "frames", self.frames, "at least 1")
        _need(math.isfinite(self.deadline_ms) and self.deadline_ms >= 1e-6, "deadline_ms", self.deadline_ms, "above 0")
        for name, choices in _CHOICES.items():
            _need(getattr(self, name) in choices, name, getattr(self, name), "one of " + ", ".join(choices))
        ring = self.ring_packets
        _need(2 <= ring <= 65536 and ring & (ring - 1) == 0, "ring_packets", ring, "a power of two, 2 to 65536")
        _need(self.columns_per_packet >= 1, "columns_per_packet", self.columns_per_packet, "at least 1")
        for name in ("poll_us", "pacer_spin_us"):
            _need(0 <= getattr(self, name) <= 1e6, name, getattr(self, name), "0 to 1000000")
        _need(0 < self.stall_threshold_ms <= 1e6, "stall_threshold_ms", self.stall_threshold_ms, "above 0")
        for name in ("drop_packets", "keep_frames"):
            _need(all(n >= 0 for n in getattr(self, name)), name, min(getattr(self, name), default=0), "at least 0")
        for name in ("service_us", "jitter_us"):
            _need(all(0 <= t <= 1e9 for t in getattr(self, name)), name, "a value outside", "0 to 1e9")
        self._check_service()

    def _check_service(self) -> None:
        constants = (self.service_packet_us, self.service_column_us)
        given = any(c is not None for c in constants)
        for name in ("service_packet_us", "service_column_us"):
            value = getattr(self, name)
            _need(value is None or 0 <= value <= 1e9, name, value, "0 to 1e9")
        if self.clock == "virtual" and not given and not self.service_us:
            raise LiveConfigError("clock 'virtual' needs service times: service_us, or those of a packet and a column")
        if self.clock == "real" and (given or self.service_us or self.jitter_us):
            raise LiveConfigError("service times and jitter are for clock 'virtual' only")
        if given and self.service_us:
            raise LiveConfigError("service_us replaces service_packet_us and service_column_us: give one or the other")


@dataclass(frozen=True)
class LiveProgress:
    """Where a run stands."""

    frames: int
    """closed"""
    frames_total: int
    misses: int
    last_latency_ms: float
    max_latency_ms: float
    packets_played: int
    packets_dropped: int


@dataclass(frozen=True)
class LiveImage:
    """An output image of the run."""

    frame: int
    distance: U16
    """[64, W] counts"""
    intensity: U8
    """[64, W]"""
    columns_out: int
    """Columns produced; the others are 0."""


@dataclass(frozen=True)
class LiveResult:
    """What happened in a run. Times named ``_ns`` count from its start."""

    clock: str
    """``real``: times are measured; ``virtual``: they are modelled."""
    rate_hz: float
    columns: int
    columns_per_packet: int
    deadline_ms: float
    frames: int
    """Begun, whatever became of them."""
    misses: int
    misses_unexplained: int
    """Misses that the machine's stalls do not explain."""
    stopped: bool
    """Ended before its time."""
    latency_ms: dict[str, float]
    """``p50``, ``p90``, ``p99``, ``p999``, ``max``, ``mean``, exact, of the frames judged; empty if there are none."""
    latency_histogram_ms: dict[str, float]
    """The same from the runtime's histogram in fixed memory: at most 1/32 above."""
    pacer_lateness_us: dict[str, float]
    column_compute_us: dict[str, float]
    packet_compute_us: dict[str, float]
    counts: dict[str, int]
    """Frames, packets and columns by what became of them."""
    ledger: list[dict[str, Any]]
    """One record a frame (see ``upb_ledger_record``), and: ``wait_ns`` (part of the latency: until the packet arrived
    that completed the last column), ``columns_received``, ``flushed`` (the stream ended with it), ``explained``."""
    drops: list[dict[str, Any]]
    """Packets that did not arrive: ``packet``, ``at_ns``, ``columns``, ``cause`` (``fault`` or ``overflow``)."""
    drops_unlisted: int
    stalls: list[dict[str, Any]]
    """Stalls of the machine: ``start_ns``, ``duration_ns``, ``cpu``."""
    stalls_unlisted: int
    witnesses: int
    witnesses_bound: int
    """Witness threads that are bound to a core each."""
    precision: str
    cpu: str
    """The instruction set in use."""
    delay_columns: int
    state_bytes: int
    stream_bytes: int
    duration_s: float
    consumer_cpu_s: float
    pacer_cpu_s: float
    realtime_granted: bool
    memory_locked: bool
    config: dict[str, Any]
    images: dict[int, LiveImage] = field(default_factory=dict)
    """Output images kept, by frame; frames of which nothing came out are absent."""
    last: LiveImage | None = None
    """The last frame that came out to its last column."""

    def to_dict(self) -> dict[str, Any]:
        """Everything but the images, for JSON."""
        return asdict(replace(self, images={}, last=None), dict_factory=_without_images)


def _without_images(items: list[tuple[str, Any]]) -> dict[str, Any]:
    return {key: value for key, value in items if key not in ("images", "last")}


def firing_columns(images: NDArray[Any]) -> NDArray[Any]:
    """Range images ``[F, 32, W]`` as a sensor delivers them: columns, ``[F, W, 32]``, contiguous."""
    return np.ascontiguousarray(np.moveaxis(images, -1, -2))


def run_live(
    model: Model,
    frames_distance: U16,
    frames_intensity: U8,
    config: LiveConfig | None = None,
    on_progress: Callable[[LiveProgress], None] | None = None,
) -> LiveResult:
    """Plays firing columns ``[F, W, 32]`` (uint16 counts, uint8; contiguous arrays are not copied) through ``model``.

    ``on_progress`` is called from the calling thread about ten times a second and once at the end. A KeyboardInterrupt
    ends the run: what was done until then is returned, with ``stopped`` set. Raises LiveConfigError for settings or
    arrays that do not fit.
    """
    config = config or LiveConfig()
    try:
        need_precision(model, config.precision)
    except ValueError as error:
        raise LiveConfigError(str(error)) from None
    distance, intensity = _check_frames(model, frames_distance, frames_intensity, config)
    total = config.frames or len(distance)
    native = NativeRun(
        model.native,
        distance,
        intensity,
        _native_config(config, total),
        sorted(set(config.drop_packets)),
        sorted({n for n in config.keep_frames if n < total}),
        [round(t * _NS_PER_US) for t in config.service_us],
        [round(t * _NS_PER_US) for t in config.jitter_us],
    )
    _run_watched(native, total, on_progress)
    return _result(native.result(), config, int(distance.shape[1]))


def explained_by_stalls(
    stalls: Sequence[tuple[int, int]], last_input_ns: int, output_ns: int, deadline_ms: float
) -> bool:
    """Whether a frame would have met its deadline without the time inside ``stalls`` (start and duration, by start)."""
    return live_explains(list(stalls), last_input_ns, output_ns, round(deadline_ms * _NS_PER_MS))


def quantiles_ms(latencies_ns: Sequence[int]) -> dict[str, float]:
    """Exact quantiles (nearest rank: a latency that occurred), maximum and mean in ms; empty without latencies."""
    if not latencies_ns:
        return {}
    ranked = sorted(latencies_ns)
    out = {
        name: ranked[max(0, -(-per_mille * len(ranked) // 1000) - 1)] / _NS_PER_MS
        for name, per_mille in (("p50", 500), ("p90", 900), ("p99", 990), ("p999", 999))
    }
    return out | {"max": ranked[-1] / _NS_PER_MS, "mean": sum(ranked) / len(ranked) / _NS_PER_MS}


def _need(condition: bool, name: str, value: object, expected: str) -> None:
    if not condition:
        raise LiveConfigError(f"{name} is {value}, expected {expected}")


def _check_frames(model: Model, distance: U16, intensity: U8, config: LiveConfig) -> tuple[U16, U8]:
    _need(distance.dtype == np.uint16, "type of frames_distance", distance.dtype, "uint16 counts")
    _need(intensity.dtype == np.uint8, "type of frames_intensity", intensity.dtype, "uint8")
    _need(
        distance.ndim == 3 and distance.shape[0] >= 1 and distance.shape[2] == BEAMS,
        "shape of frames_distance",
        list(distance.shape),
        f"[frames, columns, {BEAMS}]",
    )
    shape = list(distance.shape)
    _need(intensity.shape == distance.shape, "shape of frames_intensity", list(intensity.shape), f"{shape}")
    columns = shape[1]
    fits = config.any_sensor or columns == model.columns
    _need(fits, "columns of a frame", columns, f"the model's {model.columns}")
    _need(config.columns_per_packet <= columns, "columns_per_packet", config.columns_per_packet, f"at most {columns}")
    return np.ascontiguousarray(distance), np.ascontiguousarray(intensity)


def _native_config(config: LiveConfig, total: int) -> NativeConfig:
    native = NativeConfig()
    native.frames_total = total
    native.columns_per_packet = config.columns_per_packet
    native.rate_millihertz = round(config.rate_hz * 1000)
    native.deadline_ns = round(config.deadline_ms * _NS_PER_MS)
    native.ring_packets = config.ring_packets
    native.wait = _WAITS.index(config.wait)
    native.poll_ns = round(config.poll_us * _NS_PER_US)
    native.spin_ns = round(config.pacer_spin_us * _NS_PER_US)
    native.realtime = config.realtime
    native.lock_memory = config.lock_memory
    native.witness = config.witness
    native.stall_threshold_ns = round(config.stall_threshold_ms * _NS_PER_MS)
    native.precision = PRECISIONS.index(config.precision)
    native.cpu = CPUS.index(config.cpu)
    native.any_sensor = config.any_sensor
    native.aligned = config.aligned
    if config.clock == "virtual":
        native.virtual_clock = True
        native.lead_ns = 0
        native.packet_service_ns = round((config.service_packet_us or 0) * _NS_PER_US)
        native.column_service_ns = round((config.service_column_us or 0) * _NS_PER_US)
    return native


def _run_watched(native: NativeRun, total: int, on_progress: Callable[[LiveProgress], None] | None) -> None:
    """Runs on a thread of its own, so that this one sees signals and reports progress."""
    failures: list[Exception] = []
    done = threading.Event()

    def run() -> None:
        try:
            native.run()
        except Exception as error:
            failures.append(error)
        finally:
            done.set()

    thread = threading.Thread(target=run, name="upbeam-live", daemon=True)
    thread.start()
    try:
        # Not by joining: an interrupted Thread.join can take a running thread for a finished one.
        finished = False
        while not finished:
            finished = done.wait(_POLL_S)
            if on_progress is not None:
                on_progress(_progress(native, total))
    except KeyboardInterrupt:
        pass  # the result says that the run was stopped
    finally:
        native.stop()
        done.wait()
        thread.join()
    if failures:
        raise failures[0]


def _progress(native: NativeRun, total: int) -> LiveProgress:
    p = native.progress()
    return LiveProgress(
        frames=p["frames"],
        frames_total=total,
        misses=p["missed"],
        last_latency_ms=p["last_latency_ns"] / _NS_PER_MS,
        max_latency_ms=p["max_latency_ns"] / _NS_PER_MS,
        packets_played=p["packets_played"],
        packets_dropped=p["packets_dropped"],
    )


def _scaled(histogram: dict[str, float], unit_ns: int) -> dict[str, float]:
    """A native histogram in another unit; ``count`` stays."""
    if not histogram["count"]:
        return {}
    return {key: value if key == "count" else value / unit_ns for key, value in histogram.items()}


def _images(raw: list[tuple[int, int, U16, U8]]) -> dict[int, LiveImage]:
    return {
        frame: LiveImage(frame, np.ascontiguousarray(distance.T), np.ascontiguousarray(intensity.T), columns_out)
        for frame, columns_out, distance, intensity in raw
        if columns_out > 0
    }


def _ledger_record(frame: dict[str, Any]) -> dict[str, Any]:
    return frame | {"verdict": VERDICTS[frame["verdict"]], "mode": MODES[frame["mode"]]}


def _result(raw: dict[str, Any], config: LiveConfig, columns: int) -> LiveResult:
    ledger = [_ledger_record(frame) for frame in raw["frames"]]
    judged = [record for record in ledger if record["verdict"] != "partial"]
    missed = [record for record in judged if record["verdict"] == "missed"]
    images = _images(raw["kept"])
    return LiveResult(
        clock=config.clock,
        rate_hz=config.rate_hz,
        columns=columns,
        columns_per_packet=config.columns_per_packet,
        deadline_ms=config.deadline_ms,
        frames=raw["counts"]["frames_begun"],
        misses=len(missed),
        misses_unexplained=sum(not record["explained"] for record in missed),
        stopped=raw["stopped"],
        latency_ms=quantiles_ms([record["latency_ns"] for record in judged]),
        latency_histogram_ms=_scaled(raw["latency"], _NS_PER_MS),
        pacer_lateness_us=_scaled(raw["pacer_lateness"], _NS_PER_US),
        column_compute_us=_scaled(raw["column_compute"], _NS_PER_US),
        packet_compute_us=_scaled(raw["packet_compute"], _NS_PER_US),
        counts=raw["counts"],
        ledger=ledger,
        drops=raw["drops"],
        drops_unlisted=raw["drops_unlisted"],
        stalls=raw["stalls"],
        stalls_unlisted=raw["stalls_unlisted"],
        witnesses=raw["witnesses"],
        witnesses_bound=raw["witnesses_bound"],
        precision=config.precision,
        cpu=CPUS[raw["cpu"]],
        delay_columns=raw["delay_columns"],
        state_bytes=raw["state_bytes"],
        stream_bytes=raw["stream_bytes"],
        duration_s=raw["duration_ns"] / 1e9,
        consumer_cpu_s=raw["consumer_cpu_ns"] / 1e9,
        pacer_cpu_s=raw["pacer_cpu_ns"] / 1e9,
        realtime_granted=raw["realtime_granted"],
        memory_locked=raw["memory_locked"],
        config=_config_dict(config),
        images=images,
        last=_images([raw["last"]]).popitem()[1] if raw["last"] is not None else None,
    )


def _config_dict(config: LiveConfig) -> dict[str, Any]:
    return {key: list(value) if isinstance(value, (list, tuple)) else value for key, value in asdict(config).items()}
