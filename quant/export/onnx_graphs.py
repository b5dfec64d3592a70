"""Float ONNX graphs, standard operators only: the dense and the folded window network, and image in, image out.

Window graphs see what the networks of the model file see: metres, or intensities in 8-bit steps. The image graph
sees sensor counts and has all rules inside.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from upbeam.model.network import FoldedNetwork, WindowNetwork
from upbeam.model.rules import BEAMS, PAIRS, ROWS, Rules
from upbeam.quant.quantize import DifferenceNetwork, difference_network

from .onnx_builder import GraphBuilder
from .source import NETWORKS, NetworkName, Source

if TYPE_CHECKING:
    from onnx import ModelProto

__all__ = ["dense_model", "folded_model", "image_model", "metadata", "window_graph"]

FloatArray = NDArray[np.float64]
Names = Sequence[NetworkName]
Body = Callable[[GraphBuilder, str, NetworkName], str]


def dense_model(source: Source, networks: Names = NETWORKS) -> ModelProto:
    """The graph as trained, batched over windows: ``NAME_windows`` [N, 6] -> ``NAME`` [N] for each network.

    Raises ExportError where the model has no section DENS."""
    return window_graph(source, "dense", networks, lambda g, x, name: dense_body(g, x, source.dense(name)))


def folded_model(source: Source, networks: Names = NETWORKS) -> ModelProto:
    """The executed graph, batched over windows: ``NAME_windows`` [N, 6] -> ``NAME`` [N] for each network."""
    return window_graph(source, "folded", networks, lambda g, x, name: folded_body(g, x, source.folded(name)))


def window_graph(
    source: Source, kind: str, networks: Names, body: Body, extra: Mapping[str, str] | None = None
) -> ModelProto:
    """``body`` makes each network's part: graph, name of its windows, network -> name of its output."""
    g = GraphBuilder(f"upbeam_{kind}")
    for name in networks:
        windows = g.input(f"{name}_windows", ["N", 6])
        g.output(name, body(g, windows, name), ["N"])
    return g.model(metadata(source, kind, "metres; intensities in 8-bit steps") | dict(extra or {}))


def metadata(source: Source, kind: str, unit: str) -> dict[str, str]:
    return {"graph": kind, "unit": unit, "model_crc32": f"{source.crc32:08x}", **dict(source.describe())}


# ------------------------------------------------------------------------------------------------ window graphs


def dense_body(g: GraphBuilder, windows: str, net: WindowNetwork) -> str:
    """[N, 6] -> [N], layer by layer as trained. The pointwise convolutions are 1 x 1 on [N, C, 6, 1]: TensorRT's are of
    two dimensions."""
    x = windows if net.scale == 1 else g.op("Mul", windows, g.constant(net.scale))
    minimum = g.op("ReduceMin", x, axes=[1], keepdims=1)
    pixels = g.op("Sub", x, minimum) if net.inputs == "difference" else x
    y = g.op("Unsqueeze", pixels, g.integers(1, 3))
    y = _conv(g, y, net.conv1_weight[:, None], net.conv1_bias)
    y = _conv(g, y, net.conv2_weight, net.conv2_bias)
    flat = g.op("Concat", g.op("Flatten", y, axis=1), minimum, axis=1)
    hidden = g.op("LeakyRelu", _dense(g, flat, net.linear_1_weight, net.linear_1_bias), alpha=net.slope)
    y = _dense(g, hidden, net.linear_2_weight[None], np.array([net.linear_2_bias]))
    if net.output == "residual":
        y = g.op("Add", y, minimum)
    y = g.op("Relu", y)
    if net.scale != 1:
        y = g.op("Div", y, g.constant(net.scale))
    return g.op("Squeeze", y, g.integers(1))


