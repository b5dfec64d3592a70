"""Makes the pictures of README.md from simulated frames: ``.venv/bin/python docs/make_pictures.py``."""

from __future__ import annotations

from pathlib import Path

import numpy as np

import upbeam
from upbeam.hw_sim import simulate_frames
from upbeam.model.beams import beam_table
from upbeam.model.geometry import to_metres, to_points
from upbeam.power.report import Panel, plot_close_up, plot_range_images

FOLDER = Path(__file__).with_name("images")
SEED = 11


def main() -> None:
    model = upbeam.load_model()
    (scan,) = simulate_frames(beam_table("hdl-64e"), columns=model.columns, frames=1, seed=SEED, scene="suburb")
    distance, intensity = upbeam.Upsampler(model)(scan.distance[::2], scan.intensity[::2])
    images = (
        ("in: 32 beams (simulated)", scan.distance[::2]),
        ("out: 64 rows", distance),
        ("what a 64-beam sensor would have seen", scan.distance),
    )
    panels = [Panel(title, to_metres(image, model.distance_unit_m)) for title, image in images]
    (FOLDER / "range_images.png").write_bytes(plot_range_images(panels, half_angle_deg=60))
    rules = model.rules
    points, row, _ = to_points(
        distance, intensity, rules.row_elevation_deg, rules.distance_unit_m, rules.cut_deg, rules.row_height_m
    )
    made = upbeam.generated_rows()[row]
    xyz = points[:, :3].astype(np.float64)
    (FOLDER / "cloud.png").write_bytes(plot_close_up(xyz[~made], xyz[made]))


if __name__ == "__main__":
    main()
