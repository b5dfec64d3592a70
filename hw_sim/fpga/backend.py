"""The simulated core as a backend: of ``Upsampler`` (whole images) and of ``upbeam verify`` (images and streams)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from upbeam.quant.export.source import Source
from upbeam.quant.integer import CONTRACTS
from upbeam.quant.verify import Backend, Image

from .beats import U8, U16, image_beats
from .core import RtlCore

__all__ = ["rtl_backend", "rtl_image"]


def rtl_image(data: bytes, name: str, precision: str) -> Callable[[U16, U8], Image]:
    """Images ``[32, W]`` -> ``[64, W]`` through the core with one hidden unit a clock; both ends are edges.

    ``data``: the model file. Raises ValueError for ``fp32``, ToolError where no simulator can be built."""
    return _core(data, name, precision).image


def rtl_backend(data: bytes, name: str, precision: str) -> Backend:
    """As ``rtl_image``, for ``quant.verify``. Columns are azimuth aligned: the core has no destagger ring."""
    core = _core(data, name, precision)
    turn = Source.of(data, name).file.rules.columns

    def stream(strip: Image, arrived: NDArray[np.bool_]) -> Image:
        distance, intensity = np.where(arrived, strip[0], 0), np.where(arrived, strip[1], 0)
        beats = image_beats(distance.astype(np.uint16), intensity.astype(np.uint8), turn)
        made = core.run(beats, turn).columns
        return made.distance, made.intensity

    c = core.configuration
    return Backend(f"rtl fold {c.fold}", lambda image: core.image(*image), stream)


def _core(data: bytes, name: str, precision: str) -> RtlCore:
    if precision not in CONTRACTS:
        raise ValueError(f"the RTL core computes in {' and '.join(CONTRACTS)}, not in {precision}")
    return RtlCore(Source.of(data, name), precision)
