"""Readers and writers of clouds and range images: ``.bin``, ``.npy``, ``.npz``, ``.ply``, ``.pcd``.

A file that cannot be read gives a ``CloudError`` that names the file, what is wrong, where, and what was expected;
nothing is dropped without being counted. Sizes are checked against the file before memory is taken. Writers write a
file beside the target and rename it, so that a failed run leaves no half of a file.

Intensities of a ``Cloud`` are 0..1. A field of whole numbers holds steps of 0..255. A field of floats holds 0..1 if
none is above 1, and steps of 0..255 if one is 2 or more; in between nobody can tell, and the file is refused.
Floating steps that are all 0 or 1 would be misread: ``intensity_scale``, the intensity that stands for 1, states what a
file holds. ``.bin`` has a fixed meaning, 0..1, and other intensities are refused unless stated.
"""

from __future__ import annotations

import math
import re
import secrets
import stat
import struct
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from .geometry import IndexArray

__all__ = [
    "Cloud",
    "CloudError",
    "RangeArrays",
    "read_bin",
    "read_cloud",
    "read_npy",
    "read_pcd",
    "read_ply",
    "write_bin",
    "write_npz",
    "write_pcd",
    "write_ply",
]

Points = NDArray[np.float32]
Fields = dict[str, NDArray[Any]]

MAX_FILE_BYTES = 1 << 30
MAX_MEMBER_BYTES = 1 << 28
MAX_HEADER_BYTES = 1 << 16
MAX_LINE_BYTES = 1 << 10
MAX_COORDINATE_M = 1e6
MAX_RECORD_NUMBERS = 1 << 12
"""Numbers a point may have: far above any point type in use (a shape descriptor has 640)."""
MAX_ASCII_NUMBER_BYTES = 100
_ASCII_BLOCK_LINES = 1 << 14
_LZF_MAX_EXPANSION = 88
"""A reference of 3 bytes copies at most 264."""


class CloudError(ValueError):
    """A file that cannot be read or written: the file, what is wrong, where, and what was expected."""

    def __init__(self, path: str | Path, what: str, where: str, expected: str) -> None:
        super().__init__(f"{path}: {where}: {what}; expected {expected}")
        self.path, self.what, self.where, self.expected = Path(path), what, where, expected


@dataclass(frozen=True, eq=False)
class Cloud:
    """A cloud as a file holds it, in file order."""

    points: Points
    """``float32[N, 4]``, N >= 1: x, y, z in metres, intensity 0..1. Finite."""
    format: str
    """``bin``, ``npy``, ``pcd`` or ``ply``."""
    ring: IndexArray | None = None
    """``int64[N]``, the file's own ring numbers (a driver may count from the bottom); None if it has none."""
    generated: NDArray[np.bool_] | None = None
    """``bool[N]``, True for points that were generated, not measured; None if the file does not say."""
    has_intensity: bool = True
    """False if the file has no intensities: they are 0."""
    no_return: int = 0
    """Points left out because x, y and z are all NaN: how a ``.pcd`` writes a pixel without a return."""


@dataclass(frozen=True, eq=False)
class RangeArrays:
    """A range image as a file holds it, ``[rows, W]``."""

    distance: NDArray[np.uint16] | NDArray[np.float32]
    """uint16 counts, or float32 metres; 0 = no return."""
    intensity: NDArray[np.uint8] | None
    """0..255; None if the file has none."""


# ------------------------------------------------------------------------------------------------------------ readers


def read_bin(path: str | Path, intensity_scale: float = 1.0) -> Points:
    """A KITTI cloud: little-endian float32 x, y, z, intensity; ``float32[N, 4]``, intensity 0..1.

    ``intensity_scale`` is the file's full intensity, 1 or e.g. 255; intensities are divided by it. Raises CloudError
    for a size that is not a multiple of 16, an empty file, values that are not finite, coordinates beyond 1e6 m and
    intensities outside 0..``intensity_scale``.
    """
    path = Path(path)
    data = _read(path)
    rest = len(data) % 16
    if rest:
        what = f"{len(data)} bytes, a remainder of {rest}"
        raise CloudError(path, what, f"byte {len(data) - rest}", "a multiple of 16, 16 bytes a point")
    points = np.frombuffer(data, dtype="<f4").reshape(-1, 4).astype(np.float32)
    full = _full_intensity(path, points[:, 3], False, intensity_scale)
    return _finish_cloud(path, points, full, lambda i: f"byte {16 * i}")


