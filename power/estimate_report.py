"""The report of ``upbeam estimate --all``: one HTML file that needs nothing else, and the same as JSON."""

from __future__ import annotations

import datetime
import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from . import energy
from .catalogue import device, device_names
from .energy import as_table
from .estimate import Bounded, Estimate, Knowledge, Load, cpu_column_time
from .estimate_pictures import (
    Roof,
    RooflinePoint,
    pareto_rows,
    plot_latency,
    plot_pareto,
    plot_power,
    plot_roofline,
)
from .fpga_activity import GLITCHES, NET_FF, core_volts
from .ops import PAPER_MEMORY_NOTE
from .report import Picture, _flat, page_template

__all__ = ["ModelFacts", "write_report"]

HTML, RESULTS = "estimate.html", "estimate.json"
ModelFacts = Mapping[str, Any]
"""``name``, ``crc32``, ``sensor``, ``quantisation`` (the file's own metrics), ``provenance``."""


def write_report(
    folder: Path, estimates: Sequence[Estimate], load: Load, known: Knowledge, model: ModelFacts,
    environment: Mapping[str, Any],
) -> Path:  # fmt: skip
    """Writes ``estimate.html`` and ``estimate.json`` into ``folder`` (made if need be); gives the HTML's path."""
    data = _data(estimates, load, known, model, environment)
    html = page_template("estimate.html").render(
        **_page(estimates, load, known, model, environment), pictures=_pictures(estimates, load), data=data
    )
    folder.mkdir(parents=True, exist_ok=True)
    (folder / RESULTS).write_text(json.dumps(data, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    path = folder / HTML
    path.write_text(html, encoding="utf-8")
    return path


def _data(
    estimates: Sequence[Estimate], load: Load, known: Knowledge, model: ModelFacts, environment: Mapping[str, Any]
) -> dict[str, Any]:
    rows, comments = pareto_rows()
    return {
        "generated_at": datetime.datetime.now(datetime.timezone.utc).isoformat(timespec="seconds"),
        "devices": [one.as_dict() for one in estimates],
        "operations": load.count.as_dict(),
        "leave_one_out": as_table(known.results),
        "skill": {what: energy.skill(known.results, what) for what in ("power", "latency", "energy")},
        "pareto": {"rows": rows, "measured_with": comments},
        "quantisation": model["quantisation"],
        "figures": {name: {key: f.as_dict() for key, f in device(name).every_figure()} for name in device_names()},
        "measured_rows": [vars(row) for row in known.model.rows],
        "model": {key: model[key] for key in ("name", "crc32", "sensor")},
        "environment": dict(environment),
    }


# ------------------------------------------------------------------------------------------------------------- page


def _page(
    estimates: Sequence[Estimate], load: Load, known: Knowledge, model: ModelFacts, environment: Mapping[str, Any]
) -> dict[str, Any]:
    verdicts = [one.met for one in estimates]
    return {
        "title": f"both images of a 32 x {load.columns} frame at {load.rate_hz:g} Hz",
        "verdict": f"{verdicts.count('yes')} of {len(verdicts)} meet {load.deadline_ms:g} ms over their whole interval",
        "good": all(v == "yes" for v in verdicts),
        "load": load,
        "model": model,
        "rows": [_row(one) for one in estimates],
        "layers": [x.as_dict() for x in (*load.count.dense, *load.count.folded, *load.count.kernel(load.precision))],
        "paper": load.count.as_dict()["paper"],
        "paper_note": PAPER_MEMORY_NOTE,
        "front": [_with_cost(row, load) for row in pareto_rows()[0]],
        "priced_on": [device(name).title for name in _PRICED_ON],
        "front_source": pareto_rows()[1],
        "quantised": _quantised(model["quantisation"], load),
        "quantised_on": model["quantisation"].get("against_float_on", ""),
        "errors": as_table(known.results),
        "skill": {w: energy.skill(known.results, w) for w in ("power", "latency", "energy")},
        "assumptions": [*_figures_of(lambda kind: kind == "assumption"), *_of_activity()],
        "measured": _figures_of(lambda kind: kind.startswith("measured")),
        "data_sheets": _data_sheets(),
        "sources": list(dict.fromkeys(row.source for row in known.model.rows)),
        "environment": [(k, v) for k, v in _flat(environment) if k in _ENVIRONMENT],
    }


_ENVIRONMENT = ("upbeam", "library", "python", "system", "cpu", "cores", "instruction sets")


def _row(one: Estimate) -> dict[str, Any]:
    margin = one.margin_ms
    return {
        "name": one.device.name,
        "way": one.implementation,
        "mode": one.mode.name if one.mode else "",
        "met": one.met,
        "margin": None if margin is None else margin.span("ms"),
        "latency": _cells(one.latency_ms, "ms"),
        "power": _cells(one.power_w, "W"),
        "energy": _cells(one.energy_mj, "mJ"),
        "added": None if one.increment_w is None else _cells(one.increment_w, "mW"),
        "memory": _memory(one.memory),
        "sensors": one.sensors,
        "boundary": one.power_w.boundary.split(",")[0],
        "error": one.errors.power,
        "error_of": one.errors.of,
        "dominates": one.dominates,
    }


def _cells(bounded: Bounded, unit: str) -> dict[str, Any]:
    figure = bounded.figure
    if not figure.known:
        return {"value": None, "low": None, "high": None, "kind": "none", "why": figure.source}
    value, low, high = figure.span(unit)
    return {"value": value, "low": low, "high": high, "kind": figure.kind, "why": figure.source}


def _memory(memory: Mapping[str, Any]) -> str:
    if "luts_of" in memory:
        luts = memory["luts"]
        interval = "" if luts["low"] == luts["high"] else f" ({luts['low']:.0f} to {luts['high']:.0f})"
        return (
            f"{memory['multipliers']} of {memory['multipliers_of']} multipliers; {luts['value']:.0f}{interval} "
            f"of {memory['luts_of']} LUTs, {luts['label']}; "
            f"{memory['ram_bits'] / 8:.0f} B of RAM. Fits: {memory['fits']}"
        )
    if "bytes" in memory:
        return f"{memory['bytes'] / 1e6:.1f} MB moved a frame"
    if "state" in memory:
        return f"{memory['tables'] + memory['state']} B: model {memory['tables']}, state {memory['state']}"
    return ""


_PRICED_ON = ("jetson-nano", "jetson-orin-nano")
"""Boards whose modelled latency stands beside accuracies."""


def _price(load: Load) -> list[float]:
    """Modelled computing of a frame on one core of each, ms."""
    boards = [device(name) for name in _PRICED_ON]
    return [cpu_column_time(board, load, board.mode()).frame(load.columns).get("ms") for board in boards]


def _with_cost(row: dict[str, Any], load: Load) -> dict[str, Any]:
    """A method with what its work would cost; those without a network are not modelled."""
    units = int(row["multiply_adds"]) // _MACS_OF_A_UNIT
    pairs = (2 * -(-units // 2), 0)
    return {**row, "ms": _price(replace(load, pairs=pairs)) if units else [None] * len(_PRICED_ON)}


_MACS_OF_A_UNIT = 8
"""Seven inputs and the output weight."""


def _quantised(metrics: Mapping[str, Any], load: Load) -> list[dict[str, Any]]:
    """Errors of the integer networks as the model file states them, beside what they cost."""
    rows = [{"precision": "fp32", "mean_mm": 0.0, "p99_mm": 0.0, "max_mm": 0.0, "intensity_mean": 0.0}]
    rows += [{"precision": p, **metrics[p]} for p in ("int16", "int8") if p in metrics]
    for row in rows:
        row["bytes"] = load.count.weight_bytes_folded(str(row["precision"]))
        row["macs"] = load.count.macs_kernel(str(row["precision"]))
        row["ms"] = _price(replace(load, precision=str(row["precision"])))
    return rows


def _figures_of(wanted: Any) -> list[tuple[str, str, str, str]]:
    """Device, figure, value and source, of figures of a kind; the same source and figure of several devices once."""
    found: dict[tuple[str, str, str], list[str]] = {}
    for name in device_names():
        board = device(name)
        for key, figure in board.every_figure():
            if key.startswith("modes.") and not key.startswith(f"modes.{board.default_mode}."):
                continue  # of the modes that no estimate of this page is in
            if wanted(figure.kind):
                low, high = figure.low, figure.high
                interval = "" if low == high else f" ({low:g} to {high:g})"
                by = "" if figure.kind == "assumption" else f" [{figure.kind}]"
                text = f"{figure.value:g}{interval} {figure.unit}"
                found.setdefault((key, text, figure.source + by), []).append(name)
    return [(", ".join(names), key, value, source) for (key, value, source), names in found.items()]


def _of_activity() -> list[tuple[str, str, str, str]]:
    """What turns toggles of the FPGA core into energy, as ``_figures_of``."""
    names = ", ".join(name for name in device_names() if core_volts(device(name)) is not None)
    return [
        (names, key, f"{value:g} ({low:g} to {high:g}) {unit}", why)
        for key, (value, low, high), unit, why in (
            ("capacitance of a net", NET_FF, "fF", "with its routing, 40 nm"),
            ("glitches", GLITCHES, "toggles for each of RTL", "RTL activity misses them"),
        )
    ]


def _data_sheets() -> list[tuple[str, str]]:
    """Each source, and whose figures are from it."""
    found: dict[str, list[str]] = {}
    for name in device_names():
        for _, figure in device(name).every_figure():
            if figure.kind == "data sheet" and name not in found.setdefault(figure.source, []):
                found[figure.source].append(name)
    return [(source, ", ".join(names)) for source, names in found.items()]


# --------------------------------------------------------------------------------------------------------- pictures


def _pictures(estimates: Sequence[Estimate], load: Load) -> dict[str, Picture]:
    return {
        "latency": Picture("Latency", plot_latency(estimates, load.deadline_ms)),
        "power": Picture("Power", plot_power(estimates)),
        "roofline": Picture("Roofline", plot_roofline(_roofs(), _ways(estimates, load))),
        "pareto": Picture("Accuracy beside work", plot_pareto(pareto_rows()[0])),
    }


def _roofs() -> list[Roof]:
    found = []
    for name in device_names():
        figures = device(name).figures
        if "gpu.peak" in figures:
            found.append(Roof(f"{name} GPU", figures["gpu.peak"].get("MAC/s"), figures["memory.bandwidth"].get("B/s")))
    return sorted(found, key=lambda roof: roof.peak_macs)


def _ways(estimates: Sequence[Estimate], load: Load) -> list[RooflinePoint]:
    """The graphs as they would be run unfused, and our stream, with what this machine reaches if it was measured."""
    traffic, count = load.count.traffic(), load.count
    frame = 2 * count.windows
    host = next((e for e in estimates if e.device.family == "host"), None)
    reached = None if host is None else load.macs / (host.latency_ms.figure.get("s"))
    outside = (32 + 64) * 3 * load.columns
    return [
        RooflinePoint("paper's graph, nothing fused", frame * count.macs_dense / sum(traffic["dense"].values()), None),
        RooflinePoint("folded, nothing fused", frame * count.macs_folded / sum(traffic["folded"].values()), None),
        RooflinePoint("our stream, to caches", load.macs / sum(traffic["kernel"].values()), None),
        RooflinePoint("our stream, to memory: one core of this machine", load.macs / outside, reached),
    ]
