"""``upbeam ops``: multiply-accumulates and bytes, layer by layer."""

from __future__ import annotations

from typing import Annotated

import typer

from upbeam.power.ops import OperationCount, count_model
from upbeam.runtime.upsampler import load_model

from .common import JsonOption, emit_json, show, table

__all__ = ["ops"]


def ops(
    model: Annotated[str | None, typer.Option(help="A .ubm file, or hdl-32e or vlp-32c instead of hdl-64e.")] = None,
    columns: Annotated[
        int | None, typer.Option(min=4, max=65535, help="Columns per turn instead of the model's.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Count operations and memory of a model's networks."""
    loaded = load_model(model)
    count = count_model(loaded.file, columns or loaded.columns)
    if as_json:
        emit_json({**count.as_dict(), "model_crc32": f"{loaded.crc32:08x}"})
        return
    _print(count)


def _print(count: OperationCount) -> None:
    rows = [
        [layer.graph, layer.name, f"{layer.macs}", f"{layer.parameters}"] for layer in (*count.dense, *count.folded)
    ]
    show(table("One network, one window", ["graph", "layer", "MACs", "parameters"], rows))
    d = count.as_dict()
    show(
        table(
            f"32 x {count.columns} range image",
            ["", "dense (as trained)", "folded (executed)"],
            [
                ["MACs per window", f"{count.macs_dense}", f"{count.macs_folded}"],
                ["MACs per image", _m(d["macs_per_image_dense"]), _m(count.macs_folded * count.windows)],
                [
                    "MACs per frame (distance + intensity)",
                    _m(d["macs_per_frame_dense"]),
                    _m(d["macs_per_frame_executed"]),
                ],
                [
                    "operations per image (+ and x apart)",
                    _m(d["operations_per_image_dense"]),
                    _m(2 * count.macs_folded * count.windows),
                ],
                ["parameters", f"{count.parameters}", f"{count.parameters_folded}"],
                ["weight bytes (float32)", f"{d['weight_bytes']}", f"{d['weight_bytes_executed']}"],
                ["window inputs, if materialised", f"{d['input_bytes'] / 1e6:.3f} MB", "never materialised"],
            ],
        )
    )
    show(d["paper_total_memory_note"])


def _m(x: int) -> str:
    return f"{x / 1e6:.2f} M"
