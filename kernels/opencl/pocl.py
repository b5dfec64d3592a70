"""PoCL on a processor that its compiler does not know.

PoCL 3.0, which the wheel ``pocl-binary-distribution`` holds, compiles with LLVM 14. Of a newer processor (AMD Zen 4
and 5, say) LLVM 14 knows no name, PoCL takes ``generic``, and its own front end then refuses every program: ``unknown
target CPU 'generic'``. No option or environment variable of PoCL changes the name, and its LLVM is linked in, so that
nothing can be put before it. What can be done is to give the device another name before its first program: one that
LLVM 14 knows, and whose instructions the processor has. The name is a C string that the device's struct points to.

This touches PoCL's memory, so it is done only where all of this holds: Linux on x86-64, a CPU device of PoCL 3.0 or
3.1, which says that it is ``generic``, and in whose struct exactly one pointer leads to that word. Where any fails
nothing is changed, and the build then fails with PoCL's own message. ``UPBEAM_POCL_CPU=off`` leaves PoCL alone.
"""

from __future__ import annotations

import ctypes
import os
import platform
import struct
import sys
from io import FileIO
from pathlib import Path
from typing import Any

__all__ = ["CPU_VARIABLE", "name_processor"]

CPU_VARIABLE = "UPBEAM_POCL_CPU"
"""Environment variable: ``off``, or LLVM's name of a processor."""

_UNKNOWN = b"generic\0"
_STRUCT_BYTES = 1024
"""Looked through: the name stands at byte 640; beyond the struct is other memory, which may hold another."""
_LEVELS: tuple[tuple[str, set[str]], ...] = (
    ("skylake-avx512", {"avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl", "avx2", "fma", "bmi2", "adx"}),
    ("haswell", {"avx2", "fma", "bmi1", "bmi2", "f16c", "movbe"}),
    ("x86-64", set()),
)


def name_processor(device: Any) -> bool:
    """Names the processor of a pyopencl device that PoCL has no name for. True if it was done."""
    wanted = os.environ.get(CPU_VARIABLE) or _best_level(_processor_flags())
    if wanted == "off" or not _is_nameless(device):
        return False
    place = _place_of_name(device.int_ptr)
    if place is None:
        return False
    duplicate = ctypes.CDLL(None).strdup  # PoCL may free it
    duplicate.restype, duplicate.argtypes = ctypes.c_void_p, [ctypes.c_char_p]
    ctypes.c_void_p.from_address(place).value = duplicate(wanted.encode())
    return True


def _is_nameless(device: Any) -> bool:
    if sys.platform != "linux" or platform.machine() != "x86_64":
        return False
    ours = device.platform.name == "Portable Computing Language" and device.driver_version.startswith(("3.0", "3.1"))
    return bool(ours and device.version.strip().endswith("-linux-gnu-generic"))


def _best_level(flags: set[str]) -> str:
    return next(name for name, needed in _LEVELS if needed <= flags)


def _processor_flags() -> set[str]:
    try:
        lines = Path("/proc/cpuinfo").read_text(errors="replace").splitlines()
    except OSError:
        return set()
    return next((set(line.partition(":")[2].split()) for line in lines if line.startswith("flags")), set())


def _place_of_name(device_struct: int) -> int | None:
    """Address of the one pointer within the struct that leads to ``generic``. Reads through the kernel: what is not a
    pointer cannot do harm."""
    try:
        with Path("/proc/self/mem").open("rb", buffering=0) as memory:
            words = _read(memory, device_struct, _STRUCT_BYTES)
            pointers = struct.unpack(f"<{len(words) // 8}Q", words[: len(words) // 8 * 8])
            places = [
                device_struct + 8 * k
                for k, pointer in enumerate(pointers)
                if 4096 <= pointer < 1 << 47 and _read(memory, pointer, len(_UNKNOWN)) == _UNKNOWN
            ]
    except OSError:  # a system that does not let a process read itself
        return None
    return places[0] if len(places) == 1 else None


def _read(memory: FileIO, address: int, size: int) -> bytes:
    """What is there; less or nothing where no memory is."""
    try:
        memory.seek(address)
        return memory.read(size)
    except (OSError, ValueError, OverflowError):
        return b""
