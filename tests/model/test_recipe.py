"""Recipes: the shipped ones load, wrong ones are refused by key."""

from __future__ import annotations

from importlib import resources

import pytest
import yaml

from upbeam.model.recipe import RecipeError, load_recipe, recipe_names


@pytest.mark.parametrize("name", recipe_names())
def test_shipped_recipes_load(name):
    recipe = load_recipe(name)
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
