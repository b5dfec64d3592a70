"""The network of Shan et al. 2020, "Simulation-based Lidar Super-resolution for Ground Vehicles": a U-Net on range
images whose dropout stays on, and which removes what it is not sure of. A baseline of thousands of times the work of a
window network. Needs PyTorch.

Written from the paper's description: a transposed convolution brings the image to its full rows; encoder blocks of two
3 x 3 convolutions, each with batch normalisation and ReLU, 64 to 1024 filters, with average pooling between; a decoder
of transposed convolutions with skip connections; one convolution without normalisation as the output; L1 loss, Adam;
50 Monte-Carlo passes, a pixel removed where their standard deviation is above 0.03 of their mean.

Assumed, where that leaves it open or the task differs: distances are divided by 80 m (our range limit); dropout of 0.25
after each block but the first and the last; twice the rows instead of four times, so one transposed convolution instead
of two; the output passes a ReLU; columns beyond the image are 0; the learning rate decays to 0 along a cosine. The
network makes ranges only: intensities are those of the valid-neighbour mean.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from .baselines import Method, valid_mean
from .frames import Frame
from .network import NetworkError
from .rules import Rules

__all__ = [
    "PASSES",
    "UNCERTAIN",
    "ShanNet",
    "is_shan",
    "load_shan",
    "save_shan",
    "shan_method",
    "train_shan",
    "uncertain_removed",
]

U16 = NDArray[np.uint16]
U8 = NDArray[np.uint8]

FULL_SCALE_M = 80.0
"""What the network sees as 1."""
FILTERS = (64, 128, 256, 512, 1024)
DROPOUT = 0.25
PASSES = 50
UNCERTAIN = 0.03
"""A pixel is removed where the passes' standard deviation is above this share of their mean."""
_TILE = 2 ** (len(FILTERS) - 1)
"""Rows and columns are padded to a multiple of this, for the poolings."""
LOG_STEPS = 25
Progress = Callable[[int, int, float, float | None], None]
"""(step, steps, mean training loss since the call before, loss on the validation frames or None), in units of 80 m"""


class ShanNet(nn.Module):
    """Images ``[N, 1, B, W]`` of input rows / 80 m -> ``[N, 1, 2 B, W]``. ``width`` scales the numbers of filters
    (1 is the paper's, 34.6 million weights; at least one filter is kept)."""

    def __init__(self, width: float = 1.0, dropout: float = DROPOUT) -> None:
        super().__init__()
        filters = [max(1, round(width * count)) for count in FILTERS]
        self.enlarge = nn.Sequential(
            nn.ConvTranspose2d(1, filters[0], 3, stride=(2, 1), padding=1, output_padding=(1, 0)),
            nn.BatchNorm2d(filters[0]),
            nn.ReLU(),
        )
        steps = list(pairwise(filters))
        self.first = _block(filters[0], filters[0])
        self.down = nn.ModuleList(_block(a, b) for a, b in steps)
        self.up = nn.ModuleList(
            nn.ConvTranspose2d(b, a, 3, stride=2, padding=1, output_padding=1) for a, b in reversed(steps)
        )
        self.merge = nn.ModuleList(_block(2 * a, a) for a, _ in reversed(steps))
        self.output = nn.Conv2d(filters[0], 1, 1)
        self.pool = nn.AvgPool2d(2)
        self.dropout = nn.Dropout(dropout)

    def forward(self, image: Tensor) -> Tensor:
        x = self.enlarge(image)
        rows, columns = x.shape[-2:]
        x = self.first(nn.functional.pad(x, (0, -columns % _TILE, 0, -rows % _TILE)))
        kept = []
        for block in self.down:
            kept.append(x)
            x = self.dropout(block(self.pool(x)))
        for enlarge, block in zip(self.up, self.merge, strict=True):
            x = block(torch.cat([enlarge(x), kept.pop()], dim=1))
            x = self.dropout(x) if kept else x
        return torch.relu(self.output(x))[..., :rows, :columns]

    def passes(self, image: Tensor, count: int, seed: int) -> Tensor:
        """``[count, 2 B, W]`` of one image ``[B, W]`` / 80 m, each with other units dropped; the same for a seed."""
        self.eval()
        self.dropout.train()  # always on; batch normalisation stays as trained
        image = image.to(self.output.weight.device)
        with _own_random_numbers(image.device), torch.no_grad():
            torch.manual_seed(seed)
            return torch.stack([self(image[None, None])[0, 0] for _ in range(count)])


def _block(inputs: int, outputs: int) -> nn.Sequential:
    layers: list[nn.Module] = []
    for a in (inputs, outputs):
        layers += [nn.Conv2d(a, outputs, 3, padding=1), nn.BatchNorm2d(outputs), nn.ReLU()]
    return nn.Sequential(*layers)


def uncertain_removed(passes: NDArray[np.float32], share: float = UNCERTAIN) -> NDArray[np.float64]:
    """``passes[K, ...]``, K >= 2 -> their means ``[...]``, 0 where the standard deviation (over K) is above ``share``
    times the mean."""
    values = passes.astype(np.float64)
    mean = values.mean(axis=0)
    return np.where(values.std(axis=0) > share * mean, 0.0, mean)


def _own_random_numbers(device: torch.device) -> Any:
    """Random numbers drawn inside leave those of the caller alone."""
    return torch.random.fork_rng(devices=[device] if device.type == "cuda" else [])


def save_shan(path: str | Path, network: ShanNet, provenance: Mapping[str, Any] | None = None) -> None:
    """Weights, and where they come from, as a ``.pt`` file of tensors and text."""
    state = {key: value.cpu() for key, value in network.state_dict().items()}
    torch.save({"shan": state, "provenance": json.dumps(dict(provenance or {}))}, path)


