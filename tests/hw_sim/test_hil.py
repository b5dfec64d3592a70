"""Scenarios on the bench: all of them on virtual time, some on ``upbeamd`` over loopback, and the bench itself."""

from __future__ import annotations

import json
import xml.etree.ElementTree as ET
from collections import Counter
from dataclasses import replace
from pathlib import Path

import can
import numpy as np
import pytest

from upbeam.hw_sim.faults import CATALOGUE, FAULTS
from upbeam.hw_sim.faults.catalogue import markdown
from upbeam.hw_sim.hil import (
    Record,
    Result,
    Scenario,
    ScenarioError,
    in_process,
    judge,
    load_scenario,
    load_scenarios,
    process,
    run_all,
    run_one,
    sabotage_all,
    uncovered,
    write_junit,
)
from upbeam.hw_sim.hil.dut import Output
from upbeam.hw_sim.hil.network_dut import HardwareDut, ProcessDut
from upbeam.hw_sim.hil.runner import hardware
from upbeam.hw_sim.hil.scenario import parse_scenario
from upbeam.hw_sim.hil.transcript import transcript_lines
from upbeam.runtime.daemon import check_names
from upbeam.runtime.packets import PacketReader

ROOT = Path(__file__).resolve().parents[2]
SCENARIOS = load_scenarios(ROOT / "tests" / "hil")
BY_NAME = {scenario.name: scenario for scenario in SCENARIOS}
REAL_TIME = [scenario for scenario in SCENARIOS if scenario.real_time]


def why(result: Result) -> str:
    """What failed, for the report."""
    failed = "\n".join(f"{check.name}: {check.text}" for check in result.verdict.failures)
    return f"{failed or result.record.not_possible}\n" + "\n".join(list(transcript_lines(result.record))[-60:])


@pytest.mark.parametrize("name", BY_NAME)
def test_scenario(name: str) -> None:
    result = run_one(BY_NAME[name])
    assert result.outcome == "passed", why(result)


def test_there_are_enough_scenarios() -> None:
    assert len(SCENARIOS) >= 40
    assert len(REAL_TIME) >= 5
    assert uncovered(SCENARIOS) == []


@pytest.mark.parametrize("check", check_names())
def test_a_scenario_notices_what_is_taken_out(check: str) -> None:
    """The shortest one; ``make soak`` has all of them."""
    covering = min((s for s in SCENARIOS if check in s.covers), key=lambda scenario: scenario.seconds)
    (found,) = sabotage_all([covering], only=[check])
    assert found.caught, f"{covering.name} passes without {check}"


def test_a_scenario_gives_the_same_run_again() -> None:
    scenario = BY_NAME["bad_network"]
    one, other = run_one(scenario).record, run_one(scenario).record
    assert list(transcript_lines(one)) == list(transcript_lines(other))
    assert one.outputs == other.outputs
    assert run_one(replace(scenario, seed=scenario.seed + 1)).record.outputs != one.outputs


# --------------------------------------------------------------------------------------------------- the catalogue


def test_every_fault_has_its_entry_and_the_document_is_up_to_date() -> None:
    assert set(CATALOGUE) == set(FAULTS)
    codes = {name.upper() for name in check_names()}
    for entry in CATALOGUE.values():
        assert {*filter(None, [entry.detects]), *entry.also} <= codes
    assert (ROOT / "docs" / "faults.md").read_text(encoding="utf-8") == markdown(), "upbeam hil faults --markdown"


def test_scenarios_ask_no_less_than_the_catalogue() -> None:
    """A scenario of one fault expects what the catalogue promises of it, and no later."""
    seen = Counter()
    for scenario in SCENARIOS:
        kinds = {fault.kind for fault in scenario.faults}
        if len(kinds) != 1 or scenario.actions:
            continue
        (kind,) = kinds
        entry = CATALOGUE[kind]
        expected = {fault.id: fault for fault in scenario.expect.faults}
        if entry.detects in expected:
            seen[kind] += 1
            assert expected[entry.detects].within_ms <= entry.within_ms, scenario.name
            if expected[entry.detects].heals_ms is not None:
                assert expected[entry.detects].heals_ms <= entry.healthy_ms, scenario.name
    missing = {kind for kind, entry in CATALOGUE.items() if entry.detects} - set(seen) - {"serial_noise"}
    assert not missing, "no scenario of this fault alone"


# -------------------------------------------------------------------------------------------------------- the judge


@pytest.fixture(scope="module")
def good() -> Result:
    """A run to tamper with."""
    return run_one(replace(BY_NAME["nominal_vlp32c"], seconds=0.5))


def with_outputs(result: Result, change) -> list[str]:
    """Names of checks that fail when outputs are changed."""
    outputs = [after for output in result.record.outputs for after in change(output)]
    record = Record(
        result.record.scenario, result.record.dut, True, delivered=result.record.delivered, boots=result.record.boots,
        outputs=outputs, heard=result.record.heard, serial=result.record.serial,
    )  # fmt: skip
    return [check.name for check in judge(result.scenario, record).failures]


