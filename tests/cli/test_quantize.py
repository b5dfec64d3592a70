"""``upbeam quantize``, ``verify`` and ``inspect`` of integer models, as a user meets them."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import upbeam
from upbeam.quant import ModelFile, read_ubm, write_ubm
from upbeam.quant.sizes import section_bytes, weight_bytes

SCRIPT = Path(sys.executable).with_name("upbeam")
PNG = b"\x89PNG\r\n\x1a\n"


def run(*arguments, status=0):
    done = subprocess.run([str(SCRIPT), *map(str, arguments)], capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == status, f"{arguments}: status {done.returncode}\n{done.stdout}\n{done.stderr}"
    assert "Traceback" not in done.stderr
    return done


def run_json(*arguments, status=0):
    result = json.loads(run(*arguments, "--json", status=status).stdout)
    assert isinstance(result, dict)
    return result


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A quantised model, its report and what the command said."""
    folder = tmp_path_factory.mktemp("quantised")
    path = folder / "model.ubm"
    summary = run_json("quantize", "hdl-64e", "-o", path, "--frames", 4, "--report", folder / "report")
    return path, folder / "report", summary


def test_the_file_holds_both_precisions_and_says_where_they_come_from(made):
    path, _, summary = made
    file = read_ubm(path)
    assert file.precisions == ["fp32", "int16", "int8"]
    origin = file.provenance["quantisation"]
    assert "upbeam simulator, seed 500" in origin["calibration"]
    assert (origin["seed"], origin["rounding"], origin["windows"]) == (500, "descent", 40_000)
    assert origin["versions"]["upbeam"] == upbeam.__version__
    assert file.provenance["recipe"] == upbeam.load_model().file.provenance["recipe"]
    assert file.metrics["quantisation"]["int8"]["mean_mm"] == pytest.approx(
        summary["against_float"]["int8"]["mean_mm"], rel=1e-3
    )
    assert summary["bytes"] == path.stat().st_size


def test_errors_are_told_in_the_user_s_units(made):
    _, _, summary = made
    assert summary["frames"] == 1
    assert summary["judged_on"].endswith("the other 1")
    for name, most in (("int16", 4.0), ("int8", 15.0)):
        found = summary["against_float"][name]
        assert 0 < found["mean_mm"] <= most
        assert found["p99_mm"] <= found["p999_mm"] <= found["max_mm"]
        assert set(found["bands"]) == {"0-10 m", "10-20 m", "20-40 m", "40-80 m"}
        assert {"moved_share", "coarse_share", "cut_share", "added", "removed", "ghosts_added"} <= set(found)
        ratio = summary["against_truth"]["ratio_to_float"][name]["chamfer_m2"]["value"]
        assert ratio == pytest.approx(1, abs=0.02)
    assert summary["against_float"]["int16"]["mean_mm"] < summary["against_float"]["int8"]["mean_mm"]
    assert "valid-mean" in summary["against_truth"]["methods"]
    assert "W8A16" in summary["against_float"]


def test_the_peer_is_beside_or_its_absence_is_said(made):
    _, _, summary = made
    peers = [name for name in summary["against_float"] if name.startswith("ORT ")]
    assert peers or any("onnxruntime" in note for note in summary["notes"])
    for name in peers:
        assert summary["against_float"][name]["mean_mm"] > summary["against_float"]["int8"]["mean_mm"]


def test_the_report_needs_nothing_else(made):
    _, folder, summary = made
    html = (folder / "quantize.html").read_text(encoding="utf-8")
    assert "upbeam quantize" in html
    assert html.count("data:image/png;base64,") == 3
    assert 'src="http' not in html
    assert json.loads((folder / "quantize.json").read_text())["against_float"] == summary["against_float"]
    for name in ("error_map", "error_growth", "distance"):
        assert (folder / f"{name}.png").read_bytes().startswith(PNG)
    assert "| int8 |" in (folder / "quantize.md").read_text(encoding="utf-8")


def test_the_same_bytes_again(tmp_path):
    for name in ("a", "b"):
        run("quantize", "-o", tmp_path / f"{name}.ubm", "--frames", 1, "--precision", "int16", "--seed", 9)
    assert (tmp_path / "a.ubm").read_bytes() == (tmp_path / "b.ubm").read_bytes()
    made, shipped = read_ubm(tmp_path / "a.ubm"), upbeam.load_model().file
    assert made.precisions == ["fp32", "int16", "int8"]  # the other precision stays as it was
    assert made.int8 is not None
    assert shipped.int8 is not None
    assert np.array_equal(made.int8.distance.weight, shipped.int8.distance.weight)


