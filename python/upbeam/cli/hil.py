"""``upbeam hil``: scenarios of hardware in the loop, on the simulated bench or on real hardware."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from .common import JsonOption, UserError, emit_json, message, show, table

if TYPE_CHECKING:  # the bench needs the extra "hil": loaded when a command runs
    from upbeam.hw_sim.hil import Result, Sabotaged, Scenario
    from upbeam.hw_sim.hil.runner import MakeDut

__all__ = ["app"]

app = typer.Typer(help="Scenarios of hardware in the loop: run them, list them.", no_args_is_help=True)

FolderOption = Annotated[Path, typer.Option("--scenarios", help="Folder of scenarios (*.toml).")]
NameOption = Annotated[list[str] | None, typer.Option("--scenario", help="Only this one; may be given again.")]
DEFAULT_FOLDER = Path("tests/hil")


@app.command("list")
def list_scenarios(folder: FolderOption = DEFAULT_FOLDER, as_json: JsonOption = False) -> None:
    """The scenarios of a folder, and what each covers."""
    scenarios = _load(folder, None)
    if as_json:
        emit_json({"scenarios": [_described(scenario) for scenario in scenarios]})
        return
    rows = [[s.name, s.title, f"{s.seconds:g} s", ", ".join(s.covers)] for s in scenarios]
    show(table(f"{len(rows)} scenarios in {folder}", ["scenario", "title", "length", "covers"], rows))


@app.command("faults")
def list_faults(
    markdown: Annotated[bool, typer.Option("--markdown", help="As docs/faults.md.")] = False,
    as_json: JsonOption = False,
) -> None:
    """The catalogue of faults: what each must lead to, and within what time."""
    from upbeam.hw_sim.faults import CATALOGUE, FAULTS
    from upbeam.hw_sim.faults.catalogue import markdown as write

    if markdown:
        typer.echo(write(), nl=False)
    elif as_json:
        emit_json({"faults": {kind: {"group": FAULTS[kind].group, **vars(e)} for kind, e in CATALOGUE.items()}})
    else:
        rows = [
            [kind, FAULTS[kind].group, entry.detects or "none", _limit(entry.within_ms), _limit(entry.healthy_ms)]
            for kind, entry in CATALOGUE.items()
        ]
        show(table(f"{len(rows)} faults", ["fault", "of", "code", "within ms", "healthy ms"], rows))


def _limit(value: float | None) -> str:
    return "" if value is None else f"{value:g}"


@app.command("run")
def run(
    names: NameOption = None,
    folder: FolderOption = DEFAULT_FOLDER,
    dut: Annotated[
        str, typer.Option(help="inprocess (virtual time), process (upbeamd over loopback), or a FILE.toml of hardware.")
    ] = "inprocess",
    sabotage: Annotated[
        bool, typer.Option("--sabotage", help="Take each detection and reaction out in turn: scenarios must fail.")
    ] = False,
    junit: Annotated[Path | None, typer.Option(help="Write results as JUnit XML.")] = None,
    report: Annotated[Path, typer.Option(help="Artefacts of scenarios that fail go here.")] = Path("build/hil"),
    keep: Annotated[bool, typer.Option("--keep", help="Keep artefacts of all scenarios.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Run scenarios and judge them. Exit status 1 where one fails, or a sabotage is not noticed."""
    scenarios = _load(folder, names)
    from upbeam.hw_sim.hil import run_all, write_junit

    make_dut, virtual = _device(dut)
    if not virtual:
        scenarios = [scenario for scenario in scenarios if scenario.real_time or names]
    results = []
    for result in run_all(scenarios, make_dut, report=report, keep_all=keep):
        results.append(result)
        if result.outcome != "passed":
            _tell(result)
    if junit is not None:
        write_junit(results, junit)
    caught = _sabotage(scenarios, make_dut, names, as_json) if sabotage else []
    if as_json:
        emit_json(_summary(results, caught, dut, sabotage))
    else:
        _print(results, caught, dut, sabotage)
    failed = any(result.outcome == "failed" for result in results) or not all(one.caught for one in caught)
    if failed:
        raise typer.Exit(1)


@contextmanager
def _needs_extra() -> Iterator[None]:
    """Around imports of the bench."""
    try:
        yield
    except ModuleNotFoundError as error:
        raise UserError(f"{error.name} is not installed: pip install 'upbeam[hil]'") from None


def _load(folder: Path, names: list[str] | None) -> list[Scenario]:
    with _needs_extra():
        from upbeam.hw_sim.hil import load_scenarios
    return load_scenarios(folder, names or ())


