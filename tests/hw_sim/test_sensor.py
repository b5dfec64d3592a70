"""The simulated sensor: timing and azimuth against arithmetic, packets against velodyne-decoder."""

from __future__ import annotations

import socket
from itertools import islice, pairwise
from pathlib import Path

import numpy as np
import pytest
import velodyne_decoder as vd
import yaml

from upbeam.hw_sim import simulate_frames
from upbeam.hw_sim.sensor import (
    DATA_PORT,
    POSITION_PORT,
    SENSORS,
    Motor,
    QuickRoom,
    RecordedSensor,
    ScanLoop,
    SensorConfig,
    SimulatedSensor,
    blocks,
    is_data,
    is_position,
    send_udp,
)
from upbeam.model.beams import beam_table

HOUR_US = 3_600_000_000
DECODER = {"hdl-32e": "HDL32E", "vlp-32c": "VLP32C", "vlp-16": "VLP16"}


def data_packets(config: SensorConfig, seconds: float) -> list:
    return [d for d in SimulatedSensor(config).until(round(seconds * 1e9)) if is_data(d)]


@pytest.mark.parametrize("model", SENSORS)
@pytest.mark.parametrize("returns", ["strongest", "last", "dual"])
def test_packets_leave_at_the_sensors_own_rate(model: str, returns: str) -> None:
    config = SensorConfig(model=model, returns=returns)
    packets = data_packets(config, 0.3)
    firings = SENSORS[model] // (2 if returns == "dual" else 1)
    span = firings * beam_table(model).firing_cycle_us * 1e3
    assert len(packets) == int(0.3e9 / span)
    steps = np.diff([p.time_ns for p in packets])
    assert np.all(np.abs(steps - span) <= 1)


@pytest.mark.parametrize("rate", [5.0, 10.0, 20.0])
def test_a_turn_has_as_many_firings_as_fit(rate: float) -> None:
    config = SensorConfig(model="vlp-32c", rate_hz=rate)
    assert config.firings_per_turn == pytest.approx(1 / (rate * 55.296e-6))
    azimuth = np.concatenate([blocks(p.payload)["blocks"]["azimuth"][0] for p in data_packets(config, 2.2 / rate)])
    crossings = np.flatnonzero(np.diff(azimuth.astype(int)) < 0)
    assert abs(np.diff(crossings)[0] - config.firings_per_turn) <= 1


