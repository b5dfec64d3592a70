"""Recipes: the shipped ones load, wrong ones are refused by key."""

from __future__ import annotations

from dataclasses import replace
from importlib import resources

import numpy as np
import pytest
import yaml
from scipy.spatial import cKDTree

from upbeam.cli.common import UserError
from upbeam.cli.sources import recipe_frames, simulated_scans, source_frames
from upbeam.model.beams import beam_table
from upbeam.model.geometry import to_points
from upbeam.model.recipe import (
    DataRecipe,
    Recipe,
    RecipeError,
    UNetRecipe,
    load_any_recipe,
    load_recipe,
    recipe_names,
    with_length,
    with_simulated_data,
)


@pytest.mark.parametrize("name", recipe_names())
def test_shipped_recipes_load(name):
    recipe = load_any_recipe(name)
    assert recipe.name == name
    assert recipe.make_rules().columns == recipe.columns


def test_shipped_weights_use_no_restricted_data():
    assert {source.source for source in load_recipe("default").data} == {"simulator"}


def raw():
    return yaml.safe_load(resources.files("upbeam.model").joinpath("recipes/smoke.yaml").read_text())


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (lambda r: r.pop("seed"), "seed"),
        (lambda r: r.update(epochs=3), "unknown key epochs"),
        (lambda r: r["training"].update(steps=0), "training.steps"),
        (lambda r: r["training"]["distance_loss"].update(sigma=1), "unknown key sigma"),
        (lambda r: r["networks"].pop("intensity"), "distance and intensity"),
        (lambda r: r["networks"]["distance"].update(widths=[8, 2]), "widths"),
        (lambda r: r.update(data=[]), "data"),
        (lambda r: r["rules"].update(edge="round"), "edge"),
        (lambda r: r.update(beams="hdl-128"), "hdl-128"),
        (lambda r: r["networks"]["distance"].update(widths=[[8, 2], []]), "widths"),
        (lambda r: r["networks"]["distance"].update(widths=[[8, 2], [12, 65]]), "widths"),
        (
            lambda r: r["networks"]["distance"].update(inputs="squared"),
            "inputs is 'squared', expected raw or difference",
        ),
        (lambda r: r["training"].update(learning_rate="1e-2"), "learning_rate is '1e-2', expected a number"),
        (lambda r: r["training"].update(epochs=5), "training.steps and training.epochs"),
        (lambda r: r["training"].update(steps=0, epochs={"distance": 5}), "training.epochs"),
        (lambda r: r["training"].update(batch_images=5), "training.batch"),
        (lambda r: r["training"].update(schedule="step"), "schedule"),
        (lambda r: r["training"].update(weight_decay=-1.0), "weight_decay"),
        (lambda r: r["training"]["distance_loss"].update(kind="l2"), "kind"),
        (lambda r: r["training"]["distance_loss"].update(kind="chamfer"), "batch_images"),
        (lambda r: r["training"]["intensity_loss"].update(pixels="all"), "batch_images"),
        (lambda r: r["training"]["distance_loss"].update(power=0), "distance_loss.power"),
        (lambda r: r["data"][0].update(source="carla"), "source is 'carla'"),
        (lambda r: r["data"][0].update(frames=0), "frames"),
        (lambda r: r["data"][0].update(projection="fish-eye"), "projection"),
        (lambda r: r.update(rows="elevation"), "projection: recorded"),
        (lambda r: r.update(validation=[]), "validation"),
        (lambda r: r["training"].update(validate_every=0), "training.validate_every is 0"),
        (lambda r: r.update(data=[{"source": "capture"}]), r"data\[0\].path names no capture"),
        (lambda r: r.update(data=[{"source": "capture", "path": "a", "hide": "none"}]), "every-other or three-of-four"),
        (lambda r: r.update(data=[{"source": "capture", "path": "a", "may_ship": True}]), "licence"),
        (lambda r: r.update(rows="elevation", data=[{"source": "capture", "path": "a"}]), "KITTI's binning"),
        (lambda r: r["data"][0].update(path="a.pcap"), r"data\[0\].path is of source: capture"),
        (lambda r: r.update(unet={"width": 0, "steps": 5}), "unknown key"),
    ],
)
def test_wrong_recipes_are_refused(tmp_path, change, named):
    recipe = raw()
    change(recipe)
    path = tmp_path / "recipe.yaml"
    path.write_text(yaml.safe_dump(recipe))
    with pytest.raises(RecipeError, match=named):
        load_recipe(path)


