"""Writes the golden vectors of the integer contract and the golden model files of format version 1.

    python tests/vectors/make_integer_vectors.py

``integer/int16.json`` and ``int8.json``: networks, windows and every step of docs/numeric-contract.md, for whoever
writes another implementation. ``models/*.ubm`` with ``*.npz``: files of version 1 and what an image gives with them.
Contract and format are frozen: running this again must change nothing (``tests/quant/test_golden.py``). Parameters are
drawn, not trained.
"""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from upbeam.model.beams import beam_table
from upbeam.model.network import FoldedNetwork, WindowNetwork
from upbeam.model.rules import Rules, upsample_reference
from upbeam.quant.integer import CONTRACTS, IntegerModel, IntegerNetwork, network, prove, upsample_integer
from upbeam.quant.ubm import ModelFile

HERE = Path(__file__).resolve().parent
SEED = 20261122
LARGEST = 40_000
PARAMETERS = ("weight", "minimum", "bias", "output", "offset", "slope", "skip", "k", "j", "t")
STEPS = ("m", "d", "s", "q", "S", "a", "z", "Y", "r", "y")


def draw_network(rng: np.random.Generator, precision: Any, hidden: int, slope: int, skip: int) -> IntegerNetwork:
    """As large as the proof allows for inputs up to LARGEST."""
    widest, k = (127, 3) if precision == "int8" else (32767, 0)
    weight = rng.integers(-widest, widest + 1, (hidden, 6))
    room = 0.9 * 2**31 / (np.abs(weight).sum(axis=1) * (LARGEST << k) + (1 << 28))
    weight = np.trunc(weight * np.minimum(1.0, room)[:, None]).astype(np.int64)
    output = rng.integers(-widest, widest + 1, hidden)
    output = np.trunc(output * min(1.0, 0.8 * 2**30 / (np.abs(output).sum() * 32768))).astype(np.int64)
    made = IntegerNetwork(
        weight=weight,
        minimum=rng.integers(-3000, 3001, hidden),
        bias=rng.integers(-(1 << 26), 1 << 26, hidden),
        output=output,
        offset=int(rng.integers(-(1 << 24), 1 << 24)),
        slope=slope,
        skip=skip,
        k=k,
        j=0,
        t=int(rng.integers(10, 16)),
    )
    prove(made, precision, LARGEST, LARGEST, "golden")
    return made


def draw_windows(rng: np.random.Generator) -> np.ndarray:
    """Extremes, flat windows, edges; around the block code's borders."""
    fixed = [
        [0] * 6, [LARGEST] * 6, [0, LARGEST] * 3, [LARGEST, 0] * 3, [0, 0, 0, 0, 0, LARGEST], [1500] * 6,
        [1000, 1000, 1000, 1000, 1000, 1255], [1000, 1000, 1000, 1000, 1000, 1256],
        [1000, 1510, 1511, 1512, 1000, 1255], [0, 1, 2, 3, 4, LARGEST],
    ]  # fmt: skip
    spreads = rng.choice([2, 100, 300, 3000, 20_000], 30)
    drawn = [rng.integers(0, s, 6) + rng.integers(0, LARGEST + 1 - s) for s in spreads]
    return np.array([*fixed, *drawn], dtype=np.int64)


def contract_vectors(precision: Any) -> dict[str, Any]:
    rng = np.random.default_rng([SEED, len(precision)])
    cases = []
    for hidden, slope, skip in ((12, 0, 1), (8, 256, 1), (1, 328, 0), (32, 32767, 1)):
        drawn, windows = draw_network(rng, precision, hidden, slope, skip), draw_windows(rng)
        trace = network(drawn, precision, windows)
        steps = {name: np.asarray(getattr(trace, name)).tolist() for name in STEPS}
        parameters = {name: np.asarray(getattr(drawn, name)).tolist() for name in PARAMETERS}
        cases.append({"network": parameters, "windows": windows.tolist(), "steps": steps})
    return {"contract": CONTRACTS[precision], "largest_input": LARGEST, "cases": cases}


def draw_dense(rng: np.random.Generator, **graph: Any) -> WindowNetwork:
    def small(*shape: int) -> np.ndarray:
        return np.asarray(rng.normal(0, 0.3, shape), dtype=np.float32).astype(np.float64)

    return WindowNetwork(
        small(8), small(8), small(2, 8), small(2), small(12, 13), small(12), small(12), 0.125, scale=0.0625, **graph
    )


def golden_models() -> dict[str, tuple[ModelFile, bytes]]:
    rng = np.random.default_rng([SEED, 7])
    aligned = Rules.for_beams(beam_table("hdl-64e").aligned(), columns=64)
    paper = Rules.for_beams(
        beam_table("hdl-64e").aligned(), columns=64, edge="zero", last_row="repeat", empty="none", ground_reach=0.0
    )
    grey = draw_network(rng, "int16", 12, 0, 1), draw_network(rng, "int8", 12, 0, 1)
    full = ModelFile.from_dense(
        aligned,
        (
            draw_dense(rng, inputs="difference", output="residual", slope=0.0),
            draw_dense(rng, inputs="difference", output="residual", slope=0.0),
        ),
        provenance={"recipe": "golden", "note": "drawn, not trained"},
        metrics={"mae_m": 0.5},
    )
    full = replace(
        full,
        int16=IntegerModel("int16", draw_network(rng, "int16", 12, 256, 1), grey[0]),
        int8=IntegerModel("int8", draw_network(rng, "int8", 9, 256, 1), grey[1]),
        signature=b"golden signature",
    )
    raw = FoldedNetwork(rng.normal(0, 0.3, (12, 7)), rng.normal(size=12), rng.normal(0, 0.3, 12), 0.5, 0.0, 0.01)
    float_only = ModelFile(paper, (raw, raw))
    files = {"v1-full": full, "v1-float": float_only}
    return {name: (file, file.to_bytes()) for name, file in files.items()}


def image(name: str) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng([SEED, *name.encode()])
    near = rng.integers(1000, 42_000, (32, 1)) + rng.integers(0, 400, (32, 64))
    jumps = np.where(rng.random((32, 64)) < 0.1, rng.integers(0, 65_536, (32, 64)), near)
    distance = np.where(rng.random((32, 64)) < 0.15, 0, jumps)
    return distance.astype(np.uint16), rng.integers(0, 256, (32, 64), dtype=np.uint8)


def outputs(name: str, file: ModelFile) -> dict[str, np.ndarray]:
    distance, intensity = image(name)
    made = {"distance": distance, "intensity": intensity}
    made["fp32_distance"], made["fp32_intensity"] = upsample_reference(distance, intensity, file.folded, file.rules)
    for precision in file.precisions[1:]:
        model = file.integer(precision)
        assert model is not None
        both = upsample_integer(distance, intensity, model, file.rules)
        made[f"{precision}_distance"], made[f"{precision}_intensity"] = both
    return made


def main(out: Path) -> None:
    for folder in ("integer", "models"):
        (out / folder).mkdir(parents=True, exist_ok=True)
    for precision in CONTRACTS:
        text = json.dumps(contract_vectors(precision), separators=(",", ":"))
        (out / "integer" / f"{precision}.json").write_text(text.replace('{"network"', '\n{"network"') + "\n")
    for name, (file, data) in golden_models().items():
        (out / "models" / f"{name}.ubm").write_bytes(data)
        np.savez_compressed(out / "models" / f"{name}.npz", **outputs(name, file))  # type: ignore[arg-type]


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else HERE)
