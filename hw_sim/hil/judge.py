"""The verdict on a record: what is expected of every scenario, and what this one expects besides."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from upbeam.hw_sim.can.database import LEDGER_ID, Decoded, Decoder
from upbeam.hw_sim.can.e2e import E2EStatus
from upbeam.hw_sim.sensor import blocks, is_data

from .firings import INSERTED, SECOND, compare_columns, compare_hdl64, delivered_firings
from .record import Boot, Event, Record
from .scenario import MODES, ExpectedFault, ExpectedReaction, Scenario

__all__ = ["Check", "Timing", "Verdict", "judge"]

NS_PER_MS = 1e6
HOUR_NS = 3_600_000_000_000
_DATAGRAM_COLUMNS = 6
"""At most."""
_LEDGER = {
    "Frame": "frame", "FirstInput": "first_input_ns", "LastInput": "last_input_ns", "Output": "output_ns",
    "LatencyNs": "latency_ns", "Verdict": "verdict", "MissingColumns": "missing_columns", "Mode": "mode",
}  # fmt: skip
"""Signals of UPB_Ledger, and fields of the record."""


@dataclass(frozen=True)
class Check:
    """One expectation, and whether it held."""

    name: str
    passed: bool
    text: str = ""
    """What was found; of a failure, beside what was expected."""
    counts: bool = True
    """False: reported only. On the real clock, times are the machine's as much as the device's."""


@dataclass(frozen=True)
class Timing:
    """How long something took, in milliseconds of the device's clock. None: it did not happen."""

    what: str
    limit_ms: float
    ms: float | None
    reported_ms: float | None = None
    """Of a fault: until a receiver of the CAN messages knew."""
    healed_ms: float | None = None
    """Of a fault: from the end of its cause until it was clear."""


@dataclass
class Verdict:
    """What the judge says of one run."""

    scenario: str
    checks: list[Check] = field(default_factory=list)
    timings: list[Timing] = field(default_factory=list)

    @property
    def passed(self) -> bool:
        return not self.failures

    @property
    def failures(self) -> list[Check]:
        return [check for check in self.checks if check.counts and not check.passed]


def judge(scenario: Scenario, record: Record) -> Verdict:
    """All checks of a finished run."""
    verdict = Verdict(scenario.name)
    verdict.checks += _accounting(record)
    verdict.checks += _output(scenario, record)
    verdict.checks += _same_story(scenario, record)
    verdict.checks += _faults(scenario, record, verdict.timings)
    verdict.checks += _reactions(scenario, record, verdict.timings)
    verdict.checks += _end(scenario, record)
    return verdict


def _timed(record: Record, name: str, passed: bool | np.bool_, text: str = "") -> Check:
    """What depends on the machine's moods on the real clock: there it is reported, never held against the device."""
    return Check(name, bool(passed), text, counts=record.virtual)


def _check(name: str, passed: bool | np.bool_, text: str = "") -> Check:
    return Check(name, bool(passed), text)


# ------------------------------------------------------------------------------------------------------ accounting


def _accounting(record: Record) -> Iterator[Check]:
    """Every packet and every column has its place."""
    for number, boot in enumerate(record.boots):
        if not _tells_all(record, boot):
            continue
        s = boot.status
        dropped = sum(s["packets_dropped"].values())
        received, processed = s["packets_received"], s["packets_processed"]
        story = f"boot {number}: {boot.delivered} sent, {received} received, {processed} processed, {dropped} dropped"
        balanced = boot.delivered == received == processed + dropped
        yield _check("packets sent = processed + dropped", balanced, story)
        yield _check(
            "positions",
            boot.positions == s["positions_received"],
            f"{boot.positions} sent, {s['positions_received']} received",
        )
    if not all(_tells_all(record, boot) for boot in record.boots):
        return
    flags = record.columns["flags"]
    made = sum(boot.status["columns_out"] for boot in record.boots)
    sent = int(np.count_nonzero(flags & SECOND == 0))
    cut_off = _DATAGRAM_COLUMNS * (len(record.boots) - 1)  # waited for their datagram to fill
    yield _check("columns counted = columns sent", 0 <= made - sent <= cut_off, f"{made} counted, {sent} sent")
    taken = sum(
        b.status["firings_processed"] + b.status["firings_inserted"] - b.status["columns_lost"] for b in record.boots
    )
    held = taken - made
    limit = sum(b.status["delay_columns"] for b in record.boots[:-1])
    yield _check("columns = firings + inserted", 0 <= held <= limit, f"{taken} pushed, {made} came out")
    inserted = int(np.count_nonzero(flags & INSERTED))
    counted = sum(boot.status["firings_inserted"] for boot in record.boots)
    yield _check("inserted columns say so", 0 <= counted - inserted <= limit, f"{counted} counted, {inserted} flagged")


