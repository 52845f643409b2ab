"""Whole load series with one mistake: excluded, and the mistake named."""

from dataclasses import replace

import numpy as np
import pytest

from balance_cli.calibration.all_trims import calibrate_all_trims
from balance_cli.cli.calibration_text import math_model_warnings
from tests.support.calibration_stand import stand_points

FACTORS = {
    "reversed": (-1.0, "its loads seem to be of the other sign"),
    "lbf": (1 / 4.4482216, "its loads seem to be in lbf"),
    "kgf": (1 / 9.80665, "its loads seem to be in kgf"),
    "stated twice": (2.0, "its loads seem to be 0."),
}


def spoil(change, series=20):
    """The stand, with the loads of one of its series changed: rows, loads (r, 6) -> loads."""
    points = stand_points()
    rows = np.flatnonzero(points.load_series == series)
    loads = points.loads.copy()
    loads[rows] = change(loads[rows])
    return rows, replace(points, loads=loads, series=points.load_series)


def causes(points):
    whole = calibrate_all_trims(points)
    return whole, {suspect.cause for suspect in whole.suspect_series}


@pytest.mark.parametrize("name", FACTORS)
def test_loads_in_another_unit_or_of_the_other_sign(name):
    factor, words = FACTORS[name]
    rows, points = spoil(lambda loads: factor * loads)
    whole, (cause,) = causes(points)
    assert cause.startswith(words)
    excluded = ~np.isfinite(whole.residuals).all(axis=1)
    np.testing.assert_array_equal(np.flatnonzero(excluded), rows)
    assert any(words in warning for warning in math_model_warnings(whole))


def test_two_columns_exchanged():
    def exchange(loads):
        moved = np.argsort(-np.ptp(loads, axis=0))[0]
        other = (moved + 3) % 6
        loads = loads.copy()
        loads[:, [moved, other]] = loads[:, [other, moved]]
        return loads

    _, points = spoil(exchange)
    _, (cause,) = causes(points)
    assert cause.endswith("seem to be exchanged")


def test_rows_in_reverse_order():
    """In a ramp to both sides; a ramp to one side is its own reverse."""
    _, points = spoil(lambda loads: loads[::-1], series=1)
    _, (cause,) = causes(points)
    assert cause == "its loads seem to stand in reverse order"


def test_one_wrong_channel_is_no_mistake_of_the_loads():
    points = stand_points()
    rows = points.load_series == 20
    channels = points.channels.copy()
    c = int(np.argmax(np.ptp(channels[rows], axis=0)))
    channels[rows, c] = channels[rows, c].mean() + 1.3 * (channels[rows, c] - channels[rows, c].mean())
    whole, named = causes(replace(points, channels=channels))
    assert whole.suspect_series and named == {None}
