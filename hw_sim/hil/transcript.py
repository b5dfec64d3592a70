"""What happened on the bench as files: a text to read, BLF for CAN tools, pcap for packet tools, JSON for the rest."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import can

from upbeam.hw_sim.can.pythoncan import to_message
from upbeam.runtime.packets import PcapWriter

from .judge import Verdict
from .record import Record

__all__ = ["EPOCH_S", "transcript_lines", "write_artefacts", "write_blf"]

EPOCH_S = 946_684_800
"""2000-01-01: the bench's time 0 in file formats that know absolute times only."""
_QUIET = frozenset({"E2E_CRC", "E2E_Counter", "E2E_DataIDNibble"})


def transcript_lines(record: Record) -> Iterator[str]:
    """One line for everything but packets, in order of time: milliseconds, who, what. Packets are counted between."""
    entries = [(d.time_ns, 0, "bench", d.what) for d in record.done]
    for e in record.events:
        what = f"{e.kind} {e.fault}".strip()
        entries.append((e.time_ns, 1, "device", f"{what} a={e.a} b={e.b} value={e.value} frame={e.frame}"))
    entries += [(r["output_ns"], 2, "ledger", _pairs(r)) for r in record.ledger]
    for heard in record.heard:
        verdict = "" if heard.e2e is None else f" [{heard.e2e.name}]"
        shown = _pairs({k: v for k, v in heard.signals.items() if k not in _QUIET and v not in ("NO", "NONE")})
        entries.append((heard.time_ns, 3, "CAN", f"{heard.frame.name} {heard.name}{verdict} {shown}"))
    entries += [(t, 4, "serial", f"{frame.name} {frame.data.hex()}") for t, frame in record.serial]
    entries += [(t, 5, "answer", f"on {channel}: {answer}") for t, channel, answer in record.answers]
    entries += [(t, 6, "diagnostics", f"{action}: {found}") for t, action, found in record.diagnostics]
    entries += [(t, 7, "drops", _pairs({k: v for k, v in drops.items() if v})) for t, drops in record.samples]
    entries.sort(key=lambda entry: entry[:2])
    delivered = iter(record.delivered)
    ahead = next(delivered, None)
    for time_ns, _, who, what in entries:
        count = 0
        while ahead is not None and ahead.time_ns <= time_ns:
            count, ahead = count + 1, next(delivered, None)
        if count:
            yield f"{'':>14}  sensor       {count} datagrams"
        yield f"{time_ns / 1e6:14.6f}  {who:<12} {what}"


def _pairs(values: dict[str, object]) -> str:
    return " ".join(f"{key}={value}" for key, value in values.items())


def write_blf(record: Record, path: Path) -> int:
    """The CAN frames as the tester took them off the bus, for CAN tools; how many."""
    with can.Logger(str(path)) as writer:
        if hasattr(writer, "start_timestamp"):
            writer.start_timestamp = float(EPOCH_S)
        for heard in record.heard:
            message = to_message(heard.frame, heard.time_ns, channel=0)
            message.timestamp += EPOCH_S
            writer.on_message_received(message)
    return len(record.heard)


def write_artefacts(record: Record, verdict: Verdict, folder: Path) -> None:
    """Everything needed to look at a run: transcript, CAN, packets in and out, ledger, verdict."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "transcript.txt").write_text("\n".join(transcript_lines(record)) + "\n", encoding="utf-8")
    write_blf(record, folder / "can.blf")
    with PcapWriter(folder / "sensor.pcap") as pcap:
        for datagram in record.delivered:
            pcap.write(datagram.payload, datagram.time_ns + EPOCH_S * 1_000_000_000, datagram.port)
    with (folder / "columns.bin").open("wb") as file:
        for output in record.of_kind("columns"):
            file.write(len(output.payload).to_bytes(2, "little") + output.payload)
    with (folder / "ledger.jsonl").open("w", encoding="utf-8") as text:
        text.writelines(json.dumps(line) + "\n" for line in record.ledger)
    summary = {
        "scenario": verdict.scenario, "dut": record.dut, "passed": verdict.passed,
        "checks": [vars(check) for check in verdict.checks], "timings": [vars(t) for t in verdict.timings],
        "boots": [vars(boot) for boot in record.boots],
    }  # fmt: skip
    (folder / "verdict.json").write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")
