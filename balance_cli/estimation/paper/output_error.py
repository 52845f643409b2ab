"""The output error eps = s - G u, its covariance S, and the first and second derivatives of the likelihood."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from balance_cli.estimation.paper.equations import Coefficients, compliance, regressors
from balance_cli.estimation.paper.spectra import SensorSpectra

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
NoiseForm = Literal["full", "diagonal", "equal"]

NOISE_POWER_FLOOR = 1e-24
"""Least noise power relative to the mean power of a sensor: rounding error. It keeps ln det S finite without noise."""


@dataclass(frozen=True)
class GroupedLines:
    """N lines grouped by frequency, so that quantities that depend on frequency alone are computed once for all runs.

    `frequency` (F,) [Hz]; `s` (F, r, n) and `u` (F, r, m) hold up to r lines of each frequency, padded with zeros,
    which add nothing to any sum. `power` (n,) is the mean of |s|^2 [N2].
    """

    frequency: Array
    s: ComplexArray
    u: ComplexArray
    lines: int
    power: Array


def group_by_frequency(spectra: SensorSpectra) -> GroupedLines:
    """The lines of all runs by distinct frequency."""
    frequency, group, count = np.unique(spectra.frequency, return_inverse=True, return_counts=True)
    order = np.argsort(group, kind="stable")
    slot = np.empty(len(group), int)
    slot[order] = np.arange(len(group)) - np.repeat(np.cumsum(count) - count, count)
    s = np.zeros((len(frequency), int(count.max()), spectra.s.shape[1]), complex)
    u = np.zeros((len(frequency), int(count.max()), spectra.u.shape[1]), complex)
    s[group, slot], u[group, slot] = spectra.s, spectra.u
    return GroupedLines(frequency, s, u, len(group), np.mean(np.abs(spectra.s) ** 2, axis=0))


@dataclass(frozen=True)
class ModelEvaluation:
    """A model against the data: compliance R (F, n, n), output and error (F, r, n), S (n, n) [N2] and the cost."""

    model: Coefficients
    R: ComplexArray
    output: ComplexArray
    error: ComplexArray
    S: ComplexArray
    cost: float


def evaluate_model(data: GroupedLines, model: Coefficients, noise: NoiseForm) -> ModelEvaluation:
    """Evaluate the cost N ln det S with S estimated from the errors (docs/theory/paper-notes.md, note 10).

    With `full` S is the mean of eps eps*, with `diagonal` its diagonal (independent sensors), with `equal` sigma^2 I.
    """
    R = compliance(model, data.frequency)
    output = (data.u @ model.B_F.T) @ np.swapaxes(R, 1, 2)
    error = data.s - output
    mean = np.tensordot(error, np.conj(error), ([0, 1], [0, 1])) / data.lines + np.diag(NOISE_POWER_FLOOR * data.power)
    if noise == "equal":
        S = np.eye(len(mean)) * np.trace(mean).real / len(mean) + 0j
    else:
        S = mean if noise == "full" else np.diag(np.diag(mean))
    return ModelEvaluation(model, R, output, error, S, data.lines * float(np.linalg.slogdet(S)[1]))


@dataclass(frozen=True)
class CostDerivatives:
    """Half the negative gradient (p,) of the cost, and half its Hessian (p, p), exact or in part."""

    gradient: Array
    hessian: Array


def gauss_newton_derivatives(
    data: GroupedLines, free: NDArray[np.bool_], at: ModelEvaluation, regress_on: Literal["model", "measured"] = "model"
) -> CostDerivatives:
    """Re sum J* S^-1 eps and Re sum J* S^-1 J with J = d(G u)/d theta, S held.

    J has the column R e_a phi_r for the entry in row a and column r of [D, K, B_F] (phi the regressors of the model's
    output), so the second sum is Re sum (R* S^-1 R)_ab conj(phi_r) phi_q and no J is formed. On the regressors of the
    measured s the same equations are those of the equation error weighted by R: R e = eps.
    """
    phi = _regressors(data, at, regress_on)
    Q = _adjoint(at.R) @ np.linalg.solve(at.S, at.R)
    gram = np.conj(np.swapaxes(phi, 1, 2)) @ phi
    gradient = np.tensordot(_back_project(at), np.conj(phi), ([0, 1], [0, 1])).real
    return CostDerivatives(gradient[free], _as_free_matrix(_contract_frequency(Q, gram).real, "abrq->arbq", free))


def exact_derivatives(
    data: GroupedLines, free: NDArray[np.bool_], at: ModelEvaluation, noise: NoiseForm
) -> CostDerivatives:
    """The gradient, and the exact half Hessian of N ln det S(theta).

    To the Gauss-Newton matrix it adds -Re sum eps* S^-1 d2(G u) and -sum_ij tr(S^-1 C_i S^-1 C_j) / 2N, with
    C_i = sum J_i eps* + eps J_i*. With beta = R* S^-1 eps and phi = Psi s + [0, 0, u], the second derivative projects
    to conj(beta_b) phi_r (Psi R)_qa + conj(beta_a) phi_q (Psi R)_rb.
    """
    first = gauss_newton_derivatives(data, free, at)
    phi = _regressors(data, at, "model")
    n, q = free.shape
    PsiR = regressors(data.frequency, at.R, np.zeros((len(at.R), q - 2 * n, n), complex), axis=1)
    projected = np.conj(np.swapaxes(_back_project(at), 1, 2)) @ phi
    T = _as_free_matrix(_contract_frequency(projected, PsiR).real, "brqa->arbq", free)
    return CostDerivatives(first.gradient, first.hessian - T - T.T - _noise_term(data, free, at, phi, noise))


def _noise_term(
    data: GroupedLines, free: NDArray[np.bool_], at: ModelEvaluation, phi: ComplexArray, noise: NoiseForm
) -> Array | float:
    """tr(S^-1 C_i S^-1 C_j) / 2N, the dependence of S on theta."""
    if noise == "equal":
        # Proportional to the product of two gradients, hence zero at the minimum.
        return 0.0
    cross = np.swapaxes(phi, 1, 2) @ np.conj(at.error)
    A: ComplexArray = np.einsum("iarj->arij", _contract_frequency(at.R, cross))[free]
    C = A + _adjoint(A)
    if noise == "diagonal":
        C = C * np.eye(len(at.S))
    whitening = np.asarray(np.linalg.inv(np.linalg.cholesky(at.S)), complex)
    U = (whitening @ C @ _adjoint(whitening)).reshape(len(C), -1)
    return np.asarray((U @ np.conj(U).T).real / (2 * data.lines))


def _regressors(data: GroupedLines, at: ModelEvaluation, regress_on: str) -> ComplexArray:
    return regressors(data.frequency, at.output if regress_on == "model" else data.s, data.u)


def _back_project(at: ModelEvaluation) -> ComplexArray:
    """Beta = R* S^-1 eps (F, r, n)."""
    return np.asarray(at.error @ np.linalg.inv(at.S).T @ np.conj(at.R))


def _adjoint(x: ComplexArray) -> ComplexArray:
    return np.conj(np.swapaxes(x, -1, -2))


def _contract_frequency(x: ComplexArray, y: ComplexArray) -> ComplexArray:
    """Sum over frequency of x_f (i, j) times y_f (k, l): (i, j, k, l), as one matrix product."""
    product = x.reshape(len(x), -1).T @ y.reshape(len(y), -1)
    return np.asarray(product.reshape(*x.shape[1:], *y.shape[1:]))


def _as_free_matrix(x: Array, order: str, free: NDArray[np.bool_]) -> Array:
    """The four-index array as a matrix (p, p) over the free entries of the table."""
    index = np.flatnonzero(free)
    return np.asarray(np.einsum(order, x).reshape(free.size, free.size)[np.ix_(index, index)], float)