def read_npy(path: str | Path, intensity_scale: float | None = None) -> Points | RangeArrays:
    """An array file: a cloud or a range image. Never unpickles.

    * ``.npy``, float, ``[N, 4]``: a cloud, given as ``float32[N, 4]`` with intensity 0..1 (so no image of 4 columns);
    * ``.npy``, ``[rows, W]``: a range image, uint16 counts or float metres, without intensity;
    * ``.npy``, ``[rows, W, 2]``, else ``[2, rows, W]``: distance and intensity (no image is 2 columns wide);
    * ``.npz``: a range image in the arrays ``distance`` and, if there, ``intensity``; others are left alone.

    Intensities: see the module. Raises CloudError for other shapes and types, and for distances that are negative or
    not finite.
    """
    path = Path(path)
    if path.suffix.lower() == ".npz":
        arrays = _npz_members(path, _read(path))
        if "distance" not in arrays:
            raise CloudError(path, "no array 'distance'", "archive", "arrays 'distance' and 'intensity'")
        return _range_arrays(path, arrays["distance"], arrays.get("intensity"), intensity_scale)
    array = _parse_npy(path, _read(path), "")
    if array.ndim == 2 and array.shape[1] == 4 and array.dtype.kind == "f":
        points = _float32(path, array, "array")
        return _finish_cloud(path, points, _full_intensity(path, points[:, 3], False, intensity_scale))
    if array.ndim == 2:
        return _range_arrays(path, array, None, intensity_scale)
    if array.ndim == 3 and array.shape[2] == 2:
        return _range_arrays(path, array[:, :, 0], array[:, :, 1], intensity_scale)
    if array.ndim == 3 and array.shape[0] == 2:
        return _range_arrays(path, array[0], array[1], intensity_scale)
    raise CloudError(
        path, f"an array of shape {list(array.shape)}", "header", "[N, 4], [rows, W], [2, rows, W] or [rows, W, 2]"
    )


def read_ply(path: str | Path) -> Fields:
    """Scalar properties of a PLY file's vertices by name, each an array of its own type and of the vertices' number.

    Ascii, binary little and big endian. The vertices must come first; elements after them are skipped.
    """
    path = Path(path)
    data = _read(path)
    layout, count, dtype, start, more = _ply_header(path, data)
    read_table = _ascii_table if layout == "ascii" else _binary_table
    table, end = read_table(path, data, start, count, dtype)
    if not more:
        _refuse_trailing(path, data, end)
    return {name: _native(table[name]) for name in dtype.names or ()}


def read_pcd(path: str | Path) -> Fields:
    """Fields of a PCD file by name, each ``[N]`` (``[N, COUNT]`` where COUNT > 1) of its own type.

    Ascii, binary and binary_compressed. Padding fields (named ``_``) are left out. POINTS counts; a WIDTH x HEIGHT of
    0, which some drivers write, is not held against it.
    """
    path = Path(path)
    data = _read(path)
    layout, count, dtype, start = _pcd_header(path, data)
    names = [name for name in dtype.names or () if not name.startswith(_PADDING)]
    if layout == "binary_compressed":
        fields = _pcd_compressed(path, data, start, count, dtype)
        return {name: fields[name] for name in names}
    read_table = _ascii_table if layout == "ascii" else _binary_table
    table, end = read_table(path, data, start, count, dtype)
    _refuse_trailing(path, data, end)
    return {name: _native(table[name]) for name in names}


def read_cloud(path: str | Path, intensity_scale: float | None = None) -> Cloud:
    """A cloud from a ``.bin``, ``.npy``, ``.pcd`` or ``.ply`` file, intensities in 0..1 (see the module).

    ``.pcd`` and ``.ply`` need x, y, z; ``intensity`` (or ``i``), ``ring`` and ``generated`` are taken where they are,
    in any case of letters. Raises CloudError for what the readers refuse, a file without points, and values that are
    not finite.
    """
    path = Path(path)
    kind = path.suffix.lower().lstrip(".")
    if kind == "bin":
        return Cloud(read_bin(path, 1.0 if intensity_scale is None else intensity_scale), kind)
    if kind == "npy":
        points = read_npy(path, intensity_scale)
        if isinstance(points, RangeArrays):
            raise CloudError(path, f"a range image {list(points.distance.shape)}", "header", "a cloud [N, 4] of floats")
        return Cloud(points, kind)
    if kind == "pcd":
        return _cloud_of_fields(path, kind, read_pcd(path), intensity_scale)
    if kind == "ply":
        return _cloud_of_fields(path, kind, read_ply(path), intensity_scale)
    raise CloudError(path, f"suffix {path.suffix!r}", "name", ".bin, .npy, .pcd or .ply")


# ------------------------------------------------------------------------------------------------------------ writers


def write_bin(path: str | Path, points: Points, generated: NDArray[np.bool_]) -> None:
    """A KITTI cloud of ``points[N, 4]``: measured points in their order, then those with ``generated[N]`` True.

    The format has no room for the flag: the number of measured points is what tells them apart.
    """
    path = Path(path)
    points, generated = _check_writable(path, points, generated)
    _write(path, np.concatenate([points[~generated], points[generated]]).astype("<f4").tobytes())


