"""Beam tables: shipped ones are sound, wrong ones are refused by name."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml

from upbeam.model.beams import BeamTableError, beam_table, beam_table_names, between_rows, uniform_beam_table
from upbeam.model.rules import Rules


@pytest.mark.parametrize("name", ["hdl-64e", "hdl-64e/2", "hdl-32e", "vlp-32c"])
def test_shipped_tables(name):
    table = beam_table(name)
    assert name in beam_table_names()
    assert table.beams == (64 if name == "hdl-64e" else 32)
    assert sorted(set(table.laser_id)) == sorted(table.laser_id)
    assert np.all(table.firing_time_us < table.firing_cycle_us)


def test_known_figures():
    assert beam_table("hdl-32e").elevation_deg[[0, -1]] == pytest.approx([10.667, -30.667], abs=1e-3)
    assert np.ptp(beam_table("vlp-32c").azimuth_offset_deg) == pytest.approx(8.4)
    assert np.ptp(beam_table("hdl-64e").azimuth_offset_deg) > 17
    assert beam_table("vlp-32c").distance_unit_m == 0.004
    assert np.array_equal(beam_table("hdl-64e/2").elevation_deg, beam_table("hdl-64e").elevation_deg[::2])


def test_shipped_angles_agree_with_public_calibrations(data_dir):
    """VLP-32C and HDL-32E as third-party drivers know them (their rot_correction turns the other way)."""
    for name, file in (("vlp-32c", "VLP32.yaml"), ("hdl-32e", "HDL32.yaml")):
        lasers = yaml.safe_load((data_dir / "sensor_calibration" / file).read_text())["lasers"]
        lasers.sort(key=lambda laser: -laser["vert_correction"])
        table = beam_table(name)
        assert np.degrees([x["vert_correction"] for x in lasers]) == pytest.approx(table.elevation_deg, abs=6e-3)
        assert -np.degrees([x["rot_correction"] for x in lasers]) == pytest.approx(table.azimuth_offset_deg, abs=1e-3)
        assert [x["laser_id"] for x in lasers] == table.laser_id.tolist()


def test_column_offsets_round_half_up():
    table = uniform_beam_table(4, 3, -3)
    object.__setattr__(table, "azimuth_offset_deg", np.array([0.5, -0.5, 1.49, -1.51]))
    assert table.column_offsets(360).tolist() == [1, 0, 1, -2]


def test_a_doubled_table_holds_the_sensor_in_its_even_rows():
    table, double = beam_table("vlp-32c"), beam_table("vlp-32c*2")
    assert double.beams == 64
    assert np.array_equal(double.elevation_deg[::2], table.elevation_deg)
    assert np.array_equal(double.azimuth_offset_deg[::2], table.azimuth_offset_deg)
    assert double.elevation_deg[1] == pytest.approx((15 + 10.333) / 2)
    assert Rules.for_beams(double).sensor == "vlp-32c"
    assert np.array_equal(Rules.for_beams(double).row_elevation_deg, Rules.for_beams(table).row_elevation_deg)


def test_between_rows():
    assert between_rows(np.array([4.0, 2.0, 1.0])).tolist() == [4.0, 3.0, 2.0, 1.5, 1.0, 0.5]


GOOD = {"name": "x", "distance_unit_m": 0.002, "firing_cycle_us": 48.0, "columns": 100, "elevation_deg": [2.0, 1.0]}


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"elevation_deg": [1.0, 2.0]}, "fall strictly"),
        ({"elevation_deg": [1.0]}, "1 beams"),
        ({"elevation_deg": "up"}, "could not convert"),
        ({"elevation_deg": [2.0, float("nan")]}, "finite"),
        ({"azimuth_offset_deg": [0.0]}, "azimuth_offset_deg"),
        ({"colums": 5}, "unknown key colums"),
        ({"columns": 1}, "columns"),
        ({"distance_unit_m": 2}, "distance_unit_m"),
    ],
)
def test_wrong_files_are_refused(tmp_path, change, named):
    path = tmp_path / "table.yaml"
    path.write_text(yaml.safe_dump({**GOOD, **change}))
    with pytest.raises(BeamTableError, match=named):
        beam_table(path)


def test_a_good_file_and_missing_ones(tmp_path):
    path: Path = tmp_path / "table.yaml"
    path.write_text(yaml.safe_dump(GOOD))
    assert beam_table(path).beams == 2
    path.write_text("{not yaml: [")
    with pytest.raises(BeamTableError, match="not YAML"):
        beam_table(path)
    with pytest.raises(BeamTableError, match="No such file"):
        beam_table(tmp_path / "absent.yaml")
    with pytest.raises(BeamTableError, match="known: hdl-32e"):
        beam_table("hdl-128")
