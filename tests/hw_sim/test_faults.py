"""Faults on the wire: what each does to the packets, and that it does nothing else."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from upbeam.hw_sim.faults import FAULTS, DeviceFault, PacketFault, apply_faults, make_fault
from upbeam.hw_sim.faults.device import Throttle
from upbeam.hw_sim.faults.physics import FOG_VISIBILITY_M, FogOptics, fog_returns
from upbeam.hw_sim.sensor import DATA_PORT, SensorConfig, SimulatedSensor, blocks, is_data, is_position
from upbeam.model.beams import beam_table

BEAMS = beam_table("vlp-32c")
PACKET_KINDS = sorted(kind for kind, cls in FAULTS.items() if issubclass(cls, PacketFault))
DELAYING = {"duplicate": 0.2, "reorder": 1.0, "flood": 0.4}
"""Milliseconds by which a fault may reach beyond its end."""


@pytest.fixture(scope="module")
def stream() -> list:
    return list(SimulatedSensor(SensorConfig()).until(500_000_000))


def faulty(stream: list, *tables: dict, seed: int = 0) -> list:
    return list(apply_faults(stream, [make_fault(t) for t in tables], BEAMS, seed=seed))


def data(stream: list, from_s: float = 0.0, until_s: float = 9.0) -> np.ndarray:
    """Data packets of a span, as structured arrays."""
    kept = [blocks(d.payload) for d in stream if is_data(d) and from_s * 1e9 <= d.time_ns < until_s * 1e9]
    return np.concatenate(kept)


@pytest.mark.parametrize("kind", PACKET_KINDS)
def test_a_fault_keeps_to_its_span_and_to_its_seed(stream: list, kind: str) -> None:
    table = {"kind": kind, "from_s": 0.15, "until_s": 0.35}
    out = faulty(stream, table)
    assert out == faulty(stream, table)
    assert out != stream
    assert all(a.time_ns <= b.time_ns for a, b in pairwise(out))

    def before(datagrams: list) -> list:
        return [d for d in datagrams if d.time_ns < 0.15e9]

    assert before(out) == before(stream)
    if not FAULTS[kind].lasting:  # type: ignore[attr-defined]
        end = 0.35e9 + DELAYING.get(kind, 0.0) * 1e6
        assert [d for d in out if d.time_ns >= end] == [d for d in stream if d.time_ns >= end]


@pytest.mark.parametrize("kind", ["loss", "burst_loss", "jitter", "flood", "crosstalk", "fog", "truncate"])
def test_another_seed_is_another_fault(stream: list, kind: str) -> None:
    assert faulty(stream, {"kind": kind}) != faulty(stream, {"kind": kind, "seed": 1})
    assert faulty(stream, {"kind": kind}) != faulty(stream, {"kind": kind}, seed=1)


def test_faults_act_one_after_the_other(stream: list) -> None:
    dead, jump = {"kind": "dead_laser", "beam": 3}, {"kind": "azimuth_jump", "degrees": 90.0}
    both = data(faulty(stream, dead, jump))
    np.testing.assert_array_equal(both["blocks"]["azimuth"], data(faulty(stream, jump))["blocks"]["azimuth"])
    np.testing.assert_array_equal(both["blocks"]["returns"], data(faulty(stream, dead))["blocks"]["returns"])


def test_nothing_in_nothing_out() -> None:
    for kind in PACKET_KINDS:
        assert list(apply_faults([], [make_fault({"kind": kind})], BEAMS)) == []


def test_loss_is_independent() -> None:
    many = list(SimulatedSensor(SensorConfig()).until(4_000_000_000))
    kept = set(faulty(many, {"kind": "loss", "rate": 0.2}))
    lost = np.array([d not in kept for d in many])
    assert abs(lost.mean() - 0.2) < 4 * np.sqrt(0.16 / len(many))
    again = lost[1:][lost[:-1]].mean()
    assert abs(again - 0.2) < 4 * np.sqrt(0.16 / lost.sum())


def test_bursts_are_as_long_as_said() -> None:
    many = list(SimulatedSensor(SensorConfig()).until(8_000_000_000))
    kept = set(faulty(many, {"kind": "burst_loss", "enter": 0.01, "leave": 0.2}))
    lost = np.array([d not in kept for d in many], dtype=int)
    edges = np.diff(np.concatenate(([0], lost, [0])))
    lengths = np.flatnonzero(edges < 0) - np.flatnonzero(edges > 0)
    assert abs(lengths.mean() - 5.0) < 4 * lengths.std() / np.sqrt(len(lengths))
    expected = 0.01 / (0.01 + 0.2)
    assert abs(lost.mean() - expected) < 0.3 * expected


def test_network_faults_change_order_and_number_only(stream: list) -> None:
    for kind in ("reorder", "jitter"):
        assert sorted(d.payload for d in faulty(stream, {"kind": kind})) == sorted(d.payload for d in stream)
    doubled = faulty(stream, {"kind": "duplicate", "rate": 1.0})
    assert sorted(d.payload for d in doubled) == sorted([d.payload for d in stream] * 2)
    assert [d.payload for d in faulty(stream, {"kind": "jitter"})] == [d.payload for d in stream]
    assert [d.payload for d in faulty(stream, {"kind": "reorder"})] != [d.payload for d in stream]


def test_damage(stream: list) -> None:
    assert {len(d.payload) for d in faulty(stream, {"kind": "wrong_size", "rate": 1.0})} == {1248}
    assert all(len(d.payload) < 1206 for d in faulty(stream, {"kind": "truncate", "rate": 1.0}))
    flags = data(faulty(stream, {"kind": "corrupt", "rate": 1.0}))["blocks"]["flag"]
    assert np.all(np.sum(flags != 0xEEFF, axis=1) == 1)
    assert not any(d.port == DATA_PORT for d in faulty(stream, {"kind": "wrong_port"}))
    flood = faulty(stream, {"kind": "flood", "times": 3})
    assert len(flood) == 4 * len(stream)


def test_azimuth_faults(stream: list) -> None:
    stuck = data(faulty(stream, {"kind": "stuck_azimuth", "from_s": 0.2}), 0.2)
    assert len(np.unique(stuck["blocks"]["azimuth"])) == 1
    plain, jumped = data(stream), data(faulty(stream, {"kind": "azimuth_jump", "degrees": -30.0}))
    away = (jumped["blocks"]["azimuth"].astype(int) - plain["blocks"]["azimuth"]) % 36000
    assert set(np.unique(away)) == {33000}


@pytest.mark.parametrize("scale", [0.5, 0.9, 1.3])
def test_speed_changes_and_goes_on_without_a_jump(stream: list, scale: float) -> None:
    azimuth = data(faulty(stream, {"kind": "rpm", "scale": scale, "from_s": 0.1, "until_s": 0.3}))["blocks"]["azimuth"]
    steps = np.diff(azimuth.ravel().astype(int)) % 36000
    at = np.arange(len(steps)) * 55.296e-6
    inside = (at > 0.101) & (at < 0.298)
    assert steps[inside].mean() == pytest.approx(39.81 * scale, rel=1e-3)
    assert steps[at > 0.302].mean() == pytest.approx(39.81, rel=1e-3)
    assert steps.max() <= np.ceil(40 * max(1, scale)) + 1


def test_beam_faults_touch_their_beam_only(stream: list) -> None:
    plain = data(stream)["blocks"]["returns"]
    for table, beams in (
        ({"kind": "dead_laser", "beam": 7}, [7]),
        ({"kind": "stuck_ring", "beam": 0}, [0]),
        ({"kind": "beams_missing", "every": 8}, [0, 8, 16, 24]),
    ):
        returns = data(faulty(stream, table))["blocks"]["returns"]
        cells = BEAMS.laser_id[beams].astype(int)
        others = np.setdiff1d(np.arange(32), cells)
        np.testing.assert_array_equal(returns[..., others], plain[..., others])
        assert len(np.unique(returns["distance"][..., cells])) == 1


def test_a_vlp_16_has_two_places_for_a_beam() -> None:
    beams = beam_table("vlp-16")
    stream = SimulatedSensor(SensorConfig(model="vlp-16")).until(50_000_000)
    dead = list(apply_faults(stream, [make_fault({"kind": "dead_laser", "beam": 5})], beams))
    empty = ~data(dead)["blocks"]["returns"]["distance"].any(axis=(0, 1))
    assert list(np.flatnonzero(empty)) == [int(beams.laser_id[5]), int(beams.laser_id[5]) + 16]


def test_zero_and_saturated(stream: list) -> None:
    assert not data(faulty(stream, {"kind": "all_zero"}))["blocks"]["returns"]["distance"].any()
    returns = data(faulty(stream, {"kind": "saturated"}))["blocks"]["returns"]
    assert np.array_equal(returns["intensity"] == 255, returns["distance"] > 0)


def test_clock_faults(stream: list) -> None:
    plain = data(stream)["tail"]["toh_us"].astype(np.int64)
    jumped = data(faulty(stream, {"kind": "time_jump", "ms": 250.0, "from_s": 0.2}))["tail"]["toh_us"] - plain
    assert set(jumped[: len(jumped) // 3]) == {0}
    assert set(jumped[-100:]) == {250_000}
    drift = data(faulty(stream, {"kind": "clock_drift", "ppm": 1000.0}))["tail"]["toh_us"] - plain
    assert np.all(np.diff(drift) >= 0)
    assert drift[-1] == pytest.approx(500, abs=2)


def test_telemetry_faults(stream: list) -> None:
    hot = faulty(stream, {"kind": "thermal_shutdown"})
    assert hot
    assert all(map(is_position, hot))
    lost = faulty(stream, {"kind": "pps_lost"})
    assert [d for d in lost if is_data(d)] == [d for d in stream if is_data(d)]
    assert all(a.payload != b.payload for a, b in zip(lost, stream, strict=True) if is_position(a))


# ------------------------------------------------------------------------------------------------------------ physics


def test_fog_takes_more_the_denser_it_is(stream: list) -> None:
    plain = data(stream)["blocks"]["returns"]["distance"]
    shares, reach = [], []
    for severity in FOG_VISIBILITY_M:
        returns = data(faulty(stream, {"kind": "fog", "severity": severity}))["blocks"]["returns"]
        shares.append(np.mean((returns["distance"] == plain) & (plain > 0)))
        reach.append(np.percentile(returns["distance"][returns["distance"] > 0], 95) * 0.004)
        assert np.all((returns["distance"] <= plain) | (plain == 0)), "an echo behind the target"
    assert shares[0] > shares[1] > shares[2]
    assert reach[2] < reach[0]
    assert shares[2] < 0.7 * np.mean(plain > 0)


def test_no_fog_changes_nothing(rng: np.random.Generator) -> None:
    counts = rng.integers(500, 5000, (100, 32)).astype(np.uint16)  # 2 to 20 m: within reach in clear air
    intensity = rng.integers(10, 256, (100, 32)).astype(np.uint8)
    out = fog_returns(FogOptics(1e9), counts, intensity, 0.004, rng)
    np.testing.assert_array_equal(out[0], counts)
    np.testing.assert_array_equal(out[1], intensity)


def test_fog_follows_its_equations(rng: np.random.Generator) -> None:
    optics = FogOptics(80.0)
    # Koschmieder: at the meteorological optical range 5 % of a contrast is left.
    assert np.exp(-optics.extinction * 80.0) == pytest.approx(0.05)
    # A 10 % target in clear air is seen up to its reach, and no farther.
    clear = FogOptics(1e12)
    at = np.array([79.9, 80.1])
    assert list(clear.received(at, np.full(2, 0.1)) >= clear.threshold()) == [True, False]
    # Of half the visibility e^-2 of 0.05^(1/2) twice is left: 5 %.
    ratio = optics.received(np.array([40.0]), np.ones(1)) / clear.received(np.array([40.0]), np.ones(1))
    assert ratio[0] == pytest.approx(0.05, rel=1e-6)
    # Ranges of echoes have the survival function stated.
    metres, _ = optics.backscatter((200_000,), rng)
    for r in (5.0, 8.0, 20.0):
        share = optics.overlap_m / r * np.exp(-2 * optics.extinction * (r - optics.overlap_m))
        assert np.mean(metres > r) == pytest.approx(share, abs=0.005)


def test_crosstalk_hits_its_share_and_lies_before_the_target(stream: list) -> None:
    plain = data(stream)["blocks"]["returns"]["distance"]
    hit = data(faulty(stream, {"kind": "crosstalk", "rate": 0.1}))["blocks"]["returns"]["distance"]
    changed = hit != plain
    assert abs(changed.mean() - 0.1) < 0.002
    assert np.all(hit[changed & (plain > 0)] < plain[changed & (plain > 0)])


# ----------------------------------------------------------------------------------------------------- tables, devices


@pytest.mark.parametrize(
    ("table", "says"),
    [({}, "expected one of"), ({"kind": "los"}, "'los'"), ({"kind": "loss", "rte": 1}, "unknown key rte"),
     ({"kind": "loss", "rate": "much"}, "expected float"), ({"kind": "loss", "from_s": 2.0, "until_s": 1.0}, "from"),
     ({"kind": "loss", "from_s": 1.0, "from_frame": 1}, "both"), ({"kind": "bit_flip", "region": "heap"}, "region"),
     ({"kind": "throttle"}, "expected an end")],
)  # fmt: skip
def test_a_wrong_table_is_named(table: dict, says: str) -> None:
    with pytest.raises(ValueError, match=says):
        make_fault(table)


@pytest.mark.parametrize(
    "table",
    [{"kind": "loss", "rate": 1.5}, {"kind": "fog", "severity": "thick"}, {"kind": "dead_laser", "beam": 32},
     {"kind": "rpm", "scale": 9.0}, {"kind": "flood", "times": 0}],
)  # fmt: skip
def test_a_value_out_of_range_is_found_before_the_first_packet(table: dict) -> None:
    with pytest.raises(ValueError, match="expected"):
        list(apply_faults([], [make_fault(table)], BEAMS))


def test_frames_are_turns() -> None:
    one = make_fault({"kind": "silence", "from_frame": 10, "until_frame": 15}, rate_hz=10.0)
    assert (one.from_s, one.until_s) == (1.0, 1.5)


def test_device_faults_tell_what_happens_when() -> None:
    for kind, cls in FAULTS.items():
        if not issubclass(cls, DeviceFault):
            continue
        moments = make_fault({"kind": kind, "from_s": 1.0, "until_s": 2.0}).moments()  # type: ignore[attr-defined]
        assert moments[0].time_s == 1.0
        assert moments[0].settings is not None
        assert (moments[-1].settings is None) == (not cls.once)
    throttle = Throttle(from_s=0.0, until_s=4.0, factor=3.0, steps=2)
    assert [(m.time_s, m.settings and m.settings["factor"]) for m in throttle.moments()] == [
        (0.0, 2.0), (1.0, 3.0), (3.0, 2.0), (4.0, None),
    ]  # fmt: skip


def test_replacing_a_field_keeps_the_checks() -> None:
    with pytest.raises(ValueError, match="expected 0 <= from <= until"):
        replace(make_fault({"kind": "loss"}), until_s=-1.0)
