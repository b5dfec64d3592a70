"""C header and RTL memories, read back by programs that know nothing of what wrote them; the command line."""

from __future__ import annotations

import json
import os
import re
import shutil
import struct
import subprocess
from dataclasses import replace

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

import upbeam
from upbeam.cli.export import export
from upbeam.hw_sim import simulate_frames
from upbeam.model.beams import beam_table
from upbeam.model.rules import extract_windows
from upbeam.quant.export import ExportError, Source
from upbeam.quant.export.c_header import c_header
from upbeam.quant.export.rtl import write_rtl
from upbeam.quant.integer import CONTRACTS, IntegerModel, IntegerNetwork, network
from upbeam.quant.quantize import Calibration, quantize
from upbeam.quant.sizes import weight_bytes
from upbeam.quant.ubm import read_ubm

PRECISIONS = ("int16", "int8")
NETWORKS = ("distance", "intensity")
PARTS = {"W": "weight", "M": "minimum", "B": "bias", "V": "output"}


@pytest.fixture(scope="module")
def quantised():
    """The shipped model with integer networks of a simulated turn's windows."""
    file = replace(upbeam.load_model("hdl-64e").file, int16=None, int8=None)
    scan = next(simulate_frames(beam_table("hdl-64e"), columns=512, frames=1, seed=3)).aligned()
    windows = extract_windows(scan.distance[::2], scan.intensity[::2], file.rules)
    parts = (x[windows.any_return].astype(np.int64) for x in (windows.distance, windows.intensity))
    return quantize(file, Calibration(*parts), rounding="nearest")


@pytest.fixture(scope="module")
def source(quantised):
    return Source.of(quantised.to_bytes(), "Our model, v1.0")


@pytest.fixture(scope="module")
def extreme(quantised):
    """Largest and smallest values that the contract has a place for."""

    def edge(precision):
        top = 127 if precision == "int8" else 32767
        return IntegerNetwork(
            weight=np.array([[0] * 6, [top, -top, 0, 1, -1, 0], [0] * 6]),
            minimum=np.array([0, 0, -32767 if precision == "int8" else 32767]),
            bias=np.array([-(2**31), 2**30, 0]),
            output=np.array([1, top, -top]),
            offset=-(2**24) - 1,
            slope=32767,
            skip=0,
            k=0,
            j=0,
            t=0,
        )

    models = {name: IntegerModel(name, edge(name), edge(name)) for name in PRECISIONS}
    rules = replace(quantised.rules, max_count=8000, row_max_count=np.full(64, 8000))
    return Source.of(replace(quantised, rules=rules, **models).to_bytes(), "extreme")


def equal(a: IntegerNetwork, b: IntegerNetwork) -> None:
    for part in PARTS.values():
        assert np.array_equal(getattr(a, part), getattr(b, part)), part
    for part in ("offset", "slope", "skip", "k", "j", "t"):
        assert getattr(a, part) == getattr(b, part), part


# ------------------------------------------------------------------------------------------------------ C header

PROGRAM = """
#include "model.h"
#include <stdio.h>

static uint32_t crc32(const unsigned char *data, uint32_t bytes) {
    uint32_t crc = 0xffffffffu;
    for (uint32_t i = 0; i < bytes; i++) {
        crc ^= data[i];
        for (int bit = 0; bit < 8; bit++)
            crc = crc & 1u ? crc >> 1 ^ 0xedb88320u : crc >> 1;
    }
    return crc ^ 0xffffffffu;
}

#define SHOW(kind, name, array) \\
    do { \\
        printf("%s %u", name, (unsigned)sizeof((array)[0])); \\
        for (unsigned i = 0; i < sizeof(array) / sizeof(kind); i++) \\
            printf(" %ld", (long)((const kind *)(const void *)(array))[i]); \\
        printf("\\n"); \\
    } while (0)

int main(void) {
    const unsigned char *end = UBM + sizeof UBM - 4;
    uint32_t stored = (uint32_t)end[0] | (uint32_t)end[1] << 8 | (uint32_t)end[2] << 16 | (uint32_t)end[3] << 24;
    if (sizeof UBM != UBM_BYTES || (uintptr_t)UBM % 64 != 0)
        return 1;
    if (crc32(UBM, UBM_BYTES - 4) != stored || stored != CRC32)
        return 2;
    SHOW(unsigned char, "ubm", UBM);
    SHOWN
    return 0;
}
"""


