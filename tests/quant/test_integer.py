"""The integer reference against the contract's text, window by window in Python's own integers; the proof; the file."""

from __future__ import annotations

import struct
import zlib
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from upbeam.model.beams import beam_table
from upbeam.model.network import FoldedNetwork
from upbeam.model.rules import Rules, extract_windows
from upbeam.quant.integer import (
    IntegerModel,
    IntegerNetwork,
    OverflowProofError,
    block_code,
    largest_inputs,
    network,
    prove,
    round_shift,
    sum_bounds,
    upsample_integer,
)
from upbeam.quant.ubm import ModelFile, UbmError, read_ubm

PRECISIONS = ("int16", "int8")


def by_the_text(n: IntegerNetwork, precision: str, x: list[int]) -> tuple[int, int]:
    """Steps 1 to 9 of docs/numeric-contract.md as they are written there. Returns Y and y."""

    def rounded(a: int, bits: int) -> int:
        return (a + (1 << (bits - 1))) >> bits if bits else a

    m = min(x)
    d = [v - m for v in x]
    s, q = 0, d
    if precision == "int8":
        s = max(0, max(d).bit_length() - 8)
        q = [min(255, rounded(v, s)) for v in d]
    Y = n.offset
    for h in range(n.hidden):
        S = (sum(int(w) * v for w, v in zip(n.weight[h], q, strict=True)) << (s + n.k)) + (
            (int(n.minimum[h]) * m) << n.j
        )
        S += int(n.bias[h])
        a = rounded(S, 16)
        Y += int(n.output[h]) * max(a, rounded(a * n.slope, 15))
    return Y, rounded(Y, n.t) + n.skip * m


def random_network(rng: np.random.Generator, precision: str, **fixed: int) -> IntegerNetwork:
    """Any parameters that the contract's types hold; the sums are made to pass the proof for inputs up to 40,000."""
    hidden = fixed.pop("hidden", int(rng.integers(1, 33)))
    widest = 127 if precision == "int8" else 32767
    k = int(rng.integers(0, 6)) if precision == "int8" else 0
    weight = rng.integers(-widest, widest + 1, (hidden, 6))
    share = 0.45 * 2**31 / (np.abs(weight).sum(axis=1) * (40_000 << k))
    weight = (weight * np.minimum(1, share)[:, None]).astype(np.int64)
    output = rng.integers(-widest, widest + 1, hidden)
    output = (output * min(1.0, 0.8 * 2**30 / (np.abs(output).sum() * 32768))).astype(np.int64)
    values = {
        "weight": weight,
        "minimum": rng.integers(-20_000, 20_001, hidden),
        "bias": rng.integers(-(2**27), 2**27, hidden),
        "output": output,
        "offset": int(rng.integers(-(2**25), 2**25)),
        "slope": int(rng.choice([0, 1, 256, 328, 32767])),
        "skip": int(rng.integers(0, 2)),
        "k": k,
        "j": 0,
        "t": int(rng.integers(0, 25)),
    }
    return IntegerNetwork(**(values | fixed))


@pytest.fixture
def rules() -> Rules:
    return Rules.for_beams(beam_table("hdl-64e").aligned(), columns=64)


@pytest.mark.parametrize("precision", PRECISIONS)
def test_reference_is_the_text(precision, rng):
    extremes = [
        [0] * 6,
        [40_000] * 6,
        [0, 40_000] * 3,
        [0, 0, 0, 0, 0, 40_000],
        [255, 0, 0, 0, 0, 0],
        [256, 0, 511, 0, 512, 0],
    ]
    for _ in range(60):
        n = random_network(rng, precision)
        prove(n, precision, 40_000, 40_000, "test")
        spread = rng.choice([1, 16, 200, 300, 5000, 40_001])
        windows = [*extremes, *(rng.integers(0, spread, (20, 6)) + rng.integers(0, 40_002 - spread, (20, 1))).tolist()]
        trace = network(n, precision, windows)
        assert [by_the_text(n, precision, x) for x in windows] == list(
            zip(trace.Y.tolist(), trace.y.tolist(), strict=True)
        )


