"""The frozen contract and file format: vectors and model files of version 1 that every later version reads alike."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path

import numpy as np
import pytest

from upbeam import Upsampler, load_model
from upbeam.model.rules import upsample_reference
from upbeam.quant.integer import IntegerNetwork, network, upsample_integer
from upbeam.quant.ubm import read_ubm

VECTORS = Path(__file__).resolve().parent.parent / "vectors"
MODELS = sorted(p.stem for p in (VECTORS / "models").glob("*.ubm"))


@pytest.mark.parametrize("precision", ["int16", "int8"])
def test_contract_vectors(precision):
    golden = json.loads((VECTORS / "integer" / f"{precision}.json").read_text())
    assert golden["contract"] == f"upbeam.{precision}.v1"
    assert len(golden["cases"]) >= 4
    for case in golden["cases"]:
        trace = network(IntegerNetwork(**case["network"]), precision, case["windows"])
        for step, values in case["steps"].items():
            assert np.array_equal(getattr(trace, step), values), step


def test_there_are_samples():
    assert {"v1-full", "v1-float"} <= set(MODELS)


@pytest.mark.parametrize("name", MODELS)
def test_old_files_load_and_give_what_they_gave(name):
    data = (VECTORS / "models" / f"{name}.ubm").read_bytes()
    golden = np.load(VECTORS / "models" / f"{name}.npz")
    file, model = read_ubm(data), load_model(VECTORS / "models" / f"{name}.ubm")
    assert file.to_bytes() == data
    shape = golden["distance"], golden["intensity"]
    for precision in file.precisions:
        expected = golden[f"{precision}_distance"], golden[f"{precision}_intensity"]
        if precision == "fp32":
            reference = upsample_reference(*shape, file.folded, file.rules)
        else:
            reference = upsample_integer(*shape, file.integer(precision), file.rules)
        runtime = Upsampler(model, precision=precision)(*shape)
        slack = 1 if precision == "fp32" else 0  # float32 against float64: a rounding threshold may be met
        for made, wanted in zip((*reference, *runtime), (*expected, *expected), strict=True):
            assert np.abs(made.astype(int) - wanted).max() <= slack, precision


def test_the_script_still_makes_them(tmp_path):
    """Whoever changes what the contract or the format means changes these files, and must not."""
    spec = importlib.util.spec_from_file_location("make_integer_vectors", VECTORS / "make_integer_vectors.py")
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    script.main(tmp_path)
    for kind in (
        "integer/int16.json",
        "integer/int8.json",
        *(f"models/{name}.ubm" for name in ("v1-full", "v1-float")),
    ):
        assert (tmp_path / kind).read_bytes() == (VECTORS / kind).read_bytes(), kind
