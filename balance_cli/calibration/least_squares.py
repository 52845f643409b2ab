"""Weighted linear regression with a zero for each block of rows, and its diagnostic statistics.

Each block (a load series) has its own zero, which is eliminated: the weighted mean of the block is subtracted from
every column. One QR decomposition A = Q R of the resulting columns, scaled, yields everything:

    coefficients     b = R^-1 Q'y, refined together with the zeros (Bjorck, BIT 7 (1967) 257)
    covariance       s^2 (R'R)^-1
    variance inflation   diag (R'R)^-1 diag(R'R), zeros eliminated (Marquardt, Technometrics 12 (1970) 591)
    errors of rows that are left out: see projection.py

No model is fitted twice. All outputs have the same terms and are solved together.

Rounding errors grow with the condition of the terms. Where the condition is large, or the data are in extended
precision, the residuals of the refinement and the decomposition behind the standard errors are computed in extended
precision.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import qr, solve_triangular

from balance_cli.calibration.block_zeros import BlockZeros
from balance_cli.calibration.extended_precision import ExtendedArray, gram_schmidt, inner_products, triangular_inverse
from balance_cli.calibration.projection import Projection

Array = NDArray[np.float64]
Index = NDArray[np.intp]

COLLINEAR_CONDITION = 1e13
"""Condition of the scaled columns from which they count as collinear: double precision leaves some three digits."""
EXTENDED_CONDITION = 1e4
"""Condition from which extended precision is used: double precision would leave fewer than about eleven digits."""
MAX_REFINEMENTS = 8
"""Upper bound on the refinements. Each reduces the error by the relative error of the first solution."""
TINY = float(np.finfo(float).tiny)


@dataclass(frozen=True)
class LeastSquares(Projection):
    """Regression of outputs (m, c) on p terms, with a zero for each of b blocks.

    `coefficients` (p, c), `zeros` (b, c), `residuals` (m, c), `leverage` (m,), `weight` (m,), `block` (m,). `root`
    (p, p): the factor R for unscaled terms; `inverse` (p, p) = (R'R)^-1, the covariance of the coefficients for s = 1.
    `dof`: number of rows less the number of coefficients and zeros. `Q` (m, p) spans the terms within the blocks, in
    weighted rows.
    """

    coefficients: Array
    zeros: Array
    root: Array
    inverse: Array
    dof: float

    @property
    def variance(self) -> Array:
        """Residual variance s^2 (c,) of a row of weight one."""
        return np.asarray(self.weight @ self.residuals**2 / self.dof)

    @property
    def sigma(self) -> Array:
        """Standard errors (p, c) of the coefficients."""
        return np.asarray(np.sqrt(np.diag(self.inverse)[:, None] * self.variance))

    @property
    def t(self) -> Array:
        """Coefficients over their standard errors (p, c)."""
        return np.asarray(self.coefficients / np.maximum(self.sigma, TINY))

    @property
    def p_value(self) -> Array:
        """Two-sided p-value (p, c) of the hypothesis that the coefficient is zero."""
        from balance_cli.signals import distributions as stats

        return np.asarray(2.0 * stats.t.sf(np.abs(self.t), self.dof))

    @property
    def variance_inflation(self) -> Array:
        """Variance inflation factor (p,) of each term; 1 where it is orthogonal to the others."""
        return np.asarray(np.diag(self.inverse) * np.sum(self.root**2, axis=0))

    @property
    def press(self) -> Array:
        """Weighted sum (c,) of the squared `press_residuals`."""
        return np.asarray(self.weight @ self.press_residuals**2)


class CollinearError(Exception):
    """Columns of the regression are collinear; `share` (p,) is the part of each in the null direction."""

    def __init__(self, share: Array) -> None:
        super().__init__("columns of the regression are collinear")
        self.share = share


def solve_least_squares(X: NDArray[np.floating], Y: Array, block: Index, weight: Array | None = None) -> LeastSquares:
    """Regress outputs Y (m, c) on columns X (m, p), with a zero for each block (m,) of rows.

    X and Y may be in extended precision, which is then used throughout. `weight` (m,): 1 by default.

    Raises CollinearError where the columns are collinear within the blocks.
    """
    w = np.ones(len(X)) if weight is None else np.asarray(weight, float)
    zeros = BlockZeros.from_blocks(block, w)
    # Scaled by a power of two near the norm before elimination: after it a column may consist of rounding errors.
    size = np.sqrt(w @ np.asarray(X, float) ** 2)
    scale = np.exp2(np.round(np.log2(np.where(size > 0, size, 1.0))))
    A, shift = _shift_columns(np.asarray(X, float) / scale, zeros)
    Q, R = _thin_qr(A)
    extended = _check_condition(R) > EXTENDED_CONDITION or X.dtype == np.longdouble or Y.dtype == np.longdouble
    rows = _extended_rows(X / scale, Y, zeros) if extended else _Rows(A, Y * zeros.root[:, None], shift)
    x, z, r = _refine_solution(rows, zeros, Q, R)
    Q, R, inverse = (
        _extended_qr(zeros.subtract_means(X.astype(np.longdouble) / scale)) if extended else (Q, R, _gram_inverse(R))
    )
    return LeastSquares(
        coefficients=np.asarray(x / scale[:, None], float),
        zeros=np.asarray(z, float),
        residuals=np.asarray(r, float) / zeros.root[:, None],
        leverage=np.sum(Q**2, axis=1) + w / zeros.total[zeros.place],
        root=R * scale,
        inverse=inverse / scale / scale[:, None],
        weight=w,
        block=zeros.place,
        dof=len(X) - X.shape[1] - len(zeros.total),
        Q=Q,
    )


def _thin_qr(A: Array) -> tuple[Array, Array]:
    Q, R = qr(A, mode="economic", check_finite=False)
    return np.asarray(Q, float), np.asarray(R, float)


def _gram_inverse(R: Array) -> Array:
    inverse = solve_triangular(R, np.eye(len(R)))
    return np.asarray(inverse @ inverse.T)


def _extended_qr(A: ExtendedArray) -> tuple[Array, Array, Array]:
    """Q, R of A = Q R and (R'R)^-1, accurate to double precision for any condition."""
    Q, R = gram_schmidt(A)
    inverse = triangular_inverse(R)
    return np.asarray(Q, float), np.asarray(R, float), np.asarray(inverse @ inverse.T, float)


def _check_condition(R: Array) -> float:
    """Condition of the terms, including the cancellation when the zeros are eliminated.

    Raises CollinearError, with the smallest right singular vector, where the terms are collinear.
    """
    if not R.size:
        return 1.0
    # Columns had unit norm before elimination: their norm in R is what remains after it.
    size = np.linalg.norm(R, axis=0)
    if np.any(size * COLLINEAR_CONDITION < 1.0):
        raise CollinearError((size * COLLINEAR_CONDITION < 1.0).astype(float))
    s = np.linalg.svd(R / size, compute_uv=False)
    if s[-1] * COLLINEAR_CONDITION < s[0]:
        raise CollinearError(np.abs(np.linalg.svd(R / size)[2][-1]))
    return float(s[0] / s[-1] / size.min())


def _shift_columns(X: Array, zeros: BlockZeros) -> tuple[Array, Array]:
    """Weighted rows of X less block means (b, p), and the means that were subtracted."""
    means = np.asarray(zeros.means(X * zeros.root[:, None]), float)
    return (X - means[zeros.place]) * zeros.root[:, None], means


@dataclass(frozen=True)
class _Rows:
    """Weighted rows A (m, p) of X less `shift` (b, p), the means of each block, and y (m, c) of Y."""

    A: NDArray[np.floating]
    y: NDArray[np.floating]
    shift: NDArray[np.floating]


def _extended_rows(X: NDArray[np.floating], Y: NDArray[np.floating], zeros: BlockZeros) -> _Rows:
    """Rows in extended precision, from which nothing is subtracted: the difference would be rounded."""
    root = zeros.root.astype(np.longdouble)[:, None]
    return _Rows(X * root, Y * root, np.zeros((len(zeros.total), X.shape[1]), np.longdouble))


def _refine_solution(
    rows: _Rows, zeros: BlockZeros, Q: Array, R: Array
) -> tuple[NDArray[np.floating], NDArray[np.floating], NDArray[np.floating]]:
    """Solve r + D z + A x = y with D'r = 0 and A'r = 0 by iterative refinement (Bjorck, BIT 7 (1967) 257).

    Returns the solution x, zeros z and residuals r; z refers to A with `shift` added again. The residuals of the three
    equations are computed in the precision of A. The solution is refined once, and again while the steps shrink to
    something significant.
    """
    A, y, shift = rows.A, rows.y, rows.shift
    x, z = np.zeros((A.shape[1], y.shape[1]), A.dtype), np.zeros((len(shift), y.shape[1]), A.dtype)
    r, means, last = np.zeros_like(y), np.asarray(zeros.means(A), float), np.inf
    f, g, h = np.asarray(y, float), np.zeros(x.shape), np.zeros(z.shape)
    for number in range(MAX_REFINEMENTS):
        step = Q.T @ f - solve_triangular(R, g - means.T @ h, trans="T")
        dx, dz = solve_triangular(R, step), (zeros.sums(f) - h) / zeros.total[:, None]
        x, z, r = x + dx, z + dz - means @ dx, r + (f - Q @ step - zeros.expand(dz))
        size = float(np.max(np.max(np.abs(dx), axis=0) / np.maximum(np.max(np.abs(x), axis=0), TINY), initial=0.0))
        # Convergence is linear: the next step would be smaller by the ratio of this step to the last.
        if number and (size >= last or size * size <= np.finfo(A.dtype).eps * last):
            break
        last = size
        f = np.asarray(y - r - zeros.expand(z) - A @ x, float)
        g, h = np.asarray(-inner_products(A, r), float), np.asarray(-zeros.sums(r), float)
    return x, z - shift @ x, r


def weighted_rms(errors: Array, weight: Array) -> Array:
    """Weighted rms (c,) over the rows whose error is known."""
    known = np.isfinite(errors)
    total, squares = weight @ known, weight @ np.where(known, errors, 0.0) ** 2
    return np.asarray(np.sqrt(squares / np.where(total > 0, total, np.nan)))