def write_ply(path: str | Path, points: Points, generated: NDArray[np.bool_]) -> None:
    """Binary little-endian PLY of ``points[N, 4]`` in order: x, y, z, intensity (0..1), uchar ``generated`` 0 or 1."""
    path = Path(path)
    table = _flagged_table(path, points, generated)
    header = (
        "ply\nformat binary_little_endian 1.0\ncomment generated: 0 measured by the sensor, 1 generated\n"
        f"element vertex {len(table)}\n"
        "property float x\nproperty float y\nproperty float z\nproperty float intensity\nproperty uchar generated\n"
        "end_header\n"
    )
    _write(path, header.encode("ascii") + table.tobytes())


def write_pcd(path: str | Path, points: Points, generated: NDArray[np.bool_]) -> None:
    """Binary PCD of ``points[N, 4]`` in order: x, y, z, intensity (0..1), one-byte ``generated`` 0 or 1."""
    path = Path(path)
    table = _flagged_table(path, points, generated)
    header = (
        "# .PCD v0.7 - generated: 0 measured by the sensor, 1 generated\nVERSION 0.7\n"
        "FIELDS x y z intensity generated\nSIZE 4 4 4 4 1\nTYPE F F F F U\nCOUNT 1 1 1 1 1\n"
        f"WIDTH {len(table)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(table)}\nDATA binary\n"
    )
    _write(path, header.encode("ascii") + table.tobytes())


def write_npz(path: str | Path, /, **arrays: NDArray[Any]) -> None:
    """The arrays by name, uncompressed. Raises CloudError for an array of objects (which would need pickle)."""
    path = Path(path)
    buffer = BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive:
        for name, array in arrays.items():
            array = np.asarray(array)
            if array.dtype.hasobject or array.dtype.names is not None:
                raise CloudError(path, f"type {array.dtype}", f"array {name!r}", "plain numbers or text")
            with archive.open(zipfile.ZipInfo(f"{name}.npy"), "w", force_zip64=True) as member:
                np.lib.format.write_array(member, array, allow_pickle=False)
    _write(path, buffer.getvalue())


# ---------------------------------------------------------------------------------------------------- files and arrays


def _read(path: Path) -> bytes:
    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode):  # a pipe would block, a device never end
            raise CloudError(path, "not a regular file", "file", "a file that can be read")
        if status.st_size > MAX_FILE_BYTES:
            raise CloudError(path, f"{status.st_size} bytes", "file", f"at most {MAX_FILE_BYTES} bytes")
        data = path.read_bytes()
    except CloudError:
        raise
    except (OSError, ValueError) as error:  # ValueError: a name with a NUL byte
        raise CloudError(path, _reason(error), "file", "a file that can be read") from None
    if not data:
        raise CloudError(path, "no bytes", "file", "at least one point")
    return data


def _write(path: Path, data: bytes) -> None:
    """Write ``data`` beside the target and rename it: the target is the whole of it, or what it was before."""
    try:
        target = path.resolve()
        if target.exists() and not target.is_file():
            raise CloudError(path, "not a regular file", "target", "a file to create or replace")
        part = target.with_name(f".{secrets.token_hex(8)}.part")
        try:
            with part.open("xb") as file:
                file.write(data)
            part.replace(target)
        finally:
            part.unlink(missing_ok=True)
    except CloudError:
        raise
    except (OSError, RuntimeError, ValueError) as error:  # RuntimeError: links in a circle; ValueError: a NUL byte
        raise CloudError(path, _reason(error), "target", "a file that can be written") from None


def _reason(error: Exception) -> str:
    text = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
    return " ".join(text.split())[:200] or type(error).__name__


def _parse_npy(path: Path, data: bytes, member: str) -> NDArray[Any]:
    """The array in the bytes of an ``.npy`` file or of a member of an ``.npz`` file."""
    stream: BinaryIO = BytesIO(data)
    prefix = f"{member} " if member else ""
    try:
        version = np.lib.format.read_magic(stream)
        header = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}[version]
        shape, fortran, dtype = header(stream)
    except Exception as error:  # numpy reads the header as Python text: whatever it trips over is a bad header
        what = f"not an array: {_reason(error)}"
        raise CloudError(path, what, f"{prefix}byte 0", "an .npy header of version 1 or 2") from None
    if dtype.hasobject or dtype.names is not None or dtype.kind not in "biuf":
        raise CloudError(path, f"type {dtype}", f"{prefix}header", "plain numbers")
    count = _product(shape)
    start = stream.tell()
    if min(shape, default=1) < 0 or count * dtype.itemsize != len(data) - start:
        raise CloudError(
            path,
            f"{len(data) - start} bytes of data",
            f"{prefix}byte {start}",
            f"{count * dtype.itemsize} for shape {list(shape)} of {dtype}",
        )
    flat = np.frombuffer(data, dtype=dtype, count=count, offset=start)
    return _native(flat.reshape(shape, order="F" if fortran else "C"))


