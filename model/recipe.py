"""Training recipes: one YAML file says everything that decides the weights."""

from __future__ import annotations

from dataclasses import dataclass, fields
from importlib import resources
from pathlib import Path
from typing import Any, Literal, TypeVar

import yaml

from .beams import beam_table
from .rules import Rules

__all__ = ["Loss", "NetworkRecipe", "Recipe", "RecipeError", "TrainingRecipe", "load_recipe", "recipe_names"]


class RecipeError(ValueError):
    """A recipe that cannot be followed: names the file, the key and what was expected."""


@dataclass(frozen=True)
class Loss:
    kind: Literal["robust", "l1"]
    knee_m: float = 2.0
    """Of ``robust``: e^2 / (1 + e^2 / knee^2) grows like a square below it and saturates above."""


@dataclass(frozen=True)
class NetworkRecipe:
    widths: tuple[int, int, int]
    slope: float
    inputs: Literal["raw", "difference"]
    output: Literal["raw", "residual"]
    scale: float


@dataclass(frozen=True)
class TrainingRecipe:
    steps: int
    batch: int
    learning_rate: float
    mirror: bool
    distance_loss: Loss
    intensity_loss: Loss


@dataclass(frozen=True)
class DataRecipe:
    source: Literal["simulator", "kitti"]
    frames: int
    seed: int = 0
    frames_per_scene: int = 1
    folder: str = ""
    """Of ``kitti``: a folder of .bin files; weights trained so may not be used commercially."""


@dataclass(frozen=True)
class Recipe:
    name: str
    seed: int
    beams: str
    columns: int
    rules: dict[str, Any]
    data: tuple[DataRecipe, ...]
    windows: int
    networks: dict[str, NetworkRecipe]
    training: TrainingRecipe

    def make_rules(self) -> Rules:
        """Rules of a model whose columns are azimuth aligned, as recordings are."""
        return Rules.for_beams(beam_table(self.beams).aligned(), columns=self.columns, **self.rules)


def recipe_names() -> list[str]:
    folder = resources.files(__package__).joinpath("recipes")
    return sorted(p.name.removesuffix(".yaml") for p in folder.iterdir() if p.name.endswith(".yaml"))


def load_recipe(name: str | Path) -> Recipe:
    """A shipped recipe by name, or a YAML file."""
    path = Path(name)
    if path.suffix in {".yaml", ".yml"}:
        try:
            text = path.read_text(encoding="utf-8")
        except OSError as error:
            raise RecipeError(f"recipe {path}: {error.strerror}") from None
    elif str(name) in recipe_names():
        text = resources.files(__package__).joinpath("recipes").joinpath(f"{name}.yaml").read_text(encoding="utf-8")
    else:
        raise RecipeError(f"no recipe {str(name)!r}; known: {', '.join(recipe_names())}, or a .yaml file")
    try:
        raw = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise RecipeError(f"recipe {name}: not YAML: {' '.join(str(error).split())}") from None
    recipe = _recipe(raw, f"recipe {name}")
    try:
        recipe.make_rules()
    except (TypeError, ValueError) as error:
        raise RecipeError(f"recipe {name}: {error}") from None
    return recipe


def _recipe(raw: Any, where: str) -> Recipe:
    top = _mapping(raw, where)
    networks = _mapping(top.get("networks"), f"{where}: networks")
    training = dict(_mapping(top.get("training"), f"{where}: training"))
    if set(networks) != {"distance", "intensity"}:
        raise RecipeError(
            f"{where}: networks must be distance and intensity, got {', '.join(map(str, networks)) or 'none'}"
        )
    for key in ("distance_loss", "intensity_loss"):
        training[key] = _build(Loss, training.get(key), f"{where}: training.{key}")
    data = top.get("data")
    if not isinstance(data, list) or not data:
        raise RecipeError(f"{where}: data must be a list of sources")
    parts = {
        "networks": {k: _network(v, f"{where}: networks.{k}") for k, v in networks.items()},
        "training": _build(TrainingRecipe, training, f"{where}: training"),
        "data": tuple(_build(DataRecipe, d, f"{where}: data[{k}]") for k, d in enumerate(data)),
    }
    recipe = _build(Recipe, {**top, **parts}, where)
    _positive(recipe, where)
    return recipe


def _network(raw: Any, where: str) -> NetworkRecipe:
    network = _build(NetworkRecipe, raw, where)
    widths = tuple(network.widths)
    if len(widths) != 3 or not all(isinstance(w, int) and 1 <= w <= 64 for w in widths):
        raise RecipeError(
            f"{where}.widths must be three whole numbers of 1 to 64 (conv1, conv2, hidden), got {list(widths)}"
        )
    return NetworkRecipe(widths, network.slope, network.inputs, network.output, network.scale)


def _positive(recipe: Recipe, where: str) -> None:
    checks = {
        "windows": recipe.windows,
        "training.steps": recipe.training.steps,
        "training.batch": recipe.training.batch,
        "training.learning_rate": recipe.training.learning_rate,
        **{f"data[{k}].frames": d.frames for k, d in enumerate(recipe.data)},
    }
    for key, value in checks.items():
        if not isinstance(value, int | float) or not value > 0:
            raise RecipeError(f"{where}: {key} is {value!r}, expected a number above 0")


T = TypeVar("T")


def _build(kind: type[T], raw: Any, where: str) -> T:
    values = _mapping(raw, where)
    known = {f.name for f in fields(kind)}  # type: ignore[arg-type]
    surplus = sorted(set(map(str, values)) - known)
    if surplus:
        raise RecipeError(f"{where}: unknown key {', '.join(surplus)}; known: {', '.join(sorted(known))}")
    try:
        return kind(**values)
    except TypeError as error:
        raise RecipeError(f"{where}: {error}") from None


def _mapping(raw: Any, where: str) -> dict[str, Any]:
    if not isinstance(raw, dict):
        raise RecipeError(f"{where}: expected a mapping of keys, got {type(raw).__name__}")
    return raw
