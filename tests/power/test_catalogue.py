"""The device catalogue: what is shipped is complete; a bad file is refused with its line and reason."""

from __future__ import annotations

import pytest

from upbeam.power.catalogue import CatalogueError, cpu_core, device, device_names, read_device
from upbeam.power.files import packaged

EXPECTED = {
    "jetson-nano", "jetson-tx2", "jetson-xavier-nx", "jetson-agx-xavier", "jetson-orin-nano", "jetson-orin-nx",
    "jetson-agx-orin", "ecp5-12", "ecp5-25", "ecp5-85", "ice40up5k", "xc7z020", "zu3eg", "k26", "xc7a35t", "xc7a100t",
    "host",
}  # fmt: skip

GOOD = """\
name = "my-board"
title = "A board"
family = "fpga"

[fpga]
luts = { value = 1000, unit = "1", kind = "data sheet", source = "its data sheet" }
ffs = { value = 1000, unit = "1", kind = "data sheet", source = "its data sheet" }
multipliers = { value = 8, unit = "1", kind = "data sheet", source = "its data sheet" }
ram = { value = 64, unit = "kbit", kind = "data sheet", source = "its data sheet" }
clock = { value = 50, low = 40, high = 60, unit = "MHz", kind = "measured by me", source = "routed" }

[power]
boundary = "chip"
idle = { value = 20, unit = "mW", kind = "assumption", source = "a guess" }
mac_energy = { value = 10, low = 3, high = 30, unit = "pJ/MAC", kind = "assumption", source = "a guess" }
node = { value = 40, unit = "nm", kind = "data sheet", source = "its data sheet" }
"""


def test_the_devices_asked_for_are_there():
    assert set(device_names()) == EXPECTED


@pytest.mark.parametrize("name", sorted(EXPECTED))
def test_every_figure_has_a_source_and_a_kind(name):
    found = device(name)
    assert found.name == name
    assert found.title
    for key, figure in found.every_figure():
        assert figure.source, key
        assert figure.kind in ("data sheet", "assumption") or figure.kind.startswith("measured by "), key
    if found.family == "jetson":
        assert len(found.modes) >= 2
        assert found.mode() is found.modes[found.default_mode]
    if "cpu.core" in found.texts and name != "host":
        assert cpu_core(found.texts["cpu.core"]).pair_cycles


def write(tmp_path, text):
    path = tmp_path / "board.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_a_users_file(tmp_path):
    mine = device(str(write(tmp_path, GOOD)))
    assert mine.figure("fpga.clock").span("MHz") == (50, 40, 60)
    assert mine.figure("power.idle").get("W") == pytest.approx(0.02)
    with pytest.raises(CatalogueError, match="no power modes"):
        mine.mode("fast")


MODE = """\
[modes.fast]
cpu_cores = { value = 1, unit = "1", kind = "data sheet", source = "x" }
cpu_clock = { value = 1, unit = "GHz", kind = "data sheet", source = "x" }
gpu_clock = { value = 1, unit = "GHz", kind = "data sheet", source = "x" }
"""

