"""Estimates on devices: measured rows are met, intervals hold, more work never costs less; calibration, simulation."""

from __future__ import annotations

import dataclasses
import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from upbeam.power.calibrate import Work, calibrate, read_rows, with_rows, write_rows
from upbeam.power.catalogue import CatalogueError, device, device_names
from upbeam.power.cycles.host import pairs_of
from upbeam.power.deploy import target_service
from upbeam.power.energy import measured_rows
from upbeam.power.estimate import IMPLEMENTATIONS, Knowledge, Load, estimate_load, estimate_macs
from upbeam.power.host import estimate_host
from upbeam.power.measure import MeasureError, Recording
from upbeam.power.ops import count_model, count_operations
from upbeam.runtime.live import LiveConfig, run_live
from upbeam.runtime.upsampler import load_model

OTHERS = [name for name in device_names() if name != "host"]
WAYS = [(name, way) for name in OTHERS for way in IMPLEMENTATIONS[device(name).family]]
KEYS = {"value", "low", "high", "unit", "kind", "boundary", "source"}


@pytest.fixture(scope="module")
def known():
    return Knowledge.of()


@pytest.fixture(scope="module")
def model():
    return load_model()


@pytest.fixture(scope="module")
def load(model):
    return Load(count_model(model.file, model.columns), pairs_of(model.file))