@given(st.integers(-(2**40), 2**40), st.integers(0, 24))
def test_rounding_is_half_up(value, bits):
    assert int(round_shift(value, bits)) == (2 * value + (1 << bits)) // (2 << bits)


def test_block_code_is_exact_below_256_and_within_half_a_step_above():
    d = np.arange(65_536)[:, None] * np.array([0, 0, 0, 0, 0, 1])
    s, q = block_code(d)
    assert np.all(q <= 255)
    assert np.array_equal((q << s[:, None])[:256], d[:256])
    error = np.abs((q << s[:, None]) - d).max(axis=1)
    half = np.where(s > 0, 1 << np.maximum(s - 1, 0), 0)
    cut = round_shift(d[:, 5], s) == 256
    assert np.all(error[~cut] <= half[~cut])
    assert np.all(error[cut] <= (1 << s)[cut])
    assert np.all(s == [max(0, int(v).bit_length() - 8) for v in d[:, 5]])


@pytest.mark.parametrize("precision", PRECISIONS)
def test_no_input_leaves_the_proven_bounds_and_some_reach_them(precision, rng):
    for _ in range(30):
        n = random_network(rng, precision)
        bounds = sum_bounds(n, precision, 40_000, 40_000)
        windows = rng.choice([0, 1, 20_000, 39_999, 40_000], (400, 6))
        trace = network(n, precision, windows)
        assert np.all(bounds.S_low <= trace.S)
        assert np.all(bounds.S_high >= trace.S)
        assert trace.Y.min() >= bounds.Y_low
        assert trace.Y.max() <= bounds.Y_high
    # One unit without the minimum's path: the bound of its sum is reached by the window that its weights ask for.
    n = random_network(rng, "int16", hidden=1, minimum=np.zeros(1, dtype=np.int64))
    most = np.where(n.weight[0] > 0, 40_000, 0)
    if most.all():
        most[0] = 0
    reached = network(n, "int16", [most]).S[0, 0]
    assert reached <= sum_bounds(n, "int16", 40_000, 40_000).S_high[0]
    if not np.all(n.weight[0] > 0):
        assert reached == sum_bounds(n, "int16", 40_000, 40_000).S_high[0]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"weight": np.full((1, 6), 32767)}, r"test: the sum S of hidden unit 0 can reach 0 to \d+, beyond 32 bits"),
        ({"bias": np.array([2**31 - 1])}, "the sum S of hidden unit 0"),
        ({"weight": np.full((1, 6), 40_000)}, "W is 40000 to 40000, beyond 16 bits"),
        ({"offset": 2**30}, r"the output Y can reach .*beyond 31 bits"),
        ({"t": 25}, "t is 25, expected 0 to 24"),
        ({"j": 1}, "j is 1: an input of 40000 then needs more than 16 bits"),
        ({"k": 1}, "k is 1: an input of 40000"),
        ({"slope": 32768}, "slope is 32768"),
        ({"minimum": np.array([-40_000])}, "M is -40000 to -40000, beyond 16 bits"),
        ({"offset": 2**31}, "C does not fit"),
    ],
)
def test_what_could_overflow_is_refused(change, said):
    fine = IntegerNetwork(np.full((1, 6), 100), np.zeros(1), np.zeros(1), np.ones(1), 0, 0, 1, 0, 0, 0)
    prove(fine, "int16", 40_000, 40_000, "test")
    with pytest.raises(OverflowProofError, match=said):
        prove(replace(fine, **change), "int16", 40_000, 40_000, "test")


def test_a_network_that_would_wrap_is_noticed_by_the_reference():
    wild = IntegerNetwork(np.full((1, 6), 32767), np.zeros(1), np.zeros(1), np.ones(1), 0, 0, 1, 0, 0, 0)
    with pytest.raises(OverflowProofError, match="S is"):
        network(wild, "int16", [[0, 40_000, 40_000, 40_000, 40_000, 40_000]])


