"""The real-time runner from Python. What depends on time runs on virtual time; of a real run only the accounts
count."""

from __future__ import annotations

import json
import os
import signal
import threading
from typing import Any

import numpy as np
import pytest

from upbeam.model.beams import uniform_beam_table
from upbeam.model.network import FoldedNetwork
from upbeam.model.rules import BEAMS, Rules
from upbeam.quant.ubm import ModelFile
from upbeam.runtime.live import (
    LiveConfig,
    LiveConfigError,
    LiveProgress,
    LiveResult,
    explained_by_stalls,
    firing_columns,
    quantiles_ms,
    run_live,
)
from upbeam.runtime.upsampler import ColumnStream, Model

COLUMNS = 24
FRAMES = 6
VIRTUAL: dict[str, Any] = {"clock": "virtual", "rate_hz": 100.0, "columns_per_packet": 12}
"""Two packets a frame, 5 ms apart."""


@pytest.fixture(scope="module")
def model() -> Model:
    rng = np.random.default_rng(3)

    def network() -> FoldedNetwork:
        return FoldedNetwork(
            weight=rng.normal(0, 0.1, (4, 7)),
            bias=rng.normal(0, 0.1, 4),
            output_weight=rng.normal(0, 0.1, 4),
            output_bias=0.1,
            skip=1.0,
            slope=0.01,
        )

    table = uniform_beam_table(BEAMS, top_deg=10.0, bottom_deg=-20.0)
    return Model(ModelFile(rules=Rules.for_beams(table, columns=COLUMNS), folded=(network(), network())).to_bytes())


@pytest.fixture
def frames(rng: np.random.Generator) -> tuple[Any, Any]:
    shape = (FRAMES, COLUMNS, BEAMS)
    return rng.integers(1500, 30000, shape).astype(np.uint16), rng.integers(0, 256, shape).astype(np.uint8)


def check_accounts(result: LiveResult) -> None:
    c = result.counts
    assert c["frames_begun"] == c["frames_met"] + c["frames_missed"] + c["frames_partial"] + c["frames_empty"]
    assert c["packets_played"] == c["packets_taken"] + c["packets_dropped_fault"] + c["packets_dropped_overflow"]
    assert c["columns_played"] == c["columns_taken"] + c["columns_missing"]
    assert c["columns_taken"] == sum(r["columns_received"] for r in result.ledger)
    assert c["columns_refused"] == 0
    assert len(result.ledger) == c["frames_begun"] - c["frames_empty"]
    assert len(result.drops) == c["packets_dropped_fault"] + c["packets_dropped_overflow"]


def test_queueing_by_hand(model: Model, frames: tuple[Any, Any]) -> None:
    # A packet every 5 ms takes 8 ms: packet p is done at 8 (p + 1). Frame f ends with packet 2f + 1, received at
    # 5 (2f + 1), and is complete with the first column of packet 2f + 2; the last one with the flush.
    config = LiveConfig(**VIRTUAL, service_packet_us=8000, service_column_us=0, deadline_ms=30)
    result = run_live(model, *frames, config)
    assert [r["latency_ns"] / 1e6 for r in result.ledger] == [19, 25, 31, 37, 43, 41]
    assert [r["verdict"] for r in result.ledger] == ["met"] * 2 + ["missed"] * 4
    assert [r["wait_ns"] / 1e6 for r in result.ledger] == [5, 5, 5, 5, 5, 0]
    assert [r["flushed"] for r in result.ledger] == [False] * 5 + [True]
    assert not any(r["explained"] for r in result.ledger)
    assert (result.misses, result.misses_unexplained, result.frames) == (4, 4, 6)
    assert result.latency_ms == {"p50": 31, "p90": 43, "p99": 43, "p999": 43, "max": 43, "mean": pytest.approx(196 / 6)}
    assert result.latency_histogram_ms["max"] == 43
    assert result.packet_compute_us["max"] == 8000
    check_accounts(result)


