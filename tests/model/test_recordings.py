"""Frames of recorded packets: whole turns, the sensor's own counts, each point in its column; bad files refused."""

from __future__ import annotations

import itertools
import sqlite3
import struct
from dataclasses import replace
from pathlib import Path

import dpkt
import numpy as np
import pytest
import velodyne_decoder
import yaml

from upbeam.cli.common import UserError
from upbeam.cli.sources import describe_source, may_ship, recipe_frames, source_frames
from upbeam.model import recordings
from upbeam.model.beams import beam_table
from upbeam.model.geometry import azimuth_deg, column_of, to_points
from upbeam.model.io import CloudError
from upbeam.model.recipe import DataRecipe, load_recipe
from upbeam.model.recordings import capture_frames, open_capture, training_frames
from upbeam.model.rules import Rules

CAPTURES = {
    "hdl-32e": "velodyne_hdl32e/sample_velodyne_hdl32.pcap",
    "vlp-16": "velodyne_vlp16/sample_velodyne_vlp16_gps.pcap",
    "vlp-32c": "velodyne_vlp32c/packets.db3",
    "vls-128": "velodyne_vls128/packets.db3",
}
MODELS = {"hdl-32e": 0x21, "vlp-16": 0x22, "vlp-32c": 0x28, "vls-128": 0xA1}
BLOCK = np.dtype([("flag", "<u2"), ("azimuth", "<u2"), ("m", [("d", "<u2"), ("i", "u1")], 32)])
BLOCK_US, BLOCK_DEG = 50.0, 0.36
"""Of synthetic packets: 20 turns a second, a packet every 600 us and 4.32 degrees."""


def packet(model: int, azimuth: float, clock_us: int, distance: int = 1000, flag: int = 0xEEFF) -> bytes:
    """A data packet whose lasers all see ``distance`` counts."""
    blocks = (
        struct.pack("<HH", flag, round(100 * (azimuth + BLOCK_DEG * k)) % 36000) + struct.pack("<HB", distance, 77) * 32
        for k in range(12)
    )
    return b"".join(blocks) + struct.pack("<IBB", clock_us % 3_600_000_000, 0x37, model)


def turning(model: int, turns: float, start: float = 90.0, clock_us: int = 0) -> list[bytes]:
    count = round(turns * 360 / (12 * BLOCK_DEG))
    return [
        packet(model, start + 12 * BLOCK_DEG * k, clock_us + round(12 * BLOCK_US * k), 1000 + k) for k in range(count)
    ]


def frame_of(payload: bytes, sender: int = 200, port: int = 2368) -> bytes:
    udp = dpkt.udp.UDP(sport=port, dport=port, data=payload)
    udp.ulen = len(udp)
    ip = dpkt.ip.IP(src=bytes([192, 168, 1, sender]), dst=b"\xff" * 4, p=dpkt.ip.IP_PROTO_UDP, data=udp)
    ip.len = len(ip)
    return bytes(dpkt.ethernet.Ethernet(data=ip))


def write_pcap(path: Path, frames: list[bytes]) -> Path:
    with path.open("wb") as file:
        writer = dpkt.pcap.Writer(file)
        for k, frame in enumerate(frames):
            writer.writepkt(frame, ts=1.0 + 6e-4 * k)
    return path


def pcap(path: Path, payloads: list[bytes]) -> Path:
    return write_pcap(path / "made.pcap", [frame_of(p) for p in payloads])


# ------------------------------------------------------------------------------------------------------ real captures


@pytest.fixture(scope="module", params=sorted(CAPTURES))
def capture(request, data_dir):
    return open_capture(data_dir / "packets" / CAPTURES[request.param])


