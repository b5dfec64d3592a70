"""UDP payloads out of captures (pcap, ROS 2 bags), and into pcap files."""

from __future__ import annotations

import sqlite3
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO, NamedTuple

__all__ = ["CaptureError", "Datagram", "PacketReader", "PcapWriter"]

DATA_PORT, POSITION_PORT = 2368, 8308
SCAN_TYPE = "velodyne_msgs/msg/VelodyneScan"
_PACKET_TYPE = "velodyne_msgs/msg/VelodynePacket"
_DATA_BYTES = 1206
_MAX_RECORD = 65535


class CaptureError(ValueError):
    """A capture that cannot be read or written: names the file and what was expected."""


class Datagram(NamedTuple):
    """One UDP payload."""

    time_ns: int
    """When it was captured, since 1970; of a bag: the sensor's host's stamp."""
    port: int
    """It was sent to; of a bag: 2368."""
    payload: bytes


@dataclass
class CaptureCounts:
    """Records of a capture so far: nothing is left out without being counted."""

    datagrams: int = 0
    other: int = 0
    """Not UDP, or a fragment; in a bag messages of other types."""
    damaged: int = 0
    """Records that end early or cannot be parsed."""


class PacketReader:
    """Iterates over the UDP payloads of a ``.pcap`` (or pcapng) file or a ROS 2 bag (folder or ``.db3``), in order.

    ``port``: only payloads sent there (others count as ``other``). Raises CaptureError for a file that is neither, and
    where the extra ``recordings`` is not installed.
    """

    def __init__(self, path: str | Path, *, port: int | None = None) -> None:
        self.path = Path(path)
        self.port = port
        self.counts = CaptureCounts()
        if not self.path.exists():
            raise CaptureError(f"{self.path}: no such file")

    def __iter__(self) -> Iterator[Datagram]:
        self.counts = CaptureCounts()
        is_bag = self.path.is_dir() or self.path.suffix == ".db3"
        for datagram in self._bag() if is_bag else self._pcap():
            if self.port is not None and datagram.port != self.port:
                self.counts.other += 1
                continue
            self.counts.datagrams += 1
            yield datagram

    def _pcap(self) -> Iterator[Datagram]:
        dpkt = self._library("dpkt")
        with self.path.open("rb") as file:
            try:
                reader = dpkt.pcap.UniversalReader(file)
            except (ValueError, dpkt.dpkt.Error):
                raise CaptureError(f"{self.path}: no capture header, expected a pcap or pcapng file") from None
            link = _link_layer(dpkt, reader.datalink())
            if link is None:
                raise CaptureError(f"{self.path}: link type {reader.datalink()}, expected Ethernet, cooked or raw IP")
            records = iter(reader)
            while True:
                try:
                    stamp, record = next(records)
                except StopIteration:
                    return
                except (ValueError, dpkt.dpkt.Error):  # a record's header ends early: so does the file
                    self.counts.damaged += 1
                    return
                datagram = self._datagram(dpkt, link, stamp, record)
                if datagram is not None:
                    yield datagram

    def _datagram(self, dpkt: Any, link: Any, stamp: Any, record: bytes) -> Datagram | None:
        """Down to UDP."""
        try:
            layer = link(record)
            while not isinstance(layer, (dpkt.udp.UDP, bytes)):
                layer = layer.data
        except (dpkt.dpkt.Error, AttributeError, ValueError, IndexError):
            self.counts.damaged += 1
            return None
        if isinstance(layer, bytes):
            self.counts.other += 1
            return None
        if len(layer.data) < layer.ulen - 8:
            self.counts.damaged += 1
            return None
        return Datagram(_nanoseconds(stamp), int(layer.dport), bytes(layer.data))

    def _bag(self) -> Iterator[Datagram]:
        parse = self._scan_parser()
        files = sorted(self.path.glob("*.db3")) if self.path.is_dir() else [self.path]
        if not files:
            raise CaptureError(f"{self.path}: no .db3 file in the folder, expected a ROS 2 bag stored as SQLite")
        for file in files:
            try:
                yield from self._bag_file(file, parse)
            except sqlite3.Error as error:
                raise CaptureError(f"{file}: SQLite: {error}, expected a ROS 2 bag's .db3, whole") from None

    def _bag_file(self, file: Path, parse: Any) -> Iterator[Datagram]:
        """Messages of the storage, which is SQLite; the bag's metadata.yaml is not needed."""
        with sqlite3.connect(f"{file.resolve().as_uri()}?mode=ro&immutable=1", uri=True) as bag:
            kinds = dict(bag.execute("SELECT id, type FROM topics"))
            if SCAN_TYPE not in kinds.values():
                found = ", ".join(sorted(set(kinds.values()))) or "nothing"
                raise CaptureError(f"{file}: topics of {found}, expected a topic of {SCAN_TYPE}")
            for key, data in bag.execute("SELECT topic_id, data FROM messages ORDER BY timestamp, id"):
                if kinds.get(key) != SCAN_TYPE:
                    self.counts.other += 1
                    continue
                try:
                    packets = parse(data, SCAN_TYPE).packets
                except Exception:  # the parser is generated code: a damaged message fails anywhere in it
                    self.counts.damaged += 1
                    continue
                for packet in packets:
                    stamp_ns = packet.stamp.sec * 1_000_000_000 + packet.stamp.nanosec
                    yield Datagram(stamp_ns, DATA_PORT, packet.data.tobytes())

    def _scan_parser(self) -> Any:
        typesys = self._library("rosbags.typesys")
        store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
        definition = f"builtin_interfaces/Time stamp\nuint8[{_DATA_BYTES}] data"
        types = typesys.get_types_from_msg(definition, _PACKET_TYPE)
        types.update(
            typesys.get_types_from_msg("std_msgs/Header header\nvelodyne_msgs/VelodynePacket[] packets", SCAN_TYPE)
        )
        store.register(types)
        return store.deserialize_cdr

    def _library(self, name: str) -> Any:
        try:
            return import_module(name)
        except ImportError:
            package = name.partition(".")[0]
            raise CaptureError(f"{self.path}: {package} is not installed: pip install 'upbeam[recordings]'") from None


