"""The network of Shan et al. 2020, "Simulation-based Lidar Super-resolution for Ground Vehicles": a U-Net on range
images whose dropout stays on, and which removes what it is not sure of. A baseline of thousands of times the work of a
window network. Needs PyTorch.

Written from the paper's description: a transposed convolution brings the image to its full rows; encoder blocks of two
3 x 3 convolutions, each with batch normalisation and ReLU, 64 to 1024 filters, with average pooling between; a decoder
of transposed convolutions with skip connections; one convolution without normalisation as the output; L1 loss, Adam;
50 Monte-Carlo passes, a pixel removed where their standard deviation is above 0.03 of their mean.

Assumed, where that leaves it open or the task differs: distances are divided by 80 m (our range limit); dropout of 0.25
after each block but the first and the last; twice the rows instead of four times, so one transposed convolution instead
of two; the output passes a ReLU; columns beyond the image are 0. The network makes ranges only: intensities are those
of the valid-neighbour mean.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from .baselines import Method, valid_mean
from .frames import Frame
from .network import NetworkError
from .rules import Rules

__all__ = ["ShanNet", "load_shan", "shan_method", "train_shan", "uncertain_removed"]

U16 = NDArray[np.uint16]
U8 = NDArray[np.uint8]

FULL_SCALE_M = 80.0
"""What the network sees as 1."""
FILTERS = (64, 128, 256, 512, 1024)
DROPOUT = 0.25
UNCERTAIN = 0.03
"""A pixel is removed where the passes' standard deviation is above this share of their mean."""
_TILE = 2 ** (len(FILTERS) - 1)
"""Rows and columns are padded to a multiple of this, for the poolings."""


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
        with torch.random.fork_rng(devices=[]), torch.no_grad():
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


def load_shan(path: str | Path) -> ShanNet:
    """A network from a ``.pt`` ``state_dict`` of ``ShanNet``, its width read off the weights. Raises NetworkError."""
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
        network = ShanNet(len(state["first.0.bias"]) / FILTERS[0])
        network.load_state_dict(state)
    except Exception as error:
        raise NetworkError(f"{path}: no weights of a ShanNet: {' '.join(str(error).split())[:200]}") from None
    return network


def shan_method(weights: str | Path | ShanNet, passes: int = 50, seed: int = 0) -> Method:
    """The network behind the interface of the baselines. ``passes`` >= 2; the same seed gives the same points on the
    CPU of one machine."""
    if passes < 2:
        raise ValueError(f"{passes} passes: a standard deviation needs 2 or more")
    network = weights if isinstance(weights, ShanNet) else load_shan(weights)

    def run(distance: U16, intensity: U8, rules: Rules) -> tuple[U16, U8]:
        scale = rules.distance_unit_m / FULL_SCALE_M
        image = torch.from_numpy(np.where(rules.valid(distance), distance * scale, 0).astype(np.float32))
        metres = uncertain_removed(network.passes(image, passes, seed).numpy())[1:-1:2] * FULL_SCALE_M
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
) -> ShanNet:
    """Fits a network on crops of frames of equal rows, on one CPU thread: L1 over the rows that have a truth, an empty
    pixel being 0. The same arguments give the same bits on one machine."""
    if not frames:
        raise ValueError("no frames to train on")
    rng = np.random.default_rng(seed)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            network = ShanNet(width).train()
            optimiser = torch.optim.Adam(network.parameters(), learning_rate)
            for _ in range(steps):
                crops = torch.from_numpy(np.stack([_crop(frames, rules, crop_columns, rng) for _ in range(batch)]))
                made = network(crops[:, None, 0::2])[:, 0]
                loss = (made[:, 1:-1:2] - crops[:, 1:-1:2]).abs().mean()
                optimiser.zero_grad()
                loss.backward()
                optimiser.step()
    finally:
        torch.set_num_threads(threads)
    return network.eval()


def _crop(frames: Sequence[Frame], rules: Rules, columns: int, rng: np.random.Generator) -> NDArray[np.float32]:
    """Some neighbouring columns of a frame, ``[R, columns]`` / 80 m; over the seam too."""
    counts = frames[int(rng.integers(len(frames)))].distance
    counts = np.roll(counts, -int(rng.integers(counts.shape[1])), axis=1)[:, :columns]
    return np.where(rules.valid(counts), counts * (rules.distance_unit_m / FULL_SCALE_M), 0).astype(np.float32)
