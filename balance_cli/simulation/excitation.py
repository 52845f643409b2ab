"""Excitation signals on a uniform time grid; all but the swept sine are exactly band-limited."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.simulation.line_phases import crest_factor, low_crest_phases, schroeder_phases

Array = NDArray[np.float64]
Band = tuple[float, float]
Power = tuple[tuple[float, float], ...]

HIT_DELAY = 0.1
"""Start of a hit over the time between two: a record begins at rest, and its force window needs samples before."""


def _line_numbers(band: Band, resolution: float) -> NDArray[np.intp]:
    """Numbers of the lines at multiples of `resolution` within the band, its ends included."""
    first = max(1, int(np.ceil(band[0] / resolution - 1e-9)))
    return np.arange(first, int(np.floor(band[1] / resolution + 1e-9)) + 1)


def _synthesize(numbers: NDArray[np.intp], amplitudes: NDArray[np.complex128], base: float, time: Array) -> Array:
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


@dataclass(frozen=True)
class MultisineLines:
    """Lines of a multisine with the base frequency `base` [Hz]: their `numbers`, `amplitude` and `phase` (k,) [rad]."""

    base: float
    numbers: NDArray[np.intp]
    amplitude: Array
    phase: Array

    @property
    def frequency(self) -> Array:
        """Frequency (k,) [Hz] of each line."""
        return np.asarray(self.base * self.numbers)

    @property
    def crest_factor(self) -> float:
        """Peak over rms of the signal."""
        return crest_factor(self.numbers, self.amplitude**2, self.phase)


def multisine_lines(
    period: float,
    band: Band,
    level: float,
    rng: np.random.Generator,
    every: int = 1,
    shift: int = 0,
    phases: str = "random",
    power: Power | None = None,
) -> MultisineLines:
    """Lines of a multisine of rms `level` that repeats every `period` s.

    They are the multiples of 1/period within `band` [Hz]; of these every `every`-th, starting with `shift`
    (with interleaved lines several components can be excited at once). `phases`: `random`, `schroeder` or `low-crest`.
    `power`: relative power of a line from each frequency [Hz] on; without it all amplitudes are equal.
    """
    numbers = _line_numbers(band, 1 / period)[shift::every]
    share = line_power(numbers / period, power)
    if phases == "random":
        angles = 2 * np.pi * rng.random(len(numbers))
    else:
        angles = schroeder_phases(share) if phases == "schroeder" else low_crest_phases(numbers, share)
    return MultisineLines(1 / period, numbers, level * np.sqrt(2 * share / share.sum()), angles)


def line_power(frequency: Array, power: Power | None) -> Array:
    """Relative power (k,) of lines at `frequency` (k,) [Hz]; below the first frequency of `power` it is that there."""
    if power is None:
        return np.ones(len(frequency))
    edges, values = np.array(power, float).T
    place = np.searchsorted(edges, frequency + 1e-9 * frequency, side="right") - 1
    return np.asarray(values[np.maximum(place, 0)])


def multisine(lines: MultisineLines, time: Array) -> Array:
    """The multisine (n,) of these lines at `time` (n,) [s]."""
    return _synthesize(lines.numbers, lines.amplitude * np.exp(1j * lines.phase), lines.base, time)


def half_sine_hits(time: Array, period: float, contact: float, level: float, band: Band) -> Array:
    """Hits (n,) of a hammer of rms `level`: half sines of `contact` s, one in each `period` s, after a tenth of it.

    The force is band-limited: up to the first frequency of `band` [Hz] as it is, none from the second one on.
    """
    numbers = np.arange(1, int(band[1] * period) + 1)
    frequency = numbers / period
    fall = np.clip((frequency - band[0]) / (band[1] - band[0]), 0.0, 1.0)
    # Transform of a half sine about its middle; the limit at f = 1 / (2 contact) is pi / 4.
    x = 2.0 * frequency * contact
    smooth = np.abs(x - 1.0) < 1e-6
    shape = np.where(smooth, np.pi / 4.0, np.cos(np.pi * x / 2.0) / np.where(smooth, 1.0, 1.0 - x**2))
    shape = shape * np.cos(0.5 * np.pi * fall) ** 2
    middle = HIT_DELAY * period + 0.5 * contact
    amplitudes = shape * np.exp(-2j * np.pi * frequency * middle)
    wave = 0.5 + _synthesize(numbers, amplitudes, 1 / period, time)
    return np.asarray(wave * level / np.sqrt(0.25 + 0.5 * np.sum(shape**2)))


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
    earlier_cycles = np.floor(time / period) * (band[0] + band[1]) * period / 2
    wave: Array = level * np.sqrt(2) * np.sin(2 * np.pi * (cycles + earlier_cycles))
    return wave


def stepped_sine(time: Array, frequencies: Array, dwell: float, level: float) -> Array:
    """Sine (n,) of rms `level` that dwells `dwell` s at each of `frequencies` (k,) [Hz]; with continuous phase."""
    place = np.minimum((time / dwell).astype(int), len(frequencies) - 1)
    ended = np.concatenate([[0.0], np.cumsum(frequencies * dwell)])[place]
    wave: Array = level * np.sqrt(2) * np.sin(2 * np.pi * (ended + frequencies[place] * (time - place * dwell)))
    return wave
