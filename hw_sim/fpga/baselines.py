"""Resources and clocks of the shipped models' cores, kept in the repository; ``make fpga`` renews them (half an hour).

python -m upbeam.hw_sim.fpga.baselines FOLDER [NAME ...]    renews
python -m upbeam.hw_sim.fpga.baselines --table              the table of docs/fpga.md
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from importlib import resources
from pathlib import Path
from typing import Any

from upbeam.quant.export.source import Source
from upbeam.quant.integer import Precision

from .flow import run_flow

__all__ = ["BUILDS", "QUICK", "Build", "baselines", "build", "markdown_table", "renew"]

FILE = "baselines.json"
_LEFT_OUT = ("step", "key", "seconds")
ONE, MANY = (1,), (1, 2, 3, 4, 5)


@dataclass(frozen=True)
class Build:
    model: str
    precision: Precision
    part: str
    fold: int
    lanes: int = 1
    seeds: tuple[int, ...] = MANY

    @property
    def name(self) -> str:
        lanes = f"-l{self.lanes}" if self.lanes > 1 else ""
        return f"{self.model}-{self.precision}-{self.part}-f{self.fold}{lanes}"


QUICK = Build("hdl-64e-6", "int8", "ecp5-12", 48, seeds=ONE)
"""The smallest core: what a continuous integration has time for."""

BUILDS = (
    QUICK,
    Build("hdl-64e", "int8", "ecp5-25", 12, seeds=MANY),
    Build("hdl-64e", "int8", "ice40up5k", 24, seeds=MANY),
    Build("hdl-64e", "int8", "ecp5-12", 12, seeds=ONE),
    Build("hdl-64e", "int8", "ecp5-85", 12, seeds=ONE),
    Build("hdl-64e", "int16", "ecp5-25", 12, seeds=ONE),
    Build("hdl-64e", "int8", "ecp5-25", 24, lanes=2, seeds=ONE),
    Build("hdl-64e", "int8", "ecp5-25", 1, seeds=ONE),
    Build("hdl-64e", "int8", "ecp5-25", 24, seeds=ONE),
    Build("hdl-64e", "int8", "ecp5-25", 48, seeds=ONE),
    Build("hdl-64e", "int8", "ecp5-25", 96, seeds=ONE),
    Build("hdl-64e", "int8", "xc7", 12),
    Build("hdl-64e", "int16", "xc7", 12),
)


def baselines() -> dict[str, dict[str, Any]]:
    """Reports of ``run_flow`` by build name, as they were when last renewed; each has its date and tool versions."""
    text = resources.files("upbeam.hw_sim").joinpath("fpga").joinpath(FILE).read_text(encoding="utf-8")
    found: dict[str, dict[str, Any]] = json.loads(text)
    return found


def build(one: Build, folder: Path, on_step: Callable[[str, bool], None] = lambda name, kept: None) -> dict[str, Any]:
    """The flow of one build in a folder of its own. Raises as ``run_flow``."""
    data = resources.files("upbeam.quant").joinpath("models").joinpath(f"{one.model}.ubm").read_bytes()
    source = Source.of(data, one.model)
    return run_flow(
        source, one.precision, one.part, folder / one.name, fold=one.fold, lanes=one.lanes, seeds=one.seeds,
        on_step=on_step,
    )  # fmt: skip


def renew(builds: Sequence[Build], folder: Path, file: Path, say: Callable[[str], None] = print) -> None:
    """Runs the builds and writes them to ``file`` beside what is there; each as soon as it is done."""
    for one in builds:
        report = build(one, folder, partial(_say_step, say, one.name))
        found = json.loads(file.read_text(encoding="utf-8")) if file.is_file() else {}
        found[one.name] = {key: value for key, value in report.items() if key not in _LEFT_OUT}
        order = {other.name: place for place, other in enumerate(BUILDS)}
        kept: Mapping[str, Any] = dict(sorted(found.items(), key=lambda item: order.get(item[0], len(order))))
        file.write_text(json.dumps(kept, indent=1) + "\n", encoding="utf-8")


def markdown_table(reports: Mapping[str, Mapping[str, Any]]) -> str:
    """As docs/fpga.md has it."""
    head = "| core | part | LUTs | FFs | multipliers | clock, MHz | margin |"
    return "\n".join([head, "| --- " * 7 + "|", *(_table_row(report) for report in reports.values())])


def _table_row(r: Mapping[str, Any]) -> str:
    lanes = f", LANES {r['lanes']}" if r["lanes"] > 1 else ""
    used = r.get("utilisation", {})
    counts = []
    for name in ("luts", "ffs", "multipliers"):
        if name in used:
            share = 100 * used[name]["used"] / used[name]["available"]
            counts.append(f"{used[name]['used']:,} ({share:.0f} %)")
        else:
            counts.append(f"{r['resources'][name]:,}")
    clock, margin = r["label"], "-"
    if "clock_mhz" in r:
        c = r["clock_mhz"]
        spread = f"{c['least']:.1f} to {c['most']:.1f}, {c['seeds']} seeds" if c["seeds"] > 1 else "1 seed"
        clock, margin = f"{c['median']:.1f} ({spread})", f"{r['margin']:.1f}"
    cells = [f"{r['model']}, {r['precision']}, FOLD {r['fold']}{lanes}", r["part"], *counts, clock, margin]
    return f"| {' | '.join(cells)} |"


def _say_step(say: Callable[[str], None], name: str, step: str, kept: bool) -> None:
    say(f"{name}: {step}{' (kept)' if kept else ''}")


def _main(arguments: Sequence[str]) -> None:
    if list(arguments) == ["--table"]:
        print(markdown_table(baselines()))
        return
    folder, names = Path(arguments[0]), arguments[1:]
    chosen = [one for one in BUILDS if not names or one.name in names]
    renew(chosen, folder, Path(__file__).with_name(FILE))


if __name__ == "__main__":
    _main(sys.argv[1:])
