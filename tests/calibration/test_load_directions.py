"""Loads in another unit, or of the other sign, in one direction or one load series: refused, and sound ones are not."""

import numpy as np
import pytest

from balance_cli.calibration.all_trims import calibrate_all_trims
from balance_cli.calibration.fit import CalibrationPoints
from balance_cli.calibration.load_directions import check_load_directions
from balance_cli.io.errors import UserError

LEVEL = np.array([0.0, 0.25, 0.5, 0.75, 1.0, 0.5, 0.0])


def points_of(factor, seed=0, sides=0.0):
    """Each load in both directions; the loads of Fy downwards are stated `factor` times as large as they are."""
    parts = [np.outer(side * LEVEL, np.eye(3)[j]) for j in range(3) for side in (1.0, -1.0)]
    x, series = np.vstack(parts), np.repeat(np.arange(6), len(LEVEL))
    rng, m = np.random.default_rng(seed), len(x)
    C = np.eye(3, 4) + 0.2 * rng.normal(size=(3, 4))
    read = x @ C + sides * np.abs(x) @ C + 5e-3 * rng.normal(size=(6, 4))[series] + 3e-4 * rng.normal(size=(m, 4))
    loads = 100.0 * x * np.where(series == 3, factor, 1.0)[:, None]
    names, largest = tuple(f"g{c}" for c in range(4)), np.max(np.abs(loads), axis=0)
    return CalibrationPoints(names, ("Fx", "Fy", "Fz"), ("s",), read, loads, np.zeros(m, int), np.ones(m), largest)


@pytest.mark.parametrize(
    ("factor", "words"),
    [
        (1 / 4.4482216, "in lbf"),
        (4.4482216, "in lbf"),
        (1 / 9.80665, "in kgf"),
        (9.80665, "in kgf"),
        (1e-3, "a thousand"),
        (1e3, "a thousand"),
        (-1.0, "of the other sign"),
    ],
)
def test_a_direction_in_another_unit_is_refused(factor, words):
    """A term |Fy| had explained it in other such tables, and the calibration was written without a word."""
    with pytest.raises(UserError) as error:
        calibrate_all_trims(points_of(factor))
    assert words in str(error.value) and "Fy" in str(error.value) and "rows 2" in str(error.value)


@pytest.mark.parametrize("sides", [0.0, 0.01, 0.2])
def test_directions_that_differ_as_balances_do_are_no_contradiction(sides):
    assert calibrate_all_trims(points_of(1.0, 1, sides)).outliers == ()


@pytest.mark.parametrize("seed", [10, 18, 33, 46, 58])
def test_random_loads_whose_directions_share_their_rows_are_no_contradiction(seed):
    """Of directions that the rows do not tell apart each had a part of the response: one of twelve was refused."""
    rng = np.random.default_rng(seed)
    x = np.vstack([np.vstack([np.zeros(6), rng.uniform(-1.0, 1.0, (6, 6))]) for _ in range(11)])
    C = rng.normal(size=(6, 9))
    C[:, 8] = np.eye(6)[5]
    read = x @ C + 1e-5 * rng.normal(size=(len(x), 9))
    names, components = tuple(f"g{c}" for c in range(9)), ("Fx", "Fy", "Fz", "Mx", "My", "Mz")
    run, weight, all_rows = np.zeros(len(x), int), np.ones(len(x)), np.ones(len(x), bool)
    points = CalibrationPoints(names, components, ("s",), read, x, run, weight, np.max(np.abs(x), axis=0))
    check_load_directions(points, all_rows, all_rows)
