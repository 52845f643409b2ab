"""Whether a term of the calibration model rests on one or two rows.

A term that one or two rows carry is as likely an error of these rows. It is supported only if it stays significant
without any two of them. Deletion formulas give the fit without them (Cook and Weisberg, Residuals and Influence in
Regression, 1982, chapter 3): nothing is fitted again.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.least_squares import LeastSquares
from balance_cli.signals import distributions as stats

Array = NDArray[np.float64]
Index = NDArray[np.intp]

FEW_ROWS_P_VALUE = 1e-3
"""P-value that a term must keep without any two rows: it was found at a far smaller one, corrected for the search."""
MOST_INFLUENTIAL_ROWS = 8
"""Rows among which the two are sought, by their share of the information and by their pull on the coefficient."""
MIN_LEFT = 1e-8
"""Determinant of 1 - H of two rows from which the remaining ones determine the term no longer."""


def least_p_value_without_two_rows(fit: LeastSquares, column: int) -> float:
    """Largest p-value of one term of a fit to one output without any two rows; 1 where these determine the term."""
    root = np.sqrt(fit.weight)
    e = root * fit.residuals[:, 0]
    # Influence of each row on the coefficient: column of (R'R)^-1 A' with A = Q R.
    g = fit.Q @ (fit.root @ fit.inverse[:, column])
    pairs = np.array(list(combinations(_influential_rows(g, e, fit.leverage), 2)), np.intp).reshape(-1, 2)
    if len(pairs) == 0 or fit.dof <= 2:
        return 1.0
    i, j = pairs.T
    a, b, c = 1.0 - fit.leverage[i], 1.0 - fit.leverage[j], -_cross_leverage(fit, root, i, j)
    determinant = a * b - c**2
    safe = np.maximum(determinant, MIN_LEFT)

    def quadratic(u: Array, v: Array) -> Array:
        """U' (1 - H)^-1 v for each pair of rows."""
        return np.asarray((b * u[i] * v[i] + a * u[j] * v[j] - c * (u[i] * v[j] + u[j] * v[i])) / safe)

    coefficient = fit.coefficients[column, 0] - quadratic(g, e)
    variance = np.maximum(e @ e - quadratic(e, e), np.finfo(float).tiny) / (fit.dof - 2)
    sigma = np.sqrt(variance * (fit.inverse[column, column] + quadratic(g, g)))
    p = 2.0 * stats.t.sf(np.abs(coefficient) / np.maximum(sigma, np.finfo(float).tiny), fit.dof - 2)
    return float(np.max(np.where(determinant > MIN_LEFT, p, 1.0)))


def _influential_rows(g: Array, e: Array, leverage: Array) -> list[int]:
    pull = np.abs(g * e) / np.maximum(1.0 - leverage, MIN_LEFT)
    most = {
        *np.argsort(-np.abs(g))[:MOST_INFLUENTIAL_ROWS].tolist(),
        *np.argsort(-pull)[:MOST_INFLUENTIAL_ROWS].tolist(),
    }
    return sorted(most)


def _cross_leverage(fit: LeastSquares, root: Array, i: Index, j: Index) -> Array:
    """Elements H_ij of the leverage matrix, with the part of the zeros."""
    total = np.bincount(fit.block, fit.weight)
    same = fit.block[i] == fit.block[j]
    return np.asarray(
        np.sum(fit.Q[i] * fit.Q[j], axis=1) + np.where(same, root[i] * root[j] / total[fit.block[i]], 0.0)
    )