def patched(output: Output, at: int, value: bytes) -> Output:
    payload = bytearray(output.payload)
    payload[at : at + len(value)] = value
    return output._replace(payload=bytes(payload))


def test_the_judge_passes_what_is_good(good: Result) -> None:
    assert with_outputs(good, lambda output: [output]) == []


@pytest.mark.parametrize(
    ("at", "what"),
    [(32 + 20, "measured rows verbatim"), (32 + 20 + 128, "measured rows verbatim"), (32 + 4, "measured rows verbatim"),
     (32 + 8, "measured rows verbatim"), (32 + 20 + 126, "measured rows verbatim"), (8, "datagrams in sequence")],
    ids=["distance", "intensity", "azimuth", "time", "row 63", "sequence"],
)  # fmt: skip
def test_the_judge_finds_one_wrong_byte(good: Result, at: int, what: str) -> None:
    seen = []

    def change(output: Output) -> list[Output]:
        if output.kind != "columns":
            return [output]
        seen.append(output)
        if len(seen) != 700:
            return [output]
        return [patched(output, at, bytes([output.payload[at] ^ 1]))]

    assert any(name.startswith(what) for name in with_outputs(good, change))


def test_the_judge_looks_at_what_drivers_see(good: Result) -> None:
    shown = [output for output in good.record.outputs if output.kind == "hdl64"]
    chosen = id(shown[50])
    names = with_outputs(good, lambda o: [patched(o, 4, bytes([o.payload[4] ^ 1])) if id(o) == chosen else o])
    assert names == ["HDL-64E packets = columns"]


def test_the_judge_misses_what_is_missing(good: Result) -> None:
    columns = [output for output in good.record.outputs if output.kind == "columns"]
    lost = set(map(id, columns[100:120]))
    failed = with_outputs(good, lambda output: [] if id(output) in lost else [output])
    assert {"columns counted = columns sent", "datagrams in sequence", "output goes on"} <= set(failed)
    records = [output for output in good.record.outputs if output.kind == "ledger"]
    gone = id(records[3])
    assert "ledger on CAN = ledger" in with_outputs(good, lambda o: [] if id(o) == gone else [o])


def test_the_judge_finds_two_stories(good: Result) -> None:
    def other_latency(output: Output) -> list[Output]:
        if output.kind != "ledger":
            return [output]
        return [output._replace(payload={**output.payload, "latency_ns": output.payload["latency_ns"] + 1})]

    assert {"ledger on CAN = ledger", "ledger on serial = ledger"} <= set(with_outputs(good, other_latency))
    mode = Output("event", 100_000_000, {"kind": "mode", "a": 0, "b": 2, "value": 0, "frame": 2})
    first = [True]

    def another_mode(output: Output) -> list[Output]:
        if first[0] and output.time_ns > mode.time_ns:
            first[0] = False
            return [mode, output]
        return [output]

    assert "mode on CAN = events" in with_outputs(good, another_mode)


# --------------------------------------------------------------------------------------------------- files, outcomes


def test_artefacts_of_a_failure(tmp_path: Path) -> None:
    hopeless = replace(BY_NAME["silence"], expect=replace(BY_NAME["silence"].expect, faults=(), allows=()))
    scenarios = [hopeless, replace(BY_NAME["last_return"], seconds=0.3)]
    results = list(run_all(scenarios, report=tmp_path))
    assert [result.outcome for result in results] == ["failed", "passed"]
    folder = tmp_path / "silence"
    assert not (tmp_path / "last_return").exists()
    text = (folder / "transcript.txt").read_text(encoding="utf-8")
    assert "fault_set SENSOR_TIMEOUT" in text
    assert "UPB_Status" in text
    record = results[0].record
    with can.LogReader(str(folder / "can.blf")) as log:
        messages = list(log)
    assert len(messages) == len(record.heard)
    assert messages[0].arbitration_id == record.heard[0].frame.identifier
    assert [d.payload for d in PacketReader(folder / "sensor.pcap")] == [d.payload for d in record.delivered]
    ledger = [json.loads(line) for line in (folder / "ledger.jsonl").read_text(encoding="utf-8").splitlines()]
    assert ledger == record.ledger
    assert json.loads((folder / "verdict.json").read_text(encoding="utf-8"))["passed"] is False
    write_junit(results, tmp_path / "junit.xml")
    suite = ET.parse(tmp_path / "junit.xml").getroot()
    assert (suite.get("tests"), suite.get("failures")) == ("2", "1")
    assert suite.find("testcase[@name='silence']/failure") is not None
    list(run_all([replace(BY_NAME["silence"], seconds=2.0)], report=tmp_path))
    assert not folder.exists(), "artefacts of an earlier run are in the way"


def test_a_device_that_cannot_is_not_run_and_says_so() -> None:
    result = run_one(BY_NAME["bit_flip_model"], process)
    assert result.outcome == "not run"
    assert "bit_flip" in result.record.not_possible


