"""Training recipes: one YAML file says everything that decides the weights."""

from __future__ import annotations

import types
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, fields, replace
from importlib import resources
from pathlib import Path
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np
import yaml

from .beams import BeamTable, beam_table, uniform_beam_table
from .frames import RowRule, bin_elevation_deg
from .rules import ROWS, Rules

__all__ = [
    "NETWORKS",
    "AnyRecipe",
    "BaseRecipe",
    "DataRecipe",
    "Loss",
    "NetworkRecipe",
    "Recipe",
    "RecipeError",
    "TrainingRecipe",
    "UNetRecipe",
    "UNetTraining",
    "load_any_recipe",
    "load_recipe",
    "recipe_names",
    "with_length",
    "with_simulated_data",
]

NETWORKS = ("distance", "intensity")


class RecipeError(ValueError):
    """A recipe that cannot be followed: names the file, the key and what was expected."""


@dataclass(frozen=True)
class Loss:
    """Errors are in metres for distance and in 8-bit steps for intensity."""

    kind: Literal["l1", "robust", "charbonnier", "chamfer"]
    knee_m: float = 2.0
    """Of ``robust``: e^2 / (1 + e^2 / knee^2) grows like a square below it and saturates above."""
    scale_m: float = 0.1
    """Of ``charbonnier``: (e^2 + scale^2)^(power / 2) is smooth below it ..."""
    power: float = 1.0
    """... and grows with this power above."""
    pixels: Literal["returns", "all"] = "returns"
    """Of the pixelwise losses: pixels whose truth is a return, or all, an empty one being 0. ``all`` needs
    ``batch_images``."""
    search: Literal["exact", "window"] = "exact"
    """Of ``chamfer``: the nearest point of the image, or of the pixels around."""
    empty: Literal["excluded", "origin"] = "excluded"
    """Of ``chamfer``: pixels without a return make no points, or points at the sensor, as whoever projects a whole
    image back gets them. ``origin`` teaches a network without an empty-pixel rule to give small values where it sees
    nothing, which the range limits then remove."""
    search_rows: int = 2
    search_columns: int = 8


@dataclass(frozen=True)
class NetworkRecipe:
    widths: tuple[tuple[int, ...], tuple[int, ...]]
    """Filters of each pointwise convolution, units of each hidden layer. In a file: ``[[8, 2], [12]]``, or
    ``[8, 2, 12]`` for the standard layout of two convolutions and one hidden layer."""
    slope: float
    inputs: Literal["raw", "difference"]
    output: Literal["raw", "residual"]
    scale: float
    relu_in_loss: bool = False
    """The loss sees ``max(y, 0)``, as the paper trains; else y itself, so that a negative output has a gradient."""
    scale_free: bool = False
    """No biases, and the minimum is no feature. With differences in and a residual out, inputs times k then give the
    output times k, and inputs plus c the output plus c: nothing lies outside what was trained on."""

    @property
    def exportable(self) -> bool:
        """A model file holds one hidden layer; convolutions, being linear, fold into two."""
        return len(self.widths[1]) == 1


@dataclass(frozen=True)
class TrainingRecipe:
    learning_rate: float
    mirror: bool
    """Every other step sees its windows left-right reversed."""
    distance_loss: Loss
    intensity_loss: Loss
    steps: int = 0
    epochs: int | dict[str, int] = 0
    """Instead of ``steps``; ``{distance: 200, intensity: 100}`` where they differ."""
    batch: int = 0
    """Windows a step, drawn from all."""
    batch_images: int = 0
    """Instead of ``batch``: whole images a step, each once an epoch."""
    weight_decay: float = 0.0
    schedule: Literal["cosine", "plateau", "constant"] = "cosine"
    """``plateau``: the learning rate is halved after ``patience`` epochs without a better mean loss."""
    patience: int = 10
    starts: int = 1
    """Random starts: each runs its share of the steps, the one with the lowest loss goes on."""
    start_share: float = 0.125
    intensity_gain: float = 0.0
    """Spread of factors drawn for the upper row, the lower row and the target of each intensity window: lasers are not
    alike, and the simulator's are more alike than real ones. The natural logarithm's standard deviation."""
    intensity_noise: float = 0.0
    """The same for every pixel on its own."""
    validate_every: int = 1
    """Entries of the log (an epoch, or 50 steps where that is less) between two losses on the validation frames."""

    def loss(self, network: str) -> Loss:
        return self.distance_loss if network == "distance" else self.intensity_loss

    def epochs_of(self, network: str) -> int:
        return self.epochs[network] if isinstance(self.epochs, dict) else self.epochs


