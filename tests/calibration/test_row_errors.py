"""Errors that weights have are no mistakes, and mistakes beside them are found."""

import numpy as np
import pytest

from balance_cli.calibration.fit import CalibrationPoints
from balance_cli.calibration.outliers import screen_outliers
from balance_cli.calibration.robust_scale import LARGEST_LOAD_ERROR, USUAL_LOAD_ERROR, load_error_sigma

LEVEL = np.array([0.0, 0.5, 1.0, -0.5, -1.0, 0.0])


def points_of(seed, wrong=1.0):
    """Six loads in turn; the last channel reads the last load alone, as a torque meter, with a tenth of the noise."""
    rng = np.random.default_rng(seed)
    x = np.vstack([np.outer(LEVEL, np.eye(6)[j]) for j in range(6)])
    C = np.zeros((6, 8))
    C[:5, :7], C[5, 7] = rng.normal(size=(5, 7)), 1.0
    noise = np.where(np.arange(8) == 7, 1e-5, 1e-4) * rng.normal(size=(len(x), 8))
    read = x * (1.0 + 5e-4 * rng.normal(size=x.shape)) @ C + noise
    loads = x.copy()
    loads[32, 5] *= wrong
    names, components = tuple(f"g{c}" for c in range(8)), ("Fx", "Fy", "Fz", "Mx", "My", "Mz")
    run, weight = np.zeros(len(x), int), np.ones(len(x))
    return CalibrationPoints(names, components, ("s",), read, loads, run, weight, np.ones(6))


@pytest.mark.parametrize("seed", range(5))
def test_weights_that_are_off_by_a_twentieth_of_a_percent_stay(seed):
    """Most rows show the noise of such a channel alone: rows of the largest loads were excluded by 20 to 50 sigma."""
    assert screen_outliers(points_of(seed)).outliers == ()


@pytest.mark.parametrize("wrong", [0.9, 1.05])
def test_a_weight_that_was_forgotten_is_found_beside_them(wrong):
    assert 33 in [outlier.row for outlier in screen_outliers(points_of(0, wrong)).outliers]


def test_load_errors_are_told_by_the_rows_that_show_them():
    rng = np.random.default_rng(3)
    predicted = np.concatenate([np.zeros(400), rng.uniform(0.3, 1.0, 200)])[:, None]
    for share, known in ((6e-4, 6e-4), (1e-2, LARGEST_LOAD_ERROR), (1e-6, USUAL_LOAD_ERROR)):
        errors = 1e-7 * rng.normal(size=predicted.shape) + share * predicted * rng.normal(size=predicted.shape)
        np.testing.assert_allclose(load_error_sigma(errors, predicted), known * predicted, rtol=0.15)