def _link_layer(dpkt: Any, number: int) -> Any:
    links = {1: dpkt.ethernet.Ethernet, 12: dpkt.ip.IP, 101: dpkt.ip.IP, 113: dpkt.sll.SLL, 0: dpkt.loopback.Loopback}
    return links.get(number)


class PcapWriter:
    """Writes UDP payloads as a pcap file (Ethernet, nanoseconds) that capture tools read. A context manager."""

    _HEADER = struct.Struct("<IHHiIII")
    _RECORD = struct.Struct("<IIII")
    _NANOSECONDS = 0xA1B23C4D

    def __init__(
        self, path: str | Path, *, source: str = "192.168.1.201", destination: str = "255.255.255.255"
    ) -> None:
        self._source, self._destination = _ip(source), _ip(destination)
        self._identification = 0
        self._file: BinaryIO = Path(path).open("wb")  # noqa: SIM115  closed by close()
        self._file.write(self._HEADER.pack(self._NANOSECONDS, 2, 4, 0, 0, _MAX_RECORD, 1))

    def write(self, payload: bytes, time_ns: int, port: int = DATA_PORT) -> None:
        """Appends one datagram. Raises CaptureError for a payload beyond 65000 bytes, or a port out of range."""
        if len(payload) > 65000 or not 0 < port < 65536 or time_ns < 0:
            what = f"a payload of {len(payload)} bytes to port {port} at {time_ns} ns"
            raise CaptureError(f"{what}: expected at most 65000 bytes, port 1 to 65535, a time since 1970")
        frame = self._frame(payload, port)
        seconds, nanoseconds = divmod(time_ns, 1_000_000_000)
        self._file.write(self._RECORD.pack(seconds & 0xFFFFFFFF, nanoseconds, len(frame), len(frame)))
        self._file.write(frame)

    def _frame(self, payload: bytes, port: int) -> bytes:
        udp = struct.pack(">HHHH", port, port, 8 + len(payload), 0)  # 0: no checksum, as sensors send
        self._identification = (self._identification + 1) & 0xFFFF
        ip = struct.pack(
            ">BBHHHBBH4s4s", 0x45, 0, 28 + len(payload), self._identification, 0x4000, 64, 17, 0,
            self._source, self._destination,
        )  # fmt: skip
        ip = ip[:10] + struct.pack(">H", _internet_checksum(ip)) + ip[12:]
        ethernet = b"\xff" * 6 + b"\x60\x76\x88\x00\x00\x01" + b"\x08\x00"
        return ethernet + ip + udp + payload

    def close(self) -> None:
        self._file.close()

    def __enter__(self) -> PcapWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _nanoseconds(stamp: Any) -> int:
    """Of a record's time: seconds, as a Decimal in files of nanoseconds, else a float good for microseconds."""
    whole: int = round(stamp * 1_000_000) * 1000 if isinstance(stamp, float) else int(stamp * 1_000_000_000)
    return whole


def _ip(text: str) -> bytes:
    parts = text.split(".")
    if len(parts) != 4 or not all(part.isdigit() and int(part) < 256 for part in parts):
        raise CaptureError(f"address {text!r}, expected four numbers like 192.168.1.201")
    return bytes(int(part) for part in parts)


def _internet_checksum(header: bytes) -> int:
    total: int = sum(struct.unpack(f">{len(header) // 2}H", header))
    total = (total & 0xFFFF) + (total >> 16)
    return ~(total + (total >> 16)) & 0xFFFF
