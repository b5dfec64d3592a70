"""The C runtime through Python: against the NumPy reference, against itself by other paths, and against bad input."""

from __future__ import annotations

import numpy as np
import pytest

import upbeam
from upbeam.model.beams import beam_table
from upbeam.model.frames import kitti_frames
from upbeam.model.geometry import to_metres
from upbeam.model.network import WindowNetwork
from upbeam.model.recipe import load_recipe
from upbeam.model.rules import Rules, extract_windows, upsample_reference
from upbeam.quant import ModelFile
from upbeam.runtime._native import raw_windows

SETS = ["scalar", "avx2", "avx512", "neon"]


def available(name):
    try:
        upbeam.Upsampler(upbeam.load_model(), cpu=name)
    except ValueError as error:
        assert name in str(error) or "instruction" in str(error)  # noqa: PT017
        return False
    return True


USABLE = [name for name in SETS if available(name)]


def make_model(rng, *, table="hdl-64e", aligned=True, columns=256, raw=False, **rules):
    beams = beam_table(table)
    graph = {} if raw else {"inputs": "difference", "output": "residual", "scale": 0.05, "slope": 1 / 128}

    def network():
        c1, c2, h = 8, 2, 12
        return WindowNetwork(
            rng.normal(size=c1) / 3, rng.normal(size=c1) / 3, rng.normal(size=(c2, c1)) / 3, rng.normal(size=c2) / 3,
            rng.normal(size=(h, 6 * c2 + 1)) / 3, rng.normal(size=h) / 3, rng.normal(size=h) / 3, 0.3, **graph,
        )  # fmt: skip

    made = Rules.for_beams(beams.aligned() if aligned else beams, columns=columns, **rules)
    return upbeam.Model(ModelFile.from_dense(made, (network(), network())).to_bytes())


def random_image(rng, columns=256, empty=0.3):
    distance = rng.integers(1, 65536, (32, columns)).astype(np.uint16)
    near = rng.random(distance.shape) < 0.7
    distance[near] = rng.integers(1400, 42_000, int(near.sum()))
    distance[rng.random(distance.shape) < empty] = 0
    return distance, rng.integers(0, 256, distance.shape).astype(np.uint8)


