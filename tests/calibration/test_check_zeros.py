"""Zeros of held-out runs that hold several load series."""

import numpy as np
import pytest

from balance_cli.calibration.all_trims import calibrate_all_trims
from balance_cli.calibration.check_loads import HeldOutRun
from balance_cli.calibration.check_zeros import zeros_of_run
from balance_cli.calibration.fit import CalibrationPoints

NOISE, SHIFT = 3e-4, 5e-3
C = np.array([[1.0, 0.1, -0.2], [0.2, 0.9, 0.1], [-0.1, 0.3, 1.1]])
UP = np.arange(1, 6) / 5.0
RAMP = np.r_[UP, UP[-2::-1]]


def series_rows(tare):
    """Loads (m, 3) of a series for each side of each load, and their series; tare `first`, `last` or `both`."""
    head, tail = [0.0] * (tare != "last"), [0.0] * (tare != "first")
    parts = [np.outer(np.r_[head, side * RAMP, tail], row) for row in np.eye(3) for side in (1.0, -1.0)]
    return np.vstack(parts), np.repeat(np.arange(len(parts)), [len(part) for part in parts])


def readings(x, series, rng, shift=SHIFT):
    zeros = shift * rng.standard_normal((series[-1] + 1, 3))
    return x @ C + zeros[series] + NOISE * rng.standard_normal((len(x), 3))


def held_out(tare, seed=3, shift=SHIFT):
    """The check of a held-out run with load series of their own zeros, against a calibration of the same balance."""
    rng = np.random.default_rng(seed)
    x, series = series_rows("first")
    points = CalibrationPoints(
        ("a", "b", "c"),
        ("Fx", "Fz", "My"),
        ("s",),
        readings(x, series, rng),
        x,
        np.zeros(len(x), int),
        np.ones(len(x)),
        np.ones(3),
    )
    x, series = series_rows(tare)
    return calibrate_all_trims(
        points, [HeldOutRun("held", readings(x, series, rng, shift), x)], non_iterative=True
    ).checks


@pytest.mark.parametrize(("tare", "side"), [("first", "before"), ("last", "after"), ("both", "before and after")])
def test_each_load_series_of_a_held_out_run_has_its_own_zero(tare, side):
    """With one zero 9 to 30 % of the loads were in their intervals."""
    for check in held_out(tare):
        assert check.zeros == f"zeros of its 6 load series differ; each is counted from the tare point {side} its loads"
        assert np.mean(check.interval_coverage) > 0.9
        assert np.all(check.error < 3.0 * NOISE)


def test_zeros_that_do_not_differ_are_one():
    for check in held_out("first", shift=0.0):
        assert check.zeros is None
        assert np.mean(check.interval_coverage) > 0.9


def test_the_zero_of_a_series_is_the_mean_of_its_tare_points():
    tare = np.array([True, False, True, True, False, True])
    unloaded = np.array([[0.0], [1.0], [2.0], [10.0], [11.0], [12.0]])
    zero = zeros_of_run(unloaded, tare, np.array([1e-6]), 30.0)
    np.testing.assert_allclose(zero.readings[[1, 4], 0], [1.0, 11.0])
    np.testing.assert_allclose(zero.variance, 0.5e-6)
