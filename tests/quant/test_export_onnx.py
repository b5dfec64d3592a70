"""ONNX graphs: run by ONNX Runtime (and by ONNX's own reference where a second opinion counts) against the float64
networks, the rules' reference and the C runtime."""

from __future__ import annotations

import zlib
from dataclasses import replace

import numpy as np
import onnx
import onnx.version_converter
import pytest
from onnx.reference import ReferenceEvaluator

import upbeam
from upbeam.hw_sim import simulate_frames
from upbeam.model.beams import beam_table
from upbeam.model.frames import kitti_files, kitti_frames
from upbeam.model.network import WindowNetwork
from upbeam.model.rules import Rules, extract_windows, upsample_reference
from upbeam.quant import ModelFile
from upbeam.quant.export import ExportError, MissingPackageError, Source, onnx_builder
from upbeam.quant.export.onnx_builder import session
from upbeam.quant.export.onnx_graphs import dense_model, folded_model, image_model
from upbeam.quant.export.onnx_qdq import METHODS, peer_static_int8, qdq_model
from upbeam.quant.quantize import Calibration, DifferenceNetwork, difference_network

NETWORKS = ("distance", "intensity")

# What the importer of TensorRT 8.4 reads, of the operators that could occur here (its list of supported operators).
TENSORRT = {
    *("Add", "And", "Clip", "Concat", "Conv", "DequantizeLinear", "Div", "Flatten", "Floor", "Gemm", "Greater"),
    *("GreaterOrEqual", "LeakyRelu", "LessOrEqual", "Min", "Mul", "Pad", "QuantizeLinear", "ReduceMin", "Relu"),
    *("Reshape", "Slice", "Squeeze", "Sub", "Transpose", "Unsqueeze", "Where"),
}


def random_network(rng, widths=(8, 2, 12), **graph):
    c1, c2, h = widths
    return WindowNetwork(
        rng.normal(size=c1) / 3, rng.normal(size=c1) / 3, rng.normal(size=(c2, c1)) / 3, rng.normal(size=c2) / 3,
        rng.normal(size=(h, 6 * c2 + 1)) / 3, rng.normal(size=h) / 3, rng.normal(size=h) / 3, 0.3, **graph,
    )  # fmt: skip


def random_source(rng, widths=(8, 2, 12), graph=None, **rules):
    made = Rules.for_beams(beam_table("hdl-64e").aligned(), columns=64, **rules)
    networks = (random_network(rng, widths, **(graph or {})), random_network(rng, widths, **(graph or {})))
    return Source.of(ModelFile.from_dense(made, networks).to_bytes(), "random")


@pytest.fixture(scope="module")
def shipped():
    return Source.of(upbeam.load_model("hdl-64e").data, "hdl-64e")


@pytest.fixture(scope="module")
def scan():
    return next(simulate_frames(beam_table("hdl-64e"), columns=1024, frames=1, seed=5)).aligned()


@pytest.fixture(scope="module")
def calibration(shipped, scan):
    windows = extract_windows(scan.distance[::2], scan.intensity[::2], shipped.file.rules)
    parts = (x[windows.any_return].astype(np.int64) for x in (windows.distance, windows.intensity))
    return Calibration(*parts)


def every_graph(source, calibration):
    return [dense_model(source), folded_model(source), image_model(source), qdq_model(source, calibration)]


# ------------------------------------------------------------------------------------------------ window graphs

GRAPHS = [
    {},
    {"inputs": "difference", "output": "residual", "scale": 0.05, "slope": 1 / 128},
    {"inputs": "difference"},
    {"output": "residual", "scale": 2.0, "slope": 0.0},
]


@pytest.mark.parametrize("graph", GRAPHS, ids=str)
@pytest.mark.parametrize("widths", [(8, 2, 12), (1, 1, 1), (5, 3, 32)])
def test_window_graphs_are_the_networks(rng, widths, graph):
    source = random_source(rng, widths, graph)
    windows = {f"{name}_windows": rng.uniform(0, 80, (500, 6)).astype(np.float32) for name in NETWORKS}
    for model, networks in ((dense_model(source), source.file.dense), (folded_model(source), source.file.folded)):
        outputs = session(model).run(list(NETWORKS), windows)
        for name, y, net, folded in zip(NETWORKS, outputs, networks, source.file.folded, strict=True):
            x = windows[f"{name}_windows"].astype(np.float64)
            assert y.shape == (500,)
            assert np.max(np.abs(y - net(x)) / folded.magnitude(x)) < 1e-6


