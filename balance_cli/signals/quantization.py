"""Quantization of recorded signals: an error that repeats with a signal that repeats, so that no scatter shows it.

A converter with steps of q rounds a signal with Gaussian noise of standard deviation s. The error, a saw-tooth of the
signal, has the variance q^2 / 12. Noise averages the harmonics m of the saw-tooth, so that of it the share

    6 / pi^2  sum over m of exp(-(2 pi m s / q)^2) / m^2

is the same whenever the signal is the same; the rest is a part of the scatter (Widrow and Kollar, Quantization Noise,
2008, chapter 19: dither).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

COMPARED_SAMPLES = 4096
"""Samples whose values are compared: of a converter with fewer levels, neighboring ones are among them."""
LEAST_STEP = 1e-6
"""Step over the largest value that counts: less may be the rounding of numbers of single precision."""
OFF_GRID = 0.05
"""Of a step: departure of the values from multiples of it, by rounding to single precision."""
HARMONICS = 50
"""Harmonics of the saw-tooth: what is left of the sum is 1 % of it."""
COARSE_SCATTER = 0.17
"""Variance of the scatter over q^2 from which it is s^2 + q^2 / 12. Below, where noise only moves a value across the
nearest threshold, it is q s / sqrt(pi); at s = 0.3 q both are equal."""


def quantization_steps(samples: Array) -> Array:
    """Return the steps (m,) in which the columns of samples (n, m) were recorded; zero where they are not even.

    A step is the least difference of the values; that of a signal without steps is no divisor of the other ones.
    """
    values = np.sort(samples[:COMPARED_SAMPLES], axis=0)
    difference = np.diff(values, axis=0)
    least = LEAST_STEP * np.max(np.abs(values), axis=0, initial=0.0)
    steps = np.min(np.where(difference > least, difference, np.inf), axis=0, initial=np.inf)
    steps = np.where(np.isfinite(steps), steps, 0.0)
    multiples = difference / np.where(steps > 0.0, steps, 1.0)
    return np.where(np.all(is_on_grid(multiples), axis=0), steps, 0.0)


def is_on_grid(multiples: Array) -> NDArray[np.bool_]:
    """Return which values, in steps, are whole numbers to within the rounding of the record."""
    return np.asarray(np.abs(multiples - np.round(multiples)) < OFF_GRID)


def repeated_variance(steps: Array, scatter: Array) -> Array:
    """Return the variance (m,) of errors that repeat, for steps (m,) and the variance of a sample between periods."""
    q = np.where(steps > 0.0, steps, 1.0)
    ratio = scatter / q**2
    noise = np.where(ratio < COARSE_SCATTER, np.pi * ratio**2, ratio - 1.0 / 12.0)
    m = np.arange(1.0, HARMONICS + 1.0)[:, None]
    share = 6.0 / np.pi**2 * np.sum(np.exp(-4.0 * np.pi**2 * m**2 * noise) / m**2, axis=0)
    return np.where(steps > 0.0, q**2 / 12.0 * share, 0.0)
