"""CARLA clouds: handedness, the two encodings of PLY, raw files, and files that are broken."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from upbeam.hw_sim import read_carla
from upbeam.model.io import CloudError

CARLA = np.array([[10.0, 2.0, -1.5, 0.25], [-3.5, -4.0, 0.0, 1.0], [0.125, 0.0, 2.0, 0.0]], dtype=np.float32)
OURS = CARLA * np.array([1, -1, 1, 1], dtype=np.float32)
HEADER = (
    "ply\nformat {kind} 1.0\nelement vertex {count}\n"
    "property float32 x\nproperty float32 y\nproperty float32 z\nproperty float32 I\nend_header\n"
)


def ascii_ply(points: np.ndarray, count: int | None = None) -> bytes:
    rows = "".join(" ".join(f"{v:.4f}" for v in row) + "\n" for row in points)
    return (HEADER.format(kind="ascii", count=len(points) if count is None else count) + rows).encode()


def binary_ply(points: np.ndarray, count: int | None = None) -> bytes:
    head = HEADER.format(kind="binary_little_endian", count=len(points) if count is None else count)
    return head.encode() + points.astype("<f4").tobytes()


@pytest.mark.parametrize(
    ("name", "data"),
    [("a.ply", ascii_ply(CARLA)), ("b.ply", binary_ply(CARLA)), ("c.bin", CARLA.astype("<f4").tobytes())],
)
def test_y_turns_from_right_to_left(tmp_path: Path, name: str, data: bytes) -> None:
    (tmp_path / name).write_bytes(data)
    points = read_carla(tmp_path / name)
    assert points.dtype == np.float32
    np.testing.assert_array_equal(points, OURS)


BROKEN = {
    "cut.bin": CARLA.astype("<f4").tobytes()[:-3],
    "empty.bin": b"",
    "nan.bin": np.where(CARLA == 2.0, np.nan, CARLA).astype("<f4").tobytes(),
    "bright.bin": (CARLA * 40).astype("<f4").tobytes(),
    "cut.ply": ascii_ply(CARLA, count=5),
    "cut_binary.ply": binary_ply(CARLA)[:-2],
    "empty.ply": ascii_ply(CARLA[:0]),
    "inf.ply": binary_ply(np.where(CARLA == 10.0, np.inf, CARLA)),
    "words.ply": ascii_ply(CARLA).replace(b"2.0000", b"north"),
    "nothing.ply": b"this is no cloud",
    "no_y.ply": ascii_ply(CARLA).replace(b"float32 y", b"float32 q"),
    "cloud.las": b"LASF",
}


@pytest.mark.parametrize("name", sorted(BROKEN))
def test_broken_files_are_refused_by_name(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    path.write_bytes(BROKEN[name])
    with pytest.raises(CloudError, match=name):
        read_carla(path)