@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("empty", ["none", "fill"])
def test_image_keeps_the_rules(precision, empty, rng, rules):
    rules = replace(rules, empty=empty)
    model = IntegerModel(precision, random_network(rng, precision), random_network(rng, precision, j=0, k=0))
    d = np.where(rng.random((32, 64)) < 0.3, 0, rng.integers(0, 65_536, (32, 64))).astype(np.uint16)
    i = rng.integers(0, 256, (32, 64), dtype=np.uint8)
    out, grey = upsample_integer(d, i, model, rules)
    assert np.array_equal(out[0::2], d)
    assert np.array_equal(grey[0::2], i)
    assert not out[63].any()
    windows = extract_windows(d, i, rules)
    for row, column in ((0, 0), (7, 13), (30, 63)):
        y = by_the_text(model.distance, precision, windows.distance[row, column].astype(int).tolist())[1]
        shade = by_the_text(model.intensity, precision, windows.intensity[row, column].astype(int).tolist())[1]
        seen = bool(windows.any_return[row, column]) or empty == "none"
        kept = seen and rules.min_count <= y <= rules.row_max_count[2 * row + 1]
        assert out[2 * row + 1, column] == (y if kept else 0)
        assert grey[2 * row + 1, column] == (min(255, max(0, shade)) if kept else 0)


# ------------------------------------------------------------------------------------------------------ the file


@pytest.fixture
def file(rng, rules):
    floats = FoldedNetwork(rng.normal(size=(3, 7)), rng.normal(size=3), rng.normal(size=3), 0.5, 1.0, 0.01)
    made = {
        p: IntegerModel(p, random_network(rng, p, hidden=5), random_network(rng, p, hidden=12, j=0)) for p in PRECISIONS
    }
    return ModelFile(rules, (floats, floats), int16=made["int16"], int8=made["int8"], signature=b"signed")


def test_file_round_trip(file):
    again = read_ubm(file.to_bytes())
    assert again.to_bytes() == file.to_bytes()
    assert again.precisions == ["fp32", "int16", "int8"]
    assert again.signature == b"signed"
    for precision in PRECISIONS:
        for mine, theirs in zip(file.integer(precision), again.integer(precision), strict=True):
            for name in ("weight", "minimum", "bias", "output", "offset", "slope", "skip", "k", "j", "t"):
                assert np.array_equal(getattr(mine, name), getattr(theirs, name)), name


def test_every_damaged_byte_of_an_integer_section_is_noticed_or_means_other_numbers(file, rng):
    """Resealed, so that the checksum does not help: a damaged section is refused, or proven safe."""
    data = bytearray(file.to_bytes())
    start = data.index(b"upbeam.int8.v1")
    for at in rng.integers(start, len(data) - 20, 150):
        damaged = bytearray(data)
        damaged[at] ^= 1 << int(rng.integers(8))
        damaged[-4:] = struct.pack("<I", zlib.crc32(bytes(damaged[:-4])))
        try:
            model = read_ubm(bytes(damaged))
        except UbmError:
            continue
        if model.int8 is not None:
            for name, n in zip(("distance", "intensity"), model.int8, strict=True):
                prove(n, "int8", *largest_inputs(model.rules, name), name)


def test_another_contract_is_refused_by_name(file):
    data = file.to_bytes().replace(b"upbeam.int8.v1", b"upbeam.int8.v2")
    data = data[:-4] + struct.pack("<I", zlib.crc32(data[:-4]))
    with pytest.raises(UbmError, match=r"section Q8: contract .*upbeam.int8.v2.*knows 'upbeam.int8.v1'"):
        read_ubm(data)


def test_a_model_that_could_overflow_is_not_written(file):
    wild = replace(file.int16.distance, weight=np.full((5, 6), 32767))
    with pytest.raises(OverflowProofError, match="int16 distance network: the sum S of hidden unit 0"):
        replace(file, int16=IntegerModel("int16", wild, file.int16.intensity)).to_bytes()
