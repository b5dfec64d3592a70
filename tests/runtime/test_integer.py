"""The integer precisions of the C runtime: to the bit what ``upbeam.quant.integer`` says, by every path and kernel."""

from __future__ import annotations

import struct
import zlib
from dataclasses import replace

import numpy as np
import pytest

import upbeam
from upbeam.model.beams import beam_table
from upbeam.model.geometry import to_metres
from upbeam.model.network import FoldedNetwork
from upbeam.model.rules import Rules
from upbeam.quant import ModelFile
from upbeam.quant.integer import IntegerModel, IntegerNetwork, network, upsample_integer
from upbeam.quant.sizes import weight_bytes
from upbeam.quant.ubm import UbmError, read_ubm
from upbeam.runtime._native import CPUS, NativeError, trace_int, windows_int
from upbeam.runtime._native import Model as NativeModel
from upbeam.runtime.live import LiveConfig, LiveConfigError, firing_columns, run_live

PRECISIONS = ("int16", "int8")


def machine_has(cpu):
    """Whether this machine and build have it: asked of float, which every model has."""
    try:
        upbeam.Upsampler(upbeam.load_model(), cpu=cpu)
    except ValueError as error:
        assert "instruction set" in str(error)  # noqa: PT017
        return False
    return True


USABLE = [cpu for cpu in CPUS[1:] if machine_has(cpu)]


def random_network(rng, precision, largest):
    """Passes the proof: each of a sum's eight terms has an eighth of 32 bits, the output half of 31."""
    hidden = int(rng.integers(1, 33))
    top = 127 if precision == "int8" else 32767
    room = 16 - largest.bit_length()
    j = int(rng.integers(0, min(room, 16) + 1))
    k = int(rng.integers(0, 9 if precision == "int8" else min(room, 16) + 1))

    def within(limit, *shape):
        return rng.integers(-int(limit), int(limit) + 1, shape)

    return IntegerNetwork(
        weight=within(min(top, 0.9 * 2**28 / (largest << k)), hidden, 6),
        minimum=within(min(32767, 2**28 / (largest << j)), hidden),
        bias=within(2**28, hidden),
        output=within(min(top, 2**13 / hidden), hidden),
        offset=int(within(2**27)),
        slope=int(rng.integers(0, 32768)) if rng.random() < 0.7 else 0,
        skip=int(rng.random() < 0.8) if largest > 255 else int(rng.random() < 0.5),
        k=k,
        j=j,
        t=int(rng.integers(11, 17) if largest > 255 else rng.integers(17, 21)),
    )


def any_float_network():
    weight = np.zeros((1, 7))
    return FoldedNetwork(weight, np.zeros(1), np.zeros(1), 0.0, 1.0, 0.0, False)


def make_model(rng, *, table="hdl-64e", aligned=True, columns=64, precisions=PRECISIONS, **rules):
    beams = beam_table(table)
    made = Rules.for_beams(beams.aligned() if aligned else beams, columns=columns, **rules)
    integers = {
        name: IntegerModel(name, random_network(rng, name, made.max_count), random_network(rng, name, 255))
        for name in precisions
    }
    file = ModelFile(made, (any_float_network(), any_float_network()), **integers)
    return upbeam.Model(file.to_bytes(), "test.ubm")


def integer(model, precision):
    return model.file.integer(precision)


def random_image(rng, columns=64, empty=0.3):
    """Neighbours alike in some columns, wild in others, and counts at and beyond the limits."""
    base = rng.integers(1400, 40_000, columns)
    spread = rng.choice([3, 200, 300, 5000], columns)
    distance = np.clip(base + rng.integers(0, spread, (32, columns)), 0, 65535)
    odd = rng.random(distance.shape) < 0.1
    distance[odd] = rng.choice([1, 1499, 1500, 40_000, 40_001, 65_535], int(odd.sum()))
    distance[rng.random(distance.shape) < empty] = 0
    return distance.astype(np.uint16), rng.integers(0, 256, distance.shape).astype(np.uint8)


