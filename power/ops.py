"""Operations and memory of a window network, per layer, per image and per frame.

Counted from the layer widths, for three graphs: *dense* (as trained), *folded* (as executed: the same function in fewer
products) and *kernel* (the folded one as our vector kernels run it: 32 windows a column instead of 31, hidden units two
at a time, integer inputs in pairs). A multiply-accumulate (MAC) is one multiplication and one addition; a layer's bias
is the addition that its first product needs, so both counts are equal.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from upbeam.model.network import PAPER_WIDTHS, WINDOW
from upbeam.model.rules import BEAMS, PAIRS, ROWS
from upbeam.quant.ubm import ModelFile

__all__ = ["PAPER_FIGURES", "PAPER_MEMORY_NOTE", "Layer", "OperationCount", "count_model", "count_operations"]

FLOAT_BYTES = 4
NETWORKS = 2
"""Distance and intensity."""
PIXEL_BYTES = 2 + 1
"""A count of distance and one of intensity."""
LANES = 32
"""Windows of a column that the kernels compute; the last has no meaning."""
MINIMUM_COMPARISONS = WINDOW - 1
_WEIGHT_BYTES = {"fp32": 4, "int16": 2, "int8": 1}
_INTEGER_BIAS_BYTES = 4

PAPER_MEMORY_NOTE = (
    "The paper states 2.36 MB: 1.52 MB of window inputs plus 0.84, but 0.84 is the 860 bytes of weights in KiB, "
    "added as if they were MB. The real sum is 1.525 MB, and a streaming implementation never materialises the windows."
)

PAPER_FIGURES: dict[str, tuple[float, str, str]] = {
    "operations_per_image_dense": (39.6e6, "operations", "additions and multiplications of an image"),
    "macs_per_image_dense": (19.8e6, "MAC", "multiply-adds of one network, an image"),
    "macs_per_frame_dense": (39.6e6, "MAC", "both networks: a sensor's frame"),
    "parameters": (215, "parameters", "parameters of one network"),
    "input_bytes": (1.52e6, "bytes", "input windows, if materialised"),
    "total_bytes": (2.36e6, "bytes", "total memory: 0.84 KiB were added as MB"),
}
"""The paper's figures by the key of ours: value, unit, and what it means. ``total_bytes`` is the one that is wrong."""


@dataclass(frozen=True)
class Layer:
    """One layer on one window."""

    name: str
    graph: str
    """``dense``, ``folded`` or ``kernel``"""
    macs: int
    parameters: int
    values_in: int
    """numbers read, weights aside, where nothing is fused"""
    values_out: int
    """numbers written, where nothing is fused"""
    comparisons: int = 0
    """of the rectifier, and of the window's minimum"""

    def as_dict(self) -> dict[str, Any]:
        return {
            "graph": self.graph,
            "name": self.name,
            "macs_per_window": self.macs,
            "parameters": self.parameters,
            "bytes_read_per_window": FLOAT_BYTES * self.values_in,
            "bytes_written_per_window": FLOAT_BYTES * self.values_out,
            "comparisons_per_window": self.comparisons,
        }


