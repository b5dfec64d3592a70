"""The command line as a user meets it: results, JSON, and one line for every error."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import upbeam
from upbeam.model.io import read_cloud, read_ply

SCRIPT = Path(sys.executable).with_name("upbeam")


def run(*arguments, status=0, cwd=None):
    done = subprocess.run(
        [str(SCRIPT), *map(str, arguments)], capture_output=True, text=True, timeout=300, cwd=cwd, check=False
    )
    assert done.returncode == status, f"{arguments}: status {done.returncode}\n{done.stdout}\n{done.stderr}"
    assert "Traceback" not in done.stderr
    return done


def run_json(*arguments, status=0):
    """Standard output is one JSON object and nothing else."""
    result = json.loads(run(*arguments, "--json", status=status).stdout)
    assert isinstance(result, dict)
    return result


@pytest.fixture(scope="module")
def kitti_file(tmp_path_factory):
    """A frame in KITTI's format: simulated, 64 beams, laser by laser."""
    folder = tmp_path_factory.mktemp("frames")
    points = kitti_points(columns=1000)
    points.tofile(folder / "000000.bin")
    return folder / "000000.bin"


def kitti_points(columns):
    """A room of 64 rings around the sensor: azimuth rises within a ring, counter-clockwise, from 0 to 360."""
    azimuth, ring = np.meshgrid((np.arange(columns) + 0.5) * 2 * np.pi / columns, np.arange(64))
    elevation = np.radians(2.0 - ring * 0.42)
    reach = np.minimum(12.0, 1.7 / np.maximum(1e-3, -np.sin(elevation)))
    x, y = reach * np.cos(elevation) * np.cos(azimuth), reach * np.cos(elevation) * np.sin(azimuth)
    grey = np.full(x.shape, 0.25)
    return np.stack([x, y, reach * np.sin(elevation), grey], -1).reshape(-1, 4).astype("<f4")


def test_version_and_help():
    assert run("--version").stdout.strip() == f"upbeam {upbeam.__version__}"
    assert "stream" in run("--help").stdout
    assert "stream" in run(status=2).stdout


def test_doctor():
    report = run_json("doctor")
    assert report["self_test"] == "ok"
    assert "scalar" in report["instruction_sets"]
    assert "cpu" in run("doctor").stdout


def test_ops_keys():
    report = run_json("ops")
    assert report["windows_per_image"] == 63_488
    assert report["macs_per_frame_dense"] == 39_616_512
    assert "conv1" in run("ops").stdout


def test_inspect():
    report = run_json("inspect")
    assert report["sensor"] == "hdl-64e/2"
    assert report["networks"]["distance"]["multiply_adds_per_window"] == 96
    (data,) = report["provenance"]["data"]
    assert data.startswith("upbeam simulator, 192 frames, seed 1000")
    assert "crc32" in run("inspect").stdout


@pytest.mark.parametrize("suffix", [".bin", ".ply", ".pcd"])
def test_upsample_keeps_every_point_and_marks_the_generated_ones(kitti_file, tmp_path, suffix):
    out = tmp_path / f"out{suffix}"
    summary = run_json("upsample", kitti_file, "-o", out)
    original = np.fromfile(kitti_file, "<f4").reshape(-1, 4)
    cloud = read_cloud(out)
    assert summary["measured"] == len(original)
    assert summary["generated"] == len(cloud.points) - len(original) > 1000
    assert cloud.points[: len(original)].tobytes() == original.tobytes()
    if suffix != ".bin":
        assert np.array_equal(np.flatnonzero(cloud.generated), np.arange(len(original), len(cloud.points)))
    made = cloud.points[len(original) :]
    assert np.all(np.linalg.norm(made[:, :3], axis=1) > 2.5)


def test_upsample_to_an_image(kitti_file, tmp_path):
    run("upsample", kitti_file, "-o", tmp_path / "out.npz")
    with np.load(tmp_path / "out.npz") as out:
        assert out["distance"].shape == out["intensity"].shape == (64, 2048)
        assert out["distance"].dtype == np.float32
        assert not out["generated"][::2].any()
        assert np.array_equal(out["generated"][1::2], out["distance"][1::2] > 0)
        sensor = out["distance"][::2]
    run("upsample", kitti_file, "-o", tmp_path / "only.npz", "--sensor-only")
    with np.load(tmp_path / "only.npz") as out:
        assert not out["distance"][1::2].any()
        assert np.array_equal(out["distance"][::2], sensor)
    run("upsample", kitti_file, "-o", tmp_path / "only.ply", "--sensor-only")
    assert not read_ply(tmp_path / "only.ply")["generated"].any()


