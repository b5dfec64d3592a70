"""The window network against PyTorch's stored results, and the fold against the dense graph."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from upbeam.model.network import NetworkError, WindowNetwork, from_state_dict, load_state_dict

VECTORS = Path(__file__).parents[1] / "vectors" / "window_network.npz"


def random_network(rng, widths=(8, 2, 12), **graph):
    c1, c2, h = widths
    return WindowNetwork(
        rng.normal(size=c1), rng.normal(size=c1), rng.normal(size=(c2, c1)), rng.normal(size=c2),
        rng.normal(size=(h, 6 * c2 + 1)), rng.normal(size=h), rng.normal(size=h), float(rng.normal()), **graph,
    )  # fmt: skip


def stored(index):
    with np.load(VECTORS) as archive:
        prefix = f"{index}."
        state = {k.removeprefix(prefix): v for k, v in archive.items() if k.startswith(prefix)}
        return archive["windows"], state.pop("y"), state


@pytest.mark.parametrize("index", range(4))
def test_dense_and_folded_give_what_pytorch_gave(index):
    windows, expected, state = stored(index)
    network = from_state_dict(state)
    folded = network.fold()
    scale = folded.magnitude(windows)
    assert np.max(np.abs(network(windows) - expected) / scale) < 1e-13
    assert np.max(np.abs(folded(windows) - expected) / scale) < 1e-13
    assert (expected > 0).any()


def test_the_published_counts():
    network = from_state_dict(stored(0)[2])
    assert network.parameters == 215
    assert network.fold().parameters == 109
    assert network.fold().multiply_adds == 96


@given(
    seed=st.integers(0, 2**32 - 1),
    widths=st.tuples(st.integers(1, 12), st.integers(1, 6), st.integers(1, 16)),
    inputs=st.sampled_from(["raw", "difference"]),
    output=st.sampled_from(["raw", "residual"]),
    scale=st.sampled_from([1.0, 0.05, 1 / 64]),
    extreme=st.sampled_from([0.0, 80.0, 255.0, 65535.0, None]),
)
def test_fold_agrees_to_a_millionth_of_the_sum_of_terms(seed, widths, inputs, output, scale, extreme):
    rng = np.random.default_rng(seed)
    network = random_network(rng, widths, inputs=inputs, output=output, scale=scale, slope=0.01)
    windows = rng.uniform(0, 255, (64, 6))
    if extreme is not None:
        windows[::2] = np.where(rng.random((32, 6)) < 0.5, extreme, windows[::2])
    folded = network.fold()
    # Scale of rounding errors: the terms of the graph that was evaluated, differences taken or not.
    terms = folded.magnitude(windows) + 1e-9
    assert np.max(np.abs(network(windows) - folded(windows)) / terms) < 1e-6


def test_flattening_is_channel_major_and_the_window_is_rows_first():
    """One hot weights: hidden unit reads channel 1 of pixel r1c-1 alone."""
    linear = np.zeros((1, 13))
    linear[0, 6 + 3] = 1.0
    network = WindowNetwork(
        np.ones(1), np.zeros(1), np.array([[0.0], [10.0]]), np.zeros(2), linear, np.zeros(1), np.ones(1), 0.0
    )
    assert network(np.array([1, 2, 3, 4, 5, 6])) == pytest.approx(40.0)
    assert network.fold()(np.array([1, 2, 3, 4, 5, 6])) == pytest.approx(40.0)


def test_leaky_and_final_rectifier():
    def unit(weight, output):
        linear = np.zeros((1, 7))
        linear[0, 0] = weight
        return WindowNetwork(
            np.ones(1), np.zeros(1), np.ones((1, 1)), np.zeros(1), linear, np.zeros(1), np.array([output]), 0.0
        )

    window = np.array([5.0, 1, 1, 1, 1, 1])
    assert unit(-2.0, -1.0)(window) == pytest.approx(0.1)  # -10 -> -0.1 (slope 0.01) -> 0.1
    assert unit(2.0, -1.0)(window) == 0.0
    assert unit(-2.0, -1.0).fold()(window) == pytest.approx(0.1)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (lambda s: s.pop("conv1.weight"), "missing conv1.weight"),
        (lambda s: s.update({"conv3.weight": np.zeros(1)}), "unexpected conv3.weight"),
        (lambda s: s.update({"linear_1.weight": np.zeros((12, 12))}), "linear_1"),
        (lambda s: s.update({"conv2.weight": np.zeros((2, 8))}), "conv2.weight"),
        (lambda s: s.update({"linear_2.weight": np.zeros((2, 12))}), "linear_2"),
        (lambda s: s.update({"linear_2.bias": np.array([np.nan])}), "linear_2_bias"),
        (lambda s: s.update({"conv1.bias": np.full(8, np.inf)}), "conv1_bias"),
    ],
)
def test_a_wrong_state_dict_is_refused_by_name(change, named):
    state = stored(0)[2]
    change(state)
    with pytest.raises(NetworkError, match=named):
        from_state_dict(state)


def test_weights_from_a_file(tmp_path):
    windows, expected, state = stored(0)
    path = tmp_path / "weights.npz"
    np.savez(path, **state)
    network = load_state_dict(path)
    assert np.allclose(network(windows), expected, rtol=1e-9)
    path.write_bytes(path.read_bytes()[:500])
    with pytest.raises(NetworkError, match=r"weights\.npz"):
        load_state_dict(path)
    with pytest.raises(NetworkError, match="unknown kind"):
        load_state_dict(tmp_path / "weights.h5")


def test_windows_of_a_wrong_shape_are_refused():
    with pytest.raises(NetworkError, match=r"\[3, 5\]"):
        random_network(np.random.default_rng(0))(np.zeros((3, 5)))
