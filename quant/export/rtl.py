"""Memories and parameters for RTL: what a core needs of a model, generated, nothing typed by hand.

Per precision a folder: ``.mem`` files for ``$readmemh`` (two's complement, exact width, one value a line), a
SystemVerilog header of local parameters, one of the configuration (LANES, FOLD, the weights in the order of its
schedule), and beside the folders one manifest.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from upbeam.model.rules import Rules
from upbeam.quant.integer import (
    CODE_BITS,
    CONTRACTS,
    HIDDEN_SHIFT,
    IntegerModel,
    IntegerNetwork,
    Precision,
    largest_code,
    largest_inputs,
)
from upbeam.quant.sizes import weight_bytes

from .rtl_beams import BEAMS, beams_header
from .rtl_schedule import Configuration, Words, configuration, weight_bits, words
from .rtl_weights import WEIGHTS, weights_image
from .source import NETWORKS, ExportError, NetworkName, Source, new_folder

__all__ = [
    "CONFIGURATION",
    "FORMAT",
    "MANIFEST",
    "PARAMETERS",
    "Memory",
    "configuration",
    "configuration_header",
    "core_headers",
    "memories",
    "parameters",
    "write_rtl",
]

FORMAT = "upbeam.rtl.v1"
MANIFEST = "manifest.json"
PARAMETERS = "upb_params.svh"
CONFIGURATION = "upb_config.svh"
SUM_BITS, HIDDEN_BITS, COUNT_BITS, INTENSITY_BITS = 32, 16, 16, 8

I64 = NDArray[np.int64]


@dataclass(frozen=True)
class Memory:
    """One ``.mem`` file."""

    file: str
    what: str
    bits: int
    values: I64
    """flat; address 0 first"""

    def text(self, head: str) -> str:
        digits = self.bits // 4
        lines = [f"{int(value) & ((1 << self.bits) - 1):0{digits}x}" for value in self.values]
        return "\n".join([f"// {head}", f"// {self.what}; {len(lines)} x {self.bits} bits", *lines, ""])


def write_rtl(
    source: Source,
    folder: Path,
    precisions: Sequence[Precision] | None = None,
    *,
    fold: int | None = None,
    lanes: int = 1,
) -> dict[str, Any]:
    """Writes ``FOLDER/manifest.json`` and ``FOLDER/PRECISION/...``; returns the manifest.

    ``fold``: clocks a window and lane; one hidden unit a clock if omitted. ``folder`` must be empty or new. Raises
    ExportError for that, for a precision the model does not have, and for a model without any; ConfigurationError for
    ``fold`` and ``lanes`` that the core does not have."""
    wanted = list(source.precisions if precisions is None else precisions)
    if not wanted:
        raise ExportError(f"{source.name}: no integer networks in this model; upbeam quantize adds them")
    made = {precision: _files(source, source.integer(precision), fold, lanes) for precision in wanted}
    new_folder(folder)
    for precision, files in made.items():
        (folder / precision).mkdir()
        for name, data in files.items():
            (folder / precision / name).write_bytes(data)
    manifest = _manifest(source, made)
    (folder / MANIFEST).write_text(json.dumps(manifest, indent=2) + "\n", encoding="utf-8")
    return manifest


def _files(source: Source, model: IntegerModel, fold: int | None, lanes: int) -> dict[str, bytes]:
    head = f"{source.name} {source.crc32:08x}, {model.contract}"
    texts = core_headers(source, model.precision, fold=fold, lanes=lanes)
    texts |= {memory.file: memory.text(head) for memory in memories(model)}
    files = {name: text.encode("ascii") for name, text in texts.items()}
    if configuration(model, fold=fold, lanes=lanes).fold > 1:  # else weights are constants
        files[WEIGHTS] = weights_image(source, model.precision, fold=fold, lanes=lanes).data()
    return files


def core_headers(source: Source, precision: Precision, *, fold: int | None = None, lanes: int = 1) -> dict[str, str]:
    """The two headers that ``kernels/rtl/upb_pkg.sv`` includes and the one of ``upb_top.sv``, by file name."""
    chosen = configuration(source.integer(precision), fold=fold, lanes=lanes)
    return {
        PARAMETERS: parameters(source, precision),
        CONFIGURATION: configuration_header(source, precision, chosen),
        BEAMS: beams_header(source),
    }


def _manifest(source: Source, made: dict[Precision, dict[str, bytes]]) -> dict[str, Any]:
    sizes = weight_bytes(source.data)
    return {
        "format": FORMAT,
        "model": source.name,
        "model_bytes": len(source.data),
        "model_crc32": f"{source.crc32:08x}",
        "provenance": source.file.provenance,
        "precisions": {
            precision: {
                "contract": CONTRACTS[precision],
                "weight_bytes": sizes[precision],
                "files": {f"{precision}/{name}": len(data) for name, data in files.items()},
            }
            for precision, files in made.items()
        },
    }


# ----------------------------------------------------------------------------------------------------- memories


def memories(model: IntegerModel) -> list[Memory]:
    """W, M, B and V of both networks. W: address ``6 h + i``; the others: address ``h``."""
    narrow = weight_bits(model.precision)
    return [
        Memory(f"{which}_{letter}.mem", f"{letter} of the {which} network: {what}", bits, values.reshape(-1))
        for which, n in zip(NETWORKS, model, strict=True)
        for letter, what, bits, values in (
            ("W", "weights of the differences, address 6 h + i", narrow, n.weight),
            ("M", "weights of the minimum, address h", 16, n.minimum),
            ("B", "biases, address h", SUM_BITS, n.bias),
            ("V", "output weights, address h", narrow, n.output),
        )
    ]


# --------------------------------------------------------------------------------------------------- parameters


def parameters(source: Source, precision: Precision) -> str:
    """``upb_params.svh``: one ``localparam`` a line, to be included in a module or package. Raises ExportError."""
    model, rules = source.integer(precision), source.file.rules
    lines = [*_shared(source, model, rules)]
    for which, network in zip(NETWORKS, model, strict=True):
        lines += _of_network(network, which, precision, rules)
    about = [f"// {key}: {text}" for key, text in source.describe()]
    title = f"// Parameters of the {model.contract} networks. Generated from the model file; do not edit."
    letters = "// Letters and steps: docs/numeric-contract.md. Row limits are packed: row n at [16 * n +: 16]."
    return "\n".join([title, *about, letters, *lines, ""])


def _shared(source: Source, model: IntegerModel, rules: Rules) -> Iterator[str]:
    narrow = weight_bits(model.precision)
    yield f'localparam UPB_CONTRACT = "{model.contract}";'
    yield f"localparam [31:0] UPB_MODEL_CRC32 = 32'h{source.crc32:08x};"
    for name, value in (
        ("BLOCK_CODE", int(model.precision == "int8")),
        ("CODE_BITS", CODE_BITS if model.precision == "int8" else COUNT_BITS),
        ("WEIGHT_BITS", narrow),
        ("MINIMUM_BITS", 16),
        ("BIAS_BITS", SUM_BITS),
        ("OUTPUT_BITS", narrow),
        ("SUM_BITS", SUM_BITS),
        ("HIDDEN_BITS", HIDDEN_BITS),
        ("HIDDEN_SHIFT", HIDDEN_SHIFT),
        ("COUNT_BITS", COUNT_BITS),
        ("INTENSITY_BITS", INTENSITY_BITS),
        ("COLUMNS", rules.columns),
        ("MIN_COUNT", rules.min_count),
        ("MAX_COUNT", rules.max_count),
        ("EDGE_SEAM", int(rules.edge == "seam")),
        ("LAST_ROW_EMPTY", int(rules.last_row == "empty")),
        ("EMPTY_FILL", int(rules.empty == "fill")),
    ):
        yield _integer(name, value)
    yield _packed("SEEN_MAX", rules.row_max_count[0::2])  # of each beam
    yield _packed("GIVEN_MAX", rules.row_max_count[1:-1:2])  # of each window


def _of_network(n: IntegerNetwork, which: NetworkName, precision: Precision, rules: Rules) -> Iterator[str]:
    largest, difference = largest_inputs(rules, which)
    for name, value in (
        ("H", n.hidden),
        ("K", n.k),
        ("J", n.j),
        ("T", n.t),
        ("SLOPE", n.slope),
        ("SKIP", n.skip),
        ("C", n.offset),
        ("LARGEST_INPUT", largest),
        ("LARGEST_S", largest_code(precision, difference)[1]),
    ):
        yield _integer(f"{which.upper()}_{name}", value)


def _integer(name: str, value: int) -> str:
    """As 32-bit hexadecimal where a decimal would not fit its literal: -2^31."""
    text = str(value) if value > -(2**31) else "32'sh80000000"
    return f"localparam signed [31:0] UPB_{name} = {text};"


def _packed(name: str, values: I64) -> str:
    bits = COUNT_BITS * len(values)
    digits = "".join(f"{int(value):04x}" for value in values[::-1])
    return f"localparam [{bits - 1}:0] UPB_{name} = {bits}'h{digits};"


# ------------------------------------------------------------------------------------------------ configuration


def configuration_header(source: Source, precision: Precision, c: Configuration) -> str:
    """``upb_config.svh``. Raises ExportError."""
    model = source.integer(precision)
    made = [words(n, precision, c, bits) for n, bits in zip(model, (COUNT_BITS, INTENSITY_BITS), strict=True)]
    lines = [
        f"// LANES {c.lanes}, FOLD {c.fold}, {model.contract}. Generated from the model file; do not edit.",
        *(f"// {key}: {text}" for key, text in source.describe()[:1]),
        f"// {c.multipliers} products a clock, network and lane; a window every {c.interval} clocks.",
        "// Weights in the order of the schedule: quant/export/rtl_schedule.py. Word 0 lowest.",
        f"localparam [31:0] UPB_CONFIG_CRC32 = 32'h{source.crc32:08x};",
        *(_integer(name, value) for name, value in (("LANES", c.lanes), ("FOLD", c.fold), ("HIDDEN", c.hidden))),
        *(_integer(f"STEP_{letter}_BITS", _width(made[0], letter)) for letter in "WMBV"),
    ]
    for which, network_words in zip(NETWORKS, made, strict=True):
        lines += _step_words(which.upper(), network_words)
    return "\n".join([*lines, ""])


def _step_words(which: str, made: Words) -> Iterator[str]:
    for letter, bits in zip("WMBV", made.bits, strict=True):
        digits = "".join(f"{int(v) & ((1 << bits) - 1):0{bits // 4}x}" for v in getattr(made, letter)[::-1])
        width = _width(made, letter)
        yield f"localparam [{width - 1}:0] UPB_{which}_STEP_{letter} = {width}'h{digits or 0};"
    yield f"localparam [31:0] UPB_{which}_STEP_C = 32'h{made.C & 0xFFFFFFFF:08x};"


def _width(made: Words, letter: str) -> int:
    """In bits, at least 1: a memory that is not there is one bit, 0."""
    return max(1, made.bits["WMBV".index(letter)] * len(getattr(made, letter)))
