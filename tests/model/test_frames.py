"""Recorded frames as images, and the shipped model on them."""

from __future__ import annotations

import numpy as np
import pytest

from upbeam.model.beams import beam_table
from upbeam.model.frames import image_of_cloud, kitti_files, kitti_frames
from upbeam.model.geometry import recover_rings, to_points
from upbeam.model.io import Cloud, CloudError, read_cloud
from upbeam.model.rules import Rules

RULES = Rules.for_beams(beam_table("hdl-64e").aligned())


def test_a_real_frame_round_trips_through_its_image(data_dir):
    """Points of the image, put back into space, lie where the recording has them (heights of the lasers included)."""
    path = kitti_files(data_dir / "kitti" / "frames")[0]
    whole = read_cloud(path)
    cloud = whole.points
    image = image_of_cloud(whole, path, RULES)
    rules = RULES
    points, row, column = to_points(
        image.distance,
        image.intensity,
        rules.row_elevation_deg,
        rules.distance_unit_m,
        rules.cut_deg,
        rules.row_height_m,
    )
    original = cloud[image.index[row, column]]
    steps = np.floor(original[:, 3].astype(np.float64) * 255 + 0.5)
    assert np.array_equal(steps, np.floor(points[:, 3] * np.float64(255) + 0.5))
    error = np.linalg.norm(points[:, :3] - original[:, :3], axis=1)
    near = np.linalg.norm(original[:, :3], axis=1) < 20
    print(
        f"median {1e3 * np.median(error[near]):.0f} mm, 99 %: {1e3 * np.quantile(error[near], 0.99):.0f} mm within 20 m"
    )
    assert np.median(error[near]) < 0.06


def test_every_frame_has_64_rings_and_both_row_rules(data_dir):
    ring = list(kitti_frames(data_dir / "kitti" / "frames", RULES))
    assert len(ring) == 26
    binned = next(iter(kitti_frames(data_dir / "kitti" / "frames", RULES, rows="elevation")))
    assert (binned.distance > 0).mean() < (ring[0].distance > 0).mean()


def test_ring_numbers_of_a_file_are_ranked_by_elevation(data_dir):
    """Shuffled, and numbered from the bottom: the same image as from the order of the points."""
    path = kitti_files(data_dir / "kitti" / "frames")[0]
    cloud = read_cloud(path)
    order = np.random.default_rng(0).permutation(len(cloud.points))
    numbered = Cloud(cloud.points[order], "ply", ring=63 - recover_rings(cloud.points)[order])
    assert np.array_equal(image_of_cloud(numbered, path, RULES).distance, image_of_cloud(cloud, path, RULES).distance)
    few = Cloud(cloud.points[:100], "ply", ring=np.zeros(100, np.int64))
    with pytest.raises(CloudError, match="1 rings, expected 64"):
        image_of_cloud(few, path, RULES)


def test_a_cropped_cloud_is_refused_with_its_name(tmp_path):
    with pytest.raises(CloudError, match=r"crop\.bin.*rings"):
        image_of_cloud(Cloud(np.full((10, 4), 0.5, np.float32), "bin"), tmp_path / "crop.bin", RULES)
    with pytest.raises(CloudError, match=r"no \.bin frames"):
        kitti_files(tmp_path)
