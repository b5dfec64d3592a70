"""One benchmark run: the machine's peaks, our kernels, compilers, peers; results, ratios, and what was left out."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

import numpy as np

from upbeam.model.rules import extract_windows
from upbeam.power.ops import count_model
from upbeam.quant.integer import Precision
from upbeam.quant.quantize import Calibration, quantize
from upbeam.quant.ubm import ModelFile
from upbeam.runtime.upsampler import Model

from .contest import Candidate, Entry, alternate
from .machine import Peaks, measure_peaks, unit_pairs
from .ours import ColumnLatency, Width, column_latency, fastest_cpu, kernel_candidates, usable_cpus, widths
from .peers import PEERS, PeerPool, missing_peers
from .plain import build_all, plain_candidate
from .work import Work

__all__ = ["Benchmark", "Settings", "benchmark", "make_work", "ratios"]

PRECISIONS = ("fp32", "int16", "int8")
RATE_HZ = 20.0
_CALIBRATION = 4000
"""Windows to quantise a model with that has no integer networks: enough for its speed to be that of a careful one."""


@dataclass(frozen=True)
class Settings:
    """What is measured, and how long."""

    threads: tuple[int, ...] = (1, 2)
    peers: tuple[str, ...] = tuple(PEERS)
    columns: tuple[int, ...] = (512, 1024, 2048, 4096, 8192)
    quick: bool = False
    compilers: bool = True
    """compare with plain C by the machine's compilers"""

    def __post_init__(self) -> None:
        unknown = [name for name in self.peers if name not in PEERS]
        if unknown:
            raise ValueError(f"no peer {unknown[0]!r}, known: {', '.join(PEERS)}")
        if not self.threads or min(self.threads) < 1 or max(self.threads) > 16 or 1 not in self.threads:
            raise ValueError(f"threads {self.threads}: expected 1, and others up to 16")
        if min(self.columns, default=8) < 8 or max(self.columns, default=8) > 65535:
            raise ValueError(f"columns {self.columns}: expected 8 to 65535")

    @property
    def rounds(self) -> int:
        return 3 if self.quick else 40

    @property
    def repeats(self) -> int:
        """Of a loop that measures the machine."""
        return 3 if self.quick else 25

    @property
    def pushes(self) -> int:
        """Columns whose latency is taken."""
        return 4_000 if self.quick else 200_000


@dataclass
class Benchmark:
    """All figures are measured in this run, but operation counts."""

    work: Work
    cpu: str
    """our fastest instruction set"""
    settings: Settings
    peaks: Peaks
    entries: list[Entry] = field(default_factory=list)
    latency: list[ColumnLatency] = field(default_factory=list)
    widths: list[Width] = field(default_factory=list)
    missing: dict[str, str] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    sweeps: list[dict[str, Any]] = field(default_factory=list)

    def results(self) -> list[dict[str, Any]]:
        return [self._result(entry) for entry in self.entries]

    def as_dict(self) -> dict[str, Any]:
        """Fit for JSON."""
        return {
            "columns": self.work.columns,
            "cpu": self.cpu,
            "quick": self.settings.quick,
            "unit": "ms for both images of one frame",
            "machine": self.peaks.as_dict(),
            "results": self.results(),
            "ratios": ratios(self),
            "ratios_of_minima": ratios(self, lambda entry: entry.ms_min),
            "sensors_per_core": self.sensors(),
            "column_latency": [x.as_dict() for x in self.latency],
            "widths": [vars(x) for x in self.widths],
            "missing": self.missing,
            "sweeps": self.sweeps,
            "notes": self.notes,
        }

    def sensors(self) -> dict[str, float]:
        """20 Hz sensors of this width that one core carries: the whole streaming step, median."""
        return {
            e.candidate.precision: 1000.0 / (RATE_HZ * e.ms_median)
            for e in self.entries
            if e.candidate.detail.get("kind") == "push" and e.candidate.detail["cpu"] == self.cpu
        }

    def _result(self, entry: Entry) -> dict[str, Any]:
        c = entry.candidate
        executed, dense = self._macs(c.precision)
        per_ns = executed / (entry.ms_min * 1e6)
        peak = self.peaks.peak(c.precision, c.detail.get("cpu", self.cpu))
        peak = None if peak is None else peak * c.threads
        return {
            "name": c.name,
            "group": c.group,
            "precision": c.precision,
            "threads": c.threads,
            "does": c.does,
            "ms_min": entry.ms_min,
            "ms_median": entry.ms_median,
            "repetitions": len(entry.ns),
            "ns_per_column": entry.ms_min * 1e6 / self.work.columns,
            "macs_per_cycle": per_ns / self.peaks.clock_ghz,
            "macs_per_cycle_dense": per_ns * dense / executed / self.peaks.clock_ghz,
            "share_of_peak": None if peak is None else per_ns / peak,
            "share_of_peak_dense": None if peak is None else per_ns * dense / executed / peak,
            "share_of_bound": self._share_of_bound(entry),
            **{k: v for k, v in c.detail.items() if k not in ("precision",)},
        }

    def _macs(self, precision: str) -> tuple[int, int]:
        """Of both images: executed, and of the graph as trained."""
        count = count_model(self.work.file, self.work.columns).as_dict()
        executed = sum(net.multiply_adds for net in self.work.file.folded) * self.work.windows_per_image
        return executed, int(count["macs_per_frame_dense"])

    def _share_of_bound(self, entry: Entry) -> float | None:
        c = entry.candidate
        bound = self.peaks.bound(c.precision, c.detail.get("cpu", ""))
        if bound is None or c.threads != 1 or c.detail.get("kind") != "kernels":
            return None
        return bound.ns_per_column * self.work.columns / (entry.ms_min * 1e6)


