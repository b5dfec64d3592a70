"""OpenCL devices: what is there, which one is used, and errors in one line."""

from __future__ import annotations

import importlib
import os
from dataclasses import dataclass
from typing import Any

from .pocl import name_processor

__all__ = ["DEVICE_VARIABLE", "DeviceInfo", "OpenClError", "list_devices", "open_device"]

DEVICE_VARIABLE = "UPBEAM_OPENCL_DEVICE"
"""Environment variable: the device's index, as ``list_devices`` counts, where no argument says so."""


class OpenClError(RuntimeError):
    """OpenCL cannot do what was asked; the message says why, in one line (a build failure has the build log after
    it)."""


@dataclass(frozen=True)
class DeviceInfo:
    """One device. ``shares_memory``: its buffers are mapped instead of copied."""

    index: int
    name: str
    platform: str
    driver: str
    opencl_c: str
    kind: str
    """``cpu``, ``gpu`` or ``other``"""
    units: int
    memory_bytes: int
    shares_memory: bool

    def __str__(self) -> str:
        return (
            f"{self.index}: {self.name} ({self.kind}, {self.units} units, {self.memory_bytes >> 20} MiB, "
            f"{self.opencl_c.strip()}) on {self.platform} {self.driver}"
        )


def import_pyopencl() -> Any:
    """The module, as Any: it is an optional part. Raises OpenClError."""
    try:
        return importlib.import_module("pyopencl")
    except ImportError as error:
        raise OpenClError(f"OpenCL needs the extra 'opencl': pip install 'upbeam[opencl]' ({error})") from None


def list_devices() -> list[DeviceInfo]:
    """All devices of all platforms, in their order; may be empty. Raises OpenClError without pyopencl or platform."""
    return [describe(index, device) for index, device in enumerate(_devices(import_pyopencl()))]


def open_device(index: int | None = None) -> tuple[Any, DeviceInfo]:
    """The pyopencl device with this index (None: the environment's, or the first). Raises OpenClError."""
    devices = _devices(import_pyopencl())
    if not devices:
        raise OpenClError("OpenCL has a platform but no device")
    index = _asked_index() if index is None else index
    if not 0 <= index < len(devices):
        known = "; ".join(str(describe(k, device)) for k, device in enumerate(devices))
        raise OpenClError(f"no OpenCL device {index}, there are: {known}")
    name_processor(devices[index])
    return devices[index], describe(index, devices[index])


def _asked_index() -> int:
    text = os.environ.get(DEVICE_VARIABLE, "0")
    try:
        return int(text)
    except ValueError:
        raise OpenClError(f"{DEVICE_VARIABLE} is {text!r}, expected a device's index") from None


def _devices(cl: Any) -> list[Any]:
    try:
        platforms = cl.get_platforms()
    except cl.Error as error:  # the loader finds none
        platforms, reason = [], f" ({one_line(error)})"
    else:
        reason = ""
    if not platforms:
        raise OpenClError(f"no OpenCL platform{reason}: install a driver, or PoCL with pip install 'upbeam[opencl]'")
    found = []
    for platform in platforms:
        try:
            found += platform.get_devices()
        except cl.Error:  # CL_DEVICE_NOT_FOUND: a driver without its device
            continue
    return found


def describe(index: int, device: Any) -> DeviceInfo:
    kinds = import_pyopencl().device_type
    kind = "cpu" if device.type & kinds.CPU else "gpu" if device.type & kinds.GPU else "other"
    return DeviceInfo(
        index=index,
        name=device.name.strip(),
        platform=device.platform.name.strip(),
        driver=device.driver_version.strip(),
        opencl_c=device.opencl_c_version.strip(),
        kind=kind,
        units=int(device.max_compute_units),
        memory_bytes=int(device.global_mem_size),
        shares_memory=bool(device.host_unified_memory),
    )


def one_line(error: BaseException, limit: int = 300) -> str:
    return " ".join(str(error).split())[:limit]
