"""Noise of a harmonic, estimated from the lines of the order spectrum on either side of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.signals.rotor.spectral_floor import row_medians

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Flags = NDArray[np.bool_]
Integers = NDArray[np.int64]

BLACKMAN_COEFFICIENTS = (0.42, 0.5, 0.08)
"""Blackman's taper (Blackman and Tukey, The Measurement of Power Spectra, 1959).

Over whole revolutions its lines are zero from the third on, so that a harmonic has no effect on them, and a slow drift
falls off by 18 dB an octave.
"""
INNERMOST_LINE = 3
"""Lines from a harmonic to the first line that is used: those nearer hold the harmonic itself."""
OUTERMOST_LINE = 48
"""Lines from a harmonic to the last line that is used: 1.6 Hz in a record of 30 s, within the width of most modes."""
WIDEST_OFFSET = 0.4
"""Greatest distance from a harmonic in orders: less than half the distance to the next harmonic."""
COMPARISON_LINES = 20
"""Lines of whose median power a line is compared with: they make an outlier visible and are narrower than a mode."""
LINE_FALSE_ALARM = 1e-3
"""Probability that any line of one side is dropped although it is noise."""
FEWEST_NOISE_LINES = 8
"""Lines below which none is dropped; fewer do not determine a covariance."""
MEDIAN_OF_EXPONENTIAL = float(np.log(2.0))
"""Median over mean of the power of a line of noise, which is exponentially distributed."""
SLOPE_SIGNIFICANCE = 2.0
"""Standard errors by which the spectrum must fall with frequency before it is extrapolated to the mean."""
STEEPEST_EXPONENT = -1.5
"""Exponent of the power law below which there is no extrapolation.

Noise is at most of the kind 1/f. In a steeper spectrum the load itself varies, by a step or a maneuver.
"""
MEAN_LINE_OFFSET = 0.5
"""Line that stands for the mean in the power law: it is the mean over frequencies from zero to the first line."""
MEAN_NOISE_LINES = 24
"""Lines from which the noise of the mean is estimated; half of those of a harmonic, because it must be near zero."""
LINE_CORRELATION_SUM = 2.27
"""Lines under Blackman's taper that are worth one: the sum of |rho|^2 over all pairs of lines 3 to 24, over 22."""


def blackman_taper(fraction: Array) -> Array:
    """Return Blackman's taper at `fraction` of the record, 0 to 1."""
    a0, a1, a2 = BLACKMAN_COEFFICIENTS
    cosine = np.cos(2 * np.pi * fraction)
    return np.asarray((a0 - a2) + cosine * (2.0 * a2 * cosine - a1))  # cos(2 x) = 2 cos(x)^2 - 1


def line_offsets(revolutions: int) -> Array:
    """Return the offsets of the lines on either side of a harmonic, in units of 1/`revolutions`, in ascending order."""
    outermost = min(OUTERMOST_LINE, int(WIDEST_OFFSET * revolutions))
    outward = np.arange(INNERMOST_LINE, outermost + 1, dtype=float)
    return np.concatenate([-outward[::-1], outward])


def line_correlation(offsets: Array) -> Array:
    """Return the squared correlation |rho|^2 (k, k) between the tapered lines of white noise at the given offsets."""
    grid = (np.arange(256) + 0.5) / 256
    spectrum = np.abs(np.fft.fft(blackman_taper(grid) ** 2)) / np.sum(blackman_taper(grid) ** 2)
    distance = np.abs(offsets[:, None] - offsets[None, :]).astype(int)
    return np.where(distance < 128, spectrum[np.minimum(distance, 127)] ** 2, 0.0)


@dataclass(frozen=True)
class PooledNoise:
    """Covariance (..., c, c) of tapered lines near each harmonic, with its complex degrees of freedom (...)."""

    covariance: ComplexArray
    dof: Array


def pooled_noise(lines: ComplexArray, offsets: Array) -> PooledNoise:
    """Average z z* over the lines that hold noise alone.

    `lines` (..., k, c) are the amplitudes at `offsets` (k,), on both sides or on one. Neighboring lines of a tapered
    record are correlated: the degrees of freedom are k^2 over the sum of all |rho|^2.
    """
    keep = noise_only_lines(np.abs(lines) ** 2, offsets)
    z, count = lines * keep[..., None], np.count_nonzero(keep, axis=-1)
    dof = count**2 / np.einsum("...i,ij,...j->...", keep.astype(float), line_correlation(offsets), keep.astype(float))
    covariance = np.swapaxes(z, -1, -2) @ z.conj() / count[..., None, None]
    return PooledNoise(covariance, np.asarray(dof))


