"""What was delivered and what left, firing by firing: are measured rows verbatim, is nothing invented?

Packets and column datagrams are read here from their descriptions, apart from the product's own readers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from upbeam.hw_sim.sensor import Datagram
from upbeam.hw_sim.sensor.datagram import DATA_BYTES, DATA_PORT, PACKET
from upbeam.model.beams import BeamTable

__all__ = ["Firings", "compare_columns", "compare_hdl64", "delivered_firings"]

INCOMPLETE, LAST, SECOND, INSERTED = 1, 2, 4, 8
"""Flags of a column (docs/column-stream.md); its mode stands in bits 8 and 9."""
PASS_THROUGH = 3
_FAR = 4096
"""Columns apart that have nothing to do with each other: more than any beam's offset."""
_HOUR_NS = 3_600_000_000_000
_FLAG, _LOWER = 0xEEFF, 0xDDFF
_HDL64_UNIT_UM = 2000
_HDL64_FIRINGS = 6
"""Of a packet."""
_DUAL = 0x39


@dataclass(frozen=True)
class Firings:
    """Firings of packets, in the order of delivery; beam 0 = top."""

    time_ns: NDArray[np.int64]
    """The sensor's clock, after the full hour."""
    azimuth_mdeg: NDArray[np.int64]
    distance: NDArray[np.uint16]
    """[firings, beams]; in dual return beam by beam the brighter one."""
    intensity: NDArray[np.uint8]