def test_virtual_runs_are_equal(model: Model, frames: tuple[Any, Any], rng: np.random.Generator) -> None:
    config = LiveConfig(
        **VIRTUAL,
        frames=100,
        ring_packets=4,
        service_us=rng.uniform(0, 12000, 37).tolist(),
        jitter_us=rng.uniform(0, 9000, 41).tolist(),
        keep_frames=(17,),
    )
    first, second = (run_live(model, *frames, config) for _ in range(2))
    assert first.counts["packets_dropped_overflow"] > 0
    assert first.to_dict() == second.to_dict()
    assert np.array_equal(first.images[17].distance, second.images[17].distance)
    check_accounts(first)


def test_output_is_the_streams(model: Model, frames: tuple[Any, Any]) -> None:
    distance, intensity = frames
    config = LiveConfig(**VIRTUAL, service_packet_us=1, service_column_us=0, keep_frames=range(FRAMES))
    result = run_live(model, distance, intensity, config)
    stream = ColumnStream(model)
    parts = [stream.push(distance.reshape(-1, BEAMS), intensity.reshape(-1, BEAMS), 0), stream.flush()]
    expected_d = np.concatenate([p.distance for p in parts]).reshape(FRAMES, COLUMNS, -1)
    expected_i = np.concatenate([p.intensity for p in parts]).reshape(FRAMES, COLUMNS, -1)
    assert sorted(result.images) == list(range(FRAMES))
    for f, image in result.images.items():
        assert np.array_equal(image.distance, expected_d[f].T)
        assert np.array_equal(image.intensity, expected_i[f].T)
        assert np.array_equal(image.distance[0::2], distance[f].T)
    assert result.last is not None
    assert result.last.frame == FRAMES - 1
    assert np.array_equal(result.last.distance, expected_d[-1].T)


def test_dropped_packets_are_named(model: Model, frames: tuple[Any, Any]) -> None:
    config = LiveConfig(**VIRTUAL, service_packet_us=1, service_column_us=0, drop_packets=(7, 4, 5))
    result = run_live(model, *frames, config)
    assert [(r["frame"], r["missing_columns"]) for r in result.ledger] == [(0, 0), (1, 0), (3, 12), (4, 0), (5, 0)]
    assert [(d["packet"], d["columns"], d["cause"]) for d in result.drops] == [(p, 12, "fault") for p in (4, 5, 7)]
    assert result.counts["frames_empty"] == 1
    assert result.frames == FRAMES
    assert result.counts["columns_missing"] == 36
    check_accounts(result)


def test_a_stream_that_begins_late_is_partial(model: Model, frames: tuple[Any, Any]) -> None:
    config = LiveConfig(**VIRTUAL, service_packet_us=1, service_column_us=0, drop_packets=(0,))
    result = run_live(model, *frames, config)
    assert [r["verdict"] for r in result.ledger] == ["partial"] + ["met"] * 5
    assert result.ledger[0]["missing_columns"] == 12
    check_accounts(result)


def test_overflow_by_hand(model: Model, frames: tuple[Any, Any]) -> None:
    # Two places, 8 ms of service, a packet every 5 ms: see the same case in c/test_live.c.
    config = LiveConfig(**VIRTUAL, service_packet_us=8000, service_column_us=0, ring_packets=2)
    result = run_live(model, *frames, config)
    assert [(d["packet"], d["cause"]) for d in result.drops] == [(p, "overflow") for p in (3, 6, 9, 11)]
    assert [r["missing_columns"] for r in result.ledger] == [0, 12, 0, 12, 12, 12]
    check_accounts(result)


