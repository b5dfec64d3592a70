"""Training: what needs PyTorch. Run by ``make test-train``."""

from __future__ import annotations

import csv
import importlib.util
import json
from dataclasses import asdict, replace
from importlib import resources
from pathlib import Path

import numpy as np
import pytest

import upbeam
from upbeam.hw_sim import simulate_frames
from upbeam.model.baselines import BASELINES
from upbeam.model.beams import beam_table, uniform_beam_table
from upbeam.model.evaluate import evaluate
from upbeam.model.frames import Frame, kitti_frames
from upbeam.model.metrics import chamfer_m2
from upbeam.model.network import NetworkError, load_state_dict
from upbeam.model.recipe import Loss, NetworkRecipe, load_any_recipe, load_recipe
from upbeam.model.rules import Rules, extract_windows, upsample_reference
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
    frames = [
        Frame(str(k), s.distance, s.intensity, s.distance_unit_m, s.beams.elevation_deg, s.beams.vertical_offset_m)
        for k, s in enumerate(scans)
    ]
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
        y = torch.relu(module.layer_by_layer(torch.from_numpy(x))).numpy()
    scale = dense.fold().magnitude(x)
    assert np.max(np.abs(dense(x) - y) / scale) < 1e-7  # scale and slope pass through float32 nowhere
    assert np.max(np.abs(dense.fold()(x) - y) / scale) < 1e-7


def test_pytorch_agrees_with_the_c_runtime_on_a_real_frame(torch, data_dir):
    """float32 PyTorch on the shipped weights, dense graph, against the folded C kernels: 1e-5 of the sum of |w x|."""
    from upbeam.model.train import TorchWindowNetwork

    model = upbeam.load_model()
    frame = next(iter(kitti_frames(data_dir / "kitti" / "frames", model.rules)))
    d, i = frame.distance[::2], frame.intensity[::2]
    windows = extract_windows(d, i, model.rules)
    raw = raw_windows(model.native, np.ascontiguousarray(d.T), np.ascontiguousarray(i.T))
    values = (windows.distance, model.distance_unit_m), (windows.intensity, 1.0)
    flips = 0
    for (x, unit), y, dense, folded in zip(values, raw, model.file.dense, model.file.folded, strict=True):
        widths = dense.widths[:2], dense.widths[2:]
        module = TorchWindowNetwork(NetworkRecipe(widths, dense.slope, dense.inputs, dense.output, dense.scale))
        module.load_state_dict(_state(torch, dense))
        with torch.no_grad():
            given = torch.from_numpy((x * unit).reshape(-1, 6).astype(np.float32))
            expected = torch.relu(module.layer_by_layer(given)).numpy()
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


# ------------------------------------------------------------------------------------------------------- the graph


def network_recipe(convolutions, hidden, **changes):
    base = NetworkRecipe((convolutions, hidden), 0.01, "difference", "residual", 0.05)
    return replace(base, **changes)


@pytest.mark.parametrize("shape", [((8, 2), (12,)), ((4,), (5,)), ((10, 8, 6), (12,)), ((8, 2), (12, 6))])
@pytest.mark.parametrize("ends", [{}, {"inputs": "raw", "output": "raw", "scale": 1.0}])
def test_the_folded_graph_is_the_drawn_one(torch, rng, shape, ends):
    """Values and the gradients of every weight."""
    from upbeam.model.train import TorchWindowNetwork

    module = TorchWindowNetwork(network_recipe(*shape, **ends)).double()
    x = torch.from_numpy(rng.uniform(0, 80, (200, 6)))
    gradients = []
    for function in (module, module.layer_by_layer):
        module.zero_grad()
        y = function(x)
        (y**2).mean().backward()
        gradients.append((y.detach(), *(p.grad.clone() for p in module.parameters())))
    for folded, drawn in zip(*gradients, strict=True):
        assert torch.allclose(folded, drawn, rtol=1e-9, atol=1e-9 * float(drawn.abs().max()))


