"""Static int8 in ONNX: QuantizeLinear and DequantizeLinear around the products, float elsewhere.

This is not the integer contract: rescaling is in float, and devices round it their own way (``docs/export.md``). It is
what GPU and NPU compilers take. ``peer_static_int8`` is the same job done by ONNX Runtime's own quantiser.
"""

from __future__ import annotations

import io
import logging
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, redirect_stdout
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from upbeam.model.network import WINDOW, FoldedNetwork
from upbeam.quant.quantize import Calibration, DifferenceNetwork, difference_network

from .onnx_builder import GraphBuilder, require, session
from .onnx_graphs import folded_body, window_graph
from .source import NETWORKS, ExportError, NetworkName, Source

if TYPE_CHECKING:
    from onnx import ModelProto

__all__ = ["METHODS", "CalibrationMethod", "PeerGraph", "peer_static_int8", "qdq_model"]

FloatArray = NDArray[np.float64]
I64 = NDArray[np.int64]
CalibrationMethod = Literal["minmax", "percentile", "entropy"]
METHODS: tuple[CalibrationMethod, ...] = get_args(CalibrationMethod)
PeerGraph = Literal["folded", "difference"]

LARGEST = 127
"""Symmetric: TensorRT takes no zero point but 0, and weights of +-127."""
BATCH = 8192
_DETAIL: dict[CalibrationMethod, dict[str, Any]] = {
    "minmax": {"symmetric": True},
    "percentile": {"symmetric": True, "percentile": 99.99, "num_bins": 8192},
    "entropy": {"symmetric": True, "num_bins": 2048},
}


def qdq_model(
    source: Source,
    calibration: Calibration,
    method: CalibrationMethod = "percentile",
    networks: Sequence[NetworkName] = NETWORKS,
    origin: str = "not told",
) -> ModelProto:
    """``NAME_windows`` [N, 6] -> ``NAME`` [N], as ``folded_model``, with int8 products.

    ``y = skip m + c + V leaky(W d + M m + b)``, ``m`` the window's minimum, ``d`` the differences from it. ``W`` and
    ``V`` are int8, a scale for each channel; ``d`` and the hidden values are int8, one scale for all; the minimum's
    path and the sums are float. Scales come from ``calibration``'s windows, by ONNX Runtime's calibrators.
    ``origin`` of the windows goes into the model's metadata."""
    _check_method(method)
    plans = {
        name: _plan(
            difference_network(source.folded(name), 1.0), getattr(calibration, name) * source.unit(name), method
        )
        for name in networks
    }

    def body(g: GraphBuilder, x: str, name: NetworkName) -> str:
        y = _qdq_body(g, x, plans[name])
        return g.op("Relu", y) if source.folded(name).positive else y

    used = f"{method}, {len(calibration.distance)} windows: {origin}"
    return window_graph(source, "qdq", networks, body, {"calibration": used})


def _check_method(method: str) -> None:
    if method not in METHODS:
        raise ExportError(f"calibration method {method!r}, expected {', '.join(METHODS)}")


@dataclass(frozen=True)
class _Plan:
    """A network whose hidden values all lie within 1 of ``centre``, and the range of the differences."""

    net: DifferenceNetwork
    centre: FloatArray
    """[H] middle of each hidden value's range: taken off before quantising, since the zero point must be 0."""
    reach: float
    """Largest difference that is not cut."""


def _plan(net: DifferenceNetwork, windows: FloatArray, method: CalibrationMethod) -> _Plan:
    """Each hidden unit gets a scale of its own: a positive factor passes the rectifier."""
    sums = net.sums(windows)
    net, sums = _scaled(net, sums, np.abs(sums).max(axis=0))
    reach, limit = _ranges(net, windows, method)
    hidden = np.clip(np.where(sums > 0, sums, net.slope * sums), -limit, limit)
    low, high = hidden.min(axis=0), hidden.max(axis=0)
    half = np.maximum((high - low) / 2, 1e-6)
    centre = np.round((high + low) / 2 / half * LARGEST) / LARGEST  # so that 0 stands on the grid
    return _recentred(_Plan(_scaled(net, sums, half)[0], centre, reach), windows)


def _recentred(plan: _Plan, windows: FloatArray) -> _Plan:
    """With the output bias that leaves no median error on the calibration windows: rounding errors of neighbouring
    windows are alike, and do not cancel."""
    g = GraphBuilder("recentred")
    g.output("y", _qdq_body(g, g.input("windows", ["N", WINDOW]), plan), ["N"])
    made = _outputs(session(g.model({})), windows) - plan.net.skip * windows.min(axis=1)
    error = float(np.median(plan.net.rest(windows) - made))
    return replace(plan, net=replace(plan.net, offset=plan.net.offset + error))


