"""Linear regression with a zero for each loading sequence, and what tells whether it can be trusted.

Rows come in blocks, each with a zero of its own (a natural zero and its shift): X = [zeros, terms]. One QR
decomposition of X, columns scaled, serves everything: with X = Q R, the terms last,

    coefficients     b = R^-1 Q'y,  refined with residuals in extended precision (Bjorck, BIT 7 (1967) 257)
    covariance       s^2 (X'X)^-1,  whose part for the terms is s^2 (R2'R2)^-1, R2 the last corner of R
    variance inflation   diag (R2'R2)^-1 diag(R2'R2): zeros taken out (Marquardt, Technometrics 12 (1970) 591)
    PRESS            e_i / (1 - h_i),  h the diagonal of QQ' (Allen, Technometrics 16 (1974) 125)
    left-out blocks  (1 - H_BB)^-1 e_B,  where H is the projection on the terms less their means in each block: a block
                     that took no part still has its own zero

so that no model is fitted twice. All outputs have the same terms, and are done together.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

Array = NDArray[np.float64]
Index = NDArray[np.intp]

# Largest condition of the scaled columns that leaves coefficients a few digits in double precision.
LARGEST_CONDITION = 1e13
REFINEMENTS = 4
# A row that alone determines a coefficient is granted this share of its residual.
LEAST_SHARE = 1e-8
# Share of what is known of a term that rows of other groups must hold, to predict a group by them.
LEAST_KNOWN = 1e-4


@dataclass(frozen=True)
class LeastSquares:
    """Regression of outputs (m, c) on p terms with a zero for each of b blocks.

    coefficients (p, c) and zeros (b, c); residuals (m, c); leverage (m,); `root` (p, p): R2 of the head of this module,
    terms in their own units; weight (m,), block (m,); dof: rows less everything fitted; Q (m, p) spans the terms within
    the blocks, in weighted rows.
    """

    coefficients: Array
    zeros: Array
    residuals: Array
    leverage: Array
    root: Array
    weight: Array
    block: Index
    dof: int
    Q: Array

    @property
    def variance(self) -> Array:
        """s^2 (c,) of a row of weight one."""
        return np.asarray(self.weight @ self.residuals**2 / self.dof)

    @property
    def inverse(self) -> Array:
        """(R2'R2)^-1 (p, p): the covariance of the coefficients for s = 1."""
        inverse = solve_triangular(self.root, np.eye(len(self.root)))
        return np.asarray(inverse @ inverse.T)

    @property
    def sigma(self) -> Array:
        """Standard errors (p, c) of the coefficients."""
        return np.asarray(np.sqrt(np.diag(self.inverse)[:, None] * self.variance))

    @property
    def t(self) -> Array:
        """Coefficients over their standard errors (p, c)."""
        return np.asarray(self.coefficients / np.maximum(self.sigma, np.finfo(float).tiny))

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
        return np.asarray(self.residuals / np.maximum(1.0 - self.leverage, LEAST_SHARE)[:, None])

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
            if np.linalg.eigvalsh(left)[0] > LEAST_KNOWN:
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
    blocks = np.unique(block)
    D = (block[:, None] == blocks).astype(X.dtype)
    whole = np.hstack([D, X]).astype(np.longdouble) * np.sqrt(w).astype(np.longdouble)[:, None]
    y = np.asarray(Y, np.longdouble) * np.sqrt(w)[:, None]
    scale = np.sqrt(np.sum(np.asarray(whole, float) ** 2, axis=0))
    scale = np.where(scale > 0, scale, 1.0)
    A = whole / scale
    Q, R = np.linalg.qr(np.asarray(A, float))
    b = len(blocks)
    _check_told_apart(R, b)
    x, r = _refined(A, y, Q, R)
    coefficients = np.asarray(x / scale[:, None], float)
    return LeastSquares(
        coefficients=coefficients[b:],
        zeros=coefficients[:b],
        residuals=np.asarray(r, float) / np.sqrt(w)[:, None],
        leverage=np.sum(Q**2, axis=1),
        root=R[b:, b:] * scale[b:],
        weight=w,
        block=np.searchsorted(blocks, block),
        dof=len(X) - A.shape[1],
        Q=Q[:, b:],
    )


def _check_told_apart(R: Array, zeros: int) -> None:
    """Raises CollinearError with the smallest right singular vector of the terms, zeros taken out."""
    inner = R[zeros:, zeros:]
    if not inner.size:
        return
    # The columns were scaled with their zeros in them: what these leave of a term is its size in `inner`.
    size = np.linalg.norm(inner, axis=0)
    if np.any(size * LARGEST_CONDITION < 1.0):
        raise CollinearError((size * LARGEST_CONDITION < 1.0).astype(float))
    s, Vt = np.linalg.svd(inner / size)[1:]
    if s[-1] * LARGEST_CONDITION < s[0]:
        raise CollinearError(np.abs(Vt[-1]))


def _refined(
    A: NDArray[np.longdouble], y: NDArray[np.longdouble], Q: Array, R: Array
) -> tuple[NDArray[np.longdouble], NDArray[np.longdouble]]:
    """Solution x and residual r of the system r + A x = y, A'r = 0, both refined with extended residuals."""
    x = np.zeros((A.shape[1], y.shape[1]), np.longdouble)
    r = np.zeros_like(y)
    for _ in range(REFINEMENTS):
        f = np.asarray(y - r - A @ x, float)
        g = np.asarray(-(A.T @ r), float)
        d = solve_triangular(R, g, trans="T")
        u = Q.T @ f
        x = x + solve_triangular(R, u - d)
        r = r + (f - Q @ u + Q @ d)
    return x, r
