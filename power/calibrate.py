"""One device refitted on a user's own measurement: a tegrastats log, or a TOML file of rows. Before and after."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

from upbeam.model.toml_file import TomlError, parse_toml

from .catalogue import CatalogueError, Device
from .energy import Row
from .estimate import Estimate, Knowledge, Load, estimate_load, estimate_macs
from .figures import Figure
from .measure.rails import MeasureError, Recording
from .measure.tegrastats import read_log

__all__ = ["Calibration", "Work", "calibrate", "read_rows", "write_rows"]


@dataclass(frozen=True)
class Work:
    """What ran while a log was written. Without ``macs`` and ``latency_ms``: our own stream, ``load``."""

    load: Load
    macs: float | None = None
    latency_ms: float | None = None


@dataclass(frozen=True)
class Calibration:
    """A device before and after the user's rows."""

    device: Device
    rows: tuple[Row, ...]
    before: Estimate
    after: Estimate
    recording: Recording
    idle: Recording | None

    def as_dict(self) -> dict[str, Any]:
        return {
            "device": self.device.name,
            "log": _recorded(self.recording),
            "idle_log": None if self.idle is None else _recorded(self.idle),
            "rows": [asdict(row) for row in self.rows],
            "before": self.before.as_dict(),
            "after": self.after.as_dict(),
        }


def _recorded(recording: Recording) -> dict[str, Any]:
    return {
        "power_w": recording.figure().as_dict(),
        "boundary": recording.boundary,
        "seconds": recording.seconds,
        "samples": len(recording.watts),
        "skipped_lines": recording.skipped,
        "rails_w": dict(recording.rails),
    }


def calibrate(
    device: Device,
    log: Path,
    work: Work,
    *,
    idle_log: Path | None = None,
    interval_s: float | None = None,
    known: Knowledge,
    mode: str | None = None,
) -> Calibration:
    """Refits ``device`` on what ``log`` says of it at work, and ``idle_log`` at rest. The device's own shipped rows are
    replaced: they are of another boundary. Raises MeasureError for logs that say nothing, CatalogueError."""
    if device.family != "jetson":
        raise CatalogueError(f"{device.name}: logs of tegrastats are of Jetson modules; --rows takes any device's rows")
    recording = read_log(log, interval_s)
    recording.check()
    if recording.mean_w == 0:
        raise MeasureError(f"{recording.source}: 0 W throughout: the sensor reads nothing")
    idle = None
    if idle_log is not None:
        idle = read_log(idle_log, interval_s)
        idle.check()
        if idle.boundary != recording.boundary:
            raise MeasureError(f"{idle.source}: {idle.boundary}; {recording.source}: {recording.boundary}")
    before = _estimate(device, work, known, mode)
    rows = _rows(device, recording, idle, work, before)
    others = [row for row in known.model.rows if row.device != device.name]
    after = _estimate(device, work, Knowledge.of([*others, *rows]), mode)
    return Calibration(device, tuple(rows), before, after, recording, idle)


def _estimate(device: Device, work: Work, known: Knowledge, mode: str | None) -> Estimate:
    if work.macs is None:
        return estimate_load(device, work.load, known=known, mode=mode)
    return estimate_macs(device, work.macs, work.latency_ms, known=known, mode=mode)


def _rows(device: Device, at_work: Recording, idle: Recording | None, work: Work, before: Estimate) -> list[Row]:
    like = Row(
        device.name, device.title, "jetson-gpu", at_work.boundary, device.figure("power.node").get("nm"), "", 0.0, 1.0,
        0.0, "", by_user=True,
    )  # fmt: skip
    rows = []
    if idle is not None:
        rows.append(replace(like, workload="idle", power_w=idle.mean_w, source=idle.source))
    if work.macs is not None and work.latency_ms is not None:
        rows.append(
            replace(like, workload="given", macs=work.macs, latency_ms=work.latency_ms, power_w=at_work.mean_w,
                    source=at_work.source)
        )  # fmt: skip
    elif idle is None:
        # Our stream adds little: what is left after it is taken away is the device at rest.
        added = before.increment_w.figure.get("W") if before.increment_w is not None else 0.0
        rest = max(0.0, at_work.mean_w - added)
        rows.append(replace(like, workload="idle", power_w=rest, source=f"{at_work.source} less the modelled stream"))
    return rows


def with_rows(known: Knowledge, rows: Sequence[Row]) -> Knowledge:
    """The user's rows in the place of those shipped for the same devices."""
    named = {row.device for row in rows}
    return Knowledge.of([*(row for row in known.model.rows if row.device not in named), *rows])


# -------------------------------------------------------------------------------------------------------- row files


def write_rows(path: Path, rows: Sequence[Row]) -> None:
    """A file that ``--rows`` reads."""
    lines = ["# Rows of `upbeam estimate --calibrate --save`; read them with --rows."]
    for row in rows:
        lines += ["", "[[row]]"]
        for key, value in asdict(row).items():
            if value is None or key == "by_user":
                continue
            lines.append(f"{key} = {_quoted(value) if isinstance(value, str) else repr(float(value))}")
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _quoted(text: str) -> str:
    escaped = text.replace("\\", "\\\\").replace('"', '\\"')
    return '"' + "".join(c if c >= " " else " " for c in escaped) + '"'


def read_rows(path: Path) -> list[Row]:
    """Raises CatalogueError for a file that is not such rows."""
    try:
        data = parse_toml(path.name, path.read_text(encoding="utf-8"))
    except (TomlError, UnicodeDecodeError) as error:
        raise CatalogueError(str(error)) from None
    known = {f.name for f in fields(Row)} - {"by_user"}
    rows = []
    entries = data.get("row")
    if not isinstance(entries, list) or not entries or set(data) != {"row"}:
        raise CatalogueError(f"{path.name}: expected [[row]] tables and nothing else")
    for number, entry in enumerate(entries, 1):
        unknown = sorted(set(entry) - known)
        if unknown:
            raise CatalogueError(f"{path.name}: row {number}: {unknown[0]!r} is unknown, expected {', '.join(known)}")
        rows.append(_checked(path.name, number, entry))
    return rows


_TEXTS = ("device", "title", "family", "boundary", "workload", "source")
_NUMBERS = ("node_nm", "macs", "latency_ms", "power_w")


def _checked(name: str, number: int, entry: dict[str, Any]) -> Row:
    for key in (*_TEXTS, *_NUMBERS):
        if key not in entry:
            raise CatalogueError(f"{name}: row {number}: {key} is missing")
    for key in _TEXTS:
        if not isinstance(entry[key], str) or not entry[key]:
            raise CatalogueError(f"{name}: row {number}: {key}: {entry[key]!r}, expected a text")
    for key in _NUMBERS:
        value = entry[key]
        least = 0.0 if key == "macs" else 1e-9
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not least <= value < 1e18:
            raise CatalogueError(f"{name}: row {number}: {key}: {value!r}, expected a number of at least {least:g}")
    return Row(**entry, by_user=True)


def power_change(before: Figure, after: Figure) -> str:
    """For people: ``1.65 W (1.22 to 2.69) -> 2.05 W (1.95 to 2.15)``."""
    return " -> ".join(f"{f.get('W'):.3g} W ({f.span('W')[1]:.3g} to {f.span('W')[2]:.3g})" for f in (before, after))
