"""Dynamic energy of the FPGA core from its switching activity.

    energy = toggles x glitches x C V^2 / 2

``toggles`` come from a simulation of a real frame (``hw_sim.fpga.activity``). RTL activity knows neither glitches nor
the wires that synthesis makes, and the capacitance of a routed net is nobody's published figure: the range says so.
The clock tree is not in it.
"""

from __future__ import annotations

from .figures import Figure

__all__ = ["GLITCHES", "NET_FF", "VOLTS", "dynamic_energy"]

NET_FF = (250.0, 100.0, 600.0)
"""Capacitance of a net with its routing, femtofarads, in a 40 nm FPGA: central, low, high; assumption"""
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
        f"{toggles} toggles simulated (RTL: no glitches) x {GLITCHES[0]:g} ({GLITCHES[1]:g} to {GLITCHES[2]:g}) for "
        f"glitches x half of {NET_FF[0]:g} fF ({NET_FF[1]:g} to {NET_FF[2]:g}) a net at {volts:g} V, both assumed; "
        "clock tree not included"
    )
    return Figure(value, low, high, "mJ", "modelled", source)
