"""Sections ``Q16 `` and ``Q8  `` of a model file: the integer networks."""

from __future__ import annotations

import struct
from typing import Literal

from upbeam.model.network import WINDOW
from upbeam.model.rules import Rules

from .cursor import Cursor, UbmError
from .integer import (
    CONTRACTS,
    NETWORK_NAMES,
    IntegerModel,
    IntegerNetwork,
    OverflowProofError,
    Precision,
    largest_inputs,
    prove,
)

__all__ = ["INTEGER_TAGS", "pack_integer", "parse_integer", "prove_model"]

INTEGER_TAGS: dict[Precision, str] = {"int16": "Q16 ", "int8": "Q8  "}

_NAME_BYTES = 32


def _weight_type(precision: Precision) -> Literal["<i1", "<i2"]:
    return "<i1" if precision == "int8" else "<i2"


def prove_model(model: IntegerModel, rules: Rules) -> None:
    """Shows that neither network overflows for any input of these rules. Raises OverflowProofError."""
    for name, network in zip(NETWORK_NAMES, model, strict=True):
        prove(network, model.precision, *largest_inputs(rules, name), f"{model.precision} {name} network")


def pack_integer(model: IntegerModel, rules: Rules) -> bytes:
    """The section. A model that could overflow is refused (OverflowProofError)."""
    prove_model(model, rules)
    out = struct.pack(f"<{_NAME_BYTES}sI", model.contract.encode(), len(NETWORK_NAMES))
    narrow = _weight_type(model.precision)
    for n in model:
        out += struct.pack("<6Ii", n.hidden, n.skip, n.slope, n.k, n.j, n.t, n.offset)
        out += n.bias.astype("<i4").tobytes() + n.minimum.astype("<i2").tobytes()
        out += n.output.astype(narrow).tobytes() + n.weight.astype(narrow).tobytes()
        out += b"\0" * (-len(out) % 4)
    return out


def parse_integer(precision: Precision, sections: dict[str, bytes], rules: Rules) -> IntegerModel | None:
    """The section's networks, proven not to overflow, or None. Raises UbmError."""
    tag = INTEGER_TAGS[precision]
    if tag not in sections:
        return None
    cursor = Cursor(tag.strip(), sections[tag])
    contract = cursor.take(_NAME_BYTES)
    if contract != CONTRACTS[precision].encode().ljust(_NAME_BYTES, b"\0"):
        raise UbmError(f"section {cursor.tag}: contract {contract!r}, this program knows {CONTRACTS[precision]!r}")
    cursor.u32("number of networks", 2, 2)
    networks = [_parse_network(cursor, precision) for _ in NETWORK_NAMES]
    cursor.end()
    model = IntegerModel(precision, networks[0], networks[1])
    try:
        prove_model(model, rules)
    except OverflowProofError as error:
        raise UbmError(f"section {cursor.tag}: {error}") from None
    return model


def _parse_network(cursor: Cursor, precision: Precision) -> IntegerNetwork:
    narrow = _weight_type(precision)
    hidden = cursor.u32("hidden units", 1, 32)
    skip, slope = cursor.u32("skip", 0, 1), cursor.u32("slope", 0, 32767)
    k, j, t = (cursor.u32(name, 0, top) for name, top in (("k", 16), ("j", 16), ("t", 24)))
    offset = int(cursor.integers("C", "<i4", 1)[0])
    bias = cursor.integers("B", "<i4", hidden)
    minimum = cursor.integers("M", "<i2", hidden)
    output = cursor.integers("V", narrow, hidden)
    weight = cursor.integers("W", narrow, hidden, WINDOW)
    cursor.zeros(-cursor.at % 4)
    return IntegerNetwork(weight, minimum, bias, output, offset, slope, skip, k, j, t)
