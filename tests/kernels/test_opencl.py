"""The OpenCL kernels against NumPy and the CPU, on the first device of this machine; and what is said without one."""

from __future__ import annotations

import dataclasses
import importlib.util
import json
import types

import numpy as np
import pytest

import upbeam
from upbeam.kernels.opencl import (
    OpenClError,
    OpenClUpsampler,
    Variant,
    list_devices,
    parse_variant,
    pocl,
    program,
    record_path,
    tune,
)
from upbeam.kernels.opencl import device as device_module
from upbeam.kernels.opencl.source import folded_weights
from upbeam.model.beams import beam_table
from upbeam.model.frames import kitti_frames
from upbeam.model.network import WindowNetwork
from upbeam.model.rules import Rules, upsample_reference
from upbeam.quant import ModelFile
from upbeam.quant.integer import IntegerModel, IntegerNetwork, upsample_integer

COLUMNS = 100  # no multiple of any vector
FAST = "v16-w128s2-g1-program"
VARIANTS = ("v16-w4s2-g1-program", "v1-r5-g4-buffer", "v4-r31-g1-program", "v2-w3-g2-buffer", "v8-w1-g1-program")
RULES = (
    {},
    {"empty": "none", "last_row": "repeat", "edge": "zero"},
    {"last_row": "repeat", "ground_reach": 0.0, "max_m": 120.0},
)

needs_pyopencl = pytest.mark.skipif(
    importlib.util.find_spec("pyopencl") is None, reason="pyopencl is not installed (extra opencl)"
)


@pytest.fixture(scope="module", autouse=True)
def caches(tmp_path_factory):
    """PoCL's and our own records in a folder of the tests; nothing of the user's settings."""
    with pytest.MonkeyPatch.context() as patch:
        for name in ("POCL_CACHE_DIR", "XDG_CACHE_HOME"):
            patch.setenv(name, str(tmp_path_factory.mktemp(name.lower())))
        for name in ("UPBEAM_OPENCL_DEVICE", "UPBEAM_OPENCL_VARIANT", "UPBEAM_POCL_CPU"):
            patch.delenv(name, raising=False)
        yield


@pytest.fixture(scope="module")
def device():
    """The first device. A machine without one is told so by the reason of the skip."""
    if importlib.util.find_spec("pyopencl") is None:
        pytest.skip("pyopencl is not installed (extra opencl)")
    try:
        return list_devices()[0]
    except OpenClError as error:
        pytest.skip(str(error))


def integer_network(rng, precision, slope) -> IntegerNetwork:
    """Random, and far enough from overflow for any of the rules."""
    hidden, wide = int(rng.integers(1, 14)), precision == "int16"
    limit = 120 if wide else 12
    return IntegerNetwork(
        weight=rng.integers(-limit, limit + 1, (hidden, 6)), minimum=rng.integers(-9000, 9000, hidden),
        bias=rng.integers(-(2**26), 2**26, hidden), output=rng.integers(-120, 121, hidden),
        offset=int(rng.integers(-(2**20), 2**20)), slope=slope, skip=1, k=0, j=0, t=int(rng.integers(0, 12)),
    )  # fmt: skip


def make_file(rng, **rules) -> ModelFile:
    def network():
        c1, c2, h = 8, 2, 12
        return WindowNetwork(
            rng.normal(size=c1) / 3, rng.normal(size=c1) / 3, rng.normal(size=(c2, c1)) / 3, rng.normal(size=c2) / 3,
            rng.normal(size=(h, 6 * c2 + 1)) / 3, rng.normal(size=h) / 3, rng.normal(size=h) / 3, 0.3,
            inputs="difference", output="residual", scale=0.05, slope=1 / 128,
        )  # fmt: skip

    whole = {
        name: IntegerModel(name, integer_network(rng, name, 328), integer_network(rng, name, 0))
        for name in ("int16", "int8")
    }
    made = Rules.for_beams(beam_table("hdl-64e").aligned(), columns=COLUMNS, **rules)
    return ModelFile.from_dense(made, (network(), network()), **whole)