def make_work(file: ModelFile, frame: tuple[Any, Any]) -> tuple[Work, list[str]]:
    """The frame ``[32, W]`` with a model that has all precisions: those it lacks are quantised now, for their speed
    alone. The second value says so."""
    missing = [cast(Precision, p) for p in PRECISIONS[1:] if p not in file.precisions]
    notes = []
    if missing:
        windows = extract_windows(*frame, file.rules)
        chosen = [x[windows.any_return][:_CALIBRATION].astype(np.int64) for x in (windows.distance, windows.intensity)]
        file = quantize(file, Calibration(*chosen), missing, rounding="nearest")
        notes.append(f"{', '.join(missing)}: not in the model file, quantised for this run; the speed is the same")
    return Work(file.to_bytes(), *frame), notes


def benchmark(
    file: ModelFile,
    frame: tuple[Any, Any],
    settings: Settings,
    advance: Callable[[str], None] = lambda what: None,
) -> Benchmark:
    """Runs everything on one frame, counts and intensities ``[32, W]``. ``advance`` hears what comes next."""
    work, notes = make_work(file, frame)
    model = Model(work.ubm)
    advance("the machine")
    peaks = measure_peaks(unit_pairs(work.file.folded), repeats=settings.repeats)
    run = Benchmark(work, fastest_cpu(model), settings, peaks, notes=notes)
    run.missing = missing_peers(settings.peers)
    with tempfile.TemporaryDirectory() as folder, PeerPool(work, quick=settings.quick) as pool:
        candidates = _our_candidates(run, model)
        if settings.compilers:
            advance("compilers")
            candidates += _plain_candidates(run, Path(folder))
        for name in [x for x in settings.peers if x not in run.missing]:
            for threads in settings.threads:
                advance(f"{PEERS[name].title}, {threads} thread{'s' * (threads > 1)}")
                candidates += pool.candidates(name, threads)
        advance("alternating")
        run.entries, refused = alternate(candidates, settings.rounds)
        run.notes += pool.notes + refused
        run.sweeps = pool.sweeps
    advance("columns")
    _single_columns(run)
    return run


def _our_candidates(run: Benchmark, model: Model) -> list[Candidate]:
    made = []
    for precision in PRECISIONS:
        for cpu in usable_cpus(model):
            threads = run.settings.threads if cpu == run.cpu else (1,)
            made += kernel_candidates(run.work, precision, cpu, threads)
    return made


