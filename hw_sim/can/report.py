"""Bus load and worst-case response time of the device's messages: ``python -m upbeam.hw_sim.can.report``.

Modelled figures (frame lengths, utilisation, bounds) beside simulated ones: the bus simulated from its critical
instants, from random phases, and with random payloads.
"""

from __future__ import annotations

import argparse
import json
import random
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace

from . import analysis
from .bus import NS_PER_S, SimulatedBus, bit_time_ns
from .database import NS_PER_MS, Traffic, message_set
from .frame import CanFrame


@dataclass(frozen=True, slots=True)
class Line:
    """One message of a report. Times in microseconds."""

    name: str
    identifier: str
    format: str
    payload_bytes: int
    period_ms: float
    bits_shortest: int
    bits_longest: int
    bits_bound: int
    longest_us: float
    response_bound_us: float | None
    """Worst case from queuing to the end of the frame: the jitter of the queuing itself is left out."""
    response_classical_us: float | None
    """The same with the classical bound for frame lengths."""
    simulated_us: float
    schedulable: bool


@dataclass(frozen=True, slots=True)
class Report:
    """One bus with one message set."""

    title: str
    utilisation: float
    """Modelled: longest frames at their shortest periods."""
    simulated_load: float
    """Simulated, random payloads, same periods."""
    lines: list[Line]


def simulate(
    messages: Sequence[analysis.Message],
    nominal: int,
    data: int | None,
    *,
    seconds: float = 2.0,
    seed: int = 1,
    runs: int = 4,
) -> tuple[dict[str, int], float]:
    """Longest response time seen, ns from queuing to the end of the frame, per message; and the highest load.

    Run 0 queues all at once, just after the longest frame began (the critical instant); the others start at random
    phases. Queuing jitter and payloads are random.
    """
    longest: dict[str, int] = {m.name: 0 for m in messages}
    load = 0.0
    for run in range(runs):
        rng = random.Random(f"{seed} {run}")
        bus = SimulatedBus(nominal, data)
        end = round(seconds * NS_PER_S)
        _queue_all(bus, messages, rng, end, critical=run == 0)
        bus.advance_to(end)
        names = {(m.frame.identifier, m.frame.extended): m.name for m in messages}
        for sent in bus.transmissions:
            name = names[sent.frame.identifier, sent.frame.extended]
            longest[name] = max(longest[name], sent.response_ns)
        load = max(load, bus.load(0, end))
    return longest, load


def _queue_all(
    bus: SimulatedBus, messages: Sequence[analysis.Message], rng: random.Random, end: int, *, critical: bool
) -> None:
    nodes = {sender: bus.node(sender, capacity=1000) for sender in sorted({m.sender or "node" for m in messages})}
    if len(nodes) == 1:
        bus.node("listener")
    blocking = max(messages, key=lambda m: (len(m.frame.data), m.frame.identifier)).name
    for message in messages:
        phase = 0 if critical else rng.randrange(message.period_ns)
        start = phase if message.name == blocking or not critical else phase + 1
        first = True
        for due in range(start, end, message.period_ns):
            late = 0 if critical and first else rng.randrange(message.jitter_ns + 1)
            first = False
            if due + late < end:
                frame = replace(message.frame, data=rng.randbytes(len(message.frame.data)))
                nodes[message.sender or "node"].send(frame, due + late)


def _format(frame: CanFrame) -> str:
    if not frame.fd:
        return "classic"
    return "FD, rate switch" if frame.bit_rate_switch else "FD"


def build(
    title: str, messages: Sequence[analysis.Message], nominal: int, data: int | None, *, seconds: float, seed: int
) -> Report:
    """Everything about one bus."""
    rates = analysis.BusRates(bit_time_ns(nominal), bit_time_ns(data or nominal))
    exact = {r.message.name: r for r in analysis.response_times(messages, rates)}
    classical = {r.message.name: r for r in analysis.response_times(messages, rates, exact=False)}
    longest, load = simulate(messages, nominal, data, seconds=seconds, seed=seed)
    lines = [_line(m, exact[m.name], classical[m.name], longest[m.name]) for m in messages]
    return Report(title, analysis.utilisation(messages, rates), load, lines)


