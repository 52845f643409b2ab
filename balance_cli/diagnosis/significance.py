"""Probability of a chi-square whose noise was measured, and how findings are written down."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from balance_cli.estimation.measurements import MIN_DOF_PER_SIGNAL
from balance_cli.signals.covariance_pooling import inverse_bias_factor

# Below it the variance of an F distribution does not exist.
MIN_F_DOF = 5.0


def noise_factor(dof: float, signals: int) -> float:
    """What a chi-square with an inverted covariance of `signals` signals, `dof` complex ones, must be multiplied by."""
    return inverse_bias_factor(max(dof, signals + 1.0), signals)


def is_invertible(dof: float, signals: int) -> bool:
    """Whether a covariance is known well enough to be inverted; otherwise its variances serve."""
    return dof > MIN_DOF_PER_SIGNAL * signals


def combined_dof(shares: Sequence[float], dof: Sequence[float]) -> float:
    """Degrees of freedom of a sum of covariances, each of so many `dof`, by the share that each has in it."""
    inverse = sum(share**2 / max(d, 1.0) for share, d in zip(shares, dof, strict=True))
    return 1.0 / inverse if inverse > 0 else np.inf


def chi2_p_value(chi2: float, counts: Sequence[float], noise_dof: Sequence[float]) -> float:
    """Probability of a sum of chi-squares of `counts` degrees of freedom, each against a noise of its own `noise_dof`.

    Each part is an F variable times its count, freed of its bias, with variance 2 n (n + d - 2) / (d - 4). Their sum
    is taken as a chi-square of the same mean and variance (Satterthwaite, Biometrics Bull. 2 (1946) 110). One estimate
    of the noise is held to serve all lines of a run. There are more, for it follows the noise's colour: what is
    improbable here is more so.
    """
    from scipy.stats import chi2 as distribution

    n = np.asarray(counts, float)
    d = np.maximum(np.asarray(noise_dof, float), MIN_F_DOF)
    mean = float(n.sum())
    if mean == 0.0:
        return 1.0
    finite = np.where(np.isfinite(d), d, 1e12)
    variance = float(np.sum(2.0 * n * np.maximum(n + finite - 2.0, 1.0) / (finite - 4.0)))
    scale = variance / (2.0 * mean)
    return float(distribution.sf(chi2 / scale, mean / scale))


def bonferroni_min_p_value(p_values: Iterable[float]) -> float:
    """The least of several probabilities, for one row that was looked at in as many ways (Bonferroni)."""
    looks = list(p_values)
    return min(1.0, len(looks) * min(looks)) if looks else 1.0


def format_with_sigma(value: float, sigma: float, unit: str = "") -> str:
    """`0.600 +/- 0.004 ms`: as many digits as sigma has two of."""
    if not (np.isfinite(sigma) and sigma > 0):
        return f"{value:.3g} {unit}".strip()
    digits = max(0, 1 - int(np.floor(np.log10(sigma))))
    return f"{value:.{digits}f} +/- {sigma:.{digits}f} {unit}".strip()
