"""``upb_top`` simulated: registers through AXI4-Lite, columns through the streams. What software for the board sees."""

from __future__ import annotations

import ctypes
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from upbeam.kernels.registers import RegisterMap, read_map
from upbeam.quant.export.rtl import configuration, core_headers
from upbeam.quant.export.source import Source
from upbeam.quant.integer import Precision

from .beats import U32, U64, OutputColumns, output_columns
from .core import SimulationError
from .simulators import build_top

__all__ = ["RegisterError", "Top"]

HARNESS = "top_harness.cpp"
_FAILURES = {
    1: "m_axis did not hold what it offered",
    3: "the B channel did not hold what it offered",
    4: "the R channel did not hold what it offered",
    5: "a write was answered before it was whole",
    6: "a read was answered before it was asked",
}
_SLVERR = 2


class RegisterError(SimulationError):
    """An access that the core answered with SLVERR."""


class Top:
    """One simulated core. Its clock runs while a call says so, and while a register is read or written."""

    def __init__(
        self,
        source: Source,
        precision: Precision,
        *,
        fold: int | None = None,
        lanes: int = 1,
        writable: bool = False,
        destagger: bool = False,
        clock_hz: int = 0,
        seed: int = 1,
    ) -> None:
        """Built once, kept in the user's cache. Raises ExportError, ConfigurationError and ToolError."""
        self.configuration = configuration(source.integer(precision), fold=fold, lanes=lanes)
        self.map: RegisterMap = read_map()
        headers = core_headers(source, precision, fold=fold, lanes=lanes)
        parameters = {"WRITABLE": int(writable), "DESTAGGER": int(destagger), "CLOCK_HZ": clock_hz}
        self.program = library(headers, parameters)
        self.library = _load(self.program)
        self.handle = ctypes.c_void_p(self.library.upb_sim_new(ctypes.c_uint64(seed)))

    def close(self) -> None:
        if self.handle:
            self.library.upb_sim_delete(self.handle)
            self.handle = ctypes.c_void_p()

    def __enter__(self) -> Top:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # ------------------------------------------------------------------------------------------------ registers

    def read_at(self, address: int) -> int:
        """Raises RegisterError where the core refuses."""
        value = ctypes.c_uint32()
        self._answered(
            self.library.upb_sim_access_read(self.handle, address, ctypes.byref(value)), f"read of {address:#x}"
        )
        return value.value

    def write_at(self, address: int, value: int, strobe: int = 15) -> None:
        response = self.library.upb_sim_access_write(self.handle, address, value & 0xFFFFFFFF, strobe)
        self._answered(response, f"write of {value:#x} to {address:#x}")

    def read(self, name: str, field: str | None = None) -> int:
        register = self.map[name]
        value = self.read_at(register.address)
        if field is None:
            return value
        found = next(f for f in register.fields if f.name == field)
        return (value & found.mask) >> found.low

    def write(self, name: str, value: int) -> None:
        self.write_at(self.map[name].address, value)

    def events(self) -> set[str]:
        """Names of the flags that are set."""
        value = self.read("EVENTS")
        return {f.name for f in self.map["EVENTS"].fields if value & f.mask}

    def mask(self, *events: str) -> int:
        return sum(f.mask for f in self.map["EVENTS"].fields if f.name in events)

    # -------------------------------------------------------------------------------------------------- streams

    def traffic(self, gap: float = 0.0, stall: float = 0.0, *, stuck: bool = False) -> None:
        """Shares of the clocks at which the source offers nothing new, and the sink is not ready; or takes nothing."""
        self.library.upb_sim_traffic(self.handle, round(gap * 65536), round(stall * 65536), int(stuck))

    def feed(self, beats: U32) -> None:
        """Beats for the source, behind those that still wait."""
        data = np.ascontiguousarray(beats, np.uint32).reshape(-1)
        self.library.upb_sim_feed(self.handle, data.ctypes.data_as(ctypes.c_void_p), ctypes.c_size_t(len(data)))

    def clocks(self, count: int) -> None:
        self.library.upb_sim_clocks(self.handle, ctypes.c_uint64(count))
        self._sound()

    def drain(self, quiet: int | None = None) -> None:
        """Runs until nothing has moved for ``quiet`` clocks; several slots of the pipeline if omitted."""
        quiet = quiet or 80 * self.configuration.interval + 500
        before = None
        while before != (now := (self.waiting, self.given)):
            before = now
            self.clocks(quiet)

    def take(self) -> U64:
        """What the sink has taken since the last call: beats in the harness's format."""
        beats = np.zeros(self.given, np.uint64)
        self.library.upb_sim_take(self.handle, beats.ctypes.data_as(ctypes.c_void_p))
        return beats

    def columns(self) -> OutputColumns:
        return output_columns(self.take())

    def may_drop(self, yes: bool) -> None:
        """CONTROL.ENABLE is about to fall: what m_axis offers may then be withdrawn."""
        self.library.upb_sim_may_drop(self.handle, int(yes))

    @property
    def waiting(self) -> int:
        return int(self.library.upb_sim_waiting(self.handle))

    @property
    def given(self) -> int:
        return int(self.library.upb_sim_given(self.handle))

    @property
    def irq(self) -> bool:
        return bool(self.library.upb_sim_irq(self.handle))

    @property
    def clock(self) -> int:
        return int(self.library.upb_sim_clock(self.handle))

    @property
    def last_taken(self) -> int:
        """Clock at which the core took its last input beat."""
        return int(self.library.upb_sim_last_taken(self.handle))

    @property
    def last_given(self) -> int:
        """Clock at which the sink took the last output beat."""
        return int(self.library.upb_sim_last_given(self.handle))

    def _answered(self, response: int, what: str) -> None:
        self._sound()
        if response == _SLVERR:
            raise RegisterError(f"{what}: SLVERR")
        if response != 0:
            raise SimulationError(f"{what}: " + ("no answer" if response < 0 else f"response {response}"))

    def _sound(self) -> None:
        failure = self.library.upb_sim_failure(self.handle)
        if failure:
            raise SimulationError(_FAILURES[failure])


def library(headers: Mapping[str, str], parameters: Mapping[str, int]) -> Path:
    harness = resources.files("upbeam.hw_sim").joinpath("fpga").joinpath(HARNESS).read_text()
    return build_top(headers, parameters, HARNESS, harness)


def _load(path: Path) -> Any:
    found = ctypes.CDLL(str(path))
    found.upb_sim_new.restype = ctypes.c_void_p
    for name in ("waiting", "given", "clock", "last_taken", "last_given"):
        getattr(found, f"upb_sim_{name}").restype = ctypes.c_uint64
    return found
