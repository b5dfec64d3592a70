"""Readers and writers: round trips, extremes, damaged files, real files."""

from __future__ import annotations

import io
import os
import struct
import time
import tracemalloc
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from upbeam.model import io as cloud_io
from upbeam.model.geometry import project, recover_rings, to_counts
from upbeam.model.io import (
    Cloud,
    CloudError,
    RangeArrays,
    read_bin,
    read_cloud,
    read_npy,
    read_pcd,
    read_ply,
    write_bin,
    write_npz,
    write_pcd,
    write_ply,
)

POINTS = np.array([[1, 2, 3, 0.5], [-4, 5.5, -6, 0], [1e6, -1e6, 0.125, 1]], dtype=np.float32)
GENERATED = np.array([False, True, False])
READERS = {".bin": read_bin, ".npy": read_npy, ".npz": read_npy, ".ply": read_ply, ".pcd": read_pcd}


# ------------------------------------------------------------------------------------------------- files made by hand


def lzf(data: bytes) -> bytes:
    """A small LZF compressor: the nearest earlier copy of at least 3 bytes, else a literal."""
    out, literal, at, seen = bytearray(), bytearray(), 0, {}

    def flush():
        for i in range(0, len(literal), 32):
            piece = literal[i : i + 32]
            out.extend([len(piece) - 1, *piece])
        literal.clear()

    while at < len(data):
        source = seen.get(data[at : at + 3], -1)
        seen[data[at : at + 3]] = at
        length = 0
        if source >= 0 and at - source <= 8192:
            while length < 264 and at + length < len(data) and data[source + length] == data[at + length]:
                length += 1
        if length < 3:
            literal.append(data[at])
            at += 1
            continue
        flush()
        back = at - source - 1
        short = min(length - 2, 7)
        out.extend([short << 5 | back >> 8, *([length - 9] if short == 7 else []), back & 255])
        at += length
    flush()
    return bytes(out)


def pcd_bytes(layout: str, table: np.ndarray, extra: str = "") -> bytes:
    kinds = {"f": "F", "i": "I", "u": "U"}
    fields = [(name, table.dtype[name].base, int(np.prod(table.dtype[name].shape))) for name in table.dtype.names]
    header = (
        f"# .PCD v0.7\nVERSION 0.7\nFIELDS {' '.join(n for n, _, _ in fields)}\n"
        f"SIZE {' '.join(str(t.itemsize) for _, t, _ in fields)}\n"
        f"TYPE {' '.join(kinds[t.kind] for _, t, _ in fields)}\n"
        f"COUNT {' '.join(str(c) for _, _, c in fields)}\nWIDTH {len(table)}\nHEIGHT 1\n{extra}"
        f"VIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(table)}\nDATA {layout}\n"
    ).encode()
    if layout == "ascii":
        return header + ascii_lines(table)
    if layout == "binary":
        return header + table.tobytes()
    plain = b"".join(np.ascontiguousarray(table[name]).tobytes() for name, _, _ in fields)
    packed = lzf(plain)
    return header + struct.pack("<II", len(packed), len(plain)) + packed


def ply_bytes(layout: str, table: np.ndarray, more: str = "", rest: bytes = b"") -> bytes:
    names = {"f4": "float", "f8": "double", "u1": "uchar", "i1": "int8", "u2": "ushort", "i2": "int16", "i4": "int"}
    properties = "".join(f"property {names[table.dtype[n].str[1:]]} {n}\n" for n in table.dtype.names)
    head = (
        f"ply\nformat {layout} 1.0\ncomment made by hand\nelement vertex {len(table)}\n{properties}{more}end_header\n"
    )
    order = {"binary_big_endian": ">", "binary_little_endian": "<"}
    body = ascii_lines(table) if layout == "ascii" else table.astype(table.dtype.newbyteorder(order[layout])).tobytes()
    return head.encode() + body + rest


def ascii_lines(table: np.ndarray) -> bytes:
    rows = ([str(v) for name in table.dtype.names for v in np.ravel(row[name])] for row in table)
    return "".join(" ".join(row) + "\n" for row in rows).encode()


