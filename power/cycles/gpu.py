"""Latency of the exported ONNX graph under TensorRT on a GPU: launches, arithmetic, bytes. Modelled, and wide.

    t = launches x launch overhead + max(multiply-adds / (share of peak x peak), bytes / bandwidth)

The share of peak is what public submissions reached with large networks (``power/measurements/rows.toml``). A window
network is small: launches decide, and how many kernels TensorRT makes of a graph is not known without running it.
"""

from __future__ import annotations

from dataclasses import dataclass

from upbeam.power.figures import Figure
from upbeam.power.ops import OperationCount

__all__ = ["GpuWork", "gpu_latency", "window_work"]

FLOAT_BYTES = 4


@dataclass(frozen=True)
class GpuWork:
    """What a graph asks of a GPU; each with its low and high."""

    macs: tuple[float, float, float]
    bytes: tuple[float, float, float]
    launches: tuple[float, float, float]


def window_work(count: OperationCount) -> GpuWork:
    """Both folded networks on the whole image. Low: everything fused, inputs and outputs alone are moved. Central: each
    network is windows, two matrix products and an output step. High: element-wise steps are kernels of their own."""
    windows, hidden = count.windows, count.folded_hidden
    edges = 2 * FLOAT_BYTES * (32 * count.columns + windows)
    inner = 2 * FLOAT_BYTES * windows * (2 * 7 + 2 * hidden)
    macs = 2.0 * count.macs_folded * windows
    return GpuWork((macs, macs, macs), (edges + inner, edges, edges + 3 * inner), (8, 2, 24))


def gpu_latency(work: GpuWork, peak: Figure, share: Figure, bandwidth: Figure, launch: Figure) -> Figure:
    """``peak`` in MAC/s, ``share`` of it that is reached, ``bandwidth``, ``launch`` overhead of one kernel."""
    value = _time(0, work, peak.span("MAC/s")[0], share.span("1")[0], bandwidth.span("B/s")[0], launch.span("s")[0])
    low = _time(1, work, peak.span("MAC/s")[2], share.span("1")[2], bandwidth.span("B/s")[2], launch.span("s")[1])
    high = _time(2, work, peak.span("MAC/s")[1], share.span("1")[1], bandwidth.span("B/s")[1], launch.span("s")[2])
    source = "launches, multiply-adds and bytes of the exported graph under TensorRT; nothing was run"
    return Figure(value, low, high, "s", "modelled", source).to("ms")


def _time(k: int, work: GpuWork, peak: float, share: float, bandwidth: float, launch: float) -> float:
    return work.launches[k] * launch + max(work.macs[k] / (peak * share), work.bytes[k] / bandwidth)