def show_all(name: str) -> str:
    lines = [f'SHOW(uint16_t, "row_max_count", upb_{name}_row_max_count);']
    lines.append(f'printf("limits 0 %u %u\\n", UPB_{name.upper()}_MIN_COUNT, UPB_{name.upper()}_MAX_COUNT);')
    for precision in PRECISIONS:
        for which in NETWORKS:
            key, macro = f"{precision}_{which}", f"UPB_{name.upper()}_{precision}_{which}".upper()
            narrow = "int8_t" if precision == "int8" else "int16_t"
            kinds = {"W": narrow, "V": narrow, "M": "int16_t", "B": "int32_t"}
            lines += [f'SHOW({kind}, "{key}_{letter}", upb_{name}_{key}_{letter});' for letter, kind in kinds.items()]
            scalars = ", ".join(f"(long){macro}_{letter}" for letter in ("C", "SLOPE", "SKIP", "K", "J", "T", "H"))
            lines.append(f'printf("{key} 0 %ld %ld %ld %ld %ld %ld %ld\\n", {scalars});')
        lines.append(f'printf("%s 0 %u\\n", UPB_{name}_{precision}_CONTRACT, UPB_{name}_{precision}_WEIGHT_BYTES);')
        lines[-1] = lines[-1].replace(f"UPB_{name}_{precision}", f"UPB_{name}_{precision}".upper())
    return "\n    ".join(lines)


def compiled(folder, header: str, name: str, language: str) -> dict[str, list[int]]:
    """What a program with only the header prints: array -> bytes of an element, then values."""
    (folder / "model.h").write_text(header, encoding="ascii")
    text = PROGRAM.replace("SHOWN", show_all(name)).replace("UBM_BYTES", f"UPB_{name.upper()}_UBM_BYTES")
    text = re.sub(r"\bUBM\b", f"upb_{name}_ubm", text).replace("!= CRC32", f"!= UPB_{name.upper()}_CRC32")
    plus = "++" in language
    program = folder / ("main.cpp" if plus else "main.c")
    program.write_text(text, encoding="ascii")
    compiler = os.environ.get("CXX" if plus else "CC") or ("c++" if plus else "cc")
    assert shutil.which(compiler), f"no compiler {compiler}: a C and C++ compiler is needed to build upbeam"
    warnings = ["-Wall", "-Wextra", "-Wconversion", "-Wshadow", "-pedantic", "-Werror"]
    command = [compiler, f"-std={language}", *warnings, str(program), "-o", str(folder / "main")]
    made = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert made.returncode == 0, made.stderr
    ran = subprocess.run([str(folder / "main")], capture_output=True, text=True, timeout=60, check=False)
    assert ran.returncode == 0, f"status {ran.returncode}: 1 size or alignment, 2 checksum"
    return {line.split()[0]: [int(x) for x in line.split()[1:]] for line in ran.stdout.splitlines()}


def network_of(shown: dict[str, list[int]], key: str) -> IntegerNetwork:
    offset, slope, skip, k, j, t, hidden = shown[key][1:]
    parts = {part: np.array(shown[f"{key}_{letter}"][1:]) for letter, part in PARTS.items()}
    parts["weight"] = parts["weight"].reshape(hidden, 6)
    return IntegerNetwork(**parts, offset=offset, slope=slope, skip=skip, k=k, j=j, t=t)


