"""The report of a run: one HTML file that needs nothing else, and the same facts as JSON."""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined, Template

from upbeam.runtime.live import quantiles_ms

from .pictures import (
    Panel,
    plot_birds_eye,
    plot_close_up,
    plot_latency_histogram,
    plot_range_images,
    plot_timeline,
)

__all__ = [
    "Panel",
    "Picture",
    "ReportError",
    "page_template",
    "plot_birds_eye",
    "plot_close_up",
    "plot_latency_histogram",
    "plot_range_images",
    "plot_timeline",
    "verdict_line",
    "write_report",
]

LISTED = 50
"""Rows of a table at most; report.json has them all."""

_DETAILS = (
    ("operations", "Operations"),
    ("memory", "Memory"),
    ("model", "Model"),
    ("source", "Source"),
    ("environment", "Environment"),
)


class ReportError(ValueError):
    """Data that makes no report: names the key."""


@dataclass(frozen=True)
class Picture:
    """A picture for the report."""

    title: str
    png: bytes
    caption: str = ""


@dataclass(frozen=True)
class _Row:
    """One line of the table of times. Values are in ``unit``; None where they do not apply."""

    name: str
    boundary: str
    kind: str
    unit: str
    p50: float | None
    p99: float | None
    p999: float | None
    most: float | None


def write_report(directory: str | Path, data: Mapping[str, Any], pictures: Sequence[Picture] = ()) -> Path:
    """Writes ``report.html`` and ``report.json`` into ``directory`` (made if need be); returns the HTML's path.

    ``data["live"]`` is ``LiveResult.to_dict()``. Optional: ``title`` (text), ``operations``, ``memory``, ``model``,
    ``source``, ``environment`` (nested dicts of plain values: each becomes a table), ``notes`` (list of texts). All of
    it goes to the JSON.
    Raises ReportError when ``live`` is absent or a value does not fit JSON; nothing is written then.
    """
    if "live" not in data:
        raise ReportError("the report's data has no 'live'")
    try:
        as_json = json.dumps(data, indent=1, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise ReportError(f"the report's data does not fit JSON: {error}") from None
    html = _render(data, pictures)
    folder = Path(directory)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "report.json").write_text(as_json + "\n", encoding="utf-8")
    path = folder / "report.html"
    path.write_text(html, encoding="utf-8")
    return path


def verdict_line(live: Mapping[str, Any]) -> str:
    """``200 frames, 0 missed 50 ms, p99 0.34 ms (measured)``."""
    parts = [_count(live["frames"], "frame"), f"{live['misses']} missed {live['deadline_ms']:g} ms"]
    if live["latency_ms"]:
        parts.append(f"p99 {_figures(live['latency_ms']['p99'])} ms ({_kind(live)})")
    if live["stopped"]:
        parts.append("stopped early")
    return ", ".join(parts)