def test_files_that_are_no_recipe(tmp_path):
    path = tmp_path / "recipe.yaml"
    for text, named in (("- a", "mapping"), ("{", "not YAML")):
        path.write_text(text)
        with pytest.raises(RecipeError, match=named):
            load_recipe(path)
    with pytest.raises(RecipeError, match="No such file"):
        load_recipe(tmp_path / "absent.yaml")


def test_the_paper_recipe_is_the_papers():
    recipe = load_recipe("paper")
    rules, training = recipe.make_rules(), recipe.training
    assert (rules.edge, rules.empty, rules.last_row, rules.columns) == ("zero", "none", "repeat", 2048)
    assert (rules.min_m, rules.max_m) == (3.0, 80.0)
    assert (training.learning_rate, training.weight_decay, training.batch_images) == (1e-2, 1e-5, 100)
    assert (training.epochs, training.schedule, training.patience) == (
        {"distance": 200, "intensity": 100},
        "plateau",
        10,
    )
    assert (training.distance_loss.kind, training.intensity_loss.kind) == ("chamfer", "l1")
    for network in recipe.networks.values():
        assert network.widths == ((8, 2), (12,))
        assert (network.slope, network.inputs, network.output, network.scale) == (0.01, "raw", "raw", 1.0)


def test_recipes_of_a_u_net(tmp_path):
    recipe = load_any_recipe("shan-small")
    assert isinstance(recipe, UNetRecipe)
    assert {s.only_drives for s in recipe.validation} == {s.without_drives for s in recipe.data} == {("drive-a",)}
    with pytest.raises(RecipeError, match="trains a U-Net"):
        load_recipe("shan-small")
    text = resources.files("upbeam.model").joinpath("recipes/shan-small.yaml").read_text()
    for change, named in (("width: 0.125", "width: 9"), ("steps: 5000", "steps: 0")):
        (tmp_path / "u.yaml").write_text(text.replace(change, named))
        with pytest.raises(RecipeError, match=f"unet.{named.partition(':')[0]} is"):
            load_any_recipe(tmp_path / "u.yaml")


def test_the_paper_s_network_on_rings_is_the_same_recipe():
    ring, small = load_recipe("paper-ring"), load_recipe("paper-small")
    assert replace(ring, name=small.name, rows="elevation") == small
    assert ring.make_rules().sensor == "hdl-64e/2"


def test_other_lengths():
    """Epochs in proportion; what a recipe does not count in is refused."""
    paper = with_length(load_recipe("paper-small"), epochs=10)
    assert isinstance(paper, Recipe)
    assert paper.training.epochs == {"distance": 10, "intensity": 2}
    steps = with_length(load_recipe("default"), steps=7)
    assert isinstance(steps, Recipe)
    assert steps.training.steps == 7
    unet = with_length(load_any_recipe("shan-small"), steps=3)
    assert isinstance(unet, UNetRecipe)
    assert unet.unet.steps == 3
    assert with_length(load_recipe("default")) == load_recipe("default")
    for name, length in (("default", {"epochs": 3}), ("paper-small", {"steps": 3}), ("shan-small", {"epochs": 3})):
        with pytest.raises(RecipeError, match=f"recipe {name} counts"):
            with_length(load_any_recipe(name), **length)


@pytest.mark.parametrize("name", ["paper-small", "shan-small"])
def test_any_recipe_on_simulated_frames(name):
    recipe = with_simulated_data(load_any_recipe(name), 4)
    assert [s.frames for s in (*recipe.data, *recipe.validation)] == [4, 2]
    assert recipe.data[0].seed != recipe.validation[0].seed
    (frame,) = recipe_frames(recipe, recipe.make_rules(), (replace(recipe.data[0], frames=1),))
    assert frame.distance.shape == (64, 2048)


