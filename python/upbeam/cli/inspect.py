"""``upbeam inspect``: what is in a model file."""

from __future__ import annotations

from typing import Annotated

import typer

from upbeam.runtime.upsampler import load_model

from .common import JsonOption, emit_json, show, table

__all__ = ["inspect"]


def inspect(
    model: Annotated[
        str | None, typer.Argument(help="A .ubm file or a shipped model's name; hdl-64e if omitted.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Show sensor, rules, networks, provenance and metrics of a model."""
    loaded = load_model(model)
    rules, file = loaded.rules, loaded.file
    networks = {
        name: {
            "hidden": folded.hidden,
            "multiply_adds_per_window": folded.multiply_adds,
            "parameters_executed": folded.parameters,
            "parameters_dense": file.dense[k].parameters if file.dense else None,
            "slope": folded.slope,
        }
        for k, (name, folded) in enumerate(zip(("distance", "intensity"), file.folded, strict=True))
    }
    data = {
        "file": model or "(shipped)",
        "bytes": len(loaded.data),
        "crc32": f"{loaded.crc32:08x}",
        "sensor": rules.sensor,
        "columns": rules.columns,
        "distance_unit_m": rules.distance_unit_m,
        "limits_m": [rules.min_m, rules.max_m],
        "cut_deg": rules.cut_deg,
        "edge": rules.edge,
        "last_row": rules.last_row,
        "empty": rules.empty,
        "networks": networks,
        "provenance": file.provenance,
        "metrics": file.metrics,
    }
    if as_json:
        emit_json(data)
        return
    skip = ("networks", "provenance", "metrics")
    show(table("Model", ["", "value"], [[k, str(v)] for k, v in data.items() if k not in skip]))
    columns = ["", *networks]
    keys = list(networks["distance"])
    show(
        table(
            "Networks",
            columns,
            [[k, *(f"{networks[n][k]:g}" if networks[n][k] is not None else "-" for n in networks)] for k in keys],
        )
    )
    for name in ("provenance", "metrics"):
        if data[name]:
            show(table(name.capitalize(), ["", "value"], [[k, str(v)] for k, v in data[name].items()]))  # type: ignore[attr-defined]
