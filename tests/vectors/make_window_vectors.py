"""Makes window_network.npz: what PyTorch computes for window networks, in float64. Needs PyTorch; run it from any
folder.

The main tests compare with the stored values, so that they need no PyTorch; ``make test-train`` checks that this
script still gives them.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

SEED = 215
WIDTHS = ((8, 2, 12), (4, 2, 12), (2, 1, 3), (10, 6, 5))
TARGET = Path(__file__).with_name("window_network.npz")


class PaperNetwork(torch.nn.Module):
    """The published graph, written from its description: nothing here comes from the package under test."""

    def __init__(self, c1: int, c2: int, hidden: int) -> None:
        super().__init__()
        self.conv1 = torch.nn.Conv1d(1, c1, 1)
        self.conv2 = torch.nn.Conv1d(c1, c2, 1)
        self.linear_1 = torch.nn.Linear(6 * c2 + 1, hidden)
        self.linear_2 = torch.nn.Linear(hidden, 1)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        features = torch.flatten(self.conv2(self.conv1(x.unsqueeze(1))), 1)
        with_minimum = torch.cat([features, torch.amin(x, 1, keepdim=True)], 1)
        return torch.relu(self.linear_2(torch.nn.functional.leaky_relu(self.linear_1(with_minimum), 0.01))).squeeze(1)


def windows(rng: np.random.Generator) -> np.ndarray:
    """Random metres, and the extremes: empty, full scale, alternating, a single return, huge."""
    extreme = [[0] * 6, [80] * 6, [131.07] * 6, [0, 80] * 3, [80, 0] * 3, [1e6] * 6]
    single = np.eye(6) * 42.0
    return np.concatenate([rng.uniform(0, 80, (200, 6)), rng.uniform(0, 255, (50, 6)), np.array(extreme), single])


def make() -> dict[str, np.ndarray]:
    torch.manual_seed(SEED)
    x = windows(np.random.default_rng(SEED))
    arrays = {"windows": x}
    for k, widths in enumerate(WIDTHS):
        network = PaperNetwork(*widths).double()
        for name, tensor in network.state_dict().items():
            arrays[f"{k}.{name}"] = tensor.numpy()
        with torch.no_grad():
            arrays[f"{k}.y"] = network(torch.from_numpy(x)).numpy()
    return arrays


if __name__ == "__main__":
    np.savez(TARGET, **make())
    print(f"{TARGET.name}: {len(WIDTHS)} networks, seed {SEED}")
