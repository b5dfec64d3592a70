"""``upbeam estimate`` and ``upbeam stream --target``: what others rely on, and what is refused."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

from upbeam.cli.common import binary_bytes
from upbeam.cli.main import run
from upbeam.hw_sim.fpga.baselines import baselines

KEYS = {"value", "low", "high", "kind", "boundary", "source"}


@pytest.fixture
def upbeam(capsys, monkeypatch):
    """The console script in this process: its standard output, or where a status is expected its standard error."""

    def call(*arguments, status=0):
        monkeypatch.setattr(sys, "argv", ["upbeam", *map(str, arguments)])
        with pytest.raises(SystemExit) as ended:
            run()
        printed = capsys.readouterr()
        assert (ended.value.code or 0) == status, printed.err
        return printed.err if status else printed.out

    return call


@pytest.fixture
def as_json(upbeam):
    return lambda *arguments: json.loads(upbeam(*arguments, "--json"))


def test_a_measured_workload(as_json):
    """CNV-W1A1 on the Pynq-Z2, as MLPerf Tiny measured it: 2,521 uJ."""
    found = as_json("estimate", "--device", "xc7z020", "--macs", "59.46e6", "--latency-ms", 1.512)
    for key in ("latency_ms", "power_w", "energy_mj"):
        assert set(found[key]) >= KEYS
    assert found["energy_mj"]["value"] == pytest.approx(2.521, rel=0.05)
    assert found["energy_mj"]["low"] <= 2.521 <= found["energy_mj"]["high"]
    assert found["leave_one_out"]["power"] < 1.15


def test_our_load_in_words_and_as_json(upbeam, as_json):
    found = as_json("estimate", "--device", "jetson-nano", "--precision", "int16")
    assert found["met"] == "yes"
    assert found["power_w"]["kind"] == "assumption"
    assert len(found["model_crc32"]) == 8
    text = upbeam("estimate", "--device", "jetson-nano", "--on", "gpu", "--mode", "5w")
    assert "mode 5w, gpu" in text
    assert "What dominates" in text


def test_an_fpga_core_as_routed(upbeam, as_json):
    """LUTs and clock of the baselines, energy of switching activity; the chip at rest stays an assumption."""
    found = as_json("estimate", "--device", "ecp5-25")
    routed = baselines()["hdl-64e-int8-ecp5-25-f12"]
    luts = found["memory"]["luts"]
    assert (luts["value"], luts["kind"], luts["label"]) == (
        routed["utilisation"]["luts"]["used"], "simulated", "routed (nextpnr)"
    )  # fmt: skip
    assert found["latency_ms"]["kind"] == "simulated"
    assert found["increment_mj"]["kind"] == "modelled"
    assert "no glitches" in found["increment_w"]["source"]
    assert found["power_w"]["kind"] == "assumption"
    assert any("misses glitches" in note for note in found["notes"])
    assert as_json("estimate", "--device", "ecp5-85", "--fold", 24)["memory"]["luts"]["label"] == "fitted"
    other = as_json("estimate", "--device", "ecp5-25", "--precision", "int16", "--fold", 8)
    assert other["memory"]["luts"]["label"] == other["increment_w"]["kind"] == "assumption"
    assert "in int16, LANES 1, FOLD 8" in other["workload"]


def test_memory_has_units(upbeam):
    text = " ".join(upbeam("estimate", "--device", "jetson-nano").split())
    assert "weights 368 B, tables 2.94 KiB" in text
    assert "memory of the device 4 GiB." in text
    text = " ".join(upbeam("estimate", "--device", "ice40up5k").split())
    assert "8704 of 1171456 bits of RAM" in text
    assert "routed (nextpnr" in text


@pytest.mark.parametrize(
    ("count", "text"), [(0, "0 B"), (1023, "1023 B"), (1024, "1 KiB"), (3 << 20, "3 MiB"), (4.0 * 2**30, "4 GiB")]
)
def test_bytes_in_binary_prefixes(count, text):
    assert binary_bytes(count) == text


def test_a_users_device(tmp_path, upbeam, as_json):
    shipped = Path(__file__).parents[2] / "power" / "devices" / "ecp5-25.toml"
    mine = tmp_path / "mine.toml"
    mine.write_text(shipped.read_text().replace('name = "ecp5-25"', 'name = "my-board"'))
    assert as_json("estimate", "--device", mine)["device"] == "my-board"
    mine.write_text(shipped.read_text().replace('unit = "MHz"', 'unit = "kg"'))
    message = upbeam("estimate", "--device", mine, status=2)
    assert "mine.toml:" in message
    assert "unit 'kg': expected one of Hz, MHz, GHz" in message


def test_calibration_shows_before_and_after(tmp_path, as_json):
    log = tmp_path / "tegrastats.log"
    log.write_text("\n".join(["RAM 1/2MB POM_5V_IN 2100/2000 POM_5V_CPU 500/400"] * 30))
    rows = tmp_path / "rows.toml"
    found = as_json("estimate", "--device", "jetson-nano", "--calibrate", log, "--save", rows)
    assert found["after"]["power_w"]["value"] == pytest.approx(2.1, rel=1e-3)
    assert found["before"]["power_w"]["value"] < 2.0
    again = as_json("estimate", "--device", "jetson-nano", "--rows", rows)
    assert again["power_w"]["value"] == pytest.approx(2.1, rel=1e-3)
    assert again["power_w"]["kind"] == "modelled"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "give --device NAME, or --all"),
        (["--device", "jetson"], "no device 'jetson', known: ecp5-12"),
        (["--device", "ecp5-25", "--macs", "-3"], "--macs -3: expected a number above 0"),
        (["--device", "ecp5-25", "--latency-ms", "3"], "--latency-ms goes with --macs"),
        (["--device", "ecp5-25", "--measure", "20"], "--measure goes with --device host"),
        (["--device", "ecp5-25", "--report", "x"], "--report goes with --all"),
        (["--device", "ecp5-25", "--lanes", "40"], "LANES 40 does not divide FOLD 1"),
        (["--device", "jetson-nano", "--calibrate", "/nowhere.log"], "/nowhere.log: No such file"),
        (["--device", "jetson-nano", "--rate", "0"], "--rate 0"),
    ],
)
def test_refused_in_one_line(arguments, message, upbeam):
    printed = upbeam("estimate", *arguments, status=2)
    assert message in " ".join(printed.split())
    assert len(printed.strip().splitlines()) == 1


def test_a_deployment_is_repeatable_and_names_its_target(as_json):
    command = ("stream", "--clock", "virtual", "--target", "jetson-nano", "--frames", 6, "--seed", 4)
    first, second = as_json(*command), as_json(*command)
    assert first == second
    target = first["target"]
    assert target["device"] == "jetson-nano"
    assert target["margin_ms"] == pytest.approx(50 - first["latency_ms"]["max"])
    assert target["sensors"]["low"] >= 1
    assert first["kind"] == "modelled"


def test_targets_need_the_virtual_clock(upbeam):
    message = upbeam("stream", "--target", "jetson-nano", "--frames", 2, status=2)
    assert "--target goes with --clock virtual" in message


def test_operations_of_any_model(as_json):
    found = as_json("ops")
    assert found["macs_per_frame_dense"] == 39_616_512
    assert found["memory"]["state_int8"] == 1792
    assert {x["key"] for x in found["paper"]} >= {"macs_per_frame_dense", "total_bytes"}


def test_operations_of_any_widths(upbeam, as_json):
    assert as_json("ops", "--widths", "8,2,12")["macs_per_window_dense"] == 312
    assert as_json("ops", "--widths", "4,1,6", "--columns", 100)["macs_per_window_executed"] == 48
    assert "three whole numbers" in upbeam("ops", "--widths", "8,2", status=2)
    assert "instead of --model" in upbeam("ops", "--widths", "8,2,12", "--model", "hdl-64e", status=2)
    assert "must all be at least 1" in upbeam("ops", "--widths", "8,0,12", status=2)
