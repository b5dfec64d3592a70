"""JAX: XLA compiles and fuses. It has no option for its threads: the process is bound to as many cores."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from importlib import import_module
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
    jax = import_module("jax")
    jnp = import_module("jax.numpy")

    jax.config.update("jax_platforms", "cpu")
    if work.file.dense is not None and not quick:
        nets = [
            (net, {k: jnp.asarray(v, jnp.float32) for k, v in paper_weights(net).items()}) for net in work.file.dense
        ]
        calls = [partial(paper_graph, jnp, weights=w, net=net) for net, w in nets]
        yield _windows(work, "paper graph", WINDOWS, calls, [[x] for x in work.window_inputs])
    for tile in TILES_QUICK if quick else (*TILES, work.windows_per_image):
        yield _products(work, tile)
    if not quick:
        columns = [[tuple(np.ascontiguousarray(x.T))] for x in work.window_inputs]
        fused = [partial(fused_windows, jnp, net=PlainNetwork.folded(net)) for net in work.file.folded]
        yield _windows(work, "fused element-wise code on windows", WINDOWS, fused, columns)
    yield _image(work)


def _products(work: Work, tile: int) -> Formulation:
    jnp = import_module("jax.numpy")

    calls = []
    for net in work.file.folded:
        arrays = (jnp.asarray(x, jnp.float32) for x in (net.weight, net.bias[:, None], net.output_weight[None]))
        weight, bias, output = arrays
        calls.append(partial(product_windows, jnp, weight=weight, bias=bias, output=output, net=net))
    inputs = [tiles_of(x, tile, axis=1) for x in transposed(work)]
    made = _windows(work, f"matrix products, tiles of {tile}", WINDOWS_AND_MINIMA, calls, inputs)
    made.family, made.detail = "products", {"tile": tile}
    return made


def _windows(
    work: Work, name: str, does: str, calls: Sequence[Callable[..., Any]], inputs: list[list[Any]]
) -> Formulation:
    """``inputs``: for each network its tiles."""
    jax = import_module("jax")

    compiled = [jax.jit(call) for call in calls]
    given = [[jax.device_put(x) for x in parts] for parts in inputs]
    kept: list[list[Any]] = []

    def run() -> None:
        kept[:] = [[call(x) for x in parts] for call, parts in zip(compiled, given, strict=True)]
        jax.block_until_ready(kept)

    return Formulation(f"JAX, {name}", name, "windows", does, run, lambda: join_tiles(work, kept))


def _image(work: Work) -> Formulation:
    jax = import_module("jax")
    jnp = import_module("jax.numpy")

    rules = ImageRules.of(work)
    row_max = jnp.asarray(row_limits(work.file.rules), jnp.float32)
    call = jax.jit(lambda d, i: fused_image(jnp, rules, d, i, row_max))
    given = [jax.device_put(x.astype(np.float32)) for x in (work.distance, work.intensity)]
    kept: list[Any] = []

    def run() -> None:
        kept[:] = call(*given)
        jax.block_until_ready(kept)

    return Formulation(
        "JAX, fused element-wise code on the image", "image", "image", IMAGE, run,
        lambda: (np.asarray(kept[0]), np.asarray(kept[1])),
    )  # fmt: skip
