"""Scenarios: arrange (sensor, device), inject (faults, actions), expect. One TOML file each, see docs/hil.md."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

from upbeam.hw_sim.faults import DeviceFault, Fault, make_fault
from upbeam.hw_sim.sensor import SensorConfig
from upbeam.model.toml_file import read_toml

__all__ = [
    "ACTIONS", "REACTIONS", "Action", "Expectation", "ExpectedFault", "ExpectedReaction", "Scenario", "ScenarioError",
    "load_scenario", "load_scenarios",
]  # fmt: skip

MODES = ("NETWORK", "VALID_MEAN", "REPEAT", "PASS_THROUGH")
"""Rungs of the degradation ladder, best first."""
ACTIONS = {
    "command": "an authentic command: what = status, mode, model or clear_faults",
    "forged_command": "a command with a wrong MAC",
    "replayed_command": "the last authentic command once more, byte for byte",
    "damaged_command": "an authentic command with a wrong E2E checksum",
    "can_frame": "any CAN frame: identifier, data in hexadecimal, fd",
    "serial_bytes": "bytes on the serial line, in hexadecimal",
    "swap_model": "a model file handed to the device (SIGHUP): a shipped model's name, or damaged",
    "uds_read_faults": "diagnostics: the confirmed fault codes, over ISO-TP",
    "uds_clear_faults": "diagnostics: clear all fault codes",
}
REACTIONS = {
    "mode": "the output is made in mode `to`, or a worse one",
    "mode_back": "the output is made in mode `to`, or a better one, again",
    "gap": "firings that never arrived are inserted as no return",
    "resync": "the stream begins anew",
    "repair": "damaged memory is made anew",
    "drop": "packets are dropped for the cause `to`",
    "swap": "another model file is in use",
    "reject": "a model file is refused",
    "answer": "a command is answered with the result `to`",
    "flushed": "all columns of what was received before have left",
    "silence": "nothing leaves any more",
    "output": "columns leave again",
    "diagnosis": "diagnostics read the confirmed fault codes `to`, separated by blanks",
    "tester_wrong_crc": "the receiver of the CAN messages refuses one for its checksum",
}


class ScenarioError(ValueError):
    """A scenario that cannot be: names the file, the key and what was expected."""


@dataclass(frozen=True)
class Action:
    """Something that the tester does."""

    at_s: float
    action: str
    settings: dict[str, Any]


@dataclass(frozen=True)
class ExpectedFault:
    """A fault code that must be set, and heal."""

    id: str
    after_s: float
    """When what it detects begins."""
    within_ms: float
    until_s: float
    """When that ends."""
    heals_ms: float | None
    """None: it stays until the scenario's end."""


@dataclass(frozen=True)
class ExpectedReaction:
    """Something that the device must do."""

    does: str
    after_s: float
    within_ms: float
    to: str = ""


@dataclass(frozen=True)
class Expectation:
    """What must come of it. The rest is expected of every scenario (``judge.py``)."""

    faults: tuple[ExpectedFault, ...] = ()
    reactions: tuple[ExpectedReaction, ...] = ()
    allows: tuple[str, ...] = ()
    """Fault codes that may be set, and need not be."""
    worst_mode: str = "NETWORK"
    ends_in: str = "RUNNING"
    """State of the device at the end."""
    ends_with: tuple[str, ...] = ()
    """Fault codes that are active at the end."""
    counters: dict[str, tuple[float, float]] = field(default_factory=dict)
    """Limits of counters at the end, both included."""
    output_gap_ms: float = 3.0
    """Longest time without an output datagram, outside the spans in ``silent``."""
    silent: tuple[tuple[float, float], ...] = ()
    """Spans in seconds in which nothing need leave."""
    misses: int = 0
    """Frames that may miss their deadline."""


@dataclass(frozen=True)
class Scenario:
    """One test of the device on its bench."""

    name: str
    """The file's name without ``.toml``."""
    title: str
    seconds: float
    sensor: SensorConfig
    source: str
    """"room", or "recording:FILE"."""
    dut: dict[str, Any]
    faults: tuple[Fault, ...]
    actions: tuple[Action, ...]
    expect: Expectation
    covers: tuple[str, ...]
    """Detections and reactions without which the scenario must fail (names of the device's sabotage mask)."""
    real_time: bool
    """Whether it also makes sense on the real clock."""
    seed: int

    @property
    def disturbances(self) -> frozenset[str]:
        """Kinds of device faults in it."""
        return frozenset(m.what for f in self.faults if isinstance(f, DeviceFault) for m in f.moments())


_TOP = {"title", "seconds", "sensor", "dut", "fault", "do", "expect", "covers", "real_time", "seed"}


def load_scenarios(folder: Path, names: Iterable[str] = ()) -> list[Scenario]:
    """The scenarios of a folder in order of their names; of those with ``names``, if any. Errors: ScenarioError."""
    paths = sorted(folder.glob("*.toml"))
    wanted = list(names)
    known = {path.stem for path in paths}
    for name in wanted:
        if name not in known:
            raise ScenarioError(f"{folder}: no scenario {name!r}; known: {', '.join(sorted(known)) or 'none'}")
    if not paths:
        raise ScenarioError(f"{folder}: no scenario (*.toml)")
    return [load_scenario(path) for path in paths if not wanted or path.stem in wanted]


