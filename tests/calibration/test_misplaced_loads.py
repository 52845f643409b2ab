"""Exchanged and reversed rows of short tables: found by themselves, and not where something else explains them."""

import numpy as np
import pytest

from balance_cli.calibration.all_trims import calibrate_all_trims
from balance_cli.calibration.fit import CalibrationPoints
from balance_cli.calibration.load_series_score import ScheduleRows
from balance_cli.calibration.misplaced_loads import find_misplaced_loads

FULL_RANGE = np.array([800.0, 800.0, 3500.0])


def short_table(seed, curvature=1e-3, shift=5e-3):
    """Loads x (15, 3), each up and down between two tare points, and readings (15, 3) of a balance by chance."""
    rng = np.random.default_rng(seed)
    ramp = np.array([0.0, 0.5, 1.0, 0.5, 0.0])
    x = np.vstack([np.outer(ramp, row) for row in np.eye(3)])
    C = np.eye(3) + 0.3 * rng.standard_normal((3, 3))
    zeros = np.repeat(shift * rng.standard_normal((3, 3)), 5, axis=0)
    readings = x @ C + curvature * (x**2) @ rng.standard_normal((3, 3)) + zeros + 3e-4 * rng.standard_normal((15, 3))
    return x, readings


def find(x, readings, stated=()):
    zeros = np.zeros(len(x), np.intp)
    labels = tuple(stated) or ("",) * len(x)
    used, tare = np.ones(len(x), bool), np.zeros(len(x), bool)
    found = find_misplaced_loads(ScheduleRows(x, readings, used, zeros, zeros, ("a",), labels, tare))
    return None if found is None else found.rows


def exchange(x, i, j):
    changed = x.copy()
    changed[[i, j]] = x[[j, i]]
    return changed


@pytest.mark.parametrize("rows", [(1, 2), (2, 7), (3, 12), (6, 11)])
def test_two_exchanged_rows_are_found(rows):
    x, readings = short_table(1)
    assert find(exchange(x, *rows), readings) == rows
    assert find(exchange(x, *rows), readings, "aaaaabbbbbccccc") == rows


def test_an_exchange_that_a_reversed_gain_explains_as_well_is_not_named():
    """Peak and tare of a series with a zero of its own: the other tare and the peak, and the gain with a minus."""
    x, readings = short_table(1)
    assert find(exchange(x, 2, 4), readings) == (2, 4)
    assert find(exchange(x, 2, 4), readings, "aaaaabbbbbccccc") is None


@pytest.mark.parametrize("row", [1, 2, 8, 12])
def test_a_reversed_row_is_found(row):
    x, readings = short_table(2)
    x[row] *= -1.0
    assert find(x, readings) == (row,)


def test_sound_tables_have_none():
    """Also where the balance is curved by a fifth of its range, or the zeros jump by as much."""
    for seed in range(10):
        assert find(*short_table(seed)) is None
        assert find(*short_table(seed, curvature=0.1)) is None
        assert find(*short_table(seed, shift=0.1)) is None


def test_a_wrong_reading_is_no_exchange():
    for row in range(15):
        x, readings = short_table(3)
        readings[row, 1] += 0.3
        assert find(x, readings) is None


def test_two_loads_of_one_size_are_no_exchange():
    x, readings = short_table(4)
    assert find(exchange(x, 1, 3), readings) is None


@pytest.mark.parametrize(("mistake", "rows"), [("exchange", {3, 8}), ("reading", {7})])
def test_the_wrong_rows_of_a_short_table_are_named_and_no_others(mistake, rows):
    """One of five rows of a series that is wrong made its neighbors look wrong."""
    x, readings = short_table(5)
    if mistake == "exchange":
        x = exchange(x, 2, 7)
    else:
        readings[6, 2] += 0.05
    run, weight = np.zeros(15, np.intp), np.ones(15)
    whole = calibrate_all_trims(
        CalibrationPoints(
            ("a", "b", "c"), ("Fx", "Fy", "Fz"), ("r",), readings, x * FULL_RANGE, run, weight, FULL_RANGE
        )
    )
    assert {outlier.row for outlier in whole.outliers} == rows
    assert len(rows) == 1 or {outlier.exchanged_with for outlier in whole.outliers} == rows