@dataclass(frozen=True)
class DataRecipe:
    source: Literal["simulator", "kitti", "capture"]
    frames: int = 0
    """Of ``kitti`` and ``capture``: at most so many, 0 for all."""
    seed: int = 0
    frames_per_scene: int = 1
    projection: Literal["aligned", "recorded"] = "aligned"
    """Of ``simulator``: ``aligned`` casts every laser at its column's centre; ``recorded`` fires raw columns and puts
    their points into an image as recorded frames are, so that the lasers' sideways offset moves points between
    columns, and columns collide or stay empty as they do there."""
    columns: int = 0
    """Width of the images, 0 for the recipe's."""
    firing_columns: int = 2083
    """Of ``recorded``: firings per turn, at ``rate_hz`` turns a second (2083 at 10 Hz: an HDL-64E)."""
    rate_hz: float = 10.0
    folder: str = ""
    """Of ``kitti``: a folder of .bin files, or nothing for ``kitti/frames`` in the folder UPBEAM_DATA names; weights
    trained so may not be used commercially."""
    only_drives: tuple[str, ...] = ()
    """Of ``kitti``: only frames of these drives of the folder's ``drives.tsv``."""
    without_drives: tuple[str, ...] = ()
    path: str = ""
    """Of ``capture``: a .pcap file or a ROS 2 bag's .db3, from here or from the folder UPBEAM_DATA names."""
    sensor: str = ""
    """Of ``capture``: which one, where it holds packets of several."""
    hide: Literal["every-other", "three-of-four"] = "every-other"
    """Of ``capture``: which beams are the truth. ``every-other``: half of all are given, half hidden: gaps twice the
    sensor's. ``three-of-four``: of every other beam only, so that 128 beams train what 64 rows made of 32 need."""
    licence: str = ""
    """Of ``capture``: of the recording; it stands in the model's provenance."""
    may_ship: bool = False
    """Of ``capture``: the licence allows weights trained on it to be shipped under ours. Needs ``licence``."""


@dataclass(frozen=True, kw_only=True)
class BaseRecipe:
    """Sensor, rules and frames: what every kind of training needs."""

    name: str
    seed: int
    beams: str
    """The sensor: of the simulator, and of ring rows."""
    columns: int
    rules: dict[str, Any]
    data: tuple[DataRecipe, ...]
    rows: RowRule = "ring"
    aligned: bool = True
    """Columns of the model's sensor come azimuth aligned, as recordings are; else as the lasers fire."""
    validation: tuple[DataRecipe, ...] = ()
    """Frames the result, and the loss on the way, is judged on; never trained on."""

    def simulated_beams(self) -> BeamTable:
        return beam_table(self.beams)

    def make_rules(self) -> Rules:
        """Rules of the model."""
        sensor = beam_table(self.beams).aligned() if self.aligned else beam_table(self.beams)
        beams = sensor if self.rows == "ring" else self._elevation_bins()
        return Rules.for_beams(beams, columns=self.columns, **self.rules)

    def _elevation_bins(self) -> BeamTable:
        """The paper's rows as if each were a beam in the middle of its bin."""
        unit = beam_table(self.beams).distance_unit_m
        table = uniform_beam_table(ROWS, 2.0, -24.9, columns=self.columns, distance_unit_m=unit)
        return replace(table, name=f"elevation-{ROWS}", elevation_deg=np.asarray(bin_elevation_deg()))


@dataclass(frozen=True, kw_only=True)
class Recipe(BaseRecipe):
    """Of the two window networks."""

    networks: dict[str, NetworkRecipe]
    training: TrainingRecipe
    windows: int = 0
    """Windows drawn from all frames, for both networks, where ``training.batch`` counts windows."""