def _scaled(net: DifferenceNetwork, sums: FloatArray, by: FloatArray) -> tuple[DifferenceNetwork, FloatArray]:
    by = np.maximum(by, 1e-12)
    weight, minimum, bias = net.weight / by[:, None], net.minimum / by, net.bias / by
    return replace(net, weight=weight, minimum=minimum, bias=bias, output=net.output * by), sums / by


def _qdq_body(g: GraphBuilder, windows: str, plan: _Plan) -> str:
    """[N, 6] -> [N]. What is taken off before quantising comes back with the biases, by the weights on their grid."""
    net, middle = plan.net, plan.reach / 2
    least = g.op("ReduceMin", windows, axes=[1], keepdims=1)
    d = _on_plane(g, g.op("Sub", windows, g.op("Add", least, g.constant([[middle]]))))
    weight, on_grid = _quantised_weight(g, net.weight)
    sums = _product(g, _quantised(g, d, middle / LARGEST), weight, net.bias + middle * on_grid.sum(axis=1))
    z = g.op("Sub", _rectified(g, net, sums, least), g.constant(plan.centre[None, :, None, None]))
    weight, on_grid = _quantised_weight(g, net.output[None])
    y = _product(g, _quantised(g, z, 1.0 / LARGEST), weight, net.offset + on_grid @ plan.centre)
    return _with_minimum(g, net, y, least)


def _float_body(g: GraphBuilder, windows: str, net: DifferenceNetwork) -> tuple[str, tuple[str, str]]:
    """The same graph in float: to be calibrated. [N, 6] -> [N], and the inputs of its two products."""
    least = g.op("ReduceMin", windows, axes=[1], keepdims=1)
    d = _on_plane(g, g.op("Sub", windows, least))
    z = _rectified(g, net, _product(g, d, g.constant(net.weight[:, :, None, None]), net.bias), least)
    y = _product(g, z, g.constant(net.output[None, :, None, None]), np.array([net.offset]))
    return _with_minimum(g, net, y, least), (d, z)


def _on_plane(g: GraphBuilder, x: str) -> str:
    return g.op("Unsqueeze", x, g.integers(2, 3))


def _product(g: GraphBuilder, x: str, weight: str, bias: FloatArray) -> str:
    """A convolution of 1 x 1: what TensorRT 8 knows in int8 with a scale for each channel."""
    return g.op("Conv", x, weight, g.constant(bias), kernel_shape=[1, 1])


def _rectified(g: GraphBuilder, net: DifferenceNetwork, sums: str, least: str) -> str:
    near = g.op("Mul", _on_plane(g, least), g.constant(net.minimum[None, :, None, None]))
    return g.op("LeakyRelu", g.op("Add", sums, near), alpha=net.slope)


def _with_minimum(g: GraphBuilder, net: DifferenceNetwork, y: str, least: str) -> str:
    y = g.op("Squeeze", y, g.integers(1, 2, 3))
    return g.op("Add", y, g.op("Squeeze", least, g.integers(1))) if net.skip else y


def _quantised(g: GraphBuilder, value: str, step: float) -> str:
    return _pair(g, value, g.constant(np.float32(step)), g.constant(np.int8(0), np.int8))


def _quantised_weight(g: GraphBuilder, weight: FloatArray) -> tuple[str, FloatArray]:
    """[out, in] -> [out, in, 1, 1] with a scale for each output, and its values on their grid. Stored in float: older
    TensorRT wants it so."""
    scale = (np.maximum(np.abs(weight).max(axis=1), 1e-30) / LARGEST).astype(np.float32)
    zero = g.constant(np.zeros(len(weight)), np.int8)
    name = _pair(g, g.constant(weight[:, :, None, None]), g.constant(scale), zero, axis=0)
    step = scale.astype(np.float64)[:, None]
    return name, np.round(weight.astype(np.float32) / step) * step


def _pair(g: GraphBuilder, value: str, scale: str, zero: str, **axis: int) -> str:
    return g.op("DequantizeLinear", g.op("QuantizeLinear", value, scale, zero, **axis), scale, zero, **axis)


# -------------------------------------------------------------------------------------------------- calibration


