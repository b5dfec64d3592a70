"""Devices and CPU cores: figures from files, each with unit, kind and source. A bad file is refused with its line.

One file is one device (``power/devices/*.toml``, or a user's own). A figure is an inline table on one line::

    idle = { value = 1.6, low = 1.2, high = 2.5, unit = "W", kind = "assumption", source = "where it is from" }

``low`` and ``high`` may be left out where the figure is exact. ``kind``: ``data sheet``, ``measured by NAME`` or
``assumption``.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

from upbeam.model.toml_file import TomlError, parse_toml

from .cycles.cpu import CpuCore
from .figures import UNITS, Figure, FigureError
from .files import packaged

__all__ = ["CatalogueError", "Device", "Mode", "cpu_core", "device", "device_names", "read_device"]

FAMILIES = ("jetson", "fpga", "host")
_NAME = re.compile(r"[a-z0-9][a-z0-9-]*")
_MODE = re.compile(r"[a-z0-9][a-z0-9-]*")

# What a section may hold: a dimension of ``UNITS``, or ``text``.
_SECTIONS: dict[str, dict[str, str]] = {
    "": {"name": "text", "title": "text", "family": "text", "default_mode": "text", "note": "text"},
    "cpu": {"core": "text", "isa": "text", "cores": "number"},
    "memory": {"size": "memory", "bandwidth": "bandwidth"},
    "gpu": {"title": "text", "peak": "throughput", "peak_of": "text", "clock": "rate", "launch": "time"},
    "fpga": {
        "luts": "number",
        "ffs": "number",
        "multipliers": "number",
        "multiplier_width": "width",
        "ram": "memory",
        "clock": "rate",
    },
    "power": {
        "boundary": "text",
        "idle": "power",
        "cpu_active": "power",
        "mac_energy": "energy of work",
        "core_voltage": "voltage",
        "node": "length",
    },
    "scheduling": {"wakeup": "time"},
}
_MODE_KEYS = {"budget": "power", "cpu_cores": "number", "cpu_clock": "rate", "gpu_clock": "rate"}
_MODE_REQUIRED = ("cpu_cores", "cpu_clock", "gpu_clock")
_ABOVE_0 = ("rate", "bandwidth", "throughput", "time", "length")
"""Dimensions that are divided by: 0 makes no device."""
_REQUIRED = {
    "jetson": ("cpu.core", "cpu.isa", "memory.size", "memory.bandwidth", "gpu.peak", "gpu.clock", "gpu.launch",
               "power.boundary", "power.idle", "power.cpu_active", "power.node", "scheduling.wakeup"),
    "fpga": ("fpga.luts", "fpga.ffs", "fpga.multipliers", "fpga.ram", "fpga.clock", "power.boundary",
             "power.mac_energy", "power.node"),
    "host": ("cpu.core", "cpu.isa"),
}  # fmt: skip
_FIGURE_KEYS = {"value", "low", "high", "unit", "kind", "source"}


class CatalogueError(ValueError):
    """A device file that cannot be used: names file, line, key and what was expected."""


@dataclass(frozen=True)
class Mode:
    """A power mode of a module: limits on cores and clocks."""

    name: str
    figures: Mapping[str, Figure]

    def get(self, key: str) -> Figure | None:
        return self.figures.get(key)


@dataclass(frozen=True)
class Device:
    """One device. Keys of ``texts`` and ``figures`` are ``section.key``."""

    name: str
    title: str
    family: str
    path: str
    note: str = ""
    default_mode: str = ""
    texts: Mapping[str, str] = field(default_factory=dict)
    figures: Mapping[str, Figure] = field(default_factory=dict)
    modes: Mapping[str, Mode] = field(default_factory=dict)

    def figure(self, key: str) -> Figure:
        """Raises CatalogueError where the file has no such figure."""
        if key not in self.figures:
            raise CatalogueError(f"{self.path}: {self.name} has no figure {key}")
        return self.figures[key]

    def mode(self, name: str | None = None) -> Mode | None:
        """A power mode, the default one if not named; None for devices without modes. Raises CatalogueError."""
        if not self.modes:
            if name:
                raise CatalogueError(f"{self.name} has no power modes")
            return None
        if (name or self.default_mode) not in self.modes:
            raise CatalogueError(f"{self.name} has no mode {name!r}, known: {', '.join(self.modes)}")
        return self.modes[name or self.default_mode]

    def every_figure(self) -> Iterator[tuple[str, Figure]]:
        """Names and figures, those of modes as ``modes.NAME.key``."""
        yield from self.figures.items()
        for mode in self.modes.values():
            for key, figure in mode.figures.items():
                yield f"modes.{mode.name}.{key}", figure


@cache
def device_names() -> tuple[str, ...]:
    """Devices that come with the package."""
    return tuple(sorted(path.stem for path in packaged("devices").glob("*.toml")))


def device(name_or_path: str) -> Device:
    """A device by name, or of a file that ends in ``.toml``. Raises CatalogueError."""
    if name_or_path.endswith(".toml"):
        return read_device(Path(name_or_path))
    if name_or_path not in device_names():
        known = ", ".join(device_names())
        raise CatalogueError(f"no device {name_or_path!r}, known: {known}; or give a .toml file of your own")
    return _shipped(name_or_path)


@cache
def _shipped(name: str) -> Device:
    return read_device(packaged("devices", f"{name}.toml"))


def read_device(path: Path) -> Device:
    """Raises CatalogueError with the line of what is wrong."""
    return _Reader(path.name, _text_of(path)).device()


def _text_of(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except OSError as error:
        raise CatalogueError(f"{path}: {error.strerror}") from None
    except UnicodeDecodeError as error:
        raise CatalogueError(f"{path}: not UTF-8 text: {error.reason} at byte {error.start}") from None


# --------------------------------------------------------------------------------------------------------- reading


def _parse(name: str, text: str) -> dict[str, Any]:
    try:
        return parse_toml(name, text)
    except TomlError as error:
        raise CatalogueError(str(error)) from None


_HEADER = re.compile(r"\s*\[\s*([^\[\]]+?)\s*\]")
_KEY = re.compile(r"\s*([A-Za-z0-9_-]+)\s*=")


def _lines(text: str) -> dict[tuple[str, str], int]:
    """Where each section (key ``""``) and each of its keys stands, from 1."""
    found, section = {("", ""): 1}, ""
    for number, line in enumerate(text.splitlines(), 1):
        if header := _HEADER.match(line):
            section = header[1].replace('"', "")
            found[section, ""] = number
        elif key := _KEY.match(line):
            found[section, key[1]] = number
    return found


class _Reader:
    """One file, checked key by key."""

    def __init__(self, name: str, text: str) -> None:
        self._name = name
        self._lines = _lines(text)
        self._data = _parse(name, text)

    def device(self) -> Device:
        texts, figures = self._sections()
        family = texts.get("family", "")
        for key in ("name", "title", "family"):
            if not texts.get(key):
                raise self._error("", key, "is missing")
        if not _NAME.fullmatch(texts["name"]):
            raise self._error("", "name", f"{texts['name']!r}: expected lower-case letters, digits and hyphens")
        if family not in FAMILIES:
            raise self._error("", "family", f"{family!r}: expected one of {', '.join(FAMILIES)}")
        for key in _REQUIRED[family]:
            if key not in texts and key not in figures:
                section, _, name = key.partition(".")
                raise self._error(section, "", f"{name} is missing: a {family} device needs it")
        if family != "host" and "cpu.core" in texts and texts["cpu.core"] not in _cores():
            raise self._error("cpu", "core", f"{texts['cpu.core']!r}: expected one of {', '.join(_cores())}")
        top = {key: texts.pop(key, "") for key in ("name", "title", "family", "note", "default_mode")}
        device = Device(**top, path=self._name, texts=texts, figures=figures, modes=self._modes())
        if family == "jetson" and not device.modes:
            raise self._error("", "", "a jetson device needs at least one section [modes.NAME]")
        if device.modes and device.default_mode not in device.modes:
            expected = ", ".join(device.modes)
            raise self._error("", "default_mode", f"{device.default_mode!r}: expected one of {expected}")
        return device

    def _sections(self) -> tuple[dict[str, str], dict[str, Figure]]:
        texts: dict[str, str] = {}
        figures: dict[str, Figure] = {}
        for section, key, value in self._entries():
            if section not in _SECTIONS:
                known = ", ".join((*filter(None, _SECTIONS), "modes.NAME"))
                raise self._error(section, "", f"is unknown, expected one of: {known}")
            kind = _SECTIONS[section].get(key)
            if kind is None:
                raise self._error(section, key, f"is unknown, expected one of: {', '.join(_SECTIONS[section])}")
            name = f"{section}.{key}" if section else key
            if kind == "text":
                texts[name] = self._text(section, key, value)
            else:
                figures[name] = self._figure(section, key, value, kind)
        return texts, figures

    def _entries(self) -> Iterator[tuple[str, str, Any]]:
        """Every key but those of modes; what is no table stands in section ``""``."""
        for name, value in self._data.items():
            if name == "modes":
                continue
            if name in _SECTIONS[""] or not isinstance(value, dict):
                yield "", name, value
            else:
                if not value:
                    raise self._error(name, "", "is empty")
                for key, inner in value.items():
                    yield name, key, inner

    def _modes(self) -> dict[str, Mode]:
        found = {}
        modes = self._data.get("modes", {})
        if not isinstance(modes, dict):
            raise self._error("", "modes", "expected sections [modes.NAME]")
        for name, keys in modes.items():
            section = f"modes.{name}"
            if not isinstance(keys, dict) or not _MODE.fullmatch(name):
                raise self._error(section, "", "expected a section [modes.NAME], lower case")
            figures = {}
            for key, value in keys.items():
                if key not in _MODE_KEYS:
                    raise self._error(section, key, f"is unknown, expected one of: {', '.join(_MODE_KEYS)}")
                figures[key] = self._figure(section, key, value, _MODE_KEYS[key])
            for key in _MODE_REQUIRED:
                if key not in figures:
                    raise self._error(section, "", f"{key} is missing: a mode needs it")
            found[name] = Mode(name, figures)
        return found

    def _text(self, section: str, key: str, value: Any) -> str:
        if not isinstance(value, str) or not value.strip():
            raise self._error(section, key, f"{value!r}: expected a text")
        return value

    def _figure(self, section: str, key: str, value: Any, dimension: str) -> Figure:
        if not isinstance(value, dict):
            raise self._error(section, key, f"{value!r}: expected {{ value, unit, kind, source }}")
        unknown = sorted(set(value) - _FIGURE_KEYS)
        missing = [k for k in ("value", "unit", "kind", "source") if k not in value]
        if unknown or missing:
            what = f"has an unknown {unknown[0]!r}" if unknown else f"has no {missing[0]!r}"
            raise self._error(section, key, f"{what}: expected value, unit, kind, source, and low and high if need be")
        numbers: list[Any] = [value.get(k, value["value"]) for k in ("value", "low", "high")]
        for number in numbers:
            if isinstance(number, bool) or not isinstance(number, (int, float)) or not number >= 0:
                raise self._error(section, key, f"{number!r}: expected a number of at least 0")
            if number == 0 and dimension in _ABOVE_0:
                raise self._error(section, key, f"{number!r}: expected a number above 0")
        kind, unit, source = (value[k] for k in ("kind", "unit", "source"))
        if kind not in ("data sheet", "assumption") and not re.fullmatch(r"measured by \S.*", str(kind)):
            raise self._error(section, key, f"kind {kind!r}: expected 'data sheet', 'measured by NAME' or 'assumption'")
        if UNITS.get(str(unit), ("",))[0] != dimension:
            fitting = ", ".join(u for u, (d, _) in UNITS.items() if d == dimension)
            raise self._error(section, key, f"unit {unit!r}: expected one of {fitting}")
        try:
            central, low, high = (float(n) for n in numbers)
            return Figure(central, low, high, unit, kind, str(source))
        except FigureError as error:
            raise self._error(section, key, str(error)) from None

    def _error(self, section: str, key: str, reason: str) -> CatalogueError:
        line = self._lines.get((section, key)) or self._lines.get((section, "")) or 1
        where = f"[{section}] {key}".strip() if section else key
        return CatalogueError(f"{self._name}:{line}: {where}: {reason}" if where else f"{self._name}:{line}: {reason}")


# ----------------------------------------------------------------------------------------------------------- cores


@cache
def _cores() -> dict[str, CpuCore]:
    path = packaged("cycles", "cores.toml")
    data = parse_toml(path.name, path.read_text(encoding="utf-8"))
    return {name: CpuCore(name=name, **values) for name, values in data.items()}


def cpu_core(name: str) -> CpuCore:
    """A core whose figures are public (``power/cycles/cores.toml``). Raises CatalogueError."""
    if name not in _cores():
        raise CatalogueError(f"no CPU core {name!r}, known: {', '.join(_cores())}")
    return _cores()[name]
