"""The bench: a sensor, a network with faults, a CAN bus, a serial line and a tester around one device, on one clock."""

from __future__ import annotations

import heapq
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from itertools import count
from typing import Any

import numpy as np

from upbeam.hw_sim.can import CanFrame, Received, SimulatedBus
from upbeam.hw_sim.can.commander import Command, Commander, Mode
from upbeam.hw_sim.can.database import Decoder
from upbeam.hw_sim.can.uds import UdsTester, VirtualConnection
from upbeam.hw_sim.faults import DeviceFault, apply_faults
from upbeam.hw_sim.sensor import DATA_PORT, POSITION_PORT, Datagram, RecordedSensor, SensorConfig, SimulatedSensor
from upbeam.hw_sim.serial.framing import RecordParser, encode_record

from .dut import KEY, Dut, NotPossibleError, Output
from .models import model_crc, model_file
from .network_dut import NetworkDut
from .record import Boot, Done, Record
from .scenario import Action, Scenario

__all__ = ["TICK_NS", "Bench", "RealTimeBench", "run_scenario"]

EXTENDED_SESSION = 3
LINGER_NS = 20_000_000
"""After the end, until the last frames are off the bus."""
TICK_NS = 5_000_000
"""Between two ticks of the device."""
FLIPPED_BIT = 30
"""A data bit of a short frame."""
ATTEMPTS_TO_BUS_OFF = 32
"""Failed attempts in a row: each adds 8 to the error counter, above 255 is bus-off."""
POLL_NS = 1_000_000
"""On the real clock the device is looked at this often."""
NOISE_NS = 10_000_000
"""Between two bursts of serial noise."""


@dataclass(order=True)
class _Planned:
    time_ns: int
    order: int
    act: Callable[[], None] = field(compare=False)