BAD = {
    "no line end": (' = "my-board"', " = my-board", r"board.toml: .*line 1"),
    "misspelt key": ("luts = ", "lutz = ", r"board.toml:6: \[fpga\] lutz: is unknown, expected one of: luts"),
    "unknown section": ("[fpga]", "[asic]", r"board.toml:5: \[asic\]: is unknown, expected one of: cpu"),
    "missing key": ('mac_energy = { value = 10, low = 3, high = 30, unit = "pJ/MAC", kind = "assumption", '
                    'source = "a guess" }\n', "", r"board.toml:12: \[power\]: mac_energy is missing"),
    "plain number": ('luts = { value = 1000, unit = "1", kind = "data sheet", source = "its data sheet" }',
                     "luts = 1000", r"board.toml:6: \[fpga\] luts: 1000: expected \{ value, unit, kind, source"),
    "no source": (', source = "routed"', "", r"board.toml:10: \[fpga\] clock: has no 'source'"),
    "empty source": ('source = "routed"', 'source = " "', r"board.toml:10: .*source is empty"),
    "wrong unit": ('"MHz"', '"mW"', r"board.toml:10: \[fpga\] clock: unit 'mW': expected one of Hz, MHz, GHz"),
    "wrong kind": ('"measured by me"', '"measured"', r"board.toml:10: .*kind 'measured': expected 'data sheet'"),
    "value outside": ("low = 40", "low = 55", r"board.toml:10: .*value 50 is outside of low 55"),
    "negative": ("value = 20", "value = -20", r"board.toml:14: \[power\] idle: -20: expected a number of at least 0"),
    "text for number": ("value = 20", 'value = "20"', r"board.toml:14: .*'20': expected a number"),
    "unknown in figure": ("value = 20", "value = 20, error = 1", r"board.toml:14: .*has an unknown 'error'"),
    "number for text": ('boundary = "chip"', "boundary = 3", r"board.toml:13: \[power\] boundary: 3: expected a text"),
    "unknown family": ('"fpga"', '"gpu"', r"board.toml:3: family: 'gpu': expected one of jetson, fpga, host"),
    "bad name": ("my-board", "My Board", r"board.toml:1: name: 'My Board'"),
    "infinite": ("value = 20", "value = inf", r"board.toml:14: .*finite"),
    "not a number": ("value = 20", "value = nan", r"board.toml:14: .*nan: expected a number"),
    "truth value": ("value = 20", "value = true", r"board.toml:14: .*True: expected a number"),
    "clock of 0": ("value = 50, low = 40", "value = 50, low = 0", r"board.toml:10: .*0: expected a number above 0"),
    "mode without clocks": ("[power]", '[modes.fast]\nbudget = { value = 1, unit = "W", kind = "data sheet", '
                            'source = "x" }\n\n[power]', r"board.toml:12: \[modes.fast\]: cpu_cores is missing"),
    "mode without default": ("[power]", MODE + "\n[power]", r"board.toml:1: default_mode: '': expected one of fast"),
}  # fmt: skip


@pytest.mark.parametrize("what", BAD)
def test_a_bad_file_is_refused_with_line_and_reason(what, tmp_path):
    old, new, message = BAD[what]
    assert old in GOOD
    with pytest.raises(CatalogueError, match=message):
        read_device(write(tmp_path, GOOD.replace(old, new, 1)))


def test_a_module_without_modes(tmp_path):
    text = (packaged("devices", "jetson-nano.toml")).read_text()
    with pytest.raises(CatalogueError, match="needs at least one section"):
        read_device(write(tmp_path, text.split("[modes.")[0]))


def test_files_that_are_no_text(tmp_path):
    path = tmp_path / "board.toml"
    path.write_bytes(b"name = \xff\xfe")
    with pytest.raises(CatalogueError, match="not UTF-8"):
        read_device(path)
    with pytest.raises(CatalogueError, match="No such file"):
        device(str(tmp_path / "none.toml"))
    with pytest.raises(CatalogueError, match="no device 'jetson', known: ecp5-12"):
        device("jetson")


def test_damaged_files_are_read_or_refused_never_crash(tmp_path, rng):
    """Bytes of the good file changed, dropped and doubled."""
    text, refused = GOOD.encode(), 0
    for _ in range(400):
        data = bytearray(text)
        for _ in range(int(rng.integers(1, 4))):
            at = int(rng.integers(len(data)))
            match int(rng.integers(3)):
                case 0:
                    data[at] = int(rng.integers(32, 127))
                case 1:
                    del data[at : at + int(rng.integers(1, 20))]
                case _:
                    data[at:at] = data[at : at + 10]
        path = tmp_path / "board.toml"
        path.write_bytes(bytes(data))
        try:
            read_device(path)
        except CatalogueError:
            refused += 1
    assert refused > 100
