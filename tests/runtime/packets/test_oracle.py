"""Packets beside an independent decoder (velodyne-decoder), and beside clouds other drivers made of real captures."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import velodyne_decoder as vd
from numpy.typing import NDArray

from upbeam.model.io import read_pcd
from upbeam.runtime.packets import (
    JUMP,
    SECOND,
    Calibration,
    Decoder,
    Encoder,
    Firings,
    PacketReader,
    PcapWriter,
    Points,
    Position,
    firing_points,
    read_calibration,
    sensor_info,
    write_calibration,
)

MODELS = {
    "hdl-32e": vd.Model.HDL32E,
    "vlp-32c": vd.Model.VLP32C,
    "vlp-16": vd.Model.VLP16,
    "hdl-64e-s2": vd.Model.HDL64E_S2,
    "hdl-64e-s3": vd.Model.HDL64E_S3,
}
UNITS = ["HDL-64E_S3-xiesc.yml", "HDL-64E_S3-VeloView.yml", "HDL-64E_S2.1-sztaki.yml"]
STRONGEST, LAST, BOTH = 1, 2, 3
RETURN_TYPES = {0x37: STRONGEST, 0x38: LAST}
COUNT, ANGLE_DEG = 0.5, 0.01
"""What the two decoders may differ by: half a distance count, the resolution of the oracle's azimuths."""

FloatArray = NDArray[np.float64]


# --------------------------------------------------------------------------------------------------------- the oracle


def oracle_table(sensor: str, folder: Path) -> Calibration:
    """The table the oracle decodes a sensor by, through our reader of drivers' files."""
    path = folder / f"{sensor}.yaml"
    path.write_text(vd.Calibration.default_calibs[MODELS[sensor]].to_string())
    return read_calibration(path, sensor)


def oracle_points(sensor: str, payloads: list[bytes], calibration: Any = None) -> NDArray[np.float64]:
    """``[N, 8]``: x, y, z, intensity, packet, column, ring, return type."""
    config = vd.Config(model=MODELS[sensor])
    config.min_range, config.max_range = 0.0, 1000.0
    if calibration is not None:
        config.calibration = calibration
    decoder = vd.ScanDecoder(config)
    rows = []
    for k, payload in enumerate(payloads):
        packet = vd.PacketVector()
        packet.append(vd.VelodynePacket(0.0, payload))
        points = np.asarray(decoder.decode(packet)[1], dtype=np.float64)
        rows.append(np.column_stack([points[:, :4], np.full(len(points), k), points[:, 5:8]]))
    return np.concatenate(rows)


@dataclass(frozen=True)
class Matched:
    """Points of both decoders, one row each, the same point in the same row."""

    ours: Points
    ours_row: NDArray[np.int64]
    xyz: FloatArray
    theirs: FloatArray
    """``[N, 3]``"""
    intensity_differs: int

    def range_error(self) -> float:
        return float(np.max(np.abs(_range(self.xyz) - _range(self.theirs))))

    def azimuth_error_deg(self) -> float:
        turn = _azimuth(self.xyz) - _azimuth(self.theirs)
        return float(np.max(np.abs((turn + 180.0) % 360.0 - 180.0)))

    def elevation_error_deg(self) -> float:
        return float(np.max(np.abs(_elevation(self.xyz) - _elevation(self.theirs))))


def _range(xyz: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.norm(xyz, axis=1))


def _azimuth(xyz: FloatArray) -> FloatArray:
    return np.asarray(np.degrees(-np.arctan2(xyz[:, 1], xyz[:, 0])))


def _elevation(xyz: FloatArray) -> FloatArray:
    return np.asarray(np.degrees(np.arctan2(xyz[:, 2], np.hypot(xyz[:, 0], xyz[:, 1]))))