class Bench:
    """Runs on virtual time: the next thing that happens is the next event of bus, plan or sensor.

    Of events at one time the bus's come first, then the plan's in the order they were planned, then the sensor's.
    """

    def __init__(self, dut: Dut, stream: Iterator[Datagram], record: Record) -> None:
        self.dut = dut
        self.record = record
        self.now_ns = 0
        self.bus = SimulatedBus()
        self.device_node = self.bus.node("upbeam")
        self.tester = self.bus.node("tester")
        self.commander = Commander(KEY)
        self.decoder = Decoder()
        self.parser = RecordParser()
        self.powered = False
        self._stream = stream
        self._next: Datagram | None = next(stream, None)
        self._plan: list[_Planned] = []
        self._order = 0
        self._last_command: CanFrame | None = None
        self._drops: dict[str, int] = {}
        self._bus_was_off = False
        self._noise: dict[str, Any] | None = None
        self.device_node.listeners.append(self._device_hears)
        self.tester.listeners.append(self._tester_hears)

    # ------------------------------------------------------------------------------------------------------ time

    def at(self, time_ns: int, act: Callable[[], None]) -> None:
        """Plans something."""
        self._order += 1
        heapq.heappush(self._plan, _Planned(max(time_ns, self.now_ns), self._order, act))

    def advance_next(self, limit_ns: int) -> bool:
        """Lets the next thing happen, at most at ``limit_ns``; False if nothing was left before."""
        times = [self._plan[0].time_ns] if self._plan else []
        if self._next is not None:
            times.append(self._next.time_ns)
        soonest = min(times, default=limit_ns + 1)
        bus_ns = self.bus.next_event_ns()
        if bus_ns is not None and bus_ns <= min(soonest, limit_ns):
            self.now_ns = max(self.now_ns, bus_ns)
            self.bus.advance_next(bus_ns)
        elif soonest > limit_ns:
            self._move(limit_ns)
            return False
        else:
            self._move(soonest)
            self._act()
        self._watch_bus()
        return True

    def advance_to(self, time_ns: int) -> None:
        """Lets everything happen up to ``time_ns``."""
        while self.advance_next(time_ns):
            pass

    def _move(self, time_ns: int) -> None:
        self.now_ns = max(self.now_ns, time_ns)
        self.bus.advance_to(self.now_ns)

    def _act(self) -> None:
        if self._plan and (self._next is None or self._plan[0].time_ns <= self._next.time_ns):
            heapq.heappop(self._plan).act()
        else:
            datagram = self._next
            assert datagram is not None
            self._next = next(self._stream, None)
            self.deliver(datagram)

    # ----------------------------------------------------------------------------------------------------- device

    def power_on(self) -> None:
        """Gives the device power; a boot begins."""
        self.record.boots.append(Boot(self.now_ns))
        self.note("power on")
        self.powered = True
        self.dut.power_on(self.now_ns)
        self.collect()

    def power_off(self) -> None:
        """Cuts it: nothing is handed out, nothing is stored."""
        self.collect()
        boot = self.record.boots[-1]
        boot.status, boot.end_ns = self.dut.power_off(self.now_ns), self.now_ns
        self.powered = False
        self._drops = {}
        self.device_node.flush()
        self.note("power off")

    def deliver(self, datagram: Datagram) -> None:
        """A datagram reaches the device."""
        heard = datagram.port in (DATA_PORT, POSITION_PORT)
        if not (self.powered and heard):
            self.record.unheard += 1
            return
        boot = self.record.boots[-1]
        boot.delivered += datagram.port == DATA_PORT
        boot.positions += datagram.port == POSITION_PORT
        self.record.delivered.append(datagram)
        self.dut.datagram(datagram)
        self.collect()

    def tick(self) -> None:
        """Time passes on the device; the bench looks at its counters."""
        self.at(self.now_ns + TICK_NS, self.tick)
        if not self.powered:
            return
        self.dut.tick(self.now_ns)
        self.collect()
        drops = self.dut.status()["packets_dropped"]
        if drops != self._drops:
            self._drops = dict(drops)
            self.record.samples.append((self.now_ns, self._drops))

    def collect(self) -> None:
        """Takes what the device has sent, and passes it on."""
        begun_ns = self.record.boots[-1].start_ns
        for left in self.dut.take():
            output = left._replace(time_ns=max(left.time_ns, begun_ns))  # a core tells no time before its first call
            self.record.outputs.append(output)
            if output.kind == "can":
                self._send_on(output)
            elif output.kind == "serial":
                for frame in self.parser.feed(output.payload):
                    self._take_record(frame, output)

    def _send_on(self, output: Output) -> None:
        self.device_node.send(output.payload, max(output.time_ns, self.bus.now_ns))

    def _damage(self, settings: dict[str, Any] | None) -> None:
        self.device_node.tamper = None if settings is None else _damaged_crc(settings["share"])

    def _take_record(self, frame: CanFrame, output: Output) -> None:
        self.record.serial.append((output.time_ns, frame))
        answer = self.commander.response(frame)
        if answer is not None:
            self.record.answers.append((output.time_ns, "serial", answer))

    def _device_hears(self, received: Received) -> None:
        if received.sender != self.device_node.name and self.powered:
            self.dut.can(received.frame, max(received.time_ns, self.now_ns))
            self.collect()

    def _tester_hears(self, received: Received) -> None:
        if received.sender == self.tester.name:
            return
        decoded = self.decoder.decode(received.frame, received.time_ns)
        if decoded is None:
            return
        self.record.heard.append(decoded)
        answer = self.commander.response(received.frame)
        if answer is not None:
            self.record.answers.append((received.time_ns, "can", answer))

    def _watch_bus(self) -> None:
        off = self.device_node.counters.off
        if self.powered and off != self._bus_was_off:
            self.dut.bus_off(off)
            self._bus_was_off = off
            self.device_node.flush()
            self.note("bus off" if off else "bus on")

    def note(self, what: str) -> None:
        """Puts something the bench did on record."""
        self.record.done.append(Done(self.now_ns, what))

    # ----------------------------------------------------------------------------------------------------- faults

    def disturb(self, what: str, settings: dict[str, Any] | None) -> None:
        """Begins or ends a disturbance of a ``DeviceFault``."""
        self.note(f"{what} {'ends' if settings is None else settings}")
        if what == "reset" and settings is not None:
            self.power_off()
            self.at(self.now_ns + round(settings["off_ms"] * 1e6), self.power_on)
        elif what == "bus_off":
            self._break_bus(settings is not None)
        elif what == "wrong_crc":
            self._damage(settings)
        elif what == "serial_noise":
            self._noise = None if settings is None else settings
            if settings is not None:
                self._make_noise(np.random.default_rng([settings["seed"], 0x5E71]), settings)
        else:
            self.dut.disturb(what, settings)

    def _break_bus(self, broken: bool) -> None:
        """Each of the next frames has a wrong bit, until the device's controller has counted itself bus-off. It stays
        so until the fault ends: controllers wait for their driver."""
        self.device_node.auto_recover = not broken
        if broken:
            self.bus.flip_bit(FLIPPED_BIT, count=ATTEMPTS_TO_BUS_OFF)
        else:
            self.device_node.recover()

    def _make_noise(self, rng: np.random.Generator, settings: dict[str, Any]) -> None:
        if self._noise is not settings:
            return
        count = int(rng.poisson(settings["bytes_per_s"] * NOISE_NS * 1e-9))
        if self.powered and count:
            self.dut.serial(rng.bytes(count), self.now_ns)
            self.collect()
        self.at(self.now_ns + NOISE_NS, lambda: self._make_noise(rng, settings))

    # ---------------------------------------------------------------------------------------------------- actions

    def act(self, action: Action) -> None:
        """What the tester does."""
        self.note(f"{action.action} {action.settings}")
        settings = dict(action.settings)
        via = str(settings.pop("via", "can"))
        if action.action == "swap_model":
            self.dut.swap_model(model_file(str(settings["model"])), self.now_ns)
            self.collect()
        elif action.action == "serial_bytes":
            self.dut.serial(bytes.fromhex(settings["hex"]), self.now_ns)
            self.collect()
        elif action.action == "can_frame":
            self.send(
                CanFrame(settings["identifier"], bytes.fromhex(settings["hex"]), fd=settings.get("fd", False)), via
            )
        elif action.action.startswith("uds_"):
            self._diagnose(action.action)
        else:
            self.send(self._command_frame(action.action, settings), via)

    def send(self, frame: CanFrame, via: str = "can") -> None:
        """The tester sends a frame on the bus, or as a record on the serial line."""
        if via == "serial":
            self.dut.serial(encode_record(frame), self.now_ns)
            self.collect()
        else:
            self.tester.send(frame, max(self.now_ns, self.bus.now_ns))

    def command(self, settings: dict[str, Any], via: str = "can") -> None:
        """The tester sends an authentic command."""
        self.send(self._command_frame("command", settings), via)

    def _command_frame(self, action: str, settings: dict[str, Any]) -> CanFrame:
        if action == "replayed_command":
            if self._last_command is None:
                raise ValueError("replayed_command: no command was sent before")
            return self._last_command
        frame = self._build(settings, forged=action == "forged_command")
        if action == "damaged_command":
            return CanFrame(
                frame.identifier,
                bytes([frame.data[0] ^ 1]) + frame.data[1:],
                fd=True,
                bit_rate_switch=frame.bit_rate_switch,
            )
        if action == "command":
            self._last_command = frame
        return frame

    def _build(self, settings: dict[str, Any], *, forged: bool) -> CanFrame:
        code = Command[str(settings.get("what", "status")).upper()]
        argument, crc = 0, 0
        if code is Command.MODE:
            argument = 255 if settings["mode"] == "AUTOMATIC" else int(Mode[settings["mode"]])
        elif code is Command.MODEL:
            crc = model_crc(str(settings["model"]))
        elif code is Command.CLEAR_FAULTS:
            argument = int(settings.get("fault", 0))
        if forged:
            return self.commander.forge(
                code, self.commander.freshness + 1, argument=argument, model_crc32=crc, mac=bytes(8)
            )
        return self.commander.build(code, argument=argument, model_crc32=crc)

    def _diagnose(self, action: str) -> None:
        """Talks to the device; the bench's clock goes on meanwhile."""
        with UdsTester(VirtualConnection(self.bus, self.tester, self.advance_next)) as tester:
            if action == "uds_clear_faults":
                tester.session(EXTENDED_SESSION)
                tester.clear()
                result: list[str] = []
            else:
                result = [record.name for record in tester.faults() if record.confirmed]
        self.record.diagnostics.append((self.now_ns, action, result))


