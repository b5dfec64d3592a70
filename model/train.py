"""Fits the two window networks with PyTorch. Frames are handed in: this module knows no simulator.

Repeatable to the bit on the CPU of one machine: one thread, deterministic algorithms, and random numbers that depend on
the seed and the step alone, so that a run which was interrupted and resumed ends with the same bits.
"""

from __future__ import annotations

import copy
import hashlib
import json
import math
import os
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from .baselines import Method
from .evaluate import in_unit, with_limits
from .frames import Frame
from .losses import PixelGeometry, chamfer, pixel_errors
from .network import WINDOW, NetworkError, WindowNetwork, from_state_dict
from .recipe import NETWORKS, NetworkRecipe, Recipe
from .rules import Rules, extract_windows, generated_counts

__all__ = [
    "VALIDATION_WINDOWS",
    "Samples",
    "TorchWindowNetwork",
    "TrainingError",
    "TrainingResult",
    "collect_samples",
    "load_networks",
    "networks_method",
    "pick_device",
    "save_networks",
    "torch_method",
    "total_steps",
    "train_networks",
]

Progress = Callable[[str, int, int, float, float | None], None]
"""(network name, step, steps, mean loss since the call before, loss on the validation frames or None)"""
VALIDATION_WINDOWS = 65_536
"""That many windows of all validation frames tell the loss to a hundredth, in a fraction of the time between two log
entries."""
_MIRROR = [2, 1, 0, 5, 4, 3]
"""The pixels of a window, left-right reversed."""


class TrainingError(ValueError):
    """A run that cannot go on: says why, and what to change."""