def match(table: Calibration, payloads: list[bytes], oracle_calibration: Any = None) -> Matched:
    """Decodes with both; fails where one has a point that the other has not (packet, firing, ring, return)."""
    decoder = Decoder(table.sensor, pick="last", calibration=table, keep_calibration=True)
    decoded = decoder.decode_all(payloads)
    assert not decoded.status.any(), decoder.stats
    firings = decoded.firings
    ours = firing_points(table, firings)
    column = np.arange(len(firings)) - np.searchsorted(decoded.packet, decoded.packet)
    if (firings.flags & SECOND).any():
        column //= 2
    kind = np.array([RETURN_TYPES[int(k)] for k in firings.return_kind])
    ring = table.beams - 1 - ours.beam.astype(np.int64)
    ours_key = _key(decoded.packet[ours.firing], column[ours.firing], ring, kind[ours.firing])
    theirs = oracle_points(table.sensor, payloads, oracle_calibration)
    both = theirs[:, 7] == BOTH  # one point for two equal returns
    theirs = np.concatenate([theirs, theirs[both]])
    kinds = np.where(theirs[:, 7] == BOTH, STRONGEST, theirs[:, 7])
    kinds[len(theirs) - np.count_nonzero(both) :] = LAST
    theirs_key = _key(theirs[:, 4], theirs[:, 5], theirs[:, 6], kinds)
    order, their_order = np.argsort(ours_key), np.argsort(theirs_key)
    np.testing.assert_array_equal(ours_key[order], theirs_key[their_order])
    intensity = ours.intensity[order] != theirs[their_order, 3]
    xyz = ours.xyz[order].astype(np.float64)
    return Matched(ours, order, xyz, theirs[their_order, :3], int(np.count_nonzero(intensity)))


def _key(packet: Any, column: Any, ring: Any, kind: Any) -> NDArray[np.int64]:
    parts = [np.asarray(part, dtype=np.int64) for part in (packet, column, ring, kind)]
    return np.asarray(((parts[0] * 64 + parts[1]) * 64 + parts[2]) * 4 + parts[3])


def check(matched: Matched, unit_um: int, name: str) -> None:
    ranges, azimuth, elevation = matched.range_error(), matched.azimuth_error_deg(), matched.elevation_error_deg()
    if name:
        print(
            f"{name}: {len(matched.xyz)} points, largest difference {ranges * 1e3:.3f} mm, "
            f"azimuth {azimuth:.4f} deg, elevation {elevation:.5f} deg",
        )
    assert len(matched.xyz) > 1000
    assert ranges <= COUNT * unit_um * 1e-6
    assert azimuth <= ANGLE_DEG
    assert elevation <= ANGLE_DEG


# --------------------------------------------------------------------------------------------------- encoded packets


def spin(
    sensor: str, rng: np.random.Generator, *, turns_hz: float = 10.0, firings: int = 1200, dual: bool = False
) -> Firings:
    """An even turn with random returns, a tenth of them none."""
    info = sensor_info(sensor)
    time_ns = np.arange(firings) * info.firing_cycle_ns
    azimuth = (time_ns * turns_hz * 360e-6 % 360e3).astype(np.int64)
    returns = 2 if dual else 1
    distance = rng.integers(500, 65536, (firings * returns, info.beams)).astype(np.uint16)
    distance[rng.random(distance.shape) < 0.1] = 0
    return Firings.of(
        distance,
        rng.integers(0, 256, distance.shape).astype(np.uint8),
        azimuth_mdeg=np.repeat(azimuth, returns),
        time_ns=np.repeat(time_ns, returns),
        flags=np.tile([0, SECOND], firings)[: firings * returns] if dual else 0,
    )


@pytest.mark.parametrize("sensor", ["hdl-32e", "vlp-32c", "vlp-16"])
@pytest.mark.parametrize("mode", ["strongest", "dual"])
def test_the_oracle_reads_our_packets(sensor: str, mode: Any, tmp_path: Path, rng: np.random.Generator) -> None:
    table = oracle_table(sensor, tmp_path)
    packets = Encoder(sensor, return_mode=mode).encode(spin(sensor, rng, dual=mode == "dual"))
    matched = match(table, packets)
    assert matched.intensity_differs == 0
    check(matched, sensor_info(sensor).distance_unit_um, f"encoded {sensor} {mode}")


