"""What concerns the device itself: damaged memory, slow work, deadlines, models, commands, restarts."""

from __future__ import annotations

from typing import Any

import pytest
from daemon_feed import MODELS, Feed, finish, model_file, run

from upbeam.runtime.daemon import REGIONS, Daemon, DaemonError, check_names, default_settings, read_columns

PACKETS_PER_TURN = 181


def daemon_for(settings: dict[str, Any] | None = None, **kwargs: Any) -> Daemon:
    return Daemon(model_file(), {"service_ns": [100_000] * 4, **(settings or {})}, **kwargs)


def of_kind(events: list[dict[str, Any]], kind: str) -> list[dict[str, Any]]:
    return [event for event in events if event["kind"] == kind]


# ------------------------------------------------------------------------------------------------- integrity


@pytest.mark.parametrize("region", ["model", "config", "stream"])
def test_a_flipped_bit_is_found_and_repaired(region: str) -> None:
    """Within the stated number of frames; afterwards the bits are those of an undamaged daemon again."""
    packets = Feed().make(40)
    clean, damaged = daemon_for(), daemon_for()
    at = 5 * PACKETS_PER_TURN
    for daemon in (clean, damaged):
        run(daemon, packets[:at])
        daemon.take()
    period = damaged.status["integrity_period_frames"]
    # deadline_ns of the configuration; of the model a weight; of the stream the number that tests may damage
    bit = {"model": 8 * 100 + 3, "config": 8 * 60 + 5, "stream": 7}[region]
    damaged.flip_bit(region, bit)
    run(damaged, packets[at : at + (period + 2) * PACKETS_PER_TURN])
    out = damaged.take()
    (event,) = of_kind(out.events, "integrity")
    assert REGIONS[event["a"]] == region
    assert event["b"] == 1, "repaired"
    assert event["frame"] - 5 <= period + 1
    assert any(e["kind"] == "fault_set" and e["fault"] == "COMPUTE_INTEGRITY" for e in out.events)
    rest = packets[at + (period + 2) * PACKETS_PER_TURN :]
    after = finish(damaged, run(damaged, rest))
    run(clean, packets[at : at + (period + 2) * PACKETS_PER_TURN])
    clean.take()
    expected = finish(clean, run(clean, rest))
    assert [c.distance.tolist() for _, d in after.columns for c in read_columns(d)] == [
        c.distance.tolist() for _, d in expected.columns for c in read_columns(d)
    ]
    assert damaged.faults == []
    counters = damaged.counters
    assert counters["integrity_failures"] == counters["integrity_repairs"] == 1


def test_a_damaged_kept_file_is_told_and_a_new_one_heals() -> None:
    packets = Feed().make(40)
    daemon = daemon_for()
    now = run(daemon, packets[:PACKETS_PER_TURN])
    daemon.flip_bit("kept", 8 * 5000)
    now = run(daemon, packets[PACKETS_PER_TURN : 10 * PACKETS_PER_TURN])
    assert "COMPUTE_INTEGRITY" in daemon.faults
    assert daemon.mode == "network", "the tables in use are good"
    daemon.swap_model(model_file(), now)
    finish(daemon, run(daemon, packets[10 * PACKETS_PER_TURN :]))
    assert daemon.faults == []


def test_with_both_copies_damaged_no_row_is_generated() -> None:
    packets = Feed().make(40)
    daemon = daemon_for()
    run(daemon, packets[:PACKETS_PER_TURN])
    daemon.flip_bit("kept", 8 * 5000)
    daemon.flip_bit("model", 8 * 100)
    now = run(daemon, packets[PACKETS_PER_TURN : 10 * PACKETS_PER_TURN])
    assert daemon.mode == "pass_through"
    daemon.swap_model(model_file(), now)
    finish(daemon, run(daemon, packets[10 * PACKETS_PER_TURN :]))
    assert daemon.mode == "network"
    assert daemon.faults == []


def test_sabotaged_repair_leaves_the_damage() -> None:
    daemon = daemon_for(sabotage=["react_repair"])
    packets = Feed().make(20)
    run(daemon, packets[:PACKETS_PER_TURN])
    daemon.flip_bit("model", 8 * 100)
    finish(daemon, run(daemon, packets[PACKETS_PER_TURN:]))
    assert daemon.counters["integrity_repairs"] == 0
    assert daemon.counters["integrity_failures"] > 1
    assert "COMPUTE_INTEGRITY" in daemon.faults


# ------------------------------------------------------------------------------------------------ service time


@pytest.mark.parametrize("sabotage", [[], ["compute_throttle"]])
def test_slower_work_is_throttling(sabotage: list[str]) -> None:
    daemon = daemon_for(sabotage=sabotage)
    packets = Feed().make(60)
    run(daemon, packets[: 10 * PACKETS_PER_TURN])
    assert daemon.faults == []
    daemon.set_service([200_000] * 4)
    run(daemon, packets[10 * PACKETS_PER_TURN : 22 * PACKETS_PER_TURN])
    assert daemon.faults == ([] if sabotage else ["COMPUTE_THROTTLE"])
    assert daemon.mode == "network"
    daemon.set_service([100_000] * 4)
    finish(daemon, run(daemon, packets[22 * PACKETS_PER_TURN :]))
    assert daemon.faults == []


