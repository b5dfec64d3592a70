"""Operation counts: the published figures, and a recount by a network that counts what it does."""

from __future__ import annotations

from collections import Counter
from typing import ClassVar

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from upbeam.model.network import PAPER_WIDTHS, WindowNetwork
from upbeam.power.ops import count_model, count_operations
from upbeam.quant.sizes import weight_bytes
from upbeam.runtime.upsampler import load_model


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


class Counted:
    """A number that counts what is done to it. Products with ``slope`` and ``scale`` are told from those with weights
    by their value."""

    counts: ClassVar[Counter[str]] = Counter()
    slope, scale = 0.0123, 3.25

    def __init__(self, value):
        self.value = float(value)

    def _do(self, what, result):
        Counted.counts[what] += 1
        return Counted(result)

    def __mul__(self, other):
        other = getattr(other, "value", other)
        what = {self.slope: "slope", self.scale: "scale"}.get(other, "multiplications")
        return self._do(what, self.value * other)

    def __add__(self, other):
        return self._do("additions", self.value + getattr(other, "value", other))

    def __sub__(self, other):
        return self._do("subtractions", self.value - getattr(other, "value", other))

    def __truediv__(self, other):
        return self._do("scale", self.value / other)

    def __gt__(self, other):
        Counted.counts["comparisons"] += 1
        return self.value > getattr(other, "value", other)

    def __lt__(self, other):
        Counted.counts["comparisons"] += 1
        return self.value < getattr(other, "value", other)

    __ge__, __le__, __rmul__, __radd__ = __gt__, __lt__, __mul__, __add__


def counted(network):
    """Runs the network itself, one window, on numbers that count."""
    Counted.counts = Counter()
    y = network(np.array([Counted(x) for x in (5.0, 7.5, 9.25, 4.75, 6.125, 8.0)], dtype=object))
    return float(getattr(y, "value", y) if np.ndim(y) == 0 and not hasattr(y, "item") else y.item().value)


def network_of(widths, rng, **graph):
    c1, c2, hidden = widths
    n = rng.normal
    return WindowNetwork(
        n(size=c1), n(size=c1), n(size=(c2, c1)), n(size=c2), n(size=(hidden, 6 * c2 + 1)), n(size=hidden),
        n(size=hidden), float(n()), slope=Counted.slope, **graph,
    )  # fmt: skip


def test_counts_equal_the_network_run_on_numbers_that_count(rng):
    """The dense and the folded forward, as they are, for the paper's widths and 29 random networks."""
    networks = [PAPER_WIDTHS, *(tuple(rng.integers(1, (17, 9, 33))) for _ in range(29))]
    for widths in networks:
        widths = tuple(int(x) for x in widths)
        network, count = network_of(widths, rng), count_operations(widths)
        plain = [5.0, 7.5, 9.25, 4.75, 6.125, 8.0]
        assert counted(network) == pytest.approx(float(network(plain)), rel=1e-12), widths
        dense = Counted.counts
        # The seven inputs and the output are scaled by 1, which is no weight's product.
        assert dense["multiplications"] - 7 == count.macs_dense, widths
        assert dense["additions"] == count.macs_dense, widths
        assert dense["slope"] == widths[2]
        assert network.parameters == count.parameters
        folded = network.fold()
        assert counted(folded) == pytest.approx(float(folded(plain)), rel=1e-12), widths
        executed = Counted.counts
        assert executed["multiplications"] - 1 == count.macs_folded, widths  # less skip * minimum
        assert executed["additions"] - 1 == count.macs_folded, widths
        assert executed["comparisons"] >= sum(x.comparisons for x in count.folded) - 1, widths
        assert folded.parameters == count.parameters_folded
        assert folded.multiply_adds == count.macs_folded
    print(f"{len(networks)} networks recounted")


@given(st.integers(1, 32), st.integers(1, 4096))
def test_the_kernel_computes_no_less_than_the_folded_graph(hidden, columns):
    count = count_operations((8, 2, hidden), columns)
    frame = 2 * count.macs_folded * count.windows
    assert frame <= count.macs_kernel("fp32") <= count.macs_kernel("int16") == count.macs_kernel("int8")
    assert count.macs_kernel("fp32") <= frame * 32 / 31 * (hidden + 1) / hidden


def test_traffic():
    traffic = count_operations().traffic()
    assert traffic["dense"]["read"] > traffic["folded"]["read"] > traffic["kernel"]["read"]
    # 32 pixels in, 64 out, three bytes each; four prepared rows of 32 words.
    assert traffic["kernel"] == {"read": 2048 * (96 + 3 * 256), "written": 2048 * (192 + 256)}


def test_weights_are_those_of_a_model_file():
    """Sections hold besides: for each network of floats 16 bytes, of integers 24 and at most 3 of padding."""
    model = load_model()
    count = count_model(model.file, model.columns)
    for precision, size in weight_bytes(model.data).items():
        header = 2 * (16 if precision == "fp32" else 24)
        assert 0 <= size - header - count.weight_bytes_folded(precision) <= 6, precision


def test_the_paper_beside_ours():
    rows = {x["key"]: x for x in count_operations().as_dict()["paper"]}
    for key, row in rows.items():
        if key != "total_bytes":
            assert row["ours"] == pytest.approx(row["paper"], rel=3e-3), key
    assert rows["total_bytes"]["ours"] == 1_524_572


def test_impossible_widths():
    with pytest.raises(ValueError, match="at least 1"):
        count_operations((0, 2, 12))
