"""Worst-case response times: the simulated bus never exceeds the bound, and reaches it at critical instants."""

from __future__ import annotations

import random
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from upbeam.hw_sim.can import analysis
from upbeam.hw_sim.can.analysis import BusRates, Message, length_of, longest_length, longest_payload, response_times
from upbeam.hw_sim.can.bus import SimulatedBus
from upbeam.hw_sim.can.frame import CanFrame

BIT = 2000
RATES = BusRates(BIT, 500)
MS = 1_000_000
INTERMISSION = 3 * BIT


def bounds(messages: list[Message], **options: object) -> dict[str, int | None]:
    return {r.message.name: r.response_ns for r in response_times(messages, RATES, **options)}  # type: ignore[arg-type]


def with_length(monkeypatch: pytest.MonkeyPatch, bits: int) -> None:
    """Every frame takes ``bits`` bits: worked examples count in frames."""
    monkeypatch.setattr(analysis, "transmission_ns", lambda frame, rates, exact=True: bits * rates.nominal_bit_ns)


def test_the_papers_example_of_the_second_instance(monkeypatch: pytest.MonkeyPatch) -> None:
    """Davis et al. 2007, table 1: three messages of 125 bits at 125 kbit/s (1 ms each), periods 2.5, 3.5, 3.5 ms.

    The old analysis gave C a response of 3 ms, which its period of 3.25 ms (its deadline) allowed; its second
    instance takes 3.5 ms.
    """
    with_length(monkeypatch, 125)
    period = {"A": 2.5, "B": 3.5, "C": 3.5}
    deadline = {"A": 2.5, "B": 3.25, "C": 3.25}
    messages = [
        Message(n, CanFrame(i + 1, bytes(7)), round(period[n] * MS), 0, round(deadline[n] * MS))
        for i, n in enumerate("ABC")
    ]
    found = {r.message.name: r for r in response_times(messages, BusRates(8000, 8000))}
    assert {n: r.response_ns for n, r in found.items()} == {"A": 2 * MS, "B": 3 * MS, "C": round(3.5 * MS)}
    assert found["C"].instances == 2
    assert [r.schedulable for r in found.values()] == [True, True, False]


def test_blocking_and_jitter_enter_as_they_should(monkeypatch: pytest.MonkeyPatch) -> None:
    with_length(monkeypatch, 100)
    frame_ns = 100 * BIT
    one = Message("one", CanFrame(1), 50 * MS)
    two = Message("two", CanFrame(2), 50 * MS)
    assert bounds([one]) == {"one": frame_ns}
    assert bounds([one, two]) == {"one": 2 * frame_ns, "two": 2 * frame_ns}
    late = replace(one, jitter_ns=7 * MS)
    assert bounds([late, two]) == {"one": 2 * frame_ns + 7 * MS, "two": 2 * frame_ns}
    twice = replace(one, jitter_ns=50 * MS)  # two of them may come at once
    assert bounds([twice, two])["two"] == 3 * frame_ns


def test_an_overloaded_bus_has_no_bound() -> None:
    messages = [Message(f"m{i}", CanFrame(i, bytes(8)), MS) for i in range(5)]
    found = response_times(messages, RATES)
    assert [r.response_ns is None for r in found] == [False, False, False, True, True]
    assert not found[-1].schedulable
    with pytest.raises(ValueError, match="same identifier"):
        response_times([messages[0], replace(messages[0], name="again")], RATES)


@pytest.mark.parametrize("identifier", [0x210, 0x7A0, 0x000])
def test_longest_payload_reaches_the_longest_length(identifier: int) -> None:
    frame = CanFrame(identifier, bytes(8))
    worst = replace(frame, data=longest_payload(frame))
    assert length_of(worst) == longest_length(frame)


