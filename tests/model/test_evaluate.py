"""Methods beside each other: intervals, order, units, TULIP's protocol, what the command prints."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.distance import cdist
from typer.testing import CliRunner

from upbeam.cli.evaluate import evaluation_dict, model_method
from upbeam.cli.main import app
from upbeam.model.baselines import nearest, valid_mean, window_mean
from upbeam.model.beams import uniform_beam_table
from upbeam.model.evaluate import evaluate, in_unit, paired_ratio, rules_for, with_limits
from upbeam.model.frames import Frame
from upbeam.model.rules import Rules
from upbeam.model.tulip import ELEVATION_DEG, GIVEN, evaluate_tulip, tulip_frames, tulip_rows, tulip_rules, upsample_4x
from upbeam.runtime.upsampler import Upsampler, load_model

RULES = Rules.for_beams(uniform_beam_table(64, 2.0, -24.0), columns=64)
METHODS = {"nearest": nearest, "valid-mean": valid_mean, "window-mean": window_mean}


def street(rng, name, rows=16, columns=64, surface=None):
    """Ground below a wall whose distance wanders, with holes."""
    elevation = np.linspace(2, -20, rows)
    ground = np.where(elevation < -1, 1.7 / np.maximum(0.01, -np.sin(np.radians(elevation))), 1000)
    wall = 15 + 5 * np.sin(np.arange(columns) / 5 + rng.random() * 6)
    metres = np.minimum(ground[:, None], wall[None]) + rng.normal(0, 0.02, (rows, columns))
    counts = np.where(rng.random(metres.shape) < 0.1, 0, metres / 0.002).astype(np.uint16)
    labels = None if surface is None else np.full(counts.shape, surface, np.uint8)
    return Frame(
        name,
        counts,
        rng.integers(0, 99, counts.shape).astype(np.uint8),
        0.002,
        elevation,
        np.zeros(rows),
        180.0,
        labels,
    )


@pytest.fixture
def frames(rng):
    return [street(rng, f"{k:02d}") for k in range(6)]


def test_means_and_ratios(frames):
    result = evaluate(frames, METHODS, RULES, full=True)
    assert result.frames == [f"{k:02d}" for k in range(6)]
    means, ratios = result.means(), result.ratios()
    for name in METHODS:
        for key in ("chamfer_m2", "mae_m", "cloud_chamfer_m2", "voxel_iou"):
            assert ratios[name][key].value == pytest.approx(means[name][key] / means["valid-mean"][key])
            assert ratios[name][key].low <= ratios[name][key].value <= ratios[name][key].high
    same = ratios["valid-mean"]["mae_m"]
    assert (same.value, same.low, same.high) == (1, 1, 1)


def test_neither_the_order_of_methods_nor_of_frames_matters(frames):
    first = evaluate(frames, METHODS, RULES)
    methods_turned = evaluate(frames, dict(reversed(METHODS.items())), RULES)
    frames_turned = evaluate(frames[::-1], METHODS, RULES)
    for name in METHODS:
        assert methods_turned.per_frame[name] == first.per_frame[name]
        assert frames_turned.per_frame[name] == first.per_frame[name][::-1]
    assert methods_turned.ratios() == first.ratios()
    assert frames_turned.ratios() == first.ratios()


def test_paired_intervals(rng):
    base = rng.uniform(0.1, 3.0, 60)
    values = base * rng.normal(0.8, 0.01, 60)
    interval = paired_ratio(values, base)
    assert interval == paired_ratio(values, base)
    assert interval != paired_ratio(values, base, seed=1)
    assert interval.low <= 0.8 <= interval.high or abs(interval.value - 0.8) < 0.01
    # Pairing: frames differ thirtyfold, their ratio by 1 %.
    assert interval.half_width < 0.01
    unpaired = paired_ratio(rng.permutation(values), base)
    assert unpaired.half_width > 5 * interval.half_width


def test_intervals_hold_the_truth_about_as_often_as_they_say(rng):
    held = 0
    for _ in range(200):
        base = rng.gamma(3, 1.0, 40)
        values = base * 0.75 + rng.normal(0, 0.2, 40)
        interval = paired_ratio(values, base, resamples=400)
        held += interval.low <= 0.75 <= interval.high
    assert 170 <= held <= 200


def test_what_has_no_interval():
    one = paired_ratio(np.array([1.0]), np.array([2.0]))
    assert (one.value, one.low, one.high, one.half_width) == (0.5, None, None, None)
    assert np.isnan(paired_ratio(np.array([1.0, 2.0]), np.zeros(2)).value)
    assert paired_ratio(np.array([1.0, np.nan, 3.0]), np.array([2.0, 5.0, 6.0])).value == pytest.approx(0.5)


def test_limits_follow_the_frame_s_unit(rng):
    frame = street(rng, "4 mm")
    coarse = replace(frame, distance=frame.distance // 2, distance_unit_m=0.004)
    limits = rules_for(coarse, RULES)
    assert (limits.min_count, limits.max_count) == (750, 20_000)
    assert rules_for(frame, RULES) is RULES
    result = evaluate([coarse], METHODS, RULES)
    assert result.means()["valid-mean"]["mae_m"] < 2


def test_parts_of_some_frames_only(rng):
    """A label that only the second frame has, seen by every method."""
    frames = [street(rng, "a", surface=1), street(rng, "b", surface=2), street(rng, "c", surface=1)]
    result = evaluate(frames, METHODS, RULES, parts=True, surfaces={1: "ground"})
    assert [m is None for m in result.parts["ground"]["nearest"]] == [False, True, False]
    assert [m is None for m in result.parts["surface 2"]["nearest"]] == [True, False, True]
    mean = result.part_means()["surface 2"]["nearest"]
    assert mean["mae_m"] == pytest.approx(result.per_frame["nearest"][1].mae_m)


def test_errors_name_frame_and_method(frames):
    def nothing(distance, intensity, rules):
        return np.zeros_like(distance[1:]), np.zeros_like(intensity[1:])

    with pytest.raises(ValueError, match=r"lazy: .*frame 00"):
        evaluate(frames, {"lazy": nothing}, RULES)
    with pytest.raises(ValueError, match="no frames"):
        evaluate([], METHODS, RULES)


def test_json_says_null_where_a_figure_is_not_defined(frames):
    model = load_model()
    data = evaluation_dict(evaluate(frames[:1], METHODS, RULES, parts=True), model)
    text = json.loads(json.dumps(data, allow_nan=False))
    assert text["parts"]["40-80 m"]["nearest"]["mae_m"] is None
    assert text["ratio"]["nearest"]["mae_m"]["low"] is None


# ---------------------------------------------------------------------------------------------------------- models


def test_the_model_s_method_in_c_and_by_the_reference(rng):
    """32 rows under the model's own limits run in C; a limit that no pixel meets, one count off, calls the reference:
    the same to a count."""
    model = load_model()
    method, rules = model_method(model), model.rules
    distance = rng.integers(2000, 30_000, (32, 128)).astype(np.uint16)
    grey = rng.integers(0, 256, distance.shape).astype(np.uint8)
    in_c = method(distance, grey, rules)
    assert np.array_equal(in_c[0], Upsampler(model, columns=128)(distance, grey)[0][1:-1:2])
    reference = method(distance, grey, with_limits(rules, rules.min_count, rules.max_count + 1))
    for a, b in zip(in_c, reference, strict=True):
        assert a.shape == b.shape == (31, 128)
        assert np.mean(np.abs(a.astype(int) - b) <= 1) > 0.999  # at a limit, rounding decides whether there is a point
    assert method(distance[:20], grey[:20], rules)[0].shape == (19, 128)


def test_other_limits_keep_the_rows_own(rng):
    limits = np.clip(np.arange(64) * 1000, RULES.min_count, RULES.max_count)
    rules = replace(RULES, row_max_count=limits)
    wide = with_limits(rules, 1000, 60_000)
    assert np.array_equal(wide.row_max_count[:40], limits[:40])
    assert np.all(wide.row_max_count[limits == RULES.max_count] == 60_000)
    coarse = in_unit(rules, 0.004)
    assert np.all(np.abs(coarse.row_max_count * 2 - limits) <= 1)


def test_the_model_s_method_keeps_metres_in_another_unit(rng):
    model = load_model()
    method = model_method(model)
    fine = (rng.integers(1000, 15_000, (20, 64)) * 2).astype(np.uint16)
    grey = np.zeros(fine.shape, np.uint8)
    a = method(fine, grey, model.rules)[0] * 0.002
    b = method(fine // 2, grey, in_unit(model.rules, 0.004))[0] * 0.004
    both = (a > 0) & (b > 0)
    assert both.mean() > 0.99
    assert np.max(np.abs(a - b)[both]) <= 0.0045


# ----------------------------------------------------------------------------------------------------------- TULIP


def test_tulip_rows():
    """Row 0 of the protocol points 24.8 degrees down, row 63 two degrees up; ours count from the top."""
    for row in (0, 3, 40, 63):
        el = np.radians(ELEVATION_DEG[row])
        points = np.array([[9 * np.cos(el), 0, 9 * np.sin(el)]])
        assert tulip_rows(points) == [row]
    assert ELEVATION_DEG[0] == pytest.approx(2.0)
    assert ELEVATION_DEG[63] == pytest.approx(-24.8)
    assert tulip_rows(np.array([[1.0, 0, 1.0], [1.0, 0, -1.0]])).tolist() == [-1, -1]
    # Counted from the bottom: 0, 4, ..., 60.
    assert (63 - np.arange(64)[GIVEN])[::-1].tolist() == list(range(0, 64, 4))


def test_upsampling_four_times_keeps_what_was_given(rng):
    distance = rng.integers(2000, 30_000, (16, 32)).astype(np.uint16)
    grey = rng.integers(0, 256, distance.shape).astype(np.uint8)
    d, i = upsample_4x(valid_mean, distance, grey, RULES)
    assert d.shape == i.shape == (64, 32)
    assert np.array_equal(d[GIVEN], distance)
    assert np.array_equal(i[GIVEN], grey)
    assert np.array_equal(d[:3], np.repeat(distance[:1], 3, axis=0))
    # Row 5 from the top is the mean of given rows 3 and 7, row 4 that of 3 and 5.
    middle = (distance[0].astype(float) + distance[1]) / 2
    assert np.abs(d[5] - middle).max() <= 0.5
    assert np.abs(d[4] - (distance[0] + middle) / 2).max() <= 1


def test_tulip_metrics_against_brute_force(rng):
    counts = rng.integers(1500, 30_000, (64, 8)).astype(np.uint16)
    counts[rng.random(counts.shape) < 0.3] = 0
    frame = Frame("f", counts, np.zeros(counts.shape, np.uint8), 0.002, ELEVATION_DEG, np.zeros(64))
    rules = tulip_rules(RULES)
    assert (rules.min_count, rules.max_count) == (1000, 40_000)
    (found,) = evaluate_tulip([frame], {"valid-mean": valid_mean}, rules)["valid-mean"]
    made, _ = upsample_4x(valid_mean, counts[GIVEN], frame.intensity[GIVEN], rules)
    assert found.mae_all_m == pytest.approx(np.abs(made.astype(float) - counts).mean() * 0.002)
    el, az = np.radians(ELEVATION_DEG)[:, None], np.radians(180 + (np.arange(8) + 0.5) * 45)[None]
    unit = np.stack([np.cos(el) * np.cos(az), -np.cos(el) * np.sin(az), np.sin(el) + 0 * az], -1)
    p, q = ((unit * x[..., None] * 0.002).reshape(-1, 3) for x in (made, counts))
    squares = cdist(p, q) ** 2
    assert found.chamfer_origin_m2 == pytest.approx(squares.min(0).mean() + squares.min(1).mean(), rel=1e-5)
    corner = np.minimum(p.min(0), q.min(0))
    sets = [{tuple(v) for v in np.floor((x - corner) / 0.1).astype(int)} for x in (p, q)]
    assert found.voxel_iou == pytest.approx(len(sets[0] & sets[1]) / len(sets[0] | sets[1]), rel=0.02)


def test_tulip_frames_of_a_file(tmp_path, rng):
    """Points at the rows' own elevations come back row by row."""
    row, azimuth = np.meshgrid(np.arange(64), np.radians((np.arange(1024) + 0.5) * 360 / 1024), indexing="ij")
    el = np.radians(ELEVATION_DEG)[row]
    cloud = np.stack([20 * np.cos(el) * np.cos(azimuth), 20 * np.cos(el) * np.sin(azimuth), 20 * np.sin(el)], -1)
    np.concatenate([cloud.reshape(-1, 3), np.zeros((row.size, 1))], axis=1).astype("<f4").tofile(tmp_path / "a.bin")
    (frame,) = tulip_frames(tmp_path, RULES)
    assert frame.distance.shape == (64, 1024)
    assert set(np.unique(frame.distance)) == {10_000}