def _tells_all(record: Record, boot: Boot) -> bool:
    """Whether the boot's last status is its last word: a process that was killed takes its counters along, and a
    device that is known by CAN alone tells them in turn."""
    return "packets_received" in boot.status and (record.virtual or bool(boot.status["ended"]))


# ---------------------------------------------------------------------------------------------------------- output


def _output(scenario: Scenario, record: Record) -> Iterator[Check]:
    headers = record.headers
    beams = scenario.sensor.beams
    turn = headers["turn_columns"].astype(np.int64)[record.column_datagram]
    found = compare_columns(record.columns, turn, delivered_firings(record.delivered, beams), beams)
    yield _check(
        "measured rows verbatim, nothing invented",
        not found.faults,
        "; ".join(found.faults) or f"{found.columns} columns",
    )
    first = np.flatnonzero(np.diff(headers["sequence"].astype(np.int64)) != 1)
    yield _check(
        "datagrams in sequence", len(first) <= len(record.boots) - 1, f"{len(headers)} datagrams, {len(first)} breaks"
    )
    yield from _shown(record)
    yield from _gaps(scenario, record)
    missed = sum(r["verdict"] == "missed" for r in record.ledger)
    yield _timed(
        record,
        "deadlines",
        missed <= scenario.expect.misses,
        f"{missed} of {len(record.ledger)} frames missed, {scenario.expect.misses} allowed",
    )
    worst = max((MODES.index(str(r["mode"]).upper()) for r in record.ledger), default=0)
    limit = MODES.index(scenario.expect.worst_mode)
    yield _timed(record, "worst mode", worst <= limit, f"{MODES[worst]}, {MODES[limit]} allowed")


def _shown(record: Record) -> Iterator[Check]:
    """What HDL-64E drivers see. Where the stream began anew packets are filled up, and columns have no fixed place."""
    shown = [output.payload for output in record.of_kind("hdl64")]
    if not shown or len(record.boots) > 1 or record.status["streams_made"] > 1:
        return
    wrong = compare_hdl64(shown, record.columns, int(record.headers["unit_um"][0]))
    yield _check("HDL-64E packets = columns", not wrong, "; ".join(wrong) or f"{len(shown)} packets")


def _gaps(scenario: Scenario, record: Record) -> Iterator[Check]:
    """Output never stops for long but where it may."""
    times = record.output_ns
    limit = scenario.expect.output_gap_ms * NS_PER_MS
    edges = np.concatenate(([0], times, [round(scenario.seconds * 1e9)]))
    gaps = [
        (start, end)
        for start, end in itertools.pairwise(edges)
        if end - start > limit and not _allowed_silent(scenario, start, end, limit)
    ]
    longest = max(((end - start) / NS_PER_MS, start / 1e9) for start, end in itertools.pairwise(edges))
    text = f"longest {longest[0]:.3f} ms at {longest[1]:.3f} s"
    yield _timed(
        record, "output goes on", not gaps, f"{len(gaps)} gaps above {limit / NS_PER_MS:g} ms, {text}" if gaps else text
    )


def _allowed_silent(scenario: Scenario, start_ns: int, end_ns: int, limit_ns: float) -> bool:
    return any(a * 1e9 - limit_ns <= start_ns and end_ns <= b * 1e9 + limit_ns for a, b in scenario.expect.silent)


# ------------------------------------------------------------------------------------------------------ same story


