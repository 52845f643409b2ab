"""Noise of repeated spectra: pooled over neighbouring lines, robust against lines that hold more than noise."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Counts = NDArray[np.intp]

LEAST_DOF = 150
OUTLIER_PROBABILITY = 1e-3


def inverse_bias_factor(dof: float, n: int) -> float:
    """(dof - n) / dof, by which the inverse of an estimated covariance of n signals must be multiplied.

    A sample covariance with `dof` complex degrees of freedom is complex Wishart; the mean of its inverse is
    dof / (dof - n) times the true inverse (Maiwald and Kraus, IEE Proc. Radar 147, 2000). Without the factor every
    chi-square weighted by the estimated covariance comes out too large. ValueError where dof <= n.
    """
    if np.isinf(dof):
        return 1.0
    if dof <= n:
        raise ValueError(f"a covariance of {n} signals from {dof:g} degrees of freedom has no inverse")
    return (dof - n) / dof


def window_sums(values: NDArray[np.generic], width: int) -> NDArray[np.generic]:
    """Sums of `width` neighbouring entries along axis 0; at the edges the window stays whole and is shifted inwards.

    values (K, ...), result (K, ...): entry k holds the sum over the window centred on k where it fits.
    """
    K = len(values)
    width = min(width, K)
    total = np.concatenate([np.zeros_like(values[:1]), np.cumsum(values, axis=0)])
    start = np.clip(np.arange(K) - width // 2, 0, K - width)
    return np.asarray(total[start + width] - total[start])


def pooled_covariance(scatter: ComplexArray, counts: Array, least_dof: float = LEAST_DOF) -> tuple[ComplexArray, float]:
    """Noise covariance of one period at every line, pooled over neighbouring lines.

    scatter (K, n, n): sum of outer products of deviations at each line, with counts (K,) complex degrees of freedom.
    The window is the narrowest that gives `least_dof` everywhere (or all lines), so that the covariance follows the
    colour of the noise and still can be inverted. Lines whose scatter is improbably large (residual transients,
    pick-up) are down-weighted (Huber's weights on the Mahalanobis distance). Returns (K, n, n) and the dof.
    """
    width = _window(counts, least_dof)
    dof = _least_sum(counts, width)
    weights = _first_weights(scatter, counts)
    covariance = scatter
    for _ in range(4):
        total = np.maximum(window_sums(weights * counts, width).real, 1e-300)
        covariance = window_sums(weights[:, None, None] * scatter, width) / total[:, None, None]
        weights = np.minimum(1.0, outlier_bound(counts, scatter.shape[1]) / distances(scatter, covariance, counts, dof))
    return covariance, dof


def distances(scatter: ComplexArray, covariance: ComplexArray, counts: Array, dof: float) -> Array:
    """Mahalanobis distance per degree of freedom (K,) of the scatter of each line; its mean is 1 for noise alone."""
    n = scatter.shape[1]
    trace = np.trace(np.linalg.solve(covariance, scatter), axis1=1, axis2=2).real
    return np.maximum(trace / (n * np.maximum(counts, 1)) * inverse_bias_factor(max(dof, n + 1), n), 1e-300)


def outlier_bound(counts: Array, n: int, probability: float = OUTLIER_PROBABILITY) -> Array:
    """Distance (K,) that noise of n signals exceeds with this probability at one line (chi-square)."""
    from scipy.stats import chi2

    dof = 2.0 * n * np.maximum(counts, 1)
    return np.asarray(chi2.isf(probability, dof) / dof)


def _window(counts: Array, least_dof: float) -> int:
    """Narrowest odd number of lines that gives `least_dof` at every line."""
    width = 1
    while width < len(counts) and _least_sum(counts, width) < least_dof:
        width += 2
    return min(width, len(counts))


def _least_sum(counts: Array, width: int) -> float:
    return float(np.min(window_sums(counts, width)))


def _first_weights(scatter: ComplexArray, counts: Array) -> Array:
    """Weights from the diagonal alone: each signal's power at a line against the median of its neighbours."""
    from scipy.ndimage import median_filter

    power = np.diagonal(scatter, axis1=1, axis2=2).real / np.maximum(counts, 1)[:, None]
    typical = median_filter(power, size=(min(75, len(power)), 1), mode="nearest")
    largest = np.max(power / np.maximum(typical, 1e-300), axis=1)
    return np.minimum(1.0, 20.0 / np.maximum(largest, 1e-300))