def npy_bytes(array: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()


def npz_bytes(**arrays: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.savez_compressed(stream, **arrays)
    return stream.getvalue()


def some_table(n: int = 5, dtype: object = None) -> np.ndarray:
    rng = np.random.default_rng(n)
    table = np.zeros(n, dtype or [("x", "f4"), ("y", "f4"), ("z", "f4"), ("intensity", "u1"), ("ring", "u2")])
    for name in table.dtype.names:
        table[name] = rng.integers(0, 100, table[name].shape)
    return table


def small_files() -> dict[str, bytes]:
    table = some_table()
    return {
        "cloud.bin": POINTS.tobytes(),
        "cloud.npy": npy_bytes(POINTS),
        "image.npy": npy_bytes(np.arange(12, dtype=np.uint16).reshape(2, 6)),
        "image.npz": npz_bytes(distance=np.ones((2, 6), np.float32), intensity=np.ones((2, 6), np.uint8)),
        "ascii.pcd": pcd_bytes("ascii", table),
        "binary.pcd": pcd_bytes("binary", table),
        "packed.pcd": pcd_bytes("binary_compressed", table),
        "ascii.ply": ply_bytes("ascii", table),
        "little.ply": ply_bytes("binary_little_endian", table),
        "big.ply": ply_bytes("binary_big_endian", table),
    }


@contextmanager
def watched_memory(limit: int) -> Iterator[None]:
    """Memory taken at the peak, numpy's included, stays below ``limit`` bytes."""
    tracemalloc.start()
    try:
        yield
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < limit, f"{peak} bytes"


def put(folder: Path, name: str, data: bytes) -> Path:
    path = folder / name
    path.write_bytes(data)
    return path


def assert_same_fields(fields: dict, table: np.ndarray) -> None:
    assert list(fields) == list(table.dtype.names)
    for name, values in fields.items():
        assert values.dtype == table[name].dtype
        assert np.array_equal(values, table[name])
        assert values.flags.writeable


# ------------------------------------------------------------------------------------------------------------- bin


def test_bin_round_trip_keeps_the_bits_and_puts_generated_points_last(tmp_path):
    write_bin(tmp_path / "a.bin", POINTS, GENERATED)
    assert np.array_equal(read_bin(tmp_path / "a.bin"), POINTS[[0, 2, 1]])
    cloud = read_cloud(tmp_path / "a.bin")
    assert (cloud.format, cloud.ring, cloud.generated, cloud.has_intensity) == ("bin", None, None, True)


@pytest.mark.parametrize(
    ("data", "match"),
    [
        (b"", "file: no bytes; expected at least one point"),
        (b"\0" * 47, "byte 32: 47 bytes, a remainder of 15; expected a multiple of 16"),
        (
            np.float32([1, 2, 3, 0, 1, np.nan, 3, 0]).tobytes(),
            r"byte 16: point 1 is \[1.0, nan, 3.0, 0.0\]; expected fin",
        ),
        (np.float32([1, 2, 3, 0, 1, 2, -np.inf, 0]).tobytes(), "byte 16: point 1 is .*; expected finite numbers"),
        (np.float32([1, 2, 3, np.nan]).tobytes(), "byte 0: point 0 is .*; expected finite numbers"),
        (np.float32([1, 2, 3, 0, 1, 1.1e6, 3, 0]).tobytes(), "point 1 .*; expected metres, within"),
        (
            np.float32([1, 2, 3, 17]).tobytes(),
            r"intensity 17.0 of point 0; expected 0 to 1 \(state intensity_scale=255",
        ),
        (np.float32([1, 2, 3, -0.1]).tobytes(), "intensity -0.1"),
    ],
)
def test_a_bin_that_is_none_is_named(tmp_path, data, match):
    path = put(tmp_path, "bad.bin", data)
    with pytest.raises(CloudError, match=match) as caught:
        read_bin(path)
    assert str(caught.value).startswith(str(path))
    assert caught.value.path == path


def test_bin_intensities_of_255_steps_must_be_stated(tmp_path):
    path = put(tmp_path, "steps.bin", np.float32([1, 2, 3, 51, 1, 2, 3, 255]).tobytes())
    assert read_bin(path, intensity_scale=255)[:, 3].tolist() == [np.float32(0.2), 1.0]
    assert read_cloud(path, intensity_scale=255).points[0, 3] == np.float32(0.2)
    with pytest.raises(CloudError, match=r"intensity 255\.0 of point 1; expected 0 to 100"):
        read_bin(path, intensity_scale=100)
    with pytest.raises(CloudError, match="intensity_scale 0"):
        read_bin(path, intensity_scale=0)


# ---------------------------------------------------------------------------------------------------------- npy, npz


def test_npy_clouds_and_images(tmp_path):
    counts = np.arange(12, dtype=np.uint16).reshape(2, 6)
    steps = np.arange(12, dtype=np.uint8).reshape(2, 6)
    metres = counts.astype(np.float32) / 8
    assert np.array_equal(read_npy(put(tmp_path, "a.npy", npy_bytes(POINTS.astype(">f8")))), POINTS)
    for array, distance, intensity in [
        (counts, counts, None),
        (np.asfortranarray(metres), metres, None),
        (metres.astype("<f8"), metres, None),
        (np.stack([counts, steps]), counts, steps),
        (np.stack([counts, steps], axis=2), counts, steps),
        (np.stack([metres, steps]), metres, steps),
        (np.stack([metres, steps / np.float32(255)]), metres, steps),
    ]:
        image = read_npy(put(tmp_path, "b.npy", npy_bytes(array)))
        assert isinstance(image, RangeArrays)
        assert image.distance.dtype == distance.dtype
        assert np.array_equal(image.distance, distance)
        assert (image.intensity is None) == (intensity is None)
        assert intensity is None or np.array_equal(image.intensity, intensity)


def test_npz_round_trip(tmp_path):
    arrays = {"distance": np.ones((64, 8), np.float32), "intensity": np.full((64, 8), 200, np.uint8)}
    write_npz(tmp_path / "a.npz", **arrays, generated=np.ones(3, bool), path=np.array("x"))
    image = read_npy(tmp_path / "a.npz")
    assert np.array_equal(image.distance, arrays["distance"])
    assert np.array_equal(image.intensity, arrays["intensity"])
    with np.load(tmp_path / "a.npz", allow_pickle=False) as loaded:
        assert set(loaded) == {"distance", "intensity", "generated", "path"}
    assert read_npy(put(tmp_path, "b.npz", npz_bytes(distance=arrays["distance"]))).intensity is None
    first = (tmp_path / "a.npz").read_bytes()
    write_npz(tmp_path / "a.npz", **arrays, generated=np.ones(3, bool), path=np.array("x"))
    assert (tmp_path / "a.npz").read_bytes() == first  # no time of day in it


@pytest.mark.parametrize(
    ("array", "match"),
    [
        (np.float32(3), r"shape \[\]; expected \[N, 4\]"),
        (np.ones((3, 4, 5), np.uint16), r"shape \[3, 4, 5\]"),
        (np.ones((3, 5), np.int32), "distance of type int32; expected uint16 counts or float metres"),
        (np.empty((0, 5), np.float32), "W at least 4"),
        (np.empty((0, 4), np.float32), "no points"),
        (np.full((2, 5), -1, np.float32), "row 0, column 0: distance -1.0; expected finite metres, 0 for no return"),
        (np.float32([[0, 0, 0, 0, 1], [0, 0, np.nan, 0, 0]]), "row 1, column 2: distance nan"),
        (np.full((2, 2, 5), 300, np.uint16), "row 0, column 0: intensity 300; expected 0 to 255"),
        (np.full((2, 2, 5), 1.5, np.float32), "intensities up to 1.5; expected up to 1, or steps"),
        (np.full((2, 5), 1e300), "value 1e[+]300"),
        (np.array([[1, "a"]], dtype=object), "type object|not an array"),
        (np.array([["a", "b"]]), "type <U1; expected plain numbers"),
        (np.ones(3, [("x", "f4")]), "expected plain numbers"),
    ],
)
def test_an_array_that_is_none_is_named(tmp_path, array, match):
    stream = io.BytesIO()
    np.save(stream, array, allow_pickle=True)
    with pytest.raises(CloudError, match=match):
        read_npy(put(tmp_path, "bad.npy", stream.getvalue()))


def test_an_archive_that_is_none_is_named(tmp_path):
    ones = np.ones((2, 6), np.float32)
    with pytest.raises(CloudError, match="no array 'distance'"):
        read_npy(put(tmp_path, "a.npz", npz_bytes(other=ones)))
    with pytest.raises(CloudError, match=r"intensity of shape \[3, 6\]; expected \[2, 6\]"):
        read_npy(put(tmp_path, "a.npz", npz_bytes(distance=ones, intensity=np.ones((3, 6), np.uint8))))
    with pytest.raises(CloudError, match="not an archive of arrays"):
        read_npy(put(tmp_path, "a.npz", b"PK\x03\x04 and no more"))
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_LZMA) as archive:
        archive.writestr("distance.npy", npy_bytes(ones))
    with pytest.raises(CloudError, match="compression method 14; expected stored or deflated"):
        read_npy(put(tmp_path, "a.npz", stream.getvalue()))
    with pytest.raises(CloudError, match=r"array 'a'.*plain numbers"):
        write_npz(tmp_path / "b.npz", a=np.array([{}], dtype=object))
    assert not (tmp_path / "b.npz").exists()


def test_an_archive_that_unpacks_to_more_than_it_announces_takes_no_memory(tmp_path):
    bomb = bytearray(npz_bytes(distance=np.zeros((64, 1 << 18), np.float32)))
    size = struct.pack("<I", 64 * 4 * (1 << 18) + 128)
    assert bomb.count(size) >= 1
    bomb = bomb.replace(size, struct.pack("<I", 200))
    path = put(tmp_path, "bomb.npz", bytes(bomb))
    with watched_memory(limit=4 << 20), pytest.raises(CloudError, match=r"not an array|not an archive|bytes of data"):
        read_npy(path)


# --------------------------------------------------------------------------------------------------------- ply, pcd


@pytest.mark.parametrize("suffix", [".ply", ".pcd"])
def test_written_clouds_come_back_with_the_flag(tmp_path, suffix):
    write = {".ply": write_ply, ".pcd": write_pcd}[suffix]
    write(tmp_path / f"a{suffix}", POINTS, GENERATED)
    cloud = read_cloud(tmp_path / f"a{suffix}")
    assert np.array_equal(cloud.points, POINTS)
    assert np.array_equal(cloud.generated, GENERATED)
    assert cloud.format == suffix[1:]
    fields = READERS[suffix](tmp_path / f"a{suffix}")
    assert fields["generated"].dtype == np.uint8


DTYPES = st.lists(
    st.tuples(st.sampled_from(["f4", "f8", "i1", "u1", "i2", "u2", "i4"]), st.integers(1, 3)), min_size=1, max_size=6
)


def random_table(draw_types, n: int, seed: int, repeats: bool) -> np.ndarray:
    """Records of any bits, but finite: text cannot keep a NaN's."""
    layout = [
        (f"f{i}", kind, (count,)) if repeats and count > 1 else (f"f{i}", kind)
        for i, (kind, count) in enumerate(draw_types)
    ]
    table = np.zeros(n, dtype=layout)
    rng = np.random.default_rng(seed)
    for name in table.dtype.names:
        base = table.dtype[name].base
        raw = (
            rng.integers(0, 256, table[name].size * base.itemsize, dtype=np.uint8).view(base).reshape(table[name].shape)
        )
        table[name] = np.nan_to_num(raw, posinf=1.5, neginf=-1.5) if base.kind == "f" else raw
    return table


@settings(max_examples=60)
@given(
    types=DTYPES,
    n=st.integers(0, 40),
    seed=st.integers(0, 2**32),
    layout=st.sampled_from(["ascii", "binary", "binary_compressed"]),
)
def test_pcd_of_any_fields_comes_back(tmp_path_factory, types, n, seed, layout):
    table = random_table(types, n, seed, repeats=True)
    path = put(tmp_path_factory.getbasetemp(), "any.pcd", pcd_bytes(layout, table))
    assert_same_fields(read_pcd(path), table)


@settings(max_examples=60)
@given(
    types=DTYPES, n=st.integers(0, 40), seed=st.integers(0, 2**32), layout=st.sampled_from(list(cloud_io._PLY_LAYOUTS))
)
def test_ply_of_any_properties_comes_back(tmp_path_factory, types, n, seed, layout):
    table = random_table(types, n, seed, repeats=False)
    path = put(tmp_path_factory.getbasetemp(), "any.ply", ply_bytes(layout, table))
    assert_same_fields(read_ply(path), table)


@given(
    data=st.binary(max_size=2000) | st.binary(max_size=3).map(lambda b: b * 900), size=st.none() | st.integers(0, 99)
)
def test_lzf_comes_back_and_no_more(data, size):
    packed = lzf(data)
    assert cloud_io._lzf_decode(Path("a.pcd"), packed, len(data), 0) == data
    if size is not None and size != len(data):
        with pytest.raises(CloudError):
            cloud_io._lzf_decode(Path("a.pcd"), packed, size, 0)


@given(packed=st.binary(max_size=300), size=st.integers(0, 2000))
def test_lzf_of_any_bytes_is_bounded(packed, size):
    try:
        plain = cloud_io._lzf_decode(Path("a.pcd"), packed, size, 0)
    except CloudError:
        return
    assert len(plain) == size


@pytest.mark.parametrize(
    ("packed", "size"), [(b"\5abc", 3), (b"\0a\x20", 4), (b"\0a\xe0\0", 10), (b"\x20\0", 3), (b"\0a\x20\1", 4)]
)
def test_lzf_tokens_that_reach_outside_are_refused(packed, size):
    with pytest.raises(CloudError, match=r"byte \d+: a (token beyond the end|reference before the first byte)"):
        cloud_io._lzf_decode(Path("a.pcd"), packed, size, 0)


def test_lzf_stops_where_the_announced_size_is_full():
    with watched_memory(limit=1 << 19), pytest.raises(CloudError, match="a token beyond the end"):
        cloud_io._lzf_decode(Path("a.pcd"), b"\0a" + b"\xe0\xff\0" * 10000, 10, 0)


def test_ply_elements_after_the_vertices_are_skipped(tmp_path):
    faces = "element face 1\nproperty list uchar int vertex_indices\n"
    table = some_table()
    path = put(tmp_path, "a.ply", ply_bytes("binary_little_endian", table, faces, b"\3" + bytes(12)))
    assert_same_fields(read_ply(path), table)
    path = put(tmp_path, "b.ply", ply_bytes("ascii", table, faces, b"3 0 1 2\n"))
    assert_same_fields(read_ply(path), table)
    path = put(tmp_path, "c.ply", ply_bytes("ascii", table).replace(b"\n", b"\r\n"))
    assert_same_fields(read_ply(path), table)


@pytest.mark.parametrize(
    ("old", "new", "match"),
    [
        (b"ply\n", b"plx\n", "line 1: not a PLY file"),
        (b"format ascii 1.0\n", b"", "line 4: 'property float x'"),
        (b"format ascii", b"format utf8", "line 2: 'format utf8 1.0'"),
        (b"ascii 1.0", b"ascii 2.0", "line 2"),
        (b"vertex 5", b"vertex 6", "5 whole lines of points in .*; expected 6 lines of 5 numbers"),
        (b"vertex 5", b"vertex 999999999999999", "expected 999999999999999 lines"),
        (b"vertex 5", b"vertex 9999999999999999", "vertices '9999999999999999'"),
        (b"vertex 5", b"vertex -1", "vertices '-1'"),
        (b"vertex 5", b"vertex 4", "bytes after the last point; expected the end of the file"),
        (b"float y", b"float x", "line 6: 'property float x'"),
        (b"float y", b"half y", "line 6: 'property half y'"),
        (b"float y", b"list uchar int y", "line 6"),
        (
            b"element vertex",
            b"element face 3\nproperty list uchar int a\nelement vertex",
            "'face'; expected the vertices",
        ),
        (b"end_header", b"end_headr", "not text|ends early|too long|line"),
        (b"comment made by hand", b"comment " + b"x" * 2000, "line 3, byte 21: a line that is too long"),
        (b"comment made by hand", b"comment \xff", "line 3, byte 21: not text"),
        (b"comment made by hand\n", b"comment x\n" * 7000, "a header of at most 65536 bytes"),
    ],
)
def test_a_ply_header_that_is_none_is_named(tmp_path, old, new, match):
    data = ply_bytes("ascii", some_table())
    assert data.count(old) == 1
    with pytest.raises(CloudError, match=match):
        read_ply(put(tmp_path, "bad.ply", data.replace(old, new)))


@pytest.mark.parametrize(
    ("old", "new", "match"),
    [
        (b"DATA ascii", b"DATA hex", "DATA 'hex'"),
        (b"DATA ascii", b"DATA", "no DATA"),
        (b"FIELDS x", b"FIELDZ x", "line 3: 'FIELDZ'"),
        (b"FIELDS x y", b"FIELDS x x", "field 'x': a field twice"),
        (b"SIZE 4", b"SIZE 2", "field 'x': TYPE 'F' of SIZE '2'"),
        (b"SIZE 4 4", b"SIZE 4", "5 FIELDS, 4 SIZE"),
        (b"TYPE F", b"TYPE Q", "TYPE 'Q'"),
        (b"COUNT 1", b"COUNT 0", "COUNT '0'; expected a whole number, 1 or more"),
        (b"COUNT 1", b"COUNT 5000", "COUNT 5000; expected at most 4096"),
        (b"POINTS 5", b"POINTS 6", "POINTS 6; expected WIDTH x HEIGHT = 5"),
        (b"POINTS 5", b"POINTS five", "POINTS 'five'"),
        (b"POINTS 5", b"POINTS", "0 values of POINTS"),
        (b"HEIGHT 1", b"HEIGHT 1\nHEIGHT 1", "line 9: 'HEIGHT'"),
    ],
)
def test_a_pcd_header_that_is_none_is_named(tmp_path, old, new, match):
    data = pcd_bytes("ascii", some_table())
    assert data.count(old) == 1
    with pytest.raises(CloudError, match=match):
        read_pcd(put(tmp_path, "bad.pcd", data.replace(old, new)))


@pytest.mark.parametrize("word", ["1_0", "0x10", "a", "300", "-1", "1.5", "9" * 5000, "\u0661"])
def test_text_that_is_no_number_is_named(tmp_path, word):
    table = some_table(3, [("x", "f4"), ("ring", "u1")])
    data = pcd_bytes("ascii", table).rstrip().rsplit(b" ", 1)[0] + f" {word}\n".encode()
    with pytest.raises(CloudError, match=r"line 14: .*expected (a number of type uint8|2)"):
        read_pcd(put(tmp_path, "bad.pcd", data))


def test_text_keeps_what_is_not_finite_and_refuses_what_does_not_fit(tmp_path):
    lines = b"nan inf\n-inf 1e38\n"
    head = pcd_bytes("ascii", some_table(2, [("x", "f4"), ("y", "f4")])).split(b"DATA ascii\n")[0] + b"DATA ascii\n"
    fields = read_pcd(put(tmp_path, "a.pcd", head + lines))
    assert np.array_equal(fields["x"], np.float32([np.nan, -np.inf]), equal_nan=True)
    with pytest.raises(CloudError, match="line 13: b'1e39'; expected a number of type float32"):
        read_pcd(put(tmp_path, "a.pcd", head + lines.replace(b"1e38", b"1e39")))


def test_64_bit_text_is_exact(tmp_path):
    table = np.zeros(2, [("t", "u8"), ("s", "i8")])
    table["t"], table["s"] = [2**64 - 1, 2**53 + 1], [-(2**63), 2**63 - 1]
    assert_same_fields(read_pcd(put(tmp_path, "a.pcd", pcd_bytes("ascii", table))), table)


def test_pcd_padding_zero_width_and_page_padding(tmp_path):
    table = some_table(5, [("x", "f4"), ("y", "f4"), ("z", "f4"), ("_", "u1", (4,)), ("intensity", "f4")])
    data = pcd_bytes("binary", table).replace(b"WIDTH 5\nHEIGHT 1\n", b"WIDTH 0\nHEIGHT 0\n") + bytes(100)
    assert list(read_pcd(put(tmp_path, "a.pcd", data))) == ["x", "y", "z", "intensity"]
    with pytest.raises(CloudError, match="1 bytes after the last point"):
        read_pcd(put(tmp_path, "a.pcd", data + b"\1"))


@pytest.mark.parametrize(
    ("sizes", "match"),
    [
        ((0, 75), "75 bytes uncompressed; expected 5 points of 13|75 bytes uncompressed|65 "),
        ((10**6, 65), "bytes of compressed data; expected 1000000"),
        ((0, 65), "65 bytes out of 0; expected at most 88 times"),
    ],
)
def test_compressed_sizes_that_lie_are_named(tmp_path, sizes, match):
    table = some_table(5, [("x", "f4"), ("y", "f4"), ("z", "f4"), ("i", "u1")])
    head = pcd_bytes("binary_compressed", table).split(b"compressed\n")[0] + b"compressed\n"
    with pytest.raises(CloudError, match=match):
        read_pcd(put(tmp_path, "a.pcd", head + struct.pack("<II", *sizes) + b"\0" * 20))


def test_a_count_the_file_cannot_hold_takes_no_memory(tmp_path):
    table = some_table(5, [("x", "f4")])
    huge = b"400000000000"
    for layout in ("ascii", "binary", "binary_compressed"):
        data = pcd_bytes(layout, table).replace(b"WIDTH 5", b"WIDTH " + huge).replace(b"POINTS 5", b"POINTS " + huge)
        path = put(tmp_path, "a.pcd", data)
        with watched_memory(limit=4 << 20), pytest.raises(CloudError, match=r"expected 400000000000 "):
            read_pcd(path)


def test_wide_records_on_short_lines_take_no_memory(tmp_path):
    data = pcd_bytes("ascii", some_table(5, [("x", "f4")])).replace(b"COUNT 1", b"COUNT 4000")
    data = data.replace(b"WIDTH 5", b"WIDTH 20000").replace(b"POINTS 5", b"POINTS 20000") + b"\n" * 20000
    path = put(tmp_path, "a.pcd", data)
    with watched_memory(limit=4 << 20), pytest.raises(CloudError, match="expected 20000 lines of 4000 numbers"):
        read_pcd(path)


def test_a_line_too_long_is_not_cut_within_a_number(tmp_path):
    data = pcd_bytes("ascii", some_table(1, [("x", "f4")])).rsplit(b"\n", 2)[0] + b"\n" + b" " * 98 + b"123\n"
    with pytest.raises(CloudError, match="line 12: a line that is too long"):
        read_pcd(put(tmp_path, "a.pcd", data))


# ------------------------------------------------------------------------------------------------------------ clouds


def cloud_of(tmp_path: Path, **columns: object) -> Cloud:
    table = np.zeros(3, [(name, np.asarray(values).dtype) for name, values in columns.items()])
    for name, values in columns.items():
        table[name] = values
    return read_cloud(put(tmp_path, "cloud.pcd", pcd_bytes("binary", table)))


XYZ = {"x": np.float32([1, 2, 3]), "y": np.float64([4, 5, 6]), "z": np.float32([7, 8, 9])}


def test_cloud_takes_rings_flags_and_intensities(tmp_path):
    cloud = cloud_of(tmp_path, **XYZ, Intensity=np.uint8([0, 51, 255]), ring=np.uint16([2, 1, 0]))
    assert cloud.points.tolist() == [[1, 4, 7, 0], [2, 5, 8, np.float32(0.2)], [3, 6, 9, 1]]
    assert cloud.ring.tolist() == [2, 1, 0]
    assert cloud.generated is None
    assert cloud_of(tmp_path, **XYZ, intensity=np.float32([0, 51, 255])).points[1, 3] == np.float32(0.2)
    assert cloud_of(tmp_path, **XYZ, intensity=np.float32([0, 0.5, 1])).points[1, 3] == 0.5
    assert cloud_of(tmp_path, **XYZ, generated=np.uint8([0, 1, 0])).generated.tolist() == [False, True, False]
    bare = cloud_of(tmp_path, **XYZ)
    assert not bare.has_intensity
    assert not bare.points[:, 3].any()
    assert (bare.ring, bare.generated) == (None, None)


def test_pcd_pixels_without_a_return_are_left_out_and_counted(tmp_path):
    nan = np.float32([np.nan, 2, np.nan])
    cloud = cloud_of(tmp_path, x=nan, y=nan, z=nan, ring=np.uint16([5, 6, 7]))
    assert cloud.points.tolist() == [[2, 2, 2, 0]]
    assert cloud.ring.tolist() == [6]
    assert cloud.no_return == 2
    with pytest.raises(CloudError, match=r"point 2: .*expected finite numbers"):
        cloud_of(tmp_path, x=np.float32([np.nan, 2, 3]), y=nan, z=nan)


@pytest.mark.parametrize(
    ("columns", "match"),
    [
        ({"x": XYZ["x"], "z": XYZ["z"]}, "no field y"),
        ({**XYZ, "intensity": np.float32([0, 1, 1.2])}, "intensities up to 1.2.*state which"),
        ({**XYZ, "intensity": np.float32([0, 1, 300])}, "point 2: intensity 300.0 of point 2; expected 0 to 255"),
        ({**XYZ, "intensity": np.float32([0, np.nan, 300])}, "intensity 300"),
        ({**XYZ, "intensity": np.float32([0, np.nan, 1])}, "point 1: .*expected finite"),
        ({**XYZ, "intensity": np.int16([0, -1, 3])}, "intensity -1"),
        ({**XYZ, "ring": np.float32([0, 1.5, 2])}, "ring 1.5; expected a whole number"),
        ({**XYZ, "ring": np.int32([0, 1, -2])}, "point 2: ring -2"),
        ({**XYZ, "generated": np.uint8([0, 1, 2])}, "generated 2; expected a whole number, 0 to 1"),
        ({**XYZ, "x": np.float64([0, 0, 1e300])}, "value 1e[+]300"),
        ({**XYZ, "x": np.float64([0, 0, 2e6])}, "within"),
    ],
)
def test_a_cloud_that_is_none_is_named(tmp_path, columns, match):
    with pytest.raises(CloudError, match=match):
        cloud_of(tmp_path, **columns)


def test_read_cloud_dispatches_on_the_suffix(tmp_path):
    for name, data in small_files().items():
        path = put(tmp_path, name, data)
        if name.startswith("image"):
            with pytest.raises(CloudError, match=r"range image|suffix"):
                read_cloud(path)
        else:
            cloud = read_cloud(path)
            assert cloud.format == path.suffix[1:]
            assert cloud.points.dtype == np.float32
            assert 0 <= cloud.points[:, 3].min() <= cloud.points[:, 3].max() <= 1
    with pytest.raises(CloudError, match=r"suffix '.las'; expected .bin, .npy, .pcd or .ply"):
        read_cloud(tmp_path / "a.las")
    with pytest.raises(CloudError, match="no points"):
        read_cloud(put(tmp_path, "empty.ply", ply_bytes("ascii", some_table(0))))


@pytest.mark.parametrize("suffix", READERS)
def test_what_is_no_file_is_named(tmp_path, suffix):
    read = READERS[suffix]
    with pytest.raises(CloudError, match="No such file"):
        read(tmp_path / f"missing{suffix}")
    (tmp_path / f"folder{suffix}").mkdir()
    with pytest.raises(CloudError, match="not a regular file"):
        read(tmp_path / f"folder{suffix}")
    os.mkfifo(tmp_path / f"pipe{suffix}")
    with pytest.raises(CloudError, match="not a regular file"):
        read(tmp_path / f"pipe{suffix}")
    with pytest.raises(CloudError, match="expected a file that can be read"):
        read(f"a\0b{suffix}")
    with (tmp_path / f"huge{suffix}").open("wb") as file:
        file.truncate(cloud_io.MAX_FILE_BYTES + 16)
    with pytest.raises(CloudError, match="expected at most 1073741824 bytes"):
        read(tmp_path / f"huge{suffix}")


# ------------------------------------------------------------------------------------------------------------ writing


WRITERS = {"a.bin": write_bin, "a.ply": write_ply, "a.pcd": write_pcd}


@pytest.mark.parametrize(("name", "write"), WRITERS.items())
def test_a_failed_write_leaves_what_was_there(tmp_path, monkeypatch, name, write):
    path = put(tmp_path, name, b"before")
    bad = POINTS.copy()
    bad[1, 2] = np.nan
    for points, generated, match in [
        (bad, GENERATED, "point 1: .*expected finite"),
        (POINTS * 2, GENERATED, "expected metres|expected 0 to 1"),
        (POINTS.astype(float), GENERATED, r"points are float64\[3, 4\]; expected float32\[N, 4\]"),
        (POINTS, GENERATED[:2], r"generated is bool\[2\]; expected bool\[3\]"),
        (POINTS, GENERATED.astype(np.uint8), "generated is uint8"),
        (POINTS[:0], GENERATED[:0], "no points"),
    ]:
        with pytest.raises(CloudError, match=match):
            write(path, points, generated)

    def full(self, target):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "replace", full)
    with pytest.raises(CloudError, match="No space left on device; expected a file that can be written"):
        write(path, POINTS, GENERATED)
    assert path.read_bytes() == b"before"
    assert [p.name for p in tmp_path.iterdir()] == [name]