def test_frames_of_real_captures(capture):
    """(whole turns, partial, other packets, native columns); the VLP-32C sent half turns, and a bit of a sixth."""
    expected = {
        "hdl-32e": (1, 2, 0, 2401),
        "vlp-16": (3, 2, 57, 1811),
        "vlp-32c": (5, 1, 0, 1808),
        "vls-128": (3, 2, 0, 1876),
    }
    stats = capture.stats
    found = stats.turns, stats.partial_turns, stats.other_packets, capture.native_columns
    assert found == expected[capture.beams.name]
    assert stats.damaged == 0
    frames = list(capture.frames())
    assert len(frames) == stats.turns
    assert len(list(capture.frames(1024, partial=True))) == stats.turns + stats.partial_turns
    for frame in frames:
        assert frame.distance.shape == (capture.beams.beams, capture.native_columns)
        assert (frame.distance > 0).mean() > 0.4
        assert np.all(frame.intensity[frame.distance == 0] == 0)
        assert frame.distance_unit_m == capture.beams.distance_unit_m


def test_tables_are_the_decoders(capture):
    frame = next(capture.frames(1024))
    assert frame.elevation_deg == pytest.approx(capture.beams.elevation_deg, abs=4e-3)
    model = getattr(velodyne_decoder.Model, capture.beams.name.replace("-", "").upper())
    lasers = yaml.safe_load(velodyne_decoder.Calibration.default_calibs[model].to_string())["lasers"]
    lasers.sort(key=lambda laser: -laser["vert_correction"])
    assert [laser["laser_id"] for laser in lasers] == capture.beams.laser_id.tolist()
    offsets = [-np.degrees(laser.get("rot_correction", 0.0)) for laser in lasers]
    assert offsets == pytest.approx(capture.beams.azimuth_offset_deg, abs=1e-3)
    heights = [laser["vert_offset_correction"] for laser in lasers]
    assert frame.row_height_m == pytest.approx(heights, abs=1e-7)
    if capture.beams.name in ("vls-128", "vlp-16"):
        assert capture.beams.vertical_offset_m == pytest.approx(heights, abs=6e-5)


def test_counts_azimuths_and_rows_are_the_packets_own(capture):
    """Against the packet's bytes: each pixel's count stands in the packets, in the laser of its row, at its azimuth."""
    frame = next(capture.frames())
    columns = frame.distance.shape[1]
    measured = {}
    for data in capture._packets:
        blocks = np.frombuffer(data[:1200], dtype=BLOCK)
        for block in blocks:
            first = {0xEEFF: 0, 0xDDFF: 32, 0xCCFF: 64, 0xBBFF: 96}[int(block["flag"])]
            for k in range(32):
                laser = first + k % 16 if capture.beams.name == "vlp-16" else first + k
                if block["m"]["d"][k]:
                    key = laser, int(block["m"]["d"][k]), int(block["m"]["i"][k])
                    measured.setdefault(key, []).append(block["azimuth"] / 100.0)
    rng = np.random.default_rng(0)
    row, column = np.nonzero(frame.distance)
    for j in rng.choice(len(row), 500, replace=False):
        r, c = row[j], column[j]
        key = int(capture.beams.laser_id[r]), int(frame.distance[r, c]), int(frame.intensity[r, c])
        centre = frame.cut_deg + (c + 0.5) * 360 / columns
        aimed = np.array(measured[key]) + capture.beams.azimuth_offset_deg[r]
        # A laser fires up to a block after the block's azimuth was taken (a VLP-16's block holds two firings: 0.4).
        lag = np.mod(centre - aimed + 180, 360) - 180
        assert np.any((lag > -0.11 - 180 / columns) & (lag < 0.42 + 180 / columns)), (r, c, lag)


