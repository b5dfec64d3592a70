"""Frames from recordings of a Velodyne sensor's packets: a ``.pcap`` file, or a ROS 2 bag's ``.db3``.

Packets are decoded by ``velodyne-decoder``, captures are read by ``dpkt``, bag messages by ``rosbags``: the extra
``recordings``. Each point goes into the column of its own azimuth (its laser's offset and firing time included), so
frames are azimuth aligned; its count is the sensor's own.

A packet of 1206 bytes holds, little-endian, 12 blocks of 100 bytes (flag, azimuth in 0.01 degrees, 32 times distance
and intensity), microseconds since the hour at byte 1200, and the model in the last byte.
"""

from __future__ import annotations

import sqlite3
import struct
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import import_module
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import numpy as np
import yaml
from numpy.typing import NDArray

from .beams import BeamTable, beam_table
from .frames import Frame, every_other_row, in_counts_of
from .geometry import DEFAULT_CUT_DEG, GeometryError, azimuth_deg, project
from .io import MAX_FILE_BYTES, CloudError
from .rules import BEAMS, Rules

__all__ = ["Capture", "CaptureStats", "capture_frames", "open_capture", "training_frames"]

FloatArray = NDArray[np.float64]
Source = tuple[str, str]
"""(who sent a packet, the sensor's name)"""

PACKET_BYTES = 1206
BLOCK_BYTES = 100
_AZIMUTHS = struct.Struct("<" + "2xH96x" * 12)
SENSORS = {
    0x21: ("hdl-32e", "HDL32E"),
    0x22: ("vlp-16", "VLP16"),
    0x28: ("vlp-32c", "VLP32C"),
    0xA1: ("vls-128", "VLS128"),
}
"""Model byte: our beam table, the decoder's name."""
UNSUPPORTED = {0x23: "VLP-32A or VLP-32B", 0x24: "Puck Hi-Res", 0x31: "Velarray"}
OUSTER_BYTES = {3392, 6464, 12608, 24896, 8448, 16640, 33024}
"""Payloads of Ouster's data packets: 32, 64 and 128 beams, legacy and with two returns."""
SCAN_TYPE = "velodyne_msgs/msg/VelodyneScan"
MAX_RATE_HZ = 100.0
NEAR_DEG = 15.0
"""Beyond a packet's first azimuth, what its points may reach: laser offsets (6.4) and the packet's own sweep."""
WHOLE_TOLERANCE_DEG = 3.6
"""A turn that lacks less than this at its beginning or end is whole: a hundredth of a turn."""
SAME_BEAM_DEG = 0.3
"""Elevations of one sensor's table and another's that are taken for the same beam."""
MAX_STEP = 500
"""Between the blocks of a packet, in 0.01 degrees: far above any sensor's (0.8 degrees)."""
_HOUR_US = 3_600_000_000


@dataclass(frozen=True)
class CaptureStats:
    """What stood in a capture: nothing is left out without being counted."""

    packets: int
    """Data packets of the sensor."""
    other_packets: int
    """UDP packets that are not its data: telemetry, other devices, other sizes. In a bag: messages of other types."""
    damaged: int
    """Records that end early or cannot be parsed, data packets without a block's flag."""
    turns: int
    """Whole turns. One in which packets were lost is whole too: its pixels stay empty."""
    partial_turns: int
    """First and last turns of which the capture holds only a part."""


