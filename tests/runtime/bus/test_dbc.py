"""The DBC is the one home of messages, faults and counters: generated code and C headers agree with it."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from cantools.database.can import Database

from upbeam.runtime.bus import COUNTERS, DROP_CAUSES, FAULTS, Record, fault_dtc, fault_name, messages
from upbeam.runtime.bus.generate import FOLDER, files

MS = 1_000_000


def enum(headers: Path, header: str, prefix: str, name: str) -> dict[int, str]:
    """Values and names of a C enum."""
    text = (headers / header).read_text()
    body = re.search(rf"typedef enum {name} {{(.*?)}} {name};", text, re.DOTALL)
    assert body is not None
    return {int(value, 0): key for key, value in re.findall(rf"{prefix}(\w+) = (\w+)", body[1])}


def choices(db: Database, message: str, signal: str) -> dict[int, str]:
    found = db.get_message_by_name(message).get_signal_by_name(signal).choices
    assert found is not None
    return {number: str(name) for number, name in found.items()}


def test_generated_files_are_those_of_the_dbc() -> None:
    for name, text in files().items():
        assert (FOLDER / name).read_text() == text, f"{name}: run python -m upbeam.runtime.bus.generate"


@pytest.mark.parametrize(
    ("message", "signal", "header", "prefix", "name"),
    [
        ("UPB_FaultDetail", "Fault", "faults.h", "UPB_FAULT_", "upb_fault"),
        ("UPB_Faults", "LatestFault", "faults.h", "UPB_FAULT_", "upb_fault"),
        ("UPB_Status", "State", "bus.h", "UPB_STATE_", "upb_bus_state"),
        ("UPB_Response", "Result", "command.h", "UPB_COMMAND_", "upb_command_result"),
        ("UPB_Response", "Code", "command.h", "UPB_COMMAND_", "upb_command_code"),
        ("TST_Command", "Code", "command.h", "UPB_COMMAND_", "upb_command_code"),
        ("UPB_Status", "Verdict", "upbeam.h", "UPB_VERDICT_", "upb_verdict"),
        ("UPB_Model", "Precision", "upbeam.h", "UPB_PRECISION_", "upb_precision"),
        ("UPB_Model", "Cpu", "upbeam.h", "UPB_CPU_", "upb_cpu"),
    ],
)
def test_value_tables_are_the_c_enums(
    db: Database, headers: Path, message: str, signal: str, header: str, prefix: str, name: str
) -> None:
    assert choices(db, message, signal) == enum(headers, header, prefix, name)


def test_modes_of_the_library_are_in_the_value_tables(db: Database, headers: Path) -> None:
    modes = enum(headers, "upbeam.h", "UPB_MODE_", "upb_mode")
    for message in ("UPB_Status", "UPB_Ledger", "UPB_Response"):
        table = choices(db, message, "Mode")
        assert table == {0: "NETWORK", 1: "VALID_MEAN", 2: "REPEAT", 3: "PASS_THROUGH"}
        assert modes.items() <= table.items()


def test_counters_are_the_c_enum(db: Database, headers: Path) -> None:
    table = choices(db, "UPB_Counters", "CounterIndex")
    drops = {32 + i: f"DROP_CAUSE_{i:02d}" for i in range(DROP_CAUSES)}
    counters = enum(headers, "bus.h", "UPB_COUNTER_", "upb_counter")
    assert table == counters | drops
    assert sorted(counters) == list(range(COUNTERS))


def test_faults_have_names_bits_and_codes(db: Database) -> None:
    table = choices(db, "UPB_FaultDetail", "Fault")
    assert sorted(table) == list(range(FAULTS + 1))
    for number, name in table.items():
        assert fault_name(number) == name
        if number:
            assert db.get_message_by_name("UPB_Faults").get_signal_by_name(name).start == 15 + number
            assert fault_dtc(number) == 0xD00000 + 256 * number
    assert fault_name(FAULTS + 1) == "NONE"
    assert fault_dtc(0) == fault_dtc(FAULTS + 1) == 0


def test_messages_of_the_library_are_those_of_the_dbc(db: Database) -> None:
    for name, can_id, flags, cycle_ms, data_id, length in messages():
        message = db.get_message_by_name(name)
        assert message.dbc is not None
        assert (message.frame_id, message.length, message.cycle_time or 0) == (can_id, length, cycle_ms)
        assert message.is_fd == bool(flags & 1)
        assert message.dbc.attributes["E2E_DataID"].value == data_id
        assert message.dbc.attributes["GenMsgSendType"].value == (0 if cycle_ms else 1)


def test_every_message_and_signal_has_a_comment(db: Database) -> None:
    for message in db.messages:
        assert message.comment, message.name
        for signal in message.signals:
            assert signal.comment, f"{message.name}.{signal.name}"


@pytest.fixture
def told(make_desk, rng: np.random.Generator):  # type: ignore[no-untyped-def]
    """A device with random contents, and the frames of 4 s by message name."""
    desk = make_desk()
    now = desk.device.snapshot
    now.state, now.mode, now.latency_max_ns = 2, 1, int(rng.integers(1 << 33))
    now.model_crc32, now.precision, now.cpu, now.model_swaps = int(rng.integers(1 << 32)), 2, 3, 300
    counters = [int(v) for v in rng.integers(1, 1 << 40, COUNTERS)]
    drops = [int(v) for v in rng.integers(1 << 40, size=DROP_CAUSES)]
    drops[3] = 1 << 50
    now.set_counters(counters)
    now.set_drops(drops)
    record = Record()
    record.frame, record.latency_ns, record.verdict, record.missing_columns, record.mode = 1 << 35, 12_345_678, 1, 7, 1
    record.first_input_ns, record.last_input_ns = int(rng.integers(1 << 62)), int(rng.integers(1 << 62))
    record.output_ns = (1 << 64) - 1
    now.record = record
    desk.device.report(8, 3, 0)
    desk.device.ledger(record)
    desk.run(4000)
    return desk, counters, drops, record, desk.device.take_can()


def decoded(db: Database, frames, name: str) -> list[dict[str, object]]:  # type: ignore[no-untyped-def]
    message = db.get_message_by_name(name)
    return [message.decode(data, decode_choices=False) for can_id, _, data in frames if can_id == message.frame_id]  # type: ignore[misc]


def test_cantools_decodes_what_the_device_sends(db: Database, told) -> None:  # type: ignore[no-untyped-def]
    desk, _, _, record, frames = told
    now = desk.device.snapshot
    status = decoded(db, frames, "UPB_Status")[-1]
    assert (status["Mode"], status["Verdict"], status["State"], status["Frame"]) == (1, 1, 2, record.frame % (1 << 32))
    assert (status["CommandsEnabled"], status["FaultActive"]) == (1, 1)
    latency = decoded(db, frames, "UPB_Latency")[-1]
    assert latency["LatencyLast"] == 12_345
    assert latency["LatencyMax"] == min(now.latency_max_ns // 1000, 0xFFFFFE)
    model = decoded(db, frames, "UPB_Model")[-1]
    assert (model["ModelCrc32"], model["Precision"], model["Cpu"], model["Swaps"]) == (now.model_crc32, 2, 3, 300 % 256)
    faults = decoded(db, frames, "UPB_Faults")[-1]
    bits = [name for name, value in faults.items() if value and not name.startswith(("E2E", "Latest"))]
    assert (bits, faults["LatestFault"]) == (["SENSOR_ALL_ZERO"], 8)
    detail = decoded(db, frames, "UPB_FaultDetail")
    assert {d["Fault"] for d in detail} == {8}
    assert (detail[-1]["DtcStatus"], detail[-1]["Occurrences"]) == (0x2F, 1)


def test_every_counter_comes_in_turn(db: Database, told) -> None:  # type: ignore[no-untyped-def]
    _, counters, drops, _, frames = told
    seen: dict[int, object] = {}
    for values in decoded(db, frames, "UPB_Counters"):
        (value,) = [v for k, v in values.items() if k != "CounterIndex" and not k.startswith("E2E")]
        seen[values["CounterIndex"]] = value  # type: ignore[index]
    own = {11: 0, 12: 0, 13: 0, 14: 0, 15: 0, 16: 0}  # the bus's own: nothing was refused or lost here
    capped = {32 + i: min(v, (1 << 40) - 1) for i, v in enumerate(drops)}
    assert seen == dict(enumerate(counters)) | own | capped


def test_the_ledger_record_is_whole(db: Database, told) -> None:  # type: ignore[no-untyped-def]
    _, _, _, record, frames = told
    (ledger,) = decoded(db, frames, "UPB_Ledger")
    names = {"Frame": "frame", "FirstInput": "first_input_ns", "LastInput": "last_input_ns", "Output": "output_ns"}
    names |= {"LatencyNs": "latency_ns", "Verdict": "verdict", "MissingColumns": "missing_columns", "Mode": "mode"}
    for signal, field in names.items():
        assert ledger[signal] == getattr(record, field), signal


def test_no_latency_before_the_first_frame(db: Database, desk) -> None:  # type: ignore[no-untyped-def]
    desk.run(50)
    message = db.get_message_by_name("UPB_Latency")
    data = next(data for can_id, _, data in desk.device.take_can() if can_id == message.frame_id)
    values = message.decode(data)
    assert isinstance(values, dict)
    assert str(values["LatencyLast"]) == str(values["LatencyMax"]) == "NOT_AVAILABLE"


def test_serial_carries_the_same_messages(make_desk) -> None:  # type: ignore[no-untyped-def]
    from upbeam.runtime.bus import Parser

    desk = make_desk()
    desk.device.ledger(Record())
    desk.run(1500)
    assert Parser().feed(desk.device.take_serial()) == desk.device.take_can()
    quiet = make_desk(status_on_serial=False)
    quiet.device.ledger(Record())
    quiet.run(1500)
    assert quiet.device.take_serial() == b""