def test_tables_for_people(tmp_path):
    done = run("quantize", "-o", tmp_path / "m.ubm", "--frames", 1, "--precision", "int16")
    for text in ("against float", "p99.9", "moved", "coarse", "flips", "ghosts", "bytes", "against the truth"):
        assert text in done.stdout
    assert "those it was calibrated on" in " ".join(done.stdout.split())


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ((), "nothing to do"),
        (("-o", "model.bin"), "ends in .ubm"),
        (("-o", "no/such/folder/m.ubm"), "does not exist"),
        (("-o", "m.ubm", "--precision", "int4"), "int16 or int8"),
        (("-o", "m.ubm", "--rounding", "up"), "nearest"),
        (("-o", "m.ubm", "--calibrate", "/no/such/folder"), "no .bin frames"),
    ],
)
def test_bad_usage_is_one_line(arguments, named, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    done = run("quantize", "hdl-64e", *arguments, status=2)
    assert named in done.stderr.replace("\n", " ")
    assert not list(tmp_path.iterdir())


def test_a_model_that_could_overflow_is_refused_with_layer_unit_and_bound(tmp_path):
    file = upbeam.load_model().file
    weight = file.folded[0].weight.copy()
    weight[4] *= 1e4
    large = ModelFile(file.rules, (replace(file.folded[0], weight=weight), file.folded[1]), provenance=file.provenance)
    write_ubm(tmp_path / "large.ubm", large)
    done = run("quantize", tmp_path / "large.ubm", "-o", tmp_path / "out.ubm", "--frames", 1, status=2)
    for text in ("distance network", "unit 4", "at most"):
        assert text in done.stderr
    assert not (tmp_path / "out.ubm").exists()


# --------------------------------------------------------------------------------------------------------- verify


def test_every_backend_gives_the_same_bits(made):
    report = run_json("verify", made[0], "--limit", 2)
    assert report["exact"] is True
    assert report["frames"] == 2
    assert report["columns"]["random"] >= 10_000
    assert {"int16 numpy", "int8 numpy", "int16 cpu scalar", "int8 cpu scalar", "fp32 cpu scalar"} <= set(
        report["backends"]
    )
    for name, backend in report["backends"].items():
        assert backend["first_mismatch"] is None
        for vectors, count in backend["sets"].items():
            if (name.endswith("numpy") and vectors != "golden") or ("opencl" in name and vectors == "stream"):
                assert count is None
            elif name != "fp32 cpu scalar":
                assert (count["differing"], count["windows"] > 0) == (0, True)
    assert report["backends"]["int8 numpy"]["sets"]["golden"]["differing"] == 0


def test_a_mismatch_is_status_1_and_is_named(made, tmp_path):
    file = read_ubm(made[0])
    golden = {**file.metrics["golden"], "int8": "00000000"}
    write_ubm(tmp_path / "wrong.ubm", replace(file, metrics={**file.metrics, "golden": golden}))
    done = run("verify", tmp_path / "wrong.ubm", "--limit", 1, "--random", 10, status=1)
    assert "DIFFER" in done.stdout
    assert "int8 numpy: golden" in done.stderr
    assert "NOT EXACT" in done.stderr


def test_a_float_model_is_verified_among_its_kernels():
    report = run_json("verify", "vlp-32c", "--limit", 1, "--random", 10)
    assert report["exact"] is True
    assert report["backends"]


# -------------------------------------------------------------------------------------------------------- inspect


def test_inspect_shows_the_integer_networks_and_their_proof(made):
    report = run_json("inspect", made[0])
    assert report["precisions"] == ["fp32", "int16", "int8"]
    for name, most in (("int16", 32_767), ("int8", 127)):
        for network in report["integer"][name].values():
            assert network["contract"] == f"upbeam.{name}.v1"
            assert max(map(abs, network["W"])) <= most
            low, high = network["sum_bounds"]
            assert -(2**31) <= low < 0 < high < 2**31
            assert 0.3 < network["sum_share_of_32_bits"] <= 1
            assert network["sum_bits"] <= 32
            assert network["output_bits"] <= 31
    text = run("inspect", made[0])
    assert "upbeam.int8.v1" in text.stdout
    assert "no sum can overflow" in text.stderr


def test_sizes_are_the_same_in_python_and_in_c(made):
    path = made[0]
    report = run_json("inspect", path)
    data = path.read_bytes()
    assert {name: sizes["weights"] for name, sizes in report["sizes"].items()} == weight_bytes(data)
    assert {sizes["file"] for sizes in report["sizes"].values()} == {len(data)} == {report["bytes"]}
    assert set(section_bytes(data)) == {"SENS", "NETW", "DENS", "Q16 ", "Q8  ", "PROV", "METR"}
    assert report["sections"] == section_bytes(data)