@pytest.mark.parametrize("unit", UNITS)
@pytest.mark.parametrize("mode", ["strongest", "dual"])
def test_the_oracle_reads_our_packets_of_hdl64e_units(
    unit: str, mode: Any, tmp_path: Path, rng: np.random.Generator
) -> None:
    """Real units' tables: all corrections, near and far, rotation and offsets."""
    sensor = "hdl-64e-s3" if "S3" in unit else "hdl-64e-s2"
    path = Path(vd.__file__).parent / "calibrations" / unit
    table = read_calibration(path, sensor)
    packets = Encoder(sensor, return_mode=mode, calibration=table).encode(
        spin(sensor, rng, dual=mode == "dual", turns_hz=12.5)
    )
    check(match(table, packets, vd.Calibration.read(str(path))), 2000, f"encoded {unit} {mode}")
    written = tmp_path / "ours.yaml"
    write_calibration(table, written)
    check(match(table, packets, vd.Calibration.read(str(written))), 2000, "")


def rows_elevation(sensor: str) -> FloatArray:
    """64 rows of a 32-beam sensor: its beams, and half way between."""
    beams = Calibration.nominal(sensor).column("elevation_mdeg") / 1e3
    rows = np.empty(64)
    rows[0::2] = beams
    rows[1:-1:2] = (beams[:-1] + beams[1:]) / 2
    rows[-1] = beams[-1] + (beams[-1] - beams[-2]) / 2
    return rows


def columns_of(turn_columns: int, count: int, speed: float, rng: np.random.Generator) -> Firings:
    """64-row columns as the daemon sends them: the last row empty."""
    distance = rng.integers(500, 65536, (count, 64)).astype(np.uint16)
    distance[rng.random(distance.shape) < 0.1] = 0
    distance[:, 63] = 0
    azimuth = (np.arange(count) * (360e3 / turn_columns * speed) % 360e3).astype(np.int64)
    return Firings.of(
        distance,
        rng.integers(0, 256, distance.shape).astype(np.uint8),
        azimuth_mdeg=azimuth,
        time_ns=np.arange(count) * 46080,
    )


def row_errors(firings: Firings, packets: list[bytes], calibration: Any) -> tuple[float, float, float]:
    """Largest range error (m) of what the oracle reads, beside the column's own azimuth and row elevations."""
    elevation = rows_elevation("hdl-32e")
    theirs = oracle_points("hdl-64e-s3", packets, calibration)
    column = (theirs[:, 4] * 6 + theirs[:, 5]).astype(np.int64)
    row = 63 - theirs[:, 6].astype(np.int64)
    used = firings[: 6 * len(packets)]
    assert len(theirs) == np.count_nonzero(used.distance)  # nothing lost, row 63 empty
    assert np.array_equal(theirs[:, 3], used.intensity[column, row])
    ranges = _range(theirs[:, :3]) - used.distance[column, row] * 0.002
    on_wire = (used.azimuth_mdeg[column] + 5) // 10 / 100.0
    azimuth = (_azimuth(theirs[:, :3]) - on_wire + 180.0) % 360.0 - 180.0
    return (
        float(np.max(np.abs(ranges))),
        float(np.max(np.abs(azimuth))),
        float(np.max(np.abs(_elevation(theirs[:, :3]) - elevation[row]))),
    )


