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
FINEST_RESOLUTION = 1e-7
"""Of the range of a channel: finer steps are beyond any converter."""


def is_beyond_chance(
    points: CalibrationPoints, included: CalibrationPoints, fit: CalibrationModelFit, excluded: Mask
) -> bool:
    """Whether the `fit` of the included rows is better without the excluded rows (m,) than chance explains."""
    k = int(np.count_nonzero(excluded))
    with_them = replace(included, weight=np.where(excluded, points.weight, included.weight))
    before = _square_sums(with_them, refit_terms(with_them, fit.model))
    dof = np.maximum(fit.model.dof, 1.0)
    rounding = dof * float(np.mean(included.weight[included.weight > 0])) * _resolution(with_them) ** 2 / 12.0
    after = np.maximum(_square_sums(included, fit), np.maximum(rounding, np.finfo(float).tiny))
    before = np.maximum(before, after)
    p = stats.f.sf((before - after) / k / (after / dof), float(k), dof)
    n = int(np.count_nonzero(with_them.weight > 0))
    tests = np.log(len(p)) + gammaln(n + 1) - gammaln(k + 1) - gammaln(n - k + 1)
    least = max(float(np.min(p)), np.finfo(float).tiny)
    return bool(np.log(least) + tests <= np.log(OUTLIER_SIGNIFICANCE_LEVEL))


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


def _square_sums(points: CalibrationPoints, fit: CalibrationModelFit) -> Array:
    """Weighted sum of the squared residuals of each channel (c,)."""
    return np.asarray(np.nansum(points.weight[:, None] * fit.residuals**2, axis=0))
