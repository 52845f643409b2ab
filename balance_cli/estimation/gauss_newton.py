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
LEAST_DAMPING = 1e-8
# Scales from a bound at which it is reached.
AT_BOUND = 1e-2
# Scales that a parameter without a prior may go in one step, where it is not as large itself.
FAR = 10.0


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


def minimise(
    parameters: ParameterSet,
    start: Array,
    curvature: Callable[[Array], Curvature],
    chi2: Callable[[Array], float],
    *,
    iterations: int = 60,
    tolerance: float = 1e-4,
) -> Minimum:
    """Minimise chi2 of the data plus priors over the free parameters.

    Steps are taken in the coordinates that make the scale of the rig a straight line, damped after Marquardt. Ends
    when the step promises to lower chi2 by less than `tolerance`, or by less than 1e-9 of it.
    """
    theta, damping = np.array(start, float), 0.0
    space = coordinates(parameters, theta)
    data = curvature(theta)
    for iteration in range(1, iterations + 1):
        whole = data + prior_curvature(parameters, theta)
        total = _held_at_bounds(parameters, theta, _in_coordinates(parameters, space, theta, whole))
        promised = _promised(total)
        if promised < max(tolerance, 1e-9 * total.chi2):
            return Minimum(theta, data, whole, iteration, True)
        step = _descend(parameters, space, theta, total, damping, curvature, chi2)
        if step is None:
            return Minimum(theta, data, whole, iteration, promised < 1e-6 * total.chi2)
        theta, data, damping = step
    return Minimum(theta, data, data + prior_curvature(parameters, theta), iterations, False)


def _in_coordinates(parameters: ParameterSet, space: Coordinates, theta: Array, total: Curvature) -> Curvature:
    """The curvature with respect to the coordinates of the free parameters."""
    J = space.jacobian(theta)[np.ix_(parameters.free, parameters.free)]
    return Curvature(total.chi2, J.T @ total.gradient, J.T @ total.information @ J)


def _held_at_bounds(parameters: ParameterSet, theta: Array, total: Curvature) -> Curvature:
    """The same curvature with the parameters held that rest on a bound and would cross it.

    Those without a prior rest there exactly; the others, whose bounds are no place to be, at a hundredth of a sigma.
    """
    free = parameters.free
    near = np.where(np.isinf(parameters.sigma[free]), 0.0, AT_BOUND * parameters.scale[free])
    position = theta[free]
    below = (position - parameters.lower[free] <= near) & (total.gradient > 0)
    above = (parameters.upper[free] - position <= near) & (total.gradient < 0)
    held = below | above
    if not held.any():
        return total
    information = total.information.copy()
    information[held, :] = information[:, held] = 0.0
    information[held, held] = 1.0
    return Curvature(total.chi2, np.where(held, 0.0, total.gradient), information)


def _normalised(total: Curvature) -> tuple[Array, Array, Array]:
    """Information and gradient with unit diagonal, and the factors that give steps back their size.

    A parameter of which nothing is known (an effect's, where another of its parameters is null) keeps its value.
    """
    diagonal = np.diag(total.information)
    known = diagonal > 0
    size = np.where(known, 1.0 / np.sqrt(np.where(known, diagonal, 1.0)), 0.0)
    information = total.information * np.outer(size, size)
    np.fill_diagonal(information, 1.0)
    return information, total.gradient * size, size


def _promised(total: Curvature) -> float:
    """How much a full Gauss-Newton step would lower chi2."""
    information, gradient, _ = _normalised(total)
    return float(gradient @ np.linalg.lstsq(information, gradient, rcond=1e-15)[0])


def _descend(
    parameters: ParameterSet,
    space: Coordinates,
    theta: Array,
    total: Curvature,
    damping: float,
    curvature: Callable[[Array], Curvature],
    chi2: Callable[[Array], float],
) -> tuple[Array, Curvature, float] | None:
    """One accepted step, with the data's curvature there and the damping to begin the next with; None without one.

    The first trial nearly always serves, so its curvature is asked for at once; further ones ask for chi2 alone.
    """
    information, gradient, size = _normalised(total)
    for trials in range(24):
        step = -_solved(information + damping * np.eye(len(size)), gradient) * size
        trial = _stepped(parameters, space, theta, step)
        data = _curvature_at(trial, curvature) if trials == 0 else None
        reached = _chi2_at(trial, parameters, chi2, data)
        if reached < total.chi2:
            easier = damping / 100.0 if damping > LEAST_DAMPING else 0.0
            return trial, curvature(trial) if data is None else data, easier
        damping = max(10.0 * damping, LEAST_DAMPING)
    return None


def _solved(information: Array, gradient: Array) -> Array:
    """The Gauss-Newton step; the shortest one where two parameters do the same."""
    try:
        return np.asarray(np.linalg.solve(information, gradient))
    except np.linalg.LinAlgError:
        return np.asarray(np.linalg.lstsq(information, gradient, rcond=1e-12)[0])


def _curvature_at(trial: Array, curvature: Callable[[Array], Curvature]) -> Curvature | None:
    """The data's curvature; None where no rig is like this (an inertia that is not positive, say)."""
    try:
        return curvature(trial)
    except np.linalg.LinAlgError:
        return None


def _chi2_at(trial: Array, parameters: ParameterSet, chi2: Callable[[Array], float], data: Curvature | None) -> float:
    """Chi-square of data and priors, the data's as known where it is; infinite where no rig is like this."""
    try:
        return (chi2(trial) if data is None else data.chi2) + prior_curvature(parameters, trial).chi2
    except np.linalg.LinAlgError:
        return np.inf


def _stepped(parameters: ParameterSet, space: Coordinates, theta: Array, step: Array) -> Array:
    """The step taken, but at most nine tenths of the way to any bound, or onto it for one without a prior that is near.

    A parameter of which nothing is known beforehand may not leave its surroundings in one step: where it has little to
    do yet, the straight line of a step says nothing of far away.
    """
    z = space.inward(theta)
    free = parameters.free
    near = np.maximum(np.abs(theta[free]), FAR * parameters.scale[free])
    step = np.where(np.isfinite(parameters.sigma[free]), step, np.clip(step, -near, near))
    # A factor of three is the most that one step may change a positive parameter.
    z[parameters.free] += step * min(
        1.0, 1.0 / max(np.abs(step[space.logarithmic[parameters.free]]).max(initial=0), 1e-300)
    )
    return within_bounds(parameters, theta, space.outward(z))


def within_bounds(parameters: ParameterSet, theta: Array, trial: Array) -> Array:
    """A step from `theta` to `trial`, at most nine tenths of the way to any bound, or onto it where that is near."""
    trial = np.where(trial <= parameters.lower, _toward(parameters.lower, theta, parameters), trial)
    return np.asarray(np.where(trial >= parameters.upper, _toward(parameters.upper, theta, parameters), trial))


def _toward(bound: Array, theta: Array, parameters: ParameterSet) -> Array:
    close = np.isinf(parameters.sigma) & (np.abs(theta - bound) <= AT_BOUND * parameters.scale)
    return np.where(close, bound, theta + 0.9 * (bound - theta))
