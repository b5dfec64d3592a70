"""ONNX Runtime on the CPU: its own threads, inputs and outputs bound once."""

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
        yield formulation("ONNX Runtime", work, case, lambda c: _prepare(c, threads))


def _prepare(case: Case, threads: int) -> tuple[Callable[[], Any], Callable[[], list[dict[str, Any]]]]:
    ort = import_module("onnxruntime")

    options = ort.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.execution_mode = ort.ExecutionMode.ORT_SEQUENTIAL
    options.graph_optimization_level = ort.GraphOptimizationLevel.ORT_ENABLE_ALL
    options.log_severity_level = 3
    session = ort.InferenceSession(case.model, options, providers=["CPUExecutionProvider"])
    bound = []
    for call in case.calls:
        shapes = _output_shapes(session, call)
        binding = session.io_binding()
        kept = {name: ort.OrtValue.ortvalue_from_numpy(np.empty(shape, np.float32)) for name, shape in shapes.items()}
        values = {name: ort.OrtValue.ortvalue_from_numpy(x) for name, x in call.items()}
        for name, value in values.items():
            binding.bind_ortvalue_input(name, value)
        for name, value in kept.items():
            binding.bind_ortvalue_output(name, value)
        bound.append((binding, kept, values))

    def run() -> None:
        for binding, _, _ in bound:
            session.run_with_iobinding(binding)

    return run, lambda: [{name: value.numpy() for name, value in kept.items()} for _, kept, _ in bound]


def _output_shapes(session: Any, call: dict[str, Any]) -> dict[str, tuple[int, ...]]:
    """Outputs are allocated once: their shapes come from a first run."""
    names = [x.name for x in session.get_outputs()]
    return {name: x.shape for name, x in zip(names, session.run(names, call), strict=True)}