def test_64_rows_through_the_record_in_the_stream(tmp_path: Path, rng: np.random.Generator) -> None:
    """The oracle knows nothing but the packets: it finds the table in their last two bytes."""
    firings = columns_of(2170, 6 * 4200, 1.0, rng)
    table = Calibration.of_rows(rows_elevation("hdl-32e"), 2170)
    packets = Encoder("hdl-64e-s3", calibration=table, status={"rpm": 600, "gps": ord("A")}).encode(firings)
    capture = tmp_path / "rows.pcap"
    with PcapWriter(capture) as writer:
        for k, packet in enumerate(packets):
            writer.write(packet, k * 276480)
    with capture.open("rb") as file:
        model, calibration = vd.hdl64e.read_calibration_from_pcap(file)
    assert model == vd.Model.HDL64E_S3
    ranges, azimuth, elevation = row_errors(firings, packets[:400], calibration)
    print(f"64 rows: range {ranges * 1e3:.3f} mm, azimuth {azimuth:.4f} deg, elevation {elevation:.4f} deg")
    assert ranges <= COUNT * 0.002
    assert azimuth <= ANGLE_DEG + 1e-4  # rounded twice to 0.01 degrees, then to float32
    assert elevation <= ANGLE_DEG
    status = vd.hdl64e.read_status_info(iter(packets))
    assert (status["RPM"], status["GPS Status"], status["Model"]) == (600, ord("A"), "S3")
    decoder = Decoder()
    decoder.decode_all(packets)
    assert decoder.stats["records"] == 1
    np.testing.assert_array_equal(decoder.calibration.lasers, table.lasers)


@pytest.mark.parametrize("turn_columns", [2170, 1085])
def test_64_rows_at_other_speeds(turn_columns: int, tmp_path: Path, rng: np.random.Generator) -> None:
    """The table takes back the turn at nominal speed; at another the rows spread by the share of it."""
    table = Calibration.of_rows(rows_elevation("hdl-32e"), turn_columns)
    path = tmp_path / "rows.yaml"
    write_calibration(table, path)
    spread = 360.0 / turn_columns * 54.1 / 57.6  # the last laser fires 54.1 us into the cycle of 57.6
    for speed in (0.9, 1.0, 1.1):
        firings = columns_of(turn_columns, 6 * 300, speed, rng)
        packets = Encoder("hdl-64e-s3", calibration=table).encode(firings)
        _, azimuth, _ = row_errors(firings, packets, vd.Calibration.read(str(path)))
        print(f"64 rows, {turn_columns} columns a turn, speed x {speed}: azimuth {azimuth:.4f} deg")
        assert azimuth <= abs(speed - 1.0) * spread + ANGLE_DEG + 1e-4


def test_four_millimetre_counts_are_doubled_and_far_returns_counted(tmp_path: Path) -> None:
    """A VLP-32C's counts in an HDL-64E's packets, as the oracle reads them."""
    distance = np.zeros((6, 64), np.uint16)
    distance[:, 0], distance[:, 2], distance[:, 4] = 2500, 32767, 32768
    firings = Firings.of(distance, distance.astype(np.uint8), azimuth_mdeg=np.arange(6) * 200, time_ns=np.arange(6))
    table = Calibration.of_rows(rows_elevation("vlp-32c"), 1808)
    write_calibration(table, tmp_path / "rows.yaml")
    encoder = Encoder("hdl-64e-s3", calibration=table, distance_unit_um=4000)
    theirs = oracle_points("hdl-64e-s3", encoder.encode(firings), vd.Calibration.read(str(tmp_path / "rows.yaml")))
    assert encoder.stats["too_far"] == 6
    np.testing.assert_allclose(np.sort(_range(theirs[:, :3])), [10.0] * 6 + [131.068] * 6, atol=1e-4)


def test_the_oracle_reads_our_position_packets() -> None:
    nmea = "$GPRMC,123519,A,4807.038,N,01131.000,E,022.4,084.4,230394,003.1,W*6A"
    sent = Position(
        time_us=1_234_567_890, pps=2, thermal_shutdown=1, temperature_top=60, temperature_bottom=61,
        temperature_at_shutdown=90, temperature_at_power_up=20, adc_temperature=40, adc_temperature_change=-5,
        adc_seconds=100_000, adc_reason=4, adc_flags=5, nmea=nmea,
    )  # fmt: skip
    got = vd.TelemetryPacket(sent.encode())
    assert got.usec_since_toh == sent.time_us
    assert got.thermal_shutdown
    assert (got.pps_status.name, got.nmea_sentence.rstrip()) == ("LOCKED", nmea)
    assert (got.temp_board_top, got.temp_board_bottom, got.temp_at_shutdown, got.temp_at_powerup) == (60, 61, 90, 20)
    assert (got.temp_during_adc_calibration, got.temp_change_since_adc_calibration) == (40, -5)
    assert got.seconds_since_adc_calibration == 100_000
    assert got.adc_calib_in_progress
    assert not got.adc_delta_temp_limit_exceeded
    assert got.adc_period_exceeded
    assert Position.decode(sent.encode()) == sent


