"""The model file: round trip, damage, impossible values; Python's reader and the C runtime's on the same bytes."""

from __future__ import annotations

import struct
import zlib

import numpy as np
import pytest

from upbeam.model.beams import beam_table
from upbeam.model.network import WindowNetwork
from upbeam.model.rules import Rules
from upbeam.quant import ModelFile, UbmError, read_ubm, write_ubm
from upbeam.runtime._native import Model as NativeModel


def network(rng, widths=(8, 2, 12), **graph):
    c1, c2, h = widths
    return WindowNetwork(
        rng.normal(size=c1), rng.normal(size=c1), rng.normal(size=(c2, c1)), rng.normal(size=c2),
        rng.normal(size=(h, 6 * c2 + 1)), rng.normal(size=h), rng.normal(size=h), float(rng.normal()), **graph,
    )  # fmt: skip


@pytest.fixture
def model(rng):
    rules = Rules.for_beams(beam_table("vlp-32c"), edge="zero", last_row="repeat")
    dense = network(rng, inputs="difference", output="residual", scale=0.05, slope=1 / 128), network(rng, (4, 3, 7))
    return ModelFile.from_dense(rules, dense, provenance={"recipe": "tëst"}, metrics={"mae_m": 0.5})


def resealed(data: bytes) -> bytes:
    return data[:-4] + struct.pack("<I", zlib.crc32(data[:-4]))


def both_refuse(data: bytes, python: str, native: str) -> None:
    with pytest.raises(UbmError, match=python):
        read_ubm(data)
    with pytest.raises(ValueError, match=native):
        NativeModel(data)


def test_round_trip_and_agreement_with_the_c_reader(model, tmp_path):
    data = write_ubm(tmp_path / "m.ubm", model)
    again = read_ubm(tmp_path / "m.ubm")
    assert again.to_bytes() == data
    assert again.provenance == {"recipe": "tëst"}
    info = NativeModel(data).info()
    rules = model.rules
    assert info["sensor"] == rules.sensor == "vlp-32c"
    assert (info["columns"], info["min_count"], info["max_count"]) == (904, rules.min_count, rules.max_count)
    assert (info["edge"], info["last_row"], info["empty_rule"]) == (0, 0, 1)
    assert info["hidden"] == (12, 7)
    assert info["crc32"] == struct.unpack("<I", data[-4:])[0]
    assert np.array(info["row_elevation_udeg"]) / 1e6 == pytest.approx(rules.row_elevation_deg)
    assert np.array(info["azimuth_offset_udeg"]) / 1e6 == pytest.approx(rules.azimuth_offset_deg)


def test_the_stored_fold_is_the_dense_network(model, rng):
    again = read_ubm(model.to_bytes())
    windows = rng.uniform(0, 80, (100, 6))
    for dense, folded in zip(model.dense, again.folded, strict=True):
        assert np.max(np.abs(dense(windows) - folded(windows)) / folded.magnitude(windows)) < 1e-6


def test_every_truncation_is_refused_by_both(model):
    data = model.to_bytes()
    for length in range(0, len(data), 7):
        both_refuse(data[:length], "truncated|not a", "end|magic|model|bytes")
    both_refuse(data + b"\0", "truncated or extended", "long|end")


def test_every_flipped_bit_is_refused_by_both(model):
    data = model.to_bytes()
    for bit in range(8 * len(data)):
        broken = bytearray(data)
        broken[bit // 8] ^= 1 << bit % 8
        for reader in (read_ubm, NativeModel):
            with pytest.raises(ValueError):  # noqa: PT011 - which of the checks finds it first is not the point
                reader(bytes(broken))


def test_bytes_changed_with_a_true_checksum_never_crash_and_both_readers_agree(model, rng):
    """In the sections that both read, what one refuses the other refuses: nothing loads in one place only."""
    plain = ModelFile(model.rules, model.folded)
    data = plain.to_bytes()
    differ = []
    for _ in range(4000):
        broken = bytearray(data)
        for position in rng.integers(0, len(data) - 4, rng.integers(1, 4)):
            broken[position] = int(rng.choice([0, 1, 0x7F, 0x80, 0xFF, int(rng.integers(256))]))
        sealed = resealed(bytes(broken))
        verdicts = []
        for reader in (read_ubm, NativeModel):
            try:
                reader(sealed)
                verdicts.append(True)
            except ValueError:
                verdicts.append(False)
        if verdicts[0] != verdicts[1]:
            differ.append((verdicts, bytes(broken)))
    assert not differ, f"{len(differ)} of 4000 files load in one reader only, e.g. {differ[0]}"


def section(data: bytes, tag: bytes) -> tuple[int, int]:
    at = data.index(tag, 32)
    return at, struct.unpack_from("<I", data, at + 8)[0]


def test_unknown_sections(model):
    data = bytearray(model.to_bytes())
    entry, _ = section(bytes(data), b"METR")
    data[entry : entry + 4] = b"XTRA"
    assert read_ubm(resealed(bytes(data))).metrics == {}
    NativeModel(resealed(bytes(data)))
    struct.pack_into("<I", data, entry + 4, 1)
    both_refuse(resealed(bytes(data)), "XTRA", "XTRA")


@pytest.mark.parametrize(
    ("offset", "value", "python", "native"),
    [
        (32, "<I:16", "beams", "beams"),
        (36, "<I:3", "columns", "columns"),
        (40, "<I:99", "distance unit", "distance_unit"),
        (44, "<I:360000", "cut", "cut"),
        (48, "<I:0", "range limits", "min_count"),
        (52, "<I:65536", "range limits", "max_count"),
        (56, "<B:2", "rule", "edge"),
        (64, "<i:-25000000", "fall strictly", "elevation"),
        (320, "<i:45000001", "azimuth_offset", "azimuth_offset"),
        (448, "<i:10000001", "row_height", "row_height"),
        (704, "<H:749", "row_max_count", "row_max_count"),
        (830, "<H:65535", "row_max_count", "row_max_count"),
    ],
)
def test_impossible_values_of_the_sensor_are_named(model, offset, value, python, native):
    data = bytearray(model.to_bytes())
    kind, number = value.split(":")
    struct.pack_into(kind, data, section(bytes(data), b"SENS")[1] + offset, int(number))
    both_refuse(resealed(bytes(data)), python, native)


def test_other_files(tmp_path):
    both_refuse(b"PNG" * 100, "not a .ubm", "not a|magic")
    with pytest.raises(UbmError, match=r"absent\.ubm"):
        read_ubm(tmp_path / "absent.ubm")
    big = tmp_path / "big.ubm"
    big.write_bytes(b"UPBM" + bytes(1 << 20))
    with pytest.raises(UbmError, match="at most"):
        read_ubm(big)


def test_another_version_is_refused_by_number(model):
    data = bytearray(model.to_bytes())
    struct.pack_into("<H", data, 4, 9)
    both_refuse(resealed(bytes(data)), "version 9", "version")


def test_what_the_format_cannot_hold_is_refused_on_writing(rng):
    rules = Rules.for_beams(beam_table("hdl-32e"))
    huge = network(rng, (8, 2, 33))
    with pytest.raises(UbmError, match="33 hidden"):
        ModelFile.from_dense(rules, (huge, network(rng))).to_bytes()
    infinite = network(rng)
    object.__setattr__(infinite, "linear_2_bias", 1e7)
    with pytest.raises(UbmError, match="beyond"):
        ModelFile.from_dense(rules, (infinite, network(rng))).to_bytes()
