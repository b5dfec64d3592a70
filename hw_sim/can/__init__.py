"""CAN at the desk: a simulated bus on virtual time, its analysis, and the tester's side of the device's messages.

What is named here needs nothing beyond the standard library and numpy. The rest needs the extra ``hil``:
:mod:`.database` (cantools), :mod:`.commander` (cryptography), :mod:`.pythoncan`, :mod:`.uds`, :mod:`.monitor`,
:mod:`.report`.
"""

from .analysis import BusRates, FrameLength, Message, ResponseTime, response_times, utilisation
from .bus import BusEvent, Node, Received, SimulatedBus, Transmission
from .e2e import E2EConfig, E2EState, E2EStatus, Profile05, Profile11, Receiver, Sender, StateMachine, Window
from .frame import CanFrame
from .station import ErrorKind, ErrorState
from .wire import decode_frame, encode_frame

__all__ = [
    "BusEvent",
    "BusRates",
    "CanFrame",
    "E2EConfig",
    "E2EState",
    "E2EStatus",
    "ErrorKind",
    "ErrorState",
    "FrameLength",
    "Message",
    "Node",
    "Profile05",
    "Profile11",
    "Received",
    "Receiver",
    "ResponseTime",
    "Sender",
    "SimulatedBus",
    "StateMachine",
    "Transmission",
    "Window",
    "decode_frame",
    "encode_frame",
    "response_times",
    "utilisation",
]
