"""Writes ``packet_tables.h``: the shipped beam tables as C, for the packet codecs.

``python -m upbeam.runtime.packets.tables`` after a change of ``model/beam_tables``; a test compares.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from upbeam.model.beams import BeamTable, beam_table

__all__ = ["HEADER", "SENSORS", "header_text"]

SENSORS = ("hdl-32e", "vlp-32c", "vlp-16", "hdl-64e")
"""Beam tables the codecs know; both series of the HDL-64E share one."""
HEADER = Path(__file__).with_name("packet_tables.h")

_BEGIN = """\
/* clang-format off */
/*
 * Written by tables.py from model/beam_tables: change those, then run python -m upbeam.runtime.packets.tables.
 *
 * Top beam first: elevation and azimuth offset in mdeg, firing time in ns, vertical and horizontal offset in um, laser.
 */
#ifndef UPBEAM_PACKET_TABLES_H
#define UPBEAM_PACKET_TABLES_H

#include <stdint.h>

typedef struct packet_beam {
    int32_t elevation_mdeg;
    int32_t azimuth_offset_mdeg;
    uint32_t fire_time_ns;
    int32_t vertical_offset_um;
    int32_t horizontal_offset_um;
    uint8_t laser_id;
} packet_beam;
"""


def header_text() -> str:
    """The whole header."""
    return _BEGIN + "".join(_table(beam_table(name)) for name in SENSORS) + "\n#endif\n"


def _table(table: BeamTable) -> str:
    columns = (
        _whole(table.elevation_deg, 1e3),
        _whole(table.azimuth_offset_deg, 1e3),
        _whole(table.firing_time_us, 1e3),
        _whole(table.vertical_offset_m, 1e6),
        _whole(table.horizontal_offset_m, 1e6),
        _whole(table.laser_id, 1.0),
    )
    rows = "".join(f"    {{{', '.join(map(str, row))}}},\n" for row in zip(*columns, strict=True))
    name = table.name.replace("-", "_")
    macro = name.upper()
    return (
        f"\n#define PACKET_{macro}_UNIT_UM {round(table.distance_unit_m * 1e6)}u\n"
        f"#define PACKET_{macro}_CYCLE_NS {round(table.firing_cycle_us * 1e3)}u\n"
        f"static const packet_beam packet_{name}[{table.beams}] = {{\n{rows}}};\n"
    )


def _whole(values: np.ndarray, scale: float) -> list[int]:
    return [int(v) for v in np.floor(np.asarray(values) * scale + 0.5)]


if __name__ == "__main__":
    HEADER.write_text(header_text(), encoding="utf-8")
    print(f"{HEADER}: {', '.join(SENSORS)}", file=sys.stderr)
