"""The weights of a model as writes to a running core (``kernels/rtl/upb_memory.sv``, ``docs/fpga-registers.md``).

An image fits cores of one precision, LANES, FOLD, hidden units, shifts and slopes; its head names them, so that a
driver can refuse another before it writes."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from upbeam.quant.integer import IntegerNetwork, Precision

from .rtl_schedule import Configuration, ConfigurationError, configuration, weight_bits, words
from .source import Source

__all__ = ["MAGIC", "WEIGHTS", "WeightsImage", "weights_image"]

WEIGHTS = "upb_weights.bin"
MAGIC = b"UPBW"
FORMAT = 1
HEAD = struct.Struct("<4sIIIIIIII")
"""magic, format, then the registers SHAPE (its flags but WIDE 0), SCALE_DISTANCE, SCALE_INTENSITY, SLOPES; CRC-32 of
the model file, number of words, CRC-32 of the words"""

I64 = NDArray[np.int64]
_PART_BITS = 32
_MEMORY_BYTES, _NETWORK_BYTES = 0x400, 0x2000
_C = 4


@dataclass(frozen=True)
class WeightsImage:
    head: bytes
    words: NDArray[np.uint32]
    """[N, 2] byte address from the register map's ``weights`` on, value; ascending"""

    @property
    def crc32(self) -> int:
        """What ``WEIGHTS_SUM`` reads after they are written in this order."""
        return zlib.crc32(self.words.astype("<u4").tobytes())

    def data(self) -> bytes:
        """The file: head, then the words."""
        return self.head + self.words.astype("<u4").tobytes()


def weights_image(source: Source, precision: Precision, *, fold: int | None = None, lanes: int = 1) -> WeightsImage:
    """Raises ExportError, and ConfigurationError for FOLD 1, where weights are constants."""
    model = source.integer(precision)
    c = configuration(model, fold=fold, lanes=lanes)
    if c.fold == 1:
        raise ConfigurationError("FOLD 1 bakes the weights in: there is nothing to write")
    pairs = []
    for number, network in enumerate(model):
        pairs += [
            (number * _NETWORK_BYTES + at, value) for at, value in _network(network, precision, c, 16 - 8 * number)
        ]
    made = np.array(pairs, dtype=np.uint32)
    wide = int(weight_bits(precision) == 16)
    shape = c.fold | c.lanes << 12 | c.hidden << 22 | wide << 28
    slopes = model.distance.slope | model.intensity.slope << 16
    crc = zlib.crc32(made.astype("<u4").tobytes())
    head = HEAD.pack(
        MAGIC, FORMAT, shape, _scale(model.distance), _scale(model.intensity), slopes, source.crc32, len(made), crc
    )
    return WeightsImage(head, made)


def _scale(n: IntegerNetwork) -> int:
    return n.k | n.j << 8 | n.t << 16 | n.skip << 24


def _network(n: IntegerNetwork, precision: Precision, c: Configuration, input_bits: int) -> Iterator[tuple[int, int]]:
    made = words(n, precision, c, input_bits)
    per_step = (c.multipliers, 0, 1, 0) if c.phases > 1 else (6 * c.units, c.units, c.units, c.units)
    for number, letter in enumerate("WMBV"):
        if per_step[number]:
            memory = np.asarray(getattr(made, letter), dtype=np.int64).reshape(-1, per_step[number])
            yield from _memory(number * _MEMORY_BYTES, memory, made.bits[number])
    yield _C * _MEMORY_BYTES, made.C & 0xFFFFFFFF


def _memory(base: int, memory: I64, bits: int) -> Iterator[tuple[int, int]]:
    """Memory words ``[depth, values]`` of ``bits`` a value, value 0 lowest, cut into parts of 32 bits."""
    parts = -(-memory.shape[1] * bits // _PART_BITS)
    stride = 1 << (parts - 1).bit_length()
    for n, row in enumerate(memory):
        whole = sum((int(value) & ((1 << bits) - 1)) << (i * bits) for i, value in enumerate(row))
        for part in range(parts):
            yield base + 4 * (n * stride + part), whole >> (_PART_BITS * part) & 0xFFFFFFFF