def is_shan(path: str | Path) -> bool:
    """Whether a ``.pt`` file holds weights of a ``ShanNet``; False also for a file that cannot be read."""
    try:
        return "first.0.bias" in _state(path)
    except Exception:
        return False


def _state(path: str | Path) -> Mapping[str, Any]:
    saved: Mapping[str, Any] = torch.load(path, map_location="cpu", weights_only=True)
    state: Mapping[str, Any] = saved.get("shan", saved)
    return state


def load_shan(path: str | Path) -> ShanNet:
    """A network from what ``save_shan`` wrote, or a ``.pt`` ``state_dict``, its width read off the weights. Raises
    NetworkError."""
    try:
        state = _state(path)
        network = ShanNet(len(state["first.0.bias"]) / FILTERS[0])
        network.load_state_dict(state)
    except Exception as error:
        raise NetworkError(f"{path}: no weights of a ShanNet: {' '.join(str(error).split())[:200]}") from None
    return network


def shan_method(weights: str | Path | ShanNet, passes: int = PASSES, seed: int = 0) -> Method:
    """The network behind the interface of the baselines, on the device it is on. ``passes`` >= 2; the same seed gives
    the same points on the CPU of one machine."""
    if passes < 2:
        raise ValueError(f"{passes} passes: a standard deviation needs 2 or more")
    network = weights if isinstance(weights, ShanNet) else load_shan(weights)

    def run(distance: U16, intensity: U8, rules: Rules) -> tuple[U16, U8]:
        scale = rules.distance_unit_m / FULL_SCALE_M
        image = torch.from_numpy(np.where(rules.valid(distance), distance * scale, 0).astype(np.float32))
        metres = uncertain_removed(network.passes(image, passes, seed).cpu().numpy())[1:-1:2] * FULL_SCALE_M
        counts = np.floor(metres / rules.distance_unit_m + 0.5)
        keep = (counts >= rules.min_count) & (counts <= rules.max_count)
        grey = valid_mean(distance, intensity, rules)[1]
        return np.where(keep, counts, 0).astype(np.uint16), np.where(keep, grey, 0).astype(np.uint8)

    return run


def train_shan(
    frames: Sequence[Frame],
    rules: Rules,
    *,
    width: float,
    steps: int,
    crop_columns: int = 256,
    batch: int = 4,
    learning_rate: float = 1e-3,
    seed: int = 0,
    validation: Sequence[Frame] = (),
    progress: Progress = lambda *_: None,
    device: torch.device | None = None,
) -> ShanNet:
    """Fits a network on crops of frames of equal rows: L1 over the rows that have a truth, an empty pixel being 0.

    One thread on the CPU, where the same arguments give the same bits on one machine. ``progress`` is called every 25
    steps; the loss on ``validation`` (one crop of each frame, nothing dropped) changes nothing of the weights. The
    network stays on ``device``.
    """
    if not frames:
        raise ValueError("no frames to train on")
    device = device or torch.device("cpu")
    rng = np.random.default_rng(seed)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with _own_random_numbers(device):
            torch.manual_seed(seed)
            network = ShanNet(width).to(device).train()
            held = np.stack([_image(f.distance[:, :crop_columns], rules) for f in validation]) if validation else None
            optimiser = torch.optim.Adam(network.parameters(), learning_rate)
            schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
            losses: list[float] = []
            for step in range(1, steps + 1):
                crops = np.stack([_crop(frames, rules, crop_columns, rng) for _ in range(batch)])
                loss = _loss(network, torch.from_numpy(crops).to(device))
                optimiser.zero_grad()
                loss.backward()  # type: ignore[no-untyped-call]
                optimiser.step()
                schedule.step()
                losses.append(float(loss.detach()))
                if not math.isfinite(losses[-1]):
                    raise ValueError(f"the loss of step {step} is {losses[-1]}; lower the learning rate")
                if step % LOG_STEPS == 0 or step == steps:
                    progress(step, steps, float(np.mean(losses)), _held_out_loss(network, held))
                    losses.clear()
    finally:
        torch.set_num_threads(threads)
    return network.eval()


def _loss(network: ShanNet, images: Tensor) -> Tensor:
    """Of images ``[N, R, C]`` whose even rows are given."""
    made = network(images[:, None, 0::2])[:, 0]
    judged = images[:, 1:-1:2]
    return torch.as_tensor((made[:, 1 : 2 * judged.shape[1] : 2] - judged).abs().mean())


def _held_out_loss(network: ShanNet, images: NDArray[np.float32] | None) -> float | None:
    """Nothing dropped, normalised as in use; the network is left as it was."""
    if images is None:
        return None
    network.eval()
    with torch.no_grad():
        one_by_one = torch.split(torch.from_numpy(images).to(network.output.weight.device), 1)
        loss = float(np.mean([float(_loss(network, image)) for image in one_by_one]))
    network.train()
    return loss


def _image(counts: U16, rules: Rules) -> NDArray[np.float32]:
    """``[R, W]`` counts / 80 m."""
    return np.where(rules.valid(counts), counts * (rules.distance_unit_m / FULL_SCALE_M), 0).astype(np.float32)


def _crop(frames: Sequence[Frame], rules: Rules, columns: int, rng: np.random.Generator) -> NDArray[np.float32]:
    """Some neighbouring columns of a frame, ``[R, columns]`` / 80 m; over the seam too."""
    counts = frames[int(rng.integers(len(frames)))].distance
    return _image(np.roll(counts, -int(rng.integers(counts.shape[1])), axis=1)[:, :columns], rules)