def images(rng, columns=COLUMNS):
    """Random and extreme ones."""
    grey = rng.integers(0, 256, (32, columns)).astype(np.uint8)
    for empty in (0.0, 0.3, 0.97):
        distance = rng.integers(1, 65536, (32, columns)).astype(np.uint16)
        near = rng.random(distance.shape) < 0.8
        distance[near] = rng.integers(1400, 42_000, int(near.sum()))
        distance[rng.random(distance.shape) < empty] = 0
        yield distance, grey
    for high, low in ((65535, 0), (40_000, 1500), (9000, 1500), (0, 0)):
        distance = np.full((32, columns), low, np.uint16)
        distance[::2, ::2] = distance[1::2, 1::2] = high
        yield distance, np.where(distance == high, 255, 0).astype(np.uint8)


def differing(made, expected) -> int:
    """Windows whose distance or intensity differs. The sensor's rows and row 63 must be equal."""
    for a, b in zip(made, expected, strict=True):
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a[0::2], b[0::2])
        np.testing.assert_array_equal(a[63], b[63])
    return int(np.sum((made[0] != expected[0]) | (made[1] != expected[1])))


@pytest.mark.parametrize("rules", RULES, ids=str)
def test_dense_kernel_is_the_reference(device, rng, rules):
    file = make_file(rng, **rules)
    on_device = OpenClUpsampler(file, variant="dense")
    windows = wrong = 0
    for image in images(rng):
        reference = upsample_reference(*image, file.dense, file.rules)
        wrong += differing(on_device(*image), reference)
        windows += 31 * COLUMNS
    # Float32 sums of metres up to 130: about 1e-4 counts, so that one window in some thousands rounds the other way.
    assert wrong <= windows * 2e-3


@pytest.mark.parametrize(("variant", "rules"), list(zip(VARIANTS, RULES + RULES[:2], strict=True)), ids=str)
def test_float_kernel_agrees_with_the_cpu(device, rng, rules, variant):
    file = make_file(rng, **rules)
    cpu = upbeam.Upsampler(upbeam.Model(file.to_bytes()))
    on_device = OpenClUpsampler(file, variant=variant)
    assert on_device.variant == variant
    wrong = sum(differing(on_device(*image), cpu(*image)) for image in images(rng))
    assert wrong <= 5  # 0 where both fuse; else where a sum lies at a rounding boundary


@pytest.mark.parametrize("precision", ["int16", "int8"])
@pytest.mark.parametrize(("variant", "rules"), list(zip(VARIANTS[:3], RULES, strict=True)), ids=str)
def test_integer_kernels_are_the_contract(device, rng, precision, rules, variant):
    file = make_file(rng, **rules)
    on_device = OpenClUpsampler(file, precision, variant=variant)
    for image in images(rng):
        assert differing(on_device(*image), upsample_integer(*image, file.integer(precision), file.rules)) == 0


def test_kitti(device, rng, data_dir):
    """The shipped model on recorded frames: float on all, integers on a few (their reference is NumPy)."""
    model = upbeam.load_model()
    cpu = upbeam.Upsampler(model)
    made = make_file(rng)
    whole = {name: model.file.integer(name) or made.integer(name) for name in ("int16", "int8")}
    file = dataclasses.replace(model.file, **whole)
    on_device = {name: OpenClUpsampler(file, name, variant=FAST) for name in ("fp32", *whole)}
    differ = dict.fromkeys(on_device, 0)
    seen = dict.fromkeys(on_device, 0)
    for number, frame in enumerate(kitti_frames(data_dir / "kitti" / "frames", model.rules)):
        image = np.ascontiguousarray(frame.distance[frame.given]), np.ascontiguousarray(frame.intensity[frame.given])
        expected = {"fp32": cpu(*image)}
        if number % 9 == 0:
            expected |= {name: upsample_integer(*image, whole[name], file.rules) for name in whole}
        for name, reference in expected.items():
            differ[name] += differing(on_device[name](*image), reference)
            seen[name] += 31 * model.columns
    print(f"OpenCL, windows of KITTI that differ: {', '.join(f'{n} {differ[n]} of {seen[n]}' for n in seen)}")
    assert min(seen.values()) > 0
    assert differ["int16"] == differ["int8"] == 0
    assert differ["fp32"] <= seen["fp32"] * 1e-4