def test_writers_replace_files_follow_links_and_spare_the_rest(tmp_path):
    target = put(tmp_path, "target.bin", b"before")
    (tmp_path / "link.bin").symlink_to(target)
    write_bin(tmp_path / "link.bin", POINTS, GENERATED)
    assert (tmp_path / "link.bin").is_symlink()
    assert len(read_bin(target)) == 3
    os.mkfifo(tmp_path / "pipe.bin")
    for path, match in [
        (tmp_path / "pipe.bin", "not a regular file"),
        (tmp_path, "not a regular file"),
        (tmp_path / "no" / "a.bin", "No such file"),
        (tmp_path / "a\0.bin", "can be written"),
    ]:
        with pytest.raises(CloudError, match=match):
            write_bin(path, POINTS, GENERATED)
    (tmp_path / "ring.bin").symlink_to(tmp_path / "ring.bin")
    with pytest.raises(CloudError, match="expected a file that can be written"):
        write_bin(tmp_path / "ring.bin", POINTS, GENERATED)


def test_writing_does_not_change_what_is_written(tmp_path):
    points, flags = POINTS.copy(), GENERATED.copy()
    points.setflags(write=False)
    flags.setflags(write=False)
    for name, write in WRITERS.items():
        write(tmp_path / name, points, flags)
    assert np.array_equal(points, POINTS)