@pytest.mark.parametrize("language", ["c99", "c11", "c++11"])
def test_a_program_with_only_the_header_holds_the_model(source, tmp_path, language):
    shown = compiled(tmp_path, c_header(source), "our_model_v1_0", language)
    data = bytes(shown["ubm"][1:])
    assert data == source.data
    assert upbeam.Model(data).crc32 == source.crc32  # the C library loads it
    assert shown["row_max_count"][1:] == source.file.rules.row_max_count.tolist()
    assert shown["limits"][1:] == [source.file.rules.min_count, source.file.rules.max_count]
    for precision in PRECISIONS:
        assert shown[CONTRACTS[precision]][1] == weight_bytes(data)[precision]
        assert shown[f"{precision}_distance_W"][0] == 6 * (1 if precision == "int8" else 2)
        for which in NETWORKS:
            equal(network_of(shown, f"{precision}_{which}"), getattr(source.file.integer(precision), which))


def test_extreme_values_survive_c(extreme, tmp_path):
    shown = compiled(tmp_path, c_header(extreme), "extreme", "c99")
    assert shown["int16_distance_B"][1] == -(2**31)
    for precision in PRECISIONS:
        equal(network_of(shown, f"{precision}_distance"), extreme.file.integer(precision).distance)


def test_the_header_holds_the_precisions_asked_for(source, quantised):
    text = c_header(source, ["int8"])
    assert "int8_distance_W" in text
    assert "int16_distance_W" not in text
    bare = Source.of(replace(quantised, int16=None, int8=None).to_bytes(), "bare")
    assert "no integer networks" in c_header(bare)
    with pytest.raises(ExportError, match=r"bare: no int8 networks.*fp32.*upbeam quantize"):
        c_header(bare, ["int8"])


def test_provenance_cannot_end_the_comment(quantised, tmp_path):
    odd = replace(quantised, provenance={"note": "*/ #error\nübel /* */" + "x" * 500, "long": "y" * 190})
    odd_source = Source.of(odd.to_bytes(), "ödd")
    assert odd_source.identifier == "dd"
    compiled(tmp_path, c_header(odd_source), "dd", "c99")
    write_rtl(odd_source, tmp_path / "rtl")


# ----------------------------------------------------------------------------------------------- RTL memories


def read_memory(path, bits: int) -> np.ndarray:
    """As $readmemh: comments skipped, one value a line. Every value has its exact width."""
    lines = [line for line in path.read_text(encoding="ascii").splitlines() if not line.startswith("//")]
    assert all(re.fullmatch(f"[0-9a-f]{{{bits // 4}}}", line) for line in lines), path
    values = np.array([int(line, 16) for line in lines], dtype=np.int64)
    return np.where(values >= 1 << (bits - 1), values - (1 << bits), values)


def read_parameters(path) -> dict[str, int | str]:
    found: dict[str, int | str] = {}
    for line in path.read_text(encoding="ascii").splitlines():
        if line.startswith("//"):
            continue
        name, value = re.fullmatch(r"localparam (?:signed )?(?:\[\d+:0\] )?UPB_(\w+) = (.+);", line).groups()
        if value.startswith('"'):
            found[name] = value.strip('"')
        else:
            found[name] = int(value.split("'h")[1], 16) if "'h" in value else int(value)
    return found


def read_core(folder) -> tuple[IntegerModel, dict[str, int | str]]:
    p = read_parameters(folder / "upb_params.svh")
    narrow, bits = p["WEIGHT_BITS"], {"M": p["MINIMUM_BITS"], "B": p["BIAS_BITS"], "V": p["OUTPUT_BITS"]}
    networks = []
    for which in NETWORKS:
        scalars = {key: p[f"{which}_{key}".upper()] for key in ("k", "j", "t", "slope", "skip")}
        parts = {PARTS[x]: read_memory(folder / f"{which}_{x}.mem", width) for x, width in bits.items()}
        weight = read_memory(folder / f"{which}_W.mem", narrow).reshape(p[f"{which.upper()}_H"], 6)
        networks.append(IntegerNetwork(weight=weight, offset=p[f"{which.upper()}_C"], **parts, **scalars))
    return IntegerModel("int8" if p["BLOCK_CODE"] else "int16", *networks), p