def test_one_network_and_any_batch(shipped):
    model = session(folded_model(shipped, ["intensity"]))
    assert [x.name for x in model.get_inputs()] == ["intensity_windows"]
    for n in (0, 1, 31):
        assert model.run(None, {"intensity_windows": np.zeros((n, 6), np.float32)})[0].shape == (n,)


def test_a_model_without_dense_networks(shipped):
    bare = Source.of(replace(shipped.file, dense=None).to_bytes(), "bare")
    with pytest.raises(ExportError, match="bare: no section DENS"):
        dense_model(bare)
    folded_model(bare)


# -------------------------------------------------------------------------------------------------- image graph

RULES = [
    {},
    {"empty": "none", "edge": "zero", "last_row": "repeat"},
    {"empty": "fill", "last_row": "repeat", "ground_reach": 0.0},
]


def random_image(rng, columns, empty):
    distance = rng.integers(1, 65536, (32, columns)).astype(np.uint16)
    near = rng.random(distance.shape) < 0.7
    distance[near] = rng.integers(1400, 42_000, int(near.sum()))
    distance[rng.random(distance.shape) < empty] = 0
    return distance, rng.integers(0, 256, distance.shape).astype(np.uint8)


def run_image(model, *images):
    """Images of one width as one batch -> [(distance, intensity)], [64, W] each."""
    stacked = [np.stack(x)[:, None].astype(np.float32) for x in zip(*images, strict=True)]
    outputs = model.run(["distance", "intensity"], dict(zip(("distance_in", "intensity_in"), stacked, strict=True)))
    assert all(x.dtype == np.float32 for x in outputs)
    return [(d[0], i[0]) for d, i in zip(*outputs, strict=True)]


def decided(source, distance, intensity, which):
    """[31, W]: windows whose float64 output lies so far from a rounding threshold that float32 cannot miss it."""
    windows = extract_windows(distance, intensity, source.file.rules)
    x = getattr(windows, which)
    unit = source.unit(which)
    rest = difference_network(source.folded(which), unit).rest(x) + 0.5
    error = 1e-3 + 2e-6 * source.folded(which).magnitude(x * unit) / unit
    return np.abs(rest - np.round(rest)) > error


def check_image(source, images, outputs):
    for (distance, intensity), made in zip(images, outputs, strict=True):
        expected = upsample_reference(distance, intensity, source.file.folded, source.file.rules)
        sure_distance = decided(source, distance, intensity, "distance")
        sure = {"distance": sure_distance, "intensity": decided(source, distance, intensity, "intensity")}
        sure["intensity"] &= sure_distance  # an intensity stands where a distance does
        assert sure["distance"].mean() > 0.5
        for name, y, want in zip(NETWORKS, made, expected, strict=True):
            assert np.array_equal(y[0::2], want[0::2])
            assert np.array_equal(y[63], want[63])
            assert np.array_equal(y[1:-1:2][sure[name]], want[1:-1:2][sure[name]])
            both = (y > 0) & (want > 0)
            assert np.abs(y - want)[both].max(initial=0) <= 1


@pytest.mark.parametrize("rules", RULES, ids=str)
@pytest.mark.parametrize("graph", GRAPHS[:2], ids=str)
def test_the_image_graph_obeys_all_rules(rng, graph, rules):
    source = random_source(rng, graph=graph, **rules)
    model = session(image_model(source))
    for columns in (1, 3, 64):
        images = [random_image(rng, columns, empty) for empty in (0.0, 0.3, 0.9, 1.0)]
        images.append((np.full((32, columns), 65535, np.uint16), np.full((32, columns), 255, np.uint8)))
        check_image(source, images, run_image(model, *images))


