"""The ``.ubm`` model file: writer and reader. The format is ``docs/model-format.md``; the C runtime reads it on its
own.

A ``ModelFile`` is the parsed content; ``write`` and ``read`` are each other's inverse, byte for byte.
"""

from __future__ import annotations

import json
import struct
import zlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from upbeam.model.network import FoldedNetwork, WindowNetwork
from upbeam.model.rules import BEAMS, ROWS, Rules, RulesError

from .cursor import MAX_WEIGHT, Cursor, UbmError
from .integer import IntegerModel
from .ubm_integer import INTEGER_TAGS, pack_integer, parse_integer

__all__ = ["MAX_FILE_BYTES", "ModelFile", "UbmError", "read_ubm", "write_ubm"]

MAGIC = b"UPBM"
VERSION = 1
HEADER_BYTES = 32
MAX_FILE_BYTES = 1 << 20
MAX_SECTIONS = 32
MAX_HIDDEN = 32
MAX_WIDTH = 64
MAX_SIGNATURE_BYTES = 4096
REQUIRED = 1

_EDGES = ("zero", "seam")
_LAST_ROWS = ("repeat", "empty")
_EMPTY = ("none", "fill")
_INPUTS = ("raw", "difference")
_OUTPUTS = ("raw", "residual")
_SENS_BYTES = 64 + 4 * ROWS + 4 * BEAMS + 4 * ROWS + 2 * ROWS


@dataclass(frozen=True)
class ModelFile:
    """Content of a model file. ``folded`` and ``dense`` hold the distance network, then the intensity network."""

    rules: Rules
    folded: tuple[FoldedNetwork, FoldedNetwork]
    dense: tuple[WindowNetwork, WindowNetwork] | None = None
    provenance: dict[str, Any] = field(default_factory=dict)
    metrics: dict[str, Any] = field(default_factory=dict)
    int16: IntegerModel | None = None
    int8: IntegerModel | None = None
    signature: bytes | None = None
    """Content of the reserved section ``SIGN``."""

    @property
    def precisions(self) -> list[str]:
        """What the file can be run with."""
        return ["fp32", *(name for name in INTEGER_TAGS if self.integer(name) is not None)]

    def integer(self, precision: str) -> IntegerModel | None:
        return {"int16": self.int16, "int8": self.int8}[precision]

    @classmethod
    def from_dense(cls, rules: Rules, dense: tuple[WindowNetwork, WindowNetwork], **extra: Any) -> ModelFile:
        """Folds the networks; weights are rounded to float32, as they are stored."""
        folded = tuple(_as_stored(network.fold()) for network in dense)
        return cls(rules=rules, folded=(folded[0], folded[1]), dense=dense, **extra)

    def to_bytes(self) -> bytes:
        """The file. Raises UbmError for what the format cannot hold."""
        sections = [(b"SENS", REQUIRED, _pack_sens(self.rules)), (b"NETW", REQUIRED, _pack_netw(self.folded))]
        if self.dense is not None:
            sections.append((b"DENS", 0, _pack_dens(self.dense)))
        for name, letters in INTEGER_TAGS.items():
            model = self.integer(name)
            if model is not None:
                sections.append((letters.encode(), 0, pack_integer(model, self.rules)))
        for tag, content in ((b"PROV", self.provenance), (b"METR", self.metrics)):
            if content:
                sections.append((tag, 0, json.dumps(content, sort_keys=True, ensure_ascii=False).encode()))
        if self.signature is not None:
            sections.append((b"SIGN", 0, self.signature))
        return _pack_file(sections)


def write_ubm(path: str | Path, model: ModelFile) -> bytes:
    """Writes the file; returns its bytes."""
    data = model.to_bytes()
    Path(path).write_bytes(data)
    return data


def read_ubm(source: str | Path | bytes) -> ModelFile:
    """A model from a path or from bytes. Raises UbmError for anything that is not a sound file."""
    if isinstance(source, bytes):
        return _parse(source)
    try:
        if Path(source).stat().st_size > MAX_FILE_BYTES:
            raise UbmError(f"{source}: {Path(source).stat().st_size} bytes, a model file has at most {MAX_FILE_BYTES}")
        data = Path(source).read_bytes()
    except OSError as error:
        raise UbmError(f"{source}: {error.strerror}") from None
    try:
        return _parse(data)
    except UbmError as error:
        raise UbmError(f"{source}: {error}") from None