@pytest.mark.parametrize("which", ["source", "extreme"])
def test_the_memories_are_the_networks(request, rng, tmp_path, which):
    source = request.getfixturevalue(which)
    manifest = write_rtl(source, tmp_path / "rtl")
    for precision in PRECISIONS:
        model, parameters = read_core(tmp_path / "rtl" / precision)
        expected = source.file.integer(precision)
        assert parameters["CONTRACT"] == model.contract == expected.contract
        assert parameters["MODEL_CRC32"] == source.crc32 == int(manifest["model_crc32"], 16)
        for name, top in (("distance", source.file.rules.max_count), ("intensity", 255)):
            made, want = getattr(model, name), getattr(expected, name)
            equal(made, want)
            windows = rng.integers(0, top + 1, (2000, 6))
            assert np.array_equal(network(made, precision, windows).y, network(want, precision, windows).y)


def test_the_parameters_are_the_rules(source, tmp_path):
    write_rtl(source, tmp_path / "rtl", ["int8"])
    assert sorted(path.name for path in (tmp_path / "rtl").iterdir()) == ["int8", "manifest.json"]
    _, p = read_core(tmp_path / "rtl" / "int8")
    rules = source.file.rules
    limits = struct.unpack("<32H", p["SEEN_MAX"].to_bytes(64, "little"))
    assert list(limits) == rules.row_max_count[::2].tolist()
    limits = struct.unpack("<31H", p["GIVEN_MAX"].to_bytes(62, "little"))
    assert list(limits) == rules.row_max_count[1:-1:2].tolist()
    assert (p["MIN_COUNT"], p["MAX_COUNT"], p["COLUMNS"]) == (rules.min_count, rules.max_count, rules.columns)
    flags = (rules.edge == "seam", rules.last_row == "empty", rules.empty == "fill")
    assert (p["EDGE_SEAM"], p["LAST_ROW_EMPTY"], p["EMPTY_FILL"]) == flags
    assert (p["DISTANCE_LARGEST_S"], p["INTENSITY_LARGEST_S"]) == (8, 0)  # bits(40000 - 1500) - 8, bits(255) - 8


def test_the_manifest_lists_every_file(source, tmp_path):
    made = write_rtl(source, tmp_path / "rtl")
    manifest = json.loads((tmp_path / "rtl" / "manifest.json").read_text())
    assert manifest == made
    assert manifest["model_bytes"] == len(source.data)
    files = {k: v for entry in manifest["precisions"].values() for k, v in entry["files"].items()}
    found = {str(path.relative_to(tmp_path / "rtl")): path for path in (tmp_path / "rtl").glob("*/*")}
    assert {name: path.stat().st_size for name, path in found.items()} == files
    for precision in PRECISIONS:
        entry = manifest["precisions"][precision]
        assert entry["contract"] == CONTRACTS[precision]
        assert entry["weight_bytes"] == weight_bytes(source.data)[precision]


def test_rtl_overwrites_nothing(source, tmp_path):
    (tmp_path / "old.txt").write_text("mine")
    with pytest.raises(ExportError, match="not empty"):
        write_rtl(source, tmp_path)
    with pytest.raises(ExportError, match="cannot be made into a folder"):
        write_rtl(source, tmp_path / "old.txt")
    assert [path.name for path in tmp_path.iterdir()] == ["old.txt"]
    bare = Source.of(replace(source.file, int16=None).to_bytes(), "bare")
    with pytest.raises(ExportError, match="no int16 networks"):
        write_rtl(bare, tmp_path / "new", ["int16"])
    assert not (tmp_path / "new").exists()


