"""Bytes of a model file and of what is in it, from its own section table."""

from __future__ import annotations

import struct

from .ubm_integer import INTEGER_TAGS

__all__ = ["section_bytes", "weight_bytes"]

_HEADER, _ENTRY = 32, 16
_COUNT, _CONTRACT = 4, 32
"""Before a section's networks: how many there are; of integer ones the contract's name first."""


def section_bytes(data: bytes) -> dict[str, int]:
    """Tags and sizes of the sections of a sound model file, in their order."""
    count = struct.unpack_from("<I", data, 12)[0]
    entries = [struct.unpack_from("<4s3I", data, _HEADER + _ENTRY * k) for k in range(count)]
    return {tag.decode("ascii"): size for tag, _, _, size in entries}


def weight_bytes(data: bytes) -> dict[str, int]:
    """Both networks of each precision in the file, as it holds them: ``fp32``, ``int16``, ``int8``."""
    sections = section_bytes(data)
    sizes = {"fp32": sections["NETW"] - _COUNT}
    for precision, tag in INTEGER_TAGS.items():
        if tag in sections:
            sizes[precision] = sections[tag] - _CONTRACT - _COUNT
    return sizes