@st.composite
def message_sets(draw: st.DrawFn) -> list[Message]:
    count = draw(st.integers(2, 6))
    identifiers = draw(st.lists(st.sampled_from(range(0, 0x7FF, 0x50)), min_size=count, max_size=count, unique=True))
    messages = []
    for identifier in identifiers:
        fd = draw(st.booleans())
        size = draw(st.sampled_from([0, 8, 16, 64] if fd else [0, 2, 8]))
        period = draw(st.sampled_from([2, 3, 5, 10])) * MS
        jitter = draw(st.sampled_from([0, MS // 2, 4 * MS]))
        frame = CanFrame(identifier, bytes(size), fd=fd, bit_rate_switch=fd)
        messages.append(Message(f"m{identifier:x}", frame, period, jitter))
    return messages


def simulate(
    messages: list[Message], rng: random.Random, end: int, *, error_interval: int | None = None
) -> dict[str, int]:
    """Longest response, from due to the end of the frame, of every message: random phases, jitter and payloads."""
    bus = SimulatedBus()
    listener = bus.node("listener")
    nodes = [bus.node(f"n{i}", capacity=1000) for i in range(2)]
    due: dict[tuple[str, int], int] = {}
    for message in messages:
        node = rng.choice(nodes)
        at_once = rng.random() < 0.5
        phase = 0 if at_once else rng.randrange(message.period_ns)
        for time_ns in range(phase, end, message.period_ns):
            late = 0 if message.jitter_ns == 0 else rng.choice([0, message.jitter_ns, rng.randrange(message.jitter_ns)])
            data = rng.choice([bytes(len(message.frame.data)), rng.randbytes(len(message.frame.data))])
            node.send(replace(message.frame, data=data), time_ns + late)
            due.setdefault((message.name, len([k for k in due if k[0] == message.name])), time_ns)
    if error_interval is not None:
        for time_ns in range(0, end, error_interval):
            bus.call_at(time_ns, lambda: bus.flip_bit(rng.randrange(20, 45)))
    bus.advance_to(end + 100 * MS)
    longest = {m.name: 0 for m in messages}
    seen = {m.name: 0 for m in messages}
    names = {m.frame.identifier: m for m in messages}
    for sent in sorted(bus.transmissions, key=lambda t: t.end_ns):
        message = names[sent.frame.identifier]
        first_due = due[message.name, seen[message.name]]
        seen[message.name] += 1
        longest[message.name] = max(longest[message.name], sent.end_ns - first_due)
    assert len(bus.transmissions) == len(due)
    assert listener.received
    return longest


@settings(max_examples=25, deadline=None)
@given(message_sets(), st.integers(0, 2**32))
def test_no_simulated_response_exceeds_the_bound(messages: list[Message], seed: int) -> None:
    found = bounds(messages)
    longest = simulate(messages, random.Random(seed), 60 * MS)
    classical = bounds(messages, exact=False)
    for name, bound in found.items():
        if bound is None:
            assert classical[name] is None
            continue
        assert longest[name] <= bound - INTERMISSION
        assert classical[name] is None or bound <= classical[name]  # type: ignore[operator]


@settings(max_examples=10, deadline=None)
@given(message_sets(), st.integers(0, 2**32))
def test_nor_with_errors_that_come_no_more_often_than_stated(messages: list[Message], seed: int) -> None:
    interval = 20 * MS
    found = bounds(messages, error_interval_ns=interval)
    longest = simulate(messages, random.Random(seed), 60 * MS, error_interval=interval)
    for name, bound in found.items():
        assert bound is None or longest[name] <= bound - INTERMISSION


def test_the_bound_is_reached_at_the_critical_instant() -> None:
    """The longest frame of lower priority has just begun when all others are queued, each with its worst payload."""
    identifiers = [0x210, 0x211, 0x212, 0x213, 0x7A0]
    frames = [replace(f, data=longest_payload(f)) for f in (CanFrame(i, bytes(8)) for i in identifiers)]
    messages = [Message(f.name, f, 50 * MS) for f in frames]
    bound = bounds(messages)
    for index in range(len(frames) - 1):
        bus = SimulatedBus()
        node, _ = bus.node("a"), bus.node("b")
        below = max(frames[index + 1 :], key=lambda f: length_of(f).bits)
        node.send(below, 0)
        for frame in frames:
            if frame is not below:
                node.send(frame, 1)
        bus.advance_to(40 * MS)
        (sent,) = [t for t in bus.transmissions if t.frame is frames[index]]
        expected = bound[frames[index].name]
        assert expected is not None
        assert sent.response_ns == expected - INTERMISSION - 1  # queued 1 ns after the blocking frame began