class TorchWindowNetwork(nn.Module):
    """The dense graph in PyTorch, of any number of pointwise convolutions and hidden layers. Input ``[..., 6]``.

    Layers are ``conv1``, ``conv2`` ... and ``linear_1``, ``linear_2`` ..., the last of them the output: in the standard
    layout the published network's ``state_dict``.
    """

    def __init__(self, recipe: NetworkRecipe) -> None:
        super().__init__()
        self.recipe = recipe
        convolutions, hidden = recipe.widths
        self.convolutions = [f"conv{k + 1}" for k in range(len(convolutions))]
        self.linears = [f"linear_{k + 1}" for k in range(len(hidden) + 1)]
        for name, sizes in zip(self.convolutions, _steps((1, *convolutions)), strict=True):
            self.add_module(name, nn.Conv1d(*sizes, 1))
        for name, sizes in zip(self.linears, _steps((WINDOW * convolutions[-1] + 1, *hidden, 1)), strict=True):
            self.add_module(name, nn.Linear(*sizes))
        if recipe.scale_free:
            self._drop_level()

    def _drop_level(self) -> None:
        """Biases and the minimum's weights become 0 and stay so: frozen, and of a feature that is 0."""
        with torch.no_grad():
            self._linear(0).weight[:, -1] = 0
            for name, parameter in self.named_parameters():
                if name.endswith(".bias"):
                    parameter.zero_().requires_grad_(False)

    def forward(self, windows: Tensor) -> Tensor:
        """``[...]``, before the final ``max(y, 0)``.

        The convolutions and the linear part of the first layer are multiplied into one matrix first: the same function
        of the windows and the weights, gradients included, for a fraction of the work (``layer_by_layer`` is the other
        way).
        """
        pixels, minimum = self._inputs(windows)
        gain, offset = self._folded_convolutions()
        first = self._linear(0)
        per_channel = first.weight[:, :-1].reshape(first.out_features, len(gain), WINDOW)
        weight = torch.cat([torch.einsum("hci,c->hi", per_channel, gain), first.weight[:, -1:]], dim=1)
        bias = first.bias + per_channel.sum(dim=2) @ offset
        first_layer = nn.functional.linear(torch.cat([pixels, self._level(minimum)], dim=-1), weight, bias)
        return self._outputs(first_layer, minimum)

    def layer_by_layer(self, windows: Tensor) -> Tensor:
        """What ``forward`` gives, of the graph as it is drawn. Input ``[N, 6]``."""
        pixels, minimum = self._inputs(windows)
        features = pixels[:, None, :]
        for name in self.convolutions:
            features = self._modules[name](features)  # type: ignore[misc]
        return self._outputs(self._linear(0)(torch.cat([features.flatten(1), self._level(minimum)], dim=1)), minimum)

    def _inputs(self, windows: Tensor) -> tuple[Tensor, Tensor]:
        x = windows * self.recipe.scale
        minimum = x.min(dim=-1, keepdim=True).values
        return (x - minimum if self.recipe.inputs == "difference" else x), minimum

    def _level(self, minimum: Tensor) -> Tensor:
        """The minimum as a feature."""
        return torch.zeros_like(minimum) if self.recipe.scale_free else minimum

    def _folded_convolutions(self) -> tuple[Tensor, Tensor]:
        """Each channel as ``gain * pixel + offset``."""
        gain, offset = torch.ones_like(self._conv(0)[0][:1, 0]), torch.zeros_like(self._conv(0)[1][:1])
        for k in range(len(self.convolutions)):
            weight, bias = self._conv(k)
            gain, offset = weight @ gain, weight @ offset + bias
        return gain, offset

    def _outputs(self, first: Tensor, minimum: Tensor) -> Tensor:
        """From the first layer, before its activation, on."""
        x = first
        for k in range(1, len(self.linears)):
            x = self._linear(k)(nn.functional.leaky_relu(x, self.recipe.slope))
        y = x + minimum if self.recipe.output == "residual" else x
        return torch.as_tensor(y[..., 0] / self.recipe.scale)

    def _conv(self, k: int) -> tuple[Tensor, Tensor]:
        layer = self._modules[self.convolutions[k]]
        assert isinstance(layer, nn.Conv1d)
        assert layer.bias is not None
        return layer.weight[:, :, 0], layer.bias

    def _linear(self, k: int) -> nn.Linear:
        layer = self._modules[self.linears[k]]
        assert isinstance(layer, nn.Linear)
        return layer

    def export(self) -> WindowNetwork:
        """The trained weights as arrays, in the standard layout.

        Convolutions after the second are linear maps of its channels and multiplied into it; of a single one, the first
        is the identity: the same function exactly. Raises NetworkError for more than one hidden layer.
        """
        if not self.recipe.exportable:
            raise NetworkError(
                f"{len(self.recipe.widths[1])} hidden layers cannot be exported: a model file holds networks of one. "
                "Evaluate it through PyTorch (torch_method, save_networks)"
            )
        state = {key: value.detach().cpu().double().numpy() for key, value in self.state_dict().items()}
        weights = [(state.pop(f"{name}.weight")[:, :, 0], state.pop(f"{name}.bias")) for name in self.convolutions]
        if len(weights) == 1:
            weights.insert(0, (np.ones((1, 1)), np.zeros(1)))
        gain, offset = weights[1]
        for weight, bias in weights[2:]:
            gain, offset = weight @ gain, weight @ offset + bias
        state |= {"conv1.weight": weights[0][0][:, :, None], "conv1.bias": weights[0][1]}
        state |= {"conv2.weight": gain[:, :, None], "conv2.bias": offset}
        return from_state_dict(state, **{key: getattr(self.recipe, key) for key in _GRAPH})


_GRAPH = ("slope", "inputs", "output", "scale")


def _steps(sizes: Sequence[int]) -> list[tuple[int, int]]:
    return list(pairwise(sizes))


@dataclass(frozen=True)
class Samples:
    """Windows with a real return in the middle: ``distance``/``intensity`` ``[N, 6]`` and their targets ``[N]``."""

    distance: NDArray[np.uint16]
    distance_target: NDArray[np.uint16]
    intensity: NDArray[np.uint8]
    intensity_target: NDArray[np.uint8]

    def __len__(self) -> int:
        return len(self.distance)


TrainingData = Samples | Sequence[Frame]
"""Windows drawn from frames, where a recipe's batches are windows; whole frames, where they are images (0.4 MB each
at 2048 columns: 2.9 GB for the 7481 of KITTI's object training set)."""


@dataclass(frozen=True)
class TrainingResult:
    modules: dict[str, TorchWindowNetwork]
    """On the CPU."""
    losses: dict[str, list[tuple[int, float]]]
    """Per network: (step, mean loss since the entry before)."""
    samples: int
    """Windows, or images, trained on."""
    validation: dict[str, list[tuple[int, float]]]
    """Per network: (step, loss of the validation frames then); empty without such frames."""

    @property
    def networks(self) -> tuple[WindowNetwork, WindowNetwork]:
        """As arrays. Raises NetworkError where a network cannot be exported."""
        return self.modules["distance"].export(), self.modules["intensity"].export()


