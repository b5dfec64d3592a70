"""The schedule of the RTL core: nothing lost, nothing twice, results read while they are there; and what the memories
then calculate is the contract."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from upbeam.quant.export.rtl_schedule import (
    OF_V,
    Configuration,
    ConfigurationError,
    check,
    folds,
    schedule,
    words,
)
from upbeam.quant.integer import IntegerNetwork, network

VECTORS = Path(__file__).resolve().parent.parent / "vectors" / "integer"
EVERY = [(hidden, fold, leaky) for hidden in range(1, 33) for fold in folds(hidden) for leaky in (False, True)]


def test_every_schedule_is_sound():
    for hidden, fold, leaky in EVERY:
        c = Configuration(hidden, fold, leaky=leaky)
        check(c, schedule(c))


def test_few_multipliers_are_idle():
    """A serial core uses each at every clock; a parallel one pads the last clock's units only."""
    for hidden, fold, leaky in EVERY:
        c = Configuration(hidden, fold, leaky=leaky)
        assert c.multipliers * c.fold == 8 * c.padded
        assert 0 <= c.padded - hidden < c.fold


def tampered(c: Configuration, rng: np.random.Generator):
    placed = schedule(c)
    n = int(rng.integers(len(placed)))
    lost, doubled, elsewhere, late, early = (list(placed) for _ in range(5))
    del lost[n]
    doubled[n] = placed[n - 1]
    elsewhere[n] = replace(placed[n], multiplier=placed[n - 1].multiplier, step=placed[n - 1].step)
    v = [k for k, p in enumerate(placed) if p.product == OF_V]
    k = int(rng.choice(v))
    late[k] = replace(placed[k], step=placed[k].step + c.phases)
    early[k] = replace(placed[k], step=placed[k].step - c.phases)
    return lost, doubled, elsewhere, late, early


def test_a_tampered_schedule_is_caught(rng):
    for _ in range(200):
        hidden, fold, leaky = EVERY[int(rng.integers(len(EVERY)))]
        c = Configuration(hidden, fold, leaky=leaky)
        for wrong in tampered(c, rng):
            with pytest.raises(ConfigurationError):
                check(c, wrong)


@pytest.mark.parametrize(
    ("arguments", "problem"),
    [
        ((12, 13), r"FOLD 13: with 12 hidden units it must be 1 to 12, or 24, 48, 96"),
        ((12, 0), "FOLD 0"),
        ((33, 1), "33 hidden units, expected 1 to 32"),
        ((0, 1), "0 hidden units"),
        ((12, 12, 5), "LANES 5 does not divide FOLD 12"),
        ((12, 12, 0), "LANES 0"),
    ],
)
def test_what_cannot_be_built(arguments, problem):
    with pytest.raises(ConfigurationError, match=problem):
        Configuration(*arguments)


# ----------------------------------------------------------------------------------- what the memories calculate


def wrapped(value: int) -> int:
    """As 32 bits, signed."""
    return ((value + (1 << 31)) & 0xFFFFFFFF) - (1 << 31)


def totals(n: IntegerNetwork, precision, c: Configuration, bits: int, e: np.ndarray, m: np.ndarray) -> list[int]:
    """The core's sum of each window as its multipliers meet the words, in Python's own integers."""
    made, back = words(n, precision, c, bits), 1 << 15 if bits == 16 else 0
    found = []
    for window, least in zip(e.tolist(), m.tolist(), strict=True):
        products: dict[tuple[int, int], int] = {}
        for p in schedule(c):
            if c.phases > 1:
                factor = int(made.W[(p.step % c.fold) * c.multipliers + p.multiplier])
            elif p.product < 6:
                factor = int(made.W[6 * p.unit + p.product])
            else:
                factor = int((made.M if p.product == 6 else made.V)[p.unit])
            products[p.unit, p.product] = factor
        total = made.C
        for unit in range(c.padded):
            S = sum(products[unit, i] * (window[i] - back) for i in range(6)) << n.k
            S = wrapped(S + (products[unit, 6] * (least - back) << n.j) + int(made.B[unit]))
            a = S >> 16
            z = a if a >= 0 else (a * n.slope + (1 << 14)) >> 15
            total += products[unit, 7] * z
        found.append(wrapped(total))
    return found


@pytest.mark.parametrize("precision", ["int16", "int8"])
def test_the_words_are_the_network(precision):
    for case in json.loads((VECTORS / f"{precision}.json").read_text())["cases"]:
        n = IntegerNetwork(**case["network"])
        trace = network(n, precision, case["windows"])
        e = trace.q << trace.s[:, None]
        half = (1 << (n.t - 1)) if n.t else 0
        for fold in (1, max(1, n.hidden // 2), n.hidden, *(p * n.hidden for p in (2, 4, 8))):
            c = Configuration(n.hidden, fold, leaky=n.slope > 0)
            assert totals(n, precision, c, 16, e, trace.m) == (trace.Y + half).tolist(), (n.hidden, fold)


def test_a_narrow_network_is_padded_to_the_wide_one():
    case = json.loads((VECTORS / "int8.json").read_text())["cases"][2]
    n = IntegerNetwork(**case["network"])
    trace = network(n, "int8", case["windows"])
    for fold in (1, 2, 5, 10, 20):
        c = Configuration(5, fold, leaky=n.slope > 0) if fold in folds(5) else Configuration(10, fold, leaky=True)
        made = totals(n, "int8", c, 16, trace.q << trace.s[:, None], trace.m)
        assert made == (trace.Y + (1 << (n.t - 1))).tolist()