@dataclass(frozen=True, eq=False)
class Capture:
    """A recording in memory, opened by ``open_capture``."""

    path: Path
    beams: BeamTable
    """The sensor's; ``beams.name`` is its name."""
    rate_hz: float
    """Turns per second as measured, by the sensor's own clock."""
    cut_deg: float
    stats: CaptureStats
    _packets: list[bytes]
    """By rising azimuth."""
    _azimuth: FloatArray
    """First azimuth of each packet, in degrees since the first turn's beginning: a turn adds 360."""
    _turns: list[tuple[int, bool]]
    """(turn, whole)"""

    @property
    def native_columns(self) -> int:
        """Firings in a turn at the recorded rate: 1 / (firing cycle x rate), rounded.

        The rate wanders and azimuths are rounded, so at this width some pixels get two firings and some none.
        """
        return int(np.floor(1e6 / (self.beams.firing_cycle_us * self.rate_hz) + 0.5))

    def frames(self, columns: int | None = None, *, partial: bool = False) -> Iterator[Frame]:
        """The turns as range images ``[beams, columns]``, in order; with ``partial`` also the incomplete ones.

        ``columns``: None for ``native_columns``. Of several returns in a pixel the nearest wins.
        """
        decoder = _Decoder(self.path, self.beams)
        for turn, whole in self._turns:
            if whole or partial:
                yield self._frame(decoder, turn, columns or self.native_columns)

    def _frame(self, decoder: _Decoder, turn: int, columns: int) -> Frame:
        """Decodes the packets of a turn and a few of its neighbours': a laser that points ahead belongs to the next."""
        first, end = np.searchsorted(self._azimuth, [360.0 * turn - NEAR_DEG, 360.0 * (turn + 1) + NEAR_DEG])
        parts = []
        for packet, start in zip(self._packets[first:end], self._azimuth[first:end], strict=True):
            points = decoder.points(packet)
            ahead = np.mod(azimuth_deg(points) - self.cut_deg - start + 180.0, 360.0) - 180.0
            parts.append(points[np.floor((start + ahead) / 360.0) == turn])
        cloud = np.concatenate(parts)
        points = cloud[:, :4] / np.array([1.0, 1.0, 1.0, 255.0])
        rows = self.beams.beams - 1 - cloud[:, 4].astype(np.int64)  # the decoder's rings count from the bottom
        unit, heights = self.beams.distance_unit_m, decoder.row_height_m
        try:
            image = project(points, rows, self.beams.beams, columns, unit, self.cut_deg, heights)
        except GeometryError as error:
            raise CloudError(self.path, str(error), f"turn {turn}", "points of a Velodyne sensor") from None
        return Frame(
            name=f"{self.path.stem}:{turn}",
            distance=image.distance,
            intensity=image.intensity,
            distance_unit_m=unit,
            elevation_deg=decoder.elevation_deg,
            row_height_m=heights,
            cut_deg=self.cut_deg,
        )


def open_capture(path: str | Path, *, sensor: str | None = None, cut_deg: float = DEFAULT_CUT_DEG) -> Capture:
    """Reads a ``.pcap`` (or pcapng) file or a bag's ``.db3``, finds its sensor, and cuts it into turns at ``cut_deg``.

    ``sensor`` (``hdl-32e``, ``vlp-16``, ``vlp-32c``, ``vls-128``) chooses one of several in the capture; without it
    there must be one only. Raises CloudError for a file that cannot be read, holds no packets of such a sensor, more
    than 1 GiB, or no turn at all, and where the extra ``recordings`` is not installed.
    """
    path = Path(path)
    _check_file(path)
    found = _Found()
    (_read_bag if path.suffix == ".db3" else _read_pcap)(path, found)
    source, recorded = found.choose(path, sensor)
    beams = beam_table(source[1])
    starts, rate_hz, sweep = _unwrap(path, recorded)
    parts = [(start + on, part) for start, p in zip(starts, recorded, strict=True) for on, part in _split_at_jump(p)]
    packets = [part for _, part in parts]
    azimuth = np.array([start for start, _ in parts]) - cut_deg
    azimuth -= 360.0 * np.floor(azimuth[0] / 360.0)
    order = np.argsort(azimuth, kind="stable")
    turns = _whole_turns(azimuth[order], sweep)
    whole = sum(keep for _, keep in turns)
    stats = CaptureStats(
        packets=len(recorded),
        other_packets=found.other + sum(map(len, found.packets.values())) - len(recorded),
        damaged=found.damaged,
        turns=whole,
        partial_turns=len(turns) - whole,
    )
    return Capture(path, beams, rate_hz, cut_deg, stats, [packets[k] for k in order], azimuth[order], turns)


def capture_frames(
    path: str | Path,
    *,
    columns: int | None = None,
    sensor: str | None = None,
    cut_deg: float = DEFAULT_CUT_DEG,
    partial: bool = False,
) -> Iterator[Frame]:
    """The whole turns of a capture (``partial``: and the incomplete ones) as azimuth-aligned range images.

    See ``open_capture`` and ``Capture.frames``, which also tell what was left out. Raises CloudError, before the
    first frame, also where there is no turn to give.
    """
    capture = open_capture(path, sensor=sensor, cut_deg=cut_deg)
    if not capture.stats.turns and not partial:
        what = f"no whole turn, {capture.stats.partial_turns} partial"
        raise CloudError(path, what, "capture", f"a whole turn from {cut_deg:g} degrees on (or partial turns allowed)")
    return capture.frames(columns, partial=partial)


