"""The degradation ladder in the stream: the bits of its NumPy reference on every CPU path, in every precision."""

from __future__ import annotations

from importlib import resources
from typing import Any

import numpy as np
import pytest

from upbeam.model.rules import Rules
from upbeam.quant import ubm
from upbeam.runtime import _native
from upbeam.runtime.ladder import LADDER, ladder_rows

WIDTH = 64


def machine_has(cpu: str) -> bool:
    try:
        _native.Stream(_native.Model(file()), cpu=cpu)
    except _native.NativeError:
        return False
    return True


def file(name: str = "hdl-64e") -> bytes:
    return resources.files("upbeam.quant").joinpath("models").joinpath(f"{name}.ubm").read_bytes()


def random_image(rules: Rules, rng: np.random.Generator) -> tuple[Any, Any]:
    """Counts of all kinds: empty, at the limits of their row, one beyond, any."""
    limits = np.asarray(rules.row_max_count)[0::2, None]
    kinds = np.stack(
        [
            np.zeros((32, WIDTH), int),
            np.broadcast_to(limits, (32, WIDTH)),
            np.broadcast_to(np.minimum(limits + 1, 65535), (32, WIDTH)),
            np.full((32, WIDTH), rules.min_count),
            np.full((32, WIDTH), rules.min_count - 1),
            rng.integers(0, 65536, (32, WIDTH)),
            rng.integers(rules.min_count, rules.min_count + 2000, (32, WIDTH)),
        ]
    )
    chosen = np.take_along_axis(kinds, rng.integers(0, len(kinds), (1, 32, WIDTH)), axis=0)[0]
    return chosen.astype(np.uint16), rng.integers(0, 256, (32, WIDTH)).astype(np.uint8)


@pytest.mark.parametrize("cpu", [cpu for cpu in _native.CPUS[1:] if machine_has(cpu)])
@pytest.mark.parametrize("precision", ["fp32", "int16", "int8"])
@pytest.mark.parametrize("mode", LADDER[1:])
@pytest.mark.parametrize("name", ["hdl-64e", "vlp-32c"])
def test_bits_on_every_path(name: str, mode: str, precision: str, cpu: str, rng: np.random.Generator) -> None:
    rules = ubm.read_ubm(file(name)).rules
    distance, intensity = random_image(rules, rng)
    stream = _native.Stream(
        _native.Model(file(name)), precision=precision, cpu=cpu, columns=WIDTH, any_sensor=True, aligned=True
    )
    stream.set_mode(mode)
    out_distance, out_intensity = stream.image(distance, intensity)
    np.testing.assert_array_equal(out_distance[::2], distance, "the sensor's rows leave as they came")
    np.testing.assert_array_equal(out_intensity[::2], intensity)
    made, grey = ladder_rows(mode, distance, intensity, rules)
    np.testing.assert_array_equal(out_distance[1:63:2], made)
    np.testing.assert_array_equal(out_intensity[1:63:2], grey)
    assert not out_distance[63].any(), "row 63 is empty in these models"
    assert mode == "pass_through" or np.count_nonzero(made) > 100


def test_a_mode_holds_from_the_next_finished_column_on(rng: np.random.Generator) -> None:
    """Columns depend on their own mode only: of a run with changes each is that of a run without."""
    rules = ubm.read_ubm(file()).rules
    distance, intensity = (np.ascontiguousarray(x.T) for x in random_image(rules, rng))

    def run(modes: list[str]) -> Any:
        stream = _native.Stream(_native.Model(file()), precision="int16", columns=WIDTH, any_sensor=True, aligned=True)
        parts = []
        for column, mode in enumerate(modes):
            stream.set_mode(mode)
            parts.append(stream.push(distance[column : column + 1], intensity[column : column + 1], column)[0])
        return np.concatenate([*parts, stream.flush()[0]])

    plain = {mode: run([mode] * WIDTH) for mode in LADDER}
    chosen = [LADDER[i] for i in rng.integers(0, 4, WIDTH)]
    mixed = run(chosen)
    made_by = [*chosen[1:], chosen[-1]]  # a column is finished when the one to its right is pushed, the last by the end
    for column, mode in enumerate(made_by):
        np.testing.assert_array_equal(mixed[column], plain[mode][column])


def test_an_unknown_mode_is_refused() -> None:
    stream = _native.Stream(_native.Model(file()))
    with pytest.raises(_native.NativeError, match="nonsense"):
        stream.set_mode("nonsense")
