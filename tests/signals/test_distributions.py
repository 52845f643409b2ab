"""Tails and quantiles against scipy.stats, far into the tails."""

import subprocess
import sys

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


def test_commands_that_reduce_do_not_import_scipy_stats() -> None:
    code = (
        "import sys, balance_cli.cli.reduce, balance_cli.cli.calibrate, balance_cli.steps.reduce, "
        "balance_cli.steps.calibrate; print('scipy.stats' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


def test_student_widening_is_that_of_the_tables_and_none_where_the_degrees_of_freedom_are_not_known():
    """97.5 % points of Student's t by Abramowitz and Stegun, table 26.10: 12.706, 4.303, 2.228."""
    factor = distributions.student_widening(np.array([1.0, 2.0, 10.0, np.inf, 0.0]))
    assert np.sqrt(factor) * 1.95996 == pytest.approx([12.706, 4.303, 2.228, 1.95996, 1.95996], rel=2e-4)
