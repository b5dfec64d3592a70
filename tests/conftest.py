"""One seed a session, shown in the header; the real LiDAR data, if this machine has it."""

from __future__ import annotations

import os
import sys
import zlib
from collections.abc import Iterator
from pathlib import Path

import hypothesis
import numpy as np
import pytest

DEFAULT_SEED = 20
ROOT = Path(__file__).resolve().parent.parent

# Wall-clock time is never asserted; no example database, so that a seed alone tells what ran.
hypothesis.settings.register_profile("upbeam", deadline=None, database=None, print_blob=True)
hypothesis.settings.load_profile("upbeam")


def _seed() -> int:
    text = os.environ.get("UPBEAM_SEED", str(DEFAULT_SEED))
    try:
        return int(text)
    except ValueError:
        raise pytest.UsageError(f"UPBEAM_SEED is {text!r}: expected a whole number") from None


def _data_dir() -> Path:
    return Path(os.environ.get("UPBEAM_DATA") or ROOT.parent / "shared" / "data")


@pytest.hookimpl(tryfirst=True)
def pytest_configure(config: pytest.Config) -> None:
    """Hand the session's seed to hypothesis, unless its own option names one."""
    if config.getoption("--hypothesis-seed", None) is None:
        config.option.hypothesis_seed = str(_seed())


def pytest_report_header(config: pytest.Config) -> list[str]:
    seed = f"seed: {_seed()} (UPBEAM_SEED), hypothesis seed: {config.option.hypothesis_seed}"
    data = _data_dir()
    return [seed, f"real data: {data if data.is_dir() else f'none ({data} is not a folder; UPBEAM_DATA)'}"]


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """What passed tests printed: measured figures, seeds, counts. (Failed ones show theirs anyway.)

    Not of tests that run pytest themselves: their summaries, failures they mean included, would be taken for ours."""
    passed = [r for r in terminalreporter.getreports("passed") if r.when == "call" and r.capstdout.strip()]
    printed = [r for r in passed if "test session starts" not in r.capstdout]
    if printed:
        terminalreporter.section("printed by the tests")
    for report in printed:
        test = report.nodeid.split("::", 1)[1]
        for line in report.capstdout.strip().splitlines():
            terminalreporter.write_line(f"{test}: {line}")


@pytest.fixture
def rng(request: pytest.FixtureRequest) -> np.random.Generator:
    """Random numbers of this test's own, from the session's seed: the same alone and in any order."""
    return np.random.default_rng([_seed() % 2**32, zlib.crc32(request.node.nodeid.encode())])


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """The folder of real LiDAR data (``kitti/``, ``packets/``, ``sensor_calibration/``)."""
    data = _data_dir()
    if not data.is_dir():
        pytest.skip(f"no real LiDAR data: {data} is not a folder (set UPBEAM_DATA)")
    return data


@pytest.fixture(autouse=True)
def _subnormals_kept() -> Iterator[None]:
    """A library that flushes subnormals in this thread breaks later tests far from the cause: it fails here."""
    yield
    assert sys.float_info.min / 2 > 0.0, "this test, or one of its fixtures, made subnormal numbers count as zero"
