"""Runs scenarios on a device, with every detection and reaction in place, or with one taken out at a time."""

from __future__ import annotations

import shutil
import traceback
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from upbeam.model.toml_file import read_toml
from upbeam.runtime.daemon import check_names

from .bench import run_scenario
from .dut import Dut, InProcessDut, NotPossibleError
from .judge import Check, Verdict, judge
from .network_dut import HardwareDut, ProcessDut
from .record import Record
from .scenario import Scenario
from .transcript import write_artefacts

__all__ = [
    "Result", "Sabotaged", "hardware", "in_process", "process", "run_all", "run_one", "sabotage_all", "uncovered",
    "write_junit",
]  # fmt: skip

MakeDut = Callable[[Scenario, "str | None"], Dut]
"""A fresh device for a scenario, without the named detection or reaction."""


@dataclass
class Result:
    """One scenario on one device."""

    scenario: Scenario
    record: Record
    verdict: Verdict
    artefacts: Path | None = None

    @property
    def outcome(self) -> str:
        """passed, failed or not run."""
        if self.record.not_possible:
            return "not run"
        return "passed" if self.verdict.passed else "failed"


@dataclass(frozen=True)
class Sabotaged:
    """One detection or reaction taken out, and a scenario that covers it."""

    check: str
    scenario: str
    """Empty: no scenario covers it."""
    caught: bool
    by: str = ""
    """The first check that failed."""


def in_process(scenario: Scenario, sabotage: str | None = None) -> Dut:
    """The daemon's core in this process, on virtual time."""
    return InProcessDut({"sensor": scenario.sensor.model, **scenario.dut}, sabotage)


def process(scenario: Scenario, sabotage: str | None = None) -> Dut:
    """``upbeamd`` over loopback, on the real clock."""
    return ProcessDut({"sensor": scenario.sensor.model, **scenario.dut}, sabotage)


def hardware(path: Path) -> MakeDut:
    """The device that a TOML file describes. Errors: OSError, ValueError."""
    told = read_toml(path)

    def make(scenario: Scenario, sabotage: str | None = None) -> Dut:
        if sabotage is not None:
            raise NotPossibleError(f"{path.stem}: a real device cannot be sabotaged from here")
        return HardwareDut(path, told)

    return make


def run_one(scenario: Scenario, make_dut: MakeDut = in_process, sabotage: str | None = None) -> Result:
    """Runs and judges. A crash of bench or device is a failed check, with its trace."""
    try:
        record = _run(scenario, make_dut, sabotage)
        verdict = Verdict(scenario.name) if record.not_possible else judge(scenario, record)
    except Exception:
        record = Record(scenario.name, "?", True)
        verdict = Verdict(scenario.name, [Check("runs to its end", False, traceback.format_exc())])
    return Result(scenario, record, verdict)


def _run(scenario: Scenario, make_dut: MakeDut, sabotage: str | None) -> Record:
    try:
        return run_scenario(scenario, make_dut(scenario, sabotage))  # which closes the device
    except NotPossibleError as error:
        record = Record(scenario.name, "none", True)
        record.not_possible = str(error)
        return record


def run_all(
    scenarios: Iterable[Scenario],
    make_dut: MakeDut = in_process,
    *,
    report: Path | None = None,
    keep_all: bool = False,
) -> Iterator[Result]:
    """One after the other. ``report``: artefacts of those that failed (``keep_all``: of all) go into its folders."""
    for scenario in scenarios:
        result = run_one(scenario, make_dut)
        if report is not None:
            _keep(result, report / scenario.name, keep_all)
        yield result


def _keep(result: Result, folder: Path, keep_all: bool) -> None:
    """Leaves nothing of an earlier run in place that does not belong to this one."""
    if folder.is_dir():
        shutil.rmtree(folder)
    if result.record.boots and (keep_all or result.outcome == "failed"):
        write_artefacts(result.record, result.verdict, folder)
        result.artefacts = folder


def uncovered(scenarios: Sequence[Scenario]) -> list[str]:
    """Detections and reactions of the device that no scenario covers."""
    covered = {name for scenario in scenarios for name in scenario.covers}
    return [name for name in check_names() if name not in covered]


def sabotage_all(
    scenarios: Sequence[Scenario], make_dut: MakeDut = in_process, *, only: Iterable[str] = ()
) -> Iterator[Sabotaged]:
    """Takes each detection and reaction out in turn: every scenario that covers it must then fail.

    A scenario that crashes has failed; one that the device cannot run has not, and is left out. ``only``: these checks.
    """
    wanted = list(only) or list(check_names())
    for name in wanted:
        covering = [scenario for scenario in scenarios if name in scenario.covers]
        if not covering:
            yield Sabotaged(name, "", False)
        for scenario in covering:
            result = run_one(scenario, make_dut, name)
            if result.outcome != "not run":
                by = result.verdict.failures[0].name if result.verdict.failures else ""
                yield Sabotaged(name, scenario.name, result.outcome == "failed", by)


def write_junit(results: Sequence[Result], path: Path) -> None:
    """Results as JUnit XML: a test case each, its figures as properties, what failed as text."""
    failed = sum(result.outcome == "failed" for result in results)
    skipped = sum(result.outcome == "not run" for result in results)
    suite = ET.Element(
        "testsuite", name="upbeam hil", tests=str(len(results)), failures=str(failed), skipped=str(skipped), errors="0",
        time=f"{sum(result.record.seconds for result in results):.3f}",
    )  # fmt: skip
    for result in results:
        case = ET.SubElement(
            suite, "testcase", classname=f"hil.{result.record.dut}", name=result.scenario.name,
            time=f"{result.record.seconds:.3f}",
        )  # fmt: skip
        _figures(case, result)
        if result.outcome == "failed":
            text = "\n".join(f"{check.name}: {check.text}" for check in result.verdict.failures)
            ET.SubElement(case, "failure", message=result.verdict.failures[0].name).text = text
        elif result.outcome == "not run":
            ET.SubElement(case, "skipped", message=result.record.not_possible)
    path.parent.mkdir(parents=True, exist_ok=True)
    ET.indent(suite)
    ET.ElementTree(suite).write(path, encoding="utf-8", xml_declaration=True)


def _figures(case: ET.Element, result: Result) -> None:
    if not result.verdict.timings:
        return
    properties = ET.SubElement(case, "properties")
    for timing in result.verdict.timings:
        for name, value in (("ms", timing.ms), ("reported_ms", timing.reported_ms), ("healed_ms", timing.healed_ms)):
            if value is not None:
                ET.SubElement(properties, "property", name=f"{timing.what} {name}", value=f"{value:.3f}")
