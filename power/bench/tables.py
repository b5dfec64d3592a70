"""A benchmark as tables of text, for terminals and the report."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from .bench import Benchmark, ratios

__all__ = ["BenchTable", "short_name", "tables"]

_LONGEST = 42
_WORK = "ABCDEFGHIJKLMNOPQRSTUVWXYZ"


@dataclass(frozen=True)
class BenchTable:
    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[str]]
    note: str = ""


def tables(run: Benchmark) -> list[BenchTable]:
    """In reading order."""
    results = run.results()
    ours = [r for r in results if r["group"] == "ours"]
    return [
        _machine(run),
        _bounds(run),
        _kernels(run, ours),
        _arithmetic(ours),
        _everybody(run, sorted(results, key=lambda r: float(r["ms_median"]))),
        _ratios(run),
        _columns(run),
        _widths(run),
    ]


def short_name(name: str) -> str:
    """For tables and pictures; the JSON has names in full."""
    for long, short in (
        ("-march=native", "native"), ("-mprefer-vector-width=512", "512"), ("-ffast-math", "fast-math"),
        ("-funroll-loops", "unroll"), ("ONNX Runtime", "ORT"), ("fused element-wise code", "fused"),
        ("torch.compile, fused", "compiled"),
    ):  # fmt: skip
        name = name.replace(long, short)
    return name if len(name) <= _LONGEST else name[: _LONGEST - 3] + "..."


def _machine(run: Benchmark) -> BenchTable:
    peaks = run.peaks
    rows = [
        [f"{p.kind} {p.isa}", f"{p.macs_per_ns:.1f} G/s", f"{p.macs_per_ns / peaks.clock_ghz:.1f}"] for p in peaks.peaks
    ]
    rows += [[f"loads from {level}", f"{rate:.0f} GB/s", ""] for level, rate in peaks.load_gb_s.items()]
    rows += [["copy in memory, read and written", f"{peaks.copy_gb_s:.0f} GB/s", ""]]
    rows += [["clock", f"{peaks.clock_ghz:.2f} GHz", ""]]
    return BenchTable("This machine, one core", ["", "rate", "multiply-adds a cycle"], rows)


def _bounds(run: Benchmark) -> BenchTable:
    rows = []
    for b in run.peaks.bounds:
        counts = b.instructions_per_column
        memory = counts.get("load", 0.0) + counts.get("store", 0.0)
        rows.append(
            [
                f"{b.precision} {b.isa}",
                f"{b.ns_per_column:.1f}",
                f"{b.ns_per_column * run.work.columns / 1e6:.3f}",
                f"{sum(counts.values()) - memory:.0f}",
                f"{memory:.0f}",
                f"{100 * b.arithmetic_share:.0f} %",
            ]
        )
    columns = ["kernel", "ns/column", "ms/frame", "operations", "loads/stores", "MACs"]
    note = (
        "Port bound: the instructions that a kernel needs for a column, without their dependencies, timed as a loop "
        "(measured). MACs: the share of multiply-adds in the operations; the rest: rules, rectifier, packing."
    )
    return BenchTable("Port bounds", columns, rows, note)


def _kernels(run: Benchmark, results: Sequence[dict[str, Any]]) -> BenchTable:
    rows = [
        [
            _own_name(r), str(r["threads"]), _milliseconds(r["ms_min"]), _milliseconds(r["ms_median"]),
            f"{r['ns_per_column']:.1f}", _percent(r["share_of_bound"]),
        ]
        for r in results
    ]  # fmt: skip
    sensors = ", ".join(f"{precision} {count:.0f}" for precision, count in run.sensors().items())
    note = (
        "push: the whole step of a stream; frame: the whole-frame call. Of bound: the port bound over the least time.\n"
        f"One core carries so many 20 Hz sensors of {run.work.columns} columns (push, median): {sensors}."
    )
    columns = ["", "threads", "ms min", "median", "ns/column", "of bound"]
    return BenchTable(f"Our kernels, both images of a 32 x {run.work.columns} frame", columns, rows, note)


def _arithmetic(results: Sequence[dict[str, Any]]) -> BenchTable:
    rows = [
        [
            _own_name(r), f"{r['macs_per_cycle']:.1f}", _percent(r["share_of_peak"]),
            f"{r['macs_per_cycle_dense']:.1f}", _percent(r["share_of_peak_dense"]),
        ]
        for r in results
        if r["threads"] == 1 and r["kind"] == "kernels"
    ]  # fmt: skip
    note = (
        "Peak: of the multiply-add, for integers of the 16-bit dot product, in the same instruction set. Dense: as "
        "the graph was trained, before folding."
    )
    columns = ["", "MAC/cycle", "of peak", "dense MAC/cycle", "of peak"]
    return BenchTable("Our kernels: multiply-adds", columns, rows, note)


def _own_name(result: dict[str, Any]) -> str:
    return str(result["name"]).removeprefix("upbeam ")


def _milliseconds(ms: float) -> str:
    return f"{ms:.3f}" if ms < 10 else f"{ms:.1f}"


def _everybody(run: Benchmark, results: Sequence[dict[str, Any]]) -> BenchTable:
    texts = list(dict.fromkeys(str(r["does"]) for r in results))
    letters = dict(zip(texts, _WORK, strict=False))
    rows = [
        [
            short_name(str(r["name"])), str(r["threads"]), _milliseconds(r["ms_min"]), _milliseconds(r["ms_median"]),
            letters.get(str(r["does"]), "?"),
        ]
        for r in results
    ]  # fmt: skip
    note = "\n".join(f"{letter}: {text}" for text, letter in letters.items())
    title = f"All, both images of a 32 x {run.work.columns} frame, fastest first"
    return BenchTable(title, ["", "threads", "ms min", "median", "does"], rows, note)


def _ratios(run: Benchmark) -> BenchTable:
    medians, minima = ratios(run), ratios(run, lambda entry: entry.ms_min)
    rows = [[name.replace("_", " "), _number(medians[name]), _number(minima[name])] for name in medians]
    return BenchTable("How many times faster the first is, one thread", ["", "of medians", "of minima"], rows)


def _columns(run: Benchmark) -> BenchTable:
    rows = [
        [
            f"{x.precision} {x.cpu}, {'at 20 Hz' if x.paced else 'back to back'}",
            *(f"{ns}" for ns in (x.p50_ns, x.p99_ns, x.p999_ns, x.max_ns, x.columns)),
        ]
        for x in run.latency
    ]
    timer = min((x.timer_ns for x in run.latency), default=0)
    return BenchTable(
        "From pushing a column to its finished output, computing (ns)",
        ["", "p50", "p99", "p99.9", "max", "columns"], rows,
        f"Reading the clock costs {timer} ns of each. The maximum holds the machine's stalls.",
    )  # fmt: skip


def _widths(run: Benchmark) -> BenchTable:
    rows = [
        [
            f"{w.precision}, {w.columns} columns",
            f"{w.kernels_ns_per_column:.1f}",
            f"{w.push_ns_per_column:.1f}",
            f"{w.push_ns_per_column * w.columns / 1e6:.3f}",
        ]
        for w in run.widths
    ]
    return BenchTable("Cost against width", ["", "kernels ns/column", "push ns/column", "push ms/frame"], rows)


def _percent(share: float | None) -> str:
    return "" if share is None else f"{100 * share:.0f} %"


def _number(value: float | None) -> str:
    return "not measured" if value is None else f"{value:.2f}"
