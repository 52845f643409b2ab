"""Local models of a spectrum: in a window of neighboring lines, `Y = (B U + C) / A` with low-order polynomials.

B / A is the frequency response, C / A the transient, which leaks because the record does not repeat; all channels share
the poles. A = 1 gives the local polynomial method (Pintelon and Schoukens, System Identification, 2nd ed., 2012,
chapter 7), any other A the local rational method (McKelvey and Guerin, IFAC SYSID 2012; for several channels with a
common denominator Voorhoeve, van der Maas and Oomen, Mech. Syst. Signal Process. 105, 2018). The fit is output-error
least squares instead of the linearized problem: B and C are eliminated (variable projection, Golub and Pereyra 1973),
and Gauss-Newton steps find A, so that noise does not bias the poles.

The first axis of arrays is that of the windows: W windows of M lines, c channels, u inputs, q linear coefficients.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

REFINEMENT_ITERATIONS = 10
"""Most Gauss-Newton steps of a window; it is left earlier where a step gains less than LEAST_COST_REDUCTION."""
RIDGE = 1e-9
"""Relative to a column of unit norm: far above rounding, far below any noise."""
LEAST_COST_REDUCTION = 1e-5
"""Relative reduction of the cost below which a window has converged; a parameter of pure noise gains about 1e-3."""
LARGEST_MARQUARDT_DAMPING = 1e3
"""Damping over the mean curvature from which no step is tried: it would be a thousandth of a gradient step."""
LEAST_DENOMINATOR = 1e-6
"""Least value of A over the largest in its window, so that a pole on a line does not divide by zero."""
LARGEST_STEP = 1e6
"""Of a denominator of unit norm: beyond it only the direction matters, and where no line tells it, squares overflow."""
_PER_WINDOW_FIELDS = ("denominator", "coefficients", "triangle", "residual")


@dataclass(frozen=True)
class ModelOrders:
    """Degrees of B (numerator of the response), C (numerator of the transient) and A (common denominator)."""

    response: int
    transient: int
    denominator: int

    def coefficients(self, inputs: int) -> int:
        """Return the number q of linear coefficients of a channel; `transient` is -1 where there is none."""
        return inputs * (self.response + 1) + self.transient + 1


@dataclass(frozen=True)
class LocalFit:
    """Fitted windows.

    `denominator` is (W, na+1) in Legendre polynomials of r, `coefficients` (W, q, c), `residual` (W, M, c), weighted.
    With `triangle` (W, q, q) the inverse Gram matrix of the coefficients is triangle^-1 triangle^-*.
    """

    orders: ModelOrders
    inputs: int
    denominator: ComplexArray
    coefficients: ComplexArray
    triangle: ComplexArray
    residual: ComplexArray

    @property
    def cost(self) -> Array:
        """Sum of squared residuals (W,) of each window."""
        return np.asarray(np.sum(np.abs(self.residual) ** 2, axis=(1, 2)))

    def subset(self, windows: NDArray[np.intp]) -> LocalFit:
        """Return the selected windows."""
        return replace(self, **{name: getattr(self, name)[windows] for name in _PER_WINDOW_FIELDS})


@dataclass(frozen=True)
class WindowedData:
    """Data of the windows.

    Outputs Y (W, M, c) are scaled to equal noise; U (W, M, u) are the inputs, `weight` (W, M) is that of each line, and
    r (W, M) its position in the window, from -1 to 1.
    """

    Y: ComplexArray
    U: ComplexArray
    weight: Array
    r: Array

    def subset(self, windows: NDArray[np.intp]) -> WindowedData:
        """Return the selected windows."""
        return WindowedData(self.Y[windows], self.U[windows], self.weight[windows], self.r[windows])


@dataclass(frozen=True)
class _WindowProblem:
    """Weighted outputs (W, M, c), regressors before division by A (W, M, q), polynomials P (W, M, p) and weight."""

    orders: ModelOrders
    inputs: int
    Y: ComplexArray
    columns: ComplexArray
    weight: Array
    P: Array

    def subset(self, windows: NDArray[np.intp]) -> _WindowProblem:
        """Return the selected windows."""
        return replace(self, **{name: getattr(self, name)[windows] for name in ("Y", "columns", "weight", "P")})


def fit_windows(windows: WindowedData, orders: ModelOrders) -> LocalFit:
    """Fit every window with a model of these orders."""
    degree = max(orders.response, orders.transient, orders.denominator)
    P = np.asarray(legendre.legvander(windows.r, degree), float)
    columns = _regressor_columns(windows.U, P, orders)
    weighted = windows.Y * windows.weight[:, :, None]
    problem = _WindowProblem(
        orders, windows.U.shape[2], weighted, columns, windows.weight, P[:, :, : orders.denominator + 1]
    )
    if orders.denominator == 0:
        return _linear_fit(problem, np.ones((len(windows.Y), 1), complex))[0]
    return _refine_denominator(problem, _levy_denominator(problem))


def _regressor_columns(U: ComplexArray, P: Array, orders: ModelOrders) -> ComplexArray:
    """Regressors (W, M, q) before division by A: each input times each polynomial, then the transient's."""
    W, M, _ = U.shape
    inputs = (U[:, :, :, None] * P[:, :, None, : orders.response + 1]).reshape(W, M, -1)
    return np.concatenate([inputs, P[:, :, : orders.transient + 1]], axis=2)


