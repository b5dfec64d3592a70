"""The upbeam C library for NumPy arrays."""

from collections.abc import Sequence
from typing import Annotated, Any

import numpy
from numpy.typing import NDArray

class NativeError(ValueError):
    pass

def version() -> str: ...
def api_version() -> int: ...

class Model:
    """A loaded .ubm model, immutable."""

    def __init__(self, ubm: bytes) -> None: ...
    def info(self) -> dict: ...

class Stream:
    """A column stream over a model."""

    def __init__(
        self,
        model: Model,
        precision: str = "fp32",
        cpu: str = "auto",
        columns: int = 0,
        distance_unit_um: int = 0,
        any_sensor: bool = False,
        aligned: bool = False,
    ) -> None: ...
    def image(
        self,
        distance: Annotated[NDArray[numpy.uint16], dict(shape=(None, None), order="C", device="cpu", writable=False)],
        intensity: Annotated[NDArray[numpy.uint8], dict(shape=(None, None), order="C", device="cpu", writable=False)],
    ) -> tuple: ...
    def push(
        self,
        distance: Annotated[NDArray[numpy.uint16], dict(shape=(None, None), order="C", device="cpu", writable=False)],
        intensity: Annotated[NDArray[numpy.uint8], dict(shape=(None, None), order="C", device="cpu", writable=False)],
        column: int,
    ) -> tuple: ...
    def gap(self, columns: int) -> tuple: ...
    def flush(self) -> tuple: ...
    def set_mode(self, mode: str) -> None:
        """How generated rows are made from the next column on."""

    def reset(self) -> None: ...
    def stats(self) -> dict: ...

def raw_windows(
    model: Model,
    distance: Annotated[NDArray[numpy.uint16], dict(shape=(None, None), order="C", device="cpu", writable=False)],
    intensity: Annotated[NDArray[numpy.uint8], dict(shape=(None, None), order="C", device="cpu", writable=False)],
    cpu: str = "auto",
) -> tuple:
    """
    Outputs of both networks before rounding and validity for aligned columns [n, 32]: counts and intensities [n, 32], of each column the last without meaning. Both ends are edges.
    """

def windows_int(
    model: Model,
    precision: str,
    distance: Annotated[NDArray[numpy.uint16], dict(shape=(None, None), order="C", device="cpu", writable=False)],
    intensity: Annotated[NDArray[numpy.uint8], dict(shape=(None, None), order="C", device="cpu", writable=False)],
    cpu: str = "auto",
) -> tuple:
    """
    What an integer kernel generates for aligned columns [n, 32]: counts and intensities [n, 32], of each column the last is 0. Both ends are edges.
    """

def trace_int(
    model: Model,
    precision: str,
    network: str,
    windows: Annotated[NDArray[numpy.uint16], dict(shape=(None, None), order="C", device="cpu", writable=False)],
) -> dict:
    """
    The steps m, d, s, q, S, a, z, Y, r, y of docs/numeric-contract.md for windows [n, 6] of one network, 'distance' or 'intensity': int32 arrays [n, 1], [n, 6] or [n, hidden units, padded to an even number].
    """

def sizes(model: Model, precision: str, columns: int = 0, aligned: bool = False) -> dict:
    """Bytes of file, weights, tables, state and ring: see upb_sizes."""

CPUS: tuple = ...

PRECISIONS: tuple = ("fp32", "int16", "int8")

class LiveConfig:
    """Settings of a run: see upb_live.h."""

    def __init__(self) -> None: ...
    @property
    def frames_total(self) -> int: ...
    @frames_total.setter
    def frames_total(self, arg: int, /) -> None: ...
    @property
    def columns_per_packet(self) -> int: ...
    @columns_per_packet.setter
    def columns_per_packet(self, arg: int, /) -> None: ...
    @property
    def rate_millihertz(self) -> int: ...
    @rate_millihertz.setter
    def rate_millihertz(self, arg: int, /) -> None: ...
    @property
    def deadline_ns(self) -> int: ...
    @deadline_ns.setter
    def deadline_ns(self, arg: int, /) -> None: ...
    @property
    def ring_packets(self) -> int: ...
    @ring_packets.setter
    def ring_packets(self, arg: int, /) -> None: ...
    @property
    def wait(self) -> int: ...
    @wait.setter
    def wait(self, arg: int, /) -> None: ...
    @property
    def poll_ns(self) -> int: ...
    @poll_ns.setter
    def poll_ns(self, arg: int, /) -> None: ...
    @property
    def spin_ns(self) -> int: ...
    @spin_ns.setter
    def spin_ns(self, arg: int, /) -> None: ...
    @property
    def lead_ns(self) -> int: ...
    @lead_ns.setter
    def lead_ns(self, arg: int, /) -> None: ...
    @property
    def realtime(self) -> int: ...
    @realtime.setter
    def realtime(self, arg: int, /) -> None: ...
    @property
    def lock_memory(self) -> int: ...
    @lock_memory.setter
    def lock_memory(self, arg: int, /) -> None: ...
    @property
    def witness(self) -> int: ...
    @witness.setter
    def witness(self, arg: int, /) -> None: ...
    @property
    def witness_period_ns(self) -> int: ...
    @witness_period_ns.setter
    def witness_period_ns(self, arg: int, /) -> None: ...
    @property
    def stall_threshold_ns(self) -> int: ...
    @stall_threshold_ns.setter
    def stall_threshold_ns(self, arg: int, /) -> None: ...
    @property
    def precision(self) -> int: ...
    @precision.setter
    def precision(self, arg: int, /) -> None: ...
    @property
    def cpu(self) -> int: ...
    @cpu.setter
    def cpu(self, arg: int, /) -> None: ...
    @property
    def distance_unit_um(self) -> int: ...
    @distance_unit_um.setter
    def distance_unit_um(self, arg: int, /) -> None: ...
    @property
    def any_sensor(self) -> int: ...
    @any_sensor.setter
    def any_sensor(self, arg: int, /) -> None: ...
    @property
    def aligned(self) -> int: ...
    @aligned.setter
    def aligned(self, arg: int, /) -> None: ...
    @property
    def virtual_clock(self) -> int: ...
    @virtual_clock.setter
    def virtual_clock(self, arg: int, /) -> None: ...
    @property
    def packet_service_ns(self) -> int: ...
    @packet_service_ns.setter
    def packet_service_ns(self, arg: int, /) -> None: ...
    @property
    def column_service_ns(self) -> int: ...
    @column_service_ns.setter
    def column_service_ns(self, arg: int, /) -> None: ...

class LiveRun:
    """One run of the real-time runner."""

    def __init__(
        self,
        model: Model,
        distance: Annotated[
            NDArray[numpy.uint16], dict(shape=(None, None, 32), order="C", device="cpu", writable=False)
        ],
        intensity: Annotated[
            NDArray[numpy.uint8], dict(shape=(None, None, 32), order="C", device="cpu", writable=False)
        ],
        config: LiveConfig,
        drop_packets: Sequence[int],
        keep_frames: Sequence[int],
        service_ns: Sequence[int],
        jitter_ns: Sequence[int],
    ) -> None: ...
    def run(self) -> None: ...
    def stop(self) -> None: ...
    def progress(self) -> dict[str, int]: ...
    def result(self) -> dict[str, Any]: ...

def live_explains(stalls: Sequence[tuple[int, int]], from_ns: int, to_ns: int, deadline_ns: int) -> bool:
    """
    True if the latency meets the deadline without the stalls, (start, duration) sorted by start.
    """
