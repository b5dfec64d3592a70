"""The comparison of backends: one that agrees passes, and every kind of fault is caught and its stage named."""

from __future__ import annotations

import zlib
from dataclasses import replace

import numpy as np
import pytest

import upbeam
from upbeam.quant.integer import IntegerModel, network
from upbeam.quant.quantize import Calibration, quantize
from upbeam.quant.verify import (
    AROUND,
    KERNEL,
    Backend,
    VectorSet,
    extreme_set,
    firing_set,
    golden_digests,
    golden_image,
    golden_mismatch,
    golden_set,
    image_set,
    random_set,
    reference_backend,
    stream_set,
    verify,
)

COLUMNS = 96
GOLDEN_CRC = 55_669_821
"""Of ``golden_image``, 128 columns: what model files keep digests of."""


@pytest.fixture(scope="module")
def file():
    """The shipped networks on a narrow sensor, quantised on windows of any differences."""
    rng = np.random.default_rng(7)
    shipped = upbeam.load_model().file
    level = rng.integers(1500, 30_000, (4000, 1))
    spread = (2.0 ** rng.uniform(0, 13, (4000, 1)) * rng.random((4000, 6))).astype(int)
    calibration = Calibration(level + spread, rng.integers(0, 256, (4000, 6)))
    narrow = replace(shipped, rules=replace(shipped.rules, columns=COLUMNS), metrics={})
    return quantize(narrow, calibration, rounding="nearest")


@pytest.fixture(scope="module", params=["int16", "int8"])
def model(request, file):
    return file.integer(request.param)


def every_set(rules, rng):
    turns = random_set(rules, 3 * COLUMNS, seed=3).images
    return [
        golden_set(rules),
        image_set("frames", turns[:2]),
        stream_set("stream", turns),
        random_set(rules, 500),
        extreme_set(rules),
    ]


def changed(model: IntegerModel, which: str, **values) -> IntegerModel:
    return replace(model, **{which: replace(getattr(model, which), **values)})


def check(file, model, backend, sets):
    reference = reference_backend(model, file.rules)
    return verify(reference, [backend], sets, file.rules)[backend.name]


def test_the_reference_agrees_with_itself_on_every_set(file, model, rng):
    sets = every_set(file.rules, rng)
    result = check(file, model, reference_backend(model, file.rules, "same"), sets)
    assert result.exact
    assert {name: count.differing for name, count in result.sets.items()} == dict.fromkeys(
        ["golden", "frames", "stream", "random", "extremes"], 0
    )
    assert result.sets["random"].windows >= 500 * 31


PLAUSIBLE_FAULTS = {
    "weight": ("distance", lambda n: {"weight": n.weight + np.eye(*n.weight.shape, dtype=int)}, "step 4, sums S"),
    "minimum": ("distance", lambda n: {"minimum": n.minimum + 3}, "step 4, sums S"),
    "bias": ("intensity", lambda n: {"bias": n.bias + 40_000_000}, "step 4, sums S"),
    "slope": ("distance", lambda n: {"slope": n.slope + 2000}, "step 6, rectified z"),
    "output weight": ("intensity", lambda n: {"output": n.output + 2}, "step 7, output Y"),
    "output bias": ("distance", lambda n: {"offset": n.offset + (3 << n.t)}, "step 7, output Y"),
    "rounding shift": ("distance", lambda n: {"t": n.t - 1}, "step 8, rounded output r"),
    "skip": ("intensity", lambda n: {"skip": 1 - n.skip}, "step 9, y"),
}


@pytest.mark.parametrize("fault", PLAUSIBLE_FAULTS)
def test_a_sabotaged_network_is_caught_and_its_stage_named(file, model, rng, fault):
    which, change, stage = PLAUSIBLE_FAULTS[fault]
    bad = changed(model, which, **change(getattr(model, which)))
    result = check(file, model, reference_backend(bad, file.rules, "bad"), every_set(file.rules, rng))
    assert not result.exact
    assert any(count.differing for count in result.sets.values())
    assert result.first.stage == f"{which} network, {stage}"
    assert result.first.expected != result.first.got
    assert result.first.row % 2 == 1
    text = result.first.text()
    assert stage in text
    assert "column" in text
    assert "window [" in text


def test_a_code_of_another_precision_is_caught_at_step_3(file, rng):
    model = file.int8
    coarse = replace(model, precision="int16")
    result = check(file, model, reference_backend(coarse, file.rules, "bad"), [random_set(file.rules, 500)])
    assert result.first.stage == "distance network, step 3, shift s of the block code"


def broken_backend(model, rules, spoil, name="bad"):
    """The reference, its images spoilt."""
    good = reference_backend(model, rules, name)

    def image(given):
        distance, intensity = (part.copy() for part in good.image(given))
        spoil(distance, intensity)
        return distance, intensity

    return replace(good, image=image)


def spoil_pixel(row, column):
    def spoil(distance, intensity):
        distance[row, column] ^= 1

    return spoil


def test_sensor_rows_and_the_last_row_are_compared_too(file, model):
    sets = [random_set(file.rules, 100)]
    for row, stage in ((10, "sensor row"), (63, "last row")):
        bad = broken_backend(model, file.rules, spoil_pixel(row, 5))
        result = check(file, model, bad, sets)
        assert result.first.stage == stage
        assert (result.first.row, result.first.column) == (row, 5)


