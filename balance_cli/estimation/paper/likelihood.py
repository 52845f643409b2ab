"""Maximum likelihood on the output error with unknown noise covariance S (paper, eq. 2, with note 10)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.estimation.paper.equations import Coefficients, from_table, is_stable
from balance_cli.estimation.paper.output_error import (
    Derivatives,
    GroupedLines,
    Noise,
    Point,
    exact,
    gauss_newton,
    point,
)

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

QUASI_LINEAR = 8
"""Gauss-Newton iterations before the exact Hessian takes over; where the model fits they suffice."""
LEAST_DAMPING, MOST_DAMPING = 1e-9, 1e9
"""Range of the Levenberg-Marquardt damping, as a fraction of the scaled Hessian's unit diagonal."""
TOLERANCE = 1e-6
"""Newton decrement (in units of the log-likelihood) at which the iteration ends: 0.001 sigma."""
ROUNDING = 1e-18
"""Error power over signal power below which only rounding is left."""


@dataclass(frozen=True)
class OutputErrorFit:
    """The minimum: coefficients, covariance (p, p) of the free entries, S (n, n) [N2], cost N ln det S, and the way.

    `covariance` is the inverse of the Fisher information 2 Re sum J* S^-1 J for circular noise E[eps eps*] = S, with
    S corrected for the p parameters fitted.
    """

    model: Coefficients
    covariance: Array
    S: ComplexArray
    noise: Noise
    cost: float
    iterations: int
    converged: bool


def maximum_likelihood(
    data: GroupedLines, free: NDArray[np.bool_], start: Coefficients, noise: Noise, max_iterations: int
) -> OutputErrorFit:
    """The output-error fit with the `noise` asked for; a full S begins where the diagonal one ends.

    Where the model cannot fit, ln det S may fall without end: the full S lets one combination of the sensors go and
    gains at another, and the response gets worse on the way. Then the fit with a diagonal S is returned.
    """
    if noise != "full":
        return output_error_fit(data, free, start, noise, max_iterations)
    diagonal = output_error_fit(data, free, start, "diagonal", max_iterations)
    full = output_error_fit(data, free, diagonal.model, "full", max_iterations)
    return full if full.converged else diagonal


def output_error_fit(
    data: GroupedLines,
    free: NDArray[np.bool_],
    start: Coefficients,
    noise: Noise,
    max_iterations: int,
) -> OutputErrorFit:
    """Minimise sum eps* S^-1 eps + N ln det S over the free coefficients and S, from a stable `start`.

    eps = s - G(theta) u. Given theta the minimum over S is mean eps eps*, which leaves N ln det S(theta); its gradient
    is that of the first term with S held. So the first iterations are Gauss-Newton steps with the present S
    (quasi-linearisation); afterwards the exact Hessian is used, because where the model cannot fit, Gauss-Newton
    creeps. Steps are damped after Levenberg and Marquardt until the cost falls and the system is stable.
    """
    at, damping, iterations, converged = point(data, start, noise), 1e-3, 0, False
    while not converged and iterations < max_iterations:
        use_exact = iterations >= QUASI_LINEAR
        iterations += 1
        local = exact(data, free, at, noise) if use_exact else gauss_newton(data, free, at)
        step = _Step.of(local)
        if step.decrement < TOLERANCE and not step.saddle:
            converged = True
            break
        better, damping = _descend(data, free, at, step, damping, noise)
        if better is None:
            converged = step.decrement < 1e3 * TOLERANCE or _only_rounding_left(data, at)
            break
        at = better
    information = gauss_newton(data, free, at).hessian
    n, p = len(at.S), len(information)
    correction = 2 * n * data.lines / (2 * n * data.lines - p)
    covariance = 0.5 * correction * inverse(information)
    return OutputErrorFit(at.model, covariance, at.S * correction, noise, at.cost, iterations, converged)


def _only_rounding_left(data: GroupedLines, at: Point) -> bool:
    return bool(np.sum(np.abs(at.error) ** 2) < ROUNDING * data.lines * np.sum(data.power))


@dataclass(frozen=True)
class _Step:
    """The step as a function of the damping: eigenvectors V of the Hessian scaled to a unit diagonal.

    The entries of K are 1e4 times those of D and more, hence the scale. Where the Hessian is not positive the
    absolute values of its eigenvalues are taken, so that every step descends (saddle-free Newton).
    """

    scale: Array
    V: Array
    eigenvalues: Array
    gradient: Array
    saddle: bool

    @staticmethod
    def of(local: Derivatives) -> _Step:
        scale = np.sqrt(np.maximum(np.abs(np.diag(local.hessian)), np.finfo(float).tiny))
        eigenvalues, V = np.linalg.eigh(local.hessian / scale / scale[:, None])
        saddle = bool(eigenvalues[0] < -1e-10)
        return _Step(scale, V, np.maximum(np.abs(eigenvalues), 1e-12), V.T @ (local.gradient / scale), saddle)

    @property
    def decrement(self) -> float:
        """Newton decrement g' H^-1 g."""
        return float(np.sum(self.gradient**2 / self.eigenvalues))

    def at(self, damping: float) -> Array:
        return np.asarray(self.V @ (self.gradient / (self.eigenvalues + damping)) / self.scale)


def _descend(
    data: GroupedLines, free: NDArray[np.bool_], at: Point, step: _Step, damping: float, noise: Noise
) -> tuple[Point | None, float]:
    """The first stable point of lower cost along rising damping, and the damping to begin with next time."""
    while damping <= MOST_DAMPING:
        table = at.model.table
        table[free] += step.at(damping)
        model = from_table(table)
        if is_stable(model):
            trial = point(data, model, noise)
            if trial.cost < at.cost:
                return trial, (damping / 10 if damping > LEAST_DAMPING else 0.0)
        damping = max(10 * damping, LEAST_DAMPING)
    return None, damping


def inverse(matrix: Array) -> Array:
    """Inverse of a symmetric positive matrix, scaled to a unit diagonal first."""
    scale = np.sqrt(np.diag(matrix))
    return np.asarray(np.linalg.inv(matrix / scale / scale[:, None]) / scale / scale[:, None])
