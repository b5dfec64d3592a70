"""The degradation ladder: its bits against NumPy, its way down and up in the daemon."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from daemon_feed import MS, SENSORS, Feed, finish, model_file, run

from upbeam.model.baselines import nearest, valid_mean
from upbeam.quant.ubm import read_ubm
from upbeam.runtime.daemon import MODES, Daemon, read_columns

ARRIVAL_NS = 552_960
"""Of an HDL-32E's packets."""
OVERLOAD = [3 * ARRIVAL_NS, 3 * ARRIVAL_NS // 2, 5 * ARRIVAL_NS // 4, ARRIVAL_NS // 4]
"""Work on a packet by mode: only passing through keeps up."""
LIGHT = [ARRIVAL_NS // 10] * 4


def reference(mode: str, distance: Any, intensity: Any, rules: Any) -> tuple[Any, Any]:
    """Generated rows ``[31, n]`` of aligned columns ``[32, n]``: the baselines, with each row's own limits."""
    if mode == "pass_through":
        return np.zeros((31, distance.shape[1]), np.uint16), np.zeros((31, distance.shape[1]), np.uint8)
    seen = (distance >= rules.min_count) & (distance <= rules.row_max_count[0::2, None])
    method = valid_mean if mode == "valid_mean" else nearest
    made, grey = method(np.where(seen, distance, 0), np.where(seen, intensity, 0), rules)
    given = made <= rules.row_max_count[1:63:2, None]
    return np.where(given, made, 0), np.where(given, grey, 0)


@pytest.mark.parametrize("mode", MODES[1:])
@pytest.mark.parametrize("sensor", SENSORS)
@pytest.mark.parametrize("precision", [0, 1, 2])
def test_bits_of_a_mode(sensor: str, mode: str, precision: int, rng: np.random.Generator) -> None:
    feed = Feed(sensor, noise=30_000, seed=int(rng.integers(1 << 30)))  # any count: limits matter
    packets = feed.make(0.6)
    daemon = Daemon(model_file(sensor), {"sensor": SENSORS[sensor], "precision": precision})
    daemon.set_floor(mode, 0)
    last = run(daemon, packets)
    columns = [c for _, data in finish(daemon, last).columns for c in read_columns(data)]
    assert {c.mode for c in columns} == {mode}
    distance = np.stack([c.distance for c in columns], axis=1)
    intensity = np.stack([c.intensity for c in columns], axis=1)
    made, grey = reference(mode, distance[::2], intensity[::2], read_ubm(model_file(sensor)).rules)
    np.testing.assert_array_equal(distance[1:63:2], made)
    np.testing.assert_array_equal(intensity[1:63:2], grey)
    assert mode == "pass_through" or np.count_nonzero(made) > 1000


def overloaded(settings: dict[str, Any] | None = None, **kwargs: Any) -> Daemon:
    return Daemon(model_file(), {"service_ns": OVERLOAD, "queue_packets": 1024, **(settings or {})}, **kwargs)


def changes(events: list[dict[str, Any]]) -> list[tuple[str, str]]:
    return [(MODES[e["a"]], MODES[e["b"]]) for e in events if e["kind"] == "mode"]


def test_down_under_load_and_up_again() -> None:
    packets = Feed().make(40)
    daemon = overloaded()
    run(daemon, packets[:150])
    assert daemon.mode == "pass_through"
    run(daemon, packets[150:900])
    assert "COMPUTE_OVERLOAD" in daemon.faults
    daemon.set_service(LIGHT)
    last = run(daemon, packets[900:])
    assert daemon.mode == "network"
    out = finish(daemon, last)
    steps = changes(out.events)
    assert steps[:3] == [
        ("network", "valid_mean"),
        ("valid_mean", "repeat"),
        ("repeat", "pass_through"),
    ]
    assert steps[-3:] == [("pass_through", "repeat"), ("repeat", "valid_mean"), ("valid_mean", "network")]
    assert "COMPUTE_OVERLOAD" not in daemon.faults
    counters = daemon.counters
    assert counters["packets_received"] == counters["packets_processed"] + sum(counters["packets_dropped"].values())
    assert sum(counters["packets_dropped"].values()) == 0, "passing through keeps up: nothing may be lost"
    assert counters["mode_changes"] == len(steps)
    by_frame = {}
    for _, data in out.columns:
        for column in read_columns(data):
            by_frame[column.frame] = max(by_frame.get(column.frame, 0), MODES.index(column.mode))
    assert {r["frame"]: MODES.index(r["mode"]) for r in out.ledger} == by_frame


def test_hysteresis_waits_longer_after_an_early_climb() -> None:
    packets = Feed().make(60)
    daemon = overloaded({"service_ns": [2 * ARRIVAL_NS] * 3 + [ARRIVAL_NS // 8]})
    last = run(daemon, packets)
    events = [e for e in finish(daemon, last).events if e["kind"] == "mode"]
    climbs = [e["time_ns"] for e in events if e["b"] < e["a"]]
    waits = np.diff(climbs)
    assert len(climbs) >= 3
    assert waits[-1] > 1.5 * waits[0], "the load never ends: climbs must become rarer"
    for before, after in pairwise(events):
        assert before["b"] == after["a"]


def test_without_ladder_packets_go_stale() -> None:
    daemon = overloaded(sabotage=["react_ladder_down"])
    last = run(daemon, Feed().make(5))
    finish(daemon, last)
    dropped = daemon.counters["packets_dropped"]
    assert dropped["stale"] > 100
    counters = daemon.counters
    assert counters["packets_received"] == counters["packets_processed"] + sum(dropped.values())
    assert daemon.status["lag_max_ns"] < 60 * MS, "a dropped packet costs no work"


def test_without_stale_the_queue_overflows() -> None:
    daemon = overloaded({"queue_packets": 64}, sabotage=["react_ladder_down", "react_stale"])
    finish(daemon, run(daemon, Feed().make(5)))
    assert daemon.counters["packets_dropped"]["queue"] > 100
    assert daemon.counters["frames_missed"] > 0
    assert "COMPUTE_DEADLINE" in daemon.status["faults_ever"]


def test_a_command_cannot_be_better_than_the_floor() -> None:
    daemon = Daemon(model_file(), {"mode_floor": 2})
    finish(daemon, run(daemon, Feed().make(1.2)))
    assert daemon.counters["columns_by_mode"][:2] == [0, 0]
