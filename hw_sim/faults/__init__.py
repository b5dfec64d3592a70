"""Seeded, composable faults of network, sensor, medium, computer, buses and supply."""

from . import device, network, physics, sensor
from .base import FAULTS, DeviceFault, Fault, Moment, PacketFault, apply_faults, make_fault
from .catalogue import CATALOGUE, Entry

__all__ = [
    "CATALOGUE",
    "FAULTS",
    "DeviceFault",
    "Entry",
    "Fault",
    "Moment",
    "PacketFault",
    "apply_faults",
    "device",
    "make_fault",
    "network",
    "physics",
    "sensor",
]