def _npz_members(path: Path, data: bytes) -> dict[str, NDArray[Any]]:
    arrays: dict[str, NDArray[Any]] = {}
    try:
        with zipfile.ZipFile(BytesIO(data)) as archive:
            for info in archive.infolist():
                name = info.filename.removesuffix(".npy")
                if name in arrays:
                    raise CloudError(path, "an array twice", info.filename, "each name once")
                if name in {"distance", "intensity"}:
                    arrays[name] = _parse_npy(path, _inflate(path, archive, info), info.filename)
    except CloudError:
        raise
    except Exception as error:  # zipfile raises many types on a damaged archive
        raise CloudError(path, f"not an archive of arrays: {_reason(error)}", "archive", "an .npz file") from None
    return arrays


def _inflate(path: Path, archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> bytes:
    if info.compress_type not in {zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED}:
        raise CloudError(path, f"compression method {info.compress_type}", info.filename, "stored or deflated")
    if info.file_size > MAX_MEMBER_BYTES:
        raise CloudError(path, f"{info.file_size} bytes", info.filename, f"at most {MAX_MEMBER_BYTES} bytes")
    with archive.open(info) as member:
        return member.read(info.file_size)  # bounded: a member may unpack to more than it announces


def _product(shape: tuple[int, ...]) -> int:
    count = 1
    for size in shape:
        count *= size
    return count


def _native(array: NDArray[Any]) -> NDArray[Any]:
    """A contiguous, writable copy in this machine's byte order."""
    return np.array(array, dtype=array.dtype.newbyteorder("="), order="C")


def _float32(path: Path, array: NDArray[Any], where: str) -> NDArray[np.float32]:
    with np.errstate(over="ignore"):
        narrow = array.astype(np.float32)
    lost = np.isinf(narrow) & np.isfinite(array)
    if lost.any():
        at = tuple(int(i) for i in np.argwhere(lost)[0])
        raise CloudError(path, f"value {array[at]} at {list(at)}", where, "values that fit float32")
    return narrow


# -------------------------------------------------------------------------------------------------- clouds and images


def _range_arrays(
    path: Path, distance: NDArray[Any], intensity: NDArray[Any] | None, intensity_scale: float | None
) -> RangeArrays:
    if distance.ndim != 2 or distance.shape[0] < 1 or distance.shape[1] < 4:
        raise CloudError(path, f"distance of shape {list(distance.shape)}", "header", "[rows, W], W at least 4")
    if distance.dtype.kind == "f":
        bad = ~((distance >= 0) & np.isfinite(distance))
        if bad.any():
            row, column = (int(i) for i in np.argwhere(bad)[0])
            what = f"distance {distance[row, column]}"
            raise CloudError(path, what, f"row {row}, column {column}", "finite metres, 0 for no return")
        distance = _float32(path, distance, "distance")
    elif distance.dtype != np.uint16:
        raise CloudError(path, f"distance of type {distance.dtype}", "header", "uint16 counts or float metres")
    if intensity is None:
        return RangeArrays(distance, None)
    if intensity.shape != distance.shape:
        what = f"intensity of shape {list(intensity.shape)}"
        raise CloudError(path, what, "header", f"{list(distance.shape)}, as distance")
    full = _full_intensity(path, intensity, intensity.dtype.kind != "f", intensity_scale)
    bad = ~((intensity >= 0) & (intensity <= full))
    if bad.any():
        row, column = (int(i) for i in np.argwhere(bad)[0])
        raise CloudError(path, f"intensity {intensity[row, column]}", f"row {row}, column {column}", f"0 to {full:g}")
    steps = np.floor(intensity.astype(np.float64) * (255.0 / full) + 0.5)
    return RangeArrays(distance, steps.astype(np.uint8))


def _full_intensity(path: Path, intensity: NDArray[Any], whole: bool, stated: float | None) -> float:
    """The intensity that stands for 1: as stated, or by the rule of the module."""
    if stated is not None:
        if not (np.isfinite(stated) and stated > 0):
            raise CloudError(path, f"intensity_scale {stated}", "argument", "a number above 0")
        return stated
    if whole:
        return 255.0
    highest = float(np.fmax.reduce(intensity, axis=None, initial=0.0))
    if 1.0 < highest < 2.0:
        raise CloudError(path, f"intensities up to {highest}", "intensity", "up to 1, or steps of 0..255: state which")
    return 255.0 if highest > 1.0 else 1.0


def _cloud_of_fields(path: Path, kind: str, fields: Fields, intensity_scale: float | None) -> Cloud:
    named = {name.lower(): values for name, values in fields.items() if values.ndim == 1}
    missing = [name for name in "xyz" if name not in named]
    if missing:
        raise CloudError(path, f"no field {', '.join(missing)}", "header", "x, y and z, one number each")
    intensity = named.get("intensity", named.get("i"))
    points = np.zeros((len(named["x"]), 4), dtype=np.float32)
    for column, name in enumerate("xyz"):
        points[:, column] = _float32(path, named[name], f"field {name}")
    full = 1.0
    if intensity is not None:
        points[:, 3] = _float32(path, intensity, "field intensity")
        full = _full_intensity(path, points[:, 3], intensity.dtype.kind != "f", intensity_scale)
    returned = np.ones(len(points), dtype=np.bool_)
    if kind == "pcd":
        np.logical_not(np.isnan(points[:, :3]).all(axis=1), out=returned)
    place = np.flatnonzero(returned)
    points = _finish_cloud(path, points[returned], full, lambda i: f"point {place[i]}")
    return Cloud(
        points=points,
        format=kind,
        ring=_whole_numbers(path, named, "ring", returned, 65535),
        generated=_flags(path, named, returned),
        has_intensity=intensity is not None,
        no_return=int(np.count_nonzero(~returned)),
    )


def _finish_cloud(
    path: Path, points: Points, full: float, where: Callable[[int], str] = lambda i: f"point {i}"
) -> Points:
    _scale_intensity(path, points, full, where)
    _check_points(path, points, where)
    return points


def _whole_numbers(path: Path, named: Fields, name: str, chosen: NDArray[np.bool_], highest: int) -> IndexArray | None:
    if name not in named:
        return None
    values = named[name]
    bad = ~((values >= 0) & (values <= highest))
    if values.dtype.kind == "f":
        bad |= values != np.floor(values)
    bad &= chosen
    if bad.any():
        at = int(np.argmax(bad))
        raise CloudError(path, f"{name} {values[at]}", f"point {at}", f"a whole number, 0 to {highest}")
    return values[chosen].astype(np.int64)


def _flags(path: Path, named: Fields, chosen: NDArray[np.bool_]) -> NDArray[np.bool_] | None:
    flags = _whole_numbers(path, named, "generated", chosen, 1)
    return None if flags is None else flags.astype(bool)


def _scale_intensity(path: Path, points: Points, full: float, where: Callable[[int], str]) -> None:
    """Divide the intensities by the file's full one, in place."""
    bad = ~((points[:, 3] >= 0) & (points[:, 3] <= full)) & ~np.isnan(points[:, 3])
    if bad.any():
        at = int(np.argmax(bad))
        hint = " (state intensity_scale=255 for steps of 0..255)" if full == 1.0 else ""
        raise CloudError(path, f"intensity {points[at, 3]} of point {at}", where(at), f"0 to {full:g}{hint}")
    if full != 1.0:
        points[:, 3] = (points[:, 3].astype(np.float64) / full).astype(np.float32)


def _check_points(path: Path, points: Points, where: Callable[[int], str]) -> None:
    if len(points) == 0:
        raise CloudError(path, "no points", "file", "at least one point")
    bad = ~np.isfinite(points).all(axis=1)
    if bad.any():
        at = int(np.argmax(bad))
        raise CloudError(path, f"point {at} is {points[at].tolist()}", where(at), "finite numbers")
    bad = (np.abs(points[:, :3]) > MAX_COORDINATE_M).any(axis=1)
    if bad.any():
        at = int(np.argmax(bad))
        raise CloudError(path, f"point {at} is {points[at].tolist()}", where(at), "metres, within +-1e6")


def _check_writable(path: Path, points: Points, generated: NDArray[np.bool_]) -> tuple[Points, NDArray[np.bool_]]:
    """Refuse what the readers would refuse to read back."""
    points, generated = np.asarray(points), np.asarray(generated)
    if points.ndim != 2 or points.shape[1] != 4 or points.dtype != np.float32:
        raise CloudError(path, f"points are {points.dtype}{list(points.shape)}", "argument", "float32[N, 4]")
    if generated.shape != (len(points),) or generated.dtype != np.bool_:
        what = f"generated is {generated.dtype}{list(generated.shape)}"
        raise CloudError(path, what, "argument", f"bool[{len(points)}], one a point")
    _scale_intensity(path, points, 1.0, lambda i: f"point {i}")
    _check_points(path, points, lambda i: f"point {i}")
    return points, generated


def _flagged_table(path: Path, points: Points, generated: NDArray[np.bool_]) -> NDArray[Any]:
    points, generated = _check_writable(path, points, generated)
    table = np.empty(len(points), dtype=[("xyzi", "<f4", (4,)), ("generated", "u1")])
    table["xyzi"], table["generated"] = points, generated
    return table


# ------------------------------------------------------------------------------------------------------ tables, headers


def _header_lines(path: Path, data: bytes, last: Callable[[list[str]], bool]) -> tuple[list[list[str]], int]:
    """Words of each line up to the one ``last`` accepts, and the offset of the byte after it."""
    lines: list[list[str]] = []
    start = 0
    while True:
        end = data.find(b"\n", start, start + MAX_LINE_BYTES)
        where = f"line {len(lines) + 1}, byte {start}"
        if end < 0:
            what = "the header ends early" if len(data) - start < MAX_LINE_BYTES else "a line that is too long"
            raise CloudError(path, what, where, f"a header line of at most {MAX_LINE_BYTES} bytes")
        try:
            words = data[start:end].decode("utf-8").split()
            if b"\0" in data[start:end]:
                raise ValueError("a NUL byte")
        except ValueError:
            raise CloudError(path, "not text", where, "a header line") from None
        lines.append(words)
        start = end + 1
        if last(words):
            return lines, start
        if start > MAX_HEADER_BYTES:
            what = f"no end of header in {start} bytes"
            raise CloudError(path, what, where, f"a header of at most {MAX_HEADER_BYTES} bytes")


def _number(path: Path, word: str, where: str, what: str, lowest: int = 0) -> int:
    if not re.fullmatch(r"[0-9]{1,15}", word, re.ASCII) or int(word) < lowest:
        raise CloudError(path, f"{what} {word[:40]!r}", where, f"a whole number, {lowest} or more")
    return int(word)


_PLY_TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}
_PLY_LAYOUTS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}


