"""``upbeam estimate --synthesise`` and ``--fpga-sweep``: the FPGA core built with open tools, or chosen."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from upbeam.hw_sim.fpga.activities import activities
from upbeam.hw_sim.fpga.baselines import baselines
from upbeam.hw_sim.fpga.flow import PARTS, run_flow
from upbeam.hw_sim.fpga.simulators import cache_folder
from upbeam.power.fpga_built import BuiltCores
from upbeam.power.fpga_sweep import ROUTED, Point, Sweep, sweep
from upbeam.power.ops import count_model
from upbeam.quant.export.source import Source
from upbeam.quant.integer import CONTRACTS, Precision
from upbeam.runtime.upsampler import Model

from .common import UserError, emit_json, message, show, table

__all__ = ["built_cores", "show_sweep", "synthesise"]


def built_cores(model: Model) -> BuiltCores:
    """What this package's baselines know of a model's cores."""
    return BuiltCores.of(model.crc32, baselines(), activities())


def synthesise(
    model: Model, device: str, precision: str, fold: int | None, lanes: int, seeds: int, as_json: bool
) -> None:
    """Runs the flow for a device of the catalogue; what was done before is kept in the user's cache."""
    part = "xc7" if device.startswith("xc7") else device
    if part not in PARTS:
        raise UserError(f"--synthesise: {device} has no open tools here, expected {', '.join(PARTS)}")
    source = Source.of(model.data, model.name)
    folder = cache_folder().parent / "fpga" / f"{source.crc32:08x}-{precision}-{part}-f{fold or 'default'}-l{lanes}"
    report = run_flow(
        source, _integer(precision), part, folder, fold=fold, lanes=lanes, seeds=tuple(range(1, seeds + 1)),
        on_step=lambda step, kept: message(f"{step}{' (kept)' if kept else ' ...'}"),
    )  # fmt: skip
    if as_json:
        emit_json({**report, "folder": str(folder)})
        return
    _show_report(report, folder)


def _show_report(report: dict[str, Any], folder: Path) -> None:
    rows = [[name, str(count)] for name, count in report["resources"].items()]
    for name, entry in report.get("utilisation", {}).items():
        share = 100 * entry["used"] / entry["available"]
        rows.append([f"{name}, placed", f"{entry['used']} of {entry['available']} ({share:.1f} %)"])
    if "clock_mhz" in report:
        clock = report["clock_mhz"]
        spread = f"{clock['least']:.1f} to {clock['most']:.1f} over {clock['seeds']} seeds"
        rows.append(["clock, median", f"{clock['median']:.1f} MHz ({spread})"])
        rows.append(["columns a second", f"{report['columns_per_second']}"])
        rows.append(["margin", f"{report['margin']} x what {report['needed_for']} need"])
    title = (
        f"{report['title']}: {report['precision']}, FOLD {report['fold']}, LANES {report['lanes']}: {report['label']}"
    )
    show(table(title, ["what", "figure"], rows))
    message(f"{', '.join(report['tools'].values())}; artefacts: {folder}")


def show_sweep(model: Model, precision: str, rate_hz: float, report: Path | None, as_json: bool) -> None:
    """Every LANES and FOLD on every part with open tools."""
    source = Source.of(model.data, model.name)
    count = count_model(model.file, model.columns)
    try:
        macs = 2 * count.macs_folded * count.windows
        found = sweep(source, _integer(precision), baselines(), macs, rate_hz, activities())
    except ValueError as error:
        raise UserError(f"--fpga-sweep: {error}; shipped baselines are of hdl-64e in int8") from None
    if report is not None:
        from upbeam.power.fpga_pictures import plot_fpga_sweep

        report.mkdir(parents=True, exist_ok=True)
        (report / "fpga_sweep.png").write_bytes(plot_fpga_sweep(found))
    if as_json:
        emit_json(_as_dict(found))
        return
    rows = [_row(p) for p in found.front]
    head = ["part", "FOLD", "LANES", "mult.", "LUTs", "", "MHz", "frames/s", "margin", "mJ a turn", "range"]
    show(table("Cores that no other of their part beats in LUTs and frames", head, rows))
    message(
        f"Clocks: simulated. LUTs and clock: routed, or fitted to routed cores (largest error of a core left out: "
        f"{100 * found.fit_error:.0f} %). Energy: modelled, of switching activity where it was simulated, of "
        "multiply-accumulates elsewhere; chip at rest (assumed) included."
    )
    message(found.sentence())


def _row(p: Point) -> list[str]:
    central, low, high = p.energy_mj
    middle = p.clock_mhz[0]
    return [
        p.part,
        str(p.fold),
        str(p.lanes),
        str(p.multipliers),
        str(p.luts),
        "routed" if p.luts_label == ROUTED else "fitted",
        f"{middle:.0f}",
        f"{p.frames_per_second:.0f}",
        f"{p.margin:.1f}",
        f"{central:.1f}",
        f"{low:.1f}-{high:.1f}",
    ]


def _as_dict(found: Sweep) -> dict[str, Any]:
    front = found.front
    return {
        "rate_hz": found.rate_hz,
        "columns": found.columns,
        "fit_error": found.fit_error,
        "points": [{**p.as_dict(), "pareto": p in front} for p in found.points],
        "smallest": None if found.smallest is None else found.smallest.as_dict(),
        "sentence": found.sentence(),
    }


def _integer(precision: str) -> Precision:
    if precision not in CONTRACTS:
        raise UserError(f"the FPGA core computes in {' and '.join(CONTRACTS)}, not in {precision}")
    return precision
