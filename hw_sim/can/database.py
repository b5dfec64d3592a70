"""The device's messages as ``upbeam.dbc`` describes them: read, packed, decoded, checked, and as a message set."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import cast

import cantools.database
from cantools.database.can import Database
from cantools.database.can import Message as DbcMessage
from cantools.database.namedsignalvalue import NamedSignalValue

from . import analysis
from .e2e import E2EConfig, E2EStatus, Profile, Profile05, Profile11, Receiver
from .frame import CanFrame

DBC_FILE = Path(__file__).with_name("upbeam.dbc")
NS_PER_MS = 1_000_000
STATUS_IDS = range(0x210, 0x216)
LEDGER_ID = 0x220
COMMAND_ID = 0x300
RESPONSE_ID = 0x301
UDS_REQUEST_ID = 0x7A0
UDS_RESPONSE_ID = 0x7A8
UDS_FUNCTIONAL_ID = 0x7DF

Value = int | float | str
"""A signal: number, or the name that its value table gives it."""


@lru_cache(maxsize=4)
def load(path: Path = DBC_FILE) -> Database:
    """The message database."""
    database = cantools.database.load_file(str(path))
    if not isinstance(database, Database):
        raise ValueError(f"{path} is no CAN database")
    return database


def _attribute(message: DbcMessage, name: str) -> str | int:
    attributes = message.dbc.attributes if message.dbc is not None else {}
    if name in attributes:
        return cast("str | int", attributes[name].value)
    specifics = load().dbc
    assert specifics is not None  # of a DBC file
    return cast("str | int", specifics.attribute_definitions[name].default_value)


def profile(message: DbcMessage) -> Profile | None:
    """End-to-end protection of a message, None if it has none. :raises ValueError: a profile that we do not know."""
    name = str(_attribute(message, "E2E_Profile"))
    if name in ("none", ""):
        return None
    config = E2EConfig(
        int(_attribute(message, "E2E_DataID")), message.length, int(_attribute(message, "E2E_MaxDeltaCounter"))
    )
    if name == "11C":
        return Profile11(config)
    if name == "05":
        return Profile05(config)
    raise ValueError(f"{message.name}: E2E profile {name!r}")


def switches_bit_rate(message: DbcMessage) -> bool:
    """Whether an FD message uses the data bit rate."""
    return message.is_fd and str(_attribute(message, "CANFD_BRS")) == "1"


def frame_of(message: DbcMessage, data: bytes) -> CanFrame:
    """A frame of this message."""
    return CanFrame(message.frame_id, data, message.is_extended_frame, message.is_fd, switches_bit_rate(message))


def pack(name: str, signals: dict[str, Value], counter: int = 0) -> CanFrame:
    """A frame of the named message; the E2E header, if it has one, is filled in with ``counter``."""
    message = load().get_message_by_name(name)
    protection = profile(message)
    header = {signal.name: 0 for signal in message.signals if signal.name.startswith("E2E_")}
    data = message.encode({**header, **signals}, padding=False)
    return frame_of(message, protection.protect(data, counter) if protection else data)


@dataclass(frozen=True, slots=True)
class Decoded:
    """One frame understood: message name, its signals, verdict of the end-to-end check (None: unprotected)."""

    time_ns: int
    name: str
    frame: CanFrame
    signals: dict[str, Value] = field(default_factory=dict)
    e2e: E2EStatus | None = None

    @property
    def usable(self) -> bool:
        """Whether the signals may be used: authentic length, CRC and a counter that went on."""
        return self.e2e in (None, E2EStatus.OK, E2EStatus.OK_SOME_LOST)


class Decoder:
    """Decodes frames of the device and keeps the E2E receiver of every message.

    ``unknown`` counts frames whose identifier the database does not have, ``verdicts[name]`` the E2E verdicts.
    """

    def __init__(self) -> None:
        self._messages = {(m.frame_id, m.is_extended_frame): m for m in load().messages}
        self._receivers: dict[str, Receiver] = {}
        for message in load().messages:
            protection = profile(message)
            if protection is not None:
                self._receivers[message.name] = Receiver(protection)
        self._started: set[str] = set()
        self.unknown = 0
        self.verdicts: dict[str, dict[E2EStatus, int]] = {}

    def decode(self, frame: CanFrame, time_ns: int = 0) -> Decoded | None:
        """Signals and verdict; None for an identifier that is not in the database, which is counted.

        A message whose length or CRC is wrong has no signals. The first message of a sender whose counter is
        not 0 (we joined late) counts as :attr:`E2EStatus.WRONG_SEQUENCE`, as AUTOSAR has it.
        """
        message = self._messages.get((frame.identifier, frame.extended))
        if message is None:
            self.unknown += 1
            return None
        receiver = self._receivers.get(message.name)
        verdict = receiver.check(frame.data) if receiver else None
        if verdict is not None:
            counts = self.verdicts.setdefault(message.name, {})
            counts[verdict] = counts.get(verdict, 0) + 1
        if verdict is E2EStatus.WRONG_CRC or len(frame.data) != message.length or not message.signals:
            return Decoded(time_ns, message.name, frame, {}, verdict)
        return Decoded(time_ns, message.name, frame, signals_of(message, frame.data), verdict)


def signals_of(message: DbcMessage, data: bytes) -> dict[str, Value]:
    """Signals of a message's bytes, by the names of the value tables where they have one."""
    decoded = cast("dict[str, object]", message.decode(data, decode_choices=True))
    return {n: str(v) if isinstance(v, NamedSignalValue) else cast("Value", v) for n, v in decoded.items()}


