"""Power and cross spectral densities of a record, and the noise of its channels above all loads."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.io.errors import UserError

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Real = NDArray[np.floating]

MAIN_LOBE = 4
"""Frequency bins from the center of the main lobe of the window to its edge (Blackman-Harris, four terms)."""
BLACKMAN_HARRIS = (0.35875, -0.48829, 0.14128, -0.01168)
"""Cosine coefficients of the four-term window with side lobes at -92 dB (Harris, Proc. IEEE 66 (1978) 51, table I)."""
INDEPENDENT_PER_WINDOW = 0.89
"""Independent spectra per window of those that start a third of their length apart."""


@dataclass(frozen=True)
class CrossSpectra:
    """Two-sided spectral densities of c channels: `frequency` (k,) [Hz], `density` (k, c, c) [V2/Hz].

    `averages` (k,): number of independent spectra in the average.
    """

    frequency: Array
    density: ComplexArray
    averages: Array

    def at(self, bins: NDArray[np.bool_]) -> CrossSpectra:
        """Return the densities of some of the frequency bins (k,)."""
        return CrossSpectra(self.frequency[bins], self.density[bins], self.averages[bins])


def cross_spectra(
    parts: Iterable[tuple[int, Array]],
    step: float,
    length: int,
    select_bins: Callable[[int, Array], NDArray[np.bool_]] | None = None,
    band: tuple[float, float] = (0.0, np.inf),
) -> CrossSpectra:
    """Estimate densities by Welch's method, with windows of `length` samples over parts (first sample, samples (n, c)).

    The mean of each window is removed, and the frequency bins next to zero and to the Nyquist frequency are left out
    (Welch, IEEE Trans. Audio Electroacoust. 15, 1967, 70), as are those outside the `band` [Hz]. `select_bins` returns,
    for the first sample of a window and the frequencies (k,), which bins of that window count: so a harmonic that moves
    with the speed is excluded window by window. The window is that of Blackman and Harris with four terms, whose side
    lobes are at -92 dB.

    Raises UserError where no part is as long as a window, or no bin is selected.
    """
    window = blackman_harris(length)
    every = np.asarray(np.fft.rfftfreq(length, step), float)
    places = np.arange(MAIN_LOBE, max(len(every) - MAIN_LOBE, MAIN_LOBE))
    places = places[(every[places] >= band[0]) & (every[places] <= band[1])]
    frequency = every[places]
    total: ComplexArray | None = None
    count = np.zeros(len(frequency))
    for first, part in parts:
        for start in range(0, len(part) - length + 1, length // 3):
            samples = part[start : start + length]
            spectrum = np.fft.rfft((samples - samples.mean(axis=0)) * window[:, None], axis=0)[places]
            selected = np.ones(len(places), bool) if select_bins is None else select_bins(first + start, frequency)
            if total is None:
                total = np.zeros((len(frequency), spectrum.shape[1], spectrum.shape[1]), complex)
            counted = spectrum[selected]
            total[selected] += counted[:, :, None] * counted[:, None, :].conj()
            count += selected
    bins = count > 0
    if total is None or not bins.any():
        raise _no_window_error(length * step)
    density = total[bins] * (step / np.sum(window**2) / count[bins])[:, None, None]
    return CrossSpectra(frequency[bins], density, np.maximum(INDEPENDENT_PER_WINDOW * count[bins], 1.0))


def noise_variance_above(lowest: float, parts: Iterable[Real], step: float, length: int) -> Array:
    """Return the variance (c,) [V2] of one sample of white noise, from the bins above `lowest` [Hz].

    It is the median of the bins of the power spectra over the parts (c, n), so that a tone among them has no effect,
    in the precision of the parts. Raises UserError where no part is as long as a window, or no bin is above.
    """
    window = blackman_harris(length)
    frequency = np.fft.rfftfreq(length, step)
    end = len(frequency) - MAIN_LOBE
    first = max(int(np.searchsorted(frequency, lowest, side="right")), MAIN_LOBE)
    power, count = [], 0
    for part in parts:
        if part.shape[1] < length:
            continue
        starts = np.lib.stride_tricks.sliding_window_view(part, length, axis=1)[:, :: length // 3]
        count += starts.shape[1]
        taper = window.astype(part.dtype)
        power.append([_summed_power(windows, taper, slice(first, end)) for windows in starts])
    if not count or first >= end:
        raise _no_window_error(length * step)
    density = np.sum(power, axis=0) / (np.sum(window**2) * count)
    return np.asarray(np.median(density, axis=1) / _median_of_mean(max(INDEPENDENT_PER_WINDOW * count, 1.0)))


def _summed_power(windows: Real, taper: Real, bins: slice) -> Real:
    """Return the power (k,) of the spectra of windows (w, n) of one channel at bins beyond the main lobe, summed.

    The mean of a window is in the main lobe alone.
    """
    from scipy.fft import rfft

    spectrum = rfft(windows * taper, axis=1, overwrite_x=True)[:, bins]
    return np.asarray(
        np.einsum("wk,wk->k", spectrum.real, spectrum.real) + np.einsum("wk,wk->k", spectrum.imag, spectrum.imag)
    )


def _no_window_error(seconds: float) -> UserError:
    fault = f"no part of the record is as long as a window of {seconds:.2g} s with bins between harmonics"
    return UserError(
        fault, place="channels", remedy="Use --method harmonic or --load-model random, or record for longer"
    )


def _median_of_mean(averages: float) -> float:
    """Return the median of the mean of `averages` exponential variables of mean one."""
    from scipy.special import gammaincinv

    return float(gammaincinv(averages, 0.5) / averages)


@functools.lru_cache(maxsize=4)
def blackman_harris(length: int) -> Array:
    """Return the periodic Blackman-Harris window of `length` samples; the runs of a batch have few lengths."""
    angle = 2.0 * np.pi / length * np.arange(length)
    return np.asarray(np.cos(np.multiply.outer(angle, np.arange(4))) @ np.array(BLACKMAN_HARRIS))
