"""Errors of rows that are predicted without them and their neighbors, by which models of a channel are compared."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.least_squares import LeastSquares

Array = NDArray[np.float64]
Index = NDArray[np.intp]

MIN_SERIES = 3
"""Load series from which whole ones are left out; with fewer, consecutive rows are."""
FOLDS = 10
"""Parts of consecutive rows (Hastie, Tibshirani and Friedman, Elements of Statistical Learning, 2009, section 7.10)."""
MIN_LEFT = 1e-6
"""Least eigenvalue of 1 - H from which the other rows determine those that are left out."""


def prediction_errors(fit: LeastSquares, load_series: Index) -> Array:
    """Errors (m,) of the rows of a fit to one output, predicted without their load series.

    With fewer than MIN_SERIES series, or where the others do not determine a term of a series, its rows are predicted
    without the consecutive rows around them, and where that is not possible either, without the row itself.
    """
    errors = np.full(len(load_series), np.nan)
    if len(np.unique(load_series)) >= MIN_SERIES:
        errors = fit.cross_validation_errors(load_series)[:, 0]
    else:
        for rows in np.array_split(np.arange(len(load_series)), min(FOLDS, len(load_series))):
            errors[rows] = _errors_without(fit, rows)
    return np.where(np.isfinite(errors), errors, fit.press_residuals[:, 0])


def _errors_without(fit: LeastSquares, rows: Index) -> Array:
    """Errors (r,) of some rows predicted by all others; NaN where these do not determine them."""
    root = np.sqrt(fit.weight[rows])
    same = fit.block[rows][:, None] == fit.block[rows]
    total = np.bincount(fit.block, fit.weight)[fit.block[rows]]
    H = fit.Q[rows] @ fit.Q[rows].T + np.where(same, root[:, None] * root / total, 0.0)
    remainder = np.eye(len(rows)) - H
    if np.linalg.eigvalsh(remainder)[0] < MIN_LEFT:
        return np.full(len(rows), np.nan)
    return np.asarray(np.linalg.solve(remainder, root * fit.residuals[rows, 0]) / root)
