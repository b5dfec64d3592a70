"""LUTs, clocks and activity of built cores: as routed where routed, fitted with its error, else nothing."""

from __future__ import annotations

import dataclasses

import pytest

from upbeam import load_model
from upbeam.hw_sim.fpga.activities import MEASURED, activities
from upbeam.hw_sim.fpga.baselines import baselines
from upbeam.power.catalogue import device
from upbeam.power.cycles.fpga import FpgaCore
from upbeam.power.cycles.host import pairs_of
from upbeam.power.deploy import target_service
from upbeam.power.estimate import Knowledge, Load, default_core, estimate_load
from upbeam.power.fpga_activity import core_volts, toggles_of_a_turn
from upbeam.power.fpga_built import BuiltCores
from upbeam.power.ops import count_model

KNOWN = Knowledge.of()
ROUTED = [r for r in baselines().values() if r["model"] == "hdl-64e" and "clock_mhz" in r]


@pytest.fixture(scope="module")
def model():
    return load_model()


@pytest.fixture(scope="module")
def built(model):
    return BuiltCores.of(model.crc32, baselines(), activities())


@pytest.fixture(scope="module")
def load(model):
    return Load(count_model(model.file, model.columns), pairs_of(model.file))


@pytest.mark.parametrize("report", ROUTED, ids=lambda r: f"{r['precision']}-{r['part']}-f{r['fold']}-l{r['lanes']}")
def test_routed_cores_are_themselves(report, built):
    core = FpgaCore(report["lanes"], report["fold"], precision=report["precision"])
    luts, clock = built.luts(report["part"], core), built.clock(report["part"], core)
    assert luts.span("1") == (report["utilisation"]["luts"]["used"],) * 3
    assert clock.get("MHz") == report["clock_mhz"]["median"]
    assert luts.kind == clock.kind == "simulated"
    assert clock.low < clock.value < clock.high  # of one seed, too: the spread of others
    assert ("1 seed," in clock.source) == (report["clock_mhz"]["seeds"] == 1)


def test_a_core_left_out_is_within_the_stated_error(built):
    """Fitted without it, each routed core lies in the interval of the fit of all."""
    for report in (r for r in ROUTED if r["part"].startswith("ecp5") and r["fold"] > 1):
        without = dataclasses.replace(built, routed=tuple(r for r in built.routed if r != report))
        core = FpgaCore(report["lanes"], report["fold"], precision=report["precision"])
        fitted = without.luts(report["part"], core)
        if fitted is None:  # the largest of all, several lanes that share multipliers, the only one of its precision
            continue
        assert fitted.kind == "modelled"
        error = abs(fitted.value / report["utilisation"]["luts"]["used"] - 1)
        stated = built.luts("ecp5-85", FpgaCore(1, 24))
        assert stated.kind == "modelled"
        assert error <= stated.high / stated.value - 1 + 1e-3  # LUTs are whole


def test_what_is_not_known_is_none(built):
    assert built.luts("ecp5-25", FpgaCore(1, 2)) is None  # more multipliers than any routed core
    assert built.luts("ice40up5k", FpgaCore(1, 48)) is None
    assert built.luts("ecp5-25", FpgaCore(1, 24, precision="int16")) is None
    assert built.clock("xc7z020", FpgaCore(1, 12)) is None
    assert built.activity(FpgaCore(3, 12)) is None
    assert BuiltCores.of(0, baselines(), activities()) == BuiltCores()


def test_default_cores_are_known_ones(built, load):
    for part in ("ecp5-12", "ecp5-25", "ecp5-85", "ice40up5k"):
        core = default_core(device(part), load, built)
        assert built.luts(part, core) is not None
        assert built.activity(core) is not None


def test_activities_are_whole():
    found = activities()
    assert list(found) == [one.name for one in MEASURED]
    for name, one in found.items():
        assert 0 < one["idle_toggles_per_clock"] < one["toggles"] / one["clocks"], name
        core = FpgaCore(one["lanes"], one["fold"], 6 if one["model"] == "hdl-64e-6" else 12, one["precision"])
        assert one["clocks"] == pytest.approx(core.frame_cycles(one["columns"]), rel=0.02), name
        assert one["frame"].startswith("KITTI")


def test_toggles_of_a_turn():
    one = {"columns": 100, "clocks": 1000, "toggles": 50_000, "idle_toggles_per_clock": 20.0}
    assert toggles_of_a_turn(one, 100, 1e6, 1e-3) == (50_000, 50_000)
    assert toggles_of_a_turn(one, 100, 1e6, 3e-3) == (50_000 + 20 * 2000, 50_000)
    assert toggles_of_a_turn(one, 200, 1e6, 3e-3) == (100_000 + 20 * 1000, 100_000)
    assert toggles_of_a_turn(one, 100, 1e6, 0.5e-3) == (25_000, 25_000)  # too slow: works all the time


def test_dynamic_power_of_activity_where_the_process_is_known(built, load):
    assert core_volts(device("ecp5-25")) == 1.1
    assert core_volts(device("ice40up5k")) == 1.2
    for name in ("xc7z020", "k26", "jetson-nano"):
        assert core_volts(device(name)) is None
    one = estimate_load(device("ecp5-25"), load, known=KNOWN, built=built)
    assert one.increment_w.figure.kind == "modelled"
    assert one.power_w.figure.kind == "assumption"
    assert "at rest (assumption)" in one.power_w.figure.source
    assert estimate_load(device("xc7z020"), load, known=KNOWN, built=built).increment_w.figure.kind == "assumption"


def test_more_turns_never_cost_less(built, load):
    watts = [
        estimate_load(device("ecp5-25"), dataclasses.replace(load, rate_hz=hz), known=KNOWN, built=built)
        .increment_w.figure.get("W")
        for hz in (1, 5, 20, 80, 200, 1000)
    ]  # fmt: skip
    assert watts == sorted(watts)
    assert watts[-1] == pytest.approx(watts[-2], rel=1e-6)  # the core is busy all the time


def test_a_deployment_takes_the_routed_clock(built, load):
    column = target_service(device("ecp5-25"), load, 12, built=built).column_us
    assert "clock, simulated: routed" in column.source
    assert column.get("us") == pytest.approx(32 * 12 / 128.42, rel=1e-3)
