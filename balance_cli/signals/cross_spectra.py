"""Power and cross spectral densities of a record, and the noise of its channels where no load reaches."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
import scipy.signal
from numpy.typing import NDArray

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

MAIN_LOBE = 4
"""Lines from the centre of the window's main lobe to its edge."""
INDEPENDENT_PER_WINDOW = 0.89
"""Independent spectra for each window, of those that lie a third of their length apart."""


@dataclass(frozen=True)
class CrossSpectra:
    """Densities of c channels: `frequency` (k,) [Hz], `density` (k, c, c) [V2/Hz], both signs of frequency counted.

    `averages` (k,): how many independent spectra were averaged.
    """

    frequency: Array
    density: ComplexArray
    averages: Array

    def at(self, kept: NDArray[np.bool_]) -> CrossSpectra:
        """Some of the lines."""
        return CrossSpectra(self.frequency[kept], self.density[kept], self.averages[kept])


def cross_spectra(
    parts: Iterable[tuple[int, Array]],
    step: float,
    length: int,
    select_bins: Callable[[int, Array], NDArray[np.bool_]] | None = None,
) -> CrossSpectra:
    """Welch's estimate with windows of `length` samples over stretches (first sample, samples (n, c)) without gaps.

    Means of each window are taken off, the lines beside zero and half the sample rate left out (Welch, IEEE Trans.
    Audio Electroacoust. 15, 1967, 70). `used` says, for the first sample of a window and the frequencies (k,), which
    lines of that window count: a harmonic that moves with the speed can be kept out window by window. The window is
    that of Blackman and Harris (four terms), whose side lobes lie 92 dB down.
    """
    window = scipy.signal.windows.blackmanharris(length, sym=False)
    frequency = np.asarray(np.fft.rfftfreq(length, step), float)
    inner = (np.arange(len(frequency)) >= MAIN_LOBE) & (np.arange(len(frequency)) < len(frequency) - MAIN_LOBE)
    total, count = None, np.zeros(len(frequency))
    for first, part in parts:
        for start in range(0, len(part) - length + 1, length // 3):
            piece = part[start : start + length]
            lines = np.fft.rfft((piece - piece.mean(axis=0)) * window[:, None], axis=0)
            mine = inner if select_bins is None else inner & select_bins(first + start, frequency)
            lines[~mine] = 0.0
            power = lines[:, :, None] * lines[:, None, :].conj()
            total = power if total is None else total + power
            count += mine
    kept = count > 0
    if total is None or not kept.any():
        raise ValueError("no window fits into the stretches")
    density = total[kept] * (step / np.sum(window**2) / count[kept])[:, None, None]
    return CrossSpectra(frequency[kept], density, np.maximum(INDEPENDENT_PER_WINDOW * count[kept], 1.0))


def noise_variance(spectra: CrossSpectra, step: float, load_free: NDArray[np.bool_]) -> Array:
    """Covariance (c,) [V2] of one sample of each channel's noise, white, from `quiet` lines (k,), that no load reaches.

    The median of the lines, so that a tone among them does no harm.
    """
    power = np.einsum("kcc->kc", spectra.density[load_free]).real
    typical = float(np.median(spectra.averages[load_free]))
    return np.asarray(np.median(power, axis=0) / (step * _median_of_mean(typical)))


def _median_of_mean(averages: float) -> float:
    """Median of the mean of so many exponential variables of mean one."""
    from scipy.special import gammaincinv

    return float(gammaincinv(averages, 0.5) / averages)