def _as_stored(network: FoldedNetwork) -> FoldedNetwork:
    def f32(x: Any) -> Any:
        return np.asarray(x, dtype=np.float32).astype(np.float64)

    return FoldedNetwork(
        weight=f32(network.weight),
        bias=f32(network.bias),
        output_weight=f32(network.output_weight),
        output_bias=float(f32(network.output_bias)),
        skip=float(f32(network.skip)),
        slope=float(f32(network.slope)),
        positive=network.positive,
    )


# ---------------------------------------------------------------------------------------------------- writing


def _pack_file(sections: list[tuple[bytes, int, bytes]]) -> bytes:
    offset = HEADER_BYTES + 16 * len(sections)
    table, body = b"", b""
    for tag, flags, content in sections:
        padding = -(offset + len(body)) % 8
        body += b"\0" * padding
        table += struct.pack("<4s3I", tag, flags, offset + len(body), len(content))
        body += content
    total = offset + len(body) + 4
    if total > MAX_FILE_BYTES:
        raise UbmError(f"the model would have {total} bytes, at most {MAX_FILE_BYTES} are allowed")
    head = struct.pack("<4sHHII16x", MAGIC, VERSION, HEADER_BYTES, total, len(sections))
    data = head + table + body
    return data + struct.pack("<I", zlib.crc32(data))


def _pack_sens(rules: Rules) -> bytes:
    name = rules.sensor.encode("ascii", errors="replace")
    if len(name) > 31:
        raise UbmError(f"sensor name {rules.sensor!r} has {len(name)} characters, at most 31 are stored")
    head = struct.pack(
        "<32s6I3B5x",
        name,
        BEAMS,
        rules.columns,
        round(rules.distance_unit_m * 1e6),
        round(rules.cut_deg * 1000),
        rules.min_count,
        rules.max_count,
        _EDGES.index(rules.edge),
        _LAST_ROWS.index(rules.last_row),
        _EMPTY.index(rules.empty),
    )
    millionths = np.concatenate([rules.row_elevation_deg, rules.azimuth_offset_deg, rules.row_height_m])
    limits = rules.row_max_count.astype("<u2").tobytes()
    return head + np.round(millionths * 1e6).astype("<i4").tobytes() + limits


def _pack_netw(networks: tuple[FoldedNetwork, FoldedNetwork]) -> bytes:
    out = struct.pack("<I", len(networks))
    for network in networks:
        if not 1 <= network.hidden <= MAX_HIDDEN:
            raise UbmError(f"{network.hidden} hidden units, expected 1 to {MAX_HIDDEN}")
        if network.skip not in (0.0, 1.0):
            raise UbmError(f"skip {network.skip}, expected 0 or 1: the minimum is added as a whole number of counts")
        out += struct.pack("<IIff", network.hidden, int(network.positive), network.slope, network.skip)
        out += _floats(network.weight, network.bias, network.output_weight, [network.output_bias])
    return out


def _pack_dens(networks: tuple[WindowNetwork, WindowNetwork]) -> bytes:
    out = struct.pack("<I", len(networks))
    for n in networks:
        if max(n.widths) > MAX_WIDTH:
            raise UbmError(f"layer widths {n.widths}, at most {MAX_WIDTH} each are stored")
        out += struct.pack("<5I2f", *n.widths, _INPUTS.index(n.inputs), _OUTPUTS.index(n.output), n.scale, n.slope)
        out += _floats(n.conv1_weight, n.conv1_bias, n.conv2_weight, n.conv2_bias)
        out += _floats(n.linear_1_weight, n.linear_1_bias, n.linear_2_weight, [n.linear_2_bias])
    return out


def _floats(*arrays: Any) -> bytes:
    flat = np.concatenate([np.ravel(np.asarray(array, dtype=np.float64)) for array in arrays])
    if not np.all(np.isfinite(flat)) or np.any(np.abs(flat) > MAX_WEIGHT):
        raise UbmError(f"a weight is not finite, or beyond +-{MAX_WEIGHT:g}")
    return flat.astype("<f4").tobytes()


# ---------------------------------------------------------------------------------------------------- reading


def _parse(data: bytes) -> ModelFile:
    sections = _sections(data)
    for tag in ("SENS", "NETW"):
        if tag not in sections:
            raise UbmError(f"required section {tag} is missing")
    try:
        rules = _parse_sens(sections["SENS"])
    except RulesError as error:
        raise UbmError(f"section SENS: {error}") from None
    return ModelFile(
        rules=rules,
        folded=_parse_netw(Cursor("NETW", sections["NETW"])),
        dense=_parse_dens(Cursor("DENS", sections["DENS"])) if "DENS" in sections else None,
        provenance=_parse_json(sections, "PROV"),
        metrics=_parse_json(sections, "METR"),
        int16=parse_integer("int16", sections, rules),
        int8=parse_integer("int8", sections, rules),
        signature=_parse_signature(sections),
    )