def _same_story(scenario: Scenario, record: Record) -> Iterator[Check]:
    """Ledger, CAN, serial line and counters agree, frame by frame."""
    lossless = not ({"bus_off", "reset"} & scenario.disturbances)
    can = list(record.of_kind("can"))
    decoded = list(_decode((o.time_ns, o.payload) for o in can))
    yield from _ledger_story("CAN", record, decoded, lossless)
    if record.has_serial:
        yield from _ledger_story("serial", record, list(_decode(record.serial)), "reset" not in scenario.disturbances)
    if "ledger" in record.status:
        told = record.status["ledger"]
        same = told == record.ledger[-len(told) :] if told else not record.ledger
        yield _check("ledger in JSON = ledger", same, f"{len(told)} records")
    if record.virtual:  # frames carry no time of sending: only here it is known to the nanosecond
        yield from _mode_story(record, decoded)
        yield from _fault_story(record, decoded)
        yield from _counter_story(record, decoded)
    first = {d.name: d for d in reversed(record.heard)}  # who joins late knows no counter
    bad = [d for d in record.heard if d.e2e not in (None, E2EStatus.OK) and (record.virtual or d is not first[d.name])]
    wrong = [d for d in bad if d.e2e is E2EStatus.WRONG_CRC]
    if lossless and "wrong_crc" not in scenario.disturbances:
        yield _check("E2E good", not bad, f"{len(record.heard)} frames heard, {len(bad)} not good")
    else:
        used = [d for d in wrong if d.signals]
        yield _check(
            "nothing damaged is used", not used, f"{len(wrong)} of {len(record.heard)} frames have a wrong CRC"
        )
    yield _check("serial records good", record.serial_refused == 0, f"{record.serial_refused} refused")


def _decode(frames: Any) -> Iterator[Decoded]:
    decoder = Decoder()
    for time_ns, frame in frames:
        decoded = decoder.decode(frame, time_ns)
        if decoded is not None:
            yield decoded


def _ledger_story(channel: str, record: Record, heard: list[Decoded], lossless: bool) -> Iterator[Check]:
    told = [d.signals for d in heard if d.frame.identifier == LEDGER_ID]
    own = {r["frame"]: r for r in record.ledger} if len(record.boots) == 1 else None
    differ = []
    for signals in told:
        number = int(signals["Frame"])
        match = (
            [own[number]] if own is not None and number in own else [r for r in record.ledger if r["frame"] == number]
        )
        if not any(_same_record(signals, r) for r in match):
            differ.append(number)
    name = f"ledger on {channel}"
    yield _check(
        f"{name} = ledger",
        not differ,
        f"{len(told)} records told, frames {differ[:5]} differ" if differ else f"{len(told)} records",
    )
    missing = len(record.ledger) - len(told)
    yield _check(
        f"{name} complete",
        missing <= (1 if lossless else len(record.ledger)),
        f"{len(record.ledger)} closed, {len(told)} told",
    )


def _same_record(signals: dict[str, Any], own: dict[str, Any]) -> bool:
    for signal, name in _LEDGER.items():
        mine = own[name]
        if str(signals[signal]) != (mine.upper() if isinstance(mine, str) else str(mine)):
            return False
    return True


def _boot_at(record: Record, time_ns: int) -> Boot:
    return next(b for b in reversed(record.boots) if b.start_ns <= time_ns)


def _events_before(record: Record, time_ns: int, kinds: tuple[str, ...]) -> list[Event]:
    start = _boot_at(record, time_ns).start_ns
    return [e for e in record.events if start <= e.time_ns <= time_ns and e.kind in kinds]


def _mode_story(record: Record, heard: list[Decoded]) -> Iterator[Check]:
    differ = []
    told = [d for d in heard if d.name == "UPB_Status"]
    for d in told:
        changes = _events_before(record, d.time_ns, ("mode",))
        mode = MODES[changes[-1].b] if changes else MODES[0]
        same_time = {MODES[e.a] for e in changes if e.time_ns == d.time_ns}
        if d.signals["Mode"] != mode and d.signals["Mode"] not in same_time:
            differ.append(f"{d.time_ns / NS_PER_MS:.1f} ms: {d.signals['Mode']}, events say {mode}")
    yield _check("mode on CAN = events", not differ, "; ".join(differ[:3]) or f"{len(told)} messages")


def _fault_story(record: Record, heard: list[Decoded]) -> Iterator[Check]:
    """The faults that each UPB_Faults tells are those that events have set and not cleared, to the nanosecond."""
    differ = []
    told = [d for d in heard if d.name == "UPB_Faults"]
    for d in told:
        active: set[str] = set()
        for e in _events_before(record, d.time_ns, ("fault_set", "fault_cleared")):
            (active.add if e.kind == "fault_set" else active.discard)(e.fault)
        same_time = {e.fault for e in record.events if e.time_ns == d.time_ns}
        shown = {name for name, value in d.signals.items() if name.isupper() and value == "YES"}
        if (shown ^ active) - same_time:
            differ.append(f"{d.time_ns / NS_PER_MS:.1f} ms: {sorted(shown)}, events say {sorted(active)}")
    yield _check("faults on CAN = events", not differ, "; ".join(differ[:3]) or f"{len(told)} messages")