# --------------------------------------------------------------------------------------------------------- command


def run(*arguments):
    return CliRunner().invoke(app, [str(a) for a in arguments])


def test_the_command_s_json_table_and_report(tmp_path):
    model = tmp_path / "mine.ubm"
    model.write_bytes(load_model().data)
    arguments = ["evaluate", "sim", "--frames", 2, "--columns", 512, "--model", model]
    report = tmp_path / "report"
    result = run(*arguments, "--json", "--bands", "--full", "--report", report)
    assert result.exit_code == 0, result.output
    data = json.loads(result.stdout)
    assert (data["frames"], data["columns"], data["ratio_to"]) == (2, 512, "valid-mean")
    assert "mine" in data["methods"]
    assert "upbeam-fp32" not in data["methods"]
    for key in ("chamfer_m2", "mae_m", "ghost_share", "coverage", "cloud_chamfer_m2", "voxel_f1"):
        assert data["methods"]["mine"][key] >= 0
        assert set(data["ratio"]["mine"][key]) == {"value", "low", "high"}
    assert {"0-10 m", "40-80 m", "ground"} <= set(data["parts"])
    assert json.loads((report / "evaluate.json").read_text()) == data
    html = (report / "evaluate.html").read_text()
    assert html.count("data:image/png") == 5
    assert "http" not in html


