"""Levenberg-Marquardt minimization of a chi-square with its Gauss-Newton curvature and Gaussian priors.

K. Levenberg, Quart. Appl. Math. 2 (1944) 164; D. W. Marquardt, J. SIAM 11 (1963) 431.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.estimation.coordinates import Coordinates, coordinates
from balance_cli.estimation.deadline import Deadline
from balance_cli.estimation.likelihood import Curvature
from balance_cli.model.parameters import ParameterSet

Array = NDArray[np.float64]

# The damping starts at zero: directions that only the priors determine have 1e-10 of the information of the others, and
# any damping would keep them from moving.
MIN_DAMPING = 1e-8
# Marquardt's factors of the damping after a rejected and an accepted step, and the factor by which an accepted damped
# step is extended (Hooke and Jeeves, J. ACM 8, 1961, extrapolate in this way).
DAMPING_INCREASE, DAMPING_DECREASE, STEP_EXTENSION = 10.0, 10.0, 3.0
# Enough to raise the damping from its minimum to 1e15, where a step is lost in rounding.
MAX_TRIALS = 24
# Distances from a bound, in scales of the parameter, at which it counts as reached, and by which rounding may miss it.
BOUND_TOLERANCE = 1e-2
ROUNDING_TOLERANCE = 1e-9
# Largest step of a parameter without a prior, in its scales, where its value is smaller than that: outside this range
# the linearization of an effect that is still small means nothing.
MAX_STEP_SCALES = 10.0


@dataclass(frozen=True)
class Minimum:
    """The end of a fit: full vector `theta`, curvature of the data and of data with priors, iterations, convergence."""

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
    known: Curvature | None = None,
    near_minimum: bool = False,
    deadline: Deadline | None = None,
) -> Minimum:
    """Minimize chi2 of the data plus priors over the free parameters.

    Steps are taken in the coordinates that make the scale of the rig a straight line, within bounds, damped after
    Marquardt. The fit ends when the predicted decrease of chi2 is less than `tolerance`, or less than 1e-9 of chi2.
    `known`: the curvature of the data at `start`, where another fit has ended there. `near_minimum`: as in
    `coordinates`. After the `deadline` it ends as soon as it has taken a few steps.
    """
    theta, damping, iteration = np.array(start, float), 0.0, 0
    problem = _BoundedProblem(parameters, coordinates(parameters, theta, near_minimum), curvature, chi2)
    data = curvature(theta) if known is None else known
    for iteration in _numbers(iterations, deadline):
        with_priors = data + prior_curvature(parameters, theta)
        total = problem.fix_at_bounds(theta, problem.transform_curvature(theta, with_priors))
        decrease = predicted_decrease(total)
        if decrease < max(tolerance, 1e-9 * total.chi2):
            return Minimum(theta, data, with_priors, iteration, True)
        step = _damped_step(problem, theta, total, damping)
        if step is None:
            return Minimum(theta, data, with_priors, iteration, decrease < 1e-6 * total.chi2)
        theta, data, damping = step
    return Minimum(theta, data, data + prior_curvature(parameters, theta), iteration, False)


def _numbers(iterations: int, deadline: Deadline | None) -> Iterator[int]:
    """The numbers of the iterations, a few once the time is over."""
    for iteration in range(1, iterations + 1):
        yield iteration
        if deadline is not None and iteration >= deadline.hurried_iterations and deadline.is_over:
            return


@dataclass(frozen=True)
class _TrialStep:
    """The end of a trial step, chi-square of data and priors there, and the data's curvature where it was computed.

    Chi-square is infinite where the parameters are not physical (an inertia that is not positive, for instance).
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
        """Evaluate the problem at `theta`."""
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
        """The same curvature with the parameters fixed that are at a bound and would cross it.

        A parameter without a prior is at a bound only exactly; one with a prior within a hundredth of its sigma; and
        one that goes to zero as a logarithm, which never arrives, within a hundredth of its scale.
        """
        parameters, free = self.parameters, self.parameters.free
        is_exact = np.isinf(parameters.sigma) & ~self.space.vanishing
        tolerance = np.where(is_exact, 0.0, BOUND_TOLERANCE * parameters.scale)[free]
        position = theta[free]
        below = (position - parameters.lower[free] <= tolerance) & (total.gradient > 0)
        above = (parameters.upper[free] - position <= tolerance) & (total.gradient < 0)
        at_bound = below | above
        if not at_bound.any():
            return total
        information = total.information.copy()
        information[at_bound, :] = information[:, at_bound] = 0.0
        information[at_bound, at_bound] = 1.0
        return Curvature(total.chi2, np.where(at_bound, 0.0, total.gradient), information)

    def apply_step(self, theta: Array, step: Array) -> Array:
        """Apply a step; it changes positive parameters by a factor of e at most."""
        free, space = self.parameters.free, self.space
        limited = (space.logarithmic & ~space.vanishing)[free]
        z = space.to_coordinates(theta)
        z[free] += step / max(np.abs(step[limited]).max(initial=0.0), 1.0)
        trial = space.to_parameters(z)
        # A parameter in logarithmic coordinates cannot be set to its bound at zero.
        return np.where(space.vanishing, trial, limit_to_bounds(self.parameters, theta, trial))


