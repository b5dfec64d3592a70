"""Whatever was wrong, a healthy sensor is heard again, and nothing that the daemon learnt meanwhile stays behind."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
from daemon_feed import MS, Feed, Packet, finish, model_file, run

from upbeam.runtime.daemon import Daemon

PACKETS_PER_TURN = 181
BROKEN = range(5 * PACKETS_PER_TURN, 9 * PACKETS_PER_TURN)  # 0.4 s
CONFIRMED = 4
"""Packets of the sensor, each continuing the one before, that end every doubt."""


def daemon_for(settings: dict[str, Any] | None = None) -> Daemon:
    return Daemon(model_file(), {"service_ns": [100_000] * 4, **(settings or {})})


def edited(packet: Packet, at: int, value: bytes) -> Packet:
    data = bytearray(packet.data)
    data[at : at + len(value)] = value
    return replace(packet, data=bytes(data))


def clock_set_by(packet: Packet, microseconds: int) -> Packet:
    time = int.from_bytes(packet.data[1200:1204], "little") + microseconds
    return edited(packet, 1200, (time % 3_600_000_000).to_bytes(4, "little"))


def processed(daemon: Daemon, packets: list[Packet]) -> int:
    before = daemon.counters["packets_processed"]
    run(daemon, packets)
    return daemon.counters["packets_processed"] - before


def junk(time_ns: int) -> list[bytes]:
    return [bytes(1206)] * 5


def of_another_sensor(time_ns: int) -> list[bytes]:
    packet = Feed("vlp-32c", start_ns=time_ns).make(0.01)[0]
    return [packet.data] * 5


FLOODS: dict[str, Callable[[int], list[bytes]]] = {"junk": junk, "another_sensor": of_another_sensor}


@pytest.mark.parametrize("model_byte", [0x22, 0x28, 0xA1])
@pytest.mark.parametrize("flood_per_second", [0, 100])
def test_a_sensor_is_heard_again_after_packets_of_another_model(model_byte: int, flood_per_second: int) -> None:
    """Its own refused packets are no flood; and where settings call them one, it ends with them."""
    packets = Feed().make(15)
    daemon = daemon_for({"flood_per_second": flood_per_second})
    for i in BROKEN:
        packets[i] = edited(packets[i], 1205, bytes([model_byte]))
    run(daemon, packets[: BROKEN.stop])
    drops = daemon.counters["packets_dropped"]
    assert (drops["flood"] > 0) == (flood_per_second > 0)
    assert drops["wrong_model"] + drops["flood"] == len(BROKEN)
    rest = packets[BROKEN.stop :]
    missed = len(rest) - processed(daemon, rest)
    assert missed <= (CONFIRMED - 1 if flood_per_second else 0)
    assert daemon.faults == []


@pytest.mark.parametrize("kind", FLOODS)
@pytest.mark.parametrize("clock", ["goes_on", "set_back", "set_a_little_back", "set_forward"])
@pytest.mark.parametrize("away", [0, 20, 181, 900])
def test_a_sensor_comes_back_while_a_flood_goes_on(kind: str, clock: str, away: int) -> None:
    """After ``away`` packets that never came, with its clock as it was or set anew: heard at the fourth packet."""
    packets = Feed().make(12)
    daemon = daemon_for()
    set_by = {"goes_on": 0, "set_back": -7_000_000, "set_a_little_back": -40_000, "set_forward": 9_000_000}[clock]
    begin = 3 * PACKETS_PER_TURN
    heard = 0
    for i, packet in enumerate(packets):
        here = i < begin or i >= begin + away
        if i % 16 == 0:
            daemon.tick(packet.time_ns)
        if here:
            sent = packet if i < begin else clock_set_by(packet, set_by)
            before = daemon.counters["packets_processed"]
            daemon.packet(sent.data, packet.time_ns)
            heard += daemon.counters["packets_processed"] - before
        if i > begin - 90:
            for data in FLOODS[kind](packets[0].time_ns):
                daemon.packet(data, packet.time_ns)
    assert daemon.counters["packets_dropped"]["flood"] > 1000
    assert len(packets) - away - heard < CONFIRMED
    assert "NET_FLOOD" in daemon.faults


@pytest.mark.parametrize("turns", [1, 4, 11])
def test_a_speed_measured_while_the_azimuth_stood_still_is_forgotten(turns: int) -> None:
    packets = Feed().make(turns + 12)
    begin, end = 5 * PACKETS_PER_TURN, (5 + turns) * PACKETS_PER_TURN
    here = packets[begin].data[2:4]
    for i in range(begin, end):
        for block in range(12):
            packets[i] = edited(packets[i], 100 * block + 2, here)
    daemon = daemon_for()
    out = finish(daemon, run(daemon, packets))
    counters = daemon.counters
    assert counters["packets_dropped"]["stuck"] > 0.9 * (end - begin)
    assert daemon.status["columns"] == pytest.approx(Feed().columns, rel=0.01)
    assert counters["resyncs"] <= 1
    assert "SENSOR_AZIMUTH_JUMP" not in daemon.status["faults_ever"]
    assert [e["a"] for e in out.events if e["kind"] == "stream_made"] == [daemon.status["columns"]]
    assert len(out.ledger) <= 14, "no frames of a few firings"
    assert daemon.faults == []


@pytest.mark.parametrize("at", [0.3, 0.5, 0.95])
def test_work_in_two_modes_is_no_throttling(at: float) -> None:
    """A mode is changed within a frame, and back within another: the mean of both says nothing of either."""
    packets = Feed().make(30)
    daemon = daemon_for({"service_ns": [400_000, 100_000, 100_000, 50_000]})
    steps = [(2, "pass_through"), (4, "network"), (6, "valid_mean"), (7, "network"), (9, "repeat"), (10, "network")]
    done = 0
    for turn, mode in steps:
        upto = int((turn + at) * PACKETS_PER_TURN)
        now = run(daemon, packets[done:upto])
        daemon.set_floor(mode, now)
        done = upto
    finish(daemon, run(daemon, packets[done:]))
    assert daemon.mode == "network"
    assert "COMPUTE_THROTTLE" not in daemon.status["faults_ever"]


def test_a_frame_of_a_few_packets_is_no_baseline() -> None:
    """Work on five packets was quick by chance: that is not what all others are measured by."""
    packets = Feed().make(30)
    daemon = daemon_for()
    now = run(daemon, packets[: 8 * PACKETS_PER_TURN])
    daemon.set_service([20_000] * 4)
    now = run(daemon, packets[8 * PACKETS_PER_TURN : 8 * PACKETS_PER_TURN + 5])
    for ms in range(10, 200, 10):  # the sensor is away, and the five are looked at alone
        daemon.tick(now + ms * MS)
    daemon.set_service([100_000] * 4)
    finish(daemon, run(daemon, packets[12 * PACKETS_PER_TURN :]))
    assert "COMPUTE_THROTTLE" not in daemon.status["faults_ever"]
