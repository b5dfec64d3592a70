"""The sensors of this machine, and recordings with them."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from . import tegrastats
from .rails import MeasureError, Recording, mean_rails, total_power
from .sysfs import RaplDomain, rapl_domains, rapl_energy_j, read_rails

__all__ = ["Sensor", "find_sensors", "record"]

_INTERVAL_S = 0.5


@dataclass(frozen=True)
class Sensor:
    """Something that knows power."""

    name: str
    """``ina3221``, ``rapl`` or ``tegrastats``"""
    boundary: str
    detail: str


def find_sensors(root: Path = Path("/")) -> list[Sensor]:
    """Best first; empty where there is none."""
    found = []
    rails = read_rails(root)
    if rails:
        found.append(Sensor("ina3221", total_power(rails)[1], ", ".join(rails)))
    domains = rapl_domains(root)
    if domains:
        found.append(Sensor("rapl", _rapl_boundary(domains), ", ".join(d.name for d in domains)))
    if shutil.which("tegrastats"):
        found.append(Sensor("tegrastats", "as its rails say", "the tool of Jetson modules"))
    return found


def no_sensor(root: Path = Path("/")) -> str:
    """Why there is no number, for people."""
    locked = any(root.glob("sys/class/powercap/intel-rapl:*"))
    return (
        "no power sensor that can be read: "
        + ("the processor's energy counter (RAPL) is for root alone" if locked else "no INA3221, no RAPL")
        + ", no tegrastats"
    )


def record(
    seconds: float,
    *,
    root: Path = Path("/"),
    interval_s: float = _INTERVAL_S,
    sleep: Callable[[float], None] = time.sleep,
    clock: Callable[[], float] = time.monotonic,
) -> Recording:
    """The total power for that long, by the best sensor. Raises MeasureError where there is none."""
    sensors = find_sensors(root)
    if not sensors:
        raise MeasureError(no_sensor(root))
    if sensors[0].name == "tegrastats":
        return tegrastats.record_live(seconds, interval_s)
    if sensors[0].name == "rapl":
        return _record_rapl(rapl_domains(root), seconds, interval_s, sleep, clock)
    return _record_rails(root, seconds, interval_s, sleep, clock)


def _rapl_boundary(domains: list[RaplDomain]) -> str:
    return "platform (RAPL psys)" if domains[0].name == "psys" else f"processor package x {len(domains)} (RAPL)"


def _record_rails(
    root: Path, seconds: float, interval_s: float, sleep: Callable[[float], None], clock: Callable[[], float]
) -> Recording:
    samples, skipped, start = [], 0, clock()
    names = frozenset(read_rails(root))
    while clock() - start < seconds:
        sleep(interval_s)
        rails = read_rails(root)
        if frozenset(rails) == names:
            samples.append(rails)
        else:
            skipped += 1
    if not samples:
        raise MeasureError(f"ina3221: none of {skipped} readings was complete")
    boundary = total_power(samples[0])[1]
    watts = tuple(total_power(rails)[0] for rails in samples)
    return Recording(watts, clock() - start, boundary, "INA3221", mean_rails(samples), skipped)


def _record_rapl(
    domains: list[RaplDomain], seconds: float, interval_s: float, sleep: Callable[[float], None],
    clock: Callable[[], float],
) -> Recording:  # fmt: skip
    start = last = clock()
    counters = [rapl_energy_j(d, 0.0)[0] for d in domains]
    watts: list[float] = []
    means = dict.fromkeys((d.name for d in domains), 0.0)
    while clock() - start < seconds:
        sleep(interval_s)
        now, joules = clock(), 0.0
        for k, domain in enumerate(domains):
            counters[k], used = rapl_energy_j(domain, counters[k])
            joules += used
            means[domain.name] += used
        watts.append(joules / (now - last))
        last = now
    whole = last - start
    return Recording(tuple(watts), whole, _rapl_boundary(domains), "RAPL", {k: v / whole for k, v in means.items()})