def folded_body(g: GraphBuilder, windows: str, net: FoldedNetwork) -> str:
    """[N, 6] -> [N]."""
    minimum = g.op("ReduceMin", windows, axes=[1], keepdims=1)
    inputs = g.op("Concat", windows, minimum, axis=1)
    hidden = g.op("LeakyRelu", _dense(g, inputs, net.weight, net.bias), alpha=net.slope)
    y = _dense(g, hidden, net.output_weight[None], np.array([net.output_bias]))
    if net.skip:
        y = g.op("Add", y, minimum)
    if net.positive:
        y = g.op("Relu", y)
    return g.op("Squeeze", y, g.integers(1))


def _dense(g: GraphBuilder, x: str, weight: FloatArray, bias: FloatArray) -> str:
    return g.op("Gemm", x, g.constant(weight), g.constant(bias), transB=1)


def _conv(g: GraphBuilder, x: str, weight: FloatArray, bias: FloatArray) -> str:
    """``weight`` [out, in] as a 1 x 1 convolution."""
    return g.op("Conv", x, g.constant(weight[:, :, None, None]), g.constant(bias), kernel_shape=[1, 1])


# -------------------------------------------------------------------------------------------------- image graph


def image_model(source: Source, networks: Names = NETWORKS) -> ModelProto:
    """A whole image with all rules: ``distance_in``, ``intensity_in`` [N, 1, 32, W] -> ``distance``, ``intensity``
    [N, 1, 64, W].

    float32 sensor counts and 8-bit intensities; W and N may vary. Both ends of an image are edges. ``networks``
    chooses the outputs; distances are an input in any case, since an intensity stands only where a distance does.
    """
    g = GraphBuilder("upbeam_image")
    rules = source.file.rules
    shape: list[int | str] = ["N", 1, BEAMS, "W"]
    distance = g.input("distance_in", shape)
    seen = _within(g, distance, rules, slice(0, None, 2))
    windows = _Windows(g, rules, _where_seen(g, seen, distance))
    net = difference_network(source.folded("distance"), source.unit("distance"))
    counts, least = _rounded(g, net, windows.of_distance())
    given = _within(g, counts, rules, slice(1, -1, 2))
    if rules.empty == "fill":
        given = g.op("And", given, g.op("Greater", least, _scalar(g, 0)))
    if "distance" in networks:
        rows = _interleaved(g, distance, _where_seen(g, given, counts), rules)
        g.output("distance", rows, ["N", 1, ROWS, "W"])
    if "intensity" in networks:
        intensity = g.input("intensity_in", shape)
        net = difference_network(source.folded("intensity"), 1.0)
        grey, _ = _rounded(g, net, windows.of_intensity(_where_seen(g, seen, intensity)))
        grey = _where_seen(g, given, g.op("Clip", grey, g.constant(0.0), g.constant(255.0)))
        g.output("intensity", _interleaved(g, intensity, grey, rules), ["N", 1, ROWS, "W"])
    return g.model(metadata(source, "image", "sensor counts; intensities in 8-bit steps"))


def _scalar(g: GraphBuilder, value: float) -> str:
    """Of rank four, so that no engine need broadcast ranks."""
    return g.constant(np.full((1, 1, 1, 1), value))


def _within(g: GraphBuilder, counts: str, rules: Rules, rows: slice) -> str:
    """Between the nearest count and each row's farthest."""
    farthest = g.constant(rules.row_max_count[rows].reshape(1, 1, -1, 1))
    near = g.op("GreaterOrEqual", counts, _scalar(g, rules.min_count))
    return g.op("And", near, g.op("LessOrEqual", counts, farthest))


def _where_seen(g: GraphBuilder, seen: str, values: str) -> str:
    return g.op("Where", seen, values, _scalar(g, 0))


@dataclass(frozen=True)
class _Pair:
    """Upper and lower row of all windows, [N, 1, 31, W] each."""

    top: str
    bottom: str