@dataclass(frozen=True)
class UNetTraining:
    """Of Shan's U-Net (``shan.train_shan``)."""

    width: float
    """Its filters as a share of the published ones."""
    steps: int
    batch: int = 4
    """Crops a step."""
    crop_columns: int = 256
    learning_rate: float = 0.001
    """Adam's, with cosine decay to 0."""


@dataclass(frozen=True, kw_only=True)
class UNetRecipe(BaseRecipe):
    """Of the U-Net of Shan et al. 2020: a baseline, never a model to ship."""

    unet: UNetTraining


AnyRecipe = Recipe | UNetRecipe


def recipe_names() -> list[str]:
    folder = resources.files(__package__).joinpath("recipes")
    return sorted(p.name.removesuffix(".yaml") for p in folder.iterdir() if p.name.endswith(".yaml"))


def load_recipe(name: str | Path) -> Recipe:
    """A shipped recipe of window networks by name, or a YAML file. Raises RecipeError."""
    recipe = load_any_recipe(name)
    if not isinstance(recipe, Recipe):
        raise RecipeError(f"recipe {name}: trains a U-Net, not the two window networks")
    return recipe


def load_any_recipe(name: str | Path) -> AnyRecipe:
    """A shipped recipe by name, or a YAML file: of the window networks, or (key ``unet``) of Shan's U-Net. Raises
    RecipeError."""
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