def test_the_image_graph_on_a_scan_is_the_runtime(shipped, scan):
    """Two float32 implementations: they may differ by one count where the output is next to a half."""
    image = np.ascontiguousarray(scan.distance[::2]), np.ascontiguousarray(scan.intensity[::2])
    [made] = run_image(session(image_model(shipped)), image)
    check_image(shipped, [image], [made])
    expected = upbeam.Upsampler(upbeam.load_model("hdl-64e"), columns=1024)(*image)
    for y, want in zip(made, expected, strict=True):
        assert np.mean(y != want) < 1e-3
        assert np.abs(y - want).max() <= 1


def test_the_image_graph_on_recorded_frames_is_the_runtime(shipped, data_dir):
    model, runtime = session(image_model(shipped)), upbeam.Upsampler(upbeam.load_model("hdl-64e"))
    windows, other = 0, {"distance": 0, "intensity": 0}
    for path in kitti_files(data_dir / "kitti" / "frames")[::5]:
        [frame] = kitti_frames(path, shipped.file.rules)
        image = np.ascontiguousarray(frame.distance[::2]), np.ascontiguousarray(frame.intensity[::2])
        [made] = run_image(model, image)
        for name, y, want in zip(NETWORKS, made, runtime(*image), strict=True):
            other[name] += int((y != want).sum())
            assert np.abs(y - want)[(y > 0) & (want > 0)].max() <= 1
        windows += 31 * frame.distance.shape[1]
    print(f"image graph against the runtime, {windows} windows: {other} differ")
    assert max(other.values()) < 5e-4 * windows


def test_another_implementation_of_onnx_agrees(rng):
    source = random_source(rng)
    image = random_image(rng, 16, 0.3)
    check_image(source, [image], run_image(ReferenceEvaluator(image_model(source)), image))


def test_outputs_can_be_chosen(shipped, rng):
    distance, intensity = (x[None, None].astype(np.float32) for x in random_image(rng, 8, 0.2))
    both = session(image_model(shipped)).run(None, {"distance_in": distance, "intensity_in": intensity})
    only = session(image_model(shipped, ["distance"])).run(None, {"distance_in": distance})
    assert np.array_equal(only[0], both[0])
    only = session(image_model(shipped, ["intensity"])).run(None, {"distance_in": distance, "intensity_in": intensity})
    assert len(only) == 1
    assert np.array_equal(only[0], both[1])


# ------------------------------------------------------------------------------------------------- every graph


def test_graphs_are_what_tensorrt_and_old_runtimes_take(shipped, calibration):
    for model in every_graph(shipped, calibration):
        assert (model.ir_version, [(x.domain, x.version) for x in model.opset_import]) == (7, [("", 13)])
        assert {node.domain for node in model.graph.node} == {""}
        assert {node.op_type for node in model.graph.node} <= TENSORRT
        used = {name for node in model.graph.node for name in node.input}
        assert {x.name for x in model.graph.initializer} <= used
        assert {x.name for x in model.graph.input} <= used
        for node in model.graph.node:
            if node.op_type == "Conv":  # weights are constants, or come from one through QuantizeLinear
                assert any(x.name == origin(model, node.input[1]) for x in model.graph.initializer)


def origin(model, name):
    made = {node.output[0]: node for node in model.graph.node}
    while name in made and made[name].op_type in ("QuantizeLinear", "DequantizeLinear"):
        name = made[name].input[0]
    return name


def test_graphs_name_their_model_and_do_not_vary(shipped, calibration):
    for a, b in zip(every_graph(shipped, calibration), every_graph(shipped, calibration), strict=True):
        assert a.SerializeToString() == b.SerializeToString()
        props = {p.key: p.value for p in a.metadata_props}
        assert int(props["model_crc32"], 16) == zlib.crc32(shipped.data[:-4])
        assert "provenance" in props


def test_a_missing_package_names_the_extra(shipped, monkeypatch):
    def refuse(name):
        raise ModuleNotFoundError(f"No module named {name!r}", name=name)

    monkeypatch.setattr(onnx_builder, "import_module", refuse)
    with pytest.raises(MissingPackageError, match=r"package onnx: pip install 'upbeam\[export\]'") as found:
        image_model(shipped)
    assert isinstance(found.value, ImportError)
    assert isinstance(found.value, ExportError)


# ---------------------------------------------------------------------------------------------------------- QDQ