def _ply_header(path: Path, data: bytes) -> tuple[str, int, np.dtype[Any], int, bool]:
    """Layout, vertices, their type, where they begin, and whether other elements' data follow."""
    lines, start = _header_lines(path, data, lambda words: words == ["end_header"])
    if lines[0] != ["ply"]:
        raise CloudError(path, "not a PLY file", "line 1", "the word 'ply'")
    layout, count, after, more = "", -1, False, False
    types: dict[str, str] = {}
    for number, words in enumerate(lines[1:-1], start=2):
        where = f"line {number}"
        match words:
            case [] | ["comment" | "obj_info", *_]:
                pass
            case ["format", name, "1.0"] if name in _PLY_LAYOUTS and not layout:
                layout = name
            case ["element", "vertex", points] if count < 0:
                count = _number(path, points, where, "vertices")
            case ["element", name, items]:
                more |= _number(path, items, where, "elements") > 0
                if count < 0 or name == "vertex":
                    raise CloudError(path, f"element {name[:40]!r}", where, "the vertices first, and once")
                after = True
            case ["property", _, _] | ["property", "list", _, _, _] if after:
                pass
            case ["property", kind, name] if layout and count >= 0 and kind in _PLY_TYPES and name not in types:
                types[name] = _PLY_LAYOUTS[layout] + _PLY_TYPES[kind]
            case _:
                expected = "the format, elements, comments and scalar properties of the vertices, once each"
                raise CloudError(path, f"{' '.join(words)[:80]!r}", where, expected)
    if not layout or count < 0 or not types:
        raise CloudError(path, "an incomplete header", "header", "a format, vertices and their properties")
    return layout, count, np.dtype(list(types.items())), start, more