def with_simulated_data(recipe: R, frames: int) -> R:
    """The recipe on ``frames`` simulated frames, validated on half as many others, whatever its own data is: for who
    has no recordings."""
    projection: Literal["aligned", "recorded"] = "recorded" if recipe.rows == "elevation" else "aligned"
    source = DataRecipe("simulator", frames=frames, seed=5000, projection=projection)
    return replace(recipe, data=(source,), validation=(replace(source, frames=max(1, frames // 2), seed=6000),))


def with_length(recipe: AnyRecipe, *, epochs: int | None = None, steps: int | None = None) -> AnyRecipe:
    """The recipe with other ``epochs`` (of the distance network; the intensity network's change in proportion, to at
    least 1) or ``steps``. Raises RecipeError where it does not count in these."""
    if isinstance(recipe, UNetRecipe):
        counts, own_steps = False, recipe.unet.steps
    else:
        counts, own_steps = recipe.training.epochs_of("distance") > 0, recipe.training.steps
    if (epochs is not None and not counts) or (steps is not None and own_steps == 0):
        raise RecipeError(f"recipe {recipe.name} counts {'epochs' if counts else 'steps'}")
    if isinstance(recipe, UNetRecipe):
        return recipe if steps is None else replace(recipe, unet=replace(recipe.unet, steps=steps))
    if steps is not None:
        return replace(recipe, training=replace(recipe.training, steps=steps))
    if epochs is None:
        return recipe
    share = epochs / recipe.training.epochs_of("distance")
    lengths = {name: max(1, round(share * recipe.training.epochs_of(name))) for name in NETWORKS}
    return replace(recipe, training=replace(recipe.training, epochs=lengths))


def _recipe(raw: Any, where: str) -> AnyRecipe:
    top = _mapping(raw, where)
    parts: dict[str, Any] = {
        "data": _sources(top.get("data"), f"{where}: data"),
        "validation": _sources(top["validation"], f"{where}: validation") if "validation" in top else (),
    }
    recipe: AnyRecipe
    problems: Iterable[str]
    if "unet" in top:
        unet = _build(UNetTraining, top["unet"], f"{where}: unet")
        recipe = _build(UNetRecipe, {**top, **parts, "unet": unet}, where)
        problems = _wrong_unet(recipe.unet)
    else:
        recipe = _build(Recipe, {**top, **parts, **_network_parts(top, where)}, where)
        problems = (*_wrong_numbers(recipe), *_contradictions(recipe))
    for problem in (*problems, *_wrong_sources(recipe)):
        raise RecipeError(f"{where}: {problem}")
    return recipe


def _network_parts(top: dict[str, Any], where: str) -> dict[str, Any]:
    networks = _mapping(top.get("networks"), f"{where}: networks")
    training = dict(_mapping(top.get("training"), f"{where}: training"))
    if set(networks) != set(NETWORKS):
        raise RecipeError(
            f"{where}: networks must be distance and intensity, got {', '.join(map(str, networks)) or 'none'}"
        )
    for key in ("distance_loss", "intensity_loss"):
        training[key] = _build(Loss, training.get(key), f"{where}: training.{key}")
    return {
        "networks": {k: _network(v, f"{where}: networks.{k}") for k, v in networks.items()},
        "training": _build(TrainingRecipe, training, f"{where}: training"),
    }


def _sources(raw: Any, where: str) -> tuple[DataRecipe, ...]:
    if not isinstance(raw, list) or not raw:
        raise RecipeError(f"{where} must be a list of sources")
    sources = []
    for k, item in enumerate(raw):
        lists = {key: tuple(v) for key, v in _mapping(item, f"{where}[{k}]").items() if isinstance(v, list)}
        sources.append(_build(DataRecipe, {**item, **lists}, f"{where}[{k}]"))
    return tuple(sources)


def _network(raw: Any, where: str) -> NetworkRecipe:
    values = _mapping(raw, where)
    widths = values.get("widths", ())
    if isinstance(widths, list) and len(widths) == 3 and all(isinstance(w, int) for w in widths):
        widths = [widths[:2], widths[2:]]
    layered = isinstance(widths, list) and len(widths) == 2 and all(isinstance(part, list) and part for part in widths)
    if not layered or not all(type(w) is int and 1 <= w <= 64 for part in widths for w in part):
        raise RecipeError(
            f"{where}.widths must be three whole numbers of 1 to 64 (conv1, conv2, hidden) "
            f"or two lists of such ([convolutions], [hidden layers]), got {values.get('widths')}"
        )
    return _build(NetworkRecipe, {**values, "widths": (tuple(widths[0]), tuple(widths[1]))}, where)


def _wrong_numbers(recipe: Recipe) -> Iterator[str]:
    training = recipe.training
    positive: dict[str, Any] = {
        "training.learning_rate": training.learning_rate,
        "training.patience": training.patience,
        "training.validate_every": training.validate_every,
    }
    for key, loss in (("distance_loss", training.distance_loss), ("intensity_loss", training.intensity_loss)):
        for name in ("knee_m", "scale_m", "power", "search_rows", "search_columns"):
            positive[f"training.{key}.{name}"] = getattr(loss, name)
    for key, network in recipe.networks.items():
        positive[f"networks.{key}.scale"] = network.scale
    yield from _not_positive(positive)
    if not 1 <= training.starts <= 64:
        yield f"training.starts is {training.starts!r}, expected 1 to 64"
    if not 0 < training.start_share <= 1:
        yield f"training.start_share is {training.start_share!r}, expected above 0, at most 1"
    for name in ("intensity_gain", "intensity_noise"):
        if not 0 <= getattr(training, name) <= 2:
            yield f"training.{name} is {getattr(training, name)!r}, expected 0 to 2"
    if not 0 <= training.weight_decay < 1:
        yield f"training.weight_decay is {training.weight_decay!r}, expected 0 to 1"


def _contradictions(recipe: Recipe) -> Iterator[str]:
    training, epochs = recipe.training, recipe.training.epochs
    if isinstance(epochs, dict) and set(epochs) != set(NETWORKS):
        yield "training.epochs names other networks than distance and intensity"
        return
    lengths = [training.epochs_of(name) for name in NETWORKS]
    if (training.steps > 0) == (min(lengths) > 0) or training.steps < 0 or min(lengths) < 0:
        yield f"one of training.steps and training.epochs must be above 0, got {training.steps} and {epochs}"
    if (training.batch > 0) == (training.batch_images > 0) or min(training.batch, training.batch_images) < 0:
        yield (
            "one of training.batch (windows) and training.batch_images must be above 0, "
            f"got {training.batch} and {training.batch_images}"
        )
    if training.batch > 0 and recipe.windows <= 0:
        yield f"windows is {recipe.windows!r}, expected a number above 0"
    for key, loss in (("distance_loss", training.distance_loss), ("intensity_loss", training.intensity_loss)):
        if training.batch > 0 and (loss.kind == "chamfer" or loss.pixels == "all"):
            yield f"training.{key} looks at whole images: it needs training.batch_images instead of training.batch"
    if training.intensity_loss.kind == "chamfer":
        yield "training.intensity_loss.kind is chamfer, which only distances have"


def _wrong_unet(unet: UNetTraining) -> Iterator[str]:
    keys = ("width", "steps", "batch", "crop_columns", "learning_rate")
    yield from _not_positive({f"unet.{key}": getattr(unet, key) for key in keys})
    if unet.width > 4:
        yield f"unet.width is {unet.width!r}, expected 4 at most"


def _wrong_sources(recipe: BaseRecipe) -> Iterator[str]:
    for key, sources in (("data", recipe.data), ("validation", recipe.validation)):
        for k, source in enumerate(sources):
            for problem in _wrong_source(source, recipe):
                yield f"{key}[{k}]{problem}"


def _wrong_source(source: DataRecipe, recipe: BaseRecipe) -> Iterator[str]:
    """Begins with the key, or a colon."""
    positive = {f".{name}": getattr(source, name) for name in ("firing_columns", "rate_hz", "frames_per_scene")}
    if source.source == "simulator":
        positive[".frames"] = source.frames
    yield from _not_positive(positive)
    if source.columns and not 4 <= source.columns <= 65535:
        yield f".columns is {source.columns!r}, expected 4 to 65535, or 0 for the recipe's"
    if recipe.rows == "elevation" and source.source == "simulator" and source.projection != "recorded":
        yield ": rows: elevation needs projection: recorded of a simulator source"
    if source.source != "capture":
        given = [n for n in ("path", "sensor", "licence", "may_ship") if getattr(source, n)]
        if given:
            yield f".{given[0]} is of source: capture, this one is {source.source}"
        return
    if not source.path:
        yield ".path names no capture: expected a .pcap or .db3 file"
    if source.may_ship and not source.licence:
        yield ".may_ship needs the recording's licence"
    if recipe.rows == "elevation":
        yield ": rows: elevation is KITTI's binning; a capture has rows of its own"


def _not_positive(values: Mapping[str, Any]) -> Iterator[str]:
    for key, value in values.items():
        if not 0 < value < float("inf"):
            yield f"{key} is {value!r}, expected a number above 0"


T = TypeVar("T")
R = TypeVar("R", bound=BaseRecipe)


def _build(kind: type[T], raw: Any, where: str) -> T:
    values = _mapping(raw, where)
    known = {f.name for f in fields(kind)}  # type: ignore[arg-type]
    surplus = sorted(set(map(str, values)) - known)
    if surplus:
        raise RecipeError(f"{where}: unknown key {', '.join(surplus)}; known: {', '.join(sorted(known))}")
    hints = get_type_hints(kind)
    for key, value in values.items():
        if not _fits(value, hints[key]):
            raise RecipeError(f"{where}: {key} is {value!r}, expected {_words(hints[key])}")
    try:
        return kind(**values)
    except TypeError as error:
        raise RecipeError(f"{where}: {error}") from None


def _fits(value: Any, hint: Any) -> bool:
    """Whether a value of a file has the type of its field."""
    origin, arguments = get_origin(hint), get_args(hint)
    if origin is Literal:
        return value in arguments
    if origin in (Union, types.UnionType):
        return any(_fits(value, one) for one in arguments)
    if origin is tuple:
        inner = [arguments[0]] * len(value) if arguments[-1:] == (...,) and isinstance(value, tuple) else arguments
        return isinstance(value, tuple) and len(inner) == len(value) and all(map(_fits, value, inner))
    if origin is dict:
        return isinstance(value, Mapping) and all(
            _fits(key, arguments[0]) and _fits(one, arguments[1]) for key, one in value.items()
        )
    if hint is float:
        return isinstance(value, int | float) and not isinstance(value, bool)
    if hint is int:
        return type(value) is int
    return hint is Any or isinstance(value, hint)


def _words(hint: Any) -> str:
    if get_origin(hint) is Literal:
        return " or ".join(map(str, get_args(hint)))
    return {int: "a whole number", float: "a number", bool: "true or false", str: "a name"}.get(hint, str(hint))


def _mapping(raw: Any, where: str) -> dict[str, Any]:
    if not isinstance(raw, dict):
        raise RecipeError(f"{where}: expected a mapping of keys, got {type(raw).__name__}")
    return raw