def collect_samples(frames: Iterable[Frame], rules: Rules, count: int, expected_frames: int, seed: int) -> Samples:
    """Draws about ``count`` windows evenly from ``expected_frames`` frames; only windows whose target is a valid
    return."""
    per_frame = math.ceil(count / expected_frames)
    rng = np.random.default_rng(seed)
    parts: list[Samples] = []
    for frame in frames:
        windows = extract_windows(frame.distance[frame.given], frame.intensity[frame.given], rules)
        truth = frame.distance[frame.truth]
        usable = np.flatnonzero((rules.valid(truth) & windows.any_return).ravel())
        chosen = np.sort(rng.choice(usable, size=min(per_frame, len(usable)), replace=False))
        parts.append(
            Samples(
                windows.distance.reshape(-1, 6)[chosen].astype(np.uint16),
                truth.ravel()[chosen],
                windows.intensity.reshape(-1, 6)[chosen].astype(np.uint8),
                frame.intensity[frame.truth].ravel()[chosen],
            )
        )
    if not parts:
        raise ValueError("no frames to train on")
    return Samples(
        np.concatenate([p.distance for p in parts]),
        np.concatenate([p.distance_target for p in parts]),
        np.concatenate([p.intensity for p in parts]),
        np.concatenate([p.intensity_target for p in parts]),
    )


def pick_device(name: str) -> torch.device:
    """``cpu``, ``cuda``, or ``auto``: a GPU where there is one. Raises TrainingError for ``cuda`` without a GPU."""
    if name not in ("auto", "cpu", "cuda"):
        raise TrainingError(f"device {name!r}: expected auto, cpu or cuda")
    if name == "cuda" and not torch.cuda.is_available():
        raise TrainingError("device cuda: this machine, or this build of PyTorch, has no CUDA GPU")
    return torch.device("cuda" if name != "cpu" and torch.cuda.is_available() else "cpu")


def total_steps(recipe: Recipe, data: TrainingData) -> int:
    """Steps of both networks together."""
    batch = recipe.training.batch_images or recipe.training.batch
    per_epoch = math.ceil(len(data) / batch)
    return sum(_run_steps(recipe, name, per_epoch) for name in NETWORKS)


def _run_steps(recipe: Recipe, name: str, per_epoch: int) -> int:
    return recipe.training.steps or recipe.training.epochs_of(name) * per_epoch


def train_networks(
    recipe: Recipe,
    data: TrainingData,
    rules: Rules,
    progress: Progress = lambda *_: None,
    *,
    device: str = "cpu",
    checkpoint: Path | None = None,
    checkpoint_every: int = 500,
    validation: TrainingData | None = None,
) -> TrainingResult:
    """Distance, then intensity.

    ``validation``: of the kind of ``data``; the loss there is logged and changes nothing of the weights.
    ``checkpoint``: a file written every so many steps, whole or not at all; where it exists the run goes on from it.
    Raises TrainingError where it belongs to another recipe or other data, or where a network dies.
    """
    if any(isinstance(d, Samples) == (recipe.training.batch_images > 0) for d in (data, validation) if d is not None):
        raise TrainingError("batches of windows need Samples, batches of images need frames")
    if not len(data):
        raise TrainingError("no frames to train on")
    where = pick_device(device)
    with _repeatable(where):
        fresh = checkpoint is None or not checkpoint.exists()
        runs = {
            name: _best_start(recipe, name, *_both(recipe, name, data, validation, rules, where), where, fresh)
            for name in NETWORKS
        }
        saved = None if checkpoint is None else _CheckpointFile(checkpoint, _identity(recipe, data), runs)
        if saved is not None:
            saved.load(where)
        for run in runs.values():
            while run.step < run.steps:
                run.advance(progress)
                if saved is not None and (run.step % checkpoint_every == 0 or run.step == run.steps):
                    saved.write()
    return TrainingResult(
        {name: run.network.cpu() for name, run in runs.items()},
        {name: run.log for name, run in runs.items()},
        len(data),
        {name: run.held_log for name, run in runs.items() if validation},
    )


