"""The window network: 215 parameters as published, 109 once folded.

A window is 2 rows x 3 columns, ordered ``[r0c-1, r0c0, r0c+1, r1c-1, r1c0, r1c+1]``. Values are metres or 8-bit
intensities.
Two pointwise convolutions and the linear part of the first dense layer are one affine map, so the dense network
folds exactly: ``y = relu(c + skip * min + v . leaky(A . [x0..x5, min] + b))``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["FoldedNetwork", "NetworkError", "WindowNetwork", "from_state_dict", "load_state_dict"]

FloatArray = NDArray[np.float64]

WINDOW = 6
"""Pixels of a window."""
PAPER_WIDTHS = (8, 2, 12)
"""conv1 filters, conv2 filters, hidden units of the published network."""
PAPER_SLOPE = 0.01


class NetworkError(ValueError):
    """Weights that do not make a window network: names the tensor, its shape and the shape expected."""


def _leaky(x: FloatArray, slope: float) -> FloatArray:
    return np.where(x > 0, x, slope * x)


@dataclass(frozen=True)
class FoldedNetwork:
    """The executed graph. ``weight[H, 7]`` (six pixels, then their minimum), ``bias[H]``, ``output_weight[H]``."""

    weight: FloatArray
    bias: FloatArray
    output_weight: FloatArray
    output_bias: float
    skip: float
    slope: float
    positive: bool = True
    """The output is ``max(y, 0)``."""

    @property
    def hidden(self) -> int:
        return len(self.bias)

    @property
    def parameters(self) -> int:
        """Weights and biases; the skip is a constant of the graph, not a parameter."""
        return self.weight.size + self.bias.size + self.output_weight.size + 1

    @property
    def multiply_adds(self) -> int:
        """Per window: the weights of the two layers (biases start the accumulators; the skip is an addition)."""
        return self.weight.size + self.output_weight.size

    def __call__(self, windows: ArrayLike) -> FloatArray:
        """``windows[..., 6]`` -> ``y[...]``, in float64."""
        x = _with_minimum(windows)
        hidden = _leaky(x @ self.weight.T + self.bias, self.slope)
        y = np.asarray(hidden @ self.output_weight + self.output_bias + self.skip * x[..., -1])
        return np.maximum(y, 0.0) if self.positive else y

    def magnitude(self, windows: ArrayLike) -> FloatArray:
        """Sum of |w x| over the whole graph: the scale that rounding errors are measured against."""
        x = np.abs(_with_minimum(windows))
        hidden = x @ np.abs(self.weight).T + np.abs(self.bias)
        terms = hidden @ np.abs(self.output_weight) + abs(self.output_bias) + abs(self.skip) * x[..., -1]
        return np.asarray(terms)


@dataclass(frozen=True)
class WindowNetwork:
    """The dense graph, any widths. Float64 arrays; defaults of ``slope``, ``inputs``, ``output`` and ``scale`` are
    the paper's."""

    conv1_weight: FloatArray
    """[C1]"""
    conv1_bias: FloatArray
    """[C1]"""
    conv2_weight: FloatArray
    """[C2, C1]"""
    conv2_bias: FloatArray
    """[C2]"""
    linear_1_weight: FloatArray
    """[H, 6 * C2 + 1]: channel-major pixels, then the minimum"""
    linear_1_bias: FloatArray
    """[H]"""
    linear_2_weight: FloatArray
    """[H]"""
    linear_2_bias: float
    slope: float = PAPER_SLOPE
    inputs: Literal["raw", "difference"] = "raw"
    """``difference``: the convolutions see the pixels minus the window's minimum."""
    output: Literal["raw", "residual"] = "raw"
    """``residual``: the network's output is added to the window's minimum."""
    scale: float = 1.0
    """The network sees values times ``scale``; its output is divided by it."""

    def __post_init__(self) -> None:
        c1, c2, hidden = self.widths
        expected = {
            "conv1_weight": (c1,),
            "conv1_bias": (c1,),
            "conv2_weight": (c2, c1),
            "conv2_bias": (c2,),
            "linear_1_weight": (hidden, WINDOW * c2 + 1),
            "linear_1_bias": (hidden,),
            "linear_2_weight": (hidden,),
        }
        for name, shape in expected.items():
            array = np.asarray(getattr(self, name), dtype=np.float64)
            if array.shape != shape:
                raise NetworkError(f"{name} has shape {list(array.shape)}, expected {list(shape)}")
            if not np.all(np.isfinite(array)):
                raise NetworkError(f"{name} holds a value that is not finite")
            object.__setattr__(self, name, array)
        if not (np.isfinite(self.linear_2_bias) and 0 <= self.slope <= 1 and 0 < self.scale < np.inf):
            raise NetworkError("linear_2_bias must be finite, slope in [0, 1], scale positive")

    @property
    def widths(self) -> tuple[int, int, int]:
        """conv1 filters, conv2 filters, hidden units."""
        return len(self.conv1_weight), len(self.conv2_weight), len(self.linear_1_weight)

    @property
    def parameters(self) -> int:
        c1, c2, hidden = self.widths
        return 2 * c1 + c2 * (c1 + 1) + hidden * (WINDOW * c2 + 2) + hidden + 1

    def __call__(self, windows: ArrayLike) -> FloatArray:
        """``windows[..., 6]`` -> ``y[...]``, layer by layer, in float64."""
        with_minimum = _with_minimum(windows) * self.scale
        pixels, minimum = with_minimum[..., :-1], with_minimum[..., -1:]
        if self.inputs == "difference":
            pixels = pixels - minimum
        first = pixels[..., None, :] * self.conv1_weight[:, None] + self.conv1_bias[:, None]
        second = self.conv2_weight @ first + self.conv2_bias[:, None]
        flat = second.reshape(*second.shape[:-2], -1)
        hidden = _leaky(np.concatenate([flat, minimum], -1) @ self.linear_1_weight.T + self.linear_1_bias, self.slope)
        y = hidden @ self.linear_2_weight + self.linear_2_bias
        if self.output == "residual":
            y = y + minimum[..., 0]
        return np.maximum(y, 0.0) / self.scale

    def fold(self) -> FoldedNetwork:
        """The same function in 7 H + 2 H + 1 parameters, computed in float64."""
        c2 = len(self.conv2_weight)
        gain = self.conv2_weight @ self.conv1_weight
        offset = self.conv2_weight @ self.conv1_bias + self.conv2_bias
        per_channel = self.linear_1_weight[:, :-1].reshape(-1, c2, WINDOW)
        pixels = np.einsum("hci,c->hi", per_channel, gain)
        minimum = self.linear_1_weight[:, -1]
        if self.inputs == "difference":
            minimum = minimum - pixels.sum(axis=1)
        return FoldedNetwork(
            weight=np.concatenate([pixels, minimum[:, None]], axis=1) * self.scale,
            bias=self.linear_1_bias + per_channel.sum(axis=2) @ offset,
            output_weight=self.linear_2_weight / self.scale,
            output_bias=self.linear_2_bias / self.scale,
            skip=1.0 if self.output == "residual" else 0.0,
            slope=self.slope,
        )


