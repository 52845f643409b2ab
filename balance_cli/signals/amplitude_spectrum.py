"""The amplitude spectrum of a record: what a sine of each frequency in it measures."""

from __future__ import annotations

import functools
from bisect import bisect_right

import numpy as np
from numpy.typing import NDArray
from scipy.fft import rfft

Array = NDArray[np.float64]
Singles = NDArray[np.float32]


def amplitude_spectrum(samples: Array, sample_rate: float, longest: int = 16384) -> tuple[Array, Array]:
    """Return frequencies (k,) [Hz] and amplitudes (k, c) of samples (n, c), without their mean.

    Root mean square over half-overlapping segments of at most `longest` samples with a Hann window, scaled so that a
    sine of amplitude A gives a line of height A (Heinzel, Ruediger, Schilling 2002, eq. 20, times sqrt 2). Missing
    samples (NaN) count as the mean of their channel. Raises ValueError for fewer than two samples.
    """
    count = len(samples)
    if count < 2:
        raise ValueError("a spectrum needs at least two samples")
    length = min(count, longest)
    centered = samples - np.nanmean(samples, axis=0)
    centered = np.where(np.isfinite(centered), centered, 0.0)
    window = 0.5 - 0.5 * np.cos(2.0 * np.pi * np.arange(length) / length)
    starts = range(0, count - length + 1, max(length // 2, 1))
    power = np.zeros((length // 2 + 1, samples.shape[1]))
    for start in starts:
        power += np.abs(rfft(centered[start : start + length] * window[:, None], axis=0)) ** 2
    frequency = np.asarray(np.fft.rfftfreq(length, 1.0 / sample_rate), float)
    return frequency, np.asarray(2.0 / window.sum() * np.sqrt(power / len(starts)))


def normalize_channels(rows: Array) -> tuple[Singles, Array]:
    """Return the channels (c, m) without their means, in single precision, over their largest value (c,).

    The rounding is far below the side lobes of the windows with which lines are sought.
    """
    mean = rows.mean(axis=1)
    scale = np.maximum(np.maximum(rows.max(axis=1) - mean, mean - rows.min(axis=1)), np.finfo(float).tiny)
    channels = np.empty(rows.shape, np.float32)
    for row, channel, center, size in zip(rows, channels, mean, scale, strict=True):
        np.multiply(row - center, 1.0 / size, out=channel, casting="same_kind")
    return channels, scale


def fast_length(samples: int) -> int:
    """Return the greatest number up to `samples`, at least 1, that has no prime factor above 5.

    With a large one the transform takes several times as long. Less than 2 % of a record of 500 samples or more goes.
    """
    lengths = _fast_lengths(samples.bit_length())
    return lengths[bisect_right(lengths, samples) - 1]


@functools.cache
def _fast_lengths(bits: int) -> list[int]:
    """Return the numbers below 2^bits that have no prime factor above 5, in ascending order."""
    threes = [3**k for k in range(bits)]
    odd = [three * 5**k for three in threes for k in range(bits) if three * 5**k < 1 << bits]
    return sorted(number << shift for number in odd for shift in range(bits) if number << shift < 1 << bits)
