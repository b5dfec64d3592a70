"""Operation counts: the published figures, and a recount by a network that counts what it does."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from upbeam.power.ops import count_operations


def test_the_papers_figures():
    d = count_operations().as_dict()
    assert d["windows_per_image"] == 63_488
    assert d["macs_per_window_dense"] == 312
    assert d["macs_per_window_executed"] == 96
    assert d["operations_per_image_dense"] == 39_616_512
    assert d["macs_per_frame_dense"] == 39_616_512
    assert d["parameters"] == 215
    assert d["weight_bytes"] == 860
    assert d["parameters_executed"] == 109
    assert d["input_bytes"] == 1_523_712
    assert "2.36" in d["paper_total_memory_note"]
    assert [(x["name"], x["macs_per_window"], x["parameters"]) for x in d["layers"][:4]] == [
        ("conv1", 48, 16), ("conv2", 96, 18), ("linear_1", 156, 168), ("linear_2", 12, 13),
    ]  # fmt: skip


class Counter:
    """A window network written out product by product, which counts multiplications and additions."""

    def __init__(self):
        self.multiplications = self.additions = self.weights = 0

    def layer(self, inputs, outputs):
        """A dense layer on plain numbers: every weight is used once, every bias starts a sum."""
        for _ in range(outputs):
            total, self.weights = 0.5, self.weights + 1
            for value in inputs:
                total += value * 0.5
                self.multiplications += 1
                self.additions += 1
                self.weights += 1
            yield total


def recount(widths):
    """Pointwise convolutions: one small dense layer for every pixel, weights shared between pixels."""
    c1, c2, hidden = widths
    counter, features = Counter(), []
    for pixel in range(6):
        before = counter.weights
        features += list(counter.layer(list(counter.layer([1.0], c1)), c2))
        if pixel:
            counter.weights = before
    list(counter.layer(list(counter.layer([*features, 1.0], hidden)), 1))
    return counter


@given(st.tuples(st.integers(1, 16), st.integers(1, 8), st.integers(1, 24)))
def test_counts_equal_a_network_that_counts(widths):
    counter, count = recount(widths), count_operations(widths)
    assert count.macs_dense == counter.multiplications == counter.additions
    assert count.parameters == counter.weights


@given(st.integers(1, 32))
def test_folded_counts(hidden):
    counter = Counter()
    list(counter.layer(list(counter.layer([1.0] * 7, hidden)), 1))
    count = count_operations((8, 2, hidden))
    assert (count.macs_folded, count.parameters_folded) == (counter.multiplications, counter.weights)


def test_impossible_widths():
    with pytest.raises(ValueError, match="at least 1"):
        count_operations((0, 2, 12))
