"""Each monitor: set by its fault and nothing else, within its time, healed afterwards; taken out by sabotage."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest
from daemon_feed import MS, Feed, Packet, finish, model_file, position

from upbeam.runtime.daemon import Daemon

Damage = Callable[["Bench"], None]
TURN_MS = 100
SECOND_NS = 10**9


@dataclass
class Bench:
    """Half a second in order, then a fault for as long as ``bad_ms``, then order again."""

    settings: dict[str, Any] = field(default_factory=dict)
    sabotage: tuple[str, ...] = ()
    before_turns: int = 8
    bad_turns: int = 14
    after_turns: int = 20
    packets: list[Packet] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.daemon = Daemon(model_file(), {"service_ns": [100_000] * 4, **self.settings}, sabotage=self.sabotage)
        self.feed = Feed()
        self.packets = self.feed.make(self.before_turns + self.bad_turns + self.after_turns)
        per_turn = self.feed.columns / 12
        self.begin = int(self.before_turns * per_turn)
        self.end = int((self.before_turns + self.bad_turns) * per_turn)
        self.delay = np.full(len(self.packets), 50_000)
        self.positions: dict[int, bytes] = {}

    @property
    def bad(self) -> range:
        return range(self.begin, self.end)

    def edit(self, which: range, change: Callable[[bytearray], None]) -> None:
        for i in which:
            data = bytearray(self.packets[i].data)
            change(data)
            self.packets[i] = replace(self.packets[i], data=bytes(data))

    def play(self) -> list[dict[str, Any]]:
        """Events of the whole run."""
        arrivals = sorted(
            (p.time_ns + int(d), 0, i, p.data) for i, (p, d) in enumerate(zip(self.packets, self.delay, strict=True))
        )
        arrivals = sorted(arrivals + [(self.packets[i].time_ns, 1, i, data) for i, data in self.positions.items()])
        due = arrivals[0][0]
        for now, kind, _, data in arrivals:
            while due <= now:
                self.daemon.tick(due)
                due += 10 * MS
            (self.daemon.position if kind else self.daemon.packet)(data, now)
        return finish(self.daemon, arrivals[-1][0]).events


def blocks(change: Callable[[np.ndarray], None]) -> Callable[[bytearray], None]:
    """An edit of a packet's samples: ``[12, 32]`` of (distance, intensity), in the order of the lasers."""
    kind = np.dtype([("flag", "<u2"), ("azimuth", "<u2"), ("samples", [("distance", "<u2"), ("intensity", "u1")], 32)])

    def edit(data: bytearray) -> None:
        change(np.frombuffer(data, kind, 12)["samples"])

    return edit


def azimuths(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[bytearray], None]:
    kind = np.dtype([("flag", "<u2"), ("azimuth", "<u2"), ("rest", "V96")])

    def edit(data: bytearray) -> None:
        view = np.frombuffer(data, kind, 12)
        view["azimuth"] = change(view["azimuth"].astype(np.int64)) % 36_000

    return edit


def shift_time(data: bytearray, microseconds: int) -> None:
    time = int.from_bytes(data[1200:1204], "little") + microseconds
    data[1200:1204] = (time % 3_600_000_000).to_bytes(4, "little")


def timeout(b: Bench) -> None:
    del b.packets[b.begin : b.end]
    b.delay = b.delay[: len(b.packets)]


def stuck(b: Bench) -> None:
    here = int.from_bytes(b.packets[b.begin].data[2:4], "little")
    b.edit(b.bad, azimuths(lambda a: np.full_like(a, here)))


def azimuth_jump(b: Bench) -> None:
    b.edit(range(b.begin, len(b.packets)), azimuths(lambda a: a + 9_000))


def time_jump(b: Bench) -> None:
    b.edit(range(b.begin, len(b.packets)), lambda data: shift_time(data, 40_000_000))


def time_jump_back(b: Bench) -> None:
    b.edit(range(b.begin, len(b.packets)), lambda data: shift_time(data, -5_000))


def rpm(b: Bench) -> None:
    slow = Feed(rpm=450, start_ns=b.packets[b.begin].time_ns, start_deg=0)
    rest = Feed(start_ns=slow.make(10)[-1].time_ns, start_deg=0)
    b.packets[b.begin :] = slow.make(10) + rest.make(20)
    b.delay = np.full(len(b.packets), 50_000)


