"""A pytest plugin: a bench with an upbeam device on it as fixtures (docs/hil.md).

    pytest -p upbeam.hw_sim.pytest_plugin    # or in conftest.py: pytest_plugins = ["upbeam.hw_sim.pytest_plugin"]

    def test_the_cable_is_pulled(dut, faults, clock):
        clock.run(0.5)
        faults.start("silence")
        clock.run(0.2)
        assert dut.faults == {"SENSOR_TIMEOUT"}

Fixtures: ``sensor``, ``dut``, ``can_bus``, ``serial_port``, ``clock``, ``faults``. The marker
``@pytest.mark.upbeam(sensor={...}, dut={...})`` gives settings. Time is virtual and stands still unless the test lets
it go on. Of a test that fails, the transcript stands in its report.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
import pytest

from upbeam.hw_sim.can import CanFrame
from upbeam.hw_sim.can.pythoncan import SimulatedInterface
from upbeam.hw_sim.faults import FAULTS, DeviceFault, PacketFault, make_fault
from upbeam.hw_sim.faults.base import Step
from upbeam.hw_sim.hil.bench import Bench
from upbeam.hw_sim.hil.dut import InProcessDut
from upbeam.hw_sim.hil.record import Event, Record
from upbeam.hw_sim.hil.transcript import transcript_lines
from upbeam.hw_sim.sensor import Datagram, SensorConfig, SimulatedSensor
from upbeam.hw_sim.serial.framing import encode_record
from upbeam.model.beams import BeamTable

__all__ = ["Clock", "DeviceView", "Faults", "SerialLine"]

_TRANSCRIPT_LINES = 200
"""The last ones stand in the report."""


def pytest_configure(config: pytest.Config) -> None:
    """Makes the marker known."""
    config.addinivalue_line("markers", "upbeam(sensor={}, dut={}): settings of the bench's sensor and device")


class Clock:
    """The bench's virtual time."""

    def __init__(self, bench: Bench) -> None:
        self._bench = bench

    @property
    def now(self) -> float:
        """Seconds since power on."""
        return self._bench.now_ns * 1e-9

    def run(self, seconds: float) -> None:
        """Lets everything happen for so long."""
        self._bench.advance_to(self._bench.now_ns + round(seconds * 1e9))

    def run_until(self, condition: Callable[[], object], timeout: float = 5.0) -> float:
        """Lets time go on until ``condition()`` is true, looking after every event; seconds it took. Raises
        TimeoutError."""
        begin = self._bench.now_ns
        limit = begin + round(timeout * 1e9)
        while not condition():
            if not self._bench.advance_next(limit) and not condition():
                raise TimeoutError(f"not within {timeout} s of virtual time")
        return (self._bench.now_ns - begin) * 1e-9


class Faults:
    """Faults that begin and end when the test says so."""

    def __init__(self, beams: BeamTable, seed: int = 0) -> None:
        self._beams = beams
        self._seed = seed
        self._active: dict[str, tuple[PacketFault, Step]] = {}
        self._bench: Bench | None = None

    def start(self, kind: str, **settings: Any) -> None:
        """Begins a fault (docs/faults.md). Errors: ValueError."""
        bench = self._on_bench()
        fault = make_fault({"kind": kind, **settings, "from_s": bench.now_ns * 1e-9})
        if isinstance(fault, PacketFault):
            rng = np.random.default_rng([self._seed, fault.seed, len(self._active)])
            self._active[kind] = (fault, fault.begin(self._beams, rng))
            bench.note(f"{kind} {settings}")
        elif isinstance(fault, DeviceFault):
            bench.disturb(kind, fault.settings())

    def stop(self, kind: str) -> None:
        """Ends it. Errors: ValueError for a kind that does not exist, or was not begun."""
        bench = self._on_bench()
        if issubclass(FAULTS.get(kind, PacketFault), DeviceFault):
            bench.disturb(kind, None)
            return
        if kind not in self._active:
            raise ValueError(f"fault {kind!r} was not begun; active: {', '.join(self._active) or 'none'}")
        fault, _ = self._active[kind]
        bench.note(f"{kind} ends")
        if fault.lasting:  # goes on with what it left behind: its step looks at the end
            object.__setattr__(fault, "until_s", bench.now_ns * 1e-9)
        else:
            del self._active[kind]

    def _on_bench(self) -> Bench:
        assert self._bench is not None
        return self._bench

    def _made_of(self, datagram: Datagram) -> list[Datagram]:
        """What the active faults make of one of the sensor's datagrams."""
        made = [datagram]
        for _, step in list(self._active.values()):
            made = [after for before in made for after in step(before)]
        return made