# ------------------------------------------------------------------------------------------------------ damaged files


@pytest.mark.parametrize(("name", "data"), small_files().items())
def test_a_file_cut_short_at_any_length_is_refused(tmp_path, name, data):
    path = tmp_path / name
    for length in range(len(data)):
        path.write_bytes(data[:length])
        if name.endswith(".bin") and length and length % 16 == 0:
            assert len(read_bin(path)) == length // 16  # the format cannot tell
            continue
        with pytest.raises(CloudError):
            READERS[path.suffix](path)
    path.write_bytes(data)
    READERS[path.suffix](path)


def check_any_bytes(path: Path, data: bytes) -> None:
    """A result or a CloudError that names the file, and nothing else."""
    path.write_bytes(data)
    for read in (READERS[path.suffix], read_cloud):
        try:
            result = read(path)
        except CloudError as error:
            if str(path) not in str(error):
                raise AssertionError(f"no file named: {error}") from error
            continue
        if isinstance(result, Cloud):
            assert np.isfinite(result.points).all()
            assert len(result.points)


@settings(max_examples=100)
@given(
    suffix=st.sampled_from(list(READERS)),
    start=st.sampled_from([b"", b"ply\n", b"\x93NUMPY\1\0v\0{", b"PK\3\4"]),
    data=st.binary(max_size=400),
)
def test_random_bytes_are_refused_or_read(tmp_path_factory, suffix, start, data):
    check_any_bytes(tmp_path_factory.getbasetemp() / f"random{suffix}", start + data)