def _orthonormal_basis(columns: ComplexArray, factor: ComplexArray) -> tuple[ComplexArray, ComplexArray, Array]:
    """Thin QR of the scaled columns: basis (W, M, q), triangle, scale (W, q); the ridge is for absent inputs."""
    X = columns * factor[:, :, None]
    scale = np.maximum(np.linalg.norm(X, axis=1), 1e-300)
    W, M, q = X.shape
    ridge = np.broadcast_to(RIDGE * np.eye(q, dtype=complex), (W, q, q))
    Q, R = np.linalg.qr(np.concatenate([X / scale[:, None, :], ridge], axis=1))
    return Q[:, :M], R, scale


def _adjoint(X: ComplexArray) -> ComplexArray:
    return X.conj().swapaxes(1, 2)


def _denominator_at(problem: _WindowProblem, a: ComplexArray) -> ComplexArray:
    """A (W, M) at every line."""
    return np.asarray(np.matmul(problem.P, a[:, :, None])[:, :, 0])


def _linear_fit(problem: _WindowProblem, a: ComplexArray) -> tuple[LocalFit, ComplexArray]:
    """The fit for a given denominator, and the orthonormal basis (W, M, q) of its regressors."""
    factor = problem.weight / _bound_from_zero(_denominator_at(problem, a))
    Q, R, scale = _orthonormal_basis(problem.columns, factor)
    projected = _adjoint(Q) @ problem.Y
    coefficients = np.asarray(np.linalg.solve(R, projected) / scale[:, :, None], complex)
    residual = problem.Y - Q @ projected
    triangle = np.asarray(R * scale[:, None, :], complex)
    return LocalFit(problem.orders, problem.inputs, a, coefficients, triangle, residual), Q


def _levy_denominator(problem: _WindowProblem) -> ComplexArray:
    """Denominator of unit norm (W, na+1) that minimizes A Y - B U - C (Levy), then twice with the weight 1/A."""
    inverse = np.ones(problem.weight.shape, complex)
    for _ in range(3):
        Q, _, _ = _orthonormal_basis(problem.columns, np.asarray(problem.weight * inverse, complex))
        gram = _gram_matrices(_project_out(Q, _multiply_polynomials(problem.Y * inverse[:, :, None], problem.P)))
        a = np.linalg.eigh(gram)[1][:, :, 0]
        inverse = 1.0 / _bound_from_zero(_denominator_at(problem, a))
    return a


def _bound_from_zero(A: ComplexArray) -> ComplexArray:
    floor = LEAST_DENOMINATOR * np.max(np.abs(A), axis=1, keepdims=True)
    return np.where(np.abs(A) < floor, floor, A)


