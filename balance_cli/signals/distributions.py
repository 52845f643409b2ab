"""Tails and quantiles of the distributions that the tests use, by `scipy.special`.

`scipy.stats` has them too, but its import takes longer than the reduction of a run. Names follow `scipy.stats`:
`sf` is the survival function, `isf` its inverse, `ppf` the quantile.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import special

Array = NDArray[np.float64]
Numbers = float | Array

CONFIDENCE = 0.95
"""Probability that a load lies within its interval: the usual level of balance calibrations."""


def _positive(x: Numbers) -> Array:
    """Return x, with 0 in place of what lies below the support (its survival function is 1)."""
    return np.asarray(np.maximum(x, 0.0))


class norm:  # noqa: N801
    """Standard normal distribution."""

    @staticmethod
    def sf(x: Numbers) -> Array:
        """Return the probability of more than x."""
        return np.asarray(special.ndtr(-np.asarray(x, float)))

    @staticmethod
    def isf(p: Numbers) -> Array:
        """Return the value that is exceeded with probability p."""
        return np.asarray(-special.ndtri(p))

    @staticmethod
    def ppf(p: Numbers) -> Array:
        """Return the value below which the probability is p."""
        return np.asarray(special.ndtri(p))


class chi2:  # noqa: N801
    """Chi-square distribution with `dof` degrees of freedom."""

    @staticmethod
    def sf(x: Numbers, dof: Numbers) -> Array:
        """Return the probability of more than x."""
        return np.asarray(special.chdtrc(dof, _positive(x)))

    @staticmethod
    def isf(p: Numbers, dof: Numbers) -> Array:
        """Return the value that is exceeded with probability p."""
        return np.asarray(special.chdtri(dof, p))

    @staticmethod
    def ppf(p: Numbers, dof: Numbers) -> Array:
        """Return the value below which the probability is p."""
        return np.asarray(2.0 * special.gammaincinv(0.5 * np.asarray(dof, float), p))


class f:  # noqa: N801
    """F distribution with `numerator` and `denominator` degrees of freedom.

    x = b (1 - z) / (a z), where z has a beta distribution (b / 2, a / 2) (Abramowitz and Stegun 26.6.2).
    """

    @staticmethod
    def sf(x: Numbers, numerator: Numbers, denominator: Numbers) -> Array:
        """Return the probability of more than x."""
        return np.asarray(special.fdtrc(numerator, denominator, _positive(x)))

    @staticmethod
    def isf(p: Numbers, numerator: Numbers, denominator: Numbers) -> Array:
        """Return the value that is exceeded with probability p."""
        a, b = np.asarray(numerator, float), np.asarray(denominator, float)
        z = special.betaincinv(0.5 * b, 0.5 * a, p)
        return np.asarray(b * (1.0 - z) / (a * z))

    @staticmethod
    def ppf(p: Numbers, numerator: Numbers, denominator: Numbers) -> Array:
        """Return the value below which the probability is p."""
        a, b = np.asarray(numerator, float), np.asarray(denominator, float)
        y = special.betaincinv(0.5 * a, 0.5 * b, p)
        return np.asarray(b * y / (a * (1.0 - y)))


class t:  # noqa: N801
    """Student's t distribution with `dof` degrees of freedom."""

    @staticmethod
    def sf(x: Numbers, dof: Numbers) -> Array:
        """Return the probability of more than x."""
        return np.asarray(special.stdtr(dof, -np.asarray(x, float)))

    @staticmethod
    def isf(p: Numbers, dof: Numbers) -> Array:
        """Return the value that is exceeded with probability p."""
        return np.asarray(-special.stdtrit(dof, p))

    @staticmethod
    def ppf(p: Numbers, dof: Numbers) -> Array:
        """Return the value below which the probability is p."""
        return np.asarray(special.stdtrit(dof, p))


class poisson:  # noqa: N801
    """Poisson distribution of the mean `mean`."""

    @staticmethod
    def ppf(p: Numbers, mean: Numbers) -> Array:
        """Return the least count that is not exceeded with probability p or more."""
        count = np.ceil(np.maximum(special.pdtrik(p, mean), 0.0))
        below = np.maximum(count - 1.0, 0.0)
        return np.asarray(np.where(special.pdtr(below, mean) >= p, below, count))


class binom:  # noqa: N801
    """Binomial distribution of successes in `trials` of the probability `success`."""

    @staticmethod
    def cdf(count: Numbers, trials: Numbers, success: Numbers) -> Array:
        """Return the probability of `count` successes or fewer."""
        return np.asarray(special.bdtr(count, trials, success))


def student_widening(dof: Numbers) -> Array:
    """Return the factor on variances estimated with `dof` degrees of freedom by which 1.96 sigma cover 95 %.

    The ratio of the 97.5 % points of Student's t and of the normal distribution, squared; 1 where dof is not known.
    """
    is_known = np.isfinite(dof) & (np.asarray(dof) > 0)
    level = 0.5 + 0.5 * CONFIDENCE
    return np.where(is_known, (t.ppf(level, np.where(is_known, dof, 1.0)) / norm.ppf(level)) ** 2, 1.0)
