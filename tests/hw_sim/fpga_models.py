"""Models and configurations for the tests of the FPGA core, built side by side."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np

from upbeam import load_model
from upbeam.hw_sim.fpga import RtlCore
from upbeam.model.beams import beam_table
from upbeam.model.rules import Rules
from upbeam.quant.export.source import Source
from upbeam.quant.integer import IntegerModel, IntegerNetwork, largest_inputs, prove

VECTORS = Path(__file__).resolve().parent.parent / "vectors"


def shipped(name: str = "hdl-64e") -> Source:
    model = load_model(name)
    return Source.of(model.data, name)


def golden() -> Source:
    """Leaky rectifiers, 12 and 9 hidden units, 64 columns."""
    return Source.of((VECTORS / "models" / "v1-full.ubm").read_bytes(), "v1-full")


def small_rules(columns: int = 12, **changes) -> Rules:
    return Rules.for_beams(beam_table("hdl-64e").aligned(), columns=columns, **changes)


def with_networks(rules: Rules, distance: IntegerNetwork, intensity: IntegerNetwork, precision: str) -> Source:
    file = replace(golden().file, rules=rules, int16=None, int8=None, signature=b"")
    model = IntegerModel(precision, distance, intensity)
    return Source.of(replace(file, **{precision: model}).to_bytes(), "drawn")


def drawn(rng: np.random.Generator, precision: str, hidden: tuple[int, int], slope: int, rules: Rules) -> Source:
    """Both networks as large as the proof allows, and without a skip in one of them."""
    networks = []
    for which, units, skip in zip(("distance", "intensity"), hidden, (1, 0), strict=True):
        largest, difference = largest_inputs(rules, which)
        widest, k = (127, 3) if precision == "int8" else (32767, 0)
        weight = rng.integers(-widest, widest + 1, (units, 6))
        room = 0.9 * 2**31 / (np.abs(weight).sum(axis=1) * (largest << k) + (1 << 28))
        weight = np.trunc(weight * np.minimum(1.0, room)[:, None]).astype(np.int64)
        output = rng.integers(-widest, widest + 1, units)
        output = np.trunc(output * min(1.0, 0.8 * 2**30 / (np.abs(output).sum() * 32768))).astype(np.int64)
        made = IntegerNetwork(
            weight=weight, minimum=rng.integers(-3000, 3001, units), bias=rng.integers(-(1 << 26), 1 << 26, units),
            output=output, offset=int(rng.integers(-(1 << 20), 1 << 20)), slope=slope, skip=skip, k=k,
            j=0 if which == "distance" else 8, t=12,
        )  # fmt: skip
        prove(made, precision, largest, difference, which)
        networks.append(made)
    return with_networks(rules, *networks, precision)


def build_all(wanted: dict[str, tuple]) -> dict[str, RtlCore]:
    """``(source, precision, options)`` by name; compilers run two at a time."""
    with ThreadPoolExecutor(2) as pool:
        waiting = {name: pool.submit(RtlCore, s, precision, **more) for name, (s, precision, more) in wanted.items()}
        return {name: future.result() for name, future in waiting.items()}


def random_image(rng: np.random.Generator, rules: Rules, columns: int) -> tuple[np.ndarray, np.ndarray]:
    """Runs of small differences, jumps, holes, counts beyond the limits."""
    near = rng.integers(rules.min_count, rules.max_count, (32, 1)) + rng.integers(0, 400, (32, columns))
    anything = rng.random((32, columns)) < 0.2
    distance = np.where(anything, rng.integers(0, 65_536, (32, columns)), near)
    distance = np.where(rng.random((32, columns)) < rng.random((1, columns)) ** 2, 0, distance)
    return np.minimum(distance, 65_535).astype(np.uint16), rng.integers(0, 256, (32, columns), dtype=np.uint8)
