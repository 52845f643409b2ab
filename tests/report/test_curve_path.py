"""Paths of curves with many points: no extreme is lost, gaps stay, and they are short."""

import re

import numpy as np
import pytest

from balance_cli.report.axis_ticks import make_scale
from balance_cli.report.curve_path import BIN, FLAT, area_path, curve_path


def points(path):
    """The lines of a path, as arrays (n, 2) of places."""
    lines = []
    for first, steps in re.findall(r"M(-?\d+ -?\d+)(?:l([-\d ]*))?", path):
        moves = [int(number) for number in re.findall(r"-?\d+", steps)]
        start = np.array([[int(number) for number in first.split()]])
        lines.append(np.cumsum(np.vstack([start, np.reshape(moves, (-1, 2))]), axis=0))
    return lines


def test_a_curve_with_few_points_is_drawn_through_them():
    x, y = np.array([0.0, 10.0, 25.0]), np.array([3.2, -7.4, 8.0])
    (drawn,) = points(curve_path(x, y))
    np.testing.assert_array_equal(drawn, [[0, 3], [10, -7], [25, 8]])


def test_no_extreme_is_lost_and_the_path_is_short():
    rng = np.random.default_rng(2)
    x = np.linspace(0.0, 600.0, 20000)
    y = 40.0 * np.sin(x / 60.0) + rng.normal(size=len(x))
    y[7777], y[12345] = 100.0, -100.0
    path = curve_path(x, y)
    (drawn,) = points(path)
    assert (drawn[:, 1].min(), drawn[:, 1].max()) == (-100, 100)
    assert len(drawn) <= 2 * (600 / BIN + 1) + 2
    assert len(path) < 2500
    assert np.all(np.diff(drawn[:, 0]) >= 0)
    low, high = np.interp(x, drawn[:, 0], drawn[:, 1]) - y.min(), y.max() - np.interp(x, drawn[:, 0], drawn[:, 1])
    assert np.all(low >= -1) and np.all(high >= -1)


def test_a_slope_is_drawn_as_a_slope():
    x = np.linspace(0.0, 300.0, 5000)
    (drawn,) = points(curve_path(x, 2.0 * x))
    assert np.abs(drawn[:, 1] - 2 * drawn[:, 0]).max() <= 2.0
    (flat,) = points(curve_path(x, np.zeros(len(x)) + 0.3 * FLAT * np.sin(x)))
    assert np.abs(flat[:, 1]).max() <= 1


def test_gaps_interrupt_the_curve_and_an_area_reaches_its_bottom():
    x = np.arange(8.0) * 10
    y = np.array([np.nan, 1.0, 2.0, np.nan, 4.0, np.nan, 6.0, 7.0])
    assert [len(line) for line in points(curve_path(x, y))] == [2, 1, 2]
    drawn = points(area_path(x, y, 50.0))
    assert [line[0, 1] for line in drawn] == [50, 50, 50] == [line[-1, 1] for line in drawn]
    assert curve_path(x, np.full(8, np.nan)) == ""


@pytest.mark.parametrize("log", [True, False])
def test_places_of_values_are_those_of_the_scale(log):
    scale = make_scale([], 100.0, 0.0, log, (0.5, 50.0))
    values = np.array([0.5, 3.0, 50.0])
    np.testing.assert_allclose(scale.places(values), [scale.at(value) for value in values])
    outside = scale.places(np.array([1e9, 0.0, np.nan]))
    assert outside[0] == pytest.approx(-10.0) and 100.0 < outside[1] <= 110.0 and np.isnan(outside[2])