class _Windows:
    """The six pixels of every window after the rules. A pixel is empty where its distance is 0: no count seen is."""

    def __init__(self, g: GraphBuilder, rules: Rules, distance: str) -> None:
        self._g = g
        self._fill = rules.empty == "fill"
        self._rows = self._split(distance)
        self._valid = _Pair(self._seen(self._rows.top), self._seen(self._rows.bottom))
        self._distance = self._filled_rows(self._rows)
        self._column_seen = [self._seen(x) for x in self._columns(self._distance.top)]

    def of_distance(self) -> list[str]:
        return self._six(self._distance)

    def of_intensity(self, intensity: str) -> list[str]:
        return self._six(self._filled_rows(self._split(intensity)))

    def _seen(self, distance: str) -> str:
        return self._g.op("Greater", distance, _scalar(self._g, 0))

    def _split(self, image: str) -> _Pair:
        return _Pair(self._g.slice(image, 0, PAIRS, 2), self._g.slice(image, 1, BEAMS, 2))

    def _filled_rows(self, x: _Pair) -> _Pair:
        """An empty pixel takes the other beam's value."""
        if not self._fill:
            return x
        g, valid = self._g, self._valid
        return _Pair(g.op("Where", valid.top, x.top, x.bottom), g.op("Where", valid.bottom, x.bottom, x.top))

    def _columns(self, rows: str) -> list[str]:
        """Left, middle and right neighbour of every column; beyond the ends everything is empty."""
        g = self._g
        padded = g.op("Pad", rows, g.integers(0, 0, 0, 1, 0, 0, 0, 1), mode="constant")
        last = np.iinfo(np.int64).max
        return [g.slice(padded, 0, -2, 3), g.slice(padded, 1, -1, 3), g.slice(padded, 2, last, 3)]

    def _six(self, rows: _Pair) -> list[str]:
        columns = [self._columns(rows.top), self._columns(rows.bottom)]
        return [x for three in columns for x in (self._filled_columns(three) if self._fill else three)]

    def _filled_columns(self, three: list[str]) -> list[str]:
        """An empty column takes the nearest column's values; the middle one the smaller of its neighbours'."""
        g = self._g
        left, middle, right = three
        has_left, has_middle, has_right = self._column_seen
        both = g.op("And", has_left, has_right)
        one = g.op("Where", has_left, left, right)
        between = g.op("Where", both, g.op("Min", left, right), one)
        return [
            g.op("Where", has_left, left, g.op("Where", has_middle, middle, right)),
            g.op("Where", has_middle, middle, between),
            g.op("Where", has_right, right, g.op("Where", has_middle, middle, left)),
        ]


def _rounded(g: GraphBuilder, net: DifferenceNetwork, six: list[str]) -> tuple[str, str]:
    """Whole outputs and window minima, [N, 1, 31, W]. The minimum is added after rounding: it is whole."""
    windows = g.op("Concat", *six, axis=1)
    least = g.op("ReduceMin", windows, axes=[1], keepdims=1)
    inputs = g.op("Concat", g.op("Sub", windows, least), least, axis=1)
    weight = np.concatenate([net.weight, net.minimum[:, None]], axis=1)
    hidden = g.op("LeakyRelu", _conv(g, inputs, weight, net.bias), alpha=net.slope)
    rest = _conv(g, hidden, net.output[None], np.array([net.offset]))
    whole = g.op("Floor", g.op("Add", rest, _scalar(g, 0.5)))
    return (g.op("Add", whole, least) if net.skip else whole), least


def _interleaved(g: GraphBuilder, sensor: str, generated: str, rules: Rules) -> str:
    """Sensor rows [N, 1, 32, W] and generated ones [N, 1, 31, W] -> [N, 1, 64, W]."""
    if rules.last_row == "repeat":
        odd = g.op("Concat", generated, g.slice(sensor, BEAMS - 1, BEAMS, 2), axis=2)
    else:
        odd = g.op("Pad", generated, g.integers(0, 0, 0, 0, 0, 0, 1, 0), mode="constant")
    pairs = g.op("Transpose", g.op("Concat", sensor, odd, axis=1), perm=[0, 2, 1, 3])
    return g.op("Reshape", pairs, g.integers(0, 1, ROWS, -1))
