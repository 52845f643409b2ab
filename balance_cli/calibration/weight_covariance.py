"""Covariance by which redundant channels are weighted, where few rows tell the correlation of their residuals.

Weights from a covariance of n degrees of freedom have (n - 1)/(n - r - 1) times the variance of the best ones with r
redundant channels, and none exist for fewer degrees of freedom than channels. Correlations are therefore shrunk by what
chance makes of them (Schäfer and Strimmer, Stat. Appl. Genet. Mol. Biol. 4, 2005, 32):
those of unlike channels remain, and those that chance explains give way to weights by the variances alone.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


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
    """Covariance (c, c) with its correlations shrunk by their `correlation_shrinkage`."""
    kept = 1.0 - correlation_shrinkage(covariance, dof)
    return np.asarray(kept * covariance + (1.0 - kept) * np.diag(np.diag(covariance)))


def weight_widening(covariance: Array, dof: float, redundancy: int) -> float:
    """Factor on the variance of loads whose weights and noise come from one covariance (c, c) with n = `dof`.

    With r redundant channels the weights make the least of the covariance that they were estimated from: it tells
    (n - r)/n of the variance of the best weights, and theirs is (n - 1)/(n - r - 1) times as large (Rao, Proc. 5th
    Berkeley Symp. 1, 1967, 355). Of shrunk correlations the part that is kept counts as so many redundant channels;
    weights by the variances need the factor 1 + 4 r/(c n) (Meier, Biometrics 9, 1953, 59). 1 where dof is not known;
    the widening ends at the least n for which it is finite.
    """
    if not np.isfinite(dof) or redundancy <= 0:
        return 1.0
    shrinkage = correlation_shrinkage(covariance, dof)
    r = (1.0 - shrinkage) * redundancy
    n = max(dof, r + 2.0)
    by_variances = 1.0 + 4.0 * shrinkage * redundancy / (len(covariance) * n)
    return float(by_variances * n * (n - 1.0) / ((n - r) * (n - r - 1.0)))