def test_points_of_a_frame_lie_where_the_decoder_puts_them(capture):
    """Pixel centres against decoded points of all turns of the same rows: half a column aside at most."""
    frame = next(capture.frames())
    points, rows, columns = to_points(
        frame.distance, frame.intensity, frame.elevation_deg, frame.distance_unit_m, frame.cut_deg, frame.row_height_m
    )
    decoder = recordings._Decoder(capture.path, capture.beams)
    decoded = np.concatenate([decoder.points(p) for p in capture._packets])
    lift = frame.row_height_m[capture.beams.beams - 1 - decoded[:, 4].astype(int)]
    path = np.sqrt(decoded[:, 0] ** 2 + decoded[:, 1] ** 2 + (decoded[:, 2] - lift) ** 2) / frame.distance_unit_m
    assert np.abs(path - np.round(path)).max() < 0.02, "a range is a whole number of counts"
    key = np.round(path).astype(np.int64) * 128 + capture.beams.beams - 1 - decoded[:, 4].astype(np.int64)
    column = column_of(azimuth_deg(decoded), frame.distance.shape[1], frame.cut_deg)
    known = set(zip(key.tolist(), column.tolist(), strict=True))
    mine = frame.distance[rows, columns].astype(np.int64) * 128 + rows
    assert all(pair in known for pair in zip(mine.tolist(), columns.tolist(), strict=True))
    assert column_of(azimuth_deg(points), frame.distance.shape[1], frame.cut_deg).tolist() == columns.tolist()


def test_frames_are_the_same_every_time(capture):
    first, again = (list(open_capture(capture.path).frames(1024, partial=True)) for _ in range(2))
    for a, b in zip(first, again, strict=True):
        assert np.array_equal(a.distance, b.distance)
        assert np.array_equal(a.intensity, b.intensity)


def test_the_cut_moves_columns_only(data_dir):
    """A half turn that does not touch either cut is the same picture, shifted."""
    path = data_dir / "packets" / CAPTURES["vlp-32c"]
    behind, aside = next(capture_frames(path, columns=720)), next(capture_frames(path, columns=720, cut_deg=200.0))
    assert np.array_equal(np.roll(behind.distance, -40, axis=1), aside.distance)


def test_third_party_clouds(data_dir):
    """VLP-32C: every point another driver decoded from these packets lies within 10 cm of one of ours (p99 3 cm)."""
    from scipy.spatial import cKDTree

    path = data_dir / "packets" / "velodyne_vlp32c" / "decoded_xyz.pcd"
    data = path.read_bytes()
    body = data[data.index(b"DATA binary\n") + 12 :]
    theirs = np.frombuffer(body, dtype="<f4").reshape(-1, 3).astype(np.float64)
    capture = open_capture(path.parent / "packets.db3")
    decoder = recordings._Decoder(capture.path, capture.beams)
    ours = np.concatenate([decoder.points(p)[:, :3] for p in capture._packets])
    distance = cKDTree(ours).query(theirs)[0]
    assert np.percentile(distance, 99) < 0.03
    assert distance.max() < 0.1


# ------------------------------------------------------------------------------------------------- synthetic captures


@pytest.mark.parametrize("name", ["hdl-32e", "vlp-32c", "vlp-16"])
def test_turns_are_cut_on_azimuth(tmp_path, name):
    """3.5 turns from 90 degrees on: a quarter, three whole ones, a quarter; each laser in the turn it points to."""
    path = pcap(tmp_path, turning(MODELS[name], 3.5))
    capture = open_capture(path)
    assert capture.beams.name == name
    assert capture.rate_hz == pytest.approx(20.0)
    assert (capture.stats.turns, capture.stats.partial_turns, capture.stats.packets) == (3, 2, 292)
    frames = list(capture.frames(500))
    assert [frame.name for frame in frames] == ["made:1", "made:2", "made:3"]
    for frame in frames:
        # Every packet has a distance of its own, one more than the one before: columns rise clockwise.
        assert np.all(frame.distance > 0)
        step = np.diff(frame.distance.astype(int), axis=1)
        assert set(np.unique(step)) <= {0, 1}
        assert np.all(frame.intensity == 77)
    seam = frames[1].distance[:, 0].astype(int) - frames[0].distance[:, -1]
    assert set(seam) <= {0, 1}