def extremes(columns=64):
    alternating = np.zeros((32, columns), np.uint16)
    alternating[::2, ::2] = alternating[1::2, 1::2] = 65535
    single = np.zeros((32, columns), np.uint16)
    single[7, columns // 2] = 5000
    images = [np.zeros_like(single), np.full_like(single, 65535), np.full_like(single, 40_000), alternating, single]
    images.append(np.where(alternating > 0, 40_000, 1500).astype(np.uint16))
    greys = (np.full((32, columns), 255, np.uint8), (alternating // 257).astype(np.uint8))
    return [(image, grey) for image in images for grey in greys]


def reference(image, model, precision, **options):
    return upsample_integer(*image, integer(model, precision), model.rules, **options)


def same(got, expected):
    return np.array_equal(got[0], expected[0]) and np.array_equal(got[1], expected[1])


RULES = [{"empty": "fill"}, {"empty": "none", "edge": "zero", "last_row": "repeat"}, {"empty": "fill", "edge": "zero"}]


@pytest.mark.parametrize("rules", RULES)
@pytest.mark.parametrize("cpu", USABLE)
@pytest.mark.parametrize("precision", PRECISIONS)
def test_images_are_the_reference_to_the_bit(rng, precision, cpu, rules):
    returns = 0
    for _ in range(4):
        model = make_model(rng, **rules)
        up = upbeam.Upsampler(model, precision, cpu=cpu)
        assert (up.cpu, up.precision) == (cpu, precision)
        for image in [random_image(rng, empty=e) for e in (0.0, 0.3, 0.9)] + extremes():
            got = up(*image)
            assert same(got, reference(image, model, precision))
            returns += int((got[0][1::2] > 0).sum())
    assert returns > 1000


@pytest.mark.parametrize("cpu", USABLE)
@pytest.mark.parametrize("precision", PRECISIONS)
def test_kernels_alone_generate_the_odd_rows(rng, precision, cpu):
    model = make_model(rng, edge="zero")
    image = random_image(rng)
    d, i = (np.ascontiguousarray(x.T) for x in image)
    distance, intensity = windows_int(model.native, precision, d, i, cpu)
    expected = reference(image, model, precision)
    assert same((distance.T[:31], intensity.T[:31]), (expected[0][1:63:2], expected[1][1:63:2]))
    assert not distance[:, 31].any()


@pytest.mark.parametrize("which", ["distance", "intensity"])
@pytest.mark.parametrize("precision", PRECISIONS)
def test_every_step_of_the_contract_is_that_of_the_reference(rng, precision, which):
    for _ in range(8):
        model = make_model(rng)
        parameters = getattr(integer(model, precision), which)
        top = 256 if which == "intensity" else 40_001
        base = rng.integers(0, top, (500, 1))
        windows = np.clip(base + rng.integers(0, [[4], [300], [511], [512], [70_000]] * 100, (500, 6)), 0, top - 1)
        if which == "distance":
            windows = np.maximum(windows, 1500)
        got = trace_int(model.native, precision, which, windows.astype(np.uint16))
        expected = network(parameters, precision, windows)
        for step in "mdsqSazYry":
            values = getattr(expected, step).reshape(len(windows), -1)
            width = parameters.hidden if step in "Saz" else values.shape[1]
            assert np.array_equal(got[step][:, :width], values), step


def stream_image(model, precision, distance, intensity, chunks):
    """Pushes columns; a negative chunk is so many that never arrive."""
    stream = upbeam.ColumnStream(model, precision)
    parts, at = [], 0
    for n in chunks:
        part = slice(at, at + abs(n))
        if n > 0:
            columns = (np.ascontiguousarray(x[:, part].T) for x in (distance, intensity))
            parts.append(stream.push(*columns, at % model.columns))
        at += abs(n)
    parts.append(stream.flush())
    assert stream.stats()["precision"] == precision
    return np.concatenate([p.distance for p in parts]).T, np.concatenate([p.intensity for p in parts]).T


@pytest.mark.parametrize("edge", ["zero", "seam"])
@pytest.mark.parametrize("precision", PRECISIONS)
def test_streams_with_gaps_and_across_frame_borders_are_the_reference(rng, precision, edge):
    """Three turns: under ``seam`` one wide image, under ``zero`` three side by side; columns that did not arrive are
    empty, also around a border."""
    for _ in range(3):
        model = make_model(rng, edge=edge)
        distance, intensity = random_image(rng, columns=3 * 64)
        for chunks in ([192], [1] * 192, [50, -3, 60, -20, 51, -1, 7]):
            holed = distance.copy(), intensity.copy()
            at = 0
            for n in chunks:
                for image in holed:
                    image[:, at : at + max(0, -n)] = 0
                at += abs(n)
            if edge == "seam":
                expected = reference(holed, model, precision)
            else:
                turns = [reference([x[:, k : k + 64] for x in holed], model, precision) for k in (0, 64, 128)]
                expected = [np.concatenate(x, axis=1) for x in zip(*turns, strict=True)]
            assert same(stream_image(model, precision, distance, intensity, chunks), expected)


@pytest.mark.parametrize("precision", PRECISIONS)
def test_destaggered_streams_are_the_reference_of_the_aligned_image(rng, precision):
    """A VLP-32C: each beam of a firing lies in another azimuth column. Columns whose beams all arrived are compared."""
    model = make_model(rng, table="vlp-32c", aligned=False, columns=180)
    offsets = beam_table("vlp-32c").column_offsets(180)
    assert np.ptp(offsets) > 2
    firing = random_image(rng, columns=360)
    azimuth = [np.zeros_like(x) for x in firing]
    for image, target in zip(firing, azimuth, strict=True):
        for beam, offset in enumerate(offsets):
            target[beam, max(0, offset) : 360 + min(0, offset)] = image[beam, max(0, -offset) : 360 - max(0, offset)]
    got = stream_image(model, precision, *firing, [360])
    expected = reference(azimuth, model, precision)
    assert same(got, expected)


@pytest.mark.parametrize("precision", PRECISIONS)
def test_live_frames_are_the_reference(rng, precision):
    model = make_model(rng)
    frames = [random_image(rng) for _ in range(3)]
    distance, intensity = (firing_columns(np.stack(x)) for x in zip(*frames, strict=True))
    config = LiveConfig(
        precision=precision,
        clock="virtual",
        service_packet_us=1.0,
        service_column_us=1.0,
        aligned=True,
        keep_frames=[1],
    )
    result = run_live(model, distance, intensity, config)
    wide = [np.concatenate(x, axis=1) for x in zip(*frames, strict=True)]
    expected = reference(wide, model, precision)
    assert result.precision == precision
    assert same((result.images[1].distance, result.images[1].intensity), [x[:, 64:128] for x in expected])


def test_metres_in_metres_out(rng):
    model = make_model(rng)
    counts, intensity = random_image(rng)
    metres = to_metres(counts, model.distance_unit_m)
    up = upbeam.Upsampler(model, "int16")
    assert np.array_equal(up(metres, intensity)[0], to_metres(up(counts, intensity)[0], model.distance_unit_m))


# -------------------------------------------------------------------------------------------- what is in the file


def test_a_precision_that_the_file_lacks_is_refused_by_name(rng):
    model = make_model(rng, precisions=("int8",))
    assert model.precisions == ("fp32", "int8")
    for make in (upbeam.Upsampler, upbeam.ColumnStream, upbeam.Model.sizes):
        with pytest.raises(ValueError, match=r"int16 is not in test\.ubm, only fp32, int8: `upbeam quantize`"):
            make(model, "int16")
        with pytest.raises(ValueError, match="int4"):
            make(model, "int4")
    frames = [x[None] for x in random_image(rng)]
    with pytest.raises(LiveConfigError, match=r"int16 is not in test\.ubm"):
        run_live(model, *map(firing_columns, frames), LiveConfig(precision="int16"))
    windows = np.zeros((1, 6), np.uint16)
    with pytest.raises(NativeError, match="does not have the precision"):
        trace_int(model.native, "int16", "distance", windows)
    with pytest.raises(NativeError, match="does not have the precision"):
        windows_int(model.native, "fp32", np.zeros((1, 32), np.uint16), np.zeros((1, 32), np.uint8))


def test_sizes_are_those_of_the_file_and_of_the_stream(rng):
    model = make_model(rng, table="vlp-32c", aligned=False, columns=904)
    sizes = {p: model.sizes(p) for p in model.precisions}
    assert {p: s["weights"] for p, s in sizes.items()} == weight_bytes(model.data)
    for precision, size in sizes.items():
        assert size["file"] == len(model.data)
        assert size["state"] == upbeam.ColumnStream(model, precision).stats()["state_bytes"]
        assert model.sizes(precision, aligned=True)["state"] == size["state"] - size["ring"]
    assert sizes["int16"]["state"] == sizes["int8"]["state"] == sizes["fp32"]["state"]


def three_units(n):
    return replace(n, weight=n.weight[:3], minimum=n.minimum[:3], bias=n.bias[:3], output=n.output[:3])


def sealed(data):
    return bytes(data[:-4]) + struct.pack("<I", zlib.crc32(bytes(data[:-4])))


def reads(reader, data):
    try:
        reader(data)
    except (UbmError, NativeError):
        return False
    return True


def test_python_and_c_refuse_the_same_files(rng):
    """One byte after the other of the integer sections changed, the checksum made right."""
    model = make_model(rng)
    small = {p: IntegerModel(p, *map(three_units, integer(model, p))) for p in PRECISIONS}
    data = bytearray(replace(model.file, **small).to_bytes())
    first = data.index(b"upbeam.int16.v1")
    accepted = refused = 0
    for at in range(first, len(data) - 4):
        for flip in (0x01, 0x80, 0xFF, int(rng.integers(1, 256))):
            data[at] ^= flip
            changed = sealed(data)
            data[at] ^= flip
            answers = {reads(read_ubm, changed), reads(NativeModel, changed)}
            assert len(answers) == 1, f"byte {at - first} of the integer sections ^ {flip:#x}"
            accepted, refused = accepted + (True in answers), refused + (False in answers)
    assert accepted > 100
    assert refused > 100


def test_what_the_loader_says_of_a_model_that_could_overflow(rng):
    model = make_model(rng, precisions=("int8",))
    data = bytearray(model.data)
    at = data.index(b"upbeam.int8.v1") + 36 + 28
    data[at : at + 4] = struct.pack("<i", -(2**31))
    first = integer(model, "int8").distance
    reach = int(np.minimum(first.weight[0], 0).sum() + min(0, first.minimum[0]))
    assert reach < 0
    with pytest.raises(NativeError, match=r"Q8\.distance\.S\[0\].* \(got -\d+, expected -2147483648\) at byte"):
        NativeModel(sealed(data))
