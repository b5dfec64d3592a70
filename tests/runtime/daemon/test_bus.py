"""The daemon on its buses: authenticated commands, bus faults, restarts. The bus itself has tests of its own."""

from __future__ import annotations

from typing import Any

import cantools.database
import pytest
from daemon_feed import MODELS, MS, Feed, finish, model_file, run

from upbeam.runtime.bus import command_bytes
from upbeam.runtime.daemon import MODES, VERDICTS, Daemon

KEY = bytes(range(1, 17))
STATUS, MODE, MODEL, CLEAR = 1, 2, 3, 4
FD = 1
COMMAND_ID = 0x300


def daemon_for(settings: dict[str, Any] | None = None, **kwargs: Any) -> Daemon:
    return Daemon(model_file(), {"service_ns": [100_000] * 4, "any_model": 1, **(settings or {})}, key=KEY, **kwargs)


def command(code: int, freshness: int, argument: int = 0, crc32: int = 0, key: bytes = KEY) -> bytes:
    return command_bytes(key, code, freshness, argument, crc32)


def test_a_command_holds_a_mode_and_its_replay_changes_nothing() -> None:
    packets = Feed().make(3)
    daemon = daemon_for()
    now = run(daemon, packets[:200])
    hold = command(MODE, 1, MODES.index("repeat"))
    daemon.can(COMMAND_ID, hold, now, FD)
    assert daemon.mode == "repeat"
    assert daemon.counters["commands_accepted"] == 1
    daemon.can(COMMAND_ID, command(MODE, 2, 255), now, FD)
    assert daemon.mode == "network"
    for attack in (hold, command(MODE, 3, 3, key=bytes(16)), hold[:-1] + b"\0", hold[:10]):
        daemon.can(COMMAND_ID, attack, now, FD)
    assert daemon.mode == "network"
    assert daemon.counters["commands_accepted"] == 2
    assert daemon.counters["commands_rejected"] >= 3
    assert "CAN_COMMAND_REJECTED" in daemon.status["faults_ever"]
    finish(daemon, run(daemon, packets[200:]))
    assert daemon.counters["columns_out"] == 12 * len(packets)


def test_a_command_changes_the_model_at_a_frame_boundary() -> None:
    packets = Feed().make(3)
    other = (MODELS / "hdl-64e.ubm").read_bytes()
    crc = int.from_bytes(other[-4:], "little")
    daemon = daemon_for(models=[other])
    now = run(daemon, packets[:100])
    daemon.can(COMMAND_ID, command(MODEL, 1, crc32=crc ^ 1), now, FD)
    daemon.can(COMMAND_ID, command(MODEL, 2, crc32=crc), now, FD)
    finish(daemon, run(daemon, packets[100:]))
    assert daemon.status["model_crc32"] == crc
    assert daemon.counters["models_swapped"] == 1


def test_freshness_and_faults_survive_a_restart() -> None:
    packets = Feed().make(1)
    daemon = daemon_for()
    now = run(daemon, packets)
    daemon.can(COMMAND_ID, command(MODE, 7, 1), now, FD)
    stored = daemon.stored()  # no end: the power failed
    again = daemon_for(stored=stored)
    assert "POWER_RESET" in again.status["faults_ever"]
    again.can(COMMAND_ID, command(MODE, 7, 3), 0, FD)
    assert again.mode == "network", "a replay from before the reset"
    again.can(COMMAND_ID, command(MODE, 8, 3), 0, FD)
    assert again.mode == "pass_through"
    again.end(0)
    assert "POWER_RESET" not in daemon_for(stored=again.stored()).status["faults_ever"]


@pytest.mark.parametrize("sabotage", [[], ["can_bus_off"]])
def test_a_dead_bus_does_not_disturb_the_sensor(sabotage: list[str]) -> None:
    packets = Feed().make(4)
    daemon = daemon_for(sabotage=sabotage)
    run(daemon, packets[:100])
    daemon.set_links(can=False)
    run(daemon, packets[100:400])
    assert ("CAN_BUS_OFF" in daemon.faults) == (not sabotage)
    daemon.set_links()
    finish(daemon, run(daemon, packets[400:]))
    assert daemon.faults == []
    assert daemon.counters["columns_out"] == 12 * len(packets)


def test_can_tells_what_the_ledger_and_the_counters_tell() -> None:
    """Decoded by cantools with the project's own DBC."""
    database = cantools.database.load_file(MODELS.parents[1] / "hw_sim" / "can" / "upbeam.dbc")
    packets = Feed().make(6)
    daemon = daemon_for()
    run(daemon, packets)
    daemon.tick(packets[-1].time_ns + 5 * MS)
    out = daemon.take()
    names = {
        "Frame": "frame",
        "FirstInput": "first_input_ns",
        "LastInput": "last_input_ns",
        "Output": "output_ns",
        "LatencyNs": "latency_ns",
        "MissingColumns": "missing_columns",
    }
    on_can = [database.decode_message(f.id, f.data, decode_choices=False) for f in out.can if f.id == 0x220]
    assert [[record[name] for name in names] for record in on_can] == [
        [record[name] for name in names.values()] for record in out.ledger
    ]
    assert [MODES[record["Mode"]] for record in on_can] == [record["mode"] for record in out.ledger]
    assert [VERDICTS[record["Verdict"]] for record in on_can] == [record["verdict"] for record in out.ledger]
    assert {f.id for f in out.can} >= {0x210, 0x211, 0x212, 0x213, 0x215}


def forged(daemon: Daemon, now: int) -> None:
    daemon.can(COMMAND_ID, command(MODE, 1, 3, key=bytes(16)), now, FD)


def garbled(daemon: Daemon, now: int) -> None:
    for i in range(20):
        daemon.serial(b"\x07no record of ours\x00", now + i)


def cut_off(daemon: Daemon, now: int) -> None:
    daemon.set_links(can=False)


def nothing(daemon: Daemon, now: int) -> None:
    """The power failed before."""


OWN = {
    "CAN_BUS_OFF": cut_off,
    "CAN_COMMAND_REJECTED": forged,
    "SERIAL_FRAMING": garbled,
    "POWER_RESET": nothing,
}


@pytest.mark.parametrize("fault", OWN)
@pytest.mark.parametrize("sabotaged", [False, True])
def test_faults_that_the_bus_finds_can_be_taken_out(fault: str, sabotaged: bool) -> None:
    """Then nobody is told: no event, nothing on CAN or serial, nothing remembered."""
    database = cantools.database.load_file(MODELS.parents[1] / "hw_sim" / "can" / "upbeam.dbc")
    packets = Feed().make(4)
    before = daemon_for()
    run(before, packets[:50])
    restart = {"stored": before.stored()} if fault == "POWER_RESET" else {}
    daemon = daemon_for(sabotage=[fault.lower()] if sabotaged else [], **restart)
    now = run(daemon, packets[:100])
    OWN[fault](daemon, now)
    run(daemon, packets[100:600])
    daemon.set_links()
    out = finish(daemon, run(daemon, packets[600:]))
    sets = [e["fault"] for e in out.events if e["kind"] == "fault_set"]
    assert sets == ([] if sabotaged else [fault])
    assert (fault in daemon.status["faults_ever"]) == (not sabotaged)
    told = [database.decode_message(f.id, f.data, decode_choices=False) for f in out.can if f.id == 0x213]
    if fault != "CAN_BUS_OFF":  # while the bus is off, it tells nothing
        assert any(message[fault] for message in told) == (not sabotaged)