@contextmanager
def _repeatable(device: torch.device) -> Iterator[None]:
    """One thread and deterministic algorithms on the CPU; a GPU is left as it is, and is not repeatable to the bit."""
    threads, deterministic = torch.get_num_threads(), torch.are_deterministic_algorithms_enabled()
    if device.type == "cpu":
        torch.set_num_threads(1)
        torch.use_deterministic_algorithms(True)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
        torch.use_deterministic_algorithms(deterministic)


class _Batches(Protocol):
    """What a step looks at, and how wrong a network is there."""

    per_epoch: int

    def losses(self, step: int, network: TorchWindowNetwork) -> Iterator[tuple[Tensor, float]]:
        """Loss and share in the step of each part of the batch, to be differentiated one by one."""

    def whole(self, network: TorchWindowNetwork) -> Iterator[tuple[Tensor, float]]:
        """The same of all there is, as it is: neither mirrored nor regraded."""


def _batches(recipe: Recipe, name: str, data: TrainingData, rules: Rules, device: torch.device) -> _Batches:
    if isinstance(data, Samples):
        return _WindowBatches(recipe, name, data, rules, device)
    return _ImageBatches(recipe, name, data, rules, device)


def _both(
    recipe: Recipe, name: str, data: TrainingData, validation: TrainingData | None, rules: Rules, device: torch.device
) -> tuple[_Batches, _Batches | None]:
    held = _batches(recipe, name, validation, rules, device) if validation else None
    return _batches(recipe, name, data, rules, device), held


class _WindowBatches:
    """Windows drawn at random; an epoch is as many as there are."""

    def __init__(self, recipe: Recipe, name: str, data: Samples, rules: Rules, device: torch.device) -> None:
        self.settings, self.loss, self.device = recipe.training, recipe.training.loss(name), device
        self.name, self.seed = name, [recipe.seed, len(name)]
        self.unit = np.float32(rules.distance_unit_m if name == "distance" else 1.0)
        self.windows: NDArray[Any] = getattr(data, name)
        self.targets: NDArray[Any] = getattr(data, f"{name}_target")
        self.per_epoch = math.ceil(len(data) / self.settings.batch)

    def losses(self, step: int, network: TorchWindowNetwork) -> Iterator[tuple[Tensor, float]]:
        rng = np.random.default_rng([*self.seed, step])
        x, y = self._chosen(rng.integers(0, len(self.windows), self.settings.batch))
        if self.name == "intensity":
            x, y = self._regraded(x, y, rng)
        if self.settings.mirror and step % 2 == 0:
            x = x[:, _MIRROR]
        yield self._loss(network, x, y), 1.0

    def whole(self, network: TorchWindowNetwork) -> Iterator[tuple[Tensor, float]]:
        for part in np.split(np.arange(len(self.windows)), range(8192, len(self.windows), 8192)):
            yield self._loss(network, *self._chosen(part)), len(part) / len(self.windows)

    def _chosen(self, index: NDArray[np.integer[Any]]) -> tuple[Tensor, Tensor]:
        x, y = (torch.from_numpy(v[index].astype(np.float32) * self.unit) for v in (self.windows, self.targets))
        return x, y

    def _loss(self, network: TorchWindowNetwork, x: Tensor, y: Tensor) -> Tensor:
        return pixel_errors(_seen(network, x.to(self.device)) - y.to(self.device), self.loss).mean()

    def _regraded(self, x: Tensor, y: Tensor, rng: np.random.Generator) -> tuple[Tensor, Tensor]:
        """Intensities as other lasers would have graded them."""
        gain, noise = self.settings.intensity_gain, self.settings.intensity_noise
        if gain == 0 and noise == 0:
            return x, y
        lasers = np.exp(gain * rng.standard_normal((len(x), 3)))[:, [0, 0, 0, 1, 1, 1, 2]]
        factors = torch.from_numpy((lasers * np.exp(noise * rng.standard_normal(lasers.shape))).astype(np.float32))
        return (x * factors[:, :6]).clamp(0, 255), (y * factors[:, 6]).clamp(0, 255)