@pytest.mark.parametrize("convolutions", [(3,), (8, 2), (10, 8, 6), (4, 5, 6, 7)])
def test_any_number_of_convolutions_is_exported(torch, rng, convolutions):
    from upbeam.model.train import TorchWindowNetwork

    module = TorchWindowNetwork(network_recipe(convolutions, (12,))).double()
    x = rng.uniform(0, 80, (300, 6))
    with torch.no_grad():
        y = torch.relu(module.layer_by_layer(torch.from_numpy(x))).numpy()
    dense = module.export()
    assert np.allclose(dense(x), y, rtol=1e-9, atol=1e-9)
    assert np.allclose(dense.fold()(x), y, rtol=1e-9, atol=1e-9)


def test_a_second_hidden_layer_is_not_exported_but_kept(torch, rng, tmp_path):
    from upbeam.model.train import TorchWindowNetwork, load_networks, save_networks, torch_method

    modules = {name: TorchWindowNetwork(network_recipe((8, 2), (12, 6))) for name in ("distance", "intensity")}
    with pytest.raises(NetworkError, match="2 hidden layers cannot be exported"):
        modules["distance"].export()
    save_networks(tmp_path / "n.pt", modules)
    distance, intensity = random_image(rng, 32, 40)
    rules = Rules.for_beams(uniform_beam_table(32, 2.0, -24.0), columns=40)
    given, kept = (torch_method(m)(distance, intensity, rules) for m in (modules, load_networks(tmp_path / "n.pt")))
    assert given[0].any()
    assert all(np.array_equal(a, b) for a, b in zip(given, kept, strict=True))
    (tmp_path / "n.pt").write_bytes(b"")
    with pytest.raises(NetworkError, match="cannot be read"):
        load_networks(tmp_path / "n.pt")


def test_the_torch_method_is_the_reference(torch, smoke, trained):
    """Same rules, same rounding: the exported networks through the NumPy reference."""
    from upbeam.model.train import torch_method

    distance, intensity = random_image(np.random.default_rng(3), 32, 200)
    rules = smoke[1]
    made = torch_method(trained.modules)(distance, intensity, rules)
    folded = tuple(network.fold() for network in trained.networks)
    expected = [image[1:-1:2] for image in upsample_reference(distance, intensity, folded, rules)]
    # A float32 slope and the two orders of summation differ in the last places: never by more than one count.
    for a, b in zip(made, expected, strict=True):
        assert np.abs(a.astype(int) - b).max() <= 1
        assert np.mean(a != b) < 1e-3


def random_image(rng, rows, columns, empty=0.3):
    distance = rng.integers(1500, 40_001, (rows, columns)).astype(np.uint16)
    distance[rng.random(distance.shape) < empty] = 0
    return distance, np.where(distance > 0, rng.integers(0, 256, distance.shape), 0).astype(np.uint8)


# -------------------------------------------------------------------------------------------------------- losses


def test_pixel_losses_by_hand(torch):
    from upbeam.model.losses import pixel_errors

    error = torch.tensor([0.0, -3.0, 4.0])
    by_hand = {
        Loss("l1"): [0, 3, 4],
        Loss("robust", knee_m=2.0): [0, 9 / (1 + 9 / 4), 16 / (1 + 16 / 4)],
        Loss("charbonnier", scale_m=3.0, power=1.0): [3, 18**0.5, 5],
        Loss("charbonnier", scale_m=3.0, power=0.5): [3**0.5, 18**0.25, 5**0.5],
    }
    for loss, expected in by_hand.items():
        assert torch.allclose(pixel_errors(error, loss), torch.tensor(expected, dtype=torch.float32))
    with pytest.raises(ValueError, match="chamfer"):
        pixel_errors(error, Loss("chamfer"))


def cloud(torch, rng, rows=5, columns=12):
    """Generated and real distances of a small image, what exists of them, and its geometry."""
    from upbeam.model.losses import PixelGeometry

    geometry = PixelGeometry.of_rows(np.linspace(2, -10, rows), np.linspace(0.1, 0, rows), columns, 180.0)
    distance, truth = (torch.from_numpy(rng.uniform(5, 8, (rows, columns)).astype(np.float32)) for _ in range(2))
    made, real = (torch.from_numpy(rng.random((rows, columns)) < 0.8) for _ in range(2))
    return distance, made, truth, real, geometry


def brute_force(a, b):
    square = ((a[:, None] - b[None]) ** 2).sum(axis=-1)
    return square.min(axis=1).mean() + square.min(axis=0).mean()


