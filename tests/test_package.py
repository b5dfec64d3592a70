"""The package as a whole: its layers, its stub, its version."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import upbeam
from upbeam.runtime import _native

ROOT = Path(__file__).resolve().parent.parent


def test_one_version_everywhere():
    assert upbeam.__version__ == _native.version()
    cmake = (ROOT / "CMakeLists.txt").read_text()
    assert f"VERSION {upbeam.__version__} " in cmake
    assert f"## {upbeam.__version__}" in (ROOT / "CHANGELOG.md").read_text()


def signatures(stub: Path) -> dict[str, list[str]]:
    """Names and arguments: the text around them differs between versions of the generator."""
    found = {}
    for node in ast.walk(ast.parse(stub.read_text())):
        if isinstance(node, ast.ClassDef):
            found[node.name] = sorted(
                f"{m.name}({', '.join(a.arg for a in m.args.args)})"
                for m in node.body
                if isinstance(m, ast.FunctionDef)
            )
        elif isinstance(node, ast.FunctionDef):
            found.setdefault("functions", []).append(f"{node.name}({', '.join(a.arg for a in node.args.args)})")
    return {name: sorted(values) for name, values in found.items()}


def test_the_stub_is_what_the_extension_offers(tmp_path):
    """``make stubs`` writes it anew."""
    made = tmp_path / "_native.pyi"
    done = subprocess.run(
        [sys.executable, "-m", "nanobind.stubgen", "-m", "upbeam.runtime._native", "-o", str(made), "-q"],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert signatures(made) == signatures(ROOT / "runtime" / "_native.pyi")


def test_deploying_needs_no_training_package():
    """Importing the package, its command line and the simulator loads neither PyTorch nor matplotlib."""
    code = "import sys, upbeam.cli.main, upbeam.hw_sim; print([m for m in ('torch', 'matplotlib') if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
