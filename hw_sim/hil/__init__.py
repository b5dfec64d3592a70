"""Hardware in the loop without the hardware: scenarios on a bench around a device (docs/hil.md)."""

from .bench import Bench, run_scenario
from .dut import Dut, InProcessDut, NotPossibleError, Output
from .judge import Check, Timing, Verdict, judge
from .network_dut import HardwareDut, ProcessDut
from .record import Event, Record
from .runner import (
    Result,
    Sabotaged,
    hardware,
    in_process,
    process,
    run_all,
    run_one,
    sabotage_all,
    uncovered,
    write_junit,
)
from .scenario import Scenario, ScenarioError, load_scenario, load_scenarios

__all__ = [
    "Bench",
    "Check",
    "Dut",
    "Event",
    "HardwareDut",
    "InProcessDut",
    "NotPossibleError",
    "Output",
    "ProcessDut",
    "Record",
    "Result",
    "Sabotaged",
    "Scenario",
    "ScenarioError",
    "Timing",
    "Verdict",
    "hardware",
    "in_process",
    "judge",
    "load_scenario",
    "load_scenarios",
    "process",
    "run_all",
    "run_one",
    "run_scenario",
    "sabotage_all",
    "uncovered",
    "write_junit",
]