class _ImageBatches:
    """Whole images, each once an epoch, in an order of the epoch's own."""

    def __init__(self, recipe: Recipe, name: str, data: Sequence[Frame], rules: Rules, device: torch.device) -> None:
        self.settings, self.loss, self.device = recipe.training, recipe.training.loss(name), device
        self.seed = [recipe.seed, len(name)]
        self.name, self.rules, self.frames = name, rules, data
        self.per_epoch = math.ceil(len(data) / self.settings.batch_images)

    def losses(self, step: int, network: TorchWindowNetwork) -> Iterator[tuple[Tensor, float]]:
        epoch, k = divmod(step, self.per_epoch)
        order = np.random.default_rng([*self.seed, epoch]).permutation(len(self.frames))
        chosen = order[k * self.settings.batch_images : (k + 1) * self.settings.batch_images]
        for index in chosen:
            loss = self._image_loss(self.frames[index], network, mirror=self.settings.mirror and step % 2 == 0)
            yield loss, 1.0 / len(chosen)

    def whole(self, network: TorchWindowNetwork) -> Iterator[tuple[Tensor, float]]:
        for frame in self.frames:
            yield self._image_loss(frame, network, mirror=False), 1.0 / len(self.frames)

    def _image_loss(self, frame: Frame, network: TorchWindowNetwork, mirror: bool) -> Tensor:
        windows = extract_windows(frame.distance[frame.given], frame.intensity[frame.given], self.rules)
        truth = frame.distance[frame.truth]
        real, made = self._tensor(self.rules.valid(truth)), self._tensor(windows.any_return)
        if self.name == "distance":
            unit = self.rules.distance_unit_m
            x, y = windows.distance * unit, np.where(self.rules.valid(truth), truth * unit, 0.0)
        else:
            x, y = windows.intensity, np.where(self.rules.valid(truth), frame.intensity[frame.truth], 0.0)
        # Mirrored windows at their own places: the same as a mirrored image, whose truth and geometry turn round too.
        given = self._tensor(x[..., _MIRROR] if mirror else x)
        output, target = _seen(network, given), self._tensor(y)
        if self.loss.kind == "chamfer":
            if self.loss.empty == "origin":
                made, real = torch.ones_like(made), torch.ones_like(real)
            return chamfer(output, made, target, real, self._geometry(frame), self.loss)
        errors = pixel_errors(output - target, self.loss)
        return (
            errors.mean() if self.loss.pixels == "all" else errors[real & made].sum() / max(1, int((real & made).sum()))
        )

    def _tensor(self, x: NDArray[Any]) -> Tensor:
        return torch.from_numpy(x if x.dtype == bool else x.astype(np.float32)).to(self.device)

    def _geometry(self, frame: Frame) -> PixelGeometry:
        rows = tuple(frame.elevation_deg[frame.truth]), tuple(frame.row_height_m[frame.truth])
        return _geometry(*rows, frame.distance.shape[1], frame.cut_deg, self.device)


@lru_cache(maxsize=4)
def _geometry(
    elevation_deg: tuple[float, ...], height_m: tuple[float, ...], columns: int, cut_deg: float, device: torch.device
) -> PixelGeometry:
    """Of the frames of one sensor: alike for all of them."""
    return PixelGeometry.of_rows(np.array(elevation_deg), np.array(height_m), columns, cut_deg, device)


def _seen(network: TorchWindowNetwork, windows: Tensor) -> Tensor:
    """The output as the loss sees it."""
    y: Tensor = network(windows)
    if not network.recipe.relu_in_loss:
        return y
    y = torch.relu(y)
    if torch.is_grad_enabled() and not bool((y > 0).any()):
        raise TrainingError("the network is dead: every output is 0, so nothing has a gradient; change the seed")
    return y


def _best_start(
    recipe: Recipe, name: str, batches: _Batches, held: _Batches | None, device: torch.device, fresh: bool
) -> _Run:
    """Saturating losses have poor minima that a run does not leave: look at several starts before choosing one.

    A run that a checkpoint will fill needs no choice."""
    if recipe.training.starts == 1 or not fresh:
        return _Run(recipe, name, batches, device, held=held)
    runs = [_Run(recipe, name, batches, device, start, held) for start in range(recipe.training.starts)]
    for run in runs:
        for _ in range(max(1, int(run.steps * recipe.training.start_share))):
            run.advance(lambda *_: None)
    return min(runs, key=_recent_loss)


def _recent_loss(run: _Run) -> float:
    return float(np.mean([loss for _, loss in run.log[-4:]] or [_mean(run.since_log)]))


_PLAIN_STATE = ("step", "log", "held_log", "since_log", "since_epoch")


