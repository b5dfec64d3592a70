"""The README's examples really run: Python as it stands, C against the installed library, three ways of linking."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import upbeam

ROOT = Path(__file__).resolve().parent.parent
MODEL = ROOT / "quant" / "models" / "hdl-64e.ubm"


def example(language: str) -> str:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    (code,) = re.findall(rf"```{language}\n(.*?)```", text, flags=re.DOTALL)
    return code


def tool(name: str) -> str:
    beside = Path(sys.executable).with_name(name)
    path = str(beside) if beside.exists() else shutil.which(name)
    assert path, f"{name} is needed: make test installs cmake, and a C compiler is a prerequisite"
    return path


def run(*command, **options) -> str:
    done = subprocess.run(
        [str(c) for c in command], capture_output=True, text=True, timeout=300, check=False, **options
    )
    assert done.returncode == 0, f"{command}\n{done.stdout}\n{done.stderr}"
    return done.stdout


@pytest.fixture(scope="module")
def installed(tmp_path_factory) -> Path:
    """The C library alone, without Python, installed where an example finds it."""
    folder = tmp_path_factory.mktemp("library")
    run(
        tool("cmake"),
        "-S",
        ROOT,
        "-B",
        folder / "build",
        "-DUPBEAM_TESTS=OFF",
        "-DUPBEAM_WERROR=ON",
        "-DCMAKE_INSTALL_LIBDIR=lib",
    )
    run(tool("cmake"), "--build", folder / "build", "-j", "2")
    run(tool("cmake"), "--install", folder / "build", "--prefix", folder / "upbeam")
    (folder / "example.c").write_text(example("c"))
    return folder


def expected() -> str:
    """100 columns with one window seen; the first waits for its neighbour, the last is still pending."""
    model = upbeam.load_model()
    distance = np.zeros((32, 100), np.uint16)
    distance[15:17] = 5000
    out, _ = upbeam.Upsampler(model, columns=100)(distance, np.zeros((32, 100), np.uint8))
    return f"{int((out[31, :99] > 0).sum())} points generated\n"


def test_python_example():
    names: dict = {}
    exec(example("python"), names)
    assert names["distance64"].shape == names["intensity64"].shape == (64, 2048)
    assert len(example("python").strip().splitlines()) <= 6


def test_c_example_with_the_static_library(installed):
    library = installed / "upbeam"
    binary = installed / "static"
    run(
        "cc",
        "-std=c11",
        "-Wall",
        "-Wextra",
        "-Werror",
        installed / "example.c",
        "-I",
        library / "include",
        library / "lib/libupbeam.a",
        "-lm",
        "-o",
        binary,
    )
    assert run(binary, MODEL) == expected()


def test_c_example_through_find_package(installed):
    project = installed / "project"
    project.mkdir()
    (project / "CMakeLists.txt").write_text(
        "cmake_minimum_required(VERSION 3.16)\nproject(example C)\nfind_package(upbeam REQUIRED)\n"
        "add_executable(example ../example.c)\ntarget_link_libraries(example upbeam::upbeam)\n"
    )
    run(tool("cmake"), "-S", project, "-B", project / "build", f"-DCMAKE_PREFIX_PATH={installed / 'upbeam'}")
    run(tool("cmake"), "--build", project / "build")
    assert run(project / "build" / "example", MODEL) == expected()


def test_pkg_config_names_the_installed_files(installed):
    text = (installed / "upbeam/lib/pkgconfig/upbeam.pc").read_text()
    assert f"Version: {upbeam.__version__}" in text
    assert "-lupbeam" in text
    if shutil.which("pkg-config"):
        environment = {"PKG_CONFIG_PATH": str(installed / "upbeam/lib/pkgconfig"), "PATH": "/usr/bin:/bin"}
        flags = run("pkg-config", "--cflags", "--libs", "upbeam", env=environment).split()
        run("cc", installed / "example.c", *flags, "-o", installed / "packaged")


def test_the_installed_tree_is_what_a_firmware_team_needs(installed):
    names = {str(p.relative_to(installed / "upbeam")) for p in (installed / "upbeam").rglob("*") if p.is_file()}
    assert {"include/upbeam/upbeam.h", "lib/libupbeam.a", "lib/libupbeam.so"} <= names


def test_links_of_the_documents_exist():
    for page in [ROOT / "README.md", *(ROOT / "docs").glob("*.md")]:
        for target in re.findall(r"\]\(([^)#]+)\)", page.read_text(encoding="utf-8")):
            if "://" not in target:
                assert (page.parent / target).exists(), f"{page.name} links to {target}, which does not exist"


def test_memory_figures_are_those_of_the_library():
    """One source: what the C library says. Python, the README and the model file agree with it."""
    model = upbeam.load_model()
    (row,) = [
        line for line in (ROOT / "README.md").read_text(encoding="utf-8").splitlines() if "| memory, bytes |" in line
    ]
    sizes = {precision: model.sizes(precision) for precision in model.precisions}
    assert f"model file {len(model.data):,};" in row
    for precision, size in sizes.items():
        assert f"{size['weights']} ({precision})" in row
    assert f"state of a stream {sizes['int8']['state']:,} without" in row
    assert {size["file"] for size in sizes.values()} == {len(model.data)}
