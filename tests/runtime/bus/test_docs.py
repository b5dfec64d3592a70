"""docs/can.md and docs/serial.md: the examples run, the tables and figures are those of DBC and library."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import pytest
from cantools.database.can import Database
from cantools.logreader import Parser as LogParser

from upbeam.runtime.bus import FAULTS, Record, fault_debounce, fault_dtc, fault_name

ROOT = Path(__file__).resolve().parents[3]
CAN, SERIAL = (ROOT / "docs" / name for name in ("can.md", "serial.md"))


def example(page: Path, language: str) -> str:
    (found,) = re.findall(rf"```{language}\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)
    return str(found)


def rows(page: Path, first: str) -> list[list[str]]:
    """Cells of the table rows whose first cell matches."""
    lines = [line.strip().strip("|") for line in page.read_text(encoding="utf-8").splitlines() if line.startswith("|")]
    cells = [[cell.strip() for cell in line.split("|")] for line in lines]
    return [row for row in cells if re.fullmatch(first, row[0])]


def test_messages_are_those_of_the_dbc(db: Database) -> None:
    table = {row[0]: row for row in rows(CAN, "0x[0-9a-f]{3}")}
    assert set(table) == {f"{m.frame_id:#05x}" for m in db.messages}
    for message in db.messages:
        assert message.dbc is not None
        attributes = message.dbc.attributes
        profile = attributes["E2E_Profile"].value if "E2E_Profile" in attributes else "none"
        assert table[f"{message.frame_id:#05x}"][1:7] == [
            f"`{message.name}`",
            message.senders[0],
            f"{message.length}{' (FD)' if message.is_fd else ''}",
            str(message.cycle_time or "event"),
            profile,
            "" if profile == "none" else f"{attributes['E2E_DataID'].value:#05x}",
        ]


def test_faults_are_those_of_the_library() -> None:
    table = [row for row in rows(CAN, r"\d+") if len(row) == 6]
    assert len(table) == FAULTS
    for number, row in enumerate(table, 1):
        up, down = fault_debounce(number)
        expected = [str(number), f"`{fault_name(number)}`", f"0x{fault_dtc(number):06X}"]
        assert row[:5] == [*expected, str(-(-127 // up)), str(-(-128 // down))]


def test_c_example_sends_what_cantools_decodes(db: Database, tmp_path: Path) -> None:
    compiler = shutil.which("cc")
    assert compiler is not None, "no C compiler (cc)"
    source, binary = tmp_path / "status.c", tmp_path / "status"
    source.write_text(example(CAN, "c"))
    folder = ROOT / "runtime" / "bus"
    sources = [source, *folder.glob("*.c"), folder / "generated" / "upb_dbc.c"]
    flags = ["-std=c11", "-Wall", "-Wextra", "-Werror", '-DUPB_VERSION_TEXT="0"', f"-I{ROOT / 'runtime' / 'include'}"]
    subprocess.run([compiler, *flags, *map(str, sources), "-o", str(binary)], check=True)
    log = subprocess.run([str(binary)], check=True, capture_output=True, text=True).stdout
    frames = [LogParser().parse(line) for line in log.splitlines()]
    names = []
    for frame in frames:
        assert frame is not None
        message = db.get_message_by_frame_id(frame.frame_id)
        message.decode(frame.data)
        names.append(message.name)
    assert names == ["UPB_Status", "UPB_Latency", "UPB_Counters", "UPB_Faults", "UPB_FaultDetail", "UPB_Model"]


def test_python_example_of_commands(capsys: pytest.CaptureFixture[str]) -> None:
    exec(example(CAN, "python"), {})
    assert capsys.readouterr().out == "[(2, 1, 3, 0)] 1\n[] 1\n"


def test_python_example_of_the_console(capsys: pytest.CaptureFixture[str]) -> None:
    exec(example(SERIAL, "python"), {})
    assert capsys.readouterr().out == "0x301 0 010300000318\n"


def test_line_load_is_the_documents_figure(make_desk) -> None:  # type: ignore[no-untyped-def]
    desk = make_desk()
    desk.device.report(14, 3, 0)
    desk.run(1000)
    desk.device.take_serial()
    for _ in range(200):
        desk.device.ledger(Record())
        desk.run(50)
    bits_per_second = len(desk.device.take_serial()) * 10 / 10
    text = SERIAL.read_text(encoding="utf-8")
    (figure,) = re.findall(r"take (\d+) % of it", text)
    assert f"{100 * bits_per_second / 115200:.0f}" == figure
