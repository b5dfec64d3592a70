"""The text of a kernel program: a prelude with the model's numbers, then the ``.cl`` files.

The C library (``runtime/opencl``) writes the same prelude.
"""

from __future__ import annotations

from collections.abc import Iterable
from importlib import resources

import numpy as np
from numpy.typing import ArrayLike, NDArray

from upbeam.model.network import FoldedNetwork, WindowNetwork
from upbeam.model.rules import BEAMS, Rules
from upbeam.quant.integer import HIDDEN_SHIFT, IntegerNetwork
from upbeam.quant.ubm import ModelFile

from .device import OpenClError
from .variants import PAD, Variant

__all__ = ["dense_source", "folded_weights", "integer_weights", "source", "weight_tables"]

FILES = {
    "fp32": ("window_rules.cl", "window_f32.cl", "window_kernel.cl"),
    "int16": ("window_rules.cl", "window_int.cl", "window_kernel.cl"),
    "int8": ("window_rules.cl", "window_int.cl", "window_kernel.cl"),
    "dense": ("window_dense.cl",),
}
Macros = dict[str, str]


def source(file: ModelFile, precision: str, variant: Variant, columns: int) -> str:
    """The program for one precision (``fp32``, ``int16``, ``int8``). Raises OpenClError for one the file has not."""
    tables = weight_tables(file, precision)
    macros = _rule_macros(file.rules, variant.padded_columns(columns))
    if precision == "fp32":
        macros["UPB_NUMBER"] = "float"
        for n, network in enumerate(file.folded):
            macros |= {f"UPB_HIDDEN_{n}": str(network.hidden), f"UPB_SLOPE_{n}": _float(network.slope)}
            macros[f"UPB_SKIP_{n}"] = str(int(network.skip))
    else:
        macros |= {"UPB_NUMBER": "int", "UPB_BITS": precision.removeprefix("int")}
        for n, whole in enumerate(_integer(file, precision)):
            macros |= {f"UPB_HIDDEN_{n}": str(whole.hidden), f"UPB_SLOPE_{n}": str(whole.slope)}
            macros |= {f"UPB_SKIP_{n}": str(whole.skip), f"UPB_K_{n}": str(whole.k)}
            macros |= {f"UPB_J_{n}": str(whole.j), f"UPB_T_{n}": str(whole.t)}
    for n, table in enumerate(tables):
        macros[f"UPB_WEIGHTS_{n}"] = _table(table)
    return _join(macros, precision)


def dense_source(file: ModelFile, columns: int) -> str:
    """The program of the networks as they were trained. Raises OpenClError if the file does not have them."""
    if file.dense is None:
        raise OpenClError("the model file has no section DENS: the dense kernel cannot run it")
    macros = _rule_macros(file.rules, columns)
    macros["UPB_CONV2_MAX"] = str(max(len(network.conv2_weight) for network in file.dense))
    units = (file.rules.distance_unit_m, 1.0)
    for n, (network, unit) in enumerate(zip(file.dense, units, strict=True)):
        macros[f"UPB_WEIGHTS_{n}"] = _table(_dense_weights(network))
        head = [*network.widths, int(network.inputs == "difference"), int(network.output == "residual")]
        numbers = [str(value) for value in head] + [_float(v) for v in (network.scale, network.slope, unit)]
        macros[f"UPB_DENSE_{n}"] = "{" + ", ".join([*numbers, f"weights_{n}"]) + "}"
    return _join(macros, "dense")


def weight_tables(file: ModelFile, precision: str) -> tuple[NDArray[np.generic], NDArray[np.generic]]:
    """What the fast kernels read: float32 or int32, of the distance and of the intensity network."""
    if precision == "fp32":
        unit = round(file.rules.distance_unit_m * 1e6) * 1e-6
        return folded_weights(file.folded[0], unit), folded_weights(file.folded[1], 1.0)
    far, grey = _integer(file, precision)
    return integer_weights(far), integer_weights(grey)


def folded_weights(network: FoldedNetwork, unit: float) -> NDArray[np.float32]:
    """Nine of each unit, then the offset: on differences from the minimum, in counts of ``unit``. Calculated in the
    order of the C runtime's ``fold``, to have its bits."""
    table = []
    for weights, bias, output in zip(network.weight, network.bias, network.output_weight, strict=True):
        total = 0.0
        for weight in weights:
            total += float(weight)
        table += [float(weight) * unit for weight in weights[:-1]] + [total * unit, float(bias), float(output) / unit]
    return np.array([*table, network.output_bias / unit], dtype=np.float32)


def integer_weights(network: IntegerNetwork) -> NDArray[np.int32]:
    """Nine of each unit, then the offset; the roundings of steps 5 and 8 are added to bias and offset, modulo 2^32."""
    bias = network.bias + (1 << (HIDDEN_SHIFT - 1))
    units = np.concatenate([network.weight, np.stack([network.minimum, bias, network.output], axis=1)], axis=1)
    offset = network.offset + (1 << network.t >> 1)
    return np.append(units.ravel(), offset).astype(np.uint32).view(np.int32)


def _integer(file: ModelFile, precision: str) -> tuple[IntegerNetwork, IntegerNetwork]:
    model = file.int16 if precision == "int16" else file.int8 if precision == "int8" else None
    if model is None:
        raise OpenClError(f"precision {precision!r} is not in the model file, it has: {', '.join(file.precisions)}")
    return model.distance, model.intensity


def _dense_weights(n: WindowNetwork) -> NDArray[np.float32]:
    arrays = (n.conv1_weight, n.conv1_bias, n.conv2_weight, n.conv2_bias, n.linear_1_weight, n.linear_1_bias)
    flat = np.concatenate([np.ravel(array) for array in (*arrays, n.linear_2_weight)])
    return np.append(flat, n.linear_2_bias).astype(np.float32)


def _rule_macros(rules: Rules, padded_columns: int) -> Macros:
    return {
        "UPB_PAD": str(PAD),
        "UPB_STRIDE_IN": str(padded_columns + 2 * PAD),
        "UPB_STRIDE_OUT": str(padded_columns),
        "UPB_MIN_COUNT": str(rules.min_count),
        "UPB_FILL": str(int(rules.empty == "fill")),
        "UPB_REPEAT_LAST_ROW": str(int(rules.last_row == "repeat")),
        "UPB_SEEN_MAX": _table(rules.row_max_count[0::2].astype(np.int32)),
        "UPB_GIVEN_MAX": _table(rules.row_max_count[1::2][:BEAMS].astype(np.int32)),
    }


def _join(macros: Macros, precision: str) -> str:
    folder = resources.files("upbeam.kernels").joinpath("opencl")
    texts = [folder.joinpath(name).read_text(encoding="utf-8") for name in FILES[precision]]
    return "\n".join([*(f"#define {name} {value}" for name, value in macros.items()), *texts])


def _table(values: ArrayLike) -> str:
    array = np.asarray(values)
    texts: Iterable[str] = (
        (_float(float(v)) for v in array) if array.dtype.kind == "f" else (_int(int(v)) for v in array)
    )
    return "{" + ", ".join(texts) + "}"


def _float(value: float) -> str:
    """Exact, of a float32."""
    return f"{float(np.float32(value)).hex()}f"


def _int(value: int) -> str:
    return str(value) if value > -(2**31) else "(-2147483647 - 1)"
