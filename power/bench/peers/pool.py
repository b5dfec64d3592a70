"""Peers in processes of their own: started with their settings, asked for times by turns, told to end."""

from __future__ import annotations

import contextlib
import gc
import importlib
import importlib.util
import multiprocessing
import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..contest import Candidate
from ..work import Work, check_image, check_windows
from .formulation import Formulation

__all__ = ["PEERS", "PeerError", "PeerInfo", "PeerPool", "missing_peers"]

ANSWER_S = 300.0
"""A peer that does not answer for so long (compilers take their time) is ended."""
TRIALS = 3


class PeerError(RuntimeError):
    """A peer's process failed; one line."""


@dataclass(frozen=True)
class PeerInfo:
    """A peer: its packages, how to install them, and what must be set before it is loaded."""

    title: str
    module: str
    packages: tuple[str, ...]
    extra: str
    environment: tuple[str, ...] = ()
    """variables that hold the number of threads"""
    binds: bool = False
    """has no option for threads: its process is bound to as many cores"""
    is_runtime: bool = False
    """counts as an inference runtime in ``fp32_vs_best_runtime``"""
    threads_matter: bool = True


_BLAS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")

PEERS = {
    "numpy": PeerInfo("NumPy", "numpy_peer", ("numpy",), "", _BLAS),
    "onnxruntime": PeerInfo("ONNX Runtime", "onnxruntime_peer", ("onnxruntime", "onnx"), "bench", is_runtime=True),
    "openvino": PeerInfo("OpenVINO", "openvino_peer", ("openvino", "onnx"), "bench", is_runtime=True),
    "jax": PeerInfo("JAX", "jax_peer", ("jax",), "bench", binds=True),
    "torch": PeerInfo("PyTorch", "torch_peer", ("torch",), "train", ("OMP_NUM_THREADS",), is_runtime=True),
    "opencl": PeerInfo(
        "upbeam OpenCL", "opencl_peer", ("pyopencl",), "opencl", ("POCL_MAX_PTHREAD_COUNT", "POCL_CPU_MAX_CU_COUNT")
    ),
}


def missing_peers(names: Sequence[str] = tuple(PEERS)) -> dict[str, str]:
    """Of ``names`` those that cannot run here, and what to install."""
    missing = {}
    for name in names:
        absent = [package for package in PEERS[name].packages if importlib.util.find_spec(package) is None]
        if absent:
            missing[name] = f"{', '.join(absent)} not installed: pip install 'upbeam[{PEERS[name].extra}]'"
    return missing


class PeerPool:
    """The processes of one benchmark. Use as a context: all are ended with it."""

    def __init__(self, work: Work, *, quick: bool = False) -> None:
        self._work = work
        self._quick = quick
        self._running: list[_Remote] = []
        self.notes: list[str] = []
        """what was refused, or failed"""
        self.sweeps: list[dict[str, Any]] = []
        """every setting that was tried, with the least time of a short trial"""

    def __enter__(self) -> PeerPool:
        return self

    def __exit__(self, *_: object) -> None:
        for remote in self._running:
            remote.end()

    def candidates(self, name: str, threads: int) -> list[Candidate]:
        """The best formulation of each family of the peer. What fails is in ``notes``."""
        remote = _Remote(name, threads, self._work, self._quick)
        self._running.append(remote)
        found: list[Candidate] = []
        try:
            for index in remote.formulations(self.notes):
                self._consider(remote, index)
            found = [remote.candidate(index) for index in remote.best.values()]
        except PeerError as error:
            self.notes.append(f"{PEERS[name].title}, {threads} threads: {error}")
        return found

    def _consider(self, remote: _Remote, index: int) -> None:
        """Checks one formulation and keeps it if it is the fastest of its family."""
        described = remote.described[index]
        try:
            remote.ask("check", index)
        except PeerError as error:
            self.notes.append(f"{described['name']}: refused, not timed: {error}")
            return
        least = float(np.min(remote.time(index, TRIALS)))
        self.sweeps.append(
            {"name": described["name"], "threads": remote.threads, "trial_ms": least / 1e6, **described["detail"]}
        )
        family = described["family"]
        rival = remote.best.get(family)
        if rival is None or least < remote.trial[rival]:
            remote.best[family] = index
            if rival is not None:
                remote.ask("drop", rival)
        else:
            remote.ask("drop", index)
        remote.trial[index] = least


