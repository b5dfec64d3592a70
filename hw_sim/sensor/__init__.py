"""The simulated sensor: packets of an HDL-32E, VLP-32C or VLP-16, on a bench's clock or as UDP in real time."""

from .datagram import DATA_PORT, POSITION_PORT, Datagram, blocks, is_data, is_position
from .motor import Motor
from .recording import RecordedSensor
from .simulated import SENSORS, SensorConfig, SimulatedSensor, merge
from .sources import FiringSource, QuickRoom, Returns, ScanLoop
from .udp import SendReport, send_udp

__all__ = [
    "DATA_PORT",
    "POSITION_PORT",
    "SENSORS",
    "Datagram",
    "FiringSource",
    "Motor",
    "QuickRoom",
    "RecordedSensor",
    "Returns",
    "ScanLoop",
    "SendReport",
    "SensorConfig",
    "SimulatedSensor",
    "blocks",
    "is_data",
    "is_position",
    "merge",
    "send_udp",
]
