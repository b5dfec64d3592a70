"""The C driver (``runtime/fpga``) compiled as it would be for a board, and called through ctypes."""

from __future__ import annotations

import ctypes
import os
import shutil
import subprocess
from pathlib import Path

FOLDER = Path(__file__).resolve().parent.parent.parent / "runtime" / "fpga"
STRICT = ("-std=c11", "-Wall", "-Wextra", "-Wconversion", "-Wshadow", "-Wpedantic", "-Werror")
STATUS = (
    "OK", "ARGUMENT", "BUS", "ID", "VERSION", "RUNNING", "READ_ONLY", "PENDING", "IMAGE", "SHAPE", "WRITTEN", "SYSTEM",
)  # fmt: skip

READ = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p, ctypes.c_uint32, ctypes.POINTER(ctypes.c_uint32))
WRITE = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p, ctypes.c_uint32, ctypes.c_uint32)


def _words(*names: str) -> list[tuple[str, type]]:
    return [(name, ctypes.c_uint32) for name in names]


class Bus(ctypes.Structure):
    _fields_ = [("read", ctypes.c_void_p), ("write", ctypes.c_void_p), ("user", ctypes.c_void_p)]


class Info(ctypes.Structure):
    _fields_ = [
        ("contract", ctypes.c_char * 20),
        *_words("version", "model_crc", "weights_crc", "clock_hz", "columns", "shape"),
        ("scale", ctypes.c_uint32 * 2),
        *_words("slopes", "ring_slots", "ring_delay"),
    ]


class Settings(ctypes.Structure):
    _fields_ = _words("columns", "deadline_clocks", "irq_events")


class Counters(ctypes.Structure):
    _fields_ = _words(
        "frames_in", "columns_in", "frames_out", "columns_out", "dropped_beats", "errors", "misses", "frame_clocks",
        "latency", "latency_max",
    )  # fmt: skip


class Fault(ctypes.Structure):
    _fields_ = _words("address", "got", "expected")


class Fpga(ctypes.Structure):
    _fields_ = [("bus", Bus), ("info", Info), ("fault", Fault)]


class Uio(ctypes.Structure):
    _fields_ = [("file", ctypes.c_int), ("registers", ctypes.c_void_p)]


def compile_driver(folder: Path) -> ctypes.CDLL:
    """With every warning an error; with each of gcc and clang that is there, the last one is loaded."""
    compilers = [c for c in ("clang", "gcc") if shutil.which(c)] or [os.environ.get("CC", "cc")]
    for compiler in compilers:
        made = folder / f"driver-{Path(compiler).name}.so"
        files = [str(FOLDER / name) for name in ("upb_fpga.c", "upb_uio.c")]
        subprocess.run([compiler, *STRICT, "-O1", "-shared", "-fPIC", *files, "-o", str(made)], check=True)
    library = ctypes.CDLL(str(made), use_errno=True)
    library.upb_fpga_clocks.restype = ctypes.c_uint32
    library.upb_fpga_status_text.restype = ctypes.c_char_p
    library.upb_uio_bus.restype = Bus
    return library


class Driver:
    """One ``upb_fpga`` over a bus."""

    def __init__(self, library: ctypes.CDLL, bus: Bus) -> None:
        self.library, self.bus, self.state = library, bus, Fpga()

    def call(self, name: str, *arguments: object) -> str:
        """The name of the status."""
        return STATUS[getattr(self.library, f"upb_fpga_{name}")(ctypes.byref(self.state), *arguments)]

    def open(self) -> str:
        return self.call("open", ctypes.byref(self.bus))

    def start(self, columns: int = 0, deadline: int = 0, irq: int = 0) -> str:
        return self.call("start", ctypes.byref(Settings(columns, deadline, irq)))

    def events(self) -> int:
        found = ctypes.c_uint32()
        assert self.call("take_events", ctypes.byref(found)) == "OK"
        return found.value

    def counters(self) -> Counters:
        found = Counters()
        assert self.call("read_counters", ctypes.byref(found)) == "OK"
        return found

    def load(self, image: bytes) -> str:
        return self.call("load", image, ctypes.c_size_t(len(image)))

    @property
    def info(self) -> Info:
        return self.state.info

    @property
    def fault(self) -> Fault:
        return self.state.fault


def bus_of_top(top) -> Bus:
    """The simulated core's: its harness has the two functions."""
    read = ctypes.cast(top.library.upb_sim_bus_read, ctypes.c_void_p)
    write = ctypes.cast(top.library.upb_sim_bus_write, ctypes.c_void_p)
    return Bus(read, write, top.handle)