def test_rate_and_native_columns_survive_the_hour_and_lost_and_swapped_packets(tmp_path):
    payloads = turning(0x21, 4.0, start=179.0, clock_us=3_600_000_000 - 100_000)
    plain = open_capture(pcap(tmp_path, payloads))
    assert plain.native_columns == round(1e6 / 46.08 / 20)
    assert plain.stats.turns == 3
    # A whole turn and a bit is lost; two packets change places.
    lost = payloads[:100] + payloads[195:]
    lost[20], lost[21] = lost[21], lost[20]
    capture = open_capture(pcap(tmp_path, lost))
    assert capture.native_columns == plain.native_columns
    names = {f.name: f for f in capture.frames(500)}
    expected = {f.name: f for f in plain.frames(500)}
    assert np.array_equal(names["made:1"].distance[:, :200], expected["made:1"].distance[:, :200])
    assert np.array_equal(names["made:3"].distance[:, -100:], expected["made:3"].distance[:, -100:])


def test_nearest_of_two_returns_wins(tmp_path):
    nearer = [packet(0x21, 90 + 4.32 * k, 600 * k, 500) for k in range(250)]
    payloads = list(itertools.chain(*zip(turning(0x21, 3), nearer, strict=True)))
    for frame in capture_frames(pcap(tmp_path, payloads), columns=500):
        assert np.all(frame.distance == 500)


def test_other_traffic_is_counted(tmp_path):
    frames = [frame_of(p) for p in turning(0x21, 3)]
    arp = bytes(dpkt.ethernet.Ethernet(type=dpkt.ethernet.ETH_TYPE_ARP, data=dpkt.arp.ARP()))
    cut, flagless = frame_of(packet(0x21, 0, 0))[:600], frame_of(packet(0x21, 0, 0, flag=0))
    strange = [frame_of(b"x" * 512, port=8308), frame_of(b""), arp, cut, flagless, b"\1"]
    mixed = list(itertools.chain(*itertools.zip_longest(frames, strange)))
    capture = open_capture(write_pcap(tmp_path / "mixed.pcap", [f for f in mixed if f is not None]))
    assert (capture.stats.packets, capture.stats.other_packets, capture.stats.damaged) == (250, 3, 3)


def test_two_sensors_need_a_name(tmp_path):
    pairs = zip(turning(0x21, 3), turning(0x28, 3), strict=True)
    frames = [frame for a, b in pairs for frame in (frame_of(a, 1), frame_of(b, 2))]
    path = write_pcap(tmp_path / "two.pcap", frames)
    with pytest.raises(CloudError, match=r"hdl-32e from 192\.168\.1\.1 port 2368, vlp-32c from 192\.168\.1\.2"):
        open_capture(path)
    capture = open_capture(path, sensor="vlp-32c")
    assert (capture.beams.name, capture.stats.packets, capture.stats.other_packets) == ("vlp-32c", 250, 250)
    with pytest.raises(CloudError, match="expected packets of the vls-128"):
        open_capture(path, sensor="vls-128")
    with pytest.raises(CloudError, match="no sensor 'lidar'"):
        open_capture(path, sensor="lidar")


def hdl64e(k: int) -> bytes:
    data = bytearray(packet(ord("HMSD"[k % 4]), 4.0 * k, 600 * k))
    for block in range(1, 12, 2):
        data[100 * block : 100 * block + 2] = b"\xff\xdd"
    return bytes(data)


@pytest.mark.parametrize(
    ("payloads", "named"),
    [
        ([], "no packets at all"),
        ([b"x" * 512] * 3, "3 of 512 bytes"),
        ([b"x" * 6464] * 3, "Ouster"),
        ([packet(0x23, 4.0 * k, 600 * k) for k in range(100)], "VLP-32A"),
        ([packet(0x77, 4.0 * k, 600 * k) for k in range(100)], r"unknown \(0x77\)"),
        ([hdl64e(k) for k in range(100)], "HDL-64E"),
        ([packet(0x21, 45.0, 600 * k) for k in range(100)], "without motion"),
        ([packet(0x21, 4.0 * k, 0) for k in range(100)], "without motion"),
        ([packet(0x21, 0.0, 0)], "1 packets without motion"),
        ([packet(0x21, 0.001 * k, 600 * k) for k in range(100)], "turns per second"),
        (turning(0x21, 1.2), "no whole turn, 2 partial"),
    ],
)
def test_captures_without_frames_are_refused(tmp_path, payloads, named):
    with pytest.raises(CloudError, match=named):
        capture_frames(pcap(tmp_path, payloads))


