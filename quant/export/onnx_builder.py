"""Writes ONNX graphs node by node, and loads the optional packages that this needs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .source import MissingPackageError

if TYPE_CHECKING:
    from onnx import ModelProto

__all__ = ["IR_VERSION", "OPSET", "GraphBuilder", "require", "session"]

OPSET = 13
"""The newest that TensorRT 8.4's importer reads; the first whose QuantizeLinear knows scales per channel."""
IR_VERSION = 7


def require(module: str) -> Any:
    """``onnx`` or ``onnxruntime`` or a module of theirs. Raises MissingPackageError naming the extra."""
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        raise MissingPackageError(f"ONNX needs the package {error.name}: pip install 'upbeam[export]'") from None


def session(model: ModelProto | bytes, threads: int = 1) -> Any:
    """An ``onnxruntime.InferenceSession`` on the CPU."""
    ort = require("onnxruntime")
    options = ort.SessionOptions()
    options.intra_op_num_threads = threads
    options.log_severity_level = 3  # errors; warnings speak of other devices
    data = model if isinstance(model, bytes) else model.SerializeToString()
    return ort.InferenceSession(data, options, providers=["CPUExecutionProvider"])


class GraphBuilder:
    """One graph. Values are named by strings; ``op`` appends a node and returns its output's name."""

    def __init__(self, name: str) -> None:
        self._onnx = require("onnx")
        self._name = name
        self._nodes: list[Any] = []
        self._inputs: list[Any] = []
        self._outputs: dict[str, tuple[str, Sequence[int | str]]] = {}
        self._constants: dict[tuple[str, tuple[int, ...], bytes], str] = {}

    def input(self, name: str, shape: Sequence[int | str]) -> str:
        """A float32 input; letters stand for sizes that may vary."""
        self._inputs.append(self._value(name, shape))
        return name

    def output(self, name: str, value: str, shape: Sequence[int | str]) -> None:
        """Makes the output of a node one of the graph, under a name of its own."""
        self._outputs[value] = (name, shape)

    def constant(self, values: ArrayLike, dtype: Any = np.float32) -> str:
        """Equal constants are stored once."""
        array: NDArray[Any] = np.asarray(values, dtype=dtype)
        key = (array.dtype.str, array.shape, array.tobytes())
        return self._constants.setdefault(key, f"constant_{len(self._constants)}")

    def integers(self, *values: int) -> str:
        """A vector of int64: axes, places, pads."""
        return self.constant(values, np.int64)

    def op(self, kind: str, *inputs: str, **attributes: Any) -> str:
        """A node with one output."""
        output = f"{kind}_{len(self._nodes)}"
        self._nodes.append(self._onnx.helper.make_node(kind, inputs, [output], name=output, **attributes))
        return output

    def slice(self, value: str, start: int, end: int, axis: int) -> str:
        places = [self.integers(n) for n in (start, end, axis)]
        return self.op("Slice", value, *places)

    def model(self, metadata: Mapping[str, str]) -> ModelProto:
        """The checked model. Its bytes depend on nothing but what it computes and ``metadata``."""
        onnx = self._onnx
        self._rename()
        graph = onnx.helper.make_graph(
            self._nodes,
            self._name,
            self._inputs,
            [self._value(name, shape) for name, shape in self._outputs.values()],
            [
                onnx.numpy_helper.from_array(np.frombuffer(data, dtype).reshape(shape), name)
                for (dtype, shape, data), name in self._constants.items()
            ],
        )
        opset = [onnx.helper.make_opsetid("", OPSET)]
        model = onnx.helper.make_model(graph, opset_imports=opset, ir_version=IR_VERSION, producer_name="upbeam")
        onnx.helper.set_model_props(model, dict(metadata))
        onnx.checker.check_model(model, full_check=True)
        return model  # type: ignore[no-any-return]

    def _value(self, name: str, shape: Sequence[int | str]) -> Any:
        return self._onnx.helper.make_tensor_value_info(name, self._onnx.TensorProto.FLOAT, shape)

    def _rename(self) -> None:
        for node in self._nodes:
            for values in (node.input, node.output):
                for k, value in enumerate(values):
                    if value in self._outputs:
                        values[k] = self._outputs[value][0]
