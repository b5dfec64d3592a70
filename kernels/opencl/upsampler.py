"""Whole images on an OpenCL device."""

from __future__ import annotations

import os

import numpy as np

from upbeam.model.rules import BEAMS, U8, U16
from upbeam.quant.ubm import ModelFile

from .device import DeviceInfo, OpenClError, open_device
from .program import DENSE, FrameTimes, Session, WindowProgram
from .tune import Choice, choose
from .variants import Variant, parse_variant

__all__ = ["VARIANT_VARIABLE", "OpenClUpsampler"]

VARIANT_VARIABLE = "UPBEAM_OPENCL_VARIANT"
"""Environment variable: pins the variant where no argument does."""


class OpenClUpsampler:
    """Turns 32 rows into 64 on an OpenCL device. Every call is an image of its own, whose two ends are edges: streams
    that continue over the seam run on the CPU (``upbeam.Upsampler.stream``).

    Program and buffers are made once, here. Not for several threads at a time.
    """

    def __init__(
        self,
        model_file: ModelFile,
        precision: str = "fp32",
        columns: int | None = None,
        device: int | None = None,
        *,
        variant: str | None = None,
        tune: bool = False,
    ) -> None:
        """``columns``: width of the images, the model's by default. ``device``: its index in ``list_devices``; else
        ``UPBEAM_OPENCL_DEVICE``, else 0.

        ``variant`` (else ``UPBEAM_OPENCL_VARIANT``) pins the kernel: a name as ``parse_variant`` takes it, or
        ``dense``, the readable reference kernel on the networks as they were trained (precision ``fp32`` only).
        Without, the choice recorded for this device is taken; if there is none (``tune``: in any case) all variants
        are measured, which takes seconds. Raises OpenClError and, for a malformed variant or width, ValueError.
        """
        if precision not in ("fp32", "int16", "int8"):
            raise ValueError(f"precision {precision!r}, expected fp32, int16 or int8")
        if precision not in model_file.precisions:
            raise OpenClError(f"precision {precision!r} is not in the model file, it has: {_listed(model_file)}")
        self.columns = model_file.rules.columns if columns is None else columns
        if not 4 <= self.columns <= 65535:
            raise ValueError(f"columns {self.columns}, expected 4 to 65535")
        self.precision = precision
        self.choice: Choice | None = None
        """What was measured or recorded; None where the variant was pinned."""
        wanted = variant or os.environ.get(VARIANT_VARIABLE)
        pinned = parse_variant(wanted) if wanted and wanted != DENSE else None
        if wanted == DENSE and precision != "fp32":
            raise ValueError(f"the dense kernel computes in fp32, not in {precision}")
        self._session = Session.open(*open_device(device))
        self._program = self._make(model_file, wanted, pinned, tune)

    def _make(self, file: ModelFile, wanted: str | None, pinned: Variant | None, tune: bool) -> WindowProgram:
        if not wanted:
            self.choice = choose(self._session, file, self.precision, self.columns, again=tune)
            pinned = self.choice.variant
        self.variant = str(pinned or DENSE)
        return WindowProgram(self._session, file, self.precision, self.columns, pinned)

    @property
    def device(self) -> DeviceInfo:
        return self._session.info

    @property
    def times(self) -> FrameTimes | None:
        """Of the last image; None before the first."""
        return self._program.times

    def __call__(self, distance: U16, intensity: U8) -> tuple[U16, U8]:
        """``distance[32, columns]`` (uint16 counts) and ``intensity[32, columns]`` (uint8), azimuth aligned -> both as
        ``[64, columns]``, new arrays; even rows are the input's, to the bit. Raises ValueError, OpenClError."""
        for name, image, kind in (("distance", distance, np.uint16), ("intensity", intensity, np.uint8)):
            if image.dtype != kind or image.shape != (BEAMS, self.columns):
                raise ValueError(
                    f"{name} is {image.dtype} {list(image.shape)}, expected {np.dtype(kind)} [{BEAMS}, {self.columns}]"
                )
        return self._program(distance, intensity)


def _listed(file: ModelFile) -> str:
    return ", ".join(file.precisions)
