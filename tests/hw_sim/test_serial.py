"""The serial console from the desk: records, resynchronisation, deadlines, pty and noisy line."""

from __future__ import annotations

import threading

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from upbeam.hw_sim.can import database
from upbeam.hw_sim.can.checksum import crc16
from upbeam.hw_sim.can.commander import MAC_OFFSET, Commander, mac_of
from upbeam.hw_sim.can.frame import FD_LENGTHS, CanFrame
from upbeam.hw_sim.can.wire import encode_frame
from upbeam.hw_sim.serial import ConsoleClient, ConsoleTimeoutError, NoisyLine, PtyPair, RecordParser, encode_record
from upbeam.hw_sim.serial.framing import RECORD_MAX

KEY = bytes(range(16))


@st.composite
def frames(draw: st.DrawFn) -> CanFrame:
    fd = draw(st.booleans())
    length = draw(st.sampled_from(FD_LENGTHS) if fd else st.integers(0, 8))
    return CanFrame(draw(st.integers(0, 0x7FF)), draw(st.binary(min_size=length, max_size=length)), fd=fd)


def cobs_by_hand(data: bytes) -> bytes:
    """Cheshire and Baker's code written out: each block says how many bytes until the next zero."""
    out = bytearray()
    blocks = data.split(b"\0")
    for block in blocks:
        while len(block) >= 254:
            out += bytes([255]) + block[:254]
            block = block[254:]
        out += bytes([len(block) + 1]) + block
    return bytes(out)


@settings(max_examples=100, deadline=None)
@given(frames())
def test_a_record_is_cobs_of_frame_and_crc(frame: CanFrame) -> None:
    payload = encode_frame(frame)
    record = encode_record(frame)
    assert record == cobs_by_hand(payload + crc16(payload).to_bytes(2, "big")) + b"\0"
    assert len(record) <= RECORD_MAX


@settings(max_examples=100, deadline=None)
@given(st.lists(frames(), max_size=5), st.binary(max_size=100), st.integers(1, 17))
def test_after_garbage_the_next_record_is_read(sent: list[CanFrame], garbage: bytes, step: int) -> None:
    stream = garbage + b"\0" + b"".join(map(encode_record, sent))
    parser = RecordParser()
    got = [f for at in range(0, len(stream), step) for f in parser.feed(stream[at : at + step])]
    assert got[len(got) - len(sent) :] == sent
    assert parser.good == len(got)
    assert parser.good + parser.refused == len([r for r in stream.split(b"\0")[:-1] if r])


def test_refused_records_are_counted_by_cause() -> None:
    parser = RecordParser()
    good = encode_record(CanFrame(0x123, b"12"))
    assert parser.feed(b"\0\0\0" + good) == [CanFrame(0x123, b"12")]
    assert parser.feed(b"\x05\x01\0") == []
    flipped = bytearray(good)
    flipped[8] ^= 2
    assert parser.feed(bytes(flipped)) == []
    body = encode_frame(CanFrame(1))[:-1] + b"\x03"
    assert parser.feed(cobs_by_hand(body + crc16(body).to_bytes(2, "big")) + b"\0") == []
    assert parser.feed(b"\x01" * 500 + b"\0") == []
    assert (parser.good, parser.bad_cobs, parser.bad_crc, parser.bad_frame, parser.overlong) == (1, 1, 1, 1, 1)


class SlowPort:
    """A port on a virtual clock that gives one byte of ``data`` per read, each a millisecond later."""

    def __init__(self, data: bytes) -> None:
        self.data = data
        self.now = 0.0
        self.timeout: float | None = None
        self.written = b""

    def read(self, size: int = 1, /) -> bytes:
        out, self.data = self.data[:1], self.data[1:]
        self.now += 0.001 if out else max(self.timeout or 0.0, 0.0005)
        return out

    def write(self, data: bytes, /) -> int:
        self.written += data
        return len(data)

    def close(self) -> None:
        pass


def test_trickling_bytes_do_not_move_the_deadline() -> None:
    port = SlowPort(b"\x11" * 100_000)
    client = ConsoleClient(port, clock=lambda: port.now)
    assert client.receive(0.5) is None
    assert port.now == pytest.approx(0.5, abs=0.01)
    with pytest.raises(ConsoleTimeoutError, match="no suitable frame"):
        client.wait_for(lambda frame: True, 0.5)
    assert port.now == pytest.approx(1.0, abs=0.02)


