"""Operations and memory of a window network, per layer, per image and per frame.

Counted from the layer widths, for the dense graph (as trained) and the folded one (as executed). A
multiply-accumulate (MAC) is one
multiplication and one addition; a layer's bias is the addition that its first product needs, so both counts are equal.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from upbeam.model.network import PAPER_WIDTHS, WINDOW
from upbeam.model.rules import PAIRS
from upbeam.quant.ubm import ModelFile

__all__ = ["PAPER_MEMORY_NOTE", "Layer", "OperationCount", "count_model", "count_operations"]

FLOAT_BYTES = 4
NETWORKS = 2
"""Distance and intensity."""

PAPER_MEMORY_NOTE = (
    "The paper states 2.36 MB: 1.52 MB of window inputs plus 0.84, but 0.84 is the 860 bytes of weights in KiB, "
    "added as if they were MB. The real sum is 1.525 MB, and a streaming implementation never materialises the windows."
)


@dataclass(frozen=True)
class Layer:
    """One layer on one window."""

    name: str
    graph: str
    """``dense`` or ``folded``"""
    macs: int
    parameters: int


@dataclass(frozen=True)
class OperationCount:
    """Counts for one network; a frame runs two."""

    widths: tuple[int, int, int]
    columns: int
    dense: tuple[Layer, ...]
    folded: tuple[Layer, ...]

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

    def as_dict(self) -> dict[str, Any]:
        """The keys other programs rely on."""
        return {
            "windows_per_image": self.windows,
            "macs_per_window_dense": self.macs_dense,
            "macs_per_window_executed": self.macs_folded,
            "operations_per_image_dense": 2 * self.macs_dense * self.windows,
            "macs_per_image_dense": self.macs_dense * self.windows,
            "macs_per_frame_dense": NETWORKS * self.macs_dense * self.windows,
            "macs_per_frame_executed": NETWORKS * self.macs_folded * self.windows,
            "parameters": self.parameters,
            "parameters_executed": self.parameters_folded,
            "weight_bytes": FLOAT_BYTES * self.parameters,
            "weight_bytes_executed": FLOAT_BYTES * self.parameters_folded,
            "input_bytes": FLOAT_BYTES * WINDOW * self.windows,
            "paper_total_memory_note": PAPER_MEMORY_NOTE,
            "layers": [
                {"graph": x.graph, "name": x.name, "macs_per_window": x.macs, "parameters": x.parameters}
                for x in (*self.dense, *self.folded)
            ],
        }


def count_model(model: ModelFile, columns: int) -> OperationCount:
    """Of a model's distance network; its intensity network has the same widths in all shipped models.

    A file without its dense networks counts as the smallest dense graph that folds into it."""
    hidden = model.folded[0].hidden
    return count_operations(model.dense[0].widths if model.dense else (1, 1, hidden), columns, hidden)


def count_operations(
    widths: tuple[int, int, int] = PAPER_WIDTHS, columns: int = 2048, folded_hidden: int | None = None
) -> OperationCount:
    """``widths``: conv1 filters, conv2 filters, hidden units. ``folded_hidden``: where it is not the dense graph's."""
    conv1, conv2, hidden = widths
    if min(*widths, columns) < 1:
        raise ValueError(f"widths {widths} and columns {columns} must all be at least 1")
    taps = WINDOW * conv2 + 1
    dense = (
        Layer("conv1", "dense", WINDOW * conv1, 2 * conv1),
        Layer("conv2", "dense", WINDOW * conv1 * conv2, conv2 * (conv1 + 1)),
        Layer("linear_1", "dense", taps * hidden, hidden * (taps + 1)),
        Layer("linear_2", "dense", hidden, hidden + 1),
    )
    executed = folded_hidden or hidden
    folded = (
        Layer("affine", "folded", (WINDOW + 1) * executed, executed * (WINDOW + 2)),
        Layer("output", "folded", executed, executed + 1),
    )
    return OperationCount(widths, columns, dense, folded)
