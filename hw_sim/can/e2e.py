"""AUTOSAR end-to-end protection (FO PRS_E2EProtocol): Profiles 11 and 5 and the receiver's state machine.

Written from the standard, apart from the C of the runtime, so that each checks the other.
"""

from __future__ import annotations

import enum
from abc import ABC, abstractmethod
from dataclasses import dataclass

from .checksum import crc8, crc16


class E2EStatus(enum.IntEnum):
    """Verdict on one message; numbers as in ``upbeam/e2e.h``."""

    OK = 0
    OK_SOME_LOST = 1
    WRONG_CRC = 2
    REPEATED = 3
    WRONG_SEQUENCE = 4
    NO_NEW_DATA = 5


class E2EState(enum.IntEnum):
    """What may be done with the messages; numbers as in ``upbeam/e2e.h``."""

    NODATA = 0
    INIT = 1
    VALID = 2
    INVALID = 3


@dataclass(frozen=True, slots=True)
class E2EConfig:
    """Data id, length in bytes (header included) and how far the counter may go on between two messages."""

    data_id: int
    length: int
    max_delta_counter: int = 2


class Profile(ABC):
    """One profile with one configuration: no state."""

    counters: int
    header_bytes: int

    def __init__(self, config: E2EConfig) -> None:
        if config.length < self.header_bytes:
            raise ValueError(f"{config.length} bytes, the header alone takes {self.header_bytes}")
        self.config = config

    @abstractmethod
    def protect(self, data: bytes, counter: int) -> bytes:
        """``data`` with its header filled in. :raises ValueError: wrong length or counter."""

    @abstractmethod
    def counter_of(self, data: bytes) -> int | None:
        """Counter of a message, None if length, data id or CRC is wrong."""

    def _checked(self, data: bytes, counter: int) -> bytearray:
        if len(data) != self.config.length:
            raise ValueError(f"{len(data)} bytes, the message has {self.config.length}")
        if not 0 <= counter < self.counters:
            raise ValueError(f"counter {counter}, it runs from 0 to {self.counters - 1}")
        return bytearray(data)


class Profile11(Profile):
    """Variant 11C: CRC-8 in byte 0, counter 0 to 14 in the low nibble of byte 1, data id's bits 8 to 11 above it."""

    counters = 15
    header_bytes = 2

    def _crc(self, data: bytes | bytearray) -> int:
        return crc8(bytes([self.config.data_id & 0xFF, 0]) + bytes(data[1:]))

    def protect(self, data: bytes, counter: int) -> bytes:
        """See :meth:`Profile.protect`."""
        out = self._checked(data, counter)
        out[1] = (self.config.data_id >> 8 & 0xF) << 4 | counter
        out[0] = self._crc(out)
        return bytes(out)

    def counter_of(self, data: bytes) -> int | None:
        """See :meth:`Profile.counter_of`."""
        if len(data) != self.config.length or data[1] >> 4 != self.config.data_id >> 8 & 0xF:
            return None
        counter = data[1] & 0xF
        return counter if data[0] == self._crc(data) and counter < self.counters else None


class Profile05(Profile):
    """CRC-16 little-endian in bytes 0 and 1, counter in byte 2; the data id enters the CRC after the data."""

    counters = 256
    header_bytes = 3

    def _crc(self, data: bytes | bytearray) -> bytes:
        value = crc16(bytes(data[2:]) + self.config.data_id.to_bytes(2, "little"))
        return value.to_bytes(2, "little")

    def protect(self, data: bytes, counter: int) -> bytes:
        """See :meth:`Profile.protect`."""
        out = self._checked(data, counter)
        out[2] = counter
        out[:2] = self._crc(out)
        return bytes(out)

    def counter_of(self, data: bytes) -> int | None:
        """See :meth:`Profile.counter_of`."""
        if len(data) != self.config.length or bytes(data[:2]) != self._crc(data):
            return None
        return data[2]


class Sender:
    """Counts the messages it protects."""

    def __init__(self, profile: Profile, counter: int = 0) -> None:
        self.profile = profile
        self.counter = counter

    def protect(self, data: bytes) -> bytes:
        """``data`` protected, with the next counter."""
        out = self.profile.protect(data, self.counter)
        self.counter = (self.counter + 1) % self.profile.counters
        return out


class Receiver:
    """Judges the messages of one sender; the first counter expected is 0, as AUTOSAR has it."""

    def __init__(self, profile: Profile) -> None:
        self.profile = profile
        self._counter = profile.counters - 1

    def check(self, data: bytes | None) -> E2EStatus:
        """Verdict on a message; None: nothing was received."""
        if data is None:
            return E2EStatus.NO_NEW_DATA
        counter = self.profile.counter_of(data)
        if counter is None:
            return E2EStatus.WRONG_CRC
        delta = (counter - self._counter) % self.profile.counters
        self._counter = counter
        if delta == 0:
            return E2EStatus.REPEATED
        if delta == 1:
            return E2EStatus.OK
        return E2EStatus.OK_SOME_LOST if delta <= self.profile.config.max_delta_counter else E2EStatus.WRONG_SEQUENCE


@dataclass(frozen=True, slots=True)
class Window:
    """Over the last ``size`` checks: at least ``min_ok`` good ones, at most ``max_error`` wrong CRCs."""

    size: int
    min_ok: int
    max_error: int

    def __post_init__(self) -> None:
        if not (self.size >= 1 and self.min_ok <= self.size):
            raise ValueError(f"a window of {self.size} checks with at least {self.min_ok} good ones")


class StateMachine:
    """E2E state machine: turns single verdicts into "the data may be used"."""

    def __init__(self, init: Window, valid: Window, invalid: Window, *, clear_to_invalid: bool = False) -> None:
        self._windows = {E2EState.INIT: init, E2EState.VALID: valid, E2EState.INVALID: invalid}
        self._clear_to_invalid = clear_to_invalid
        self._seen: list[E2EStatus] = []
        self.state = E2EState.NODATA

    def step(self, status: E2EStatus) -> E2EState:
        """One verdict in, the new state out."""
        if self.state is E2EState.NODATA:
            if status not in (E2EStatus.WRONG_CRC, E2EStatus.NO_NEW_DATA):
                self.state = E2EState.INIT
            return self.state
        window = self._windows[self.state]
        self._seen = [*self._seen, status][-window.size :]
        good = sum(s in (E2EStatus.OK, E2EStatus.OK_SOME_LOST) for s in self._seen)
        bad = self._seen.count(E2EStatus.WRONG_CRC)
        fits = bad <= window.max_error and good >= window.min_ok
        if fits:
            self.state = E2EState.VALID
        elif self.state is E2EState.VALID or (self.state is E2EState.INIT and bad > window.max_error):
            self.state = E2EState.INVALID
            if self._clear_to_invalid:
                self._seen.clear()
        return self.state
