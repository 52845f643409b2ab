"""Rows that stand out because their load was reached from above: hysteresis, as by friction in pulleys, and no mistake.

A schedule that goes up in many steps and down in few has so few unloading rows that they look like outliers beside the
others. Without them the calibration shows no hysteresis, and its loads are off by half of it, beyond their sigma.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.fit import CalibrationModelFit, CalibrationPoints, fit_calibration_model
from balance_cli.calibration.row_errors import errors_without
from balance_cli.calibration.term_choice import TermChoice

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

FEWEST_ROWS = 2
"""Excluded rows of a load from which they may be a pattern: a single one may be a weight that was read wrong."""
LEAST_LIKENESS = 0.95
"""Cosine of an error and of what the load causes, from which the error is one of this load."""
LEAST_LAG = 1.0 / 3.0
"""Lag of each unloading row over the median of those excluded: friction is even to less than that."""
LARGEST_LAG = 0.2
"""Of the load itself: no usable rope or balance has more."""
SAME_LOAD = 1e-3
"""Share of the calibrated range by which the other loads may change from row to row."""


def include_unloading_rows(
    points: CalibrationPoints, included: CalibrationPoints, fit: CalibrationModelFit, excluded: Mask, choice: TermChoice
) -> tuple[Mask, CalibrationModelFit, tuple[str, ...]]:
    """Include the excluded rows (m,) that lag as all rows of a load do that were reached from above.

    Returns the rows that stay excluded, the fit, and a note for each such load.
    """
    kept, notes = np.zeros(len(excluded), bool), []
    errors = np.where(excluded[:, None], errors_without(points, fit, excluded), fit.residuals)
    for j, name in enumerate(points.components):
        rows = _unloading_rows(points.x, points.load_series, j)
        own = rows & excluded
        if np.count_nonzero(own) < FEWEST_ROWS:
            continue
        lag = _lag(points, fit, errors, j)
        usual = float(np.median(lag[own]))
        if 0.0 < usual < LARGEST_LAG and np.all(lag[rows] > LEAST_LAG * usual):
            kept |= own
            lag_text = f"{name} is larger by {100.0 * usual:.2g} % where it was reached from above"
            number = np.count_nonzero(own)
            notes.append(f"{lag_text}, in {number} rows that were kept: hysteresis, as by friction in pulleys")
    if not kept.any():
        return excluded, fit, ()
    further = replace(included, weight=np.where(kept, points.weight, included.weight))
    return excluded & ~kept, fit_calibration_model(further, choice), tuple(notes)


def _unloading_rows(x: Array, series: NDArray[np.intp], j: int) -> Mask:
    """Rows (m,) at which load j alone was lowered in size and not to zero, for loads x (m, k) over their range."""
    change = np.diff(x, axis=0, prepend=x[:1])
    alone = np.all(np.abs(np.delete(change, j, axis=1)) < SAME_LOAD, axis=1)
    alone &= np.diff(series, prepend=series[:1]) == 0
    return np.asarray(alone & (np.abs(x[:, j]) > SAME_LOAD) & (change[:, j] * np.sign(x[:, j]) < -SAME_LOAD))


def _lag(points: CalibrationPoints, fit: CalibrationModelFit, errors: Array, j: int) -> Array:
    """Share (m,) by which load j seems larger than stated in each row; -inf where its error is one of another kind."""
    sigma = np.sqrt(np.diag(fit.model.residual_covariance))
    J, e = fit.model.jacobian(points.loads)[:, :, j] / sigma, np.nan_to_num(errors) / sigma
    along, size = np.sum(J * e, axis=1), np.linalg.norm(J, axis=1)
    is_own = along**2 >= (LEAST_LIKENESS * size * np.linalg.norm(e, axis=1)) ** 2
    share = along / np.maximum(size**2, np.finfo(float).tiny) / np.where(points.x[:, j] != 0.0, points.x[:, j], 1.0)
    return np.asarray(np.where(is_own, share, -np.inf))
