"""Load series with two loads in proportion that contradict those of the single loads, where terms would hide it.

A wrong load in such a series looks like a gain that it alone has. Terms of two loads, such as |Fx| My, which no other
series tells, follow that nearly, so that the fit is good and its terms are wrong. Without the series a linear model
then fits as well as all terms did, and one gain explains the series.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.calibration.all_trims_result import SuspectLoadSeries
from balance_cli.calibration.fit import CalibrationModelFit, CalibrationPoints, fit_calibration_model
from balance_cli.calibration.gain_scatter import MIN_GAIN_ERROR
from balance_cli.calibration.least_squares import CollinearError
from balance_cli.calibration.load_series import MIN_LOAD_CHANGE
from balance_cli.calibration.term_choice import LINEAR_TERMS

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

MIN_MISFIT_RATIO = 1.5
"""Residual of a linear model over that of the selected terms from which these follow more than noise."""
SAME_MISFIT = 1.2
"""The same without the series, and of the series by one gain, up to which no term is needed: chance alone makes 1.1 of
some dozens of rows. Terms that follow a gain leave more than noise, and the ratio is below one."""
MIN_SHARE = 0.05
"""Signal of a channel in a series, over its largest one, from which its gain there counts."""
PROPORTIONAL = 0.05
"""Second singular value of the loads of a series over the first, up to which they change in proportion."""


@dataclass(frozen=True)
class Exclusion:
    """Rows (m,) of load series to be excluded, their suspect channels, and in words what decided, empty by default."""

    rows: Mask
    channels: list[SuspectLoadSeries]
    note: str = ""


def contradicting_series(
    points: CalibrationPoints, fit: CalibrationModelFit, linear_fit: CalibrationModelFit
) -> Exclusion | None:
    """Return the load series without which a linear model fits as well as the terms of `fit` do with it; None without.

    Of several, which contradict each other, it is the one with most loads: each may be wrong.
    """
    used = points.weight > 0
    groups = list(_groups(points, used))
    if not fit.model.is_nonlinear or not any(is_proportional(points.x[rows]) for rows in groups):
        return None
    unit = _rms(fit.residuals[used])
    if float(_rms(_rms(linear_fit.residuals[used]) / unit)) < MIN_MISFIT_RATIO:
        return None
    tried = (_without(points, fit, rows, unit) for rows in groups)
    found = sorted(filter(None, tried), key=lambda each: -int(np.count_nonzero(_moved(points, each.rows))))
    if not found:
        return None
    others = tuple(dict.fromkeys(suspect.load_series for each in found[1:] for suspect in each.channels))
    return replace(found[0], channels=[replace(suspect, alternatives=others) for suspect in found[0].channels])


def _groups(points: CalibrationPoints, used: Mask) -> Iterator[Mask]:
    """Yield the rows (m,) of all load series that vary the same loads."""
    moved: dict[tuple[bool, ...], Mask] = {}
    for name in np.unique(points.load_series[used]).tolist():
        rows = (points.load_series == name) & used
        key = tuple(_moved(points, rows).tolist())
        moved[key] = moved.get(key, np.zeros(len(used), bool)) | rows
    yield from moved.values()


def is_proportional(x: Array) -> bool:
    """Whether two loads or more of some rows x (r, k) change in proportion."""
    singular = np.linalg.svd(x - x.mean(axis=0), compute_uv=False)
    several = np.count_nonzero(np.ptp(x, axis=0) > MIN_LOAD_CHANGE) > 1
    return bool(several and singular[1] <= PROPORTIONAL * singular[0])


def _without(points: CalibrationPoints, fit: CalibrationModelFit, rows: Mask, unit: Array) -> Exclusion | None:
    """Return what some rows (m,) contradict if a linear fit to the others leaves errors of about `unit` (c,)."""
    try:
        others = fit_calibration_model(points.exclude_rows(rows), LINEAR_TERMS)
    except CollinearError:  # no other series tells one of its loads
        return None
    left = float(_rms(_rms(others.residuals[(points.weight > 0) & ~rows]) / unit))
    if left > SAME_MISFIT:
        return None
    readings = (points.channels, others.model.readings(points.loads))
    change, expected = (_centered(points, rows, values) for values in readings)
    power = np.sum(expected**2, axis=0)
    gain = np.sum(change * expected, axis=0) / np.maximum(power, np.finfo(float).tiny)
    misfit = float(_rms(_rms(change - gain * expected) / unit))
    counts = np.sqrt(power / len(change)) > MIN_SHARE * _rms(points.channels - points.channels.mean(axis=0))
    deviating = np.flatnonzero(counts & (np.abs(gain - 1.0) > MIN_GAIN_ERROR))
    if misfit > SAME_MISFIT or not len(deviating):
        return None
    sigma = _rms(change - gain * expected) / np.sqrt(np.maximum(power, np.finfo(float).tiny))
    used = np.unique(points.load_series[points.weight > 0]).tolist()
    words = [fit.model.load_series[used.index(name)] for name in np.unique(points.load_series[rows]).tolist()]
    channels = [
        SuspectLoadSeries(name, points.channel_names[c], float(gain[c]), float(sigma[c]), "")
        for name in words
        for c in deviating.tolist()
    ]
    return Exclusion(rows, channels)


def _moved(points: CalibrationPoints, rows: Mask) -> Mask:
    """Return which loads (k,) change in some rows (m,)."""
    return np.asarray(np.ptp(points.x[rows], axis=0) > MIN_LOAD_CHANGE)


def _centered(points: CalibrationPoints, rows: Mask, values: Array) -> Array:
    """Return values (r, c) of some rows (m,) less their mean in each load series."""
    own, series = values[rows].copy(), points.load_series[rows]
    for name in np.unique(series).tolist():
        own[series == name] -= own[series == name].mean(axis=0)
    return own


def _rms(values: Array) -> Array:
    return np.asarray(np.sqrt(np.nanmean(values**2, axis=0)))