@pytest.mark.parametrize("sabotage", [[], ["compute_deadline"]])
def test_missed_deadlines_set_the_fault(sabotage: list[str]) -> None:
    daemon = daemon_for({"deadline_ns": 650_000}, sabotage=sabotage)
    out = finish(daemon, run(daemon, Feed().make(12)))
    assert daemon.counters["frames_missed"] == 0
    slow = daemon_for({"deadline_ns": 300_000, "service_ns": [500_000] * 4}, sabotage=sabotage)
    out = finish(slow, run(slow, Feed().make(12)))
    judged = [r for r in out.ledger if r["verdict"] != "partial"]
    assert all((r["latency_ns"] > 300_000) == (r["verdict"] == "missed") for r in judged)
    assert slow.counters["frames_missed"] == len([r for r in judged if r["verdict"] == "missed"]) > 3
    assert ("COMPUTE_DEADLINE" in slow.status["faults_ever"]) == (not sabotage)


# ------------------------------------------------------------------------------------------------------ models


def test_a_swap_takes_effect_at_a_frame_boundary() -> None:
    packets = Feed().make(4)
    settings = {"any_model": 1}
    daemon = daemon_for(settings)
    now = run(daemon, packets[:250])
    other = (MODELS / "hdl-64e.ubm").read_bytes()
    daemon.swap_model(other, now)
    out = finish(daemon, run(daemon, packets[250:]))
    columns = [c for _, data in out.columns for c in read_columns(data)]
    crcs = {c.frame: set() for c in columns}
    for column in columns:
        crcs[column.frame].add(column.model_crc32)
    assert all(len(models) == 1 for models in crcs.values()), "no frame has rows of two models"
    assert crcs[0] == crcs[1] != crcs[2] == crcs[3]
    assert len(columns) == 12 * len(packets), "no column was lost by it"
    assert [r["verdict"] for r in out.ledger] == ["partial", "met", "met", "met", "partial"][: len(out.ledger)]
    (event,) = of_kind(out.events, "model_swapped")
    assert {event["value"]} == crcs[3] == {daemon.status["model_crc32"]}


def test_bad_models_are_refused_and_the_old_one_stays() -> None:
    packets = Feed().make(3)
    daemon = daemon_for()
    now = run(daemon, packets[:100])
    before = daemon.status["model_crc32"]
    good = model_file()
    for bad in (good[:-1], b"", good[:500] + bytes([good[500] ^ 1]) + good[501:], model_file("vlp-32c"), b"x" * 99):
        with pytest.raises(DaemonError):
            daemon.swap_model(bad, now)
    assert daemon.counters["models_rejected"] == 5
    assert daemon.faults == ["MODEL_REJECTED"]
    finish(daemon, run(daemon, packets[100:]))
    assert daemon.status["model_crc32"] == before
    assert daemon.counters["models_swapped"] == 0
    assert daemon.counters["columns_out"] == 12 * len(packets)


def test_impossible_settings_are_refused_by_name() -> None:
    for name, value in {
        "sensor": 3,
        "rpm": 5000,
        "cut_mdeg": 360_000,
        "precision": 9,
        "ladder_up_ns": 10**9,
        "stale_ns": 1,
        "ledger_capacity": 0,
        "queue_packets": 10**6,
        "ladder_down_ns": (3, 2, 1),
    }.items():
        with pytest.raises(DaemonError, match=name):
            Daemon(model_file(), {name: value})
    with pytest.raises(DaemonError, match=r"SENS\.name"):
        Daemon(model_file("vlp-32c"))
    with pytest.raises(DaemonError, match="nonsense"):
        Daemon(model_file(), {"nonsense": 1})
    assert set(default_settings()) >= {"sensor", "sabotage", "service_ns"}


def test_names_of_what_sabotage_takes_out() -> None:
    """The first are the faults of the fault memory, in its order."""
    names = check_names()
    assert len(set(names)) == len(names)
    assert names[0] == "sensor_timeout"
    assert names[28] == "power_reset"
    assert all(name.startswith("react_") for name in names[29:])
    with pytest.raises(DaemonError, match="unheard_of"):
        daemon_for(sabotage=["unheard_of"])


def test_the_same_calls_give_the_same_bytes() -> None:
    def everything() -> Any:
        daemon = daemon_for()
        return finish(daemon, run(daemon, Feed("hdl-32e", dual=True).make(2.5)))

    assert everything() == everything()


def test_packets_after_the_end_are_counted() -> None:
    packets = Feed().make(1)
    daemon = daemon_for()
    now = run(daemon, packets[:50])
    daemon.end(now)
    for packet in packets[50:60]:
        daemon.packet(packet.data, packet.time_ns)
    counters = daemon.counters
    assert counters["packets_dropped"]["ended"] == 10
    assert counters["packets_received"] == counters["packets_processed"] + 10
    assert daemon.status["ended"]


def test_ledger_columns_and_can_tell_the_same_story() -> None:
    packets = Feed(rpm=1200).make(8)
    daemon = daemon_for()
    out = finish(daemon, run(daemon, [p for i, p in enumerate(packets) if i % 97]))
    columns = [c for _, data in out.columns for c in read_columns(data)]
    for record in out.ledger:
        own = [c for c in columns if c.frame == record["frame"]]
        assert record["missing_columns"] == sum(bool(c.flags & 8) for c in own)
        times = [t for t, data in out.columns if read_columns(data)[0].frame == record["frame"]]
        hdl = [t for t, _ in out.hdl64 if t >= times[-1]]
        assert record["output_ns"] == max(times[-1], hdl[0] if hdl else 0), "when the last packet left"
        assert record["latency_ns"] == record["output_ns"] - record["last_input_ns"]
    on_can = [frame for frame in out.can if frame.id == 0x220]
    assert len(on_can) == len(out.ledger)
    assert daemon.counters["frames_closed"] == len(out.ledger)