def _sections(data: bytes) -> dict[str, bytes]:
    if len(data) < HEADER_BYTES + 4:
        raise UbmError(
            f"{len(data)} bytes, a model file has at least {HEADER_BYTES + 4}: truncated, or not a .ubm file"
        )
    magic, version, header, total, count = struct.unpack_from("<4sHHII", data)
    if magic != MAGIC:
        raise UbmError(f"begins with {magic!r}, expected {MAGIC!r}: not a .ubm model file")
    if version not in (0, 1):
        raise UbmError(f"format version {version}, this program reads version {VERSION}")
    if header != HEADER_BYTES or total != len(data):
        raise UbmError(f"the header speaks of {total} bytes, the file has {len(data)}: truncated or extended")
    stored = struct.unpack_from("<I", data, total - 4)[0]
    if zlib.crc32(data[:-4]) != stored:
        raise UbmError(f"checksum {zlib.crc32(data[:-4]):08x}, expected {stored:08x}: the file is damaged")
    if any(data[16:HEADER_BYTES]):
        raise UbmError("reserved bytes of the header are not 0")
    if not 1 <= count <= MAX_SECTIONS or HEADER_BYTES + 16 * count + 4 > total:
        raise UbmError(f"{count} sections, expected 1 to {MAX_SECTIONS}")
    out: dict[str, bytes] = {}
    free = HEADER_BYTES + 16 * count
    for k in range(count):
        raw_tag, flags, offset, size = struct.unpack_from("<4s3I", data, HEADER_BYTES + 16 * k)
        tag = raw_tag.decode("ascii", errors="replace")
        if not (tag.isascii() and tag.isprintable()) or flags & ~REQUIRED:
            raise UbmError(
                f"entry {k} of the section table: tag {raw_tag!r}, flags {flags:#x}; expected 4 letters, 0 or 1"
            )
        if offset % 8 or offset < free or offset + size > total - 4:
            raise UbmError(f"section {tag} at {offset} with {size} bytes lies outside the file, or overlaps")
        if tag in out:
            raise UbmError(f"section {tag} stands twice")
        if tag not in _KNOWN and flags & REQUIRED:
            raise UbmError(f"section {tag} is required and this program does not know it: a newer model file?")
        _need_zeros(data, free, offset)
        out[tag] = data[offset : offset + size]
        free = offset + size
    _need_zeros(data, free, total - 4)
    return out


def _need_zeros(data: bytes, start: int, end: int) -> None:
    if any(data[start:end]):
        raise UbmError(f"bytes {start} to {end} lie between sections and are not 0")


_KNOWN = {"SENS", "NETW", "DENS", "PROV", "METR", "SIGN", *INTEGER_TAGS.values()}


def _parse_signature(sections: dict[str, bytes]) -> bytes | None:
    signature = sections.get("SIGN")
    if signature is None:
        return None
    if len(signature) > MAX_SIGNATURE_BYTES:
        raise UbmError(f"section SIGN has {len(signature)} bytes, at most {MAX_SIGNATURE_BYTES}")
    if list(sections)[-1] != "SIGN":
        raise UbmError("section SIGN must be the last one")
    return signature


def _parse_sens(data: bytes) -> Rules:
    if len(data) != _SENS_BYTES:
        raise UbmError(f"section SENS has {len(data)} bytes, expected {_SENS_BYTES}")
    name, beams, columns, unit_um, cut, low, high = struct.unpack_from("<32s6I", data)
    edge, last_row, empty = data[56:59]
    if beams != BEAMS:
        raise UbmError(f"section SENS: {beams} beams, expected {BEAMS}")
    if not 100 <= unit_um <= 100_000:
        raise UbmError(f"section SENS: distance unit {unit_um} um, expected 100 to 100000")
    if cut >= 360_000:
        raise UbmError(f"section SENS: cut {cut} thousandths of a degree, expected 0 to 359999")
    if any(data[59:64]):
        raise UbmError("section SENS: reserved bytes are not 0")
    if edge > 1 or last_row > 1 or empty > 1:
        raise UbmError(f"section SENS: unknown rule (edge {edge}, last row {last_row}, empty {empty}), expected 0 or 1")
    millionths = np.frombuffer(data, dtype="<i4", offset=64, count=ROWS + BEAMS + ROWS).astype(np.float64) / 1e6
    for key, values, limit in (
        ("row elevation", millionths[:ROWS], 90),
        ("azimuth_offset", millionths[ROWS : ROWS + BEAMS], 45),
        ("row_height", millionths[ROWS + BEAMS :], 10),
    ):
        if np.any(np.abs(values) > limit):
            raise UbmError(f"section SENS: {key} beyond +-{limit}")
    return Rules(
        sensor=_name(name),
        columns=columns,
        distance_unit_m=unit_um / 1e6,
        row_elevation_deg=millionths[:ROWS],
        azimuth_offset_deg=millionths[ROWS : ROWS + BEAMS],
        row_height_m=millionths[ROWS + BEAMS :],
        row_max_count=np.frombuffer(data, dtype="<u2", offset=_SENS_BYTES - 2 * ROWS).astype(np.int64),
        min_count=low,
        max_count=high,
        cut_deg=cut / 1000.0,
        edge=_EDGES[edge],  # type: ignore[arg-type]
        last_row=_LAST_ROWS[last_row],  # type: ignore[arg-type]
        empty=_EMPTY[empty],  # type: ignore[arg-type]
    )