def test_waiting_skips_what_does_not_suit() -> None:
    port = SlowPort(b"".join(encode_record(CanFrame(i)) for i in range(10)))
    client = ConsoleClient(port, clock=lambda: port.now)
    assert client.wait_for(lambda frame: frame.identifier == 7, 5.0) == CanFrame(7)
    assert client.receive(1.0) == CanFrame(8)
    with pytest.raises(ConsoleTimeoutError, match="1 others"):
        client.wait_for(lambda frame: False, 1.0)


def test_loop_back_over_pyserial() -> None:
    with ConsoleClient.open("loop://") as client:
        sent = [CanFrame(i, bytes(i % 9)) for i in range(20)]
        for frame in sent:
            client.send(frame)
        assert [client.receive(5.0) for _ in sent] == sent


def answer(request: CanFrame) -> CanFrame:
    signals: dict[str, database.Value] = {"Code": "STATUS", "Freshness": int.from_bytes(request.data[4:8], "little")}
    signals |= {"Result": "DONE", "Mode": 0, "StoredFreshness": 1, "Mac": 0}
    data = bytearray(database.pack("UPB_Response", signals).data)
    data[MAC_OFFSET:] = mac_of(KEY, 0x301, bytes(data))
    protection = database.profile(database.load().get_message_by_name("UPB_Response"))
    assert protection is not None
    return CanFrame(0x301, protection.protect(bytes(data), 0), fd=True, bit_rate_switch=True)


def test_command_and_answer_over_a_pty() -> None:
    with PtyPair() as line, ConsoleClient.open(line.device) as client:
        device = ConsoleClient(line)

        def serve() -> None:
            line.write(b"\x07garbage")
            request = device.wait_for(lambda f: f.identifier == 0x300, 20.0)
            line.write(b"\0" + encode_record(CanFrame(0x210, bytes(8))) + encode_record(answer(request)))

        server = threading.Thread(target=serve)
        server.start()
        commander = Commander(KEY)
        response = client.command(commander, commander.status(), timeout_s=20.0)
        server.join()
        assert (response.result, response.authentic) == ("DONE", True)
        assert client.parser.refused == 1


def test_a_pty_that_nobody_reads_counts_what_is_lost() -> None:
    with PtyPair() as line:
        line.timeout = 0
        assert line.read(10) == b""
        for _ in range(100):
            line.write(bytes(range(1, 256)) * 8)
        assert line.lost > 0


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32), st.sampled_from([0.001, 0.01, 0.05]))
def test_over_a_noisy_line_nothing_wrong_gets_through(seed: int, rate: float) -> None:
    """Every frame read was sent, in order; what did not arrive left a trace in the counters."""
    sent = [CanFrame(0x100 + i, i.to_bytes(4, "little") * 2) for i in range(100)]
    line = NoisyLine(seed, loss=rate, flip=rate, insert=rate, burst=3)
    parser = RecordParser()
    got = [f for frame in sent for f in parser.feed(line.pass_on(encode_record(frame)))]
    assert set(got) <= set(sent)
    assert got == sorted(got, key=lambda f: f.identifier)
    if not (line.lost or line.flipped or line.inserted):
        assert got == sent
    damage = line.lost + line.flipped + line.inserted
    assert len(sent) - len(got) <= 2 * damage


def test_noise_is_seeded_and_counted() -> None:
    data = bytes(range(256)) * 20
    one, two = (NoisyLine(7, loss=0.01, flip=0.01, insert=0.01, burst=4) for _ in range(2))
    assert one.pass_on(data) == two.pass_on(data)
    assert min(one.lost, one.flipped, one.inserted) > 10
    assert NoisyLine(7).pass_on(data) == data
    assert NoisyLine(1, loss=1.0).pass_on(data) == b""
    with pytest.raises(ValueError, match="no probability"):
        NoisyLine(1, loss=1.5)
    with pytest.raises(ValueError, match="at least 1 byte"):
        NoisyLine(1, burst=0)
