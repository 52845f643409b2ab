"""Noise of a harmonic, estimated from the lines of the order spectrum on either side of it."""

from __future__ import annotations

import functools
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
AROUND = 4
"""Lines on either side of a harmonic in which tones beside it are sought; a record of ten revolutions has as many."""
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
MEAN_NOISE_LINES = 24
"""Lines from which the noise of the mean is estimated; half of those of a harmonic, because it must be near zero."""
LINE_CORRELATION_SUM = 2.27
"""Lines under Blackman's taper that are worth one: the sum of |rho|^2 over all pairs of lines 3 to 24, over 22."""
WHITE_PRIOR = 0.9
"""Prior probability that noise is white near the mean. White noise is then stated 1.1 times as large as it is, in the
median; with 0.5 it is 1.3 times."""
CORNER_LINES = 0.35 * 2.0 ** (0.5 * np.arange(14))
"""Corners of red noise, in lines: from gusts slower than the record, which pass for a drift, to all lines."""
WHITE_SHARES = (0.0, 0.01, 0.1)
"""White noise beside red noise, over its power at rest."""


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
    correlation = _correlation_by_distance()
    distance = np.abs(offsets[:, None] - offsets[None, :]).astype(int)
    return np.asarray(correlation[np.minimum(distance, len(correlation) - 1)])


@functools.cache
def _correlation_by_distance() -> Array:
    """Return |rho|^2 of lines 0, 1, 2 and so on apart; the last number is zero."""
    grid = (np.arange(256) + 0.5) / 256
    spectrum = np.abs(np.fft.fft(blackman_taper(grid) ** 2)) / np.sum(blackman_taper(grid) ** 2)
    return np.append(spectrum[:128] ** 2, 0.0)


@dataclass(frozen=True)
class PooledNoise:
    """Covariance (..., c, c) of tapered lines near each harmonic, with its complex degrees of freedom (...)."""

    covariance: ComplexArray
    dof: Array


@dataclass(frozen=True)
class NoiseLines:
    """Lines (n, k, c) at `offsets` (k,) from harmonics 1 to n, without the tones and free decays of the regression.

    The mean of z z* over the lines that hold noise alone, `keep` (n, k), times `factor` (n,) is the covariance of a
    harmonic in noise of a flat spectrum. `around` (n, 2 AROUND + 1, c) are those from AROUND lines before a harmonic to
    as many after it, with the harmonic itself, and with phases that count from the beginning of the interval.
    """

    values: ComplexArray
    offsets: Array
    keep: Flags
    factor: Array
    around: ComplexArray


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
    """Return the medians (..., len(counts), c) of the first lines of `power` (..., k, c), `counts` for each."""
    lines = np.swapaxes(power, -1, -2)[..., None, :]
    ordered = np.sort(np.where(np.arange(power.shape[-2]) < counts[:, None], lines, np.inf), axis=-1)
    low, high = (ordered[..., np.arange(len(counts)), middle] for middle in ((counts - 1) // 2, counts // 2))
    return np.asarray(np.swapaxes(0.5 * (low + high), -1, -2))


def mean_line_offsets(revolutions: int) -> Array:
    """Return the offsets of the lines that tell the noise of the mean, in units of 1/`revolutions`."""
    return np.arange(1.0, min(MEAN_NOISE_LINES, int(WIDEST_OFFSET * revolutions)) + 1.0)


def mean_noise(lines: ComplexArray, offsets: Array, mean: Array) -> PooledNoise:
    """Return the noise of harmonic 0, which is real: from the lines of one side, because the other is its mirror image.

    `lines` (k, c) at `offsets` (k,) from 1 on; the two innermost contain the `mean` (c,), which is taken out. X_0 is
    half of the value that the formula for k >= 1 gives. Gusts and drifts are noise whose spectrum falls with frequency:
    what is taken at rest is the average of white and red spectra, by how well they describe the lines.
    """
    a0, a1, a2 = BLACKMAN_COEFFICIENTS
    of_mean = np.where(offsets == 1.0, -0.5 * a1, np.where(offsets == 2.0, 0.5 * a2, 0.0)) / a0
    # Without the mean the first line lacks what the taper takes from there.
    whole = a0**2 + 0.5 * (a1**2 + a2**2)
    left = np.where(offsets == 1.0, 1.0 - 0.25 * a1**2 / whole, 1.0)
    z = (0.5 * lines - of_mean[:, None] * mean) / np.sqrt(left)[:, None]
    outward = offsets >= INNERMOST_LINE
    keep = ~outward
    keep[outward] = noise_only_lines(np.abs(z[outward]) ** 2, offsets[outward])
    covariance = _covariance_at_rest(z[keep], offsets[keep])
    dof = np.count_nonzero(keep) / LINE_CORRELATION_SUM
    return PooledNoise(covariance.astype(complex), np.asarray(dof))


def _covariance_at_rest(z: ComplexArray, lines: Array) -> Array:
    """Return the covariance (c, c) at the mean of noise with amplitudes z (k, c) at the lines (k,).

    The principal components of the channels are uncorrelated, and each has a spectrum of its own: a gust that loads
    several cells stays in proportion.
    """
    size = np.sqrt(np.mean(np.abs(z) ** 2, axis=0))
    size[size == 0.0] = 1.0
    scaled = z / size
    directions = np.linalg.svd(np.concatenate([scaled.real, scaled.imag]), full_matrices=False)[2].T
    power = np.abs(scaled @ directions) ** 2
    at_rest = power.mean(axis=0) * _power_at_rest(power, lines)
    return np.asarray(size[:, None] * (directions * at_rest) @ directions.T * size)


def _power_at_rest(power: Array, lines: Array) -> Array:
    """Return the power at the mean over the mean power of the lines (k,), for each column of `power` (k, c).

    The average over spectra 1/(1 + (line/corner)^2) with and without white noise, and white noise alone, by their
    posterior probability; the scale of a spectrum has the prior of Jeffreys.
    """
    used = np.where(np.any(power > 0, axis=0), power, 1.0)
    shape, at_rest, prior = _red_spectra(lines)
    scale = (1.0 / shape) @ used / len(lines)
    log_likelihood = np.log(scale) + np.log(shape).mean(axis=1)[:, None]
    log_posterior = np.log(prior)[:, None] - len(lines) / LINE_CORRELATION_SUM * log_likelihood
    weight = np.exp(log_posterior - log_posterior.max(axis=0))
    weight /= weight.sum(axis=0)
    return np.asarray((weight * scale * at_rest[:, None]).sum(axis=0) / used.mean(axis=0))


def _red_spectra(lines: Array) -> tuple[Array, Array, Array]:
    """Return the powers (g, k) of spectra at the lines, their means (g,) within half a line of rest, their priors."""
    corner, share = (grid.ravel() for grid in np.meshgrid(CORNER_LINES, WHITE_SHARES))
    shape = 1.0 / (1.0 + (lines / corner[:, None]) ** 2) + share[:, None]
    at_rest = 2.0 * corner * np.arctan(0.5 / corner) + share
    prior = np.full(len(corner), (1.0 - WHITE_PRIOR) / len(corner))
    return np.vstack([np.ones(len(lines)), shape]), np.append(1.0, at_rest), np.append(WHITE_PRIOR, prior)
