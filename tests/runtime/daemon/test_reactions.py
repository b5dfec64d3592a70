"""Every reaction that sabotage can take out makes a difference; a limited field of view on simulated packets."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
from daemon_feed import MODELS, MS, SENSORS, Feed, Packet, finish, model_file, run

from upbeam.runtime.daemon import Daemon, DaemonError, check_names
from upbeam.runtime.packets import Encoder

Outcome = Callable[[Daemon], Any]
HEAVY, LIGHT = [700_000] * 3 + [50_000], [50_000] * 4


def lost(daemon: Daemon) -> Any:
    packets = Feed().make(1)
    finish(daemon, run(daemon, packets[:50] + packets[53:]))
    return daemon.counters["columns_out"] == 12 * len(packets)


def duplicated(daemon: Daemon) -> Any:
    packets = Feed().make(1)
    finish(daemon, run(daemon, packets[:50] + packets[49:]))
    return daemon.counters["columns_out"] == 12 * len(packets)


def late(daemon: Daemon) -> Any:
    packets = Feed().make(1)
    swapped = [*packets[:50], packets[51], replace(packets[50], time_ns=packets[51].time_ns), *packets[52:]]
    finish(daemon, run(daemon, swapped))
    return daemon.counters["packets_dropped"]["late"]


def flooded(daemon: Daemon) -> Any:
    packets = Feed().make(1)
    junk = [Packet(p.time_ns, bytes(1206)) for p in packets for _ in range(5)]
    finish(daemon, run(daemon, sorted(packets + junk, key=lambda p: p.time_ns)))
    return daemon.counters["packets_dropped"]["flood"] > 0


def stuck(daemon: Daemon) -> Any:
    packets = []
    for packet in Feed().make(1):
        data = bytearray(packet.data)
        for at in range(2, 1200, 100):
            data[at : at + 2] = data[2:4] if not packets else packets[0].data[2:4]
        packets.append(replace(packet, data=bytes(data)))
    finish(daemon, run(daemon, packets))
    return daemon.counters["packets_dropped"]["stuck"] > 100


def clock_set_back(daemon: Daemon) -> Any:
    packets = Feed().make(1)
    for i in range(50, len(packets)):
        data = bytearray(packets[i].data)
        microseconds = int.from_bytes(data[1200:1204], "little") - 2_000_000
        data[1200:1204] = microseconds.to_bytes(4, "little")
        packets[i] = replace(packets[i], data=bytes(data))
    finish(daemon, run(daemon, packets))
    return daemon.counters["packets_dropped"]["jump"] == 1


def silent(daemon: Daemon) -> Any:
    packets = Feed().make(1)
    now = run(daemon, packets)
    for ms in range(10, 100, 10):
        daemon.tick(now + ms * MS)
    return daemon.counters["columns_out"] == 12 * len(packets)


def stranger(daemon: Daemon) -> Any:
    for packet in Feed().make(0.2):
        daemon.packet(packet.data, packet.time_ns, source=0x7F000001)
    return daemon.counters["packets_processed"]


def relieved(daemon: Daemon) -> Any:
    packets = Feed().make(15)
    daemon.set_service(HEAVY)
    run(daemon, packets[:300])
    worst = daemon.mode
    daemon.set_service(LIGHT)
    finish(daemon, run(daemon, packets[300:]))
    return worst, daemon.mode


def burdened(daemon: Daemon) -> Any:
    daemon.set_service(HEAVY)
    finish(daemon, run(daemon, Feed().make(3)))
    return daemon.counters["mode_changes"] > 0


def hopeless(daemon: Daemon) -> Any:
    daemon.set_service([3_000_000] * 4)
    finish(daemon, run(daemon, Feed().make(3)))
    return daemon.counters["packets_dropped"]["stale"] > 0


def damaged(daemon: Daemon) -> Any:
    packets = Feed().make(8)
    run(daemon, packets[:200])
    daemon.flip_bit("model", 800)
    finish(daemon, run(daemon, packets[200:]))
    return daemon.counters["integrity_repairs"]


def foreign_model(daemon: Daemon) -> Any:
    try:
        daemon.swap_model((MODELS / "hdl-64e.ubm").read_bytes(), 0)
    except DaemonError:
        return "refused"
    return "taken"


REACTIONS: dict[str, tuple[Outcome, Any]] = {
    "react_ladder_down": (burdened, True),
    "react_ladder_up": (relieved, ("pass_through", "network")),
    "react_stale": (hopeless, True),
    "react_flood": (flooded, True),
    "react_duplicate": (duplicated, True),
    "react_late": (late, 1),
    "react_source": (stranger, 0),
    "react_gap": (lost, True),
    "react_resync": (clock_set_back, True),
    "react_timeout": (silent, True),
    "react_stuck": (stuck, True),
    "react_repair": (damaged, 1),
    "react_model_check": (foreign_model, "refused"),
}


def test_every_reaction_is_here() -> None:
    assert list(REACTIONS) == [name for name in check_names() if name.startswith("react_")]


@pytest.mark.parametrize("name", REACTIONS)
def test_a_reaction_makes_a_difference(name: str) -> None:
    outcome, expected = REACTIONS[name]
    settings = {"service_ns": LIGHT, "source_ipv4": 0x0A000001 if name == "react_source" else 0}
    assert outcome(Daemon(model_file(), settings)) == expected
    broken = Daemon(model_file(), settings, sabotage=[name])
    assert outcome(broken) != expected
    counters = broken.counters
    assert counters["packets_received"] == counters["packets_processed"] + sum(counters["packets_dropped"].values())


@pytest.mark.parametrize("sensor", SENSORS)
@pytest.mark.parametrize("told", [True, False])
def test_a_sensor_that_fires_in_a_part_of_the_turn(sensor: str, told: bool) -> None:
    """Told, its frames are whole and nothing is missing; untold, each turn looks like a jump."""
    feed = Feed(sensor)
    feed.make(8)
    firings = feed.firings
    assert firings is not None
    degrees = firings.azimuth_mdeg / 1e3
    seen = firings[(degrees >= 270) | (degrees < 90)]
    data = Encoder(sensor).encode(seen)
    sent = seen.time_ns[11::12] + feed.cycle_ns
    packets = [Packet(int(t), d) for t, d in zip(sent, data, strict=False)]
    fov = {"fov_begin_mdeg": 270_000, "fov_end_mdeg": 90_000} if told else {}
    daemon = Daemon(model_file(sensor), {"sensor": SENSORS[sensor], "service_ns": LIGHT, **fov})
    out = finish(daemon, run(daemon, packets))
    counters = daemon.counters
    assert counters["columns_out"] == 12 * len(packets) + counters["firings_inserted"]
    whole = [record for record in out.ledger if record["verdict"] == "met"]
    if told:
        assert daemon.status["faults_ever"] == []
        assert counters["firings_inserted"] == counters["firings_skipped"] == 0
        assert len(whole) >= 6
        assert all(record["missing_columns"] == 0 for record in whole)
    else:
        assert daemon.status["faults_ever"] != []


def test_columns_per_turn_follow_the_speed_only_where_it_matters() -> None:
    """Offsets in whole columns change for a VLP-32C; an HDL-32E has none."""
    for sensor, several in (("hdl-32e", False), ("vlp-32c", True)):
        packets: list[Packet] = []
        degrees, now = 181.0, 5 * 10**9
        for rpm in range(600, 900, 20):
            feed = Feed(sensor, rpm=rpm, start_deg=degrees, start_ns=now)
            part = feed.make(1.2)
            packets += part
            degrees += len(part) * 12 * 360 / feed.columns
            now = part[-1].time_ns
        daemon = Daemon(model_file(sensor), {"sensor": SENSORS[sensor], "service_ns": LIGHT, "rpm": 600})
        finish(daemon, run(daemon, packets))
        counters = daemon.counters
        assert (counters["streams_made"] > 1) == several, sensor
        assert counters["resyncs"] == counters["firings_skipped"] == 0
        assert counters["columns_out"] == 12 * len(packets)
        assert daemon.status["faults_ever"] == ["SENSOR_RPM_RANGE"]
