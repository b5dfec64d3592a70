"""Which variant is the fastest on a device: measured once, and recorded."""

from __future__ import annotations

import hashlib
import json
import os
import statistics
import tempfile
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from upbeam.model.rules import BEAMS, U8, U16
from upbeam.quant.ubm import ModelFile

from .device import DeviceInfo, OpenClError
from .program import Session, WindowProgram
from .source import source
from .variants import Variant, parse_variant, refinements, shapes

__all__ = ["Choice", "choose", "measure", "record_path"]

REPEATS = 15
WARM_UP = 3
ODD_PIXELS = 1e-4
"""Share of the generated points of a float variant that may differ from another's: sums that were fused otherwise."""


@dataclass(frozen=True)
class Choice:
    """The variant to use, and the median kernel time of each one that was measured, in milliseconds. Nothing was
    measured now if it came from the record."""

    variant: Variant
    kernel_ms: dict[str, float]
    from_record: bool


def record_path() -> Path:
    """The file of earlier choices, in the user's cache folder."""
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "upbeam" / "opencl.json"


def choose(session: Session, file: ModelFile, precision: str, columns: int, *, again: bool = False) -> Choice:
    """The recorded choice for this device, driver, shape of model and width, or (``again``: in any case) a new
    measurement, which is then recorded. Raises OpenClError if no variant works."""
    key = _key(session.info, file, precision, columns)
    record = _read_record()
    if not again and key in record:
        try:
            measured = {str(name): float(ms) for name, ms in record[key].items()}
            return Choice(parse_variant(min(measured, key=measured.__getitem__)), measured, True)
        except (AttributeError, TypeError, ValueError):
            pass  # not written by this version: measured again
    choice = _measured_choice(session, file, precision, columns)
    _write_record({**_read_record(), key: choice.kernel_ms})
    return choice


def measure(program: WindowProgram, distance: U16, intensity: U8, repeats: int = REPEATS) -> float:
    """Median time of the kernel, in milliseconds."""
    taken = []
    for _ in range(WARM_UP + repeats):
        program(distance, intensity)
        assert program.times is not None
        taken.append(program.times.kernel)
    return statistics.median(taken[WARM_UP:])


def _measured_choice(session: Session, file: ModelFile, precision: str, columns: int) -> Choice:
    is_cpu = session.info.kind == "cpu"
    trial = _Trial(session, file, precision, columns)
    trial.run(shapes(is_cpu, columns, int(session.device.max_work_group_size)))
    if trial.kernel_ms:
        trial.run(refinements(trial.best))
        return Choice(trial.best, {str(variant): ms for variant, ms in trial.kernel_ms.items()}, False)
    raise OpenClError(f"OpenCL device {session.info.name} runs no variant of the {precision} kernel: {trial.failure}")


class _Trial:
    """Measurements of variants on one random image. One that fails, or gives another image, is left out."""

    def __init__(self, session: Session, file: ModelFile, precision: str, columns: int) -> None:
        random = np.random.default_rng(20)
        counts = random.integers(0, file.rules.max_count + 1000, (BEAMS, columns))
        counts[random.random(counts.shape) < 0.2] = 0
        self._image = counts.astype(np.uint16), random.integers(0, 256, counts.shape).astype(np.uint8)
        self._arguments = session, file, precision, columns
        self._odd_pixels = ODD_PIXELS if precision == "fp32" else 0.0
        self._expected: tuple[U16, U8] | None = None
        self.kernel_ms: dict[Variant, float] = {}
        self.failure = ""

    @property
    def best(self) -> Variant:
        return min(self.kernel_ms, key=self.kernel_ms.__getitem__)

    def run(self, variants: Iterable[Variant]) -> None:
        for variant in variants:
            try:
                program = WindowProgram(*self._arguments, variant)
                if self._is_like_the_others(program(*self._image)):
                    self.kernel_ms[variant] = measure(program, *self._image)
            except OpenClError as error:
                self.failure = str(error)

    def _is_like_the_others(self, image: tuple[U16, U8]) -> bool:
        if self._expected is None:
            self._expected = image
        return all(np.mean(a != b) <= self._odd_pixels for a, b in zip(image, self._expected, strict=True))


def _key(info: DeviceInfo, file: ModelFile, precision: str, columns: int) -> str:
    """Device, driver and shape; not the weights: a retrained model is as fast."""
    hidden = "+".join(str(network.hidden) for network in file.folded)
    program = source(file, precision, Variant(1), columns)
    kernels = "".join(line for line in program.splitlines(keepends=True) if not line.startswith("#define UPB_"))
    digest = hashlib.sha256(kernels.encode()).hexdigest()[:12]
    return f"{info.platform} | {info.name} | {info.driver} | {precision} {hidden} x {columns} | kernels {digest}"


def _read_record() -> dict[str, dict[str, float]]:
    try:
        content = json.loads(record_path().read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}


def _write_record(record: dict[str, dict[str, float]]) -> None:
    """Atomically. A cache folder that cannot be written costs a measurement next time, no more."""
    path = record_path()
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile("w", dir=path.parent, delete=False, encoding="utf-8") as new:
            json.dump(record, new, indent=1, sort_keys=True)
        Path(new.name).replace(path)
    except OSError:
        return
