"""``upbeam doctor``: what this machine can run, for people and for bug reports."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import shutil
import subprocess
from pathlib import Path
from typing import Any

import upbeam
from upbeam.kernels.opencl import OpenClError, list_devices
from upbeam.power.measure.sensors import find_sensors, no_sensor
from upbeam.runtime import _native
from upbeam.runtime.upsampler import load_model

from .common import JsonOption, emit_json, show, table

__all__ = ["doctor", "environment"]

TOOLS = ("cc", "c++", "cmake", "ninja", "clang", "aarch64-linux-gnu-gcc", "qemu-aarch64-static")
PACKAGES = ("numpy", "scipy", "matplotlib", "torch", "pyopencl", "onnxruntime")
INTERESTING_FLAGS = ("avx2", "fma", "avx512f", "avx512bw", "avx512_vnni", "avx_vnni", "asimd", "asimddp", "fphp")


def doctor(as_json: JsonOption = False) -> None:
    """Show versions, CPU features, instruction sets in use, tools, and whether the shipped model computes."""
    report = {**environment(), "self_test": _self_test()}
    if as_json:
        emit_json(report)
    else:
        show(table("upbeam doctor", ["", "value"], [[k, _text(v)] for k, v in report.items()]))
    if report["self_test"] != "ok":
        raise SystemExit(1)


def environment() -> dict[str, Any]:
    """The machine and the software: what a report must state beside its numbers."""
    return {
        "upbeam": upbeam.__version__,
        "library": _native.version(),
        "python": platform.python_version(),
        "system": f"{platform.system()} {platform.release()} {platform.machine()}",
        "cpu": _cpu_model(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "cpu_features": _cpu_flags(),
        "instruction_sets": _usable_sets(),
        "opencl_devices": _opencl_devices(),
        "power_sensors": [f"{s.name}: {s.boundary} ({s.detail})" for s in find_sensors()] or no_sensor(),
        "packages": {name: _version(name) for name in PACKAGES},
        "tools": {name: _tool(name) for name in TOOLS},
    }


def _usable_sets() -> list[str]:
    model = load_model()
    usable = []
    for name in ("scalar", "avx2", "avx512", "neon"):
        try:
            _native.Stream(model.native, cpu=name)
        except ValueError:
            continue
        usable.append(name)
    return usable


def _opencl_devices() -> list[str] | str:
    try:
        return [str(device) for device in list_devices()]
    except OpenClError as error:
        return str(error)


def _self_test() -> str:
    """The shipped model on a small image, every instruction set against the scalar one."""
    import numpy as np

    model = load_model()
    rng = np.random.default_rng(0)
    distance = rng.integers(0, 50_000, (32, 64), dtype=np.uint16)
    intensity = rng.integers(0, 256, (32, 64), dtype=np.uint8)
    expected = upbeam.Upsampler(model, columns=64, cpu="scalar")(distance, intensity)[0].astype(np.int64)
    for name in _usable_sets():
        result = upbeam.Upsampler(model, columns=64, cpu=name)(distance, intensity)[0].astype(np.int64)
        if np.mean(np.abs(result - expected) > 1) > 1e-3:
            return f"{name} differs from scalar"
    return "ok"


def _cpu_info(key: str) -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return ""
    return next((line.split(":", 1)[1].strip() for line in lines if line.split(":")[0].strip() == key), "")


def _cpu_model() -> str:
    return _cpu_info("model name") or platform.processor() or platform.machine()


def _cpu_flags() -> list[str]:
    present = set((_cpu_info("flags") or _cpu_info("Features")).split())
    return [flag for flag in INTERESTING_FLAGS if flag in present]


def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "not installed"


def _tool(name: str) -> str:
    path = shutil.which(name)
    if path is None:
        return "not found"
    try:
        done = subprocess.run([path, "--version"], capture_output=True, text=True, timeout=10, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return "found, does not answer"
    return (done.stdout or done.stderr).strip().splitlines()[0] if (done.stdout or done.stderr).strip() else "found"


def _text(value: Any) -> str:
    if isinstance(value, dict):
        return "\n".join(f"{k}: {v}" for k, v in value.items())
    return ", ".join(value) if isinstance(value, list) else str(value)