_PCD_KEYS = ("VERSION", "FIELDS", "SIZE", "TYPE", "COUNT", "WIDTH", "HEIGHT", "VIEWPOINT", "POINTS", "DATA")
_PADDING = "\0"
"""Begins the names given to padding fields; no header has such a byte."""
_PCD_SIZES = {"F": (4, 8), "I": (1, 2, 4, 8), "U": (1, 2, 4, 8)}


def _pcd_header(path: Path, data: bytes) -> tuple[str, int, np.dtype[Any], int]:
    """Layout, points, their type, and where they begin. Padding is named ``_PADDING`` and a number."""
    lines, start = _header_lines(path, data, lambda words: words[:1] == ["DATA"])
    entries: dict[str, list[str]] = {}
    for number, words in enumerate(lines, start=1):
        if not words or words[0].startswith("#"):
            continue
        key = "FIELDS" if words[0] == "COLUMNS" else words[0]
        if key not in _PCD_KEYS or key in entries:
            raise CloudError(path, f"{words[0][:40]!r}", f"line {number}", f"one each of {', '.join(_PCD_KEYS)}")
        entries[key] = words[1:]
    missing = [key for key in ("FIELDS", "SIZE", "TYPE", "DATA") if not entries.get(key)]
    if missing:
        raise CloudError(path, f"no {', '.join(missing)}", "header", "FIELDS, SIZE, TYPE and DATA")
    layout = entries["DATA"][0]
    if layout not in {"ascii", "binary", "binary_compressed"} or len(entries["DATA"]) != 1:
        what = f"DATA {' '.join(entries['DATA'])[:40]!r}"
        raise CloudError(path, what, "header", "ascii, binary or binary_compressed")
    return layout, _pcd_points(path, entries), _pcd_type(path, entries), start


