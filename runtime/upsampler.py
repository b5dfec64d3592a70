"""The C runtime from Python: models, whole images, column streams."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any, overload

import numpy as np
from numpy.typing import NDArray

from upbeam.kernels.opencl import OpenClUpsampler
from upbeam.model.geometry import to_counts, to_metres
from upbeam.model.rules import BEAMS, ROWS, Rules
from upbeam.quant.ubm import ModelFile, UbmError, read_ubm

from ._native import CPUS, PRECISIONS
from ._native import Model as NativeModel
from ._native import Stream as NativeStream
from ._native import sizes as native_sizes

__all__ = [
    "BACKENDS",
    "CPUS",
    "PRECISIONS",
    "ColumnStream",
    "Columns",
    "Model",
    "Upsampler",
    "generated_rows",
    "hand_down_backend",
    "load_model",
    "need_precision",
    "shipped_models",
]

U16 = NDArray[np.uint16]
U8 = NDArray[np.uint8]
F32 = NDArray[np.float32]

DEFAULT_MODEL = "hdl-64e"
BACKENDS = ("cpu", "opencl")
"""Of this layer; ``hand_down_backend`` adds others."""


class Model:
    """A model file, parsed twice: by Python (for people and tools) and by the C runtime (which computes with it)."""

    def __init__(self, data: bytes, name: str = "the model") -> None:
        """``name`` is what messages call it. Raises UbmError for bytes that are not a sound model."""
        self.data = data
        self.name = name
        self.file: ModelFile = read_ubm(data)
        self.native = NativeModel(data)
        self.info: dict[str, Any] = self.native.info()

    @property
    def rules(self) -> Rules:
        return self.file.rules

    @property
    def distance_unit_m(self) -> float:
        """Size of one distance count in metres."""
        return self.rules.distance_unit_m

    @property
    def columns(self) -> int:
        """Columns per turn."""
        return self.rules.columns

    @property
    def crc32(self) -> int:
        """The file's checksum: the model's identity in reports."""
        return int(self.info["crc32"])

    @property
    def precisions(self) -> tuple[str, ...]:
        """What it can compute with: ``fp32``, and those of ``int16`` and ``int8`` that the file has."""
        return tuple(self.info["precisions"])

    def sizes(self, precision: str = "fp32", *, columns: int | None = None, aligned: bool = False) -> dict[str, int]:
        """Bytes, from the C runtime: the ``file``; the ``weights`` of the precision, as the file holds them; the
        ``tables`` they become in memory; the ``state`` of a stream, and the destagger ``ring`` that is part of it.

        Raises ValueError for a precision that the model does not have.
        """
        need_precision(self, precision)
        return native_sizes(self.native, precision, columns=columns or 0, aligned=aligned)

    def __repr__(self) -> str:
        return f"Model({self.rules.sensor!r}, {self.columns} columns, crc32 {self.crc32:08x})"


MakeImage = Callable[[Model, str], Callable[[U16, U8], tuple[U16, U8]]]
"""A model and a precision -> what turns images ``[32, W]`` into ``[64, W]``."""
_handed_down: dict[str, MakeImage] = {}


def hand_down_backend(name: str, make: MakeImage) -> None:
    """Adds a backend of whole images from a layer above, which this one must not know. ``make`` raises ValueError for a
    precision it does not have."""
    _handed_down[name] = make


def need_precision(model: Model, precision: str) -> None:
    """Raises ValueError for a name that is no precision, and for one that the model file does not have."""
    if precision not in PRECISIONS:
        raise ValueError(f"precision {precision!r} is unknown, expected one of: {', '.join(PRECISIONS)}")
    if precision not in model.precisions:
        raise ValueError(
            f"precision {precision} is not in {model.name}, only {', '.join(model.precisions)}: "
            "`upbeam quantize` makes a model file that has it"
        )


def shipped_models() -> list[str]:
    """Sensors a model is shipped for; ``hdl-64e`` (every other beam of it) is the default."""
    folder = resources.files("upbeam.quant").joinpath("models")
    return sorted(p.name.removesuffix(".ubm") for p in folder.iterdir() if p.name.endswith(".ubm"))


def load_model(path: str | Path | None = None) -> Model:
    """A ``.ubm`` file, or a shipped model by its sensor's name (``hdl-64e``, the default, ``hdl-32e``, ``vlp-32c``).

    Raises UbmError naming the file."""
    name = str(path) if path is not None else DEFAULT_MODEL
    if name in shipped_models():
        return Model(resources.files("upbeam.quant").joinpath("models").joinpath(f"{name}.ubm").read_bytes(), name)
    if Path(name).suffix != ".ubm" and not Path(name).exists():
        raise UbmError(f"{name}: no such model; shipped are {', '.join(shipped_models())}, or give a .ubm file")
    read_ubm(name)  # its errors name the file
    try:
        return Model(Path(name).read_bytes(), name)
    except ValueError as error:
        raise UbmError(f"{name}: {error}") from None


def generated_rows() -> NDArray[np.bool_]:
    """``[64]``: True for the output rows that no laser measured."""
    return np.asarray(np.arange(ROWS) % 2 == 1)


@dataclass(frozen=True)
class Columns:
    """Finished columns of a stream, in order."""

    distance: U16
    """[n, 64] counts"""
    intensity: U8
    """[n, 64]"""
    frame: NDArray[np.uint64]
    """[n] turns since the stream's start"""
    column: NDArray[np.uint64]
    """[n] place in the turn"""
    incomplete: NDArray[np.bool_]
    """[n] at least one beam's column never arrived"""

    def __len__(self) -> int:
        return len(self.column)


