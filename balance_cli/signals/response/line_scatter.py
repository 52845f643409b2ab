"""Variance of a measured response whose estimate is not known: from coherence, or from the scatter of its lines.

By coherence g and n independent averages the variance of H1 is |H|^2 (1 - g) / (g (n - 1)) (Bendat and Piersol, Random
Data, 4th ed. (2010), section 9.2). Without them, a rational function with a denominator that all channels share is
fitted to the lines about each line (Levy, IRE Trans. Automatic Control 4, 1959; weighted by the denominator of the
iteration before, Sanathanan and Koerner, ibid. 8, 1963). What it leaves is noise, or a mode that is narrower than the
lines, which makes the variance larger and never smaller.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

WINDOW_LINES, FEW_CHANNELS_LINES = 9, 13
"""Lines of a fit, and those where fewer than FEW_CHANNELS share its denominator. On the sample rig, whose lines stand
two to a mode's width, 9 instead of 13 lines halve what modes beside the window add to the scatter."""
FEW_CHANNELS = 3
DEGREE = 3
"""Of numerators and denominator: one mode within the lines, half of another, and what the others add."""
ITERATIONS = 3
RIDGE = 1e-12
"""Of the power of the lines: far below what a mode within them has."""
LEAST_NOISE = 1e-12
"""Of the power of a channel: noise is never so far below it that other channels do not count at all."""
POOLED_LINES = 7
"""Neighboring lines over which the relative variance is averaged: it is then known to a fifth."""
SCATTER_DOF = 25.0
"""Complex degrees of freedom of a variance that is known to a fifth."""
LEAST_SEEN = 0.05
"""Share of the noise that a fit must leave: lines that a window makes nearly one curve hide it."""
WINDOW_TERMS = {
    "none": (1.0,),
    "hann": (0.5, -0.25),
    "hamming": (0.54, -0.23),
    "blackman": (0.42, -0.25, 0.04),
    "flattop": (0.21557895, -0.20831579, 0.138631579, -0.041789474, 0.003473684),
}
"""Spectrum of each window at lines 0, 1, 2 ...; the lines -1, -2 ... have the same. Harris, Proc. IEEE 66, 1978."""


def coherence_variance(response: ComplexArray, coherence: Array, averages: float) -> Array:
    """Return the variance (k, c) of responses (k, c) with this ordinary coherence (k, c), for n > 1 averages."""
    inside = np.clip(coherence, np.finfo(float).eps, 1.0)
    return np.asarray(np.abs(response) ** 2 * (1.0 - inside) / (inside * (averages - 1.0)))