@pytest.mark.parametrize("search", ["exact", "window"])
def test_chamfer_is_the_brute_force_one(torch, rng, search):
    """The window here is the whole image. The gradient: central differences of the brute force."""
    from upbeam.model.losses import chamfer

    distance, made, truth, real, geometry = cloud(torch, rng)
    loss = Loss("chamfer", search=search, search_rows=4, search_columns=6)
    points = lambda x, exists: geometry.points(x)[exists].double().numpy()  # noqa: E731
    given = distance.clone().requires_grad_()
    value = chamfer(given, made, truth, real, geometry, loss)
    both = points(distance, made), points(truth, real)
    assert float(value.detach()) == pytest.approx(brute_force(*both), rel=1e-5)
    assert float(value.detach()) == pytest.approx(chamfer_m2(*both)[0], rel=1e-5)
    value.backward()
    assert not given.grad[~made].any()
    for row, column in [(0, 0), (2, 5), (4, 11)]:
        step = torch.zeros_like(distance)
        step[row, column] = 1e-3
        slope = [brute_force(points(distance + s * step, made), points(truth, real)) for s in (1, -1)]
        assert float(given.grad[row, column]) == pytest.approx((slope[0] - slope[1]) / 2e-3, abs=2e-3)


def test_chamfer_with_empty_pixels_at_the_sensor(torch, rng):
    """Many equal points, on both sides: the same as the brute force over all pixels."""
    from upbeam.model.losses import chamfer

    distance, made, truth, real, geometry = cloud(torch, rng)
    distance[2] = 0
    distance[~made], truth[~real] = 0, 0
    everything = torch.ones_like(made)
    given = distance.clone().requires_grad_()
    value = chamfer(given, everything, truth, everything, geometry, Loss("chamfer"))
    both = (geometry.points(x).double().reshape(-1, 3).numpy() for x in (distance, truth))
    assert float(value.detach()) == pytest.approx(brute_force(*both), rel=1e-5)
    value.backward()
    assert bool(torch.isfinite(given.grad).all())


def test_window_search_against_a_loop(torch, rng):
    """A narrow window that wraps: the nearest existing point within reach, or none."""
    from upbeam.model.losses import nearest_in_window

    distance, made, truth, real, geometry = cloud(torch, rng, rows=6, columns=20)
    real[:, 8:13] = False  # some points find nothing
    a, b = geometry.points(distance), geometry.points(truth)
    found = nearest_in_window(a, made, b, real, 1, 2)
    for mine, exists, other, other_exists, result in ((a, made, b, real, found[0]), (b, real, a, made, found[1])):
        for row in range(6):
            for column in range(20):
                reach = [
                    (r, c % 20) for r in range(max(0, row - 1), min(6, row + 2)) for c in range(column - 2, column + 3)
                ]
                reach = [cell for cell in reach if other_exists[cell]] if exists[row, column] else []
                gaps = [float(((mine[row, column] - other[cell]) ** 2).sum()) for cell in reach]
                expected = -1 if not gaps else reach[int(np.argmin(gaps))][0] * 20 + reach[int(np.argmin(gaps))][1]
                assert int(result[row, column]) == expected
    assert (found[0][made] == -1).any()


def test_exact_search_in_blocks(torch, rng):
    """What a GPU runs, here on the CPU, against the k-d tree."""
    from upbeam.model import losses

    a, b = (torch.from_numpy(rng.uniform(-40, 40, (n, 3)).astype(np.float32)) for n in (700, 500))
    plain = "donot_use_mm_for_euclid_dist"
    blocks = torch.cat([torch.cdist(part, b, compute_mode=plain).argmin(dim=1) for part in torch.split(a, 64)])
    assert torch.equal(losses.nearest_exact(a, b), blocks)


def test_a_chamfer_of_nothing_has_no_gradient(torch, rng):
    from upbeam.model.losses import chamfer

    distance, made, truth, real, geometry = cloud(torch, rng)
    for search in ("exact", "window"):
        given = distance.clone().requires_grad_()
        value = chamfer(given, made, truth, torch.zeros_like(real), geometry, Loss("chamfer", search=search))
        value.backward()
        assert float(value.detach()) == 0
        assert not given.grad.any()