def test_upsample_of_a_range_image(tmp_path, rng):
    counts = rng.integers(2000, 30_000, (32, 512), dtype=np.uint16)
    np.save(tmp_path / "in.npy", counts)
    run("upsample", tmp_path / "in.npy", "-o", tmp_path / "out.npz")
    with np.load(tmp_path / "out.npz") as out:
        assert np.array_equal(out["counts"][::2], counts)
        expected = upbeam.Upsampler(upbeam.load_model(), columns=512)(counts, np.zeros(counts.shape, np.uint8))
        assert np.array_equal(out["counts"], expected[0])


def broken_inputs(folder, good):
    """(name, bytes, what the message must say)"""
    points = np.fromfile(good, "<f4").reshape(-1, 4)
    nan, infinite = points.copy(), points.copy()
    nan[7, 1], infinite[9, 2] = np.nan, np.inf
    return {
        "truncated.bin": (good.read_bytes()[:-5], "multiple of 16"),
        "nan.bin": (nan.tobytes(), "finite"),
        "infinite.bin": (infinite.tobytes(), "finite"),
        "empty.bin": (b"", "empty"),
        "cropped.bin": (points[: len(points) // 2].tobytes(), "rings"),
        "cloud.xyz": (b"1 2 3", "xyz"),
        "image.npy": (b"\x93NUMPY\x01\x00", "image.npy"),
    }


@pytest.mark.parametrize(
    "name", ["truncated.bin", "nan.bin", "infinite.bin", "empty.bin", "cropped.bin", "cloud.xyz", "image.npy"]
)
def test_bad_clouds_are_one_line_and_nothing_is_written(kitti_file, tmp_path, name):
    data, said = broken_inputs(tmp_path, kitti_file)[name]
    (tmp_path / name).write_bytes(data)
    out = tmp_path / "out.ply"
    error = run("upsample", tmp_path / name, "-o", out, status=2).stderr
    assert error.count("\n") == 1
    assert name in error
    assert said in error
    assert not out.exists()


def test_bad_models_and_sizes_are_one_line(kitti_file, tmp_path):
    flipped = bytearray(upbeam.load_model().data)
    flipped[300] ^= 1
    (tmp_path / "flipped.ubm").write_bytes(flipped)
    np.save(tmp_path / "rows.npy", np.zeros((16, 100), np.uint16))
    out = tmp_path / "out.npz"
    for arguments, said in (
        (["upsample", kitti_file, "-o", out, "--model", tmp_path / "flipped.ubm"], "damaged"),
        (["upsample", kitti_file, "-o", out, "--model", tmp_path / "absent.ubm"], "absent.ubm"),
        (["upsample", tmp_path / "rows.npy", "-o", out], "16 rows"),
        (["upsample", kitti_file, "-o", tmp_path / "out.las"], "out.las"),
        (["upsample", tmp_path / "absent.bin", "-o", out], "absent.bin"),
        (["upsample", kitti_file, "-o", tmp_path / "no" / "out.npz"], "no"),
        (["upsample", kitti_file, "-o", out, "--precision", "int2"], "int2"),
        (["upsample", kitti_file, "-o", out, "--backend", "cuda"], "cuda"),
        (["upsample"], "IN"),
        (["stream", "--rate", "0"], "rate"),
        (["stream", "--frames", "0"], "frames"),
        (["stream", "--source", tmp_path / "absent"], "absent"),
        (["stream", "--source", tmp_path / "x.pcap"], "pcap"),
        (["stream", "--sensor", "vlp-32c", "--frames", "1"], "any-sensor"),
        (["stream", "--deadline-ms", "nan", "--frames", "1"], "deadline"),
        (["stream", "--clock", "wall"], "wall"),
        (["evaluate", tmp_path], "no .bin frames"),
        (["evaluate", "sim", "--rows", "beam"], "beam"),
        (["train", "--recipe", "nothing"], "nothing"),
        (["train", "--out", "model.bin"], "model.bin"),
        (["train", "--epochs", "3"], "counts steps"),
        (["train", "--recipe", "shan-small"], "must end in .pt"),
        (["train", "--recipe", "shan-small", "--out", "u.pt", "--checkpoint", "c"], "--checkpoint"),
        (["evaluate", "sim", "--with", tmp_path / "absent.pt"], "absent.pt"),
        (["simulate", "-o", tmp_path / "sim", "--sensor", "hdl-128"], "hdl-128"),
        (["ops", "--columns", "many"], "columns"),
        (["frobnicate"], "frobnicate"),
    ):
        error = run(*arguments, status=2).stderr
        assert error.count("\n") == 1, error
        assert said in error, (arguments, error)
    assert not out.exists()


def test_a_virtual_stream_is_the_same_every_time(tmp_path):
    arguments = ["stream", "--frames", "6", "--clock", "virtual", "--seed", "3"]
    first, second = run_json(*arguments), run_json(*arguments)
    assert first["ledger"] == second["ledger"]
    assert first["latency_ms"] == second["latency_ms"]
    assert (first["frames"], first["misses"], first["kind"]) == (6, 0, "modelled")
    assert first["deadline_ms"] == 50


def test_a_late_virtual_stream_misses_and_says_so():
    """30 us a column is more than the 24.4 us that a column lasts: the queue grows until frames miss 2 ms."""
    arguments = ["stream", "--frames", "4", "--clock", "virtual", "--column-us", "30", "--deadline-ms", "2"]
    result = run_json(*arguments)
    assert result["misses"] >= 3
    assert [r["verdict"] for r in result["ledger"]][-1] == "missed"
    run(*arguments, "--fail-on-miss", status=1)


def test_a_real_time_stream_with_report(tmp_path):
    """Accounting is asserted, wall-clock time is only reported."""
    result = run_json("stream", "--frames", "5", "--report", tmp_path / "report")
    assert result["frames"] == 5
    assert result["kind"] == "measured"
    assert set(result["latency_ms"]) >= {"p50", "p99", "p999", "max"}
    html = (tmp_path / "report" / "report.html").read_text()
    assert "http://" not in html.replace("http://www.w3.org", "")
    assert html.count("data:image/png") >= 5
    report = json.loads((tmp_path / "report" / "report.json").read_text())
    assert report["operations"]["macs_per_frame_dense"] == 39_616_512
    assert report["environment"]["instruction_sets"]


def test_a_stream_of_recorded_frames(kitti_file):
    result = run_json("stream", "--source", kitti_file.parent, "--frames", "3", "--clock", "virtual")
    assert result["frames"] == 3
    assert "3" in run("stream", "--source", kitti_file, "--frames", "3", "--clock", "virtual").stdout


def test_another_sensor_plays_only_when_wished():
    """Another sensor is refused unless wished; then its columns are counted like any other's."""
    result = run_json("stream", "--sensor", "hdl-32e", "--any-sensor", "--frames", "2", "--clock", "virtual")
    assert result["frames"] == 2


def test_a_native_sensor_goes_through_the_destagger_ring():
    """A VLP-32C's lasers point up to 4.2 degrees aside: 11 columns of 904, and the column that is under way."""
    result = run_json("stream", "--model", "vlp-32c", "--frames", "2", "--clock", "virtual")
    assert result["delay_columns"] == 12
    assert result["columns"] == 904
    assert result["counts"]["columns_missing"] == 0


def test_simulate_and_evaluate(tmp_path):
    run("simulate", "-o", tmp_path / "sim", "--frames", "2", "--seed", "4")
    files = sorted((tmp_path / "sim").iterdir())
    assert [f.name for f in files] == ["000000.bin", "000001.bin"]
    assert len(read_cloud(files[0]).points) > 50_000
    run("simulate", "-o", tmp_path / "npz", "--frames", "1", "--sensor", "vlp-32c", "--format", "npz")
    with np.load(tmp_path / "npz" / "000000.npz") as image:
        assert image["distance"].shape == (32, 904)
    report = run_json("evaluate", "sim", "--frames", "2")
    assert report["frames"] == 2
    assert set(report["methods"]) >= {"nearest", "bilinear", "valid-mean", "window-mean", "upbeam-fp32"}
    for key in ("chamfer_m2", "mae_m", "ghost_share", "coverage"):
        assert report["methods"]["upbeam-fp32"][key] >= 0


def test_the_shipped_model_beats_bilinear_on_real_frames(data_dir):
    methods = run_json("evaluate", data_dir / "kitti" / "frames")["methods"]
    print({name: {k: round(v, 3) for k, v in m.items()} for name, m in methods.items()})
    for key in ("chamfer_m2", "mae_m", "ghost_share"):
        assert methods["upbeam-fp32"][key] < methods["bilinear"][key]
    assert methods["upbeam-fp32"]["chamfer_m2"] < methods["valid-mean"]["chamfer_m2"]


def test_upsample_a_real_frame(data_dir, tmp_path):
    """Generated points lie on the recording's surfaces: most within 20 cm of a recorded point."""
    from scipy.spatial import cKDTree

    source = data_dir / "kitti" / "frames" / "000003.bin"
    run("upsample", source, "-o", tmp_path / "out.ply")
    cloud = read_cloud(tmp_path / "out.ply")
    measured, made = cloud.points[~cloud.generated, :3], cloud.points[cloud.generated, :3]
    assert cloud.points[~cloud.generated].tobytes() == source.read_bytes()
    distance = cKDTree(measured).query(made)[0]
    print(f"median {np.median(distance):.3f} m, 90 %: {np.quantile(distance, 0.9):.3f} m")
    assert np.median(distance) < 0.2


def test_the_script_is_installed():
    assert shutil.which(str(SCRIPT))