def _ranges(net: DifferenceNetwork, windows: FloatArray, method: CalibrationMethod) -> tuple[float, float]:
    """What differences and hidden values reach, in magnitude, by ONNX Runtime's calibrators."""
    calibrate = require("onnxruntime.quantization.calibrate")
    g = GraphBuilder("calibrated")
    y, activations = _float_body(g, g.input("windows", ["N", WINDOW]), net)
    g.output("y", y, ["N"])
    with _temporary(g.model({})) as path:
        calibrator = calibrate.create_calibrator(
            str(path),
            ["Conv"],
            augmented_model_path=str(path.with_name("augmented.onnx")),
            calibrate_method=_method(method),
            extra_options=_DETAIL[method],
        )
        calibrator.collect_data(_Reader(windows))
        found = calibrator.compute_data().data
    d, z = (max(abs(np.min(found[name].lowest)), abs(np.max(found[name].highest))) for name in activations)
    return max(float(d), 1e-6), max(float(z), 1e-6)


def _method(method: CalibrationMethod) -> Any:
    methods = require("onnxruntime.quantization").CalibrationMethod
    return {"minmax": methods.MinMax, "percentile": methods.Percentile, "entropy": methods.Entropy}[method]


class _Reader:
    """All windows at once: ONNX Runtime's histograms take batches of one size only."""

    def __init__(self, windows: NDArray[Any]) -> None:
        self._batches = iter([{"windows": windows.astype(np.float32)}])

    def get_next(self) -> dict[str, NDArray[np.float32]] | None:
        return next(self._batches, None)


def _outputs(run: Any, windows: NDArray[Any]) -> FloatArray:
    """[N, 6] -> [N], of a graph from ``windows`` to one output."""
    batches = range(0, len(windows), BATCH)
    parts = [run.run(None, {"windows": windows[k : k + BATCH].astype(np.float32)})[0] for k in batches]
    return np.concatenate([*parts, np.zeros(0)]).astype(np.float64)


@contextmanager
def _temporary(model: ModelProto) -> Iterator[Path]:
    """The model as a file: calibrators and quantisers take nothing else. What they print is dropped."""
    root = logging.getLogger()
    level = root.level
    with tempfile.TemporaryDirectory(prefix="upbeam-") as folder:
        path = Path(folder) / "model.onnx"
        path.write_bytes(model.SerializeToString())
        root.setLevel(logging.ERROR)
        try:
            with redirect_stdout(io.StringIO()):
                yield path
        finally:
            root.setLevel(level)


# ------------------------------------------------------------------------------------------------------- the peer


def peer_static_int8(
    network: DifferenceNetwork,
    windows: I64,
    method: CalibrationMethod,
    graph: PeerGraph = "folded",
) -> Callable[[I64], FloatArray]:
    """ONNX Runtime's own ``quantize_static`` of the same network: windows [N, 6] -> outputs [N], less ``skip`` times
    the minimum.

    ``windows``: int64 [N, 6] to calibrate with, in counts (or 8-bit intensities), as the callable's. All options are
    ONNX Runtime's own but weights per channel. ``graph``: ``folded``, what ``folded_model`` exports, pixels and
    minimum in and the finished output out; or ``difference``, our graph ``net(differences, minimum)`` with the
    minimum added in float: the form that suits it best."""
    _check_method(method)
    quantization = require("onnxruntime.quantization")
    model = _peer_graph(network, graph)
    with _temporary(model) as path:
        made = path.with_name("int8.onnx")
        quantization.quantize_static(
            str(path),
            str(made),
            _Reader(windows),
            quant_format=quantization.QuantFormat.QDQ,
            per_channel=True,
            calibrate_method=_method(method),
        )
        run = session(made.read_bytes())
    skip = network.skip if graph == "folded" else 0

    def outputs(windows: I64) -> FloatArray:
        return np.asarray(_outputs(run, windows) - skip * windows.min(axis=1))

    return outputs


def _peer_graph(net: DifferenceNetwork, graph: PeerGraph) -> ModelProto:
    g = GraphBuilder("peer")
    windows = g.input("windows", ["N", WINDOW])
    if graph == "folded":
        y = folded_body(g, windows, _on_pixels(net))
    else:
        y, _ = _float_body(g, windows, replace(net, skip=0))
    g.output("y", y, ["N"])
    return g.model({})


def _on_pixels(net: DifferenceNetwork) -> FoldedNetwork:
    """The inverse of ``difference_network``."""
    minimum = net.minimum - net.weight.sum(axis=1)
    weight = np.concatenate([net.weight, minimum[:, None]], axis=1)
    return FoldedNetwork(weight, net.bias, net.output, net.offset, float(net.skip), net.slope, positive=False)
