"""ONNX graphs for ONNX Runtime and OpenVINO: the exporter's, and two of our own that suit them better."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import numpy as np

from upbeam.model.network import FoldedNetwork
from upbeam.model.rules import BEAMS, PAIRS
from upbeam.quant.export.onnx_builder import GraphBuilder
from upbeam.quant.export.onnx_graphs import dense_model, folded_model, image_model
from upbeam.quant.export.source import NETWORKS

from ..work import Work
from .formulation import (
    F32,
    IMAGE,
    TILES,
    TILES_QUICK,
    WINDOWS,
    WINDOWS_AND_MINIMA,
    WINDOWS_BY_CONVOLUTION,
    Formulation,
    join_tiles,
    tiles_of,
    transposed,
)  # fmt: skip

__all__ = ["Case", "cases", "formulation"]


@dataclass(frozen=True)
class Case:
    """A graph and its inputs: for every call a mapping of names to arrays, all calls together one frame."""

    name: str
    family: str
    kind: Literal["windows", "image"]
    does: str
    model: bytes
    calls: list[dict[str, F32]]
    outputs: tuple[str, ...]
    detail: dict[str, Any]


Runner = Callable[[Case], tuple[Callable[[], Any], Callable[[], list[dict[str, Any]]]]]
"""Prepares a case: returns how to run it, and how to get each call's outputs by name."""


def cases(work: Work, quick: bool) -> Iterator[Case]:
    """The paper's graph, the folded one in a batch and in tiles, as matrix products in tiles, as an image."""
    if work.file.dense is not None and not quick:
        yield _batch(work, "paper graph, windows in one batch", dense_model(work.source), work.windows_per_image)
    folded, products = folded_model(work.source), _products_model(work)
    whole = work.windows_per_image
    for tile in (whole,) if quick else (*TILES[:-1], whole):
        yield _batch(work, "folded graph", folded, tile)
    for tile in TILES_QUICK if quick else (*TILES[:-1], whole):
        yield _products(work, products, tile)
    if not quick:
        yield _convolution(work)
    yield _image(work)


def formulation(peer: str, work: Work, case: Case, runner: Runner) -> Formulation:
    run, results = runner(case)

    def output() -> tuple[Any, Any]:
        found = results()
        if case.kind == "image":
            images = (np.asarray(found[0][name]).reshape(-1, work.columns) for name in ("distance", "intensity"))
            distance, intensity = (image[1:-1:2] for image in images)
            return distance, intensity
        if len(case.calls) == 1 and len(case.outputs) == 2:
            return join_tiles(work, [[found[0][name]] for name in NETWORKS])
        return join_tiles(work, [[x[name] for x in found if name in x] for name in NETWORKS])

    return Formulation(f"{peer}, {case.name}", case.family, case.kind, case.does, run, output, detail=case.detail)


def _batch(work: Work, name: str, model: Any, tile: int) -> Case:
    """Windows ``[N, 6]`` of both networks in one graph."""
    parts = [tiles_of(x, tile, axis=0) for x in work.window_inputs]
    calls = [
        {f"{network}_windows": x for network, x in zip(NETWORKS, pair, strict=True)}
        for pair in zip(*parts, strict=True)
    ]
    is_whole = len(calls) == 1
    text = name if is_whole else f"{name}, tiles of {tile}"
    return Case(text, name.split()[0], "windows", WINDOWS, model.SerializeToString(), calls, NETWORKS, {"tile": tile})


def _products_model(work: Work) -> Any:
    """``NAME_taps`` [7, N] -> ``NAME`` [1, N]: windows are the columns, so that nothing is transposed."""
    g = GraphBuilder("upbeam_products")
    for network in NETWORKS:
        net = work.source.folded(network)
        taps = g.input(f"{network}_taps", [7, "N"])
        hidden = g.op("Add", g.op("MatMul", g.constant(net.weight), taps), g.constant(net.bias[:, None]))
        hidden = g.op("LeakyRelu", hidden, alpha=net.slope)
        y = g.op("Add", g.op("MatMul", g.constant(net.output_weight[None]), hidden), g.constant(net.output_bias))
        g.output(network, _finish(g, y, net, partial(g.slice, taps, 6, 7, 0)), [1, "N"])
    return g.model({"graph": "products"})


def _finish(g: GraphBuilder, y: str, net: FoldedNetwork, minimum: Callable[[], str]) -> str:
    if net.skip:
        y = g.op("Add", y, minimum())
    return g.op("Relu", y) if net.positive else y


def _products(work: Work, model: Any, tile: int) -> Case:
    parts = [tiles_of(x, tile, axis=1) for x in transposed(work)]
    calls = [
        {f"{network}_taps": x for network, x in zip(NETWORKS, pair, strict=True)} for pair in zip(*parts, strict=True)
    ]
    return Case(
        f"matrix products, tiles of {tile}", "products", "windows", WINDOWS_AND_MINIMA, model.SerializeToString(),
        calls, NETWORKS, {"tile": tile},
    )  # fmt: skip


def _convolution(work: Work) -> Case:
    """The folded network as a convolution over rows of windows that lie side by side, minima by pooling.

    Over the image itself it would see empty pixels as zeros, which the rules forbid; filling them is most of the whole
    image's graph."""
    g = GraphBuilder("upbeam_convolution")
    for network in NETWORKS:
        net = work.source.folded(network)
        image = g.input(f"{network}_image", ["N", 1, 2, "W"])
        g.output(network, _convolved(g, image, net), ["N", 1, 1, "W"])
    calls = [
        {f"{network}_image": x for network, x in zip(NETWORKS, map(_side_by_side, work.window_inputs), strict=True)}
    ]
    return Case(
        "folded graph as a convolution", "convolution", "windows", WINDOWS_BY_CONVOLUTION,
        g.model({"graph": "convolution"}).SerializeToString(), calls, NETWORKS, {},
    )  # fmt: skip


def _convolved(g: GraphBuilder, image: str, net: FoldedNetwork) -> str:
    negative = g.op("MaxPool", g.op("Neg", image), kernel_shape=[2, 3], strides=[1, 3])
    minimum = g.op("Neg", negative)
    pixels = net.weight[:, :6].reshape(-1, 1, 2, 3)
    hidden = g.op("Conv", image, g.constant(pixels), g.constant(net.bias), kernel_shape=[2, 3], strides=[1, 3])
    of_minimum = g.op("Conv", minimum, g.constant(net.weight[:, 6].reshape(-1, 1, 1, 1)), kernel_shape=[1, 1])
    hidden = g.op("LeakyRelu", g.op("Add", hidden, of_minimum), alpha=net.slope)
    output = g.constant(net.output_weight.reshape(1, -1, 1, 1))
    y = g.op("Conv", hidden, output, g.constant(np.array([net.output_bias])), kernel_shape=[1, 1])
    return _finish(g, y, net, lambda: minimum)


def _side_by_side(windows: F32) -> F32:
    """``[N, 6]`` -> ``[31, 1, 2, 3 W]``: the windows of a row beside each other."""
    rows = windows.reshape(PAIRS, -1, 2, 3).transpose(0, 2, 1, 3)
    return np.ascontiguousarray(rows.reshape(PAIRS, 1, 2, -1))


def _image(work: Work) -> Case:
    rows = (work.distance.astype(np.float32), work.intensity.astype(np.float32))
    images = {f"{name}_in": x.reshape(1, 1, BEAMS, -1) for name, x in zip(NETWORKS, rows, strict=True)}
    return Case(
        "whole image", "image", "image", IMAGE, image_model(work.source).SerializeToString(), [images],
        ("distance", "intensity"), {},
    )  # fmt: skip
