"""upbeam turns a 32-beam LiDAR into a 64-beam one on embedded hardware.

model = upbeam.load_model()
up = upbeam.Upsampler(model)
distance64, intensity64 = up(distance32, intensity32)
"""

from collections.abc import Callable as _Callable
from importlib.metadata import version as _version
from typing import Any as _Any

from upbeam.runtime.upsampler import (
    ColumnStream,
    Model,
    Upsampler,
    generated_rows,
    hand_down_backend,
    load_model,
    shipped_models,
)


def _rtl(model: Model, precision: str) -> _Callable[..., _Any]:
    from upbeam.hw_sim.fpga.backend import rtl_image

    return rtl_image(model.data, model.name, precision)


hand_down_backend("rtl", _rtl)

__version__ = _version("upbeam")
__all__ = ["ColumnStream", "Model", "Upsampler", "__version__", "generated_rows", "load_model", "shipped_models"]