def extremes(columns=256):
    grey = np.full((32, columns), 255, np.uint8)
    alternating = np.zeros((32, columns), np.uint16)
    alternating[::2, ::2] = alternating[1::2, 1::2] = 65535
    single = np.zeros((32, columns), np.uint16)
    single[7, columns // 2] = 5000
    checker = np.where(alternating > 0, 40_000, 1500).astype(np.uint16)
    images = [
        np.zeros((32, columns), np.uint16),
        np.full((32, columns), 65535, np.uint16),
        alternating,
        single,
        checker,
    ]
    return [(image, grey) for image in images]


@pytest.mark.parametrize(
    "rules", [{"empty": "fill"}, {"empty": "none", "edge": "zero", "last_row": "repeat", "raw": True}]
)
@pytest.mark.parametrize("cpu", USABLE)
def test_images_match_the_reference(rng, cpu, rules):
    """Within one count (float32 against float64 at a rounding boundary); validity differs only at a threshold."""
    model = make_model(rng, **rules)
    up = upbeam.Upsampler(model, cpu=cpu)
    assert up.cpu == cpu
    images = [random_image(rng, empty=e) for e in (0.0, 0.3, 0.9)] + extremes()
    for distance, intensity in images:
        out, grey = up(distance, intensity)
        expected, expected_grey = upsample_reference(distance, intensity, model.file.folded, model.rules)
        assert np.array_equal(out[::2], distance)
        assert np.array_equal(grey[::2], intensity)
        flips = (out > 0) != (expected > 0)
        limits = {model.rules.min_count, *model.rules.row_max_count.tolist()}
        assert flips.sum() <= 1
        assert all(int(count) in limits for count in np.maximum(out, expected)[flips])
        both = (out > 0) & (expected > 0)
        assert np.abs(out.astype(int) - expected)[both].max(initial=0) <= 1
        assert (out != expected).mean() < 2e-3
        assert np.abs(grey.astype(int) - expected_grey)[both].max(initial=0) <= 1


@pytest.mark.parametrize("cpu", USABLE)
def test_raw_outputs_agree_to_a_hundred_thousandth_of_the_terms(rng, data_dir, cpu):
    """Before the validity rule, on a real frame, both networks; the scale is the sum of |w x|."""
    model = upbeam.load_model()
    frame = next(iter(kitti_frames(data_dir / "kitti" / "frames", model.rules)))
    d, i = frame.distance[::2], frame.intensity[::2]
    raw = raw_windows(model.native, np.ascontiguousarray(d.T), np.ascontiguousarray(i.T), cpu)
    windows = extract_windows(d, i, model.rules)
    for y, values, unit, network in zip(
        raw, (windows.distance, windows.intensity), (model.distance_unit_m, 1.0), model.file.folded, strict=True
    ):
        expected = network(values * unit) / unit
        scale = network.magnitude(values * unit) / unit
        error = np.abs(y.T[:31] - expected) / scale
        assert error[windows.any_return].max() < 1e-5


def test_every_instruction_set_gives_the_same_bits_on_real_frames(data_dir):
    """All kernels fuse the same products in the same order, the scalar one too where the machine has FMA."""
    if len(USABLE) == 1:
        pytest.skip(f"this machine runs the {USABLE[0]} kernel only: nothing to compare")
    model = upbeam.load_model()
    ups = [upbeam.Upsampler(model, cpu=cpu) for cpu in USABLE]
    windows = differing = 0
    for frame in kitti_frames(data_dir / "kitti" / "frames", model.rules):
        images = [up(frame.distance[::2], frame.intensity[::2]) for up in ups]
        windows += 31 * model.columns
        for distance, intensity in images[1:]:
            differing += int(((distance != images[0][0]) | (intensity != images[0][1])).sum())
    print(f"{differing} of {windows} windows differ between {', '.join(USABLE)}")
    assert differing == 0


def stream_image(model, distance, intensity, chunks, **options):
    stream = upbeam.ColumnStream(model, **options)
    parts, at = [], 0
    for n in chunks:
        part = slice(at, at + n)
        parts.append(
            stream.push(
                np.ascontiguousarray(distance[:, part].T),
                np.ascontiguousarray(intensity[:, part].T),
                at % model.columns,
            )
        )
        at += n
    parts.append(stream.flush())
    return np.concatenate([p.distance for p in parts]).T, np.concatenate([p.intensity for p in parts]).T, stream.stats()


@pytest.mark.parametrize("edge", ["zero", "seam"])
def test_a_stream_of_any_chunks_gives_the_bits_of_the_image(rng, edge):
    model = make_model(rng, edge=edge)
    distance, intensity = random_image(rng)
    whole = upbeam.Upsampler(model)(distance, intensity)
    for chunks in ([256], [1] * 256, [100, 1, 155]):
        out, grey, stats = stream_image(model, distance, intensity, chunks)
        assert np.array_equal(out, whole[0])
        assert np.array_equal(grey, whole[1])
        assert stats["columns_out"] == 256


@pytest.mark.parametrize("edge", ["zero", "seam"])
def test_frame_borders(rng, edge):
    """Two turns in one stream: under ``seam`` one wide image, under ``zero`` two images side by side."""
    model = make_model(rng, edge=edge)
    turns = [random_image(rng) for _ in range(2)]
    distance, intensity = (np.concatenate(x, axis=1) for x in zip(*turns, strict=True))
    out, grey, _ = stream_image(model, distance, intensity, [512])
    if edge == "zero":
        expected = [np.concatenate(x, 1) for x in zip(*(upbeam.Upsampler(model)(*t) for t in turns), strict=True)]
    else:
        expected = list(upbeam.Upsampler(model, columns=512)(distance, intensity))
    assert np.array_equal(out, expected[0])
    assert np.array_equal(grey, expected[1])


def test_columns_that_never_arrive_are_inserted_empty_and_counted(rng):
    model = make_model(rng)
    distance, intensity = random_image(rng, empty=0.0)
    stream = upbeam.ColumnStream(model)
    first = stream.push(np.ascontiguousarray(distance[:, :100].T), np.ascontiguousarray(intensity[:, :100].T), 0)
    rest = stream.push(np.ascontiguousarray(distance[:, 103:].T), np.ascontiguousarray(intensity[:, 103:].T), 103)
    end = stream.flush()
    holed = distance.copy(), intensity.copy()
    for image in holed:
        image[:, 100:103] = 0
    expected = upbeam.Upsampler(model)(*holed)
    got = np.concatenate([first.distance, rest.distance, end.distance]).T
    assert np.array_equal(got, expected[0])
    incomplete = np.concatenate([first.incomplete, rest.incomplete, end.incomplete])
    assert np.flatnonzero(incomplete).tolist() == [100, 101, 102]
    stats = stream.stats()
    assert (stats["columns_in"], stats["columns_missing"], stats["columns_out"]) == (253, 3, 256)


def test_late_columns_are_dropped_and_counted(rng):
    model = make_model(rng)
    distance, intensity = random_image(rng)
    columns = np.ascontiguousarray(distance.T), np.ascontiguousarray(intensity.T)
    stream = upbeam.ColumnStream(model)
    stream.push(columns[0][:50], columns[1][:50], 0)
    assert len(stream.push(columns[0][40:45], columns[1][40:45], 40)) == 0
    assert stream.stats()["columns_late"] == 5


def test_the_destagger_ring_puts_beams_of_one_azimuth_side_by_side(rng):
    """A VLP-32C stream: sensor rows come out shifted by each beam's own offset, 8 columns and more behind."""
    model = make_model(rng, table="vlp-32c", aligned=False, columns=904)
    offsets = beam_table("vlp-32c").column_offsets(904)
    distance, intensity = random_image(rng, columns=904)
    stream = upbeam.ColumnStream(model)
    parts = [stream.push(np.ascontiguousarray(distance.T), np.ascontiguousarray(intensity.T), 0), stream.flush()]
    out = np.concatenate([p.distance for p in parts])
    place = np.concatenate([p.column for p in parts])
    assert stream.stats()["delay_columns"] == -offsets.min() + 1
    for k, column in enumerate(place):
        for beam in range(0, 32, 5):
            source = int(column) - offsets[beam]
            if 100 <= column < 800:
                assert out[k, 2 * beam] == distance[beam, source]
    state = stream.stats()["memory_bytes"]
    assert state > upbeam.ColumnStream(make_model(rng)).stats()["memory_bytes"]


def test_metres_in_metres_out(rng):
    model = make_model(rng)
    counts, intensity = random_image(rng)
    metres = (counts.astype(np.float64) * model.distance_unit_m + 3e-4 * (counts > 0)).astype(np.float32)
    out, grey = upbeam.Upsampler(model)(metres, intensity)
    expected, expected_grey = upbeam.Upsampler(model)(counts, intensity)
    assert out.dtype == np.float32
    assert out[::2].tobytes() == metres.tobytes()  # verbatim, not rounded to counts
    assert np.array_equal(out[1::2], to_metres(expected[1::2], model.distance_unit_m))
    assert np.array_equal(grey, expected_grey)


def test_generated_rows_are_named():
    rows = upbeam.generated_rows()
    assert rows.sum() == 32
    assert not rows[::2].any()


@pytest.mark.parametrize(
    ("distance", "intensity", "named"),
    [
        (
            np.zeros((32, 255), np.uint16),
            np.zeros((32, 256), np.uint8),
            r"distance has shape \[32, 255\], expected \[32, 256\]",
        ),
        (np.zeros((32, 256), np.uint16), np.zeros((31, 256), np.uint8), r"intensity has shape \[31, 256\]"),
        (np.zeros((32, 256), np.int32), np.zeros((32, 256), np.uint8), "distance is int32"),
        (np.zeros((32, 256), np.uint16), np.zeros((32, 256), np.float32), "intensity is float32"),
        (np.full((32, 256), np.nan, np.float32), np.zeros((32, 256), np.uint8), "finite"),
        (np.full((32, 256), np.inf, np.float32), np.zeros((32, 256), np.uint8), "finite"),
        (np.full((32, 256), -1, np.float32), np.zeros((32, 256), np.uint8), "expected"),
        (np.zeros((0,), np.uint16), np.zeros((0,), np.uint8), "shape"),
    ],
)
def test_bad_arrays_are_refused_by_name(rng, distance, intensity, named):
    up = upbeam.Upsampler(make_model(rng))
    with pytest.raises(ValueError, match=named):
        up(distance, intensity)


def test_unavailable_choices_are_refused_by_name():
    model = upbeam.load_model()
    for options, named in (
        ({"precision": "int4"}, "int4"),
        ({"backend": "gpu"}, "gpu"),
        ({"cpu": "sse"}, "sse"),
        ({"columns": 3}, "columns"),
        ({"columns": 70_000}, "columns"),
    ):
        with pytest.raises(ValueError, match=named):
            upbeam.Upsampler(model, **options)


def test_models_that_cannot_be_loaded(tmp_path):
    with pytest.raises(ValueError, match=r"nowhere\.ubm"):
        upbeam.load_model(tmp_path / "nowhere.ubm")
    data = bytearray(upbeam.load_model().data)
    data[200] ^= 4
    (tmp_path / "flipped.ubm").write_bytes(data)
    with pytest.raises(ValueError, match=r"flipped\.ubm.*damaged"):
        upbeam.load_model(tmp_path / "flipped.ubm")


RECIPES = {
    "hdl-64e": "default",
    "hdl-64e-6": "hidden-6",
    "hdl-64e-8": "hidden-8",
    "hdl-32e": "hdl-32e",
    "vlp-32c": "vlp-32c",
}
MULTIPLY_ADDS = {"hdl-64e-6": 48, "hdl-64e-8": 64}


@pytest.mark.parametrize("name", list(RECIPES))
def test_shipped_models_are_what_their_recipes_make(name):
    """Sensor, columns and rules of the file are those of the recipe, and the data may be used commercially."""
    assert upbeam.shipped_models() == sorted(RECIPES)
    model = upbeam.load_model(name)
    recipe = load_recipe(RECIPES[name])
    rules = recipe.make_rules()
    assert model.rules.sensor == rules.sensor
    assert model.columns == rules.columns
    assert model.rules.row_max_count.tolist() == rules.row_max_count.tolist()
    assert model.rules.azimuth_offset_deg == pytest.approx(rules.azimuth_offset_deg, abs=1e-6)
    assert model.file.provenance["recipe"] == recipe.name
    assert model.file.provenance["licence"] == "Apache-2.0"
    assert [n.multiply_adds for n in model.file.folded] == [MULTIPLY_ADDS.get(name, 96)] * 2


def test_unknown_model_names_are_listed():
    with pytest.raises(ValueError, match="no such model; shipped are hdl-32e, hdl-64e, hdl-64e-6, hdl-64e-8, vlp-32c"):
        upbeam.load_model("hdl-128")


def test_two_threads_may_share_a_model_and_even_an_upsampler(rng):
    from concurrent.futures import ThreadPoolExecutor

    model = make_model(rng)
    images = [random_image(rng) for _ in range(8)]
    up = upbeam.Upsampler(model)
    alone = [up(*image)[0] for image in images]
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(lambda image: up(*image)[0], images * 10))
    assert all(np.array_equal(a, b) for a, b in zip(alone * 10, together, strict=True))
