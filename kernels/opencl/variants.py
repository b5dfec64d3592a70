"""How a kernel is cut into vectors and work-items: what may be chosen, and is measured once for a device."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from typing import Literal

__all__ = ["Variant", "parse_variant", "refinements", "shapes"]

PAIRS = 31
PAD = 16
"""Empty columns on both sides of an input row: the widest vector."""
MAX_WALK = 512

Weights = Literal["program", "buffer"]

_NAME = re.compile(r"v(1|2|4|8|16)-([rw])(\d{1,3})(s2)?-g(\d{1,4})-(program|buffer)")


@dataclass(frozen=True)
class Variant:
    """One way to run the window kernel. ``str`` gives its name, ``parse_variant`` takes it."""

    vec: int
    """Columns in a vector: 1, 2, 4, 8, 16."""
    rows: int = 1
    """Pairs of beams that a work-item takes one after the other (only where ``walk`` is 0)."""
    walk: int = 0
    """Blocks of ``vec`` columns that a work-item takes one after the other; 0: one."""
    share: int = 1
    """Of these blocks, how many go through a network together and share the loads of its weights: 1, 2."""
    group: int = 1
    """Work-items of a work-group, side by side in a row."""
    weights: Weights = "program"
    """Constants of the program, or a constant buffer."""

    def __str__(self) -> str:
        work = f"w{self.walk}" + ("s2" if self.share == 2 else "") if self.walk else f"r{self.rows}"
        return f"v{self.vec}-{work}-g{self.group}-{self.weights}"

    @property
    def columns_per_item(self) -> int:
        return self.vec * max(1, self.walk)

    def padded_columns(self, columns: int) -> int:
        """``columns``, rounded up to whole work-groups and, for the alignment of rows, to whole pads."""
        block = self.columns_per_item * self.group
        while block % PAD:
            block *= 2
        return -(-columns // block) * block

    def global_size(self, columns: int) -> tuple[int, int]:
        return self.padded_columns(columns) // self.columns_per_item, -(-PAIRS // self.rows)

    def defines(self) -> list[str]:
        """Build options."""
        options = [f"-DVEC={self.vec}", f"-DROWS={self.rows}", f"-DWALK={self.walk}", f"-DSHARE={self.share}"]
        if self.weights == "buffer":
            options.append("-DUPB_WEIGHTS_ARE_ARGUMENTS")
        return options


def parse_variant(name: str) -> Variant:
    """The variant of that name, e.g. ``v16-w128s2-g1-program``: vector, rows (``r``) or walk (``w``) and blocks that
    share weights (``s2``), work-group, place of the weights. Raises ValueError."""
    match = _NAME.fullmatch(name)
    if match is None:
        raise ValueError(f"variant {name!r}, expected a name such as v16-w128s2-g1-program, v1-r1-g64-buffer, or dense")
    vec, count, group = int(match[1]), int(match[3]), int(match[5])
    weights: Weights = "buffer" if match[6] == "buffer" else "program"
    share = 2 if match[4] else 1
    if match[2] == "w":
        sound = 1 <= count <= MAX_WALK and count % share == 0 and vec > 1
        variant = Variant(vec, walk=count, share=share, group=group, weights=weights)
    else:
        sound = 1 <= count <= PAIRS and share == 1
        variant = Variant(vec, rows=count, group=group, weights=weights)
    if not sound or group < 1:
        raise ValueError(f"variant {name!r}: rows are 1 to {PAIRS}; walks, of vectors, 1 to {MAX_WALK}, even with s2")
    return variant


def shapes(is_cpu: bool, columns: int, largest_group: int) -> list[Variant]:
    """What is measured on a device that nothing is known of. A CPU wants few, long work-items of vectors, everything
    else many short ones."""
    if is_cpu:
        walks = [(16, 1), (16, 4), (8, 1), (8, 4), (4, 1)]
        found = [Variant(vec, walk=_blocks(columns, vec, parts)) for vec, parts in walks]
        found += [replace(variant, share=2) for variant in found[:3] if variant.walk % 2 == 0]
        found += [Variant(16, rows=PAIRS), Variant(16, rows=1, group=min(largest_group, _blocks(columns, 16, 1)))]
    else:
        groups = (min(64, largest_group), min(256, largest_group))
        found = [Variant(vec, rows=rows, group=group) for vec in (1, 2, 4) for rows in (1, 4) for group in groups]
    return list(dict.fromkeys(found))


def _blocks(columns: int, vec: int, parts: int) -> int:
    """Blocks of a walk that takes one of ``parts`` of a row."""
    return max(1, min(MAX_WALK, -(-columns // (vec * parts))))


def refinements(best: Variant) -> list[Variant]:
    """What is measured beside the best shape."""
    return [replace(best, weights="buffer")]
