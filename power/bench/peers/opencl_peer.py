"""Our own OpenCL backend, on the device that ``upbeam`` would take."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from ..work import Work
from .formulation import IMAGE, Formulation

__all__ = ["formulations"]

PRECISIONS = ("fp32", "int16", "int8")


def formulations(work: Work, threads: int, quick: bool) -> Iterator[Formulation]:
    """For every precision of the model: the kernel by the device's own clock, and the whole call from host to host."""
    from upbeam.kernels.opencl import OpenClUpsampler

    for precision in [p for p in PRECISIONS if p in work.file.precisions]:
        up = OpenClUpsampler(work.file, precision, columns=work.columns)
        detail = {"precision": precision, "variant": up.variant, "device": str(up.device)}
        yield _formulation(work, up, precision, "kernel", detail)
        yield _formulation(work, up, precision, "whole call", detail)


def _formulation(work: Work, up: Any, precision: str, what: str, detail: dict[str, Any]) -> Formulation:
    kept: list[Any] = []

    def run() -> None:
        kept[:] = up(work.distance, work.intensity)

    return Formulation(
        f"upbeam OpenCL {precision}, {what}", f"{precision} {what}", "image",
        IMAGE if what == "whole call" else f"{IMAGE}, without transfers", run,
        lambda: (kept[0][1:-1:2], kept[1][1:-1:2]),
        own_clock=(lambda: float(up.times.kernel) * 1e6) if what == "kernel" else None, detail=detail | {"part": what},
    )  # fmt: skip
