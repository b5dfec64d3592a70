"""``upbeam ops``: multiply-accumulates and bytes, layer by layer."""

from __future__ import annotations

from typing import Annotated

import typer
from rich.table import Table

from upbeam.power.ops import OperationCount, count_model, count_operations
from upbeam.runtime.upsampler import load_model

from .common import JsonOption, UserError, emit_json, show, table

__all__ = ["ops"]


def ops(
    model: Annotated[str | None, typer.Option(help="A .ubm file, or hdl-32e or vlp-32c instead of hdl-64e.")] = None,
    columns: Annotated[
        int | None, typer.Option(min=4, max=65535, help="Columns per turn instead of the model's.")
    ] = None,
    widths: Annotated[
        str | None, typer.Option(help="Another network of the family: filters, filters, hidden units, as 8,2,12.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Count operations and memory of a model's networks, or of any widths."""
    if widths is not None:
        if model is not None:
            raise UserError("--widths is instead of --model")
        _give(count_operations(_numbers(widths), columns or 2048), None, as_json)
        return
    loaded = load_model(model)
    width = columns or loaded.columns
    sizes = {precision: loaded.sizes(precision, columns=width) for precision in loaded.precisions}
    memory = {f"{name}_{precision}": n for precision, found in sizes.items() for name, n in found.items()}
    count = count_model(loaded.file, width, memory)
    _give(count, f"{loaded.crc32:08x}", as_json)


def _numbers(text: str) -> tuple[int, int, int]:
    try:
        conv1, conv2, hidden = (int(x) for x in text.split(","))
    except ValueError:
        raise UserError(f"--widths {text!r}: expected three whole numbers with commas, as 8,2,12") from None
    return conv1, conv2, hidden


def _give(count: OperationCount, crc32: str | None, as_json: bool) -> None:
    if as_json:
        emit_json({**count.as_dict(), "model_crc32": crc32})
    else:
        _print(count)


def _print(count: OperationCount) -> None:
    layers = (*count.dense, *count.folded, *count.kernel("fp32"))
    names = ("graph", "layer", "MACs", "parameters", "values read", "written", "comparisons")
    rows = [
        [x.graph, x.name, *(f"{n}" for n in (x.macs, x.parameters, x.values_in, x.values_out, x.comparisons))]
        for x in layers
    ]
    show(table("One network, one window", names, rows))
    d = count.as_dict()
    kernel = d["macs_per_frame_kernel"]["fp32"]
    traffic = d["traffic_per_frame"]
    show(
        table(
            f"32 x {count.columns} range image: as trained, as executed, and as vector kernels run it",
            ["", "dense", "folded", "kernel"],
            [
                ["MACs per window", f"{count.macs_dense}", f"{count.macs_folded}", ""],
                ["MACs per image", _m(d["macs_per_image_dense"]), _m(d["macs_per_image_executed"]), _m(kernel / 2)],
                [
                    "MACs per frame (distance + intensity)",
                    _m(d["macs_per_frame_dense"]),
                    _m(d["macs_per_frame_executed"]),
                    _m(kernel),
                ],
                [
                    "operations per image (+ and x apart)",
                    _m(d["operations_per_image_dense"]),
                    _m(2 * d["macs_per_image_executed"]),
                    _m(kernel),
                ],
                ["parameters", f"{count.parameters}", f"{count.parameters_folded}", ""],
                ["weight bytes (float32)", f"{d['weight_bytes']}", f"{d['weight_bytes_executed']}", ""],
                *[
                    [f"bytes {way} per frame", *(f"{traffic[g][way] / 1e6:.3f} MB" for g in traffic)]
                    for way in ("read", "written")
                ],
                ["window inputs, if materialised", f"{d['input_bytes'] / 1e6:.3f} MB", "", "never"],
            ],
        )
    )
    if count.memory:
        show(_memory(count.memory))
    rows = [[x["meaning"], _number(x["paper"], x["unit"]), _number(x["ours"], x["unit"])] for x in d["paper"]]
    show(table("The paper's figures", ["", "paper", "this network"], rows))
    show(d["paper_total_memory_note"])


def _memory(sizes: dict[str, int]) -> Table:
    """``sizes``: ``<what>_<precision>``."""
    names = list(dict.fromkeys(key.rsplit("_", 1)[0] for key in sizes))
    precisions = list(dict.fromkeys(key.rsplit("_", 1)[1] for key in sizes))
    rows = [[name, *(f"{sizes[f'{name}_{p}']}" for p in precisions)] for name in names]
    return table("Bytes of the loaded model and of a stream", ["", *precisions], rows)


def _m(x: float) -> str:
    return f"{x / 1e6:.2f} M"


def _number(value: float, unit: str) -> str:
    if unit == "bytes":
        return f"{value / 1e6:.3f} MB"
    return f"{value / 1e6:.3f} M" if value >= 1e5 else f"{value:g}"
