"""The packet codecs from Python: arrays in and out, errors, tables, tracking on real captures."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from upbeam.model.beams import beam_table
from upbeam.runtime.packets import (
    DUAL,
    EMPTY,
    JUMP,
    SECOND,
    AzimuthTracker,
    Calibration,
    Decoder,
    Encoder,
    Firings,
    PacketError,
    PacketReader,
    Position,
    Status,
    Steps,
    identify,
    read_calibration,
    read_record,
    sensor_info,
    sensor_names,
    write_calibration,
    write_record,
)
from upbeam.runtime.packets.tables import HEADER, header_text

CORPUS = Path(__file__).parent / "corpus"
TEN_HZ = 3_600_000


def spin(sensor: str, rng: np.random.Generator, firings: int = 240, rate_mdeg_s: int = TEN_HZ) -> Firings:
    info = sensor_info(sensor)
    time_ns = np.arange(firings) * info.firing_cycle_ns
    distance = rng.integers(0, 65536, (firings, info.beams)).astype(np.uint16)
    return Firings.of(
        distance,
        rng.integers(0, 256, distance.shape).astype(np.uint8),
        azimuth_mdeg=time_ns * rate_mdeg_s // 1_000_000_000 % 360_000,
        time_ns=time_ns,
        rate_mdeg_s=rate_mdeg_s,
    )


# ------------------------------------------------------------------------------------------------------------- tables


def test_the_c_tables_are_the_beam_tables() -> None:
    assert HEADER.read_text() == header_text(), "run: python -m upbeam.runtime.packets.tables"


@pytest.mark.parametrize("sensor", ["hdl-32e", "vlp-32c", "vlp-16", "hdl-64e-s2"])
def test_nominal_calibrations_are_the_beam_tables(sensor: str) -> None:
    table, calibration = beam_table(sensor.removesuffix("-s2")), Calibration.nominal(sensor)
    info = sensor_info(sensor)
    assert (info.beams, info.distance_unit_um) == (table.beams, round(table.distance_unit_m * 1e6))
    assert info.firing_cycle_ns == round(table.firing_cycle_us * 1e3)
    for name, values, scale in (
        ("elevation_mdeg", table.elevation_deg, 1e3),
        ("azimuth_offset_mdeg", table.azimuth_offset_deg, 1e3),
        ("fire_time_ns", table.firing_time_us, 1e3),
        ("vertical_offset_um", table.vertical_offset_m, 1e6),
        ("laser_id", table.laser_id, 1.0),
    ):
        np.testing.assert_allclose(calibration.column(name), values * scale, atol=0.51, err_msg=name)


# -------------------------------------------------------------------------------------------------------------- arrays


@pytest.mark.parametrize("sensor", sensor_names())
def test_there_and_back(sensor: str, rng: np.random.Generator) -> None:
    sent = spin(sensor, rng)
    encoder = Encoder(sensor)
    packets = encoder.encode(sent)
    assert len(packets) == 240 // sensor_info(sensor).packet_firings
    assert (encoder.pending, encoder.stats) == (0, {"packets": len(packets), "firings": 240, "too_far": 0})
    decoded = Decoder(sensor).decode_all(packets)
    got = decoded.firings
    np.testing.assert_array_equal(got.distance, sent.distance)
    np.testing.assert_array_equal(got.intensity, sent.intensity)
    np.testing.assert_allclose(np.unwrap(got.azimuth_mdeg / 1e3 - sent.azimuth_mdeg / 1e3, period=360), 0, atol=0.0101)
    np.testing.assert_array_equal(decoded.packet, np.repeat(np.arange(len(packets)), 240 // len(packets)))
    assert not decoded.status.any()
    assert len(got[:5]) == 5
    assert len(got.primary) == 240


@given(seed=st.integers(0, 2**32 - 1), sensor=st.sampled_from(sensor_names()), count=st.integers(0, 60))
@settings(max_examples=40)
def test_a_dual_pair_keeps_its_returns(seed: int, sensor: str, count: int) -> None:
    """Beam by beam the two returns of a pair are those sent; the primary has the brighter one, and one if there is."""
    rng = np.random.default_rng(seed)
    beams = sensor_info(sensor).beams
    distance = rng.integers(0, 4, (2 * count, beams)).astype(np.uint16)
    firings = Firings.of(
        distance,
        rng.integers(0, 4, distance.shape).astype(np.uint8),
        azimuth_mdeg=np.repeat(np.arange(count) * 200, 2),
        time_ns=np.repeat(np.arange(count), 2),
        flags=np.tile([0, SECOND], count),
    )
    encoder = Encoder(sensor, return_mode="dual")
    packets = encoder.encode(firings)
    got = Decoder(sensor).decode_all(packets).firings
    assert len(got) + encoder.pending == 2 * count
    sent = firings[: len(got)]
    both = [np.stack([f.distance, f.intensity], -1).reshape(-1, 2, beams, 2) for f in (sent, got)]
    ordered = [np.sort(b[..., 0].astype(int) * 256 + b[..., 1], axis=1) for b in both]
    np.testing.assert_array_equal(*ordered)
    primary, second = both[1][:, 0], both[1][:, 1]
    assert np.all((primary[..., 0] > 0) | (second[..., 0] == 0))
    two = (primary[..., 0] > 0) & (second[..., 0] > 0)
    assert np.all(primary[..., 1][two] >= second[..., 1][two])
    assert np.all((got.flags & DUAL) != 0)
    assert np.array_equal((got.flags & EMPTY) != 0, ~got.distance.any(axis=1))


def test_the_corpus_is_read() -> None:
    files = sorted(CORPUS.glob("*.bin"))
    assert len(files) == 17
    for path in files:
        info = identify(path.read_bytes())
        assert info.status is Status.OK, path
        assert info.kind == ("position" if path.name.startswith("position") else "data")
        if info.kind == "data":
            sensor = path.name.partition("_")[0]
            assert info.sensor == sensor.replace("s2", "s3")  # one packet does not tell the series
            assert len(Decoder().decode(path.read_bytes())) in {6, 12, 24}


def test_refusals_are_named_and_counted() -> None:
    good = (CORPUS / "hdl-32e_strongest.bin").read_bytes()
    decoder = Decoder()
    cases = {
        b"": "SIZE",
        good[:-1]: "SIZE",
        bytes(1206): "FLAG",
        good[:-1] + b"\xa1": "VLS_128",
        good[:-1] + b"\x23": "VLP_32AB",
        good[:-1] + b"\x24": "PUCK_HIRES",
        good[:-1] + b"\x31": "VELARRAY",
        bytes(6464): "OUSTER",
    }
    for payload, name in cases.items():
        assert identify(payload).status is Status[name]
        with pytest.raises(PacketError) as error:
            decoder.decode(payload)
        assert error.value.args[1] == Status[name]
    assert decoder.sensor == "auto"
    with pytest.raises(PacketError, match="unknown"):
        _ = decoder.calibration
    assert len(decoder.decode(good)) == 12
    assert decoder.sensor == "hdl-32e"
    with pytest.raises(PacketError, match="another sensor"):
        decoder.decode((CORPUS / "vlp-16_strongest.bin").read_bytes())
    counts = decoder.stats["packets"]
    assert counts == {"OK": 1, "SIZE": 2, "SENSOR": 1} | {n: 1 for n in cases.values() if n != "SIZE"}


def test_wrong_arguments(rng: np.random.Generator) -> None:
    for make in (
        lambda: Decoder("vls-128"),
        lambda: Decoder("hdl-33"),
        lambda: Decoder(pick="first"),  # type: ignore[arg-type]
        lambda: Decoder("vlp-16", calibration=Calibration.nominal("hdl-32e")),
        lambda: Encoder("auto"),
        lambda: Encoder("hdl-32e", return_mode="both"),  # type: ignore[arg-type]
        lambda: Encoder("hdl-64e-s3", distance_unit_um=3000),
        lambda: Encoder("hdl-64e-s3", status={"hours": 1}),
        lambda: Calibration.nominal("ouster"),
        lambda: Calibration.of_rows(np.zeros(64), 2000),
        lambda: Calibration.of_rows(np.linspace(10, -30, 32), 2000),
        lambda: Calibration.nominal("vlp-16").with_column("laser_id", 0).sorted(),
        lambda: Calibration.nominal("vlp-16").with_column("laser_id", 300).sorted(),
        lambda: Position(time_us=3_600_000_000).encode(),
        lambda: Position(nmea="x" * 127).encode(),
        lambda: Position.decode(bytes(511)),
        lambda: read_record(bytes(1820)),
        lambda: sensor_info("hdl-33"),
        lambda: Encoder("hdl-32e").encode(spin("vlp-16", rng)),
        lambda: Encoder("hdl-32e").encode(replace(spin("hdl-32e", rng), time_ns=np.zeros(3, np.uint64))),
    ):
        with pytest.raises(PacketError):
            make()


# -------------------------------------------------------------------------------------------------- calibration files


@pytest.mark.parametrize("sensor", sensor_names())
def test_calibration_files_there_and_back(sensor: str, tmp_path: Path) -> None:
    table = Calibration.nominal(sensor).with_column("distance_correction_um", 1_300_000)
    write_calibration(table, tmp_path / "unit.yaml")
    again = read_calibration(tmp_path / "unit.yaml", sensor)
    np.testing.assert_array_equal(again.lasers, table.lasers)
    assert again.two_point == table.two_point


def test_calibration_files_that_cannot_be(tmp_path: Path) -> None:
    path = tmp_path / "unit.yaml"
    with pytest.raises(PacketError, match="No such file"):
        read_calibration(path, "vlp-16")
    write_calibration(Calibration.nominal("vlp-16"), path)
    good = yaml.safe_load(path.read_text())
    for text, expected in (
        ("[1, 2", "expected"),
        ("lasers: 3", "no list of lasers"),
        (yaml.safe_dump(good | {"lasers": good["lasers"][1:]}), "expected 0 to 15"),
        (yaml.safe_dump(good | {"lasers": [*good["lasers"][1:], {"laser_id": 0, "vert_correction": "up"}]}), "number"),
        (yaml.safe_dump(good | {"lasers": [*good["lasers"][1:], {"laser_id": 0, "vert_correction": 2.0}]}), "beam"),
    ):
        path.write_text(text)
        with pytest.raises(PacketError, match=expected):
            read_calibration(path, "vlp-16")


def test_real_calibration_files(data_dir: Path) -> None:
    """Tables of real units: every one is taken, and goes through an HDL-64E's record within its resolution."""
    folder = data_dir / "sensor_calibration"
    for name, sensor in (
        ("HDL32.yaml", "hdl-32e"),
        ("VLP16.yaml", "vlp-16"),
        ("VLP32.yaml", "vlp-32c"),
        ("HDL64e_s2.yaml", "hdl-64e-s2"),
        ("HDL64e_s3.yaml", "hdl-64e-s3"),
        ("HDL64e_utexas.yaml", "hdl-64e-s2"),
    ):
        table = read_calibration(folder / name, sensor)
        nominal = Calibration.nominal(sensor)
        if not sensor.startswith("hdl-64e"):  # one table for all units
            for field in ("elevation_mdeg", "azimuth_offset_mdeg"):
                assert np.max(np.abs(table.column(field) - nominal.column(field))) <= 10, (name, field)
            continue
        again, _ = read_record(write_record(table.with_column("focal_distance_um", 0).with_column("focal_slope_e4", 0)))
        by_laser = [t.lasers[np.argsort(t.column("laser_id"))] for t in (table, again)]
        assert np.max(np.abs(by_laser[0][:, :2] - by_laser[1][:, :2])) <= 5  # 0.005 degrees
        assert np.max(np.abs(by_laser[0][:, 3:8] - by_laser[1][:, 3:8])) <= 500  # half a millimetre