def test_interrupted_in_the_middle(model: Model, frames: tuple[Any, Any]) -> None:
    seen: list[LiveProgress] = []

    def interrupt(progress: LiveProgress) -> None:
        seen.append(progress)
        if progress.frames >= 3:
            raise KeyboardInterrupt

    config = LiveConfig(rate_hz=100, frames=1_000_000, columns_per_packet=12)
    result = run_live(model, *frames, config, on_progress=interrupt)
    assert result.stopped
    assert 3 <= result.frames < 1_000_000
    assert seen[-1].frames_total == 1_000_000
    assert all(r["verdict"] != "partial" for r in result.ledger[:-1])
    check_accounts(result)


def test_ctrl_c(model: Model, frames: tuple[Any, Any]) -> None:
    timers: list[threading.Timer] = []

    def press(progress: LiveProgress) -> None:
        if progress.frames >= 3 and not timers:
            timers.append(threading.Timer(0.02, os.kill, (os.getpid(), signal.SIGINT)))
            timers[0].start()

    result = run_live(model, *frames, LiveConfig(rate_hz=100, frames=1_000_000), on_progress=press)
    timers[0].join()
    assert result.stopped
    assert result.frames >= 3
    check_accounts(result)


def test_an_error_in_progress_ends_the_run(model: Model, frames: tuple[Any, Any]) -> None:
    def fail(progress: LiveProgress) -> None:
        raise RuntimeError("no terminal")

    with pytest.raises(RuntimeError, match="no terminal"):
        run_live(model, *frames, LiveConfig(rate_hz=100, frames=1_000_000), on_progress=fail)


def test_real_threads(model: Model, frames: tuple[Any, Any]) -> None:
    seen: list[LiveProgress] = []
    config = LiveConfig(rate_hz=50, frames=10, drop_packets=(5,), columns_per_packet=10, realtime=True)
    result = run_live(model, *frames, config, on_progress=seen.append)
    assert result.frames == 10
    assert not result.stopped
    assert result.counts["packets_dropped_fault"] == 1
    assert result.witnesses >= 1
    assert result.pacer_lateness_us["count"] == result.counts["packets_played"]
    assert seen[-1].frames == len(result.ledger)
    assert result.latency_ms["max"] == max(r["latency_ns"] for r in result.ledger) / 1e6
    check_accounts(result)


def test_result_round_trips_as_json(model: Model, frames: tuple[Any, Any]) -> None:
    config = LiveConfig(**VIRTUAL, service_packet_us=1, service_column_us=0, keep_frames=(1,))
    data = run_live(model, *frames, config).to_dict()
    assert json.loads(json.dumps(data, allow_nan=False)) == data
    assert {"frames", "misses", "deadline_ms", "clock", "latency_ms", "ledger"} <= set(data)
    assert not {"images", "last"} & set(data)


@pytest.mark.parametrize(
    ("stalls", "last_input", "output", "explained"),
    [
        ([], 0, 60_000_000, False),
        ([(5_000_000, 20_000_000)], 0, 60_000_000, True),
        ([(5_000_000, 9_000_000)], 0, 60_000_000, False),
        # two cores at the same time count once
        ([(5_000_000, 6_000_000), (5_000_000, 6_000_000)], 0, 60_000_000, False),
        ([(5_000_000, 6_000_000), (20_000_000, 6_000_000)], 0, 60_000_000, True),
        # only the part within the latency
        ([(0, 20_000_000)], 15_000_000, 75_000_000, False),
        ([(0, 25_000_000)], 15_000_000, 75_000_000, True),
        ([(70_000_000, 20_000_000)], 0, 60_000_000, False),
    ],
)
def test_explanation(stalls: list[tuple[int, int]], last_input: int, output: int, explained: bool) -> None:
    assert explained_by_stalls(stalls, last_input, output, 50.0) is explained


