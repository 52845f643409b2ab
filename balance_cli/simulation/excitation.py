"""Excitation signals on a uniform time grid; all but the swept sine are exactly band-limited."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Band = tuple[float, float]


def _line_numbers(band: Band, resolution: float) -> NDArray[np.int_]:
    """Numbers of the lines at multiples of `resolution` within the band, its ends included."""
    first = max(1, int(np.ceil(band[0] / resolution - 1e-9)))
    return np.arange(first, int(np.floor(band[1] / resolution + 1e-9)) + 1)


def _synthesize(numbers: NDArray[np.int_], amplitudes: NDArray[np.complex128], base: float, time: Array) -> Array:
    """`Re sum_k a_k exp(j 2 pi k base t)`: by inverse FFT over one period where the period fits the grid."""
    step = time[1] - time[0]
    count = round(1 / (base * step))
    if time[0] == 0 and abs(count * base * step - 1) < 1e-12 and count > 2 * numbers[-1]:
        spectrum = np.zeros(count // 2 + 1, complex)
        spectrum[numbers] = amplitudes * count / 2
        return np.resize(np.fft.irfft(spectrum, count), len(time))
    signal = np.zeros(len(time))
    for number, amplitude in zip(numbers, amplitudes, strict=True):
        signal += (amplitude * np.exp(2j * np.pi * base * number * time)).real
    return signal


def schroeder_phases(count: int) -> Array:
    """Phases (count,) [rad] of equal lines with a small peak: -pi k (k - 1) / count for line k = 1, 2 ...

    M. R. Schroeder, IEEE Trans. Inf. Theory 16 (1970) 85. The peak of the sum is less than twice its rms, that of
    random phases three to four times.
    """
    k = np.arange(1.0, count + 1.0)
    return np.asarray(-np.pi * k * (k - 1.0) / count)


def multisine(
    time: Array,
    period: float,
    band: Band,
    level: float,
    rng: np.random.Generator,
    every: int = 1,
    shift: int = 0,
    phases: str = "random",
) -> Array:
    """Multisine (n,) with equal amplitudes and rms `level`, repeating every `period` s.

    Its lines are the multiples of 1/period within `band` [Hz]; of these every `every`-th, starting with `shift`
    (with interleaved lines several components can be excited at once). `phases`: `random` or `schroeder`.
    """
    numbers = _line_numbers(band, 1 / period)[shift::every]
    angles = schroeder_phases(len(numbers)) if phases == "schroeder" else 2 * np.pi * rng.random(len(numbers))
    phases_of_lines = np.exp(1j * angles)
    return _synthesize(numbers, level * np.sqrt(2 / len(numbers)) * phases_of_lines, 1 / period, time)


def random_noise(time: Array, band: Band, level: float, rng: np.random.Generator) -> Array:
    """Gaussian noise (n,) of flat spectrum within `band` [Hz] and rms `level` (in expectation)."""
    step = time[1] - time[0]
    count = len(time) + len(time) % 2
    numbers = _line_numbers(band, 1 / (count * step))
    sigma = level / np.sqrt(len(numbers))
    amplitudes = sigma * (rng.standard_normal(len(numbers)) + 1j * rng.standard_normal(len(numbers)))
    spectrum = np.zeros(count // 2 + 1, complex)
    spectrum[numbers] = amplitudes * count / 2
    return np.fft.irfft(spectrum, count)[: len(time)]


def sine_sweep(time: Array, period: float, band: Band, level: float) -> Array:
    """Sine (n,) of rms `level` whose frequency rises linearly through `band` [Hz] in each `period` s."""
    within = np.mod(time, period)
    rate = (band[1] - band[0]) / period
    cycles = band[0] * within + rate * within**2 / 2
    whole = np.floor(time / period) * (band[0] + band[1]) * period / 2
    wave: Array = level * np.sqrt(2) * np.sin(2 * np.pi * (cycles + whole))
    return wave


def stepped_sine(time: Array, frequencies: Array, dwell: float, level: float) -> Array:
    """Sine (n,) of rms `level` that dwells `dwell` s at each of `frequencies` (k,) [Hz]; with continuous phase."""
    place = np.minimum((time / dwell).astype(int), len(frequencies) - 1)
    ended = np.concatenate([[0.0], np.cumsum(frequencies * dwell)])[place]
    wave: Array = level * np.sqrt(2) * np.sin(2 * np.pi * (ended + frequencies[place] * (time - place * dwell)))
    return wave
