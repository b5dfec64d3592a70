"""Devices at the end of real wires: packets over UDP, CAN over python-can, a serial line. Time is the real clock's."""

from __future__ import annotations

import json
import select
import signal
import socket
import subprocess
import tempfile
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol

import can

from upbeam.hw_sim.can import CanFrame
from upbeam.hw_sim.can.database import Decoder
from upbeam.hw_sim.can.pythoncan import UdpInterface, from_message, to_message
from upbeam.hw_sim.sensor import DATA_PORT, POSITION_PORT, Datagram
from upbeam.hw_sim.serial.pty import PtyPair
from upbeam.runtime.daemon import UPBEAMD

from .dut import KEY, NotPossibleError, Output
from .models import model_file

__all__ = ["HardwareDut", "NetworkDut", "ProcessDut", "SerialPort"]

_READY_S = 20.0
_END_S = 20.0
_BUFFER_BYTES = 8 << 20
_ON_ITS_WAY_S = 0.01
_SETTLE_S = 0.05
"""After the device's end, for datagrams that are still on their way."""


class SerialPort(Protocol):
    """A pyserial port, or the end of a pty."""

    timeout: float | None

    def read(self, size: int = 1, /) -> bytes: ...

    def write(self, data: bytes, /) -> int | None: ...


class NetworkDut:
    """What the bench and any real device share: sockets, a CAN bus, a serial line, and threads that read them.

    Everything that arrives is stamped with this machine's monotonic clock, counted from power on.
    """

    virtual = False

    def __init__(self, name: str, can_do: frozenset[str]) -> None:
        self.name = name
        self.can_do = can_do
        self.data_address: tuple[str, int] = ("127.0.0.1", DATA_PORT)
        self.position_address: tuple[str, int] = ("127.0.0.1", POSITION_PORT)
        self.can_bus: can.BusABC | None = None
        self.serial_port: SerialPort | None = None
        self.start_ns: int | None = None
        self._columns = _listen()
        self._sender = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._left: list[Output] = []
        self._lock = threading.Lock()
        self._stop = threading.Event()
        self._threads: list[threading.Thread] = []

    @property
    def columns_port(self) -> int:
        """Where the column stream must go."""
        return int(self._columns.getsockname()[1])

    def now_ns(self) -> int:
        """Of the bench's clock."""
        return 0 if self.start_ns is None else time.monotonic_ns() - self.start_ns

    def open(self) -> None:
        """Begins to listen, once."""
        if self.start_ns is None:
            self.start_ns = time.monotonic_ns()
        if not self._threads:
            self._stop.clear()
            self._threads = [
                threading.Thread(target=loop, daemon=True)
                for loop in (self._read_columns, self._read_can, self._read_serial)
            ]
            for thread in self._threads:
                thread.start()

    def close(self) -> None:
        """Ends listening, closes what is open."""
        self._stop.set()
        for thread in self._threads:
            thread.join()
        self._threads = []
        self._columns.close()
        self._sender.close()
        if self.can_bus is not None:
            self.can_bus.shutdown()
            self.can_bus = None

    def _put(self, kind: str, payload: Any, time_ns: int | None = None) -> None:
        with self._lock:
            self._left.append(Output(kind, self.now_ns() if time_ns is None else time_ns, payload))

    def _read_columns(self) -> None:
        while not self._stop.is_set():
            if not select.select([self._columns], [], [], 0.02)[0]:
                continue
            try:
                while True:
                    self._put("columns", self._columns.recv(2048))
            except BlockingIOError:
                pass

    def _read_can(self) -> None:
        while not self._stop.is_set():
            message = self.can_bus.recv(0.02) if self.can_bus is not None else None
            if message is not None and not message.is_error_frame:
                self._put("can", from_message(message))
            elif self.can_bus is None:
                self._stop.wait(0.02)

    def _read_serial(self) -> None:
        while not self._stop.is_set():
            port = self.serial_port
            if port is None:
                self._stop.wait(0.02)
                continue
            port.timeout = 0.02
            data = port.read(512)
            if data:
                self._put("serial", data)

    # ------------------------------------------------------------------------------------------------------- Dut

    def power_on(self, time_ns: int) -> None:
        raise NotImplementedError

    def power_off(self, time_ns: int) -> dict[str, Any]:
        raise NotImplementedError

    def swap_model(self, ubm: bytes, time_ns: int) -> None:
        raise NotImplementedError

    def status(self) -> dict[str, Any]:
        raise NotImplementedError

    def end(self, time_ns: int) -> None:
        raise NotImplementedError

    def datagram(self, datagram: Datagram) -> None:
        address = self.data_address if datagram.port == DATA_PORT else self.position_address
        self._sender.sendto(datagram.payload, address)

    def can(self, frame: CanFrame, time_ns: int) -> None:
        if self.can_bus is None:
            raise NotPossibleError(f"{self.name}: no CAN bus")
        self.can_bus.send(to_message(frame))

    def serial(self, data: bytes, time_ns: int) -> None:
        if self.serial_port is None:
            raise NotPossibleError(f"{self.name}: no serial line")
        self.serial_port.write(data)

    def tick(self, time_ns: int) -> None:
        """Time passes without help."""

    def bus_off(self, off: bool) -> None:
        raise NotPossibleError(f"{self.name}: its CAN controller is its own")

    def disturb(self, what: str, settings: dict[str, Any] | None) -> None:
        raise NotPossibleError(f"{self.name}: cannot do {what}")

    def take(self) -> list[Output]:
        with self._lock:
            left, self._left = self._left, []
        return left


