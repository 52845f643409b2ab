"""Load series without an unloaded row, whose zero differs from what the unloaded balance reads beside them.

Such a zero is an extrapolation of the loads of its series. Where it differs from the unloaded rows of the same run, the
fit is as good as where it does not: the loads of the series lack a constant part (a hanger), the zero moved, or the
readings jump at zero (free play). Only in the first case are loads right that count from an unloaded reading.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.fit import CalibrationModelFit, CalibrationPoints
from balance_cli.calibration.load_series import MIN_LOAD_CHANGE
from balance_cli.signals import distributions as stats

Array = NDArray[np.float64]
Index = NDArray[np.intp]

ZERO_P_VALUE = 1e-3
"""P-value, over all series and components, below which a zero differs: one of a thousand sound tables has a note."""
MAX_NOTES = 3
"""Load series that are named one by one; where more have a zero of their own, the rest is counted."""


def series_zero_notes(points: CalibrationPoints, fit: CalibrationModelFit) -> Iterator[str]:
    """Notes on the load series without an unloaded row whose zero is significantly off the unloaded rows beside it."""
    used = np.asarray(np.isfinite(fit.residuals).all(axis=1))
    unloaded = np.flatnonzero(used & np.all(np.abs(points.x) <= MIN_LOAD_CHANGE, axis=1))
    series = np.searchsorted(np.unique(points.load_series[used]), points.load_series)
    without_unloaded = [s for s in range(len(fit.model.zeros)) if s not in series[unloaded]]
    notes = []
    for s in without_unloaded:
        rows = np.flatnonzero(used & (series == s))
        beside = _rows_beside(points, rows, unloaded)
        distances = [_distance(points, fit, s, int(row)) for row in beside]
        if distances and all(p * len(without_unloaded) < ZERO_P_VALUE for _, p in distances):
            at = int(np.argmin([np.max(np.abs(loads / points.calibrated_range)) for loads, _ in distances]))
            notes.append(_note(points, fit.model.load_series[s], int(beside[at]), distances[at][0]))
    yield from notes[:MAX_NOTES]
    if len(notes) > MAX_NOTES:
        yield f"{len(notes) - MAX_NOTES} more load series have a zero off the unloaded rows beside them"


def _rows_beside(points: CalibrationPoints, rows: Index, unloaded: Index) -> Index:
    """The unloaded rows next to the `rows` of a series, before and after them, in the same run and attitude."""
    candidates = unloaded[points.attitude_segment[unloaded] == points.attitude_segment[rows[0]]]
    before, after = candidates[candidates < rows[0]][-1:], candidates[candidates > rows[-1]][:1]
    return np.concatenate([before, after])


def _distance(points: CalibrationPoints, fit: CalibrationModelFit, s: int, row: int) -> tuple[Array, float]:
    """The loads (k,) [N, N m] that the zero of series `s` looks like at an unloaded row, and their least p-value."""
    model = fit.model
    unloaded = points.channels[row] - model.readings(points.loads[row][None])[0]
    W = model.inverse() * points.calibrated_range[:, None]
    variance = np.diag(model.residual_covariance) + fit.zero_covariance[:, s, s]
    loads = W @ (model.zeros[s] - unloaded)
    ratio = loads**2 / np.maximum(W**2 @ variance, np.finfo(float).tiny)
    p_value = min(stats.f.sf(value, 1.0, float(model.dof.min())) for value in ratio)
    return loads, float(p_value * len(loads))


def _note(points: CalibrationPoints, description: str, row: int, loads: Array) -> str:
    share = np.abs(loads) / points.calibrated_range
    j = int(np.argmax(share))
    first = int(np.argmax(points.run == points.run[row]))
    return (
        f"{description}: no unloaded row tells the zero of this load series, and its loads put it "
        f"{100.0 * share[j]:.2g} % of the calibrated {points.components[j]} off the unloaded row {row - first + 1}: "
        "the loads lack a constant part (a hanger?), or else the zero moved, or the readings jump at zero, and "
        "loads that count from an unloaded reading are off by as much"
    )