def _pcd_points(path: Path, entries: dict[str, list[str]]) -> int:
    sizes = {}
    for key in ("WIDTH", "HEIGHT", "POINTS"):
        if key in entries:
            if len(entries[key]) != 1:
                raise CloudError(path, f"{len(entries[key])} values of {key}", "header", "one")
            sizes[key] = _number(path, entries[key][0], "header", key)
    area = sizes.get("WIDTH", 0) * sizes.get("HEIGHT", 1)
    if "POINTS" not in sizes and "WIDTH" not in sizes:
        raise CloudError(path, "no POINTS", "header", "POINTS, or WIDTH and HEIGHT")
    points = sizes.get("POINTS", area)
    if area not in {0, points}:
        raise CloudError(path, f"POINTS {points}", "header", f"WIDTH x HEIGHT = {area}")
    return points


def _pcd_type(path: Path, entries: dict[str, list[str]]) -> np.dtype[Any]:
    names, sizes, kinds = entries["FIELDS"], entries["SIZE"], entries["TYPE"]
    counts = entries.get("COUNT", ["1"] * len(names))
    if not len(names) == len(sizes) == len(kinds) == len(counts):
        what = f"{len(names)} FIELDS, {len(sizes)} SIZE, {len(kinds)} TYPE, {len(counts)} COUNT"
        raise CloudError(path, what, "header", "one each a field")
    types: dict[str, Any] = {}
    numbers = 0
    for place, (name, size, kind, count) in enumerate(zip(names, sizes, kinds, counts, strict=True)):
        where = f"field {name[:40]!r}"
        if kind not in _PCD_SIZES or _number(path, size, where, "SIZE") not in _PCD_SIZES[kind]:
            what = f"TYPE {kind[:40]!r} of SIZE {size[:40]!r}"
            raise CloudError(path, what, where, "F of 4 or 8, I or U of 1, 2, 4 or 8")
        key = f"{_PADDING}{place}" if name == "_" else name
        if key in types:
            raise CloudError(path, "a field twice", where, "each name once")
        repeat = _number(path, count, where, "COUNT", lowest=1)
        numbers += repeat
        if numbers > MAX_RECORD_NUMBERS:
            raise CloudError(path, f"COUNT {repeat}", where, f"at most {MAX_RECORD_NUMBERS} numbers a point")
        element = f"<{kind.lower()}{size}"
        types[key] = element if repeat == 1 else (element, (repeat,))
    return np.dtype(list(types.items()))


def _binary_table(path: Path, data: bytes, start: int, count: int, dtype: np.dtype[Any]) -> tuple[NDArray[Any], int]:
    """``count`` records that begin at ``start``, and the offset after them."""
    whole = (len(data) - start) // dtype.itemsize
    if count > whole:
        where = f"byte {start + whole * dtype.itemsize}"
        raise CloudError(path, f"data for {whole} points", where, f"{count} points of {dtype.itemsize} bytes")
    return np.frombuffer(data, dtype=dtype, count=count, offset=start), start + count * dtype.itemsize


def _refuse_trailing(path: Path, data: bytes, end: int) -> None:
    """Some writers pad to a page with zeros; anything else after the points was not understood."""
    rest = data[end:].lstrip(b"\0 \r\n")
    if rest:
        where = f"byte {len(data) - len(rest)}"
        raise CloudError(path, f"{len(rest)} bytes after the last point", where, "the end of the file")


def _ascii_table(path: Path, data: bytes, start: int, count: int, dtype: np.dtype[Any]) -> tuple[NDArray[Any], int]:
    """``count`` lines of numbers that begin at ``start`` as records, and the offset after them."""
    line = data.count(b"\n", 0, start) + 1
    whole = data.count(b"\n", start)
    width = sum(_product(dtype[name].shape) for name in dtype.names or ())
    if count > whole or count * 2 * width > len(data) - start:
        # A number cut short is a number still: only the line's end shows that the last one is whole.
        expected = f"{count} lines of {width} numbers, the last one ended too"
        raise CloudError(path, f"{whole} whole lines of points in {len(data) - start} bytes", f"line {line}", expected)
    table = np.empty(count, dtype=dtype.newbyteorder("="))
    stream = BytesIO(data)
    stream.seek(start)
    for first in range(0, count, _ASCII_BLOCK_LINES):
        block = table[first : first + _ASCII_BLOCK_LINES]
        rows = [_ascii_row(path, stream, width, line + first + i) for i in range(len(block))]
        _fill_records(path, block, rows, line + first)
    return table, stream.tell()


