"""Significance levels and p-values, with noise that was itself measured."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from balance_cli.signals.covariance_pooling import MIN_DOF_PER_SIGNAL, inverse_bias_factor

Array = NDArray[np.float64]

DATA_TEST_LEVEL = 1e-3
"""p-value of a row of the data tests below which it has a finding: with a hundred rows, one campaign in ten has one."""
MIN_F_DOF = 5.0
"""Smallest noise degrees of freedom that are used: the variance of F exists above 4."""
KNOWN_NOISE_DOF = 1e12
"""Degrees of freedom that stand for a noise known exactly."""


# ---- gain of candidates ----------------------------------------------------------------------------------------------


def gain_p_value(gain: float, parameters: int, noise_dof: float = np.inf) -> float:
    """Return the p-value of a decrease of chi-square by `gain` for one candidate with this number of parameters.

    With a noise known to `noise_dof` degrees of freedom, gain / parameters has an F distribution.
    """
    from balance_cli.signals.distributions import chi2, f

    if not parameters:
        return 1.0
    if not np.isfinite(noise_dof):
        return float(chi2.sf(gain, parameters))
    return float(f.sf(gain / parameters, parameters, noise_dof))


def bonferroni_p_value(gain: float, parameters: int, count: float, noise_dof: float = np.inf) -> float:
    """Return the p-value of the best gain among `count` candidates (Bonferroni)."""
    return min(1.0, count * gain_p_value(gain, parameters, noise_dof))


# ---- tests of the data -----------------------------------------------------------------------------------------------


def chi2_p_value(chi2: float, counts: Sequence[float], noise_dof: Sequence[float]) -> float:
    """Return the p-value of a sum of chi-squares of `counts` degrees of freedom, each with a noise of `noise_dof`.

    Each part is an F variable times its count, free of its bias, with variance 2 n (n + d - 2) / (d - 4). Their sum is
    approximated by a chi-square of the same mean and variance (Satterthwaite, Biometrics Bull. 2 (1946) 110). All lines
    of a run are assumed to share one estimate of the noise. In fact there are more, since the estimate follows the
    noise spectrum, so that the p-value is on the safe side.
    """
    from balance_cli.signals.distributions import chi2 as distribution

    n = np.asarray(counts, float)
    d = np.maximum(np.asarray(noise_dof, float), MIN_F_DOF)
    mean = float(n.sum())
    if mean == 0.0:
        return 1.0
    finite = np.where(np.isfinite(d), d, KNOWN_NOISE_DOF)
    variance = float(np.sum(2.0 * n * np.maximum(n + finite - 2.0, 1.0) / (finite - 4.0)))
    scale = variance / (2.0 * mean)
    return float(distribution.sf(chi2 / scale, mean / scale))


def hotelling_p_value(t2: float, count: int, dof: float) -> float:
    """Return the p-value of Hotelling's T^2 of `count` values whose covariance has `dof` degrees of freedom."""
    from balance_cli.signals.distributions import f

    free = max(dof - count + 1.0, 1.0)
    return float(f.sf(t2 * free / (dof * count), count, free))


def variance_ratio_p_values(ratio: Array, count: Array, noise_count: Array) -> Array:
    """Return the p-values of sums of `count` squares over the mean of `noise_count` others (F distribution)."""
    from balance_cli.signals.distributions import f

    n = np.maximum(count, 1.0)
    return np.asarray(f.sf(ratio / n, n, np.maximum(noise_count, 1.0)))


def fisher_p_values(statistic: Array, count: Array) -> Array:
    """Return the p-values of sums of -2 ln p over `count` tests (Fisher's method); 1 where there is none."""
    from balance_cli.signals.distributions import chi2

    return np.asarray(np.where(count > 0, chi2.sf(statistic, np.maximum(2.0 * count, 1.0)), 1.0))


def bonferroni_min_p_value(p_values: Iterable[float]) -> float:
    """Return the smallest of several p-values, corrected for their number (Bonferroni); 1 where there is none."""
    values = list(p_values)
    return min(1.0, len(values) * min(values)) if values else 1.0


# ---- measured noise --------------------------------------------------------------------------------------------------


def noise_factor(dof: float, signals: int) -> float:
    """Return the factor that removes the bias of a chi-square with an inverted covariance of `signals` signals.

    `dof` counts the complex samples of the covariance.
    """
    return inverse_bias_factor(max(dof, signals + 1.0), signals)


def is_invertible(dof: float, signals: int) -> bool:
    """Return whether a covariance is known well enough to be inverted. Otherwise its variances are used."""
    return dof > MIN_DOF_PER_SIGNAL * signals


def combined_dof(shares: Sequence[float], dof: Sequence[float]) -> float:
    """Return the degrees of freedom of a sum of covariances, from the `dof` of each and its share in the sum."""
    inverse = sum(share**2 / max(d, 1.0) for share, d in zip(shares, dof, strict=True))
    return 1.0 / inverse if inverse > 0 else np.inf


def format_with_sigma(value: float, sigma: float, unit: str = "") -> str:
    """Return `0.600 +/- 0.004 ms`, with as many digits as give sigma two of them."""
    if not (np.isfinite(sigma) and sigma > 0):
        return f"{value:.3g} {unit}".strip()
    digits = max(0, 1 - int(np.floor(np.log10(sigma))))
    return f"{value:.{digits}f} +/- {sigma:.{digits}f} {unit}".strip()
