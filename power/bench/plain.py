"""The same networks as plain C, vectorised by this machine's own compilers: compiled now, checked, then timed."""

from __future__ import annotations

import ctypes
import platform
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from upbeam.model.rules import BEAMS, PAIRS
from upbeam.quant.quantize import difference_network

from . import _native
from .contest import Candidate
from .work import Work, check_image

__all__ = ["COMPILERS", "FLAGS", "Built", "CompileError", "build_all", "plain_candidate"]

COMPILERS = ("gcc", "clang")
_FLAGS_X86 = (
    ("-O3", "-march=native", "-mprefer-vector-width=512"),
    ("-O3", "-march=native", "-mprefer-vector-width=512", "-ffast-math"),
    ("-Ofast", "-march=native", "-mprefer-vector-width=512", "-funroll-loops"),
)
_FLAGS_OTHER = (("-O3", "-mcpu=native"), ("-O3", "-mcpu=native", "-ffast-math"))
FLAGS = _FLAGS_X86 if platform.machine() in ("x86_64", "AMD64") else _FLAGS_OTHER
"""Sets of flags to try; the fastest counts. A set that a compiler does not know is left out, and that is said."""
SHAPES = {0: "all units of a window", 1: "one unit at a time"}
_FOLDER = Path(__file__).parent / "c"
_PRECISIONS = ("fp32", "int16", "int8")
_COLUMNS_MAX = 8192


class CompileError(RuntimeError):
    """What the compiler said, in one line."""


@dataclass(frozen=True)
class Built:
    """One compiled library."""

    compiler: str
    version: str
    flags: tuple[str, ...]
    shape: int
    library: Any = field(repr=False)

    @property
    def name(self) -> str:
        return f"{self.compiler} {' '.join(self.flags)}, {SHAPES[self.shape]}"


def build_all(hidden: int, folder: Path, *, quick: bool = False) -> tuple[list[Built], list[str]]:
    """Every compiler with every set of flags and both shapes of the loop; what is missing, in words. ``quick``: one
    set and one shape."""
    built: list[Built] = []
    notes: list[str] = []
    for compiler in COMPILERS:
        path = shutil.which(compiler)
        if path is None:
            notes.append(f"{compiler}: not on this machine, no comparison with it")
            continue
        for flags, shape in _settings(quick):
            try:
                built.append(_build(compiler, path, flags, shape, hidden, folder))
            except CompileError as error:
                notes.append(f"{compiler} {' '.join(flags)}: {error}")
    return built, notes


def _settings(quick: bool) -> Iterator[tuple[tuple[str, ...], int]]:
    for flags in FLAGS[1:2] if quick else FLAGS:
        for shape in (0,) if quick else SHAPES:
            yield flags, shape


def _build(compiler: str, path: str, flags: tuple[str, ...], shape: int, hidden: int, folder: Path) -> Built:
    library = folder / f"plain_{compiler}_{FLAGS.index(flags)}_{shape}.so"
    unit = library.with_suffix(".o")
    defines = (f"-DHIDDEN={hidden}", f"-DSHAPE={shape}")
    _compile(path, *flags, *defines, "-fPIC", "-c", "-o", str(unit), str(_FOLDER / "plain_windows.c"))
    # Linked without the flags: given -ffast-math, gcc and clang link crtfastmath.o, a constructor that makes the thread
    # that loads the library treat subnormal numbers as zero, in all its code and for good.
    _compile(path, "-shared", "-o", str(library), str(unit), "-lm")
    version = subprocess.run([path, "-dumpfullversion", "-dumpversion"], capture_output=True, text=True, check=False)
    return Built(compiler, version.stdout.strip(), flags, shape, _load(library))


def _compile(*command: str) -> None:
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    if done.returncode:
        raise CompileError(" ".join(done.stderr.split())[:300] or f"status {done.returncode}")


def _load(library: Path) -> ctypes.CDLL:
    """Raises RuntimeError where loading it makes this thread treat subnormal numbers as zero."""
    kept = _keeps_subnormals()
    loaded = ctypes.CDLL(str(library))
    if kept and not _keeps_subnormals():
        raise RuntimeError(f"{library.name}: loading it made this process treat subnormal numbers as zero")
    return loaded


def _keeps_subnormals() -> bool:
    return sys.float_info.min / 2 > 0.0