def scatter_variance(frequency: Array, response: ComplexArray, window: str) -> Array | None:
    """Return the variance (k, c) of responses (k, c) at `frequency` (k,) [Hz] from the scatter of neighboring lines.

    `window` is one of WINDOW_TERMS, which correlates the noise of neighboring lines. None where there are fewer lines
    than those of a fit, or the window leaves too little of the noise.
    """
    channels = response.shape[1]
    lines = WINDOW_LINES if channels >= FEW_CHANNELS else FEW_CHANNELS_LINES
    if len(frequency) < lines or _share_seen(window, lines) < LEAST_SEEN:
        return None
    first = np.clip(np.arange(len(frequency)) - lines // 2, 0, len(frequency) - lines)
    starts, place = np.unique(first, return_inverse=True)
    index = starts[:, None] + np.arange(lines)
    residual = _residual_power(frequency[index], response[index]) / _share_seen(window, lines)
    # The coefficients of the denominator are shared among the channels.
    freedom = lines - DEGREE - 1 - DEGREE / channels
    # Noise is the same beside a zero of the response: it is relative to the power of the window.
    power = np.maximum(np.mean(np.abs(response[index]) ** 2, axis=1), np.finfo(float).tiny)
    return np.asarray((_pool(residual / (freedom * power)) * power)[place])


def _pool(values: Array) -> Array:
    """Return values (k, c) averaged over POOLED_LINES neighbors."""
    kernel = np.ones(min(POOLED_LINES, len(values)))
    count = np.convolve(np.ones(len(values)), kernel, "same")
    return np.stack([np.convolve(column, kernel, "same") / count for column in values.T], axis=1)


def independent_share(window: str) -> float:
    """Return the independent share of neighboring lines of a window: one over the sum of their squared correlations."""
    return float(1.0 / (2.0 * np.sum(_correlation(window) ** 2) - 1.0))


def _correlation(window: str) -> Array:
    """Return the correlation of the spectrum of a window between lines 0, 1, 2 ... apart, by its terms."""
    terms = np.array(WINDOW_TERMS[window])
    spectrum = np.concatenate([terms[:0:-1], terms])
    return np.asarray(np.correlate(spectrum, spectrum, "full")[len(spectrum) - 1 :] / np.sum(spectrum**2))


def _share_seen(window: str, lines: int) -> float:
    """Return the share of the noise of a window that a polynomial through the lines leaves, in the mean.

    The error of an averaged cross-spectrum is a product of two spectra, and so is its correlation.
    """
    correlation = _correlation(window)
    lag = np.abs(np.subtract.outer(np.arange(lines), np.arange(lines)))
    R = np.where(lag < len(correlation), correlation[np.minimum(lag, len(correlation) - 1)] ** 2, 0.0)
    basis = np.linalg.qr(np.vander(np.linspace(-1.0, 1.0, lines), DEGREE + 1))[0]
    left = np.eye(lines) - basis @ basis.T
    return float(np.trace(left @ R) / np.trace(left))


def _residual_power(frequency: Array, response: ComplexArray) -> Array:
    """Return the residual power (n, c) of rational functions fitted to windows (n, M) of responses (n, M, c).

    Channels count by their noise, which is what a polynomial leaves of them and then the iteration before: those that
    hardly respond are all noise, and would make a denominator that fits no other channel.
    """
    middle, half = frequency.mean(axis=1), np.ptp(frequency, axis=1) / 2.0
    x = (frequency - middle[:, None]) / half[:, None]
    powers = x[:, :, None] ** np.arange(DEGREE + 1)
    size = np.sqrt(np.mean(np.abs(response) ** 2, axis=1, keepdims=True))
    scaled = response / np.where(size > 0.0, size, 1.0)
    weight = np.ones_like(x)
    basis = np.linalg.qr(powers)[0]
    residual = scaled - basis @ (basis.swapaxes(1, 2) @ scaled)
    for _ in range(ITERATIONS):
        precision = 1.0 / np.maximum(_pool(np.mean(np.abs(residual) ** 2, axis=1)), LEAST_NOISE)
        basis = np.linalg.qr(weight[:, :, None] * powers)[0]
        terms = (weight[:, :, None, None] * powers[:, :, None, :] * scaled[:, :, :, None]).reshape(*x.shape, -1)
        terms = terms - basis @ (basis.swapaxes(1, 2) @ terms)
        flat = terms.reshape(len(terms), -1, DEGREE + 1)
        normal = (flat[:, :, 1:] * np.tile(precision, x.shape[1])[:, :, None]).conj().swapaxes(1, 2)
        # The ridge holds the coefficients of lines that one polynomial describes, which determine no denominator.
        ridge = RIDGE * x.shape[1] * precision.sum(axis=1)[:, None, None] * np.eye(DEGREE)
        unknown = np.linalg.solve(normal @ flat[:, :, 1:] + ridge, -normal @ flat[:, :, :1])
        denominator = 1.0 + (powers[:, :, 1:] @ unknown)[:, :, 0]
        residual = (flat[:, :, :1] + flat[:, :, 1:] @ unknown).reshape(scaled.shape)
        weight = 1.0 / np.maximum(np.abs(denominator), np.finfo(float).eps)
    return np.asarray(np.sum(np.abs(residual) ** 2, axis=1) * size[:, 0] ** 2)
