"""Every CPU kernel of this machine against the NumPy reference of the contract: on all real frames, streamed, and at
the extremes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import upbeam
from upbeam.cli.frames import model_frames
from upbeam.model.frames import kitti_frames
from upbeam.quant.quantize import calibration_windows, quantize
from upbeam.quant.verify import (
    extreme_set,
    firing_set,
    golden_set,
    image_set,
    random_set,
    reference_backend,
    stream_set,
    verify,
)
from upbeam.runtime.verify import CPUS, cpu_backends


def quantised(name):
    file = upbeam.load_model(name).file
    found = model_frames("sim", file, limit=2, seed=7, simulated=2, what="frames", quiet=True).frames
    return upbeam.Model(quantize(file, calibration_windows(found, file.rules), rounding="nearest").to_bytes())


@pytest.fixture(scope="module")
def model():
    return quantised("hdl-64e")


def check(model, precision, sets):
    backends = cpu_backends(model, precision)
    reference = reference_backend(model.file.integer(precision), model.rules)
    results = verify(reference, backends, sets, model.rules)
    assert len(results) == len(backends) >= 1
    for name, result in results.items():
        assert result.exact, f"{precision} {name}: {result.first.text()}"
        assert all(count is not None and count.windows > 0 for count in result.sets.values())
    return results


@pytest.mark.parametrize("precision", ["int16", "int8"])
def test_golden_random_and_extreme_columns(model, precision):
    rules = model.rules
    check(model, precision, [golden_set(rules), random_set(rules), extreme_set(rules)])


@pytest.mark.parametrize("precision", ["int16", "int8"])
def test_all_real_frames_as_images_and_as_a_stream(model, precision, data_dir):
    images = [(f.distance[::2], f.intensity[::2]) for f in kitti_frames(data_dir / "kitti" / "frames", model.rules)]
    results = check(model, precision, [image_set("frames", images), stream_set("stream", images)])
    windows = sum(c.windows for c in next(iter(results.values())).sets.values())
    print(f"{precision}: {windows} windows, no difference in {', '.join(results)}")


@pytest.mark.parametrize("precision", ["int16", "int8"])
def test_lasers_that_fire_apart_through_the_destagger_ring(precision):
    model = quantised("vlp-32c")
    turns = random_set(model.rules, 3 * model.columns).images
    check(model, precision, [firing_set("firing", turns), stream_set("stream", turns)])


def test_a_precision_the_model_lacks_is_refused():
    data = replace(upbeam.load_model().file, int16=None, int8=None).to_bytes()
    with pytest.raises(ValueError, match="int8"):
        cpu_backends(upbeam.Model(data), "int8")


def test_the_c_trace_has_every_step_of_the_reference(model, rng):
    """What names the stage of a mismatch must itself be right."""
    greys = rng.integers(0, 256, (200, 6))
    inputs = {"distance": 1500 + (greys << rng.integers(0, 7, (200, 1))), "intensity": greys}
    for precision in ("int16", "int8"):
        reference = reference_backend(model.file.integer(precision), model.rules)
        scalar = cpu_backends(model, precision)[0]
        for which, windows in inputs.items():
            wanted = reference.trace(which, windows)
            made = scalar.trace(which, windows)
            assert set(made) == set(wanted)
            for step, values in wanted.items():
                width = values.reshape(len(windows), -1).shape[1]
                assert np.array_equal(values.reshape(len(windows), -1), made[step][:, :width]), (precision, which, step)


def test_the_instruction_sets_begin_with_the_scalar_one():
    assert CPUS[0] == "scalar"