def test_times_and_refused_images(device, rng):
    on_device = OpenClUpsampler(make_file(rng), variant=FAST)
    assert on_device.times is None
    distance, intensity = next(images(rng))
    on_device(distance, intensity)
    assert 0 < on_device.times.kernel < on_device.times.total
    assert on_device.times.transfer >= 0
    with pytest.raises(ValueError, match=r"distance is float32 \[32, 100\], expected uint16"):
        on_device(distance.astype(np.float32), intensity)
    with pytest.raises(ValueError, match=r"intensity is uint8 \[32, 99\]"):
        on_device(distance, intensity[:, 1:])


def test_arguments(device, rng, monkeypatch):
    file = dataclasses.replace(make_file(rng), int8=None, dense=None)
    with pytest.raises(ValueError, match="precision 'half'"):
        OpenClUpsampler(file, "half")
    with pytest.raises(OpenClError, match=r"int8.*it has: fp32, int16"):
        OpenClUpsampler(file, "int8")
    with pytest.raises(ValueError, match="columns 3, expected 4"):
        OpenClUpsampler(file, columns=3)
    with pytest.raises(OpenClError, match="no section DENS"):
        OpenClUpsampler(file, variant="dense")
    with pytest.raises(ValueError, match="dense kernel computes in fp32"):
        OpenClUpsampler(file, "int16", variant="dense")
    with pytest.raises(OpenClError, match="no OpenCL device 99, there are: 0: "):
        OpenClUpsampler(file, device=99, variant=FAST)
    monkeypatch.setenv("UPBEAM_OPENCL_DEVICE", "first")
    with pytest.raises(OpenClError, match="UPBEAM_OPENCL_DEVICE is 'first'"):
        OpenClUpsampler(file, variant=FAST)


def test_variant_of_the_environment(device, rng, monkeypatch):
    monkeypatch.setenv("UPBEAM_OPENCL_VARIANT", "v8-w2-g1-buffer")
    assert OpenClUpsampler(make_file(rng)).variant == "v8-w2-g1-buffer"


def test_choice_is_measured_once(device, rng, monkeypatch):
    asked = [parse_variant("v8-w2-g1-program"), parse_variant("v1-r1-g1-program")]
    monkeypatch.setattr(tune, "shapes", lambda *_: asked)
    file = make_file(rng)
    first = OpenClUpsampler(file).choice
    assert not first.from_record
    assert len(first.kernel_ms) == 3  # and the best one with its weights in a buffer
    assert str(first.variant) == min(first.kernel_ms, key=first.kernel_ms.__getitem__)
    again = OpenClUpsampler(file).choice
    assert again == dataclasses.replace(first, from_record=True)
    record = json.loads(record_path().read_text())
    (key,) = record
    assert f"| {device.name} | {device.driver} | fp32 12+12 x {COLUMNS} |" in key
    for damaged in ("[1]", json.dumps({key: {"no such variant": 1}})):
        record_path().write_text(damaged)
        assert not OpenClUpsampler(file).choice.from_record


def test_build_failure_has_the_log(device, rng, monkeypatch):
    monkeypatch.setattr(program, "BUILD_OPTIONS", ("-Dushort=no_such_type",))
    with pytest.raises(OpenClError, match=r"(?s)cannot build kernel v16-w128s2-g1-program; its log:.*no_such_type"):
        OpenClUpsampler(make_file(rng), variant=FAST)
    monkeypatch.setattr(tune, "shapes", lambda *_: [parse_variant(FAST)])
    with pytest.raises(OpenClError, match=r"runs no variant of the fp32 kernel: .*cannot build"):
        OpenClUpsampler(make_file(rng), tune=True)


