"""A long run of ``upbeamd`` over loopback at 20 Hz: every packet accounted for, memory flat, latencies reported.

    .venv/bin/python tests/runtime/daemon/soak_upbeamd.py [--seconds 600] [--rpm 1200] [--sensor hdl-32e]

Exit status 1 if a packet is not accounted for, or memory grows. Latencies are reported, not judged.
"""

from __future__ import annotations

import argparse
import json
import socket
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent))

from daemon_feed import MODELS, Feed, sensor_settings

GROWTH_KIB = 1024
"""What the resident memory may grow by between the first tenth of the run and its end."""


def resident_kib(pid: int) -> int:
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith("VmRSS"):
            return int(line.split()[1])
    raise ValueError("no VmRSS")


def send(port: int, feed: Feed, seconds: float) -> int:
    """Turns of one packet set again and again, the sensor's clock and azimuth going on."""
    turn = feed.make(40)
    span_ns = len(turn) * 12 * feed.cycle_ns
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    begun, sent = time.monotonic_ns(), 0
    shift_cdeg = round(len(turn) * 12 * 36_000 / feed.columns)
    for lap in range(10**9):
        for i, packet in enumerate(turn):
            due = begun + lap * span_ns + packet.time_ns - turn[0].time_ns
            if i % 8 == 0:
                ahead = due - time.monotonic_ns()
                if ahead > 0:
                    time.sleep(ahead / 1e9)
                if time.monotonic_ns() - begun > seconds * 1e9:
                    return sent
            data = bytearray(packet.data)
            for block in range(12):
                at = 100 * block + 2
                azimuth = int.from_bytes(data[at : at + 2], "little") + lap * shift_cdeg
                data[at : at + 2] = (azimuth % 36_000).to_bytes(2, "little")
            microseconds = int.from_bytes(data[1200:1204], "little") + lap * span_ns // 1000
            data[1200:1204] = (microseconds % 3_600_000_000).to_bytes(4, "little")
            sock.sendto(data, ("127.0.0.1", port))
            sent += 1
    return sent


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=600)
    parser.add_argument("--rpm", type=float, default=1200)
    parser.add_argument("--sensor", default="hdl-32e")
    options = parser.parse_args()
    from test_process import running

    received: dict[str, int] = {"columns": 0, "hdl64": 0}
    memory: list[int] = []
    settings: dict[str, Any] = {
        "model": MODELS / f"{options.sensor}.ubm",
        "sensor": options.sensor,
        "ledger_capacity": 100_000,
        "ring_packets": 1024,
        "json_ms": 1000,
        **sensor_settings(),
    }
    with tempfile.TemporaryDirectory() as folder, running(Path(folder), **settings) as run:
        ended = threading.Event()

        def watch() -> None:
            while not ended.wait(0.01):
                run.collect()
                received["columns"] += len(run.datagrams)
                received["hdl64"] += len(run.shown)
                run.datagrams.clear()
                run.shown.clear()
                memory.append(resident_kib(run.process.pid))

        watcher = threading.Thread(target=watch)
        watcher.start()
        sent = send(run.port, Feed(options.sensor, rpm=options.rpm), options.seconds)
        time.sleep(0.5)
        ended.set()
        watcher.join()
        status, _, _ = run.end()
        received["columns"] += len(run.datagrams)
        received["hdl64"] += len(run.shown)
    counters = status["counters"]
    accounted = counters["packets_processed"] + sum(counters["packets_dropped"].values())
    tenth = max(memory[: max(1, len(memory) // 10)])
    report = {
        "seconds": options.seconds,
        "packets_sent": sent,
        "packets_received": counters["packets_received"],
        "packets_accounted": accounted,
        "packets_dropped": {k: v for k, v in counters["packets_dropped"].items() if v},
        "columns_inserted": counters["firings_inserted"],
        "frames": counters["frames_closed"],
        "missed": counters["frames_missed"],
        "columns_by_mode": counters["columns_by_mode"],
        "latency_ms": status["latency_ms"],
        "service_ms": status["service_ms"],
        "lag_max_ms": status["lag_max_ms"],
        "datagrams_sent": counters["column_datagrams"],
        "datagrams_received": received["columns"],
        "hdl64_sent": counters["hdl64_packets"],
        "hdl64_received": received["hdl64"],
        "faults_ever": status["faults_ever"],
        "memory_kib": {"first_tenth": tenth, "most": max(memory)},
    }
    print(json.dumps(report, indent=2))
    good = sent == counters["packets_received"] == accounted and max(memory) - tenth < GROWTH_KIB
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
