"""UDS tester (ISO 14229-1 over ISO-TP) with udsoncan and can-isotp, on a python-can bus or on virtual time.

On a real-time bus :func:`connect` gives udsoncan's own connection. On the simulated bus :class:`VirtualConnection`
runs can-isotp's protocol logic step by step while the virtual clock moves: the response timeout and the separation
time between consecutive frames are virtual, can-isotp's own timeouts (1 s) stay on the real clock and do not matter.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any

import can
import isotp
import udsoncan
from udsoncan.client import Client
from udsoncan.configs import default_client_config
from udsoncan.connections import BaseConnection, PythonIsoTpConnection
from udsoncan.exceptions import TimeoutException
from udsoncan.typing import ClientConfig

from . import database
from .bus import NS_PER_S, Node, Received, SimulatedBus
from .frame import CanFrame
from .pythoncan import Advance

DTC_BASE = 0xD00000
DTC_STEP = 0x100
PADDING = 0xCC
ISOTP_PARAMETERS: dict[str, Any] = {"tx_padding": PADDING, "tx_data_min_length": 8, "blocking_send": False}
FLOW_CONTROL = 0x3
CONSECUTIVE = 0x2


def address() -> isotp.Address:
    """The tester's side of the device's diagnostic address."""
    return isotp.Address(
        isotp.AddressingMode.Normal_11bits, txid=database.UDS_REQUEST_ID, rxid=database.UDS_RESPONSE_ID
    )


class Raw(udsoncan.DidCodec):
    """Data of an identifier as bytes."""

    def encode(self, *value: Any, **_: Any) -> bytes:
        """Bytes as given."""
        return bytes(value[0])

    def decode(self, string_bin: bytes) -> bytes:
        """Bytes as received."""
        return bytes(string_bin)

    def __len__(self) -> int:
        raise self.ReadAllRemainingData


@dataclass(frozen=True, slots=True)
class FaultRecord:
    """One entry of the fault memory."""

    fault: int
    name: str
    dtc: int
    status: int

    @property
    def active(self) -> bool:
        """testFailed."""
        return bool(self.status & 0x01)

    @property
    def confirmed(self) -> bool:
        """confirmedDTC."""
        return bool(self.status & 0x08)


class VirtualConnection(BaseConnection):
    """udsoncan connection over a node of a :class:`SimulatedBus`; waiting moves the virtual clock (``advance``)."""

    def __init__(self, bus: SimulatedBus, node: Node, advance: Advance | None = None) -> None:
        super().__init__("simulated bus")
        self._bus = bus
        self._advance = advance or bus.advance_next
        self._node = node
        self._incoming: deque[isotp.CanMessage] = deque()
        self._paced_until = 0
        self._separation_ns = 0
        self._opened = False
        parameters = {**ISOTP_PARAMETERS, "override_receiver_stmin": 0}
        self._layer = isotp.TransportLayerLogic(
            rxfn=lambda timeout: self._incoming.popleft() if self._incoming else None,
            txfn=self._transmit,
            address=address(),
            params=parameters,
        )

    def open(self) -> VirtualConnection:
        """Start to listen."""
        if not self._opened:
            self._node.listeners.append(self._on_frame)
            self._opened = True
        return self

    def close(self) -> None:
        """Stop to listen."""
        if self._opened:
            self._node.listeners.remove(self._on_frame)
            self._opened = False

    def is_open(self) -> bool:
        """Whether it listens."""
        return self._opened

    def empty_rxqueue(self) -> None:
        """Forget answers that nobody waited for."""
        self._incoming.clear()
        self._layer.clear_rx_queue()

    def specific_send(self, payload: bytes, timeout: float | None = None) -> None:
        """Begin to send a request."""
        self._layer.send(payload)
        self._layer.process(0.0)

    def specific_wait_frame(self, timeout: float | None = None) -> bytes | None:
        """An answer. :raises udsoncan.exceptions.TimeoutException: none in ``timeout`` virtual seconds (2 if None)."""
        limit = self._bus.now_ns + round((2.0 if timeout is None else timeout) * NS_PER_S)
        while True:
            self._layer.process(0.0)
            answer = self._layer.recv()
            if answer is not None:
                return bytes(answer)
            if not self._advance(limit) and not self._incoming:
                raise TimeoutException("no answer in time, on the virtual clock")  # type: ignore[no-untyped-call]

    def _on_frame(self, received: Received) -> None:
        frame = received.frame
        if frame.identifier != database.UDS_RESPONSE_ID or frame.fd:
            return
        if frame.data and frame.data[0] >> 4 == FLOW_CONTROL and len(frame.data) >= 3:
            self._separation_ns = separation_ns(frame.data[2])
        self._incoming.append(isotp.CanMessage(arbitration_id=frame.identifier, data=frame.data))

    def _transmit(self, message: isotp.CanMessage) -> None:
        """Queue a frame; consecutive ones not closer than the separation time that the device asked for."""
        frame = CanFrame(message.arbitration_id, bytes(message.data))
        due = self._bus.now_ns
        if frame.data[0] >> 4 == CONSECUTIVE:
            due = max(due, self._paced_until)
            self._paced_until = due + self._separation_ns
        self._node.send(frame, due)


def separation_ns(code: int) -> int:
    """STmin of a flow control frame; reserved codes count as the longest, 127 ms (ISO 15765-2)."""
    if code <= 0x7F:
        return code * 1_000_000
    if 0xF1 <= code <= 0xF9:
        return (code - 0xF0) * 100_000
    return 127_000_000


def connect(bus: can.BusABC) -> PythonIsoTpConnection:
    """Connection over a python-can bus on the real clock (the daemon's datagrams, SocketCAN, an adapter)."""
    return PythonIsoTpConnection(isotp.CanStack(bus, address=address(), params=ISOTP_PARAMETERS))


class UdsTester:
    """Diagnostics of the device; use as a context manager.

    :param connection: :func:`connect` or :class:`VirtualConnection`.
    :param timeout_s: for one answer, on the clock of the connection.
    """

    def __init__(self, connection: BaseConnection, timeout_s: float = 2.0) -> None:
        config: ClientConfig = {
            **default_client_config,
            "request_timeout": timeout_s,
            "p2_timeout": timeout_s,
            "p2_star_timeout": timeout_s,
            "use_server_timing": False,
            "data_identifiers": {"default": Raw()},
        }
        self.client = Client(connection, config=config)
        self._names = _fault_names()

    def __enter__(self) -> UdsTester:
        self.client.open()
        return self

    def __exit__(self, *_: object) -> None:
        self.client.close()

    def read(self, did: int) -> bytes:
        """ReadDataByIdentifier. :raises udsoncan.exceptions.NegativeResponseException: refused."""
        response = self.client.read_data_by_identifier_first(did)
        return bytes(response)

    def faults(self, status_mask: int = 0xFF) -> list[FaultRecord]:
        """ReadDTCInformation by status mask."""
        response = self.client.get_dtc_by_status_mask(status_mask)
        assert response is not None
        return [self._record(dtc.id, dtc.status.get_byte_as_int()) for dtc in response.service_data.dtcs]

    def clear(self, group: int = 0xFFFFFF) -> None:
        """ClearDiagnosticInformation. :raises udsoncan.exceptions.NegativeResponseException: refused."""
        self.client.clear_dtc(group)

    def session(self, session: int) -> None:
        """DiagnosticSessionControl."""
        self.client.change_session(session)

    def reset(self, kind: int = 1) -> None:
        """ECUReset."""
        self.client.ecu_reset(kind)

    def _record(self, dtc: int, status: int) -> FaultRecord:
        fault, rest = divmod(dtc - DTC_BASE, DTC_STEP)
        known = self._names.get(fault) if rest == 0 else None
        return FaultRecord(fault if known else 0, known or f"DTC {dtc:06X}", dtc, status)


def _fault_names() -> dict[int, str]:
    """Fault ids and names: the value table of the signal LatestFault."""
    signal = database.load().get_message_by_name("UPB_Faults").get_signal_by_name("LatestFault")
    return {int(number): str(name) for number, name in (signal.choices or {}).items()}