# ------------------------------------------------------------------------------------------------------------ tracking


def test_the_tracker_finds_what_was_lost(rng: np.random.Generator) -> None:
    firings = spin("hdl-32e", rng, 12_000)
    keep = np.repeat(rng.random(1000) > 0.2, 12)
    keep[:12] = True
    steps = AzimuthTracker("hdl-32e").track(firings[keep])
    np.testing.assert_array_equal(steps.firing, np.flatnonzero(keep))
    assert steps.missing.sum() == np.count_nonzero(~keep[: np.flatnonzero(keep)[-1]])
    assert not (steps.flags & ~np.uint32(Steps.FIRST | Steps.FRAME)).any()


CAPTURES = {
    "velodyne_hdl32e/sample_velodyne_hdl32.pcap": ("hdl-32e", 0),
    "velodyne_vlp16/sample_velodyne_vlp16_gps.pcap": ("vlp-16", 0),
    "velodyne_vlp16/packets.db3": ("vlp-16", 0),
    "velodyne_vlp32c/packets.db3": ("vlp-32c", 5),
}


@pytest.mark.parametrize("name", list(CAPTURES))
def test_real_turns(name: str, data_dir: Path) -> None:
    """Nothing is missing in whole captures but what the sensor left out of the turn; frames begin once a turn."""
    sensor, jumps = CAPTURES[name]
    decoder = Decoder()
    firings = decoder.decode_all(d.payload for d in PacketReader(data_dir / "packets" / name)).firings.primary
    tracker = AzimuthTracker(sensor)
    steps = tracker.track(firings)
    jumped = (firings.flags & JUMP) != 0
    assert np.count_nonzero(jumped) == jumps
    assert not steps.missing[~jumped].any()
    # What time the jump took is reckoned from the speed: the next packet's clock may find it some firings wrong.
    after = np.isin(np.arange(len(firings)), (np.flatnonzero(jumped) // 12 + 1) * 12)
    assert not (steps.flags[after] & ~np.uint32(Steps.FRAME | Steps.TIME_JUMP)).any()
    assert not (steps.flags[~after] & ~np.uint32(Steps.FIRST | Steps.FRAME)).any()
    turns = (int(steps.angle_mdeg[-1]) - int(steps.angle_mdeg[0])) / 360e3
    assert np.count_nonzero(steps.flags & Steps.FRAME) in {int(turns), int(turns) + 1}
    low, high = steps.rpm_milli[100:].min() / 1e3, steps.rpm_milli[100:].max() / 1e3
    print(f"{name}: {turns:.2f} turns, {low:.1f} to {high:.1f} rpm, {tracker.turn_firings} firings")
    if jumps:  # the part left out, as a share of the turn
        assert 0.4 < steps.missing[jumped][1:].mean() / tracker.turn_firings < 0.6


def test_real_position_packets(data_dir: Path) -> None:
    capture = data_dir / "packets" / "velodyne_vlp16" / "sample_velodyne_vlp16_gps.pcap"
    positions = [Position.decode(d.payload) for d in PacketReader(capture, port=8308)]
    assert len(positions) == 57
    assert {(p.pps, p.nmea_valid, p.thermal_shutdown) for p in positions} == {(2, True, 0)}
    times = [p.time_us for p in positions]
    assert times == sorted(times)
    again = [Position.decode(p.encode()) for p in positions]
    assert again == positions