# ---------------------------------------------------------------------------------------------------------- runs


def small_run(recipe, kind):
    """Seconds of training: windows, or images with the Chamfer loss and the plateau schedule."""
    if kind == "windows":
        return replace(recipe, training=replace(recipe.training, steps=60, batch=512, starts=3))
    paper = load_recipe("paper-small")
    short = {"epochs": {"distance": 6, "intensity": 3}, "batch_images": 2, "mirror": True}
    training = replace(paper.training, schedule="plateau", patience=1, **short)
    return replace(paper, training=training, seed=recipe.seed)


@pytest.fixture(scope="module")
def images(torch):
    """Three narrow frames of a plain, with a truth that is no mean of its neighbours."""
    rng = np.random.default_rng(11)
    rules = replace(load_recipe("paper-small").make_rules(), columns=128)
    ground = np.clip(1.8 / np.sin(np.radians(np.maximum(0.5, -rules.row_elevation_deg))), 3, 75) / rules.distance_unit_m
    frames = []
    for k in range(3):
        distance = (ground[:, None] * rng.uniform(0.98, 1.02, (64, 128))).astype(np.uint16)
        distance[rng.random(distance.shape) < 0.2] = 0
        intensity = np.where(distance > 0, 40 + rng.integers(0, 60, distance.shape), 0).astype(np.uint8)
        frame = Frame(str(k), distance, intensity, rules.distance_unit_m, rules.row_elevation_deg, rules.row_height_m)
        frames.append(frame)
    return rules, frames


@pytest.mark.parametrize("kind", ["windows", "images"])
def test_an_interrupted_run_ends_with_the_same_bits(smoke, images, tmp_path, kind):
    from upbeam.model.train import TrainingError, train_networks

    recipe = small_run(smoke[0], kind)
    rules, data = (smoke[1], smoke[2]) if kind == "windows" else images
    held = samples_part(data) if kind == "windows" else data[:1]
    whole = train_networks(recipe, data, rules, validation=held)
    path, every = tmp_path / "run.ckpt", 7 if kind == "windows" else 3

    class StopError(Exception):
        pass

    for stop_in in ("distance", "intensity"):  # interrupted twice, once in each network

        def progress(name, step, steps, loss, validation, stop_in=stop_in):
            if name == stop_in and step >= steps // 2:
                raise StopError

        with pytest.raises(StopError):
            train_networks(recipe, data, rules, progress, checkpoint=path, checkpoint_every=every, validation=held)
        assert path.exists()
    resumed = train_networks(recipe, data, rules, checkpoint=path, checkpoint_every=every, validation=held)
    assert resumed.losses == whole.losses
    assert resumed.validation == whole.validation
    for name, module in whole.modules.items():
        for key, value in module.state_dict().items():
            assert resumed.modules[name].state_dict()[key].numpy().tobytes() == value.numpy().tobytes()
    assert [p.name for p in tmp_path.iterdir()] == ["run.ckpt"]

    with pytest.raises(TrainingError, match="another recipe"):
        train_networks(replace(recipe, seed=99), data, rules, checkpoint=path)
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(TrainingError, match="no checkpoint"):
        train_networks(recipe, data, rules, checkpoint=path)


def samples_part(samples):
    """Every seventh window, as if of other frames."""
    return type(samples)(*(getattr(samples, field)[::7] for field in asdict(samples)))


@pytest.mark.parametrize("kind", ["windows", "images"])
def test_a_validation_loss_changes_no_bit(torch, smoke, images, kind):
    """Same weights and losses with and without; the loss is the one of the finished network, as it is."""
    from upbeam.model import train

    recipe = small_run(smoke[0], kind)
    recipe = replace(recipe, training=replace(recipe.training, validate_every=2))
    rules, data = (smoke[1], smoke[2]) if kind == "windows" else images
    held = samples_part(data) if kind == "windows" else data[:1]
    calls = []
    plain = train.train_networks(recipe, data, rules)
    result = train.train_networks(recipe, data, rules, lambda *call: calls.append(call), validation=held)
    assert plain.validation == {}
    assert result.losses == plain.losses
    for name, module in plain.modules.items():
        for key, value in module.state_dict().items():
            assert result.modules[name].state_dict()[key].numpy().tobytes() == value.numpy().tobytes()
        logged = [step for step, _ in result.losses[name]]
        due = logged[1::2] if len(logged) % 2 == 0 else [*logged[1::2], logged[-1]]
        assert [step for step, _ in result.validation[name]] == due
        told = [(step, loss) for n, step, _, _, loss in calls if n == name and loss is not None]
        assert told == result.validation[name][-len(told) :]
        batches = train._batches(recipe, name, held, rules, train.pick_device("cpu"))
        with torch.no_grad():
            by_hand = sum(float(part) * share for part, share in batches.whole(result.modules[name]))
        assert result.validation[name][-1][1] == pytest.approx(by_hand)