def _multiply_polynomials(Y: ComplexArray, P: Array) -> ComplexArray:
    """Every channel times every polynomial (W, M, c, na+1)."""
    return np.asarray(Y[:, :, :, None] * P[:, :, None, :])


def _project_out(Q: ComplexArray, X: ComplexArray) -> ComplexArray:
    """X (W, M, ...) less its projection on the basis Q."""
    flat = X.reshape(X.shape[0], X.shape[1], -1)
    return np.asarray((flat - Q @ (_adjoint(Q) @ flat)).reshape(X.shape))


def _gram_matrices(X: ComplexArray) -> ComplexArray:
    """Gram matrices (W, p, p) of X (W, M, c, p) over lines and channels."""
    flat = X.reshape(X.shape[0], -1, X.shape[3])
    return np.asarray(_adjoint(flat) @ flat)


def _refine_denominator(problem: _WindowProblem, a: ComplexArray) -> LocalFit:
    """Refine the denominator by damped Gauss-Newton steps (Levenberg-Marquardt) until no window improves."""
    fit, basis = _linear_fit(problem, a)
    cost, damping = fit.cost, np.full(len(a), 1e-6)
    active = np.arange(len(a))
    for _ in range(REFINEMENT_ITERATIONS):
        active_problem, before = problem.subset(active), fit.subset(active)
        denominator = before.denominator + _marquardt_step(active_problem, before, basis[active], damping[active])
        unit = denominator / np.linalg.norm(denominator, axis=1, keepdims=True)
        after, basis_after = _linear_fit(active_problem, unit)
        reached = after.cost
        better = reached < cost[active]
        gain = 1.0 - reached / np.maximum(cost[active], 1e-300)
        _overwrite_windows(fit, active[better], after.subset(np.flatnonzero(better)))
        basis[active[better]] = basis_after[better]
        cost[active[better]] = reached[better]
        damping[active] = np.where(better, damping[active] / 10.0, damping[active] * 30.0)
        active = active[np.where(better, gain > LEAST_COST_REDUCTION, damping[active] < LARGEST_MARQUARDT_DAMPING)]
        if not active.size:
            break
    return fit


def _overwrite_windows(fit: LocalFit, windows: NDArray[np.intp], replacement: LocalFit) -> None:
    """Overwrite some windows of a fit that is being refined."""
    for name in _PER_WINDOW_FIELDS:
        getattr(fit, name)[windows] = getattr(replacement, name)


def _marquardt_step(problem: _WindowProblem, fit: LocalFit, Q: ComplexArray, damping: Array) -> ComplexArray:
    """Step of the denominator (W, na+1); a change of its scale has no effect, so that the step has no such part.

    The derivatives of the model are -P_i m with m = (B U + C) / A^2, less their projection on the regressors; the
    residual is orthogonal to the regressors, whose orthonormal basis is Q (W, M, q).
    """
    inverse = 1.0 / _bound_from_zero(_denominator_at(problem, fit.denominator))
    model = (problem.Y - fit.residual) * inverse[:, :, None]
    P = problem.P
    power = np.sum(np.abs(model) ** 2, axis=2)
    adjoint = _adjoint(Q)
    explained = [(adjoint @ (model * P[:, :, i, None])).reshape(len(model), -1) for i in range(P.shape[2])]
    projection = np.stack(explained, axis=2)
    H = P.swapaxes(1, 2) @ (P * power[:, :, None]) - _adjoint(projection) @ projection
    g = -P.swapaxes(1, 2) @ np.sum(model.conj() * fit.residual, axis=2)[:, :, None]
    size = P.shape[2]
    mean = np.trace(H, axis1=1, axis2=2).real / size + 1e-300
    regular = H + ((damping + 1e-12) * mean)[:, None, None] * np.eye(size)
    step = np.asarray(np.linalg.solve(regular, g)[:, :, 0], complex)
    excess = np.max(np.abs(step), axis=1, keepdims=True) / LARGEST_STEP
    return np.asarray(step / np.maximum(1.0, excess), complex)
