"""Channels whose gain rises or falls from calibration to calibration, as an amplifier or a supply that ages.

A drift of single coefficients is judged by the scatter of each about its line, of two degrees of freedom in four
calibrations. The gain of a channel for all loads together is known better, and the gains of all channels tell how much
they scatter from one calibration to the next.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.signals import distributions as stats

Array = NDArray[np.float64]

MIN_CALIBRATIONS = 3
"""Calibrations that a line with a residual needs."""
SIGNIFICANCE_LEVEL = 0.01
"""Probability that any channel of an unchanged balance is named (Bonferroni over the channels)."""


@dataclass(frozen=True)
class GainTrend:
    """Change of the gain of a channel a calibration, relative to its mean, with its standard error and p-value."""

    channel: str
    slope: float
    sigma: float
    p_value: float
    calibrations: int

    @property
    def sentence(self) -> str:
        """The trend in words."""
        whole = 100.0 * self.slope * (self.calibrations - 1)
        return (
            f"{self.channel}: its gain for all loads {'rises' if self.slope > 0.0 else 'falls'} by "
            f"{100.0 * abs(self.slope):.2g} % a calibration, {whole:+.2g} % over all {self.calibrations} "
            f"(p {self.p_value:.2g}): its amplifier, supply or gauge changes"
        )


def gain_trends(channels: Sequence[str], values: Array, variances: Array) -> tuple[GainTrend, ...]:
    """Return the channels with a significant trend of their gain, the most significant first.

    `values` and `variances` (n, k, c): coefficients of k loads in n calibrations. None with fewer than three of them,
    or where their errors are not known.
    """
    n, _, c = values.shape
    if n < MIN_CALIBRATIONS or not np.isfinite(variances).all() or not np.all(np.any(variances > 0.0, axis=1)):
        return ()
    gains, sigma = _gains(values, variances)
    time = np.arange(n) - 0.5 * (n - 1)
    slope = time @ gains / float(time @ time)
    left = gains - gains.mean(axis=0) - np.outer(time, slope)
    own = np.sum(left**2, axis=0) / (n - 2)
    pooled = float(np.mean(own))
    error = np.sqrt(np.maximum(np.maximum(own, pooled), sigma**2) / float(time @ time))
    p_values = 2.0 * stats.t.sf(np.abs(slope) / np.maximum(error, np.finfo(float).tiny), c * (n - 2))
    named = [place for place in np.argsort(p_values).tolist() if p_values[place] < SIGNIFICANCE_LEVEL / c]
    return tuple(
        GainTrend(channels[place], float(slope[place]), float(error[place]), float(p_values[place]), n)
        for place in named
    )


def _gains(values: Array, variances: Array) -> tuple[Array, Array]:
    """Gains (n, c) of the channels for all loads, relative to their mean coefficients, and standard errors (c,)."""
    mean = values.mean(axis=0)
    weight = mean / np.maximum(variances.mean(axis=0), np.finfo(float).tiny)
    power = np.maximum(np.sum(weight * mean, axis=0), np.finfo(float).tiny)
    return np.asarray(np.sum(weight * values, axis=1) / power), np.asarray(1.0 / np.sqrt(power))