def _with_minimum(windows: ArrayLike) -> FloatArray:
    x = np.asarray(windows)
    if x.dtype != object:  # numbers of another kind, as those that count operations, go through as they are
        x = x.astype(np.float64)
    if x.shape[-1:] != (WINDOW,):
        raise NetworkError(f"windows have shape {list(x.shape)}, expected [..., {WINDOW}]")
    return np.concatenate([x, x.min(axis=-1, keepdims=True)], axis=-1)


_LAYERS = ("conv1", "conv2", "linear_1", "linear_2")


def from_state_dict(state: Mapping[str, Any], **graph: Any) -> WindowNetwork:
    """A network from a PyTorch ``state_dict`` of this layout, given as a mapping of arrays or CPU tensors.

    Keys ``conv1``, ``conv2``, ``linear_1``, ``linear_2`` with ``.weight`` and ``.bias``; widths are read off the
    shapes. ``graph`` sets ``slope``, ``inputs``, ``output``, ``scale`` where they are not the paper's.
    Raises NetworkError for missing, unexpected or misshaped tensors.
    """
    wanted = [f"{layer}.{kind}" for layer in _LAYERS for kind in ("weight", "bias")]
    missing = [key for key in wanted if key not in state]
    surplus = sorted(set(state) - set(wanted))
    if missing or surplus:
        raise NetworkError(
            f"state_dict: missing {', '.join(missing) or 'nothing'}; unexpected {', '.join(surplus) or 'nothing'}; "
            f"expected conv1, conv2, linear_1, linear_2, each with weight and bias"
        )
    arrays = {key: np.asarray(state[key], dtype=np.float64) for key in wanted}
    ranks = {"conv1.weight": 3, "conv2.weight": 3, "linear_1.weight": 2, "linear_2.weight": 2}
    for key, array in arrays.items():
        if array.ndim != ranks.get(key, 1):
            raise NetworkError(f"{key} has shape {list(array.shape)}, expected {ranks.get(key, 1)} dimensions")
    c1, c2 = len(arrays["conv1.weight"]), len(arrays["conv2.weight"])
    for key, shape in {"conv1.weight": (c1, 1, 1), "conv2.weight": (c2, c1, 1)}.items():
        if arrays[key].shape != shape:
            raise NetworkError(f"{key} has shape {list(arrays[key].shape)}, expected {list(shape)}")
    if arrays["linear_2.weight"].shape[0] != 1 or arrays["linear_2.bias"].shape != (1,):
        raise NetworkError(f"linear_2.weight has shape {list(arrays['linear_2.weight'].shape)}, expected one output")
    return WindowNetwork(
        conv1_weight=arrays["conv1.weight"][:, 0, 0],
        conv1_bias=arrays["conv1.bias"],
        conv2_weight=arrays["conv2.weight"][:, :, 0],
        conv2_bias=arrays["conv2.bias"],
        linear_1_weight=arrays["linear_1.weight"],
        linear_1_bias=arrays["linear_1.bias"],
        linear_2_weight=arrays["linear_2.weight"][0],
        linear_2_bias=float(arrays["linear_2.bias"][0]),
        **graph,
    )


def load_state_dict(path: str | Path, **graph: Any) -> WindowNetwork:
    """``from_state_dict`` on a file: ``.npz``, or ``.pt``/``.pth`` where PyTorch is installed (tensors only are
    unpickled)."""
    path = Path(path)
    try:
        if path.suffix == ".npz":
            with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
                return from_state_dict(dict(archive), **graph)
        if path.suffix in {".pt", ".pth"}:
            return from_state_dict(_torch_load(path), **graph)
    except NetworkError as error:
        raise NetworkError(f"{path}: {error}") from None
    except Exception as error:
        raise NetworkError(f"{path}: cannot be read as weights: {' '.join(str(error).split())[:200]}") from None
    raise NetworkError(f"{path}: unknown kind of weights {path.suffix!r}, expected .npz, .pt or .pth")


def _torch_load(path: Path) -> Mapping[str, Any]:
    try:
        import torch
    except ImportError:
        raise NetworkError("reading .pt needs PyTorch: pip install 'upbeam[train]'") from None
    state = torch.load(path, map_location="cpu", weights_only=True)
    if not isinstance(state, Mapping):
        raise NetworkError(f"holds a {type(state).__name__}, expected a state_dict")
    return {key: value.detach().numpy() for key, value in state.items()}