def load_scenario(path: Path) -> Scenario:
    """One scenario. Errors: ScenarioError."""
    try:
        raw = read_toml(path)
    except OSError as error:
        raise ScenarioError(f"{path}: {error.strerror}") from None
    except ValueError as error:
        raise ScenarioError(str(error)) from None
    try:
        return parse_scenario(path.stem, raw)
    except (ValueError, TypeError, KeyError) as error:
        what = f"missing key {error}" if isinstance(error, KeyError) else str(error)
        raise ScenarioError(f"{path}: {what}") from None


def parse_scenario(name: str, raw: dict[str, Any]) -> Scenario:
    """A scenario from its table. Errors: ValueError, KeyError."""
    _known("the scenario", raw, _TOP)
    table = dict(raw.get("sensor", {}))
    source = str(table.pop("source", "room"))
    _known("sensor", table, {f.name for f in fields(SensorConfig)})
    sensor = SensorConfig(**table)
    faults = tuple(make_fault(fault, rate_hz=sensor.rate_hz) for fault in raw.get("fault", []))
    actions = tuple(_action(do) for do in raw.get("do", []))
    expect = _expectation(raw.get("expect", {}), _span(faults, actions))
    covers = [*raw.get("covers", []), *(fault.id.lower() for fault in expect.faults)]
    seconds = float(raw["seconds"])
    if not 0 < seconds <= 3600:
        raise ValueError(f"seconds = {seconds}: expected above 0, at most 3600")
    return Scenario(
        name=name, title=str(raw["title"]), seconds=seconds, sensor=sensor, source=source, dut=dict(raw.get("dut", {})),
        faults=faults, actions=actions, expect=expect, covers=tuple(dict.fromkeys(covers)),
        real_time=bool(raw.get("real_time", False)), seed=int(raw.get("seed", 0)),
    )  # fmt: skip


def _known(where: str, table: dict[str, Any], known: Iterable[str]) -> None:
    unknown = sorted(set(table) - set(known))
    if unknown:
        raise ValueError(f"{where}: unknown key {', '.join(unknown)}; known: {', '.join(sorted(known))}")


def _action(table: dict[str, Any]) -> Action:
    given = dict(table)
    action, at_s = str(given.pop("action")), float(given.pop("at_s"))
    if action not in ACTIONS:
        raise ValueError(f"do: action {action!r}: expected one of {', '.join(ACTIONS)}")
    return Action(at_s, action, given)


def _span(faults: tuple[Fault, ...], actions: tuple[Action, ...]) -> tuple[float, float]:
    """When what is injected begins and ends: what expectations are counted from unless they say otherwise."""
    begins = [fault.from_s for fault in faults] + [action.at_s for action in actions]
    ends = [fault.from_s if getattr(fault, "once", False) else fault.until_s for fault in faults]
    ends += [action.at_s for action in actions]
    return (min(begins), max(ends)) if begins else (0.0, 0.0)


def _expectation(table: dict[str, Any], span: tuple[float, float]) -> Expectation:
    given = dict(table)
    faults = tuple(_expected_fault(one, span) for one in given.pop("fault", []))
    reactions = tuple(_expected_reaction(one, span) for one in given.pop("reaction", []))
    _known("expect", given, {f.name for f in fields(Expectation)} - {"faults", "reactions"})
    for key in ("allows", "ends_with"):
        given[key] = tuple(given.get(key, ()))
    given["silent"] = tuple((float(a), float(b)) for a, b in given.get("silent", ()))
    given["counters"] = {key: _limits(key, value) for key, value in given.get("counters", {}).items()}
    if given.get("worst_mode", MODES[0]) not in MODES:
        raise ValueError(f"expect: worst_mode {given['worst_mode']!r}: expected one of {', '.join(MODES)}")
    return Expectation(faults=faults, reactions=reactions, **given)


def _expected_fault(table: dict[str, Any], span: tuple[float, float]) -> ExpectedFault:
    _known("expect.fault", table, {"id", "after_s", "within_ms", "until_s", "heals_ms", "stays"})
    stays = bool(table.get("stays", False))
    if stays == ("heals_ms" in table):
        raise ValueError(f"expect.fault {table['id']}: expected either heals_ms or stays = true")
    heals = None if stays else float(table["heals_ms"])
    after, until = float(table.get("after_s", span[0])), float(table.get("until_s", span[1]))
    return ExpectedFault(str(table["id"]), after, float(table["within_ms"]), until, heals)


def _expected_reaction(table: dict[str, Any], span: tuple[float, float]) -> ExpectedReaction:
    _known("expect.reaction", table, {"does", "after_s", "within_ms", "to"})
    does = str(table["does"])
    if does not in REACTIONS:
        raise ValueError(f"expect.reaction: does {does!r}: expected one of {', '.join(REACTIONS)}")
    return ExpectedReaction(
        does, float(table.get("after_s", span[0])), float(table["within_ms"]), str(table.get("to", ""))
    )


def _limits(key: str, value: Any) -> tuple[float, float]:
    if isinstance(value, list) and len(value) == 2:
        return float(value[0]), float(value[1])
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        return float(value), float(value)
    raise ValueError(f"expect.counters: {key} = {value!r}: expected a number or [least, most]")