def _line(
    message: analysis.Message, exact: analysis.ResponseTime, classical: analysis.ResponseTime, simulated_ns: int
) -> Line:
    def queued_us(result: analysis.ResponseTime) -> float | None:
        return None if result.response_ns is None else (result.response_ns - message.jitter_ns) / 1000

    return Line(
        name=message.name,
        identifier=message.frame.name,
        format=_format(message.frame),
        payload_bytes=len(message.frame.data),
        period_ms=message.period_ns / NS_PER_MS,
        bits_shortest=analysis.shortest_length(message.frame).bits,
        bits_longest=analysis.longest_length(message.frame).bits,
        bits_bound=analysis.bound_length(message.frame).bits,
        longest_us=exact.longest_ns / 1000,
        response_bound_us=queued_us(exact),
        response_classical_us=queued_us(classical),
        simulated_us=simulated_ns / 1000,
        schedulable=exact.schedulable,
    )


def text(report: Report) -> str:
    """The report as a Markdown table."""
    head = (
        f"**{report.title}**: modelled utilisation {report.utilisation:.1%}, "
        f"simulated load at most {report.simulated_load:.1%}\n\n"
        "| message | id | format | bytes | period ms | bits shortest / longest / bound | longest us | "
        "worst response us (exact lengths) | (classical lengths) | longest simulated us |\n"
        "| --- | --- | --- | --: | --: | --: | --: | --: | --: | --: |\n"
    )
    return head + "\n".join(_row(line) for line in report.lines)


def _row(line: Line) -> str:
    def number(value: float | None) -> str:
        return "not bounded" if value is None else f"{value:.1f}"

    late = "" if line.schedulable else " (deadline missed)"
    bits = f"{line.bits_shortest} / {line.bits_longest} / {line.bits_bound}"
    cells = (
        *(line.name, line.identifier, line.format, line.payload_bytes, f"{line.period_ms:g}", bits),
        *(number(line.longest_us), number(line.response_bound_us) + late, number(line.response_classical_us)),
        number(line.simulated_us),
    )
    return "| " + " | ".join(map(str, cells)) + " |"


def reports(traffic: Traffic, nominal: int, data: int, *, seconds: float, seed: int) -> list[Report]:
    """Status on a classic bus; everything on an FD bus, without and with bit rate switch."""
    kilo, mega = nominal / 1e3, data / 1e6
    sets: tuple[tuple[str, dict[str, bool], int | None], ...] = (
        (f"classic CAN {kilo:g} kbit/s, classic messages only", {"classic_only": True}, None),
        (f"CAN FD {kilo:g} kbit/s without bit rate switch, all messages", {"switch_bit_rate": False}, None),
        (f"CAN FD {kilo:g} kbit/s and {mega:g} Mbit/s, all messages", {}, data),
    )
    out = []
    for title, options, rate in sets:
        messages = message_set(
            classic_only=options.get("classic_only", False),
            switch_bit_rate=options.get("switch_bit_rate", True),
            traffic=traffic,
        )
        out.append(build(title, messages, nominal, rate, seconds=seconds, seed=seed))
    return out


def main(argv: list[str] | None = None) -> int:
    """Command line; exit status 1 if a message can miss its deadline."""
    parser = argparse.ArgumentParser(prog="python -m upbeam.hw_sim.can.report", description=__doc__)
    parser.add_argument("--nominal", type=int, default=500_000, help="nominal bit rate, bit/s (default 500000)")
    parser.add_argument("--data", type=int, default=2_000_000, help="data bit rate, bit/s (default 2000000)")
    parser.add_argument("--jitter-ms", type=float, default=10.0, help="queuing jitter of the device (default 10)")
    parser.add_argument("--rate", type=float, default=20.0, help="sensor turns per second (default 20)")
    parser.add_argument("--seconds", type=float, default=2.0, help="simulated time of each of four runs (default 2)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", action="store_true", help="one JSON object on standard output")
    arguments = parser.parse_args(argv)
    traffic = Traffic(
        frame_period_ns=round(NS_PER_S / arguments.rate), jitter_ns=round(arguments.jitter_ms * NS_PER_MS)
    )
    try:
        found = reports(traffic, arguments.nominal, arguments.data, seconds=arguments.seconds, seed=arguments.seed)
    except ValueError as error:
        print(f"report: {error}", file=sys.stderr)
        return 2
    if arguments.json:
        print(json.dumps({"traffic": asdict(traffic), "buses": [asdict(r) for r in found]}))
    else:
        print("\n\n".join(text(report) for report in found))
    return 0 if all(line.schedulable for report in found for line in report.lines) else 1


if __name__ == "__main__":
    raise SystemExit(main())