def _counter_story(record: Record, heard: list[Decoded]) -> Iterator[Check]:
    """Each counter told is what had happened by then; the last ones told are not above the device's own."""
    differ = []
    told = [d for d in heard if d.name == "UPB_Counters"]
    closed = np.array([r["output_ns"] for r in record.ledger], dtype=np.int64)
    missed = np.array([r["output_ns"] for r in record.ledger if r["verdict"] == "missed"], dtype=np.int64)
    for d in told:
        since = _boot_at(record, d.time_ns).start_ns
        for name, times in (("Frames", closed), ("FramesMissed", missed)):
            if name in d.signals:
                low = int(np.count_nonzero((times >= since) & (times < d.time_ns)))
                high = int(np.count_nonzero((times >= since) & (times <= d.time_ns)))
                if not low <= int(d.signals[name]) <= high:
                    differ.append(f"{d.time_ns / NS_PER_MS:.1f} ms: {name} {d.signals[name]}, ledger says {high}")
    names = {"PacketsIn": "packets_received", "ColumnsIn": "firings_processed", "ModeChanges": "mode_changes"}
    for d in told:
        status = _boot_at(record, d.time_ns).status
        for signal, name in names.items():
            if signal in d.signals and int(d.signals[signal]) > status[name]:
                differ.append(f"{signal} {d.signals[signal]}, {status[name]} at the end")
    yield _check("counters on CAN", not differ, "; ".join(differ[:3]) or f"{len(told)} messages")


# ----------------------------------------------------------------------------------------------- faults, reactions


def _faults(scenario: Scenario, record: Record, timings: list[Timing]) -> Iterator[Check]:
    for expected in scenario.expect.faults:
        yield from _fault(expected, record, timings)
    known = {fault.id for fault in scenario.expect.faults} | set(scenario.expect.allows)
    others = sorted({e.fault for e in record.events if e.kind == "fault_set"} - known)
    yield _timed(record, "no other fault", not others, f"set: {', '.join(others)}" if others else "")


def _fault(expected: ExpectedFault, record: Record, timings: list[Timing]) -> Iterator[Check]:
    own = [e for e in record.events if e.fault == expected.id and e.kind in ("fault_set", "fault_cleared")]
    after, until = expected.after_s * 1e9, expected.until_s * 1e9
    early = [e for e in own if e.kind == "fault_set" and e.time_ns < after]
    yield _timed(record, f"{expected.id} not before its cause", not early, f"{len(early)} times")
    sets = [e.time_ns for e in own if e.kind == "fault_set" and e.time_ns >= after]
    ms = (sets[0] - after) / NS_PER_MS if sets else None
    ends_active = bool(own) and own[-1].kind == "fault_set"
    cleared = [e.time_ns for e in own if e.kind == "fault_cleared"]
    healed = (max(cleared[-1] - until, 0.0) / NS_PER_MS) if cleared and not ends_active else None
    timings.append(Timing(expected.id, expected.within_ms, ms, _reported(expected, record), healed))
    text = "never set" if ms is None else f"set after {ms:.3f} ms"
    yield _check(f"{expected.id} is set", ms is not None, text)
    yield _timed(record, f"{expected.id} within {expected.within_ms:g} ms", (ms or 0.0) <= expected.within_ms, text)
    if expected.heals_ms is None:
        yield _check(f"{expected.id} stays", ends_active, "cleared" if not ends_active else "")
        return
    text = "still set" if healed is None else f"clear after {healed:.3f} ms"
    yield _check(f"{expected.id} heals", healed is not None, text)
    yield _timed(
        record, f"{expected.id} heals within {expected.heals_ms:g} ms", (healed or 0.0) <= expected.heals_ms, text
    )


def _reported(expected: ExpectedFault, record: Record) -> float | None:
    after = expected.after_s * 1e9
    for d in record.heard:
        if d.name == "UPB_Faults" and d.time_ns >= after and d.signals.get(expected.id) == "YES":
            return (d.time_ns - after) / NS_PER_MS
    return None