def test_partial_turns_on_request(tmp_path):
    frames = list(capture_frames(pcap(tmp_path, turning(0x21, 1.2)), columns=100, partial=True))
    assert [(f.distance > 0).mean() for f in frames] == pytest.approx([0.25, 0.95], abs=0.03)


def test_a_sensor_that_sends_half_turns(tmp_path):
    """From 270 to 90 degrees, blocks going on at 270 within a packet: nothing lands in the other half."""
    azimuths = (270 + np.arange(2400) * BLOCK_DEG % 180) % 360
    payloads = []
    for k in range(0, 2400, 12):
        data = bytearray(packet(0x28, 0, round(2 * BLOCK_US * k), 1000))
        for block in range(12):
            struct.pack_into("<H", data, 100 * block + 2, round(100 * azimuths[k + block]) % 36000)
        payloads.append(bytes(data))
    capture = open_capture(pcap(tmp_path, payloads))
    assert (capture.stats.packets, capture.stats.turns, capture.stats.partial_turns) == (200, 4, 1)
    for frame in capture.frames(360):
        seen = np.flatnonzero((frame.distance > 0).any(axis=0))  # lasers point up to 4.2 degrees aside
        assert seen.min() >= 85
        assert seen.max() <= 276
        assert np.all(frame.distance[:, 96:264] == 1000)


def test_every_truncation_is_counted_or_refused(tmp_path):
    data = pcap(tmp_path, turning(0x21, 3)).read_bytes()
    path = tmp_path / "cut.pcap"
    for size in [*range(60), *range(len(data) - 1300, len(data), 7)]:
        path.write_bytes(data[:size])
        if size < 1000:
            with pytest.raises(CloudError, match=r"cut\.pcap"):
                open_capture(path)
        else:
            stats = open_capture(path).stats
            assert 248 <= stats.packets <= 249
            assert stats.damaged + stats.packets <= 250


def test_noise_is_refused_or_survived(tmp_path, rng):
    data = pcap(tmp_path, turning(0x28, 3)).read_bytes()
    path = tmp_path / "noise.pcap"
    for _ in range(60):
        noisy = bytearray(data)
        for place in rng.integers(0, len(data), 40):
            noisy[place] = rng.integers(256)
        path.write_bytes(noisy)
        try:
            for frame in open_capture(path).frames(128, partial=True):
                assert frame.distance.shape == (32, 128)
        except CloudError as error:
            assert "noise.pcap" in str(error)  # noqa: PT017  either outcome is right, another error is not


def test_bags(tmp_path, data_dir):
    path = tmp_path / "bag.db3"
    with pytest.raises(CloudError, match=r"bag\.db3"):
        open_capture(path)
    path.write_bytes(b"not a database" * 100)
    with pytest.raises(CloudError, match="SQLite"):
        open_capture(path)
    path.unlink()
    with sqlite3.connect(path) as bag:
        bag.execute("CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT)")
        bag.execute("CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB)")
        bag.execute("INSERT INTO topics VALUES(1, '/points', 'sensor_msgs/msg/PointCloud2')")
    with pytest.raises(CloudError, match="sensor_msgs/msg/PointCloud2"):
        open_capture(path)
    source = sqlite3.connect(f"file:{data_dir / 'packets' / CAPTURES['vlp-32c']}?mode=ro&immutable=1", uri=True)
    messages = [row[0] for row in source.execute("SELECT data FROM messages ORDER BY timestamp")]
    source.close()
    with sqlite3.connect(path) as bag:
        bag.execute("INSERT INTO topics VALUES(2, '/packets', 'velodyne_msgs/msg/VelodyneScan')")
        for k, data in enumerate([b"", messages[0][:5000], b"\0" * 300, *messages, 7]):
            bag.execute("INSERT INTO messages VALUES(?, ?, ?, ?)", (k, 2, k, data))
        bag.execute("INSERT INTO messages VALUES(99, 1, 99, x'00')")
    stats = open_capture(path).stats
    assert (stats.turns, stats.packets, stats.other_packets) == (5, 379, 1)
    assert stats.damaged in (3, 4)  # 300 zeros are a message without packets