def test_out_of_memory(device, rng):
    session = program.Session.open(*device_module.open_device(0))
    small = dataclasses.replace(session, device=types.SimpleNamespace(max_mem_alloc_size=1000))
    made = program.WindowProgram(session, make_file(rng), "fp32", COLUMNS, parse_variant(FAST))
    made.session = small
    with pytest.raises(OpenClError, match=r"out of memory: an image of 100 columns needs .* gives 1000"):
        made._allocate()


def test_without_pyopencl(monkeypatch, rng):
    monkeypatch.setitem(__import__("sys").modules, "pyopencl", None)
    for call in (list_devices, lambda: OpenClUpsampler(make_file(rng), variant=FAST)):
        with pytest.raises(OpenClError, match=r"pip install 'upbeam\[opencl\]'") as caught:
            call()
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("platforms", "message"),
    [(None, r"no OpenCL platform \(-1001\)"), ([], "no OpenCL platform: "), ([1], "a platform but no device")],
)
def test_no_platform_or_device(monkeypatch, platforms, message):
    class FakeError(Exception):
        pass

    class FakePlatform:
        def get_devices(self):
            raise FakeError("DEVICE_NOT_FOUND")

    def get_platforms():
        if platforms is None:
            raise FakeError("-1001")
        return [FakePlatform() for _ in platforms]

    fake = types.SimpleNamespace(Error=FakeError, get_platforms=get_platforms)
    monkeypatch.setitem(__import__("sys").modules, "pyopencl", fake)
    with pytest.raises(OpenClError, match=message):
        device_module.open_device()


def test_names_of_variants():
    for name in (*VARIANTS, FAST):
        assert str(parse_variant(name)) == name
    for name in (
        "v3-r1-g1-program",
        "v1-w2-g1-program",
        "v4-r32-g1-buffer",
        "v4-r1-g0-program",
        "v4-w513-g1-program",
        "v4-w3s2-g1-program",
        "v4-r2s2-g1-program",
        "",
    ):
        with pytest.raises(ValueError, match="variant"):
            parse_variant(name)
    assert Variant(16, walk=7).padded_columns(100) == 112
    assert Variant(1, group=5).padded_columns(100) == 160


def test_every_candidate_has_a_name():
    for is_cpu in (True, False):
        for columns in (4, 2048, 65535):
            for variant in tune.shapes(is_cpu, columns, 4096):
                assert parse_variant(str(variant)) == variant


def test_weights_are_those_of_the_c_runtime(rng):
    """In double precision, rounded once: the file's order of pixels, then the minimum, bias, output."""
    network = make_file(rng).folded[0]
    table = folded_weights(network, 0.002)
    units = table[:-1].reshape(network.hidden, 9).astype(np.float64)
    np.testing.assert_allclose(units[:, :6], network.weight[:, :6] * 0.002, rtol=1e-7)
    np.testing.assert_allclose(units[:, 6], network.weight.sum(axis=1) * 0.002, rtol=1e-5, atol=1e-9)
    np.testing.assert_allclose(units[:, 8] * 0.002, network.output_weight, rtol=1e-6)


def test_names_for_processors():
    assert pocl._best_level(set()) == "x86-64"
    assert pocl._best_level({"avx2", "fma", "bmi1", "bmi2", "f16c", "movbe", "avx512f"}) == "haswell"
    everything = set().union(*(needed for _, needed in pocl._LEVELS))
    assert pocl._best_level(everything) == "skylake-avx512"


@needs_pyopencl
def test_other_devices_keep_their_names(monkeypatch):
    known = types.SimpleNamespace(
        platform=types.SimpleNamespace(name="Portable Computing Language"),
        driver_version="3.0",
        version="OpenCL 3.0 PoCL HSTR: pthread-x86_64-unknown-linux-gnu-znver3",
        int_ptr=0,
    )
    assert not pocl.name_processor(known)
    monkeypatch.setenv("UPBEAM_POCL_CPU", "off")
    known.version = "OpenCL 3.0 PoCL HSTR: pthread-x86_64-unknown-linux-gnu-generic"
    assert not pocl.name_processor(known)