class _Remote:
    """One peer's process, seen from here."""

    def __init__(self, name: str, threads: int, work: Work, quick: bool) -> None:
        context = multiprocessing.get_context("spawn")
        self.name, self.threads = name, threads
        self.described: list[dict[str, Any]] = []
        self.best: dict[str, int] = {}
        self.trial: dict[int, float] = {}
        self._connection, theirs = context.Pipe()
        self._process = context.Process(
            target=serve, args=(theirs, PEERS[name].module, threads, work, quick, PEERS[name].binds), daemon=True
        )
        with _environment({variable: str(threads) for variable in PEERS[name].environment}):
            self._process.start()
        theirs.close()

    def formulations(self, notes: list[str]) -> Iterator[int]:
        """Has them made one by one; yields their indices."""
        while True:
            made = self.ask("next")
            if made is None:
                return
            if "error" in made:
                notes.append(f"{PEERS[self.name].title}, {self.threads} threads: {made['error']}")
                return
            self.described.append(made)
            yield len(self.described) - 1

    def candidate(self, index: int) -> Candidate:
        made = self.described[index]
        detail = {**made["detail"], "family": made["family"]}
        return Candidate(
            made["name"], made["detail"].get("precision", "fp32"), self.threads, made["does"],
            lambda repeats: self.time(index, repeats), lambda: self.ask("check", index), self.name, detail,
        )  # fmt: skip

    def time(self, index: int, repeats: int) -> NDArray[np.uint64]:
        return np.asarray(self.ask("time", index, repeats), dtype=np.uint64)

    def ask(self, *request: Any) -> Any:
        """Raises PeerError for what went wrong there."""
        try:
            self._connection.send(request)
            if not self._connection.poll(ANSWER_S):
                self.end()
                raise PeerError(f"no answer for {ANSWER_S:g} s")
            is_good, answer = self._connection.recv()
        except (EOFError, OSError) as error:
            raise PeerError(f"its process ended ({type(error).__name__})") from None
        if not is_good:
            raise PeerError(str(answer))
        return answer

    def end(self) -> None:
        with contextlib.suppress(OSError, ValueError):
            self._connection.send(("end",))
        self._process.join(2)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()


@contextlib.contextmanager
def _environment(variables: dict[str, str]) -> Iterator[None]:
    """What a process that is started inherits."""
    before = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


# ---------------------------------------------------------------------------------------------- the peer's process


def serve(connection: Connection, module: str, threads: int, work: Work, quick: bool, binds: bool) -> None:
    """Answers requests until told to end."""
    _silence()
    if binds and hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[-threads:])
    server = _Server(module, threads, work, quick)
    while True:
        try:
            request, *arguments = connection.recv()
        except (EOFError, OSError):
            return
        if request == "end":
            return
        try:
            answer = True, server.answer(request, *arguments)
        except Exception as error:
            answer = False, f"{type(error).__name__}: {' '.join(str(error).split())[:300]}"
        connection.send(answer)


def _silence() -> None:
    """What libraries print belongs neither into the results nor into the messages."""
    sys.stdout.flush()
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for stream in (1, 2):
        os.dup2(nowhere, stream)


class _Server:
    def __init__(self, module: str, threads: int, work: Work, quick: bool) -> None:
        self._work = work
        self._arguments = module, threads, quick
        self._waiting: Iterator[Formulation] | None = None
        self._made: list[Formulation | None] = []

    def answer(self, request: str, *arguments: Any) -> Any:
        requests: dict[str, Callable[..., Any]] = {
            "next": self._next, "check": self._check, "time": self._time, "drop": self._drop,
        }  # fmt: skip
        return requests[request](*arguments)

    def _open(self) -> Iterator[Formulation]:
        module, threads, quick = self._arguments
        peer: Any = importlib.import_module(f"{__package__}.{module}")
        opened: Iterator[Formulation] = peer.formulations(self._work, threads, quick)
        return opened

    def _next(self) -> dict[str, Any] | None:
        try:
            self._waiting = self._waiting or self._open()
            made = next(self._waiting, None)
        except Exception as error:
            return {"error": f"{type(error).__name__}: {' '.join(str(error).split())[:300]}"}
        if made is None:
            return None
        self._made.append(made)
        return {"name": made.name, "family": made.family, "does": made.does, "detail": made.detail}

    def _check(self, index: int) -> None:
        made = self._get(index)
        made.run()
        if made.kind == "windows":
            check_windows(self._work, *made.output())
        else:
            check_image(self._work, made.detail.get("precision", "fp32"), *made.output())

    def _time(self, index: int, repeats: int) -> list[int]:
        made = self._get(index)
        run, own_clock = made.run, made.own_clock
        taken = []
        gc.disable()
        for _ in range(repeats):
            start = time.perf_counter_ns()
            run()
            taken.append(time.perf_counter_ns() - start if own_clock is None else round(own_clock()))
        gc.enable()
        return taken

    def _drop(self, index: int) -> None:
        self._made[index] = None

    def _get(self, index: int) -> Formulation:
        made = self._made[index]
        if made is None:
            raise PeerError("dropped: another of its family is faster")
        return made
