"""Authenticated commands: the tester's side of ``upbeam/command.h``.

A command is the message TST_Command of ``upbeam.dbc``: freshness counter, CMAC-AES-128 (RFC 4493, first 64 bits) over
data id (big-endian) and bytes 3 to 15, E2E Profile 5 over all of it. The freshness counter must grow over restarts of
either side, so it is kept in a file and stored before the command leaves.
"""

from __future__ import annotations

import enum
import json
import os
from dataclasses import dataclass
from pathlib import Path

from cryptography.hazmat.primitives.ciphers.algorithms import AES
from cryptography.hazmat.primitives.cmac import CMAC

from . import database
from .e2e import E2EStatus, Receiver, Sender
from .frame import CanFrame

KEY_BYTES = 16
MAC_BYTES = 8
MAC_OFFSET = 16
MAC_START = 3
FRESHNESS_MAX = 0xFFFFFFFF
MODE_AUTOMATIC = 255


class Command(enum.IntEnum):
    """Command codes (value table Command)."""

    STATUS = 1
    MODE = 2
    MODEL = 3
    CLEAR_FAULTS = 4


class Mode(enum.IntEnum):
    """What the output is made with (value table Mode)."""

    NETWORK = 0
    VALID_MEAN = 1
    REPEAT = 2
    PASS_THROUGH = 3


@dataclass(frozen=True, slots=True)
class Response:
    """Answer of the device; ``authentic`` only if its MAC is that of the key. Names are those of the value tables."""

    code: str
    result: str
    freshness: int
    stored_freshness: int
    mode: str
    authentic: bool


def cmac(key: bytes, data: bytes) -> bytes:
    """AES-128-CMAC, all 16 bytes. :raises ValueError: the key is not 16 bytes."""
    if len(key) != KEY_BYTES:
        raise ValueError(f"key of {len(key)} bytes, AES-128 takes {KEY_BYTES}")
    mac = CMAC(AES(key))
    mac.update(data)
    return mac.finalize()


def mac_of(key: bytes, data_id: int, data: bytes) -> bytes:
    """Truncated MAC of a command's or response's 24 bytes."""
    return cmac(key, data_id.to_bytes(2, "big") + data[MAC_START:MAC_OFFSET])[:MAC_BYTES]


class FreshnessFile:
    """The counter of the last command sent, in a file that is replaced whole.

    :raises ValueError: the file is damaged; it is never taken as 0, for a repeated counter is refused for ever.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    def read(self) -> int:
        """Last counter used; 0 if there is no file yet."""
        try:
            text = self.path.read_text(encoding="utf-8")
        except FileNotFoundError:
            return 0
        try:
            value = json.loads(text)["freshness"]
        except (ValueError, KeyError, TypeError) as error:
            raise ValueError(f"{self.path}: no freshness counter in it: {text[:40]!r}") from error
        if not isinstance(value, int) or not 0 <= value <= FRESHNESS_MAX:
            raise ValueError(f"{self.path}: freshness counter {value!r}")
        return value

    def write(self, value: int) -> None:
        """Store; after a power cut the file holds the old value or the new one."""
        partial = self.path.with_name(self.path.name + ".part")
        with partial.open("w", encoding="utf-8") as stream:
            json.dump({"freshness": value}, stream)
            stream.flush()
            os.fsync(stream.fileno())
        partial.replace(self.path)


class Commander:
    """Builds command frames and reads answers.

    ``freshness``: a file that keeps the counter, or a start value that is kept in memory only.
    """

    def __init__(self, key: bytes, freshness: Path | int = 0) -> None:
        if len(key) != KEY_BYTES:
            raise ValueError(f"key of {len(key)} bytes, AES-128 takes {KEY_BYTES}")
        self.key = key
        self._file = FreshnessFile(freshness) if isinstance(freshness, Path) else None
        self._freshness = freshness if isinstance(freshness, int) else FreshnessFile(freshness).read()
        command = database.profile(database.load().get_message_by_name("TST_Command"))
        response = database.profile(database.load().get_message_by_name("UPB_Response"))
        assert command is not None
        assert response is not None
        self._sender = Sender(command)
        self._receiver = Receiver(response)
        self._last_response = b""

    @property
    def freshness(self) -> int:
        """Counter of the last command built."""
        return self._freshness

    def build(self, command: int, *, argument: int = 0, model_crc32: int = 0) -> CanFrame:
        """The next command. :raises OverflowError: the freshness counter is used up, the device needs a new key."""
        if self._freshness >= FRESHNESS_MAX:
            raise OverflowError("the freshness counter is used up: give the device a new key")
        self._freshness += 1
        if self._file:
            self._file.write(self._freshness)
        return self.forge(command, self._freshness, argument=argument, model_crc32=model_crc32)

    def forge(
        self,
        command: int,
        freshness: int,
        *,
        argument: int = 0,
        model_crc32: int = 0,
        mac: bytes | None = None,
        reserved: int = 0,
    ) -> CanFrame:
        """A command with any counter, MAC and reserved bytes: what an attacker or a fault would send."""
        signals = {"Code": command, "Freshness": freshness, "Argument": argument, "ModelCrc32": model_crc32}
        message = database.load().get_message_by_name("TST_Command")
        header = {s.name: 0 for s in message.signals if s.name.startswith("E2E_")}
        data = bytearray(message.encode({**header, "Mac": 0, **signals}, strict=False))
        data[9:12] = reserved.to_bytes(3, "little")
        right = mac_of(self.key, self._sender.profile.config.data_id, bytes(data))
        data[MAC_OFFSET : MAC_OFFSET + MAC_BYTES] = right if mac is None else mac
        return database.frame_of(message, self._sender.protect(bytes(data)))

    def status(self) -> CanFrame:
        """Ask for an answer and all status messages."""
        return self.build(Command.STATUS)

    def mode(self, mode: int | None) -> CanFrame:
        """Hold a mode; None: the degradation ladder decides again."""
        return self.build(Command.MODE, argument=MODE_AUTOMATIC if mode is None else int(mode))

    def model(self, crc32: int) -> CanFrame:
        """Change to the model file with this CRC-32."""
        return self.build(Command.MODEL, model_crc32=crc32)

    def clear_faults(self, fault: int = 0) -> CanFrame:
        """Forget one fault, or all (0)."""
        return self.build(Command.CLEAR_FAULTS, argument=fault)

    def response(self, frame: CanFrame) -> Response | None:
        """The answer in a frame; None if it is none, damaged, or the very frame that came before.

        A device that was reset counts from 0 again, so a repeated counter alone does not make a repetition.
        """
        message = database.load().get_message_by_name("UPB_Response")
        if frame.identifier != message.frame_id or frame.extended:
            return None
        verdict = self._receiver.check(frame.data)
        is_repetition = verdict is E2EStatus.REPEATED and frame.data == self._last_response
        if verdict is E2EStatus.WRONG_CRC or is_repetition:
            return None
        self._last_response = frame.data
        values = database.signals_of(message, frame.data)
        expected = mac_of(self.key, self._receiver.profile.config.data_id, frame.data)
        return Response(
            code=str(values["Code"]),
            result=str(values["Result"]),
            freshness=int(values["Freshness"]),
            stored_freshness=int(values["StoredFreshness"]),
            mode=str(values["Mode"]),
            authentic=frame.data[MAC_OFFSET : MAC_OFFSET + MAC_BYTES] == expected,
        )
