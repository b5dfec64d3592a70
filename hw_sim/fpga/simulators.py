"""Builds a simulator of the core, once for each configuration, and keeps it in the user's cache.

Two independent front ends, so that a quirk of one cannot hide: Verilator, and Yosys (the one that synthesises), whose
CXXRTL back end writes C++ as well. Both are driven by one harness.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import tempfile
from collections.abc import Callable, Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Literal

from .tools import Tool, compiler, find_verilator, find_yosys, run

__all__ = ["CACHE_VARIABLE", "SIMULATORS", "Simulator", "Trace", "build", "build_top", "cache_folder", "sources"]

Simulator = Literal["verilator", "cxxrtl"]
Trace = Literal["vcd", "saif"]
"""Waveforms; toggles of each net"""
SIMULATORS: tuple[Simulator, ...] = ("verilator", "cxxrtl")
CACHE_VARIABLE = "UPBEAM_RTL_CACHE"
"""Environment variable: where built simulators are kept, ``~/.cache/upbeam/rtl`` without it."""
TOP = "upb_core"
PACKAGE = "upb_pkg.sv"
HARNESS = "harness.cpp"
_RUNTIME = ("verilated.cpp", "verilated_threads.cpp")
_CXX = ("-O2", "-std=c++17", "-pthread")


def sources() -> dict[str, str]:
    """The core's SystemVerilog files by name, the package first; and what they include."""
    folder = resources.files("upbeam.kernels").joinpath("rtl")
    found = {item.name: item.read_text() for item in folder.iterdir() if item.name.endswith((".sv", ".svh"))}
    return {name: found[name] for name in sorted(found, key=lambda name: (name != PACKAGE, name))}


def cache_folder() -> Path:
    given = os.environ.get(CACHE_VARIABLE)
    if given:
        return Path(given)
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "upbeam" / "rtl"


def build(headers: Mapping[str, str], simulator: Simulator = "verilator", *, trace: Trace | None = None) -> Path:
    """The simulator of a configuration (``quant.export.rtl.core_headers``), from the cache or built (seconds).

    ``trace``: it can write that, and is slower (Verilator only). Raises ToolError."""
    if trace and simulator != "verilator":
        raise ValueError(f"only Verilator writes {trace} here")
    tool = find_verilator() if simulator == "verilator" else find_yosys()
    harness = resources.files("upbeam.hw_sim").joinpath("fpga").joinpath(HARNESS).read_text()
    files = {**sources(), **headers, HARNESS: harness}
    maker = _with_verilator if simulator == "verilator" else _with_yosys
    key = (sorted(files.items()), simulator, trace, tool.version(), compiler())
    return _kept(key, lambda folder: maker(folder, tool, files, trace), files)


def build_top(
    headers: Mapping[str, str],
    parameters: Mapping[str, int],
    harness: str,
    text: str,
    *,
    top: str = "upb_top",
    more: Mapping[str, str] | None = None,
) -> Path:
    """``top`` with these parameters and a C++ harness (its file name and text) around it, as a shared library
    (Verilator). ``more``: sources beside the core's. Raises ToolError."""
    tool = find_verilator()
    files = {**sources(), **headers, **(more or {}), harness: text}
    flags = ["--top-module", top, *(f"-G{name}={value}" for name, value in parameters.items())]
    key = (sorted(files.items()), flags, tool.version(), compiler())
    return _kept(key, lambda folder: _shared_library(folder, tool, files, flags, harness), files)


def _shared_library(folder: Path, tool: Tool, files: Mapping[str, str], flags: list[str], harness: str) -> Path:
    _verilate(folder, tool, files, flags)
    made = [str(path) for path in sorted((folder / "made").glob("*.cpp"))]
    runtime = [str(_verilated_object(tool, None, name)) for name in _RUNTIME]
    # -O1: such a simulator runs a few frames at most; compilation is most of its time.
    options = [*_verilated_options(tool, None), "-O1", "-Imade", "-fPIC", "-shared", *made, harness, *runtime]
    run([*compiler(), *_CXX, *options, "-o", "simulator.so"], folder, "the C++ compiler")
    return folder / "simulator.so"


