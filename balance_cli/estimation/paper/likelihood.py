"""Maximum likelihood on the output error with unknown noise covariance S (paper, eq. 2).

Its corrected form is that of docs/theory/paper-notes.md, note 10.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.estimation.paper.equations import Coefficients, coefficients_from_table, is_stable
from balance_cli.estimation.paper.output_error import (
    CostDerivatives,
    GroupedLines,
    ModelEvaluation,
    NoiseForm,
    evaluate_model,
    exact_derivatives,
    gauss_newton_derivatives,
)

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

QUASI_LINEAR_ITERATIONS = 8
"""Gauss-Newton iterations before the exact Hessian is used; they suffice where the model fits."""
MIN_DAMPING_RATIO, MAX_DAMPING_RATIO = 1e-9, 1e9
"""Range of the Levenberg-Marquardt damping relative to the unit diagonal of the scaled Hessian: no effect, no step."""
TOLERANCE = 1e-6
"""Newton decrement (in units of the log-likelihood) at which the iteration ends: 0.001 sigma."""
ROUNDING_POWER_RATIO = 1e-18
"""Error power over signal power below which the error is rounding."""


@dataclass(frozen=True)
class OutputErrorFit:
    """The minimum: coefficients, covariance (p, p) of the free entries, S (n, n) [N2], and the cost N ln det S.

    `covariance` is the inverse of the Fisher information 2 Re sum J* S^-1 J for circular noise E[eps eps*] = S, with
    S corrected for the p parameters fitted.
    """

    model: Coefficients
    covariance: Array
    S: ComplexArray
    noise: NoiseForm
    cost: float
    iterations: int
    converged: bool


def maximize_likelihood(
    data: GroupedLines, free: NDArray[np.bool_], start: Coefficients, noise: NoiseForm, max_iterations: int
) -> OutputErrorFit:
    """Fit the output error with the given form of noise; a full S starts from the fit with a diagonal one.

    Where the model cannot fit, ln det S may decrease without limit: a full S gains more from one combination of sensors
    with hardly any error than it loses by gross errors of another, and the response gets worse. Then the fit with a
    diagonal S is returned.
    """
    if noise != "full":
        return fit_output_error(data, free, start, noise, max_iterations)
    diagonal = fit_output_error(data, free, start, "diagonal", max_iterations)
    full = fit_output_error(data, free, diagonal.model, "full", max_iterations)
    return full if full.converged else diagonal


def fit_output_error(
    data: GroupedLines,
    free: NDArray[np.bool_],
    start: Coefficients,
    noise: NoiseForm,
    max_iterations: int,
) -> OutputErrorFit:
    """Minimize sum eps* S^-1 eps + N ln det S over the free coefficients and S, from a stable `start`.

    eps = s - G(theta) u. Given theta the minimum over S is mean eps eps*, which leaves N ln det S(theta); its gradient
    is that of the first term with S held. So the first iterations are Gauss-Newton steps with the present S
    (quasi-linearization); afterwards the exact Hessian is used, because Gauss-Newton converges slowly where the model
    cannot fit. Steps are damped after Levenberg and Marquardt until the cost decreases and the system is stable.
    """
    at, damping, iterations, converged = evaluate_model(data, start, noise), 1e-3, 0, False
    while not converged and iterations < max_iterations:
        use_exact = iterations >= QUASI_LINEAR_ITERATIONS
        iterations += 1
        local = exact_derivatives(data, free, at, noise) if use_exact else gauss_newton_derivatives(data, free, at)
        step = _NewtonStep.from_derivatives(local)
        if step.decrement < TOLERANCE and not step.saddle:
            converged = True
            break
        better, damping = _damped_newton_step(data, free, at, step, damping, noise)
        if better is None:
            converged = step.decrement < 1e3 * TOLERANCE or _is_at_rounding_level(data, at)
            break
        at = better
    information = gauss_newton_derivatives(data, free, at).hessian
    n, p = len(at.S), len(information)
    correction = 2 * n * data.lines / (2 * n * data.lines - p)
    covariance = 0.5 * correction * invert_scaled(information)
    return OutputErrorFit(at.model, covariance, at.S * correction, noise, at.cost, iterations, converged)


def _is_at_rounding_level(data: GroupedLines, at: ModelEvaluation) -> bool:
    return bool(np.sum(np.abs(at.error) ** 2) < ROUNDING_POWER_RATIO * data.lines * np.sum(data.power))


@dataclass(frozen=True)
class _NewtonStep:
    """The step as a function of the damping: eigenvectors V of the Hessian scaled to a unit diagonal.

    The Hessian is scaled because the entries of K exceed those of D by 1e4 and more. Where it is not positive definite
    the absolute values of its eigenvalues are used, so that every step descends (saddle-free Newton).
    """

    scale: Array
    V: Array
    eigenvalues: Array
    gradient: Array
    saddle: bool

    @staticmethod
    def from_derivatives(local: CostDerivatives) -> _NewtonStep:
        scale = np.sqrt(np.maximum(np.abs(np.diag(local.hessian)), np.finfo(float).tiny))
        eigenvalues, V = np.linalg.eigh(local.hessian / scale / scale[:, None])
        saddle = bool(eigenvalues[0] < -1e-10)
        return _NewtonStep(scale, V, np.maximum(np.abs(eigenvalues), 1e-12), V.T @ (local.gradient / scale), saddle)

    @property
    def decrement(self) -> float:
        """Newton decrement g' H^-1 g."""
        return float(np.sum(self.gradient**2 / self.eigenvalues))

    def at(self, damping: float) -> Array:
        return np.asarray(self.V @ (self.gradient / (self.eigenvalues + damping)) / self.scale)


def _damped_newton_step(
    data: GroupedLines,
    free: NDArray[np.bool_],
    at: ModelEvaluation,
    step: _NewtonStep,
    damping: float,
    noise: NoiseForm,
) -> tuple[ModelEvaluation | None, float]:
    """The first stable model of lower cost with increasing damping, and the initial damping of the next step."""
    while damping <= MAX_DAMPING_RATIO:
        table = at.model.table
        table[free] += step.at(damping)
        model = coefficients_from_table(table)
        if is_stable(model):
            trial = evaluate_model(data, model, noise)
            if trial.cost < at.cost:
                return trial, (damping / 10 if damping > MIN_DAMPING_RATIO else 0.0)
        damping = max(10 * damping, MIN_DAMPING_RATIO)
    return None, damping


def invert_scaled(matrix: Array) -> Array:
    """Inverse of a symmetric positive matrix, scaled to a unit diagonal first."""
    scale = np.sqrt(np.diag(matrix))
    return np.asarray(np.linalg.inv(matrix / scale / scale[:, None]) / scale / scale[:, None])