def dead_beam(b: Bench) -> None:
    def kill(samples: np.ndarray) -> None:
        samples["distance"][:, 5] = 0

    b.edit(b.bad, blocks(kill))


def stuck_ring(b: Bench) -> None:
    def freeze(samples: np.ndarray) -> None:
        samples["distance"][:, 9] = 4321

    b.edit(b.bad, blocks(freeze))


def all_zero(b: Bench) -> None:
    def clear(samples: np.ndarray) -> None:
        samples["distance"] = 0

    b.edit(b.bad, blocks(clear))


def fog(b: Bench) -> None:
    rng = np.random.default_rng(4)

    def thin(samples: np.ndarray) -> None:
        gone = rng.random(samples["distance"].shape) < 0.5
        samples["distance"][gone] = 0

    b.edit(b.bad, blocks(thin))


def backscatter(b: Bench) -> None:
    rng = np.random.default_rng(5)

    def near(samples: np.ndarray) -> None:
        hit = rng.random(samples["distance"].shape) < 0.25
        samples["distance"][hit] = rng.integers(500, 1500, np.count_nonzero(hit))

    b.edit(b.bad, blocks(near))


def crosstalk(b: Bench) -> None:
    rng = np.random.default_rng(6)

    def hit(samples: np.ndarray) -> None:
        alone = rng.random(samples["distance"].shape) < 0.03
        samples["distance"][alone] = rng.integers(20_000, 60_000, np.count_nonzero(alone))

    b.edit(b.bad, blocks(hit))


def positions(**bad: Any) -> Damage:
    def damage(b: Bench) -> None:
        for i in range(0, len(b.packets), 40):
            fields = bad if i in b.bad else {}
            b.positions[i] = position(b.packets[i].time_ns, **fields)

    return damage


def wrong_model(b: Bench) -> None:
    for i in list(b.bad)[::7]:
        data = bytearray(b.packets[i].data)
        data[1205] = 0x28
        b.packets.append(Packet(b.packets[i].time_ns, bytes(data)))
    b.delay = np.full(len(b.packets), 50_000)


def loss(b: Bench) -> None:
    rng = np.random.default_rng(7)
    kept = [p for i, p in enumerate(b.packets) if i not in b.bad or rng.random() > 0.05]
    b.packets = kept
    b.delay = b.delay[: len(kept)]


def reorder(b: Bench) -> None:
    for i in list(b.bad)[::20]:
        b.delay[i] += 1_500_000


def duplicate(b: Bench) -> None:
    b.packets += [replace(b.packets[i]) for i in list(b.bad)[::11]]
    b.delay = np.full(len(b.packets), 50_000)


def malformed(b: Bench) -> None:
    b.packets += [Packet(b.packets[i].time_ns, b.packets[i].data[:1000]) for i in list(b.bad)[::30]]
    b.delay = np.full(len(b.packets), 50_000)


def flood(b: Bench) -> None:
    for i in b.bad:
        b.packets += [Packet(b.packets[i].time_ns, bytes(1206))] * 5
    b.delay = np.full(len(b.packets), 50_000)


def jitter(b: Bench) -> None:
    for i in list(b.bad)[::50]:
        b.delay[i:] = np.maximum(b.delay[i:], 50_000)
        b.delay[i] = 8 * MS
        late = b.packets[i].time_ns + b.delay[i]
        for k in range(i + 1, min(i + 40, len(b.packets))):
            b.delay[k] = max(50_000, late - b.packets[k].time_ns)


def drift(b: Bench) -> None:
    origin = b.packets[b.begin].time_ns
    for i in range(b.begin, len(b.packets)):
        b.delay[i] += int((min(b.packets[i].time_ns, b.packets[b.end].time_ns) - origin) * 500e-6)


@dataclass(frozen=True)
class Case:
    fault: str
    damage: Damage
    detect_ms: int
    """Within this after the fault begins."""
    beside: frozenset[str] = frozenset()
    """Other faults that the same damage rightly sets."""
    settings: tuple[tuple[str, Any], ...] = ()
    turns: tuple[int, int, int] = (8, 14, 20)