class _Run:
    """The training of one network: all that a checkpoint must hold."""

    def __init__(
        self,
        recipe: Recipe,
        name: str,
        batches: _Batches,
        device: torch.device,
        start: int = 0,
        held: _Batches | None = None,
    ) -> None:
        settings = recipe.training
        torch.manual_seed(recipe.seed + start)
        self.name, self.batches, self.held = name, batches, held
        self.validate_every = settings.validate_every
        self.network = TorchWindowNetwork(recipe.networks[name]).to(device)
        self.steps = _run_steps(recipe, name, batches.per_epoch)
        self.optimiser = torch.optim.Adam(
            self.network.parameters(), settings.learning_rate, weight_decay=settings.weight_decay
        )
        self.schedule = _schedule(recipe, self.optimiser, self.steps)
        self.every_epoch = settings.schedule == "plateau"
        self.step = 0
        self.log: list[tuple[int, float]] = []
        self.held_log: list[tuple[int, float]] = []
        self.since_log = [0.0, 0.0]
        """Sum and number of the losses since the log's last entry; since the epoch began."""
        self.since_epoch = [0.0, 0.0]

    def advance(self, progress: Progress) -> None:
        """One step."""
        self.optimiser.zero_grad()
        loss = 0.0
        for part, share in self.batches.losses(self.step, self.network):
            (part * share).backward()  # type: ignore[no-untyped-call]
            loss += float(part.detach()) * share
        if not math.isfinite(loss):
            raise TrainingError(f"{self.name}: the loss of step {self.step + 1} is {loss}; lower the learning rate")
        self.optimiser.step()
        self.step += 1
        for sums in (self.since_log, self.since_epoch):
            sums[0], sums[1] = sums[0] + loss, sums[1] + 1
        epoch_ends = self.step % self.batches.per_epoch == 0
        if not self.every_epoch:
            self.schedule.step()
        elif epoch_ends:
            self.schedule.step(_mean(self.since_epoch))
        if epoch_ends:
            self.since_epoch = [0.0, 0.0]
        if self.step % min(50, self.batches.per_epoch) == 0 or self.step == self.steps:
            self.log.append((self.step, _mean(self.since_log)))
            self.since_log = [0.0, 0.0]
            progress(self.name, self.step, self.steps, self.log[-1][1], self._validate())

    def _validate(self) -> float | None:
        """The loss on the validation frames, where it is due; no random number is drawn."""
        if self.held is None or (len(self.log) % self.validate_every and self.step < self.steps):
            return None
        with torch.no_grad():
            loss = sum(float(part) * share for part, share in self.held.whole(self.network))
        self.held_log.append((self.step, loss))
        return loss

    def state(self) -> dict[str, Any]:
        plain = {key: getattr(self, key) for key in _PLAIN_STATE}
        parts = {key: getattr(self, key).state_dict() for key in ("network", "optimiser", "schedule")}
        return {**plain, **parts}

    def load(self, state: Mapping[str, Any]) -> None:
        for key in _PLAIN_STATE:
            setattr(self, key, state[key])
        for key in ("network", "optimiser", "schedule"):
            getattr(self, key).load_state_dict(state[key])


def _mean(sums: list[float]) -> float:
    return sums[0] / sums[1]


def _schedule(recipe: Recipe, optimiser: torch.optim.Optimizer, steps: int) -> Any:
    settings, schedulers = recipe.training, torch.optim.lr_scheduler
    if settings.schedule == "plateau":
        return schedulers.ReduceLROnPlateau(optimiser, factor=0.5, patience=settings.patience)
    if settings.schedule == "cosine":
        return schedulers.CosineAnnealingLR(optimiser, steps)
    return schedulers.ConstantLR(optimiser, factor=1.0)


class _CheckpointFile:
    def __init__(self, path: Path, identity: str, runs: Mapping[str, _Run]) -> None:
        self.path, self.identity, self.runs = path, identity, runs

    def load(self, device: torch.device) -> None:
        if not self.path.exists():
            return
        try:
            saved = torch.load(self.path, map_location=device, weights_only=True)
            identity, states = saved["identity"], saved["runs"]
        except Exception as error:
            raise TrainingError(f"{self.path}: no checkpoint: {' '.join(str(error).split())[:200]}") from None
        if identity != self.identity:
            raise TrainingError(f"{self.path}: a checkpoint of another recipe or other data; remove it or name another")
        for name, run in self.runs.items():
            run.load(states[name])

    def write(self) -> None:
        """Beside its place first, then moved there: a crash leaves the old file or the new one."""
        beside = self.path.with_name(self.path.name + ".part")
        with beside.open("wb") as file:
            torch.save(
                {"identity": self.identity, "runs": {name: run.state() for name, run in self.runs.items()}}, file
            )
            file.flush()
            os.fsync(file.fileno())
        beside.replace(self.path)