def load_of_hidden(hidden, columns=2048, rate_hz=20.0):
    return Load(count_operations((8, 2, hidden), columns), (2 * -(-hidden // 2), 0), rate_hz=rate_hz)


def sound(one):
    """Every figure of an estimate has an interval that holds it, a kind, a boundary and a source."""
    for bounded in (one.latency_ms, one.power_w, one.energy_mj, one.increment_w, one.increment_mj):
        if bounded is None:
            continue
        f = bounded.figure
        assert set(bounded.as_dict()) == KEYS
        assert bounded.boundary
        assert f.source
        assert f.low <= f.value <= f.high
        assert f.low >= 0
    json.dumps(one.as_dict(), allow_nan=False)


@pytest.mark.parametrize(("name", "way"), WAYS)
def test_our_load_everywhere(name, way, known, load):
    one = estimate_load(device(name), load, known=known, implementation=way)
    sound(one)
    assert one.met in ("yes", "no", "not certain")
    assert one.sensors[1] <= one.sensors[0] <= one.sensors[2]
    assert one.energy_mj.figure.get("mJ") == pytest.approx(one.power_w.figure.get("W") * 50.0)
    measured = {row.device for row in measured_rows()}
    if name not in measured and not device(name).figures["power.idle"].kind.startswith("measured"):
        assert one.power_w.figure.kind == "assumption"
    assert one.increment_w.figure.kind == "assumption"
    assert one.increment_w.figure.get("W") < 0.2 * one.power_w.figure.get("W") or name == "ice40up5k"


@pytest.mark.parametrize("row", [r for r in measured_rows() if r.device in OTHERS and not r.is_idle])
def test_measured_rows_are_met_when_their_latency_is_given(row, known):
    one = estimate_macs(device(row.device), row.macs, row.latency_ms, known=known)
    sound(one)
    for got, true, unit in ((one.power_w, row.power_w, "W"), (one.energy_mj, row.energy_mj, "mJ")):
        value, low, high = got.figure.span(unit)
        assert low <= true <= high
        assert max(value / true, true / value) <= 1.1


@pytest.mark.parametrize("row", [r for r in measured_rows() if r.device in OTHERS and not r.is_idle])
def test_from_macs_alone_the_interval_holds_the_measured_row(row, known):
    one = estimate_macs(device(row.device), row.macs, known=known)
    sound(one)
    assert one.latency_ms.figure.low <= row.latency_ms <= one.latency_ms.figure.high
    assert one.energy_mj.figure.low <= row.energy_mj <= one.energy_mj.figure.high


@given(st.sampled_from(OTHERS), st.floats(1e3, 1e11), st.floats(1.0, 1e3))
def test_more_macs_never_cost_less(name, macs, more):
    known = KNOWN
    less, most = (estimate_macs(device(name), m, known=known) for m in (macs, macs * more))
    for what in ("latency_ms", "energy_mj"):
        a, b = (getattr(one, what).figure for one in (less, most))
        assert all(y >= x * (1 - 1e-9) for x, y in zip((a.value, a.low, a.high), (b.value, b.low, b.high), strict=True))


@given(st.sampled_from(WAYS), st.integers(2, 31), st.integers(8, 4000))  # one unit: another kind of FPGA core
def test_a_larger_network_never_costs_less(way, hidden, columns):
    name, runs_on = way
    small, large = load_of_hidden(hidden, columns), load_of_hidden(hidden + 1, columns)
    a = estimate_load(device(name), small, known=KNOWN, implementation=runs_on)
    b = estimate_load(device(name), large, known=KNOWN, implementation=runs_on)
    for what in ("latency_ms", "increment_w", "energy_mj"):
        x, y = (getattr(one, what).figure for one in (a, b))
        assert y.value >= x.value * (1 - 1e-9), what
        assert y.low >= x.low * (1 - 1e-9), what
        assert y.high >= x.high * (1 - 1e-9), what


@given(st.sampled_from([n for n in OTHERS if device(n).modes]), st.sampled_from(("cpu", "gpu")), st.integers(1, 32))
def test_a_faster_mode_is_never_slower(name, way, hidden):
    board, key = device(name), f"{way}_clock"
    modes = sorted(board.modes.values(), key=lambda m: m.figures[key].get("MHz"))
    times = [
        estimate_load(board, load_of_hidden(hidden), known=KNOWN, implementation=way, mode=m.name).latency_ms.figure
        for m in modes
    ]
    assert [t.value for t in times] == sorted((t.value for t in times), reverse=True)


KNOWN = Knowledge.of()


def test_the_architecture_decides_not_the_macs(known):
    """On one board 6.41 M multiply-accumulates cost 44 mJ and 59.46 M cost 2.5 mJ: the error says so."""
    errors = estimate_macs(device("xc7z020"), 6.41e6, known=known).errors
    assert errors.power < 1.15
    assert errors.energy_from_macs > 10
    assert set(errors.skill) == {"power", "latency", "energy"}


def test_a_device_without_rows_says_assumption(known):
    one = estimate_macs(device("ecp5-25"), 1e6, 1.0, known=known)
    assert one.power_w.figure.kind == one.energy_mj.figure.kind == "assumption"
    assert any("No measured row" in note for note in one.notes)


def test_what_cannot_be_estimated(known, load):
    with pytest.raises(CatalogueError, match="no mode 'fast', known: maxn, 5w"):
        estimate_load(device("jetson-nano"), load, known=known, mode="fast")
    with pytest.raises(CatalogueError, match="runs our load on fpga"):
        estimate_load(device("ecp5-25"), load, known=known, implementation="gpu")
    with pytest.raises(CatalogueError, match="give --latency-ms"):
        estimate_macs(device("host"), 1e6, known=known)
    unknown = estimate_macs(device("host"), 1e6, 2.0, known=known)
    assert unknown.power_w.figure.kind == "none"
    assert unknown.latency_ms.figure.get("ms") == 2.0


def test_the_host_is_measured_and_has_no_number_without_a_sensor(model, load, tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", "/nowhere")
    one = estimate_host(device("host"), dataclasses.replace(load, precision="int8"), model, root=tmp_path)
    assert one.latency_ms.figure.kind == "measured here"
    for bounded in (one.power_w, one.energy_mj, one.increment_w):
        assert bounded.figure.value is None
        assert "no INA3221" in bounded.figure.source
    json.dumps(one.as_dict(), allow_nan=False)
    with pytest.raises(MeasureError, match="no power sensor"):
        estimate_host(device("host"), load, model, measure_s=10, root=tmp_path)


def test_the_host_with_a_sensor(model, load, monkeypatch, tmp_path):
    """30 W at rest and 45 W while frames are computed back to back: at 20 Hz the load's share of 15 W is added."""
    watts = iter((30.0, 45.0))

    def recorded(seconds, *, root):
        return Recording((next(watts),) * 24, 12.0, "package", "a sensor", {})

    monkeypatch.setattr("upbeam.power.host.record", recorded)
    one = estimate_host(device("host"), load, model, measure_s=12, root=tmp_path)
    sound(one)
    added = one.increment_w.figure.get("W")
    assert 0 < added < 15
    assert one.power_w.figure.get("W") == pytest.approx(30 + added)
    assert one.energy_mj.figure.get("mJ") == pytest.approx(50 * (30 + added))
    assert one.increment_mj.figure.get("mJ") == pytest.approx(50 * added)
    assert one.power_w.boundary.startswith("package")


# ------------------------------------------------------------------------------------------------------- calibration


def log(tmp_path, name, milliwatts):
    lines = [f"RAM 1/2MB CPU [1%@1] POM_5V_IN {mw}/0 POM_5V_CPU {mw // 4}/0" for mw in milliwatts]
    path = tmp_path / name
    path.write_text("\n".join(lines), encoding="utf-8")
    return path


def test_a_log_of_our_own_stream_moves_the_idle_power(tmp_path, known, load):
    nano = device("jetson-nano")
    found = calibrate(nano, log(tmp_path, "a.log", [2400, 2420] * 20), Work(load), known=known)
    assert found.before.power_w.figure.kind == "assumption"
    assert found.after.power_w.figure.get("W") == pytest.approx(2.41, rel=1e-6)
    assert found.after.power_w.figure.kind == "modelled"
    json.dumps(found.as_dict(), allow_nan=False)


def test_logs_at_work_and_at_rest_are_met_exactly(tmp_path, known, load):
    """Two rows of one device, static and dynamic: after the refit both are what was measured."""
    nano = device("jetson-nano")
    work = Work(load, macs=2.25e9, latency_ms=81.0)
    logs = log(tmp_path, "a.log", [7000] * 20), log(tmp_path, "b.log", [2000] * 20)
    found = calibrate(nano, logs[0], work, idle_log=logs[1], known=known)
    before, after = (one.power_w.figure.get("W") for one in (found.before, found.after))
    assert before == pytest.approx(6.84, rel=0.01)
    assert after == pytest.approx(7.0, rel=1e-9)
    path = tmp_path / "rows.toml"
    write_rows(path, found.rows)
    assert read_rows(path) == list(found.rows)
    again = estimate_load(nano, load, known=with_rows(known, read_rows(path)))
    assert again.power_w.figure.get("W") == pytest.approx(2.0 + again.increment_w.figure.get("W"), rel=1e-9)


def test_rows_that_contradict_the_model_stay_finite(known, load):
    """A device that draws less at work than its family's dynamic power alone: errors are large, not infinite."""
    (row,) = [r for r in known.model.rows if r.device == "jetson-orin-nx" and not r.is_idle]
    rows = [dataclasses.replace(row, power_w=0.001, by_user=True)]
    changed = with_rows(known, rows)
    for one in (
        estimate_macs(device("jetson-orin-nx"), 1e9, 1.0, known=changed),
        estimate_load(device("jetson-orin-nx"), load, known=changed),
    ):
        sound(one)


def test_logs_that_cannot_calibrate(tmp_path, known, load):
    nano = device("jetson-nano")
    good = log(tmp_path, "a.log", [2400] * 20)
    with pytest.raises(MeasureError, match="9 s, expected at least 10"):
        calibrate(nano, log(tmp_path, "s.log", [2400] * 9), Work(load), known=known)
    with pytest.raises(CatalogueError, match="logs of tegrastats are of Jetson modules"):
        calibrate(device("ecp5-25"), good, Work(load), known=known)
    with pytest.raises(MeasureError, match="the sensor reads nothing"):
        calibrate(nano, log(tmp_path, "z.log", [0] * 20), Work(load), known=known)
    other = tmp_path / "o.log"
    other.write_text("\n".join(["CPU 300/0 SOC 200/0"] * 20))
    with pytest.raises(MeasureError, match="sum of 2 rails"):
        calibrate(nano, good, Work(load), idle_log=other, known=known)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "expected .*row.* tables"),
        ("x = ", "rows.toml: "),
        ("[[row]]\ndevice = 'a'", "row 1: title is missing"),
        ("[[row]]\nwatts = 3", "row 1: 'watts' is unknown"),
    ],
)
def test_row_files_that_cannot_be(tmp_path, text, message):
    path = tmp_path / "rows.toml"
    path.write_text(text)
    with pytest.raises(CatalogueError, match=message):
        read_rows(path)


def test_row_files_with_wrong_values(tmp_path, known):
    path = tmp_path / "rows.toml"
    write_rows(path, [known.model.rows[0]])
    good = path.read_text()
    for old, new, message in (
        ("macs = 20736.0", "macs = -1", "macs: -1"), ("latency_ms = 0.01874", "latency_ms = 0", "latency_ms: 0"),
        ("power_w = 1.581", "power_w = 'much'", "power_w: 'much'"), ('"xc7z020"', '""', "device: ''"),
    ):  # fmt: skip
        assert old in good
        path.write_text(good.replace(old, new))
        with pytest.raises(CatalogueError, match=message):
            read_rows(path)


# --------------------------------------------------------------------------------------------------------- deployment


@pytest.mark.parametrize("name", ["jetson-nano", "jetson-agx-orin", "ecp5-25", "ice40up5k"])
def test_a_deployment_is_the_same_on_every_run(name, model, load, rng):
    frames = (
        rng.integers(2000, 9000, (3, model.columns, 32), dtype="uint16"),
        rng.integers(0, 256, (3, model.columns, 32), dtype="uint8"),
    )

    def ledger(seed):
        service = target_service(device(name), load, 12, seed=seed)
        config = LiveConfig(clock="virtual", aligned=True, service_us=service.service_us)
        return run_live(model, *frames, config).to_dict()["ledger"], service

    (first, service), (second, _), (other, _) = ledger(1), ledger(1), ledger(2)
    assert first == second
    assert all(r["verdict"] == "met" for r in first)
    if service.wakeup_us.high:
        assert first != other
    sensors = service.sensors(20.0, model.columns)
    assert 1 <= sensors["low"] <= sensors["value"] <= sensors["high"]


def test_jitter_keeps_to_its_interval(load):
    """5 % of the wake-ups are below low and 5 % above high, the median is the value."""
    service = target_service(device("jetson-nano"), load, 12, seed=3)
    column = service.column_us.get("us")
    wakeups = sorted(us - 12 * column for us in service.service_us)
    n = len(wakeups)
    value, low, high = service.wakeup_us.span("us")
    assert wakeups[n // 2] == pytest.approx(value, rel=0.1)
    assert sum(w < low for w in wakeups) / n == pytest.approx(0.05, abs=0.02)
    assert sum(w > high for w in wakeups) / n == pytest.approx(0.05, abs=0.02)


def test_an_overloaded_target_misses(model, load, rng):
    """A hundred turns a second on the smallest part: the ledger says so."""
    fast = dataclasses.replace(load, rate_hz=100.0)
    service = target_service(device("ice40up5k"), fast, 12)
    frames = (
        rng.integers(2000, 9000, (8, model.columns, 32), dtype="uint16"),
        rng.integers(0, 256, (8, model.columns, 32), dtype="uint8"),
    )
    config = LiveConfig(
        clock="virtual", aligned=True, rate_hz=100.0, deadline_ms=10.0, ring_packets=65536,
        service_us=service.service_us,
    )  # fmt: skip
    assert run_live(model, *frames, config).misses > 0
    assert service.sensors(100.0, model.columns)["value"] == 0


def test_targets_that_cannot_be(load):
    with pytest.raises(CatalogueError, match="--clock real"):
        target_service(device("host"), load, 12)
    with pytest.raises(CatalogueError, match="service 'best'"):
        target_service(device("jetson-nano"), load, 12, service="best")