def test_missing_extra_is_named(tmp_path, monkeypatch):
    path = pcap(tmp_path, turning(0x21, 3))

    def absent(name: str) -> None:
        raise ImportError(name)

    monkeypatch.setattr(recordings, "import_module", absent)
    with pytest.raises(
        CloudError, match=r"dpkt is not installed; expected the extra: pip install 'upbeam\[recordings\]'"
    ):
        open_capture(path)
    assert beam_table("vls-128").beams == 128


# ------------------------------------------------------------------------------------------------------- to train on


def small_recipe(**changes):
    return replace(load_recipe("smoke"), columns=180, rules={"ground_reach": 0.0}, **changes)


def test_a_capture_as_training_data(tmp_path, monkeypatch):
    """Every other beam of 32 hidden: 16 rows given, 15 between them; 4 mm of a VLP-32C become the recipe's 2 mm."""
    path = pcap(tmp_path, turning(0x28, 4.5))
    recipe = small_recipe(data=(DataRecipe("capture", path=str(path), columns=100, licence="mine"),))
    (source,) = recipe.data
    frames = list(recipe_frames(recipe, recipe.make_rules()))
    own = list(capture_frames(path, columns=100))
    assert len(frames) == source_frames(source) == len(own) == 4
    for frame, seen in zip(frames, own, strict=True):
        assert frame.distance_unit_m == 0.002
        assert np.array_equal(frame.distance, 2 * seen.distance)
        assert len(frame.distance[frame.given]) == 16
        assert len(frame.distance[frame.truth]) == 15
    assert len(list(recipe_frames(recipe, recipe.make_rules(), (replace(source, frames=1, columns=0),)))) == 1
    assert describe_source(source) == (
        "capture made.pcap of a vlp-32c, 4 turns, every-other beams hidden (licence mine; may not ship)"
    )
    assert not may_ship(source)
    assert may_ship(replace(source, may_ship=True))
    monkeypatch.setenv("UPBEAM_DATA", str(tmp_path))
    assert source_frames(replace(source, path="made.pcap")) == 4


def test_captures_that_cannot_be_trained_on(tmp_path):
    recipe = small_recipe()
    rules = recipe.make_rules()
    for path, error, said in (
        (str(tmp_path / "absent.pcap"), UserError, "absent.pcap"),
        ("old.bag", UserError, "rosbags-convert"),
        (str(pcap(tmp_path, turning(0x28, 1.2))), CloudError, "no whole turn"),
    ):
        with pytest.raises(error, match=said):
            list(recipe_frames(recipe, rules, (DataRecipe("capture", path=path),)))


def test_three_of_four_beams_hidden(data_dir):
    """A VLS-128 as a sensor of 64 beams. Its 32 given beams are not an HDL-64E's, whose row limits do not fit them."""
    path = data_dir / "packets" / CAPTURES["vls-128"]
    capture = open_capture(path)
    rules = Rules.for_beams(beam_table("hdl-64e"), ground_reach=0.0)
    whole = next(training_frames(capture, rules, columns=512))
    frame = next(training_frames(capture, rules, columns=512, hide="three-of-four"))
    assert (whole.rows, frame.rows) == (128, 64)
    assert np.array_equal(frame.distance, whole.distance[::2])
    assert frame.elevation_deg == pytest.approx(capture.beams.elevation_deg[::2], abs=4e-3)
    with pytest.raises(CloudError, match="not those of hdl-64e/2"):
        next(training_frames(capture, Rules.for_beams(beam_table("hdl-64e")), hide="three-of-four"))
    next(training_frames(capture, Rules.for_beams(beam_table("hdl-64e")), columns=512))  # 64 given rows: no limits
