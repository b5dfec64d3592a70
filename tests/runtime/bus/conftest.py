"""A device of the C bus library on the desk, and a clock."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from cantools.database import load_file
from cantools.database.can import Database

from upbeam.runtime.bus import Device
from upbeam.runtime.bus.generate import DBC

KEY = bytes(range(1, 17))
MS = 1_000_000


class Desk:
    """A device, its storage over restarts, and virtual time."""

    def __init__(self, key: bytes | None = KEY, **options: bool | int) -> None:
        self.key = key
        self.options = options
        self.storage: dict[int, bytes] = {}
        self.now = 0
        self.restart()

    def restart(self) -> None:
        self.device = Device(self.key, self.storage, now_ns=self.now, **self.options)  # type: ignore[arg-type]

    def run(self, ms: int) -> None:
        for _ in range(ms):
            self.now += MS
            self.device.step(self.now)

    def send(self, can_id: int, data: bytes, flags: int = 0) -> bool:
        return self.device.can(can_id, data, flags, self.now)


@pytest.fixture
def make_desk() -> Callable[..., Desk]:
    return Desk


@pytest.fixture
def desk() -> Desk:
    return Desk()


@pytest.fixture(scope="session")
def db() -> Database:
    database = load_file(DBC)
    assert isinstance(database, Database)
    return database


@pytest.fixture(scope="session")
def headers() -> Path:
    return Path(__file__).resolve().parents[3] / "runtime" / "include" / "upbeam"
