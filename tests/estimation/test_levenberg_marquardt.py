"""The minimizer on problems whose minima are known: bounds, curved valleys, parameters that vanish."""

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from balance_cli.estimation.levenberg_marquardt import minimize
from balance_cli.estimation.likelihood import Curvature
from balance_cli.model.parameters import ParameterSet

UNKNOWN = np.inf


class Residuals:
    """r(theta) with its Jacobian as `minimize` takes them; counts the calls of each."""

    def __init__(self, residuals, jacobian):
        self.residuals, self.jacobian, self.curvatures, self.values = residuals, jacobian, 0, 0

    def curvature(self, theta):
        self.curvatures += 1
        r, J = self.residuals(theta), self.jacobian(theta)
        return Curvature(float(r @ r), J.T @ r, J.T @ J)

    def chi2(self, theta):
        self.values += 1
        r = self.residuals(theta)
        return float(r @ r)

    def minimum(self, parameters, start, **options):
        return minimize(parameters, np.array(start, float), self.curvature, self.chi2, **options)


def unknown(*names, unit="1", lower=-np.inf, upper=np.inf, scale=1.0):
    """Parameters without a prior."""
    n = len(names)
    limits = (np.full(n, limit) for limit in (lower, upper))
    return ParameterSet(names, (unit,) * n, np.ones(n), np.full(n, UNKNOWN), np.full(n, scale), *limits)


@pytest.mark.parametrize("seed", range(20))
def test_linear_least_squares_within_bounds(seed):
    """Where a step would leave the bounds the other parameters adapt; the result is that of bounded least squares."""
    rng = np.random.default_rng(seed)
    A, b = rng.normal(size=(12, 6)) @ np.diag(10.0 ** rng.uniform(-2, 2, 6)), rng.normal(size=12)
    problem = Residuals(lambda x: A @ x - b, lambda x: A)
    names = tuple(f"effect.{i}" for i in range(6))
    scale = 1e-3 * np.linalg.norm(np.linalg.pinv(A), axis=1).max()
    result = problem.minimum(unknown(*names, lower=0.0, scale=scale), np.full(6, scale), tolerance=1e-9)
    expected = lsq_linear(A, b, (0.0, np.inf))
    assert result.converged
    assert result.total.chi2 == pytest.approx(2.0 * expected.cost, rel=1e-7)
    assert result.theta == pytest.approx(expected.x, rel=1e-3, abs=1e-2 * scale)


def test_a_narrow_curved_valley_is_followed_in_long_steps():
    """Rosenbrock's valley, a thousand times as steep across as along: four hundred damped steps end half way."""
    steep = 1e3
    problem = Residuals(
        lambda x: np.array([steep * (x[1] - x[0] ** 2), 1.0 - x[0]]),
        lambda x: np.array([[-2.0 * steep * x[0], steep], [-1.0, 0.0]]),
    )
    result = problem.minimum(unknown("a", "b", scale=0.1), (-2.0, 4.0), iterations=400, tolerance=1e-10)
    assert result.theta == pytest.approx([1.0, 1.0], abs=1e-4)
    assert result.iterations < 250


@pytest.mark.parametrize("mass", [0.05, 0.2, 5.0, 20.0])
def test_near_its_minimum_the_mass_of_a_support_is_found_below_the_resonance(mass):
    """As a logarithm it took 22 steps from 0.05 kg, and from 5 and 20 kg ended in another minimum."""
    w = np.linspace(0.1, 0.6, 40)

    def motion(x):
        return x[1] / (1.0 - w**2 * x[0] * x[1])

    def jacobian(x):
        stiffness = 1.0 - w**2 * x[0] * x[1]
        return 100.0 * np.stack([(w * x[1] / stiffness) ** 2, stiffness**-2.0], axis=1)

    support = unknown("effect.mass", unit="kg", lower=0.0, scale=0.1)
    support += unknown("effect.compliance", unit="m/N", lower=0.0, scale=0.01)
    problem = Residuals(lambda x: 100.0 * (motion(x) - motion([1.0, 1.0])), jacobian)
    result = problem.minimum(support, (mass, 0.7), tolerance=1e-6, near_minimum=True)
    assert result.theta == pytest.approx([1.0, 1.0], abs=1e-4)
    assert result.iterations < 20


def test_a_vanishing_parameter_does_not_delay_the_others():
    """An inertia with its minimum at a negative value goes to zero as a logarithm; the rest is fitted soon."""
    inertia = unknown("effect.inertia", unit="kg m2", lower=0.0, scale=1.0)
    problem = Residuals(
        lambda x: np.array([x[0] + 2.0, 100.0 * np.expm1(x[1]) - 600.0, 100.0 * (x[2] - 3.0 * x[1])]),
        lambda x: np.array([[1.0, 0.0, 0.0], [0.0, 100.0 * np.exp(x[1]), 0.0], [0.0, -300.0, 100.0]]),
    )
    result = problem.minimum(inertia + unknown("a", "b"), (1.0, 0.0, 0.0), tolerance=1e-6)
    assert result.theta[1:] == pytest.approx([np.log(7.0), 3.0 * np.log(7.0)], rel=1e-4)
    assert 0.0 <= result.theta[0] < 0.02
    assert result.converged and result.iterations < 25


def test_a_nearly_vanished_parameter_stays_finite():
    """From 1e-18 of its scale: a logarithm never reaches its bound."""
    inertia = unknown("effect.inertia", unit="kg m2", lower=0.0, scale=1.0)
    problem = Residuals(
        lambda x: np.array([x[0] + 2.0, x[1] - 1.0]),
        lambda x: np.eye(2),
    )
    result = problem.minimum(inertia + unknown("a"), (1e-18, 0.0), tolerance=1e-9)
    assert 0.0 < result.theta[0] < 1e-17
    assert result.theta[1] == pytest.approx(1.0)


def test_an_accepted_first_step_evaluates_no_chi2():
    """Its curvature includes chi-square."""
    problem = Residuals(lambda x: np.array([x[0] - 3.0, 2.0 * x[1]]), lambda x: np.diag([1.0, 2.0]))
    result = problem.minimum(unknown("a", "b"), (1.0, 1.0))
    assert result.theta == pytest.approx([3.0, 0.0], abs=1e-9)
    assert (problem.curvatures, problem.values) == (result.iterations, 0)


def test_a_fit_goes_on_from_a_known_curvature_as_if_it_had_not_stopped():
    """Of a fit that ended after three steps and goes on, no evaluation is repeated and no digit differs."""

    def residuals(x):
        return np.array([10.0 * (x[1] - x[0] ** 2), 1.0 - x[0]])

    def jacobian(x):
        return np.array([[-20.0 * x[0], 10.0], [-1.0, 0.0]])

    parameters, start = unknown("effect.a", "effect.b"), [-1.2, 1.0]
    apart, at_once = Residuals(residuals, jacobian), Residuals(residuals, jacobian)
    first = apart.minimum(parameters, start, iterations=3)
    assert not first.converged
    before = apart.curvatures
    known = apart.minimum(parameters, first.theta, known=first.data)
    again = at_once.minimum(parameters, first.theta)
    np.testing.assert_array_equal(known.theta, again.theta)
    assert apart.curvatures - before == at_once.curvatures - 1
