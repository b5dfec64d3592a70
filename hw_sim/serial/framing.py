"""Records of the serial console: ``COBS(frame | CRC-16/IBM-3740, big-endian) 0x00``, as ``upbeam/console.h`` has it."""

from __future__ import annotations

from cobs import cobs

from ..can.checksum import crc16
from ..can.frame import CanFrame
from ..can.wire import MAX_BYTES, decode_frame, encode_frame

CRC_BYTES = 2
DELIMITER = 0
RECORD_MAX = MAX_BYTES + CRC_BYTES + 2
"""Bytes of the longest record, COBS's code byte and the delimiter with it."""


def encode_record(frame: CanFrame) -> bytes:
    """A record, delimiter and all."""
    payload = encode_frame(frame)
    return bytes(cobs.encode(payload + crc16(payload).to_bytes(CRC_BYTES, "big"))) + bytes([DELIMITER])


class RecordParser:
    """Bytes in, frames out; after garbage in step again at the next delimiter.

    Counters, as in the device: ``good``, and by cause what was refused: ``bad_cobs``, ``bad_crc``, ``bad_frame``,
    ``overlong``. Delimiters in a row are an idle line.
    """

    def __init__(self) -> None:
        self.good = 0
        self.bad_cobs = 0
        self.bad_crc = 0
        self.bad_frame = 0
        self.overlong = 0
        self._have = bytearray()
        self._skipping = False

    @property
    def refused(self) -> int:
        """Records refused, all causes."""
        return self.bad_cobs + self.bad_crc + self.bad_frame + self.overlong

    def feed(self, data: bytes) -> list[CanFrame]:
        """Frames that these bytes complete."""
        frames = []
        for byte in data:
            if byte != DELIMITER:
                self._keep(byte)
                continue
            frame = self._end_of_record()
            if frame is not None:
                frames.append(frame)
        return frames

    def _keep(self, byte: int) -> None:
        if len(self._have) < RECORD_MAX:
            self._have.append(byte)
        else:
            self._skipping = True

    def _end_of_record(self) -> CanFrame | None:
        record, skipped = bytes(self._have), self._skipping
        self._have.clear()
        self._skipping = False
        if skipped:
            self.overlong += 1
            return None
        return self._parse(record) if record else None

    def _parse(self, record: bytes) -> CanFrame | None:
        try:
            payload = cobs.decode(record)
        except cobs.DecodeError:
            self.bad_cobs += 1
            return None
        if not CRC_BYTES <= len(payload) <= MAX_BYTES + CRC_BYTES:
            self.bad_cobs += 1
            return None
        body, crc = payload[:-CRC_BYTES], payload[-CRC_BYTES:]
        if crc16(body).to_bytes(CRC_BYTES, "big") != crc:
            self.bad_crc += 1
            return None
        try:
            frame = decode_frame(body)
        except ValueError:
            self.bad_frame += 1
            return None
        self.good += 1
        return frame