class _LiveBench(Bench):
    """A bench whose faults may change at any moment: the sensor is asked for one datagram at a time."""

    def __init__(self, dut: InProcessDut, sensor: SimulatedSensor, faults: Faults, record: Record) -> None:
        super().__init__(dut, iter(()), record)
        self._sensor = iter(sensor)
        self._faults = faults
        faults._bench = self
        self._pull()

    def _pull(self) -> None:
        datagram = next(self._sensor)
        self.at(datagram.time_ns, partial(self._arrive, datagram))

    def _arrive(self, datagram: Datagram) -> None:
        for made in self._faults._made_of(datagram):
            if made.time_ns > self.now_ns:
                self.at(made.time_ns, partial(self.deliver, made))
            else:
                self.deliver(made)
        self._pull()


@dataclass
class DeviceView:
    """The device, as a test looks at it."""

    _bench: Bench
    record: Record = field(repr=False)
    """All that has happened: columns, ledger, events, CAN (``upbeam.hw_sim.hil.Record``)."""

    @property
    def status(self) -> dict[str, Any]:
        """Counters and state."""
        return self._bench.dut.status()

    @property
    def faults(self) -> set[str]:
        """Active fault codes."""
        return set(self.status["faults"])

    @property
    def mode(self) -> str:
        """network, valid_mean, repeat or pass_through."""
        return str(self.status["mode"])

    @property
    def ledger(self) -> list[dict[str, Any]]:
        """Records of the frames closed so far."""
        return [output.payload for output in self.record.of_kind("ledger")]

    @property
    def events(self) -> list[Event]:
        """So far."""
        return Record(self.record.scenario, self.record.dut, True, outputs=self.record.outputs).events

    def command(self, what: str, *, via: str = "can", **settings: Any) -> None:
        """Sends an authentic command: status, mode, model or clear_faults."""
        self._bench.command({"what": what, **settings}, via)

    def power_cycle(self, off_s: float = 0.05) -> None:
        """Cuts the supply; only stored memory stays."""
        self._bench.disturb("reset", {"off_ms": off_s * 1e3})


class SerialLine:
    """The device's serial console."""

    def __init__(self, bench: Bench) -> None:
        self._bench = bench

    @property
    def received(self) -> list[CanFrame]:
        """Whole records that the device has sent."""
        return [frame for _, frame in self._bench.record.serial]

    def write(self, data: bytes) -> None:
        """Bytes to the device."""
        self._bench.dut.serial(data, self._bench.now_ns)
        self._bench.collect()

    def send(self, frame: CanFrame) -> None:
        """A record to the device."""
        self.write(encode_record(frame))


def _settings(request: pytest.FixtureRequest, key: str) -> dict[str, Any]:
    marker = request.node.get_closest_marker("upbeam")
    return dict(marker.kwargs.get(key, {})) if marker else {}


@pytest.fixture
def sensor(request: pytest.FixtureRequest) -> SimulatedSensor:
    """The simulated sensor on the bench: a VLP-32C at 20 Hz in a quick room, unless marked otherwise."""
    return SimulatedSensor(SensorConfig(**_settings(request, "sensor")))


@pytest.fixture
def faults(sensor: SimulatedSensor) -> Faults:
    """Begins and ends faults."""
    return Faults(sensor.config.beams)


@pytest.fixture
def _upbeam_bench(request: pytest.FixtureRequest, sensor: SimulatedSensor, faults: Faults) -> Bench:
    record = Record(request.node.name, "inprocess", True)
    device = InProcessDut({"sensor": sensor.config.model, **_settings(request, "dut")})
    bench = _LiveBench(device, sensor, faults, record)
    request.node.stash[_BENCH] = bench
    bench.power_on()
    bench.tick()
    return bench


@pytest.fixture
def clock(_upbeam_bench: Bench) -> Clock:
    """Lets virtual time go on."""
    return Clock(_upbeam_bench)


@pytest.fixture
def dut(_upbeam_bench: Bench) -> DeviceView:
    """The device under test."""
    return DeviceView(_upbeam_bench, _upbeam_bench.record)


@pytest.fixture
def can_bus(_upbeam_bench: Bench) -> Iterator[SimulatedInterface]:
    """A node of the simulated CAN bus as a python-can bus; ``recv(timeout)`` lets virtual time go on."""
    bus = SimulatedInterface(_upbeam_bench.bus, _upbeam_bench.bus.node("test"), _upbeam_bench.advance_next)
    yield bus
    bus.shutdown()


@pytest.fixture
def serial_port(_upbeam_bench: Bench) -> SerialLine:
    """The device's serial console."""
    return SerialLine(_upbeam_bench)


_BENCH = pytest.StashKey[Bench]()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Puts the transcript into the report of a test that fails."""
    report = yield
    if report.when == "call" and report.failed and _BENCH in item.stash:
        lines = list(transcript_lines(item.stash[_BENCH].record))
        left_out = len(lines) - _TRANSCRIPT_LINES
        head = [f"... {left_out} lines before"] if left_out > 0 else []
        report.sections.append(("upbeam transcript", "\n".join([*head, *lines[-_TRANSCRIPT_LINES:]])))
    return report