@dataclass(frozen=True)
class OperationCount:
    """Counts for one network; a frame runs two."""

    widths: tuple[int, int, int]
    columns: int
    dense: tuple[Layer, ...]
    folded: tuple[Layer, ...]
    folded_hidden: int
    memory: dict[str, int] = field(default_factory=dict)
    """bytes of a loaded model and its stream (``upsampler.Model.sizes``); empty where only widths are known"""

    @property
    def windows(self) -> int:
        return PAIRS * self.columns

    @property
    def macs_dense(self) -> int:
        """Per window."""
        return sum(layer.macs for layer in self.dense)

    @property
    def macs_folded(self) -> int:
        """Per window."""
        return sum(layer.macs for layer in self.folded)

    @property
    def parameters(self) -> int:
        return sum(layer.parameters for layer in self.dense)

    @property
    def parameters_folded(self) -> int:
        return sum(layer.parameters for layer in self.folded)

    def kernel(self, precision: str) -> tuple[Layer, ...]:
        """The folded graph as a vector kernel computes it: an even number of units, integer inputs in pairs."""
        units = -(-self.folded_hidden // 2) * 2
        taps = WINDOW + 1 + (precision != "fp32")
        return _two_layers("kernel", taps, units)

    def macs_kernel(self, precision: str) -> int:
        """Per frame: products that are really computed, the lane without meaning included."""
        return NETWORKS * LANES * self.columns * sum(layer.macs for layer in self.kernel(precision))

    def weight_bytes_folded(self, precision: str) -> int:
        """Both networks' weights and biases as numbers of this precision; integer biases have 32 bits, and so has the
        output's. A model file adds a few bytes of scales."""
        biases = self.folded_hidden + 1
        size = _WEIGHT_BYTES[precision]
        bias_size = size if precision == "fp32" else _INTEGER_BIAS_BYTES
        # The weights of the window's minimum have 16 bits in int8 too.
        wide = self.folded_hidden if precision == "int8" else 0
        return NETWORKS * (size * (self.parameters_folded - biases) + wide + bias_size * biases)

    def as_dict(self) -> dict[str, Any]:
        """The keys other programs rely on."""
        d = {
            "windows_per_image": self.windows,
            "macs_per_window_dense": self.macs_dense,
            "macs_per_window_executed": self.macs_folded,
            "operations_per_image_dense": 2 * self.macs_dense * self.windows,
            "macs_per_image_dense": self.macs_dense * self.windows,
            "macs_per_image_executed": self.macs_folded * self.windows,
            "macs_per_frame_dense": NETWORKS * self.macs_dense * self.windows,
            "macs_per_frame_executed": NETWORKS * self.macs_folded * self.windows,
            "macs_per_frame_kernel": {p: self.macs_kernel(p) for p in _WEIGHT_BYTES},
            "parameters": self.parameters,
            "parameters_executed": self.parameters_folded,
            "weight_bytes": FLOAT_BYTES * self.parameters,
            "weight_bytes_executed": FLOAT_BYTES * self.parameters_folded,
            "weight_bytes_both": {p: self.weight_bytes_folded(p) for p in _WEIGHT_BYTES},
            "input_bytes": FLOAT_BYTES * WINDOW * self.windows,
            "traffic_per_frame": self.traffic(),
            "memory": dict(self.memory),
            "paper_total_memory_note": PAPER_MEMORY_NOTE,
            "layers": [x.as_dict() for x in (*self.dense, *self.folded, *self.kernel("fp32"))],
        }
        return {**d, "paper": _beside_the_paper(d)}

    def traffic(self) -> dict[str, dict[str, int]]:
        """Bytes read and written for a frame, both networks. ``dense`` and ``folded``: layer by layer in float32,
        nothing fused, windows materialised, weights read once. ``kernel``: our stream, whose intermediate numbers stay
        in registers: the sensor's columns in, 64 rows out, prepared columns written once and read three times."""
        found = {}
        for graph, layers in (("dense", self.dense), ("folded", self.folded)):
            read = sum(x.values_in for x in layers) * self.windows + sum(x.parameters for x in layers)
            written = (WINDOW + 1 + sum(x.values_out for x in layers)) * self.windows
            found[graph] = {"read": NETWORKS * FLOAT_BYTES * read, "written": NETWORKS * FLOAT_BYTES * written}
        prepared = 4 * 2 * LANES * self.columns
        found["kernel"] = {
            "read": BEAMS * PIXEL_BYTES * self.columns + 3 * prepared,
            "written": ROWS * PIXEL_BYTES * self.columns + prepared,
        }
        return found


def _beside_the_paper(ours: dict[str, Any]) -> list[dict[str, Any]]:
    """Each published figure with ours: for another network than the paper's they differ, which says what it is."""
    total = ours["input_bytes"] + ours["weight_bytes"]
    rows = []
    for key, (value, unit, meaning) in PAPER_FIGURES.items():
        own = total if key == "total_bytes" else ours[key]
        rows.append({"key": key, "paper": value, "ours": own, "unit": unit, "meaning": meaning})
    return rows


def count_model(model: ModelFile, columns: int, memory: dict[str, int] | None = None) -> OperationCount:
    """Of a model's distance network; its intensity network has the same widths in all shipped models. ``memory``: sizes
    of the loaded model, to be handed on.

    A file without its dense networks counts as the smallest dense graph that folds into it."""
    hidden = model.folded[0].hidden
    return count_operations(model.dense[0].widths if model.dense else (1, 1, hidden), columns, hidden, memory)


def count_operations(
    widths: tuple[int, int, int] = PAPER_WIDTHS,
    columns: int = 2048,
    folded_hidden: int | None = None,
    memory: dict[str, int] | None = None,
) -> OperationCount:
    """``widths``: conv1 filters, conv2 filters, hidden units. ``folded_hidden``: where it is not the dense graph's."""
    conv1, conv2, hidden = widths
    if min(*widths, columns) < 1:
        raise ValueError(f"widths {widths} and columns {columns} must all be at least 1")
    taps = WINDOW * conv2 + 1
    dense = (
        Layer("conv1", "dense", WINDOW * conv1, 2 * conv1, WINDOW, WINDOW * conv1),
        Layer("conv2", "dense", WINDOW * conv1 * conv2, conv2 * (conv1 + 1), WINDOW * conv1, WINDOW * conv2),
        Layer("linear_1", "dense", taps * hidden, hidden * (taps + 1), taps, hidden, hidden + MINIMUM_COMPARISONS),
        Layer("linear_2", "dense", hidden, hidden + 1, hidden, 1, 1),
    )
    executed = folded_hidden or hidden
    folded = _two_layers("folded", WINDOW + 1, executed)
    return OperationCount(widths, columns, dense, folded, executed, memory or {})


def _two_layers(graph: str, taps: int, units: int) -> tuple[Layer, Layer]:
    return (
        Layer("affine", graph, taps * units, units * (taps + 1), taps, units, units + MINIMUM_COMPARISONS),
        Layer("output", graph, units, units + 1, units, 1, 1),
    )
