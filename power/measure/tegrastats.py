"""What ``tegrastats`` prints, of JetPack 4, 5 and 6: rails, loads, clocks, temperatures. Newer tokens are passed over.

Rails stand as ``NAME now/mean`` in mW (JetPack 4) or ``NAME 1234mW/1200mW`` (5 and later). Only ``now`` is used: what
the tool calls the mean has no stated window.
"""

from __future__ import annotations

import datetime
import re
import shutil
import subprocess
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

from .rails import MeasureError, Recording, mean_rails, total_power

__all__ = ["TegraLine", "parse_line", "read_log", "record_live"]

_DEFAULT_INTERVAL_S = 1.0
_LONGEST_LINE = 20_000
_RAIL = re.compile(r"(?<![\w@/])([A-Za-z][A-Za-z0-9_]*) (\d{1,7})(?:mW)?/(\d{1,7})(?:mW)?(?![\w/(.])")
_MEMORY = re.compile(r"\bRAM (\d+)/(\d+)MB")
_CPUS = re.compile(r"\bCPU \[([^\]]*)\]")
_GPU = re.compile(r"\bGR3D_FREQ (?:(\d+)%)?(?:@\[?([\d,]+)\]?)?")
_TEMPERATURE = re.compile(r"(?<![\w])([A-Za-z][\w-]*)@(-?\d+(?:\.\d+)?)C\b")
_STAMP = re.compile(r"\s*(\d\d)-(\d\d)-(\d{4}) (\d\d):(\d\d):(\d\d)\b")
_NOT_CONNECTED = "NC"


@dataclass(frozen=True)
class TegraLine:
    """One line. Rails in W; loads in %; clocks in MHz; what a line does not say is absent."""

    rails: dict[str, float] = field(default_factory=dict)
    cpu_load: tuple[float | None, ...] = ()
    """of each core; None: switched off"""
    gpu_load: float | None = None
    gpu_mhz: tuple[int, ...] = ()
    ram_mb: int | None = None
    temperature_c: dict[str, float] = field(default_factory=dict)
    time: datetime.datetime | None = None


def parse_line(text: str) -> TegraLine:
    """Never fails: what is not understood is not there."""
    text = text[:_LONGEST_LINE]
    rails = {m[1]: int(m[2]) / 1000 for m in _RAIL.finditer(text) if m[1] != _NOT_CONNECTED}
    memory, cpus, gpu = _MEMORY.search(text), _CPUS.search(text), _GPU.search(text)
    clocks = tuple(int(x) for x in gpu[2].split(",") if x) if gpu and gpu[2] else ()
    return TegraLine(
        rails=rails,
        cpu_load=tuple(_load(x) for x in cpus[1].split(",") if x.strip()) if cpus else (),
        gpu_load=float(gpu[1]) if gpu and gpu[1] else None,
        gpu_mhz=clocks,
        ram_mb=int(memory[1]) if memory else None,
        temperature_c={m[1]: float(m[2]) for m in _TEMPERATURE.finditer(text)},
        time=_time(text),
    )


def _load(core: str) -> float | None:
    found = re.match(r"\s*(\d+)%", core)
    return float(found[1]) if found else None


def _time(text: str) -> datetime.datetime | None:
    stamp = _STAMP.match(text)
    if not stamp:
        return None
    month, day, year, hour, minute, second = (int(x) for x in stamp.groups())
    try:
        return datetime.datetime(year, month, day, hour, minute, second)
    except ValueError:
        return None


def read_log(path: str | Path, interval_s: float | None = None) -> Recording:
    """A log file. Its time is taken from the lines' stamps (JetPack 5 and later), or from ``interval_s``, that of
    ``tegrastats --interval``; one second if neither is there. Raises MeasureError; OSError."""
    text = Path(path).read_text(encoding="utf-8", errors="replace")
    return _recording(text.splitlines(), f"tegrastats log {Path(path).name}", interval_s)


def record_live(seconds: float, interval_s: float = 0.5, command: str = "tegrastats") -> Recording:
    """Runs the tool for that long. Raises MeasureError where it is not installed or says nothing."""
    path = shutil.which(command)
    if path is None:
        raise MeasureError(f"{command} is not on this machine")
    process = subprocess.Popen(
        [path, "--interval", f"{interval_s * 1000:.0f}"], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    )
    lines: list[str] = []
    wanted = max(2, round(seconds / interval_s))
    try:
        assert process.stdout is not None
        for line in process.stdout:
            lines.append(line)
            if len(lines) >= wanted:
                break
    finally:
        process.terminate()
        process.wait(timeout=5)
        if process.stdout is not None:
            process.stdout.close()
    return _recording(lines, "tegrastats, live", interval_s)


def _recording(lines: Iterable[str], source: str, interval_s: float | None) -> Recording:
    parsed = [parse_line(line) for line in lines if line.strip()]
    good = [line for line in parsed if line.rails]
    if not good:
        raise MeasureError(f"{source}: no power rail in any of {len(parsed)} lines")
    # A line that lacks rails of the others would change the sum.
    names = {frozenset(line.rails) for line in good}
    usual = max(names, key=lambda n: sum(frozenset(line.rails) == n for line in good))
    used = [line for line in good if frozenset(line.rails) == usual]
    totals = [total_power(line.rails) for line in used]
    means = mean_rails([line.rails for line in used])
    skipped = len(parsed) - len(used)
    seconds = _duration(used, interval_s)
    return Recording(tuple(w for w, _ in totals), seconds, totals[0][1], source, means, skipped)


def _duration(lines: list[TegraLine], interval_s: float | None) -> float:
    stamps = [line.time for line in lines if line.time is not None]
    if interval_s is None and len(stamps) == len(lines) > 1:
        whole = (stamps[-1] - stamps[0]).total_seconds()
        return whole * len(lines) / (len(lines) - 1) if whole > 0 else 0.0
    return len(lines) * (interval_s if interval_s is not None else _DEFAULT_INTERVAL_S)
