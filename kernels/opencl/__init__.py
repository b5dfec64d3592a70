"""The window kernel in OpenCL C 1.2, and whole images through it. Needs the extra ``opencl`` (pyopencl); importing this
package does not."""

from .device import DEVICE_VARIABLE, DeviceInfo, OpenClError, list_devices
from .program import FrameTimes
from .tune import Choice, record_path
from .upsampler import VARIANT_VARIABLE, OpenClUpsampler
from .variants import Variant, parse_variant

__all__ = [
    "DEVICE_VARIABLE",
    "VARIANT_VARIABLE",
    "Choice",
    "DeviceInfo",
    "FrameTimes",
    "OpenClError",
    "OpenClUpsampler",
    "Variant",
    "list_devices",
    "parse_variant",
    "record_path",
]
