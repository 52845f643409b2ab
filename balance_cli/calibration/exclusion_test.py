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
UNUSUAL_SCATTER_P_VALUE = 0.05
"""P-value below which a load series scatters more than the others: then it is judged by itself, with its few rows."""
MIN_OTHER_SERIES = 4
"""Other load series from which the scatter of their variances is known to a factor of two or so."""
SCATTER_DOF = np.geomspace(0.1, 1e3, 300)
"""Degrees of freedom that the usual variance of a load series may be worth, in steps of 3 %."""
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
        rows = members & excluded
        channel = int(np.argmin(gain.p_values(rows, gain.variance, gain.dof)))
        own = _own_scatter(included, fit, others, gain)
        by_series = gain.p_values(rows, np.maximum(own[0], gain.variance), own[1])[channel]
        if by_series * np.count_nonzero(members) > SERIES_SIGNIFICANCE_LEVEL:
            chance |= rows
    return chance


def _own_scatter(points: CalibrationPoints, fit: CalibrationModelFit, others: Mask, gain: _Gain) -> tuple[Array, Array]:
    """Variance (c,) of a load series of rows `others` (m,), and its degrees of freedom (c,).

    Few rows tell it hardly: unless it exceeds that of the other load series by more than chance, it is moved toward it.
    """
    series = points.load_series == points.load_series[np.argmax(others)]
    usual, worth = _scatter_of_others(points, fit, ~series)
    dof = float(np.count_nonzero(others) - SERIES_PARAMETERS)
    own, own_dof = _square_sums(points, fit, others) / dof, np.full(len(gain.dof), dof)
    if worth == 0.0:
        return own, own_dof
    if np.isinf(worth):
        moderated, moderated_dof = usual, gain.dof
    else:
        moderated, moderated_dof = (worth * usual + dof * own) / (worth + dof), np.minimum(worth + dof, gain.dof)
    larger = stats.f.sf(own / usual, dof, np.minimum(max(worth, dof), gain.dof)) < UNUSUAL_SCATTER_P_VALUE
    return np.where(larger, own, moderated), np.where(larger, own_dof, moderated_dof)


def _scatter_of_others(points: CalibrationPoints, fit: CalibrationModelFit, rows: Mask) -> tuple[Array, float]:
    """Usual variance (c,) of the load series in some rows (m,), and the degrees of freedom that it is worth.

    Empirical Bayes (Smyth, Stat. Appl. Genet. Mol. Biol. 3, 2004, 3): the logarithms of the variances scatter by
    trigamma(n/2) by chance, and by trigamma(d/2) beyond it. Infinite where chance explains them; 0 for too few series.
    """
    from scipy.special import polygamma, psi

    logs, half_dof = [], []
    for series in np.unique(points.load_series[rows]).tolist():
        members = rows & (points.load_series == series) & (points.weight > 0)
        dof = float(np.count_nonzero(members) - SERIES_PARAMETERS)
        squares = _square_sums(points, fit, members)
        if dof >= 1.0 and np.all(squares > 0.0):
            logs.append(np.log(squares / dof) - psi(0.5 * dof) + np.log(0.5 * dof))
            half_dof.append(0.5 * dof)
    if len(logs) < MIN_OTHER_SERIES:
        return np.ones(points.channels.shape[1]), 0.0
    excess = float(np.mean(np.var(logs, axis=0, ddof=1)) - np.mean(polygamma(1, half_dof)))
    if excess <= 0.0:
        return np.exp(np.mean(logs, axis=0)), float("inf")
    worth = float(SCATTER_DOF[np.argmin(np.abs(np.log(polygamma(1, 0.5 * SCATTER_DOF) / excess)))])
    return np.exp(np.mean(logs, axis=0) + psi(0.5 * worth) - np.log(0.5 * worth)), worth


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
        """P-value (c,) of the mean shift of some rows (m,) among errors of a variance (c,) with `dof` (c,)."""
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