def training_frames(
    capture: Capture,
    rules: Rules,
    *,
    columns: int | None = None,
    hide: Literal["every-other", "three-of-four"] = "every-other",
) -> Iterator[Frame]:
    """The whole turns in counts of ``rules``, to train on: even rows given, odd rows the truth.

    ``every-other`` hides half of the beams; ``three-of-four`` looks at every other beam alone and hides half of these.
    Raises CloudError without a whole turn, and where 32 rows are given that are not those of ``rules``, whose range
    limits by row would then cut returns of other elevations.
    """
    if not capture.stats.turns:
        what = f"no whole turn, {capture.stats.partial_turns} partial"
        raise CloudError(capture.path, what, "capture", "a whole turn to train on")
    for frame in capture.frames(columns):
        seen = every_other_row(frame) if hide == "three-of-four" else frame
        _check_row_limits(capture.path, seen, rules)
        yield in_counts_of(seen, rules.distance_unit_m)


def _check_row_limits(path: Path, frame: Frame, rules: Rules) -> None:
    given, own = frame.elevation_deg[frame.given], rules.row_elevation_deg[0::2]
    limited = bool(np.any(rules.row_max_count < rules.max_count))
    if limited and len(given) == BEAMS and np.max(np.abs(given - own)) > SAME_BEAM_DEG:
        what = f"the 32 given beams are not those of {rules.sensor}, whose rows have range limits of their own"
        raise CloudError(path, what, "beams", "rules without such limits (ground_reach: 0), or that sensor")


# ---------------------------------------------------------------------------------------------------- reading packets


class _Found:
    """Packets of a capture by source, and how many records were none."""

    def __init__(self) -> None:
        self.packets: dict[Source, list[bytes]] = {}
        self.sizes: Counter[int] = Counter()
        """Of the payloads that were no data packets."""
        self.other = 0
        self.damaged = 0

    def add(self, sender: str, payload: bytes) -> None:
        if len(payload) != PACKET_BYTES:
            self.other += 1
            self.sizes[len(payload)] += 1
        elif payload[:2] != b"\xff\xee":
            self.damaged += 1
        else:
            self.packets.setdefault((sender, _sensor_name(payload)), []).append(payload)

    def choose(self, path: Path, sensor: str | None) -> tuple[Source, list[bytes]]:
        """The packets of the one sensor there is, or that was asked for."""
        names = [name for name, _ in SENSORS.values()]
        if sensor is not None and sensor not in names:
            raise CloudError(path, f"no sensor {sensor!r}", "sensor", f"one of {', '.join(names)}")
        if not self.packets:
            raise CloudError(path, self._nothing(), "packets", "data packets of a Velodyne sensor, 1206 bytes each")
        sources = [s for s in self.packets if sensor in (None, s[1])]
        listed = ", ".join(f"{name} from {sender}" for sender, name in self.packets)
        if not sources:
            raise CloudError(path, f"holds {listed}", "packets", f"packets of the {sensor}")
        if sources[0][1] not in names:
            raise CloudError(path, f"packets of {sources[0][1]}", "packets", f"one of {', '.join(names)}")
        if len(sources) > 1:
            raise CloudError(path, f"holds {listed}", "packets", "one sensor, or the name of a single one")
        return sources[0], self.packets[sources[0]]

    def _nothing(self) -> str:
        if OUSTER_BYTES & set(self.sizes):
            return "packets of an Ouster sensor's size"
        sizes = ", ".join(f"{n} of {size} bytes" for size, n in self.sizes.most_common(4))
        return f"no data packets ({sizes or 'no packets at all'}; {self.damaged} damaged)"


def _sensor_name(payload: bytes) -> str:
    # An HDL-64E sends its upper and lower bank by turns, and status characters where the others name their model.
    if payload[100:102] == b"\xff\xdd" and payload[200:202] == b"\xff\xee":
        return "an HDL-64E"
    model = payload[-1]
    if model in SENSORS:
        return SENSORS[model][0]
    return f"an unsupported model, {UNSUPPORTED.get(model, 'unknown')} (0x{model:02X})"


def _check_file(path: Path) -> None:
    try:
        size = path.stat().st_size
    except OSError as error:
        raise CloudError(path, error.strerror or "cannot be read", "file", "a readable file") from None
    if not path.is_file() or size == 0 or size > MAX_FILE_BYTES:
        what = f"{size} bytes" if path.is_file() else "not a file"
        raise CloudError(path, what, "file", f"a .pcap or .db3 file of 1 to {MAX_FILE_BYTES} bytes")


def _library(path: Path, name: str) -> Any:
    try:
        return import_module(name)
    except ImportError:
        what = f"{name.partition('.')[0]} is not installed"
        raise CloudError(path, what, "recordings", "the extra: pip install 'upbeam[recordings]'") from None


