"""One fitted window of a local model: what it says at a place r in [-1, 1], and how that rests on the window's outputs.

M lines, c channels, u inputs, q linear coefficients a channel, as in `local_fit`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray

from balance_cli.signals.local.fit import LocalFit, ModelOrders, WindowedData

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


@dataclass(frozen=True)
class WindowFit:
    """Inputs U (M, u), weight (M,) and places r (M,) of the lines; denominator (na+1,), coefficients (q, c) and the

    triangle (q, q) of their Gram matrix; residual (M, c), not weighted.
    """

    orders: ModelOrders
    U: ComplexArray
    weight: Array
    r: Array
    denominator: ComplexArray
    coefficients: ComplexArray
    triangle: ComplexArray
    residual: ComplexArray


def split_windows(fit: LocalFit, windows: WindowedData) -> tuple[WindowFit, ...]:
    """The windows of a fit, one by one."""
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
    """A at the places r."""
    return np.asarray(legendre.legval(r, fit.denominator), complex)


def response_rows(fit: WindowFit, r: Array) -> ComplexArray:
    """Rows (len(r), u, q) that take the coefficients to the response at the places r."""
    u, size = fit.U.shape[1], fit.orders.response + 1
    basis = legendre.legvander(r, fit.orders.response) / denominator_at(fit, r)[:, None]
    rows = np.zeros((len(r), u, fit.orders.coefficients(u)), complex)
    for j in range(u):
        rows[:, j, j * size : (j + 1) * size] = basis
    return rows


def derivative_rows(fit: WindowFit, r: Array) -> ComplexArray:
    """Rows (len(r), u, q) that take the coefficients to the derivative of the response with r."""
    u, size = fit.U.shape[1], fit.orders.response + 1
    A = denominator_at(fit, r)[:, None]
    slope = np.asarray(legendre.legval(r, legendre.legder(fit.denominator)))[:, None]
    value = legendre.legvander(r, size - 1)
    rise = np.asarray(legendre.legval(r, legendre.legder(np.eye(size)))).T
    rows = np.zeros((len(r), u, fit.orders.coefficients(u)), complex)
    for j in range(u):
        rows[:, j, j * size : (j + 1) * size] = rise / A - value * slope / A**2
    return rows


def transient_rows(fit: WindowFit, r: Array) -> ComplexArray:
    """Rows (len(r), q) that take the coefficients to the transient at the places r."""
    u, size = fit.U.shape[1], fit.orders.transient + 1
    rows = np.zeros((len(r), fit.orders.coefficients(u)), complex)
    if size:
        rows[:, -size:] = legendre.legvander(r, size - 1) / denominator_at(fit, r)[:, None]
    return rows


def design_matrix(fit: WindowFit) -> ComplexArray:
    """Regressors (M, q) at the window's lines."""
    driven = np.sum(fit.U[:, :, None] * response_rows(fit, fit.r), axis=1)
    return np.asarray(driven + transient_rows(fit, fit.r))


def design_pseudoinverse(fit: WindowFit) -> ComplexArray:
    """Matrix (q, M) that takes the window's outputs to its linear coefficients."""
    X = design_matrix(fit) * fit.weight[:, None] ** 2
    return np.asarray(np.linalg.solve(fit.triangle, np.linalg.solve(fit.triangle.conj().T, X.conj().T)))


def poles(fit: WindowFit) -> ComplexArray:
    """Poles, as places r in the complex plane."""
    if fit.orders.denominator == 0:
        return np.zeros(0, complex)
    return np.asarray(np.roots(legendre.leg2poly(fit.denominator)[::-1]), complex)


def pole_uncertainty(fit: WindowFit, r: Array, noise: ComplexArray) -> ComplexArray:
    """Response's standard deviations (len(r), c, u, na+1) by the uncertainty of the denominator a; noise (M, c, c).

    They are the columns of dG/da cov(a)^(1/2), where the other coefficients follow a.
    """
    model = design_matrix(fit) @ fit.coefficients
    slopes = -_log_derivative(fit, fit.r)[:, None, :] * model[:, :, None]
    followed = np.tensordot(design_pseudoinverse(fit), slopes, axes=1)
    seen = (slopes - np.tensordot(design_matrix(fit), followed, axes=1)) * (fit.weight**2)[:, None, None]
    flat = (seen / fit.weight[:, None, None]).reshape(-1, seen.shape[2])
    step = np.linalg.pinv(flat.conj().T @ flat, rcond=1e-10, hermitian=True)
    spread = np.einsum("mca,mcb->ab", seen.conj(), np.matmul(noise, seen))
    value, vector = np.linalg.eigh(step @ spread @ step)
    rows = response_rows(fit, r)
    response = (rows @ fit.coefficients).swapaxes(1, 2)
    direct = -response[:, :, :, None] * _log_derivative(fit, r)[:, None, None, :]
    through = np.einsum("kuq,qca->kcua", rows, followed)
    return np.asarray((direct - through) @ (vector * np.sqrt(np.maximum(value, 0.0))))


def _log_derivative(fit: WindowFit, r: Array) -> ComplexArray:
    """Change (len(r), na+1) of ln A with each of its coefficients."""
    return np.asarray(legendre.legvander(r, fit.orders.denominator) / denominator_at(fit, r)[:, None])