class RealTimeBench(Bench):
    """The same bench on the real clock, around a device on real wires.

    What is planned for a moment is done when the monotonic clock says so, or as soon after as can be
    (``lateness_ns``). CAN frames go over the device's own bus; the simulated one stays idle.
    """

    def __init__(self, dut: NetworkDut, stream: Iterator[Datagram], record: Record) -> None:
        super().__init__(dut, stream, record)
        self.network = dut
        self.lateness_ns: list[int] = []
        self._tamper: Callable[[CanFrame], CanFrame] | None = None

    def _move(self, time_ns: int) -> None:
        while (left := time_ns - self.network.now_ns()) > 0:
            time.sleep(min(left, POLL_NS) * 1e-9)
            self.collect()
        self.now_ns = max(self.now_ns, time_ns)
        self.bus.advance_to(self.now_ns)
        self.lateness_ns.append(max(0, -left))

    def _send_on(self, output: Output) -> None:
        frame = self._tamper(output.payload) if self._tamper else output.payload
        self._tester_hears(Received(output.time_ns, frame, self.device_node.name))

    def _damage(self, settings: dict[str, Any] | None) -> None:
        self._tamper = None if settings is None else _damaged_crc(settings["share"])

    def send(self, frame: CanFrame, via: str = "can") -> None:
        if via == "serial":
            super().send(frame, via)
        else:
            self.dut.can(frame, self.now_ns)

    def _diagnose(self, action: str) -> None:
        raise NotPossibleError(f"{self.dut.name}: diagnostics on the real clock are python-can's and udsoncan's own")


