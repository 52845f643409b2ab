"""Noise covariance of repeated spectra, pooled over neighboring lines, robust against lines with more than noise."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Counts = NDArray[np.intp]

LEAST_POOLED_DOF = 150
"""Complex degrees of freedom: about ten for each signal of a balance, so that the bias of the inverse is a tenth."""
OUTLIER_PROBABILITY = 1e-3
"""Probability with which noise alone exceeds the bound from which a line gets less weight (Huber)."""
STEPS_PER_WINDOW = 8
"""Covariances computed for each pooling window; a smooth noise spectrum changes little within an eighth of it."""
ROBUST_ITERATIONS = 3
"""Passes of the robust weighting; each one removes from the covariance what outliers added in the one before."""
INITIAL_POWER_LIMIT = 20.0
"""Power over the median from which a line gets less weight at first: a probability of 1e-6 for one period of noise."""
MEDIAN_LINES = 75
"""Lines whose median power is the reference of the initial weights: of three periods, LEAST_POOLED_DOF in all."""
RELATIVE_NOISE_FLOOR = 1e-7
"""Least noise, relative to the signal: the rounding error of single precision."""


def inverse_bias_factor(dof: float, n: int) -> float:
    """Return the factor (dof - n) / dof that removes the bias of the inverse of an estimated covariance of n signals.

    A sample covariance with `dof` complex degrees of freedom is complex Wishart; the mean of its inverse is
    dof / (dof - n) times the true inverse (Maiwald and Kraus, IEE Proc. Radar 147, 2000). Without the factor every
    chi-square weighted by the estimated covariance is too large. Raises ValueError where dof <= n.
    """
    if np.isinf(dof):
        return 1.0
    if dof <= n:
        raise ValueError(f"a covariance of {n} signals from {dof:g} degrees of freedom has no inverse")
    return (dof - n) / dof


def window_sums(values: NDArray[Any], width: int, step: int = 1) -> NDArray[Any]:
    """Return sums over windows of `width` entries of `values` (K, ...) along axis 0, for every `step`-th entry.

    The window is centered on its entry; at the edges it keeps its width and is shifted inward.
    """
    K = len(values)
    start = _window_starts(K, width, step)
    total = np.concatenate([np.zeros_like(values[:1]), np.cumsum(values, axis=0)])
    return np.asarray(total[start + min(width, K)] - total[start])


def _window_starts(count: int, width: int, step: int) -> NDArray[np.int64]:
    width = min(width, count)
    return np.clip(np.arange(0, count, step) - width // 2, 0, count - width)


def _weighted_sums(weights: Array, scatter: ComplexArray, width: int, step: int) -> ComplexArray:
    """Return `window_sums` of weights (K,) times scatter (K, n, n).

    The windows are few, and each is a product of its weights with rows of the scatter: a cumulative sum over all lines
    takes seven times as long.
    """
    rows = np.ascontiguousarray(scatter, complex).reshape(len(scatter), -1).view(np.float64)
    starts = _window_starts(len(scatter), width, step)
    sums = np.empty((len(starts), rows.shape[1]))
    for total, start in zip(sums, starts.tolist(), strict=True):
        np.dot(weights[start : start + width], rows[start : start + width], out=total)
    return np.asarray(sums.view(np.complex128).reshape(-1, *scatter.shape[1:]))


def variance_floor(spectra: ComplexArray) -> Array:
    """Return the least variance (n,) that is assumed for the noise of signals (..., n).

    A computed record has no noise, so that without a floor its covariance would have no inverse.
    """
    power = np.mean(np.abs(spectra) ** 2, axis=tuple(range(spectra.ndim - 1)))
    return np.asarray(
        RELATIVE_NOISE_FLOOR**2 * np.maximum(power, RELATIVE_NOISE_FLOOR * power.max()) + np.finfo(float).tiny, float
    )


def pooled_covariance(
    scatter: ComplexArray, counts: Array, least_dof: float = LEAST_POOLED_DOF, floor: Array | float = 0.0
) -> tuple[ComplexArray, float]:
    """Estimate the noise covariance of one degree of freedom at every line, pooled over neighboring lines.

    `scatter` (K, n, n) is the sum of outer products of deviations at each line, with `counts` (K,) complex degrees of
    freedom. The window is the narrowest that gives `least_dof` at every line (or holds all lines), so that the
    covariance follows the spectrum of the noise and can still be inverted. Lines whose scatter is improbably large
    (residual transients, mains interference) get less weight (Huber's weights on the Mahalanobis distance). `floor`
    (n,) or one number is added to the variances. Returns the covariance (K, n, n) and its degrees of freedom.
    """
    scatter = scatter + counts[:, None, None] * (floor * np.eye(scatter.shape[1]))
    width = _pooling_width(counts, least_dof)
    dof = float(np.median(window_sums(counts, width)))
    step = max(width // STEPS_PER_WINDOW, 1)
    nearest = np.minimum((np.arange(len(counts)) + step // 2) // step, (len(counts) - 1) // step)
    weights = _initial_weights(scatter, counts)
    for _ in range(ROBUST_ITERATIONS):
        total = np.maximum(window_sums(weights * counts, width, step), 1e-300)
        knots = _weighted_sums(weights, scatter, width, step) / total[:, None, None]
        distance = _distances_from_inverse(scatter, np.linalg.inv(knots)[nearest], counts, dof)
        weights = np.minimum(1.0, outlier_bound(counts, scatter.shape[1]) / distance)
    return knots[nearest], dof


def invert_pooled(covariance: ComplexArray) -> ComplexArray:
    """Return the inverses (K, n, n) of covariances at neighboring lines, each computed once where several are equal."""
    changed = np.ones(len(covariance), bool)
    changed[1:] = np.any(covariance[1:] != covariance[:-1], axis=(1, 2))
    return np.asarray(np.linalg.inv(covariance[changed])[np.cumsum(changed) - 1], complex)


def mahalanobis_distances(scatter: ComplexArray, covariance: ComplexArray, counts: Array, dof: float) -> Array:
    """Return the Mahalanobis distance per degree of freedom (K,) of the scatter (K, n, n), of mean 1 for noise."""
    return _distances_from_inverse(scatter, invert_pooled(covariance), counts, dof)


def _distances_from_inverse(scatter: ComplexArray, inverse: ComplexArray, counts: Array, dof: float) -> Array:
    n = scatter.shape[1]
    # Both are Hermitian: the trace of their product is the sum of products of their real and imaginary parts.
    first, second = (
        np.ascontiguousarray(item, complex).reshape(len(item), n * n).view(np.float64) for item in (inverse, scatter)
    )
    trace = np.einsum("ka,ka->k", first, second)
    return np.asarray(
        np.maximum(trace / (n * np.maximum(counts, 1e-12)) * inverse_bias_factor(max(dof, n + 1), n), 1e-300), float
    )


def vector_mahalanobis_distances(vectors: ComplexArray, covariance: ComplexArray, dof: float) -> Array:
    """Return the Mahalanobis distance per degree of freedom (..., K) of vectors (..., K, n), of mean 1 for noise."""
    n = vectors.shape[-1]
    weighted = np.matmul(invert_pooled(covariance), vectors[..., None])[..., 0]
    squared = np.sum(vectors.conj() * weighted, axis=-1).real
    return np.asarray(squared / n * inverse_bias_factor(max(dof, n + 1), n), float)


def outlier_bound(counts: Array, n: int, probability: float = OUTLIER_PROBABILITY) -> Array:
    """Return the distance (K,) that noise of n signals exceeds with this probability at one line (chi-square)."""
    from scipy.special import gammainccinv

    half = n * np.maximum(counts, 1.0)
    return np.asarray(gammainccinv(half, probability) / half)


def _pooling_width(counts: Array, least_dof: float) -> int:
    """Least odd number of lines that gives `least_dof` at every line (by bisection), or all lines."""
    low, high = 0, (len(counts) - 1) // 2
    while low < high:
        middle = (low + high) // 2
        enough = np.min(window_sums(counts, 2 * middle + 1)) >= least_dof
        low, high = (low, middle) if enough else (middle + 1, high)
    return 2 * low + 1


def _initial_weights(scatter: ComplexArray, counts: Array) -> Array:
    """Weights from the diagonal alone: the power of each signal at a line against the median of its neighbors."""
    power = np.diagonal(scatter, axis1=1, axis2=2).real / np.maximum(counts, 1e-12)[:, None]
    blocks = np.array_split(np.arange(len(power)), max(len(power) // MEDIAN_LINES, 1))
    typical = np.concatenate([np.broadcast_to(np.median(power[b], axis=0), power[b].shape) for b in blocks])
    largest = np.max(power / np.maximum(typical, 1e-300), axis=1)
    return np.asarray(np.minimum(1.0, INITIAL_POWER_LIMIT / np.maximum(largest, 1e-300)), float)
