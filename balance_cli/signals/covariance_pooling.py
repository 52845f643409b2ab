"""Noise of repeated spectra: pooled over neighbouring lines, robust against lines that hold more than noise."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Counts = NDArray[np.intp]

LEAST_POOLED_DOF = 150
OUTLIER_PROBABILITY = 1e-3
STEPS_PER_WINDOW = 8
ROBUST_ITERATIONS = 3
MEDIAN_LINES = 75
RELATIVE_NOISE_FLOOR = 1e-7


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


def window_sums(values: NDArray[Any], width: int, step: int = 1) -> NDArray[Any]:
    """Sums of `width` neighbouring entries along axis 0; at the edges the window stays whole and is shifted inwards.

    values (K, ...); the result holds, for every `step`-th k, the sum over the window centred on k where it fits.
    """
    K = len(values)
    width = min(width, K)
    total = np.concatenate([np.zeros_like(values[:1]), np.cumsum(values, axis=0)])
    start = np.clip(np.arange(0, K, step) - width // 2, 0, K - width)
    return np.asarray(total[start + width] - total[start])


def variance_floor(spectra: ComplexArray) -> Array:
    """Variance (n,) that no noise of signals (..., n) is taken to fall below: rounding to single precision, say.

    A computed record has no noise at all, and its covariance no inverse.
    """
    power = np.mean(np.abs(spectra) ** 2, axis=tuple(range(spectra.ndim - 1)))
    return np.asarray(
        RELATIVE_NOISE_FLOOR**2 * np.maximum(power, RELATIVE_NOISE_FLOOR * power.max()) + np.finfo(float).tiny, float
    )


def pooled_covariance(
    scatter: ComplexArray, counts: Array, least_dof: float = LEAST_POOLED_DOF, floor: Array | float = 0.0
) -> tuple[ComplexArray, float]:
    """Noise covariance of one degree of freedom at every line, pooled over neighbouring lines.

    scatter (K, n, n): sum of outer products of deviations at each line, with counts (K,) complex degrees of freedom.
    The window is the narrowest that gives `least_dof` everywhere (or all lines), so that the covariance follows the
    colour of the noise and still can be inverted. Lines whose scatter is improbably large (residual transients,
    pick-up) are down-weighted (Huber's weights on the Mahalanobis distance). `floor` (n,) or one number is added to
    the variances. Returns (K, n, n) and the dof.
    """
    scatter = scatter + counts[:, None, None] * (floor * np.eye(scatter.shape[1]))
    width = _pooling_width(counts, least_dof)
    dof = float(np.median(window_sums(counts, width)))
    step = max(width // STEPS_PER_WINDOW, 1)
    nearest = np.minimum((np.arange(len(counts)) + step // 2) // step, (len(counts) - 1) // step)
    weights = _initial_weights(scatter, counts)
    for _ in range(ROBUST_ITERATIONS):
        total = np.maximum(window_sums(weights * counts, width, step), 1e-300)
        knots = window_sums(weights[:, None, None] * scatter, width, step) / total[:, None, None]
        far = _distances_from_inverse(scatter, np.linalg.inv(knots)[nearest], counts, dof)
        weights = np.minimum(1.0, outlier_bound(counts, scatter.shape[1]) / far)
    return knots[nearest], dof


def mahalanobis_distances(scatter: ComplexArray, covariance: ComplexArray, counts: Array, dof: float) -> Array:
    """Mahalanobis distance per degree of freedom (K,) of the scatter (K, n, n); its mean is 1 for noise alone."""
    return _distances_from_inverse(scatter, np.asarray(np.linalg.inv(covariance), complex), counts, dof)


def _distances_from_inverse(scatter: ComplexArray, inverse: ComplexArray, counts: Array, dof: float) -> Array:
    n = scatter.shape[1]
    trace = np.einsum("kij,kji->k", inverse, scatter).real
    return np.asarray(
        np.maximum(trace / (n * np.maximum(counts, 1e-12)) * inverse_bias_factor(max(dof, n + 1), n), 1e-300), float
    )


def vector_mahalanobis_distances(vectors: ComplexArray, covariance: ComplexArray, dof: float) -> Array:
    """Mahalanobis distance per degree of freedom (..., K) of vectors (..., K, n); its mean is 1 for noise alone."""
    n = vectors.shape[-1]
    weighted = np.matmul(np.linalg.inv(covariance), vectors[..., None])[..., 0]
    squared = np.sum(vectors.conj() * weighted, axis=-1).real
    return np.asarray(squared / n * inverse_bias_factor(max(dof, n + 1), n), float)


def outlier_bound(counts: Array, n: int, probability: float = OUTLIER_PROBABILITY) -> Array:
    """Distance (K,) that noise of n signals exceeds with this probability at one line (chi-square)."""
    from scipy.special import gammainccinv

    half = n * np.maximum(counts, 1.0)
    return np.asarray(gammainccinv(half, probability) / half)


def _pooling_width(counts: Array, least_dof: float) -> int:
    """Narrowest odd number of lines that gives `least_dof` at every line (by bisection), or all of them."""
    low, high = 0, (len(counts) - 1) // 2
    while low < high:
        middle = (low + high) // 2
        enough = np.min(window_sums(counts, 2 * middle + 1)) >= least_dof
        low, high = (low, middle) if enough else (middle + 1, high)
    return 2 * low + 1


def _initial_weights(scatter: ComplexArray, counts: Array) -> Array:
    """Weights from the diagonal alone: each signal's power at a line against the median of its neighbours."""
    power = np.diagonal(scatter, axis1=1, axis2=2).real / np.maximum(counts, 1e-12)[:, None]
    blocks = np.array_split(np.arange(len(power)), max(len(power) // MEDIAN_LINES, 1))
    typical = np.concatenate([np.broadcast_to(np.median(power[b], axis=0), power[b].shape) for b in blocks])
    largest = np.max(power / np.maximum(typical, 1e-300), axis=1)
    return np.asarray(np.minimum(1.0, 20.0 / np.maximum(largest, 1e-300)), float)