def _reactions(scenario: Scenario, record: Record, timings: list[Timing]) -> Iterator[Check]:
    for expected in scenario.expect.reactions:
        after = round(expected.after_s * 1e9)
        at = _reaction_ns(expected, record, after)
        ms = None if at is None else (at - after) / NS_PER_MS
        what = f"{expected.does} {expected.to}".strip()
        timings.append(Timing(what, expected.within_ms, ms))
        text = "did not happen" if ms is None else f"after {ms:.3f} ms"
        yield _check(what, ms is not None, text)
        yield _timed(record, f"{what} within {expected.within_ms:g} ms", (ms or 0.0) <= expected.within_ms, text)


_EVENT_OF = {"gap": "gap", "resync": "resync", "swap": "model_swapped", "reject": "model_rejected"}


def _reaction_ns(expected: ExpectedReaction, record: Record, after: int) -> int | None:
    """When the device first did it at or after ``after``; None: never."""
    does, to = expected.does, expected.to
    events = [e for e in record.events if e.time_ns >= after]
    if does in _EVENT_OF:
        return next((e.time_ns for e in events if e.kind == _EVENT_OF[does]), None)
    if does == "repair":
        return next((e.time_ns for e in events if e.kind == "integrity" and e.b), None)
    if does in ("mode", "mode_back"):
        rung = MODES.index(to)
        return next(
            (
                e.time_ns
                for e in events
                if e.kind == "mode" and (e.b >= rung > e.a if does == "mode" else e.b <= rung < e.a)
            ),
            None,
        )
    if does == "drop":
        before = next((drops.get(to, 0) for t, drops in reversed(record.samples) if t < after), 0)
        return next((t for t, drops in record.samples if t >= after and drops.get(to, 0) > before), None)
    if does == "answer":
        return next((t for t, _, answer in record.answers if t >= after and answer.result == to), None)
    if does == "flushed":
        return _flushed_ns(record, after)
    if does == "diagnosis":
        told = (t for t, action, found in record.diagnostics if t >= after and found == to.split() and "read" in action)
        return next(told, None)
    if does == "tester_wrong_crc":
        return next((d.time_ns for d in record.heard if d.time_ns >= after and d.e2e is E2EStatus.WRONG_CRC), None)
    times = record.output_ns
    if does == "output":
        later = times[times >= after]
        return int(later[0]) if len(later) else None
    earlier = times[times < after + expected.within_ms * NS_PER_MS]
    rest = times[(times >= after + expected.within_ms * NS_PER_MS)]
    silent_until = rest[0] if len(rest) else np.iinfo(np.int64).max
    if len(earlier) and silent_until - earlier[-1] > 10 * NS_PER_MS:
        return max(int(earlier[-1]), after)
    return None


def _flushed_ns(record: Record, after: int) -> int | None:
    """When the column of the last firing delivered before ``after`` left."""
    sent = [d for d in record.delivered if d.time_ns < after and is_data(d)]
    if not sent:
        return None
    clock_ns = int(blocks(sent[-1].payload)["tail"]["toh_us"][0]) * 1000
    # Its packet's firings come within a millisecond; the last of them is the last column before the pause.
    left = np.flatnonzero(record.columns["time_ns"].astype(np.int64) % HOUR_NS >= clock_ns)
    times = record.columns["time_ns"][left].astype(np.int64) % HOUR_NS
    before_pause = left[times < clock_ns + NS_PER_MS]
    return int(record.output_ns[record.column_datagram[before_pause[-1]]]) if len(before_pause) else None


# ------------------------------------------------------------------------------------------------------------- end


def _end(scenario: Scenario, record: Record) -> Iterator[Check]:
    status = record.status
    end_ns = round(scenario.seconds * 1e9)
    states = [d for d in record.heard if d.name == "UPB_Status" and d.signals and d.time_ns <= end_ns]
    state = str(states[-1].signals["State"]) if states else "unknown"
    yield _timed(
        record, "state at the end", state == scenario.expect.ends_in, f"{state}, expected {scenario.expect.ends_in}"
    )
    active = set(status["faults"])
    expected = set(scenario.expect.ends_with)
    yield _timed(record, "faults at the end", active == expected, f"active: {', '.join(sorted(active)) or 'none'}")
    for name, (low, high) in scenario.expect.counters.items():
        value = _counter(status, name)
        yield _check(name, low <= value <= high, f"{value}, expected {low:g} to {high:g}")


def _counter(status: dict[str, Any], name: str) -> float:
    """A number of the status; ``packets_dropped.late`` and the like reach into tables."""
    value: Any = status
    for part in name.split("."):
        value = value[int(part)] if isinstance(value, (list, tuple)) else value[part]
    return float(value)
