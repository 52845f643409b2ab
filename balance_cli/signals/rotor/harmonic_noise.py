"""The noise of a harmonic, told by the lines of the order spectrum on either side of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Flags = NDArray[np.bool_]

# Blackman's taper (Blackman and Tukey, The Measurement of Power Spectra, 1959): over whole revolutions its lines are
# zero from the third on, so that a harmonic leaves no trace in them, and what drifts slowly fades by 18 dB an octave.
BLACKMAN_COEFFICIENTS = (0.42, 0.5, 0.08)
INNERMOST_LINE = 3
OUTERMOST_LINE = 48  # lines: 1.6 Hz in a record of 30 s, well inside the width of an ordinary mode
WIDEST_OFFSET = 0.4  # revolution^-1: never as far as half-way to the next harmonic
COMPARISON_LINES = 20  # lines that a line is compared with
LINE_FALSE_ALARM = 1e-3
FEWEST_NOISE_LINES = 8
MEDIAN_OF_EXPONENTIAL = float(np.log(2.0))


def blackman_taper(fraction: Array) -> Array:
    """Blackman's taper at `fraction` of the record, 0 to 1."""
    a0, a1, a2 = BLACKMAN_COEFFICIENTS
    return a0 - a1 * np.cos(2 * np.pi * fraction) + a2 * np.cos(4 * np.pi * fraction)


def line_offsets(revolutions: int) -> Array:
    """Offsets m of the lines from their harmonic, in units of 1/`revolutions`, either side, in rising order."""
    outermost = min(OUTERMOST_LINE, int(WIDEST_OFFSET * revolutions))
    outward = np.arange(INNERMOST_LINE, outermost + 1, dtype=float)
    return np.concatenate([-outward[::-1], outward])


def line_correlation(offsets: Array) -> Array:
    """|rho|^2 (k, k) between the tapered lines of white noise at the given offsets."""
    grid = (np.arange(256) + 0.5) / 256
    spectrum = np.abs(np.fft.fft(blackman_taper(grid) ** 2)) / np.sum(blackman_taper(grid) ** 2)
    apart = np.abs(offsets[:, None] - offsets[None, :]).astype(int)
    return np.where(apart < 128, spectrum[np.minimum(apart, 127)] ** 2, 0.0)


@dataclass(frozen=True)
class PooledNoise:
    """Covariance (c, c) of tapered lines near one harmonic, with its complex degrees of freedom."""

    covariance: ComplexArray
    dof: float


def pooled_noise(lines: ComplexArray, offsets: Array) -> PooledNoise:
    """Mean of z z* over the sound lines.

    `lines` (k, c) are the amplitudes at `offsets` (k,), both sides or one. Neighbouring lines of a tapered record are
    correlated: the degrees of freedom are k^2 over the sum of all |rho|^2.
    """
    keep = noise_only_lines(np.abs(lines) ** 2, offsets)
    z = lines[keep]
    dof = len(z) ** 2 / float(np.sum(line_correlation(offsets[keep])))
    return PooledNoise(z.T @ z.conj() / len(z), dof)


def noise_only_lines(power: Array, offsets: Array) -> Flags:
    """Which lines hold noise alone: not the mains, not the skirt of a harmonic whose amplitude moves.

    `power` (k, c). A line is left out where any channel stands out from the median of the lines beyond it or before it
    on the same side. A resonance is wider than the window of comparison is long, and stays. Where hardly anything
    would be left, everything is kept: rather too much noise than too little.
    """
    keep = np.ones(len(offsets), bool)
    for side in (offsets < 0, offsets > 0):
        index = np.flatnonzero(side)
        outward = index[np.argsort(np.abs(offsets[index]))]
        keep[outward] = ~_outlier_lines(power[outward])
    return keep if np.count_nonzero(keep) >= min(FEWEST_NOISE_LINES, len(offsets)) else np.ones(len(offsets), bool)


def _outlier_lines(power: Array) -> Flags:
    """Lines of one side, innermost first, that stand out, with the two on either side that the taper spoils."""
    count = len(power)
    if count < COMPARISON_LINES:
        return np.zeros(count, bool)
    limit = -np.log(LINE_FALSE_ALARM / power.size) / MEDIAN_OF_EXPONENTIAL
    beyond = np.array(
        [np.median(power[min(j + 3, count - COMPARISON_LINES) :][:COMPARISON_LINES], axis=0) for j in range(count)]
    )
    before = np.array(
        [np.median(power[max(j - 2 - COMPARISON_LINES, 0) : max(j - 2, 1)], axis=0) for j in range(count)]
    )
    before[: COMPARISON_LINES // 2] = np.inf
    out = np.any(power > limit * np.minimum(beyond, before), axis=1)
    spoilt = np.convolve(out, np.ones(5), mode="same") > 0
    return np.asarray(spoilt, bool)
