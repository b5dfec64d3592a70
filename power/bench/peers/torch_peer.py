"""PyTorch: eager matrix products, and torch.compile where a C++ compiler is found."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from importlib import import_module
from shutil import which
from typing import Any

import numpy as np

from ..work import Work
from .formulas import (
    ImageRules,
    PlainNetwork,
    fused_image,
    fused_windows,
    paper_graph,
    paper_weights,
    product_windows,
    row_limits,
)
from .formulation import (
    IMAGE,
    TILES,
    TILES_QUICK,
    WINDOWS,
    WINDOWS_AND_MINIMA,
    Formulation,
    join_tiles,
    tiles_of,
    transposed,
)  # fmt: skip

__all__ = ["formulations"]


def formulations(work: Work, threads: int, quick: bool) -> Iterator[Formulation]:
    torch = import_module("torch")

    torch.set_num_threads(threads)
    if work.file.dense is not None and not quick:
        nets = [(net, {k: _tensor(v) for k, v in paper_weights(net).items()}) for net in work.file.dense]
        calls = [partial(paper_graph, torch, weights=w, net=net) for net, w in nets]
        yield _windows(work, "paper graph", WINDOWS, calls, [[_tensor(x)] for x in work.window_inputs])
    for tile in TILES_QUICK if quick else (*TILES[:-1], work.windows_per_image):
        yield _products(work, tile)
    if quick or not (which("g++") or which("c++")):
        return
    columns = [[tuple(_tensor(row) for row in x.T)] for x in work.window_inputs]
    plain = [PlainNetwork.folded(net) for net in work.file.folded]
    fused = [torch.compile(partial(fused_windows, torch, net=net), dynamic=False) for net in plain]
    compiled = _windows(work, "torch.compile, fused on windows", WINDOWS, fused, columns)
    compiled.detail = {"compiled": True}
    yield compiled
    yield _image(work)


def _tensor(values: Any) -> Any:
    torch = import_module("torch")

    return torch.from_numpy(np.ascontiguousarray(values, dtype=np.float32))


def _products(work: Work, tile: int) -> Formulation:
    torch = import_module("torch")

    calls = []
    for net in work.file.folded:
        weight, bias, output = (_tensor(x) for x in (net.weight, net.bias[:, None], net.output_weight[None]))
        calls.append(partial(product_windows, torch, weight=weight, bias=bias, output=output, net=net))
    inputs = [[_tensor(x) for x in tiles_of(x, tile, axis=1)] for x in transposed(work)]
    made = _windows(work, f"matrix products, tiles of {tile}", WINDOWS_AND_MINIMA, calls, inputs)
    made.family, made.detail = "products", {"tile": tile}
    return made


def _windows(
    work: Work, name: str, does: str, calls: Sequence[Callable[..., Any]], inputs: list[list[Any]]
) -> Formulation:
    """``inputs``: for each network its tiles."""
    torch = import_module("torch")

    kept: list[list[Any]] = []

    def run() -> None:
        with torch.inference_mode():
            kept[:] = [[call(x) for x in parts] for call, parts in zip(calls, inputs, strict=True)]

    return Formulation(f"PyTorch, {name}", name, "windows", does, run, lambda: join_tiles(work, kept))


def _image(work: Work) -> Formulation:
    torch = import_module("torch")

    rules = ImageRules.of(work)
    row_max = _tensor(row_limits(work.file.rules))
    call = torch.compile(lambda d, i: fused_image(torch, rules, d, i, row_max), dynamic=False)
    given = [_tensor(x) for x in (work.distance, work.intensity)]
    kept: list[Any] = []

    def run() -> None:
        with torch.inference_mode():
            kept[:] = call(*given)

    return Formulation(
        "PyTorch, torch.compile, fused on the image", "image", "image", IMAGE, run,
        lambda: (kept[0].numpy(), kept[1].numpy()), detail={"compiled": True},
    )  # fmt: skip
