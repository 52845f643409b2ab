"""Levenberg-Marquardt on a chi-square that comes with its Gauss-Newton curvature and Gaussian priors."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.estimation.coordinates import Coordinates, coordinates
from balance_cli.estimation.likelihood import Curvature
from balance_cli.model.parameters import ParameterSet

Array = NDArray[np.float64]

# Damping starts at none: what the priors alone hold has an information of 1e-10 of what the data hold, and any damping
# would keep such directions from moving.
MIN_DAMPING = 1e-8
# Factors of the damping where a step does not serve and where one does; that by which one that serves is lengthened.
DAMPING_INCREASE, DAMPING_DECREASE, STEP_EXTENSION = 10.0, 10.0, 3.0
MAX_TRIALS = 24
# Scales from a bound at which it is reached, and by which rounding may miss it.
BOUND_TOLERANCE = 1e-2
ROUNDING_TOLERANCE = 1e-9
# Scales that a parameter without a prior may go in one step, where it is not as large itself.
MAX_STEP_SCALES = 10.0


@dataclass(frozen=True)
class Minimum:
    """Where a fit ended: full vector `theta`, curvature of the data and of data with priors, and how it got there."""

    theta: Array
    data: Curvature
    total: Curvature
    iterations: int
    converged: bool


def prior_curvature(parameters: ParameterSet, theta: Array) -> Curvature:
    """Gaussian priors of the free parameters; an infinite sigma adds nothing."""
    free = parameters.free
    precision = 1.0 / parameters.sigma[free] ** 2
    departure = theta[free] - parameters.value[free]
    return Curvature(float(departure**2 @ precision), departure * precision, np.diag(precision))


def minimize(
    parameters: ParameterSet,
    start: Array,
    curvature: Callable[[Array], Curvature],
    chi2: Callable[[Array], float],
    *,
    iterations: int = 60,
    tolerance: float = 1e-4,
) -> Minimum:
    """Minimise chi2 of the data plus priors over the free parameters.

    Steps are taken in the coordinates that make the scale of the rig a straight line, within bounds, damped after
    Marquardt. Ends when the step promises to lower chi2 by less than `tolerance`, or by less than 1e-9 of it.
    """
    theta, damping = np.array(start, float), 0.0
    problem = _BoundedProblem(parameters, coordinates(parameters, theta), curvature, chi2)
    data = curvature(theta)
    for iteration in range(1, iterations + 1):
        whole = data + prior_curvature(parameters, theta)
        total = problem.fix_at_bounds(theta, problem.transform_curvature(theta, whole))
        predicted_decrease = _predicted_decrease(total)
        if predicted_decrease < max(tolerance, 1e-9 * total.chi2):
            return Minimum(theta, data, whole, iteration, True)
        step = _damped_step(problem, theta, total, damping)
        if step is None:
            return Minimum(theta, data, whole, iteration, predicted_decrease < 1e-6 * total.chi2)
        theta, data, damping = step
    return Minimum(theta, data, data + prior_curvature(parameters, theta), iterations, False)


@dataclass(frozen=True)
class _TrialStep:
    """Where a step led, chi-square of data and priors there, and the data's curvature where it is known.

    Chi-square is infinite where no rig is like this (an inertia that is not positive, say).
    """

    theta: Array
    chi2: float
    data: Curvature | None


@dataclass(frozen=True)
class _BoundedProblem:
    """Chi-square and curvature of the data, the parameters with their priors, and the coordinates of the steps."""

    parameters: ParameterSet
    space: Coordinates
    curvature: Callable[[Array], Curvature]
    chi2: Callable[[Array], float]

    def trial(self, theta: Array, with_curvature: bool) -> _TrialStep:
        """What is there."""
        try:
            data = self.curvature(theta) if with_curvature else None
            chi2 = self.chi2(theta) if data is None else data.chi2
            return _TrialStep(theta, chi2 + prior_curvature(self.parameters, theta).chi2, data)
        except np.linalg.LinAlgError:
            return _TrialStep(theta, np.inf, None)

    def transform_curvature(self, theta: Array, total: Curvature) -> Curvature:
        """The curvature with respect to the coordinates of the free parameters."""
        free = self.parameters.free
        J = self.space.jacobian(theta)[np.ix_(free, free)]
        return Curvature(total.chi2, J.T @ total.gradient, J.T @ total.information @ J)

    def fix_at_bounds(self, theta: Array, total: Curvature) -> Curvature:
        """The same curvature with the parameters held that rest on a bound and would cross it.

        Those without a prior rest there exactly; the others, whose bounds are no place to be, at a hundredth of a
        sigma, and what goes to zero by its logarithm, without end, at a hundredth of its scale.
        """
        parameters, free = self.parameters, self.parameters.free
        exactly = np.isinf(parameters.sigma) & ~self.space.vanishing
        near = np.where(exactly, 0.0, BOUND_TOLERANCE * parameters.scale)[free]
        position = theta[free]
        below = (position - parameters.lower[free] <= near) & (total.gradient > 0)
        above = (parameters.upper[free] - position <= near) & (total.gradient < 0)
        at_bound = below | above
        if not at_bound.any():
            return total
        information = total.information.copy()
        information[at_bound, :] = information[:, at_bound] = 0.0
        information[at_bound, at_bound] = 1.0
        return Curvature(total.chi2, np.where(at_bound, 0.0, total.gradient), information)

    def apply_step(self, theta: Array, step: Array) -> Array:
        """The step taken; a factor of three is the most that it may change a positive parameter."""
        free, space = self.parameters.free, self.space
        together = (space.logarithmic & ~space.vanishing)[free]
        z = space.to_coordinates(theta)
        z[free] += step / max(np.abs(step[together]).max(initial=0.0), 1.0)
        trial = space.to_parameters(z)
        # A logarithm has no zero to be put at.
        return np.where(space.vanishing, trial, limit_to_bounds(self.parameters, theta, trial))


def _scale_to_unit_diagonal(total: Curvature) -> tuple[Array, Array, Array]:
    """Information and gradient with unit diagonal, and the factors that give steps back their size.

    A parameter of which nothing is known (an effect's, where another of its parameters is null) keeps its value.
    """
    diagonal = np.diag(total.information)
    known = diagonal > 0
    size = np.where(known, 1.0 / np.sqrt(np.where(known, diagonal, 1.0)), 0.0)
    information = total.information * np.outer(size, size)
    np.fill_diagonal(information, 1.0)
    return information, total.gradient * size, size


def _predicted_decrease(total: Curvature) -> float:
    """How much a full Gauss-Newton step would lower chi2."""
    information, gradient, _ = _scale_to_unit_diagonal(total)
    return float(gradient @ np.linalg.lstsq(information, gradient, rcond=1e-15)[0])


def _damped_step(
    problem: _BoundedProblem, theta: Array, total: Curvature, damping: float
) -> tuple[Array, Curvature, float] | None:
    """One accepted step, with the data's curvature there and the damping to begin the next with; None without one.

    An undamped step nearly always serves, so its curvature is asked for at once; of others chi2 alone. A damped one is
    lengthened as long as that serves: along a narrow, curved valley the damping keeps steps short, and the next ones
    would go the same way.
    """
    information, gradient, size = _scale_to_unit_diagonal(total)
    bounds = _step_bounds(problem.parameters, problem.space, theta)
    for _ in range(MAX_TRIALS):
        step = _bounded_step(information + damping * np.eye(len(size)), gradient, size, bounds)
        trial = problem.trial(problem.apply_step(theta, step), with_curvature=damping == 0.0)
        if trial.chi2 < total.chi2:
            end = trial if damping == 0.0 else _extend_step(problem, theta, step, trial)
            data = problem.curvature(end.theta) if end.data is None else end.data
            return end.theta, data, damping / DAMPING_DECREASE if damping > MIN_DAMPING else 0.0
        damping = max(DAMPING_INCREASE * damping, MIN_DAMPING)
    return None


def _extend_step(problem: _BoundedProblem, theta: Array, step: Array, trial: _TrialStep) -> _TrialStep:
    """The same step threefold, and threefold again, as long as chi2 falls."""
    for _ in range(MAX_TRIALS):
        step = STEP_EXTENSION * step
        further = problem.trial(problem.apply_step(theta, step), with_curvature=False)
        if not further.chi2 < trial.chi2:
            break
        trial = further
    return trial


def _solve_normal_equations(information: Array, gradient: Array) -> Array:
    """The Gauss-Newton step; the shortest one where two parameters do the same."""
    try:
        return np.asarray(np.linalg.solve(information, gradient))
    except np.linalg.LinAlgError:
        return np.asarray(np.linalg.lstsq(information, gradient, rcond=1e-12)[0])


@dataclass(frozen=True)
class _StepBounds:
    """How far each coordinate of the free parameters may go in one step: down to `least`, up to `most`, (f,)."""

    min_step: Array
    max_step: Array


def _step_bounds(parameters: ParameterSet, space: Coordinates, theta: Array) -> _StepBounds:
    """Nine tenths of the way to any bound, or onto it for a parameter without a prior that is near.

    A parameter of which nothing is known beforehand may not leave its surroundings in one step: where it has little to
    do yet, the straight line of a step says nothing of far away. What may vanish changes by a factor of e at most.
    """
    far = np.where(np.isfinite(parameters.sigma), np.inf, np.maximum(np.abs(theta), MAX_STEP_SCALES * parameters.scale))
    min_step = np.maximum(-far, _move_toward_bound(parameters.lower, theta, parameters) - theta)
    max_step = np.minimum(far, _move_toward_bound(parameters.upper, theta, parameters) - theta)
    growth = np.diag(space.jacobian(theta))
    min_step, max_step = min_step / growth, max_step / growth
    # The logarithms of what has a prior are limited together.
    min_step, max_step = (
        np.where(space.logarithmic, limit, x) for limit, x in ((-np.inf, min_step), (np.inf, max_step))
    )
    min_step, max_step = (np.where(space.vanishing, limit, x) for limit, x in ((-1.0, min_step), (1.0, max_step)))
    return _StepBounds(min_step[parameters.free], max_step[parameters.free])


def _bounded_step(information: Array, gradient: Array, size: Array, bounds: _StepBounds) -> Array:
    """The Gauss-Newton step; coordinates that would leave the box go to its side, and the others as then suits best.

    `information` and `gradient` have a unit diagonal, and `size` gives steps back their units.
    """
    min_step, max_step = (limit / np.where(size > 0, size, 1.0) for limit in (bounds.min_step, bounds.max_step))
    step = -_solve_normal_equations(information, gradient)
    inside = np.ones(len(step), bool)
    while True:
        out = inside & ((step < min_step) | (step > max_step))
        if not out.any():
            return np.asarray(step * size)
        step, inside = np.clip(step, min_step, max_step), inside & ~out
        given = gradient[inside] + information[np.ix_(inside, ~inside)] @ step[~inside]
        step[inside] = -_solve_normal_equations(information[np.ix_(inside, inside)], given)


def limit_to_bounds(parameters: ParameterSet, theta: Array, trial: Array) -> Array:
    """A step from `theta` to `trial`, at most nine tenths of the way to any bound, or onto it where that is near."""
    rounding = ROUNDING_TOLERANCE * parameters.scale
    trial = np.where(
        trial <= parameters.lower + rounding, _move_toward_bound(parameters.lower, theta, parameters), trial
    )
    return np.asarray(
        np.where(trial >= parameters.upper - rounding, _move_toward_bound(parameters.upper, theta, parameters), trial)
    )


def _move_toward_bound(bound: Array, theta: Array, parameters: ParameterSet) -> Array:
    close = np.isinf(parameters.sigma) & (np.abs(theta - bound) <= BOUND_TOLERANCE * parameters.scale)
    return np.where(close, bound, theta + 0.9 * (bound - theta))
