"""A built kernel with its buffers: writes a frame, runs, reads, and says how long each took."""

from __future__ import annotations

import time
import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from upbeam.model.rules import BEAMS, ROWS, U8, U16
from upbeam.quant.ubm import ModelFile

from .device import DeviceInfo, OpenClError, import_pyopencl, one_line
from .source import dense_source, source, weight_tables
from .variants import PAD, PAIRS, Variant

__all__ = ["DENSE", "FrameTimes", "Session", "WindowProgram"]

DENSE = "dense"
"""Name of the reference kernel, in place of a variant's."""
BUILD_OPTIONS = ("-cl-std=CL1.2", "-cl-finite-math-only")
"""Counts and weights are finite, and so are all sums of them."""
_PIXEL_BYTES = 3
"""Two of a distance, one of an intensity."""


@dataclass(frozen=True)
class FrameTimes:
    """Of one frame, in milliseconds. The device's own clock (events), but for ``total``: the host's, around all."""

    kernel: float
    transfer: float
    """Copies to and from the device; on shared memory, mapping and unmapping."""
    total: float


@dataclass(frozen=True)
class Session:
    """A device, opened: context and queue."""

    device: Any
    info: DeviceInfo
    context: Any
    queue: Any

    @classmethod
    def open(cls, device: Any, info: DeviceInfo) -> Session:
        cl = import_pyopencl()
        try:
            context = cl.Context([device])
            queue = cl.CommandQueue(context, properties=cl.command_queue_properties.PROFILING_ENABLE)
        except cl.Error as error:
            raise OpenClError(f"OpenCL device {info.name} cannot be opened: {one_line(error)}") from None
        return cls(device, info, context, queue)


