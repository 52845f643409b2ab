"""Spectral lines of a steady tone whose frequency need not be one of the bins, and their derivative by frequency."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from balance_cli.signals.waveform_types import BinSampling, Waveform

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

# Half the phase over a record [rad] below which a sum of phasors is expanded in it to second order: the next term of
# sin(x)/x, x^4 / 120, is then below 1e-14.
SMALL_PHASE = 1e-3


def tone_columns(waveform: Waveform, sampling: BinSampling, f: float) -> tuple[ComplexArray, ComplexArray]:
    """Lines (k, 2) of cos(2 pi f t) and -sin(2 pi f t) after the anti-alias filter, and their derivatives by f [Hz].

    Zero for a tone beyond the bins of all lines: what leaks from it is smooth, as an error at the end of the band is.
    """
    gain = waveform.filter_gain(f) if _is_among_bins(f, sampling) else 0.0
    positive, d_positive = _mean_phasors(f, sampling)
    negative, d_negative = _mean_phasors(-f, sampling)
    value = np.stack([positive + negative, 1j * (positive - negative)], axis=1)
    derivative = np.stack([d_positive - d_negative, 1j * (d_positive + d_negative)], axis=1)
    return gain * waveform.combine_bins(value), gain * waveform.combine_bins(derivative)


def _is_among_bins(f: float, sampling: BinSampling) -> bool:
    """Whether the main lobe of a tone reaches the bins of the lines, or it lies between them."""
    moving = sampling.used[sampling.used > 0]
    if not len(moving):
        return False
    lobe = 1.0 / float((sampling.count[sampling.frequency > 0] * sampling.step).min())
    return bool(moving.min() - lobe < f < moving.max() + lobe)


def _mean_phasors(f: float, sampling: BinSampling) -> tuple[ComplexArray, ComplexArray]:
    """Mean (R,) of exp(j 2 pi (f - frequency) i step) over i < count, times exp(j 2 pi f start), and its derivative."""
    start, step, count = sampling.start, sampling.step, sampling.count
    angle = 2 * np.pi * (f - sampling.frequency) * step
    angle = angle - 2 * np.pi * np.round(angle / (2 * np.pi))
    half = 0.5 * count * angle
    ratio, d_ratio = _dirichlet_kernel(angle, half, count)
    turn = np.exp(2j * np.pi * f * start + 0.5j * (count - 1) * angle)
    value = turn * ratio
    d_angle, d_start = 2 * np.pi * step, 2j * np.pi * start
    derivative = value * (d_start + 0.5j * (count - 1) * d_angle) + turn * d_ratio * d_angle
    weight = sampling.tone_weight
    return np.asarray(weight * value, complex), np.asarray(weight * derivative, complex)


def _dirichlet_kernel(angle: Array, half: Array, count: NDArray[np.intp]) -> tuple[Array, Array]:
    """sin(count angle / 2) / (count sin(angle / 2)) and its derivative by the angle [rad]; `half` = count angle / 2."""
    is_small = np.abs(half) < SMALL_PHASE
    sine = np.where(is_small, 1.0, np.sin(0.5 * angle))
    ratio = np.where(is_small, 1.0 - half**2 / 6.0, np.sin(half) / (count * sine))
    d_ratio = np.where(
        is_small,
        -angle * count**2 / 12.0,
        (0.5 * count * np.cos(half) * sine - 0.5 * np.sin(half) * np.cos(0.5 * angle)) / (count * sine**2),
    )
    return ratio, d_ratio