CASES = {
    "timeout": Case("SENSOR_TIMEOUT", timeout, 70),
    "stuck": Case("SENSOR_AZIMUTH_STUCK", stuck, 260),
    "azimuth_jump": Case("SENSOR_AZIMUTH_JUMP", azimuth_jump, 5),
    "time_jump": Case("SENSOR_TIME_JUMP", time_jump, 5),
    "time_jump_back": Case("SENSOR_TIME_JUMP", time_jump_back, 5, beside=frozenset({"NET_REORDER"})),
    "rpm": Case("SENSOR_RPM_RANGE", rpm, 500, settings=(("rpm", 600),), beside=frozenset({"SENSOR_AZIMUTH_JUMP"})),
    "dead_beam": Case("SENSOR_BEAM_DEAD", dead_beam, 500),
    "stuck_ring": Case("SENSOR_RING_STUCK", stuck_ring, 500),
    "all_zero": Case("SENSOR_ALL_ZERO", all_zero, 400),
    "fog": Case("SENSOR_VISIBILITY", fog, 1100),
    "backscatter": Case("SENSOR_VISIBILITY", backscatter, 1100, beside=frozenset({"SENSOR_CROSSTALK"})),
    "crosstalk": Case("SENSOR_CROSSTALK", crosstalk, 1100, beside=frozenset({"SENSOR_VISIBILITY"})),
    "thermal": Case("SENSOR_THERMAL", positions(thermal_shutdown=1), 220),
    "pps": Case("SENSOR_PPS_LOST", positions(pps=0), 1100),
    "wrong_model": Case("SENSOR_WRONG_MODEL", wrong_model, 220),
    "loss": Case("NET_LOSS", loss, 450),
    "reorder": Case("NET_REORDER", reorder, 450, beside=frozenset({"NET_LOSS"})),
    "duplicate": Case("NET_DUPLICATE", duplicate, 450),
    "malformed": Case("NET_MALFORMED", malformed, 350),
    "flood": Case("NET_FLOOD", flood, 15, beside=frozenset({"NET_MALFORMED"})),
    "jitter": Case("NET_JITTER", jitter, 450),
    "drift": Case("CLOCK_DRIFT", drift, 5500, turns=(12, 70, 110)),
}


def bench_of(case: Case, *sabotage: str) -> Bench:
    before, bad, after = case.turns
    bench = Bench(dict(case.settings), tuple(sabotage), before, bad, after)
    case.damage(bench)
    return bench


def faults(events: list[dict[str, Any]], kind: str = "fault_set") -> dict[str, int]:
    """First time of each."""
    found: dict[str, int] = {}
    for event in events:
        if event["kind"] == kind:
            found.setdefault(event["fault"], event["time_ns"])
    return found


@pytest.mark.parametrize("name", CASES)
def test_fault_is_found_in_time_and_heals(name: str) -> None:
    case = CASES[name]
    bench = bench_of(case)
    begun = Feed().make(case.turns[0])[-1].time_ns
    events = bench.play()
    found = faults(events)
    assert case.fault in found, f"not found; set were {sorted(found)}"
    assert begun <= found[case.fault] <= begun + case.detect_ms * MS, (found[case.fault] - begun) / MS
    assert set(found) - {case.fault} <= case.beside
    assert bench.daemon.faults == [], "healthy again at the end"
    counters = bench.daemon.counters
    assert counters["packets_received"] == counters["packets_processed"] + sum(counters["packets_dropped"].values())
    assert counters["columns_out"] == counters["firings_processed"] + counters["firings_inserted"]


@pytest.mark.parametrize("name", CASES)
def test_sabotage_blinds_the_monitor(name: str) -> None:
    case = CASES[name]
    assert case.fault not in faults(bench_of(case, case.fault.lower()).play())


def test_order_sets_nothing() -> None:
    bench = Bench(before_turns=5, bad_turns=20, after_turns=5, settings={"rpm": 600})
    for i in range(0, len(bench.packets), 40):
        bench.positions[i] = position(bench.packets[i].time_ns)
    assert faults(bench.play()) == {}
    assert bench.daemon.counters["events"] == 2, "the stream was made, and ended"