class WindowProgram:
    """The kernel for one model, precision, width and variant (``None``: the dense reference) on a device."""

    def __init__(
        self, session: Session, file: ModelFile, precision: str, columns: int, variant: Variant | None
    ) -> None:
        """Builds the program and allocates all buffers. Raises OpenClError."""
        self.session = session
        self.columns = columns
        self.times: FrameTimes | None = None
        """Of the last frame."""
        self._cl = import_pyopencl()
        padded = variant.padded_columns(columns) if variant else columns
        self._stride_in, self._stride_out = padded + 2 * PAD, padded
        text = source(file, precision, variant, columns) if variant else dense_source(file, columns)
        self._kernel = self._build(text, variant)
        self._global = variant.global_size(columns) if variant else (columns, PAIRS)
        self._local = (variant.group, 1) if variant else None
        self._allocate()
        tables = weight_tables(file, precision) if variant and variant.weights == "buffer" else ()
        self._weights = [self._constant(table) for table in tables]
        self._kernel.set_args(self._input, self._output, *self._weights)

    def __call__(self, distance: U16, intensity: U8) -> tuple[U16, U8]:
        """``[32, columns]`` counts and intensities -> both as ``[64, columns]``, new arrays. Raises OpenClError."""
        begin = time.perf_counter()
        try:
            write = self._write(distance, intensity)
            kernel = self._cl.enqueue_nd_range_kernel(self.session.queue, self._kernel, self._global, self._local)
            result, read = self._read()
        except self._cl.Error as error:
            raise self._failure("run the kernel", error) from None
        total = (time.perf_counter() - begin) * 1e3
        self.times = FrameTimes(_milliseconds(kernel), sum(map(_milliseconds, write + read)), total)
        return result

    # ------------------------------------------------------------------------------------------------ building

    def _build(self, text: str, variant: Variant | None) -> Any:
        options = [*BUILD_OPTIONS, *(variant.defines() if variant else [])]
        program = self._cl.Program(self.session.context, text)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # compilers that have something to say of a good program
                program.build(options=options, devices=[self.session.device], cache_dir=False)
            return self._cl.Kernel(program, "upsample_image")
        except self._cl.Error as error:
            name = self.session.info.name
            raise OpenClError(
                f"OpenCL device {name} cannot build kernel {variant or DENSE}; its log:\n{error}"
            ) from None

    def _allocate(self) -> None:
        cl, flags = self._cl, self._cl.mem_flags
        sizes = [_PIXEL_BYTES * BEAMS * self._stride_in, _PIXEL_BYTES * ROWS * self._stride_out]
        largest = int(self.session.device.max_mem_alloc_size)
        if max(sizes) > largest:
            raise OpenClError(
                f"out of memory: an image of {self.columns} columns needs a buffer of {max(sizes)} bytes, "
                f"OpenCL device {self.session.info.name} gives {largest}"
            )
        host = flags.ALLOC_HOST_PTR if self.session.info.shares_memory else 0
        try:
            self._input = cl.Buffer(self.session.context, flags.READ_ONLY | host, sizes[0])
            self._output = cl.Buffer(self.session.context, flags.WRITE_ONLY | host, sizes[1])
            self._staging_in = np.zeros(sizes[0], np.uint8)  # what lies beyond the edges stays 0
            self._staging_out = np.zeros(0 if self.session.info.shares_memory else sizes[1], np.uint8)
            cl.enqueue_copy(self.session.queue, self._input, self._staging_in)
        except cl.Error as error:
            raise self._failure(f"allocate {sum(sizes)} bytes", error) from None

    def _constant(self, table: NDArray[Any]) -> Any:
        flags = self._cl.mem_flags
        try:
            return self._cl.Buffer(self.session.context, flags.READ_ONLY | flags.COPY_HOST_PTR, hostbuf=table)
        except self._cl.Error as error:
            raise self._failure(f"allocate {table.nbytes} bytes", error) from None

    def _failure(self, what: str, error: Any) -> OpenClError:
        codes = self._cl.status_code
        exhausted = (codes.MEM_OBJECT_ALLOCATION_FAILURE, codes.OUT_OF_RESOURCES, codes.OUT_OF_HOST_MEMORY)
        reason = "out of memory: " if getattr(error, "code", None) in exhausted else ""
        return OpenClError(f"{reason}OpenCL device {self.session.info.name} cannot {what}: {one_line(error)}")

    # ------------------------------------------------------------------------------------------------- a frame

    def _write(self, distance: U16, intensity: U8) -> list[Any]:
        """The image to the device. Returns the events."""
        cl, queue = self._cl, self.session.queue
        if not self.session.info.shares_memory:
            self._fill(self._staging_in, distance, intensity)
            return [cl.enqueue_copy(queue, self._input, self._staging_in, is_blocking=False)]
        mapped, event = cl.enqueue_map_buffer(
            queue, self._input, cl.map_flags.WRITE, 0, (self._input.size,), np.uint8, is_blocking=True
        )
        self._fill(mapped, distance, intensity)
        return [event, mapped.base.release(queue)]

    def _fill(self, memory: NDArray[np.uint8], distance: U16, intensity: U8) -> None:
        far, grey = _split(memory, BEAMS, self._stride_in)
        far[:, PAD : PAD + self.columns] = distance
        grey[:, PAD : PAD + self.columns] = intensity

    def _read(self) -> tuple[tuple[U16, U8], list[Any]]:
        """Waits for the image from the device, copies it. Returns the events, too."""
        cl, queue = self._cl, self.session.queue
        if not self.session.info.shares_memory:
            event = cl.enqueue_copy(queue, self._staging_out, self._output, is_blocking=True)
            return self._copies(self._staging_out), [event]
        mapped, event = cl.enqueue_map_buffer(
            queue, self._output, cl.map_flags.READ, 0, (self._output.size,), np.uint8, is_blocking=True
        )
        result = self._copies(mapped)
        release = mapped.base.release(queue)
        release.wait()
        return result, [event, release]

    def _copies(self, memory: NDArray[np.uint8]) -> tuple[U16, U8]:
        far, grey = _split(memory, ROWS, self._stride_out)
        return far[:, : self.columns].copy(), grey[:, : self.columns].copy()


def _split(memory: NDArray[np.uint8], rows: int, stride: int) -> tuple[U16, U8]:
    """The two images of a buffer, as views ``[rows, stride]``."""
    middle = 2 * rows * stride
    far = memory[:middle].view(np.uint16).reshape(rows, stride)
    return far, memory[middle : middle + rows * stride].reshape(rows, stride)


def _milliseconds(event: Any) -> float:
    return float(event.profile.end - event.profile.start) * 1e-6