def _read_pcap(path: Path, found: _Found) -> None:
    dpkt = _library(path, "dpkt")
    links = {1: dpkt.ethernet.Ethernet, 12: dpkt.ip.IP, 101: dpkt.ip.IP, 113: dpkt.sll.SLL, 0: dpkt.loopback.Loopback}
    with path.open("rb") as file:
        try:
            reader = dpkt.pcap.UniversalReader(file)
            link = links.get(reader.datalink())
        except (ValueError, dpkt.dpkt.Error):
            raise CloudError(path, "no capture header", "byte 0", "a pcap or pcapng file") from None
        if link is None:
            raise CloudError(path, f"link type {reader.datalink()}", "header", "Ethernet, Linux cooked, raw IP")
        records = iter(reader)
        while True:
            try:
                _, record = next(records)
            except StopIteration:
                return
            except (ValueError, dpkt.dpkt.Error):  # the header of a record ends early: so does the file
                found.damaged += 1
                return
            _add_record(dpkt, link, record, found)


def _add_record(dpkt: Any, link: Any, record: bytes, found: _Found) -> None:
    """One captured frame, down to UDP. What is not UDP, or a fragment, counts as another packet."""
    try:
        layer = link(record)
        while not isinstance(layer, (dpkt.udp.UDP, bytes)):
            sender = getattr(layer, "src", b"")
            layer = layer.data
    except (dpkt.dpkt.Error, AttributeError, ValueError, IndexError):
        found.damaged += 1
        return
    if isinstance(layer, bytes):
        found.other += 1
    elif len(layer.data) < layer.ulen - 8:
        found.damaged += 1
    else:
        found.add(f"{'.'.join(map(str, sender)) or 'unknown'} port {layer.sport}", bytes(layer.data))


def _read_bag(path: Path, found: _Found) -> None:
    """Messages of a bag: the storage is SQLite; a bag's metadata.yaml is not needed."""
    parse = _scan_parser(path)
    try:
        with sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro&immutable=1", uri=True) as bag:
            topics = {key: (name, kind) for key, name, kind in bag.execute("SELECT id, name, type FROM topics")}
            for key, data in bag.execute("SELECT topic_id, data FROM messages ORDER BY timestamp, id"):
                name, kind = topics.get(key, ("", ""))
                if kind != SCAN_TYPE:
                    found.other += 1
                else:
                    _add_message(parse, name, data, found)
    except sqlite3.Error as error:
        raise CloudError(path, f"SQLite: {error}", "file", "a ROS 2 bag's .db3, whole") from None
    if not any(kind == SCAN_TYPE for _, kind in topics.values()):
        what = f"topics of {', '.join(sorted({kind for _, kind in topics.values()})) or 'nothing'}"
        raise CloudError(path, what, "topics", f"a topic of {SCAN_TYPE}")


def _add_message(parse: Any, topic: str, data: Any, found: _Found) -> None:
    try:
        packets = [packet.data.tobytes() for packet in parse(data, SCAN_TYPE).packets]
    except Exception:  # the parser is generated code: a damaged message fails anywhere in it
        found.damaged += 1
        return
    for payload in packets:
        found.add(topic, payload)


def _scan_parser(path: Path) -> Any:
    typesys = _library(path, "rosbags.typesys")
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    packet, scan = "velodyne_msgs/msg/VelodynePacket", SCAN_TYPE
    types = typesys.get_types_from_msg(f"builtin_interfaces/Time stamp\nuint8[{PACKET_BYTES}] data", packet)
    types.update(typesys.get_types_from_msg("std_msgs/Header header\nvelodyne_msgs/VelodynePacket[] packets", scan))
    store.register(types)
    return store.deserialize_cdr


# -------------------------------------------------------------------------------------------------------------- turns


def _split_at_jump(packet: bytes) -> list[tuple[float, bytes]]:
    """A packet in which the azimuth jumps, as two without a jump, and how many degrees each begins after it; any other
    as it is.

    A sensor told to send a part of the turn jumps over the rest. The decoder takes what lies between two blocks for
    the way the sensor turned while the lasers of the first one fired, and would smear that firing over 10 degrees.
    """
    azimuth = _AZIMUTHS.unpack_from(packet)
    steps = [(after - before) % 36000 for before, after in pairwise(azimuth)]
    jumps = [k + 1 for k, step in enumerate(steps) if MAX_STEP < step < 36000 - MAX_STEP]
    if not jumps:
        return [(0.0, packet)]
    at = jumps[0]
    step = max((s for s in steps[: at - 1] if s <= MAX_STEP), default=0)
    ahead = [(azimuth[at - 1] + step * (k + 1)) % 36000 for k in range(12 - at)]
    before, after = bytearray(packet), bytearray(packet)
    for block in range(12):
        blanked, angle = (after, azimuth[at]) if block < at else (before, ahead[block - at])
        place = BLOCK_BYTES * block
        blanked[place + 2 : place + BLOCK_BYTES] = struct.pack("<H96x", angle)
    jump = (azimuth[at] - azimuth[0]) % 36000 / 100.0
    return [(0.0, bytes(before)), *((jump + on, part) for on, part in _split_at_jump(bytes(after)))]


