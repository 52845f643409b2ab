"""Errors of rows that are predicted without them and their neighbors, by which models of a channel are compared."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.projection import Projection, RowGroups

Array = NDArray[np.float64]
Index = NDArray[np.intp]

MIN_SERIES = 3
"""Load series from which whole ones are left out; with fewer, consecutive rows are."""
FOLDS = 10
"""Parts of consecutive rows (Hastie, Tibshirani and Friedman, Elements of Statistical Learning, 2009, section 7.10)."""
MIN_LEFT = 1e-6
"""Least eigenvalue of 1 - H from which the other rows determine those that are left out."""


def parts_of_rows(load_series: Index) -> RowGroups | tuple[Index, ...]:
    """What is left out in turn: whole load series (m,), or with fewer than MIN_SERIES of them consecutive rows."""
    if len(np.unique(load_series)) >= MIN_SERIES:
        return RowGroups.from_labels(load_series)
    return tuple(np.array_split(np.arange(len(load_series)), min(FOLDS, len(load_series))))


def prediction_errors(fit: Projection, parts: RowGroups | tuple[Index, ...]) -> Array:
    """Errors (m,) of the rows of a fit to one output, predicted without the others of their `parts_of_rows`.

    With fewer than MIN_SERIES series, or where the others do not determine a term of a series, its rows are predicted
    without the consecutive rows around them, and where that is not possible either, without the row itself.
    """
    if isinstance(parts, RowGroups):
        errors = fit.errors_without(parts)[:, 0]
    else:
        errors = np.concatenate([_errors_without(fit, rows) for rows in parts])
    return np.where(np.isfinite(errors), errors, fit.press_residuals[:, 0])


def _errors_without(fit: Projection, rows: Index) -> Array:
    """Errors (r,) of some rows predicted by all others; NaN where these do not determine them."""
    root = np.sqrt(fit.weight[rows])
    same = fit.block[rows][:, None] == fit.block[rows]
    total = np.bincount(fit.block, fit.weight)[fit.block[rows]]
    H = fit.Q[rows] @ fit.Q[rows].T + np.where(same, root[:, None] * root / total, 0.0)
    remainder = np.eye(len(rows)) - H
    if np.linalg.eigvalsh(remainder)[0] < MIN_LEFT:
        return np.full(len(rows), np.nan)
    return np.asarray(np.linalg.solve(remainder, root * fit.residuals[rows, 0]) / root)
