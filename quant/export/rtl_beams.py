"""The destagger ring of a model's beam table, for ``kernels/rtl/upb_destagger.sv``; planned as in
``runtime/src/upb_stream.c``."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from upbeam.model.rules import Rules

from .source import Source

__all__ = ["BEAMS", "Ring", "beams_header", "ring"]

BEAMS = "upb_beams.svh"
LAG_BITS = 16

I64 = NDArray[np.int64]


@dataclass(frozen=True)
class Ring:
    slots: int
    """columns that fill at the same time; 1: none is needed"""
    delay: int
    """firing columns from an azimuth column to its last beam"""
    lag: I64
    """[32] columns that each beam waits"""


def ring(rules: Rules) -> Ring:
    """Offsets that are all of one sign only rename the columns: ``delay`` is 0 then, which the RTL ring refuses."""
    offset = np.floor(rules.azimuth_offset_deg * rules.columns / 360.0 + 0.5).astype(np.int64)
    least, most = int(offset.min()), int(offset.max())
    shift = least if least > 0 else most if most < 0 else 0
    return Ring(most - least + 1, shift - least, offset - least)


def beams_header(source: Source) -> str:
    """``upb_beams.svh``."""
    r = ring(source.file.rules)
    digits = "".join(f"{int(n):0{LAG_BITS // 4}x}" for n in r.lag[::-1])
    bits = LAG_BITS * len(r.lag)
    lines = [
        "// Destagger ring of the model's beam table. Generated from the model file; do not edit.",
        *(f"// {key}: {text}" for key, text in source.describe()[:1]),
        "// LAG: columns that beam k waits, at [16 * k +: 16].",
        f"localparam [31:0] UPB_BEAMS_CRC32 = 32'h{source.crc32:08x};",
        f"localparam integer UPB_RING_SLOTS = {r.slots};",
        f"localparam integer UPB_RING_DELAY = {r.delay};",
        f"localparam [{bits - 1}:0] UPB_RING_LAG = {bits}'h{digits};",
    ]
    return "\n".join([*lines, ""])