def test_tables_fit_a_terminal(tmp_path):
    model = tmp_path / "a-model-with-a-long-name.ubm"
    model.write_bytes(load_model().data)
    result = run("evaluate", "sim", "--frames", 2, "--columns", 256, "--full", "--bands", "--model", model)
    assert result.exit_code == 0, result.output
    lines = result.stdout.splitlines()
    assert max(map(len, lines)) <= 80
    # No cell was broken over two lines: every row of a table begins with its method.
    assert sum(line.startswith(" a-model-with") for line in lines) == sum(line.startswith(" nearest") for line in lines)
    assert not [line for line in lines if line.strip().startswith(("±", "+-"))]


def test_wrong_usage_is_one_line(tmp_path):
    model = tmp_path / "valid-mean.ubm"
    model.write_bytes(load_model().data)
    for arguments, said in (
        (["sim", "--protocol", "other"], "expected upbeam or tulip"),
        (["sim", "--protocol", "tulip"], "KITTI .bin"),
        (["sim", "--protocol", "tulip", "--full"], "its own rows"),
        (["sim", "--model", model], "another method is called valid-mean"),
        ([tmp_path / "absent.pcap"], "absent.pcap"),
        (["sim", "--with", model], "another method is called valid-mean"),
        (["sim", "--with", tmp_path / "absent.ubm"], "absent.ubm"),
        (["sim", "--with", tmp_path / "absent.pt"], "absent.pt"),
        (["sim", "--drive", "a"], "--drive is of a folder"),
        ([tmp_path, "--drive", "a"], "no .bin frames"),
        (["sim", "--protocol", "tulip", "--drive", "a"], "no --drive"),
    ):
        result = run("evaluate", *arguments)
        assert result.exit_code != 0
        assert said in str(result.exception), (arguments, result.exception)
        assert "\n" not in str(result.exception)


