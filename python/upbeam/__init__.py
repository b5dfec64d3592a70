"""upbeam turns a 32-beam LiDAR into a 64-beam one on embedded hardware.

model = upbeam.load_model()
up = upbeam.Upsampler(model)
distance64, intensity64 = up(distance32, intensity32)
"""

from importlib.metadata import version as _version

from upbeam.runtime.upsampler import ColumnStream, Model, Upsampler, generated_rows, load_model, shipped_models

__version__ = _version("upbeam")
__all__ = ["ColumnStream", "Model", "Upsampler", "__version__", "generated_rows", "load_model", "shipped_models"]