# ------------------------------------------------------------------------------------------------ command line


@pytest.fixture
def run(quantised, tmp_path, monkeypatch):
    """``upbeam export`` in an empty folder that holds the model ``made.ubm``."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "made.ubm").write_bytes(quantised.to_bytes())
    app = typer.Typer()
    app.command("export")(export)

    def call(*arguments: object):
        return CliRunner().invoke(app, [*map(str, arguments)])

    return call


@pytest.mark.parametrize(
    ("to", "made"),
    [
        ("onnx-dense", "made-dense.onnx"),
        ("onnx-folded", "made-folded.onnx"),
        ("onnx-image", "made-image.onnx"),
        ("onnx-qdq", "made-qdq.onnx"),
        ("c", "made.h"),
        ("rtl", "made-rtl"),
    ],
)
def test_every_target_is_written_and_described(run, tmp_path, to, made):
    few = ["--frames", 1] if to == "onnx-qdq" else []
    result = run("made.ubm", "--to", to, *few, "--json")
    assert result.exit_code == 0, result.output
    summary = json.loads(result.stdout)
    path = tmp_path / made
    assert (summary["output"], summary["to"]) == (made, to)
    assert int(summary["model_crc32"], 16) == struct.unpack("<I", (tmp_path / "made.ubm").read_bytes()[-4:])[0]
    size = path.stat().st_size if path.is_file() else sum(f.stat().st_size for f in path.glob("*/*"))
    assert summary["bytes"] == size
    if to.startswith("onnx"):
        assert summary["outputs"] == ["distance", "intensity"]


@pytest.mark.parametrize(
    ("arguments", "problem"),
    [
        (["made.ubm", "--to", "tflite"], "--to tflite: expected onnx-dense"),
        (["made.ubm", "--to", "c", "--network", "distance"], "--network has no meaning for --to c"),
        (["made.ubm", "--to", "onnx-image", "--precision", "int8"], "--precision has no meaning"),
        (["made.ubm", "--to", "rtl", "--method", "entropy"], "--method has no meaning"),
        (["made.ubm", "--to", "c", "--fold", "12"], "--fold has no meaning for --to c, only for rtl"),
        (["made.ubm", "--to", "rtl", "--fold", "13"], "FOLD 13: with 12 hidden units it must be 1 to 12, or 24"),
        (["made.ubm", "--to", "rtl", "--lanes", "5"], "LANES 5 does not divide FOLD 12"),
        (["made.ubm", "--to", "onnx-qdq", "--method", "guess", "--frames", "1"], "--method guess: expected minmax"),
        (["made.ubm", "--to", "onnx-folded", "--network", "colour"], "--network colour: expected distance, intensity"),
        (["made.ubm", "--to", "c", "--precision", "int4"], "--precision int4: expected int16 or int8"),
        (["made.ubm", "--to", "c", "-o", "no/such/x.h"], "folder no/such does not exist"),
        (["made.ubm", "--to", "c", "-o", "."], "is a folder"),
        (["missing.ubm", "--to", "c"], "missing.ubm"),
        (["made.ubm", "--to", "rtl", "-o", "."], "not empty"),
    ],
)
def test_errors_say_what_to_do(run, tmp_path, arguments, problem):
    result = run(*arguments)
    assert result.exit_code != 0
    assert problem in str(result.exception), result.output
    assert [path.name for path in tmp_path.iterdir()] == ["made.ubm"]


def test_a_precision_that_is_not_there(run, tmp_path, quantised):
    (tmp_path / "made.ubm").write_bytes(replace(quantised, int8=None).to_bytes())
    assert read_ubm(tmp_path / "made.ubm").precisions == ["fp32", "int16"]
    for to in ("c", "rtl"):
        result = run("made.ubm", "--to", to, "--precision", "int8")
        assert "no int8 networks in this model, it has fp32, int16" in str(result.exception)
