"""Errors against float: what is counted, where, and the goals on real frames."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import upbeam
from upbeam.cli.frames import model_frames
from upbeam.model.baselines import BASELINES
from upbeam.model.frames import kitti_frames
from upbeam.quant.accuracy import FLOAT, Variant, compare, float_variant, integer_variant
from upbeam.quant.quantize import calibration_windows, quantize
from upbeam.quant.schemes import narrow_variant


@pytest.fixture(scope="module")
def file():
    return upbeam.load_model().file


@pytest.fixture(scope="module")
def frames(file):
    return model_frames("sim", file, limit=2, seed=40, simulated=2, what="frames", quiet=True).frames


@pytest.fixture(scope="module")
def calibration(file):
    found = model_frames("sim", file, limit=9, seed=500, simulated=9, what="frames", quiet=True)
    return calibration_windows(found.frames, file.rules)


def moved(variant, counts):
    return Variant(lambda windows: variant.distance(windows) + counts, variant.intensity)


def test_float_against_itself_has_no_error(file, frames):
    same = float_variant(file.folded, file.rules.distance_unit_m)
    result = compare(file, frames, {"same": same})
    summary = result.summaries()["same"]
    assert (summary.mean_mm, summary.max_mm, summary.added, summary.removed) == (0, 0, 0, 0)
    assert (summary.moved_share, summary.coarse_share, summary.intensity_max) == (0, 0, 0)
    assert summary.points > 50_000
    assert result.ghosts["same"].added == result.ghosts["same"].removed == 0
    means = result.evaluation.means()
    assert means["same"] == means[FLOAT]


@pytest.mark.parametrize(("counts", "share"), [(50, 0.0), (-51, 1.0), (400, 1.0)])
def test_a_known_shift_is_found_in_millimetres(file, frames, counts, share):
    """A count is 2 mm: 50 of them are 10 cm, 51 are more."""
    exact = float_variant(file.folded, file.rules.distance_unit_m)
    summary = compare(file, frames, {"moved": moved(exact, counts)}, truth=False).summaries()["moved"]
    for value in (summary.mean_mm, summary.p99_mm, summary.p999_mm, summary.max_mm):
        assert value == pytest.approx(2 * abs(counts))
    assert summary.moved_share == share


def test_points_beyond_the_limits_are_flips_not_errors(file, frames):
    exact = float_variant(file.folded, file.rules.distance_unit_m)
    away = moved(exact, 70_000)
    summary = compare(file, frames, {"away": away}, truth=False).summaries()["away"]
    kept = compare(file, frames, {"same": exact}, truth=False).summaries()["same"]
    assert (summary.points, summary.added, summary.removed) == (0, 0, kept.points)
    assert np.isnan(summary.mean_mm)


def test_intensity_is_judged_where_both_generate(file, frames):
    exact = float_variant(file.folded, file.rules.distance_unit_m)
    brighter = Variant(exact.distance, lambda windows: np.minimum(exact.intensity(windows) + 3, 300))
    summary = compare(file, frames, {"brighter": brighter}, truth=False).summaries()["brighter"]
    assert 2.5 < summary.intensity_mean <= 3
    assert summary.intensity_max == 3


def test_bands_part_the_points(file, frames, calibration):
    made = quantize(file, calibration, ["int8"], "nearest")
    errors = compare(file, frames, {"int8": integer_variant(made.int8)}, truth=False).errors["int8"]
    bands, whole = errors.by_band(), errors.summary()
    assert sum(band.points for band in bands.values()) == whole.points
    assert sum(band.removed for band in bands.values()) == whole.removed
    assert max(band.max_mm for band in bands.values()) == whole.max_mm
    mean = sum(band.mean_mm * band.points for band in bands.values()) / whole.points
    assert mean == pytest.approx(whole.mean_mm)


def test_coarse_and_cut_windows_follow_the_contract():
    windows = np.full((4, 6), 5000)
    windows[0, 3] += 255  # fits eight bits
    windows[1, 3] += 256  # coarse, exact all the same
    windows[2, 3] += 511  # coarse, rounds to 256 steps: cut
    windows[3, 3] += 509  # coarse, rounds to 255
    file = upbeam.load_model().file
    calibration = type("Windows", (), {"distance": windows, "intensity": windows % 256})
    made = quantize(file, calibration, ["int16", "int8"], "nearest")
    coarse, cut = integer_variant(made.int8).code(windows)
    assert coarse.tolist() == [False, True, True, True]
    assert cut.tolist() == [False, False, True, False]
    assert integer_variant(made.int16).code is None


def test_frames_of_another_count_are_refused(file, frames):
    wrong = replace(frames[0], distance_unit_m=0.004)
    with pytest.raises(ValueError, match="counts in 4 mm, the model in 2 mm"):
        compare(file, [wrong], {})
    with pytest.raises(ValueError, match="no frames"):
        compare(file, [], {})


def test_the_goals_on_real_frames(file, calibration, data_dir):
    """Calibrated on simulated frames alone. Means and ratios are printed."""
    made = quantize(file, calibration)
    variants = {
        "int16": integer_variant(made.int16),
        "int8": integer_variant(made.int8),
        "W8A16": narrow_variant(file, calibration),
    }
    recorded = kitti_frames(data_dir / "kitti" / "frames", file.rules)
    result = compare(file, recorded, variants, baselines={"valid-mean": BASELINES["valid-mean"]})
    ratios = result.evaluation.ratios(FLOAT)
    limits = {  # mean mm, share of the points that may be farther off than mm, ratio to float
        "int16": (4.0, 100.0, 20.0, 1.002),
        "int8": (15.0, 99.9, 250.0, 1.01),
        "W8A16": (4.0, 99.9, 250.0, 1.002),
    }
    for name, (mean, share, most, ratio) in limits.items():
        errors = result.errors[name]
        summary = errors.summary()
        off = np.percentile(np.abs(errors.error_counts[errors.both]) * 1000 * errors.unit_m, share)
        chamfer, mae = (ratios[name][key].value for key in ("chamfer_m2", "mae_m"))
        print(f"{name}: mean {summary.mean_mm:.2f} mm, max {summary.max_mm:.0f}, Chamfer {chamfer:.4f}, MAE {mae:.4f}")
        assert summary.mean_mm <= mean
        assert off <= most
        assert chamfer <= ratio
        assert mae <= ratio
    assert result.summaries()["int8"].coarse_share > 0.1