def _plain_candidates(run: Benchmark, folder: Path) -> list[Candidate]:
    """The fastest build of each compiler for each precision, by a short trial."""
    nets = run.work.file.folded
    if nets[0].hidden != nets[1].hidden:
        run.notes.append("plain C: not compared, the two networks differ in size")
        return []
    built, notes = build_all(nets[0].hidden, folder, quick=run.settings.quick)
    run.notes += notes
    made = []
    for precision in PRECISIONS:
        entries, refused = alternate([plain_candidate(b, run.work, precision) for b in built], 2)
        run.notes += refused
        run.sweeps += [{"name": e.candidate.name, "threads": 1, "trial_ms": e.ms_min} for e in entries]
        for compiler in dict.fromkeys(e.candidate.detail["compiler"] for e in entries):
            own = [e for e in entries if e.candidate.detail["compiler"] == compiler]
            made.append(min(own, key=lambda e: e.ms_min).candidate)
    return made


def _single_columns(run: Benchmark) -> None:
    for precision in PRECISIONS:
        for paced in (False, True):
            pushes = run.settings.pushes // (4 if paced else 1)
            run.latency.append(column_latency(run.work, precision, run.cpu, pushes=pushes, paced=paced))
        run.widths += widths(run.work, precision, run.cpu, run.settings.columns, run.settings.rounds)


# ----------------------------------------------------------------------------------------------------------- ratios


def ratios(run: Benchmark, time_of: Callable[[Entry], float] = lambda entry: entry.ms_median) -> dict[str, Any]:
    """How many times faster the first is, one thread, both images; None where one of the two was not measured.

    Of medians, but ``share_of_bound``: the bound is a least time, and is compared with one."""

    def best(chosen: Callable[[Candidate], bool]) -> float | None:
        return min((time_of(e) for e in run.entries if e.candidate.threads == 1 and chosen(e.candidate)), default=None)

    def kernel(precision: str, kind: str = "kernels") -> float | None:
        return best(
            lambda c: (
                (c.group, c.precision, c.detail.get("kind"), c.detail.get("cpu")) == ("ours", precision, kind, run.cpu)
            )
        )

    def plain(precision: str, compiler: str) -> float | None:
        return best(lambda c: (c.group, c.precision, c.detail.get("compiler")) == ("compiler", precision, compiler))

    runtimes = {name for name, info in PEERS.items() if info.is_runtime}
    fp32 = kernel("fp32")
    found: dict[str, float | None] = {
        "fp32_vs_best_runtime": _times(fp32, best(lambda c: c.group in runtimes)),
        "fp32_vs_best_uncompiled_runtime": _times(
            fp32, best(lambda c: c.group in runtimes and not c.detail.get("compiled"))
        ),
        "fp32_vs_best_runtime_all_rules": _times(
            fp32, best(lambda c: c.group in runtimes and c.detail["family"] == "image")
        ),
        "fp32_vs_paper_graph": _times(
            fp32, best(lambda c: c.group in runtimes and c.detail["family"].startswith("paper"))
        ),
        "fp32_vs_jax": _times(fp32, best(lambda c: c.group == "jax")),
    }
    for precision in PRECISIONS:
        for compiler in ("gcc", "clang"):
            found[f"{precision}_vs_{compiler}"] = _times(kernel(precision), plain(precision, compiler))
        found[f"{precision}_kernels_vs_push"] = _times(kernel(precision), kernel(precision, "push"))
    for precision in PRECISIONS[1:]:
        found[f"{precision}_vs_fp32"] = _times(kernel(precision), fp32)
    for part, key in (("kernel", "opencl_vs_fp32"), ("whole call", "opencl_call_vs_fp32")):
        device = best(
            lambda c, part=part: c.group == "opencl" and c.precision == "fp32" and c.detail["part"] == part  # type: ignore[misc]
        )
        found[key] = _times(device, fp32)
    for precision in PRECISIONS:
        found["share_of_bound" + ("" if precision == "fp32" else f"_{precision}")] = _bound_share(run, precision)
    return found


def _times(first: float | None, second: float | None) -> float | None:
    """How many times faster the first is."""
    return None if first is None or second is None else second / first


def _bound_share(run: Benchmark, precision: str) -> float | None:
    shares: Sequence[Mapping[str, Any]] = [
        r for r in run.results() if r["precision"] == precision and r.get("cpu") == run.cpu and r["share_of_bound"]
    ]
    return shares[0]["share_of_bound"] if shares else None