# ------------------------------------------------------------------------------- as a message set


@dataclass(frozen=True, slots=True)
class Traffic:
    """What the database does not say: how often event messages come, and how late messages may be queued."""

    frame_period_ns: int = 50 * NS_PER_MS
    """Between two ledger records: the sensor's turn, 20 Hz."""
    command_period_ns: int = 100 * NS_PER_MS
    """Least time between two commands, and between two answers."""
    uds_period_ns: int = 5 * NS_PER_MS
    """Least time between two diagnostic frames of one sender."""
    jitter_ns: int = 10 * NS_PER_MS
    """Release jitter of the device's messages: upb_bus_step is called every 10 ms or more often."""
    tester_jitter_ns: int = 1 * NS_PER_MS
    uds_deadline_ns: int = 50 * NS_PER_MS
    """Of diagnostic frames: P2 of ISO 14229-2. Cyclic and event messages are due within their period."""

    def deadline_ns(self, message: DbcMessage) -> int:
        """Time from due to received that is asked for."""
        is_uds = message.frame_id in (UDS_REQUEST_ID, UDS_RESPONSE_ID, UDS_FUNCTIONAL_ID)
        return self.uds_deadline_ns if is_uds else self.period_ns(message)

    def period_ns(self, message: DbcMessage) -> int:
        """Least time between two frames of a message."""
        cycle = int(_attribute(message, "GenMsgCycleTime"))
        if cycle:
            return cycle * NS_PER_MS
        if message.frame_id == LEDGER_ID:
            return self.frame_period_ns
        return self.command_period_ns if message.frame_id in (COMMAND_ID, RESPONSE_ID) else self.uds_period_ns


def message_set(
    *, classic_only: bool = False, switch_bit_rate: bool = True, traffic: Traffic | None = None
) -> list[analysis.Message]:
    """The database's messages as the response-time analysis takes them.

    ``classic_only`` leaves the CAN FD ones out (a classic bus cannot carry them); without ``switch_bit_rate`` FD
    frames stay at the nominal bit rate. The payload of each frame is zeros: only its length is used.
    """
    traffic = traffic or Traffic()
    out = []
    for message in load().messages:
        if classic_only and message.is_fd:
            continue
        switch = switch_bit_rate and switches_bit_rate(message)
        frame = CanFrame(message.frame_id, bytes(message.length), message.is_extended_frame, message.is_fd, switch)
        sender = message.senders[0] if message.senders else ""
        jitter = traffic.jitter_ns if sender == "UPBEAM" else traffic.tester_jitter_ns
        period, deadline = traffic.period_ns(message), traffic.deadline_ns(message)
        out.append(analysis.Message(message.name, frame, period, jitter, deadline, sender))
    return sorted(out, key=lambda m: m.frame.identifier)