def _name(padded: bytes) -> str:
    name = padded.rstrip(b"\0").decode("ascii", errors="replace")
    if len(name) > 31 or not (name.isascii() and (name.isprintable() or not name)):
        raise UbmError(f"section SENS: sensor name {padded!r}, expected at most 31 printable letters")
    return name


def _parse_netw(cursor: Cursor) -> tuple[FoldedNetwork, FoldedNetwork]:
    cursor.u32("number of networks", 2, 2)
    networks = []
    for _ in range(2):
        hidden = cursor.u32("hidden units", 1, MAX_HIDDEN)
        positive = cursor.u32("flags", 0, 1)
        slope = float(cursor.floats("slope", 1, limit=1.0)[0])
        if slope < 0:
            raise UbmError(f"section NETW: slope is {slope}, expected 0 to 1")
        skip = float(cursor.floats("skip", 1)[0])
        if skip not in (0.0, 1.0):
            raise UbmError(f"section NETW: skip is {skip}, expected 0 or 1")
        networks.append(
            FoldedNetwork(
                weight=cursor.floats("A", hidden, 7),
                bias=cursor.floats("b", hidden),
                output_weight=cursor.floats("v", hidden),
                output_bias=float(cursor.floats("c", 1)[0]),
                skip=skip,
                slope=slope,
                positive=bool(positive),
            )
        )
    cursor.end()
    return networks[0], networks[1]


def _parse_dens(cursor: Cursor) -> tuple[WindowNetwork, WindowNetwork]:
    cursor.u32("number of networks", 2, 2)
    networks = []
    for _ in range(2):
        c1, c2, hidden = (cursor.u32(f"{name} width", 1, MAX_WIDTH) for name in ("conv1", "conv2", "hidden"))
        inputs, output = cursor.u32("input", 0, 1), cursor.u32("output", 0, 1)
        scale, slope = cursor.floats("scale and slope", 2)
        if not (scale > 0 and 0 <= slope <= 1):
            raise UbmError(
                f"section DENS: scale {scale:g}, slope {slope:g}; expected a positive scale, a slope of 0 to 1"
            )
        networks.append(
            WindowNetwork(
                conv1_weight=cursor.floats("conv1 weight", c1),
                conv1_bias=cursor.floats("conv1 bias", c1),
                conv2_weight=cursor.floats("conv2 weight", c2, c1),
                conv2_bias=cursor.floats("conv2 bias", c2),
                linear_1_weight=cursor.floats("linear_1 weight", hidden, 6 * c2 + 1),
                linear_1_bias=cursor.floats("linear_1 bias", hidden),
                linear_2_weight=cursor.floats("linear_2 weight", hidden),
                linear_2_bias=float(cursor.floats("linear_2 bias", 1)[0]),
                slope=float(slope),
                inputs=_INPUTS[inputs],  # type: ignore[arg-type]
                output=_OUTPUTS[output],  # type: ignore[arg-type]
                scale=float(scale),
            )
        )
    cursor.end()
    return networks[0], networks[1]


def _parse_json(sections: dict[str, bytes], tag: str) -> dict[str, Any]:
    if tag not in sections:
        return {}
    try:
        content = json.loads(sections[tag].decode("utf-8"))
    except (UnicodeDecodeError, ValueError, RecursionError):
        raise UbmError(f"section {tag} is not UTF-8 JSON") from None
    if not isinstance(content, dict):
        raise UbmError(f"section {tag} holds a JSON {type(content).__name__}, expected an object")
    return content
