"""NumPy: what an array library without a compiler makes of it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from ..work import Work
from .formulas import paper_graph, paper_weights
from .formulation import (
    F32,
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
    """Matrix products use ``threads`` (of the BLAS); everything else is on one."""
    if work.file.dense is not None and not quick:
        yield _paper(work)
    for tile in TILES_QUICK if quick else TILES:
        yield _products(work, tile)


def _paper(work: Work) -> Formulation:
    assert work.file.dense is not None
    nets = [(net, {k: v.astype(np.float32) for k, v in paper_weights(net).items()}) for net in work.file.dense]
    kept: list[Any] = []

    def run() -> None:
        kept[:] = [[paper_graph(np, x, w, net)] for (net, w), x in zip(nets, work.window_inputs, strict=True)]

    return Formulation("NumPy, paper graph", "paper", "windows", WINDOWS, run, lambda: join_tiles(work, kept))


def _products(work: Work, tile: int) -> Formulation:
    nets = [
        (net, net.weight.astype(np.float32), net.bias.astype(np.float32)[:, None], net.output_weight.astype(np.float32))
        for net in work.file.folded
    ]
    inputs = [tiles_of(x, tile, axis=1) for x in transposed(work)]
    outputs = [[np.empty(x.shape[1], np.float32) for x in parts] for parts in inputs]
    hidden = [np.empty((len(w), min(tile, work.windows_per_image)), np.float32) for _, w, _, _ in nets]
    bent = [np.empty_like(h) for h in hidden]

    def one(which: int, x: F32, y: F32) -> None:
        net, weight, bias, output = nets[which]
        h, b = hidden[which][:, : x.shape[1]], bent[which][:, : x.shape[1]]
        np.matmul(weight, x, out=h) if x.shape[1] == hidden[which].shape[1] else np.copyto(h, weight @ x)
        h += bias
        np.multiply(h, np.float32(net.slope), out=b)
        np.maximum(h, b, out=h)
        np.matmul(output, h, out=y)
        y += np.float32(net.output_bias)
        if net.skip:
            y += np.float32(net.skip) * x[6]
        if net.positive:
            np.maximum(y, 0, out=y)

    def run() -> None:
        for which in range(2):
            for x, y in zip(inputs[which], outputs[which], strict=True):
                one(which, x, y)

    return Formulation(
        f"NumPy, matrix products, tiles of {tile}", "tiles", "windows", WINDOWS_AND_MINIMA, run,
        lambda: join_tiles(work, [list(parts) for parts in outputs]), detail={"tile": tile},
    )  # fmt: skip
