"""Measures the shipped model's quantisation anew and writes the tables and pictures of quantisation.md.

    python docs/make_quantisation.py FOLDER [MODEL]

FOLDER: KITTI .bin frames to judge on. Minutes of one core. ONNX Runtime is compared with where it is installed.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

DOCS = Path(__file__).resolve().parent
PAGE = DOCS / "quantisation.md"
PICTURES = {"error_map": "quantisation_error", "error_growth": "quantisation_growth"}
MARKS = "<!-- measured -->", "<!-- end of measured -->"


def main(folder: str, model: str = "hdl-64e") -> None:
    with tempfile.TemporaryDirectory() as report:
        command = ["quantize", model, "--evaluate", folder, "--compare-schemes", "--report", report]
        subprocess.run([str(Path(sys.executable).with_name("upbeam")), *command], check=True)
        tables = Path(report, "quantize.md").read_text(encoding="utf-8")
        for name, kept in PICTURES.items():
            shutil.copy(Path(report, f"{name}.png"), DOCS / "images" / f"{kept}.png")
    page = PAGE.read_text(encoding="utf-8")
    replaced, count = re.subn(f"(?s){MARKS[0]}.*?{MARKS[1]}", lambda _: f"{MARKS[0]}\n\n{tables}\n{MARKS[1]}", page)
    if count != 1:
        raise SystemExit(f"{PAGE}: expected the marks {' and '.join(MARKS)} once")
    PAGE.write_text(replaced, encoding="utf-8")


if __name__ == "__main__":
    if len(sys.argv) not in (2, 3):
        raise SystemExit(__doc__)
    main(*sys.argv[1:])
