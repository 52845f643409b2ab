"""Errors of the rows of a calibration when the others predict them, and what they may be."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.fit import CalibrationModelFit, CalibrationPoints
from balance_cli.calibration.robust_fit import OUTLIER_SIGNIFICANCE_LEVEL
from balance_cli.calibration.robust_scale import load_error_sigma, robust_row_sigma
from balance_cli.signals import distributions as stats

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

OUTLIER_LIMIT_FACTOR = 1.3
"""Factor on the limit of Student's t: the median of a load series is itself known to a few per cent only."""
LOAD_ERROR_LIMIT = 5.0
"""Standard deviations of its load by which a row may be off: one of two million normal errors exceeds it."""


def outlier_limit(points: CalibrationPoints, fit: CalibrationModelFit) -> float:
    """Ratio of error and sigma beyond which the largest of all rows and channels is not chance."""
    dof = max(float(np.min(fit.model.dof)), 3.0)  # below 3 the variance of Student's t is infinite
    tests = np.count_nonzero(points.weight > 0) * points.channels.shape[1]
    return float(OUTLIER_LIMIT_FACTOR * stats.t.isf(0.5 * OUTLIER_SIGNIFICANCE_LEVEL / tests, dof))


def row_sigma(points: CalibrationPoints, fit: CalibrationModelFit, used: Mask) -> Array:
    """Standard deviation (m, c) of weighted errors of rows that are predicted without them, by those `used` (m,)."""
    return robust_row_sigma(fit.press * np.sqrt(points.weight)[:, None], points.load_series, used, points.x)


def have_load_errors(points: CalibrationPoints, fit: CalibrationModelFit, rows: Mask) -> Mask:
    """Which of some rows (m,), that a fit leaves out, err no more than their loads may, beside the noise of readings.

    Most rows show the noise alone of a channel that one load moves, as a torque meter: beside it the error of a weight
    looks like a mistake.
    """
    used = (points.weight > 0) & ~rows
    errors, predicted = errors_without(points, fit, rows), fit.model.readings(points.loads)
    load_error = load_error_sigma(np.where(rows[:, None], errors, fit.press), predicted)
    noise = outlier_limit(points, fit) * row_sigma(points, fit, used)
    bound = np.hypot(noise, LOAD_ERROR_LIMIT * load_error * np.sqrt(points.weight)[:, None])
    known = np.isin(points.load_series, points.load_series[used])
    return np.asarray(rows & known & np.all(np.abs(errors) * np.sqrt(points.weight)[:, None] <= bound, axis=1))


def errors_without(points: CalibrationPoints, fit: CalibrationModelFit, rows: Mask) -> Array:
    """Readings of some rows (m, c) less those of a fit without them; 0 where their load series was not fitted."""
    fitted = np.unique(points.load_series[np.isfinite(fit.residuals).all(axis=1)])
    known = rows & np.isin(points.load_series, fitted)
    errors = np.zeros_like(points.channels)
    zeros = fit.model.zeros[np.searchsorted(fitted, points.load_series[known])]
    errors[known] = points.channels[known] - zeros - fit.model.readings(points.loads[known])
    return errors