def _ascii_row(path: Path, stream: BytesIO, width: int, line: int) -> list[bytes]:
    text = stream.readline(width * MAX_ASCII_NUMBER_BYTES)
    words = text.split()
    if not text.endswith(b"\n"):
        raise CloudError(path, "a line that is too long", f"line {line}", f"{width} numbers")
    if len(words) != width:
        raise CloudError(path, f"{len(words)} numbers", f"line {line}", f"{width}")
    return words


def _fill_records(path: Path, block: NDArray[Any], rows: list[list[bytes]], line: int) -> None:
    """Parse ``rows`` of words, of which the first stands in ``line``, into the records of ``block``."""
    columns = iter(zip(*rows, strict=True))
    for name in block.dtype.names or ():
        values = block[name].reshape(len(block), -1)
        for place in range(values.shape[1]):
            values[:, place] = _ascii_column(path, next(columns), values.dtype, line)


def _ascii_column(path: Path, words: tuple[bytes, ...], dtype: np.dtype[Any], line: int) -> NDArray[Any]:
    floating = dtype.kind == "f"
    parse: Callable[[bytes], float] = float if floating else int
    limits = np.finfo(dtype) if floating else np.iinfo(dtype)
    lowest, highest = (float(limits.min), float(limits.max)) if floating else (int(limits.min), int(limits.max))
    values = []
    for number, word in enumerate(words, start=line):
        try:
            value = parse(word)
            # "nan" and "inf" are floats, a number too large is none; Python reads 1_000, which the formats do not know.
            good = (lowest <= value <= highest or (floating and not math.isfinite(value))) and b"_" not in word
        except ValueError:
            good = False
        if not good:
            raise CloudError(path, f"{word[:40]!r}", f"line {number}", f"a number of type {dtype}")
        values.append(value)
    return np.array(values, dtype=dtype)


def _pcd_compressed(path: Path, data: bytes, start: int, count: int, dtype: np.dtype[Any]) -> Fields:
    """Fields of a binary_compressed body: two sizes, then an LZF stream that holds field after field."""
    if len(data) - start < 8:
        raise CloudError(path, f"{len(data) - start} bytes", f"byte {start}", "two 4-byte sizes")
    packed, size = struct.unpack_from("<II", data, start)
    body = start + 8
    if packed > len(data) - body:
        raise CloudError(path, f"{len(data) - body} bytes of compressed data", f"byte {body}", f"{packed}")
    if size != count * dtype.itemsize:
        expected = f"{count} points of {dtype.itemsize} bytes"
        raise CloudError(path, f"{size} bytes uncompressed", f"byte {start + 4}", expected)
    if size > packed * _LZF_MAX_EXPANSION:
        expected = f"at most {_LZF_MAX_EXPANSION} times as many"
        raise CloudError(path, f"{size} bytes out of {packed}", f"byte {start}", expected)
    _refuse_trailing(path, data, body + packed)
    plain = _lzf_decode(path, data[body : body + packed], size, body)
    fields, offset = {}, 0
    for name in dtype.names or ():
        field = dtype[name]
        values = np.frombuffer(plain, dtype=field.base, count=count * _product(field.shape), offset=offset)
        fields[name] = _native(values.reshape((count, *field.shape)))
        offset += count * field.itemsize
    return fields


def _lzf_decode(path: Path, packed: bytes, size: int, base: int) -> bytes:
    """``size`` bytes out of an LZF stream; ``base`` is its offset in the file, for messages.

    A control byte below 32 announces that many + 1 literal bytes; else its upper 3 bits are a length - 2 (7: one more
    byte is added) and its lower 5 with the next byte the distance - 1 to copy from.
    """
    out = bytearray()
    at, end = 0, len(packed)
    while at < end:
        token, control = at, packed[at]
        at += 1
        if control < 32:
            stop = at + control + 1
            out += packed[at:stop]
            at = stop
        else:
            length = control >> 5
            if length == 7 and at < end:
                length += packed[at]
                at += 1
            source = len(out) - ((control & 31) << 8) - 1
            source -= packed[at] if at < end else 0
            at += 1
            length += 2
            if source < 0:
                raise CloudError(path, "a reference before the first byte", f"byte {base + token}", "an LZF stream")
            # A copy may run into what it writes: then the bytes from the source on repeat.
            chunk = out[source : source + length]
            out += (chunk * (length // len(chunk) + 1))[:length] if len(chunk) < length else chunk
        if at > end or len(out) > size:
            raise CloudError(path, "a token beyond the end", f"byte {base + token}", f"{size} bytes out of {end}")
    if len(out) != size:
        raise CloudError(path, f"{len(out)} bytes uncompressed", f"byte {base}", f"{size}")
    return bytes(out)