def _listen() -> socket.socket:
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER_BYTES)
    sock.bind(("127.0.0.1", 0))
    sock.setblocking(False)
    return sock


def _free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.1", 0))
        return int(sock.getsockname()[1])


_KEYS = {
    "deadline_ns": "deadline_ms", "ladder_up_ns": "ladder_up_ms", "ladder_hold_ns": "ladder_hold_ms",
    "stale_ns": "stale_ms", "timeout_ns": "timeout_ms", "jitter_ns": "jitter_ms",
}  # fmt: skip
"""Settings of the core in nanoseconds, and of the process in milliseconds."""
_LADDER = ("ladder_mean_ms", "ladder_repeat_ms", "ladder_pass_ms")
_VIRTUAL_ONLY = frozenset({"service_ns", "queue_packets"})


class ProcessDut(NetworkDut):
    """``upbeamd`` as a process of its own, over loopback, a pty, and CAN frames in UDP datagrams."""

    def __init__(self, settings: Mapping[str, Any], sabotage: str | None = None, executable: Path = UPBEAMD) -> None:
        if not executable.is_file():
            raise NotPossibleError(f"{executable}: not built (upbeamd needs Linux)")
        impossible = _VIRTUAL_ONLY & set(settings)
        if impossible:
            raise NotPossibleError(f"process: {', '.join(sorted(impossible))} are of virtual time")
        super().__init__("process", frozenset({"serial_noise", "reset", "wrong_crc"}))
        self._executable = executable
        self._settings = dict(settings)
        self._sabotage = sabotage
        self._scratch = tempfile.TemporaryDirectory(prefix="upbeam-hil-")
        self.folder = Path(self._scratch.name)
        self._pty = PtyPair()
        self.serial_port = self._pty
        self._process: subprocess.Popen[str] | None = None
        self._messenger: threading.Thread | None = None
        self._can_port = _free_port()
        self._seen_ns = 0
        self._status: dict[str, Any] = _EMPTY_STATUS
        self.messages: list[str] = []
        """What it wrote to standard error."""

    def power_on(self, time_ns: int) -> None:
        self.data_address, self.position_address = ("127.0.0.1", _free_port()), ("127.0.0.1", _free_port())
        if self.can_bus is None:
            self.can_bus = UdpInterface(peer=("127.0.0.1", self._can_port))
        config = self.folder / "upbeamd.conf"
        config.write_text("".join(f"{key} = {value}\n" for key, value in self._config().items()), encoding="utf-8")
        self._process = subprocess.Popen(
            [self._executable, "--config", config], stderr=subprocess.PIPE, text=True
        )  # its own files and sockets only
        self._wait_until_ready(self._process)
        self.open()

    def _config(self) -> dict[str, Any]:
        settings = dict(self._settings)
        sensor = str(settings.pop("sensor", "vlp-32c"))
        model = str(settings.pop("model", sensor))
        assert isinstance(self.can_bus, UdpInterface)
        (self.folder / "models").mkdir(exist_ok=True)
        (self.folder / "models" / "another.ubm").write_bytes(model_file(f"another {model}"))
        (self.folder / "model.ubm").write_bytes(model_file(model))
        (self.folder / "key").write_text(KEY.hex() + "\n")
        (self.folder / "key").chmod(0o600)
        host, port = self.can_bus.address
        chosen: dict[str, Any] = {
            "sensor": sensor, "model": self.folder / "model.ubm", "models": self.folder / "models",
            "listen": "{}:{}".format(*self.data_address), "position_listen": "{}:{}".format(*self.position_address),
            "columns": f"127.0.0.1:{self.columns_port}", "can": f"udp:{self._can_port}:{host}:{port}",
            "serial": self._pty.device, "key": self.folder / "key", "state": self.folder,
            "json": self.folder / "status.json", "json_ms": 20, "ledger": self.folder / "ledger.jsonl",
            "ring_packets": 16384,
        }  # fmt: skip
        if self._sabotage is not None:
            chosen["sabotage"] = self._sabotage
        for key, value in settings.items():
            chosen.update(_process_settings(key, value))
        return chosen

    def _wait_until_ready(self, process: subprocess.Popen[str]) -> None:
        assert process.stderr is not None
        deadline = time.monotonic() + _READY_S
        while time.monotonic() < deadline:
            line = process.stderr.readline()
            self.messages.append(line.rstrip())
            if "ready" in line:
                self._messenger = threading.Thread(target=self._read_messages, args=(process,), daemon=True)
                self._messenger.start()
                return
            if not line and process.poll() is not None:
                break
        raise RuntimeError(f"upbeamd did not become ready: {' | '.join(self.messages)}")

    def _read_messages(self, process: subprocess.Popen[str]) -> None:
        assert process.stderr is not None
        with process.stderr as lines:
            self.messages += [line.rstrip() for line in lines]

    def power_off(self, time_ns: int) -> dict[str, Any]:
        """A kill: what it had not written is lost, and its counters with it."""
        self._running().kill()
        self._wait()
        return self.status()

    def _wait(self) -> None:
        """Until the process has ended and its last words are read."""
        process = self._running()
        process.wait(_END_S)
        self._process = None
        if self._messenger is not None:
            self._messenger.join()
            self._messenger = None
        self._take_ledger()

    def _running(self) -> subprocess.Popen[str]:
        if self._process is None:
            raise RuntimeError("upbeamd does not run")
        return self._process

    def swap_model(self, ubm: bytes, time_ns: int) -> None:
        (self.folder / "model.ubm").write_bytes(ubm)
        self._running().send_signal(signal.SIGHUP)

    def status(self) -> dict[str, Any]:
        """From the file it writes every 20 ms, and at its end."""
        path = self.folder / "status.json"
        try:
            changed = path.stat().st_mtime_ns
            if changed != self._seen_ns:
                told = json.loads(path.read_text(encoding="utf-8"))
                self._seen_ns = changed
                self._status = {**told, **told["counters"]}
        except (FileNotFoundError, json.JSONDecodeError):
            pass  # not written yet
        return self._status

    def end(self, time_ns: int) -> None:
        self._running().send_signal(signal.SIGTERM)
        self._wait()
        time.sleep(_SETTLE_S)

    def close(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._wait()
        super().close()
        self._pty.close()
        self._scratch.cleanup()

    def _take_ledger(self) -> None:
        """Records and events of the file, their times on the bench's clock."""
        path = self.folder / "ledger.jsonl"
        if not path.exists():
            return
        for line in path.read_text(encoding="utf-8").splitlines():
            try:
                told = json.loads(line)
            except json.JSONDecodeError:
                continue  # the last line of a killed process
            if "event" in told:
                event = {"kind": told["event"], "a": 0, "b": 0, "value": 0, **told}
                self._put("event", event, told["time_ns"] - (self.start_ns or 0))
            else:
                self._put("ledger", told, told["output_ns"] - (self.start_ns or 0))
        path.unlink()


_EMPTY_STATUS: dict[str, Any] = {"packets_dropped": {}, "faults": [], "ended": False}
_MODES = ("network", "valid_mean", "repeat", "pass_through")


def _process_settings(key: str, value: Any) -> dict[str, Any]:
    """A setting of the core as the process calls it."""
    if key == "ladder_down_ns":
        return {name: ns / 1e6 for name, ns in zip(_LADDER, value, strict=True)}
    if key in _KEYS:
        return {_KEYS[key]: value / 1e6}
    if key == "source_ipv4":
        return {"source": ".".join(str(value >> shift & 255) for shift in (24, 16, 8, 0))}
    return {key: value}


class HardwareDut(NetworkDut):
    """A device on real wires, described by a TOML file (docs/hil.md). It is known by CAN alone: faults, modes, ledger
    and counters are those it tells there."""

    def __init__(self, path: Path, told: Mapping[str, Any]) -> None:
        unknown = set(told) - {"sensor", "columns_port", "can", "serial", "baudrate", "power"}
        if unknown or "sensor" not in told:
            what = f"unknown key {', '.join(sorted(unknown))}" if unknown else "missing key sensor"
            raise ValueError(f"{path}: {what}; known: sensor, columns_port, can, serial, baudrate, power")
        power = told.get("power")
        super().__init__(path.stem, frozenset({"serial_noise", "wrong_crc"} | ({"reset"} if power else set())))
        address = dict(told["sensor"])
        self.data_address = (str(address["address"]), int(address.get("data_port", DATA_PORT)))
        self.position_address = (self.data_address[0], int(address.get("position_port", POSITION_PORT)))
        self._power = {str(k): str(v) for k, v in dict(power or {}).items()}
        self._told = told
        self._decoder = Decoder()
        self._faults: set[str] = set()
        self._mode = 0
        self._counters: dict[str, Any] = dict(_EMPTY_STATUS)
        if "columns_port" in told:
            self._columns.close()
            self._columns = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            self._columns.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER_BYTES)
            self._columns.bind(("0.0.0.0", int(told["columns_port"])))
            self._columns.setblocking(False)

    def power_on(self, time_ns: int) -> None:
        self._command("on")
        if self.can_bus is None and "can" in self._told:
            self.can_bus = can.Bus(**self._told["can"])
        if self.serial_port is None and "serial" in self._told:
            import serial

            self.serial_port = serial.serial_for_url(self._told["serial"], baudrate=self._told.get("baudrate", 115200))
        self.open()

    def _command(self, what: str) -> None:
        if what in self._power:
            subprocess.run(self._power[what], shell=True, check=True, timeout=60)

    def power_off(self, time_ns: int) -> dict[str, Any]:
        self._command("off")
        return self.status()

    def swap_model(self, ubm: bytes, time_ns: int) -> None:
        raise NotPossibleError(f"{self.name}: no way to put a model file on it but a command")

    def _put(self, kind: str, payload: Any, time_ns: int | None = None) -> None:
        super()._put(kind, payload, time_ns)
        if kind == "can":
            self._derive(payload, self.now_ns())

    def _derive(self, frame: CanFrame, now_ns: int) -> None:
        """Events, ledger and counters out of what CAN tells."""
        decoded = self._decoder.decode(frame, now_ns)
        if decoded is None or not decoded.signals:
            return
        signals = decoded.signals
        if decoded.name == "UPB_Faults":
            shown = {name for name, value in signals.items() if name.isupper() and value == "YES"}
            for kind, names in (("fault_set", shown - self._faults), ("fault_cleared", self._faults - shown)):
                for name in sorted(names):
                    super()._put("event", _event(kind, now_ns, fault=name))
            self._faults = shown
        elif decoded.name == "UPB_Status":
            mode = _MODES.index(str(signals["Mode"]).lower())
            if mode != self._mode:
                super()._put("event", _event("mode", now_ns, a=self._mode, b=mode))
            self._mode = mode
        elif decoded.name == "UPB_Ledger":
            super()._put("ledger", _record(signals))
        elif decoded.name == "UPB_Counters":
            self._counters.update({k: int(v) for k, v in signals.items() if not k.startswith(("E2E", "CounterIndex"))})

    def status(self) -> dict[str, Any]:
        return {**self._counters, "faults": sorted(self._faults)}

    def end(self, time_ns: int) -> None:
        """It runs on, without a sensor: what it says of that is no longer listened to."""
        time.sleep(_ON_ITS_WAY_S)
        self._stop.set()


def _event(kind: str, time_ns: int, *, a: int = 0, b: int = 0, fault: str = "") -> dict[str, Any]:
    return {"kind": kind, "time_ns": time_ns, "a": a, "b": b, "value": 0, "frame": 0, "fault": fault}


def _record(signals: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "frame": int(signals["Frame"]), "first_input_ns": int(signals["FirstInput"]),
        "last_input_ns": int(signals["LastInput"]), "output_ns": int(signals["Output"]),
        "latency_ns": int(signals["LatencyNs"]), "verdict": str(signals["Verdict"]).lower(),
        "missing_columns": int(signals["MissingColumns"]), "mode": str(signals["Mode"]).lower(),
    }  # fmt: skip