# ----------------------------------------------------------------------------------------------------- real captures


CAPTURES = {
    "velodyne_hdl32e/sample_velodyne_hdl32.pcap": ("hdl-32e", 500, 0),
    "velodyne_vlp16/sample_velodyne_vlp16_gps.pcap": ("vlp-16", 293, 57),
    "velodyne_vlp16/packets.db3": ("vlp-16", 603, 0),
    "velodyne_vlp32c/packets.db3": ("vlp-32c", 379, 0),
}


@pytest.mark.parametrize("name", list(CAPTURES))
def test_real_captures_beside_the_oracle(name: str, data_dir: Path, tmp_path: Path) -> None:
    sensor, packets, positions = CAPTURES[name]
    payloads = [datagram.payload for datagram in PacketReader(data_dir / "packets" / name)]
    decoder = Decoder()
    decoded = decoder.decode_all(payloads)
    assert decoder.sensor == sensor
    assert decoder.stats["packets"] == {"OK": packets + positions}
    assert decoder.stats["positions"] == positions
    # Within a packet whose azimuth jumps the oracle takes the jump for rotation, and smears.
    jumps = {int(k) for k in decoded.packet[(decoded.firings.flags & JUMP) != 0]}
    assert len(jumps) == (5 if sensor == "vlp-32c" else 0)
    used = [p for k, p in enumerate(payloads) if k not in jumps and len(p) == 1206]
    matched = match(oracle_table(sensor, tmp_path), used)
    assert matched.intensity_differs == 0
    check(matched, sensor_info(sensor).distance_unit_um, f"real {name}, {len(jumps)} packets with a jump left out")


@pytest.mark.parametrize("sensor", ["hdl-32e", "vlp-32c", "vlp-16"])
def test_our_nominal_tables_beside_the_oracles(sensor: str, tmp_path: Path) -> None:
    """Angles agree; heights of the lasers' origins are at most 20 mm apart: the oracle's 32-beam sensors have some."""
    ours, theirs = Calibration.nominal(sensor), oracle_table(sensor, tmp_path)
    height = np.abs(ours.column("vertical_offset_um") - theirs.column("vertical_offset_um")).max()
    print(f"nominal {sensor}: heights of origins differ by up to {height * 1e-3:.2f} mm")
    for name in ("elevation_mdeg", "azimuth_offset_mdeg"):
        assert np.max(np.abs(ours.column(name) - theirs.column(name))) <= 4  # 0.004 degrees
    np.testing.assert_array_equal(ours.column("laser_id"), theirs.column("laser_id"))
    assert height <= 20_000


def nearest(xyz: FloatArray, keys: NDArray[np.int64], table: Calibration, firings: Firings) -> FloatArray:
    """Of each foreign point the distance to the nearest of ours with its ring and count: nan where there is none."""
    points = firing_points(table, firings)
    unit = sensor_info(table.sensor).distance_unit_um
    ours = (table.beams - 1 - points.beam.astype(np.int64)) << 20 | np.round(points.distance_um / unit).astype(np.int64)
    order = np.argsort(ours, kind="stable")
    low, high = (np.searchsorted(ours[order], keys, side) for side in ("left", "right"))
    errors = np.full(len(xyz), np.nan)
    for k in np.flatnonzero(high > low):
        candidates = points.xyz[order[low[k] : high[k]]].astype(np.float64)
        errors[k] = np.min(np.linalg.norm(candidates - xyz[k], axis=1))
    return errors


