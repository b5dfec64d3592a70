"""How often the core's nets toggle while it works: from a simulation's SAIF file.

RTL activity is that of registers and of the sources' own wires, settled once a clock: it misses glitches, and the wires
that synthesis makes. What it is good for is stated by ``power/fpga_activity.py``, with a range.
"""

from __future__ import annotations

import re
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from upbeam.quant.export.source import Source
from upbeam.quant.integer import Precision

from .beats import U8, U16, image_beats
from .core import RtlCore, Traffic
from .simulators import sources

__all__ = ["Activity", "Toggles", "idle_toggles", "measure_activity", "read_saif"]

TOP = "upb_core"
CLOCKS = ("aclk", "clk")


@dataclass(frozen=True)
class Toggles:
    bits: int
    toggles: int


@dataclass(frozen=True)
class Activity:
    """Of one run. A clock net's two edges a clock are not in it."""

    clocks: int
    parts: dict[str, Toggles]
    """the core's units, and the rest of it as ``core``"""

    @property
    def toggles(self) -> int:
        return sum(part.toggles for part in self.parts.values())

    @property
    def bits(self) -> int:
        return sum(part.bits for part in self.parts.values())

    @property
    def rate(self) -> float:
        """Toggles of a bit and clock, the mean of all."""
        return self.toggles / (self.bits * self.clocks)

    def as_dict(self) -> dict[str, Any]:
        return {
            "clocks": self.clocks,
            "bits": self.bits,
            "toggles": self.toggles,
            "rate": self.rate,
            "parts": {name: vars(part) for name, part in self.parts.items()},
        }


def measure_activity(
    source: Source,
    precision: Precision,
    distance: U16,
    intensity: U8,
    *,
    fold: int | None = None,
    lanes: int = 1,
    traffic: Traffic | None = None,
) -> Activity:
    """Of an image ``[32, W]``, from reset to the last beat. Raises as ``RtlCore``."""
    core = RtlCore(source, precision, fold=fold, lanes=lanes, trace="saif")
    width = distance.shape[1]
    with tempfile.TemporaryDirectory(prefix="upbeam-saif-") as folder:
        path = Path(folder) / "core.saif"
        run = core.run(image_beats(distance, intensity, width), width, traffic, trace=path)
        parts = read_saif(path)
    return Activity(run.clocks, parts)


_IDLE_FROM, _IDLE_CLOCKS = 100, 192 * 96
_IDLE_COLUMNS = 32
"""Enough to fill what the core holds, before it waits."""


def idle_toggles(
    source: Source, precision: Precision, distance: U16, intensity: U8, *, fold: int | None = None, lanes: int = 1
) -> float:
    """Toggles a clock of a core that waits with empty slots: the schedule runs on and reads its weights. From two runs
    of a few columns whose sink takes nothing for a while, in one twice as long."""
    image = distance[:, :_IDLE_COLUMNS], intensity[:, :_IDLE_COLUMNS]
    runs = [
        measure_activity(
            source, precision, *image, fold=fold, lanes=lanes,
            traffic=Traffic(stuck=(_IDLE_FROM, _IDLE_FROM + times * _IDLE_CLOCKS)),
        )
        for times in (1, 2)
    ]  # fmt: skip
    return (runs[1].toggles - runs[0].toggles) / (runs[1].clocks - runs[0].clocks)


_TOKEN = re.compile(r"\(INSTANCE\s+(\S+)|\((\S+)\s+(?:\(T\w \d+\)\s*)+\(TC (\d+)\)\)|[()]")
_PORT = re.compile(r"^\s*(?:input|output)\s+(?:wire|reg)\s+(?:signed\s+)?(?:\[[^\]]*\]\s*)?(\w+)", re.MULTILINE)
_INSTANCE = re.compile(r"\b(upb_\w+)\s+(#\()?")


def read_saif(path: Path) -> dict[str, Toggles]:
    """Toggles by unit of the core: the instance below ``upb_core``, or ``core`` for its own nets. A port is the net
    that it is connected to: it counts there, once."""
    found: dict[str, list[int]] = {}
    for unit, toggles in _nets(path.read_text(), _ports_of_instances(sources())):
        entry = found.setdefault(unit, [0, 0])
        entry[0] += 1
        entry[1] += toggles
    return {unit: Toggles(*counts) for unit, counts in sorted(found.items())}


def _nets(text: str, ports: dict[str, set[str]]) -> Iterator[tuple[str, int]]:
    """Unit and toggles of each bit. Nets of a deeper instance belong to the unit that holds it."""
    depth, scopes = 0, list[tuple[int, str]]()
    for match in _TOKEN.finditer(text):
        instance, net, count = match.groups()
        if instance is not None:
            depth += 1
            scopes.append((depth, instance.replace("\\", "")))
        elif net is not None:
            names = [name for _, name in scopes]
            bare = net.split("\\")[0]
            if TOP in names and bare not in CLOCKS and bare not in ports.get(names[-1], ()):
                yield _unit(names), int(count)
        elif match.group() == "(":
            depth += 1
        else:
            if scopes and scopes[-1][0] == depth:
                scopes.pop()
            depth -= 1


def _unit(scopes: list[str]) -> str:
    below = scopes[scopes.index(TOP) + 1 :]
    return below[0] if below else "core"


def _ports_of_instances(files: Mapping[str, str]) -> dict[str, set[str]]:
    """Names of the ports of whatever module an instance name stands for."""
    ports = {name.removesuffix(".sv"): set(_PORT.findall(text)) for name, text in files.items()}
    found: dict[str, set[str]] = {}
    for text in files.values():
        code = re.sub(r"//.*", "", text)
        for match in _INSTANCE.finditer(code):
            at = _closing(code, match.end()) if match.group(2) else match.end()
            name = re.match(r"\s*(\w+)\s*\(", code[at:])
            if name is not None and match.group(1) in ports:
                found.setdefault(name.group(1), set()).update(ports[match.group(1)])
    return found


def _closing(text: str, at: int) -> int:
    """Behind the bracket that closes the one before ``at``."""
    depth = 1
    while depth:
        depth += {"(": 1, ")": -1}.get(text[at], 0)
        at += 1
    return at