def test_the_validation_loss_of_windows_by_hand(torch, smoke, trained):
    """Of a mean over chunks of unequal length, too."""
    from upbeam.model import train

    recipe, rules, samples = smoke
    batches = train._batches(recipe, "intensity", samples, rules, train.pick_device("cpu"))
    module = trained.modules["intensity"]
    with torch.no_grad():
        y = module(torch.from_numpy(samples.intensity.astype(np.float32))).numpy()
        whole = sum(float(part) * share for part, share in batches.whole(module))
    assert len(samples) % 8192
    assert whole == pytest.approx(np.abs(y - samples.intensity_target).mean(), rel=1e-5)


def test_of_several_starts_the_best_goes_on(smoke):
    """The chosen run is the one whose loss was lowest after an eighth of the steps, and it keeps what it learned."""
    from upbeam.model import train

    recipe, rules, samples = smoke
    short = replace(recipe, training=replace(recipe.training, steps=400, starts=4))
    batches = train._batches(short, "distance", samples, rules, train.pick_device("cpu"))
    runs = [train._Run(short, "distance", batches, train.pick_device("cpu"), start) for start in range(4)]
    for run in runs:
        for _ in range(50):
            run.advance(lambda *_: None)
    losses = [run.log[-1][1] for run in runs]
    chosen = train._best_start(short, "distance", batches, None, train.pick_device("cpu"), fresh=True)
    assert len(set(losses)) == 4
    assert chosen.log == runs[int(np.argmin(losses))].log
    assert chosen.step == 50


def test_regraded_intensities_stay_intensities(smoke, torch):
    from upbeam.model import train

    recipe, rules, samples = smoke
    graded = replace(recipe, training=replace(recipe.training, intensity_gain=0.5, intensity_noise=0.5))
    batches = train._batches(graded, "intensity", samples, rules, train.pick_device("cpu"))
    x, y = torch.full((4000, 6), 100.0), torch.full((4000,), 100.0)
    a, b = batches._regraded(x, y, np.random.default_rng(0))
    assert 0 <= float(a.min()) < 50 < 150 < float(a.max()) <= 255
    logs = torch.log(a / 100).numpy()
    assert np.corrcoef(logs[:, 0], logs[:, 1])[0, 1] == pytest.approx(0.5, abs=0.1)  # one laser: half is shared
    assert abs(np.corrcoef(logs[:, 0], logs[:, 3])[0, 1]) < 0.1  # another laser
    assert float(b.std()) > 20


def test_images_and_chamfer_learn(smoke, images):
    from upbeam.model.train import train_networks

    recipe = small_run(smoke[0], "images")
    rules, frames = images
    recipe = replace(recipe, training=replace(recipe.training, epochs={"distance": 60, "intensity": 20}))
    result = train_networks(recipe, frames, rules)
    for name in ("distance", "intensity"):
        assert result.losses[name][-1][1] < 0.8 * result.losses[name][0][1]
    assert result.samples == 3
    # 2 steps an epoch, an entry an epoch
    assert [step for step, _ in result.losses["distance"]] == list(range(2, 121, 2))


def test_a_plateau_halves_the_learning_rate(torch, smoke, images):
    from upbeam.model import train

    recipe = small_run(smoke[0], "images")
    device = train.pick_device("cpu")
    batches = train._batches(recipe, "intensity", images[1], images[0], device)
    run = train._Run(recipe, "intensity", batches, device)
    for loss, expected in ((5.0, 0.01), (6.0, 0.01), (6.0, 0.005), (4.0, 0.005)):  # patience 1
        run.schedule.step(loss)
        assert run.optimiser.param_groups[0]["lr"] == expected