class Upsampler:
    """Turns 32 rows into 64. Holds no image state: every call is an image of its own, whose two ends are edges.

    Use ``stream()`` for a sensor that keeps turning.
    """

    def __init__(
        self,
        model: Model,
        precision: str = "fp32",
        backend: str = "cpu",
        *,
        columns: int | None = None,
        cpu: str = "auto",
    ) -> None:
        """``precision``: ``fp32``, ``int16`` or ``int8``; the integers give the same bits on every machine.
        ``backend``: ``cpu``; or, whole images only, ``opencl`` (extra ``opencl``) or ``rtl`` (the simulated FPGA core,
        integers only; extra ``fpga`` and a C++ compiler).
        ``columns``: width of the images where it is not the model's. ``cpu``: force one of ``CPUS``.

        Raises ValueError for what the model, this machine or this version does not have.
        """
        need_precision(model, precision)
        if backend not in (*BACKENDS, *_handed_down):
            names = ", ".join((*BACKENDS, *_handed_down))
            raise ValueError(f"backend {backend!r} is not available, expected one of: {names}")
        self.model = model
        self.precision = precision
        self.backend = backend
        self.columns = columns or model.columns
        self._cpu = cpu
        self._stream = NativeStream(
            model.native,
            precision=precision,
            cpu=cpu,
            columns=self.columns,
            any_sensor=columns is not None,
            aligned=True,
        )
        self._image: Callable[[U16, U8], tuple[U16, U8]] = self._stream.image
        if backend == "opencl":
            self._image = OpenClUpsampler(model.file, precision, self.columns)
        elif backend in _handed_down:
            self._image = _handed_down[backend](model, precision)

    @property
    def cpu(self) -> str:
        """The instruction set in use."""
        return str(self._stream.stats()["cpu"])

    @overload
    def __call__(self, distance: U16, intensity: U8) -> tuple[U16, U8]: ...
    @overload
    def __call__(self, distance: F32, intensity: U8) -> tuple[F32, U8]: ...
    def __call__(self, distance: Any, intensity: Any) -> tuple[Any, U8]:
        """``[32, W]`` azimuth-aligned distances and intensities (uint8) -> both as ``[64, W]``.

        Distances are uint16 counts (``model.distance_unit_m`` each) or float32 metres; the result has the same type.
        Even rows are
        the input's, to the bit. Raises ValueError for other types and shapes, and for metres that are NaN, infinite
        or negative.
        """
        d, i = np.asarray(distance), np.asarray(intensity)
        self._check(d, i)
        if d.dtype == np.uint16:
            return self._image(np.ascontiguousarray(d), np.ascontiguousarray(i))
        counts, _ = to_counts(d, self.model.distance_unit_m)
        out, grey = self._image(counts, np.ascontiguousarray(i))
        metres = to_metres(out, self.model.distance_unit_m)
        metres[0::2] = d
        if self.model.rules.last_row == "repeat":
            metres[-1] = d[-1]
        return metres, grey

    def stream(self, *, aligned: bool = False) -> ColumnStream:
        """A column stream. ``aligned``: the columns are destaggered already. Only on the backend ``cpu``."""
        if self.backend != "cpu":
            raise ValueError(f"backend {self.backend} takes whole images; a column stream runs on the cpu")
        return ColumnStream(self.model, self.precision, columns=self.columns, cpu=self._cpu, aligned=aligned)

    def _check(self, distance: NDArray[Any], intensity: NDArray[Any]) -> None:
        shape = (BEAMS, self.columns)
        if distance.dtype not in (np.uint16, np.float32):
            raise ValueError(f"distance is {distance.dtype}, expected uint16 counts or float32 metres")
        if intensity.dtype != np.uint8:
            raise ValueError(f"intensity is {intensity.dtype}, expected uint8")
        for name, array in (("distance", distance), ("intensity", intensity)):
            if array.shape != shape:
                raise ValueError(f"{name} has shape {list(array.shape)}, expected {list(shape)} (beams, columns)")


class ColumnStream:
    """A sensor that keeps turning: columns in, finished columns out, a few columns behind."""

    def __init__(
        self,
        model: Model,
        precision: str = "fp32",
        *,
        columns: int | None = None,
        cpu: str = "auto",
        aligned: bool = False,
    ) -> None:
        """As ``Upsampler``. ``aligned``: the columns are destaggered already."""
        need_precision(model, precision)
        self.model = model
        self.precision = precision
        self._stream = NativeStream(
            model.native,
            precision=precision,
            cpu=cpu,
            columns=columns or 0,
            any_sensor=columns is not None,
            aligned=aligned,
        )

    def push(self, distance: U16, intensity: U8, column: int) -> Columns:
        """Firing columns ``[n, 32]`` (uint16 counts, uint8), the first at place ``column`` of the turn. Late ones
        are dropped and
        counted in ``stats``; places that were skipped come out as columns without a return."""
        if distance.dtype != np.uint16 or intensity.dtype != np.uint8:
            raise ValueError(f"columns are {distance.dtype} and {intensity.dtype}, expected uint16 and uint8")
        return _columns(*self._stream.push(np.ascontiguousarray(distance), np.ascontiguousarray(intensity), column))

    def gap(self, columns: int) -> Columns:
        """Inserts columns that never arrived."""
        return _columns(*self._stream.gap(columns))

    def flush(self) -> Columns:
        """Ends the stream with an edge: what was pending."""
        return _columns(*self._stream.flush())

    def stats(self) -> dict[str, Any]:
        """Counts, delay and memory: see ``upb_stream_stats``."""
        return self._stream.stats()


_INCOMPLETE = 1


def _columns(distance: U16, intensity: U8, place: NDArray[np.uint64]) -> Columns:
    return Columns(distance, intensity, place[:, 0], place[:, 1], (place[:, 2] & np.uint64(_INCOMPLETE)) != 0)
