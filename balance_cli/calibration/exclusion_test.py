"""Whether rows that were excluded as outliers are more than the rows that happen to fit worst.

Of a few rows some always lie on a line by chance. Without the others the residual is then small, and the others seem to
be many standard deviations away. The mean-shift test of the excluded rows together, corrected for the number of sets of
rows among which they were found, allows for that (Cook and Weisberg, Residuals and Influence in Regression, 1982,
section 2.2.2).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln

from balance_cli.calibration.fit import CalibrationModelFit, CalibrationPoints, refit_terms
from balance_cli.calibration.robust_fit import OUTLIER_SIGNIFICANCE_LEVEL
from balance_cli.signals import distributions as stats

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

COARSEST_RESOLUTION = 1e-2
"""Of the range of a channel: in coarser steps no display reads, and computed readings are round numbers by design."""
SERIES_SIGNIFICANCE_LEVEL = 0.05
"""Probability that the worst row of a load series stands out so far among its others, whose scatter few rows tell."""
SERIES_PARAMETERS = 2
"""Coefficients that a load series with one load alone tells: its zero and the response to that load."""
FINEST_RESOLUTION = 1e-7
"""Of the range of a channel: finer steps are beyond any converter."""


def rows_of_chance(
    points: CalibrationPoints, included: CalibrationPoints, fit: CalibrationModelFit, excluded: Mask
) -> Mask:
    """The excluded rows (m,) without which the `fit` of the included ones is no better than chance explains.

    These are all of them, or those of load series whose other rows scatter as much.
    """
    gain = _Gain(points, included, fit)
    n = int(np.count_nonzero(included.weight > 0))
    k = int(np.count_nonzero(excluded))
    p = gain.p_values(excluded, gain.variance, gain.dof)
    tests = np.log(len(p)) + gammaln(n + k + 1) - gammaln(k + 1) - gammaln(n + 1)
    if np.log(max(float(np.min(p)), np.finfo(float).tiny)) + tests > np.log(OUTLIER_SIGNIFICANCE_LEVEL):
        return excluded
    chance = np.zeros_like(excluded)
    for series in np.unique(points.load_series[excluded]).tolist():
        members = points.load_series == series
        others = members & (included.weight > 0)
        dof = np.count_nonzero(others) - SERIES_PARAMETERS
        if dof < 1:
            continue
        own = np.maximum(_square_sums(included, fit, others) / dof, gain.variance)
        rows = members & excluded
        channel = int(np.argmin(gain.p_values(rows, gain.variance, gain.dof)))
        by_series = gain.p_values(rows, own, np.full(len(own), float(dof)))[channel]
        if by_series * np.count_nonzero(members) > SERIES_SIGNIFICANCE_LEVEL:
            chance |= rows
    return chance


class _Gain:
    """What a fit gains by leaving rows out: `variance` (c,) of its residuals with their `dof` (c,)."""

    def __init__(self, points: CalibrationPoints, included: CalibrationPoints, fit: CalibrationModelFit) -> None:
        self.points, self.included, self.fit = points, included, fit
        self.dof = np.maximum(fit.model.dof, 1.0)
        used = included.weight > 0
        rounding = float(np.mean(included.weight[used])) * _resolution(points) ** 2 / 12.0
        variance = _square_sums(included, fit, used) / self.dof
        self.variance = np.maximum(variance, np.maximum(rounding, np.finfo(float).tiny))

    def p_values(self, rows: Mask, variance: Array, dof: Array) -> Array:
        """P-value (c,) of the mean shift of some rows (m,) among errors of a variance (c,) with so many `dof`."""
        with_rows = replace(self.included, weight=np.where(rows, self.points.weight, self.included.weight))
        before = _square_sums(with_rows, refit_terms(with_rows, self.fit.model), with_rows.weight > 0)
        gain = np.maximum(before - _square_sums(self.included, self.fit, self.included.weight > 0), 0.0)
        k = float(np.count_nonzero(rows))
        return np.asarray(stats.f.sf(gain / k / variance, k, dof))


def _resolution(points: CalibrationPoints) -> Array:
    """Decimal step (c,) of which all readings of a channel are multiples; 0 where there is none."""
    readings = points.channels[points.weight > 0]
    step = np.zeros(readings.shape[1])
    for channel, values in enumerate(readings.T):
        spread = float(np.ptp(values))
        if spread > 0.0:
            powers = np.arange(
                np.floor(np.log10(COARSEST_RESOLUTION * spread)), np.log10(FINEST_RESOLUTION * spread), -1
            )
            fitting = (u for u in (10.0**powers).tolist() if np.all(np.abs(values / u - np.round(values / u)) < 1e-4))
            step[channel] = next(fitting, 0.0)
    return step


def _square_sums(points: CalibrationPoints, fit: CalibrationModelFit, rows: Mask) -> Array:
    """Weighted sum (c,) of the squared residuals of some rows (m,)."""
    return np.asarray(np.nansum(points.weight[rows, None] * fit.residuals[rows] ** 2, axis=0))