def test_a_dead_network_is_named(torch, smoke, images):
    from upbeam.model import train

    recipe = small_run(smoke[0], "images")
    module = train.TorchWindowNetwork(recipe.networks["distance"])
    with torch.no_grad():
        module.linear_2.weight.zero_()
        module.linear_2.bias.fill_(-1)
    with pytest.raises(train.TrainingError, match="dead"):
        train._seen(module, torch.ones(4, 6))


def test_wrong_data_or_device_is_refused(torch, smoke, images):
    from upbeam.model.train import TrainingError, pick_device, train_networks

    recipe = small_run(smoke[0], "images")
    with pytest.raises(TrainingError, match="batches of images need frames"):
        train_networks(recipe, smoke[2], smoke[1])
    with pytest.raises(TrainingError, match="no frames"):
        train_networks(recipe, [], smoke[1])
    with pytest.raises(TrainingError, match="expected auto"):
        pick_device("tpu")
    if not torch.cuda.is_available():
        assert pick_device("auto").type == "cpu"
        with pytest.raises(TrainingError, match="no CUDA"):
            pick_device("cuda")


# ----------------------------------------------------------------------------------------------------- command line


UNCHANGED = {
    "evaluate": None, "checkpoint": None, "checkpoint_every": 10, "device": "cpu",
    "epochs": None, "steps": None, "simulated": None,
}  # fmt: skip


def tiny_recipe(path, widths):
    recipe = asdict(replace(load_recipe("smoke"), windows=2000))
    del recipe["validation"]
    for network in recipe["networks"].values():
        network["widths"] = widths
    recipe["data"][0].update(frames=1, only_drives=[], without_drives=[])
    recipe["validation"] = [{"source": "simulator", "frames": 1, "seed": 9}]
    recipe["training"] = {**recipe["training"], "steps": 20, "batch": 256}
    recipe["data"] = list(recipe["data"])
    path.write_text(json.dumps(recipe))  # JSON is YAML
    return str(path)