SMALL = small_files()
WORDS = [
    b"0",
    b"-1",
    b"1",
    b"7",
    b"4096",
    b"99999999999",
    b"nan",
    b"1e400",
    b"list",
    b"vertex",
    b"F",
    b"_",
    b"x",
    b"\n",
    b" ",
    b"(",
    b"'",
]


def mutate(data: bytes, rng: np.random.Generator) -> bytes:
    """Some bytes changed, cut out or doubled, or a word of the header exchanged."""
    for _ in range(rng.integers(1, 4)):
        at, n = int(rng.integers(0, len(data) + 1)), int(rng.integers(0, 9))
        kind = rng.integers(0, 4)
        if kind == 0:
            data = data[:at] + rng.bytes(n) + data[at + n :]
        elif kind == 1:
            data = data[:at] + data[at + n :]
        elif kind == 2:
            data = data[:at] + data[at : at + n] * 2 + data[at + n :]
        else:
            words = data.split(b" ")
            words[int(rng.integers(0, len(words)))] = WORDS[int(rng.integers(0, len(WORDS)))]
            data = b" ".join(words)
    return data


@pytest.mark.parametrize("name", SMALL)
def test_mutated_files_are_refused_or_read(tmp_path, rng, name):
    slowest = 0.0
    for _ in range(300):
        data = mutate(SMALL[name], rng)
        start = time.perf_counter()
        try:
            with watched_memory(limit=4 << 20):
                check_any_bytes(tmp_path / name, data)
        except Exception as error:
            raise AssertionError(f"{name}: {data!r}") from error
        slowest = max(slowest, time.perf_counter() - start)
    print(f"\n{name}: slowest of 300 mutants {slowest * 1e3:.1f} ms (measured)")


