"""``upbeamd`` over loopback: real sockets, signals, files. Counts are asserted, times are not."""

from __future__ import annotations

import json
import os
import pty
import signal
import socket
import subprocess
import time
import tty
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
from daemon_feed import MODELS, Feed, model_file, position

from upbeam.runtime.daemon import UPBEAMD, read_columns
from upbeam.runtime.packets import read_calibration

WAIT_S = 20


def udp(timeout: float = 0.0) -> socket.socket:
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 8 << 20)
    sock.bind(("127.0.0.1", 0))
    sock.setblocking(False)
    if timeout:
        sock.settimeout(timeout)
    return sock


def free_port() -> int:
    with udp() as sock:
        return int(sock.getsockname()[1])


def endpoint(sock: socket.socket) -> str:
    return f"127.0.0.1:{sock.getsockname()[1]}"


def read_all(sock: socket.socket) -> list[bytes]:
    got = []
    while True:
        try:
            got.append(sock.recv(2048))
        except BlockingIOError:
            return got


@dataclass
class Running:
    process: subprocess.Popen[str]
    folder: Path
    port: int
    position_port: int
    can_port: int
    columns: socket.socket
    hdl64: socket.socket
    can: socket.socket
    serial: int
    sender: socket.socket = field(default_factory=lambda: socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
    datagrams: list[bytes] = field(default_factory=list)
    shown: list[bytes] = field(default_factory=list)

    def collect(self) -> None:
        self.datagrams += read_all(self.columns)
        self.shown += read_all(self.hdl64)

    def play(self, packets: list[Any]) -> None:
        """At the pace of their times, ten at once."""
        origin, begun = packets[0].time_ns, time.monotonic_ns()
        for i, packet in enumerate(packets):
            if i % 10 == 0:
                ahead = packet.time_ns - origin - (time.monotonic_ns() - begun)
                time.sleep(max(0, ahead) / 1e9)
                self.collect()
            self.sender.sendto(packet.data, ("127.0.0.1", self.port))

    def status(self) -> Any:
        return json.loads((self.folder / "status.json").read_text())

    def wait_for(self, what: str, condition: Any) -> Any:
        deadline = time.monotonic() + WAIT_S
        while time.monotonic() < deadline:
            self.collect()
            if (self.folder / "status.json").exists() and condition(self.status()):
                return self.status()
            assert self.process.poll() is None, self.process.communicate()
            time.sleep(0.05)
        raise AssertionError(f"waited {WAIT_S} s for: {what}; {self.status()}")

    def end(self) -> tuple[Any, list[dict[str, Any]], str]:
        self.process.send_signal(signal.SIGTERM)
        _, messages = self.process.communicate(timeout=WAIT_S)
        assert self.process.returncode == 0, messages
        self.collect()
        lines = [json.loads(line) for line in (self.folder / "ledger.jsonl").read_text().splitlines()]
        return self.status(), lines, messages


@contextmanager
def running(folder: Path, **settings: Any) -> Iterator[Running]:
    columns, hdl64, can = udp(), udp(), udp()
    port, position_port, can_port = free_port(), free_port(), free_port()
    master, slave = pty.openpty()
    tty.setraw(master)
    model = folder / "model.ubm"
    model.write_bytes(model_file())
    chosen = {
        "model": model,
        "listen": f"127.0.0.1:{port}",
        "position_listen": f"127.0.0.1:{position_port}",
        "columns": endpoint(columns),
        "hdl64": endpoint(hdl64),
        "can": f"udp:{can_port}:{endpoint(can)}",
        "serial": os.ttyname(slave),
        "json": folder / "status.json",
        "json_ms": 50,
        "ledger": folder / "ledger.jsonl",
        "calibration": folder / "hdl64.yaml",
        "state": folder,
        # A busy machine: what is asserted here must not depend on its moods.
        "ladder_mean_ms": 10_000,
        "ladder_repeat_ms": 10_000,
        "ladder_pass_ms": 10_000,
        "stale_ms": 10_000,
        "timeout_ms": 3_000,
        "ring_packets": 16384,
        **settings,
    }
    config = folder / "upbeamd.conf"
    config.write_text("# of a test\n" + "".join(f"{key} = {value}\n" for key, value in chosen.items()))
    process = subprocess.Popen([UPBEAMD, "--config", config], stderr=subprocess.PIPE, text=True)
    run = Running(process, folder, port, position_port, can_port, columns, hdl64, can, master)
    try:
        assert process.stderr is not None
        while "ready" not in (line := process.stderr.readline()):
            assert line or process.poll() is None, "it ended before it was ready"
        yield run
    finally:
        process.kill()
        process.wait()
        for sock in (columns, hdl64, can, run.sender):
            sock.close()
        assert process.stderr is not None
        process.stderr.close()
        os.close(master)
        os.close(slave)


def test_packets_signals_and_files(tmp_path: Path) -> None:
    feed = Feed(rpm=1200)
    packets = feed.make(24)
    a, b = len(packets) // 3, 2 * len(packets) // 3
    with running(tmp_path, any_model=1) as run:
        run.sender.sendto(position(packets[0].time_ns), ("127.0.0.1", run.position_port))
        run.sender.sendto(b"not a packet", ("127.0.0.1", run.port))
        run.play(packets[:a])
        run.wait_for("the first third", lambda s: s["counters"]["packets_received"] == a + 1)
        first = run.status()["model_crc32"]
        (tmp_path / "model.ubm").write_bytes(b"no model")
        run.process.send_signal(signal.SIGHUP)
        run.wait_for("refusal", lambda s: s["counters"]["models_rejected"] == 1)
        assert run.status()["model_crc32"] == first
        (tmp_path / "model.ubm").write_bytes((MODELS / "hdl-64e.ubm").read_bytes())
        run.process.send_signal(signal.SIGHUP)
        run.wait_for("healing", lambda s: "MODEL_REJECTED" not in s["faults"])
        run.play(packets[a:b])
        run.wait_for("the swap", lambda s: s["counters"]["models_swapped"] == 1)
        run.play(packets[b:])
        run.wait_for("all packets", lambda s: s["counters"]["packets_received"] == len(packets) + 1)
        status, lines, _ = run.end()
        can = read_all(run.can)
        console = os.read(run.serial, 65536)
    counters = status["counters"]
    assert status["ended"]
    assert counters["packets_processed"] == len(packets)
    assert counters["packets_dropped"]["malformed"] == 1
    assert counters["packets_received"] == counters["packets_processed"] + sum(counters["packets_dropped"].values())
    assert counters["positions_received"] == 1
    assert counters["columns_out"] == 12 * len(packets)
    assert status["process"]["send_failed"] == 0
    assert status["process"]["reloads"] == 2
    # The files and what was sent tell the same story.
    columns = [c for d in run.datagrams for c in read_columns(d)]
    assert len(run.datagrams) == counters["column_datagrams"]
    assert len(columns) == counters["columns_out"]
    assert [read_columns(d)[0].sequence for d in run.datagrams] == list(range(len(run.datagrams)))
    assert len(run.shown) == counters["hdl64_packets"]
    assert {len(packet) for packet in run.shown} == {1206}
    records = [line for line in lines if "latency_ns" in line]
    assert records == status["ledger"]
    assert len(records) == counters["frames_closed"] == len({c.frame for c in columns})
    assert {line["event"] for line in lines if "event" in line} >= {"model_rejected", "model_swapped", "ended"}
    assert all(r["latency_ns"] == r["output_ns"] - r["last_input_ns"] for r in records)
    assert {frame[0] | frame[1] << 8 for frame in can} >= {0x210, 0x211, 0x212, 0x213, 0x220}
    assert console.count(0) > 5
    table = read_calibration(tmp_path / "hdl64.yaml", "hdl-64e-s3")
    assert table.beams == 64
    # The wire column bits are those of the core on virtual time: the first frames had the first model.
    assert {c.model_crc32 for c in columns if c.frame < 3} == {first}


def test_state_survives_a_restart(tmp_path: Path) -> None:
    packets = Feed().make(2)
    with running(tmp_path) as run:
        for _ in range(3):
            run.sender.sendto(bytes(100), ("127.0.0.1", run.can_port))
        (tmp_path / "model.ubm").write_bytes(b"no model")
        run.process.send_signal(signal.SIGHUP)
        run.play(packets[:100])
        run.wait_for("the fault", lambda s: "MODEL_REJECTED" in s["faults"])
        run.end()
        assert run.status()["process"]["can_failed"] == 3
    assert (tmp_path / "faults").stat().st_size > 100
    with running(tmp_path) as run:
        run.play(packets[:50])
        run.wait_for("packets", lambda s: s["counters"]["packets_processed"] == 50)
        status, _, messages = run.end()
    assert status["counters"]["packets_processed"] == 50
    assert "FAILED" not in messages


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "no model"),
        (["--modell", "x"], "unknown setting 'modell'"),
        (["--model"], "no value"),
        (["model"], "is no flag"),
        (["--config", "/nonexistent.conf"], "/nonexistent.conf"),
        (["--model", "m.ubm", "--ring_packets", "100"], "power of two"),
        (["--model", "/nonexistent.ubm", "--listen", "127.0.0.1:0"], "/nonexistent.ubm"),
        (["--model", "m.ubm", "--listen", "nowhere"], "expected address:port"),
        (["--model", "m.ubm", "--sensor=vlp-16"], "expected hdl-32e vlp-32c"),
    ],
)
def test_bad_usage_is_refused_with_the_reason(arguments: list[str], message: str) -> None:
    done = subprocess.run([UPBEAMD, *arguments], capture_output=True, text=True, timeout=WAIT_S)
    assert done.returncode in (1, 2)
    assert message in done.stderr
    assert done.stdout == ""


def test_a_bad_line_is_named_by_file_and_number(tmp_path: Path) -> None:
    config = tmp_path / "bad.conf"
    config.write_text("model = x.ubm\n\ndeadline_ms = soon\n")
    done = subprocess.run([UPBEAMD, "--config", config], capture_output=True, text=True, timeout=WAIT_S)
    assert done.returncode == 2
    assert f"{config}:3: deadline_ms is 'soon', expected milliseconds" in done.stderr


def test_printed_settings_are_settings(tmp_path: Path) -> None:
    command = [UPBEAMD, "--model", "x.ubm", "--deadline-ms=25", "--print-config"]
    printed = subprocess.run(command, capture_output=True, text=True, timeout=WAIT_S, check=True).stdout
    assert "deadline_ms = 25\n" in printed
    config = tmp_path / "printed.conf"
    config.write_text(printed)
    again = subprocess.run([UPBEAMD, "--config", config, "--print-config"], capture_output=True, text=True, check=True)
    assert again.stdout == printed
    help_text = subprocess.run([UPBEAMD, "--help"], capture_output=True, text=True, check=True).stdout
    for line in printed.splitlines():
        assert f"--{line.split(' = ')[0]} " in help_text