def test_a_kernel_whose_steps_agree_is_told_from_the_rules_around_it(file, model, rng):
    """A kernel that is wrong wherever a window stands, and one that is wrong for its neighbours' sake."""
    sets = [random_set(file.rules, 100)]

    def spoil(distance, intensity):
        distance[1::2][distance[1::2] > 0] += 1

    kernel = check(file, model, broken_backend(model, file.rules, spoil), sets)
    assert kernel.first.stage == KERNEL
    empty = replace(file.rules, empty="none")
    assert check(file, model, reference_backend(model, empty, "bad"), sets).first.stage == AROUND


def test_without_a_trace_the_values_are_named(file, model):
    bad = replace(broken_backend(model, file.rules, spoil_pixel(31, 7)), trace=None)
    first = check(file, model, bad, [golden_set(file.rules)]).first
    assert "no trace" in first.stage
    assert (first.frame, first.column, first.row) == (0, 7, 31)
    assert first.expected != first.got


def test_a_stream_that_joins_what_a_gap_parts_is_caught_in_the_stream_set_alone(file, model, rng):
    good = reference_backend(model, file.rules, "bad")

    def joined(strip, arrived):
        distance, intensity = good.stream(strip, np.ones_like(arrived))
        distance[0::2], intensity[0::2] = (np.where(arrived, part, 0) for part in strip)
        return distance, intensity

    sets = every_set(file.rules, rng)
    result = check(file, model, replace(good, stream=joined), sets)
    assert [name for name, count in result.sets.items() if count.differing] == ["stream"]
    assert result.first.vectors == "stream"


def test_a_stream_set_has_gaps_also_over_the_border_of_two_turns(file):
    turns = random_set(file.rules, 4 * COLUMNS).images
    arrived = stream_set("stream", turns).arrived
    assert not arrived[COLUMNS - 1]
    assert not arrived[COLUMNS]
    assert arrived[-1]
    assert 0.9 < arrived.mean() < 1


def test_a_backend_without_a_stream_is_said_to_have_none(file, model, rng):
    backend = replace(reference_backend(model, file.rules, "images only"), stream=None)
    result = check(file, model, backend, every_set(file.rules, rng))
    assert result.sets["stream"] is None
    assert result.exact


def test_an_output_of_another_shape_is_a_mismatch(file, model):
    good = reference_backend(model, file.rules)
    bad = Backend("bad", lambda given: tuple(part[:, :-1] for part in good.image(given)))
    assert check(file, model, bad, [golden_set(file.rules)]).first.stage == "shape"


def test_under_the_zero_edge_turns_are_images_of_their_own(file, rng):
    rules = replace(file.rules, edge="zero")
    turns = random_set(rules, 3 * COLUMNS).images
    vectors = VectorSet("stream", turns, np.ones(3 * COLUMNS, bool))
    backend = reference_backend(file.int8, rules)
    whole = backend.stream(vectors.strip, vectors.arrived)
    for k, turn in enumerate(turns):
        part = slice(k * COLUMNS, (k + 1) * COLUMNS)
        assert np.array_equal(backend.image(turn)[0], whole[0][:, part])


def test_golden_vectors_never_change(file):
    """The digests in model files stand for this very input."""
    distance, intensity = golden_image(replace(file.rules, columns=128))
    assert zlib.crc32(distance.astype("<u2").tobytes() + intensity.tobytes()) == GOLDEN_CRC
    limits = file.rules.min_count, file.rules.max_count
    assert (distance == 0).any()
    assert ((distance > 0) & (distance < limits[0])).any()
    assert (distance > limits[1]).any()


def test_the_digest_in_the_file_holds_the_reference(file):
    stored = replace(file, metrics={"golden": golden_digests(file)})
    assert golden_mismatch(stored, "int8") is None
    other = replace(stored, int8=changed(file.int8, "distance", offset=file.int8.distance.offset + 5000))
    found = golden_mismatch(other, "int8")
    assert found.expected == stored.metrics["golden"]["int8"] != found.got
    with pytest.raises(KeyError):
        golden_mismatch(file, "int8")


def test_random_and_golden_columns_reach_every_shift_of_the_block_code(file):
    for vectors in (golden_set(replace(file.rules, columns=2048)), random_set(file.rules, 10_000)):
        windows = np.concatenate(
            [np.lib.stride_tricks.sliding_window_view(d, (2, 3)).reshape(-1, 6) for d, _ in vectors.images]
        )
        shifts = network(file.int8.distance, "int8", windows[(windows > 1500).all(1) & (windows < 40_000).all(1)]).s
        assert set(range(9)) == set(np.unique(shifts).tolist())


def test_a_stream_that_ignores_the_azimuth_offsets_is_caught(file):
    shipped = upbeam.load_model("vlp-32c").file.rules
    offsets = {"azimuth_offset_deg": shipped.azimuth_offset_deg * (904 / COLUMNS)}  # as many columns as there
    rules = replace(file.rules, **offsets)
    reference = reference_backend(file.int8, rules)
    vectors = firing_set("firing", random_set(rules, 3 * COLUMNS).images)
    bad = replace(reference, name="bad", firing=reference.stream)
    found = verify(reference, [replace(reference, name="same"), bad], [vectors], rules)
    assert found["same"].exact
    assert found["bad"].sets["firing"].differing > COLUMNS
    assert found["bad"].first.stage == "sensor row"
