"""A pseudo-terminal pair: a serial line without hardware, for POSIX systems."""

from __future__ import annotations

import os
import select
import tty
from types import TracebackType


class PtyPair:
    """``device`` is the path that one end opens as its serial port; this object is the other end.

    It has pyserial's ``read``, ``write``, ``timeout`` and ``close``, so a client can use either end. Data passes as
    it is: no echo, no line editing.
    """

    def __init__(self) -> None:
        self._controller, self._device = os.openpty()
        tty.setraw(self._device)
        os.set_blocking(self._controller, False)
        self.device = os.ttyname(self._device)
        self.timeout: float | None = None
        self.lost = 0
        """Bytes that did not fit the line because nobody read them."""

    def __enter__(self) -> PtyPair:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @property
    def in_waiting(self) -> int:
        """1 if a byte can be read at once, else 0 (how many, a pty does not say portably)."""
        return len(select.select([self._controller], [], [], 0)[0])

    def read(self, size: int = 1, /) -> bytes:
        """What is there, at most ``size`` bytes, waiting up to ``timeout`` for the first."""
        ready, _, _ = select.select([self._controller], [], [], self.timeout)
        return os.read(self._controller, size) if ready else b""

    def write(self, data: bytes, /) -> int:
        """Send what fits the line's buffer; the rest is counted in ``lost``, as on a real line without flow control."""
        try:
            written = os.write(self._controller, data)
        except BlockingIOError:
            written = 0
        self.lost += len(data) - written
        return written

    def close(self) -> None:
        """Close both ends that this object holds."""
        for fd in (self._controller, self._device):
            if fd >= 0:
                os.close(fd)
        self._controller = self._device = -1
