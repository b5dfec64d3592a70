"""Dynamic energy of the FPGA core from its switching activity.

    energy = toggles x glitches x C V^2 / 2

``toggles`` come from a simulation of a real frame (``hw_sim.fpga.activity``). RTL activity knows neither glitches nor
the wires that synthesis makes, and the capacitance of a routed net is nobody's published figure: the range says so.
The clock tree is not in it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from .catalogue import Device
from .figures import Figure

__all__ = ["GLITCHES", "NET_FF", "NODE_NM", "VOLTS", "core_volts", "dynamic_energy", "toggles_of_a_turn"]

NET_FF = (250.0, 100.0, 600.0)
"""Capacitance of a net with its routing, femtofarads, in a 40 nm FPGA: central, low, high; assumption"""
NODE_NM = 40.0
"""What ``NET_FF`` is of"""
GLITCHES = (1.5, 1.0, 2.5)
"""Toggles of the real net for each of RTL; assumption"""
VOLTS = 1.1
"""ECP5 core supply, data sheet"""


def dynamic_energy(toggles: int, volts: float = VOLTS) -> Figure:
    """Of so many toggles, mJ, with its range. Raises ValueError for a negative count."""
    if toggles < 0:
        raise ValueError(f"{toggles} toggles, expected 0 or more")
    value, low, high = (
        1e3 * toggles * glitches * 0.5 * net * 1e-15 * volts**2 for net, glitches in zip(NET_FF, GLITCHES, strict=True)
    )
    source = (
        f"{toggles / 1e6:.4g} million toggles simulated (RTL: no glitches) x {GLITCHES[0]:g} "
        f"({GLITCHES[1]:g} to {GLITCHES[2]:g}) for glitches x half of "
        f" {NET_FF[0]:g} fF ({NET_FF[1]:g} to {NET_FF[2]:g}) a net at {volts:g} V, both assumed; "
        "clock tree not included"
    )
    return Figure(value, low, high, "mJ", "modelled", source)


def core_volts(device: Device) -> float | None:
    """Core supply of a part that ``NET_FF`` holds for; None for one of another process, or of unknown supply."""
    if "power.core_voltage" not in device.figures or device.figure("power.node").get("nm") != NODE_NM:
        return None
    return device.figure("power.core_voltage").get("V")


def toggles_of_a_turn(activity: Mapping[str, Any], columns: int, clock_hz: float, turn_s: float) -> tuple[int, int]:
    """Of a core that runs on between frames: in all, and of its frame alone. ``activity`` as ``hw_sim.fpga.activities``
    has it, of a frame of any width. Its schedule reads weights in every clock, whether there is a window or not. A core
    too slow for its frames works all the time."""
    scale = columns / activity["columns"]
    clocks, turn = activity["clocks"] * scale, clock_hz * turn_s
    frame = activity["toggles"] * scale * min(1.0, turn / clocks)
    idle = activity["idle_toggles_per_clock"] * max(0.0, turn - clocks)
    return round(frame + idle), round(frame)
