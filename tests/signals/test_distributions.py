"""Tails and quantiles against scipy.stats, far into the tails."""

import numpy as np
import pytest
from scipy import stats

from balance_cli.signals import distributions

P = np.array([1e-200, 1e-30, 1e-9, 1e-3, 0.05, 0.5, 0.95, 0.999])
DOF = np.array([[1.0], [2.5], [7.0], [60.0], [4000.0]])
X = np.array([-1.0, 0.0, 1e-3, 0.5, 1.0, 4.0, 30.0, 900.0])


@pytest.mark.parametrize(
    ("name", "parameters"), [("norm", ()), ("chi2", (DOF,)), ("f", (DOF, 12.0)), ("f", (3.0, DOF)), ("t", (DOF,))]
)
class TestDistributions:
    def test_survival_function(self, name: str, parameters: tuple[object, ...]) -> None:
        mine = getattr(distributions, name).sf(X, *parameters)
        np.testing.assert_allclose(mine, getattr(stats, name).sf(X, *parameters), rtol=1e-9, atol=1e-300)

    def test_inverse_of_the_survival_function(self, name: str, parameters: tuple[object, ...]) -> None:
        mine = getattr(distributions, name)
        p = P[1:]
        back = mine.sf(mine.isf(p, *parameters), *parameters)
        np.testing.assert_allclose(back, np.broadcast_to(p, back.shape), rtol=1e-6)

    def test_quantile(self, name: str, parameters: tuple[object, ...]) -> None:
        mine = getattr(distributions, name).ppf(P[2:], *parameters)
        np.testing.assert_allclose(mine, getattr(stats, name).ppf(P[2:], *parameters), rtol=1e-8, atol=1e-12)


def test_infinite_degrees_of_freedom_of_f_are_no_nan() -> None:
    assert np.isfinite(distributions.f.sf(2.0, 3.0, 1e12))


def test_quantile_of_counts_is_the_count_that_is_reached_exactly() -> None:
    p, mean = np.array([1e-6, 0.01, 0.3, 0.5, 0.95, 0.999, 1.0 - 1e-9]), np.array([[1e-6], [0.6], [5.0], [2000.0]])
    np.testing.assert_array_equal(distributions.poisson.ppf(p, mean), stats.poisson.ppf(p, mean))
    exact = stats.poisson.cdf(np.arange(40), 12.0)
    np.testing.assert_array_equal(distributions.poisson.ppf(exact, 12.0), stats.poisson.ppf(exact, 12.0))


def test_probability_of_few_successes() -> None:
    count, success = np.arange(31)[:, None], np.array([0.1, 0.5, 0.95, 1.0])
    expected = stats.binom.cdf(count, 30, success)
    np.testing.assert_allclose(distributions.binom.cdf(count, 30, success), expected, rtol=1e-12, atol=1e-300)


def test_student_widening_is_that_of_the_tables_and_none_where_the_degrees_of_freedom_are_not_known():
    """97.5 % points of Student's t by Abramowitz and Stegun, table 26.10: 12.706, 4.303, 2.228."""
    factor = distributions.student_widening(np.array([1.0, 2.0, 10.0, np.inf, 0.0]))
    assert np.sqrt(factor) * 1.95996 == pytest.approx([12.706, 4.303, 2.228, 1.95996, 1.95996], rel=2e-4)
