"""Linear regression with a zero for each loading sequence, and what tells whether it can be trusted.

Rows come in blocks, each with a zero of its own (a natural zero and its shift), which is eliminated: every column less
its weighted mean in each block. One QR decomposition of the centred terms, columns scaled, serves everything: with
A = Q R,

    coefficients     b = R^-1 Q'y, refined together with the zeros (Bjorck, BIT 7 (1967) 257)
    covariance       s^2 (R'R)^-1
    variance inflation   diag (R'R)^-1 diag(R'R): zeros taken out (Marquardt, Technometrics 12 (1970) 591)
    PRESS            e_i / (1 - h_i),  h the diagonal of QQ' and the share of a row in its zero
                     (Allen, Technometrics 16 (1974) 125)
    left-out blocks  (1 - Q_B Q_B')^-1 e_B: a block that took no part still has its own zero

so that no model is fitted twice. All outputs have the same terms, and are done together.

Errors grow with the condition of the terms. Where that is large, or what comes is in extended precision, so are the
residuals of the refinement and the decomposition that the standard errors rest on.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from balance_cli.calibration.extended_precision import ExtendedArray, gram_schmidt, inner_products, triangular_inverse

Array = NDArray[np.float64]
Index = NDArray[np.intp]

# Largest condition of the scaled columns that leaves coefficients a few digits in double precision.
COLLINEAR_CONDITION = 1e13
# Condition beyond which double precision would leave fewer than some eleven digits.
EXTENDED_CONDITION = 1e4
# Refinements at most; each leaves of the error what the first solution has of it. They end where no more is gained.
MAX_REFINEMENTS = 8
TINY = float(np.finfo(float).tiny)
# A row that alone determines a coefficient is granted this share of its residual.
PRESS_LEVERAGE_FLOOR = 1e-8
# Share of what is known of a term that rows of other groups must hold, to predict a group by them.
MIN_KNOWN_SHARE = 1e-4


@dataclass(frozen=True)
class LeastSquares:
    """Regression of outputs (m, c) on p terms with a zero for each of b blocks.

    coefficients (p, c) and zeros (b, c); residuals (m, c); leverage (m,); `root` (p, p): R of the head of this module,
    terms in their own units, and `inverse` (p, p) = (R'R)^-1, the covariance of the coefficients for s = 1; weight
    (m,), block (m,); dof: rows less everything fitted; Q (m, p) spans the terms within the blocks, in weighted rows.
    """

    coefficients: Array
    zeros: Array
    residuals: Array
    leverage: Array
    root: Array
    inverse: Array
    weight: Array
    block: Index
    dof: int
    Q: Array

    @property
    def variance(self) -> Array:
        """s^2 (c,) of a row of weight one."""
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
        """Probability (p, c) of so large a t where the coefficient is zero."""
        from scipy import stats

        return np.asarray(2.0 * stats.t.sf(np.abs(self.t), self.dof))

    @property
    def variance_inflation(self) -> Array:
        """By how much (p,) the other terms inflate the variance of each; 1 where it is orthogonal to them."""
        return np.asarray(np.diag(self.inverse) * np.sum(self.root**2, axis=0))

    @property
    def press_residuals(self) -> Array:
        """Error (m, c) of each row, predicted by all others."""
        return np.asarray(self.residuals / np.maximum(1.0 - self.leverage, PRESS_LEVERAGE_FLOOR)[:, None])

    @property
    def press(self) -> Array:
        """Sum (c,) of the squares of `press_residuals`, weighted."""
        return np.asarray(self.weight @ self.press_residuals**2)

    def left_out(self, group: Index) -> Array:
        """Errors (m, c) of the rows of each group, predicted by the rows of all others and the zeros of their blocks.

        `group` (m,): whole blocks. NaN where the others do not determine a term.
        """
        errors = np.full(self.residuals.shape, np.nan)
        root = np.sqrt(self.weight)[:, None]
        for name in np.unique(group):
            rows = np.flatnonzero(group == name)
            Q = self.Q[rows]
            # The small one of the two forms: (1 - Q Q')^-1 = 1 + Q (1 - Q'Q)^-1 Q'.
            left = np.eye(Q.shape[1]) - Q.T @ Q
            if np.linalg.eigvalsh(left)[0] > MIN_KNOWN_SHARE:
                e = root[rows] * self.residuals[rows]
                errors[rows] = (e + Q @ np.linalg.solve(left, Q.T @ e)) / root[rows]
        return errors


class CollinearError(Exception):
    """Columns of the regression that say the same; `share` (p,) says how much of each is in it."""

    def __init__(self, share: Array) -> None:
        super().__init__("columns of the regression say the same")
        self.share = share


def regression(X: NDArray[np.floating], Y: Array, block: Index, weight: Array | None = None) -> LeastSquares:
    """Regress outputs Y (m, c) on columns X (m, p), with a zero for each block (m,) of rows.

    X and Y may come in extended precision, which is kept where it matters. Raises CollinearError.
    """
    w = np.ones(len(X)) if weight is None else np.asarray(weight, float)
    zeros = _BlockZeros.from_blocks(block, w)
    # The size of a column with its zeros in it, to a power of two: what the zeros leave of it may be rounding.
    size = np.sqrt(w @ np.asarray(X, float) ** 2)
    scale = np.exp2(np.round(np.log2(np.where(size > 0, size, 1.0))))
    Q, R = np.linalg.qr(zeros.subtract_means(np.asarray(X, float) / scale))
    extended = _check_condition(R) > EXTENDED_CONDITION or X.dtype == np.longdouble or Y.dtype == np.longdouble
    x, z, r = _refine_solution(*_shift_columns(X / scale, Y, zeros, extended), zeros, Q, R)
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


@dataclass(frozen=True)
class _BlockZeros:
    """Blocks of rows: `place` (m,) among the blocks, `order` (m,) and `starts` (b,) of rows sorted by them; sums

    of weights `total` (b,), square roots of weights `root` (m,).
    """

    place: Index
    order: Index
    starts: Index
    total: Array
    root: Array

    @classmethod
    def from_blocks(cls, block: Index, weight: Array) -> _BlockZeros:
        names, place = np.unique(block, return_inverse=True)
        order = np.argsort(place, kind="stable")
        starts = np.searchsorted(place[order], np.arange(len(names)))
        return cls(place, order, starts, np.asarray(np.bincount(place, weight), float), np.sqrt(weight))

    def sums(self, rows: NDArray[np.floating]) -> NDArray[np.floating]:
        """D' times weighted rows (m, p), with D (m, b) the weighted columns of the zeros."""
        weighted = rows * self.root[:, None]
        return np.asarray(np.add.reduceat(weighted[self.order], self.starts, axis=0))

    def expand(self, values: NDArray[np.floating]) -> NDArray[np.floating]:
        """D times values (b, p) of the blocks."""
        return np.asarray(values[self.place] * self.root[:, None])

    def means(self, rows: NDArray[np.floating]) -> NDArray[np.floating]:
        """Means (b, p) of weighted rows (m, p) in each block."""
        return np.asarray(self.sums(rows) / self.total[:, None])

    def subtract_means(self, values: NDArray[np.floating]) -> NDArray[np.floating]:
        """Weighted rows of values (m, p), without what the zeros explain of them."""
        rows = values * self.root[:, None]
        return np.asarray(rows - self.expand(self.means(rows)))


def subtract_block_means(values: Array, block: Index, weight: Array | None = None) -> Array:
    """Weighted rows of values (m, p) less their weighted means in each block (m,)."""
    w = np.ones(len(values)) if weight is None else weight
    return np.asarray(_BlockZeros.from_blocks(block, w).subtract_means(values), float)


def _gram_inverse(R: Array) -> Array:
    inverse = solve_triangular(R, np.eye(len(R)))
    return np.asarray(inverse @ inverse.T)


def _extended_qr(A: ExtendedArray) -> tuple[Array, Array, Array]:
    """Q, R of A = Q R and (R'R)^-1, to double precision whatever the condition."""
    Q, R = gram_schmidt(A)
    inverse = triangular_inverse(R)
    return np.asarray(Q, float), np.asarray(R, float), np.asarray(inverse @ inverse.T, float)


def _check_condition(R: Array) -> float:
    """Condition of the terms, times what the zeros cancel of them.

    Raises CollinearError with the smallest right singular vector where they say the same.
    """
    if not R.size:
        return 1.0
    # The columns were scaled with their zeros in them: what these leave of a term is its size in R.
    size = np.linalg.norm(R, axis=0)
    if np.any(size * COLLINEAR_CONDITION < 1.0):
        raise CollinearError((size * COLLINEAR_CONDITION < 1.0).astype(float))
    s = np.linalg.svd(R / size, compute_uv=False)
    if s[-1] * COLLINEAR_CONDITION < s[0]:
        raise CollinearError(np.abs(np.linalg.svd(R / size)[2][-1]))
    return float(s[0] / s[-1] / size.min())


def _shift_columns(
    X: NDArray[np.floating], Y: NDArray[np.floating], zeros: _BlockZeros, extended: bool
) -> tuple[NDArray[np.floating], NDArray[np.floating], NDArray[np.floating]]:
    """Weighted rows of X, shifted by some (b, p), and of Y; and the shifts.

    In extended precision by nothing: the difference would be rounded.
    """
    if extended:
        root = zeros.root.astype(np.longdouble)[:, None]
        return X * root, Y * root, np.zeros((len(zeros.total), X.shape[1]), np.longdouble)
    means = zeros.means(X * zeros.root[:, None])
    return (X - means[zeros.place]) * zeros.root[:, None], Y * zeros.root[:, None], means


def _refine_solution(
    A: NDArray[np.floating],
    y: NDArray[np.floating],
    shift: NDArray[np.floating],
    zeros: _BlockZeros,
    Q: Array,
    R: Array,
) -> tuple[NDArray[np.floating], NDArray[np.floating], NDArray[np.floating]]:
    """Solution x, zeros z and residual r of r + D z + A x = y with D'r = 0 and A'r = 0; `shift` is added to A again.

    The residuals of all three equations have the precision of A. Refined once always, further as long as the last step
    says that something is left to refine.
    """
    x, z = np.zeros((A.shape[1], y.shape[1]), A.dtype), np.zeros((len(shift), y.shape[1]), A.dtype)
    r, means, last = np.zeros_like(y), np.asarray(zeros.means(A), float), np.inf
    f, g, h = np.asarray(y, float), np.zeros(x.shape), np.zeros(z.shape)
    for number in range(MAX_REFINEMENTS):
        step = Q.T @ f - solve_triangular(R, g - means.T @ h, trans="T")
        dx, dz = solve_triangular(R, step), (zeros.sums(f) - h) / zeros.total[:, None]
        x, z, r = x + dx, z + dz - means @ dx, r + (f - Q @ step - zeros.expand(dz))
        size = float(np.max(np.max(np.abs(dx), axis=0) / np.maximum(np.max(np.abs(x), axis=0), TINY), initial=0.0))
        # The next step is as much smaller as this one is than the last.
        if number and (size >= last or size * size <= np.finfo(A.dtype).eps * last):
            break
        last = size
        f = np.asarray(y - r - zeros.expand(z) - A @ x, float)
        g, h = np.asarray(-inner_products(A, r), float), np.asarray(-zeros.sums(r), float)
    return x, z - shift @ x, r
