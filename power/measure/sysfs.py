"""Sensors below ``/sys``: INA3221 rails (both kernel drivers) and RAPL energy counters. ``root`` is for tests."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

__all__ = ["RaplDomain", "rapl_domains", "rapl_energy_j", "read_rails"]

_NOT_CONNECTED = "NC"
_CHANNELS = 3
"""Of an INA3221; the driver's further voltages are shunts, and the sum of shunts."""


def _text(path: Path) -> str | None:
    try:
        return path.read_text(encoding="ascii", errors="replace").strip()
    except OSError:
        return None


def _number(path: Path) -> float | None:
    text = _text(path)
    return float(text) if text is not None and re.fullmatch(r"-?\d{1,18}", text) else None


def read_rails(root: Path = Path("/")) -> dict[str, float]:
    """Power of each rail, W, by name; empty without a sensor. Rails not connected or not readable are absent."""
    rails = dict(_hwmon_rails(root))
    return rails or dict(_iio_rails(root))


def _hwmon_rails(root: Path) -> Iterator[tuple[str, float]]:
    """JetPack 5 and later: millivolts and milliamperes."""
    for folder in sorted(root.glob("sys/bus/i2c/devices/*/hwmon/hwmon*")):
        if "ina" not in (_text(folder / "name") or "ina3221"):
            continue
        for channel in range(1, _CHANNELS + 1):
            name = _text(folder / f"in{channel}_label")
            volts, amperes = _number(folder / f"in{channel}_input"), _number(folder / f"curr{channel}_input")
            if name and name != _NOT_CONNECTED and volts is not None and amperes is not None:
                yield name, max(0.0, volts * amperes * 1e-6)


def _iio_rails(root: Path) -> Iterator[tuple[str, float]]:
    """JetPack 4: milliwatts."""
    for folder in sorted(root.glob("sys/bus/i2c/drivers/ina3221x/*/iio:device*")):
        for channel in range(_CHANNELS):
            name = _text(folder / f"rail_name_{channel}")
            milliwatts = _number(folder / f"in_power{channel}_input")
            if name and name != _NOT_CONNECTED and milliwatts is not None:
                yield name, max(0.0, milliwatts * 1e-3)


# ------------------------------------------------------------------------------------------------------------ RAPL


@dataclass(frozen=True)
class RaplDomain:
    """An energy counter. ``psys`` is the whole platform and holds the packages."""

    name: str
    path: Path
    range_j: float
    """it wraps round to 0 there"""


def rapl_domains(root: Path = Path("/")) -> list[RaplDomain]:
    """The packages, or ``psys`` alone where there is one: never a total with its parts. Empty if none can be read."""
    found = []
    for folder in sorted(root.glob("sys/class/powercap/intel-rapl:*")):
        if folder.name.count(":") != 1:
            continue
        name, energy = _text(folder / "name"), _number(folder / "energy_uj")
        limit = _number(folder / "max_energy_range_uj")
        if name and energy is not None and limit:
            found.append(RaplDomain(name, folder, limit * 1e-6))
    return [d for d in found if d.name == "psys"] or [d for d in found if d.name.startswith("package")]


def rapl_energy_j(domain: RaplDomain, before_j: float) -> tuple[float, float]:
    """The counter now, and the energy since it stood at ``before_j``, J. One wrap is seen, two are not: read it more
    often than it wraps. Raises OSError where it went away."""
    text = (domain.path / "energy_uj").read_text(encoding="ascii")
    now = float(text) * 1e-6
    return now, now - before_j if now >= before_j else now + domain.range_j - before_j