def _kept(key: object, make: Callable[[Path], Path], files: Mapping[str, str]) -> Path:
    """The file of this key in the cache; made in a scratch folder that holds ``files`` if it is not there."""
    kept = cache_folder() / hashlib.sha256(repr(key).encode()).hexdigest()[:32]
    if kept.is_file():
        return kept
    kept.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="upbeam-rtl-") as scratch:
        for name, text in files.items():
            (Path(scratch) / name).write_text(text)
        made = make(Path(scratch))
        # Renamed into place: whoever builds the same at the same time finds a whole file.
        partial = kept.with_name(f"{kept.name}.{os.getpid()}")
        shutil.copy2(made, partial)
        partial.replace(kept)
    return kept


def _units(files: Mapping[str, str]) -> list[str]:
    return [name for name in files if name.endswith(".sv")]


def _with_verilator(folder: Path, tool: Tool, files: Mapping[str, str], trace: Trace | None) -> Path:
    _verilate(folder, tool, files, ["--top-module", TOP, *([f"--trace-{trace}"] if trace else [])])
    options = [*_verilated_options(tool, trace), "-Imade"]
    made = [str(path) for path in sorted((folder / "made").glob("*.cpp"))]
    runtime = [
        str(_verilated_object(tool, trace, name))
        for name in (*_RUNTIME, *([f"verilated_{trace}_c.cpp"] if trace else []))
    ]
    return _compile(folder, [*options, *made], runtime)


def _verilate(folder: Path, tool: Tool, files: Mapping[str, str], more: list[str]) -> None:
    # Widths are chosen on purpose (sums modulo 2^32); every other warning stops the build.
    flags = ["--cc", "-O3", "--x-assign", "unique", "--x-initial", "unique", "-Wno-WIDTH", "--assert", *more]
    command = [*tool.command, *flags, "--Mdir", "made", "-I.", *_units(files)]
    run(command, folder, tool.name, tool.environment())


def _verilated_options(tool: Tool, trace: Trace | None) -> list[str]:
    assert tool.root is not None
    include = tool.root / "include"
    traces = {"VM_TRACE": trace is not None, "VM_TRACE_VCD": trace == "vcd", "VM_TRACE_SAIF": trace == "saif"}
    defines = ["-DVM_COVERAGE=0", "-DVM_SC=0", *(f"-D{name}={int(value)}" for name, value in traces.items())]
    return [*defines, f"-I{include}", f"-I{include / 'vltstd'}"]


def _verilated_object(tool: Tool, trace: Trace | None, name: str) -> Path:
    """Verilator's runtime is the same for every core, and takes longer to compile than most."""
    assert tool.root is not None
    source = str(tool.root / "include" / name)

    def make(folder: Path) -> Path:
        options = [*compiler(), *_CXX, *_verilated_options(tool, trace), "-fPIC", "-c", source, "-o", "runtime.o"]
        run(options, folder, "the C++ compiler")
        return folder / "runtime.o"

    return _kept(("runtime, -fPIC", name, trace, tool.version(), compiler()), make, {})


def _with_yosys(folder: Path, tool: Tool, files: Mapping[str, str], trace: Trace | None) -> Path:
    assert tool.root is not None
    assert not trace
    script = (
        f"read_verilog -sv -defer -I. {' '.join(_units(files))}; hierarchy -check -top {TOP}; proc; flatten; "
        "write_cxxrtl -O6 -g0 upb_core_cxxrtl.cpp"
    )
    run([*tool.command, "-q", "-p", script], folder, tool.name, tool.environment())
    return _compile(folder, ["-DUPB_CXXRTL", f"-I{tool.root / 'include' / 'backends' / 'cxxrtl' / 'runtime'}"])


def _compile(folder: Path, options: list[str], objects: Sequence[str] = ()) -> Path:
    run([*compiler(), *_CXX, *options, HARNESS, *objects, "-o", "simulator"], folder, "the C++ compiler")
    return folder / "simulator"