def test_elevation_rows_have_their_own_beams():
    """Bins of 26.9 / 64 degrees from 2.0 down, heights of 0: no laser of the sensor."""
    rules = load_recipe("paper").make_rules()
    assert rules.row_elevation_deg[0] == pytest.approx(2.0 - 26.9 / 128)
    assert rules.row_elevation_deg[-1] == pytest.approx(-24.9 + 26.9 / 128)
    assert not rules.row_height_m.any()


def test_ablations_change_the_graph_alone():
    base = load_recipe("paper-small")
    widths = {
        "paper-4-filters": ((4, 2), (12,)),
        "paper-10-8-6": ((10, 8, 6), (12,)),
        "paper-second-hidden": ((8, 2), (12, 6)),
    }
    for name, expected in widths.items():
        recipe = load_recipe(name)
        assert (recipe.training, recipe.data, recipe.validation) == (base.training, base.data, base.validation)
        for network, original in zip(recipe.networks.values(), base.networks.values(), strict=True):
            assert network == replace(original, widths=expected)
        assert recipe.networks["distance"].exportable == (name != "paper-second-hidden")


def drives(folder, names, listed):
    for name in names:
        (folder / f"{name}.bin").write_bytes(b"")
    (folder / "drives.tsv").write_text("frame\tdrive\n" + "".join(f"{f}\t{d}\n" for f, d in listed.items()))
    return str(folder)


def test_frames_are_split_by_drive(tmp_path):
    folder = drives(tmp_path, "abcde", {"b": "drive-a", "d": "drive-a", "e": "drive-b"})
    count = lambda **limits: source_frames(DataRecipe("kitti", folder=folder, **limits))  # noqa: E731
    assert count() == 5
    assert count(frames=2) == 2
    assert count(only_drives=("drive-a",)) == 2
    assert count(without_drives=("drive-a",)) == 3
    assert count(without_drives=("drive-a", "drive-b")) == 2
    with pytest.raises(UserError, match="drive-z"):
        count(without_drives=("drive-z",))


def test_frames_without_a_folder(tmp_path, monkeypatch):
    monkeypatch.delenv("UPBEAM_DATA", raising=False)
    with pytest.raises(UserError, match="UPBEAM_DATA"):
        source_frames(DataRecipe("kitti"))
    (tmp_path / "kitti" / "frames").mkdir(parents=True)
    drives(tmp_path / "kitti" / "frames", "ab", {"a": "drive-a"})
    monkeypatch.setenv("UPBEAM_DATA", str(tmp_path))
    assert source_frames(DataRecipe("kitti")) == 2


@pytest.mark.parametrize("rows", ["ring", "elevation"])
def test_simulated_frames_projected_as_recordings(rows):
    """Aligned casting gives every laser every column; points of firings collide and leave gaps, as recordings do."""
    recipe = replace(load_recipe("smoke"), rows=rows)
    rules = recipe.make_rules()
    source = replace(recipe.data[0], frames=1, projection="recorded")
    (frame,) = recipe_frames(recipe, rules, (source,))
    scan = next(
        iter(
            simulated_scans(
                beam_table("hdl-64e"), columns=2083, frames=1, seed=5, rate_hz=10.0, frames_per_scene=1, align=False
            )
        )
    )
    assert frame.distance.shape == (64, 2048)
    assert np.array_equal(frame.elevation_deg, rules.row_elevation_deg)
    assert np.array_equal(frame.row_height_m, rules.row_height_m)
    assert np.array_equal(frame.surface > 0, frame.distance > 0)
    # Put back into space, every pixel is one of the scan's points but for the pixel's width and height.
    geometry = frame.elevation_deg, frame.distance_unit_m, frame.cut_deg, frame.row_height_m
    made = to_points(frame.distance, frame.intensity, *geometry)[0][:, :3]
    gap, _ = cKDTree(scan.points()[:, :3]).query(made)
    # 1.7 mrad half a column, and 4.5 cm from a laser's sideways place to the axis; 3.7 mrad half an elevation bin
    allowed = (0.002 if rows == "ring" else 0.0045) * np.linalg.norm(made, axis=1) + 0.06
    assert np.mean(gap <= allowed) > 0.999
