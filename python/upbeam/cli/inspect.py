"""``upbeam inspect``: what is in a model file."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import numpy as np
import typer

from upbeam.quant.integer import IntegerModel, IntegerNetwork, largest_inputs, prove
from upbeam.quant.sizes import section_bytes
from upbeam.runtime.upsampler import Model, load_model

from .common import JsonOption, emit_json, message, show, table

__all__ = ["inspect"]

NETWORKS: tuple[Literal["distance"], Literal["intensity"]] = ("distance", "intensity")
SIZE_NOTE = (
    "bytes, from the C runtime. weights: both networks as the file holds them; tables: the same as kernels read them; "
    "state: a stream's memory, the destagger ring in it."
)


def inspect(
    model: Annotated[
        str | None, typer.Argument(help="A .ubm file or a shipped model's name; hdl-64e if omitted.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Show sensor, rules, networks of each precision with their proof, sizes, provenance and metrics of a model."""
    loaded = load_model(model)
    data = {
        "file": model or "(shipped)",
        **_head(loaded),
        "networks": _float_networks(loaded),
        "integer": _integer_networks(loaded),
        "sizes": {precision: loaded.sizes(precision) for precision in loaded.precisions},
        "sections": section_bytes(loaded.data),
        "provenance": loaded.file.provenance,
        "metrics": loaded.file.metrics,
    }
    if as_json:
        emit_json(data)
        return
    plain = {key: value for key, value in data.items() if not isinstance(value, dict)}
    show(table("Model", ["", "value"], [[key, _text(value)] for key, value in plain.items()]))
    show(_side_by_side("Networks", data["networks"]))
    for precision, networks in data["integer"].items():
        show(_side_by_side(f"Integer networks, {networks['distance']['contract']}", networks))
        message(_proof(precision, networks))
    show(_side_by_side("Sizes", data["sizes"]))
    message(SIZE_NOTE)
    for name in ("provenance", "metrics"):
        if data[name]:
            show(table(name.capitalize(), ["", "value"], [[key, _text(value)] for key, value in _flat(data[name])]))


def _head(loaded: Model) -> dict[str, Any]:
    rules = loaded.rules
    return {
        "bytes": len(loaded.data),
        "crc32": f"{loaded.crc32:08x}",
        "precisions": list(loaded.precisions),
        "sensor": rules.sensor,
        "columns": rules.columns,
        "distance_unit_m": rules.distance_unit_m,
        "limits_m": [rules.min_m, rules.max_m],
        "cut_deg": rules.cut_deg,
        "edge": rules.edge,
        "last_row": rules.last_row,
        "empty": rules.empty,
    }


def _float_networks(loaded: Model) -> dict[str, dict[str, Any]]:
    file = loaded.file
    return {
        name: {
            "hidden": folded.hidden,
            "multiply_adds_per_window": folded.multiply_adds,
            "parameters_executed": folded.parameters,
            "parameters_dense": file.dense[k].parameters if file.dense else None,
            "slope": folded.slope,
        }
        for k, (name, folded) in enumerate(zip(NETWORKS, file.folded, strict=True))
    }


def _integer_networks(loaded: Model) -> dict[str, dict[str, dict[str, Any]]]:
    found = {name: loaded.file.integer(name) for name in loaded.file.precisions if name != "fp32"}
    return {
        name: {which: _integer_network(loaded, model, which) for which in NETWORKS}
        for name, model in found.items()
        if model is not None
    }


def _integer_network(loaded: Model, model: IntegerModel, which: Literal["distance", "intensity"]) -> dict[str, Any]:
    network: IntegerNetwork = getattr(model, which)
    largest_input, largest_difference = largest_inputs(loaded.rules, which)
    bounds = prove(network, model.precision, largest_input, largest_difference, f"{model.precision} {which} network")
    sums = max(-int(bounds.S_low.min()), int(bounds.S_high.max()))
    output = max(-bounds.Y_low, bounds.Y_high)
    return {
        "contract": model.contract,
        "hidden": network.hidden,
        "multiply_adds_per_window": network.multiply_adds,
        "k, j, t": [network.k, network.j, network.t],
        "slope": f"{network.slope} / 32768",
        "skip": network.skip,
        "W": _range(network.weight),
        "M": _range(network.minimum),
        "B": _range(network.bias),
        "V": _range(network.output),
        "C": network.offset,
        "largest_input": largest_input,
        "largest_difference": largest_difference,
        "sum_bounds": [int(bounds.S_low.min()), int(bounds.S_high.max())],
        "sum_bits": sums.bit_length() + 1,
        "sum_share_of_32_bits": round(sums / 2**31, 4),
        "output_bounds": [bounds.Y_low, bounds.Y_high],
        "output_bits": output.bit_length() + 1,
    }


def _range(values: np.ndarray[Any, Any]) -> list[int]:
    return [int(values.min()), int(values.max())]


def _proof(precision: str, networks: dict[str, dict[str, Any]]) -> str:
    shares = ", ".join(f"{name} {100 * n['sum_share_of_32_bits']:.0f} %" for name, n in networks.items())
    return f"{precision}: no sum can overflow, whatever comes in. Of 32 bits the largest sums use: {shares}."


# ----------------------------------------------------------------------------------------------------------- text


def _side_by_side(title: str, columns: dict[str, dict[str, Any]]) -> Any:
    keys = list(next(iter(columns.values())))
    return table(title, ["", *columns], [[key, *(_text(column[key]) for column in columns.values())] for key in keys])


def _text(value: Any) -> str:
    if value is None:
        return "-"
    if isinstance(value, list):
        return ", ".join(_text(item) for item in value)
    return f"{value:g}" if isinstance(value, float) else str(value)


def _flat(data: dict[str, Any], prefix: str = "") -> list[tuple[str, Any]]:
    """Nested objects as rows: ``quantisation.int8.mean_mm``."""
    rows: list[tuple[str, Any]] = []
    for key, value in data.items():
        rows += _flat(value, f"{prefix}{key}.") if isinstance(value, dict) else [(f"{prefix}{key}", value)]
    return rows
