"""Numbers as text: never more digits than sigma is worth, and what is read back is what was meant."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from balance_cli.report.number_format import (
    capitalize_first,
    format_fixed,
    format_percent,
    format_significant,
    join_names,
    value_and_sigma_text,
)

NUMBERS = st.floats(1e-12, 1e12) | st.floats(-1e12, -1e-12)


def back(text: str) -> float:
    return float(text.replace("\N{MINUS SIGN}", "-"))


@given(NUMBERS, st.integers(1, 7))
def test_significant_digits_read_back(value, digits):
    assert back(format_significant(value, digits)) == pytest.approx(value, rel=0.51 * 10.0 ** (1 - digits))


@given(NUMBERS, st.floats(1e-12, 1e12))
def test_value_and_sigma_read_back(value, sigma):
    text, error = value_and_sigma_text(value, sigma)
    assert back(error) == pytest.approx(sigma, rel=0.051)
    assert abs(back(text) - value) <= max(0.051 * sigma, 0.51e-6 * abs(value))


@pytest.mark.parametrize(
    ("value", "sigma", "expected"),
    [
        (23.31217, 0.5871, ("23.31", "0.59")),
        (-0.00976, 0.0011, ("\N{MINUS SIGN}0.0098", "0.0011")),
        (3.559e6, 4.8e4, ("3.559e6", "0.048e6")),
        (161.02, 2.2, ("161.0", "2.2")),
        (1.5, 23.0, ("2", "23")),
        (90000.0, 0.0, ("90000", "\N{EN DASH}")),
        (math.nan, 1.0, ("\N{EN DASH}", "1.0")),
    ],
)
def test_value_and_sigma_as_they_are_written(value, sigma, expected):
    assert value_and_sigma_text(value, sigma) == expected


def test_percent_and_fixed():
    assert [format_percent(x) for x in (1.334, 0.0721, 4.5e-4, 1e-6, 0.0, math.nan)] == [
        "133",
        "7.2",
        "0.045",
        "<0.001",
        "0",
        "\N{EN DASH}",
    ]
    assert format_fixed(-0.001, 2) == "0.00"
    assert format_fixed(-1.25, 1) == "\N{MINUS SIGN}1.2"


def test_words():
    assert [join_names([]), join_names(["a"]), join_names(["a", "b", "c"])] == ["", "a", "a, b and c"]
    assert capitalize_first("identified rigid") == "Identified rigid"
