"""The covariance of lines of repeated spectra: that of their neighborhood times a factor for each line."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from balance_cli.signals.covariance_pooling import PooledCovariance, mean_distances, outlier_bound, pooled_covariance

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Counts = NDArray[np.intp]

INFLATION_PROBABILITY = 1e-4
"""Probability with which noise alone exceeds the bound from which a line has its own, larger covariance."""


@dataclass(frozen=True)
class LineCovariance:
    """Covariance of n signals at K lines: `pooled` over neighboring lines, times a `factor` (K,) of each line."""

    pooled: PooledCovariance
    factor: Array

    @property
    def dof(self) -> float:
        """Complex degrees of freedom of the pooled covariance."""
        return self.pooled.dof

    @property
    def variance(self) -> Array:
        """The variances (K, n) of the signals."""
        return np.diagonal(self.pooled.knots, axis1=1, axis2=2).real[self.pooled.nearest] * self.factor[:, None]

    def scaled(self, factor: Array) -> LineCovariance:
        """Return the covariance times a further factor (K,)."""
        return replace(self, factor=self.factor * factor)

    def at(self, lines: NDArray[np.bool_], signals: Counts) -> ComplexArray:
        """Return the covariance (k, s, s) of some signals at some lines, given as a mask (K,)."""
        knots = self.pooled.knots[:, signals[:, None], signals]
        return np.asarray(knots[self.pooled.nearest[lines]] * self.factor[lines, None, None])


def pool_scatter(deviations: ComplexArray, counts: Array, floor: Array) -> LineCovariance:
    """Return the covariance of one period from deviations (K, v, n); larger where a line scatters unlike its neighbors.

    `counts` (K,) are the degrees of freedom of the deviations of a line, `floor` (n,) is added to the variances.
    """
    pooled = pooled_covariance(deviations, counts, floor=floor)
    distance = mean_distances(pooled, deviations, counts)
    improbable = distance > outlier_bound(counts, deviations.shape[2], INFLATION_PROBABILITY)
    return LineCovariance(pooled, np.where(improbable, distance, 1.0))