def _device(dut: str) -> tuple[MakeDut, bool]:
    """How to make a device, and whether it lives on virtual time."""
    from upbeam.hw_sim.hil import hardware, in_process, process

    if dut == "inprocess":
        return in_process, True
    if dut == "process":
        return process, False
    if dut.endswith(".toml"):
        return hardware(Path(dut)), False
    raise UserError(f"--dut {dut}: expected inprocess, process or a .toml file")


def _sabotage(scenarios: list[Scenario], make_dut: MakeDut, names: list[str] | None, quiet: bool) -> list[Sabotaged]:
    """With chosen scenarios, only what these cover is taken out."""
    from upbeam.hw_sim.hil import sabotage_all

    only = {name for scenario in scenarios for name in scenario.covers} if names else set()
    found = []
    for one in sabotage_all(scenarios, make_dut, only=sorted(only)):
        found.append(one)
        if not one.caught:
            message(f"not noticed: {one.check} taken out, {one.scenario or 'no scenario covers it'}")
    return found


def _tell(result: Result) -> None:
    if result.outcome == "not run":
        message(f"{result.scenario.name}: not run, {result.record.not_possible}")
        return
    message(f"{result.scenario.name}: failed")
    for check in result.verdict.failures:
        message(f"    {check.name}: {check.text}")
    if result.artefacts is not None:
        message(f"    see {result.artefacts}")


def _print(results: list[Result], caught: list[Sabotaged], dut: str, sabotage: bool) -> None:
    """Lines of fixed columns: a table would cut names short where the terminal is narrow."""
    clock = "virtual time" if dut == "inprocess" else "real time, measured"
    typer.echo(f"{dut}, {clock}; milliseconds from the cause's begin, and from its end until healed")
    typer.echo(_line("scenario", "", "what", "after", "limit", "on CAN", "healed"))
    for result in results:
        name, outcome = result.scenario.name, result.outcome
        if not result.verdict.timings:
            typer.echo(_line(name, outcome))
        for timing in result.verdict.timings:
            figures = (timing.ms, timing.limit_ms, timing.reported_ms, timing.healed_ms)
            typer.echo(_line(name, outcome, timing.what, *("" if v is None else f"{v:.2f}" for v in figures)))
            name = outcome = ""
    typer.echo(f"{_count(results, 'passed')} of {len(results)} scenarios passed")
    if sabotage:
        typer.echo(f"sabotage: {sum(one.caught for one in caught)} of {len(caught)} noticed")


def _line(name: str, outcome: str, what: str = "", *figures: str) -> str:
    return f"{name:<28} {outcome:<8} {what:<24}{''.join(f'{figure:>10}' for figure in figures)}".rstrip()


def _count(results: list[Result], outcome: str) -> int:
    return sum(result.outcome == outcome for result in results)


def _described(scenario: Scenario) -> dict[str, Any]:
    return {
        "name": scenario.name, "title": scenario.title, "seconds": scenario.seconds, "covers": list(scenario.covers),
        "real_time": scenario.real_time,
    }  # fmt: skip


def _lateness(result: Result) -> dict[str, float] | None:
    """On the real clock: how late the bench itself was, measured."""
    late = sorted(result.record.lateness_ns)
    if not late:
        return None
    return {
        name: late[min(len(late) - 1, int(len(late) * share))] / 1e3
        for name, share in (("p50", 0.5), ("p99", 0.99), ("max", 1.0))
    }


def _summary(results: list[Result], caught: list[Sabotaged], dut: str, sabotage: bool) -> dict[str, Any]:
    summary: dict[str, Any] = {
        "dut": dut,
        "passed": _count(results, "passed"),
        "failed": _count(results, "failed"),
        "not_run": _count(results, "not run"),
        "scenarios": [_result(result) for result in results],
    }
    if sabotage:
        summary["sabotaged"] = len(caught)
        summary["caught"] = sum(one.caught for one in caught)
        summary["sabotage"] = [vars(one) for one in caught]
    return summary


def _result(result: Result) -> dict[str, Any]:
    return {
        "name": result.scenario.name,
        "title": result.scenario.title,
        "outcome": result.outcome,
        "why": result.record.not_possible,
        "checks": [vars(check) for check in result.verdict.checks],
        "timings": [vars(timing) for timing in result.verdict.timings],
        "seconds": round(result.record.seconds, 3),
        "bench_lateness_us": _lateness(result),
        "artefacts": str(result.artefacts) if result.artefacts else None,
    }
