"""Training: what needs PyTorch. Run by ``make test-train``."""

from __future__ import annotations

import importlib.util
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import upbeam
from upbeam.hw_sim import simulate_frames
from upbeam.model.baselines import BASELINES
from upbeam.model.beams import beam_table
from upbeam.model.evaluate import evaluate
from upbeam.model.frames import Frame, kitti_frames
from upbeam.model.network import load_state_dict
from upbeam.model.recipe import load_recipe
from upbeam.model.rules import extract_windows, upsample_reference
from upbeam.runtime._native import raw_windows

pytestmark = pytest.mark.train
VECTORS = Path(__file__).parents[1] / "vectors"


@pytest.fixture(scope="module")
def torch():
    return pytest.importorskip("torch", reason="make test-train installs PyTorch")


@pytest.fixture(scope="module")
def smoke(torch):
    """Samples of the smoke recipe, made once."""
    from upbeam.model.train import collect_samples

    recipe = load_recipe("smoke")
    source = recipe.data[0]
    scans = simulate_frames(
        beam_table(recipe.beams), columns=recipe.columns, frames=source.frames, seed=source.seed, frames_per_scene=1
    )
    frames = [Frame(str(k), s.distance, s.intensity, s.distance_unit_m) for k, s in enumerate(scans)]
    rules = recipe.make_rules()
    return recipe, rules, collect_samples(frames, rules, recipe.windows, len(frames), recipe.seed)


@pytest.fixture(scope="module")
def trained(smoke):
    from upbeam.model.train import train_networks

    recipe, rules, samples = smoke
    return train_networks(recipe, samples, rules)


def test_the_stored_vectors_are_what_the_script_makes(torch):
    spec = importlib.util.spec_from_file_location("make_window_vectors", VECTORS / "make_window_vectors.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    made = module.make()
    with np.load(module.TARGET) as stored:
        assert set(made) == set(stored.files)
        for name, values in made.items():
            assert np.allclose(stored[name], values, rtol=1e-12, atol=1e-12), name


def test_training_learns_and_repeats_to_the_bit(smoke, trained):
    from upbeam.model.train import train_networks

    recipe, rules, samples = smoke
    for name in ("distance", "intensity"):
        first, last = trained.losses[name][0][1], trained.losses[name][-1][1]
        assert last < 0.95 * first
    again = train_networks(recipe, samples, rules)
    for a, b in zip(trained.networks, again.networks, strict=True):
        assert a.linear_1_weight.tobytes() == b.linear_1_weight.tobytes()
        assert a.linear_2_bias == b.linear_2_bias
    other = train_networks(replace(recipe, seed=recipe.seed + 1), samples, rules)
    assert other.networks[0].linear_1_weight.tobytes() != trained.networks[0].linear_1_weight.tobytes()


def test_even_the_smoke_run_beats_bilinear_on_real_frames(smoke, trained, data_dir):
    rules = smoke[1]
    folded = tuple(network.fold() for network in trained.networks)

    def method(distance, intensity, rules):
        d, i = upsample_reference(distance, intensity, folded, rules)
        return d[1:-1:2], i[1:-1:2]

    frames = list(kitti_frames(data_dir / "kitti" / "frames", rules))[::6]
    means = evaluate(frames, {**BASELINES, "smoke": method}, rules).means()
    print({name: {k: round(v, 3) for k, v in m.items()} for name, m in means.items()})
    for key in ("chamfer_m2", "mae_m", "ghost_share"):
        assert means["smoke"][key] < means["bilinear"][key]


def test_the_exported_network_is_the_trained_one(torch, smoke, trained):
    """The PyTorch module, the dense arrays and the fold: one function."""
    from upbeam.model.train import TorchWindowNetwork

    recipe, _, samples = smoke
    module = TorchWindowNetwork(recipe.networks["distance"]).double()
    dense = module.export()
    x = samples.distance[:500] * 0.002
    with torch.no_grad():
        y = torch.relu(module(torch.from_numpy(x))).numpy()
    scale = dense.fold().magnitude(x)
    assert np.max(np.abs(dense(x) - y) / scale) < 1e-7  # scale and slope pass through float32 nowhere
    assert np.max(np.abs(dense.fold()(x) - y) / scale) < 1e-7


def test_pytorch_agrees_with_the_c_runtime_on_a_real_frame(torch, data_dir):
    """float32 PyTorch on the shipped weights, dense graph, against the folded C kernels: 1e-5 of the sum of |w x|."""
    from upbeam.model.recipe import NetworkRecipe
    from upbeam.model.train import TorchWindowNetwork

    model = upbeam.load_model()
    frame = next(iter(kitti_frames(data_dir / "kitti" / "frames", model.rules)))
    d, i = frame.distance[::2], frame.intensity[::2]
    windows = extract_windows(d, i, model.rules)
    raw = raw_windows(model.native, np.ascontiguousarray(d.T), np.ascontiguousarray(i.T))
    values = (windows.distance, model.distance_unit_m), (windows.intensity, 1.0)
    flips = 0
    for (x, unit), y, dense, folded in zip(values, raw, model.file.dense, model.file.folded, strict=True):
        module = TorchWindowNetwork(NetworkRecipe(dense.widths, dense.slope, dense.inputs, dense.output, dense.scale))
        module.load_state_dict(_state(torch, dense))
        with torch.no_grad():
            expected = torch.relu(module(torch.from_numpy((x * unit).reshape(-1, 6).astype(np.float32)))).numpy()
        scale = (folded.magnitude(x * unit) / unit).ravel()
        seen = windows.any_return.ravel()
        error = np.abs(y.T[:31].ravel() - expected / unit)[seen] / scale[seen]
        print(f"largest error {error.max():.2e} of the sum of |w x|")
        assert error.max() < 1e-5
        if unit != 1.0:
            limits = model.rules.min_count, model.rules.max_count
            inside = [(v >= limits[0] - 0.5) & (v < limits[1] + 0.5) for v in (y.T[:31].ravel(), expected / unit)]
            flips = int((inside[0] != inside[1])[seen].sum())
    assert flips <= 10 * 63_488 // 1_000_000 + 1


def _state(torch, dense):
    tensor = lambda x, *shape: torch.from_numpy(np.asarray(x, np.float32).reshape(shape))  # noqa: E731
    c1, c2, h = dense.widths
    return {
        "conv1.weight": tensor(dense.conv1_weight, c1, 1, 1), "conv1.bias": tensor(dense.conv1_bias, c1),
        "conv2.weight": tensor(dense.conv2_weight, c2, c1, 1), "conv2.bias": tensor(dense.conv2_bias, c2),
        "linear_1.weight": tensor(dense.linear_1_weight, h, 6 * c2 + 1),
        "linear_1.bias": tensor(dense.linear_1_bias, h),
        "linear_2.weight": tensor(dense.linear_2_weight, 1, h), "linear_2.bias": tensor(dense.linear_2_bias, 1),
    }  # fmt: skip


def test_a_state_dict_file_of_pytorch(torch, tmp_path):
    from upbeam.model.train import TorchWindowNetwork

    module = TorchWindowNetwork(load_recipe("smoke").networks["distance"])
    torch.save(module.state_dict(), tmp_path / "w.pt")
    graph = {"inputs": "difference", "output": "residual", "scale": 0.05, "slope": 1 / 128}
    loaded = load_state_dict(tmp_path / "w.pt", **graph)
    assert np.array_equal(loaded.conv1_weight, module.export().conv1_weight)
    (tmp_path / "w.pt").write_bytes(b"not a model")
    with pytest.raises(ValueError, match=r"w\.pt"):
        load_state_dict(tmp_path / "w.pt")
