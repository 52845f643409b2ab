"""Levenberg-Marquardt on a chi-square that comes with its Gauss-Newton curvature and Gaussian priors."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.estimation.likelihood import Curvature
from balance_cli.model.parameters import ParameterSet

Array = NDArray[np.float64]


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

    Marquardt's damping acts on parameters in units of their `scale`. Ends when the step promises to lower chi2 by
    less than `tolerance`, or by less than 1e-9 of it.
    """
    scale = parameters.scale[parameters.free]
    theta, damping = np.array(start, float), 1e-6
    for iteration in range(1, iterations + 1):
        data = curvature(theta)
        total = data + prior_curvature(parameters, theta)
        total = _held_at_bounds(parameters, theta, total)
        promised = _promised(total, scale)
        if promised < max(tolerance, 1e-9 * total.chi2):
            return Minimum(theta, data, data + prior_curvature(parameters, theta), iteration, True)
        theta, damping, moved = _descend(parameters, theta, total, scale, damping, chi2)
        if not moved:
            total = data + prior_curvature(parameters, theta)
            return Minimum(theta, data, total, iteration, promised < 1e-6 * total.chi2)
    data = curvature(theta)
    return Minimum(theta, data, data + prior_curvature(parameters, theta), iterations, False)


def _held_at_bounds(parameters: ParameterSet, theta: Array, total: Curvature) -> Curvature:
    """The same curvature with the parameters held that rest on a bound and would cross it."""
    free = parameters.free
    position, near = theta[free], 1e-2 * parameters.scale[free]
    below = (position - parameters.lower[free] < near) & (total.gradient > 0)
    above = (parameters.upper[free] - position < near) & (total.gradient < 0)
    held = below | above
    if not held.any():
        return total
    information = total.information.copy()
    information[held, :] = information[:, held] = 0.0
    information[held, held] = 1.0 / parameters.scale[free][held] ** 2
    return Curvature(total.chi2, np.where(held, 0.0, total.gradient), information)


def _scaled(total: Curvature, scale: Array) -> tuple[Array, Array]:
    return total.information * np.outer(scale, scale), total.gradient * scale


def _promised(total: Curvature, scale: Array) -> float:
    """How much a full Gauss-Newton step would lower chi2."""
    information, gradient = _scaled(total, scale)
    return float(gradient @ np.linalg.lstsq(information, gradient, rcond=1e-14)[0])


def _descend(
    parameters: ParameterSet,
    theta: Array,
    total: Curvature,
    scale: Array,
    damping: float,
    chi2: Callable[[Array], float],
) -> tuple[Array, float, bool]:
    """One accepted step: raise the damping until chi2 falls."""
    information, gradient = _scaled(total, scale)
    diagonal = np.diag(information).copy()
    for _ in range(24):
        damped = information + damping * np.diag(np.maximum(diagonal, 1e-12 * diagonal.max()))
        step = -np.linalg.solve(damped, gradient) * scale
        trial = _within(parameters, theta, step)
        if chi2(trial) + prior_curvature(parameters, trial).chi2 < total.chi2:
            return trial, max(damping / 10.0, 1e-9), True
        damping *= 10.0
    return theta, damping, False


def _within(parameters: ParameterSet, theta: Array, step: Array) -> Array:
    """The step taken, but at most nine tenths of the way to any bound."""
    trial = theta.copy()
    trial[parameters.free] += step
    trial = np.where(trial <= parameters.lower, theta + 0.9 * (parameters.lower - theta), trial)
    return np.asarray(np.where(trial >= parameters.upper, theta + 0.9 * (parameters.upper - theta), trial))