def test_a_crash_is_a_failure() -> None:
    def broken(scenario: Scenario, sabotage: str | None = None):
        raise RuntimeError("the bench is on fire")

    result = run_one(BY_NAME["last_return"], broken)
    assert result.outcome == "failed"
    assert "on fire" in result.verdict.failures[0].text


@pytest.mark.parametrize(
    ("text", "says"),
    [("seconds = 1.0", "title"), ("title = 'a'\nseconds = -1", "seconds"),
     ("title = 'a'\nseconds = 1\nspeed = 2", "speed"), ("title = 'a'\nseconds = 1\n[sensor]\nrate = 2", "rate"),
     ("title = 'a'\nseconds = 1\n[[fault]]\nkind = 'x'", "kind"),
     ("title = 'a'\nseconds = 1\n[[do]]\nat_s = 1\naction = 'x'", "action"),
     ("title = 'a'\nseconds = 1\n[[expect.fault]]\nid = 'NET_LOSS'\nwithin_ms = 1", "heals_ms or stays"),
     ("title = 'a'\nseconds = 1\n[[expect.reaction]]\ndoes = 'x'\nwithin_ms = 1", "does"),
     ("title = 'a'\nseconds = 1\n[expect]\nworst_mode = 'x'", "worst_mode"),
     ("title = 'a'\nseconds = 1\n[expect.counters]\na = 'x'", "counters"), ("title = ", "Invalid value")],
)  # fmt: skip
def test_a_wrong_scenario_is_named(tmp_path: Path, text: str, says: str) -> None:
    path = tmp_path / "wrong.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ScenarioError, match=says) as error:
        load_scenario(path)
    assert str(path) in str(error.value)


def test_scenarios_that_are_not_there(tmp_path: Path) -> None:
    with pytest.raises(ScenarioError, match="no scenario"):
        load_scenarios(tmp_path)
    with pytest.raises(ScenarioError, match="'nothing'"):
        load_scenarios(ROOT / "tests" / "hil", ["nothing"])


def test_expectations_are_counted_from_what_is_injected() -> None:
    scenario = parse_scenario(
        "x",
        {
            "title": "x",
            "seconds": 2,
            "fault": [
                {"kind": "loss", "from_s": 0.5, "until_s": 0.7},
                {"kind": "silence", "from_s": 0.4, "until_s": 0.6},
            ],
            "expect": {"fault": [{"id": "NET_LOSS", "within_ms": 1, "heals_ms": 2}]},
        },
    )
    (expected,) = scenario.expect.faults
    assert (expected.after_s, expected.until_s) == (0.4, 0.7)
    assert scenario.covers == ("net_loss",)


# ------------------------------------------------------------------------------------------------------- real time


@pytest.mark.parametrize("name", [scenario.name for scenario in REAL_TIME])
def test_upbeamd_over_loopback(name: str, record_property) -> None:
    """Counts, contents and which faults are found are asserted; times are reported."""
    result = run_one(BY_NAME[name], process)
    for timing in result.verdict.timings:
        record_property(timing.what, timing.ms)
    assert result.outcome == "passed", why(result)


def test_a_device_on_real_wires(tmp_path: Path) -> None:
    """A stand-in: upbeamd in the place of a board, known by CAN and serial alone."""
    scenario = replace(BY_NAME["silence"], seconds=2.2)
    board = ProcessDut({"sensor": scenario.sensor.model})
    try:
        board.power_on(0)
        told = tmp_path / "board.toml"
        told.write_text(
            f"[sensor]\naddress = '127.0.0.1'\ndata_port = {board.data_address[1]}\n"
            f"position_port = {board.position_address[1]}\n",
            encoding="utf-8",
        )
        device = hardware(told)(scenario)
        assert isinstance(device, HardwareDut)
        device.can_bus, board.can_bus = board.can_bus, None  # the board's bus, heard by the bench
        device._columns, board._columns = board._columns, device._columns
        result = run_one(scenario, lambda *_: device)
    finally:
        board.close()
    assert result.outcome == "passed", why(result)
    assert {event.fault for event in result.record.events if event.kind == "fault_set"} >= {"SENSOR_TIMEOUT"}
    assert len(result.record.ledger) > 20
    assert np.count_nonzero(result.record.columns["column"] == 0) > 20


def test_a_wrong_device_file_is_named(tmp_path: Path) -> None:
    path = tmp_path / "board.toml"
    path.write_text("port = 3\n", encoding="utf-8")
    with pytest.raises(ValueError, match="unknown key port"):
        hardware(path)(BY_NAME["silence"])
    path.write_text("= 3\n", encoding="utf-8")
    with pytest.raises(ValueError, match=r"board\.toml"):
        hardware(path)


def test_in_process_is_the_default() -> None:
    assert run_one.__defaults__ is not None
    assert run_one.__defaults__[0] is in_process
