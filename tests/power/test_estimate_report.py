"""The report of estimates: complete, self-contained, and the same figures as its JSON."""

from __future__ import annotations

import json
import re

import pytest

from upbeam.power.catalogue import device, device_names
from upbeam.power.cycles.host import pairs_of
from upbeam.power.estimate import IMPLEMENTATIONS, Knowledge, Load, estimate_load
from upbeam.power.estimate_pictures import pareto_rows
from upbeam.power.estimate_report import write_report
from upbeam.power.host import estimate_host
from upbeam.power.ops import count_model
from upbeam.runtime.upsampler import load_model


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    model, known = load_model(), Knowledge.of()
    load = Load(count_model(model.file, model.columns), pairs_of(model.file), memory=model.sizes("int8"))
    found = []
    for name in device_names():
        for way in IMPLEMENTATIONS[device(name).family]:
            board = device(name)
            found.append(
                estimate_host(board, load, model) if name == "host"
                else estimate_load(board, load, known=known, implementation=way)
            )  # fmt: skip
    facts = {
        "name": model.name, "crc32": f"{model.crc32:08x}", "sensor": model.rules.sensor,
        "quantisation": model.file.metrics["quantisation"],
    }  # fmt: skip
    path = write_report(tmp_path_factory.mktemp("report"), found, load, known, facts, {"upbeam": "0", "cpu": "a <CPU>"})
    return path.read_text(encoding="utf-8"), json.loads(path.with_name("estimate.json").read_text()), found, facts


def test_the_page_needs_nothing_else(report):
    html = report[0]
    assert not re.search(r'(?:src|href)\s*=\s*"(?!data:)', html)
    assert "url(" not in html
    assert "<script" not in html
    assert html.count("data:image/png;base64,") == 4
    assert "a &lt;CPU&gt;" in html


def test_the_first_page_answers_for_every_device(report):
    html, _, found, facts = report
    first = html.split("<h2>")[0]
    for one in found:
        assert f"<th>{one.device.name} {one.implementation}" in first
    assert first.count("assumption") > 10
    assert facts["crc32"] in first
    assert "meets" in first
    for heading in ("Roofline", "Layers", "Accuracy beside work", "Quantisation beside its cost", "How far off",
                    "Assumptions", "Measured by others", "Made with"):  # fmt: skip
        assert f"<h2>{heading}" in html


def test_json_has_every_figure_with_its_source(report):
    _, data, found, facts = report
    assert len(data["devices"]) == len(found)
    for one in data["devices"]:
        for key in ("latency_ms", "power_w", "energy_mj"):
            assert {"value", "low", "high", "kind", "boundary", "source"} <= set(one[key])
            assert one[key]["source"]
    assert data["model"]["crc32"] == facts["crc32"]
    assert {f["kind"] for figures in data["figures"].values() for f in figures.values()} >= {"data sheet", "assumption"}
    assert len(data["leave_one_out"]) == len(data["measured_rows"])
    assert data["operations"]["macs_per_frame_dense"] == 39_616_512


def test_the_front_is_that_of_the_measured_file():
    rows, comments = pareto_rows()
    assert "KITTI" in comments[0]
    by_name = {r["method"]: r["on_the_front"] for r in rows}
    assert not by_name["valid-mean"]
    assert not by_name["paper-ring"]
    assert by_name["hidden-6"]
    for r in rows:
        dominated = any(
            o["multiply_adds"] <= r["multiply_adds"] and o["chamfer"] < r["chamfer"] for o in rows if o is not r
        )
        assert dominated != r["on_the_front"]