def _unwrap(path: Path, packets: list[bytes]) -> tuple[FloatArray, float, float]:
    """First azimuth of each packet in degrees, going on past 360; turns per second; degrees from packet to packet.

    Packets may be lost (the clock tells whole turns that went by) or swapped (a small step back is one).
    """
    head = b"".join(packet[2:4] + packet[1200:1204] for packet in packets)
    fields = np.frombuffer(head, dtype=[("azimuth", "<u2"), ("us", "<u4")])
    azimuth, clock = fields["azimuth"] / 100.0, fields["us"].astype(np.int64)
    step = np.mod(np.diff(azimuth) + 10.0, 360.0) - 10.0
    elapsed = np.mod(np.diff(clock) + _HOUR_US // 2, _HOUR_US) - _HOUR_US // 2
    usual = (elapsed > 0) & (step > 0) & (step < 90.0)
    if usual.any():
        usual &= elapsed < 1.5 * np.median(elapsed[usual])
    if not usual.any():
        raise CloudError(path, f"{len(packets)} packets without motion", "packets", "a turning sensor, a running clock")
    degrees_per_us = step[usual].sum() / elapsed[usual].sum()
    rate_hz = float(degrees_per_us * 1e6 / 360.0)
    if not 1.0 <= rate_hz <= MAX_RATE_HZ:
        raise CloudError(path, f"{rate_hz:.3g} turns per second", "packets", f"1 to {MAX_RATE_HZ:g}")
    step += 360.0 * np.maximum(0, np.floor((elapsed * degrees_per_us - step) / 360.0 + 0.5))
    return np.concatenate(([0.0], np.cumsum(step))) + azimuth[0], rate_hz, float(np.median(step[usual]))


def _whole_turns(azimuth: FloatArray, sweep_deg: float) -> list[tuple[int, bool]]:
    """Turns of sorted azimuths since the first turn's beginning, and which are whole.

    Inner turns are, and show the field of view (some sensors send a part of the turn only); without any it is the
    full turn. The first must begin, and the last must end, where it does.
    """
    turn, place = np.divmod(azimuth, 360.0)
    numbers = np.unique(turn).astype(int)
    spans = np.array([[place[turn == k].min(), place[turn == k].max() + sweep_deg] for k in numbers])
    inner = spans[1:-1] if len(spans) > 2 else np.array([[0.0, 360.0]])
    begin, end = np.median(inner, axis=0)
    whole = np.ones(len(spans), dtype=bool)
    whole[0] &= spans[0, 0] <= begin + WHOLE_TOLERANCE_DEG
    whole[-1] &= spans[-1, 1] >= end - WHOLE_TOLERANCE_DEG
    return [(int(number), bool(keep)) for number, keep in zip(numbers, whole, strict=True)]


class _Decoder:
    """velodyne-decoder, one packet at a time, with the geometry it decodes by."""

    def __init__(self, path: Path, beams: BeamTable) -> None:
        self._library = vd = _library(path, "velodyne_decoder")
        config = vd.Config()
        config.model = model = getattr(vd.Model, dict(SENSORS.values())[beams.name])
        config.min_range, config.max_range = 0.0, 65536 * beams.distance_unit_m
        self._decoder = vd.ScanDecoder(config)
        lasers = yaml.safe_load(vd.Calibration.default_calibs[model].to_string())["lasers"]
        lasers.sort(key=lambda laser: -laser["vert_correction"])
        self.elevation_deg = np.degrees([laser["vert_correction"] for laser in lasers])
        # Lasers leave through one lens beside the axis: seen from the axis, each begins a little higher or lower.
        self.row_height_m = np.array([laser.get("vert_offset_correction", 0.0) for laser in lasers])

    def points(self, packet: bytes) -> FloatArray:
        """``[N, 5]``: x, y, z, intensity 0..255, ring."""
        packets = self._library.PacketVector()
        packets.append(self._library.VelodynePacket(0.0, packet))
        decoded = self._decoder.decode(packets)[1]
        return np.asarray(decoded[:, [0, 1, 2, 3, 6]], dtype=np.float64)