def test_qdq_scales_are_symmetric_and_constant(shipped, calibration):
    model = qdq_model(shipped, calibration)
    constants = {x.name: onnx.numpy_helper.to_array(x) for x in model.graph.initializer}
    kinds = []
    for node in model.graph.node:
        if node.op_type not in ("QuantizeLinear", "DequantizeLinear"):
            continue
        scale, zero = constants[node.input[1]], constants[node.input[2]]
        assert zero.dtype == np.int8
        assert not zero.any()
        assert np.all(scale > 0)
        per_channel = scale.ndim == 1
        assert [a.i for a in node.attribute if a.name == "axis"] == ([0] if per_channel else [])
        if node.op_type == "QuantizeLinear":
            weight = constants.get(node.input[0])
            assert per_channel == (weight is not None)
            kinds.append("weight" if per_channel else "activation")
            if weight is not None:
                assert np.abs(weight / scale[:, None, None, None]).max() < 127.5
    assert sorted(kinds) == ["activation"] * 4 + ["weight"] * 4
    inputs = [origin_kind(model, name) for x in model.graph.node if x.op_type == "Conv" for name in x.input[:2]]
    assert inputs == ["DequantizeLinear"] * 8


def origin_kind(model, name):
    return next(node.op_type for node in model.graph.node if node.output[0] == name)


@pytest.mark.parametrize("name", NETWORKS)
def test_qdq_by_two_implementations(shipped, calibration, name):
    """They may round a tie differently: one step of one value."""
    model = qdq_model(shipped, calibration, networks=[name])
    windows = {f"{name}_windows": (getattr(calibration, name)[:3000] * shipped.unit(name)).astype(np.float32)}
    newer = onnx.version_converter.convert_version(model, 19)  # the reference has no older DequantizeLinear
    a, b = session(model).run(None, windows)[0], ReferenceEvaluator(newer).run(None, windows)[0]
    steps = np.abs(a - b) / np.abs(a).max()
    assert np.quantile(steps, 0.95) < 1e-5
    assert steps.max() < 0.02


def errors(shipped, calibration, name, y):
    """Against the float network, in counts or intensity steps. ``y``: outputs less the minimum's part."""
    net = difference_network(shipped.folded(name), shipped.unit(name))
    return np.abs(y - net.rest(getattr(calibration, name)))


def qdq_rest(shipped, calibration, name, method):
    model, windows, unit = (
        qdq_model(shipped, calibration, method, [name]),
        getattr(calibration, name),
        shipped.unit(name),
    )
    y = session(model).run(None, {f"{name}_windows": (windows * unit).astype(np.float32)})[0]
    return y.astype(np.float64) / unit - windows.min(axis=1)


@pytest.mark.parametrize("method", ["minmax", "percentile"])
@pytest.mark.parametrize("name", NETWORKS)
def test_qdq_is_nearer_to_float_than_the_peer(shipped, calibration, name, method):
    net, windows = difference_network(shipped.folded(name), shipped.unit(name)), getattr(calibration, name)
    ours = errors(shipped, calibration, name, qdq_rest(shipped, calibration, name, method))
    for graph in ("folded", "difference"):
        peer = errors(shipped, calibration, name, peer_static_int8(net, windows, method, graph)(windows))
        assert ours.mean() < peer.mean()
    assert ours.mean() < (50 if name == "distance" else 1)  # 10 cm; one intensity step


@pytest.mark.parametrize("method", METHODS)
def test_the_peer_gives_counts_less_the_minimum(rng, capsys, method):
    weight = np.array([[0.5, 0.0, 0.0, 0.0, 0.0, 0.0]])
    net = DifferenceNetwork(weight, np.array([0.0]), np.array([0.0]), np.array([1.0]), 3.0, 0.0, 1)
    windows = rng.integers(0, 256, (4000, 6))
    run = peer_static_int8(net, windows, method)
    y = run(windows)
    assert (y.shape, y.dtype) == ((4000,), np.float64)
    expected = (windows[:, 0] - windows.min(axis=1)) * 0.5 + 3.0
    assert np.abs(y - expected).mean() < 2.0
    assert run(np.zeros((0, 6), np.int64)).shape == (0,)
    assert capsys.readouterr().out == ""


def test_a_method_that_does_not_exist(shipped, calibration):
    with pytest.raises(ExportError, match="expected minmax, percentile, entropy"):
        qdq_model(shipped, calibration, "guess")
