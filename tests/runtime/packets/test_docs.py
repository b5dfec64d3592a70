"""The examples of docs/packets.md run, and its table of sensors is the library's."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

from upbeam.runtime.packets import sensor_info, sensor_names

ROOT = Path(__file__).resolve().parents[3]
TEXT = (ROOT / "docs" / "packets.md").read_text(encoding="utf-8")
CORPUS = Path(__file__).parent / "corpus"


def example(language: str) -> str:
    (code,) = re.findall(rf"```{language}\n(.*?)```", TEXT, flags=re.DOTALL)
    return str(code)


def test_the_python_example() -> None:
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", example("python")], capture_output=True, text=True, check=False
    )
    assert done.stderr == ""
    assert done.stdout.split() == ["hdl-32e", "180", "(69120,", "3)", "0"]


def test_the_c_example(tmp_path: Path) -> None:
    """Compiled with the library's sources, fed with packets of the corpus."""
    compiler = shutil.which("cc")
    assert compiler, "a C compiler is a prerequisite"
    (tmp_path / "example.c").write_text(example("c"))
    sources = sorted((ROOT / "runtime" / "packets").glob("*.c"))
    flags = ["-std=c11", "-Wall", "-Wextra", "-Werror", f"-I{ROOT / 'runtime' / 'include'}"]
    program = tmp_path / "example"
    subprocess.run([compiler, *flags, tmp_path / "example.c", *sources, "-lm", "-o", program], check=True)
    names = ("vlp-16_strongest", "vlp-16_dual", "hdl-32e_last")
    payloads = b"".join((CORPUS / f"{name}.bin").read_bytes() for name in names)
    done = subprocess.run([program], input=payloads, capture_output=True, check=True)
    assert done.stdout.decode().splitlines() == [
        "fine: 24 firings",
        "fine: 24 firings",
        "the packet is another sensor's than the one expected: 0 firings",
    ]


def test_the_table_of_sensors() -> None:
    rows = [[c.strip() for c in line.split("|")[1:-1]] for line in TEXT.splitlines() if re.match(r"\|[^|]*\| `", line)]
    assert [row[1].strip("`") for row in rows] == sensor_names()
    for row in rows:
        info = sensor_info(row[1].strip("`"))
        assert row[2:6] == [
            str(info.beams),
            f"{info.distance_unit_um // 1000} mm",
            row[4],
            str(info.packet_firings),
        ]
        assert float(row[4].removesuffix(" us")) * 1000 == info.firing_cycle_ns
