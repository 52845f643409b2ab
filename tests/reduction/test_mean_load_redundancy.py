"""The residual test of mean loads keeps its level where its covariance was estimated from little."""

import numpy as np
import pytest

from balance_cli.reduction.mean_loads import mean_load_redundancy, redundancy_chi2


@pytest.mark.parametrize("dof", [12, 40])
def test_an_estimated_covariance_raises_no_false_alarms(dof):
    rng = np.random.default_rng(dof)
    C0 = rng.standard_normal((11, 6))
    above = {"estimated": 0, "taken as known": 0}
    for _ in range(3000):
        samples = rng.standard_normal((dof, 11))
        covariance = samples.T @ samples / dof
        reading = C0 @ rng.standard_normal(6) + rng.standard_normal(11)
        for name, degrees in (("estimated", dof), ("taken as known", np.inf)):
            redundancy, limit = mean_load_redundancy(reading, C0, covariance, degrees)
            above[name] += redundancy > limit
    assert above["estimated"] <= 12
    assert above["taken as known"] > above["estimated"]


def test_chi_square_of_many_rows_is_that_of_weighted_least_squares():
    rng = np.random.default_rng(2)
    C0, readings, factors = (rng.standard_normal(shape) for shape in ((20, 9, 6), (20, 9), (20, 9, 9)))
    chi2 = redundancy_chi2(readings, C0, factors @ factors.swapaxes(1, 2))
    for i, value in enumerate(chi2):
        whitened = np.linalg.solve(factors[i], np.column_stack([C0[i], readings[i]]))
        expected = np.linalg.lstsq(whitened[:, :6], whitened[:, 6])[1][0]
        np.testing.assert_allclose(value, expected, rtol=1e-6)
