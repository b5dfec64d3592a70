"""The C runtime's kernels, and OpenCL devices, as backends of ``quant.verify``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from upbeam.kernels.opencl import OpenClUpsampler, list_devices
from upbeam.quant.verify import Backend, Image, NetworkName

from . import _native
from .upsampler import ColumnStream, Model, Upsampler

__all__ = ["CPUS", "cpu_backends", "opencl_backends"]

CPUS = tuple(name for name in _native.CPUS if name != "auto")
_CHUNKS = (1, 2, 31, 64, 7, 500, 3)
"""Columns of consecutive pushes: a stream must not care how it is fed."""


def cpu_backends(model: Model, precision: str) -> list[Backend]:
    """One for each instruction set of this machine and this build, the scalar one first.

    Raises ValueError where the model does not have the precision.
    """
    return [_backend(model, precision, cpu) for cpu in CPUS if _usable(model, precision, cpu)]


def opencl_backends(model: Model, precision: str) -> list[Backend]:
    """One for each OpenCL device, whole images only. Raises OpenClError where there is none."""
    return [_opencl_backend(model, precision, device.index) for device in list_devices()]


def _opencl_backend(model: Model, precision: str, device: int) -> Backend:
    made: dict[int, OpenClUpsampler] = {}

    def image(given: Image) -> Image:
        width = given[0].shape[1]
        if width not in made:
            made[width] = OpenClUpsampler(model.file, precision, width, device)
        return made[width](np.ascontiguousarray(given[0]), np.ascontiguousarray(given[1]))

    return Backend(f"opencl {device}", image)


def _usable(model: Model, precision: str, cpu: str) -> bool:
    try:
        Upsampler(model, precision, cpu=cpu)
    except ValueError as error:
        if "instruction set" not in str(error):
            raise
        return False
    return True


def _backend(model: Model, precision: str, cpu: str) -> Backend:
    up = Upsampler(model, precision, cpu=cpu)

    def image(given: Image) -> Image:
        return up(np.ascontiguousarray(given[0]), np.ascontiguousarray(given[1]))

    def stream(strip: Image, arrived: NDArray[np.bool_]) -> Image:
        return _stream(ColumnStream(model, precision, cpu=cpu, aligned=True), model.columns, strip, arrived)

    def firing(strip: Image, arrived: NDArray[np.bool_]) -> Image:
        return _stream(ColumnStream(model, precision, cpu=cpu), model.columns, strip, arrived)

    def trace(which: NetworkName, windows: NDArray[np.int64]) -> Mapping[str, NDArray[Any]]:
        steps: Mapping[str, NDArray[Any]] = _native.trace_int(
            model.native, precision, which, np.ascontiguousarray(windows, dtype=np.uint16)
        )
        return steps

    return Backend(f"cpu {cpu}", image, stream, firing, None if precision == "fp32" else trace)


def _stream(stream: ColumnStream, turn: int, strip: Image, arrived: NDArray[np.bool_]) -> Image:
    """Pushes the columns that arrived, in chunks; the stream itself finds what is missing between them."""
    distance, intensity = (np.ascontiguousarray(part.T) for part in strip)
    parts, at, chunk = [], 0, 0
    while at < len(arrived):
        if not arrived[at]:
            at += 1
            continue
        end = min(at + _CHUNKS[chunk % len(_CHUNKS)], len(arrived))
        missing = np.flatnonzero(~arrived[at:end])
        end = at + int(missing[0]) if len(missing) else end
        parts.append(stream.push(distance[at:end], intensity[at:end], at % turn))
        at, chunk = end, chunk + 1
    parts.append(stream.flush())
    return np.concatenate([p.distance for p in parts]).T, np.concatenate([p.intensity for p in parts]).T