def _identity(recipe: Recipe, data: TrainingData) -> str:
    """Of all that decides the weights."""
    if isinstance(data, Samples):
        arrays: Iterable[NDArray[Any]] = (data.distance, data.distance_target, data.intensity, data.intensity_target)
    else:
        arrays = (image for frame in data for image in (frame.distance, frame.intensity))
    crc = 0
    for array in arrays:
        crc = zlib.crc32(np.ascontiguousarray(array).data, crc)
    return hashlib.sha256(f"{recipe!r} {len(data)} {crc:08x} {torch.__version__}".encode()).hexdigest()


def torch_method(modules: Mapping[str, TorchWindowNetwork]) -> Method:
    """The two networks behind the interface of the baselines, in float64: what cannot be exported is judged so."""
    networks = {name: copy.deepcopy(modules[name]).cpu().double() for name in NETWORKS}

    def run(
        distance: NDArray[np.uint16], intensity: NDArray[np.uint8], rules: Rules
    ) -> tuple[NDArray[np.uint16], NDArray[np.uint8]]:
        windows = extract_windows(distance, intensity, rules)
        unit = rules.distance_unit_m
        with torch.no_grad():
            y = torch.relu(networks["distance"](torch.from_numpy(windows.distance * unit))).numpy() / unit
            grey = torch.relu(networks["intensity"](torch.from_numpy(windows.intensity))).numpy()
        made = generated_counts(y, windows, rules)
        return made, np.where(made > 0, np.clip(np.floor(grey + 0.5), 0, 255), 0).astype(np.uint8)

    return run


def save_networks(
    path: Path,
    modules: Mapping[str, TorchWindowNetwork],
    rules: Rules | None = None,
    provenance: Mapping[str, Any] | None = None,
) -> None:
    """Weights, graph and rules of both networks as a ``.pt`` file: of networks that a model file cannot hold."""
    saved: dict[str, Any] = {name: {"graph": asdict(m.recipe), "state": m.state_dict()} for name, m in modules.items()}
    if rules is not None:
        plain = {f.name: getattr(rules, f.name) for f in fields(rules)}
        saved["rules"] = {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in plain.items()}
    torch.save({**saved, "provenance": json.dumps(dict(provenance or {}))}, path)


def load_networks(path: str | Path) -> dict[str, TorchWindowNetwork]:
    """The networks that ``save_networks`` wrote (only tensors and plain values are unpickled). Raises NetworkError."""
    return _load_networks(path)[0]


def _load_networks(path: str | Path) -> tuple[dict[str, TorchWindowNetwork], Rules | None]:
    try:
        saved = torch.load(path, map_location="cpu", weights_only=True)
        modules = {name: TorchWindowNetwork(NetworkRecipe(**saved[name]["graph"])) for name in NETWORKS}
        for name, module in modules.items():
            module.load_state_dict(saved[name]["state"])
        return modules, Rules(**saved["rules"]) if "rules" in saved else None
    except Exception as error:
        raise NetworkError(f"{path}: cannot be read as networks: {' '.join(str(error).split())[:200]}") from None


def networks_method(path: str | Path) -> Method:
    """What ``save_networks`` wrote, rules included, behind the interface of the baselines, under the caller's range
    limits. Raises NetworkError."""
    modules, own = _load_networks(path)
    if own is None:
        raise NetworkError(f"{path}: holds networks without the rules they were trained under")
    rules = own
    method = torch_method(modules)

    def run(
        distance: NDArray[np.uint16], intensity: NDArray[np.uint8], limits: Rules
    ) -> tuple[NDArray[np.uint16], NDArray[np.uint8]]:
        limited = with_limits(in_unit(rules, limits.distance_unit_m), limits.min_count, limits.max_count)
        return method(distance, intensity, limited)

    return run