def test_stress_has_the_columns_asked_for() -> None:
    config = SensorConfig(columns=2048, rate_hz=20.0)
    packets = data_packets(config, 0.05)
    assert len(packets) in {2048 // 12, 2048 // 12 + 1}
    azimuth = blocks(packets[3].payload)["blocks"]["azimuth"][0].astype(int)
    assert set(np.diff(azimuth)) <= {17, 18}


@pytest.mark.parametrize("wander", [0.0, 0.1])
def test_azimuths_are_where_the_motor_is(wander: float) -> None:
    config = SensorConfig(wander=wander, start_azimuth_deg=123.0, seed=3)
    sensor = SimulatedSensor(config)
    for number, packet in enumerate(islice((d for d in sensor if is_data(d)), 300)):
        firing = np.arange(number * 12, number * 12 + 12)
        turns = sensor.motor.turns(np.floor(firing * config.firing_ns) * 1e-9)
        azimuth = blocks(packet.payload)["blocks"]["azimuth"][0] / 100.0
        away = (turns * 360.0 - azimuth) % 360.0
        assert np.all((away < 0.0100001) | (away > 359.9999))


def test_motor_is_the_integral_of_its_speed(rng: np.random.Generator) -> None:
    motor = Motor(10.0, 0.1, 0.25, seed=int(rng.integers(1000)))
    t = np.linspace(0, 20, 200_001)
    rate = motor.rate_at(t)
    assert np.all(np.abs(rate / 10.0 - 1) <= 0.1)
    assert np.ptp(rate) > 0.5
    integral = 0.25 + np.concatenate(([0.0], np.cumsum((rate[1:] + rate[:-1]) / 2 * np.diff(t))))
    np.testing.assert_allclose(motor.turns(t), integral, atol=1e-6)


def test_the_clock_passes_the_hour() -> None:
    packets = data_packets(SensorConfig(start_toh_us=HOUR_US - 50_000), 0.1)
    clock = np.array([int(blocks(p.payload)["tail"]["toh_us"][0]) for p in packets])
    assert clock.max() < HOUR_US
    falls = np.flatnonzero(np.diff(clock) < 0)
    assert len(falls) == 1
    assert abs(packets[falls[0] + 1].time_ns - 50e6) < 2e6


def test_same_settings_same_bytes_other_seed_other_bytes() -> None:
    def first(seed: int) -> list:
        return list(islice(SimulatedSensor(SensorConfig(seed=seed, wander=0.05)), 120))

    assert first(1) == first(1)
    assert first(1) != first(2)


def test_position_packets_come_between_the_data() -> None:
    sensor = SimulatedSensor(SensorConfig(position_hz=20.0))
    stream = list(sensor.until(1_000_000_000))
    assert sum(is_position(d) for d in stream) == 20
    assert all(a.time_ns <= b.time_ns for a, b in pairwise(stream))
    assert {d.port for d in stream} == {DATA_PORT, POSITION_PORT}
    assert not any(map(is_position, SimulatedSensor(SensorConfig(position_hz=0)).until(300_000_000)))


def test_dual_return_pairs() -> None:
    """Both blocks of a pair are one firing; the last return is never nearer, and sometimes deeper."""
    deeper = 0
    for packet in data_packets(SensorConfig(returns="dual"), 0.1):
        b = blocks(packet.payload)["blocks"][0]
        last, strongest = b[0::2], b[1::2]
        assert np.array_equal(last["azimuth"], strongest["azimuth"])
        near, far = strongest["returns"]["distance"].astype(int), last["returns"]["distance"].astype(int)
        assert np.all(far >= near)
        deeper += int(np.sum(far > near))
    assert deeper > 10


@pytest.mark.parametrize("model", ["hdl-32e", "vlp-32c"])
def test_velodyne_decoder_reads_what_the_source_saw(model: str) -> None:
    """Per point: range within half a count, azimuth and elevation within 0.01 degrees, same ring."""
    config = SensorConfig(model=model, position_hz=0)
    table, sensor = beam_table(model), SimulatedSensor(config)
    settings = vd.Config()
    settings.model, settings.min_range, settings.max_range = getattr(vd.Model, DECODER[model]), 0.0, 300.0
    decoder = vd.ScanDecoder(settings)
    lasers = yaml.safe_load(vd.Calibration.default_calibs[settings.model].to_string())["lasers"]
    height = np.array([laser.get("vert_offset_correction", 0.0) for laser in lasers])
    for number, packet in enumerate(islice(sensor, 3)):
        packets = vd.PacketVector()
        packets.append(vd.VelodynePacket(0.0, packet.payload))
        points = np.asarray(decoder.decode(packets)[1], dtype=np.float64)
        seen = sensor.source.returns(packet_turns(sensor, packet), np.arange(number * 12, number * 12 + 12))
        beam = 31 - points[:, 6].astype(int)
        firing = np.round((points[:, 4] * 1e6 - table.firing_time_us[beam]) / table.firing_cycle_us).astype(int)
        assert len(points) == len({*zip(firing, beam, strict=True)}) == np.count_nonzero(seen.distance)
        x, y, z = points[:, :3].T
        z = z - height[table.laser_id[beam].astype(int)]  # the decoder's: a laser's origin lies over the sensor's
        distance = np.sqrt(x * x + y * y + z * z)
        unit = table.distance_unit_m
        assert np.max(np.abs(distance - seen.distance[firing, beam] * unit)) < unit / 2
        elevation = np.degrees(np.arcsin(z / distance))
        assert np.max(np.abs(elevation - table.elevation_deg[beam])) < 0.01
        start = blocks(packet.payload)["blocks"]["azimuth"][0][firing] / 100.0
        expected = start + table.azimuth_offset_deg[beam] + 20.0 * 360.0 * table.firing_time_us[beam] * 1e-6
        away = (-np.degrees(np.arctan2(y, x)) - expected + 180.0) % 360.0 - 180.0
        assert np.max(np.abs(away)) < 0.01
        np.testing.assert_array_equal(points[:, 3], seen.intensity[firing, beam])


def test_scans_of_the_ray_caster_are_played_in_a_loop() -> None:
    table = beam_table("vlp-32c")
    scans = list(simulate_frames(table, columns=904, frames=2, seed=1, rate_hz=20.0, align=False, scene="suburb"))
    sensor = SimulatedSensor(SensorConfig(start_azimuth_deg=180.0, position_hz=0), ScanLoop(scans))
    packets = list(islice(sensor, 3 * 76))
    lasers = table.laser_id.astype(int)
    for packet in packets[::17]:
        b = blocks(packet.payload)["blocks"][0]
        turns = packet_turns(sensor, packet)
        for k in range(12):
            at = turns[k] - 0.5
            column, frame = int(at % 1 * 904), int(at) % 2
            np.testing.assert_array_equal(b["returns"]["distance"][k][lasers], scans[frame].distance[:, column])
            np.testing.assert_array_equal(b["returns"]["intensity"][k][lasers], scans[frame].intensity[:, column])


def packet_turns(sensor, packet):
    first = round((packet.time_ns - 12 * sensor.config.firing_ns) / sensor.config.firing_ns)
    return sensor.motor.turns(np.floor(np.arange(first, first + 12) * sensor.config.firing_ns) * 1e-9)


def test_scans_that_do_not_fit_are_refused() -> None:
    table = beam_table("vlp-32c")
    aligned = list(simulate_frames(table, columns=64, frames=1))
    with pytest.raises(ValueError, match="expected raw firings"):
        ScanLoop(aligned)
    with pytest.raises(ValueError, match="no scans"):
        ScanLoop([])
    with pytest.raises(ValueError, match="expected of the sensor, vlp-32c"):
        SimulatedSensor(SensorConfig(), QuickRoom(beam_table("hdl-32e")))


@pytest.mark.parametrize(
    "settings",
    [{"model": "vls-128"}, {"rate_hz": 4.9}, {"rate_hz": 21}, {"columns": 1}, {"returns": "both"},
     {"start_toh_us": HOUR_US}, {"position_hz": -1}, {"wander": 0.6}],
)  # fmt: skip
def test_impossible_settings_are_named(settings: dict) -> None:
    with pytest.raises(ValueError, match=next(iter(settings)).replace("model", "sensor")):
        SimulatedSensor(SensorConfig(**settings))


def test_udp_sends_everything_and_says_how_late() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as ear:
        ear.bind(("127.0.0.1", 0))
        ear.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
        ear.settimeout(5)
        stream = list(SimulatedSensor(SensorConfig(position_hz=0)).until(50_000_000))
        report = send_udp(stream, "127.0.0.1", ear.getsockname()[1])
        got = [ear.recv(2048) for _ in stream]
    assert got == [d.payload for d in stream]
    assert report.datagrams == len(stream)
    assert report.refused == 0
    assert 0 <= report.late_p50_us <= report.late_p99_us <= report.late_max_us


# ------------------------------------------------------------------------------------------------------- recordings


def test_a_recording_is_played_without_a_seam() -> None:
    """Twice round: payloads as recorded but for the clock, which goes on; azimuths step at the seam as elsewhere."""
    made = list(SimulatedSensor(SensorConfig(start_toh_us=HOUR_US - 60_000)).until(175_000_000))
    recorded = RecordedSensor([d.payload for d in made])
    assert recorded.loop_s == pytest.approx(0.15, abs=0.001)
    played = list(recorded.until(round(2.5 * recorded.loop_s * 1e9)))
    payloads = [d.payload for d in made if is_data(d)]
    loop = round(recorded.loop_s * 1e9 / 663_552)
    for k, datagram in enumerate(played):
        assert datagram.payload[:1200] == payloads[k % loop][:1200]
        assert datagram.payload[1204:] == payloads[k % loop][1204:]
    clock = np.array([int(blocks(d.payload)["tail"]["toh_us"][0]) for d in played])
    steps = np.diff(clock) % HOUR_US
    assert np.all(np.abs(steps - 663.552) <= 2)
    assert np.array_equal(steps * 1000, np.diff([d.time_ns for d in played]))
    azimuth = np.concatenate([blocks(d.payload)["blocks"]["azimuth"][0] for d in played]).astype(int)
    assert np.max(np.diff(azimuth) % 36000) <= 300


def test_a_recordings_clock_can_be_set() -> None:
    made = [d.payload for d in SimulatedSensor(SensorConfig()).until(120_000_000)]
    first = next(iter(RecordedSensor(made, start_toh_us=1_000_000)))
    assert int(blocks(first.payload)["tail"]["toh_us"][0]) == 1_000_000


def test_what_is_no_recording_of_a_sensor_is_refused() -> None:
    short = [d.payload for d in SimulatedSensor(SensorConfig()).until(20_000_000)]
    with pytest.raises(ValueError, match="expected a whole turn"):
        RecordedSensor(short)
    with pytest.raises(ValueError, match="model none"):
        RecordedSensor([b"x" * 100])
    other = [d.payload for d in SimulatedSensor(SensorConfig(model="hdl-32e")).until(60_000_000)]
    with pytest.raises(ValueError, match="0x21, 0x28"):
        RecordedSensor([*short, *other])


@pytest.mark.parametrize(
    ("name", "model"),
    [("velodyne_hdl32e/sample_velodyne_hdl32.pcap", "hdl-32e"), ("velodyne_vlp32c/packets.db3", "vlp-32c")],
)
def test_real_recordings(data_dir: Path, name: str, model: str) -> None:
    recorded = RecordedSensor.open(data_dir / "packets" / name)
    assert recorded.beams.name == model
    played = list(recorded.until(round(2.2 * recorded.loop_s * 1e9)))
    azimuth = np.array([int(blocks(d.payload)["blocks"]["azimuth"][0, 0]) for d in played])
    steps = np.diff(azimuth) % 36000  # the VLP-32C sends half of the turn only, and jumps over the rest
    usual = np.median(steps)
    loop = round(np.searchsorted([d.time_ns for d in played], recorded.loop_s * 1e9 - 1))
    assert 100 < usual < 500
    assert np.min(np.abs(steps[: loop - 1] - steps[loop - 1])) <= usual / 2 + 1, "the seam is a step like others"
    assert all(a.time_ns <= b.time_ns for a, b in pairwise(played))
