"""Covariance by which redundant channels are weighted, where few rows tell the correlation of their residuals.

Weights from a covariance of n degrees of freedom have (n - 1)/(n - r - 1) times the variance of the best ones with r
redundant channels, and none exist for fewer degrees of freedom than channels. Correlations are therefore shrunk by what
chance makes of them (Schäfer and Strimmer, Stat. Appl. Genet. Mol. Biol. 4, 2005, 32):
those of unlike channels remain, and those that chance explains give way to weights by the variances alone. Variances of
few degrees of freedom are themselves moved toward what the channels have in common, by as much as their scatter tells
(empirical Bayes: Smyth, Stat. Appl. Genet. Mol. Biol. 3, 2004, 3).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

MAX_MODERATED_DOF = 30.0
"""Degrees of freedom beyond which variances are taken as they are: weights then lose 2 % by their errors at most."""
PRIOR_DOF = np.geomspace(1.0, 1e4, 500)
"""Degrees of freedom that a common variance may be worth, in steps of 2 %; for unlike units it is less than one."""


def correlation_shrinkage(covariance: Array, dof: float) -> float:
    """Share of the correlations of a covariance (c, c) that chance explains, of which 1 less this share is kept.

    The variance of a correlation r with n degrees of freedom is (1 - r^2)^2/n. 0 where n is not known.
    """
    if not (np.isfinite(dof) and dof > 0 and np.isfinite(covariance).all()):
        return 0.0
    sigma = np.sqrt(np.maximum(np.diag(covariance), np.finfo(float).tiny))
    others = (covariance / sigma[:, None] / sigma)[~np.eye(len(covariance), dtype=bool)]
    by_chance = float(np.sum((1.0 - np.minimum(others**2, 1.0)) ** 2)) / dof
    squares = float(np.sum(others**2))
    # Few rows make correlations of 1, whose variance seems to be 0: of a single one nothing is known.
    return max(by_chance / squares, min(1.0, 1.0 / dof)) if by_chance < squares else 1.0


def weight_covariance(covariance: Array, dof: float) -> Array:
    """Covariance (c, c) with its variances moderated, and its correlations shrunk by their `correlation_shrinkage`."""
    weight = 1.0 - correlation_shrinkage(covariance, dof)
    variances = np.diag(covariance)
    growth = np.sqrt(moderated_variances(variances, dof) / np.where(variances > 0.0, variances, 1.0))
    shrunk = weight * covariance + (1.0 - weight) * np.diag(variances)
    return np.asarray(shrunk * growth[:, None] * growth)


def moderated_variances(variances: Array, dof: float) -> Array:
    """Variances (c,) of n = `dof` moved toward a common one that is worth d degrees of freedom.

    The logarithm of an estimate has the variance trigamma(n/2) by chance; what they scatter by beyond it is
    trigamma(d/2). Channels of unlike noise scatter more, d is small, and their variances remain.
    """
    from scipy.special import psi

    d = _dof_of_common_variance(variances, dof)
    if d == 0.0:
        return variances
    if np.isinf(d):
        return np.full(len(variances), np.mean(variances))
    bias = psi(0.5 * dof) - np.log(0.5 * dof) - psi(0.5 * d) + np.log(0.5 * d)
    common = float(np.exp(np.mean(np.log(variances)) - bias))
    return np.asarray((d * common + dof * variances) / (d + dof))


def _dof_of_common_variance(variances: Array, dof: float) -> float:
    """Degrees of freedom d that a common variance is worth: infinite where the estimates scatter by chance alone."""
    is_few = np.isfinite(dof) and 0.0 < dof <= MAX_MODERATED_DOF
    if not is_few or len(variances) < 3 or not np.all(np.isfinite(variances) & (variances > 0.0)):
        return 0.0
    from scipy.special import polygamma

    excess = float(np.var(np.log(variances), ddof=1) - polygamma(1, 0.5 * dof))
    if excess <= 0.0:
        return float("inf")
    if excess > polygamma(1, 0.5 * PRIOR_DOF[0]):
        return 0.0
    return float(PRIOR_DOF[np.argmin(np.abs(np.log(polygamma(1, 0.5 * PRIOR_DOF) / excess)))])


def weight_widening(covariance: Array, dof: float, redundancy: int) -> float:
    """Factor on the variance of loads whose weights and noise come from one covariance (c, c) with n = `dof`.

    With r redundant channels the weights make the least of the covariance that they were estimated from: it tells
    (n - r)/n of the variance of the best weights, and theirs is (n - 1)/(n - r - 1) times as large (Rao, Proc. 5th
    Berkeley Symp. 1, 1967, 355). Of shrunk correlations the part that is kept counts as so many redundant channels;
    weights by the variances need the factor 1 + 4 r/(c n) (Meier, Biometrics 9, 1953, 59), the second term times the
    share that they have of the moderated ones. 1 where dof is not known; the widening ends at the least n for which it
    is finite.
    """
    if not np.isfinite(dof) or redundancy <= 0:
        return 1.0
    shrinkage = correlation_shrinkage(covariance, dof)
    r = (1.0 - shrinkage) * redundancy
    n = max(dof, r + 2.0)
    own_share = n / (n + _dof_of_common_variance(np.diag(covariance), dof))
    by_variances = 1.0 + 4.0 * shrinkage * redundancy * own_share / (len(covariance) * n)
    return float(by_variances * n * (n - 1.0) / ((n - r) * (n - r - 1.0)))