def noise_only_lines(power: Array, offsets: Array) -> Flags:
    """Return which lines (..., k) of `power` (..., k, c) hold noise alone.

    Others hold the mains, or the sidebands of a harmonic whose amplitude varies. A line is dropped where the power of
    any channel exceeds the median of the lines before it, or beyond it, on the same side. A resonance is wider than the
    lines of the comparison, and is kept. Where fewer than FEWEST_NOISE_LINES would remain, all lines are kept: the
    noise is then overestimated rather than underestimated.
    """
    keep = np.ones(power.shape[:-1], bool)
    for side in (offsets < 0, offsets > 0):
        index = np.flatnonzero(side)
        outward = index[np.argsort(np.abs(offsets[index]))]
        keep[..., outward] = ~_outlier_lines(power[..., outward, :])
    enough = np.count_nonzero(keep, axis=-1) >= min(FEWEST_NOISE_LINES, len(offsets))
    return np.asarray(keep | ~enough[..., None], bool)


def _outlier_lines(power: Array) -> Flags:
    """Outliers among the lines of one side, innermost first, with the two on either side into which the taper leaks."""
    count, channels = power.shape[-2:]
    if count < COMPARISON_LINES:
        return np.zeros(power.shape[:-1], bool)
    limit = -np.log(LINE_FALSE_ALARM / (count * channels)) / MEDIAN_OF_EXPONENTIAL
    windows = np.lib.stride_tricks.sliding_window_view(power, COMPARISON_LINES, axis=-2)
    medians = row_medians(windows)
    line = np.arange(count)
    beyond = medians[..., np.minimum(line + 3, count - COMPARISON_LINES), :]
    before = medians[..., np.maximum(line - 2 - COMPARISON_LINES, 0), :]
    few = slice(COMPARISON_LINES // 2, min(COMPARISON_LINES + 2, count))  # fewer lines lie before these
    before[..., few, :] = _medians_of_first(power[..., :COMPARISON_LINES, :], line[few] - 2)
    before[..., : COMPARISON_LINES // 2, :] = np.inf
    outliers = np.any(power > limit * np.minimum(beyond, before), axis=-1)
    spread = outliers.copy()
    for shift in (1, 2):
        spread[..., shift:] |= outliers[..., :-shift]
        spread[..., :-shift] |= outliers[..., shift:]
    return np.asarray(spread, bool)


def _medians_of_first(power: Array, counts: Integers) -> Array:
    """Return the medians (..., len(counts), c) of the first lines of `power` (..., k, c), so many for each."""
    lines = np.swapaxes(power, -1, -2)[..., None, :]
    ordered = np.sort(np.where(np.arange(power.shape[-2]) < counts[:, None], lines, np.inf), axis=-1)
    low, high = (ordered[..., np.arange(len(counts)), middle] for middle in ((counts - 1) // 2, counts // 2))
    return np.asarray(np.swapaxes(0.5 * (low + high), -1, -2))


def mean_noise(lines: ComplexArray, offsets: Array) -> PooledNoise:
    """Return the noise of harmonic 0, which is real: from the lines of one side, because the other is its mirror image.

    X_0 is half of the value that the formula for k >= 1 gives. Where the spectrum of a signal falls significantly with
    frequency, as that of a drift does, its power law is extrapolated to the mean.
    """
    above = (offsets > 0) & (offsets <= MEAN_NOISE_LINES)
    pooled = pooled_noise(lines[above] / 2.0, offsets[above])
    ratio = np.sqrt(_power_law_factor(np.abs(lines[above]) ** 2, offsets[above]))
    covariance = pooled.covariance.real * np.outer(ratio, ratio)
    return PooledNoise(covariance.astype(complex), pooled.dof)


def _power_law_factor(power: Array, lines: Array) -> Array:
    """Factor (c,) by which the power at the mean exceeds the mean power of the lines, from a fitted power law."""
    nonzero = np.any(power > 0, axis=0)
    x = np.log(lines) - np.mean(np.log(lines))
    exponent = x @ np.log(np.where(nonzero, power, 1.0) + np.finfo(float).tiny) / (x @ x)
    # The logarithm of an exponential variable has the standard deviation pi/sqrt(6).
    error = np.pi / np.sqrt(6.0) * np.sqrt(LINE_CORRELATION_SUM / (x @ x))
    significant = nonzero & (exponent < -SLOPE_SIGNIFICANCE * error) & (exponent > STEEPEST_EXPONENT)
    exponent = np.where(significant, exponent, 0.0)
    law = (lines[:, None] / MEAN_LINE_OFFSET) ** exponent
    return np.asarray(1.0 / np.mean(law, axis=0))
