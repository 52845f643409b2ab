"""Loads in time: sweeps of four kinds, and what a rotor does; all without content above the band."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Waveform = Callable[[Array], Array]

# Periods of the lowest mode in one period of a periodic sweep, and periods in a record.
CYCLES_PER_PERIOD, PERIODS = 45.0, 5


def multisine(period: float, band: tuple[float, float], rng: np.random.Generator) -> Waveform:
    """Sines of equal size and random phase on all lines of the period within the band; rms 1."""
    first, last = int(np.ceil(band[0] * period)), int(np.floor(band[1] * period))
    spectrum = np.zeros(last + 1, complex)
    spectrum[first:] = np.exp(1j * rng.uniform(0, 2 * np.pi, last + 1 - first))
    return periodic(period, spectrum / np.sqrt(0.5 * (last + 1 - first)))


def periodic(period: float, spectrum: Array | NDArray[np.complex128]) -> Waveform:
    """Sum of Re spectrum[k] exp(j 2 pi k t / period), on any grid of equal steps."""

    def waveform(time: Array) -> Array:
        step = time[1] - time[0]
        count = round(period / step)
        if abs(count * step - period) < 1e-9 * period and count >= 2 * len(spectrum):
            full = np.zeros(count // 2 + 1, complex)
            full[: len(spectrum)] = spectrum
            one = np.fft.irfft(full, count) * count / 2
            return np.asarray(one[np.round(time / step).astype(int) % count])
        result = np.zeros(len(time))
        for k in np.flatnonzero(spectrum):
            result += np.real(spectrum[k] * np.exp(2j * np.pi * k / period * time))
        return result

    return waveform


def sine_sweep(period: float, band: tuple[float, float], rng: np.random.Generator) -> Waveform:
    """A swept sine that repeats, its content outside the band taken off; rms 1."""
    count = int(2 ** np.ceil(np.log2(8 * band[1] * period)))
    time = np.arange(count) / count * period
    rising = band[0] * time + (band[1] - band[0]) * time**2 / (2 * period)
    spectrum = np.fft.rfft(np.cos(2 * np.pi * rising + rng.uniform(0, 6.28))) * 2 / count
    spectrum = spectrum[: int(band[1] * period) + 1]
    spectrum[: int(np.ceil(band[0] * period))] = 0
    return periodic(period, spectrum / np.sqrt(0.5 * np.sum(abs(spectrum) ** 2)))


def stepped(duration: float, band: tuple[float, float], steps: int) -> Waveform:
    """A sine of one frequency after the other with smooth changes; rms 1."""
    frequency = np.geomspace(*band, steps)
    dwell = duration / steps

    def waveform(time: Array) -> Array:
        position = np.clip(time / dwell, 0, steps - 1e-9)
        step = np.floor(position).astype(int)
        inside = position - step
        phase = 2 * np.pi * frequency[step] * (time - step * dwell)
        edge = np.clip(np.minimum(inside, 1 - inside) / 0.1, 0, 1)
        return np.asarray(np.sqrt(2) * np.sin(phase) * np.sin(np.pi / 2 * edge) ** 2 * (time >= 0))

    return waveform


def from_rest(waveform: Waveform, rise: float) -> Waveform:
    """The waveform switched on at the first sample, smoothly."""
    return lambda time: waveform(time) * np.sin(np.pi / 2 * np.clip(time / rise, 0, 1)) ** 2


def rotor(azimuth: Waveform, harmonics: NDArray[np.complex128], random: list[Waveform]) -> Callable[[Array], Array]:
    """Loads (m, 6) with complex harmonics (n, 6), cosine minus j sine, of the azimuth, and random ones beside them."""

    def loads(time: Array) -> Array:
        psi = azimuth(time)
        result = np.column_stack([waveform(time) for waveform in random])
        for n, amplitude in enumerate(harmonics):
            if n:
                result += np.real(np.exp(1j * n * psi)[:, None] * amplitude)
        return result

    return loads
