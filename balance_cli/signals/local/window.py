"""One fitted window of a local model: its response at a position r in [-1, 1] as a linear function of its outputs.

M lines, c channels, u inputs, q linear coefficients for each channel, as in `signals.local.fit`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray

from balance_cli.signals.local.fit import LocalFit, ModelOrders, WindowedData

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Index = NDArray[np.intp]


@dataclass(frozen=True)
class WindowFit:
    """Data and fit of one window.

    Of the lines: inputs U (M, u), `weight` (M,), positions r (M,). Of the fit: `denominator` (na+1,), `coefficients`
    (q, c), the `triangle` (q, q) of their Gram matrix, and the `residual` (M, c), not weighted.
    """

    orders: ModelOrders
    U: ComplexArray
    weight: Array
    r: Array
    denominator: ComplexArray
    coefficients: ComplexArray
    triangle: ComplexArray
    residual: ComplexArray

    @cached_property
    def regressors(self) -> ComplexArray:
        """The regressors (M, q) at the lines of the window."""
        forced = np.sum(self.U[:, :, None] * response_rows(self, self.r), axis=1)
        return np.asarray(forced + transient_rows(self, self.r))

    @cached_property
    def pseudoinverse(self) -> ComplexArray:
        """The matrix (q, M) that maps the outputs of the window to its linear coefficients."""
        X = self.regressors * self.weight[:, None] ** 2
        return np.asarray(np.linalg.solve(self.triangle, np.linalg.solve(self.triangle.conj().T, X.conj().T)))


def split_windows(fit: LocalFit, windows: WindowedData) -> tuple[WindowFit, ...]:
    """Return the windows of a fit one by one."""
    return tuple(
        WindowFit(
            orders=fit.orders,
            U=windows.U[w],
            weight=windows.weight[w],
            r=windows.r[w],
            denominator=fit.denominator[w],
            coefficients=fit.coefficients[w],
            triangle=fit.triangle[w],
            residual=fit.residual[w] / windows.weight[w][:, None],
        )
        for w in range(len(windows.Y))
    )


def denominator_at(fit: WindowFit, r: Array) -> ComplexArray:
    """Return the denominator A at the positions r."""
    return np.asarray(legendre.legval(r, fit.denominator), complex)


def response_rows(fit: WindowFit, r: Array) -> ComplexArray:
    """Return rows (len(r), u, q) that map the coefficients to the response at the positions r."""
    u, size = fit.U.shape[1], fit.orders.response + 1
    basis = legendre.legvander(r, fit.orders.response) / denominator_at(fit, r)[:, None]
    rows = np.zeros((len(r), u, fit.orders.coefficients(u)), complex)
    for j in range(u):
        rows[:, j, j * size : (j + 1) * size] = basis
    return rows


def derivative_rows(fit: WindowFit, r: Array) -> ComplexArray:
    """Return rows (len(r), u, q) that map the coefficients to the derivative of the response with respect to r."""
    u, size = fit.U.shape[1], fit.orders.response + 1
    A = denominator_at(fit, r)[:, None]
    denominator_derivative = np.asarray(legendre.legval(r, legendre.legder(fit.denominator)))[:, None]
    value = legendre.legvander(r, size - 1)
    derivative = np.asarray(legendre.legval(r, legendre.legder(np.eye(size)))).T
    basis = derivative / A - value * denominator_derivative / A**2
    rows = np.zeros((len(r), u, fit.orders.coefficients(u)), complex)
    for j in range(u):
        rows[:, j, j * size : (j + 1) * size] = basis
    return rows


def transient_rows(fit: WindowFit, r: Array) -> ComplexArray:
    """Return rows (len(r), q) that map the coefficients to the transient at the positions r."""
    u, size = fit.U.shape[1], fit.orders.transient + 1
    rows = np.zeros((len(r), fit.orders.coefficients(u)), complex)
    if size:
        rows[:, -size:] = legendre.legvander(r, size - 1) / denominator_at(fit, r)[:, None]
    return rows


def poles(fit: WindowFit) -> ComplexArray:
    """Return the poles, as complex positions r."""
    if fit.orders.denominator == 0:
        return np.zeros(0, complex)
    return np.asarray(np.roots(legendre.leg2poly(fit.denominator)[::-1]), complex)


@dataclass(frozen=True)
class DenominatorErrors:
    """Standard deviations of the denominator of a window, and how the linear coefficients follow it.

    `root` (na+1, na+1): the square root of the covariance of the denominator a. `coefficient_changes` (q, c, na+1): the
    derivatives of the linear coefficients with respect to a, negative.
    """

    root: ComplexArray
    coefficient_changes: ComplexArray


def denominator_errors(fit: WindowFit, noise: ComplexArray) -> DenominatorErrors:
    """Return the errors of the denominator that follow from the noise (M, c, c) of the outputs; without poles zeros."""
    size = fit.orders.denominator + 1
    if size == 1:
        return DenominatorErrors(np.zeros((1, 1), complex), np.zeros((*fit.coefficients.shape, 1), complex))
    model = fit.regressors @ fit.coefficients
    derivatives = -log_derivative(fit, fit.r)[:, None, :] * model[:, :, None]
    coefficient_changes = np.tensordot(fit.pseudoinverse, derivatives, axes=1)
    projected = (derivatives - np.tensordot(fit.regressors, coefficient_changes, axes=1)) * (fit.weight**2)[
        :, None, None
    ]
    flat = (projected / fit.weight[:, None, None]).reshape(-1, size)
    inverse = np.linalg.pinv(flat.conj().T @ flat, rcond=1e-10, hermitian=True)
    spread = np.einsum("mca,mcb->ab", projected.conj(), np.matmul(noise, projected))
    value, vector = np.linalg.eigh(inverse @ spread @ inverse)
    return DenominatorErrors(vector * np.sqrt(np.maximum(value, 0.0)), coefficient_changes)


def pole_uncertainty(fit: WindowFit, r: Array, noise: ComplexArray) -> ComplexArray:
    """Return the standard deviations (len(r), c, u, na+1) of the response by the uncertainty of the denominator a.

    `noise` is (M, c, c). The result holds the columns of dG/da cov(a)^(1/2), where the linear coefficients are
    functions of a.
    """
    errors = denominator_errors(fit, noise)
    rows = response_rows(fit, r)
    response = (rows @ fit.coefficients).swapaxes(1, 2)
    direct = -response[:, :, :, None] * log_derivative(fit, r)[:, None, None, :]
    indirect = np.einsum("kuq,qca->kcua", rows, errors.coefficient_changes)
    return np.asarray((direct - indirect) @ errors.root)


@dataclass(frozen=True)
class Remainder:
    """What is left of L lines without transient and curvature: their outputs as if all were at the middle line.

    `operator` (L, M) gives it from the outputs of the window; `errors` (L, c, na+1) are its standard deviations by the
    uncertainty of the denominator.
    """

    operator: ComplexArray
    errors: ComplexArray


def remainder_at_center(fit: WindowFit, lines: Index, errors: DenominatorErrors) -> Remainder:
    """Subtract the transient, and what the response differs by from that at the middle one of these lines (L,)."""
    center, model = len(lines) // 2, fit.regressors[lines]
    at_center = np.sum(fit.U[lines][:, :, None] * response_rows(fit, fit.r[lines[center : center + 1]]), axis=1)
    subtracted = model - at_center
    # Linear in the outputs of the window: those of the group less a part of the coefficients.
    operator = -(subtracted @ fit.pseudoinverse)
    operator[np.arange(len(lines)), lines] += 1.0
    slopes = log_derivative(fit, fit.r[lines])
    change = slopes[:, None, :] * (model @ fit.coefficients)[:, :, None]
    change -= slopes[center] * (at_center @ fit.coefficients)[:, :, None]
    change += np.tensordot(subtracted, errors.coefficient_changes, axes=1)
    return Remainder(operator, change @ errors.root)


def log_derivative(fit: WindowFit, r: Array) -> ComplexArray:
    """Return the derivatives (len(r), na+1) of ln A with respect to its coefficients."""
    return np.asarray(legendre.legvander(r, fit.orders.denominator) / denominator_at(fit, r)[:, None])