def test_a_model_beside_the_shipped_one(tmp_path):
    model = tmp_path / "other.ubm"
    model.write_bytes(load_model("hdl-64e-8").data)
    data = json.loads(run("evaluate", "sim", "--frames", 1, "--columns", 256, "--with", model, "--json").stdout)
    assert {"upbeam-fp32", "other"} <= set(data["methods"])
    assert {name: m["multiply_adds_per_window"] for name, m in data["models"].items()} == {
        "upbeam-fp32": 96,
        "other": 64,
    }
    assert "monte_carlo_passes" not in data


def test_frames_of_one_drive(data_dir):
    """Ten of the 26 frames come from drive-a."""
    arguments = ["evaluate", data_dir / "kitti" / "frames", "--drive", "drive-a", "--columns", 256, "--json"]
    data = json.loads(run(*arguments).stdout)
    assert (data["frames"], data["drives"]) == (10, ["drive-a"])
    assert "drive-z" in str(run(*arguments, "--drive", "drive-z").exception)


def test_real_frames(data_dir):
    folder = data_dir / "kitti" / "frames"
    found = json.loads(run("evaluate", folder, "--frames", 2, "--json").stdout)["methods"]["valid-mean"]
    binned = json.loads(run("evaluate", folder, "--frames", 2, "--rows", "elevation", "--json").stdout)
    tulip = json.loads(run("evaluate", folder, "--frames", 2, "--protocol", "tulip", "--json").stdout)
    assert 0.05 < found["chamfer_m2"] < 0.6
    assert binned["rows"] == "elevation"
    assert 0 < tulip["methods"]["valid-mean"]["voxel_iou"] < 1
    assert tulip["frames"] == 2