# --------------------------------------------------------------------------------------------------------- real files


def test_real_clouds_of_two_drivers(data_dir):
    packets = data_dir / "packets"
    vlp16 = read_cloud(packets / "velodyne_vlp16" / "decoded_with_ring.pcd")  # WIDTH 0, HEIGHT 0
    assert vlp16.points.shape == (14673, 4)
    assert set(np.unique(vlp16.ring)) <= set(range(16))
    fields = read_pcd(packets / "velodyne_vlp16" / "decoded_with_ring.pcd")
    measured = np.linalg.norm(vlp16.points[:, :3].astype(float), axis=1)
    assert np.allclose(measured, fields["distance"], atol=0.1)


def test_a_real_compressed_cloud_decodes_to_what_its_own_fields_say(data_dir):
    """The driver stored distance, azimuth and elevation beside x, y, z: one wrong byte in the LZF stream would show."""
    folder = data_dir / "packets" / "velodyne_vlp32c"
    start = time.perf_counter()
    fields = read_pcd(folder / "decoded_full_fields.pcd")
    print(f"\n{len(fields['x'])} compressed points: {(time.perf_counter() - start) * 1e3:.0f} ms (measured)")
    xyz = np.stack([fields[axis] for axis in "xyz"], axis=1).astype(float)
    assert np.allclose(np.linalg.norm(xyz, axis=1), fields["distance"], atol=0.05)
    plain = read_pcd(folder / "decoded_xyz.pcd")
    assert np.array_equal(plain["z"], fields["z"])


def test_real_frames_read_and_round_trip(data_dir, tmp_path):
    files = sorted((data_dir / "kitti" / "frames").glob("*.bin"))
    assert len(files) >= 20
    for file in files[:5]:
        points = read_bin(file)
        assert points.tobytes() == file.read_bytes()
        flags = np.zeros(len(points), bool)
        write_bin(tmp_path / "a.bin", points, flags)
        assert (tmp_path / "a.bin").read_bytes() == file.read_bytes()
        for name, write in list(WRITERS.items())[1:]:
            write(tmp_path / name, points, flags)
            assert np.array_equal(read_cloud(tmp_path / name).points, points)
    image = project(points, recover_rings(points), 64, 2048, 0.002)
    write_npz(tmp_path / "a.npz", distance=image.metres(), intensity=image.intensity)
    again = read_npy(tmp_path / "a.npz")
    assert np.array_equal(to_counts(again.distance, 0.002)[0], image.distance)
    assert np.array_equal(again.intensity, image.intensity)
