"""Fits the two window networks with PyTorch. Frames are handed in: this module knows no simulator.

Repeatable to the bit on one machine: one thread, seeded, deterministic algorithms.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from .frames import Frame
from .network import WindowNetwork, from_state_dict
from .recipe import Loss, NetworkRecipe, Recipe
from .rules import Rules, extract_windows

__all__ = ["Samples", "TorchWindowNetwork", "TrainingResult", "collect_samples", "train_networks"]

Progress = Callable[[str, int, int, float], None]
"""(network name, step, steps, smoothed loss)"""


class TorchWindowNetwork(nn.Module):
    """The dense graph in PyTorch, in the layout of the published network's ``state_dict``. Input ``[N, 6]``."""

    def __init__(self, recipe: NetworkRecipe) -> None:
        super().__init__()
        c1, c2, hidden = recipe.widths
        self.recipe = recipe
        self.conv1 = nn.Conv1d(1, c1, 1)
        self.conv2 = nn.Conv1d(c1, c2, 1)
        self.linear_1 = nn.Linear(6 * c2 + 1, hidden)
        self.linear_2 = nn.Linear(hidden, 1)

    def forward(self, windows: Tensor) -> Tensor:
        """Before the final ``max(y, 0)``, so that a negative output still has a gradient."""
        x = windows * self.recipe.scale
        minimum = x.min(dim=1, keepdim=True).values
        pixels = x - minimum if self.recipe.inputs == "difference" else x
        features = self.conv2(self.conv1(pixels[:, None, :])).flatten(1)
        hidden = nn.functional.leaky_relu(self.linear_1(torch.cat([features, minimum], dim=1)), self.recipe.slope)
        y = self.linear_2(hidden)[:, 0]
        if self.recipe.output == "residual":
            y = y + minimum[:, 0]
        return torch.as_tensor(y / self.recipe.scale)

    def export(self) -> WindowNetwork:
        """The trained weights as arrays."""
        state = {key: value.detach().cpu().numpy() for key, value in self.state_dict().items()}
        graph = {key: getattr(self.recipe, key) for key in ("slope", "inputs", "output", "scale")}
        return from_state_dict(state, **graph)


@dataclass(frozen=True)
class Samples:
    """Windows with a real return in the middle: ``distance``/``intensity`` ``[N, 6]`` and their targets ``[N]``."""

    distance: NDArray[np.uint16]
    distance_target: NDArray[np.uint16]
    intensity: NDArray[np.uint8]
    intensity_target: NDArray[np.uint8]


@dataclass(frozen=True)
class TrainingResult:
    networks: tuple[WindowNetwork, WindowNetwork]
    losses: dict[str, list[tuple[int, float]]]
    """Per network: (step, mean loss since the entry before)."""
    samples: int


def collect_samples(frames: Iterable[Frame], rules: Rules, count: int, expected_frames: int, seed: int) -> Samples:
    """Draws about ``count`` windows evenly from ``expected_frames`` frames; only windows whose target is a valid
    return."""
    per_frame = math.ceil(count / expected_frames)
    rng = np.random.default_rng(seed)
    parts: list[Samples] = []
    for frame in frames:
        windows = extract_windows(frame.distance[0::2], frame.intensity[0::2], rules)
        truth = frame.distance[1:-1:2]
        usable = np.flatnonzero((rules.valid(truth) & windows.any_return).ravel())
        chosen = np.sort(rng.choice(usable, size=min(per_frame, len(usable)), replace=False))
        parts.append(
            Samples(
                windows.distance.reshape(-1, 6)[chosen].astype(np.uint16),
                truth.ravel()[chosen],
                windows.intensity.reshape(-1, 6)[chosen].astype(np.uint8),
                frame.intensity[1:-1:2].ravel()[chosen],
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


def train_networks(
    recipe: Recipe, samples: Samples, rules: Rules, progress: Progress = lambda *_: None
) -> TrainingResult:
    """Distance, then intensity."""
    unit = rules.distance_unit_m
    losses: dict[str, list[tuple[int, float]]] = {}
    threads = torch.get_num_threads()
    deterministic = torch.are_deterministic_algorithms_enabled()
    torch.set_num_threads(1)
    torch.use_deterministic_algorithms(True)
    try:
        distance, losses["distance"] = _fit(
            recipe, "distance", samples.distance, samples.distance_target, unit, recipe.training.distance_loss, progress
        )
        intensity, losses["intensity"] = _fit(
            recipe,
            "intensity",
            samples.intensity,
            samples.intensity_target,
            1.0,
            recipe.training.intensity_loss,
            progress,
        )
    finally:
        torch.set_num_threads(threads)
        torch.use_deterministic_algorithms(deterministic)
    return TrainingResult((distance, intensity), losses, len(samples.distance))


def _fit(
    recipe: Recipe,
    name: str,
    windows: NDArray[np.generic],
    targets: NDArray[np.generic],
    unit: float,
    loss: Loss,
    progress: Progress,
) -> tuple[WindowNetwork, list[tuple[int, float]]]:
    settings = recipe.training
    torch.manual_seed(recipe.seed)
    rng = np.random.default_rng([recipe.seed, len(name)])
    network = TorchWindowNetwork(recipe.networks[name])
    optimiser = torch.optim.Adam(network.parameters(), settings.learning_rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, settings.steps)
    log: list[tuple[int, float]] = []
    running, since = 0.0, 0
    for step in range(1, settings.steps + 1):
        index = rng.integers(0, len(windows), settings.batch)
        x = torch.from_numpy(windows[index].astype(np.float32) * np.float32(unit))
        y = torch.from_numpy(targets[index].astype(np.float32) * np.float32(unit))
        if settings.mirror and step % 2:
            x = x[:, [2, 1, 0, 5, 4, 3]]
        value = _loss(network(x) - y, loss)
        optimiser.zero_grad()
        value.backward()  # type: ignore[no-untyped-call]
        optimiser.step()
        schedule.step()
        running, since = running + float(value.detach()), since + 1
        if step % 50 == 0 or step == settings.steps:
            log.append((step, running / since))
            progress(name, step, settings.steps, running / since)
            running, since = 0.0, 0
    return network.export(), log


def _loss(error: Tensor, loss: Loss) -> Tensor:
    if loss.kind == "l1":
        return error.abs().mean()
    square = error**2
    return (square / (1 + square / loss.knee_m**2)).mean()
