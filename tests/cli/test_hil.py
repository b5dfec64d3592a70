"""``upbeam hil`` and the packets of ``upbeam simulate`` as a user meets them."""

from __future__ import annotations

import json
import socket
import subprocess
import sys
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest

from upbeam.runtime.packets import Decoder, PacketReader, identify

SCRIPT = Path(sys.executable).with_name("upbeam")
ROOT = Path(__file__).resolve().parents[2]


def run(*arguments, status: int = 0) -> subprocess.CompletedProcess[str]:
    done = subprocess.run(
        [str(SCRIPT), *map(str, arguments)], capture_output=True, text=True, timeout=300, cwd=ROOT, check=False
    )
    assert done.returncode == status, f"{arguments}: status {done.returncode}\n{done.stdout}\n{done.stderr}"
    assert "Traceback" not in done.stderr
    return done


def run_json(*arguments, status: int = 0) -> dict:
    return json.loads(run(*arguments, "--json", status=status).stdout)


def test_run_tells_every_figure(tmp_path: Path) -> None:
    result = run_json(
        "hil", "run", "--scenario", "silence", "--scenario", "command_forged", "--sabotage", "--keep",
        "--junit", tmp_path / "junit.xml", "--report", tmp_path / "report",
    )  # fmt: skip
    assert (result["passed"], result["failed"], result["not_run"]) == (2, 0, 0)
    assert result["sabotaged"] == result["caught"] == 3
    silence = next(one for one in result["scenarios"] if one["name"] == "silence")
    timing = next(one for one in silence["timings"] if one["what"] == "SENSOR_TIMEOUT")
    assert 0 < timing["ms"] <= timing["limit_ms"]
    assert timing["ms"] < timing["reported_ms"]
    assert (tmp_path / "report" / "silence" / "can.blf").stat().st_size > 1000
    assert ET.parse(tmp_path / "junit.xml").getroot().get("tests") == "2"


def test_run_for_people() -> None:
    text = run("hil", "run", "--scenario", "silence").stdout
    assert "1 of 1 scenarios passed" in text
    assert "SENSOR_TIMEOUT" in text


def test_a_failure_is_status_1_and_says_where_to_look(tmp_path: Path) -> None:
    text = (ROOT / "tests" / "hil" / "silence.toml").read_text(encoding="utf-8")
    (tmp_path / "hopeless.toml").write_text(text.replace("within_ms = 70", "within_ms = 1"), encoding="utf-8")
    done = run("hil", "run", "--scenarios", tmp_path, "--report", tmp_path / "report", status=1)
    assert "hopeless: failed" in done.stderr
    assert str(tmp_path / "report" / "hopeless") in done.stderr
    assert (tmp_path / "report" / "hopeless" / "transcript.txt").exists()


def test_list_and_faults() -> None:
    assert len(run_json("hil", "list")["scenarios"]) >= 40
    faults = run_json("hil", "faults")["faults"]
    assert faults["silence"]["detects"] == "SENSOR_TIMEOUT"
    assert "burst_loss" in run("hil", "faults").stdout


@pytest.mark.parametrize(
    ("arguments", "says"),
    [(["hil", "run", "--scenario", "nothing"], "no scenario 'nothing'"), (["hil", "run", "--dut", "x"], "--dut x"),
     (["hil", "run", "--scenarios", "/nowhere"], "no scenario"), (["hil", "run", "--dut", "/nowhere.toml"], "nowhere"),
     (["simulate"], "--output"), (["simulate", "--udp", "nowhere"], "HOST:PORT"),
     (["simulate", "--pcap", "x.pcap", "--sensor", "hdl-64e"], "packets are made of"),
     (["simulate", "--pcap", "x.pcap", "--sensor", "vlp-32c", "--source", "/nowhere.pcap"], "no such file")],
)  # fmt: skip
def test_bad_usage_is_one_line(arguments: list[str], says: str) -> None:
    done = run(*arguments, status=2)
    assert says in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1


def test_simulate_writes_a_capture(tmp_path: Path) -> None:
    path = tmp_path / "vlp32c.pcap"
    result = run_json("simulate", "--pcap", path, "--sensor", "vlp-32c", "--frames", 2, "--returns", "dual")
    packets = [d.payload for d in PacketReader(path, port=2368)]
    assert result["datagrams"] == len(packets) + 1  # one of position
    assert len(packets) == 301  # 0.1 s of 0.331776 ms
    firings = Decoder("vlp-32c").decode_all(packets).firings
    assert (firings.distance > 0).mean() > 0.3
    assert identify(packets[0]).return_mode == "dual"


def test_simulate_sends_with_faults(tmp_path: Path) -> None:
    faults = tmp_path / "faults.toml"
    faults.write_text("[[fault]]\nkind = 'loss'\nrate = 0.5\n", encoding="utf-8")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as ear:
        ear.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
        ear.bind(("127.0.0.1", 0))
        ear.settimeout(5)
        port = ear.getsockname()[1]
        settings = ["--sensor", "hdl-32e", "--source", "room", "--frames", 4, "--faults", faults]
        result = run_json("simulate", "--udp", f"127.0.0.1:{port}", *settings)
        got = [ear.recv(2048) for _ in range(80)]
    assert 120 < result["datagrams"] < 240
    assert {len(payload) for payload in got} == {1206}
    assert result["late_p50_us"] >= 0
    faults.write_text("kind = 'loss'\n", encoding="utf-8")
    done = run("simulate", "--udp", f"127.0.0.1:{port}", *settings, status=2)
    assert "[[fault]]" in done.stderr


def test_a_capture_is_played_again(tmp_path: Path) -> None:
    path, again = tmp_path / "a.pcap", tmp_path / "b.pcap"
    room = ["--sensor", "hdl-32e", "--source", "room", "--frames", 4]
    run_json("simulate", "--pcap", path, *room)
    result = run_json("simulate", "--pcap", again, "--source", path, "--frames", 6)
    assert result["sensor"] == "hdl-32e"
    first = [d.payload for d in PacketReader(path, port=2368)]
    assert [d.payload for d in PacketReader(again)][:90] == first[:90]