def plain_candidate(built: Built, work: Work, precision: str) -> Candidate:
    """Raises ValueError where the frame is wider than the plain code's rows, or the networks differ in size."""
    job = _Job(built, work, precision)

    def check() -> None:
        job.time(1)
        check_image(work, precision, job.out_distance, job.out_intensity)

    detail = {"compiler": built.compiler, "version": built.version, "flags": " ".join(built.flags)}
    return Candidate(
        f"plain C {precision}, {built.name}", precision, 1,
        "all rules, both networks: counts of image rows in, generated counts out",
        job.time, check, "compiler", detail | {"shape": SHAPES[built.shape]},
    )  # fmt: skip


class _Job:
    """The ``plain_job`` of plain_windows.c, and the arrays it points to."""

    def __init__(self, built: Built, work: Work, precision: str) -> None:
        self._built = built
        self.distance, self.intensity = (np.ascontiguousarray(x) for x in (work.distance, work.intensity))
        self.out_distance = np.zeros((PAIRS, work.columns), np.uint16)
        self.out_intensity = np.zeros((PAIRS, work.columns), np.uint8)
        hidden = {net.hidden for net in work.file.folded}
        if len(hidden) > 1 or work.columns > _COLUMNS_MAX:
            raise ValueError(f"plain C takes two networks of one size and at most {_COLUMNS_MAX} columns")
        kind = _structure(hidden.pop())
        if ctypes.sizeof(kind) != built.library.plain_job_bytes():
            raise RuntimeError("plain_windows.c and plain.py differ in their layout of plain_job")
        self._job = kind()
        self._fill(work, precision)

    def time(self, repeats: int) -> Any:
        call = ctypes.cast(self._built.library.plain_run, ctypes.c_void_p).value
        assert call is not None
        return _native.time_call(call, ctypes.addressof(self._job), repeats)

    def _fill(self, work: Work, precision: str) -> None:
        job, rules = self._job, work.file.rules
        if rules.empty != "fill":
            raise ValueError("plain C knows the rule 'fill' for empty pixels only")
        job.min_count, job.columns, job.precision = rules.min_count, work.columns, _PRECISIONS.index(precision)
        job.seen_max[:] = [int(x) for x in rules.row_max_count[0::2]]
        job.given_max[:] = [int(x) for x in rules.row_max_count[1::2]]
        for name in ("distance", "intensity", "out_distance", "out_intensity"):
            setattr(job, name, getattr(self, name).ctypes.data)
        if precision == "fp32":
            _fill_float(job, work)
        else:
            _fill_integer(job, work, precision)


def _structure(hidden: int) -> Any:
    def network(number: Any) -> list[tuple[str, Any]]:
        return [("weight", number * 7 * hidden), ("bias", number * hidden), ("output", number * hidden)]

    class PlainFloat(ctypes.Structure):
        _fields_ = [*network(ctypes.c_float), *((x, ctypes.c_float) for x in ("slope", "skip", "offset"))]

    class PlainInt(ctypes.Structure):
        _fields_ = [
            *network(ctypes.c_int32), *((x, ctypes.c_int32) for x in ("k", "j", "t", "slope", "skip", "offset")),
        ]  # fmt: skip

    class PlainJob(ctypes.Structure):
        _fields_ = [
            ("f32", PlainFloat * 2),
            ("integer", PlainInt * 2),
            ("seen_max", ctypes.c_int32 * BEAMS),
            ("given_max", ctypes.c_int32 * BEAMS),
            *((x, ctypes.c_int32) for x in ("min_count", "columns", "precision")),
            *((x, ctypes.c_void_p) for x in ("distance", "intensity", "out_distance", "out_intensity")),
        ]

    return PlainJob


def _fill_float(job: Any, work: Work) -> None:
    for which, unit in enumerate((work.file.rules.distance_unit_m, 1.0)):
        net = difference_network(work.file.folded[which], unit)
        out = job.f32[which]
        weights = np.concatenate([net.weight, net.minimum[:, None]], axis=1)
        for h, row in enumerate(weights):
            out.weight[h][:] = row.tolist()
        out.bias[:], out.output[:] = net.bias.tolist(), net.output.tolist()
        out.slope, out.skip, out.offset = net.slope, net.skip, net.offset


def _fill_integer(job: Any, work: Work, precision: str) -> None:
    for which, net in enumerate(work.source.integer("int16" if precision == "int16" else "int8")):
        out = job.integer[which]
        for h in range(net.hidden):
            out.weight[h][:] = [*(int(x) for x in net.weight[h]), int(net.minimum[h])]
        out.bias[:], out.output[:] = ([int(x) for x in values] for values in (net.bias, net.output))
        for name in ("k", "j", "t", "slope", "skip", "offset"):
            setattr(out, name, int(getattr(net, name)))
