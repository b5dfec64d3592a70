"""Figures: units survive a round trip, intervals hold their value, what is not a figure is refused."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from upbeam.power.figures import UNITS, Figure, FigureError, convert

BY_DIMENSION = {d: [u for u, (k, _) in UNITS.items() if k == d] for d in {k for k, _ in UNITS.values()}}
PAIRS_OF_UNITS = [(a, b) for units in BY_DIMENSION.values() for a in units for b in units]


@given(st.sampled_from(PAIRS_OF_UNITS), st.floats(1e-12, 1e12))
def test_units_survive_a_round_trip(pair, value):
    there, back = pair
    assert convert(convert(value, there, back), back, there) == pytest.approx(value, rel=1e-15)


@given(st.sampled_from(PAIRS_OF_UNITS), *[st.floats(0.001, 1e6)] * 3)
def test_figures_survive_a_round_trip(pair, a, b, c):
    low, value, high = sorted((a, b, c))
    figure = Figure(value, low, high, pair[0], "assumption", "test")
    again = figure.to(pair[1]).to(pair[0])
    assert again.span(pair[0]) == pytest.approx((value, low, high), rel=1e-15)
    assert figure.to(pair[1]).low <= figure.to(pair[1]).value <= figure.to(pair[1]).high


@pytest.mark.parametrize(
    ("value", "unit", "to", "expected"),
    [(0.154, "mWh", "mJ", 554.4), (5, "KiB", "B", 5120), (21, "GMAC/s", "MAC/s", 21e9), (8, "kbit", "B", 1024),
     (2.5, "GHz", "MHz", 2500), (3, "pJ/MAC", "J/MAC", 3e-12)],
)  # fmt: skip
def test_known_conversions(value, unit, to, expected):
    assert convert(value, unit, to) == pytest.approx(expected)


def test_conversions_that_cannot_be():
    with pytest.raises(FigureError, match="W is a power, mJ a energy"):
        convert(1.0, "W", "mJ")
    with pytest.raises(FigureError, match="'watt' is unknown"):
        convert(1.0, "watt", "W")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((1.0, 2.0, 3.0, "W", "assumption", "x"), "outside"),
        ((3.0, 1.0, 2.0, "W", "assumption", "x"), "outside"),
        ((1.0, 1.0, 1.0, "W", "guess", "x"), "kind 'guess'"),
        ((1.0, 1.0, 1.0, "W", "measured", " "), "source is empty"),
        ((math.nan, 1.0, 1.0, "W", "measured", "x"), "finite"),
        ((1.0, 1.0, math.inf, "W", "measured", "x"), "finite"),
        ((None, None, None, "W", "measured", "x"), "kind 'none'"),
        ((1.0, 1.0, 1.0, "W", "none", "x"), "kind 'none'"),
        ((1.0, 1.0, 1.0, "kV", "measured", "x"), "unit 'kV'"),
    ],
)
def test_refused(arguments, message):
    with pytest.raises(FigureError, match=message):
        Figure(*arguments)


def test_an_absent_figure_says_why_and_gives_no_number():
    absent = Figure.absent("W", "no sensor")
    assert absent.as_dict()["value"] is None
    with pytest.raises(FigureError, match="no sensor"):
        absent.get("W")
    assert absent.to("mW").unit == "mW"