def delivered_firings(datagrams: Sequence[Datagram], beams: BeamTable) -> Firings:
    """Of all datagrams that could be whole data packets of a 32-beam sensor."""
    kept = [d.payload for d in datagrams if d.port == DATA_PORT and len(d.payload) == DATA_BYTES]
    packets = np.frombuffer(b"".join(kept), dtype=PACKET)
    packets = packets[np.all(packets["blocks"]["flag"] == _FLAG, axis=1)]
    returns, azimuth = packets["blocks"]["returns"], packets["blocks"]["azimuth"].astype(np.int64) * 10
    dual = packets["tail"]["return_mode"] == _DUAL
    parts = []
    for is_dual in (False, True):
        of = np.flatnonzero(dual == is_dual)
        if not len(of):
            continue
        blocks = returns[of]
        chosen = _brighter(blocks[:, 0::2], blocks[:, 1::2]) if is_dual else blocks
        step = 2 if is_dual else 1
        firing = np.arange(12 // step) * round(beams.firing_cycle_us * 1000)
        time_ns = packets["tail"]["toh_us"][of].astype(np.int64)[:, None] * 1000 + firing
        order = np.repeat(of, 12 // step)
        parts.append((order, time_ns.reshape(-1), azimuth[of][:, ::step].reshape(-1), chosen.reshape(-1, 32)))
    if not parts:
        empty = np.zeros(0, np.int64)
        return Firings(empty, empty, np.zeros((0, 32), np.uint16), np.zeros((0, 32), np.uint8))
    order, time_ns, angle, seen = (np.concatenate([part[k] for part in parts]) for k in range(4))
    by = np.argsort(order, kind="stable")
    seen = seen[by][:, beams.laser_id.astype(int)]
    return Firings(time_ns[by] % _HOUR_NS, angle[by], seen["distance"], seen["intensity"])


def _brighter(last: NDArray[Any], strongest: NDArray[Any]) -> NDArray[Any]:
    """Beam by beam the brighter return; of equal ones the strongest block's."""
    take = (last["distance"] > 0) & ((strongest["distance"] == 0) | (last["intensity"] > strongest["intensity"]))
    return np.where(take, last, strongest)


@dataclass(frozen=True)
class Comparison:
    """What ``compare_columns`` found."""

    columns: int
    """Compared."""
    inserted: int
    faults: tuple[str, ...]
    """What is wrong, one sentence each; empty: nothing."""


def compare_columns(
    columns: NDArray[Any], turn_columns: NDArray[np.int64], firings: Firings, beams: BeamTable
) -> Comparison:
    """Columns that left (``COLUMN``; ``turn_columns`` of the datagram of each) against what was delivered.

    Every column but an inserted one is a firing that was delivered, at its azimuth; its even rows are that firing's
    and, for beams with an azimuth offset, its neighbours', to the bit; where a column says that samples are missing, a
    pixel may be empty instead. Generated rows are empty without a return near by, in pass-through, and in row 63.
    """
    plain = columns["flags"] & SECOND == 0
    columns, turn_columns = columns[plain], turn_columns[plain]
    inserted = columns["flags"] & INSERTED > 0
    source = _sources(columns, inserted, firings)
    faults = []
    unknown = np.flatnonzero((source < 0) & ~inserted)
    if len(unknown):
        faults.append(f"{len(unknown)} columns are of no firing that was delivered, the first is column {unknown[0]}")
    known = source >= 0
    wrong = np.flatnonzero(known & (columns["azimuth_mdeg"] != firings.azimuth_mdeg[source]))
    if len(wrong):
        faults.append(f"{len(wrong)} columns have another azimuth than their firing, the first is column {wrong[0]}")
    faults += _compare_rows(columns, turn_columns, source, firings, beams)
    faults += _check_generated(columns)
    return Comparison(len(columns), int(inserted.sum()), tuple(faults))


def _sources(columns: NDArray[Any], inserted: NDArray[np.bool_], firings: Firings) -> NDArray[np.int64]:
    """Of each column the firing with its time, -1 if there is none. A clock that was set back tells times twice: then
    the firing is the one after the last column's."""
    order = np.argsort(firings.time_ns, kind="stable")
    times = firings.time_ns[order]
    wanted = columns["time_ns"].astype(np.int64) % _HOUR_NS
    first, end = np.searchsorted(times, wanted, "left"), np.searchsorted(times, wanted, "right")
    source = np.where(
        (end > first) & ~inserted, order[np.minimum(first, max(len(order) - 1, 0))] if len(order) else -1, -1
    )
    last = -1
    for k in np.flatnonzero((end - first > 1) & ~inserted):
        last = int(source[k - 1]) if k else -1
        candidates = order[first[k] : end[k]]
        later = candidates[candidates > last]
        source[k] = later[0] if len(later) else candidates[0]
    return np.asarray(source, dtype=np.int64)


def _compare_rows(
    columns: NDArray[Any],
    turn_columns: NDArray[np.int64],
    source: NDArray[np.int64],
    firings: Firings,
    beams: BeamTable,
) -> list[str]:
    faults = []
    incomplete = columns["flags"] & INCOMPLETE > 0
    number = _numbers(columns, beams)
    for row, offset in enumerate(beams.azimuth_offset_deg):
        of, is_there = _firing_of(number, np.floor(offset * turn_columns / 360.0 + 0.5).astype(np.int64), source)
        for what, plane, out in (
            ("distance", firings.distance, columns["distance"]),
            ("intensity", firings.intensity, columns["intensity"]),
        ):
            expected = np.where(of >= 0, plane[of, row] if len(plane) else 0, 0)
            got = out[:, 2 * row]
            # A column that was lost on the way may have given its samples to its neighbours.
            wrong = (got != expected) & is_there & ~(incomplete & (got == 0))
            if wrong.any():
                k = int(np.flatnonzero(wrong)[0])
                faults.append(
                    f"beam {row}: {int(wrong.sum())} {what}s are not the sensor's, the first in column {k}: {got[k]}, "
                    f"measured {expected[k]}"
                )
    return faults[:4]


def _numbers(columns: NDArray[Any], beams: BeamTable) -> NDArray[np.int64]:
    """Running numbers of columns by their times: what was lost leaves a gap, a clock that jumps a wide one."""
    time_ns: NDArray[np.int64] = columns["time_ns"].astype(np.int64)
    steps: NDArray[np.float64] = np.diff(time_ns) / (beams.firing_cycle_us * 1e3)
    steps = np.where((steps < 0.5) | (steps > _FAR), _FAR, np.floor(steps + 0.5))
    return np.concatenate(([0], np.cumsum(steps))).astype(np.int64)[: len(columns)]


def _firing_of(
    number: NDArray[np.int64], offset: NDArray[np.int64], source: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """The firing that a beam's samples are of, -1 for none, and whether its column is among those that left."""
    wanted = number - offset
    at = np.minimum(np.searchsorted(number, wanted), max(len(number) - 1, 0))
    is_there = number[at] == wanted
    return np.where(is_there, source[at], -1), is_there


def _check_generated(columns: NDArray[Any]) -> list[str]:
    faults = []
    distance = columns["distance"]
    odd = distance[:, 1::2]
    if odd[:, 31].any():
        faults.append(f"row 63 holds {np.count_nonzero(odd[:, 31])} returns: no beam lies below")
    through = columns["flags"] >> 8 & 3 == PASS_THROUGH
    if odd[through].any():
        faults.append(f"{np.count_nonzero(odd[through])} generated returns in mode PASS_THROUGH")
    seen = distance[:, 0::2] > 0
    near = seen.copy()
    for step in (1, 2):
        near[step:] |= seen[:-step]
        near[:-step] |= seen[step:]
    lone = (odd[:, :31] > 0) & ~(near[:, :-1] | near[:, 1:])
    if lone.any():
        faults.append(f"{int(lone.sum())} generated returns with none measured near by")
    return faults


def compare_hdl64(payloads: Sequence[bytes], columns: NDArray[Any], unit_um: int) -> list[str]:
    """HDL-64E packets against the columns that left, in order: what is wrong, one sentence each.

    Row 2k is laser k of the upper bank, row 2k+1 laser k of the lower; counts are of 2 mm, beyond 16 bits no return;
    row 63 is empty. Packets may end with firings that no column fills any more.
    """
    packets = np.frombuffer(b"".join(payloads), dtype=PACKET)["blocks"]
    upper, lower = packets[:, 0::2], packets[:, 1::2]
    faults = []
    if np.any(upper["flag"] != _FLAG) or np.any(lower["flag"] != _LOWER):
        faults.append("a block's flag is not its bank's")
    plain = columns[columns["flags"] & SECOND == 0]
    count = min(len(plain), upper.size)
    counts = plain["distance"][:count].astype(np.int64) * unit_um // _HDL64_UNIT_UM
    counts[counts > 65535] = 0
    counts[:, 63] = 0
    for name, bank, rows in (("upper", upper, counts[:, 0::2]), ("lower", lower, counts[:, 1::2])):
        shown = bank["returns"]["distance"].reshape(-1, 32)
        wrong = np.count_nonzero(shown[:count] != rows)
        if wrong:
            faults.append(f"{wrong} returns of the {name} bank are not the columns'")
        if shown[count:].any():
            faults.append(f"returns of the {name} bank after the last column")
    azimuth = np.floor((plain["azimuth_mdeg"][:count] + 5) / 10).astype(np.int64) % 36000
    if np.any(upper["azimuth"].reshape(-1)[:count] != azimuth):
        faults.append("azimuths are not the columns'")
    if not 0 <= upper.size - len(plain) < _HDL64_FIRINGS:
        faults.append(f"{upper.size} firings in packets, {len(plain)} columns")
    return faults