def _scale_to_unit_diagonal(total: Curvature) -> tuple[Array, Array, Array]:
    """Information scaled to a unit diagonal, the gradient, and the factors that scale steps back.

    A parameter without information (an effect's, where another of its parameters is zero) keeps its value.
    """
    diagonal = np.diag(total.information)
    informed = diagonal > 0
    size = np.where(informed, 1.0 / np.sqrt(np.where(informed, diagonal, 1.0)), 0.0)
    information = total.information * np.outer(size, size)
    np.fill_diagonal(information, 1.0)
    return information, total.gradient * size, size


def predicted_decrease(total: Curvature) -> float:
    """Return the decrease of chi2 that a full Gauss-Newton step would bring if the problem were linear."""
    information, gradient, _ = _scale_to_unit_diagonal(total)
    return float(gradient @ np.linalg.lstsq(information, gradient, rcond=1e-15)[0])


def _damped_step(
    problem: _BoundedProblem, theta: Array, total: Curvature, damping: float
) -> tuple[Array, Curvature, float] | None:
    """One accepted step, with the data's curvature at its end and the damping of the next step; None if all fail.

    An undamped step is nearly always accepted, so its curvature is computed at once; for others chi2 alone. An accepted
    damped step is extended as long as chi2 falls: along a narrow, curved valley the damping keeps steps short, and the
    next ones would have the same direction.
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
    """Extend the step by a factor of three, repeatedly, as long as chi2 falls."""
    for _ in range(MAX_TRIALS):
        step = STEP_EXTENSION * step
        extended = problem.trial(problem.apply_step(theta, step), with_curvature=False)
        if not extended.chi2 < trial.chi2:
            break
        trial = extended
    return trial


def _solve_normal_equations(information: Array, gradient: Array) -> Array:
    """The solution of the normal equations; the shortest one where parameters are dependent."""
    try:
        return np.asarray(np.linalg.solve(information, gradient))
    except np.linalg.LinAlgError:
        return np.asarray(np.linalg.lstsq(information, gradient, rcond=1e-12)[0])


@dataclass(frozen=True)
class _StepBounds:
    """Limits (f,) of one step in the coordinates of the free parameters."""

    min_step: Array
    max_step: Array


def _step_bounds(parameters: ParameterSet, space: Coordinates, theta: Array) -> _StepBounds:
    """Nine tenths of the way to each bound, or up to it for a parameter without a prior that is near.

    A parameter without a prior may not go far in one step: as long as its effect is small, a linearization means
    nothing at a distance. A parameter that may vanish changes by a factor of e at most.
    """
    reach = np.where(
        np.isfinite(parameters.sigma), np.inf, np.maximum(np.abs(theta), MAX_STEP_SCALES * parameters.scale)
    )
    min_step = np.maximum(-reach, _move_toward_bound(parameters.lower, theta, parameters) - theta)
    max_step = np.minimum(reach, _move_toward_bound(parameters.upper, theta, parameters) - theta)
    growth = np.diag(space.jacobian(theta))
    min_step, max_step = min_step / growth, max_step / growth
    # The logarithms of parameters with a prior are limited together, in `apply_step`.
    min_step, max_step = (
        np.where(space.logarithmic, limit, x) for limit, x in ((-np.inf, min_step), (np.inf, max_step))
    )
    min_step, max_step = (np.where(space.vanishing, limit, x) for limit, x in ((-1.0, min_step), (1.0, max_step)))
    return _StepBounds(min_step[parameters.free], max_step[parameters.free])


def _bounded_step(information: Array, gradient: Array, size: Array, bounds: _StepBounds) -> Array:
    """The Gauss-Newton step within bounds: coordinates that would leave the box are set to its side, the rest refitted.

    `information` and `gradient` are scaled to a unit diagonal; `size` scales steps back to their units.
    """
    min_step, max_step = (limit / np.where(size > 0, size, 1.0) for limit in (bounds.min_step, bounds.max_step))
    step = -_solve_normal_equations(information, gradient)
    inside = np.ones(len(step), bool)
    while True:
        outside = inside & ((step < min_step) | (step > max_step))
        if not outside.any():
            return np.asarray(step * size)
        step, inside = np.clip(step, min_step, max_step), inside & ~outside
        given = gradient[inside] + information[np.ix_(inside, ~inside)] @ step[~inside]
        step[inside] = -_solve_normal_equations(information[np.ix_(inside, inside)], given)


def limit_to_bounds(parameters: ParameterSet, theta: Array, trial: Array) -> Array:
    """A step from `theta` to `trial`, at most nine tenths of the way to a bound, or up to it where that is near."""
    rounding = ROUNDING_TOLERANCE * parameters.scale
    trial = np.where(
        trial <= parameters.lower + rounding, _move_toward_bound(parameters.lower, theta, parameters), trial
    )
    return np.asarray(
        np.where(trial >= parameters.upper - rounding, _move_toward_bound(parameters.upper, theta, parameters), trial)
    )


def _move_toward_bound(bound: Array, theta: Array, parameters: ParameterSet) -> Array:
    is_near = np.isinf(parameters.sigma) & (np.abs(theta - bound) <= BOUND_TOLERANCE * parameters.scale)
    return np.where(is_near, bound, theta + 0.9 * (bound - theta))