def test_the_command_writes_model_log_and_picture(torch, tmp_path, capsys):
    from upbeam.cli.train import train

    recipe = tiny_recipe(tmp_path / "tiny.yaml", [8, 2, 12])
    out = tmp_path / "tiny.ubm"
    arguments = {**UNCHANGED, "checkpoint": tmp_path / "tiny.ckpt"}
    train(recipe, out, as_json=True, **arguments)
    summary = json.loads(capsys.readouterr().out)
    assert upbeam.load_model(out).crc32 == int(summary["crc32"], 16)
    assert summary["samples"] == 2000
    assert set(summary["validation"]["methods"]) == {*BASELINES, "smoke"}
    with out.with_suffix(".csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == ["network", "step", "loss", "validation_loss"]
    assert {row["network"] for row in rows} == {"distance", "intensity"}
    assert all(float(row["loss"]) > 0 and float(row["validation_loss"]) > 0 for row in rows)
    assert out.with_suffix(".png").read_bytes().startswith(b"\x89PNG")
    assert (tmp_path / "tiny.ckpt").exists()


def test_the_command_keeps_what_a_model_file_cannot_hold(torch, tmp_path, capsys):
    from upbeam.cli.common import UserError
    from upbeam.cli.train import train
    from upbeam.model.train import load_networks

    recipe = tiny_recipe(tmp_path / "tiny.yaml", [[8, 2], [12, 6]])
    arguments = {**UNCHANGED, "as_json": True}
    with pytest.raises(UserError, match=r"must end in \.pt"):
        train(recipe, tmp_path / "tiny.ubm", **arguments)
    train(recipe, tmp_path / "tiny.pt", **arguments)
    assert json.loads(capsys.readouterr().out)["validation"]["methods"]["smoke"]["mae_m"] > 0
    assert load_networks(tmp_path / "tiny.pt")["distance"].recipe.widths == ((8, 2), (12, 6))


def test_what_the_command_line_changes_is_told(torch, tmp_path, capsys):
    """Epochs and data of the recipe replaced: by what, stands in the model."""
    from upbeam.cli.train import train

    text = resources.files("upbeam.model").joinpath("recipes/paper-ring.yaml").read_text()
    (tmp_path / "narrow.yaml").write_text(text.replace("columns: 2048", "columns: 128"))
    changed = {**UNCHANGED, "epochs": 4, "simulated": 2}
    train(str(tmp_path / "narrow.yaml"), tmp_path / "narrow.ubm", **changed, as_json=True)
    summary = json.loads(capsys.readouterr().out)
    assert summary["changes"] == {"epochs": 4, "simulated": 2}
    provenance = upbeam.load_model(tmp_path / "narrow.ubm").file.provenance
    assert provenance["changes"] == summary["changes"]
    assert provenance["data"] == ["upbeam simulator, 2 frames, seed 5000"]
    assert summary["validation"]["frames"] == 1


# ------------------------------------------------------------------------------------------------------- Shan 2020


@pytest.fixture(scope="module")
def shan(images):
    from upbeam.model.shan import train_shan

    rules, frames = images
    return train_shan(frames, rules, width=1 / 16, steps=60, crop_columns=64, batch=2, learning_rate=3e-3, seed=4)


def test_shan_trains_and_repeats(torch, shan, images):
    from upbeam.model.shan import ShanNet, train_shan

    rules, frames = images
    image = torch.from_numpy(frames[0].distance.astype(np.float32) * np.float32(rules.distance_unit_m / 80))
    with torch.no_grad():
        error = [
            float((network.eval()(image[None, None, ::2])[0, 0, 1:-1:2] - image[1:-1:2]).abs().mean())
            for network in (ShanNet(1 / 16), shan)
        ]
    assert error[1] < 0.6 * error[0]
    short = {"width": 1 / 64, "steps": 3, "crop_columns": 32, "batch": 1, "seed": 8}
    a, b = (train_shan(frames, rules, **short).state_dict() for _ in range(2))
    assert all(torch.equal(a[key], b[key]) for key in a)


def test_shan_method_shape_and_seed(torch, shan, images, tmp_path):
    from upbeam.model.shan import load_shan, shan_method

    rules, frames = images
    given = frames[1].distance[::2, :100], frames[1].intensity[::2, :100]  # no multiple of the pooling
    before = torch.get_rng_state()
    d, i = shan_method(shan, passes=6, seed=3)(*given, rules)
    assert torch.equal(before, torch.get_rng_state())
    assert d.shape == i.shape == (31, 100)
    assert (d.dtype, i.dtype) == (np.uint16, np.uint8)
    assert d.any()
    assert np.all((d == 0) | ((d >= rules.min_count) & (d <= rules.max_count)))
    assert not i[d == 0].any()
    torch.save(shan.state_dict(), tmp_path / "shan.pt")
    again = shan_method(tmp_path / "shan.pt", passes=6, seed=3)(*given, rules)
    assert np.array_equal(d, again[0])
    other = shan_method(shan, passes=6, seed=4)(*given, rules)
    assert not np.array_equal(d, other[0])
    (tmp_path / "shan.pt").write_bytes(b"no")
    with pytest.raises(NetworkError, match=r"shan\.pt"):
        load_shan(tmp_path / "shan.pt")
    with pytest.raises(ValueError, match="2 or more"):
        shan_method(shan, passes=1)


def test_shan_removes_what_it_is_not_sure_of(torch):
    """Standard deviation over the passes above 0.03 of the mean: by hand, on both sides of the border."""
    from upbeam.model.shan import uncertain_removed

    spread = np.array([-1, 1], np.float32)[:, None]
    passes = np.float32(10) + spread * np.array([[0.0, 0.29, 0.31, 5.0]], np.float32)
    assert np.allclose(uncertain_removed(passes), [10, 10, 0, 0])
    assert uncertain_removed(np.zeros((3, 1), np.float32)) == [0]


def test_shan_network_of_the_paper(torch):
    from upbeam.model.shan import ShanNet

    network = ShanNet(1.0)
    assert [len(block[0].bias) for block in (network.first, *network.down)] == [64, 128, 256, 512, 1024]
    dropped = network.passes(torch.rand(32, 32), 3, seed=0)
    assert dropped.shape == (3, 64, 32)
    assert not torch.equal(dropped[0], dropped[1])


def test_shan_is_as_published_where_it_can_be(torch):
    """50 passes, removed above 0.03 of the mean."""
    import inspect

    from upbeam.cli import evaluate
    from upbeam.model import shan

    assert shan.PASSES == evaluate.PASSES == inspect.signature(shan.shan_method).parameters["passes"].default == 50
    assert shan.UNCERTAIN == inspect.signature(shan.uncertain_removed).parameters["share"].default == 0.03


def test_shan_s_validation_changes_no_bit(torch, images):
    from upbeam.model.shan import train_shan

    rules, frames = images
    short = {"width": 1 / 64, "steps": 30, "crop_columns": 32, "batch": 1, "seed": 8}
    calls = []
    a = train_shan(frames, rules, **short).state_dict()
    b = train_shan(frames, rules, **short, validation=frames[:2], progress=lambda *c: calls.append(c)).state_dict()
    assert all(torch.equal(a[key], b[key]) for key in a)
    assert [call[:2] for call in calls] == [(25, 30), (30, 30)]
    assert all(0 < call[2] < 1 and 0 < call[3] < 1 for call in calls)


def test_networks_and_u_net_beside_the_baselines(torch, tmp_path, capsys):
    """From the commands alone: train both kinds of .pt, and judge them in one table."""
    from typer.testing import CliRunner

    from upbeam.cli.main import app
    from upbeam.cli.train import train

    two = tmp_path / "two-layers.pt"
    train(tiny_recipe(tmp_path / "tiny.yaml", [[8, 2], [12, 6]]), two, **UNCHANGED)
    recipe = asdict(load_any_recipe("shan-small"))
    recipe.update(columns=256, unet={"width": 1 / 64, "steps": 60, "batch": 2, "crop_columns": 128})
    recipe["data"] = [{"source": "simulator", "frames": 2, "seed": 3}]
    del recipe["validation"]
    (tmp_path / "u.yaml").write_text(json.dumps(recipe))
    unet = tmp_path / "unet.pt"
    train(str(tmp_path / "u.yaml"), unet, **UNCHANGED, as_json=True)
    capsys.readouterr()
    arguments = ["evaluate", "sim", "--frames", "1", "--columns", "256", "--passes", "3", "--json"]
    done = CliRunner().invoke(app, [*arguments, "--with", str(two), "--with", str(unet)])
    assert done.exit_code == 0, done.output
    found = json.loads(done.stdout)
    assert {*BASELINES, "upbeam-fp32", "two-layers", "unet"} == set(found["methods"])
    assert found["monte_carlo_passes"] == {"unet": 3}
    assert found["models"]["upbeam-fp32"]["multiply_adds_per_window"] == 96
    (tmp_path / "other.pt").write_bytes(b"no")
    for path, said in ((tmp_path / "other.pt", "a file of upbeam train"), (tmp_path / "absent.pt", "no such file")):
        wrong = CliRunner().invoke(app, [*arguments, "--with", str(path)])
        assert said in str(wrong.exception)


def test_saved_networks_keep_their_rules(torch, tmp_path):
    """The paper's rules in the file, the caller's range limits: as the reference under both."""
    from upbeam.model.train import TorchWindowNetwork, networks_method, save_networks, torch_method

    torch.manual_seed(1)
    modules = {name: TorchWindowNetwork(network_recipe((8, 2), (12, 6))) for name in ("distance", "intensity")}
    own = Rules.for_beams(beam_table("hdl-64e"), columns=40, edge="zero", empty="none", ground_reach=0.0)
    save_networks(tmp_path / "n.pt", modules, own)
    caller = replace(own, edge="seam", empty="fill", max_count=30_000, row_max_count=np.full(64, 30_000))
    distance, intensity = random_image(np.random.default_rng(1), 32, 40)
    found = networks_method(tmp_path / "n.pt")(distance, intensity, caller)
    limited = replace(own, max_count=30_000, row_max_count=np.full(64, 30_000))
    expected, other = (torch_method(modules)(distance, intensity, rules) for rules in (limited, caller))
    assert np.array_equal(found[0], expected[0])
    assert not np.array_equal(found[0], other[0])
    save_networks(tmp_path / "bare.pt", modules)
    with pytest.raises(NetworkError, match="without the rules"):
        networks_method(tmp_path / "bare.pt")
