"""Captures in and out."""

from __future__ import annotations

import sqlite3
from itertools import pairwise
from pathlib import Path
from typing import Any

import dpkt
import numpy as np
import pytest

from upbeam.runtime.packets import CaptureError, Datagram, Decoder, PacketReader, PcapWriter


def written(path: Path, datagrams: list[Datagram]) -> Path:
    with PcapWriter(path) as writer:
        for datagram in datagrams:
            writer.write(datagram.payload, datagram.time_ns, datagram.port)
    return path


def some(rng: np.random.Generator, count: int = 20) -> list[Datagram]:
    return [
        Datagram(1_700_000_000_000_000_000 + k * 552_960, 2368 if k % 5 else 8308, rng.bytes(1206 if k % 5 else 512))
        for k in range(count)
    ]


def test_there_and_back(tmp_path: Path, rng: np.random.Generator) -> None:
    sent = some(rng)
    path = written(tmp_path / "a.pcap", sent)
    reader = PacketReader(path)
    assert list(reader) == sent
    assert list(reader) == sent  # again, from the beginning
    assert reader.counts.datagrams == 20
    only = PacketReader(path, port=8308)
    assert [d.payload for d in only] == [d.payload for d in sent if d.port == 8308]
    assert (only.counts.datagrams, only.counts.other) == (4, 16)


def test_another_reader_agrees(tmp_path: Path, rng: np.random.Generator) -> None:
    """dpkt checks lengths and the header's checksum."""
    sent = some(rng, 3)
    with written(tmp_path / "a.pcap", sent).open("rb") as file:
        for (stamp, record), datagram in zip(dpkt.pcap.Reader(file), sent, strict=True):
            ip = dpkt.ethernet.Ethernet(record).data
            assert int(stamp * 1_000_000_000) == datagram.time_ns
            assert dpkt.in_cksum(bytes(ip)[:20]) == 0
            assert (ip.data.dport, ip.data.data, ip.len) == (
                datagram.port,
                datagram.payload,
                28 + len(datagram.payload),
            )


def test_microseconds_and_pcapng(tmp_path: Path, rng: np.random.Generator) -> None:
    sent = some(rng, 5)
    for name, make in (("b.pcap", dpkt.pcap.Writer), ("c.pcapng", dpkt.pcapng.Writer)):
        path = tmp_path / name
        with written(tmp_path / "a.pcap", sent).open("rb") as source, path.open("wb") as file:
            writer = make(file)
            for stamp, record in dpkt.pcap.Reader(source):
                writer.writepkt(record, float(stamp))
        got = list(PacketReader(path))
        assert [d.payload for d in got] == [d.payload for d in sent]
        assert max(abs(a.time_ns - b.time_ns) for a, b in zip(got, sent, strict=True)) <= 1000


def test_a_cut_file_says_so(tmp_path: Path, rng: np.random.Generator) -> None:
    path = written(tmp_path / "a.pcap", some(rng))
    whole = path.read_bytes()
    for cut in (len(whole) - 700, len(whole) - 1250):
        path.write_bytes(whole[:cut])
        reader = PacketReader(path)
        assert len(list(reader)) == 19
        assert reader.counts.damaged == (1 if cut == len(whole) - 700 else reader.counts.damaged)


def test_what_is_not_udp_is_counted(tmp_path: Path, rng: np.random.Generator) -> None:
    path = tmp_path / "a.pcap"
    with path.open("wb") as file:
        writer = dpkt.pcap.Writer(file)
        tcp = dpkt.ip.IP(src=b"\x01" * 4, dst=b"\x02" * 4, p=6, data=dpkt.tcp.TCP(sport=1, dport=2))
        tcp.len = len(bytes(tcp))
        writer.writepkt(dpkt.ethernet.Ethernet(type=0x0800, data=tcp), 1.0)
        writer.writepkt(b"\x00" * 5, 2.0)
    reader = PacketReader(path)
    assert list(reader) == []
    assert reader.counts.other + reader.counts.damaged == 2


def test_files_that_are_none(tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match="no such file"):
        PacketReader(tmp_path / "none.pcap")
    (tmp_path / "a.pcap").write_bytes(b"not a capture")
    with pytest.raises(CaptureError, match="expected a pcap"):
        list(PacketReader(tmp_path / "a.pcap"))
    with pytest.raises(CaptureError, match=r"no \.db3"):
        list(PacketReader(tmp_path))
    (tmp_path / "a.db3").write_bytes(b"not a bag" * 100)
    with pytest.raises(CaptureError, match="SQLite"):
        list(PacketReader(tmp_path / "a.db3"))
    with sqlite3.connect(tmp_path / "b.db3") as bag:
        bag.execute("CREATE TABLE topics (id INTEGER, type TEXT)")
        bag.execute("INSERT INTO topics VALUES (1, 'std_msgs/msg/String')")
    bag.close()
    with pytest.raises(CaptureError, match="std_msgs"):
        list(PacketReader(tmp_path / "b.db3"))


@pytest.mark.parametrize(("payload", "time_ns", "port"), [(bytes(65001), 0, 1), (b"", 0, 0), (b"", -1, 1)])
def test_datagrams_that_cannot_be(payload: bytes, time_ns: int, port: int, tmp_path: Path) -> None:
    with PcapWriter(tmp_path / "a.pcap") as writer, pytest.raises(CaptureError):
        writer.write(payload, time_ns, port)


@pytest.mark.parametrize("address", ["1.2.3", "1.2.3.256", "host"])
def test_addresses_that_cannot_be(address: Any, tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match="address"):
        PcapWriter(tmp_path / "a.pcap", source=address)


def test_real_bags(data_dir: Path) -> None:
    """Every packet of a bag, in the order of its stamps; those of a sensor we refuse, too."""
    folder = data_dir / "packets"
    for name, packets in (("velodyne_vlp16", 603), ("velodyne_vlp32c", 379), ("velodyne_vls128", 2193)):
        for path in (folder / name / "packets.db3", folder / name):
            reader = PacketReader(path)
            datagrams = list(reader)
            assert (len(datagrams), reader.counts.damaged) == (packets, 0)
            assert {len(d.payload) for d in datagrams} == {1206}
            assert all(a.time_ns <= b.time_ns for a, b in pairwise(datagrams))


def test_real_sensors_that_are_refused_by_name(data_dir: Path) -> None:
    folder = data_dir / "packets"
    for path, name, count in (
        (folder / "velodyne_vls128" / "packets.db3", "VLS_128", 2193),
        (next((folder / "ouster").glob("*.pcap")), "OUSTER", 64),
    ):
        decoder = Decoder()
        decoded = decoder.decode_all(d.payload for d in PacketReader(path))
        assert len(decoded.firings) == 0
        assert decoder.stats["packets"] == {name: count}
