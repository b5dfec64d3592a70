"""What a bad line does to bytes: losses, bit flips, insertions. Seeded; equal seeds give equal noise."""

from __future__ import annotations

import random


class NoisyLine:
    """Passes bytes on, damaged with the given probabilities per byte; counts what it did.

    ``burst`` is the mean length in bytes of what is lost at once (an overrun loses more than one).
    """

    def __init__(
        self, seed: int, *, loss: float = 0.0, flip: float = 0.0, insert: float = 0.0, burst: float = 1.0
    ) -> None:
        for name, value in (("loss", loss), ("flip", flip), ("insert", insert)):
            if not 0 <= value <= 1:
                raise ValueError(f"{name} {value} is no probability")
        if burst < 1:
            raise ValueError(f"burst {burst}: at least 1 byte is lost at once")
        self._rng = random.Random(seed)
        self.loss, self.flip, self.insert, self.burst = loss, flip, insert, burst
        self.lost = self.flipped = self.inserted = 0
        self._losing = 0

    def pass_on(self, data: bytes) -> bytes:
        """The bytes as they arrive."""
        out = bytearray()
        for byte in data:
            if self._rng.random() < self.insert:
                self.inserted += 1
                out.append(self._rng.randrange(256))
            if self._is_lost():
                self.lost += 1
                continue
            if self._rng.random() < self.flip:
                self.flipped += 1
                byte ^= 1 << self._rng.randrange(8)
            out.append(byte)
        return bytes(out)

    def _is_lost(self) -> bool:
        if self._losing:
            self._losing -= 1
            return True
        if self._rng.random() >= self.loss:
            return False
        while self._rng.random() >= 1 / self.burst:
            self._losing += 1
        return True
