"""The spectrum of a rotor harmonic itself: narrow at constant speed, as wide as the speed drifts otherwise.

A load exp(j n psi(t)) drives a channel through T over that whole band. What regression on azimuth then finds is

    integral w conj(b) (h * b) dt / integral w |b|^2 dt = sum_k S_k T(f_k),   b = exp(j n psi),  S_k = conj(W_k) B_k

with B the spectrum of b, W that of w b (Parseval), and S scaled to add up to one. At constant speed it is T at n times
the speed; where speed drifts beside a lightly damped mode the two differ by per cent.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from balance_cli.signals.rotor.azimuth import Azimuth
from balance_cli.signals.rotor.harmonics import Harmonics, edge_weight

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

# Lines with less than this share of the largest weight are left out; the weights fall off fast on both sides.
LEAST_LINE_WEIGHT = 1e-4
# Samples per second for each harmonic's band: the carrier is taken down to zero frequency first.
SAMPLES_PER_HZ_OF_SPEED = 4.0


@dataclass(frozen=True)
class HarmonicLines:
    """Frequencies (g,) [Hz] that harmonic n holds, and their complex weights (g,), which add up to one."""

    frequency: Array
    weight: ComplexArray


def harmonic_lines(azimuth: Azimuth, spectra: Harmonics, n: int, decay_time: float) -> HarmonicLines:
    """Lines of harmonic n over the interval of `spectra`; `memory` [s] is how long the balance remembers.

    Beyond the pulses the rotor is taken to go on at the speed that it has there.
    """
    rate = SAMPLES_PER_HZ_OF_SPEED * azimuth.mean_rate
    carrier = float(spectra.frequency_hz[n])
    start, stop = azimuth.first - 2 * decay_time, azimuth.last + 2 * decay_time
    time = np.arange(start, stop, 1.0 / rate)
    turns = azimuth.extrapolated_count(time)
    baseband = np.exp(2j * np.pi * (n * turns - carrier * time)) * _end_taper(time, azimuth, decay_time)
    inside = (time >= spectra.interval[0]) & (time <= spectra.interval[1])
    weight = np.where(inside, edge_weight(turns, *spectra.revolutions), 0.0)
    B, W = np.fft.fft(baseband), np.fft.fft(weight * baseband)
    S = np.conj(W) * B
    kept = np.abs(S) > LEAST_LINE_WEIGHT * np.abs(S).max()
    frequency = carrier + np.fft.fftfreq(len(time), 1.0 / rate)[kept]
    order = np.argsort(frequency)
    return HarmonicLines(frequency[order], (S[kept] / S[kept].sum())[order])


def _end_taper(time: Array, azimuth: Azimuth, decay_time: float) -> Array:
    """One up to `memory` beyond the pulses, then a cosine down to zero, so that the ends cast no wide skirts."""
    beyond = np.maximum(np.maximum(azimuth.first - time, time - azimuth.last) / decay_time - 1.0, 0.0)
    return np.asarray(0.5 + 0.5 * np.cos(np.pi * np.clip(beyond, 0.0, 1.0)))
