"""The sweep over FPGA cores: routed where routed, fitted where fitted, and the sentence a user wants."""

from __future__ import annotations

import json
from itertools import pairwise

import pytest
import typer
from typer.testing import CliRunner

from upbeam import load_model
from upbeam.cli import fpga as cli
from upbeam.cli.estimate import estimate
from upbeam.hw_sim.fpga.baselines import baselines
from upbeam.power.fpga_pictures import plot_fpga_sweep
from upbeam.power.fpga_sweep import FITTED, PARTS, ROUTED, sweep
from upbeam.quant.export.source import Source

MACS = 2 * 96 * 31 * 2048


@pytest.fixture(scope="module")
def source():
    model = load_model()
    return Source.of(model.data, model.name)


@pytest.fixture(scope="module")
def found(source):
    return sweep(source, "int8", baselines(), MACS)


def test_routed_cores_are_themselves(found):
    for report in baselines().values():
        if report["model"] != "hdl-64e" or report["precision"] != "int8" or "clock_mhz" not in report:
            continue
        (point,) = [
            p for p in found.points if (p.part, p.fold, p.lanes) == (report["part"], report["fold"], report["lanes"])
        ]
        assert point.luts_label == point.clock_label == ROUTED
        assert point.luts == report["utilisation"]["luts"]["used"]
        assert point.clock_mhz[0] == report["clock_mhz"]["median"]
        assert point.margin == pytest.approx(report["margin"], abs=0.01)
        assert point.multipliers == report["utilisation"]["multipliers"]["used"]


def test_others_are_fitted_and_say_so(found):
    fitted = [p for p in found.points if p.luts_label == FITTED]
    assert fitted
    assert found.fit_error < 0.25
    assert all(p.part.startswith("ecp5") and p.fold > 1 for p in fitted)
    assert all(p.clock_mhz[1] <= p.clock_mhz[0] <= p.clock_mhz[2] for p in found.points)
    assert all(p.energy_mj[1] <= p.energy_mj[0] <= p.energy_mj[2] for p in found.points)


def test_the_front_is_one(found):
    front = found.front
    assert front
    for part in PARTS:
        line = sorted((p for p in front if p.part == part), key=lambda p: p.luts)
        assert all(a.frames_per_second < b.frames_per_second for a, b in pairwise(line))
    for p in found.points:
        better = [q for q in front if q.part == p.part and q.luts <= p.luts]
        assert any(q.frames_per_second >= p.frames_per_second for q in better)


def test_the_sentence(found, source):
    assert found.smallest.part == "ice40up5k"
    assert "iCE40" in found.sentence()
    assert "20 Hz x 2048 columns with both networks" in found.sentence()
    fast = sweep(source, "int8", baselines(), MACS, rate_hz=100.0)
    assert fast.smallest.part.startswith("ecp5")
    never = sweep(source, "int8", baselines(), MACS, rate_hz=1e6)
    assert never.smallest is None
    assert "No listed part" in never.sentence()


def test_too_few_routed_cores_are_refused(source):
    with pytest.raises(ValueError, match=r"in int16: 1 routed ECP5 cores: expected 4 or more"):
        sweep(source, "int16", baselines(), MACS)


def test_the_picture(found):
    assert plot_fpga_sweep(found)[:8] == b"\x89PNG\r\n\x1a\n"


@pytest.fixture
def run():
    app = typer.Typer()
    app.command("estimate")(estimate)
    return lambda *arguments: CliRunner().invoke(app, [str(a) for a in arguments])


def test_command_line(run, tmp_path):
    result = run("--fpga-sweep", "--json", "--report", tmp_path)
    assert result.exit_code == 0, result.output
    summary = json.loads(result.stdout)
    assert summary["smallest"]["part"] == "ice40up5k"
    assert any(p["pareto"] for p in summary["points"])
    assert (tmp_path / "fpga_sweep.png").stat().st_size > 10_000
    text = run("--fpga-sweep")
    assert text.exit_code == 0, text.output
    assert "FOLD" in text.stdout
    assert "not in fp32" in str(run("--fpga-sweep", "--precision", "fp32").exception)
    assert "expected 4 or more" in str(run("--fpga-sweep", "--precision", "int16").exception)


def test_synthesise_hands_its_options_down(run, monkeypatch, tmp_path):
    report = next(iter(baselines().values()))
    asked = {}

    def flow(source, precision, part, folder, **more):
        asked.update(precision=precision, part=part, folder=folder, **more)
        return report

    monkeypatch.setattr(cli, "run_flow", flow)
    monkeypatch.setenv("UPBEAM_RTL_CACHE", str(tmp_path / "rtl"))
    result = run("--device", "ecp5-25", "--synthesise", "--fold", 24, "--seeds", 2, "--json")
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout)["clock_mhz"] == report["clock_mhz"]
    assert (asked["part"], asked["fold"], asked["seeds"]) == ("ecp5-25", 24, (1, 2))
    assert asked["folder"].parent == tmp_path / "fpga"
    assert "clock, median" in run("--device", "xc7z020", "--synthesise").stdout
    assert asked["part"] == "xc7"
    assert "has no open tools" in str(run("--device", "zu3eg", "--synthesise").exception)
