"""OpenVINO on the CPU: latency hint, float32 throughout, its own threads."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from importlib import import_module
from typing import Any

import numpy as np

from ..work import Work
from .formulation import Formulation
from .graphs import Case, cases, formulation

__all__ = ["formulations"]


def formulations(work: Work, threads: int, quick: bool) -> Iterator[Formulation]:
    for case in cases(work, quick):
        yield formulation("OpenVINO", work, case, lambda c: _prepare(c, threads))


def _prepare(case: Case, threads: int) -> tuple[Callable[[], Any], Callable[[], list[dict[str, Any]]]]:
    ov = import_module("openvino")

    core = ov.Core()
    settings = {
        "PERFORMANCE_HINT": "LATENCY",
        "INFERENCE_PRECISION_HINT": "f32",
        "INFERENCE_NUM_THREADS": threads,
        "ENABLE_CPU_PINNING": False,
    }
    # Static shapes: what a deployment would use, and what its planner does best with. One model for each shape.
    compiled: dict[tuple[Any, ...], Any] = {}
    requests = []
    for call in case.calls:
        shape = tuple(sorted((name, x.shape) for name, x in call.items()))
        if shape not in compiled:
            model = core.read_model(case.model)
            model.reshape({name: list(x.shape) for name, x in call.items()})
            compiled[shape] = core.compile_model(model, "CPU", settings)
        request = compiled[shape].create_infer_request()
        tensors = {name: ov.Tensor(x, shared_memory=True) for name, x in call.items()}
        for name, tensor in tensors.items():
            request.set_tensor(name, tensor)
        requests.append((request, tensors))

    def run() -> None:
        for request, _ in requests:
            request.infer()

    def results() -> list[dict[str, Any]]:
        return [{n: np.array(r.get_tensor(n).data) for n in case.outputs} for r, _ in requests]

    return run, results