def _damaged_crc(share: float) -> Callable[[CanFrame], CanFrame]:
    debt = 0.0

    def tamper(frame: CanFrame) -> CanFrame:
        nonlocal debt
        debt += share
        if debt < 1 or not frame.data:
            return frame
        debt -= 1
        return replace(frame, data=bytes([frame.data[0] ^ 0x55]) + frame.data[1:])

    return tamper


def run_scenario(scenario: Scenario, dut: Dut) -> Record:
    """One scenario on one device, on virtual time or on the real clock as the device has it."""
    begun = time.perf_counter()
    record = Record(scenario.name, dut.name, dut.virtual)
    missing = scenario.disturbances - dut.can_do
    try:
        if missing:
            raise NotPossibleError(f"{dut.name} cannot do {', '.join(sorted(missing))}")
        _run(_bench(scenario, dut, record), scenario)
    except NotPossibleError as error:
        record.not_possible = str(error)
    finally:
        if isinstance(dut, NetworkDut):
            dut.close()
    record.seconds = time.perf_counter() - begun
    return record


def _bench(scenario: Scenario, dut: Dut, record: Record) -> Bench:
    stream = sensor_stream(scenario)
    if isinstance(dut, NetworkDut):
        return RealTimeBench(dut, iter(list(stream)), record)  # made before, to be sent in time
    return Bench(dut, stream, record)


def _run(bench: Bench, scenario: Scenario) -> None:
    record, dut = bench.record, bench.dut
    _plan(bench, scenario)
    bench.power_on()
    bench.tick()
    bench.advance_to(round(scenario.seconds * 1e9))
    dut.end(bench.now_ns)
    bench.collect()
    bench.advance_to(bench.now_ns + LINGER_NS)
    record.boots[-1].status, record.boots[-1].end_ns = dut.status(), bench.now_ns
    record.serial_refused = bench.parser.refused
    record.bus_load = bench.bus.load(0, bench.now_ns)
    if isinstance(bench, RealTimeBench):
        record.lateness_ns = bench.lateness_ns
        record.has_serial = bench.network.serial_port is not None


class _Replayed:
    """A simulated sensor whose datagrams are made once: scenarios share few sensors."""

    def __init__(self, sensor: SimulatedSensor) -> None:
        self._made: list[Datagram] = []
        self._rest = iter(sensor)

    def until(self, time_ns: int) -> Iterator[Datagram]:
        for k in count():
            if k == len(self._made):
                self._made.append(next(self._rest))
            if self._made[k].time_ns >= time_ns:
                return
            yield self._made[k]


@lru_cache(maxsize=4)
def _room(config: SensorConfig) -> _Replayed:
    return _Replayed(SimulatedSensor(config))


def sensor_stream(scenario: Scenario) -> Iterator[Datagram]:
    """What the network delivers: the sensor's datagrams with the scenario's faults."""
    end_ns = round(scenario.seconds * 1e9)
    if scenario.source == "room":
        sensor: _Replayed | RecordedSensor = _room(scenario.sensor)
    elif scenario.source.startswith("recording:"):
        sensor = RecordedSensor.open(scenario.source.removeprefix("recording:"))
    else:
        raise ValueError(f"sensor source {scenario.source!r}: expected room or recording:FILE")
    stream = apply_faults(sensor.until(end_ns), scenario.faults, scenario.sensor.beams, seed=scenario.seed)
    return (datagram for datagram in stream if datagram.time_ns < end_ns)


def _plan(bench: Bench, scenario: Scenario) -> None:
    for fault in scenario.faults:
        if isinstance(fault, DeviceFault):
            for moment in fault.moments():
                bench.at(round(moment.time_s * 1e9), partial(bench.disturb, moment.what, moment.settings))
    for action in scenario.actions:
        bench.at(round(action.at_s * 1e9), partial(bench.act, action))
