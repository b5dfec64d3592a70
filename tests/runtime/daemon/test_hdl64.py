"""HDL-64E packets of the daemon, read by an independent decoder (velodyne-decoder)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import velodyne_decoder as vd
from daemon_feed import SENSORS, Feed, finish, model_file, run

from upbeam.runtime.daemon import Column, Daemon, Outputs, read_columns
from upbeam.runtime.packets import Calibration, PacketReader, PcapWriter

UNIT_M = {"hdl-32e": 0.002, "vlp-32c": 0.004}


def oracle(packets: list[bytes], calibration: Any) -> Any:
    """[n, 6]: x, y, z, intensity, running column, row (0 on top)."""
    config = vd.Config(model=vd.Model.HDL64E_S3, calibration=calibration, min_range=0.0, max_range=1000.0)
    decoder = vd.ScanDecoder(config)
    parts = []
    for k, payload in enumerate(packets):
        packet = vd.PacketVector()
        packet.append(vd.VelodynePacket(0.0, payload))
        points = np.asarray(decoder.decode(packet)[1], dtype=np.float64)
        parts.append(np.column_stack([points[:, :4], k * 6 + points[:, 5], 63 - points[:, 6]]))
    return np.concatenate(parts)


def through(tmp_path: Path, packets: list[bytes]) -> Any:
    """The calibration that stands in the packets, found by the oracle."""
    path = tmp_path / "capture.pcap"
    with PcapWriter(path) as writer:
        for k, packet in enumerate(packets):
            writer.write(packet, k * 276_480)
    with path.open("rb") as file:
        model, calibration = vd.hdl64e.read_calibration_from_pcap(file)
    assert model == vd.Model.HDL64E_S3
    return calibration


def played(feed: Feed, turns: float, **settings: Any) -> tuple[Daemon, Outputs, list[Column]]:
    daemon = Daemon(model_file(feed.sensor), {"sensor": SENSORS[feed.sensor], **settings})
    out = finish(daemon, run(daemon, feed.make(turns)))
    return daemon, out, [c for _, data in out.columns for c in read_columns(data)]


@pytest.mark.parametrize("sensor", SENSORS)
def test_the_oracle_reads_points_of_the_column_stream(sensor: str, tmp_path: Path) -> None:
    """Range within half a count; azimuth and elevation within 0.01 degrees (rounded on the wire); the same ring."""
    feed = Feed(sensor)
    daemon, out, columns = played(feed, 14, rpm=600)  # 4160 packets tell the whole record
    packets = [data for _, data in out.hdl64]
    table = np.array(daemon.calibration())
    points = oracle(packets[:600], through(tmp_path, packets))
    column, row = points[:, 4].astype(int), points[:, 5].astype(int)
    counts = np.stack([c.distance for c in columns[:3600]]).astype(np.int64)
    grey = np.stack([c.intensity for c in columns[:3600]])
    shown = counts.copy()
    shown[:, 63] = 0
    assert len(points) == np.count_nonzero(shown), "nothing lost, nothing invented, row 63 empty"
    np.testing.assert_array_equal(points[:, 3], grey[column, row])
    ranges = np.linalg.norm(points[:, :3], axis=1) - counts[column, row] * UNIT_M[sensor]
    # What the table adds beside taking back the oracle's firing times: the laser's own place in the column.
    own = table[:, 1] - Calibration.of_rows(table[:, 0] / 1e3, daemon.status["columns"]).column("azimuth_offset_mdeg")
    azimuth = np.array([c.azimuth_mdeg for c in columns[:3600]])[column] + own[row]
    seen = np.degrees(-np.arctan2(points[:, 1], points[:, 0]))
    apart = (seen - azimuth / 1e3 + 180.0) % 360.0 - 180.0
    elevation = np.degrees(np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1]))) - table[row, 0] / 1e3
    print(
        f"{sensor} as HDL-64E: {len(points)} points, range {np.abs(ranges).max() * 1e3:.3f} mm, "
        f"azimuth {np.abs(apart).max():.4f} deg, elevation {np.abs(elevation).max():.4f} deg",
    )
    assert np.abs(ranges).max() <= 0.5 * UNIT_M[sensor]
    assert np.abs(apart).max() <= 0.0101  # rounded twice to 0.01 degrees, then to float32
    assert np.abs(elevation).max() <= 0.01
    assert daemon.counters["hdl64_padding"] < 6


@pytest.mark.parametrize("sensor", SENSORS)
def test_measured_points_stay_where_the_sensor_saw_them(sensor: str, tmp_path: Path) -> None:
    """The oracle on the sensor's own packets and on ours: each measured beam at its own azimuth, firing times too."""
    feed = Feed(sensor)
    daemon, out, _ = played(feed, 2.2, rpm=600)
    mine = oracle([data for _, data in out.hdl64], _from_table(daemon, tmp_path))
    model = {"hdl-32e": vd.Model.HDL32E, "vlp-32c": vd.Model.VLP32C}[sensor]
    config = vd.Config(model=model, calibration=vd.Calibration.default_calibs[model], min_range=0.0, max_range=1000.0)
    decoder = vd.ScanDecoder(config)
    theirs: list[Any] = []
    for k, packet in enumerate(feed.make(2.2)):
        vector = vd.PacketVector()
        vector.append(vd.VelodynePacket(0.0, packet.data))
        points = np.asarray(decoder.decode(vector)[1], dtype=np.float64)
        theirs.append(np.column_stack([points[:, :3], k * 12 + points[:, 5], 31 - points[:, 6]]))
    original = np.concatenate(theirs)
    beam = original[:, 4].astype(int)
    # A beam's sample of firing n is in the column that its offset leads to.
    steps = np.round(Calibration.nominal(sensor).column("azimuth_offset_mdeg") / (360e3 / daemon.status["columns"]))
    key = {(int(c), int(b)): i for i, (c, b) in enumerate(zip(original[:, 3] + steps[beam], beam, strict=True))}
    apart = []
    for point in mine[mine[:, 5] % 2 == 0]:
        i = key.get((int(point[4]), int(point[5]) // 2))
        if i is not None:
            before, after = (np.degrees(np.arctan2(p[1], p[0])) for p in (original[i], point))
            apart.append((after - before + 180.0) % 360.0 - 180.0)
    print(
        f"{sensor}: {len(apart)} measured points, azimuth beside the sensor's own packets: "
        f"p99 {np.percentile(np.abs(apart), 99):.4f}, max {np.abs(apart).max():.4f} deg",
    )
    assert len(apart) > 10_000
    assert np.abs(apart).max() <= 0.03  # two roundings on the wire, and the oracle's last firing of a packet


def _from_table(daemon: Daemon, tmp_path: Path) -> Any:
    from upbeam.runtime.packets import write_calibration

    table = np.array(daemon.calibration())
    base = Calibration.of_rows(table[:, 0] / 1e3, daemon.status["columns"])
    path = tmp_path / "hdl64.yaml"
    write_calibration(base.with_column("azimuth_offset_mdeg", table[:, 1]), path)
    return vd.Calibration.read(str(path))


def test_far_returns_are_counted_and_left_out() -> None:
    feed = Feed("vlp-32c", noise=60_000, seed=3)
    daemon, _, columns = played(feed, 1.2)
    beyond = sum(np.count_nonzero(c.distance[:63] > 32_767) for c in columns)
    assert daemon.counters["hdl64_beyond_range"] == beyond > 100


def test_real_captures_pass_without_a_fault(data_dir: Path) -> None:
    """A moving HDL-32E, and a VLP-32C that fires in half of the turn."""
    cases = {
        "hdl-32e": ("velodyne_hdl32e/sample_velodyne_hdl32.pcap", {}, 3),
        "vlp-32c": ("velodyne_vlp32c/packets.db3", {"fov_begin_mdeg": 270_000, "fov_end_mdeg": 90_000}, 6),
    }
    for sensor, (name, settings, frame_count) in cases.items():
        datagrams = list(PacketReader(data_dir / "packets" / name))
        daemon = Daemon(model_file(sensor), {"sensor": SENSORS[sensor], "service_ns": [50_000] * 4, **settings})
        for datagram in datagrams:
            daemon.tick(datagram.time_ns - datagrams[0].time_ns)
            daemon.packet(datagram.payload, datagram.time_ns - datagrams[0].time_ns)
        out = finish(daemon, datagrams[-1].time_ns - datagrams[0].time_ns)
        counters = daemon.counters
        assert daemon.status["faults_ever"] == [], sensor
        assert counters["packets_processed"] == len(datagrams)
        assert counters["columns_out"] == 12 * len(datagrams)
        assert counters["firings_inserted"] == counters["firings_skipped"] == 0
        assert [r["frame"] for r in out.ledger] == list(range(frame_count))
        assert [r["verdict"] for r in out.ledger] == ["partial"] + ["met"] * (frame_count - 2) + ["partial"]
