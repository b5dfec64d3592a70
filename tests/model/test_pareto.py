"""docs/make_pictures.py: the Pareto front from what ``upbeam evaluate --json`` printed."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import pytest

DOCS = Path(__file__).parents[2] / "docs"


@pytest.fixture(scope="module")
def pictures():
    spec = importlib.util.spec_from_file_location("make_pictures", DOCS / "make_pictures.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules["make_pictures"] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    yield module
    del sys.modules["make_pictures"]


def evaluation(frames=26, **models):
    """As the command prints it: a ratio of 0.9 in Chamfer, 0.8 in MAE, for every method."""
    ratio = {
        key: {"value": value, "low": value - 0.1, "high": value + 0.1}
        for key, value in (("chamfer_m2", 0.9), ("mae_m", 0.8))
    }
    return {
        "frames": frames,
        "models": {name: {"multiply_adds_per_window": work} for name, work in models.items()},
        "ratio": dict.fromkeys(("valid-mean", "edge-aware", "bilinear", *models), ratio),
    }


def test_figures_survive_the_file(pictures, tmp_path):
    points = list(pictures.points_of(evaluation(small=32, paper=96)))
    assert [(p.method, p.multiply_adds) for p in points] == [
        ("valid-mean", 0), ("edge-aware", 0), ("small", 32), ("paper", 96),
    ]  # fmt: skip
    assert (points[2].chamfer, points[2].mae_low) == (0.9, pytest.approx(0.7))
    pictures.write_points(tmp_path / "p.csv", [*points, *pictures.points_of(evaluation(large=96))])
    read = pictures.read_points(tmp_path / "p.csv")
    assert [p.method for p in read] == ["valid-mean", "edge-aware", "small", "paper", "large"]
    assert read[2].mae_high == pytest.approx(points[2].mae_high)
    assert "upbeam evaluate" in (tmp_path / "p.csv").read_text()


def test_figures_of_other_frames_are_refused(pictures, tmp_path):
    points = [p for frames in (10, 26) for p in pictures.points_of(evaluation(frames, **{f"m{frames}": 96}))]
    with pytest.raises(SystemExit, match="different numbers of frames"):
        pictures.write_points(tmp_path / "p.csv", points)


def test_the_committed_figures_are_drawn(pictures, tmp_path):
    points = pictures.read_points(pictures.FIGURES)
    assert {"valid-mean", "edge-aware", "hidden-4", "hidden-6", "paper-ring"} <= {p.method for p in points}
    for point in points:
        assert point.chamfer_low <= point.chamfer <= point.chamfer_high
        assert point.mae_low <= point.mae <= point.mae_high
    pictures.draw_pareto(tmp_path / "pareto.png", points)
    assert (tmp_path / "pareto.png").read_bytes().startswith(b"\x89PNG")
