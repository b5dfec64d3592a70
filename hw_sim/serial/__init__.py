"""The serial console from the desk: records, a client over pyserial, a pty pair, a noisy line (needs extra ``hil``)."""

from .client import ConsoleClient, ConsoleTimeoutError
from .framing import RecordParser, encode_record
from .noise import NoisyLine
from .pty import PtyPair

__all__ = ["ConsoleClient", "ConsoleTimeoutError", "NoisyLine", "PtyPair", "RecordParser", "encode_record"]