def test_quantiles_are_latencies_that_occurred() -> None:
    assert quantiles_ms([]) == {}
    assert quantiles_ms([3_000_000])["p50"] == 3
    ranks = quantiles_ms([n * 1_000_000 for n in range(1, 201)])
    assert (ranks["p50"], ranks["p99"], ranks["p999"], ranks["max"]) == (100, 198, 200, 200)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"rate_hz": 0.0}, "rate_hz is 0.0, expected 0.001 to 100"),
        ({"rate_hz": 101.0}, "rate_hz"),
        ({"rate_hz": float("nan")}, "rate_hz"),
        ({"deadline_ms": 0.0}, "deadline_ms"),
        ({"deadline_ms": float("inf")}, "deadline_ms"),
        ({"frames": 0}, "frames is 0, expected at least 1"),
        ({"clock": "sundial"}, "clock is sundial, expected one of real, virtual"),
        ({"precision": "fp64"}, "precision"),
        ({"cpu": "mmx"}, "cpu"),
        ({"wait": "hope"}, "wait"),
        ({"ring_packets": 100}, "ring_packets is 100, expected a power of two"),
        ({"columns_per_packet": 0}, "columns_per_packet"),
        ({"keep_frames": (-1,)}, "keep_frames is -1"),
        ({"drop_packets": (2, -3)}, "drop_packets is -3"),
        ({"pacer_spin_us": -1.0}, "pacer_spin_us"),
        ({"stall_threshold_ms": 0.0}, "stall_threshold_ms"),
        ({"clock": "virtual"}, "needs service times"),
        ({"clock": "virtual", "service_us": (1.0,), "service_packet_us": 1.0}, "one or the other"),
        ({"clock": "virtual", "service_us": (-1.0,)}, "service_us"),
        ({"clock": "virtual", "service_column_us": -1.0}, "service_column_us"),
        ({"service_us": (1.0,)}, "for clock 'virtual' only"),
        ({"jitter_us": (1.0,)}, "for clock 'virtual' only"),
    ],
)
def test_impossible_settings(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(LiveConfigError, match=message):
        LiveConfig(**settings)


def test_frames_that_do_not_fit(model: Model, frames: tuple[Any, Any]) -> None:
    distance, intensity = frames
    cases: list[tuple[Any, Any, LiveConfig, str]] = [
        (distance.astype(np.float32), intensity, LiveConfig(), "type of frames_distance is float32, expected uint16"),
        (distance, intensity.astype(np.uint16), LiveConfig(), "type of frames_intensity"),
        (distance[0], intensity[0], LiveConfig(), "shape of frames_distance"),
        (distance[:0], intensity[:0], LiveConfig(), "shape of frames_distance"),
        (distance[:, :, :31], intensity[:, :, :31], LiveConfig(), "shape of frames_distance"),
        (distance, intensity[:3], LiveConfig(), "shape of frames_intensity"),
        (distance[:, :12], intensity[:, :12], LiveConfig(), "columns of a frame is 12, expected the model's 24"),
        (distance, intensity, LiveConfig(columns_per_packet=25), "columns_per_packet is 25, expected at most 24"),
    ]
    for d, i, config, message in cases:
        with pytest.raises(LiveConfigError, match=message):
            run_live(model, d, i, config)


def test_precision_that_is_not_there(model: Model, frames: tuple[Any, Any]) -> None:
    with pytest.raises(ValueError, match="precision"):
        run_live(model, *frames, LiveConfig(precision="int8"))


def test_another_width_when_asked(model: Model, frames: tuple[Any, Any]) -> None:
    distance, intensity = (np.ascontiguousarray(a[:, :18]) for a in frames)
    config = LiveConfig(**VIRTUAL, service_packet_us=1, service_column_us=0, any_sensor=True)
    result = run_live(model, distance, intensity, config)
    assert (result.columns, result.counts["frames_met"]) == (18, FRAMES)
    check_accounts(result)


def test_firing_columns_of_images(rng: np.random.Generator) -> None:
    images = rng.integers(0, 100, (2, BEAMS, 7)).astype(np.uint16)
    columns = firing_columns(images)
    assert columns.shape == (2, 7, BEAMS)
    assert columns.flags.c_contiguous
    assert columns[1, 3, 5] == images[1, 5, 3]