def foreign(path: Path, ring: str, unit_m: float) -> tuple[FloatArray, NDArray[np.int64], dict[str, Any]]:
    cloud = read_pcd(path)
    xyz = np.stack([cloud[axis] for axis in "xyz"], axis=1).astype(np.float64)
    counts = np.round(cloud["distance"].astype(np.float64) / unit_m).astype(np.int64)
    return xyz, cloud[ring].astype(np.int64) << 20 | counts, dict(cloud)


def report(name: str, errors: FloatArray) -> float:
    p50, p99, top = np.percentile(errors, [50, 99, 100]) * 1e3
    print(f"{name}: {len(errors)} points, p50 {p50:.1f} mm, p99 {p99:.1f} mm, max {top:.1f} mm")
    return float(p99)


def test_vlp32c_beside_third_party_clouds(data_dir: Path) -> None:
    """Both differ by the turn while firing: one driver leaves it out, the other takes it twice, a packet's last block's
    not at all."""
    folder = data_dir / "packets" / "velodyne_vlp32c"
    payloads = [d.payload for d in PacketReader(folder / "packets.db3")][:85]  # the clouds' turn
    table = Calibration.nominal("vlp-32c")
    firings = Decoder("vlp-32c").decode_all(payloads).firings
    full, keys, _ = foreign(folder / "decoded_full_fields.pcd", "channel", 0.004)
    bare = read_pcd(folder / "decoded_xyz.pcd")
    bare_xyz = np.stack([bare[axis] for axis in "xyz"], axis=1).astype(np.float64)
    assert report("vlp-32c, cloud with fields", nearest(full, keys, table, firings)) <= 30.0
    assert report("vlp-32c, cloud of xyz", nearest(bare_xyz, keys, table, firings)) <= 30.0
    still = replace(firings, rate_mdeg_s=np.zeros_like(firings.rate_mdeg_s))
    last = np.arange(len(firings)) % 12 == 11
    twice = replace(firings, rate_mdeg_s=np.where(last, 0, 2 * firings.rate_mdeg_s).astype(np.uint32))
    assert report("  without firing times", nearest(full, keys, table, still)) <= 3.0
    assert report("  with firing times as it takes them", nearest(bare_xyz, keys, table, twice)) <= 10.0


def test_vlp16_dual_beside_a_third_party_cloud(data_dir: Path) -> None:
    """That driver does not turn a packet's last azimuth: it has no block behind it to tell how far."""
    folder = data_dir / "packets" / "velodyne_vlp16"
    datagrams = list(PacketReader(folder / "packets.db3"))
    xyz, keys, cloud = foreign(folder / "decoded_with_ring.pcd", "ring", 0.002)
    begin, end = cloud["time_stamp"].min() * 1e9 - 2e6, cloud["time_stamp"].max() * 1e9 + 2e6
    payloads = [d.payload for d in datagrams if begin <= d.time_ns <= end]
    table = Calibration.nominal("vlp-16")
    decoded = Decoder("vlp-16", pick="last").decode_all(payloads)
    firings = decoded.firings
    place = np.arange(len(firings)) - np.searchsorted(decoded.packet, decoded.packet)  # 0..23 in its packet
    last = place >= 20  # two firings of a pair of blocks
    assert np.count_nonzero(np.isnan(nearest(xyz, keys, table, firings))) == 0
    report("vlp-16 dual, all", nearest(xyz, keys, table, firings))
    azimuth = firings.azimuth_mdeg.copy()
    azimuth[place >= 22] = azimuth[(place >= 20) & (place < 22)]
    rate = np.where(last, 0, firings.rate_mdeg_s).astype(np.uint32)
    repeated = replace(firings, azimuth_mdeg=azimuth, rate_mdeg_s=rate)
    assert report("  its omission repeated", nearest(xyz, keys, table, repeated)) <= 30.0
    own = nearest(xyz, keys, table, firings[~last])
    theirs_of_last = nearest(xyz, keys, table, firings[last])
    best = np.where(np.isnan(own), np.inf, own)
    of_others = best <= np.where(np.isnan(theirs_of_last), np.inf, theirs_of_last)
    assert of_others.mean() > 0.8
    assert report("  without the last azimuths", own[of_others]) <= 30.0