def page_template(name: str) -> Template:
    """A page of ``power/templates``; pictures go into it through the filter ``data_url``."""
    environment = Environment(
        loader=PackageLoader("upbeam.power", "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["figures"] = _figures
    environment.filters["data_url"] = _data_url
    return environment.get_template(name)


def _render(data: Mapping[str, Any], pictures: Sequence[Picture]) -> str:
    live = data["live"]
    return page_template("report.html").render(
        title=data.get("title", "upbeam stream"),
        verdict=verdict_line(live),
        good=live["misses"] == 0,
        kind=_kind(live),
        live=live,
        times=_times(live),
        misses=_misses(live),
        incomplete=[r for r in live["ledger"] if r["missing_columns"] or r["verdict"] == "partial"],
        accounts=_accounts(live["counts"]),
        plots=_plots(live),
        pictures=pictures,
        details=[(name, _flat(data[key])) for key, name in _DETAILS if data.get(key)],
        notes=data.get("notes", ()),
        listed=LISTED,
    )


def _plots(live: Mapping[str, Any]) -> list[Picture]:
    judged = [r["latency_ns"] / 1e6 for r in live["ledger"] if r["verdict"] != "partial"]
    kind = _kind(live)
    return [
        Picture("Latency histogram", plot_latency_histogram(judged, live["deadline_ms"], kind)),
        Picture("Time line", plot_timeline(live["ledger"], live["deadline_ms"], live["stalls"], kind)),
    ]


def _kind(live: Mapping[str, Any]) -> str:
    return "measured" if live["clock"] == "real" else "modelled"


# -------------------------------------------------------------------------------------------------------- tables


_LATENCY = ("latency of a frame", "last input column received to last output column complete")
_WAIT = ("of it: waiting for the sensor", "until the packet arrived that completes the last column")
_COLUMN = ("compute, one column", "both networks, output collected")
_PACKET = ("compute, one packet", "from taken to done")
_LATENESS = ("lateness of the simulated sensor", "packet played after it was due")


def _row(what: tuple[str, str], kind: str, unit: str, values: Mapping[str, float]) -> _Row:
    return _Row(*what, kind, unit, *(values.get(key) for key in ("p50", "p99", "p999", "max")))


def _times(live: Mapping[str, Any]) -> list[_Row]:
    kind = _kind(live)
    waits = quantiles_ms([r["wait_ns"] for r in live["ledger"] if r["verdict"] != "partial"])
    rows = [
        _row(_LATENCY, kind, "ms", live["latency_ms"]),
        _row(_WAIT, kind, "ms", waits),
        _row(_COLUMN, kind, "µs", live["column_compute_us"]),
        _row(_PACKET, kind, "µs", live["packet_compute_us"]),
        _row(_LATENESS, "measured" if live["clock"] == "real" else "given", "µs", live["pacer_lateness_us"]),
    ]
    return [row for row in rows if row.most is not None]


def _misses(live: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    return [r for r in live["ledger"] if r["verdict"] == "missed"]


def _accounts(counts: Mapping[str, int]) -> list[tuple[str, str]]:
    """Three sums a reader can check."""
    c = counts
    dropped = c["columns_played"] - c["columns_taken"]
    return [
        (
            f"{c['frames_begun']} frames begun",
            f"{c['frames_met']} met + {c['frames_missed']} missed + {c['frames_partial']} partial + "
            f"{c['frames_empty']} of which nothing arrived",
        ),
        (
            f"{c['packets_played']} packets sent",
            f"{c['packets_taken']} taken + {c['packets_dropped_fault']} dropped by an ordered fault + "
            f"{c['packets_dropped_overflow']} by overflow",
        ),
        (f"{c['columns_played']} columns sent", f"{c['columns_taken']} taken + {dropped} never arrived"),
    ]


def _flat(value: Mapping[str, Any], prefix: str = "") -> list[tuple[str, str]]:
    """Nested dicts, and lists of them, as rows of a table: ``cpu.name`` and ``layers.1.macs`` -> text."""
    rows: list[tuple[str, str]] = []
    for key, item in value.items():
        name = f"{prefix}{key}"
        if isinstance(item, Mapping):
            rows.extend(_flat(item, f"{name}."))
        elif isinstance(item, (list, tuple)) and any(isinstance(part, Mapping) for part in item):
            rows.extend(_flat({str(n): part for n, part in enumerate(item, 1)}, f"{name}."))
        else:
            rows.append((name.replace("_", " "), _text(item)))
    return rows


def _text(item: Any) -> str:
    if isinstance(item, bool):
        return "yes" if item else "no"
    if isinstance(item, int):
        return f"{item:,}".replace(",", "\u202f")
    if isinstance(item, float):
        return _figures(item)
    if item is None:
        return "none"
    if isinstance(item, str):
        return item
    if isinstance(item, Iterable):
        return ", ".join(_text(part) for part in item)
    return str(item)


def _figures(value: float | None) -> str:
    """Three significant figures, without an exponent."""
    if value is None:
        return ""
    if value == 0 or not math.isfinite(value):
        return f"{value:g}"
    decimals = max(0, 2 - math.floor(math.log10(abs(value))))
    return f"{value:.{decimals}f}"


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def _data_url(png: bytes) -> str:
    return "data:image/png;base64," + base64.b64encode(png).decode("ascii")
